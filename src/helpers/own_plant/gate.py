"""The gate: no controller is released before it has shown on models held out that it is better than the one of the record."""

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd
import torch

from helpers.own_plant.operation import Operation
from helpers.own_plant.settings import GateParams
from helpers.plant.tracking import Scenarios, Tracked, Tracker, track

RECORD, TUNED, PREDICTIVE, POLICY = "PID of the record", "re-tuned PID", "predictive control", "policy"
NORMAL = 1.645  # the 95 % point of the standard normal distribution
SIMPLEST = (RECORD, TUNED, PREDICTIVE, POLICY)  # of two controllers that do as well, the one to keep


@dataclass(frozen=True)
class Verdict:
    """What the gate found.

    Attributes:
        table: a row a controller: mean |e| and movement as shares of those of the record's PID, share of the models on which it
            is better, offset as a share of the range, mean |e| in the worst corner of the margins, in how many corners it is above
            that of the record's PID by more than chance, whether it passes. models: the first two on each model, a row each.
        released: whether the policy passes. keep: the controller to keep. words: the sentence that says so.
    """

    table: pd.DataFrame
    models: pd.DataFrame
    released: bool
    keep: str
    words: str


def offsets(run: Tracked, operation: Operation) -> torch.Tensor:
    """|e| at the end of each undisturbed episode, of the worst loop, in ranges of the set points, (K,)."""
    error = (run.error.abs() / operation.reach)[..., list(operation.loops)].amax(-1)
    return error[-1]


def judge(
    candidates: Mapping[str, Tracker], episodes: tuple[Scenarios, Scenarios, Scenarios], operation: Operation, allowed: float,
    params: GateParams,
) -> Verdict:  # fmt: skip
    """Every candidate on the same episodes.

    Args:
        candidates: by name, the record's PID first. allowed: movement, as a multiple of that of the record's PID.
        episodes: of models held out, several of each after each other; undisturbed ones, which tell the offset; and
            `corner_episodes` of each corner of the margins.
    """
    noisy, quiet, corners = episodes
    rows, errors, at_corners, models = {}, {}, {}, []
    with torch.no_grad():
        for name, tracker in candidates.items():
            run = track(tracker, noisy, operation.bounds)
            errors[name], movement = (
                value.double().reshape(-1, params.episodes).mean(1) for value in (operation.error(run), operation.movement(run))
            )
            if name == RECORD:
                moved = movement
            parts = {"mean |e|": errors[name] / errors[RECORD], "movement": movement / moved}
            models.append(pd.DataFrame(parts).assign(controller=name))
            at_ends = operation.error(track(tracker, corners, operation.bounds)).double()
            at_corners[name] = at_ends.reshape(-1, params.corner_episodes)
            rest = offsets(track(tracker, quiet, operation.bounds), operation)
            rows[name] = {
                "mean |e|": (errors[name] / errors[RECORD]).mean().item(),
                "movement": (movement.mean() / moved.mean()).item(),
                "better": (errors[name] < errors[RECORD]).double().mean().item(),
                "offset": rest.nan_to_num(torch.inf).quantile(params.better).item(),
                "worst corner": (at_corners[name].mean(1) / at_corners[RECORD].mean(1)).nan_to_num(torch.inf).max().item(),
                "corners lost": _lost(at_corners[name] - at_corners[RECORD]),
            }
    table = pd.DataFrame(rows).T
    fine = (table["better"] >= params.better) & (table["movement"] <= allowed) & (table["offset"] <= params.offset)
    fine &= table["corners lost"] == 0
    table["passes"] = fine
    released = bool(fine.get(POLICY, False))
    passing = [name for name in SIMPLEST if name in rows and (name == RECORD or fine[name])]
    best = min(table.loc[name, "mean |e|"] for name in passing)
    keep = next(name for name in passing if table.loc[name, "mean |e|"] <= best * (1 + params.close))
    return Verdict(table, pd.concat(models, ignore_index=True), released, keep, _words(table, released, keep, allowed, params))


def _lost(excess: torch.Tensor) -> int:
    """In how many corners errors above those of the record's PID, (corners, episodes) on the same draws, are more than chance.

    By a one-sided paired test at the level of 5 %; errors that are not finite are lost.
    """
    mean, error = excess.mean(1), excess.std(1) / excess.shape[1] ** 0.5
    return int((~(mean <= NORMAL * error)).sum())


def _words(table: pd.DataFrame, released: bool, keep: str, allowed: float, params: GateParams) -> str:
    """The first line of the report."""

    def share(name: str) -> str:
        error, movement = table.loc[name, "mean |e|"], table.loc[name, "movement"]
        return f"its mean |e| is {100 * error:.0f} % of that of the record's PID at {100 * movement:.0f} % of its movement"

    if keep == POLICY:
        better = f"it is better on {100 * table.loc[POLICY, 'better']:.0f} % of the models"
        return f"verdict: release the policy: on models held out {share(POLICY)}, and {better}"
    policy = table.loc[POLICY]
    rival = "" if keep == RECORD else f"; {keep} would do: {share(keep)}"
    if released:
        return f"verdict: the policy may be released ({share(POLICY)}), but {keep} is as good and simpler: {share(keep)}"
    faults = [
        words
        for bad, words in (
            (policy["better"] < params.better, f"it is better on only {100 * policy['better']:.0f} % of the models"),
            (policy["movement"] > allowed, f"it moves the inputs {policy['movement']:.2f} times as much"),
            (policy["offset"] > params.offset, f"it leaves an offset of {100 * policy['offset']:.1f} % of the range"),
            (policy["corners lost"] > 0, f"at an end of the margins its mean |e| is {100 * policy['worst corner']:.0f} %"),
        )
        if bad
    ]
    return f"verdict: keep the PID: the policy is not released: {' and '.join(faults)}{rival}"
