"""What Algorithm 1 is made of: returns and advantages, surrogates of the policy gradient, and the learner that takes the steps.

As printed: the whole return less its mean over the batch, and one plain step an epoch. Ours are reward-to-go with a regression
baseline, clipped steps on minibatches, an entropy bonus, a critic, a step size that falls, and a running average of the weights.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from helpers.learning.critic import Critic
from helpers.learning.evaluation import expected_features
from helpers.learning.features import FeatureMap, accumulated_error, discounts, normalised_error
from helpers.learning.lstm import Tape
from helpers.learning.optimiser import Adam
from helpers.learning.policy import LSTMPolicy, PolicyController, entropy, log_density
from helpers.plant.process import Process
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories
from helpers.settings.paper import LearnerParams

BLOCK = 1000  # episodes whose gradient is computed at once: more would only take memory
FEW = 100  # episodes below which torch's own LSTM is faster than the gradient through time written out: 7 against 17 ms for 50
NOTHING = "every episode earned the same reward, so there is nothing to learn from"


class TrainingError(RuntimeError):
    """Learning cannot go on; the message names the epoch and the cause."""


def discounted_return(rewards: Tensor, gamma: float) -> Tensor:
    """G of each trajectory, Eq. 3.1.5: sum_t gamma^(t-1) R_t; (T, K) to (K,)."""
    return discounts(len(rewards), gamma, rewards) @ rewards


def reward_to_go(rewards: Tensor, gamma: float, decay: float = 1.0) -> Tensor:
    """The part of G that u_t can still change, row t = 0..T-1: the sum of gamma^(s-1) decay^(s-1-t) R_s over s > t.

    With decay = 1 it is exact. Below one it counts late rewards less: they hardly depend on u_t but carry all the noise
    met on the way, so a little bias buys much variance (Schulman et al. 2016, Eq. 16 with a value of zero).
    """
    discounted = rewards * discounts(len(rewards), gamma, rewards)[:, None]
    future = torch.empty_like(discounted)
    carried = torch.zeros_like(discounted[0])
    for t in reversed(range(len(rewards))):
        carried = discounted[t] + decay * carried
        future[t] = carried
    return future


def whole_return_advantage(rewards: Tensor, gamma: float) -> Tensor:
    """G^k - b with one scalar baseline, step 2 of Algorithm 1, the same at every step; (T, K) to (T, K)."""
    value = discounted_return(rewards, gamma)
    return (value - value.mean()).expand_as(rewards)


def regression_advantage(rewards: Tensor, gamma: float, decay: float, regressors: Tensor) -> Tensor:
    """Reward-to-go less a baseline of its own for each step: a linear regression on what was known before the input.

    A baseline may depend on the past but not on the present input, so the gradient keeps its expectation (notebook 02).

    Args:
        rewards: R_1..R_T, shape (T, K).
        regressors: shape (T, K, p); row t was known before u_t was drawn. A constant is added here.
    """
    future = reward_to_go(rewards, gamma, decay)
    design = torch.cat([torch.ones_like(future)[:, None], regressors.mT], dim=1)  # in memory the trajectories come last
    ridge = 1e-3 * rewards.shape[1] * torch.eye(design.shape[1], dtype=design.dtype)
    coefficients = torch.linalg.solve(design @ design.mT + ridge, design @ future[..., None])
    return future - (coefficients.mT @ design)[:, 0]


def baseline_regressors(trajectories: Trajectories, features: FeatureMap) -> Tensor:
    """What the per-step baseline may look at: error, its size and square, its integral, the previous input; (T, K, p).

    All come from the observations, so that the same baseline serves on a plant.
    """
    task = features.task
    error = normalised_error(trajectories.y[:-1], task.set_point, task.error_scale)
    integral = accumulated_error(error, features.sampling_time)
    previous = torch.cat([torch.zeros_like(trajectories.u[:1]), trajectories.u[:-1]]) / (task.input_high - task.input_low)
    return torch.cat([entry.mT for entry in (error, error.abs(), error**2, integral, previous)], dim=1).mT


def surrogate(log_probability: Tensor, advantage: Tensor) -> Tensor:
    """The scalar whose gradient is the policy gradient, Eq. 3.2.4: (1/K) sum_k sum_t A_t^k ln pi(u_t^k | ...)."""
    return (advantage * log_probability).sum(0).mean()


def clipped_surrogate(log_probability: Tensor, drawn: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """The same gradient for a batch drawn a few steps ago: probability ratios, clipped (Schulman et al. 2017, Eq. 7).

    The paper names proximal policy optimisation as an alternative. Where the policy has not moved since the batch was
    drawn, the gradient is that of `surrogate`.

    Args:
        log_probability, drawn: ln pi of the commands under the present policy and under the one that drew them, (T, K).
    """
    ratio = (log_probability - drawn).exp()
    return torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).sum(0).mean()


def annealed(start: float, end: float, progress: float) -> float:
    """A step size that falls from `start` to `end` along half a cosine while `progress` goes from 0 to 1."""
    return end + (start - end) * (1 + math.cos(math.pi * progress)) / 2


@dataclass(frozen=True)
class EpochRecord:
    """What one epoch of Algorithm 1 gave, and what learning had cost by its end.

    `mean_return` is that of the exploring policy and `standard_error` its Monte Carlo error; `policy_std` is the mean
    standard deviation of the policy as a share of the input range.
    """

    epochs: int
    episodes: int
    gradient_steps: int
    mean_return: float
    standard_error: float
    learning_rate: float
    policy_std: float


class Learner:
    """A policy under Algorithm 1: its optimiser, the running average of its weights and what learning has cost so far.

    Attributes:
        policy: the policy that explores and takes the gradient steps.
        average: the exponential average of its weights, which is what is kept in the end. With an averaging coefficient
            of zero it equals the policy.
        rate: the present learning rate.
        epochs, episodes, gradient_steps: counted up as they are spent.
    """

    def __init__(
        self,
        policy: LSTMPolicy,
        process: Process,
        features: FeatureMap,
        params: LearnerParams,
        n_episodes: int,
        total_epochs: int,
        generator: torch.Generator,
    ) -> None:
        self.policy = policy
        self.average = copy.deepcopy(policy)
        self.process = process
        self.features = features
        self.params = params
        self.n_episodes = n_episodes
        self.total_epochs = total_epochs
        self.generator = generator
        self.optimiser, self.rate = Adam(policy.parameters()), params.learning_rate_start
        self.epochs = self.episodes = self.gradient_steps = 0
        self.critic, self.beta = Critic(features), 0.0  # without beta, of no use
        self._tape: Tape | None = None

    def tracking(self, beta: float) -> Callable[[Trajectories], Tensor]:
        """The reward of Eq. 5.1.2.1 with this beta; from now on the critic, if there is one, learns under the same."""
        self.beta = beta
        return partial(self.features.tracking, beta=beta)

    @property
    def led(self) -> float:
        """The share of the gradient that the critic gives."""
        return self.params.critic if self.beta else 0.0

    def realise(self) -> Trajectories:
        """Step 1 of Algorithm 1: K episodes of T steps under the exploring policy."""
        task, recording = self.features.task, self.n_episodes <= BLOCK
        controller = PolicyController(self.policy, task, exploring=True, recording=recording, used=self._tape)
        batch = rollout(self.process, controller, task, self.n_episodes, self.generator)
        self._tape = controller.tape
        return batch

    def advantage(self, rewards: Tensor, batch: Trajectories) -> Tensor:
        """What each input earned beyond the baseline, in units of its spread over the batch; (T, K).

        Raises:
            TrainingError: if the return is not finite, or the same in every episode.
        """
        params, gamma = self.params, self.features.params.discount
        if params.credit == "whole_return":
            advantage = whole_return_advantage(rewards, gamma)
        else:
            advantage = regression_advantage(rewards, gamma, params.credit_decay, baseline_regressors(batch, self.features))
        if not torch.isfinite(advantage).all():
            raise TrainingError(f"epoch {self.epochs + 1}: the return of the policy is not finite")
        spread = advantage.std()
        if not spread > 0 and self.led == 1:
            return advantage  # nobody asks for it
        if not spread > 0:
            raise TrainingError(f"epoch {self.epochs + 1}: {NOTHING}")
        return advantage / spread

    def ascend(self, batch: Trajectories, advantage: Tensor) -> None:
        """Step 2 of Algorithm 1: along the policy gradient, at this epoch's step size; then the average of the weights.

        Raises:
            TrainingError: if the gradient is not finite, or the critic expects the same reward of every input.
        """
        params = self.params
        self.rate = annealed(params.learning_rate_start, params.learning_rate_end, self.epochs / max(1, self.total_epochs - 1))
        self._ascend(batch, advantage)
        self.epochs += 1
        self.episodes += self.n_episodes
        # The warm-up keeps the untrained first weights from lingering in the average.
        keep = min(params.averaging, self.epochs / (self.epochs + 9)) if params.averaging else 0.0
        with torch.no_grad():
            for average, current in zip(self.average.parameters(), self.policy.parameters(), strict=True):
                average.lerp_(current, 1 - keep)

    def record(self, rewards: Tensor, batch: Trajectories) -> EpochRecord:
        """What the epoch that has just ended gave; how far the policy explores is read off one trajectory."""
        returns, task = discounted_return(rewards, self.features.params.discount), self.features.task
        with torch.no_grad():
            std = self.policy(batch.y[:, :1], batch.u[:, :1], task)[1]
        return EpochRecord(
            self.epochs,
            self.episodes,
            self.gradient_steps,
            returns.mean().item(),
            returns.std().item() / self.n_episodes**0.5,
            self.rate,
            (std / (task.input_high - task.input_low)).mean().item(),
        )

    def expected_features(self, n_episodes: int) -> Tensor:
        """E[v] of the policy's mode by Monte Carlo, Algorithm S1, shape (d,); its episodes count as spent.

        The mode of the present policy, not the average of its weights: that would lag behind and make the reward weights swing.

        Raises:
            TrainingError: if the features are not finite.
        """
        mode = PolicyController(self.policy, self.features.task, exploring=False)
        v = expected_features(self.process, mode, self.features, n_episodes, self.generator)
        self.episodes += n_episodes
        if not torch.isfinite(v).all():
            raise TrainingError(f"epoch {self.epochs}: the trajectory features of the policy are not finite")
        return v

    def _ascend(self, batch: Trajectories, advantage: Tensor) -> None:
        """Gradient steps on one batch, minibatch by minibatch, in one pass or more.

        A single step is the plain policy gradient; with more, every step after the first meets a batch that an older
        policy drew, and the clipped ratio corrects for it.
        """
        params, task = self.params, self.features.task
        n_steps = params.passes * params.minibatches
        if led := self.led:
            self.critic.learn(batch)
        edges = [self.n_episodes * part // params.minibatches for part in range(params.minibatches + 1)]
        drawn = None
        if n_steps > 1:
            with torch.no_grad():
                drawn = log_density(batch.command, *self._distribution(batch, slice(0, self.n_episodes), self._tape is not None))
        for step in range(n_steps):
            first, last = edges[step % params.minibatches], edges[step % params.minibatches + 1]
            recorded = step == 0 and self._tape is not None  # later on the tape is that of an older policy
            self.policy.zero_grad()
            for start in range(first, last, BLOCK):
                rows = slice(start, min(start + BLOCK, last))
                mean, std = self._distribution(batch, rows, recorded)
                log_probability = log_density(batch.command[:, rows], mean, std)
                if drawn is None:
                    gain = surrogate(log_probability, advantage[:, rows])
                else:
                    gain = clipped_surrogate(log_probability, drawn[:, rows], advantage[:, rows], params.ratio_clip)
                if params.entropy:
                    gain = gain + params.entropy * entropy(std, task).sum(0).mean()
                if led:
                    q = self.critic.value(batch.y[:-1, rows], mean.clamp(task.input_low, task.input_high), self.beta)
                    gain = (1 - led) * gain + led * q.sum(0).mean()
                (-gain * (rows.stop - rows.start) / (last - first)).backward()
            for name, parameter in self.policy.named_parameters():
                if parameter.grad is not None and not parameter.grad.isfinite().all():
                    cause = f"the gradient of {name} is not finite at the learning rate {self.rate:g}"
                    raise TrainingError(f"epoch {self.epochs + 1}: {cause}")
            if led == 1 and not any(parameter.grad.any() for parameter in self.policy.parameters() if parameter.grad is not None):
                raise TrainingError(f"epoch {self.epochs + 1}: {NOTHING}")
            self.optimiser.step(self.rate)
            self.gradient_steps += 1

    def _distribution(self, batch: Trajectories, rows: slice, recorded: bool) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the present policy along some episodes."""
        if not recorded and rows.stop - rows.start < FEW:
            return self.policy(batch.y[:, rows], batch.u[:, rows], self.features.task)
        tape = self._tape and self._tape.part(rows.start, rows.stop)
        return self.policy.unrolled(batch.y[:, rows], batch.u[:, rows], self.features.task, tape, recorded)
