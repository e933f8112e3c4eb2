"""One policy for a range of set points: a PID plus what a recurrent network adds to it.

u_t = clip(s_t + q_t) with q_t = P e_t + D (e_t - e_{t-1}) + c_t and the integral s_t = clip(s_{t-1} + I e_t), where e = y_sp - y
and c_t is the network's correction. At rest neither q nor s changes, so that I e = 0: no offset stays, whatever was learned. The
integral stays within the bounds of the input, so that nothing winds up. What the bounds cut off q is not lost, so that noise near a
bound shifts nothing, as it does in the usual velocity form. s_{t-1} is u_{t-1} + x_{t-1} - q_{t-1} with the input that was applied
and what was cut off, x: whoever moves it by hand hands over without a jump.

For plants whose inputs sit at their bounds for long there is a patient form, which does not leave a bound as soon as the error
shrinks: s_t = u_{t-1} + k x_{t-1} - q_{t-1} + I e_t with k in (0, 1) learned (back-calculation, Astrom and Hagglund 2006, Section
3.5). Where the network's output layer is zero, both are PIDs.
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

    def command(
        self,
        error: Tensor,
        u_previous: Tensor,
        memory: tuple[Tensor, ...],
        bounds: Bounds,
        correction: Tensor | float = 0.0,
        kept: Tensor | None = None,
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The command (K, n_u) of the module's formula, and the memory after it.

        Args:
            error: at this sample, (K, n_y). u_previous: the input applied last, (K, n_u). correction: of the network, (K, n_u).
            kept: k of the patient form, (n_u,). memory: the error one sample before, what the bounds cut off then, and q.
        """
        once, excess, quick = memory
        if kept is None:
            integral = (u_previous + excess - quick + _times(self.integral, error)).clamp(bounds.low, bounds.high)
        else:
            integral = u_previous + kept * excess - quick + _times(self.integral, error)
        quick = _times(self.proportional, error) + _times(self.derivative, error - once) + correction
        command = integral + quick
        return command, (error, command - command.clamp(bounds.low, bounds.high), quick)

    def start(self, n_trajectories: int) -> tuple[Tensor, ...]:
        """The memory before the first sample: zero."""
        n_u, n_y = self.integral.shape[-2:]
        return tuple(self.integral.new_zeros(n_trajectories, width) for width in (n_y, n_u, n_u))


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[..., None])[..., 0]


class TrackingPID:
    """A PID for many set points; its memory is that of `Gains.command`."""

    def __init__(self, gains: Gains, bounds: Bounds) -> None:
        self.gains = gains
        self.bounds = bounds

    def start(self, n_trajectories: int) -> tuple[Tensor, ...]:
        """No error before, and nothing cut off."""
        return self.gains.start(n_trajectories)

    def act(
        self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: tuple[Tensor, ...]
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The law at one sample."""
        return self.gains.command(set_point - y, u_previous, memory, self.bounds)


class TrackingPolicy(nn.Module):
    """The policy of this module; deviation variables.

    The network sees each error in units of its scale, the set point and the input applied last within their ranges. Its layers are
    those of Section 3.2.

    Args:
        gains: of the PID that it starts from. unit: scale of each error (n_y,).
        centre, reach: middle and half width of the range of set points, (n_y,). kept: k at the start, for the patient form.
    """

    unit: Tensor
    centre: Tensor
    reach: Tensor
    low: Tensor
    high: Tensor
    integral: Tensor
    kept_logit: nn.Parameter | None

    def __init__(
        self,
        params: PolicyParams,
        gains: Gains,
        unit: Tensor,
        centre: Tensor,
        reach: Tensor,
        bounds: Bounds,
        kept: float | None = None,
    ) -> None:
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
        self.register_parameter("kept_logit", None if kept is None else nn.Parameter(torch.full_like(bounds.low, kept).logit()))

    @property
    def lstms(self) -> list[nn.LSTM]:
        """The hidden layers, from the input upwards."""
        return [layer for layer in self.layers if isinstance(layer, nn.LSTM)]

    @property
    def _scale(self) -> Tensor:
        return (self.high - self.low)[:, None] / 2 / self.unit

    @property
    def kept(self) -> Tensor | None:
        """k, (n_u,), or None where the integral stays within the bounds."""
        return None if self.kept_logit is None else torch.sigmoid(self.kept_logit)

    @property
    def gains(self) -> Gains:
        """The PID inside."""
        scale = self._scale
        return Gains(self.proportional * scale, self.integral * self.integral_log.exp(), self.derivative * scale)

    def start(self, n_trajectories: int) -> tuple[Tensor, ...]:
        """Zero: the memory of `Gains.command`, and h and c of each layer."""
        self.pid, self.k = self.gains, self.kept  # once an episode
        self.bounds = Bounds(self.low, self.high, torch.full_like(self.low, torch.inf))
        widths = (width for width in self.params.hidden_cells for _ in "hc")
        return *self.pid.start(n_trajectories), *(self.unit.new_zeros(n_trajectories, width) for width in widths)

    def act(
        self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: tuple[Tensor, ...]
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The command and the memory for the next sample."""
        error, (pid, states) = set_point - y, (memory[:3], memory[3:])
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        seen = [torch.asinh(SHARPNESS * error / self.unit), (set_point - self.centre) / self.reach, (u_previous - middle) / half]
        signal = torch.cat(seen, dim=-1)
        after: list[Tensor] = []
        for index, layer in enumerate(self.lstms):
            after += torch.lstm_cell(signal, states[2 * index : 2 * index + 2], *layer.all_weights[0])
            signal = functional.leaky_relu(after[-2], self.params.leaky_slope)
        command, pid = self.pid.command(error, u_previous, pid, self.bounds, self.output(signal) * half, self.k)
        return command, (*pid, *after)
