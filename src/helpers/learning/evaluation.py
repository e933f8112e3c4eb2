"""Algorithm S1 (Monte Carlo evaluation) and the figures of merit of a controller in closed loop."""

import torch
from torch import Tensor

from helpers.learning.features import FeatureMap, discounts, feature_names, normalised_error
from helpers.plant.controllers import Controller
from helpers.plant.process import Process
from helpers.plant.rollout import rollout
from helpers.plant.task import Trajectories


def expected_features(
    process: Process, controller: Controller, features: FeatureMap, n_trajectories: int, generator: torch.Generator
) -> Tensor:
    """E[v] of a controller by Monte Carlo realisations, Algorithm S1: the discounted trajectory features, shape (d,)."""
    trajectories = rollout(process, controller, features.task, n_trajectories, generator)
    return features.trajectory(trajectories).mean(0)


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


def overshoot(error: Tensor) -> Tensor:
    """How far a response passes the set point, as a share of the set point change; (T + 1, ...) to (...); zero if never.

    Args:
        error: normalised (Eq. 4.2.1), about the set point, not the last sample; at t = 0..T.
    """
    return (-error).amax(0).clamp(min=0)


def rise_time(error: Tensor, sampling_time: float) -> Tensor:
    """Time between first reaching 10 and first reaching 90 % of the set point change; (T + 1, ...) to (...); nan if never.

    Args:
        error: as of `overshoot`.
    """
    reached = [1 - error >= level for level in (0.1, 0.9)]
    first = [torch.where(samples.any(0), samples.int().argmax(0).to(error.dtype), torch.nan) for samples in reached]
    return (first[1] - first[0]) * sampling_time


def total_variation(u: Tensor) -> Tensor:
    """Mean over trajectories of sum_t |u_t - u_{t-1}| of each input; (T, K, n_u) to (n_u,), deviation variables."""
    return u.diff(dim=0).abs().sum(0).mean(0)


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
    features are evaluated on, on x and on y; then one figure a loop (overshoot and rise_time of the mean response, offset: the
    mean normalised error over the last `n_last` samples), one an input (movement) and two a feature: v, and v:<feature>:std,
    its standard deviation over the trajectories, which says how large the sampling error of any number of them is.
    """
    task, x = features.task, trajectories.x
    error, last = (normalised_error(states, task.set_point, task.error_scale) for states in (x.mean(1), x[-n_last:]))
    rows = {"objective": objective(trajectories, features, beta).mean().item()}
    for signal in ("x", "y"):
        rows[f"objective_{signal}"] = objective(trajectories, features.on(signal), beta).mean().item()
    for name, values in (
        ("overshoot", overshoot(error)),
        ("offset", last.mean((0, 1))),
        ("rise_time", rise_time(error, features.sampling_time)),
    ):
        rows |= {f"{name}:{loop}": value for loop, value in zip(controlled, values.tolist(), strict=True)}
    rows |= {f"movement:{name}": value for name, value in zip(manipulated, total_variation(trajectories.u).tolist(), strict=True)}
    names, v = feature_names(controlled), features.trajectory(trajectories)
    rows |= {f"v:{name}": value for name, value in zip(names, v.mean(0).tolist(), strict=True)}
    return rows | {f"v:{name}:std": value for name, value in zip(names, v.std(0).tolist(), strict=True)}
