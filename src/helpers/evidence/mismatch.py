"""Plants that differ from the model in time: an unmeasured load step, and dead time."""

from typing import Any

import torch
from torch import Tensor

from helpers.plant.controllers import Controller
from helpers.plant.process import Process
from helpers.plant.task import ControlTask


class LoadStep:
    """A process that from mid-horizon on is pushed by the same amount at every sample, which no controller is told.

    It counts its own steps, so it serves for episodes of the task's length, one batch after the other.

    Args:
        load: added to each state at every sample, shape (n_x,), deviation variables.
    """

    def __init__(self, process: Process, task: ControlTask, load: Tensor) -> None:
        self.process = process
        self.n_states, self.n_outputs, self.n_inputs = process.n_states, process.n_outputs, process.n_inputs
        self.n_disturbances = process.n_disturbances
        self.n_steps = task.n_steps
        self.load = load
        self.time = 0

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The next state, shape (K, n_x)."""
        after = self.process.step(x, u, noise)
        loaded = after + self.load if self.time >= self.n_steps // 2 else after
        self.time = (self.time + 1) % self.n_steps
        return loaded

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The observation, shape (K, n_y), of states (K, n_x)."""
        return self.process.observe(x, noise)


class Delayed:
    """A controller whose commands reach the plant some samples late; until the first arrives the input is u* = 0.

    The controller goes on as if its command had been applied at once. The memory is its own and the commands under way.
    """

    def __init__(self, controller: Controller, task: ControlTask, samples: int) -> None:
        self.controller = controller
        self.samples = samples
        self.at_rest = torch.zeros_like(task.input_low)

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> tuple[Any, list[Tensor]]:
        """The controller's fresh memory and nothing but zeros under way."""
        under_way = [self.at_rest.expand(n_trajectories, -1)] * self.samples
        return self.controller.start(n_trajectories, n_steps, generator), under_way

    def act(self, observation: Tensor, memory: tuple[Any, list[Tensor]]) -> tuple[Tensor, tuple[Any, list[Tensor]]]:
        """The command of so many samples ago."""
        inner, under_way = memory
        command, inner = self.controller.act(observation, inner)
        arriving, *later = [*under_way, command.clone()]
        return arriving, (inner, later)
