"""Every controller on plants other than the one of the model, and at set points that it was not trained on."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import product
from typing import NamedTuple

import pandas as pd

from helpers.evidence.equal_budget import Build, Contest, mean_and_error
from helpers.evidence.experiments import scaled
from helpers.evidence.mismatch import Delayed, LoadStep
from helpers.learning.evaluation import objective
from helpers.learning.learner import TrainingError
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


def conditions(contest: Contest) -> Iterator[Condition]:
    """Every plant and set point of params/limits.yaml; at a scale of `corners`, the first and last factor of each list alone."""
    session, params = contest.session, contest.limits.robustness
    process, case = session.params.process, session.params.case
    grids = params.model_dump()
    if contest.scale.corners:
        grids = {name: (values[0], values[-1]) for name, values in grids.items() if name.endswith("_factors")}
    for state, entry in product(grids["state_factors"], grids["input_factors"]):
        yield Condition("model", f"{state:g}", f"{entry:g}", session, mismatched(session, state, entry))
    for disturbance, noise in product(grids["disturbance_factors"], grids["noise_factors"]):
        plant = session.varied(
            process={
                "disturbance": scaled(disturbance, process.disturbance),
                "observation_noise": scaled(noise, process.observation_noise),
            }
        )
        yield Condition("noise", f"{disturbance:g}", f"{noise:g}", session, plant)
    for first, others in product(grids["set_point_factors"], repeat=2):
        told = session.varied(case={"set_point": scaled(first, case.set_point[:1]) + scaled(others, case.set_point[1:])})
        yield Condition("set_point", f"{first:g}", f"{others:g}", told, told)
    for dead_time, load in product((0, params.dead_time), (0.0, params.load)):
        yield Condition("time", f"{dead_time}", f"{load:g}", session, session, load, dead_time)


def mismatched(session: Study, state: float, entry: float) -> Study:
    """The session with A and B of Eq. 4.1.3b scaled."""
    drift_state, drift_input = session.params.process.drift_state, session.params.process.drift_input
    scaled_state = tuple(scaled(state, row) for row in drift_state)
    return session.varied(process={"drift_state": scaled_state, "drift_input": tuple(scaled(entry, row) for row in drift_input)})


def robustness(contest: Contest, builds: Mapping[str, Build]) -> pd.DataFrame:
    """The objective on x of every controller under every condition, on the same random draws.

    Columns: group, row, column, controller, objective, standard_error.
    """
    rows = []
    for condition in conditions(contest):
        for name, build in builds.items():
            batch = _under(contest, condition, build(condition.told))
            returns = objective(batch, condition.told.features.on("x"), contest.beta).double()
            rows.append((condition.group, condition.row, condition.column, name, *mean_and_error(returns)))
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

    Columns: state, input (factors), controller, objective. online: the policy that was improved on the plant of the model;
    online_there: on this one.
    """
    params, rows = contest.limits.robustness, []
    for state, entry in zip(params.improve_state, params.improve_input, strict=True):
        plant, there = mismatched(contest.session, state, entry), contest.imitator
        with suppress(TrainingError):  # nothing to learn from, as where no input holds the set point: the policy stays as it is
            there = plant.improve(copied(contest.imitator), "x").policy
        controllers: dict[str, Controller | LSTMPolicy] = {
            "expert": plant.expert,
            "offline": contest.imitator,
            "online": contest.improved,
            "online_there": there,
            "minimum_variance": contest.session.minimum_variance,
        }
        for name, controller in controllers.items():
            batch = plant.fresh(controller, contest.scale.judged)
            rows.append((state, entry, name, contest.returns(batch).mean().item()))
    return pd.DataFrame(rows, columns=["state", "input", "controller", "objective"])
