"""The LSTM policy of Section 3.2: its distribution over the inputs, and its fast stepping in closed loop."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from helpers.learning.lstm import Tape, Unroll, for_steps, stacked, step
from helpers.plant.task import ControlTask
from helpers.settings.paper import ExplorationParams, PolicyParams

RELU6_TOP = 6.0  # Eq. 3.2.5


@dataclass(frozen=True)
class Scaling:
    """Deviation variables to and from what the network works with.

    Attributes:
        centre, gain: of its inputs, shape (n_y + n_u,): the error y_sp - y in its unit, the input as a share of its bounds.
        shift, factor: of its outputs after ReLU6, shape (n_u + n_u,): means between the bounds, standard deviations.
    """

    centre: Tensor
    gain: Tensor
    shift: Tensor
    factor: Tensor

    def inputs(self, y: Tensor, u_previous: Tensor) -> Tensor:
        """What the network sees, shape (..., n_y + n_u)."""
        return (torch.cat([y, u_previous], dim=-1) - self.centre) * self.gain

    def features_first(self) -> "Scaling":
        """The same for arrays whose trajectories come last: each of shape (n, 1)."""
        return Scaling(self.centre[:, None], self.gain[:, None], self.shift[:, None], self.factor[:, None])

    def outputs(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, each (..., n_u), from the output layer before its activation."""
        mean, std = torch.addcmul(self.shift, functional.relu6(output), self.factor).chunk(2, dim=-1)
        return mean, std


def log_density(command: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """ln of the density of independent normal inputs, summed over them; (..., n_u) to (...)."""
    return (-(((command - mean) / std) ** 2) / 2 - std.log() - math.log(2 * math.pi) / 2).sum(-1)


def entropy(std: Tensor, task: ControlTask) -> Tensor:
    """Entropy of independent normal inputs, each as a share of its range, summed over them; (..., n_u) to (...)."""
    return ((std / (task.input_high - task.input_low)).log() + (1 + math.log(2 * math.pi)) / 2).sum(-1)


class LSTMPolicy(nn.Module):
    """u_t ~ N(mu_t, diag(sigma_t^2)): an LSTM maps the history of normalised errors and inputs to mu and sigma.

    Each hidden layer is an LSTM with its usual gates whose output passes a leaky ReLU on its way up (the recurrence
    sees it without). The output layer ends in ReLU6 (Eq. 3.2.5), whose range 0 to 6 is mapped onto the input bounds for
    the mean, and onto the range of permitted standard deviations. What the network sees at time t is the error of each
    loop, y_sp - y, in units of `error_unit`, and the previous input, scaled so that the bounds are -1 and 1. The unit of
    the error is the same in all cases: a policy carried over to another set point keeps its gain, as a PID does.
    """

    def __init__(self, params: PolicyParams, n_controlled: int, n_manipulated: int) -> None:
        super().__init__()
        self.params = params
        self.n_manipulated = n_manipulated
        widths = [n_controlled + n_manipulated, *params.hidden_cells]
        self.layers = nn.ModuleList(nn.LSTM(below, width) for below, width in zip(widths, params.hidden_cells, strict=False))
        self.output = nn.Linear(widths[-1], n_manipulated + n_manipulated)
        self.error_unit = nn.Buffer(torch.tensor(params.error_unit, dtype=torch.float64), persistent=False)

    @property
    def lstms(self) -> list[nn.LSTM]:
        """The hidden layers, from the input upwards."""
        return [layer for layer in self.layers if isinstance(layer, nn.LSTM)]

    @classmethod
    def initial(cls, params: PolicyParams, task: ControlTask, generator: torch.Generator) -> "LSTMPolicy":
        """A fresh policy whose mean input is near u* = 0 and whose standard deviation is the initial one."""
        policy = cls(params, len(task.set_point), len(task.input_low)).to(task.set_point.dtype)
        with torch.no_grad():
            layers = [(layer, 1 / math.sqrt(layer.hidden_size)) for layer in policy.lstms]
            bounds = [(parameter, bound) for layer, bound in layers for parameter in layer.parameters()]
            top = params.initial_output_scale / math.sqrt(policy.output.in_features)
            for parameter, bound in [*bounds, (policy.output.weight, top)]:
                parameter.copy_(torch.rand(parameter.shape, generator=generator, dtype=parameter.dtype) * 2 * bound - bound)
            policy.output.bias[: policy.n_manipulated] = -RELU6_TOP * task.input_low / (task.input_high - task.input_low)
        policy.reset_exploration()
        return policy

    def reset_exploration(self, exploration: ExplorationParams | None = None) -> None:
        """Set the standard deviation to its initial value everywhere, so that a policy carried over can explore again.

        With `exploration` its limits change too; without, they stay those of the policy.
        """
        if exploration is not None:
            self.params = self.params.model_copy(update=exploration.model_dump())
        params, rows = self.params, slice(self.n_manipulated, None)
        with torch.no_grad():
            self.output.weight[rows] = 0
            self.output.bias[rows] = RELU6_TOP * (params.initial_std - params.std_low) / (params.std_high - params.std_low)

    def scaling(self, task: ControlTask) -> "Scaling":
        """The units in which the network sees and answers for a task."""
        params, span = self.params, task.input_high - task.input_low
        return Scaling(
            centre=torch.cat([task.set_point, (task.input_high + task.input_low) / 2]),
            gain=torch.cat([-1 / self.error_unit, 2 / span]),
            shift=torch.cat([task.input_low, params.std_low * span]),
            factor=torch.cat([span, (params.std_high - params.std_low) * span]) / RELU6_TOP,
        )

    def network_inputs(self, y: Tensor, u: Tensor, task: ControlTask) -> Tensor:
        """What the network sees along trajectories as of `forward`, shape (T, K, n_y + n_u); at first the input is u* = 0."""
        return self.scaling(task).inputs(y[: len(u)], torch.cat([torch.zeros_like(u[:1]), u[:-1]]))

    def forward(self, y: Tensor, u: Tensor, task: ControlTask) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of u_0..u_{T-1} along recorded trajectories, each (T, K, n_u).

        Args:
            y: observations y_0..y_{T-1} (a y_T is ignored), shape (T or T + 1, K, n_y).
            u: applied inputs u_0..u_{T-1}, shape (T, K, n_u).
        """
        signal = self.network_inputs(y, u, task)
        for layer in self.lstms:
            signal = functional.leaky_relu(layer(signal)[0], self.params.leaky_slope)
        return self.scaling(task).outputs(self.output(signal))

    def unrolled(
        self, y: Tensor, u: Tensor, task: ControlTask, tape: Tape | None = None, recorded: bool = False
    ) -> tuple[Tensor, Tensor]:
        """What `forward` gives, faster.

        A tape of these trajectories lends its memory. With `recorded` it holds what a controller with these parameters computed
        along the trajectories, and that is not computed again.
        """
        weights = [stacked(layer) for layer in self.lstms]
        if tape is None or not recorded:
            tape = Tape.blank(weights, u.shape[1], len(u), tape)
            tape.layers[0].inputs[:-1] = self.network_inputs(y, u, task).mT
        signal = Unroll.apply(tape, recorded, self.params.leaky_slope, *weights)
        # A batch of products: `@` would copy the signal of all steps to make one product of them.
        output = torch.baddbmm(self.output.bias[:, None], self.output.weight.expand(len(signal), -1, -1), signal)
        return self.scaling(task).outputs(output.mT)

    def log_probability(self, y: Tensor, u: Tensor, command: Tensor, task: ControlTask) -> Tensor:
        """ln pi(command_t | y_0..y_t, u_0..u_{t-1}), shape (T, K): the term of Eq. 3.2.3.

        The probability is that of the command before it was clipped to the bounds, which is what the policy drew.
        """
        return log_density(command, *self.unrolled(y, u, task))


@dataclass
class PolicyMemory:
    """What every layer computed so far, and the exploration noise of every step; features first."""

    step: int
    tape: Tape
    seen: Tensor  # the present observation above the input before it, shape (n_y + n_u, K)
    observed: Tensor  # the two parts of `seen`
    applied: Tensor
    exploration: tuple[Tensor, ...]  # standard normal, (n_u, K) for each step; empty without exploration


class PolicyController:
    """A policy in closed loop: the same mathematics as `LSTMPolicy.forward`, one step at a time, without gradients.

    `exploring` draws from the distribution; without it the mode is used, as on deployment. `recording` keeps what the
    layers computed in `tape`, for the gradient, writing over a used tape where there is one. The parameters are those of
    the policy when the controller was made.
    """

    def __init__(
        self, policy: LSTMPolicy, task: ControlTask, exploring: bool, recording: bool = False, used: Tape | None = None
    ) -> None:
        self.policy = policy
        self.task = task
        self.exploring = exploring
        self.recording = recording
        with torch.no_grad():
            self.layers = [for_steps(stacked(layer)) for layer in policy.lstms]
            self.output_weight, self.output_bias = policy.output.weight.clone(), policy.output.bias[:, None].clone()
        self.tape = used
        self.scaling = policy.scaling(task).features_first()
        self.low, self.high = task.input_low[:, None], task.input_high[:, None]

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> PolicyMemory:
        """Zero hidden states, the input at u* = 0, and all exploration noise drawn at once."""
        like, n_inputs = self.output_weight, self.policy.n_manipulated
        tape = Tape.blank(self.layers, n_trajectories, n_steps if self.recording else None, self.tape)
        self.tape = tape if self.recording else None
        shape = (n_steps, n_inputs, n_trajectories)
        noise = torch.randn(shape, generator=generator, dtype=like.dtype).unbind(0) if self.exploring else ()
        seen = like.new_zeros(len(self.scaling.centre), n_trajectories)
        return PolicyMemory(0, tape, seen, seen[:-n_inputs], seen[-n_inputs:], noise)

    def act(self, observation: Tensor, memory: PolicyMemory) -> tuple[Tensor, PolicyMemory]:
        """The policy's command for one sample; the memory is updated in place."""
        memory.observed.copy_(observation.T)
        moments = memory.tape.at(memory.step)
        torch.sub(memory.seen, self.scaling.centre, out=moments[0].inputs).mul_(self.scaling.gain)
        output = torch.addmm(self.output_bias, self.output_weight, step(moments, self.layers, self.policy.params.leaky_slope))
        mean, std = torch.addcmul(self.scaling.shift, functional.relu6(output), self.scaling.factor).chunk(2)
        command = torch.addcmul(mean, std, memory.exploration[memory.step]) if memory.exploration else mean
        torch.clamp(command, self.low, self.high, out=memory.applied)
        memory.step += 1
        return command.T, memory
