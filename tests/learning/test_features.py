"""State features, trajectory features and rewards against hand-derived cases and plain loops."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from helpers.learning.features import (
    accumulated_error,
    closeness,
    error_rate,
    linear_reward,
    normalised_error,
    state_features,
    tracking_reward,
    trajectory_features,
)
from helpers.plant.rollout import rollout, stream

F64 = torch.float64


def tensor(values):
    return torch.tensor(values, dtype=F64)


def column(values):
    """One loop of one trajectory, shape (T, 1, 1)."""
    return tensor(values)[:, None, None]


@pytest.fixture
def errors():
    return torch.randn(9, 4, 2, generator=stream(0, "errors"), dtype=F64)


@pytest.mark.equation("4.2.1")
@pytest.mark.parametrize(("output", "expected"), [(2.0, 1.0), (-2.0, 0.0), (0.0, 0.5), (-3.0, -0.25)])
def test_normalised_error_is_one_at_rest_and_zero_at_the_set_point(output, expected):
    # y_ss = 2 and y_sp = -2: a step downwards, so the sign of the scale matters.
    assert normalised_error(tensor([output]), tensor([-2.0]), tensor([-4.0])).item() == expected


@pytest.mark.equation("4.2.2")
@pytest.mark.parametrize(
    ("error", "beta", "expected"),
    [(0.0, 10, 1.0), (0.1, 10, math.exp(-1)), (-0.1, 10, math.exp(-1)), (0.1, 30, math.exp(-9)), (0.2, 10, math.exp(-4))],
)
def test_closeness(error, beta, expected):
    assert closeness(tensor([error]), beta).item() == pytest.approx(expected, rel=1e-14)


@pytest.mark.equation("4.2.3")
def test_accumulated_error_tends_to_the_integral():
    exact = quad(lambda t: abs(math.cos(3 * t)), 0, 2, limit=200)[0]
    gaps = [
        abs(accumulated_error(column(np.cos(3 * np.arange(1, n + 1) * 2 / n)), 2 / n)[-1].item() - exact)
        for n in (1000, 2000, 4000)
    ]
    assert gaps[2] < 1e-3
    assert gaps[0] / gaps[1] == pytest.approx(2, rel=0.05)
    assert gaps[1] / gaps[2] == pytest.approx(2, rel=0.05)


@pytest.mark.equation("4.2.4")
def test_error_rate_by_hand():
    # |e|: 1 before the first step, then 0.6, 0.2, 0.3.
    found = error_rate(column([0.6, -0.2, 0.3]), 0.1, 1.0)
    np.testing.assert_allclose(found.flatten(), [-4.0, -4.0, 1.0], rtol=1e-13)


@pytest.mark.equation("4.2.5")
@pytest.mark.equation("3.3.1")
def test_reward_is_the_weighted_sum_in_the_order_of_the_paper(errors):
    alpha = np.array([0.137, 0.652, -0.067, -0.630, -0.194, -0.343])
    found = linear_reward(state_features(errors, 10.0, 0.04, 1.0), tensor(alpha)).numpy()
    e = errors.numpy()
    for k in range(e.shape[1]):
        integral, before = np.zeros(2), np.ones(2)
        for t in range(len(e)):
            size = np.abs(e[t, k])
            integral = integral + size * 0.04
            c_a, temperature = ([math.exp(-((10 * size[i]) ** 2)), integral[i], (size[i] - before[i]) / 0.04] for i in (0, 1))
            expected = sum(alpha[2 * kind] * c_a[kind] + alpha[2 * kind + 1] * temperature[kind] for kind in range(3))
            assert found[t, k] == pytest.approx(expected, rel=1e-11, abs=1e-12)
            before = size


@pytest.mark.equation("3.3.4")
@pytest.mark.parametrize("gamma", [1.0, 0.99, 0.5])
def test_trajectory_features_by_plain_loops(gamma):
    phi = torch.randn(7, 3, 5, generator=stream(0, "phi"), dtype=F64)
    expected = np.zeros((3, 5))
    for k in range(3):
        for i in range(5):
            for t in range(1, 8):
                expected[k, i] += gamma ** (t - 1) * phi[t - 1, k, i].item()
    np.testing.assert_allclose(trajectory_features(phi, gamma), expected, rtol=1e-12)


@pytest.mark.equation("3.3.6")
def test_the_discounted_linear_reward_is_the_weighted_trajectory_features(errors):
    phi, alpha = state_features(errors, 10.0, 0.04, 1.0), torch.randn(6, generator=stream(0, "alpha"), dtype=F64)
    direct = sum(0.9**t * linear_reward(phi, alpha)[t] for t in range(len(phi)))
    torch.testing.assert_close(direct, trajectory_features(phi, 0.9) @ alpha, rtol=1e-12, atol=1e-12)


@pytest.mark.equation("5.1.2.1")
def test_tracking_reward_is_the_sum_of_both_closenesses():
    error = tensor([[[0.0, 1 / 30]], [[-2 / 30, 0.0]], [[10.0, 10.0]]])
    np.testing.assert_allclose(
        tracking_reward(error, 30.0).flatten(), [1 + math.exp(-1), 1 + math.exp(-4), 0.0], rtol=1e-12, atol=1e-300
    )


@pytest.mark.parametrize("signal", ["x", "y"])
def test_the_features_look_at_samples_1_to_t_of_the_chosen_signal(study, signal):
    case = study()
    features = type(case.features)(case.features.params.model_copy(update={"features_on": signal}), case.task, 0.04)
    batch = rollout(case.process, case.pid, case.task, 3, stream(0, "rollout"))
    errors = (case.task.set_point - getattr(batch, signal)[1:]) / case.task.set_point  # the steady state is the origin
    torch.testing.assert_close(features.errors(batch), errors, rtol=0, atol=0)
    phi = state_features(errors, 10.0, 0.04, 1.0)
    torch.testing.assert_close(features.state(batch), phi, rtol=0, atol=0)
    assert features.trajectory(batch).shape == (3, 6)
    torch.testing.assert_close(features.trajectory(batch), sum(0.99**t * phi[t] for t in range(50)), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(features.tracking(batch, 30.0), torch.exp(-((30 * errors) ** 2)).sum(-1), rtol=1e-12, atol=1e-15)
