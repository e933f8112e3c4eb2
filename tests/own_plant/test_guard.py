"""The guard: limits, bad measurements, the fall-back PID, and switches without a jump."""

import re

import numpy as np
import pytest

from helpers.own_plant.description import load_description
from helpers.own_plant.guard import Guard, GuardLimits, Mode
from helpers.settings.leaf import InputError
from tests.own_plant.plants import MadeUpPlant

LIMITS = GuardLimits(stale=6, hold=3, healthy=2, fade=2)
SET_POINT = np.array([51.0, 52.0])


class Asking:
    """A policy that asks for one thing and remembers what it was shown, with the notes of its file."""

    def __init__(self, asked=(22.0, 23.0), **notes):
        self.asked, self.seen, self.notes = np.array(asked), [], notes

    def reset(self):
        self.seen.clear()

    def step(self, y, set_point, u_previous):
        self.seen.append(np.concatenate([y, set_point, u_previous]))
        return self.asked[None]


@pytest.fixture
def description(tmp_path):
    return load_description(MadeUpPlant(2, 2, n_cycles=1).write(tmp_path))  # bounds 17..23 and 18..24, at rest 20 and 21


def guarded(description, policy=None, samples=30):
    """A guard after so many samples in automatic; and measurements that never repeat themselves, unless told to."""
    guard, rng = Guard(policy or Asking(), description, LIMITS), np.random.default_rng(0)

    def measured(*changes):
        y = np.array([50.0, 51.0]) + 0.01 * rng.normal(size=2)
        for index, value in changes:
            y[index] = value
        return y

    for _ in range(samples):
        guard.step(measured(), SET_POINT)
    return guard, measured


def test_the_switch_from_manual_does_not_jump_and_the_offset_fades(description):
    guard, measured = guarded(description, samples=0)
    for u in ([18.0, 18.0], [18.0, 19.0], [np.nan, 19.0], [18.0, 19.0]):  # an input that is no number is not followed
        guard.follow(measured(), SET_POINT, np.array(u))
        assert guard.u.tolist() == [18.0, u[1]]
    guard.follow(measured((0, -9999.0)), SET_POINT, guard.u)
    assert guard.mode == Mode.MANUAL
    assert len(guard.policy.seen) == 4  # its memory is warm, and was shown no number out of range
    assert guard.policy.seen[-1][2].tolist() == [18.0, 19.0]
    inputs = np.array([guard.step(measured(), SET_POINT) for _ in range(20)])
    assert inputs[0].tolist() == [18.0, 19.0]
    assert inputs[2] == pytest.approx(np.array([22.0, 23.0]) - 4 * np.exp(-1), abs=1e-9)
    assert inputs[-1] == pytest.approx([22.0, 23.0], abs=1e-3)
    assert guard.mode == Mode.POLICY
    assert np.isfinite(guard.policy.seen).all()


def test_bounds_and_rates_hold_whatever_the_policy_asks(description):
    slow = [variable.model_copy(update={"rate": 0.25}) for variable in description.manipulated]
    description = description.model_copy(update={"manipulated": tuple(slow)})
    guard, measured = guarded(description, Asking([100.0, -100.0]), samples=0)
    inputs = np.array([guard.step(measured(), SET_POINT) for _ in range(60)])
    assert np.abs(np.diff(inputs, axis=0)).max() <= 0.25 + 1e-12
    assert inputs[-1].tolist() == [23.0, 18.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 120.0, -1.0], ids=str)
def test_a_bad_measurement_is_held_then_the_pid_takes_the_loops_that_are_left(description, bad):
    guard, measured = guarded(description)
    before = guard.u.copy()
    for _ in range(LIMITS.hold):
        assert guard.step(measured((0, bad)), SET_POINT).tolist() == before.tolist()
        assert guard.mode == Mode.HOLD
    taken_over = guard.step(measured((0, bad)), SET_POINT)
    assert guard.mode == Mode.PID
    assert taken_over == pytest.approx(before)  # bumpless
    for _ in range(10):
        inputs = guard.step(measured((0, bad)), SET_POINT)
    assert inputs[0] == before[0]  # its loop is blind
    assert inputs[1] > before[1] + 0.05  # the error is about one, and the integral gain 0.2 per second
    assert len(guard.policy.seen) == 30  # the policy's memory stands still


GOOD, BAD, STUCK = (), ((0, np.nan),), ((0, 50.5),)


@pytest.mark.parametrize(
    ("samples", "modes"),
    [
        pytest.param([BAD, GOOD, GOOD, GOOD], "hhpp", id="a short fault never reaches the PID"),
        pytest.param([BAD] * 8 + [GOOD] * 2, "hhhPPPPPPp", id="the policy comes back after enough good measurements"),
        pytest.param([STUCK] * 10, "pppppphhhP", id="a sensor that does not move is stale"),
        pytest.param([BAD, GOOD] * 6 + [GOOD, GOOD, BAD], "hhhhhhPPPPPPpph", id="one that comes and goes reaches the PID"),
        pytest.param([BAD] * 3 + ["manual", BAD], "hhhmh", id="after a phase in manual the count begins anew"),
    ],
)
def test_who_sets_the_inputs_and_the_policy_comes_back_without_a_jump(description, samples, modes):
    guard, measured = guarded(description)
    for changes, mode in zip(samples, modes, strict=True):
        before = guard.u.copy()
        if changes == "manual":
            guard.follow(measured(), SET_POINT, guard.u)
        else:
            guard.step(measured(*changes), SET_POINT)
        assert guard.mode != Mode.POLICY or np.abs(guard.u - before).max() < 0.5
        assert guard.mode == {"m": Mode.MANUAL, "p": Mode.POLICY, "h": Mode.HOLD, "P": Mode.PID}[mode]


@pytest.mark.parametrize("proportional", [None, np.nan], ids=["no PID", "a PID that fails"])
def test_without_a_sound_pid_the_inputs_stay_held(description, proportional):
    loops = [loop.model_copy(update={"proportional": proportional}) for loop in description.pid if proportional]
    guard, measured = guarded(description.model_copy(update={"pid": tuple(loops)}))
    before = guard.u.copy()
    for _ in range(20):
        inputs = guard.step(measured((0, np.nan)), SET_POINT)
    assert guard.mode == Mode.PID
    assert inputs == pytest.approx(before)


def test_a_set_point_that_is_no_number_is_bad_and_the_last_one_counts_on(description):
    guard, measured = guarded(description)
    inputs, modes = [], []
    for _ in range(LIMITS.hold + 3):
        inputs.append(guard.step(measured(), np.array([np.nan, 52.0])))
        modes.append(guard.mode)
    assert modes == [Mode.HOLD] * LIMITS.hold + [Mode.PID] * 3
    assert len(guard.policy.seen) == 30
    assert inputs[-1][0] > inputs[0][0]  # its loop goes on towards the last set point, which lies above
    inputs += [guard.step(measured(), SET_POINT) for _ in range(20)]
    assert guard.mode == Mode.POLICY
    assert np.isfinite(guard.policy.seen).all()
    assert ((guard.low <= inputs) & (inputs <= guard.high)).all()


def test_without_any_set_point_the_inputs_stay_held(description):
    guard, measured = guarded(description, samples=0)
    inputs = [guard.step(measured(), np.full(2, np.nan)) for _ in range(LIMITS.hold + 5)]
    assert guard.mode == Mode.PID
    assert np.array(inputs) == pytest.approx(np.tile([20.0, 21.0], (len(inputs), 1)))


def first(**changes):
    """The first manipulated variable changed."""
    return lambda d: {"manipulated": (d.manipulated[0].model_copy(update=changes), d.manipulated[1])}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: {"title": "another"}, "made for another description: 'title' is made up in the policy and another in the"),
        (lambda d: {"time_unit": "min"}, "'sampling_time' in s is 2.0 in the policy and 120.0"),
        (lambda d: {"controlled": d.controlled[:1]}, "the number of 'controlled' variables is 2 in the policy and 1"),
        (lambda d: {"controlled": d.controlled[::-1]}, "'name' of 'y1' is y0 in the policy and y1"),
        (first(tag="U9.OP"), "'tag' of 'u0' is U0.OP in the policy and U9.OP in the description"),
        (first(high=30.0), "'high' of 'u0' is 23.0 in the policy and 30.0 in the description"),
        (lambda d: {"pid": (d.pid[0], d.pid[0])}, "two loops set the same manipulated variable"),
    ],
)
def test_a_policy_under_a_description_that_is_not_its_own_is_refused(description, change, says):
    keys = {"name", "tag", "unit", "low", "high", "steady_state"}
    notes = {k: [v.model_dump(include=keys) for v in getattr(description, k)] for k in ("controlled", "manipulated")}
    policy = Asking(title=description.title, sampling_time=[description.sampling_time, description.time_unit], **notes)
    Guard(policy, description.model_copy(update={"time_unit": "min", "sampling_time": 2 / 60}))  # the same time
    with pytest.raises(InputError, match=re.escape(says)):
        Guard(policy, description.model_copy(update=change(description)))


@pytest.mark.parametrize("failure", ["raises", "returns another shape", "returns no number"])
def test_a_policy_that_cannot_run_falls_back_like_a_bad_measurement(description, failure):
    guard, measured = guarded(description)

    def broken(y, set_point, u_previous):
        if failure == "raises":
            raise RuntimeError("onnxruntime")
        return np.zeros((1, 7)) if failure == "returns another shape" else np.array([[np.nan, 23.0]])

    sound, guard.policy.step = guard.policy.step, broken
    modes = [(guard.step(measured(), SET_POINT), guard.mode)[1] for _ in range(LIMITS.hold + 1)]
    assert modes == [Mode.HOLD] * LIMITS.hold + [Mode.PID]
    assert np.isfinite(guard.u).all()
    guard.follow(measured(), SET_POINT, guard.u)
    guard.policy.step = sound
    guard.step(measured(), SET_POINT)
    assert guard.mode == Mode.POLICY


def test_a_set_point_outside_the_range_of_the_policy_is_the_pid_s_until_it_is_back(description):
    policy = Asking(set_point_range=[[49.0, 51.0], [50.0, 52.0]])
    guard, measured = guarded(description, policy)  # at the edge, which is inside
    assert guard.mode == Mode.POLICY
    before, outside = guard.u.copy(), np.array([51.5, 52.0])
    inputs = [guard.step(measured(), outside) for _ in range(3)]
    assert inputs[0] == pytest.approx(before)
    assert inputs[2][0] > inputs[1][0] > inputs[0][0]  # towards the set point that was given
    assert guard.mode == Mode.PID
    guard.follow(measured(), outside, guard.u)
    for faults in ((), ((1, np.nan),), (), ()):  # a bad measurement changes nothing there
        last = guard.step(measured(*faults), outside)
        assert guard.mode == Mode.PID
    assert len(policy.seen) == 30
    assert guard.step(measured(), SET_POINT) == pytest.approx(last)
    assert guard.mode == Mode.POLICY
    assert len(policy.seen) == 31
