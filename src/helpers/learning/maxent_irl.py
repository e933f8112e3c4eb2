"""Algorithm 2: maximum-entropy inverse reinforcement learning of the reward weights, with Algorithm 1 inside."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from helpers.learning.evaluation import expected_features, feature_gap, relative_gap
from helpers.learning.features import FeatureMap, linear_reward
from helpers.learning.policy import LSTMPolicy, PolicyController
from helpers.learning.reinforce import EpochRecord, Learner, Memory, NoMemory, TrainingError, reinforce
from helpers.plant.task import Trajectories
from helpers.settings.paper import WeightParams


def maxent_gradient(expert_features: Tensor, policy_features: Tensor) -> Tensor:
    """Gradient of the mean log-likelihood of the demonstrations in alpha, Eq. 3.4.4-3.4.5: v_E - E[v_pi], shape (d,)."""
    return expert_features - policy_features


def project(weights: Tensor) -> Tensor:
    """The weights at unit Euclidean norm."""
    return weights / weights.norm()


def initial_weights(params: WeightParams, n_loops: int, dtype: torch.dtype) -> Tensor:
    """alpha before the first iteration, shape (d,): one sign for each kind of feature, of unit norm."""
    return project(torch.tensor(params.initial, dtype=dtype).repeat_interleave(n_loops))


class WeightAscent:
    """Gradient ascent on the log-likelihood of the demonstrations, Eq. 3.4.6, clipped and then of unit norm.

    lambda <- clip((1 - decay) lambda + kappa D grad), alpha = lambda / |lambda|. With D = I and without decay this is the
    printed step, which goes on from alpha itself. A decay is a Gaussian prior on the weights (it adds
    -decay/(2 kappa) |lambda|^2 to the log-likelihood): old evidence fades, which damps the swinging of alpha about a
    policy that already matches. D = diag(1/|v_E|) measures each feature in units of the expert's own value.
    """

    def __init__(self, params: WeightParams, start: Tensor, expert_features: Tensor) -> None:
        if params.scaled_by_expert and not expert_features.all():
            raise TrainingError("a feature of the expert is zero, so its gap has no scale: set scaled_by_expert to false")
        self.params = params
        self.raw = start.clone()
        self.weights = project(start)
        self.mean = self.weights.clone()
        self.metric = 1 / expert_features.abs() if params.scaled_by_expert else torch.ones_like(start)

    def step(self, gradient: Tensor) -> None:
        """One step along the gradient, shape (d,)."""
        params = self.params
        before = self.raw if params.decay else self.weights
        raw = (1 - params.decay) * before + params.step * self.metric * gradient
        self.raw = raw.clamp(-params.bound, params.bound)
        self.weights = project(self.raw)
        self.mean = params.averaging * self.mean + (1 - params.averaging) * self.weights

    def state(self) -> dict[str, Tensor]:
        """What the next steps depend on; see `restore`."""
        return {"raw": self.raw, "weights": self.weights, "mean": self.mean}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from the state of another ascent with the same parameters."""
        self.raw, self.weights, self.mean = state["raw"], state["weights"], state["mean"]

    @property
    def result(self) -> Tensor:
        """alpha*: the running mean of the weights over the iterations, of unit norm."""
        return project(self.mean)


def apprentice_reward(trajectories: Trajectories, features: FeatureMap, weights: Tensor) -> Tensor:
    """R_1..R_T of Eq. 4.2.5 along trajectories, shape (T, K)."""
    return linear_reward(features.state(trajectories), weights)


@dataclass(frozen=True)
class IterationRecord:
    """One outer iteration of Algorithm 2: what it cost so far, how near the policy came, under which weights.

    Episodes count those that were rolled out to measure the features as well as those learned from.
    """

    iteration: int
    epochs: int
    episodes: int
    gradient_steps: int
    mean_return: float
    feature_gap: float
    learning_rate: float
    policy_std: float
    weights: tuple[float, ...]


@dataclass(frozen=True)
class Apprenticeship:
    """The result of Algorithm 2: alpha*, the learned policy, the epoch it was taken from, and how it came about."""

    weights: Tensor
    policy: LSTMPolicy
    chosen_epoch: int
    records: tuple[IterationRecord, ...]


def maxent_irl(
    learner: Learner,
    expert_features: Tensor,
    start: Tensor,
    params: WeightParams,
    n_iterations: int,
    n_measured: int,
    report: Callable[[IterationRecord], None] = lambda record: None,
    memory: Memory | None = None,
) -> Apprenticeship:
    """Algorithm 2: policy optimisation, Monte Carlo evaluation, gradient, ascent; `n_iterations` times.

    The epochs of the learner are shared evenly among the iterations. With as many iterations as epochs, the weights
    move a little after every epoch. What is measured is the mode of the present policy, because a running average would
    lag behind and make the weights swing; what is kept is the learner's average where the smoothed gap is least.

    Args:
        expert_features: v_E, the mean trajectory features of the demonstrations, shape (d,).
        start: alpha before the first iteration, shape (d,).
        n_measured: episodes of the deployed policy (its mode) that estimate E[v_pi] in each iteration.
        report: called with the record of each iteration as it ends.
        memory: where the training keeps its state; with one it goes on where an interrupted run was.

    Raises:
        TrainingError: if the return, the gradient or the features are not finite.
    """
    features = learner.features
    ascent = WeightAscent(params, start, expert_features)
    smoothed = torch.zeros_like(expert_features)
    records: list[IterationRecord] = []
    nearest, best_gap, chosen = copy.deepcopy(learner.average), float("inf"), 0
    memory = memory or NoMemory()
    started: list[EpochRecord] = []  # epochs of an interrupted iteration
    first = 1
    if (state := memory.recall()) is not None:
        learner.restore(state["learner"])
        ascent.restore(state["ascent"])
        nearest.load_state_dict(state["nearest"])
        smoothed, best_gap, chosen, first = (state[name] for name in ("smoothed", "best_gap", "chosen", "iteration"))
        records = [IterationRecord(**row | {"weights": tuple(row["weights"])}) for row in state["records"]]
        started = [EpochRecord(**row) for row in state["started"]]

    def state_of(iteration: int, epochs: Sequence[EpochRecord]) -> dict[str, Any]:
        return {
            "learner": learner.state(),
            "ascent": ascent.state(),
            "nearest": nearest.state_dict(),
            "smoothed": smoothed,
            "best_gap": best_gap,
            "chosen": chosen,
            "iteration": iteration,
            "records": [asdict(record) for record in records],
            "started": [asdict(record) for record in epochs],
        }

    def keep(iteration: int, epochs: Sequence[EpochRecord]) -> None:
        memory.keep(partial(state_of, iteration, epochs))

    for iteration in range(first, n_iterations + 1):
        n_epochs = learner.total_epochs * iteration // n_iterations - learner.total_epochs * (iteration - 1) // n_iterations
        alpha = ascent.weights
        reward = partial(apprentice_reward, features=features, weights=alpha)
        epochs = reinforce(learner, reward, n_epochs, learner.params.patience, earlier=started, keep=partial(keep, iteration))
        started = []
        controller = PolicyController(learner.policy, features.task, exploring=False)
        measured = expected_features(learner.process, controller, features, n_measured, learner.generator)
        learner.episodes += n_measured
        if not torch.isfinite(measured.mean).all():
            raise TrainingError(f"epoch {learner.epochs}: the trajectory features of the policy are not finite")
        ascent.step(maxent_gradient(expert_features, measured.mean))
        gap = relative_gap(measured.mean, expert_features)
        smoothed = gap if iteration == 1 else params.selection_memory * smoothed + (1 - params.selection_memory) * gap
        if smoothed.abs().mean() < best_gap or not params.keep_nearest:
            nearest, best_gap, chosen = copy.deepcopy(learner.average), smoothed.abs().mean().item(), learner.epochs
        records.append(
            IterationRecord(
                iteration=iteration,
                epochs=learner.epochs,
                episodes=learner.episodes,
                gradient_steps=learner.gradient_steps,
                mean_return=epochs[-1].mean_return,
                feature_gap=feature_gap(measured.mean, expert_features),
                learning_rate=epochs[-1].learning_rate,
                policy_std=epochs[-1].policy_std,
                weights=tuple(alpha.tolist()),
            )
        )
        report(records[-1])
    memory.keep(partial(state_of, n_iterations + 1, []), finished=True)
    return Apprenticeship(ascent.result, nearest, chosen, tuple(records))
