"""An LSTM layer, features first: one step, and the gradient through time written out.

The mathematics is that of torch.nn.LSTM, whose parameters it takes. It exists for speed: a rollout needs one step at a
time, and the gradient can start from what the rollout has computed already. Arrays have their features first and the
trajectories last, so that every gate is a contiguous block.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

# d z from d a, where a = sigmoid(z) or a = tanh(z), as torch's own backward passes compute it.
sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input
tanh_backward = torch.ops.aten.tanh_backward.default
tanh_backward_into = torch.ops.aten.tanh_backward.grad_input


@dataclass(frozen=True)
class Tape:
    """All that one layer computed along its last T steps of K trajectories; n cells, n_in inputs.

    A tape as long as the episode holds what the gradient needs; a tape of one step is all that control needs.

    Attributes:
        signals: [x_t, 1, h_{t-1}] for t = 0..T, shape (T + 1, n_in + 1 + n, K); the last x is never set. The row of ones
            carries the bias, so that one product makes all gates.
        gates: i_t, f_t, o_t and g_t after their activations, shape (T, 4 n, K): those with the logistic function first.
        cells: c_{t-1} for t = 0..T, shape (T + 1, n, K).
        squashed: tanh(c_t), shape (T, n, K).
    """

    signals: Tensor
    gates: Tensor
    cells: Tensor
    squashed: Tensor

    @classmethod
    def blank(cls, n_steps: int, weight: Tensor, n_trajectories: int, used: "Tape | None" = None) -> "Tape":
        """A tape at its start, hidden and cell state zero, for a layer with these `stacked` weights.

        A used tape of the same shape is wound back instead: new memory costs as much time as filling it.
        """
        width = weight.shape[0] // 4
        shape = (n_steps, weight.shape[0], n_trajectories)
        if used is not None and used.gates.shape == shape and used.gates.dtype == weight.dtype:
            tape = used
        else:
            tape = cls(
                signals=weight.new_ones(n_steps + 1, weight.shape[1], n_trajectories),
                gates=weight.new_empty(shape),
                cells=weight.new_empty(n_steps + 1, width, n_trajectories),
                squashed=weight.new_empty(n_steps, width, n_trajectories),
            )
        tape.signals[0, -width:] = 0
        tape.cells[0] = 0
        return tape

    def rows(self, rows: slice) -> "Tape":
        """The same for some of the trajectories."""
        return Tape(*(entry[..., rows].contiguous() for entry in (self.signals, self.gates, self.cells, self.squashed)))

    @property
    def hidden(self) -> Tensor:
        """h_0..h_{T-1}, shape (T, n, K)."""
        return self.signals[1:, -self.cells.shape[1] :]

    def step(self, t: int, x: Tensor, weight: Tensor) -> Tensor:
        """h_t from x_t (n_in, K) and what the tape holds of step t - 1; shape (n, K).

        (i, f, g, o) = W [x, 1, h], with the logistic function on i, f and o and tanh on g; c' = f c + i g; h' = o tanh(c').
        """
        width = self.cells.shape[1]
        now, after, row = t % len(self.signals), (t + 1) % len(self.signals), t % len(self.gates)
        self.signals[now, : len(x)] = x
        gates = torch.mm(weight, self.signals[now], out=self.gates[row])
        gates[: 3 * width].sigmoid_()
        gates[3 * width :].tanh_()
        entry, forget, exit_, candidate = gates.split(width)
        cell = torch.mul(forget, self.cells[now], out=self.cells[after]).addcmul_(entry, candidate)
        squashed = torch.tanh(cell, out=self.squashed[row])
        return torch.mul(exit_, squashed, out=self.signals[after, -width:])


def stacked(layer: nn.LSTM) -> Tensor:
    """The layer's parameters as one matrix on [x, 1, h], shape (4 n, n_in + 1 + n); torch's gates i, f, g, o as i, f, o, g."""
    return stack(layer.all_weights[0])


def stack(parameters: Sequence[Tensor]) -> Tensor:
    """`stacked` for the four parameters of a layer in torch's order, or for changes of them."""
    from_below, from_before, bias_below, bias_before = parameters
    matrix = torch.cat([from_below, (bias_below + bias_before)[:, None], from_before], dim=1)
    entry, forget, candidate, exit_ = matrix.chunk(4)
    return torch.cat([entry, forget, exit_, candidate])


class Unroll(torch.autograd.Function):
    """h_0..h_{T-1}, shape (T, n, K), from x_0..x_{T-1}, shape (T, n_in, K): an LSTM layer with its gradient through time.

    With the tape of a rollout under the same parameters nothing is computed twice. A tape serves for one gradient only.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, tape: Tape | None = None) -> Tensor:
        """The hidden states, from the tape if there is one."""
        if tape is None:
            tape = Tape.blank(len(inputs), weight, inputs.shape[-1])
            for t, x in enumerate(inputs):
                tape.step(t, x, weight)
        ctx.tape = tape
        ctx.n_inputs = inputs.shape[1]
        ctx.save_for_backward(weight)
        return tape.hidden

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, None]:
        """Backpropagation through time; `d_z` is the gradient of the loss in z. It spends the tape.

        Step by step, so that what a step needs stays in the processor's cache, and the gradients in the gates before their
        activation take the place of the gates.
        """
        (d_hidden,) = gradients
        (weight,) = ctx.saved_tensors
        signals, gates, cells, squashed = ctx.tape.signals, ctx.tape.gates, ctx.tape.cells, ctx.tape.squashed
        width = cells.shape[1]
        recurrent = weight[:, -width:].T.contiguous()
        d_later = torch.zeros_like(cells[0])  # the part of d_h that comes from step t + 1
        d_cell = torch.zeros_like(cells[0])
        d_weight = torch.zeros_like(weight)
        d_gates = torch.empty_like(gates[0])  # in the gates after their activation
        d_entry, d_forget, d_exit, d_candidate = d_gates.split(width)
        logistic, hyperbolic = gates.split([3 * width, width], dim=1)
        for t in reversed(range(len(gates))):
            entry, forget, exit_, candidate = gates[t].split(width)
            d_h = d_later.add_(d_hidden[t])
            d_cell += tanh_backward(d_h * exit_, squashed[t])
            torch.mul(d_cell, candidate, out=d_entry)
            torch.mul(d_cell, cells[t], out=d_forget)
            torch.mul(d_h, squashed[t], out=d_exit)
            torch.mul(d_cell, entry, out=d_candidate)
            d_cell *= forget
            sigmoid_backward(d_gates[: 3 * width], logistic[t], grad_input=logistic[t])
            tanh_backward_into(d_candidate, candidate, grad_input=hyperbolic[t])
            torch.mm(recurrent, gates[t], out=d_later)
            d_weight.addmm_(gates[t], signals[t].T)
        d_inputs = weight[:, : ctx.n_inputs].T @ gates if ctx.needs_input_grad[0] else None
        return d_inputs, d_weight, None
