"""What is attainable: an estimate of the optimum of the tracking objective by dynamic programming, knowing process and state.

The process x_(t+1) = A x_t + B u_t + diag(s) x_t w_t with diagonal B makes it tractable: each input moves the mean of one state
alone, and the noise of the states is independent, so that one-step expectations are products over the states.
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


def expected_closeness(mean_error: Array, error_std: Array, beta: float) -> Array:
    """E exp(-(beta e)^2) for a normal e: the Type I feature of Eq. 4.2.2, expected one step ahead.

    (1 + 2 beta^2 s^2)^(-1/2) exp(-beta^2 m^2 / (1 + 2 beta^2 s^2)), m and s being mean and standard deviation of e.
    """
    spread = 1 + 2 * (beta * error_std) ** 2
    return np.exp(-((beta * mean_error) ** 2) / spread) / np.sqrt(spread)


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
        result = _coefficients(self.axes, self.value)[None]
        for points, state in zip(self.axes, x.double().numpy().T, strict=True):
            rows = _basis(points, state).toarray()
            result = np.einsum("ka...,ka->k...", np.broadcast_to(result, (len(rows), *result.shape[1:])), rows)
        return torch.from_numpy(result)


def _coefficients(axes: Sequence[Array], values: Array) -> Array:
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
        reward: expected reward of each loop, shape (n_x, G, n).
        transition: for each state the expected spline basis at the next sample, shape (G, n, N).
    """

    inputs: Array
    reward: Array
    transition: tuple[Array, ...]


def one_step(process: LinearProcess, task: ControlTask, beta: float, axes: Sequence[Array], resolution: Resolution) -> OneStep:
    """Rewards and transitions one sample ahead from every grid point.

    The reward is in closed form, because beta = 30 is too narrow for a few nodes. The value of the next state is smoother; the
    expectation of its splines is taken by a Gauss-Hermite rule.

    Raises:
        ValueError: if an input moves the mean of more than one state.
    """
    A, B = process.state_step.double().numpy(), process.input_step.double().numpy()
    if B.shape[0] != B.shape[1] or np.count_nonzero(B - np.diag(B.diagonal())):
        raise ValueError("the dynamic programme needs inputs that each move one state alone: B must be diagonal")
    states = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    low, high = task.input_low.double().numpy(), task.input_high.double().numpy()
    inputs = np.linspace(low, high, resolution.inputs, axis=-1)
    mean = (states @ A.T).T[..., None] + B.diagonal()[:, None, None] * inputs[:, None]
    std = (process.disturbance_gain.double().numpy() * process.sampling_time**0.5 * np.abs(states)).T
    scale, target = task.error_scale.double().numpy(), task.set_point.double().numpy()
    reward = expected_closeness(
        (target[:, None, None] - mean) / scale[:, None, None], (std / np.abs(scale)[:, None])[..., None], beta
    )
    nodes, weights = np.polynomial.hermite_e.hermegauss(resolution.nodes)
    weights /= weights.sum()
    transition = []
    for points, m, s in zip(axes, mean, std, strict=True):
        expected = np.zeros((m.size, len(points)))
        for node, weight in zip(nodes, weights, strict=True):
            expected += weight * _basis(points, m + node * s[:, None]).toarray()
        transition.append(expected.reshape(*m.shape, len(points)))
    return OneStep(inputs, reward, tuple(transition))


def _expected_value(step: OneStep, spline: Array) -> Array:
    """E of the next value for every grid point and pair of inputs, shape (G, n, ..., n), from spline coefficients."""
    first, *others = step.transition
    n_grid, n_inputs, n_points = first.shape
    value = (first.reshape(-1, n_points) @ spline.reshape(n_points, -1)).reshape(n_grid, n_inputs, *spline.shape[1:])
    for matrix in others:
        value = np.moveaxis(value, 2, -1)  # the first axis that is still one of the next state
        before = value.shape[1:-1]
        value = (value.reshape(n_grid, -1, matrix.shape[-1]) @ matrix.mT).reshape(n_grid, *before, n_inputs)
    return value


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

    Raises:
        ValueError: if an input moves the mean of more than one state.
    """
    step = one_step(process, task, beta, axes, resolution)
    shape = tuple(len(points) for points in axes)
    reward: Array = np.zeros(())
    for axis, of_loop in enumerate(step.reward):
        reward = reward + of_loop.reshape(len(of_loop), *(-1 if other == axis else 1 for other in range(len(shape))))
    value, tables = np.zeros(shape), []
    for _ in range(task.n_steps):
        best, inputs = _best(reward + discount * _expected_value(step, _coefficients(axes, value)), step.inputs)
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
