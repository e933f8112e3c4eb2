"""The dynamic programme: its pieces against other routes, and what it must not fall below."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm

from helpers.evidence.attainable import Resolution, Tabulated, dynamic_programme, expected_closeness, grid_around, one_step
from helpers.learning.evaluation import objective
from helpers.plant.controllers import MinimumVariance
from helpers.plant.rollout import rollout, stream


@pytest.mark.parametrize(("mean", "std", "beta"), [(0.0, 0.1, 30.0), (0.05, 0.06, 30.0), (-0.4, 0.3, 10.0), (0.2, 1e-9, 10.0)])
def test_the_expected_reward_is_the_integral(mean, std, beta):
    """Against quadrature over the density, where that is not a spike."""
    found = expected_closeness(np.array(mean), np.array(std), beta)
    if std < 1e-6:
        expected = np.exp(-((beta * mean) ** 2))
    else:
        expected = quad(
            lambda e: np.exp(-((beta * e) ** 2)) * norm.pdf(e, mean, std), mean - 9 * std, mean + 9 * std, points=[0.0]
        )[0]
    assert found == pytest.approx(expected, rel=1e-6)


def test_rewards_and_transitions_are_those_of_the_process(study):
    """Monte Carlo through the process itself: reward and the expectation of a cubic, which a cubic spline holds exactly."""
    case = study(1)
    axes = (np.linspace(-4, 3, 9), np.linspace(-8, 12, 9))
    step = one_step(case.process, case.task, 10.0, axes, Resolution(9, 3, 5))
    place, tried = 9 * 3 + 6, (2, 0)  # the state (axes[0][3], axes[1][6]) and the inputs at the upper and the lower bound
    x = torch.tensor([[axes[0][3], axes[1][6]]], dtype=torch.float64).expand(200_000, -1)
    u = torch.tensor([[step.inputs[0, 2], step.inputs[1, 0]]], dtype=torch.float64).expand(200_000, -1)
    after = case.process.step(x, u, torch.randn(x.shape, generator=stream(0, "step"), dtype=torch.float64))
    error = (case.task.set_point - after) / case.task.error_scale
    rewards = torch.exp(-((10.0 * error) ** 2))
    for loop, entry in enumerate(tried):
        margin = 4 * rewards[:, loop].std().item() / len(x) ** 0.5 + 1e-12
        assert step.reward[loop, place, entry] == pytest.approx(rewards[:, loop].mean().item(), abs=margin)
        ones = step.transition[loop][place, entry].sum()
        assert ones == pytest.approx(1.0)  # the basis is a partition of one


@pytest.mark.parametrize(("case_number", "beta"), [(1, 30.0), (2, 10.0)])
def test_value_and_monte_carlo_agree_and_neither_lies_below_minimum_variance(study, case_number, beta):
    case = study(case_number, process={"observation_noise": (0.0, 0.0)})
    known = MinimumVariance(case.process.state_step, case.process.input_step, case.task.set_point)
    reference = rollout(case.process, known, case.task, 2000, stream(0, "test"))
    axes = grid_around(reference.x, 31, 0.05)
    discount = case.features.params.discount
    optimum = dynamic_programme(case.process, case.task, beta, discount, axes, Resolution(31, 17, 7))
    greedy = rollout(case.process, Tabulated(optimum), case.task, 2000, stream(0, "test"))
    least, found = (objective(batch, case.features.on("x"), beta).mean().item() for batch in (reference, greedy))
    value = optimum.value_at(greedy.x[0]).mean().item()
    assert value == pytest.approx(found, rel=0.01)  # of a coarser grid than at paper scale, and fewer draws
    assert found > least
    assert value > least * 0.995


def test_a_last_step_without_noise_goes_to_the_set_point(study):
    """With one step to go and the set point in reach, the best input is that of minimum variance."""
    case = study(1, process={"disturbance": (0.0, 0.0), "horizon": 1})
    axes = (np.linspace(-1.2, -0.8, 7), np.linspace(3.5, 4.5, 7))
    optimum = dynamic_programme(case.process, case.task, 10.0, 1.0, axes, Resolution(7, 201, 3))
    x = torch.tensor([[axes[0][2], axes[1][4]]])
    known = MinimumVariance(case.process.state_step, case.process.input_step, case.task.set_point)
    found, _ = Tabulated(optimum).act(x, 0)
    assert found.numpy() == pytest.approx(known.act(x, None)[0].numpy(), abs=0.02)
    assert optimum.value_at(x).item() == pytest.approx(2.0, abs=1e-3)


def test_coupled_inputs_are_refused(study):
    case = study(1, process={"drift_input": ((0.5, 0.1), (0.0, 0.3))})
    axes = (np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    with pytest.raises(ValueError, match="diagonal"):
        dynamic_programme(case.process, case.task, 10.0, 0.99, axes, Resolution(5, 3, 3))


def test_the_stationary_policy_stays_that_of_the_first_sample(study):
    case = study(1)
    axes = (np.linspace(-2, 1, 7), np.linspace(-3, 5, 7))
    optimum = dynamic_programme(case.process, case.task, 10.0, 0.99, axes, Resolution(7, 5, 3))
    policy = Tabulated(optimum, stationary=True)
    memory = policy.start(1, 1, stream(0))
    for _ in range(case.task.n_steps + 3):
        command, memory = policy.act(case.task.set_point[None], memory)
    assert torch.equal(command, Tabulated(optimum).act(case.task.set_point[None], 0)[0])
