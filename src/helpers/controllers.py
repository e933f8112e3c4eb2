"""Demonstrating controllers and what every controller has in common."""

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from helpers.params import GainParams


class Controller(Protocol):
    """A controller acts on observations and keeps its memory outside itself, so that no episode inherits another's."""

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> Any:
        """A fresh memory for that many trajectories."""
        ...

    def act(self, observation: Tensor, memory: Any) -> tuple[Tensor, Any]:
        """Commands (K, n_u), not yet bounded, for observations (K, n_y), and the memory for the next step."""
        ...


@dataclass(frozen=True)
class PIDMemory:
    """Integral of the error (K, n_y), time units, and the previous error (K, n_y); None before the first sample."""

    integral: Tensor
    previous: Tensor | None


class PID:
    """One PID loop for each pair of controlled and manipulated variable, parallel form on the raw error.

    u = K_p e + K_i sum(e) dt + K_d (e - e_previous) / dt. The sum holds the present error, the first sample has no
    derivative, and the integral goes on while the input sits at its bound (no anti-windup). The form is inferred: the
    paper's supporting information is not to be had.
    """

    def __init__(self, gains: GainParams, set_point: Tensor, sampling_time: float) -> None:
        self.proportional = torch.tensor(gains.proportional, dtype=set_point.dtype)
        self.integral = torch.tensor(gains.integral, dtype=set_point.dtype)
        self.derivative = torch.tensor(gains.derivative, dtype=set_point.dtype)
        self.set_point = set_point
        self.sampling_time = sampling_time

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> PIDMemory:
        """No accumulated error and no previous sample."""
        return PIDMemory(self.set_point.new_zeros(n_trajectories, len(self.set_point)), None)

    def act(self, observation: Tensor, memory: PIDMemory) -> tuple[Tensor, PIDMemory]:
        """The PID law at one sample."""
        error = self.set_point - observation
        integral = memory.integral + error * self.sampling_time
        change = torch.zeros_like(error) if memory.previous is None else error - memory.previous
        command = self.proportional * error + self.integral * integral + self.derivative * change / self.sampling_time
        return command, PIDMemory(integral, error)
