"""Demonstrating controllers and what every controller has in common."""

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from helpers.plant.task import ControlTask
from helpers.settings.paper import GainParams


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


class MinimumVariance:
    """One-step minimum-variance control: the input after which the expected next state is the set point.

    u = B^-1 (y_sp - A y) for the process x_(t+1) = A x_t + B u_t + noise, with the observation in place of the state. It knows
    the process and looks one sample ahead: a reference for what is attainable, not a limit (Astrom 1970, Chapter 6). It has no
    memory.

    Args:
        state_step, input_step: A (n_x, n_x) and B (n_x, n_u) of one sample, B invertible.
    """

    def __init__(self, state_step: Tensor, input_step: Tensor, set_point: Tensor) -> None:
        self.gain = torch.linalg.solve(input_step, state_step)
        self.feedforward = torch.linalg.solve(input_step, set_point)

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> None:
        """Nothing to remember."""

    def act(self, observation: Tensor, memory: None) -> tuple[Tensor, None]:
        """The law at one sample."""
        return self.feedforward - observation @ self.gain.T, None


class SaturatedLQ:
    """A saturated finite-horizon LQ controller: the first move of an unconstrained linear MPC, clipped to the bounds.

    It minimises sum_(i=1..N) |(x_(t+i) - x_sp) / scale|^2 + penalty sum_(i=0..N-1) |Delta u_(t+i) / range|^2 along the
    undisturbed process x_(t+1) = A x_t + B u_t, with the present observation in place of x_t. Without bounds the minimiser is a
    fixed linear law; a constrained MPC differs from its clipped form only while an input sits at a bound. The memory is the
    input applied last, shape (K, n_u).

    Args:
        state_step, input_step: A (n_x, n_x) and B (n_x, n_u) of one sample.
        horizon: N, samples; `move_penalty` weighs the moves, as a share of the range of each input.
    """

    def __init__(self, state_step: Tensor, input_step: Tensor, task: ControlTask, horizon: int, move_penalty: float) -> None:
        self.task = task
        n_x, n_u = input_step.shape
        A, B = state_step.double(), input_step.double()
        eye = torch.eye(n_u, dtype=A.dtype)
        # The state (x - x_sp, u_previous - u_ss) makes the move Delta u the input, so that a penalty on it is a plain LQ weight.
        F = torch.cat([torch.cat([A, B], 1), torch.cat([torch.zeros_like(B).T, eye], 1)])
        G = torch.cat([B, eye])
        weight = torch.cat([task.error_scale.double() ** -2, torch.zeros(n_u, dtype=A.dtype)]).diag()
        penalty = (move_penalty * (task.input_high - task.input_low).double() ** -2).diag()
        cost = weight  # cost-to-go, backwards from the end of the horizon (Riccati)
        for _ in range(horizon):
            gain = torch.linalg.solve(G.T @ cost @ G + penalty, G.T @ cost @ F)
            cost = weight + F.T @ cost @ (F - G @ gain)
        self.gain = gain.to(task.set_point.dtype)
        at_rest = torch.linalg.solve(B, (torch.eye(n_x, dtype=A.dtype) - A) @ task.set_point.double())
        self.input_at_rest = at_rest.to(task.set_point.dtype)

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> Tensor:
        """The input at u* = 0."""
        return self.input_at_rest.new_zeros(n_trajectories, len(self.input_at_rest))

    def act(self, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """The first move of the plan made at this sample."""
        deviation = torch.cat([observation - self.task.set_point, memory - self.input_at_rest], dim=-1)
        command = memory - deviation @ self.gain.T
        return command, command.clamp(self.task.input_low, self.task.input_high)


class Operator:
    """A controller under an operator's hand: where a loop has passed its set point too far, its input is held by hand.

    Hand control begins at a sample whose observed normalised error lies below -`threshold` and ends with the first that does
    not. Meanwhile the controller goes on computing, unheeded. The memory is the controller's.

    Args:
        held: the input of each loop under hand control, shape (n_u,), deviation variables; nan where the operator never acts.
    """

    def __init__(self, controller: Controller, task: ControlTask, threshold: float, held: Tensor) -> None:
        self.controller = controller
        self.task = task
        self.threshold = threshold
        self.held = held

    def by_hand(self, observation: Tensor) -> Tensor:
        """Which inputs the operator holds at these observations, shape (..., n_u)."""
        error = (self.task.set_point - observation) / self.task.error_scale
        return (error < -self.threshold) & ~self.held.isnan()

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> Any:
        """The controller's fresh memory."""
        return self.controller.start(n_trajectories, n_steps, generator)

    def act(self, observation: Tensor, memory: Any) -> tuple[Tensor, Any]:
        """The operator's input where there is one, else the controller's."""
        command, memory = self.controller.act(observation, memory)
        return torch.where(self.by_hand(observation), self.held, command), memory
