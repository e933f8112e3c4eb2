"""An LSTM layer, features first: one step, and the gradient through time written out.

The mathematics is that of torch.nn.LSTM, whose parameters it takes. It exists for speed: a rollout needs one step at a
time, and the gradient can start from what the rollout has computed already. Arrays have their features first and the
trajectories last, so that every gate is a contiguous block.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

# d z from d a, where a = sigmoid(z) or a = tanh(z), as torch's own backward passes compute it.
sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input
tanh_backward = torch.ops.aten.tanh_backward.grad_input


class Moment(NamedTuple):
    """Views of one step of a tape, made once: to cut them out anew at every step takes longer than what is done with them.

    `signal` is [x_t, 1, h_{t-1}] and `inputs` its part x_t (n_in, K); `gates` are (4 n, K), `logistic` their part i_t, f_t, o_t,
    whose parts are `entry`, `forget` and `exit`; `candidate` is g_t. The rest is c_{t-1}, c_t, tanh(c_t) and h_t, each (n, K).
    """

    signal: Tensor
    inputs: Tensor
    gates: Tensor
    logistic: Tensor
    entry: Tensor
    forget: Tensor
    exit: Tensor
    candidate: Tensor
    cell_before: Tensor
    cell: Tensor
    squashed: Tensor
    hidden: Tensor


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
        moments: the views of each step. A tape of one step turns in a circle, so it has two of them.
    """

    signals: Tensor
    gates: Tensor
    cells: Tensor
    squashed: Tensor
    moments: tuple[Moment, ...]

    @classmethod
    def over(cls, signals: Tensor, gates: Tensor, cells: Tensor, squashed: Tensor) -> "Tape":
        """The tape over this memory."""
        n_steps, width = squashed.shape[:2]
        signal, gate, cell, tanh = (entry.unbind(0) for entry in (signals, gates, cells, squashed))
        n_inputs = signals.shape[1] - 1 - width
        moments = []
        for t in range(max(n_steps, 2)):
            now, after, row = t % (n_steps + 1), (t + 1) % (n_steps + 1), t % n_steps
            entry, forget, exit_, candidate = gate[row].split(width)
            moments.append(
                Moment(
                    signal=signal[now],
                    inputs=signal[now][:n_inputs],
                    gates=gate[row],
                    logistic=gate[row][: 3 * width],
                    entry=entry,
                    forget=forget,
                    exit=exit_,
                    candidate=candidate,
                    cell_before=cell[now],
                    cell=cell[after],
                    squashed=tanh[row],
                    hidden=signal[after][n_inputs + 1 :],
                )
            )
        return cls(signals, gates, cells, squashed, tuple(moments))

    @classmethod
    def blank(cls, n_steps: int, weight: Tensor, n_trajectories: int, used: "Tape | None" = None) -> "Tape":
        """A tape at its start, hidden and cell state zero, for a layer with these `stacked` weights.

        A used tape of the same shape is wound back instead: new memory costs as much time as filling it.
        """
        width = weight.shape[0] // 4
        shape = (n_steps, weight.shape[0], n_trajectories)
        if used is not None and used.gates.shape == shape and used.gates.dtype == weight.dtype:
            return used.wound_back()
        return cls.over(
            signals=weight.new_ones(n_steps + 1, weight.shape[1], n_trajectories),
            gates=weight.new_empty(shape),
            cells=weight.new_empty(n_steps + 1, width, n_trajectories),
            squashed=weight.new_empty(n_steps, width, n_trajectories),
        ).wound_back()

    def wound_back(self) -> "Tape":
        """The tape itself, at its start."""
        self.signals[0, -self.cells.shape[1] :] = 0
        self.cells[0] = 0
        return self

    def part(self, rows: slice) -> "Tape":
        """The tape of some neighbouring trajectories, in the same memory."""
        if len(range(self.gates.shape[-1])[rows]) == self.gates.shape[-1]:
            return self
        return Tape.over(*(entry[..., rows] for entry in (self.signals, self.gates, self.cells, self.squashed)))

    @property
    def inputs(self) -> Tensor:
        """x_0..x_{T-1}, shape (T, n_in, K)."""
        return self.signals[:-1, : -1 - self.cells.shape[1]]

    @property
    def hidden(self) -> Tensor:
        """h_0..h_{T-1}, shape (T, n, K)."""
        return self.signals[1:, -self.cells.shape[1] :]

    def at(self, t: int) -> Moment:
        """The views of step t."""
        return self.moments[t % len(self.moments)]


def step(moment: Moment, weight: Tensor) -> Tensor:
    """h_t, shape (n, K), from the x_t and h_{t-1} that stand in the moment's signal.

    (i, f, g, o) = W [x, 1, h], with the logistic function on i, f and o and tanh on g; c' = f c + i g; h' = o tanh(c').
    """
    torch.mm(weight, moment.signal, out=moment.gates)
    moment.logistic.sigmoid_()
    moment.candidate.tanh_()
    torch.mul(moment.forget, moment.cell_before, out=moment.cell).addcmul_(moment.entry, moment.candidate)
    torch.tanh(moment.cell, out=moment.squashed)
    return torch.mul(moment.exit, moment.squashed, out=moment.hidden)


def stacked(layer: nn.LSTM) -> Tensor:
    """The layer's parameters as one matrix on [x, 1, h], shape (4 n, n_in + 1 + n); torch's gates i, f, g, o as i, f, o, g."""
    from_below, from_before, bias_below, bias_before = layer.all_weights[0]
    matrix = torch.cat([from_below, (bias_below + bias_before)[:, None], from_before], dim=1)
    entry, forget, candidate, exit_ = matrix.chunk(4)
    return torch.cat([entry, forget, exit_, candidate])


class Unroll(torch.autograd.Function):
    """h_0..h_{T-1}, shape (T, n, K), from x_0..x_{T-1}, shape (T, n_in, K): an LSTM layer with its gradient through time.

    With the tape of a rollout under the same parameters (`recorded`) nothing is computed twice. Otherwise a tape at its start only
    lends its memory. A tape serves for one gradient only.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, tape: Tape, recorded: bool) -> Tensor:
        """The hidden states, from the tape if they are recorded there."""
        if not recorded:
            tape.inputs.copy_(inputs)
            for moment in tape.moments[: len(inputs)]:
                step(moment, weight)
        ctx.tape = tape
        ctx.n_inputs = inputs.shape[1]
        ctx.save_for_backward(weight)
        return tape.hidden

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, None, None]:
        """Backpropagation through time; `d_z` is the gradient of the loss in z. It spends the tape.

        Step by step, so that what a step needs stays in the processor's cache, and the gradients in the gates before their
        activation take the place of the gates.
        """
        (d_hidden,) = gradients
        (weight,) = ctx.saved_tensors
        tape = ctx.tape
        width, n_steps = tape.cells.shape[1], len(tape.gates)
        # Back through [x, h] or through h alone: the lowest layer's inputs need no gradient.
        below = [weight[:, : ctx.n_inputs]] if ctx.needs_input_grad[0] else []
        back = torch.cat([*below, weight[:, -width:]], dim=1).T.contiguous()
        d_signals = weight.new_zeros(n_steps + 1, len(back), d_hidden.shape[-1])
        d_recurrent = d_signals[:, -width:].unbind(0)
        d_later = d_recurrent[n_steps]  # the part of d_h that comes from step t + 1
        d_cell, d_squashed = torch.zeros_like(d_later), torch.empty_like(d_later)
        d_weight = torch.zeros_like(weight)
        d_gates = weight.new_empty(4 * width, d_later.shape[1])  # in the gates after their activation
        d_entry, d_forget, d_exit, d_candidate = d_gates.split(width)
        d_logistic = d_gates[: 3 * width]
        steps = zip(tape.moments, d_hidden.unbind(0), d_signals.unbind(0), d_recurrent, strict=False)
        for moment, d_now, d_signal, d_before in reversed(list(steps)[:n_steps]):
            d_h = d_later.add_(d_now)
            torch.mul(d_h, moment.exit, out=d_squashed)
            d_cell += tanh_backward(d_squashed, moment.squashed, grad_input=d_squashed)
            torch.mul(d_cell, moment.candidate, out=d_entry)
            torch.mul(d_cell, moment.cell_before, out=d_forget)
            torch.mul(d_h, moment.squashed, out=d_exit)
            torch.mul(d_cell, moment.entry, out=d_candidate)
            d_cell *= moment.forget
            sigmoid_backward(d_logistic, moment.logistic, grad_input=moment.logistic)
            tanh_backward(d_candidate, moment.candidate, grad_input=moment.candidate)
            torch.mm(back, moment.gates, out=d_signal)
            d_later = d_before
            # The copy pays: a product is twice as fast where both matrices have their rows in a piece.
            d_weight.addmm_(moment.gates, moment.signal.T.contiguous())
        return d_signals[:-1, :-width] if ctx.needs_input_grad[0] else None, d_weight, None, None
