"""The same algorithm one episode at a time, the usual research style: Python loops over episodes and over steps.

Policy and process are called with a batch of one, log-probabilities are kept for autograd as they arise, and the loss and
the optimiser step are those of the project's own learner.
"""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from helpers.learning.algorithm_1 import Reward
from helpers.learning.learner import Learner, surrogate
from helpers.learning.policy import RELU6_TOP, LSTMPolicy
from helpers.plant.process import Process
from helpers.plant.task import ControlTask, Trajectories


class StepwisePolicy(nn.Module):
    """The policy of Section 3.2 as one would write it for one sample; takes the weights of an `LSTMPolicy`."""

    def __init__(self, policy: LSTMPolicy, task: ControlTask) -> None:
        """Starts as a copy of `policy`."""
        super().__init__()
        self.params, self.task = policy.params, task
        dtype = task.set_point.dtype
        widths = [len(task.set_point) + len(task.input_low), *self.params.hidden_cells]
        self.layers = nn.ModuleList(nn.LSTM(below, width, dtype=dtype) for below, width in pairwise(widths))
        self.output = nn.Linear(widths[-1], 2 * len(task.input_low), dtype=dtype)
        self.error_unit = torch.tensor(self.params.error_unit, dtype=dtype)
        self.load_state_dict(policy.state_dict())

    def forward(
        self, y: Tensor, u_previous: Tensor, states: list[tuple[Tensor, Tensor] | None]
    ) -> tuple[Tensor, Tensor, list[tuple[Tensor, Tensor] | None]]:
        """Mean and standard deviation of the input, each (1, n_u), and the layers' states, for one observation (1, n_y)."""
        task, params = self.task, self.params
        span = task.input_high - task.input_low
        seen = [(task.set_point - y) / self.error_unit, (2 * u_previous - task.input_high - task.input_low) / span]
        signal = torch.cat(seen, dim=-1)[None]
        following: list[tuple[Tensor, Tensor] | None] = []
        for layer, state in zip(self.layers, states, strict=True):
            signal, state_after = layer(signal, state)
            following.append(state_after)
            signal = functional.leaky_relu(signal, params.leaky_slope)
        mean, deviation = (functional.relu6(self.output(signal[0])) / RELU6_TOP).chunk(2, dim=-1)
        return task.input_low + span * mean, (params.std_low + (params.std_high - params.std_low) * deviation) * span, following


def episode(policy: StepwisePolicy, process: Process, generator: torch.Generator) -> tuple[Trajectories, Tensor]:
    """One episode, step by step: its record with K = 1 and ln pi of its commands, shape (T, 1), ready for autograd."""
    task = policy.task
    dtype = task.set_point.dtype

    def normal(width: int) -> Tensor:
        return torch.randn(1, width, generator=generator, dtype=dtype)

    states: list[tuple[Tensor, Tensor] | None] = [None] * len(policy.layers)
    x = task.initial_mean + task.initial_std * normal(process.n_states)
    y = process.observe(x, normal(process.n_outputs))
    u = torch.zeros(1, process.n_inputs, dtype=dtype)
    xs, ys, us, commands, log_probabilities = [x], [y], [], [], []
    for _ in range(task.n_steps):
        mean, std, states = policy(y, u, states)
        command = (mean + std * normal(process.n_inputs)).detach()
        log_probability = -(((command - mean) / std) ** 2) / 2 - std.log() - math.log(2 * math.pi) / 2
        log_probabilities.append(log_probability.sum(-1))
        u = command.clamp(task.input_low, task.input_high)
        x = process.step(x, u, normal(process.n_disturbances))
        y = process.observe(x, normal(process.n_outputs))
        xs.append(x)
        ys.append(y)
        us.append(u)
        commands.append(command)
    record = Trajectories(torch.stack(xs), torch.stack(ys), torch.stack(us), torch.stack(commands))
    return record, torch.stack(log_probabilities)


class OneAtATime:
    """A learner that draws its episodes one after the other; all else is as in the project's `learner`, which stays as it is."""

    def __init__(self, learner: Learner) -> None:
        """Starts from a copy of the learner's policy."""
        self.learner = learner
        self.policy = StepwisePolicy(learner.policy, learner.features.task)
        self.optimiser = torch.optim.Adam(self.policy.parameters(), lr=learner.params.learning_rate_start)

    def gain(self, reward: Reward) -> tuple[Tensor, Trajectories]:
        """The surrogate of the policy gradient, Eq. 3.2.4, from fresh episodes, and their record."""
        learner = self.learner
        episodes = [episode(self.policy, learner.process, learner.generator) for _ in range(learner.n_episodes)]
        signals = ([getattr(record, name) for record, _ in episodes] for name in ("x", "y", "u", "command"))
        batch = Trajectories(*(torch.cat(signal, dim=1) for signal in signals))
        log_probability = torch.cat([each for _, each in episodes], dim=1)
        return surrogate(log_probability, learner.advantage(reward(batch), batch)), batch

    def epoch(self, reward: Reward) -> None:
        """Episodes, gradient, Adam step."""
        gain, _ = self.gain(reward)
        self.optimiser.zero_grad()
        (-gain).backward()
        self.optimiser.step()
