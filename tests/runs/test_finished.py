"""Finished trainings: a run that was killed does not repeat them; what is not a training's own is never taken for it."""

import multiprocessing
import os
import signal
from dataclasses import replace

import pytest
import torch

from helpers.evidence import equal_budget, experiments, limits
from helpers.learning.learner import Learner
from helpers.runs.finished import Finished
from tests.runs.test_study import session


def run(folder, variant="improved", dtype="float64"):
    """A session of a dozen small epochs whose finished trainings lie in `folder`."""
    opened = session(variant=variant)
    few = {"epoch_share": 0.04, "episodes": 20, "measured": 5}
    scale = opened.scale_params.model_copy(update={"number_type": dtype, **few})
    return replace(opened, scale_params=scale, output_root=folder)


def n_kept(folder):
    return len(list(folder.rglob("*.pt")))


def offline(opened):
    result = opened.imitate(opened.load_demonstrations(), opened.fresh_policy())
    return result.records, result.chosen_epoch, [result.weights, *result.policy.state_dict().values()]


def online(opened):
    policy, _ = opened.load_policy("offline_improved", "02_offline_irl")
    result = opened.improve(policy, "x")
    return result.records, 0, list(result.policy.state_dict().values())


def frozen(opened):
    weights = torch.linspace(-1.0, 1.0, 6, dtype=opened.dtype)
    return (), 0, list(experiments.learn_under(opened, weights, 8, "frozen").state_dict().values())


def budgeted(opened):
    contest = limits.enter(opened)
    small = contest.scale.model_copy(update={"episodes": 200, "every": 50, "judged": 10})
    contest = replace(contest, limits=contest.limits.model_copy(update={"scales": {"smoke": small}}))
    result = equal_budget.reinforced(contest, opened.fresh_policy(), "scratch", True)
    return result.curve, 0, list(result.build.keywords["policy"].state_dict().values())


def assert_equal(found, expected):
    assert found[:2] == expected[:2]
    assert all(left.dtype == right.dtype and torch.equal(left, right) for left, right in zip(found[2], expected[2], strict=True))


SLOW = [pytest.param(learn, "improved", "float32", marks=pytest.mark.torture) for learn in (online, frozen, budgeted)]


@pytest.mark.parametrize(("learn", "variant", "dtype"), [(offline, "improved", "float32"), (offline, "printed", "float64"), *SLOW])
def test_a_finished_training_is_not_repeated_and_comes_back_to_the_last_bit(tmp_path, monkeypatch, learn, variant, dtype):
    first = learn(run(tmp_path, variant, dtype))
    assert (first[2][0].dtype, n_kept(tmp_path)) == (getattr(torch, dtype), 1)
    monkeypatch.setattr(Learner, "realise", lambda _: pytest.fail("an epoch was run again"))
    assert_equal(learn(run(tmp_path, variant, dtype)), first)


@pytest.mark.skipif(os.name != "posix", reason="a process is forked and killed by signal 9")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_run_killed_in_its_second_training_repeats_that_one_alone(tmp_path, monkeypatch):
    """And ends at the very same bits as one that nobody disturbed."""
    undisturbed = [learn(run(tmp_path / "undisturbed")) for learn in (online, frozen)]
    child = multiprocessing.get_context("fork").Process(target=_killed_in_the_second, args=(tmp_path / "killed",))
    child.start()
    child.join()
    assert (child.exitcode, n_kept(tmp_path / "killed")) == (-signal.SIGKILL, 1)
    epochs, realise = [], Learner.realise
    monkeypatch.setattr(Learner, "realise", lambda learner: epochs.append(learner.epochs) or realise(learner))
    for learn, expected in zip((online, frozen), undisturbed, strict=True):
        assert_equal(learn(run(tmp_path / "killed")), expected)
    assert epochs == list(range(8))  # of the second alone


def _killed_in_the_second(folder):
    online(run(folder))
    realise = Learner.realise
    Learner.realise = lambda learner: realise(learner) if learner.epochs < 3 else os.kill(os.getpid(), signal.SIGKILL)
    frozen(run(folder))


def test_another_training_and_another_run_train_anew(tmp_path):
    for opened, learn in ((run(tmp_path), offline), (run(tmp_path, "printed"), offline), (run(tmp_path), online)):
        learn(opened)
    assert n_kept(tmp_path) == 3
    kept, calls = Finished(tmp_path / "own", "a"), []

    def train():
        calls.append(len(calls))
        return {"number": calls[-1]}

    start = torch.ones(3), {"a": 1}
    assert [kept.once(train, *start)["number"] for _ in range(2)] == [0, 0]
    assert kept.once(train, *start, "more")["number"] == 1
    assert Finished(kept.folder, "of other code").once(train, *start)["number"] == 2
    first, other, _ = sorted(kept.folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)
    first.replace(other)  # even where the names agree
    assert kept.once(train, *start, "more")["number"] == 3
    kept.remove()
    assert not kept.folder.exists()


def test_a_state_comes_back_as_it_was(tmp_path):
    state = {"t": torch.tensor([0.1, -0.0, torch.nan]), "f": [0.1, 1e-300, float("inf")], "deep": {"n": [{"i": torch.tensor(3)}]}}
    for train in (lambda: state, lambda: pytest.fail("it was asked for again")):
        found = Finished(tmp_path, "a").once(train, "b")
        assert found["t"].numpy().tobytes() == state["t"].numpy().tobytes()
        assert found["f"] == state["f"]
        assert torch.equal(found["deep"]["n"][0]["i"], torch.tensor(3))


class Forged:
    """What a pickle would make when it is read."""

    def __reduce__(self):
        return pytest.fail, ("code of the file was executed",)


@pytest.mark.parametrize("damage", ["cut", "header", "empty", "pickle", "forged"])
def test_a_damaged_file_means_a_fresh_start_and_a_forged_one_executes_nothing(tmp_path, damage):
    finished = Finished(tmp_path, "a")
    finished.once(lambda: {"t": torch.ones(3)}, "b")
    (path,) = tmp_path.iterdir()
    good = path.read_bytes()
    if damage == "forged":  # it names the right training, and holds code
        torch.save({"training": torch.load(path)["training"], "state": {"t": Forged()}}, path)
    else:
        path.write_bytes({"cut": good[:-5], "header": good[:20], "empty": b"", "pickle": b"\x80\x04." * 9}[damage])
    assert finished.once(lambda: {"fresh": 1}, "b") == {"fresh": 1}


def test_a_disk_that_takes_nothing_does_not_end_the_run(tmp_path):
    (tmp_path / "file").write_text("in the way")
    for number in (1, 2):
        with pytest.warns(UserWarning, match="a finished training could not be kept"):
            assert Finished(tmp_path / "file", "a").once(lambda number=number: {"n": number}, "b") == {"n": number}
