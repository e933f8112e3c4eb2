"""The control task of a case study: Table 1 and the input bounds, as tensors."""

from dataclasses import dataclass

import torch
from torch import Tensor

from helpers.settings.paper import CaseParams, ProcessParams


@dataclass(frozen=True)
class ControlTask:
    """What a controller has to do: where the process starts, where it should go, and with which inputs.

    All are deviation variables. Attributes:
        set_point, error_scale: y_sp and y_sp - y_ss (Eq. 4.2.1), shape (n_y,).
        initial_mean, initial_std: of the normal distribution of x_0 (Table 1), shape (n_x,).
        input_low, input_high: bounds of the inputs, shape (n_u,).
        n_steps: T, the number of control steps of an episode.
    """

    set_point: Tensor
    error_scale: Tensor
    initial_mean: Tensor
    initial_std: Tensor
    input_low: Tensor
    input_high: Tensor
    n_steps: int

    @classmethod
    def from_params(cls, process: ProcessParams, case: CaseParams, dtype: torch.dtype) -> "ControlTask":
        """The task that the parameter files describe."""

        def tensor(values: tuple[float, ...]) -> Tensor:
            return torch.tensor(values, dtype=dtype)

        return cls(
            set_point=tensor(case.set_point),
            error_scale=tensor(case.scale_of_error),
            initial_mean=tensor(case.initial_mean),
            initial_std=tensor(case.initial_std),
            input_low=tensor(process.input_low),
            input_high=tensor(process.input_high),
            n_steps=process.horizon,
        )


@dataclass(frozen=True)
class Trajectories:
    """K trajectories of T control steps, time first: tau = (x_0, y_0, u_0, ..., u_{T-1}, x_T, y_T), Section 3.1.

    Attributes:
        x: true states, shape (T + 1, K, n_x), deviation variables.
        y: observations, shape (T + 1, K, n_y), deviation variables.
        u: inputs as the process received them, inside the bounds, shape (T, K, n_u), deviation variables.
        command: inputs as the controller asked for them, before the bounds, shape (T, K, n_u).

    Raises:
        ValueError: if the shapes do not fit together.
    """

    x: Tensor
    y: Tensor
    u: Tensor
    command: Tensor

    def __post_init__(self) -> None:
        for name in ("x", "y", "u", "command"):
            n_axes = getattr(self, name).ndim
            if n_axes != 3:
                raise ValueError(f"trajectories: {name} has {n_axes} axes, expected time, trajectory, variable")
        if self.u.shape != self.command.shape:
            raise ValueError(f"trajectories: u {tuple(self.u.shape)} and command {tuple(self.command.shape)} differ in shape")
        expected = (self.u.shape[0] + 1, self.u.shape[1])
        for name in ("x", "y"):
            found = tuple(getattr(self, name).shape[:2])
            if found != expected:
                raise ValueError(f"trajectories: {name} has {found} times and trajectories, expected {expected}")

    @property
    def n_steps(self) -> int:
        """T, the number of control steps."""
        return self.u.shape[0]

    @property
    def n_trajectories(self) -> int:
        """K, the number of trajectories."""
        return self.u.shape[1]
