"""Episodes and stretches out of a clean record: what the policy learns from, and what the model is identified from."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from helpers.own_plant.description import ControlledVariable, PlantDescription
from helpers.own_plant.quality import CleanRecords
from helpers.own_plant.settings import QualityParams
from helpers.plant.task import Trajectories
from helpers.settings.leaf import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Stretch:
    """Consecutive samples without a break, deviation variables: outputs y (n, n_y), inputs u (n, n_u)."""

    y: Array
    u: Array

    def __len__(self) -> int:
        return len(self.y)

    def __getitem__(self, part: slice) -> "Stretch":
        return Stretch(self.y[part], self.u[part])


@dataclass(frozen=True)
class Episodes:
    """Demonstrations of one task.

    Attributes:
        trajectories: with y in the place of x, which a plant does not show; the command is the input.
        before: the inputs one sample before each episode, shape (K, n_u); after a break those of its first sample.
        starts: the rows of the file where they begin.
        left_out: how many more began, by the reason why they do not count.
    """

    trajectories: Trajectories
    before: torch.Tensor
    starts: tuple[int, ...]
    left_out: dict[str, int]


def signals(clean: CleanRecords, description: PlantDescription) -> tuple[Array, Array]:
    """Outputs and inputs of every sample in deviation variables, (N, n_y) and (N, n_u)."""
    y = clean.table[[variable.tag for variable in description.controlled]].to_numpy() - description.steady("controlled").numpy()
    u = clean.table[[variable.tag for variable in description.manipulated]].to_numpy() - description.steady("manipulated").numpy()
    return y, u


def stretches(clean: CleanRecords, description: PlantDescription, shortest: int) -> list[Stretch]:
    """Every stretch of at least `shortest` samples, whoever was in control."""
    y, u = signals(clean, description)
    runs = _runs(clean.table["segment"].to_numpy())
    return [Stretch(y[first:end], u[first:end]) for first, end in runs if end - first >= shortest]


def episodes(clean: CleanRecords, description: PlantDescription, params: QualityParams, dtype: torch.dtype) -> Episodes:
    """The demonstrations of the description's task: T samples under automatic control after its set point step.

    An episode begins where the set points arrive at those of the task, the loops that move coming from the steady state. Where
    no set point moves, in the task or in the record, stretches at the set point are cut into episodes one after the other.

    Raises:
        InputError: if there are too few, or the record does not come near the set point of the task.
    """
    table, n_steps, moved = clean.table, description.horizon, set_point_moves(clean, description, params)
    at_task, came_from = _set_points(clean, description, params)
    described = any(variable.set_point != variable.steady_state for variable in description.controlled if variable.set_point_tag)
    moving = described and moved
    segment, automatic = table["segment"].to_numpy(), table["automatic"].to_numpy()
    length, arrives = n_steps + 1, at_task[1:] & ~at_task[:-1]
    if moving:
        first = np.flatnonzero(arrives & came_from[:-1]) + 1
    else:
        runs = _runs(np.where(at_task & automatic, segment, -1))
        first = np.array([start for begin, end in runs for start in range(begin, end - length + 1, length)], dtype=int)
    samples = np.minimum(first[:, None] + np.arange(length), len(table) - 1)
    pieces, fits = segment[samples], first + length <= len(table)
    whole = fits & (pieces >= 0).all(1) & (pieces[:, 0] == pieces[:, -1])
    hands_off, held = automatic[samples].all(1), at_task[samples].all(1)
    left_out = {
        "cut short by a break": int((~whole).sum()),
        "not in automatic": int((whole & ~hands_off).sum()),
        "set point moved again": int((whole & hands_off & ~held).sum()),
    }
    starts = first[whole & hands_off & held]
    if len(starts) < params.fewest_episodes:
        reasons = left_out | ({"not from 'steady_state'": int((arrives & ~came_from[:-1]).sum())} if moving else {})
        words = ", ".join(f"{number} {reason}" for reason, number in reasons.items())
        where = "after a step to" if moving else "at"
        raise InputError(
            f"{description.data}: {len(starts)} episodes of {n_steps} samples {where} the set point of the task, expected "
            f"{params.fewest_episodes} or more; left out: {words} (keys 'horizon', 'set_point', 'steady_state')"
        )
    y, u = signals(clean, description)
    index = starts + np.arange(length)[:, None]
    outputs, inputs = torch.tensor(y[index], dtype=dtype), torch.tensor(u[index[:-1]], dtype=dtype)
    previous = np.maximum(starts - 1, 0)
    # Before a break the input is not known, or was another: the first of the episode stands for it.
    before = torch.tensor(u[np.where(segment[previous] == segment[starts], previous, starts)], dtype=dtype)
    rows = tuple(int(row) for row in table["row"].to_numpy()[starts])
    return Episodes(Trajectories(outputs, outputs, inputs, inputs), before, rows, left_out)


def set_point_moves(clean: CleanRecords, description: PlantDescription, params: QualityParams) -> bool:
    """Whether a set point moves in the record.

    Raises:
        InputError: if none of a loop's set points is that of the task, or no measurement comes half the way there.
    """
    moves = [
        _set_point_moves(clean, variable, params.set_point_band * abs(variable.scale), description.data)
        for variable in description.controlled
    ]
    return any(moves)


def _set_point_moves(clean: CleanRecords, variable: ControlledVariable, band: float, data: str) -> bool:
    usable = clean.table["segment"] >= 0
    aim, key = f"that of the task, {variable.set_point:g} {variable.unit}", f"'set_point' of '{variable.name}'"
    moves = False
    if variable.set_point_tag is not None:
        values = clean.table.loc[usable, variable.set_point_tag]
        moves = bool(values.max() - values.min() > band)
        if not (abs(values - variable.set_point) <= band).any():
            found = f"lie between {values.min():g} and {values.max():g}" if moves else f"stay at {values.min():g}"
            raise InputError(
                f"{data}: column '{variable.set_point_tag}': the set points {found}, none is {aim}: change {key}, "
                f"and give 'error_scale' where it equals 'steady_state'"
            )
    values = clean.table.loc[usable, variable.tag]
    if not (abs(values - variable.set_point) <= abs(variable.scale) / 2).any():
        raise InputError(
            f"{data}: column '{variable.tag}': lies between {values.min():g} and {values.max():g}, never near the set point, "
            f"{aim}: change {key}"
        )
    return moves


def _set_points(clean: CleanRecords, description: PlantDescription, params: QualityParams) -> tuple[NDArray, NDArray]:
    """Where all set points are those of the task, and where those of the loops that move are at the steady state."""
    at_task = np.ones(len(clean.table), dtype=bool)
    came_from = at_task.copy()
    for variable in description.controlled:
        if variable.set_point_tag is None:
            continue
        values, band = clean.table[variable.set_point_tag].to_numpy(), params.set_point_band * abs(variable.scale)
        at_task &= np.abs(values - variable.set_point) <= band
        came_from &= np.abs(values - variable.steady_state) <= band
    return at_task, came_from


def _runs(numbers: NDArray) -> list[tuple[int, int]]:
    """First sample and end of every run of the same number, those of negative ones left out."""
    edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1), len(numbers)]
    return [(first, end) for first, end in pairwise(edges) if numbers[first] >= 0]
