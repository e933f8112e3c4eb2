"""The natural gradient of the policy: the steepest ascent where distance is how much the policy's distribution changes."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.utils import parameters_to_vector

from helpers.learning.lstm import Tape, stack, stacked, step
from helpers.learning.policy import RELU6_TOP, LSTMPolicy
from helpers.plant.task import ControlTask, Trajectories

EPISODES = 50  # of a batch that estimate the Fisher matrix: the metric needs fewer than the gradient
ITERATIONS = 8  # of conjugate gradients
DAMPING = 1e-2  # added to the diagonal, so that directions which the policy's distribution hardly feels stay short


class Layer:
    """How the hidden states of an LSTM layer move with its parameters and inputs, along recorded inputs (T, n_in, K)."""

    def __init__(self, inputs: Tensor, weight: Tensor) -> None:
        self.n_inputs = inputs.shape[1]
        self.weight = weight
        self.tape = Tape.blank(len(inputs), weight, inputs.shape[-1])
        self.tape.inputs.copy_(inputs)
        for moment in self.tape.moments[: len(inputs)]:
            step(moment, weight)
        gates = self.tape.gates
        slope = gates * (1 - gates)
        width = len(weight) // 4
        slope[:, 3 * width :] = 1 - gates[:, 3 * width :] ** 2
        squashed = self.tape.squashed
        entry, forget, exit_, candidate = gates.split(width, dim=1)
        # d z_t -> what it adds to d c_t, and with the third block to d h_t: each gate's partner times its slope.
        self.into = torch.stack([candidate, self.tape.cells[:-1], squashed, entry], dim=1) * slope.unflatten(1, (4, width))
        self.forget, self.onward = forget, exit_ * (1 - squashed**2)

    def tangent(self, d_inputs: Tensor, d_weight: Tensor) -> Tensor:
        """d h_0..h_{T-1}, shape (T, n, K), for changes of the inputs (T, n_in, K) and of the `stacked` weights."""
        width = len(self.weight) // 4
        recurrent = self.weight[:, -width:].contiguous()
        d_gates = d_weight @ self.tape.signals[:-1] + self.weight[:, : self.n_inputs] @ d_inputs
        d_hidden = torch.zeros_like(self.forget)
        d_h = d_cell = torch.zeros_like(self.forget[0])
        for t, d_z in enumerate(d_gates):
            moved = torch.addmm(d_z, recurrent, d_h).view_as(self.into[t]) * self.into[t]
            d_cell = torch.addcmul(moved[0] + moved[1] + moved[3], self.forget[t], d_cell)
            d_h = torch.addcmul(moved[2], self.onward[t], d_cell, out=d_hidden[t])
        return d_hidden


def jacobian_product(
    policy: LSTMPolicy, y: Tensor, u: Tensor, task: ControlTask
) -> Callable[[Sequence[Tensor]], tuple[Tensor, Tensor]]:
    """J v: how mean and standard deviation, each (T, K, n_u), move with the parameters; v in pieces of their shapes.

    Forward through the linearised network, which costs about as much as the rollout.
    """
    with torch.no_grad():
        signal = policy.network_inputs(y[: len(u)], torch.cat([torch.zeros_like(u[:1]), u[:-1]]), task).mT
        layers, kinks, first = [], [], torch.zeros_like(signal)
        for lstm in policy.lstms:
            layers.append(Layer(signal, stacked(lstm).detach()))
            hidden = layers[-1].tape.hidden
            kinks.append(torch.where(hidden > 0, 1.0, policy.params.leaky_slope).to(hidden))
            signal = functional.leaky_relu(hidden, policy.params.leaky_slope)
        top = policy.output.weight.detach()
        output = top @ signal + policy.output.bias[:, None]
        inside = ((output > 0) & (output < RELU6_TOP)) * policy.scaling(task).factor[:, None]

    def product(pieces: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        moved, each = first, iter(pieces)
        for layer, kink in zip(layers, kinks, strict=True):
            moved = layer.tangent(moved, stack([next(each) for _ in range(4)])) * kink
        d_output = (next(each) @ signal + top @ moved + next(each)[:, None]) * inside
        mean, std = d_output.mT.chunk(2, dim=-1)
        return mean, std

    return product


def fisher_product(policy: LSTMPolicy, y: Tensor, u: Tensor, task: ControlTask) -> Callable[[Tensor], Tensor]:
    """F v for any v, shape (p,), with F the Fisher matrix of one decision, averaged over trajectories (Kakade 2002).

    With J the Jacobian of mean and standard deviation in the p parameters, F = J' diag(1/s^2, 2/s^2) J for independent
    normal inputs.

    Args:
        y, u: as for `LSTMPolicy.forward`.
    """
    parameters = list(policy.parameters())
    jacobian = jacobian_product(policy, y, u, task)
    outputs = policy(y, u, task)
    precision = outputs[1].detach() ** -2 / u[..., 0].numel()

    def product(vector: Tensor) -> Tensor:
        mean, std = jacobian(_like(vector, parameters))
        back = torch.autograd.grad(outputs, parameters, [mean * precision, 2 * std * precision], retain_graph=True)
        return parameters_to_vector(back)

    return product


def precondition(policy: LSTMPolicy, batch: Trajectories, task: ControlTask, trust_region: float) -> None:
    """Turn the gradient that the policy's parameters hold into the natural one, as long as the trust region allows.

    By the quadratic model, a step along it changes the policy by a divergence of `trust_region` nats a decision, less what
    damping takes (Schulman et al. 2015, Appendix C). There is no line search.
    """
    # Every stage that learns imports this module, few take the natural gradient, and scipy's solvers take long to load.
    from scipy.sparse.linalg import LinearOperator, cg  # noqa: PLC0415

    parameters = list(policy.parameters())
    gradient = parameters_to_vector([parameter.grad for parameter in parameters if parameter.grad is not None])
    product = fisher_product(policy, batch.y[:, :EPISODES], batch.u[:, :EPISODES], task)

    def damped(vector: np.ndarray) -> np.ndarray:
        tensor = torch.from_numpy(vector.ravel()).to(gradient.dtype)
        return (product(tensor) + DAMPING * tensor).numpy()

    operator = LinearOperator((len(gradient), len(gradient)), matvec=damped, dtype=gradient.numpy().dtype)
    solution, _ = cg(operator, gradient.numpy(), maxiter=ITERATIONS)
    direction = torch.from_numpy(solution).to(gradient.dtype)
    # Along the iterates of conjugate gradients, d' (F + damping) d = d' g.
    length = (2 * trust_region / (direction @ gradient).clamp(min=torch.finfo(gradient.dtype).tiny)).sqrt()
    for parameter, piece in zip(parameters, _like(length * direction, parameters), strict=True):
        parameter.grad = piece.clone()


def _like(vector: Tensor, parameters: Sequence[Tensor]) -> list[Tensor]:
    """A vector cut into pieces of the parameters' shapes."""
    pieces = vector.split([parameter.numel() for parameter in parameters])
    return [piece.view_as(parameter) for piece, parameter in zip(pieces, parameters, strict=True)]
