"""A guarded policy stepped sample by sample on whatever stands for the plant, as it would be on the plant itself."""

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import pandas as pd
import torch

from helpers.own_plant.guard import Guard
from helpers.plant.process import Process


@dataclass(frozen=True)
class Trial:
    """What happens when, in samples: the operator hands over, the set points move, a sensor fails for a while.

    Attributes:
        faulty: which controlled variable fails, by its place.
    """

    n_samples: int
    hand_over: int
    step: int
    fault: range
    faulty: int


def commission(guard: Guard, process: Process, trial: Trial, generator: torch.Generator) -> tuple[pd.DataFrame, list[float]]:
    """Run a trial from the steady state to the set points of the description; engineering units.

    Returns:
        A row a sample (mode, a column for each variable, `<name>_sp` for the set points), and the seconds that each step took.
    """
    description = guard.description
    steady_y, steady_u = description.steady("controlled"), description.steady("manipulated")
    target, outputs = description.values("controlled", "set_point"), description.names("controlled")
    shape = (trial.n_samples, 1)
    kicks = torch.randn(*shape, process.n_disturbances, generator=generator, dtype=torch.float64)
    errors = torch.randn(*shape, process.n_outputs, generator=generator, dtype=torch.float64)
    x, rows, seconds = torch.zeros(1, process.n_states, dtype=torch.float64), [], []
    for t in range(trial.n_samples):
        y = (process.observe(x, errors[t])[0] + steady_y).numpy()
        set_point = target if t >= trial.step else steady_y.numpy()
        if t in trial.fault:
            y[trial.faulty] = np.nan
        begin = perf_counter()
        if t < trial.hand_over:
            u = steady_u.numpy()
            guard.follow(y, set_point, u)
        else:
            u = guard.step(y, set_point)
        seconds.append(perf_counter() - begin)
        rows.append((str(guard.mode), *y, *u, *set_point))
        x = process.step(x, torch.tensor(u)[None] - steady_u, kicks[t])
    columns = ["mode", *outputs, *description.names("manipulated"), *(f"{name}_sp" for name in outputs)]
    return pd.DataFrame(rows, columns=columns), seconds
