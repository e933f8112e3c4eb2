"""Algorithm 2: maximum-entropy inverse reinforcement learning of the reward weights, with Algorithm 1 inside."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from helpers.learning.algorithm_1 import algorithm_1
from helpers.learning.evaluation import feature_gap, relative_gap
from helpers.learning.features import FeatureMap, linear_reward
from helpers.learning.learner import EpochRecord, Learner, TrainingError
from helpers.learning.policy import LSTMPolicy
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


class Nearest:
    """Ours: which policy is kept. The average of the learner's weights where the smoothed gap of the features is least.

    The printed algorithm keeps the last one, as `keep_nearest: false` does.
    """

    def __init__(self, params: WeightParams, learner: Learner) -> None:
        self.params = params
        self.policy, self.epoch, self.gap = copy.deepcopy(learner.average), 0, float("inf")
        self.smoothed: Tensor | None = None

    def offer(self, learner: Learner, gap: Tensor) -> None:
        """The learner after an iteration, and the relative gap of its features, shape (d,)."""
        old = self.params.selection_memory
        self.smoothed = gap if self.smoothed is None else old * self.smoothed + (1 - old) * gap
        mean = self.smoothed.abs().mean()
        if mean < self.gap or not self.params.keep_nearest:
            self.policy, self.epoch, self.gap = copy.deepcopy(learner.average), learner.epochs, mean.item()


def algorithm_2(
    learner: Learner,
    v_expert: Tensor,
    start: Tensor,
    params: WeightParams,
    n_iterations: int,
    n_measured: int,
    watch: Callable[[IterationRecord], object] = lambda record: None,
) -> Apprenticeship:
    """Maximum-entropy IRL: policy optimisation, Monte Carlo evaluation, gradient, ascent; `n_iterations` times.

    The epochs of the learner are shared evenly among the iterations; with as many iterations as epochs (ours) the weights move a
    little after every epoch.

    Args:
        v_expert: v_E, the mean trajectory features of the demonstrations, shape (d,).
        start: alpha before the first iteration, shape (d,).
        n_measured: episodes of the policy's mode that estimate E[v_pi] in each iteration.
        watch: called with the record of each iteration as it ends.

    Raises:
        TrainingError: if the return, the gradient or the features are not finite.
    """
    ascent, kept = WeightAscent(params, start, v_expert), Nearest(params, learner)
    records: list[IterationRecord] = []
    for n_epochs in shares(learner.total_epochs, n_iterations):
        alpha = ascent.weights
        reward = partial(apprentice_reward, features=learner.features, weights=alpha)  # Eq. 4.2.5
        epochs = algorithm_1(learner, reward, n_epochs, learner.params.patience)  # policy optimisation
        v = learner.expected_features(n_measured)  # Monte Carlo evaluation, Algorithm S1
        ascent.step(maxent_gradient(v_expert, v))  # Eq. 3.4.4-3.4.6
        kept.offer(learner, relative_gap(v, v_expert))
        records.append(iteration_record(len(records) + 1, learner, epochs[-1], alpha, feature_gap(v, v_expert)))
        watch(records[-1])
    return Apprenticeship(ascent.result, kept.policy, kept.epoch, tuple(records))


def iteration_record(iteration: int, learner: Learner, epoch: EpochRecord, alpha: Tensor, gap: float) -> IterationRecord:
    """What an outer iteration gave: its last epoch, the weights it was under, and the feature gap after it."""
    last = {name: getattr(epoch, name) for name in ("mean_return", "learning_rate", "policy_std")}
    spent = {name: getattr(learner, name) for name in ("epochs", "episodes", "gradient_steps")}
    return IterationRecord(iteration=iteration, feature_gap=gap, weights=tuple(alpha.tolist()), **spent, **last)


def shares(total: int, parts: int) -> list[int]:
    """So many epochs, shared as evenly as whole numbers can be."""
    ends = [total * part // parts for part in range(parts + 1)]
    return [after - before for before, after in pairwise(ends)]
