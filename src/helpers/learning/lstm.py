"""A stack of LSTM layers, features first: one step, and the gradient through time written out.

The mathematics is that of torch.nn.LSTM, whose parameters it takes, with a leaky ReLU on what each layer hands up. It exists for
speed: a rollout needs one step at a time, and the gradient can start from what the rollout has computed already. Arrays have their
features first and the trajectories last, so that every gate is a contiguous block.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

leaky_relu = torch.ops.aten.leaky_relu.out
# d z from d a, where a = sigmoid(z), tanh(z) or leaky_relu(z), as torch's own backward passes compute it.
sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input
tanh_backward = torch.ops.aten.tanh_backward.grad_input
leaky_relu_backward = torch.ops.aten.leaky_relu_backward.grad_input
MINUS_ONE, TWO = torch.tensor(-1.0), torch.tensor(2.0)  # a number of Python's would be made a tensor at every call


class Moment(NamedTuple):
    """Views of one step of a layer, made once: to cut them out anew at every step takes longer than what is done with them.

    `signal` is [x_t, 1, h_{t-1}] and `inputs` its part x_t (n_in, K); `gates` are (4 n, K), `logistic` their part i_t, f_t, o_t,
    whose parts are `entry`, `forget` and `exit`; `candidate` is g_t. The rest is c_{t-1}, c_t, tanh(c_t), h_t and what the layer
    hands up, each (n, K).
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
    output: Tensor


class Layer(NamedTuple):
    """What one layer computed along the last T steps of K trajectories; n cells, n_in inputs.

    Attributes:
        signals: [x_t, 1, h_{t-1}] for t = 0..T, shape (T + 1, n_in + 1 + n, K). The row of ones carries the bias, so that one
            product makes all gates.
        gates: i_t, f_t, o_t and g_t after their activations, shape (T, 4 n, K).
        cells: c_{t-1} for t = 0..T, shape (T + 1, n, K).
        squashed: tanh(c_t), shape (T, n, K).
    """

    signals: Tensor
    gates: Tensor
    cells: Tensor
    squashed: Tensor

    @property
    def inputs(self) -> Tensor:
        """x_0..x_T, shape (T + 1, n_in, K); the last is never set."""
        return self.signals[:, : -1 - self.cells.shape[1]]

    def moments(self, output: Tensor) -> Iterator[Moment]:
        """The views of each step; after the last row comes the first, so that as many rows as steps make a circle."""
        width = self.cells.shape[1]
        now = (self.signals, self.inputs, self.gates, self.gates[:, : 3 * width], *self.gates.split(width, dim=1), self.cells)
        cell, hidden = (rows[1:] + rows[:1] for rows in (self.cells.unbind(0), self.signals[:, -width:].unbind(0)))
        return map(Moment, *(entry.unbind(0) for entry in now), cell, self.squashed.unbind(0), hidden, output.unbind(0))


class Tape:
    """All that the layers computed along their last T steps, and views of each step.

    A tape as long as the episode holds what the gradient needs; one of two steps that turns in a circle is all that control needs.
    """

    def __init__(self, layers: Sequence[Layer], output: Tensor) -> None:
        """The tape over this memory; `output` (T, n, K) is what the top layer hands up."""
        self.layers, self.output = layers, output
        outputs = [*(layer.inputs for layer in layers[1:]), output]
        self.moments = list(zip(*map(Layer.moments, layers, outputs), strict=True))
        self.parts: dict[tuple[int, int], Tape] = {}

    @classmethod
    def blank(cls, weights: Sequence[Tensor], n_trajectories: int, n_steps: int | None, used: "Tape | None" = None) -> "Tape":
        """A tape at its start, hidden and cell states zero, for layers with these `stacked` weights; without `n_steps` a circle.

        A used tape of the same shape is wound back instead: new memory costs as much time as filling it.
        """
        n_rows, n_steps = (2, 2) if n_steps is None else (n_steps + 1, n_steps)
        if used is None or used.output.shape[::2] != (n_steps, n_trajectories) or used.output.dtype != weights[0].dtype:
            layers = []
            for weight in weights:
                width = len(weight) // 4
                shapes = (n_rows, weight.shape[1]), (n_steps, 4 * width), (n_rows, width), (n_steps, width)
                layers.append(Layer(*(weight.new_empty(*shape, n_trajectories) for shape in shapes)))
            used = cls(layers, torch.empty_like(layers[-1].squashed))
        for layer in used.layers:
            width = layer.cells.shape[1]
            layer.signals[:, -1 - width] = 1
            layer.signals[0, -width:] = 0
            layer.cells[0] = 0
        return used

    def part(self, first: int, last: int) -> "Tape":
        """The tape of some neighbouring trajectories, in the same memory."""
        if (first, last) == (0, self.output.shape[-1]):
            return self
        if (first, last) not in self.parts:
            layers = [Layer(*(entry[..., first:last] for entry in layer)) for layer in self.layers]
            self.parts[first, last] = Tape(layers, self.output[..., first:last])
        return self.parts[first, last]

    def at(self, t: int) -> tuple[Moment, ...]:
        """The views of step t, from the lowest layer upwards."""
        return self.moments[t % len(self.moments)]


def stacked(layer: nn.LSTM) -> Tensor:
    """The layer's parameters as one matrix on [x, 1, h], shape (4 n, n_in + 1 + n); torch's gates i, f, g, o as i, f, o, g."""
    from_below, from_before, bias_below, bias_before = layer.all_weights[0]
    matrix = torch.cat([from_below, (bias_below + bias_before)[:, None], from_before], dim=1)
    entry, forget, candidate, exit_ = matrix.chunk(4)
    return torch.cat([entry, forget, exit_, candidate])


def for_steps(weight: Tensor) -> Tensor:
    """`stacked` weights as `step` takes them: with tanh(z) = 2 sigmoid(2 z) - 1 one logistic function serves all gates."""
    doubled = weight.detach().clone()
    doubled[-(len(weight) // 4) :] *= 2
    return doubled


def step(moments: Sequence[Moment], weights: Sequence[Tensor], slope: float) -> Tensor:
    """What the top layer hands up, shape (n, K), from x_t and every h_{t-1}, which stand in the moments' signals.

    (i, f, g, o) = W [x, 1, h], with the logistic function on i, f and o and tanh on g; c' = f c + i g; h' = o tanh(c'). The
    recurrence sees h', the layer above leaky_relu(h'). tanh is made of the logistic function, which takes a third of the time.

    Args:
        weights: of each layer, as from `for_steps`.
    """
    for moment, weight in zip(moments, weights, strict=True):
        torch.mm(weight, moment.signal, out=moment.gates).sigmoid_()
        torch.add(MINUS_ONE, moment.candidate, alpha=2, out=moment.candidate)
        torch.mul(moment.forget, moment.cell_before, out=moment.cell).addcmul_(moment.entry, moment.candidate)
        torch.mul(moment.cell, TWO, out=moment.squashed).sigmoid_()
        torch.add(MINUS_ONE, moment.squashed, alpha=2, out=moment.squashed)
        torch.mul(moment.exit, moment.squashed, out=moment.hidden)
        leaky_relu(moment.hidden, slope, out=moment.output)
    return moments[-1].output


class Unroll(torch.autograd.Function):
    """What the top layer hands up, shape (T, n, K), from the inputs that stand on a tape, with its gradient through time.

    With the tape of a rollout under the same parameters (`recorded`) nothing is computed twice; another has to be at its start. A
    tape serves for one gradient only.
    """

    @staticmethod
    def forward(ctx: Any, tape: Tape, recorded: bool, slope: float, *weights: Tensor) -> Tensor:
        """The output of the tape, after going along it unless it is recorded there."""
        if not recorded:
            doubled = [for_steps(weight) for weight in weights]
            for moments in tape.moments:
                step(moments, doubled, slope)
        ctx.tape, ctx.slope = tape, slope
        ctx.save_for_backward(*weights)
        return tape.output[:]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Backpropagation through time; `d_z` is the gradient of the loss in z. It spends the tape.

        Step by step and layer by layer, so that what a step needs stays in the processor's cache. The gradient in a signal takes
        the signal's place: its parts are that in what the layer below handed up, and that in the hidden state one step before.
        """
        backs = [weight.T.contiguous() for weight in ctx.saved_tensors]
        d_weights = [torch.zeros_like(back) for back in backs]
        scratch = []
        for layer in ctx.tape.layers:
            layer.signals[-1, -layer.cells.shape[1] :] = 0  # nothing comes from beyond the last step
            d_gates = layer.gates.new_empty(layer.gates.shape[1:])  # in the gates after their activation
            parts = d_gates.split(layer.cells.shape[1])
            d_cell = torch.zeros_like(layer.cells[0])
            scratch.append((d_gates, d_gates[: -len(d_cell)], *parts, d_cell, torch.empty_like(d_cell)))
        work = list(zip(backs, d_weights, scratch, strict=True))
        for moments, d_top in reversed(list(zip(ctx.tape.moments, gradients[0].unbind(0), strict=True))):
            d_output = d_top
            for moment, (back, d_weight, rest) in zip(reversed(moments), reversed(work), strict=True):
                d_gates, d_logistic, d_entry, d_forget, d_exit, d_candidate, d_cell, d_h = rest
                # tanh(c) has the sign of h = o tanh(c), whose own place is taken.
                leaky_relu_backward(d_output, moment.squashed, ctx.slope, False, grad_input=d_h).add_(moment.hidden)
                torch.mul(d_h, moment.exit, out=d_exit)
                d_cell += tanh_backward(d_exit, moment.squashed, grad_input=d_exit)
                torch.mul(d_cell, moment.candidate, out=d_entry)
                torch.mul(d_cell, moment.cell_before, out=d_forget)
                torch.mul(d_h, moment.squashed, out=d_exit)
                torch.mul(d_cell, moment.entry, out=d_candidate)
                d_cell *= moment.forget
                sigmoid_backward(d_logistic, moment.logistic, grad_input=d_logistic)
                tanh_backward(d_candidate, moment.candidate, grad_input=d_candidate)
                d_weight.addmm_(moment.signal, d_gates.T)
                torch.mm(back, d_gates, out=moment.signal)
                d_output = moment.inputs
        return None, None, None, *(d_weight.T for d_weight in d_weights)
