"""The verbs of notebook 06: how far every controller is from the attainable, its quality, robustness and the price of learning."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from IPython.display import Markdown
from torch import Tensor

from helpers import stages
from helpers.attainable import Optimum, Resolution, Tabulated, dynamic_programme, grid_around
from helpers.control_quality import harris_index, quality
from helpers.controllers import Controller
from helpers.equal_budget import Build, Contest, Learned
from helpers.evaluation import objective
from helpers.experiments import Prepared, copied, prepare, varied
from helpers.kalman import Filtered
from helpers.limits_params import load_limits
from helpers.mismatch import Delayed, LoadStep
from helpers.policy import LSTMPolicy
from helpers.process import Process
from helpers.reinforce import Learner
from helpers.rollout import rollout
from helpers.session import Session
from helpers.trajectories import Trajectories

NORMAL = 1.96  # half the width of a 95 % interval, in standard errors
NO_LEARNERS = ("clone", "mpc")
ON_STATE = ("minimum_variance_x", "dynamic_programme")  # full information: they are given x in place of y


def enter(session: Session) -> Contest:
    """What notebook 06 starts from: the results of notebooks 01 to 04 and params/limits.yaml."""
    prepared: Prepared = prepare(session)
    return Contest(prepared, load_limits(session.params_root, session.params))


def without_noise(session: Session) -> Session:
    """The session with an observation that is the state."""
    exact = tuple(0.0 for _ in session.params.process.observation_noise)
    return varied(session, process={"observation_noise": exact})


# The attainable ------------------------------------------------------------------------------------------------------


def attain(contest: Contest, beta: float) -> tuple[Optimum, pd.DataFrame]:
    """The dynamic programme for one beta, on finer and finer grids until value and Monte Carlo agree, and what each grid gave.

    It stops where the value, averaged over initial states, and the Monte Carlo value of the greedy policy from the same states
    agree within the tolerance, neither lies below one-step minimum variance on x, and the grid before gave the same within the
    tolerance. agrees: whether that was reached.
    """
    params, scale, session = contest.params.attainable, contest.scale, without_noise(contest.session)
    features = session.features.on("x")
    reference = stages.fresh_trajectories(session, session.minimum_variance, scale.draws)
    least = objective(reference, features, beta).double().mean().item()
    rows: list[dict[str, float]] = []
    for states, inputs in zip(scale.states, scale.inputs, strict=True):
        axes = grid_around(reference.x, states, params.margin)
        resolution = Resolution(states, inputs, params.nodes)
        optimum = dynamic_programme(session.process, session.task, beta, features.params.discount, axes, resolution)
        greedy = stages.fresh_trajectories(session, Tabulated(optimum), scale.draws)
        returns = objective(greedy, features, beta).double()
        value, found = optimum.value_at(greedy.x[0]).mean().item(), returns.mean().item()
        gap = value / found - 1
        change = found / rows[-1]["monte_carlo"] - 1 if rows else np.nan
        agrees = abs(gap) <= params.tolerance and min(value, found) >= least and abs(change) <= params.tolerance
        error = returns.std().item() / len(returns) ** 0.5
        row = {"beta": beta, "states": states, "inputs": inputs, "value": value, "monte_carlo": found, "standard_error": error}
        rows.append(row | {"difference": gap, "change": change, "minimum_variance_x": least, "agrees": float(agrees)})
        if agrees:
            break
    return optimum, pd.DataFrame(rows)


def attainable(contest: Contest) -> tuple[dict[float, Optimum], pd.DataFrame]:
    """`attain` for every beta."""
    found = {beta: attain(contest, beta) for beta in contest.params.attainable.betas}
    return {beta: optimum for beta, (optimum, _) in found.items()}, pd.concat([rows for _, rows in found.values()])


def known_process(contest: Contest, optimum: Optimum | None = None, stationary: bool = False) -> dict[str, Build]:
    """The controllers that know the process: minimum variance and the programme, on y, on x and behind a Kalman filter.

    `stationary`: the programme's policy of the first sample throughout.
    """
    nominal = contest.session.process

    def filtered(controller: Controller, run: Session) -> Controller:
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
    prepared = contest.prepared
    return {
        "expert": lambda run: run.expert,
        "offline": lambda run: stages.deploy(run, prepared.imitator),
        "online": lambda run: stages.deploy(run, prepared.improved),
    }


def gaps(contest: Contest, optima: Mapping[float, Optimum], learned: Mapping[str, Learned]) -> pd.DataFrame:
    """Every controller's objective on x and its gap to the programme's greedy policy, on the same disturbances.

    Columns: beta, controller, objective with its 95 % interval (low, high), gap in per cent with its own (gap_low, gap_high), by
    the delta method on paired trajectories. The learners had the real objective's beta; at another they are only judged.
    """
    shared = of_the_paper(contest) | {name: result.build for name, result in learned.items()} | known_process(contest)
    batches = {name: _full(contest, name, build) for name, build in shared.items()}
    features, rows = contest.session.features.on("x"), []
    for beta, optimum in optima.items():
        own = {name: build for name, build in known_process(contest, optimum).items() if name not in shared}
        every = batches | {name: _full(contest, name, build) for name, build in own.items()}
        returns = {name: objective(batch, features, beta).double() for name, batch in every.items()}
        best = returns["dynamic_programme"]
        for name, values in returns.items():
            rows.append({"beta": beta, "controller": name, **_interval(values), **_gap(values, best)})
    return pd.DataFrame(rows)


def _full(contest: Contest, name: str, build: Build) -> Trajectories:
    session = without_noise(contest.session) if name in ON_STATE else contest.session
    return stages.fresh_trajectories(session, build(session), contest.scale.draws)


def _interval(values: Tensor) -> dict[str, float]:
    mean, reach = values.mean().item(), NORMAL * values.std().item() / len(values) ** 0.5
    return {"objective": mean, "low": mean - reach, "high": mean + reach}


def _gap(values: Tensor, best: Tensor) -> dict[str, float]:
    share = (values.mean() / best.mean()).item()
    reach = NORMAL * ((values - share * best).std() / best.mean()).item() / len(values) ** 0.5
    return {"gap": 100 * (1 - share), "gap_low": 100 * (1 - share - reach), "gap_high": 100 * (1 - share + reach)}


def answer(gaps: pd.DataFrame, budget: pd.DataFrame, contest: Contest) -> Markdown:
    """What a practitioner can read off the numbers, in words; every number comes from the tables.

    Args:
        gaps: of `gaps`; budget: of `equal_budget.at_budgets`.
    """
    found = gaps[gaps["beta"] == contest.beta].set_index("controller")
    learners = budget.drop(index=[name for name in NO_LEARNERS if name in budget.index])
    names = {name: name.replace("_", " ") for name in found.index}
    lines = []
    for episodes in budget.columns:
        best = learners[episodes].idxmax()
        lines.append(
            f"after {episodes:,} plant episodes {names[best]} is the best learner, $J$ = {learners.loc[best, episodes]:.1f}"
        )
    model = {name: found.loc[name] for name in ("mpc", "minimum_variance", "minimum_variance_filtered")}
    known = ", ".join(f"{names[name]} {row['objective']:.1f} ({row['gap']:.1f} %)" for name, row in model.items())
    ahead = learners.columns[(learners > found.loc["mpc", "objective"]).any()]
    passed = f"from {ahead[0]:,} episodes on" if len(ahead) else "at none of these budgets"
    best = learners.iloc[:, -1].idxmax()
    return Markdown(
        f"**Without a model**, {'; '.join(lines)}. **With the exact model** and no episode at all (in brackets the gap to the "
        f"programme): {known}. A learner passes offset-free MPC {passed}. The best learner ends {found.loc[best, 'gap']:.1f} % "
        f"below the programme, the demonstrator stands {found.loc['expert', 'gap']:.1f} % below it."
    )


# Control quality -----------------------------------------------------------------------------------------------------


def control_quality(contest: Contest, builds: Mapping[str, Build], stationary: Mapping[str, Build]) -> pd.DataFrame:
    """The scorecard: `quality` of every controller, and the Harris index of each loop from a long run at the set point.

    Columns: controller, figure, value. `stationary` holds the controllers of the long run where they differ.
    """
    session, params, scale = contest.session, contest.params.quality, contest.scale
    process, case = session.params.process, session.params.case
    at_rest = {"initial_mean": case.set_point, "initial_std": tuple(0.0 for _ in case.initial_std)}
    rows = []
    for name, build in builds.items():
        run = without_noise(session) if name in ON_STATE else session
        batch = stages.fresh_trajectories(run, build(run), scale.judged)
        figures = quality(batch, run.features, params, process.controlled, process.manipulated)
        long = varied(run, case=at_rest, process={"horizon": scale.at_rest})
        single = rollout(long.process, stationary.get(name, build)(long), long.task, 1, long.stream("limits", "at rest"))
        deviation = (single.y[1:, 0] - long.task.set_point).double().numpy()
        figures |= {
            f"harris:{loop}": harris_index(y, params.order) for loop, y in zip(process.controlled, deviation.T, strict=True)
        }
        rows += [(name, figure, value) for figure, value in figures.items()]
    return pd.DataFrame(rows, columns=["controller", "figure", "value"])


# Robustness ----------------------------------------------------------------------------------------------------------


class Condition(NamedTuple):
    """A plant, and a set point that the controllers are told of.

    Attributes:
        group: which grid it belongs to; row, column: its place there.
        told: the session that controllers are built for; plant: the one whose process they meet.
    """

    group: str
    row: str
    column: str
    told: Session
    plant: Session
    load: float = 0.0
    dead_time: int = 0


def conditions(contest: Contest) -> list[Condition]:
    """Every plant and set point of params/limits.yaml."""
    session, params = contest.session, contest.params.robustness
    process, case = session.params.process, session.params.case
    found = []
    for state in params.state_factors:
        for entry in params.input_factors:
            plant = mismatched(session, state, entry)
            found.append(Condition("model", f"{state:g}", f"{entry:g}", session, plant))
    for disturbance in params.disturbance_factors:
        for noise in params.noise_factors:
            changes = {
                "disturbance": tuple(disturbance * gain for gain in process.disturbance),
                "observation_noise": tuple(noise * std for std in process.observation_noise),
            }
            plant = varied(session, process=changes)
            found.append(Condition("noise", f"{disturbance:g}", f"{noise:g}", session, plant))
    for first in params.set_point_factors:
        for others in params.set_point_factors:
            factors = [first, *[others] * (len(case.set_point) - 1)]
            target = tuple(factor * value for factor, value in zip(factors, case.set_point, strict=True))
            told = varied(session, case={"set_point": target})
            found.append(Condition("set_point", f"{first:g}", f"{others:g}", told, told))
    for dead_time in (0, params.dead_time):
        for load in (0.0, params.load):
            found.append(Condition("time", f"{dead_time}", f"{load:g}", session, session, load, dead_time))
    return found


def mismatched(session: Session, state: float, entry: float) -> Session:
    """The session with A and B of Eq. 4.1.3b scaled."""
    process = session.params.process
    drift_state = tuple(tuple(state * value for value in row) for row in process.drift_state)
    drift_input = tuple(tuple(entry * value for value in row) for row in process.drift_input)
    return varied(session, process={"drift_state": drift_state, "drift_input": drift_input})


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
    params, prepared, rows = contest.params.robustness, contest.prepared, []
    for state, entry in zip(params.improve_state, params.improve_input, strict=True):
        plant = mismatched(contest.session, state, entry)
        improved = stages.improve(plant, copied(plant, prepared.imitator), "x").policy
        controllers: dict[str, Controller] = {
            "expert": plant.expert,
            "offline": stages.deploy(plant, prepared.imitator),
            "online": stages.deploy(plant, prepared.improved),
            "online_there": stages.deploy(plant, improved),
            "minimum_variance": contest.session.minimum_variance,
        }
        for name, controller in controllers.items():
            batch = stages.fresh_trajectories(plant, controller, contest.scale.judged)
            rows.append((state, entry, name, contest.returns(batch).mean().item()))
    return pd.DataFrame(rows, columns=["state", "input", "controller", "objective"])


# Safety of online learning -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Watched:
    """A reward that keeps the real objective of every exploring episode it is asked about."""

    contest: Contest
    beta: float
    seen: list[Tensor]

    def __call__(self, batch: Trajectories) -> Tensor:
        """The rewards R_1..R_T with this beta, shape (T, K)."""
        self.seen.append(self.contest.returns(batch))
        return self.contest.session.features.on("x").tracking(batch, self.beta)


def exploring_episodes(contest: Contest) -> pd.DataFrame:
    """Every exploring episode of the case's online epochs, from the imitating policy (hot) and from an untrained one (scratch).

    Beside each the episode that the PID would have had from the same initial state under the same disturbances. From scratch the
    first round has the smaller beta of `dense`, without which there is nothing to learn from; all are judged by the real
    objective. Columns: run, epoch, episode, objective, expert.
    """
    online = contest.session.params.case.online
    starts = {
        "hot": (contest.prepared.imitator, online.beta),
        "scratch": (stages.fresh_policy(contest.session), (contest.params.dense.beta, *online.beta[1:])),
    }
    return pd.concat([_explore(contest, name, *start) for name, start in starts.items()], ignore_index=True)


def _explore(contest: Contest, run: str, start: LSTMPolicy, betas: tuple[float, ...]) -> pd.DataFrame:
    session = contest.session
    online, generator = session.params.learning.online, session.stream("limits", "safety")
    epochs = [session.epochs(n_epochs) for n_epochs in session.params.case.online.epochs]
    policy = copied(session, start)
    policy.reset_exploration(online.exploration)
    features = session.features.on("x")
    learner = Learner(policy, session.process, features, online.learner, contest.batch, sum(epochs), generator)
    frames = []
    for n_epochs, beta in zip(epochs, betas, strict=True):
        for _ in range(n_epochs):
            twin = torch.Generator().set_state(generator.get_state())
            reward = Watched(contest, beta, [])
            learner.epoch(reward)
            paired = contest.returns(rollout(session.process, session.expert, session.task, contest.batch, twin))
            columns = {"run": run, "epoch": learner.epochs, "objective": reward.seen[0].numpy(), "expert": paired.numpy()}
            frames.append(pd.DataFrame(columns))
    episodes = pd.concat(frames, ignore_index=True)
    return episodes.assign(episode=np.arange(1, len(episodes) + 1))[["run", "epoch", "episode", "objective", "expert"]]


def safety(episodes: pd.DataFrame) -> pd.DataFrame:
    """The price of exploring: a row for each run.

    worst: the least objective of an episode, worst_expert: the PID's on the same draws; worse: the share of episodes worse than
    the PID's; regret: the sum of what they earned less than the PID (negative: more), regret_peak: the greatest sum on the way,
    regret_episodes: the sum in mean episodes of the PID.
    """
    rows = []
    for run, group in episodes.groupby("run", sort=False):
        lost = group["expert"] - group["objective"]
        row = {"run": run, "episodes": len(group), "worst": group["objective"].min(), "worst_expert": group["expert"].min()}
        row |= {"worse": (lost > 0).mean(), "regret": lost.sum(), "regret_episodes": lost.sum() / group["expert"].mean()}
        rows.append(row | {"regret_peak": lost.cumsum().max()})
    return pd.DataFrame(rows)
