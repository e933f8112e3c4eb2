"""Filters in front of a controller: what the observation noise costs, and what a predictive controller corrects its model by."""

from typing import Any

import torch
from torch import Tensor

from helpers.plant.controllers import Controller
from helpers.plant.process import LinearProcess
from helpers.plant.task import ControlTask

# Mean (K, n_x) and covariance (K, n_x, n_x) of x_t given y_0..y_(t-1), and the memory of the controller behind the filter.
FilterMemory = tuple[Tensor, Tensor, Any]


class Filtered:
    """A controller that acts on a Kalman filter's estimate of the state in place of the observation.

    Process and observation noise grow with the state, so their variances are taken from its expected square: among the filters
    that are linear in the observations this has the least mean square error (De Koning 1984). It knows the process and where
    episodes start.
    """

    def __init__(self, controller: Controller, process: LinearProcess, task: ControlTask) -> None:
        self.controller = controller
        self.task = task
        self.process = process
        self.observation_variance = process.observation_noise**2

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> FilterMemory:
        """The distribution of the initial states."""
        mean = self.task.initial_mean.expand(n_trajectories, -1)
        covariance = (self.task.initial_std**2).diag().expand(n_trajectories, -1, -1)
        return mean, covariance, self.controller.start(n_trajectories, n_steps, generator)

    def act(self, observation: Tensor, memory: FilterMemory) -> tuple[Tensor, FilterMemory]:
        """Correct by the observation, act on the estimate, and predict the next state."""
        mean, covariance, inner = memory
        noise = self.observation_variance * (mean**2 + covariance.diagonal(dim1=-2, dim2=-1))  # of the expected square
        tiny = torch.finfo(mean.dtype).tiny  # a state known to be nought is observed without noise
        innovation = covariance + (noise + tiny).diag_embed()
        gain = torch.linalg.solve(innovation, covariance).mT  # both are symmetric
        mean, covariance = mean + (gain @ (observation - mean)[..., None])[..., 0], covariance - gain @ covariance
        command, inner = self.controller.act(mean, inner)
        u = command.clamp(self.task.input_low, self.task.input_high)
        return command, (*self.process.moments(mean, covariance, u), inner)
