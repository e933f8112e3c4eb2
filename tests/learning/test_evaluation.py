"""Monte Carlo evaluation and figures of merit; the expert rows of Tables 2, 3 and 4."""

import math

import numpy as np
import pytest
import torch

from helpers.learning.evaluation import expected_features, feature_gap, objective, scores
from helpers.plant.rollout import rollout, stream
from helpers.plant.task import Trajectories
from helpers.settings.paper import load_published

F64 = torch.float64


@pytest.mark.equation("S1")
def test_features_are_means_over_fresh_episodes_and_scores_hold_their_deviations_too(case):
    batch = rollout(case.process, case.pid, case.task, 30, stream(0, "evaluation"))
    v = case.features.trajectory(batch).numpy()
    expected = expected_features(case.process, case.pid, case.features, 30, stream(0, "evaluation"))
    np.testing.assert_allclose(expected, v.mean(0), rtol=1e-12)
    found = scores(batch, case.features, 30.0, ("C_A", "T"), ("C_A0", "T_E"))
    names = ("C_A-I", "T-I", "C_A-II", "T-II", "C_A-III", "T-III")
    np.testing.assert_allclose([found[f"v:{name}"] for name in names], v.mean(0), rtol=1e-12)
    np.testing.assert_allclose([found[f"v:{name}:std"] for name in names], v.std(0, ddof=1), rtol=1e-12)


@pytest.mark.parametrize("case", [1, 2, 3])
def test_expert_rows_of_the_published_tables(study, root, case):
    """20,000 trajectories: mean relative error to Tables 2, 3 and 4 at most 3 %."""
    example, published = study(case), torch.tensor(load_published(root)[case].expert, dtype=F64)
    found = expected_features(example.process, example.pid, example.features, 20_000, stream(0, "expert", case))
    assert feature_gap(found, published) <= 0.03


@pytest.mark.parametrize(("case", "gap"), [(1, 0.037), (2, 0.137), (3, 0.115)])
def test_feature_gap_of_the_published_rows(root, case, gap):
    table = load_published(root)[case]
    found = feature_gap(torch.tensor(table.policy, dtype=F64), torch.tensor(table.expert, dtype=F64))
    assert found == pytest.approx(gap, abs=5e-4)


@pytest.mark.equation("5.1.2.1")
@pytest.mark.parametrize("beta", [10.0, 30.0])
def test_objective_by_plain_loops(case, beta):
    batch = rollout(case.process, case.pid, case.task, 3, stream(0, "objective"))
    for k, found in enumerate(objective(batch, case.features, beta)):
        total = 0.0
        for t in range(1, 51):
            for loop, target in enumerate((-1.0, 4.0)):
                total += 0.99 ** (t - 1) * math.exp(-((beta * (target - batch.x[t, k, loop].item()) / target) ** 2))
        assert found.item() == pytest.approx(total, rel=1e-11)


def test_figures_of_the_mean_response_by_hand(study):
    """Set points -1, 4. Mean of two trajectories: 10 % at sample 1, 90 % at 3, then past -1 by 0.2; at 1 and 5, past 4 by 0.4."""
    c_a = np.array([0.0, -0.15, -0.5, -0.95, -1.2, -0.9, -0.7])
    t = np.array([0.0, 3.0, 3.2, 3.4, 3.4, 4.4, 4.4])
    u = torch.tensor([[[0.0, 5.0], [1.0, 1.0]], [[2.0, 5.0], [1.0, -1.0]], *[[[-1.0, 5.0], [1.0, 1.0]]] * 4], dtype=F64)
    apart = np.array([0.3, -0.3])[:, None] * [1, 0]  # the two trajectories about their mean
    x = torch.tensor(np.stack([c_a, t], axis=-1)[:, None] + apart)
    found = scores(Trajectories(x, x, u, u), study().features, 30.0, ("C_A", "T"), ("C_A0", "T_E"), n_last=2)
    expected = {"overshoot:C_A": 0.2, "overshoot:T": 0.1, "offset:C_A": 0.2, "offset:T": -0.1}
    expected |= {"rise_time:C_A": 2 * 0.04, "rise_time:T": 4 * 0.04, "movement:C_A0": (5 + 0) / 2, "movement:T_E": (0 + 4) / 2}
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-12)
