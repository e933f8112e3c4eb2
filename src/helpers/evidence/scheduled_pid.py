"""A PID whose gains a network schedules: control-informed reinforcement learning (Bloor et al. 2024, arXiv 2408.13566)."""

import torch
from torch import Tensor

from helpers.plant.task import ControlTask
from helpers.settings.paper import GainParams

WIDEST = 5.0  # ln of the greatest factor that the network puts on a gain
ScheduledMemory = tuple[Tensor, Tensor, Tensor]  # the command before, the error before and its change, each (K, n_y)


class ScheduledPID:
    """The PID in velocity form, whose gains are those it begins with as long as all weights are zero.

    u_t = u_{t-1} + P (e_t - e_{t-1}) + I e_t dt + D (e_t - 2 e_{t-1} + e_{t-2}) / dt with P and I times the exponential of what the
    network gives, and D plus it. u_{t-1} is what was asked for, so that constant gains make the PID of the demonstrations. The
    network has one layer of tanh and sees the errors and the set point; without cells it gives constants: a PID that was tuned.

    Args:
        weights: of the network, (P, n), n as of `n_weights`: P controllers side by side, each for as many of the trajectories.
        gains: those it begins with.
        derivative_unit: of what it adds to D, in proportional gains times sampling times.
        error_unit: of the errors (n_y,). nominal: the set point that counts as one (n_y,).
    """

    def __init__(
        self,
        weights: Tensor,
        gains: GainParams,
        derivative_unit: float,
        error_unit: Tensor,
        nominal: Tensor,
        task: ControlTask,
        sampling_time: float,
    ) -> None:
        self.start_gains = torch.tensor([gains.proportional, gains.integral, gains.derivative], dtype=weights.dtype)
        self.derivative_step = derivative_unit * self.start_gains[0] * sampling_time
        self.unit, self.place, self.set_point, self.dt = error_unit, task.set_point / nominal, task.set_point, sampling_time
        n_y, n_gains = len(nominal), self.start_gains.numel()
        cells = (weights.shape[1] - n_gains) // (2 * n_y + 1 + n_gains)
        hidden, output = weights.split([cells * (2 * n_y + 1), n_gains * (cells + 1)], dim=1)
        self.hidden, self.output = hidden.unflatten(1, (cells, 2 * n_y + 1)), output.unflatten(1, (n_gains, cells + 1))

    @staticmethod
    def n_weights(n_y: int, cells: int) -> int:
        """How many weights a network of so many cells has."""
        return cells * (2 * n_y + 1) + 3 * n_y * (cells + 1)

    def gains(self, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """P, I and D for errors (K, n_y), each (K, n_y)."""
        scaled = (error / self.unit).view(len(self.output), -1, error.shape[1])
        one = torch.ones_like(scaled[..., :1])
        seen = torch.cat([scaled, self.place.expand_as(scaled), one], dim=-1)
        found = torch.cat([torch.tanh(seen @ self.hidden.mT), one], dim=-1) @ self.output.mT
        proportional, integral, derivative = found.clamp(-WIDEST, WIDEST).flatten(0, 1).chunk(3, dim=-1)
        p, i, d = self.start_gains
        return p * proportional.exp(), i * integral.exp(), d + self.derivative_step * derivative

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> None:
        """Nothing asked for, and no previous error."""

    def act(self, observation: Tensor, memory: ScheduledMemory | None) -> tuple[Tensor, ScheduledMemory]:
        """The law at one sample; the first has no derivative, as in the PID of the demonstrations."""
        error = self.set_point - observation
        p, i, d = self.gains(error)
        before, error_before, change_before = memory or (p * error, error, torch.zeros_like(error))
        change = error - error_before
        command = before + p * change + i * error * self.dt + d * (change - change_before) / self.dt
        return command, (command, error, change)
