"""Closed loops whose set points move: episodes with set points, loads and a model of their own."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from helpers.plant.process import Process
from helpers.plant.task import ControlTask


class Bounds(NamedTuple):
    """Lowest and highest inputs, and the greatest move from one sample to the next (infinite without one); each (n_u,)."""

    low: Tensor
    high: Tensor
    rate: Tensor

    @property
    def span(self) -> Tensor:
        """The range of each input, (n_u,)."""
        return self.high - self.low


class Tracker(Protocol):
    """A controller that is told its set point at every sample; K trajectories side by side, deviation variables."""

    def start(self, n_trajectories: int) -> Any:
        """The memory before the first sample."""
        ...

    def act(self, y: Tensor, set_point: Tensor, u_previous: Tensor, memory: Any) -> tuple[Tensor, Any]:
        """The command, (K, n_u), from observation and set point (K, n_y) and the input applied last (K, n_u)."""
        ...


@dataclass(frozen=True)
class Scenarios:
    """What K episodes of T samples meet: a process, and everything that is drawn before the loop is closed.

    Attributes:
        process: the plant or a model of it, with a row of parameters for each episode where they differ.
        set_point: (T, K, n_y), known to the controller at sample t and judged at t + 1.
        load: (T, K, n_u), added to the input on its way to the plant, unknown to the controller.
        start, before: x_0 (K, n_x) and the input before it (K, n_u).
        disturbance, noise: standard normal, (T, K, n_disturbances) and (T + 1, K, n_y).
    """

    process: Process
    set_point: Tensor
    load: Tensor
    start: Tensor
    before: Tensor
    disturbance: Tensor
    noise: Tensor


@dataclass(frozen=True)
class Tracked:
    """Closed loops: x and y at t = 0..T, (T + 1, K, n), u within its bounds (T, K, n_u), the input before, the set points."""

    x: Tensor
    y: Tensor
    u: Tensor
    before: Tensor
    set_point: Tensor

    @property
    def error(self) -> Tensor:
        """y_sp - y one sample after each input, (T, K, n_y)."""
        return self.set_point - self.y[1:]

    @property
    def movement(self) -> Tensor:
        """|u_t - u_{t-1}|, (T, K, n_u)."""
        return torch.cat([self.before[None], self.u]).diff(dim=0).abs()


def track(tracker: Tracker, scenarios: Scenarios, bounds: Bounds) -> Tracked:
    """Run a controller through all scenarios; differentiable in its parameters where the process is."""
    process, u = scenarios.process, scenarios.before
    memory = tracker.start(len(u))
    disturbance, noise = scenarios.disturbance.unbind(0), scenarios.noise.unbind(0)
    limited = bool(torch.isfinite(bounds.rate).any())
    states, inputs = [scenarios.start], []
    outputs = [process.observe(scenarios.start, noise[0])]
    for t, (set_point, load) in enumerate(zip(scenarios.set_point.unbind(0), scenarios.load.unbind(0), strict=True)):
        command, memory = tracker.act(outputs[t], set_point, u, memory)
        if limited:
            command = torch.clamp(command, u - bounds.rate, u + bounds.rate)
        u = torch.clamp(command, bounds.low, bounds.high)
        states.append(process.step(states[t], u + load, disturbance[t]))
        inputs.append(u)
        outputs.append(process.observe(states[t + 1], noise[t + 1]))
    return Tracked(torch.stack(states), torch.stack(outputs), torch.stack(inputs), scenarios.before, scenarios.set_point)


class AtSetPoint:
    """A tracker as the controller of one task, for `rollout`: its set point stands still and the input begins at u* = 0.

    The memory is the input applied last, (K, n_u), and the tracker's own.
    """

    def __init__(self, tracker: Tracker, task: ControlTask) -> None:
        self.tracker = tracker
        self.task = task

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> tuple[Tensor, Any]:
        """Before the first sample."""
        return self.task.input_low.new_zeros(n_trajectories, len(self.task.input_low)), self.tracker.start(n_trajectories)

    def act(self, observation: Tensor, memory: tuple[Tensor, Any]) -> tuple[Tensor, tuple[Tensor, Any]]:
        """The tracker's command for one sample."""
        command, own = self.tracker.act(observation, self.task.set_point.expand_as(observation), *memory)
        return command, (command.clamp(self.task.input_low, self.task.input_high), own)
