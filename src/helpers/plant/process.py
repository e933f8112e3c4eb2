"""The controlled process: a linear stochastic differential equation and the balances behind it, Section 4.1."""

import copy
from typing import Protocol

import torch
from torch import Tensor

from helpers.settings.paper import BalanceParams, ProcessParams


class Process(Protocol):
    """What a rollout needs of a process. Noise is handed in: standard normal draws of the shape of the result."""

    n_states: int
    n_outputs: int
    n_inputs: int

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The next state, shape (K, n_x), from states (K, n_x) and inputs (K, n_u)."""
        ...

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The observation, shape (K, n_y), of states (K, n_x)."""
        ...


class LinearProcess:
    """Euler-Maruyama integration of Eq. 4.1.3 with the observation of Eq. 4.1.4, in deviation variables.

    x_{t+1} = x_t + (A x_t + B u_t) dt + diag(d) x_t sqrt(dt) w_t,  y_t = (1 + s v_t) x_t,  w, v ~ N(0, I).

    Attributes:
        state_step, input_step: I + A dt (n_x, n_x) and B dt (n_x, n_u), the expected step of one sample; where `scaled`, one a
            trajectory (K, n_x, n_x) and (K, n_x, n_u).
    """

    def __init__(self, params: ProcessParams, dtype: torch.dtype) -> None:
        self.n_states = len(params.drift_state)
        self.n_outputs = len(params.controlled)
        self.n_inputs = len(params.manipulated)
        self.sampling_time = params.sampling_time
        self.drift_state = torch.tensor(params.drift_state, dtype=dtype)
        self.drift_input = torch.tensor(params.drift_input, dtype=dtype)
        self.disturbance_gain = torch.tensor(params.disturbance, dtype=dtype)
        self.observation_noise = torch.tensor(params.observation_noise, dtype=dtype)
        # One step as two products, so that the rollout does no work twice: x + h dt = (I + A dt) x + (B dt) u.
        self.state_step = torch.eye(self.n_states, dtype=dtype) + self.drift_state * self.sampling_time
        self.input_step = self.drift_input * self.sampling_time
        self._disturbance_step = self.disturbance_gain * self.sampling_time**0.5

    def scaled(self, state: Tensor, entry: Tensor) -> "LinearProcess":
        """This process with A and B of Eq. 4.1.3b times factors of each trajectory, (K,) each."""
        other = copy.copy(self)
        other.drift_state, other.drift_input = state[:, None, None] * self.drift_state, entry[:, None, None] * self.drift_input
        other.state_step = torch.eye(self.n_states, dtype=state.dtype) + other.drift_state * self.sampling_time
        other.input_step = other.drift_input * self.sampling_time
        return other

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        """h(x, u) of Eq. 4.1.3b, shape (K, n_x), per unit of time."""
        return _product(self.drift_state, x) + _product(self.drift_input, u)

    def disturbance(self, x: Tensor) -> Tensor:
        """delta(x) of Eq. 4.1.3c, shape (K, n_x), per square root of time: it vanishes at the steady state."""
        return self.disturbance_gain * x

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The next state by Euler-Maruyama, Eq. 4.1.3a: x + h(x, u) dt + delta(x) sqrt(dt) noise."""
        if self.state_step.ndim == 3:
            return x * noise * self._disturbance_step + _product(self.state_step, x) + _product(self.input_step, u)
        return (x * noise).mul_(self._disturbance_step).addmm_(x, self.state_step.T).addmm_(u, self.input_step.T)

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The observation of Eq. 4.1.4b: each output is read with a relative error."""
        return torch.addcmul(x, x * noise, self.observation_noise)


def _product(matrix: Tensor, vectors: Tensor) -> Tensor:
    """One matrix (n, m), or one for each of K vectors (K, n, m), times vectors (K, m)."""
    return vectors @ matrix.T if matrix.ndim == 2 else (matrix @ vectors[..., None])[..., 0]


def linearised_balances(groups: BalanceParams) -> tuple[list[list[float]], list[list[float]]]:
    """The matrices of Eq. 4.1.3b from the balances of an endothermic stirred tank, linearised at its steady state.

    dC_A/dt = (F/V)(C_A0 - C_A) - k(T) C_A and
    dT/dt = (F/V)(T_in - T) - (dH/(rho c_p)) k(T) C_A + (UA/(V rho c_p))(T_E - T), both derived in notebook 01.
    """
    q, k, heat = groups.dilution_rate, groups.rate_constant, groups.reaction_heat
    exchange, slope = groups.heat_exchange, groups.rate_sensitivity
    drift_state = [[-(q + k), -slope], [-heat * k, -(q + exchange + heat * slope)]]
    drift_input = [[q, 0.0], [0.0, exchange]]
    return drift_state, drift_input
