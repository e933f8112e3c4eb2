"""Plants that taught no controller: each is recorded under its PI, learned from its file, and judges what comes out.

`make plants` does so for five seeds and writes reports/reference/plants.csv and plants.md; what results/plants.csv holds of the
same commit is not run again. The plant as recorded, and plants with 0.7 or 1.3 times its gain and its time constants and a sample
more of dead time, play episodes with set points over the recorded range and a load step.
"""

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from ruamel.yaml import YAML
from scipy.linalg import block_diag
from scipy.signal import cont2discrete, tf2ss
from torch import Tensor

from helpers.learning.tracking_policy import Gains, TrackingPID
from helpers.own_plant import gate, learn, online
from helpers.plant.rollout import stream
from helpers.plant.tracking import Bounds, track
from helpers.runs.artifacts import code_revision
from helpers.runs.scratch import beside
from helpers.runs.sources import PROJECT

FOUND, SO_FAR = PROJECT / "reports/reference", PROJECT / "results/plants.csv"  # git ignores the latter
DT, HOLD, STEPS = 5.0, 120, 40  # s, samples of a step of the set point, steps in a record
NOISE, DRIFT, KEPT = 0.1, 0.02, 0.95  # of a measurement; of a disturbance that wanders, and what of it is left after a sample
OFF = {"as recorded": (1.0, 1.0, 0)} | {f"gain {g:g}, time {t:g}, later": (g, t, 1) for g, t in product((0.7, 1.3), (0.7, 1.3))}
EPISODES, REPEATS = 60, 20

Channel = tuple[list[float], list[float], int]  # numerator and denominator in s, dead time in samples


@dataclass(frozen=True)
class Loops:
    """A plant: channels by (output, input), PI loops (output, input, gain, gain over time), and how far set points go."""

    channels: dict[tuple[int, int], Channel]
    loops: tuple[tuple[int, int, float, float], ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def n_outputs(self) -> int:
        """How many are measured."""
        return 1 + max(output for output, _ in self.channels)

    @property
    def n_inputs(self) -> int:
        """How many inputs there are."""
        return 1 + max(entry for _, entry in self.channels)


ONE = ((0, 0, 0.7, 0.012),)
PLANTS = {
    "dead time 0": Loops({(0, 0): ([2.0], [40, 1], 0)}, ((0, 0, 0.6, 0.012),), (-15,), (20,)),
    "dead time 2": Loops({(0, 0): ([0.8], [60, 1], 2)}, ((0, 0, 2.0, 0.02),), (-10,), (20,)),
    "dead time 4": Loops({(0, 0): ([1.2], [50, 1], 4)}, ((0, 0, 0.8, 0.012),), (-15,), (20,)),
    "underdamped": Loops({(0, 0): ([1.0], [400, 12, 1], 0)}, ((0, 0, 0.3, 0.012),), (-15,), (20,)),
    "inverse response": Loops({(0, 0): ([-12, 1.0], [600, 50, 1], 0)}, ONE, (-15,), (20,)),
    "integrating": Loops({(0, 0): ([0.01], [1, 0], 1)}, ((0, 0, 4.0, 0.02),), (-10,), (10,)),
    "2 x 2": Loops(
        {(0, 0): ([1.0], [60, 1], 1), (0, 1): ([0.4], [40, 1], 4), (1, 0): ([0.5], [50, 1], 3), (1, 1): ([1.2], [70, 1], 0)},
        ((0, 0, 1.0, 0.015), (1, 1, 1.0, 0.012)), (-10, -8), (12, 10),
    ),
    "3 x 2": Loops(
        {
            (0, 0): ([1.0], [60, 1], 1), (0, 1): ([0.2], [40, 1], 1), (1, 0): ([0.2], [50, 1], 1), (1, 1): ([1.2], [70, 1], 0),
            (2, 0): ([0.5], [30, 1], 0), (2, 1): ([0.5], [30, 1], 2),
        },
        ((0, 0, 1.0, 0.015), (1, 1, 1.0, 0.012)), (-10, -8), (12, 10),
    ),
}  # fmt: skip


class TransferPlant:
    """Transfer functions with dead time, sampled with the input held, in deviation variables; a `process.Process`.

    Args:
        gain, slower: factors of the gains and of the time constants. later: samples more of dead time.
    """

    def __init__(self, plant: Loops, gain: float = 1.0, slower: float = 1.0, later: int = 0) -> None:
        """Sample the channels and put them side by side."""
        states, entries, reads = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
        for (output, entry), (numerator, denominator, dead) in plant.channels.items():
            top, below = (np.array(part) * slower ** np.arange(len(part) - 1, -1, -1) for part in (numerator, denominator))
            top = top * gain * (1.0 if denominator[-1] else slower)  # an integrator keeps its rate
            a, b, c, *_ = cont2discrete(tf2ss(top, below), DT, method="zoh")
            n, wait = len(a), dead + later
            state = block_diag(a, np.eye(wait, k=-1))  # its own, then the inputs on their way
            enters, read = np.zeros((n + wait, plant.n_inputs)), np.zeros((plant.n_outputs, n + wait))
            if wait:
                state[:n, -1], enters[n, entry] = b[:, 0], 1.0
            else:
                enters[:, entry] = b[:, 0]
            read[output, :n] = c
            for parts, part in ((states, state), (entries, enters), (reads, read)):
                parts.append(part)
        self.n_outputs = self.n_disturbances = plant.n_outputs
        self.n_inputs, wander = plant.n_inputs, KEPT * np.eye(plant.n_outputs)
        entries.append(np.zeros((self.n_outputs, self.n_inputs)))
        self.state, self.entry = (torch.tensor(part) for part in (block_diag(*states, wander), np.vstack(entries)))
        self.read = torch.tensor(np.hstack([*reads, np.eye(self.n_outputs)]))
        self.n_states = len(self.state)

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The state one sample later."""
        moved = x.double() @ self.state.T + u.double() @ self.entry.T
        moved[:, -self.n_outputs :] += DRIFT * noise
        return moved.to(x.dtype)

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """What is measured."""
        return (x.double() @ self.read.T).to(x.dtype) + NOISE * noise


def record(plant: Loops, seed: int) -> pd.DataFrame:
    """The historian file of a plant under its PI: set points over the range, every other step back to the middle."""
    draws, n = stream(seed, "record"), HOLD * STEPS
    tracked, low, high = [loop[0] for loop in plant.loops], torch.tensor(plant.low).double(), torch.tensor(plant.high).double()
    aims = torch.zeros(STEPS, plant.n_outputs, dtype=torch.float64)
    aims[1::2, tracked] = low + (high - low) * torch.rand(STEPS // 2, len(tracked), generator=draws, dtype=torch.float64)
    aims[1::4, tracked] = high
    set_point = aims.repeat_interleave(HOLD, 0)[:, None]
    gains = torch.zeros(3, plant.n_inputs, plant.n_outputs, dtype=torch.float64)
    for output, entry, proportional, integral in plant.loops:
        gains[:, entry, output] = torch.tensor([proportional, integral * DT, 0.0])
    ends = torch.full((plant.n_inputs,), 50.0, dtype=torch.float64)
    bounds = Bounds(-ends, ends, torch.full_like(ends, torch.inf))
    scenarios = online.from_rest(TransferPlant(plant), set_point, torch.zeros(n, 1, plant.n_inputs).double(), draws)
    with torch.no_grad():
        run = track(TrackingPID(Gains(gains[0], gains[1], gains[2]), bounds), scenarios, bounds)
    columns = {"TIME": DT * np.arange(n)} | {f"Y{i}": 75 + run.y[:-1, 0, i] for i in range(plant.n_outputs)}
    columns |= {f"SP{i}": 75 + set_point[:, 0, i] for i in tracked}
    return pd.DataFrame(columns | {f"U{j}": 50 + run.u[:, 0, j] for j in range(plant.n_inputs)})


def description(name: str, plant: Loops) -> dict[str, Any]:
    """The description of a plant and its historian file."""
    tracked = dict(zip((loop[0] for loop in plant.loops), plant.high, strict=True))
    measured = {"unit": "degC", "low": 0.0, "high": 150.0, "steady_state": 75.0}
    controlled: list[dict[str, Any]] = []
    for i in range(plant.n_outputs):
        aim = (
            {"set_point_tag": f"SP{i}", "set_point": 75.0 + tracked[i]} if i in tracked else {"set_point": 75.0, "error_scale": 1.0}
        )
        controlled.append({"name": f"y{i}", "tag": f"Y{i}", **measured, **aim})
    entry = {"unit": "%", "low": 0.0, "high": 100.0, "steady_state": 50.0}
    manipulated = [{"name": f"u{j}", "tag": f"U{j}", **entry} for j in range(plant.n_inputs)]
    pid = [{"controlled": f"y{i}", "manipulated": f"u{j}", "proportional": p, "integral": k} for i, j, p, k in plant.loops]
    given = {"title": name, "data": "plant.csv", "time": "TIME", "time_unit": "s", "sampling_time": DT, "horizon": 60}
    return given | {"controlled": controlled, "manipulated": manipulated, "pid": pid}


def judged(name: str, seed: int, scale: str = "paper") -> pd.DataFrame:
    """One record of a plant, what is learned from it, and every controller on the plant and those like it; a row each."""
    torch.set_num_threads(1)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        record(PLANTS[name], seed).to_csv(Path(folder) / "plant.csv", index=False)
        with (Path(folder) / "plant.yaml").open("w", encoding="utf-8") as file:
            YAML().dump(description(name, PLANTS[name]), file)
        plant = learn.open_plant(Path(folder) / "plant.yaml", PROJECT / "params", scale, seed)
        identified, _ = learn.identify_plant(plant)
    workshop = learn.open_workshop(plant, identified)
    tuned, predictive = learn.tune(workshop)
    policy, _ = learn.learn_policy(workshop, tuned)
    controllers = learn.candidates(workshop, tuned, predictive, policy)
    verdict = learn.pass_gate(workshop, controllers)
    told = {"plant": name, "seed": seed, "released": verdict.released, "keep": verdict.keep, "seconds": time.process_time() - began}
    if verdict.released:
        improvement = online.improve_on_plant(workshop, identified, policy, TransferPlant(PLANTS[name]))
        controllers["policy, after the episodes"] = improvement.policy
        told |= {"exploring, worse": improvement.worse, "taken over": improvement.taken}
    rows = []
    for off, factors in OFF.items():
        truth = TransferPlant(PLANTS[name], *factors)
        episodes = online.plant_episodes(workshop, truth, EPISODES, stream(seed, "truth"))
        rested = online.at_set_points(workshop, truth, controllers, REPEATS).groupby("controller")["offset"].max()
        of_record = workshop.operation.figures(controllers[gate.RECORD], episodes)
        for controller, tracker in controllers.items():
            shares = (
                (own / its).mean().item() for own, its in zip(workshop.operation.figures(tracker, episodes), of_record, strict=True)
            )
            found = dict(zip(("mean |e|", "movement"), shares, strict=True))
            rows.append(told | {"truth": off, "controller": controller, **found, "offset": rested[controller]})
    return pd.DataFrame(rows)


def summary(found: pd.DataFrame) -> str:
    """Medians over the seeds, as Markdown: each controller on the plant as recorded, and on the worst of those like it."""
    own, others = (found[(found["truth"] == "as recorded") == which] for which in (True, False))
    keys, lines = ["plant", "controller"], []
    worst = others.groupby([*keys, "seed"])["mean |e|"].max().groupby(keys).median().rename("mean abs(e), worst of four unlike it")
    there = own.groupby(keys, sort=False)[["mean |e|", "movement", "offset"]].median()
    names = {"mean |e|": "mean abs(e)", "movement": "movement", "offset": "offset, share of the range"}
    table = there.rename(columns=names).join(worst).loc[lambda rows: rows.index.get_level_values(1) != gate.RECORD]
    lines.append(table.reset_index().to_markdown(index=False, floatfmt=".3f"))
    once = own[own["controller"] == gate.POLICY].groupby("plant", sort=False)
    kept = once["keep"].agg(lambda names: ", ".join(f"{name} ({count})" for name, count in names.value_counts().items()))
    verdicts = pd.DataFrame(
        {"released, of seeds": once["released"].sum().astype(str) + " of " + once.size().astype(str), "to keep": kept}
    )
    if "exploring, worse" in own:
        verdicts["exploring episodes worse than the PI, %"] = 100 * once["exploring, worse"].median()
    verdicts["seconds of processor"] = once["seconds"].median().round()
    lines += ["", verdicts.reset_index().to_markdown(index=False, floatfmt=".0f")]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m torture.plants", description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cores", type=int, default=2)
    given = parser.parse_args(arguments)
    path, revision = SO_FAR, code_revision(PROJECT)
    path.parent.mkdir(exist_ok=True)
    found = pd.read_csv(path) if path.is_file() else pd.DataFrame({"plant": [], "seed": [], "revision": []})
    found = found[found["revision"] == revision]
    done = set(zip(found["plant"], found["seed"], strict=True))
    waiting = [(name, seed) for seed in range(given.seeds) for name in PLANTS if (name, seed) not in done]
    with ProcessPoolExecutor(given.cores) as pool:
        for rows in pool.map(judged, *zip(*waiting, strict=True)) if waiting else ():
            found = pd.concat([found, rows.assign(revision=revision)], ignore_index=True)
            found.to_csv(beside(path), index=False, float_format="%.6g")
            beside(path).replace(path)
            print(f"{rows['plant'][0]}, seed {rows['seed'][0]}: {rows['seconds'][0]:.0f} s, keep: {rows['keep'][0]}", flush=True)
    words = (
        "# Plants that taught no controller",
        f"Written by `make plants` at `{revision}`: medians over {given.seeds} seeds; mean abs(e) and movement are "
        "shares of those of the PI of the record, over set points of the whole range and a load step.",
        summary(found),
    )
    shutil.copy2(path, FOUND / "plants.csv")
    (FOUND / "plants.md").write_text("\n\n".join(words) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
