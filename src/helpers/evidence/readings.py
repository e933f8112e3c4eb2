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
        bounded_integral: the term of the integral is kept inside the bounds.
        present_error: share of the present error in the integral: one half by the trapezoidal rule, from no error before.
        derivative_from_zero: the first sample has a derivative, of an error that was zero before.
        error_memory: share of the last filtered error in the next one, which the derivative is taken of.
        delay: the controller acts on the sample before.
        acts_on_state: the controller meets no observation noise.
        exact_drift: the drift is integrated exactly between two steps, not by Euler's rule; the disturbance is not.
        integration_steps: Euler-Maruyama steps between two samples, where there are not as many as in the parameter files.
        disturbance: "along" for every step, of the state before it; "behind" for every step, of the state behind its drift;
            "once" for a sample, of the state at its end; "milstein" for Milstein's rule.
        disturbance_power: the power of the step that scales the disturbance.
        one_disturbance: both states meet the same Wiener process.
        observed_state: the noise of the observation stays in the state.
        accumulated_on, rate_on: the signal of Type II and of Type III, where it is another than that of Type I.
        samples: the horizon.
    """

    name: str = "as in the parameter files"
    first_error: float | str | None = "own"
    conditional_integration: bool = False
    bounded_integral: bool = False
    present_error: float = 1.0
    derivative_from_zero: bool = False
    error_memory: float = 0.0
    delay: bool = False
    acts_on_state: bool = False
    noise_as_variance: bool = False
    start_as_variance: bool = False
    symmetric_bounds: bool = False
    exact_drift: bool = False
    integration_steps: int | None = None
    disturbance: str = "along"
    disturbance_power: float = 0.5
    one_disturbance: bool = False
    observed_state: bool = False
    features_on: str | None = None
    accumulated_on: str | None = None
    rate_on: str | None = None
    samples: int | None = None


MAIN = Reading()
READINGS = (
    MAIN,
    *(Reading(f"{number} step{'s' * (number > 1)} a sample", integration_steps=number) for number in (1, 2, 3, 5, 8, 10, 20)),
    Reading("|e| before the first step is 1", first_error=1.0),
    Reading("|e| before the first step is 0", first_error=0.0),
    Reading("conditional integration", conditional_integration=True),
    Reading("integral kept inside the bounds", bounded_integral=True),
    Reading("integral without the present error", present_error=0.0),
    Reading("trapezoidal integral", present_error=0.5),
    Reading("derivative at the first sample", derivative_from_zero=True),
    Reading("derivative of a filtered error", error_memory=0.5),
    Reading("controller acts on the sample before", delay=True),
    Reading("controller acts on x", acts_on_state=True),
    Reading("observation noise is a variance", noise_as_variance=True),
    Reading("observation noise stays in the state", observed_state=True),
    Reading("spread of the initial state is a variance", start_as_variance=True),
    Reading("bounds as wide downwards as upwards", symmetric_bounds=True),
    Reading("features on y", features_on="y"),
    Reading("Type II on y", accumulated_on="y"),
    Reading("Type III on y", rate_on="y"),
    Reading("49 samples", samples=49),
    Reading("51 samples", samples=51),
    Reading("exact drift, noise along the way", exact_drift=True),
    Reading("exact drift in 1 step, noise of the state before it", exact_drift=True, integration_steps=1),
    Reading("exact drift in 1 step, noise at the end", exact_drift=True, disturbance="once", integration_steps=1),
    Reading("noise of the state behind the drift", disturbance="behind"),
    Reading("Milstein's rule", disturbance="milstein"),
    Reading("noise scaled by the step, not its root", disturbance_power=1.0),
    Reading("one Wiener process for both states", one_disturbance=True),
    Reading("noise once a sample, at the end", disturbance="once"),
    *(
        Reading(f"1 step, {name}", integration_steps=1, **changes)
        for name, changes in (
            ("controller acts on x", {"acts_on_state": True}),
            ("integral without the present error", {"present_error": 0.0}),
            ("one Wiener process", {"one_disturbance": True}),
            ("spread of the initial state is a variance", {"start_as_variance": True}),
            ("Type III on y", {"rate_on": "y"}),
            ("features on y", {"features_on": "y"}),
            ("51 samples", {"samples": 51}),
        )
    ),
)


class ReadPID(PID):
    """The PID under another reading; it serves one rollout."""

    def __init__(self, gains: GainParams, task: ControlTask, sampling_time: float, reading: Reading) -> None:
        super().__init__(gains, task.set_point, sampling_time)
        self.task = task
        self.reading = reading
        self.seen: Tensor | None = None

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> PIDMemory:
        """No accumulated error; the error before the first sample is zero or unknown."""
        memory = super().start(n_trajectories, n_steps, generator)
        return replace(memory, previous=torch.zeros_like(memory.integral)) if self.reading.derivative_from_zero else memory

    def act(self, observation: Tensor, memory: PIDMemory) -> tuple[Tensor, PIDMemory]:
        """The PID law at one sample."""
        if self.reading.delay:
            observation, self.seen = observation if self.seen is None else self.seen, observation
        command, after = super().act(observation, memory)
        error = self.set_point - observation
        command = command - (1 - self.reading.present_error) * self.integral * error * self.sampling_time
        if self.reading.error_memory and memory.previous is not None:  # the filter moves the derivative's error, none of the others
            lag = self.reading.error_memory * (error - memory.previous)
            command = command - self.derivative * lag / self.sampling_time
            after = replace(after, previous=error - lag)
        if self.reading.conditional_integration:
            outward = ((command > self.task.input_high) & (error > 0)) | ((command < self.task.input_low) & (error < 0))
            after = replace(after, integral=torch.where(outward, memory.integral, after.integral))
        if self.reading.bounded_integral:
            term = self.integral * after.integral
            kept = term.clamp(self.task.input_low, self.task.input_high)
            command, after = command + kept - term, replace(after, integral=after.integral + (kept - term) / self.integral)
        return command, after


class ReadProcess(LinearProcess):
    """The process of Eq. 4.1.3 under another reading; noise that stays in the state comes from a generator of its own."""

    def __init__(self, params: ProcessParams, reading: Reading, generator: torch.Generator) -> None:
        super().__init__(exact_drift(params) if reading.exact_drift else params, DTYPE)
        self.reading = reading
        self.generator = generator

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The state at the next sample."""
        reading, still = self.reading, torch.zeros_like(x)
        spread = self.disturbance_gain * self.tau**0.5
        behind = reading.disturbance == "behind"
        for drawn in noise.split(self.n_states, dim=1):
            w = drawn[:, :1].expand_as(drawn) if reading.one_disturbance else drawn
            if reading.disturbance == "milstein":
                w = w + spread * (w**2 - 1) / 2
            w = w * self.tau ** (reading.disturbance_power - 0.5)
            x = self._integrated(x, u, still if behind or reading.disturbance == "once" else w)
            if behind:
                x = x * (1 + spread * w)
        if reading.disturbance == "once":
            x = x * (1 + spread * self.integration_steps**0.5 * w)
        return super().observe(x, torch.randn(x.shape, generator=self.generator, dtype=DTYPE)) if reading.observed_state else x

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """What the controller acts on."""
        return x if self.reading.observed_state or self.reading.acts_on_state else super().observe(x, noise)


def exact_drift(process: ProcessParams) -> ProcessParams:
    """The process whose Euler step of length tau is exact: I + A' tau = exp(A tau), B' tau the integral of exp(A s) B up to tau."""
    A, B = torch.tensor(process.drift_state, dtype=DTYPE), torch.tensor(process.drift_input, dtype=DTYPE)
    (n_x, n_u), tau = B.shape, process.sampling_time / process.integration_steps
    whole = torch.cat([torch.cat([A, B], 1), torch.zeros(n_u, n_x + n_u, dtype=DTYPE)])
    step = (torch.matrix_exp(whole * tau) - torch.eye(n_x + n_u, dtype=DTYPE)) / tau
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
    if reading.integration_steps is not None:
        process = process.model_copy(update={"integration_steps": reading.integration_steps})
    if reading.noise_as_variance:
        process = process.model_copy(update={"observation_noise": tuple(s**0.5 for s in process.observation_noise)})
    if reading.samples is not None:
        process = process.model_copy(update={"horizon": reading.samples})
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
    process = ReadProcess(params.process, reading, torch.Generator().manual_seed(generator.initial_seed() + 1))
    trajectories = rollout(process, controller, task, n_trajectories, generator)
    signals = [signal or params.features.features_on for signal in (None, reading.accumulated_on, reading.rate_on)]
    v = {signal: features.on(signal).trajectory(trajectories) for signal in set(signals)}
    by_type = [v[signal].chunk(3, dim=1)[kind] for kind, signal in enumerate(signals)]
    if reading.first_error == "own":
        signal = trajectories.x if signals[-1] == "x" else trajectories.y
        by_type[-1] = by_type[-1] - normalised_error(signal[0], task.set_point, task.error_scale).abs() / time
    return Simulated(
        torch.cat(by_type, dim=1), overshoot(normalised_error(trajectories.x.mean(1), task.set_point, task.error_scale))
    )
