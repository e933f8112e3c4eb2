"""Every controller on plants other than the one of the model, and at set points that it was not trained on."""

from collections.abc import Mapping
from typing import NamedTuple

import pandas as pd

from helpers.evidence.equal_budget import Build, Contest
from helpers.evidence.mismatch import Delayed, LoadStep
from helpers.learning.evaluation import objective
from helpers.learning.policy import LSTMPolicy
from helpers.plant.controllers import Controller
from helpers.plant.process import Process
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.runs.study import Study, copied


class Condition(NamedTuple):
    """A plant, and a set point that the controllers are told of.

    Attributes:
        group: which grid it belongs to; row, column: its place there.
        told: the session that controllers are built for; plant: the one whose process they meet.
    """

    group: str
    row: str
    column: str
    told: Study
    plant: Study
    load: float = 0.0
    dead_time: int = 0


def conditions(contest: Contest) -> list[Condition]:
    """Every plant and set point of params/limits.yaml; at a scale of `corners`, the first and last factor of each list alone."""
    session, params = contest.session, contest.limits.robustness
    process, case = session.params.process, session.params.case
    grids = params.model_dump()
    if contest.scale.corners:
        grids = {name: (values[0], values[-1]) for name, values in grids.items() if name.endswith("_factors")}
    found = []
    for state in grids["state_factors"]:
        for entry in grids["input_factors"]:
            plant = mismatched(session, state, entry)
            found.append(Condition("model", f"{state:g}", f"{entry:g}", session, plant))
    for disturbance in grids["disturbance_factors"]:
        for noise in grids["noise_factors"]:
            changes = {
                "disturbance": tuple(disturbance * gain for gain in process.disturbance),
                "observation_noise": tuple(noise * std for std in process.observation_noise),
            }
            plant = session.varied(process=changes)
            found.append(Condition("noise", f"{disturbance:g}", f"{noise:g}", session, plant))
    for first in grids["set_point_factors"]:
        for others in grids["set_point_factors"]:
            factors = [first, *[others] * (len(case.set_point) - 1)]
            target = tuple(factor * value for factor, value in zip(factors, case.set_point, strict=True))
            told = session.varied(case={"set_point": target})
            found.append(Condition("set_point", f"{first:g}", f"{others:g}", told, told))
    for dead_time in (0, params.dead_time):
        for load in (0.0, params.load):
            found.append(Condition("time", f"{dead_time}", f"{load:g}", session, session, load, dead_time))
    return found


def mismatched(session: Study, state: float, entry: float) -> Study:
    """The session with A and B of Eq. 4.1.3b scaled."""
    process = session.params.process
    drift_state = tuple(tuple(state * value for value in row) for row in process.drift_state)
    drift_input = tuple(tuple(entry * value for value in row) for row in process.drift_input)
    return session.varied(process={"drift_state": drift_state, "drift_input": drift_input})


def robustness(contest: Contest, builds: Mapping[str, Build]) -> pd.DataFrame:
    """The objective on x of every controller under every condition, on the same random draws.

    Columns: group, row, column, controller, objective, standard_error.
    """
    rows = []
    for condition in conditions(contest):
        for name, build in builds.items():
            batch = _under(contest, condition, build(condition.told))
            returns = objective(batch, condition.told.features.on("x"), contest.beta).double()
            error = returns.std().item() / len(returns) ** 0.5
            rows.append((condition.group, condition.row, condition.column, name, returns.mean().item(), error))
    return pd.DataFrame(rows, columns=["group", "row", "column", "controller", "objective", "standard_error"])


def _under(contest: Contest, condition: Condition, controller: Controller) -> Trajectories:
    task, plant = condition.told.task, condition.plant
    process: Process = plant.process
    if condition.load:
        process = LoadStep(process, task, condition.load * task.error_scale)
    if condition.dead_time:
        controller = Delayed(controller, task, condition.dead_time)
    return rollout(process, controller, task, contest.scale.grid, contest.session.stream("evaluation"))


def improved_on_mismatch(contest: Contest) -> pd.DataFrame:
    """Online improvement that starts on the mismatched plant: the objective there before and after, beside others.

    Columns: state, input (factors), controller, objective. nominal: the policy that was improved on the plant of the model.
    """
    params, rows = contest.limits.robustness, []
    for state, entry in zip(params.improve_state, params.improve_input, strict=True):
        plant = mismatched(contest.session, state, entry)
        controllers: dict[str, Controller | LSTMPolicy] = {
            "expert": plant.expert,
            "offline": contest.imitator,
            "online": contest.improved,
            "online_there": plant.improve(copied(contest.imitator), "x").policy,
            "minimum_variance": contest.session.minimum_variance,
        }
        for name, controller in controllers.items():
            batch = plant.fresh(controller, contest.scale.judged)
            rows.append((state, entry, name, contest.returns(batch).mean().item()))
    return pd.DataFrame(rows, columns=["state", "input", "controller", "objective"])
