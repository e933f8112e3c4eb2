"""Algorithm S1 (Monte Carlo evaluation) and the figures of merit of a controller in closed loop."""

from dataclasses import dataclass

import torch
from torch import Tensor

from helpers.learning.features import FeatureMap, discounts, feature_names
from helpers.plant.controllers import Controller
from helpers.plant.process import Process
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories


@dataclass(frozen=True)
class Estimate:
    """A Monte Carlo mean and its standard error, each of shape (d,)."""

    mean: Tensor
    standard_error: Tensor


def monte_carlo(samples: Tensor) -> Estimate:
    """Mean and standard error over trajectories; samples (K, d) or (K,)."""
    return Estimate(samples.mean(0), samples.std(0) / len(samples) ** 0.5)


def expected_features(
    process: Process, controller: Controller, features: FeatureMap, n_trajectories: int, generator: torch.Generator
) -> Estimate:
    """E[v] of a controller by Monte Carlo realisations, Algorithm S1: the discounted trajectory features, shape (d,)."""
    trajectories = rollout(process, controller, features.task, n_trajectories, generator)
    return monte_carlo(features.trajectory(trajectories))


def relative_gap(policy_features: Tensor, expert_features: Tensor) -> Tensor:
    """(v_E - v_pi) / |v_E| of each feature, shape (d,)."""
    return (expert_features - policy_features) / expert_features.abs()


def feature_gap(policy_features: Tensor, expert_features: Tensor) -> float:
    """Mean over the features of |v_pi - v_E| / |v_E|."""
    return relative_gap(policy_features, expert_features).abs().mean().item()


def objective(trajectories: Trajectories, features: FeatureMap, beta: float) -> Tensor:
    """The discounted tracking objective of Eq. 5.1.2.1 for each trajectory, shape (K,)."""
    reward = features.tracking(trajectories, beta)
    return discounts(len(reward), features.params.discount, reward) @ reward


def overshoot(trajectories: Trajectories, features: FeatureMap) -> Tensor:
    """How far the mean response of each loop passes its set point, as a share of the set point change, shape (n_y,).

    About the set point, not the last sample; zero where the mean response never passes it.
    """
    task = features.task
    mean = trajectories.x.mean(1)
    return ((mean - task.set_point) / task.error_scale).max(0).values.clamp(min=0)


def offset(trajectories: Trajectories, features: FeatureMap, n_last: int) -> Tensor:
    """Mean normalised error of each loop over the last `n_last` samples, shape (n_y,); positive short of the set point."""
    return ((features.task.set_point - trajectories.x[-n_last:]) / features.task.error_scale).mean((0, 1))


def rise_time(trajectories: Trajectories, features: FeatureMap) -> Tensor:
    """Time that the mean response of each loop takes from 10 to 90 % of the set point change; nan where it never does."""
    task = features.task
    share = (trajectories.x.mean(1) - task.set_point + task.error_scale) / task.error_scale
    first = [torch.where((share >= level).any(0), (share >= level).int().argmax(0), torch.nan) for level in (0.1, 0.9)]
    return (first[1] - first[0]) * features.sampling_time


def input_movement(trajectories: Trajectories) -> Tensor:
    """Mean over trajectories of sum_t |u_t - u_{t-1}| of each input, shape (n_u,), deviation variables."""
    return trajectories.u.diff(dim=0).abs().sum(0).mean(0)


def scores(
    trajectories: Trajectories,
    features: FeatureMap,
    beta: float,
    controlled: tuple[str, ...],
    manipulated: tuple[str, ...],
    n_last: int = 10,
) -> dict[str, float]:
    """All figures of merit of one controller, by name.

    objective, objective_x and objective_y: mean discounted tracking objective with this beta, on the signal that the
    features are evaluated on, on x and on y; then one figure a loop (overshoot, offset over the last `n_last` samples,
    rise_time), one an input (movement) and two a feature: v, and v:<feature>:std, its standard deviation over the
    trajectories, which says how large the sampling error of any number of them is.
    """
    rows = {"objective": objective(trajectories, features, beta).mean().item()}
    for signal in ("x", "y"):
        rows[f"objective_{signal}"] = objective(trajectories, features.on(signal), beta).mean().item()
    for name, values in (
        ("overshoot", overshoot(trajectories, features)),
        ("offset", offset(trajectories, features, n_last)),
        ("rise_time", rise_time(trajectories, features)),
    ):
        rows |= {f"{name}:{loop}": value for loop, value in zip(controlled, values.tolist(), strict=True)}
    rows |= {f"movement:{name}": value for name, value in zip(manipulated, input_movement(trajectories).tolist(), strict=True)}
    names, v = feature_names(controlled), features.trajectory(trajectories)
    rows |= {f"v:{name}": value for name, value in zip(names, v.mean(0).tolist(), strict=True)}
    return rows | {f"v:{name}:std": value for name, value in zip(names, v.std(0).tolist(), strict=True)}
