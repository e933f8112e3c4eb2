"""Checkpoints: a training that was killed goes on to the very same bits; what is not its own state is never taken for it."""

import json
import multiprocessing
import os
import signal
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from helpers.evidence import equal_budget, experiments, limits
from helpers.runs import stages
from helpers.runs.checkpoint import Checkpoints
from helpers.settings.paper import LearnerParams
from tests.runs.test_stages import session


class KilledError(BaseException):
    """Stands for the end of a process: nothing catches it."""


class Dying(Checkpoints):
    """Checkpoints of every epoch, and the end of the process after some of them."""

    lives = -1

    def due(self, finished):
        self.lives -= 1
        if self.lives == 0:
            raise KilledError
        return True


def run(folder, variant="improved", dtype="float64"):
    """A session of a dozen small epochs whose checkpoints lie in `folder`."""
    opened = session(variant=variant)
    few = {"epoch_share": 0.04, "episodes": 20, "measured": 5}
    scale = opened.scale_params.model_copy(update={"number_type": dtype, **few})
    return replace(opened, scale_params=scale, checkpoints=Dying(Path(folder), opened.checkpoints.identity, 0.0))


def offline(opened):
    result = stages.imitate(opened, stages.load_demonstrations(opened), stages.fresh_policy(opened))
    return result.records, result.chosen_epoch, [result.weights, *result.policy.state_dict().values()]


def online(opened):
    policy, _ = stages.load_policy(opened, "offline_improved", "02_offline_irl")
    result = stages.improve(opened, policy, "x")
    return result.records, 0, list(result.policy.state_dict().values())


def frozen(opened):
    weights = torch.linspace(-1.0, 1.0, 6, dtype=opened.dtype)
    return (), 0, list(experiments.learn_under(opened, weights, 8, "frozen").state_dict().values())


def budgeted(opened):
    contest = limits.enter(opened)
    small = contest.scale.model_copy(update={"episodes": 200, "every": 50, "judged": 10})
    contest = replace(contest, params=contest.params.model_copy(update={"scales": {"smoke": small}}))
    result = equal_budget.reinforced(contest, stages.fresh_policy(opened), "scratch", True)
    return result.curve, 0, list(result.build.args[0].state_dict().values())


def assert_equal(found, expected):
    assert found[:2] == expected[:2]
    assert all(left.dtype == right.dtype and torch.equal(left, right) for left, right in zip(found[2], expected[2], strict=True))


# The printed variant has several epochs in an iteration, and stops early; so has a trial with the natural gradient no moments.
LEARNING = [(offline, "improved", dtype) for dtype in ("float32", "float64")]
LEARNING += [(online, "improved", dtype) for dtype in ("float32", "float64")]
LEARNING += [(offline, "natural_gradient", "float32"), (frozen, "improved", "float32"), (budgeted, "improved", "float32")]
LEARNING = [(offline, "printed", "float32"), *(pytest.param(*case, marks=pytest.mark.torture) for case in LEARNING)]


@pytest.mark.parametrize(("learn", "variant", "dtype"), LEARNING)
def test_a_training_killed_again_and_again_ends_at_the_very_same_bits(tmp_path, learn, variant, dtype):
    undisturbed = learn(run(tmp_path / "undisturbed", variant, dtype))
    assert undisturbed[2][0].dtype == getattr(torch, dtype)
    kills = 0
    for lives in (2, 1, 4):
        opened = run(tmp_path / "killed", variant, dtype)
        opened.checkpoints.lives = lives
        try:
            learn(opened)
        except KilledError:
            kills += 1
    assert kills >= 2
    resumed = run(tmp_path / "killed", variant, dtype)
    assert_equal(learn(resumed), undisturbed)
    assert [path.suffix for path in (tmp_path / "killed").iterdir()] == [".safetensors"]


@pytest.mark.skipif(os.name != "posix", reason="a process is forked and killed by signal 9")
def test_a_training_killed_by_the_system_goes_on_to_the_very_same_bits(tmp_path):
    undisturbed = online(run(tmp_path / "undisturbed"))
    child = multiprocessing.get_context("fork").Process(target=_until_killed, args=(tmp_path / "killed",))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert len(list((tmp_path / "killed").glob("*.safetensors"))) == 1
    assert_equal(online(run(tmp_path / "killed")), undisturbed)


def _until_killed(folder):
    opened = run(folder)
    opened.checkpoints.lives = 2
    try:
        online(opened)
    except KilledError:
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_finished_training_is_not_repeated(tmp_path, monkeypatch):
    first = offline(run(tmp_path))
    monkeypatch.setattr("helpers.learning.reinforce.Learner.epoch", lambda *_: pytest.fail("an epoch was run again"))
    assert_equal(offline(run(tmp_path)), first)


def test_another_training_does_not_go_on_from_it(tmp_path):
    for opened, learn in ((run(tmp_path), offline), (run(tmp_path, "printed"), offline), (run(tmp_path), online)):
        learn(opened)
    assert len(list(tmp_path.iterdir())) == 3
    own = stages.memory(*_learner(run(tmp_path)))
    other = stages.memory(*_learner(run(tmp_path)), 1.0)
    own.keep(lambda: {"own": 1})
    assert (own.recall(), other.recall()) == ({"own": 1}, None)
    own.path.rename(other.path)  # even where the names agree
    assert other.recall() is None
    opened = run(tmp_path)
    changed = replace(opened, checkpoints=Dying(tmp_path, "of other code", 0.0))
    assert stages.memory(*_learner(changed)).path != own.path


def _learner(opened):
    params: LearnerParams = opened.variant_params.learner
    policy = stages.fresh_policy(opened)
    return opened, stages.Learner(policy, opened.process, opened.features, params, 4, 3, opened.stream("offline", "test"))


def test_a_state_comes_back_as_it_was(tmp_path):
    checkpoint = Checkpoints(tmp_path, "a", 0.0).of("b")
    state = {"t": torch.tensor([0.1, -0.0, torch.nan]), "f": [0.1, 1e-300, float("inf")], "deep": {"n": [{"i": torch.tensor(3)}]}}
    checkpoint.keep(lambda: state)
    found = checkpoint.recall()
    assert found["t"].numpy().tobytes() == state["t"].numpy().tobytes()
    assert found["f"] == state["f"]
    assert torch.equal(found["deep"]["n"][0]["i"], torch.tensor(3))


@pytest.mark.parametrize(
    "damage", [lambda good: good[:-5], lambda good: good[:20], lambda good: b"", lambda good: b"\x80\x04." * 9]
)
def test_a_damaged_checkpoint_means_a_fresh_start(tmp_path, damage):
    checkpoint = Checkpoints(tmp_path, "a", 0.0).of("b")
    checkpoint.keep(lambda: {"t": torch.ones(3)})
    checkpoint.path.write_bytes(damage(checkpoint.path.read_bytes()))
    assert checkpoint.recall() is None


def test_a_forged_header_is_refused(tmp_path):
    checkpoint = Checkpoints(tmp_path, "a", 0.0).of("b")
    checkpoint.keep(lambda: {"t": torch.ones(3)})
    save_file(load_file(checkpoint.path), checkpoint.path, {"training": checkpoint.training, "state": json.dumps(["tensor:9"])})
    assert checkpoint.recall() is None


def test_nothing_is_kept_before_the_interval_is_over(tmp_path):
    checkpoints = Checkpoints(tmp_path, "a", 1000.0)
    checkpoints.of("b").keep(lambda: pytest.fail("the state was asked for"))
    checkpoints.of("b").keep(lambda: pytest.fail("the state was asked for"), finished=True)
    checkpoints.started -= 1001.0
    checkpoints.of("b").keep(lambda: {"n": 1})
    checkpoints.of("b").keep(lambda: {"n": 2})
    assert checkpoints.of("b").recall() == {"n": 1}
    checkpoints.of("b").keep(lambda: {"n": 3}, finished=True)
    assert checkpoints.of("b").recall() == {"n": 3}
    checkpoints.remove()
    assert list(tmp_path.parent.glob(tmp_path.name)) == []


def test_a_disk_that_takes_no_checkpoint_does_not_end_the_training(tmp_path):
    (tmp_path / "file").write_text("in the way")
    checkpoint = Checkpoints(tmp_path / "file", "a", 0.0).of("b")
    with pytest.warns(UserWarning, match="no checkpoint could be written"):
        checkpoint.keep(lambda: {"n": 1})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert checkpoint.recall() is None
