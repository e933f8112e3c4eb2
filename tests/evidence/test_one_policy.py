"""The verbs of notebook 09: what episodes are drawn, what they cost, and how policies are judged."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.evidence import one_policy
from helpers.learning.features import discounts, tracking_reward
from helpers.learning.tracking_policy import TrackingPID
from helpers.plant.rollout import stream
from helpers.plant.tracking import track

MARGIN, LOAD = 0.4, 0.05


@pytest.fixture(scope="module")
def ground(opened):
    return one_policy.enter(opened("09_one_policy"))


def test_the_range_of_set_points_holds_every_case_and_the_grid(ground):
    assert len(ground.grid()) == 3 * 16
    np.testing.assert_allclose(ground.set_points.amin(0), [-2.5 * 1.25, 3 * 0.5])
    np.testing.assert_allclose(ground.set_points.amax(0), [1.25, 4 * 1.25])
    drawn = ground.draw(2000, stream(0, "episodes"))
    assert ((ground.set_points.amin(0) <= drawn.set_point) & (drawn.set_point <= ground.set_points.amax(0))).all()
    above = (drawn.set_point[0, :, 0] > 0.5).double().mean().item()  # Case II, and what lies anywhere
    assert abs(above - (0.5 / 3 + 0.5 * 0.75 / 4.375)) < 0.05
    assert drawn.process is ground.session.process
    assert not drawn.load.any()
    assert torch.equal(drawn.set_point[0], drawn.set_point[-1])


def test_models_and_loads_are_drawn_within_their_margins(ground):
    drawn, nominal = ground.draw(2000, stream(0, "episodes"), MARGIN, LOAD), ground.session.process
    for name in ("drift_state", "drift_input"):
        ratio = getattr(drawn.process, name)[:, 0, 0] / getattr(nominal, name)[0, 0]
        assert 1 - MARGIN <= ratio.min() < 1 - 0.9 * MARGIN
        assert 1 + 0.9 * MARGIN < ratio.max() <= 1 + MARGIN
    begins = (drawn.load != 0).any(-1).sum(0)  # samples with a load
    assert abs((begins == 0).double().mean().item() - 0.5) < 0.05
    assert (drawn.load.diff(dim=0).abs().sum(-1) > 0).sum(0).max() == 1  # one step
    std = drawn.load[-1][begins > 0].std(0) / ground.bounds.span
    np.testing.assert_allclose(std, LOAD, rtol=0.1)


@pytest.mark.equation("5.1.2.1")
def test_the_cost_has_the_mean_of_the_objective(ground):
    """Over 40,000 episodes; and it varies less."""
    n = 40_000
    drawn = ground.draw(n, stream(1, "episodes"))
    case = ground.cases[1]
    drawn = replace(drawn, set_point=case.task.set_point.expand_as(drawn.set_point))
    run = track(TrackingPID(ground.record, ground.bounds), drawn, ground.bounds)
    reward = tracking_reward((case.task.set_point - run.x[1:]) / case.task.error_scale, ground.beta)
    weights = discounts(len(reward), 0.99, reward)
    sampled, expected = 1 - weights @ reward / (2 * weights.sum()), ground.lost(drawn, run, ground.beta)
    error = (sampled - expected).std().item() / n**0.5
    assert abs((sampled - expected).mean().item()) < 5 * error
    assert expected.std() < 0.7 * sampled.std()


def test_near_rest_the_error_has_the_scale_of_the_smallest_set_point(ground):
    scale = ground.error_scale(torch.tensor([[-0.1, 4.0], [0.1, 4.0], [-2.0, 1.0]], dtype=ground.session.dtype))
    np.testing.assert_allclose(scale, [[-0.5, 4.0], [0.5, 4.0], [-2.0, 1.5]])


def test_which_set_points_can_be_held(ground):
    """In Case III the nominal input at rest is -17.3 of -20; with A x 1.3 and B x 0.7 it would be -32."""
    study = ground.cases[3]
    assert one_policy.holdable(study)
    assert not one_policy.holdable(one_policy.mismatched(study, 1.3, 0.7))


def test_a_fresh_policy_is_judged_as_a_pid_and_minimum_variance_is_the_measure(ground):
    table = one_policy.judged(ground, {"fresh": ground.policy(ground.record)})
    assert len(table) == 3 * (3 + 48 + 12)
    rows = table.set_index("controller")
    assert (rows.loc["minimum_variance", "share"] == 1).all()
    assert (rows.loc["expert", "movement"] == 1).all()
    summary = one_policy.goals(table, ["fresh", "expert"])
    assert summary.loc[("fresh", 1), "corners held"] == 4
    assert summary.loc[("fresh", 3), "corners held"] < 4
    assert (summary["set points, least"] <= summary["set points, mean"]).all()


def test_a_training_is_made_once_and_improves(ground):
    first, records = one_policy.learn(ground, "test")
    again, same = one_policy.learn(ground, "test")
    assert records.equals(same)
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in first.state_dict().items())
    start = ground.policy(ground.record).state_dict()
    assert not torch.equal(first.state_dict()["output.weight"], start["output.weight"])
    drawn = ground.draw(200, stream(2, "episodes"))
    with torch.no_grad():
        costs = [
            ground.lost(drawn, track(policy, drawn, ground.bounds), ground.beta).mean()
            for policy in (first, ground.policy(ground.record))
        ]
    assert costs[0] < costs[1]
