"""The gradient through the model against finite differences; the price on movement."""

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from helpers.learning.learner import TrainingError
from helpers.learning.model_gradient import PATIENCE, Descent, differentiable, model_gradient
from helpers.own_plant.tank import example
from helpers.plant.rollout import stream
from helpers.plant.tracking import Scenarios, track
from tests.learning.test_tracking_policy import bounds, episodes, fresh

ONE = Descent(steps=1, longest=torch.inf, price=0.0, price_step=0.0)


def start(case, n, n_steps, set_point=(-0.2, 0.5), **changes):
    """A policy with random weights in its output layer and small gains, and episodes with noise."""
    target = torch.tensor(set_point, dtype=case.dtype).expand(n_steps, 2)
    policy = fresh(case, 0, parts=([4.0, 5.0], [0.5, 1.0], [0.1, 0.2]))
    torch.nn.init.zeros_(policy.output.bias)
    return policy, episodes(case, target, n=n, noise=1.0, start=0.1, **changes)


def squared(scenarios, run):
    """Mean square error on the true state, and no movement."""
    error = (scenarios.set_point - run.x[1:]).square().mean((0, 2))
    return error, torch.zeros_like(error)


def test_the_gradient_is_that_of_finite_differences(case):
    policy, drawn = start(case, 4, 8)
    before = parameters_to_vector(policy.parameters()).detach()
    model_gradient(policy, lambda: drawn, squared, bounds(case), ONE)
    gradient = parameters_to_vector([parameter.grad for parameter in policy.parameters()])
    for seed in range(4):
        way, costs = torch.randn(len(before), generator=stream(seed, "direction"), dtype=case.dtype), []
        for length in (1e-6, -1e-6):
            vector_to_parameters(before + length * way, policy.parameters())
            with torch.no_grad():
                costs.append(squared(drawn, track(policy, drawn, bounds(case)))[0].mean().item())
        np.testing.assert_allclose((costs[0] - costs[1]) / 2e-6, (gradient @ way).item(), rtol=1e-5, atol=1e-9)


def test_the_price_on_movement_rises_while_there_is_too_much_and_falls_after(case):
    """Dual ascent, and movement that ends where it is allowed."""

    def measure(scenarios, run):
        return squared(scenarios, run)[0], run.movement.sum(0).mean(-1) / 8.0

    policy, drawn = start(case, 16, 10, (-0.5, 2.0))
    descent = Descent(steps=120, rate_start=2e-2, price=0.0, price_step=0.2)
    records = model_gradient(policy, lambda: drawn, measure, bounds(case), descent)
    prices, moved = [record.price for record in records], [record.movement for record in records]
    expected = [max(0.0, price + 0.2 * (m - descent.slack)) for price, m in zip(prices, moved, strict=True)]
    np.testing.assert_allclose(prices[1:], expected[:-1], rtol=1e-12)
    assert moved[0] > 1.1
    assert np.mean(moved[-20:]) < 1.0


def test_a_cost_that_stays_not_finite_ends_the_training(case):
    seen, (policy, drawn) = [], start(case, 2, 3)

    def measure(scenarios, run):
        seen.append(1)
        cost = squared(scenarios, run)[0]
        return cost * torch.nan, cost

    with pytest.raises(TrainingError, match="is not finite"):
        model_gradient(policy, lambda: drawn, measure, bounds(case), Descent(steps=50))
    assert len(seen) == PATIENCE + 1


def test_the_gradient_through_the_nonlinear_tank_is_that_of_finite_differences():
    tank = example()
    x, u, w = (torch.tensor([values], dtype=torch.float64) for values in ([-1.0, 4.0], [5.0, -20.0], [0.3, -0.4]))
    assert differentiable(tank, x, u)
    assert torch.autograd.gradcheck(lambda state, entry: tank.step(state, entry, w), (x.requires_grad_(), u.requires_grad_()))


def test_a_process_that_torch_cannot_differentiate_is_refused_in_one_sentence(case):
    class ByNumpy:
        n_disturbances = 2

        def step(self, x, u, noise):
            return torch.from_numpy(x.numpy() + u.numpy())

    zero = torch.zeros(1, 2)
    assert differentiable(case.process, zero.double(), zero.double())
    scenarios = Scenarios(ByNumpy(), *[torch.zeros(1, 1, 2)] * 2, zero, zero, *[torch.zeros(2, 1, 2)] * 2)
    with pytest.raises(TrainingError, match="torch cannot differentiate this process"):
        model_gradient(torch.nn.Linear(1, 1), lambda: scenarios, None, None, Descent(1))
