"""The plants that taught no controller: their channels, their records, and what is told of them."""

from concurrent.futures import ThreadPoolExecutor
from itertools import product

import numpy as np
import pandas as pd
import pytest
import torch

from helpers.own_plant import gate
from torture import plants


@pytest.mark.parametrize(("gain", "slower", "later"), [(1.0, 1.0, 0), (0.7, 1.3, 1)])
def test_a_channel_answers_a_step_as_its_transfer_function_says(gain, slower, later):
    plant = plants.TransferPlant(plants.PLANTS["2 x 2"], gain, slower, later)
    x, u, quiet, found = torch.zeros(1, plant.n_states).double(), torch.tensor([[1.0, 0.0]]).double(), torch.zeros(1, 2), []
    for _ in range(40):
        found.append(plant.observe(x, quiet)[0].numpy())
        x = plant.step(x, u, quiet)
    for of_output, (size, constant, dead) in zip(np.array(found).T, ((1.0, 60, 1), (0.5, 50, 3)), strict=True):
        waited = plants.DT * np.clip(np.arange(40) - dead - later, 0, None)
        np.testing.assert_allclose(of_output, gain * size * (1 - np.exp(-waited / (slower * constant))), atol=1e-12)


def test_a_record_covers_its_range_and_is_that_of_its_seed():
    plant = plants.PLANTS["dead time 4"]
    first, again, other = (plants.record(plant, seed) for seed in (0, 0, 1))
    pd.testing.assert_frame_equal(first, again)
    assert not first.equals(other)
    assert 75 + plant.low[0] <= first["SP0"].min() < first["SP0"].max() == 75 + plant.high[0]


def test_the_summary_holds_medians_and_verdicts():
    places = product(range(3), ("as recorded", "other"), (gate.RECORD, gate.POLICY))
    found = pd.DataFrame(places, columns=["seed", "truth", "controller"]).assign(plant="tank", keep=gate.POLICY, seconds=60.0)
    errors = found["truth"].map({"as recorded": 0.4, "other": 0.5}) * (1 + found["seed"])
    told = plants.summary(found.assign(movement=1.0, offset=0.01, released=found["seed"] > 0, **{"mean |e|": errors}))
    line = next(row for row in told.splitlines() if row.startswith("| tank") and gate.POLICY in row)
    assert [cell.strip() for cell in line.split("|")[2:-1]] == [gate.POLICY, "0.800", "1.000", "0.010", "1.000"]
    assert "2 of 3" in told
    assert "policy (3)" in told


def test_what_was_judged_at_the_same_commit_is_not_judged_again(tmp_path, monkeypatch):
    asked = []

    def judged(name, seed):
        asked.append((name, seed))
        row = {"plant": name, "seed": seed, "released": True, "keep": gate.POLICY, "seconds": 1.0, "truth": "as recorded"}
        return pd.DataFrame([row | {"controller": gate.POLICY, "mean |e|": 0.9, "movement": 1.0, "offset": 0.0}])

    names = {"FOUND": tmp_path, "SO_FAR": tmp_path / "results/plants.csv", "judged": judged}
    for name, value in (names | {"ProcessPoolExecutor": ThreadPoolExecutor, "code_revision": lambda _: "abc"}).items():
        monkeypatch.setattr(plants, name, value)
    for seeds, new in (("1", 8), ("1", 0), ("2", 8)):
        asked.clear()
        assert plants.main(["--seeds", seeds]) == 0
        assert len(asked) == new
    assert len(pd.read_csv(tmp_path / "plants.csv")) == 16
