"""Trials of offline learning: what trials.yaml makes of a variant, what it must not touch, and its refusals."""

from typing import get_args

import pytest
import torch

from helpers.runs.opening import parameters_hash
from helpers.settings.leaf import read_yaml
from helpers.settings.paper import TrialParams, load, load_trials
from tests.runs.test_study import session
from tests.settings.test_params import DELETE, edit, folder, leaf, refusal  # noqa: F401  (a fixture)

TRIALS = "trials.yaml"
MANY = leaf(41, "per pass")
OF_A_TRIAL = [("base", "best", "improved, printed"), ("base", "whole_return", "improved, printed"), ("base", DELETE, "missing")]
OF_A_TRIAL += [("title", "", "1 character"), ("family", "luck", "step size"), ("policy", {}, "unknown")]
OF_A_TRIAL += [("learner", 3, "keys and values"), ("learner.learning_rate_end", 0.1, "value, unit, source, status")]
OF_A_TRIAL += [
    ("learner.learning_rate_end", leaf(2.0), "less than or equal to 1"),
    ("learner.learning_rate_end", leaf(0.1, "s"), "unit"),
]
OF_A_TRIAL += [("learner.rate", leaf(0.1), "unknown"), ("learner.minibatches", MANY, "40 episodes")]
OF_A_TRIAL += [("learner.entropy", leaf(-0.1), "greater than or equal to 0")]
REFUSED = [
    *(({f"constant_step.{key}": value}, f"constant_step.{key}", says) for key, value, says in OF_A_TRIAL),
    ({"constant_step.learner": DELETE}, "constant_step", "changes nothing"),
    ({"improved": {"base": "printed", "title": "a", "family": "credit", "weights": {"step": leaf(0.1)}}}, "improved", "other than"),
    ({"variants": {"best": {"weights": {}}}}, "variants.best", "improved, printed"),
    ({"variants": {"printed": 3}}, "variants.printed", "keys and values"),
    ({"variants": {"printed": {"weights": {"pace": leaf(0.1)}}}}, "variants.printed.weights.pace", "unknown"),
    ({"variants": {"printed": {"learner": {"minibatches": MANY}}}}, "variants.printed.learner.minibatches", "40 episodes"),
]


def test_every_family_has_a_trial_and_every_trial_a_title_of_its_own(root):
    trials = load_trials(root).values()
    assert {trial.family for trial in trials} == set(get_args(TrialParams.model_fields["family"].annotation))
    assert len({trial.title for trial in trials}) == len(trials)
    assert max(len(trial.title) for trial in trials) <= 70
    assert {trial.base for trial in trials} == {"improved"}


def test_a_trial_is_its_base_but_for_the_leaves_that_the_file_names(root):
    variants = load(root, 1).learning.variants
    for name, entry in read_yaml(root / TRIALS).items():
        found, base = variants[name].model_dump(), variants["improved"].model_dump()
        for part in ("learner", "weights"):
            given = {key: leaf["value"] for key, leaf in entry.get(part, {}).items()}
            assert {key: value for key, value in found[part].items() if value != base[part][key]} == given, name


def test_trials_leave_the_variants_the_leaves_and_their_hash_alone_which_changes_with_values_only(folder, root):  # noqa: F811
    edit(folder / TRIALS, {"undamped_weights.weights.decay.value": 0.2})
    before, after = load(root, 1), load(folder, 1)
    assert after.leaves == before.leaves
    assert not [row for row in after.leaves if row["file"] == TRIALS]
    assert after.learning.variants["undamped_weights"].weights.decay == 0.2
    (folder / TRIALS).write_text("{}\n")
    assert load(folder, 1).learning.variants == {name: before.learning.variants[name] for name in ("improved", "printed")}
    hashes = []
    for part, value in (("source", "a book"), ("source", "thought about"), ("value", 0.02)):
        edit(folder / "learning.yaml", {f"policy.leaky_slope.{part}": value})
        hashes.append(parameters_hash(load(folder, 1)))
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_case_may_change_a_variant_and_no_other_case_sees_it(folder, root):  # noqa: F811
    changes = {"weights": {"step": leaf(0.2)}, "episodes": leaf(30, "episodes")}
    edit(folder / "case_2.yaml", {"variants": {"improved": changes}})
    before, own, other = load(root, 2).learning, load(folder, 2).learning, load(folder, 1).learning
    improved = before.variants["improved"]
    expected = improved.model_copy(update={"episodes": 30, "weights": improved.weights.model_copy(update={"step": 0.2})})
    assert own.variants["improved"] == expected
    assert other.variants["improved"] == improved
    assert own.variants["constant_step"] == before.variants["constant_step"]  # a trial changes the variant of learning.yaml


@pytest.mark.parametrize(("changes", "key", "says"), REFUSED, ids=[f"{key} {says}" for _, key, says in REFUSED])
def test_a_wrong_trial_or_variant_of_a_case_is_named(folder, changes, key, says):  # noqa: F811
    file = "case_2.yaml" if "variants" in changes else TRIALS
    edit(folder / file, changes)
    sentence = refusal(folder, case=2)
    assert all(part in sentence for part in (file, f"'{key}'", says)), sentence


def test_a_trial_meets_the_random_numbers_of_its_base():
    """So where only what is kept in the end was changed, learning itself is the same."""
    runs = session(), session(variant="unaveraged_policy")
    base, trial = (run.imitate(run.load_demonstrations(), run.fresh_policy()) for run in runs)
    assert trial.records == base.records
    kept = zip(trial.policy.parameters(), base.policy.parameters(), strict=True)
    assert not all(torch.equal(mine, its) for mine, its in kept)
