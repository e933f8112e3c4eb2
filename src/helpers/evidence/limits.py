"""The first verbs of notebook 06: how far every controller is from the attainable, and its control quality."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pandas as pd
from torch import Tensor

from helpers.evidence import one_policy
from helpers.evidence.attainable import Optimum, Resolution, Tabulated, dynamic_programme, grid_around
from helpers.evidence.equal_budget import Build, Contest, Learned, as_it_is, mean_and_error
from helpers.evidence.experiments import prepare
from helpers.evidence.kalman import Filtered
from helpers.learning.control_quality import harris_index, quality
from helpers.learning.evaluation import objective
from helpers.plant.controllers import Controller
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.runs.session import Session
from helpers.runs.study import Study
from helpers.settings.limits import load_limits

NORMAL = 1.96  # half the width of a 95 % interval, in standard errors
ON_STATE = ("minimum_variance_x", "dynamic_programme")  # full information: they are given x in place of y


def enter(session: Session) -> Contest:
    """What notebook 06 starts from: the results of notebooks 01 to 04 and params/limits.yaml."""
    return Contest(**vars(prepare(session)), limits=load_limits(session.params_root, session.params))


def without_noise(session: Study) -> Study:
    """The session with an observation that is the state."""
    exact = tuple(0.0 for _ in session.params.process.observation_noise)
    return session.varied(process={"observation_noise": exact})


# The attainable ------------------------------------------------------------------------------------------------------


def attainable(contest: Contest) -> tuple[Optimum, pd.DataFrame]:
    """The dynamic programme, on finer and finer grids until value and Monte Carlo agree, and what each grid gave.

    It stops where, within the tolerance, the value averaged over initial states and the Monte Carlo value of the greedy policy from
    the same states agree, neither lies below one-step minimum variance on x, and the grid before gave the same. agrees: whether
    that was reached.
    """
    params, scale, session = contest.limits.attainable, contest.scale, without_noise(contest.session)
    features, beta = session.features.on("x"), contest.beta
    reference = session.fresh(session.minimum_variance, scale.draws)
    least = objective(reference, features, beta).double().mean().item()
    rows: list[dict[str, float]] = []
    for states, inputs in zip(scale.states, scale.inputs, strict=True):
        axes = grid_around(reference.x, states, params.margin)
        resolution = Resolution(states, inputs, params.nodes)
        optimum = dynamic_programme(session.process, session.task, beta, features.params.discount, axes, resolution)
        greedy = session.fresh(Tabulated(optimum), scale.draws)
        returns = objective(greedy, features, beta).double()
        value, (found, error) = optimum.value_at(greedy.x[0]).mean().item(), mean_and_error(returns)
        gap = value / found - 1
        change = found / rows[-1]["monte_carlo"] - 1 if rows else np.nan
        agrees = (
            abs(gap) <= params.tolerance and min(value, found) >= least * (1 - params.tolerance) and abs(change) <= params.tolerance
        )
        row = {"states": states, "inputs": inputs, "value": value, "monte_carlo": found, "standard_error": error}
        rows.append(row | {"difference": gap, "change": change, "minimum_variance_x": least, "agrees": float(agrees)})
        if agrees:
            break
    return optimum, pd.DataFrame(rows)


def known_process(contest: Contest, optimum: Optimum | None = None, stationary: bool = False) -> dict[str, Build]:
    """The controllers that know the process: minimum variance and the programme, on y, on x and behind a Kalman filter.

    `stationary`: the programme's policy of the first sample throughout.
    """
    nominal = contest.session.process

    def filtered(controller: Controller, run: Study) -> Controller:
        return Filtered(controller, nominal, run.task)

    builds: dict[str, Build] = {
        "minimum_variance": lambda run: run.minimum_variance,
        "minimum_variance_filtered": lambda run: filtered(run.minimum_variance, run),
        "minimum_variance_x": lambda run: run.minimum_variance,
    }
    if optimum is not None:
        builds["dynamic_programme_filtered"] = lambda run: filtered(Tabulated(optimum, stationary), run)
        builds["dynamic_programme"] = lambda run: Tabulated(optimum, stationary)
    return builds


def of_the_paper(contest: Contest) -> dict[str, Build]:
    """The demonstrating PID and the policies of notebooks 02 to 04, after offline and after online learning."""
    return {
        "expert": lambda run: run.expert,
        "offline": lambda run: run.deploy(contest.imitator),
        "online": lambda run: run.deploy(contest.improved),
    }


def through_the_model(contest: Contest) -> Learned:
    """Notebook 09's policy for every set point, trained by the gradient through the model: it needs no episode of the plant."""
    return as_it_is(contest, partial(Study.deploy, policy=one_policy.stored(contest.session)))


def gaps(contest: Contest, optimum: Optimum, learned: Mapping[str, Learned]) -> pd.DataFrame:
    """Every controller's objective on x and its gap to the programme's greedy policy, on the same disturbances.

    Columns: controller, objective with its 95 % interval (low, high), gap in per cent with its own (gap_low, gap_high), by the
    delta method on paired trajectories.
    """
    builds = of_the_paper(contest) | {name: result.build for name, result in learned.items()} | known_process(contest, optimum)
    returns = {name: contest.returns(_full(contest, name, build)) for name, build in builds.items()}
    best, rows = returns["dynamic_programme"], []
    for name, values in returns.items():
        mean, reach = values.mean().item(), NORMAL * values.std().item() / len(values) ** 0.5
        interval = {"objective": mean, "low": mean - reach, "high": mean + reach}
        rows.append({"controller": name, **interval, **_gap(values, best)})
    return pd.DataFrame(rows)


def _full(contest: Contest, name: str, build: Build) -> Trajectories:
    session = without_noise(contest.session) if name in ON_STATE else contest.session
    return session.fresh(build(session), contest.scale.draws)


def _gap(values: Tensor, best: Tensor) -> dict[str, float]:
    share = (values.mean() / best.mean()).item()
    reach = NORMAL * ((values - share * best).std() / best.mean()).item() / len(values) ** 0.5
    return {"gap": 100 * (1 - share), "gap_low": 100 * (1 - share - reach), "gap_high": 100 * (1 - share + reach)}


# Control quality -----------------------------------------------------------------------------------------------------


def control_quality(contest: Contest, builds: Mapping[str, Build], stationary: Mapping[str, Build]) -> pd.DataFrame:
    """The scorecard: `quality` of every controller, and the Harris index of each loop from a long run at the set point.

    Columns: controller, figure, value. `stationary` holds the controllers of the long run where they differ.
    """
    session, params, scale = contest.session, contest.limits.quality, contest.scale
    process, case = session.params.process, session.params.case
    at_rest = {"initial_mean": case.set_point, "initial_std": tuple(0.0 for _ in case.initial_std)}
    rows = []
    for name, build in builds.items():
        run = without_noise(session) if name in ON_STATE else session
        batch = run.fresh(build(run), scale.judged)
        figures = quality(batch, run.features, params, process.controlled, process.manipulated)
        long = run.varied(case=at_rest, process={"horizon": scale.at_rest})
        single = rollout(long.process, stationary.get(name, build)(long), long.task, 1, long.stream("limits", "at rest"))
        deviation = (single.y[1:, 0] - long.task.set_point).double().numpy()
        figures |= {
            f"harris:{loop}": harris_index(y, params.order) for loop, y in zip(process.controlled, deviation.T, strict=True)
        }
        rows += [(name, figure, value) for figure, value in figures.items()]
    return pd.DataFrame(rows, columns=["controller", "figure", "value"])
