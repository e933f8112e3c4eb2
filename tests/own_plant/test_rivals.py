"""What a practitioner would take: the PID of a record is found, re-tuned, and beside it predictive control without offset."""

import numpy as np
import pytest
import torch

from helpers.learning.tracking_policy import Gains, TrackingPID
from helpers.own_plant.gate import POLICY, RECORD, TUNED, judge
from helpers.own_plant.identify import Equation, Margins, Structure, apart, assemble
from helpers.own_plant.operation import Operation, draw_scenarios
from helpers.own_plant.rivals import PredictiveControl, simc, step_response, tuned_pid, tuned_predictive
from helpers.own_plant.settings import load_own_plant
from helpers.plant.tracking import Bounds, track

HEATER = Equation(Structure(1, (2,)), np.array([0.92, 0.064, 0.0, -0.8]), np.array([0.05, 0.0]))  # gain 0.8, time 12, dead time 2


def models(n_models=16, gain=0.2):
    factors = np.linspace(1 - gain, 1 + gain, n_models)
    return assemble([[apart(HEATER, Margins(np.array([factor]), 1.0, (0,)))] for factor in factors], (np.ones(1), np.ones(1)))


@pytest.fixture
def operation():
    bounds = Bounds(torch.tensor([-40.0]), torch.tensor([60.0]), torch.full((1,), torch.inf))
    one = torch.ones(1)
    return Operation((0,), -10 * one, 10 * one, 10 * one, bounds)


@pytest.fixture(scope="module")
def params(root):
    quick = {"generations": 4, "penalties": (1.0, 10.0, 100.0), "observer": (0.8,)}
    given = load_own_plant(root)
    return given.model_copy(update={"rivals": given.rivals.model_copy(update=quick)})


def scenarios(operation, params, quiet=False, **changes):
    drawn = models(**changes).to(torch.float32)
    return draw_scenarios(drawn, operation, params.operation, 150, torch.Generator().manual_seed(0), quiet)


def pid(proportional, integral):
    return Gains(torch.tensor([[proportional]]), torch.tensor([[integral]]), torch.zeros(1, 1))


def test_scenarios_start_at_rest_and_can_be_held(operation, params):
    drawn = scenarios(operation, params, quiet=True)
    still = track(TrackingPID(pid(0.0, 0.0), operation.bounds), drawn, operation.bounds)
    assert still.y[20].numpy() == pytest.approx(still.y[0].numpy(), abs=1e-4)
    assert (still.y[-1] - still.y[0]).abs().max() > 1  # the load
    assert (drawn.set_point.abs() <= 10).all()
    assert (drawn.load.abs() <= params.operation.load * 100).all()
    assert drawn.load[0].eq(0).all()
    assert drawn.load[-1].ne(0).any()


def test_the_simc_rule_is_that_of_the_literature():
    response = step_response(models(1, 0.0), 300)[0, :, 0]
    gain, integral = simc(response)
    time, dead = -1 / np.log(0.92), 2.0
    assert gain == pytest.approx(time / (0.8 * 2 * dead), rel=0.15)
    assert integral == pytest.approx(gain / min(time, 8 * dead), rel=0.1)
    ramp = np.concatenate([np.zeros(3), 0.05 * np.arange(1, 200)])
    gain, integral = simc(ramp)
    assert gain == pytest.approx(1 / (0.05 * 2 * 2), rel=0.3)
    assert integral == pytest.approx(gain / 16, rel=0.3)


def test_the_re_tuned_pid_is_better_than_the_record_s_on_all_models(operation, params):
    drawn, record = scenarios(operation, params), pid(0.5, 0.05)
    tuned = tuned_pid(models(1, 0.0), drawn, record, operation, lambda error, movement: error.mean(-1), params.rivals, seed=0)
    errors = [
        operation.error(track(TrackingPID(gains, operation.bounds), drawn, operation.bounds)).mean() for gains in (record, tuned)
    ]
    assert errors[1] < 0.8 * errors[0]
    assert (tuned.integral > 0).all()


def test_predictive_control_leaves_no_offset_where_its_model_is_wrong(operation, params):
    noisy, quiet = (scenarios(operation, params, still, gain=0.4) for still in (False, True))
    control = tuned_predictive(models(1, 0.0), noisy, operation, lambda error, movement: error.mean(-1), params.rivals)
    assert isinstance(control, PredictiveControl)
    run = track(control, quiet, operation.bounds)
    assert run.error[-1].abs().max() < 0.05
    assert operation.error(track(control, noisy, operation.bounds)).mean() < 0.05 + 0.2


@pytest.fixture
def verdict(operation, params):
    """Whether a PID of these gains may take the place of the record's, on models as drawn and others at the ends of the margins."""

    def judged(gains, others=None, allowed=10.0, corner_episodes=8, ends=None, **changes):
        noisy, quiet = (scenarios(operation, params, still, **changes) for still in (False, True))
        corners = scenarios(operation, params, **changes | ends) if ends else noisy
        controllers = {RECORD: pid(0.5, 0.05), **(others or {}), POLICY: gains}
        trackers = {name: TrackingPID(each, operation.bounds) for name, each in controllers.items()}
        settings = params.gate.model_copy(update={"episodes": 1, "corner_episodes": corner_episodes})
        return judge(trackers, (noisy, quiet, corners), operation, allowed, settings)

    return judged


def test_the_gate_releases_what_is_better_and_nothing_else(verdict):
    good = pid(1.5, 0.12)
    better = verdict(good)
    assert better.released
    assert better.keep == POLICY
    assert better.words.startswith("verdict: release the policy: on models held out its mean |e| is ")
    assert len(better.models) == 32
    as_good = verdict(good, {TUNED: good})
    assert as_good.released
    assert as_good.keep == TUNED
    assert f"but {TUNED} is as good and simpler" in as_good.words


def test_the_gate_says_why_it_keeps_the_pid(verdict):
    moving, worse, drifting = verdict(pid(1.5, 0.12), allowed=0.5), verdict(pid(0.2, 0.02)), verdict(pid(3.0, 0.0))
    assert not moving.released
    assert "times as much" in moving.words
    assert worse.words.startswith("verdict: keep the PID: the policy is not released: it is better on only ")
    assert "it leaves an offset of" in drifting.words


def test_a_controller_that_fails_at_an_end_of_the_margins_is_not_released(verdict):
    """A gain that suits the model, and not one of almost twice its gain; what counts is the mean of an end's episodes."""
    hot, given = pid(6.0, 0.3), {"allowed": 100.0, "n_models": 32, "gain": 0.0}
    assert verdict(hot, **given).released
    at_ends = [verdict(hot, corner_episodes=each, ends={"gain": 0.9}, **given) for each in (2, 8, 32)]
    assert not at_ends[1].released
    assert "at an end of the margins its mean |e| is" in at_ends[1].words
    worst = [found.table.loc[POLICY, "worst corner"] for found in at_ends]
    assert worst[0] > worst[1] > worst[2]
