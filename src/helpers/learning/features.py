"""State features, trajectory features and rewards: Section 4.2, Eq. 3.3.4, Eq. 4.2.5 and Eq. 5.1.2.1."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from helpers.plant.task import ControlTask, Trajectories
from helpers.settings.paper import FeatureParams

KINDS = ("I", "II", "III")


def normalised_error(output: Tensor, set_point: Tensor, error_scale: Tensor) -> Tensor:
    """Normalised error of each control loop, Eq. 4.2.1: (y_sp - y) / (y_sp - y_ss).

    Args:
        output: states or observations, shape (..., n_y), deviation variables.
        set_point: y_sp, shape (n_y,), deviation variables.
        error_scale: y_sp - y_ss, shape (n_y,), deviation variables, nowhere zero.
    """
    return (set_point - output) / error_scale


def closeness(error: Tensor, beta: float) -> Tensor:
    """Type I, Eq. 4.2.2: exp(-(beta e)^2), one at the set point and falling to zero away from it."""
    return torch.exp(-((beta * error) ** 2))


def accumulated_error(error: Tensor, sampling_time: float) -> Tensor:
    """Type II, Eq. 4.2.3: the running integral of |e| over time; `error` has time t = 1..T first. Unit: time."""
    return error.abs().cumsum(0) * sampling_time


def error_rate(error: Tensor, sampling_time: float, initial: float) -> Tensor:
    """Type III, Eq. 4.2.4: the rate of change of |e|; `error` has time t = 1..T first. Unit: 1/time.

    `initial` is |e| before the first step. The paper does not give it.
    """
    magnitude = error.abs()
    before = torch.cat([torch.full_like(magnitude[:1], initial), magnitude[:-1]])
    return (magnitude - before) / sampling_time


def state_features(error: Tensor, beta: float, sampling_time: float, initial: float) -> Tensor:
    """All features phi of Eq. 4.2.5 in its order (type by type, loop by loop), shape (T, K, d).

    Args:
        error: normalised errors at t = 1..T, shape (T, K, n_y).
    """
    return torch.cat(
        [closeness(error, beta), accumulated_error(error, sampling_time), error_rate(error, sampling_time, initial)], dim=-1
    )


def discounts(n_steps: int, gamma: float, like: Tensor) -> Tensor:
    """gamma^(t - 1) for t = 1..T, shape (T,), of the number type of `like`."""
    return gamma ** torch.arange(n_steps, dtype=like.dtype)


def trajectory_features(features: Tensor, gamma: float) -> Tensor:
    """Discounted trajectory features, Eq. 3.3.4: v = sum_t gamma^(t-1) phi_t; (T, K, d) to (K, d)."""
    return torch.einsum("t,tkd->kd", discounts(len(features), gamma, features), features)


def linear_reward(features: Tensor, weights: Tensor) -> Tensor:
    """Reward of apprenticeship learning, Eq. 4.2.5: R_t = alpha . phi_t; (T, K, d) and (d,) to (T, K)."""
    return features @ weights


def tracking_reward(error: Tensor, beta: float) -> Tensor:
    """Reward of online learning, Eq. 5.1.2.1: the sum of the Type I features over the loops; (T, K, n_y) to (T, K)."""
    return closeness(error, beta).sum(-1)


def feature_names(controlled: Sequence[str]) -> list[str]:
    """Names of the features in the order of Eq. 4.2.5: C_A-I, T-I, C_A-II and so on."""
    return [f"{loop}-{kind}" for kind in KINDS for loop in controlled]


@dataclass(frozen=True)
class FeatureMap:
    """The features of one control task: which signal they are evaluated on, and with which constants."""

    params: FeatureParams
    task: ControlTask
    sampling_time: float

    def on(self, signal: str) -> "FeatureMap":
        """The same features, evaluated on x or on y."""
        return replace(self, params=self.params.model_copy(update={"features_on": signal}))

    def errors(self, trajectories: Trajectories) -> Tensor:
        """Normalised errors at t = 1..T on x or on y as the parameters say, shape (T, K, n_y)."""
        signal = trajectories.x if self.params.features_on == "x" else trajectories.y
        return normalised_error(signal[1:], self.task.set_point, self.task.error_scale)

    def state(self, trajectories: Trajectories) -> Tensor:
        """phi at t = 1..T, shape (T, K, d)."""
        return state_features(self.errors(trajectories), self.params.beta, self.sampling_time, self.params.initial_error)

    def trajectory(self, trajectories: Trajectories) -> Tensor:
        """v of each trajectory, Eq. 3.3.4, shape (K, d)."""
        return trajectory_features(self.state(trajectories), self.params.discount)

    def tracking(self, trajectories: Trajectories, beta: float) -> Tensor:
        """The online reward R_1..R_T of Eq. 5.1.2.1, shape (T, K)."""
        return tracking_reward(self.errors(trajectories), beta)
