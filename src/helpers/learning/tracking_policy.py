"""One policy for a range of set points: a PID in velocity form plus what a recurrent network adds to it.

u_t = u_{t-1} + P (e_t - e_{t-1}) + I e_t + D (e_t - 2 e_{t-1} + e_{t-2}) + c_t - c_{t-1}, with e = y_sp - y and c_t the network's
correction. At rest c does not change, so that I e = 0: no offset stays, whatever the network has learned. The input before is
the one that was applied, so that nothing winds up at a bound. Where the network's output layer is zero the policy is the PID.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from helpers.plant.tracking import Bounds
from helpers.settings.paper import PolicyParams

SHARPNESS = 10.0  # asinh(10 e) tells small errors apart and does not run away for large ones


@dataclass(frozen=True)
class Gains:
    """A linear law on the errors, each (n_u, n_y) or one an episode, per sample: P, I and D."""

    proportional: Tensor
    integral: Tensor
    derivative: Tensor

    @property
    def law(self) -> Tensor:
        """The PID in velocity form as one matrix on (e_t, e_{t-1}, e_{t-2}), shape (..., n_u, 3 n_y)."""
        p, i, d = self.proportional, self.integral, self.derivative
        return torch.cat([p + i + d, -p - 2 * d, d], dim=-1)


class VelocityPID:
    """A PID in velocity form for many set points; before the first sample the error is zero."""

    def __init__(self, gains: Gains) -> None:
        self.law = gains.law

    def start(self, n_trajectories: int) -> tuple[Tensor, Tensor]:
        """No error before."""
        zero = self.law.new_zeros(n_trajectories, self.law.shape[-1] // 3)
        return zero, zero

    def act(
        self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """The law at one sample."""
        error = set_point - y
        errors = torch.cat([error, *memory], dim=-1)
        return u_previous + (self.law @ errors[..., None])[..., 0], (error, memory[0])


class TrackingPolicy(nn.Module):
    """The policy of this module; deviation variables.

    The network sees each error in units of its scale, the set point and the input applied last within their ranges. Its layers are
    those of Section 3.2.

    Args:
        gains: of the PID that it starts from. unit: scale of each error (n_y,).
        centre, reach: middle and half width of the range of set points, (n_y,).
    """

    unit: Tensor
    centre: Tensor
    reach: Tensor
    low: Tensor
    high: Tensor
    integral: Tensor

    def __init__(self, params: PolicyParams, gains: Gains, unit: Tensor, centre: Tensor, reach: Tensor, bounds: Bounds) -> None:
        super().__init__()
        self.params = params
        n_u, n_y = gains.integral.shape
        widths = [2 * n_y + n_u, *params.hidden_cells]
        self.layers = nn.ModuleList(nn.LSTM(below, width) for below, width in zip(widths, params.hidden_cells, strict=False))
        self.output = nn.Linear(widths[-1], n_u)
        self.to(unit.dtype)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)
        buffers = {
            "unit": unit,
            "centre": centre,
            "reach": reach,
            "low": bounds.low,
            "high": bounds.high,
            "integral": gains.integral,
        }
        for name, value in buffers.items():
            self.register_buffer(name, value.clone())
        # In half ranges of the input over units of the error, so that a step of the optimiser means as much in every loop.
        self.proportional = nn.Parameter(gains.proportional / self._scale)
        self.derivative = nn.Parameter(gains.derivative / self._scale)
        self.integral_log = nn.Parameter(torch.zeros_like(gains.integral))  # the integral action keeps its sign and never vanishes

    @property
    def lstms(self) -> list[nn.LSTM]:
        """The hidden layers, from the input upwards."""
        return [layer for layer in self.layers if isinstance(layer, nn.LSTM)]

    @property
    def _scale(self) -> Tensor:
        return (self.high - self.low)[:, None] / 2 / self.unit

    @property
    def gains(self) -> Gains:
        """The PID inside."""
        scale = self._scale
        return Gains(self.proportional * scale, self.integral * self.integral_log.exp(), self.derivative * scale)

    def start(self, n_trajectories: int) -> tuple[Tensor, ...]:
        """Zero: errors one and two samples before, the correction before, and h and c of each layer."""
        self.law = self.gains.law  # once an episode
        n_u, n_y = self.integral.shape
        widths = [n_y, n_y, n_u, *(width for width in self.params.hidden_cells for _ in "hc")]
        return tuple(self.unit.new_zeros(n_trajectories, width) for width in widths)

    def act(
        self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: tuple[Tensor, ...]
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The command and the memory for the next sample."""
        error = set_point - y
        once, twice, before, *states = memory
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        seen = [torch.asinh(SHARPNESS * error / self.unit), (set_point - self.centre) / self.reach, (u_previous - middle) / half]
        signal = torch.cat(seen, dim=-1)
        after: list[Tensor] = []
        for index, layer in enumerate(self.lstms):
            after += torch.lstm_cell(signal, states[2 * index : 2 * index + 2], *layer.all_weights[0])
            signal = functional.leaky_relu(after[-2], self.params.leaky_slope)
        correction = self.output(signal) * half
        moves = torch.cat([error, once, twice], dim=-1) @ self.law.mT
        return u_previous + moves + correction - before, (error, once, correction, *after)


class PatientPolicy(TrackingPolicy):
    """The same, for plants whose inputs sit at their bounds for long: it does not leave a bound as soon as the error shrinks.

    u_t = u_{t-1} + k (asked_{t-1} - clip(asked_{t-1})) + ..., where k in (0, 1) is learned: with k = 0 it is the velocity form,
    with k = 1 a PID without anti-windup, between them back-calculation (Astrom and Hagglund 2006, Section 3.5).

    Args:
        kept: k at the start.
    """

    def __init__(
        self, params: PolicyParams, gains: Gains, unit: Tensor, centre: Tensor, reach: Tensor, bounds: Bounds, kept: float
    ) -> None:
        super().__init__(params, gains, unit, centre, reach, bounds)
        self.kept_logit = nn.Parameter(torch.full_like(bounds.low, kept).logit())

    def start(self, n_trajectories: int) -> tuple[Tensor, ...]:
        """What the bounds have cut off, which is nothing, before the other memory."""
        return self.low.new_zeros(n_trajectories, len(self.low)), *super().start(n_trajectories)

    def act(
        self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: tuple[Tensor, ...]
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The command and the memory for the next sample."""
        excess, *rest = memory
        command, after = super().act(y, set_point, u_previous, tuple(rest))
        command = command + torch.sigmoid(self.kept_logit) * excess
        return command, (command - command.clamp(self.low, self.high), *after)
