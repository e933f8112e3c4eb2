"""State features, trajectory features and rewards against plain loops."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from helpers.learning.features import accumulated_error, linear_reward, normalised_error, state_features, trajectory_features
from helpers.plant.rollout import rollout, stream

F64 = torch.float64


@pytest.mark.equation("4.2.1")
@pytest.mark.parametrize(("output", "expected"), [(2.0, 1.0), (-2.0, 0.0), (0.0, 0.5), (-3.0, -0.25)])
def test_normalised_error_is_one_at_rest_and_zero_at_the_set_point(output, expected):
    # y_ss = 2 and y_sp = -2: a step downwards, so the sign of the scale matters.
    assert normalised_error(*torch.tensor([[output], [-2.0], [-4.0]], dtype=F64)).item() == expected


@pytest.mark.equation("4.2.3")
def test_accumulated_error_tends_to_the_integral():
    exact = quad(lambda t: abs(math.cos(3 * t)), 0, 2, limit=200)[0]
    errors = [torch.cos(6 * torch.arange(1, n + 1, dtype=F64) / n)[:, None, None] for n in (1000, 2000, 4000)]
    gaps = np.array([abs(accumulated_error(error, 2 / len(error))[-1].item() - exact) for error in errors])
    assert gaps[2] < 1e-3
    assert gaps[:-1] / gaps[1:] == pytest.approx([2, 2], rel=0.05)


@pytest.mark.equation("3.3.1", "4.2.2", "4.2.4", "4.2.5")
def test_reward_is_the_weighted_sum_in_the_order_of_the_paper():
    errors = 0.3 * torch.randn(9, 4, 2, generator=stream(0, "errors"), dtype=F64)
    alpha = [0.137, 0.652, -0.067, -0.630, -0.194, -0.343]
    found = linear_reward(state_features(errors, 10.0, 0.04, 1.0), torch.tensor(alpha, dtype=F64)).numpy()
    for k in range(4):
        integral, before = np.zeros(2), np.ones(2)
        for t in range(9):
            size = np.abs(errors[t, k].numpy())
            integral = integral + size * 0.04
            c_a, temperature = ([math.exp(-((10 * size[i]) ** 2)), integral[i], (size[i] - before[i]) / 0.04] for i in (0, 1))
            expected = sum(alpha[2 * kind] * c_a[kind] + alpha[2 * kind + 1] * temperature[kind] for kind in range(3))
            assert found[t, k] == pytest.approx(expected, rel=1e-11, abs=1e-12)
            before = size


@pytest.mark.equation("3.3.4", "3.3.6")
@pytest.mark.parametrize("gamma", [1.0, 0.5])
def test_trajectory_features_and_their_weighted_sum_by_plain_loops(gamma):
    phi, alpha = (torch.randn(*shape, generator=stream(0, "phi"), dtype=F64) for shape in ((7, 3, 5), (5,)))
    found = trajectory_features(phi, gamma)
    torch.testing.assert_close(found, sum(gamma**t * phi[t] for t in range(7)), rtol=1e-12, atol=1e-12)
    rewards = sum(gamma**t * linear_reward(phi, alpha)[t] for t in range(7))
    torch.testing.assert_close(found @ alpha, rewards, rtol=1e-12, atol=1e-12)


@pytest.mark.equation("5.1.2.1")
@pytest.mark.parametrize("signal", ["x", "y"])
def test_the_features_look_at_samples_1_to_t_of_the_chosen_signal(case, signal):
    features = type(case.features)(case.features.params.model_copy(update={"features_on": signal}), case.task, 0.04)
    batch = rollout(case.process, case.pid, case.task, 3, stream(0, "rollout"))
    errors = (case.task.set_point - getattr(batch, signal)[1:]) / case.task.set_point  # the steady state is the origin
    torch.testing.assert_close(features.errors(batch), errors, rtol=0, atol=0)
    phi = state_features(errors, 10.0, 0.04, 1.0)
    torch.testing.assert_close(features.state(batch), phi, rtol=0, atol=0)
    torch.testing.assert_close(features.trajectory(batch), sum(0.99**t * phi[t] for t in range(50)), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(features.tracking(batch, 30.0), torch.exp(-((30 * errors) ** 2)).sum(-1), rtol=1e-12, atol=1e-15)
