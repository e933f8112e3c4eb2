"""Other features, demonstrators and cloning: their pieces by hand, and that the claims find every number they ask for."""

import pytest
import torch

from helpers.evidence import alternatives, experiments
from helpers.evidence.alternatives import SomeFeatures, conditions, first, miss_by_hand
from helpers.plant.controllers import Operator
from helpers.plant.task import Trajectories
from helpers.report.claims import load_claims
from helpers.runs.study import score_table


@pytest.mark.parametrize("case", [*(pytest.param(case, marks=pytest.mark.torture) for case in (1, 2)), 3])
def test_every_number_that_the_claims_ask_for_is_there(prepared, root, case):
    run = prepared(case)
    verbs = [getattr(experiments, name) for name in ("responses", "readings", "transfer", "frozen_weights", "gradient_spread")]
    verbs += [alternatives.feature_sets, alternatives.demonstrators, alternatives.robustness]
    scores = experiments.online_starts(run)[0]
    for verb in verbs:
        found = verb(run)
        assert not found.keys() & scores.keys(), verb.__name__
        scores |= found
    table = score_table(scores)
    known = set("experiments/" + table["stage"] + "/" + table["metric"])
    for name, claim in load_claims(root).items():
        if case in claim.cases:
            for quantity in claim.quantities.values():
                wanted = {reference for reference in (quantity.value, quantity.against) if reference}
                assert {reference for reference in wanted if reference.startswith("experiments/")} <= known, name


def test_some_features_and_the_first_demonstrations_are_the_same(prepared):
    run = prepared()
    features, batch = run.session.features, run.demonstrations.trajectories
    some = SomeFeatures(**vars(features), kept=(0, 3))
    assert torch.equal(some.state(batch), features.state(batch)[..., [0, 3]])
    torch.testing.assert_close(some.trajectory(batch), features.trajectory(batch)[:, [0, 3]], rtol=1e-12, atol=1e-12)
    found = first(run.demonstrations, 3).trajectories
    assert torch.equal(found.u, batch.u[:, :3])
    assert torch.equal(found.y, batch.y[:, :3])


def test_conditions(prepared):
    run = prepared()
    found = conditions(run)
    nominal, initial, target, disturbance = (found[name] for name in ("nominal", "initial_state", "set_point", "disturbance"))
    assert nominal is run.session
    assert initial.task.initial_mean.tolist() == [0.5, 1.5]  # two standard deviations
    assert target.task.set_point.tolist() == [-0.75, 5.0]
    assert target.expert.set_point.tolist() == [-0.75, 5.0]  # the PID is told of it, as the policies are
    assert target.task.error_scale.tolist() == [-0.75, 5.0]
    assert disturbance.process.disturbance_gain.tolist() == [1.0, 0.6]
    assert nominal.task.set_point.tolist() == [-1.0, 4.0]  # as it was
    assert torch.equal(*(torch.rand(3, generator=study.stream("a")) for study in (nominal, target)))


def test_the_miss_is_measured_where_hand_control_begins(prepared):
    session = prepared().session
    operator = Operator(session.expert, session.task, 0.25, torch.tensor([torch.nan, -30.0], dtype=torch.float64))
    temperature = torch.tensor([0.0, 5.2, 5.2, 4.0, 5.2, 5.2], dtype=torch.float64)  # by hand: samples 1, 2 and 4; 1 and 4 begin
    y = torch.stack([torch.zeros(6, dtype=torch.float64), temperature], -1)[:, None]
    u = torch.tensor([[0.0, 60.0], [0, -30], [0, 99], [0, 60], [0, -30]], dtype=torch.float64)[:, None]
    batch = Trajectories(y, y, u, u)
    for asked, miss in ((-30.0, 0.0), (-18.0, 12 / 120)):
        constant = torch.tensor([5.0, asked], dtype=torch.float64)
        assert miss_by_hand(batch, operator, lambda y, u, task, constant=constant: (constant.expand_as(u), None)) == pytest.approx(
            miss
        )
