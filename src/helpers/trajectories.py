"""The record of a batch of process trajectories."""

from dataclasses import dataclass

from torch import Tensor


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
