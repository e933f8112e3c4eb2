"""Algorithm 1: returns, baselines, the policy gradient against exact integration, and the learner's book-keeping."""

from functools import partial

import numpy as np
import pytest
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from helpers.learning.algorithm_1 import algorithm_1
from helpers.learning.learner import (
    TrainingError,
    annealed,
    baseline_regressors,
    clipped_surrogate,
    discounted_return,
    regression_advantage,
    reward_to_go,
    surrogate,
    whole_return_advantage,
)
from helpers.learning.policy import PolicyController
from helpers.plant.process import LinearProcess
from helpers.plant.rollout import rollout, stream
from tests.plant.test_rollout import CALM

F64 = torch.float64


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=stream(seed, "test", *shape), dtype=F64)


def differences(function, at, step=1e-6):
    """Central differences of a scalar function."""
    return np.array([(function(at + row) - function(at - row)) / (2 * step) for row in step * np.eye(len(at))])


@pytest.fixture(scope="module")
def settings(study):
    """Learner parameters of the printed variant, with changes."""
    base = study().params.learning.variants["printed"].learner
    return lambda **changes: base.model_copy(update={"patience": 0, **changes})


@pytest.mark.equation("3.1.5")
@pytest.mark.parametrize("decay", [1.0, 0.6])
def test_return_and_reward_to_go_by_plain_loops(decay):
    rewards = normal(5, 2)
    for t, found in enumerate(reward_to_go(rewards, 0.8, decay)):  # the input u_t meets R_{t+1}..R_T, rows t..T-1
        expected = sum(0.8**row * decay ** (row - t) * rewards[row] for row in range(t, 5))
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    whole = sum(0.8**row * rewards[row] for row in range(5))
    torch.testing.assert_close(discounted_return(rewards, 0.8), whole, rtol=1e-12, atol=1e-12)
    less_mean = (whole - whole.mean()).expand(5, -1)
    torch.testing.assert_close(whole_return_advantage(rewards, 0.8), less_mean, rtol=1e-12, atol=1e-12)


def test_regression_advantage_is_the_residual_of_ridge_regression():
    """Ridge regression is least squares with rows sqrt(ridge) I and zeros below the data; a regressor may be a constant."""
    rewards, regressors, n = normal(4, 30), normal(4, 30, 2, seed=1), 30
    regressors[..., 1] = 1
    found = regression_advantage(rewards, 0.9, decay=0.7, regressors=regressors)
    future = reward_to_go(rewards, 0.9, 0.7).numpy()
    for t in range(4):
        design = np.column_stack([np.ones(n), regressors[t]])
        below = np.sqrt(1e-3 * n) * np.eye(3)
        fit = np.linalg.lstsq(np.vstack([design, below]), np.concatenate([future[t], np.zeros(3)]), rcond=None)[0]
        np.testing.assert_allclose(found[t], future[t] - design @ fit, rtol=1e-9, atol=1e-10)


class Grid(PolicyController):
    """A policy whose exploration runs over the nodes of a quadrature instead of being drawn."""

    def __init__(self, policy, task, nodes):
        super().__init__(policy, task, exploring=True)
        self.nodes = nodes

    def start(self, n_trajectories, n_steps, generator):
        memory = super().start(n_trajectories, n_steps, generator)
        memory.exploration = self.nodes.mT.unbind(0)
        return memory


class Integral:
    """J(theta) = E[G] of two steps of one input by Gauss-Hermite quadrature over both draws; nothing else is random.

    The leaky ReLU is made linear, so that the integrand is smooth and the quadrature exact to rounding.
    """

    gamma = 0.9

    def __init__(self, study):
        one_input = {"manipulated": ("u",), "drift_input": ((4.0,), (1.0,)), "input_low": (-4.0,), "input_high": (6.0,)}
        case = study(process=CALM | one_input | {"horizon": 2}, case_study={"initial_std": (0.0, 0.0)})
        self.task, self.features, self.process = case.task, case.features, case.process
        self.policy = case.policy(hidden_cells=(3, 2), leaky_slope=1.0)
        with torch.no_grad():  # the spread and its gradient should depend on the history too
            self.policy.output.weight.copy_(normal(2, 2))
        nodes, weights = np.polynomial.hermite_e.hermegauss(24)
        first, second = np.meshgrid(nodes, nodes, indexing="ij")
        self.nodes = torch.tensor(np.stack([first.ravel(), second.ravel()])[..., None])
        self.weights = torch.tensor(np.outer(weights, weights).ravel() / weights.sum() ** 2)
        self.theta = parameters_to_vector(self.policy.parameters()).detach()
        self.exact = differences(self.value, self.theta.numpy(), 1e-4)

    def batch(self, theta):
        vector_to_parameters(torch.as_tensor(theta), self.policy.parameters())
        return rollout(self.process, Grid(self.policy, self.task, self.nodes), self.task, len(self.weights), stream(0))

    def rewards(self, batch):
        return torch.cos(3 * batch.x[1:, :, 0]) + batch.x[1:, :, 0] ** 3

    def value(self, theta):
        rewards = self.rewards(self.batch(theta))
        return (self.weights @ (rewards[0] + self.gamma * rewards[1])).item()

    def gradient(self, advantage, objective):
        """The exact expectation of the estimator: each trajectory counts by its probability, not by 1/K."""
        batch = self.batch(self.theta)
        log_probability = self.policy.log_probability(batch.y, batch.u, batch.command, self.task)
        weighted = advantage(self.rewards(batch), batch) * self.weights * len(self.weights)
        self.policy.zero_grad()
        objective(log_probability, weighted).backward()
        return parameters_to_vector([parameter.grad for parameter in self.policy.parameters()]).numpy()


ADVANTAGES = {
    "whole return": lambda problem, rewards, batch: discounted_return(rewards, problem.gamma).expand_as(rewards),
    "scalar baseline": lambda problem, rewards, batch: whole_return_advantage(rewards, problem.gamma),
    "reward to go": lambda problem, rewards, batch: reward_to_go(rewards, problem.gamma),
    "regression baseline": lambda problem, rewards, batch: regression_advantage(
        rewards, problem.gamma, decay=1.0, regressors=baseline_regressors(batch, problem.features)
    ),
}
OBJECTIVES = {
    "plain": surrogate,
    "clipped": lambda log_probability, advantage: clipped_surrogate(log_probability, log_probability.detach(), advantage, 0.2),
}


@pytest.fixture(scope="module")
def problem(study):
    return Integral(study)


@pytest.mark.equation("3.2.1", "3.2.4")
@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("name", ADVANTAGES)
def test_the_surrogates_gradient_is_that_of_the_expected_return_whatever_the_baseline(problem, name, objective):
    """The clipped one where the batch was drawn. A baseline that looked at the present input or later ones would move it."""
    found = problem.gradient(partial(ADVANTAGES[name], problem), OBJECTIVES[objective])
    assert np.abs(problem.exact).max() > 0.05
    np.testing.assert_allclose(found, problem.exact, rtol=1e-5, atol=1e-7)


def closeness_reward(case):
    return lambda batch: case.features.tracking(batch, 1.0)


@pytest.mark.equation("3.2.2")
@pytest.mark.parametrize(("n", "passes", "minibatches"), [(12, 1, 1), (12, 2, 1), (12, 1, 3), (200, 2, 2)])
def test_the_steps_of_an_epoch_against_plain_autograd(case, settings, n, passes, minibatches):
    """Each is taken by Adam from the policy that the one before it left, along the clipped ratio of what the first one drew."""
    reference, reward, task = case.policy(), closeness_reward(case), case.task
    changes = {"learning_rate_start": 1e-2, "credit": "whole_return", "averaging": 0.0, "ratio_clip": 0.05}
    learner = case.learner(case.policy(), n, 2, settings(passes=passes, minibatches=minibatches, **changes))
    batch = rollout(case.process, PolicyController(reference, task, True), task, n, stream(0, "learner"))
    advantage = whole_return_advantage(reward(batch), 0.99)
    advantage = advantage / advantage.std()
    optimiser = torch.optim.Adam(reference.parameters(), lr=1e-2)

    def log_probability():
        return torch.distributions.Normal(*reference(batch.y, batch.u, task)).log_prob(batch.command).sum(-1)

    drawn = log_probability().detach()
    for step in range(passes * minibatches):
        rows = torch.arange(n).chunk(minibatches)[step % minibatches]
        ratio = (log_probability() - drawn).exp()
        gain = torch.minimum(ratio * advantage, ratio.clamp(0.95, 1.05) * advantage)[:, rows].sum(0).mean()
        optimiser.zero_grad()
        (-gain).backward()
        optimiser.step()
    algorithm_1(learner, reward, 1)
    for value, expected in zip(learner.policy.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(value.detach(), expected.detach(), rtol=1e-6, atol=1e-7)
    assert (learner.epochs, learner.episodes, learner.gradient_steps) == (1, n, passes * minibatches)


def test_the_record_of_an_epoch_is_that_of_its_batch(case, settings):
    policy = case.policy()
    batch = rollout(case.process, PolicyController(policy, case.task, True), case.task, 20, stream(0, "learner"))
    returns = discounted_return(closeness_reward(case)(batch), 0.99)
    record = algorithm_1(case.learner(policy, 20, 1, settings()), closeness_reward(case), 1)[0]
    assert record.mean_return == pytest.approx(returns.mean().item(), rel=1e-12)
    assert record.standard_error == pytest.approx(returns.numpy().std(ddof=1) / np.sqrt(20), rel=1e-12)
    assert record.policy_std == pytest.approx(policy.params.initial_std, rel=0.2)  # in units of the input range, after one step


def test_the_learning_rate_falls_along_half_a_cosine(case, settings):
    assert [annealed(3.0, 1.0, progress) for progress in (0.0, 0.5, 1.0)] == pytest.approx([3.0, 2.0, 1.0], rel=1e-14)
    learner = case.learner(case.policy(), 4, 5, settings(learning_rate_start=4e-3, learning_rate_end=1e-3))
    rates = [record.learning_rate for record in algorithm_1(learner, closeness_reward(case), 5)]
    assert rates == pytest.approx([annealed(4e-3, 1e-3, epoch / 4) for epoch in range(5)])


@pytest.mark.parametrize("averaging", [0.0, 0.5, 0.9])
def test_the_average_is_a_running_mean_of_the_weights(case, settings, averaging):
    """After n epochs the old average counts n / (n + 9), but not more than `averaging`; without it the last policy is kept."""
    learner = case.learner(case.policy(), 8, 6, settings(averaging=averaging))
    expected = learner.policy.output.bias.detach().clone()
    for n in range(1, 7):
        algorithm_1(learner, closeness_reward(case), 1)
        keep = min(averaging, n / (n + 9))
        expected = keep * expected + (1 - keep) * learner.policy.output.bias.detach()
    torch.testing.assert_close(learner.average.output.bias.detach(), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("minibatches", [1, 2])
def test_an_entropy_bonus_keeps_exploration_up(study, settings, minibatches):
    case = study(1, torch.float32)

    def spread(bonus):
        params = settings(credit="reward_to_go", entropy=bonus, minibatches=minibatches, learning_rate_start=3e-2)
        return algorithm_1(case.learner(case.policy(), 20, 8, params), closeness_reward(case), 8)[-1].policy_std

    assert spread(1.0) > spread(0.0) + 0.003


def scripted(levels):
    """A reward whose mean return follows `levels`, one an epoch, with a little spread for the advantage."""
    levels = iter(levels)

    def reward(batch):
        spread = torch.linspace(-1, 1, batch.n_trajectories, dtype=batch.x.dtype)
        return (next(levels) + 0.01 * spread).expand(batch.n_steps, -1)

    return reward


@pytest.mark.parametrize(
    ("levels", "patience", "expected"),
    [
        ([5, 4, 3, 2, 1, 0], 0, 6),  # no early stop
        ([5, 4, 3, 2, 1, 0], 3, 4),  # the best epoch and three worse ones
        ([5, 4, 6, 4, 3, 2], 2, 5),  # an improvement starts the count again
        ([1, 2, 3, 4, 5, 6], 1, 6),  # never stops while it improves
        ([3, 1, 2, 2.5, 4, 5], 3, 4),  # better than the last is not better than the best
    ],
)
def test_early_stopping_by_patience(case, settings, levels, patience, expected):
    learner = case.learner(case.policy(), 4, 6, settings())
    records = algorithm_1(learner, scripted(levels), 6, patience)
    assert len(records) == learner.epochs == expected


class Failing(LinearProcess):
    """A process whose states are not numbers after so many steps."""

    steps = 50

    def step(self, x, u, noise):
        self.steps -= 1
        return super().step(x, u, noise) * (1.0 if self.steps >= 0 else float("nan"))


def test_a_process_that_returns_nan_ends_training_with_the_epoch(case, settings):
    learner = case.learner(case.policy(), 4, 5, settings())
    learner.process = Failing(case.params.process, F64)
    with pytest.raises(TrainingError, match=r"epoch 2: .*not finite"):
        algorithm_1(learner, closeness_reward(case), 5)
    assert learner.epochs == 1
    assert all(torch.isfinite(parameter).all() for parameter in learner.policy.parameters())


@pytest.mark.parametrize("minibatches", [1, 3])
def test_a_gradient_that_is_not_finite_ends_training_before_the_step(case, settings, minibatches):
    policy = case.policy()
    before = policy.output.weight.detach().clone()
    policy.output.bias.register_hook(lambda gradient: gradient * float("inf"))
    with pytest.raises(TrainingError, match=r"epoch 1: the gradient of output\.bias is not finite"):
        algorithm_1(case.learner(policy, 6, 5, settings(minibatches=minibatches)), closeness_reward(case), 1)[0]
    assert torch.equal(policy.output.weight, before)


@pytest.mark.parametrize("credit", ["whole_return", "reward_to_go"])
def test_a_reward_without_spread_ends_training_with_the_cause(case, settings, credit):
    """Nothing to learn from: the cause is the reward, not the learning rate."""
    learner = case.learner(case.policy(), 4, 5, settings(credit=credit))
    with pytest.raises(TrainingError, match=r"epoch 1: .*(reward|return)"):
        algorithm_1(learner, lambda batch: torch.zeros(batch.n_steps, batch.n_trajectories, dtype=F64), 1)
