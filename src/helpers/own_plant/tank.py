"""The nonlinear parent of the paper's plant: an endothermic stirred tank with Arrhenius kinetics, Section 4.1.

Its linearisation at the steady state is Eq. 4.1.3b; `process.linearised_balances` derives that.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from helpers.runs.sources import PROJECT
from helpers.settings.leaf import Count, Leaf, NotNegative, ParameterError, Positive, Record, Share, Vector, read_yaml, validate
from helpers.settings.paper import BalanceParams, ProcessParams, load

Array = NDArray[np.float64]
SUBSTEPS = 4  # of the integration, a sample; the error is far below the disturbance


class HistoryParams(Record):
    """What the historian file of the tank records."""

    proportional: Annotated[Vector, Leaf("input/output")]
    integral: Annotated[Vector, Leaf("input/(output time)")]
    input_low: Annotated[Vector, Leaf("deviation of mol/L and K")]
    input_high: Annotated[Vector, Leaf("deviation of mol/L and K")]
    cycles: Annotated[Count, Leaf("set point steps")]
    hold: Annotated[Count, Leaf("samples")]
    rest: Annotated[Count, Leaf("samples")]
    other_set_point: Annotated[Vector, Leaf("deviation of mol/L and K")]
    other_every: Annotated[Count, Leaf("set point steps")]
    manual_every: Annotated[Count, Leaf("set point steps")]
    manual_samples: Annotated[Count, Leaf("samples")]
    manual_move: Annotated[Share, Leaf("input range")]
    drift: Annotated[NotNegative, Leaf("K")]
    drift_time: Annotated[Positive, Leaf("samples")]
    faults: Annotated[Count, Leaf("of each kind")]


class TankParams(Record):
    """params/nonlinear_tank.yaml: what the linear model leaves free."""

    concentration: Annotated[Positive, Leaf("mol/L")]
    temperature: Annotated[Positive, Leaf("K")]
    time_unit: Annotated[Literal["s", "min", "h"], Leaf("-")]
    sensor_noise: Annotated[tuple[NotNegative, ...], Leaf("mol/L, K")]
    history: HistoryParams


@dataclass(frozen=True)
class SteadyState:
    """Where the tank rests, in engineering units, and the kinetics that the groups of the linear model then fix.

    Attributes:
        controlled: C_A, mol/L, and T, K; `manipulated`: C_A0, mol/L, and T_E, K.
        feed_temperature: T_in, K, assumed equal to T. `activation`: E/R, K. `frequency`: k_0, 1/time.
    """

    controlled: Array
    manipulated: Array
    feed_temperature: float
    activation: float
    frequency: float

    @classmethod
    def of(cls, groups: BalanceParams, tank: TankParams) -> Self:
        """The steady state of both balances; k E/(R T^2) C_A = `rate_sensitivity` fixes the activation."""
        c, temperature, k = tank.concentration, tank.temperature, groups.rate_constant
        activation = groups.rate_sensitivity * temperature**2 / (k * c)
        feed = c * (groups.dilution_rate + k) / groups.dilution_rate
        jacket = temperature + groups.reaction_heat * k * c / groups.heat_exchange
        frequency = k * math.exp(activation / temperature)
        return cls(np.array([c, temperature]), np.array([feed, jacket]), temperature, activation, frequency)


class NonlinearTank:
    """The two balances, integrated over a sample, with the disturbance and the noise of Eq. 4.1.3-4.1.4.

    A `process.Process` in deviation variables from the steady state. The disturbance enters as a kick at the end of each sample,
    diag(d) x sqrt(dt) w as in the paper; a sensor noise of fixed size comes on top of the relative one.
    """

    def __init__(self, params: ProcessParams, tank: TankParams, path: Path = Path("process.yaml")) -> None:
        if params.balance is None:
            raise ParameterError(f"{path}: key 'balance': the key is missing, and the nonlinear tank needs it")
        self.groups = params.balance
        self.steady = SteadyState.of(params.balance, tank)
        self.n_states = self.n_outputs = self.n_disturbances = len(self.steady.controlled)
        self.n_inputs = len(self.steady.manipulated)
        self.sampling_time, self.time_unit = params.sampling_time, tank.time_unit
        self.disturbance = torch.tensor(params.disturbance, dtype=torch.float64) * params.sampling_time**0.5
        self.relative_noise = torch.tensor(params.observation_noise, dtype=torch.float64)
        self.sensor_noise = torch.tensor(tank.sensor_noise, dtype=torch.float64)
        self.lowest = -torch.tensor(self.steady.controlled)

    def balances(self, state: Tensor, inputs: Tensor, feed_temperature: Tensor | float) -> Tensor:
        """dC_A/dt and dT/dt in engineering units, (K, 2), from states and inputs of that shape.

        dC_A/dt = (F/V)(C_A0 - C_A) - k(T) C_A and
        dT/dt = (F/V)(T_in - T) - (dH/(rho c_p)) k(T) C_A + (UA/(V rho c_p))(T_E - T), k(T) = k_0 exp(-E/(R T)).
        """
        (c, temperature), (feed, jacket), groups = state.unbind(-1), inputs.unbind(-1), self.groups
        reaction = self.steady.frequency * torch.exp(-self.steady.activation / temperature) * c
        heating = groups.dilution_rate * (feed_temperature - temperature) + groups.heat_exchange * (jacket - temperature)
        return torch.stack([groups.dilution_rate * (feed - c) - reaction, heating - groups.reaction_heat * reaction], dim=-1)

    def integrate(self, x: Tensor, u: Tensor, feed_drift: float = 0.0) -> Tensor:
        """The state one sample later without disturbance, (K, 2), deviation variables; the input is held.

        The classical method of Runge and Kutta (Hairer et al. 1993, Section II.1), so that torch can differentiate it.
        """
        rest = torch.from_numpy(self.steady.controlled)
        state, inputs = rest + x.double(), torch.from_numpy(self.steady.manipulated) + u.double()
        feed_temperature, dt = self.steady.feed_temperature + feed_drift, self.sampling_time / SUBSTEPS
        for _ in range(SUBSTEPS):
            slopes = [self.balances(state, inputs, feed_temperature)]
            for part in (0.5, 0.5, 1.0):
                slopes.append(self.balances(state + part * dt * slopes[-1], inputs, feed_temperature))
            state = state + dt / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        return state - rest

    def step(self, x: Tensor, u: Tensor, noise: Tensor, feed_drift: float = 0.0) -> Tensor:
        """The next state, shape (K, 2): integrated, disturbed, and with no concentration below zero."""
        disturbed = self.integrate(x, u, feed_drift) + self.disturbance * x * noise
        return torch.maximum(disturbed, self.lowest).to(x.dtype)

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """Each output with the relative error of Eq. 4.1.4b and that of the sensor, as one error of their joint size."""
        return (x + ((self.relative_noise * x) ** 2 + self.sensor_noise**2).sqrt() * noise).to(x.dtype)


def load_tank(root: Path, process: ProcessParams) -> tuple[NonlinearTank, TankParams]:
    """The tank of params/nonlinear_tank.yaml with the groups of the process.

    Raises:
        ParameterError: in one sentence that names the file and the key.
    """
    path = root / "nonlinear_tank.yaml"
    params = validate(TankParams, read_yaml(path), path)
    own = ("proportional", "integral", "input_low", "input_high", "other_set_point")
    vectors = {"sensor_noise": params.sensor_noise} | {f"history.{name}": getattr(params.history, name) for name in own}
    for name, value in vectors.items():
        if len(value) != len(process.controlled):
            raise ParameterError(f"{path}: key '{name}': expected {len(process.controlled)} entries, found {len(value)}")
    try:
        return NonlinearTank(process, params, root / "process.yaml"), params
    except OverflowError as error:
        raise ParameterError(
            f"{path}: key 'concentration': {params.concentration:g} mol/L is too low for a 'temperature' of "
            f"{params.temperature:g} K: the frequency factor of the reaction exceeds every number"
        ) from error


def example(description: object = None) -> NonlinearTank:
    """The tank with the committed parameters; what `plant: helpers.own_plant.tank:example` in a description makes."""
    root = PROJECT / "params"
    return load_tank(root, load(root, 1).process)[0]
