"""Algorithm 2: the MaxEnt gradient against the log-likelihood itself, the ascent step, and the outer loop."""

import copy

import numpy as np
import pytest
import torch

from helpers.learning.algorithm_1 import algorithm_1
from helpers.learning.algorithm_2 import WeightAscent, algorithm_2, initial_weights, maxent_gradient, project
from helpers.learning.evaluation import expected_features
from helpers.learning.features import linear_reward
from helpers.learning.learner import TrainingError
from helpers.learning.policy import PolicyController
from helpers.plant.rollout import rollout, stream
from tests.learning.test_algorithm_1 import Failing, differences, normal

F64 = torch.float64


@pytest.fixture(scope="module")
def weights_of(study):
    """Parameters of the ascent as printed, with changes."""
    base = study().params.learning.variants["printed"].weights
    plain = {"step": 0.1, "decay": 0.0, "bound": 1.0, "scaled_by_expert": False, "averaging": 0.0, "keep_nearest": False}
    return lambda **changes: base.model_copy(update={**plain, "selection_memory": 0.0, **changes})


@pytest.mark.equation("3.4.1", "3.4.3", "3.4.4", "3.4.5")
def test_the_gradient_is_that_of_the_mean_log_likelihood():
    """Nine possible trajectories, so that the partition function is a sum; five demonstrations, some seen twice."""
    features = normal(9, 4).numpy()
    demonstrations = [0, 3, 3, 8, 5]
    alpha = np.array([0.4, -0.7, 0.2, 0.55])

    def log_likelihood(weights):
        partition = sum(np.exp(weights @ v) for v in features)
        return np.mean([weights @ features[k] - np.log(partition) for k in demonstrations])

    probability = np.exp(features @ alpha) / np.exp(features @ alpha).sum()
    found = maxent_gradient(torch.tensor(features[demonstrations].mean(0)), torch.tensor(probability @ features))
    np.testing.assert_allclose(found, differences(log_likelihood, alpha), rtol=1e-7, atol=1e-9)


@pytest.mark.equation("3.4.6")
@pytest.mark.parametrize("decay", [0.0, 0.3])
@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("averaging", [0.0, 0.9])
def test_the_steps_against_plain_numpy(weights_of, decay, scaled, averaging):
    """Clipped before they are normalised; as printed they go on from alpha itself, with decay from what was clipped."""
    expert = 2 * normal(6, seed=2)
    ascent = WeightAscent(
        weights_of(decay=decay, scaled_by_expert=scaled, averaging=averaging, bound=0.7), project(normal(6)), expert
    )
    raw = alpha = mean = project(normal(6)).numpy()
    for index in range(50):
        gradient = 5 * normal(6, seed=10 + index)
        ascent.step(gradient)
        step = 0.1 * gradient.numpy() / (np.abs(expert.numpy()) if scaled else 1)
        raw = np.clip((1 - decay) * (raw if decay else alpha) + step, -0.7, 0.7)
        alpha = raw / np.linalg.norm(raw)
        mean = averaging * mean + (1 - averaging) * alpha
        np.testing.assert_allclose(ascent.weights, alpha, rtol=1e-10)
        np.testing.assert_allclose(ascent.result, mean / np.linalg.norm(mean), rtol=1e-10)


@pytest.mark.parametrize("n_loops", [1, 2, 3])
def test_initial_weights_give_one_sign_to_each_kind_of_feature(weights_of, n_loops):
    found = initial_weights(weights_of(initial=(1.0, -1.0, -2.0)), n_loops, F64)
    expected = np.repeat([1.0, -1.0, -2.0], n_loops) / np.sqrt(6 * n_loops)
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def setting(case, n_episodes=6, total_epochs=6, seed=0, **changes):
    """A learner, the expert's features and the first weights."""
    params = case.params.learning.variants["printed"].learner.model_copy(update={"patience": 0, **changes})
    learner = case.learner(case.policy(seed), n_episodes, total_epochs, params, seed)
    expert = expected_features(case.process, case.pid, case.features, 20, stream(seed, "expert"))
    return learner, expert, project(normal(len(expert)))


@pytest.mark.parametrize(
    ("total", "iterations", "shares"), [(6, 3, [2, 4, 6]), (7, 3, [2, 4, 7]), (4, 4, [1, 2, 3, 4]), (3, 1, [3])]
)
def test_epochs_are_shared_among_the_iterations_and_all_episodes_counted(study, weights_of, total, iterations, shares):
    learner, expert, start = setting(study(), total_epochs=total)
    seen = []
    result = algorithm_2(learner, expert, start, weights_of(), iterations, 5, seen.append)
    assert [record.epochs for record in result.records] == shares
    assert [record.episodes for record in result.records] == [6 * done + 5 * (index + 1) for index, done in enumerate(shares)]
    assert [record.gradient_steps for record in result.records] == shares
    assert [record.iteration for record in result.records] == list(range(1, iterations + 1))
    assert tuple(seen) == result.records


def test_an_iteration_learns_under_the_weights_it_records(case, weights_of):
    """The first return is that of the fresh policy's own batch under alpha_0; the next weights follow from Eq. 3.4.6."""
    learner, expert, start = setting(case, total_epochs=2)
    batch = rollout(case.process, PolicyController(case.policy(), case.task, True), case.task, 6, stream(0, "learner"))
    result = algorithm_2(learner, expert, start, weights_of(), 2, 5)
    first, second = result.records
    np.testing.assert_allclose(first.weights, start, rtol=1e-12)
    expected = case.features.trajectory(batch).mean(0) @ start
    assert first.mean_return == pytest.approx(expected.item(), rel=1e-10)
    learner = setting(case, total_epochs=2)[0]  # the same epoch again, and the features of the deployed policy after it
    algorithm_1(learner, lambda batch: linear_reward(case.features.state(batch), start), 1)
    controller = PolicyController(learner.policy, case.task, exploring=False)
    gap = expert - expected_features(case.process, controller, case.features, 5, learner.generator)
    assert first.feature_gap == pytest.approx((gap / expert).abs().mean().item(), rel=1e-10)
    stepped = np.clip(start.numpy() + 0.1 * gap.numpy(), -1, 1)
    np.testing.assert_allclose(second.weights, stepped / np.linalg.norm(stepped), rtol=1e-10)


def test_the_nearest_epoch_is_kept_where_asked(study, weights_of):
    case, n_epochs = study(), 6

    def run(keep):
        learner, expert, start = setting(case, total_epochs=n_epochs, learning_rate_start=0.05, learning_rate_end=0.05)
        return learner, algorithm_2(learner, expert, start, weights_of(keep_nearest=keep), n_epochs, 5)

    learner, last = run(False)
    gaps = [record.feature_gap for record in last.records]
    assert last.chosen_epoch == n_epochs
    assert all(torch.equal(a, b) for a, b in zip(last.policy.parameters(), learner.policy.parameters(), strict=True))
    before = copy.deepcopy(last.policy)
    algorithm_1(learner, lambda batch: batch.x[1:, :, 0], 1)  # learning goes on without touching the kept policy
    assert all(torch.equal(a, b) for a, b in zip(last.policy.parameters(), before.parameters(), strict=True))
    _, nearest = run(True)
    assert [record.feature_gap for record in nearest.records] == gaps
    assert nearest.chosen_epoch == 1 + int(np.argmin(gaps)) < n_epochs  # an earlier epoch, so that the choice shows


def test_early_stopping_ends_an_iteration_early(study, weights_of):
    learner, expert, start = setting(study(), total_epochs=20, patience=1, learning_rate_start=1e-5, learning_rate_end=1e-5)
    result = algorithm_2(learner, expert, start, weights_of(), 2, 5)
    assert result.records[-1].epochs < 20


def test_features_that_are_not_finite_end_training_with_the_epoch(case, weights_of):
    learner, expert, start = setting(case)
    learner.process = Failing(case.params.process, F64)
    learner.process.steps = 2 * case.task.n_steps
    with pytest.raises(TrainingError, match=r"epoch 2: .*not finite"):  # two epochs of learning pass, the evaluation fails
        algorithm_2(learner, expert, start, weights_of(), 3, 5)
