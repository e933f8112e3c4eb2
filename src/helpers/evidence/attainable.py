"""What is attainable: an estimate of the optimum of the tracking objective by dynamic programming, knowing process and state.

The next state is taken for what its first moments say, and its entries for independent, so that one-step expectations are products
over the states. Those of the value are computed on a lattice of *moves* v = B u, each of which shifts the mean of one state alone,
and read off by splines at the inputs that are tried. What this leaves out shows between value and Monte Carlo.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import BSpline, RegularGridInterpolator, make_interp_spline
from scipy.sparse import csr_array
from torch import Tensor

from helpers.plant.process import LinearProcess
from helpers.plant.task import ControlTask

Array = NDArray[np.float64]
DEGREE = 3  # of the splines between the grid points
BLOCK = 500  # grid points at once, which bounds the memory


def expected_closeness(mean_error: Array, error_std: Array, beta: float, third: Array | float = 0.0) -> Array:
    """E exp(-(beta e)^2) for an error e with this mean, standard deviation and third central moment: Eq. 4.2.2, one step ahead.

    Of a normal e it is G = (1 + 2 beta^2 s^2)^(-1/2) exp(-a m^2), a = beta^2 / (1 + 2 beta^2 s^2). The third moment k adds
    k / 6 times the third derivative of G in m (Gram-Charlier series of type A).
    """
    spread = 1 + 2 * (beta * error_std) ** 2
    a = beta**2 / spread
    skewed = 1 + third / 6 * (12 * a**2 * mean_error - 8 * a**3 * mean_error**3)
    return np.exp(-a * mean_error**2) / np.sqrt(spread) * skewed


@dataclass(frozen=True)
class Resolution:
    """How finely the programme computes: grid points a state, inputs tried a loop, nodes of the Gauss-Hermite rule."""

    states: int
    inputs: int
    nodes: int


@dataclass(frozen=True)
class Optimum:
    """The programme's solution on a grid.

    Attributes:
        axes: grid points of each state, deviation variables.
        inputs: the best input at each time and grid point, shape (T, *grid, n_u).
        value: expected discounted objective from each grid point at t = 0, shape of the grid.
    """

    axes: tuple[Array, ...]
    inputs: Array
    value: Array

    def value_at(self, x: Tensor) -> Tensor:
        """The expected objective from initial states (K, n_x), shape (K,); states off the grid count as its edge."""
        result = coefficients(self.axes, self.value)[None]
        for points, state in zip(self.axes, x.double().numpy().T, strict=True):
            rows = _basis(points, state).toarray()
            result = np.einsum("ka...,ka->k...", np.broadcast_to(result, (len(rows), *result.shape[1:])), rows)
        return torch.from_numpy(result)


def coefficients(axes: Sequence[Array], values: Array) -> Array:
    """The coefficients of the spline through values on the grid, of their shape."""
    for axis, points in enumerate(axes):
        values = np.moveaxis(make_interp_spline(points, np.moveaxis(values, axis, 0), DEGREE).c, 0, axis)
    return values


def _basis(points: Array, at: Array) -> csr_array:
    """The spline basis on grid points at states, one row a state; states off the grid are taken to its edge."""
    knots = make_interp_spline(points, points, DEGREE).t
    inside = np.clip(at.ravel(), points[0], points[-1])
    return csr_array(BSpline.design_matrix(inside, knots, DEGREE))


def grid_around(states: Tensor, n_points: int, margin: float) -> tuple[Array, ...]:
    """Axes that hold all given states (..., n_x), widened on either side by a share `margin` of their range."""
    flat = states.double().reshape(-1, states.shape[-1]).numpy()
    low, high = flat.min(0), flat.max(0)
    reach = margin * (high - low)
    return tuple(np.linspace(first, last, n_points) for first, last in zip(low - reach, high + reach, strict=True))


@dataclass(frozen=True)
class OneStep:
    """What does not depend on time: for every grid point and every input of a lattice between the bounds.

    Attributes:
        inputs: the lattice of each input, shape (n_u, n).
        reward: expected reward of all loops, shape (G, n, ..., n).
        transition: for each state the expected spline basis at the next sample, as coefficients of a spline over n moves of its
            mean, shape (G, n, N).
        moves: the basis of these splines at the moves of every combination of inputs, shape (n^n_u, n^n_x).
    """

    inputs: Array
    reward: Array
    transition: tuple[Array, ...]
    moves: csr_array


def one_step(process: LinearProcess, task: ControlTask, beta: float, axes: Sequence[Array], resolution: Resolution) -> OneStep:
    """Rewards and transitions one sample ahead from every grid point.

    The reward is in closed form, because beta = 30 is too narrow for a few nodes. The value of the next state is smoother: there a
    Gauss-Hermite rule does, for a normal of its mean and variance.
    """
    A, B = process.state_step.double().numpy(), process.input_step.double().numpy()
    states = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    low, high = task.input_low.double().numpy(), task.input_high.double().numpy()
    inputs = np.linspace(low, high, resolution.inputs, axis=-1)
    tried = np.stack(np.meshgrid(*inputs, indexing="ij"), axis=-1)  # (n, ..., n, n_u)
    scale, target = task.error_scale.double().numpy(), task.set_point.double().numpy()
    reward = []
    for block in np.array_split(states, -(-len(states) // BLOCK)):
        mean, std, third = _moments(process, block[(slice(None), *[None] * len(inputs))], tried)
        error, skew = (target - mean) / scale, -third / scale**3
        reward.append(expected_closeness(error, std / np.abs(scale), beta, skew).sum(-1))
    asked = tried @ B.T
    flat = asked.reshape(-1, asked.shape[-1])
    lattice = np.linspace(flat.min(0), flat.max(0), resolution.inputs, axis=-1)
    nodes, weights = np.polynomial.hermite_e.hermegauss(resolution.nodes)
    weights /= weights.sum()
    middle, transition = (low + high) / 2, []
    for loop, (points, moves) in enumerate(zip(axes, lattice, strict=True)):
        # The input that makes a move; how it moves the other states hardly counts for the spread of this one.
        making = middle + np.outer(moves - (B @ middle)[loop], np.linalg.inv(B)[:, loop])
        _, spread, _ = _moments(process, states[:, None], making)
        expected = np.zeros((len(states) * len(moves), len(points)))
        for node, weight in zip(nodes, weights, strict=True):
            at = (states @ A.T)[:, [loop]] + moves + node * spread[..., loop]
            expected += weight * _basis(points, at).toarray()
        over_moves = np.moveaxis(expected.reshape(len(states), len(moves), len(points)), 1, 0)
        transition.append(np.moveaxis(make_interp_spline(moves, over_moves, DEGREE).c, 0, 1))
    # Row by row the products of the few splines that are not nought at a move.
    values, columns = np.ones((len(flat), 1)), np.zeros((len(flat), 1), dtype=int)
    for moves, column in zip(lattice, flat.T, strict=True):
        basis = _basis(moves, column)
        inner, place = (part.reshape(len(flat), 1, -1) for part in (basis.data, basis.indices))
        values = (values[:, :, None] * inner).reshape(len(flat), -1)
        columns = (columns[:, :, None] * len(moves) + place).reshape(len(flat), -1)
    rows = np.arange(0, values.size + 1, values.shape[1])
    combined = csr_array((values.ravel(), columns.ravel(), rows), shape=(len(flat), resolution.inputs ** len(lattice)))
    return OneStep(inputs, np.concatenate(reward), tuple(transition), combined)


def _moments(process: LinearProcess, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """Mean, standard deviation and third central moment of the next state, (..., n_x), from states and inputs that broadcast.

    The third is that which each state would have by itself: what reaches it by way of the others is left out.
    """
    shape = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
    dtype = process.state_step.dtype
    mean, entry = (torch.from_numpy(np.broadcast_to(part, (*shape, part.shape[-1])).copy()).to(dtype) for part in (x, u))
    covariance, third = torch.zeros_like(mean).diag_embed(), torch.zeros_like(mean)
    kept, kick = 1 + process.tau * process.drift_state.diagonal(), process.tau * process.disturbance_gain**2
    for _ in range(process.integration_steps):
        # Of a x + c + s x w with w ~ N(0, 1): E[(x - m) x^2] is the third moment plus twice mean times variance.
        twice = 2 * mean * covariance.diagonal(dim1=-2, dim2=-1)
        third = kept**3 * third + 3 * kept * kick * (third + twice)
        mean, covariance = process.moments(mean, covariance, entry, steps=1)
    return mean.double().numpy(), covariance.diagonal(dim1=-2, dim2=-1).double().sqrt().numpy(), third.double().numpy()


def expected_value(step: OneStep, spline: Array) -> Array:
    """E of the next value for every grid point and combination of inputs, shape (G, n, ..., n), from spline coefficients."""
    first, *others = step.transition
    n_grid, n_inputs, n_points = first.shape
    value = (first.reshape(-1, n_points) @ spline.reshape(n_points, -1)).reshape(n_grid, n_inputs, *spline.shape[1:])
    for matrix in others:
        value = np.moveaxis(value, 2, -1)  # the first axis that is still one of the next state
        before = value.shape[1:-1]
        value = (value.reshape(n_grid, -1, matrix.shape[-1]) @ matrix.mT).reshape(n_grid, *before, n_inputs)
    return (step.moves @ value.reshape(n_grid, -1).T).T.reshape(n_grid, *[n_inputs] * len(step.inputs))


def _best(gain: Array, lattice: Array) -> tuple[Array, Array]:
    """The greatest gain over the inputs and where it is taken: the best of the lattice, moved to the top of a parabola.

    Args:
        gain: shape (G, n, ..., n), an axis for each input.

    Returns:
        Gain (G,) and inputs (G, n_u).
    """
    n_grid, n_inputs = gain.shape[:2]
    flat = gain.reshape(n_grid, -1).argmax(1)
    place = np.unravel_index(flat, gain.shape[1:])
    rows = np.arange(n_grid)
    top = gain.reshape(n_grid, -1)[rows, flat]
    best, inputs = top.copy(), []
    for axis, index in enumerate(place):
        inner = (index > 0) & (index < n_inputs - 1)  # at a bound the best input is the bound
        around = []
        for move in (-1, 1):
            moved = [*place]
            moved[axis] = np.clip(index + move, 0, n_inputs - 1)
            around.append(gain[(rows, *moved)])
        slope, bend = (around[1] - around[0]) / 2, around[0] - 2 * top + around[1]
        shift = np.where(inner & (bend < 0), -slope / np.where(bend < 0, bend, -1), 0)
        best += np.where(inner, slope * shift + bend * shift**2 / 2, 0)
        spacing = lattice[axis, 1] - lattice[axis, 0]
        inputs.append(lattice[axis, index] + spacing * shift)
    return best, np.stack(inputs, axis=-1)


def dynamic_programme(
    process: LinearProcess, task: ControlTask, beta: float, discount: float, axes: tuple[Array, ...], resolution: Resolution
) -> Optimum:
    """Value iteration backwards over the horizon for the tracking objective of Eq. 5.1.2.1 on x.

    V_t(x) = max over u of E[R_(t+1) + gamma V_(t+1)(x_(t+1))], V_T = 0 (Bertsekas 2017, Section 1.3). Between the grid points V is
    a cubic spline. It is an estimate of the optimum, not a bound: grid, lattice and nodes all err a little to either side.
    """
    step = one_step(process, task, beta, axes, resolution)
    shape = tuple(len(points) for points in axes)
    value, tables = np.zeros(shape), []
    for _ in range(task.n_steps):
        best, inputs = _best(step.reward + discount * expected_value(step, coefficients(axes, value)), step.inputs)
        value = best.reshape(shape)
        tables.append(inputs.reshape(*shape, -1))
    return Optimum(axes, np.stack(tables[::-1]), value)


class Tabulated:
    """The programme's policy: the best inputs of the grid, linear between its points. The memory is the time.

    It takes the observation for the state, and is optimal only where they are the same. `stationary` keeps the inputs of the
    first sample, for runs longer than the horizon.
    """

    def __init__(self, optimum: Optimum, stationary: bool = False) -> None:
        self.axes = optimum.axes
        self.inputs = optimum.inputs
        self.stationary = stationary

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> int:
        """Time nought."""
        return 0

    def act(self, observation: Tensor, memory: int) -> tuple[Tensor, int]:
        """The best input of this time at these states."""
        x = observation.double().numpy()
        inside = np.stack([np.clip(state, points[0], points[-1]) for state, points in zip(x.T, self.axes, strict=True)], axis=-1)
        table = RegularGridInterpolator(self.axes, self.inputs[memory])
        return torch.from_numpy(table(inside)).to(observation.dtype), memory + (not self.stationary)
