"""The alternatives at equal budget: each learns on the real objective from the same number of plant episodes.

Every learner gives a curve (the objective of its mode against the plant episodes spent) and its last controller.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial

import cma
import numpy as np
import pandas as pd
import torch
from torch import Tensor

from helpers.evidence.alternatives import cloned
from helpers.evidence.experiments import Prepared, scaled
from helpers.evidence.mpc import OffsetFreeMPC
from helpers.evidence.scheduled_pid import ScheduledPID
from helpers.learning.algorithm_1 import Reward, algorithm_1
from helpers.learning.evaluation import objective
from helpers.learning.learner import TrainingError
from helpers.learning.policy import LSTMPolicy, log_density
from helpers.plant.controllers import Controller
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.runs.finished import State
from helpers.runs.study import Study, copied
from helpers.settings.leaf import InputError
from helpers.settings.limits import LimitsParams, LimitsScaleParams

Build = Callable[[Study], Controller]  # the same controller, told of the set point of that session
CURVE = ("learner", "episodes", "objective", "standard_error")
# Of the last step size, under a reward of which the policy is the optimum already. With all of it, and as many steps a batch as
# under the real objective, J fell from 17.6 to 2.7 in five epochs (Case I, seed 0); with one such step it stays at 17.6.
GENTLE = 0.1


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

    def early(self, episodes: int) -> bool:
        """Whether the first part of the budget, of `dense`, still lasts after so many episodes."""
        return episodes < self.limits.dense.share * self.scale.episodes

    def sharpness(self, episodes: int, dense: bool) -> float:
        """Beta of the reward after so many episodes; where `dense`, it begins with the smaller one."""
        return self.limits.dense.beta if dense and self.early(episodes) else self.beta

    @cached_property
    def clone(self) -> LSTMPolicy:
        """The policy that behavioural cloning learns from the demonstrations."""
        return cloned(self, self.demonstrations.trajectories)

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

    def __call__(self, episodes: int, controller: Controller | LSTMPolicy) -> None:
        """Add a point."""
        returns = self.contest.returns(self.contest.session.fresh(controller, self.contest.scale.judged))
        self.curve.append((episodes, *mean_and_error(returns)))


def mean_and_error(values: Tensor) -> tuple[float, float]:
    """The mean of a sample and its standard error."""
    return values.mean().item(), values.std().item() / len(values) ** 0.5


def as_it_is(contest: Contest, build: Build) -> Learned:
    """A controller that spends no episode of the plant: its curve is one point."""
    visitor = Visitor(contest)
    visitor(0, build(contest.session))
    return Learned(build, visitor.curve)


def reinforced(
    contest: Contest,
    start: LSTMPolicy,
    purpose: str,
    from_scratch: bool = False,
    alone: bool = False,
    early_reward: Reward | None = None,
) -> Learned:
    """Algorithm 1 on the real objective with the online settings of learning.yaml, from a given policy; its curve may end early.

    Args:
        from_scratch: it explores further, and begins with the smaller beta of `dense`. alone: REINFORCE without a critic, which
            has to explore as far. early_reward: what it begins with instead.
    """
    session, visitor = contest.session, Visitor(contest)
    policy, n_epochs = copied(start), -(-contest.scale.episodes // contest.batch)
    learner = session.online_learner(
        policy, contest.batch, n_epochs, session.stream("limits", purpose), from_scratch=from_scratch or alone
    )
    usual = learner.params.model_copy(update={"critic": 0.0}) if alone else learner.params
    rates = dict.fromkeys(("learning_rate_start", "learning_rate_end"), GENTLE * usual.learning_rate_end)
    gentle = usual.model_copy(update=rates | {"passes": 1, "minibatches": 1})

    def train() -> State:
        visitor(0, learner.average)
        with suppress(TrainingError):  # nothing to learn from: the policy stays as it is
            while learner.epochs < n_epochs:
                if early_reward and contest.early(learner.episodes):
                    learner.params = gentle
                    algorithm_1(learner, early_reward, 1)
                else:
                    learner.params = usual
                    algorithm_1(learner, learner.tracking(contest.sharpness(learner.episodes, from_scratch)), 1)
                if visitor.due(learner.episodes):
                    visitor(learner.episodes, learner.average)
        return {"policy": learner.average.state_dict(), "curve": visitor.curve}

    kept = session.trained(train, learner, purpose)
    return Learned(partial(Study.deploy, policy=copied(policy, kept["policy"])), kept["curve"])


def coherent_reward(contest: Contest, clone: LSTMPolicy) -> Reward:
    """CSIL's reward, under which the clone is optimal already: ln of its density over that of an even one (Watson et al. 2023).

    The spread of the clone is that of the recorded inputs about its mode, Watson et al. 2023, Eq. 9 with an even prior.
    """
    task, recorded = contest.session.task, contest.demonstrations.trajectories

    def mode(batch: Trajectories) -> Tensor:
        with torch.no_grad():
            return clone(batch.y, batch.u, task)[0]

    spread = (mode(recorded) - recorded.u).square().mean((0, 1)).sqrt()
    even = (task.input_high - task.input_low).log().sum()
    return lambda batch: log_density(batch.command, mode(batch), spread) + even


def searched(contest: Contest, purpose: str, cells: int, set_point_factors: Sequence[float]) -> Learned:
    """The gains of a PID, or with `cells` the network that schedules them, by CMA-ES on the real objective (Hansen 2016).

    Several searches for constant gains, from the demonstrator with less and less integral action, take turns for the first half of
    the budget. The best of them has the other half, or the network that begins with its gains. Every candidate is judged on
    episodes of its own, spread over the set points. The curve is that of the mean of the search that is best so far.
    """
    session, params, visitor = contest.session, contest.limits.tuning, Visitor(contest)
    generator, n_y = session.stream("limits", purpose), len(session.task.set_point)
    target = session.params.case.set_point
    runs = [session.varied(case={"set_point": scaled(factor, target)}) for factor in set_point_factors]
    each = -(-params.episodes // len(runs))

    def costs(candidates: np.ndarray) -> np.ndarray:
        """Less the mean objective of each candidate (P, n), from as many episodes at each set point; (P,)."""
        found = np.zeros(len(candidates))
        for run in runs:
            batch = rollout(run.process, _scheduled(contest, candidates, run), run.task, each * len(candidates), generator)
            found -= objective(batch, run.features.on("x"), contest.beta).double().view(len(candidates), each).mean(1).numpy()
        return found / len(runs)

    def begun(start: np.ndarray) -> cma.CMAEvolutionStrategy:
        options = {"seed": int(torch.randint(1, 2**31, (1,), generator=generator)), "verbose": -9}
        return cma.CMAEvolutionStrategy(start, params.initial_step * 3 * n_y / len(start), options)

    def network(gains: np.ndarray) -> np.ndarray:
        """Weights of the network that gives these constants, (3 n_y,), whatever it sees."""
        weights = np.zeros(ScheduledPID.n_weights(n_y, cells))
        weights[-3 * n_y * (cells + 1) :].reshape(3 * n_y, cells + 1)[:, -1] = gains
        return weights

    starts = np.zeros((len(params.integral_factors), 3, n_y))
    starts[:, 1] = np.log(params.integral_factors)[:, None]
    searches, spent = [begun(start.ravel()) for start in starts], 0
    searches = searches[: max(1, contest.scale.episodes // (each * len(runs) * searches[0].popsize))]
    best, constant = searches[0], True
    visitor(0, _scheduled(contest, best.mean[None], session))
    while spent + (turn := each * len(runs) * sum(search.popsize for search in searches)) <= contest.scale.episodes:
        values = []
        for search in searches:
            points = search.ask()
            found = costs(np.stack(points))
            search.tell(points, found.tolist())
            values.append(np.median(found))
        before, spent, best = spent, spent + turn, searches[int(np.argmin(values))]
        if before // contest.scale.every < spent // contest.scale.every:
            visitor(spent, _scheduled(contest, best.mean[None], session))
        if constant and spent >= contest.scale.episodes / 2:
            searches, constant = [begun(network(best.mean)) if cells else best], False
    return Learned(partial(_scheduled, contest, best.mean[None]), visitor.curve)


def _scheduled(contest: Contest, weights: np.ndarray, run: Study) -> Controller:
    """The PIDs that such weights (P, n) make, told of the set point of a run."""
    params, nominal, dtype = contest.session.params, contest.session.task.set_point, contest.session.dtype
    unit = torch.tensor(params.learning.policy.error_unit, dtype=dtype)
    dt, step = params.process.sampling_time, contest.limits.tuning.derivative_unit
    return ScheduledPID(torch.as_tensor(weights).to(dtype), params.demonstrator, step, unit, nominal, run.task, dt)


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
    return Learned(build, kept["curve"])


def predictive(contest: Contest) -> Learned:
    """Offset-free MPC, which learns nothing: it has the model of the process instead."""
    nominal, params = contest.session.process, contest.limits.predictive
    return as_it_is(
        contest, lambda run: OffsetFreeMPC(nominal, run.task, params.horizon, params.move_penalty, params.disturbance_std)
    )


def learn_all(contest: Contest) -> dict[str, Learned]:
    """Every alternative by name, in the order of the report."""
    clone, tuning = contest.clone, contest.limits.tuning
    learned = {
        "irl_reinforce": reinforced(contest, contest.imitator, "hot"),
        "irl_alone": reinforced(contest, contest.imitator, "alone", alone=True),
        "clone_reinforce": reinforced(contest, clone, "cloned"),
        "csil_reinforce": reinforced(contest, clone, "coherent", early_reward=coherent_reward(contest, clone)),
        "scratch_reinforce": reinforced(contest, contest.session.fresh_policy(), "scratch", from_scratch=True),
        "pid_tuned": searched(contest, "tuning", 0, (1.0,)),
        "pid_scheduled": searched(contest, "scheduling", tuning.cells, contest.limits.robustness.set_point_factors),
        "mpc": predictive(contest),
    }
    if contest.scale.library:
        learned |= {name: from_library(contest, name) for name in ("ppo", "recurrent_ppo")}
    return {"clone": as_it_is(contest, partial(Study.deploy, policy=clone))} | learned


def curves(learned: Mapping[str, Learned]) -> pd.DataFrame:
    """All curves as one table with the columns of `CURVE`."""
    rows = [(name, *point) for name, result in learned.items() for point in result.curve]
    return pd.DataFrame(rows, columns=list(CURVE))


def at_budgets(curve: pd.DataFrame, contest: Contest) -> pd.DataFrame:
    """The objective of each learner at the listed budgets; what does not learn keeps its value."""
    table = curve.pivot_table(index="learner", columns="episodes", values="objective", sort=False)
    every = sorted({*table.columns, *contest.scale.listed})
    return table.reindex(columns=every).ffill(axis=1)[list(contest.scale.listed)]
