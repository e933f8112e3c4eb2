"""The historian file of the tank: its plan, the PI that wrote it, the operator's moves, the faults, and the committed file."""

import pandas as pd
import pytest
import torch

from helpers.own_plant.tank import example, load_tank
from helpers.own_plant.tank_history import AUTOMATIC, BAD, FILE, MANUAL, START, Plan, record, spoil
from helpers.plant.rollout import stream
from helpers.settings.paper import load


@pytest.fixture(scope="module")
def recorded(root):
    """A plan of two set point steps, and what is recorded under it."""
    params = load(root, 1)
    settings = load_tank(root, params.process)[1].history.model_copy(update={"cycles": 2, "other_every": 2})
    plan = Plan.draw(settings, params.case.set_point, stream(0, "plan"))
    table = record(example(), settings, plan, stream(0, "record"))
    return settings, plan, table


def test_rest_and_step_take_turns_every_other_step_goes_elsewhere_and_the_pi_gets_there(recorded):
    settings, plan, table = recorded
    block = settings.rest + settings.hold
    assert len(table) == 2 * block
    targets = plan.set_point[[0, settings.rest - 1, settings.rest, block - 1, block, block + settings.rest]].tolist()
    assert targets == [[0, 0], [0, 0], [-1, 4], [-1, 4], [0, 0], [-1.5, 3]]
    assert table["AC101.SP"][settings.rest] == pytest.approx(2.0)
    assert table["TC101.SP"][settings.rest] == pytest.approx(354.0)
    end = table.iloc[block - 20 : block]  # the PI brings the tank there
    assert end["AC101.PV"].mean() == pytest.approx(2.0, abs=0.1)
    assert end["TC101.PV"].mean() == pytest.approx(354.0, abs=0.5)


def test_the_operator_moves_the_inputs_and_hands_them_back_without_a_jump(recorded):
    settings, plan, table = recorded
    manual = table["MODE"] == MANUAL
    assert manual.sum() == settings.manual_samples
    first, last = manual.idxmax(), manual[::-1].idxmax()
    assert table["MODE"].nunique() == 2
    assert table["AC101.OP"][first : last + 1].nunique() == 4  # so many moves
    expected = table["AC101.OP"][first - 1] + plan.by_hand[first, 0].item()
    assert table["AC101.OP"][first] == pytest.approx(min(max(expected, 3.982), 43.982))
    # The first sample back in automatic: the integral is such that the input stays but for one sample of integration.
    assert table["MODE"][last + 1] == AUTOMATIC
    for tag in ("AC101.OP", "TC101.OP"):
        assert table[tag][last + 1] == pytest.approx(table[tag][last], abs=1e-9)


def test_the_stamps_are_in_the_time_unit_of_the_tank(recorded):
    settings, plan, in_minutes = recorded
    tank = example()
    tank.time_unit = "s"
    in_seconds = record(tank, settings, Plan(plan.set_point[:2], plan.by_hand[:2], plan.drift[:2]), stream(0, "record"))
    steps = [table["TIME"].diff().iloc[1].total_seconds() for table in (in_minutes, in_seconds)]
    assert steps == pytest.approx([2.4, 0.04])


def test_the_recording_suffers_every_kind_of_fault(recorded):
    table = pd.concat([recorded[2]] * 8, ignore_index=True).assign(TIME=lambda t: t["TIME"][0] + t.index * pd.Timedelta("2.4s"))
    spoilt = spoil(table, 3, seed=1)
    bad = (spoilt.drop_duplicates("TIME")[["AC101.PV", "TC101.PV"]] == BAD).sum().sum()
    assert 4 <= bad <= 6  # three pairs, less what fell into a gap
    assert 1 <= spoilt["TIME"].duplicated().sum() <= 3
    steps = pd.to_datetime(spoilt["TIME"]).diff().dt.total_seconds().dropna()
    assert (steps > 40 * 2.4).sum() >= 1
    assert ((steps > 2.5) & (steps < 4)).sum() >= 2
    same = [pd.to_numeric(spoilt[tag], errors="coerce").diff().eq(0) for tag in ("AC101.PV", "TC101.PV")]
    assert (same[0] | same[1]).sum() >= 29


def test_the_committed_file_begins_and_ends_as_it_would_be_written_now(root):
    """The whole takes eight seconds. Its end is recorded from four set point steps before: the loop forgets where it began.

    No fault of the recording strikes the first 100 rows or begins in the last 100, and none lasts longer than 45.
    """
    params = load(root, 1)
    tank, tank_params = load_tank(root, params.process)
    settings = tank_params.history
    written = pd.read_csv(FILE, na_values=BAD)
    assert len(written) > 10_000
    assert FILE.stat().st_size < 1e6

    def recorded_again(first, last):
        generator = stream(0, "tank history")
        plan = Plan.draw(settings, params.case.set_point, generator)
        torch.randn(first, 2, 1, tank.n_states, generator=generator, dtype=torch.float64)  # the noise of the samples before
        part = Plan(plan.set_point[first:last], plan.by_hand[first:last], plan.drift[first:last])
        return record(tank, settings, part, generator)

    n_samples = (settings.rest + settings.hold) * settings.cycles
    last = recorded_again(n_samples - 4 * (settings.rest + settings.hold), n_samples).tail(50)
    seconds = [(pd.Timestamp(time) - START).total_seconds() for time in written["TIME"].tail(50)]
    assert seconds == pytest.approx([60 * tank.sampling_time * sample for sample in range(n_samples - 50, n_samples)])
    for found, expected in ((written.head(100), recorded_again(0, 100)), (written.tail(50), last)):
        assert found["MODE"].tolist() == expected["MODE"].tolist()
        for tag in found.select_dtypes("number"):
            assert found[tag].to_numpy() == pytest.approx(expected[tag].to_numpy(), abs=6e-4), tag  # three or four decimals
