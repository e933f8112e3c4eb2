"""Linear offset-free model predictive control with a Kalman filter, its quadratic programmes solved by a library."""

import daqp
import numpy as np
import torch
from scipy.linalg import block_diag, solve_discrete_are
from torch import Tensor

from helpers.plant.process import LinearProcess
from helpers.plant.task import ControlTask

# State and disturbance as expected before the observation (K, n_x + n_x), and the input applied last (K, n_u).
PredictiveMemory = tuple[Tensor, Tensor]


class OffsetFreeMPC:
    """Linear MPC whose model has an integrating disturbance on each state, estimated by a stationary Kalman filter.

    It minimises sum_(i=1..N) |(x_i - x_sp) / scale|^2 + penalty sum_(i=0..N-1) |Delta u_i / range|^2 over u_0..u_(N-1) inside the
    bounds, along x_(i+1) = A x_i + B u_i + d with the present estimates of x and d, and applies u_0. The disturbance takes up
    what the model does not know, so that no offset remains as long as the inputs can reach the set point (Muske and Badgwell
    2002; Pannocchia and Rawlings 2003). The filter's noise is that of the process at the set point. Where the minimiser
    without bounds lies inside them it is the solution; only the other programmes go to the solver.

    Args:
        horizon: N, samples; `move_penalty` weighs the moves, as a share of the range of each input.
        disturbance_std: how far d moves in a sample, as a share of the process noise at the set point.
    """

    def __init__(
        self, process: LinearProcess, task: ControlTask, horizon: int, move_penalty: float, disturbance_std: float
    ) -> None:
        self.task = task
        self.horizon = horizon
        A, B = process.state_step.double().numpy(), process.input_step.double().numpy()
        target, scale = task.set_point.double().numpy(), task.error_scale.double().numpy()
        span = (task.input_high - task.input_low).double().numpy()
        n_x, n_u = B.shape
        eye = np.eye(n_x)
        # x_1..x_N = from_state x_0 + from_disturbance d + from_inputs u.
        powers = [np.linalg.matrix_power(A, i) for i in range(horizon + 1)]
        from_state = np.concatenate(powers[1:])
        from_disturbance = np.concatenate([sum(powers[:i]) for i in range(1, horizon + 1)])
        zero = np.zeros_like(B)
        from_inputs = np.block([[powers[i - j] @ B if j <= i else zero for j in range(horizon)] for i in range(horizon)])
        moves = np.eye(horizon * n_u) - np.eye(horizon * n_u, k=-n_u)
        weight = np.tile(scale**-2, horizon)[:, None]
        penalty = move_penalty * np.tile(span**-2, horizon)[:, None]
        self.hessian = np.ascontiguousarray(from_inputs.T @ (weight * from_inputs) + moves.T @ (penalty * moves))
        weighted = (weight * from_inputs).T
        first_move = (penalty * moves).T[:, :n_u]
        # The gradient is linear in (x, d, u_previous, 1).
        self.gradient = np.hstack(
            [weighted @ from_state, weighted @ from_disturbance, -first_move, -weighted @ np.tile(target, horizon)[:, None]]
        )
        self.unbounded = -np.linalg.solve(self.hessian, self.gradient)
        self.low, self.high = (np.tile(bound.double().numpy(), horizon) for bound in (task.input_low, task.input_high))
        self.model = torch.from_numpy(np.block([[A, eye], [np.zeros_like(A), eye]]))
        self.input_model = torch.from_numpy(np.vstack([B, zero]))
        observed = np.hstack([eye, np.zeros_like(A)])
        at_rest = torch.linalg.solve(process.drift_input, -process.drift_state @ task.set_point)
        still = torch.zeros(n_x, n_x, dtype=at_rest.dtype)
        found = process.moments(task.set_point, still, at_rest)[1].double().numpy()
        at_target = (found + found.T) / 2  # to the last digit, which the solver asks for
        reading = np.maximum((process.observation_noise.double().numpy() * target) ** 2, np.finfo(float).eps)
        noise = block_diag(at_target, disturbance_std**2 * at_target)
        covariance = solve_discrete_are(self.model.numpy().T, observed.T, noise, np.diag(reading))
        self.filter_gain = torch.from_numpy(
            covariance @ observed.T @ np.linalg.inv(observed @ covariance @ observed.T + np.diag(reading))
        )

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> PredictiveMemory:
        """The mean initial state, no disturbance, and the input at u* = 0."""
        mean = self.task.initial_mean.double()
        expected = torch.cat([mean, torch.zeros_like(mean)]).expand(n_trajectories, -1)
        return expected, self.task.input_low.double().new_zeros(n_trajectories, len(self.task.input_low))

    def act(self, observation: Tensor, memory: PredictiveMemory) -> tuple[Tensor, PredictiveMemory]:
        """The first input of the plan made at this sample."""
        predicted, u_previous = memory
        estimate = predicted + (observation.double() - predicted[:, : observation.shape[-1]]) @ self.filter_gain.T
        known = torch.cat([estimate, u_previous, torch.ones_like(estimate[:, :1])], dim=-1).numpy()
        u = torch.from_numpy(self.plan(known)[:, : u_previous.shape[-1]])
        return u.to(observation.dtype), (estimate @ self.model.T + u @ self.input_model.T, u)

    def plan(self, known: np.ndarray) -> np.ndarray:
        """u_0..u_(N-1) for what is known, rows (x, d, u_previous, 1); shape (K, N n_u)."""
        plans = known @ self.unbounded.T
        beyond = ((plans < self.low) | (plans > self.high)).any(1)
        no_rows = np.zeros((0, len(self.low)))
        for row in np.flatnonzero(beyond):
            plans[row], _, status, _ = daqp.solve(self.hessian, self.gradient @ known[row], no_rows, self.high, self.low)
            if status < 1:
                raise ArithmeticError(f"the quadratic programme of the predictive controller was not solved (status {status})")
        return plans
