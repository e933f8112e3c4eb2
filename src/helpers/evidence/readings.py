"""The demonstrators under several readings of what the paper leaves open, simulated with candidate settings."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from helpers.learning.evaluation import overshoot
from helpers.learning.features import FeatureMap, normalised_error
from helpers.plant.controllers import PID, PIDMemory
from helpers.plant.process import LinearProcess
from helpers.plant.rollout import rollout
from helpers.plant.task import ControlTask
from helpers.settings.paper import GainParams, Params, ProcessParams

Key = tuple[str, str]  # a setting and the variable it belongs to, such as ("proportional", "T")
Values = Mapping[Key, float]
Vector = NDArray[np.float64]

GAINS = ("proportional", "integral", "derivative")
TIME: Key = ("sampling_time", "-")
DTYPE = torch.float64  # a search takes differences of features


@dataclass(frozen=True)
class Reading:
    """One way to read what the paper leaves open; what is not named here is as in the parameter files.

    Attributes:
        first_error: |e| before the first step: a number, or "own" for the error of each initial state. Its mean is one, so that
            the number one, which the files hold, gives the same features, but with a smaller spread of Type III.
        conditional_integration: the integral stands still while the command lies outside the bounds and would move further out.
        derivative_from_zero: the first sample has a derivative, of an error that was zero before.
        exact_drift: the drift is integrated exactly between two samples, not by one Euler step; the disturbance is not.
        substeps: Euler-Maruyama steps between two samples.
    """

    name: str = "as in the parameter files"
    first_error: float | str | None = "own"
    conditional_integration: bool = False
    derivative_from_zero: bool = False
    noise_as_variance: bool = False
    start_as_variance: bool = False
    symmetric_bounds: bool = False
    exact_drift: bool = False
    substeps: int = 1
    features_on: str | None = None


MAIN = Reading()
READINGS = (
    MAIN,
    Reading("|e| before the first step is 1", first_error=1.0),
    Reading("|e| before the first step is 0", first_error=0.0),
    Reading("conditional integration", conditional_integration=True),
    Reading("derivative at the first sample", derivative_from_zero=True),
    Reading("observation noise is a variance", noise_as_variance=True),
    Reading("spread of the initial state is a variance", start_as_variance=True),
    Reading("features on y", features_on="y"),
    Reading("bounds as wide downwards as upwards", symmetric_bounds=True),
    Reading("drift integrated exactly", exact_drift=True),
    Reading("four Euler-Maruyama steps a sample", substeps=4),
)


class ReadPID(PID):
    """The PID under another reading."""

    def __init__(self, gains: GainParams, task: ControlTask, sampling_time: float, reading: Reading) -> None:
        super().__init__(gains, task.set_point, sampling_time)
        self.task = task
        self.reading = reading

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> PIDMemory:
        """No accumulated error; the error before the first sample is zero or unknown."""
        memory = super().start(n_trajectories, n_steps, generator)
        return replace(memory, previous=torch.zeros_like(memory.integral)) if self.reading.derivative_from_zero else memory

    def act(self, observation: Tensor, memory: PIDMemory) -> tuple[Tensor, PIDMemory]:
        """The PID law at one sample."""
        command, after = super().act(observation, memory)
        if self.reading.conditional_integration:
            error = self.set_point - observation
            outward = ((command > self.task.input_high) & (error > 0)) | ((command < self.task.input_low) & (error < 0))
            after = replace(after, integral=torch.where(outward, memory.integral, after.integral))
        return command, after


class FinerProcess(LinearProcess):
    """The process of Eq. 4.1.3 integrated in several Euler-Maruyama steps between two samples.

    The noise handed in is that of the first of them; the others' comes from a generator of its own.
    """

    def __init__(self, params: ProcessParams, substeps: int, generator: torch.Generator) -> None:
        super().__init__(params.model_copy(update={"sampling_time": params.sampling_time / substeps}), DTYPE)
        self.substeps = substeps
        self.generator = generator

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The state at the next sample."""
        x = super().step(x, u, noise)
        for _ in range(self.substeps - 1):
            x = super().step(x, u, torch.randn(x.shape, generator=self.generator, dtype=DTYPE))
        return x


def exact_drift(process: ProcessParams) -> ProcessParams:
    """The process whose Euler step is the exact one: I + A' dt = exp(A dt), B' dt = integral of exp(A s) B over 0 <= s <= dt."""
    A, B = torch.tensor(process.drift_state, dtype=DTYPE), torch.tensor(process.drift_input, dtype=DTYPE)
    n_x, n_u = B.shape
    whole = torch.cat([torch.cat([A, B], 1), torch.zeros(n_u, n_x + n_u, dtype=DTYPE)])
    step = (torch.matrix_exp(whole * process.sampling_time) - torch.eye(n_x + n_u, dtype=DTYPE)) / process.sampling_time
    return process.model_copy(update={"drift_state": step[:n_x, :n_x].tolist(), "drift_input": step[:n_x, n_x:].tolist()})


def with_settings(params: Params, values: Values, reading: Reading) -> Params:
    """The parameters of a case with these settings in place of those of the files, under a reading.

    Gains are those of the case's demonstrator. ("input_bound", name) stands for both bounds of an input.
    """
    process, case, features = params.process, params.case, params.features
    low, high = list(process.input_low), list(process.input_high)
    for index, name in enumerate(process.manipulated):
        bound = values.get(("input_bound", name))
        low[index] = values.get(("input_low", name), low[index] if bound is None else -bound)
        high[index] = values.get(("input_high", name), high[index] if bound is None else bound)
    time = values.get(TIME, process.sampling_time)
    process = process.model_copy(update={"sampling_time": time, "input_low": tuple(low), "input_high": tuple(high)})
    if reading.noise_as_variance:
        process = process.model_copy(update={"observation_noise": tuple(s**0.5 for s in process.observation_noise)})
    if reading.exact_drift:
        process = exact_drift(process)
    if reading.start_as_variance:
        case = case.model_copy(update={"initial_std": tuple(s**0.5 for s in case.initial_std)})
    if reading.features_on is not None:
        features = features.model_copy(update={"features_on": reading.features_on})
    if reading.first_error is not None:
        features = features.model_copy(update={"initial_error": 0.0 if reading.first_error == "own" else reading.first_error})
    gains = {
        kind: tuple(values.get((kind, loop), present) for loop, present in zip(process.controlled, entries, strict=True))
        for kind, entries in params.demonstrator.model_dump().items()
    }
    return replace(params, process=process, case=case, features=features, demonstrator=params.demonstrator.model_copy(update=gains))


@dataclass(frozen=True)
class Simulated:
    """What the demonstrator of a case would have shown: v of each trajectory (K, d); overshoot of the mean response (n_y,)."""

    v: Tensor
    overshoot: Tensor

    @property
    def mean(self) -> Vector:
        """E[v] by Monte Carlo, shape (d,)."""
        return self.v.mean(0).numpy()

    def sampling_error(self, sample: int) -> Vector:
        """The standard error of the mean over `sample` trajectories, shape (d,)."""
        return self.v.std(0).numpy() / sample**0.5


def simulate(params: Params, values: Values, reading: Reading, n_trajectories: int, generator: torch.Generator) -> Simulated:
    """The demonstrator of a case with these settings under a reading: Algorithm S1 on the draws of the generator."""
    params = with_settings(params, values, reading)
    task = ControlTask.from_params(params.process, params.case, DTYPE)
    time = params.process.sampling_time
    features = FeatureMap(params.features, task, time)
    controller = ReadPID(params.demonstrator, task, time, reading)
    process = LinearProcess(params.process, DTYPE)
    if reading.substeps > 1:
        process = FinerProcess(params.process, reading.substeps, torch.Generator().manual_seed(generator.initial_seed() + 1))
    trajectories = rollout(process, controller, task, n_trajectories, generator)
    v = features.trajectory(trajectories)
    if reading.first_error == "own":
        signal = trajectories.x if params.features.features_on == "x" else trajectories.y
        first = normalised_error(signal[0], task.set_point, task.error_scale).abs()
        v = torch.cat([v[:, : -first.shape[1]], v[:, -first.shape[1] :] - first / time], dim=1)
    return Simulated(v, overshoot(normalised_error(trajectories.x.mean(1), task.set_point, task.error_scale)))
