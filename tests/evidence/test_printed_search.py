"""The search for the printed algorithms' settings: its design, its rungs, what a kill loses; and the weights relearnt."""

import math
from itertools import count

import numpy as np
import pytest
import torch

from helpers.evidence import printed_search, weights_set
from helpers.evidence import search as command
from helpers.evidence.printed_search import Search, design
from helpers.plant.rollout import stream
from helpers.report import search_report
from helpers.runs.artifacts import load_stage
from helpers.settings.paper import load_published
from helpers.settings.search import RangeParams, load_search
from tests.plant.test_rollout import CALM


@pytest.fixture
def search(root, tmp_path):
    return Search(root, "smoke", tmp_path / "kept")


def test_the_design_is_even_within_its_ends_and_never_the_same_twice(root):
    ranges = load_search(root).ranges
    settings = design(ranges, 256)
    assert len({str(setting) for setting in settings}) == 256
    for name in RangeParams.model_fields:
        values, given = [setting[name] for setting in settings], getattr(ranges, name)
        if name in printed_search.CHOICES:
            assert max(map(values.count, given)) - min(map(values.count, given)) <= 2
        else:
            assert given[0] <= min(values) <= max(values) <= given[1]
            assert abs(np.mean(np.log(values) < np.log(given).mean()) - 0.5) < 0.02


def test_a_setting_reaches_learner_and_policy(search):
    setting = search.settings[1] | {"episodes": 7}
    study = search.study(1, 0, setting)
    policy = study.fresh_policy()
    assert policy.params.initial_output_scale == setting["output_scale"]
    learner, _, start, n_iterations = study.apprentice(printed_search.recorded(study), policy)
    assert (learner.n_episodes, n_iterations) == (7, study.params.case.offline.iterations)
    assert learner.params.learning_rate_start == learner.params.learning_rate_end == setting["learning_rate"]
    assert learner.params.patience == setting["patience"]
    assert torch.equal(start.sign(), torch.tensor(setting["initial"], dtype=start.dtype).repeat_interleave(2).sign())
    assert policy.params.std_low <= policy.params.initial_std <= policy.params.std_high == setting["std_high"]


@pytest.fixture
def made(search, monkeypatch):
    """The trials that were made: case, setting, seed, whether from another case. Gaps are made up, and the fourth is killed."""
    found, calls, rates = [], count(1), [setting["learning_rate"] for setting in search.settings]

    def trained(study, policy, start):
        number = rates.index(study.variant_params.learner.learning_rate_start)
        if next(calls) == 4:
            raise KeyboardInterrupt
        found.append((study.case, number, study.seed, start is not None))
        gap = (0.5, 0.3, 0.1, 0.2, math.inf)[number] + (number == 2 and study.seed == 1)  # the best of the first seed was luck
        weights = torch.ones(6, dtype=study.dtype)
        return {"gap": gap, "iterations": 1, "epochs": 1, "seconds": 0.0, "weights": weights, "policy": policy.state_dict()}

    monkeypatch.setattr(printed_search, "trained", trained)
    return found


def test_rungs_keep_the_best_and_a_stopped_search_goes_on(search, made):
    with pytest.raises(KeyboardInterrupt):
        search.run(1, {})
    best, trials = search.run(1, {})
    assert len(made) == len(trials) == len(set(made))  # none is made twice
    assert best == 3
    assert trials.groupby("setting").size().to_dict() == {0: 3, 1: 1, 2: 2, 3: 3, 4: 1}
    made.clear()
    search.run(3, {1: best})
    assert all(started for case, *_, started in made if case == 3)


def test_the_command_writes_every_trial_and_the_weights_and_the_report_draws_them(made, root, tmp_path, monkeypatch):
    monkeypatch.setattr(weights_set, "relearnt", lambda study, weights, *size: 10 * weights)
    with pytest.raises(KeyboardInterrupt):
        command.search("smoke", [1, 2, 3], tmp_path)
    command.search("smoke", [1, 2, 3], tmp_path)
    stage = load_stage(tmp_path / "smoke/search", "the search")
    trials = stage.table("trials.csv")
    best = search_report.best_of(trials)
    assert len(trials) == 3 * 10
    assert {"case", "setting", "seed", "gap", "iterations", "epochs", "seconds", *RangeParams.model_fields} < set(trials)
    assert best[["setting", "median", "by_hand"]].to_numpy().tolist() == [[3, 0.2, 0.5]] * 3
    printed = stage.table("weights.csv").query("kind == 'printed'").filter(like="alpha:").to_numpy()
    published = load_published(root)
    np.testing.assert_allclose(printed[0], published[1].alpha, atol=1e-3)
    told = search_report.tabulate(stage, published).set_index("case")
    assert told[["settings", "trials", "seeds", "by_hand", "best"]].to_numpy().tolist() == [[5, 10, 3, 50, 20]] * 3
    assert told["paper"].tolist() == [100 * published[case].feature_gap for case in (1, 2, 3)]
    figures = search_report.draw(stage, published, trials[["case", *stage.table("weights.csv").filter(like="alpha:")]])
    for figure in figures.values():
        assert len(figure.axes) == 3


def test_relearning_meets_the_closed_loop_of_the_policy_and_climbs(search):
    study, n = search.study(1, 0), 3
    quiet = study.varied(process=CALM, case={"initial_std": (0.0, 0.0)})
    policy = study.fresh_policy()
    stacked = {name: value.expand(n, *value.shape) for name, value in policy.named_parameters()}
    found, expected = weights_set.closed_loops(policy, stacked, quiet, 2, stream(0)), quiet.fresh(policy, 1)
    for name in ("x", "y", "u"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name).expand(-1, 2 * n, -1))
    weights = torch.nn.functional.normalize(torch.randn(n, 6, generator=stream(1), dtype=study.dtype))
    before, after = (weights_set.relearnt(study, weights, steps, 8) for steps in (0, 30))
    assert ((after * weights).sum(1) > (before * weights).sum(1)).all()
