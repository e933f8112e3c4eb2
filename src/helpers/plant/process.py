"""The controlled process: a linear stochastic differential equation and the balances behind it, Section 4.1."""

import copy
from typing import Protocol

import torch
from torch import Tensor

from helpers.settings.paper import BalanceParams, ProcessParams


class Process(Protocol):
    """What a rollout needs of a process. Noise is handed in, standard normal: a step takes n_disturbances numbers an episode."""

    n_states: int
    n_outputs: int
    n_inputs: int
    n_disturbances: int

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The next state, shape (K, n_x), from states (K, n_x), inputs (K, n_u) and noise (K, n_disturbances)."""
        ...

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The observation, shape (K, n_y), of states (K, n_x) with noise (K, n_y)."""
        ...


class LinearProcess:
    """Euler-Maruyama integration of Eq. 4.1.3 with the observation of Eq. 4.1.4, in deviation variables.

    Between two samples x goes through m steps of length tau = dt / m, each with noise of its own and all with the sample's input:
    x <- x + (A x + B u) tau + diag(d) x sqrt(tau) w.  Observed is y_t = (1 + s v_t) x_t;  w, v ~ N(0, I).

    Attributes:
        state_step, input_step: of one sample, x_{t+1} = state_step x_t + input_step u_t as expected: (I + A tau)^m (n_x, n_x) and
            sum_(k<m) (I + A tau)^k B tau (n_x, n_u); where `scaled`, one a trajectory (K, n_x, n_x) and (K, n_x, n_u).
    """

    def __init__(self, params: ProcessParams, dtype: torch.dtype) -> None:
        self.n_states = len(params.drift_state)
        self.n_outputs = len(params.controlled)
        self.n_inputs = len(params.manipulated)
        self.sampling_time = params.sampling_time
        self.integration_steps = params.integration_steps
        self.n_disturbances = self.integration_steps * self.n_states
        self.drift_state = torch.tensor(params.drift_state, dtype=dtype)
        self.drift_input = torch.tensor(params.drift_input, dtype=dtype)
        self.disturbance_gain = torch.tensor(params.disturbance, dtype=dtype)
        self.observation_noise = torch.tensor(params.observation_noise, dtype=dtype)
        self._compose()

    @property
    def tau(self) -> float:
        """The length of a step of integration."""
        return self.sampling_time / self.integration_steps

    def _compose(self) -> None:
        """The matrices of a step of integration and of a sample."""
        self._spread = self.disturbance_gain * self.tau**0.5
        self._state = torch.eye(self.n_states, dtype=self.drift_state.dtype) + self.drift_state * self.tau
        self._entry = self.drift_input * self.tau
        self.state_step, self.input_step = self._state, self._entry
        for _ in range(self.integration_steps - 1):
            self.state_step, self.input_step = self._state @ self.state_step, self._state @ self.input_step + self._entry

    def scaled(self, state: Tensor, entry: Tensor) -> "LinearProcess":
        """This process with A and B of Eq. 4.1.3b times factors of each trajectory, (K,) each."""
        other = copy.copy(self)
        other.drift_state, other.drift_input = state[:, None, None] * self.drift_state, entry[:, None, None] * self.drift_input
        other._compose()
        return other

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        """h(x, u) of Eq. 4.1.3b, shape (K, n_x), per unit of time."""
        return _product(self.drift_state, x) + _product(self.drift_input, u)

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The state one sample later by Euler-Maruyama, Eq. 4.1.3a.

        Raises:
            ValueError: if the noise has not n_disturbances columns.
        """
        if noise.shape[-1] != self.n_disturbances:
            raise ValueError(f"noise of {noise.shape[-1]} columns, expected {self.n_disturbances}")
        return self._integrated(x, u, noise)

    def _integrated(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The state after as many steps as the noise has parts of n_x columns."""
        pushed = _product(self._entry, u)
        for w in noise.split(self.n_states, dim=-1):
            moved = torch.addcmul(pushed, x, w * self._spread)
            x = moved.addmm_(x, self._state.T) if x.ndim == self._state.ndim == 2 else moved + _product(self._state, x)
        return x

    def before_last_kick(self, x: Tensor, u: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (..., n_x) of the next state, given all of the noise but that of its last step.

        So given it is normal. From states (..., n_x), inputs (..., n_u) and noise (..., n_disturbances).
        """
        earlier = noise[..., : -self.n_states]
        x = self._integrated(x, u, earlier) if earlier.shape[-1] else x
        return self._integrated(x, u, torch.zeros_like(x)), self._spread * x.abs()

    def moments(self, mean: Tensor, covariance: Tensor, u: Tensor, steps: int | None = None) -> tuple[Tensor, Tensor]:
        """Mean (..., n_x) and covariance (..., n_x, n_x) of the next state from those of this one and the input (..., n_u).

        `steps`: of integration, where it is not a whole sample. The disturbance grows with the state, so that its variance is that
        of a step times the expected square of the state.
        """
        for _ in range(self.integration_steps if steps is None else steps):
            kicked = self._spread**2 * (mean**2 + covariance.diagonal(dim1=-2, dim2=-1))
            covariance = self._state @ covariance @ self._state.mT + kicked.diag_embed()
            mean = _product(self._state, mean) + _product(self._entry, u)
        return mean, covariance

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The observation of Eq. 4.1.4b: each output is read with a relative error."""
        return torch.addcmul(x, x * noise, self.observation_noise)


def _product(matrix: Tensor, vectors: Tensor) -> Tensor:
    """One matrix (n, m), or one for each of K vectors (K, n, m), times vectors (..., K, m)."""
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
