"""The historian file of the nonlinear tank: `python -m helpers.own_plant.tank_history` writes notebooks/plant/tank.csv again.

A tank under PI control, recorded sample by sample as a plant records it: set point steps to and fro, an operator's moves by
hand, a drifting feed, sensor noise, and faults of the recording.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from scipy.signal import lfilter
from torch import Tensor

from helpers.own_plant.tank import HistoryParams, NonlinearTank, load_tank
from helpers.plant.controllers import PID, PIDMemory
from helpers.plant.rollout import stream
from helpers.runs.sources import PROJECT
from helpers.settings.paper import GainParams, Params, load

FILE = PROJECT / "notebooks/plant/tank.csv"
LOOPS = ("AC101", "TC101")  # the tags of the loops: .PV what is measured, .SP the set point, .OP the input
START = pd.Timestamp("2026-01-05")
AUTOMATIC, MANUAL, BAD = "AUTO", "MAN", "Bad"


@dataclass(frozen=True)
class Plan:
    """What happens at each of N samples: set point (N, n_y), move by hand (N, n_u), nan in automatic, feed drift (N,) in K."""

    set_point: Tensor
    by_hand: Tensor
    drift: Tensor

    @classmethod
    def draw(cls, params: HistoryParams, set_point: Sequence[float], generator: torch.Generator) -> "Plan":
        """Rest and set point step in turn; by hand, an input moves about where it was."""
        span = torch.tensor(params.input_high, dtype=torch.float64) - torch.tensor(params.input_low, dtype=torch.float64)
        block = params.rest + params.hold
        n_samples = block * params.cycles
        targets = torch.zeros(n_samples, len(set_point), dtype=torch.float64)
        by_hand = torch.full((n_samples, len(span)), torch.nan, dtype=torch.float64)
        length = params.manual_samples // 4
        for cycle in range(params.cycles):
            step = cycle * block + params.rest
            other = cycle % params.other_every == params.other_every - 1
            targets[step : step + params.hold] = torch.tensor(params.other_set_point if other else set_point)
            if cycle % params.manual_every == 0:
                first = cycle * block + params.rest // 4
                moves = torch.rand(4, len(span), generator=generator, dtype=torch.float64) * 2 - 1
                by_hand[first : first + 4 * length] = (params.manual_move * span * moves).repeat_interleave(length, 0)
        keep = 1 - 1 / params.drift_time  # an Ornstein-Uhlenbeck process, sample by sample
        kicks = torch.randn(n_samples, generator=generator, dtype=torch.float64) * (1 - keep**2) ** 0.5
        kicks[0] = 0
        return cls(targets, by_hand, torch.tensor(lfilter([params.drift], [1, -keep], kicks)))


def record(tank: NonlinearTank, params: HistoryParams, plan: Plan, generator: torch.Generator) -> pd.DataFrame:
    """Run the plan under PI control; a row for each sample, engineering units.

    By hand an input is where the PI left it plus the operator's move. On return to automatic the integral is set so that the
    input does not jump.
    """
    n_samples = len(plan.drift)
    noise = torch.randn(n_samples, 2, 1, tank.n_states, generator=generator, dtype=torch.float64)
    steady_y, steady_u = torch.tensor(tank.steady.controlled), torch.tensor(tank.steady.manipulated)
    x = torch.zeros(1, tank.n_states, dtype=torch.float64)
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (params.input_low, params.input_high))
    none = (0.0,) * tank.n_inputs
    gains = GainParams.model_construct(proportional=params.proportional, integral=params.integral, derivative=none)
    pid = PID(gains, plan.set_point[0], tank.sampling_time)
    memory = pid.start(1, n_samples, generator)
    u = held = torch.zeros(1, tank.n_inputs, dtype=torch.float64)
    rows: list[Tensor] = []
    modes: list[str] = []
    for t in range(n_samples):
        y = tank.observe(x, noise[t, 0])
        pid.set_point = plan.set_point[t]
        manual = not plan.by_hand[t].isnan().any()
        if manual:
            held = held if modes and modes[-1] == MANUAL else u
            u = (held + plan.by_hand[t]).clamp(low, high)
        else:
            if modes and modes[-1] == MANUAL:
                error = pid.set_point - y
                memory = PIDMemory((u - pid.proportional * error) / pid.integral - error * tank.sampling_time, error)
            command, memory = pid.act(y, memory)
            u = command.clamp(low, high)
        rows.append(torch.cat([y[0] + steady_y, pid.set_point + steady_y, u[0] + steady_u]))
        modes.append(MANUAL if manual else AUTOMATIC)
        x = tank.step(x, u, noise[t, 1], plan.drift[t].item())
    columns = [f"{loop}.{signal}" for signal in ("PV", "SP", "OP") for loop in LOOPS]
    table = pd.DataFrame(torch.stack(rows).numpy(), columns=columns).assign(MODE=modes)
    seconds = pd.Timedelta(tank.sampling_time, tank.time_unit)
    return table.assign(TIME=START + np.arange(n_samples) * seconds)[["TIME", *columns, "MODE"]]


def spoil(table: pd.DataFrame, n_faults: int, seed: int) -> pd.DataFrame:
    """What a recording suffers: gaps short and long, doubled rows, spikes, frozen sensors, bad values and late stamps.

    Every kind strikes `n_faults` times, at rows drawn at random.
    """
    rng = np.random.default_rng(seed)
    spoilt = table.copy()
    sampling = table["TIME"].diff().median()

    def rows(length: int) -> list[slice]:
        return [slice(first, first + length - 1) for first in rng.integers(100, len(table) - 100, n_faults)]

    measured = [f"{loop}.PV" for loop in LOOPS]
    for place in rows(1):
        tag = rng.choice(measured)
        spoilt.loc[place, tag] += 12 * table[tag].std() * rng.choice([-1, 1])
    for place in rows(30):
        tag = rng.choice(measured)
        spoilt.loc[place, tag] = spoilt.loc[place.start, tag]
    for place in rows(1):
        spoilt.loc[place, "TIME"] += sampling * rng.uniform(0.1, 0.3)
    text = spoilt.astype(object)
    for column in table.select_dtypes("number"):
        text[column] = spoilt[column].map(("{:.4f}" if column.startswith(LOOPS[0]) else "{:.3f}").format)
    text["TIME"] = spoilt["TIME"].dt.strftime("%Y-%m-%dT%H:%M:%S.%f").str[:-5]
    for place in rows(2):
        text.loc[place, rng.choice(measured)] = BAD
    doubled = [place.start for place in rows(1)]
    lost = [row for length in (2, 45) for place in rows(length) for row in range(place.start, place.stop + 1)]
    return pd.concat([text, text.loc[doubled]]).sort_index(kind="stable").drop(index=sorted({*lost} - {*doubled}))


def make_history(params: Params, seed: int = 0) -> pd.DataFrame:
    """The whole historian file of the tank, as text."""
    tank, tank_params = load_tank(PROJECT / "params", params.process)
    history = tank_params.history
    generator = stream(seed, "tank history")
    plan = Plan.draw(history, params.case.set_point, generator)
    table = record(tank, history, plan, generator)
    return spoil(table, history.faults, seed)


def main() -> int:
    """Write the file that is committed; returns the exit status."""
    table = make_history(load(PROJECT / "params", 1))
    FILE.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(FILE, index=False)
    print(f"written: {FILE.relative_to(PROJECT)}, {len(table)} rows, {FILE.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
