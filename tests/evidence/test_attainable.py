"""The dynamic programme: its pieces against other routes, and what it must not fall below."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm

from helpers.evidence import attainable
from helpers.evidence.attainable import Resolution, Tabulated, dynamic_programme, one_step
from helpers.learning.evaluation import objective
from helpers.learning.features import tracking_reward
from helpers.plant.rollout import rollout, stream


@pytest.mark.parametrize("skewness", [0.0, 0.3])
@pytest.mark.parametrize(("mean", "std", "beta"), [(0.0, 0.1, 30.0), (0.05, 0.06, 30.0), (-0.4, 0.3, 10.0)])
def test_the_expected_reward_is_the_integral(mean, std, beta, skewness):
    """Against quadrature over the density; with a third moment over the series of Gram and Charlier."""

    def weighted(e):
        z = (e - mean) / std
        return np.exp(-((beta * e) ** 2)) * norm.pdf(z) / std * (1 + skewness / 6 * (z**3 - 3 * z))

    expected = quad(weighted, mean - 9 * std, mean + 9 * std, points=[0.0])[0]
    found = attainable.expected_closeness(np.array(mean), np.array(std), beta, skewness * std**3)
    assert found == pytest.approx(expected, rel=1e-6)
    spike = attainable.expected_closeness(np.array(mean), np.array(1e-9), beta, 0.0)
    assert spike == pytest.approx(np.exp(-((beta * mean) ** 2)), rel=1e-6)


@pytest.mark.parametrize(("beta", "place", "tried"), [(10.0, 3 * 9 + 6, (4, 0)), (30.0, 3 * 9 + 5, (3, 0))])
def test_rewards_and_transitions_are_those_of_the_process(case, beta, place, tried):
    """Monte Carlo through the process itself: the reward, and the expectation of what a cubic spline holds exactly."""
    axes = (np.linspace(-4, 3, 9), np.linspace(-8, 12, 9))
    step = one_step(case.process, case.task, beta, axes, Resolution(9, 5, 5))
    x = torch.tensor([[axes[0][place // 9], axes[1][place % 9]]], dtype=torch.float64).expand(400_000, -1)
    u = torch.tensor([[step.inputs[loop, entry] for loop, entry in enumerate(tried)]], dtype=torch.float64).expand(len(x), -1)
    noise = torch.randn(len(x), case.process.n_disturbances, generator=stream(0, "step"), dtype=torch.float64)
    after = case.process.step(x, u, noise)
    rewards = tracking_reward((case.task.set_point - after) / case.task.error_scale, beta)
    margin = 4 * rewards.std().item() / len(x) ** 0.5 + 2e-3 * rewards.mean().item()  # moments above the third
    assert step.reward[place, *tried] == pytest.approx(rewards.mean().item(), abs=margin)
    for power in (0, 1, 2):
        values = np.add.outer(axes[0] ** power, 0.5 * axes[1] ** power)
        expected = (after[:, 0] ** power + 0.5 * after[:, 1] ** power).mean().item()
        assert attainable.expected_value(step, attainable.coefficients(axes, values))[place, *tried] == pytest.approx(
            expected, rel=2e-3, abs=1e-3
        )


@pytest.mark.parametrize(("case_number", "beta", "share"), [(1, 30.0, 0.999), (3, 30.0, 1.01)])
def test_value_and_monte_carlo_agree_and_neither_lies_below_minimum_variance(study, case_number, beta, share):
    """In Case I looking ahead gains nothing, in Case III, where the inputs are slow, some per cent."""
    case = study(case_number, process={"observation_noise": (0.0, 0.0)})
    reference = rollout(case.process, case.minimum_variance, case.task, 2000, stream(0, "test"))
    axes = attainable.grid_around(reference.x, 31, 0.05)
    discount = case.features.params.discount
    optimum = dynamic_programme(case.process, case.task, beta, discount, axes, Resolution(31, 17, 7))
    greedy = rollout(case.process, Tabulated(optimum), case.task, 2000, stream(0, "test"))
    least, found = (objective(batch, case.features.on("x"), beta).mean().item() for batch in (reference, greedy))
    value = optimum.value_at(greedy.x[0]).mean().item()
    assert value == pytest.approx(found, rel=0.01)  # of a coarser grid than at paper scale, and fewer draws
    assert found > share * least
    assert value > share * 0.995 * least


def test_a_last_step_without_noise_goes_to_the_set_point(study):
    """With one step to go and the set point in reach, the best input is that of minimum variance."""
    case = study(1, process={"disturbance": (0.0, 0.0), "horizon": 1})
    axes = (np.linspace(-1.2, -0.8, 7), np.linspace(3.5, 4.5, 7))
    optimum = dynamic_programme(case.process, case.task, 10.0, 1.0, axes, Resolution(7, 201, 3))
    x = torch.tensor([[axes[0][2], axes[1][4]]])
    found, _ = Tabulated(optimum).act(x, 0)
    assert found.numpy() == pytest.approx(case.minimum_variance.act(x, None)[0].numpy(), abs=0.05)  # they are 0.2 and 0.6 apart
    assert optimum.value_at(x).item() == pytest.approx(2.0, abs=1e-3)


def test_inputs_may_move_each_others_states(study):
    """The value at inputs that are coupled is that of the same moves made by inputs that are not."""
    case = study(1, process={"horizon": 1, "disturbance": (0.2, 0.2)})
    coupled = study(1, process={"horizon": 1, "disturbance": (0.2, 0.2), "drift_input": ((0.5, 0.05), (0.1, 0.305))})
    axes = (np.linspace(-1.2, -0.8, 7), np.linspace(3.5, 4.5, 7))
    values = [dynamic_programme(each.process, each.task, 10.0, 1.0, axes, Resolution(7, 101, 5)).value for each in (case, coupled)]
    np.testing.assert_allclose(values[0], values[1], rtol=2e-3)


def test_the_stationary_policy_stays_that_of_the_first_sample(case):
    axes = (np.linspace(-2, 1, 7), np.linspace(-3, 5, 7))
    optimum = dynamic_programme(case.process, case.task, 10.0, 0.99, axes, Resolution(7, 5, 3))
    policy = Tabulated(optimum, stationary=True)
    memory = policy.start(1, 1, stream(0))
    for _ in range(case.task.n_steps + 3):
        command, memory = policy.act(case.task.set_point[None], memory)
    assert torch.equal(command, Tabulated(optimum).act(case.task.set_point[None], 0)[0])


def test_single_precision_changes_little(study):
    """The number type of the paper's scale."""
    axes = (np.linspace(-4, 3, 7), np.linspace(-8, 12, 7))
    steps = [one_step(case.process, case.task, 30.0, axes, Resolution(7, 5, 3)) for case in (study(1, torch.float32), study(1))]
    np.testing.assert_allclose(steps[0].reward, steps[1].reward, atol=1e-5)
