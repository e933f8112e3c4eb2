"""The alternatives at equal budget: each learns on the real objective from the same number of plant episodes.

Every learner gives a curve (the objective of its mode against the plant episodes spent) and its last controller.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import cma
import numpy as np
import pandas as pd
import torch
from torch import Tensor

from helpers.evidence.alternatives import cloned
from helpers.evidence.experiments import Prepared
from helpers.evidence.mpc import OffsetFreeMPC
from helpers.learning.algorithm_1 import algorithm_1
from helpers.learning.evaluation import objective
from helpers.learning.policy import LSTMPolicy
from helpers.plant.controllers import PID, Controller
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.runs.finished import State
from helpers.runs.study import Study, copied
from helpers.settings.leaf import InputError
from helpers.settings.limits import LimitsParams, LimitsScaleParams
from helpers.settings.paper import GainParams

Build = Callable[[Study], Controller]  # the same controller, told of the set point of that session
KINDS = ("proportional", "integral", "derivative")
CURVE = ("learner", "episodes", "objective", "standard_error")


class PackageError(InputError):
    """Packages that a learner needs are not installed."""


@dataclass(frozen=True)
class Contest(Prepared):
    """What all learners of one case share: the results of the stages before, the settings, and how much is computed."""

    limits: LimitsParams

    @property
    def scale(self) -> LimitsScaleParams:
        """How much this scale computes."""
        return self.limits.scales[self.session.scale]

    @property
    def batch(self) -> int:
        """Plant episodes of an epoch."""
        return self.session.online_episodes()

    @property
    def beta(self) -> float:
        """The sharpness of the real objective."""
        return self.session.params.case.online.headline_beta

    def sharpness(self, episodes: int, dense: bool) -> float:
        """Beta of the reward after so many episodes; where `dense`, it begins with the smaller one."""
        early = episodes < self.limits.dense.share * self.scale.episodes
        return self.limits.dense.beta if dense and early else self.beta

    def returns(self, trajectories: Trajectories) -> Tensor:
        """The real objective of each trajectory on the true state, shape (K,)."""
        return objective(trajectories, self.session.features.on("x"), self.beta).double()


@dataclass(frozen=True)
class Learned:
    """A learner's last controller, and its curve: a list of (episodes, objective, standard error)."""

    build: Build
    curve: list[tuple[int, float, float]]


class Visitor:
    """Judges a controller on the same fresh trajectories each time it is due, and keeps the curve."""

    def __init__(self, contest: Contest) -> None:
        self.contest = contest
        self.curve: list[tuple[int, float, float]] = []

    def due(self, episodes: int) -> bool:
        """Whether so many episodes are a new point of the curve."""
        return episodes % self.contest.scale.every == 0 and all(episodes != spent for spent, *_ in self.curve)

    @staticmethod
    def read(rows: Sequence[Sequence[float]]) -> list[tuple[int, float, float]]:
        """A curve as it was kept."""
        return [(int(episodes), mean, error) for episodes, mean, error in rows]

    def __call__(self, episodes: int, controller: Controller | LSTMPolicy) -> None:
        """Add a point."""
        returns = self.contest.returns(self.contest.session.fresh(controller, self.contest.scale.judged))
        self.curve.append((episodes, returns.mean().item(), returns.std().item() / len(returns) ** 0.5))


def reinforced(contest: Contest, start: LSTMPolicy, purpose: str, dense: bool) -> Learned:
    """Algorithm 1 on the real objective with the online settings of learning.yaml, from a given policy."""
    session, visitor = contest.session, Visitor(contest)
    policy, n_epochs = copied(start), -(-contest.scale.episodes // contest.batch)
    learner = session.online_learner(policy, contest.batch, n_epochs, session.stream("limits", purpose))

    def train() -> State:
        visitor(0, learner.average)
        while learner.epochs < n_epochs:
            algorithm_1(learner, partial(learner.features.tracking, beta=contest.sharpness(learner.episodes, dense)), 1)
            if visitor.due(learner.episodes):
                visitor(learner.episodes, learner.average)
        return {"policy": learner.average.state_dict(), "curve": visitor.curve}

    kept = session.trained(train, learner, purpose)
    return Learned(partial(_deployed, copied(policy, kept["policy"])), visitor.read(kept["curve"]))


def _deployed(policy: LSTMPolicy, session: Study) -> Controller:
    return session.deploy(policy)


def retuned(contest: Contest) -> Learned:
    """The PID with gains tuned by CMA-ES on the real objective, every candidate judged on episodes of its own (Hansen 2016).

    The gains are searched in units of those of the demonstrator and stay positive. The curve is that of the search's mean.
    """
    session, params, visitor = contest.session, contest.limits.tuning, Visitor(contest)
    start, generator = session.params.demonstrator, session.stream("limits", "tuning")
    proportional, integral = np.array(start.proportional), np.array(start.integral)
    derivative = params.derivative_unit * proportional * session.params.process.sampling_time
    unit = np.concatenate([proportional, integral, np.maximum(derivative, start.derivative)])
    first = np.concatenate([proportional, integral, start.derivative]) / unit
    options = {"bounds": [0, None], "seed": int(torch.randint(1, 2**31, (1,), generator=generator)), "verbose": -9}
    search = cma.CMAEvolutionStrategy(first, params.initial_step, options)

    def gains(point: np.ndarray) -> GainParams:
        kinds = np.split(point * unit, 3)
        return start.model_copy(update={name: tuple(kind.tolist()) for name, kind in zip(KINDS, kinds, strict=True)})

    def pid(found: GainParams, run: Study) -> Controller:
        return PID(found, run.task.set_point, run.params.process.sampling_time)

    visitor(0, pid(start, session))
    spent, mean = 0, first
    while spent + params.episodes * search.popsize <= contest.scale.episodes:
        points, costs = search.ask(), []
        for point in points:
            batch = rollout(session.process, pid(gains(point), session), session.task, params.episodes, generator)
            costs.append(-contest.returns(batch).mean().item())
        search.tell(points, costs)
        before, spent = spent, spent + params.episodes * len(points)
        mean = np.asarray(search.result.xfavorite)
        if before // contest.scale.every < spent // contest.scale.every:
            visitor(spent, pid(gains(mean), session))
    return Learned(partial(pid, gains(mean)), visitor.curve)


def from_library(contest: Contest, name: str) -> Learned:
    """PPO or RecurrentPPO from scratch; an interrupted run does not repeat one that has ended.

    Raises:
        PackageError: if the extra `alternatives` is not installed.
    """
    try:
        from helpers.evidence import library_learners as library  # noqa: PLC0415  # of an extra
    except ImportError as error:
        raise PackageError(
            f"params/limits.yaml: key 'scales.{contest.session.scale}.library': {name} needs a package that is not installed "
            f"({error.name}); run python -m pip install -e '.[alternatives]'"
        ) from error
    session, visitor = contest.session, Visitor(contest)
    params, policy = getattr(contest.limits, name), session.params.learning.policy
    model = library.library_learner(
        name, session.process, session.task, policy, params, session.features.params.discount, contest.batch, session.seed
    )

    def build(run: Study) -> Controller:
        return library.LibraryController(model, run.task, run.fresh_policy().scaling(run.task))

    def visit(episodes: int) -> None:
        if visitor.due(episodes):
            visitor(episodes, build(session))

    def train() -> State:
        library.learn(model, session.task, contest.scale.episodes, partial(contest.sharpness, dense=True), visit)
        return {"policy": model.policy.state_dict(), "curve": visitor.curve}

    kept = session.once(train, "library", name)
    model.policy.load_state_dict(kept["policy"])
    return Learned(build, visitor.read(kept["curve"]))


def predictive(contest: Contest) -> Learned:
    """Offset-free MPC, which learns nothing: it has the model of the process instead."""
    params = contest.limits.predictive

    def build(run: Study) -> Controller:
        nominal = contest.session.process
        return OffsetFreeMPC(nominal, run.task, params.horizon, params.move_penalty, params.disturbance_std)

    visitor = Visitor(contest)
    visitor(0, build(contest.session))
    return Learned(build, visitor.curve)


def learn_all(contest: Contest) -> dict[str, Learned]:
    """Every alternative by name, in the order of the report."""
    clone = cloned(contest, contest.demonstrations.trajectories)
    learned = {
        "irl_reinforce": reinforced(contest, contest.imitator, "hot", False),
        "clone_reinforce": reinforced(contest, clone, "cloned", False),
        "scratch_reinforce": reinforced(contest, contest.session.fresh_policy(), "scratch", True),
        "pid_tuned": retuned(contest),
        "mpc": predictive(contest),
    }
    if contest.scale.library:
        learned |= {name: from_library(contest, name) for name in ("ppo", "recurrent_ppo")}
    visitor = Visitor(contest)
    visitor(0, clone)
    return {"clone": Learned(partial(_deployed, clone), visitor.curve)} | learned


def curves(learned: Mapping[str, Learned]) -> pd.DataFrame:
    """All curves as one table with the columns of `CURVE`."""
    rows = [(name, *point) for name, result in learned.items() for point in result.curve]
    return pd.DataFrame(rows, columns=list(CURVE))


def at_budgets(curve: pd.DataFrame, contest: Contest) -> pd.DataFrame:
    """The objective of each learner at the listed budgets; what does not learn keeps its value."""
    table = curve.pivot_table(index="learner", columns="episodes", values="objective", sort=False)
    every = sorted({*table.columns, *contest.scale.listed})
    return table.reindex(columns=every).ffill(axis=1)[list(contest.scale.listed)]
