"""The policy for many set points: the PID inside, no offset, no windup."""

from dataclasses import replace

import pytest
import torch

from helpers.learning.tracking_policy import Gains, TrackingPID, TrackingPolicy
from helpers.plant.controllers import PID
from helpers.plant.rollout import rollout, stream
from helpers.plant.tracking import AtSetPoint, Bounds, Scenarios, track
from helpers.settings.paper import GainParams
from tests.plant.test_rollout import CALM

PARTS = ([20.0, 25.0], [1.0, 6.0], [0.0, 0.5])


@pytest.fixture
def case(study):
    return study(process=CALM)


def gains(parts=PARTS):
    return Gains(*(torch.tensor(values, dtype=torch.float64).diag() for values in parts))


def bounds(case):
    return Bounds(case.task.input_low, case.task.input_high, torch.full_like(case.task.input_low, torch.inf))


def tracking_pid(case, parts=PARTS):
    return TrackingPID(gains(parts), bounds(case))


def fresh(case, seed=None, kept=None, parts=PARTS):
    """A policy whose output layer is zero, or random with a seed; `kept`: of the patient form."""
    torch.manual_seed(0 if seed is None else seed)
    unit = case.task.error_scale.abs()
    policy = TrackingPolicy(case.params.learning.policy, gains(parts), unit, case.task.set_point, unit, bounds(case), kept)
    if seed is not None:
        for parameter in policy.output.parameters():
            torch.nn.init.normal_(parameter, std=0.1)
    return policy


def episodes(case, set_point, load=0.0, n=3, noise=0.0, start=0.3):
    """Episodes from several states, `noise`: the size of what is drawn; set points (T, 2)."""
    generator, n_steps = stream(0, "episodes"), len(set_point)
    shapes = (n, 2), (n_steps, n, case.process.n_disturbances), (n_steps + 1, n, 2)
    first, w, v = (torch.randn(shape, generator=generator, dtype=case.dtype) for shape in shapes)
    target = set_point[:, None].expand(-1, n, -1)
    return Scenarios(case.process, target, torch.zeros_like(target) + load, start * first, 0 * first, noise * w, noise * v)


def test_with_an_output_layer_of_zero_it_is_the_pid(study):
    case = study()
    policy, drawn = fresh(case), episodes(case, case.task.set_point.expand(40, 2), noise=1.0)
    found, expected = (track(tracker, drawn, bounds(case)) for tracker in (policy, tracking_pid(case)))
    torch.testing.assert_close(found.u, expected.u, rtol=1e-10, atol=1e-10)
    for found_part, part in zip(vars(policy.gains).values(), vars(gains()).values(), strict=True):
        torch.testing.assert_close(found_part, part)


def test_where_nothing_is_cut_off_or_all_of_it_kept_it_is_the_pid_of_the_paper(study):
    """Which goes on integrating at a bound. Without derivative action: at the first sample the paper's PID has none."""
    case, wide, parts = study(), study(process={"input_low": (-1e4, -1e4), "input_high": (1e4, 1e4)}), (*PARTS[:2], [0.0, 0.0])
    patient, dt = fresh(case, kept=1 - 1e-13, parts=parts), case.params.process.sampling_time
    same = {"proportional": parts[0], "integral": [value / dt for value in parts[1]], "derivative": parts[2]}
    paper = PID(GainParams.model_construct(**same), case.task.set_point, dt)
    for each, tracker, tolerance in ((wide, tracking_pid(wide, parts), 1e-9), (case, patient, 1e-7)):
        controllers = AtSetPoint(tracker, each.task), paper
        with torch.no_grad():
            runs = [rollout(each.process, controller, each.task, 4, stream(0, "episodes")).u for controller in controllers]
        torch.testing.assert_close(*runs, rtol=tolerance, atol=tolerance)


def test_the_input_that_was_applied_counts(case):
    """An input moved by hand: the integral goes on from there, without a jump."""
    controller, still = tracking_pid(case), torch.zeros(1, 2, dtype=case.dtype)
    command, memory = controller.act(still, still, still, controller.start(1))
    assert torch.equal(command, still)
    by_hand = torch.tensor([[5.0, -7.0]], dtype=case.dtype)
    command, memory = controller.act(still, still, by_hand, memory)
    torch.testing.assert_close(command, by_hand)


def test_noise_near_a_bound_does_not_move_the_mean(study):
    """What a form without memory of the excess does: every command that is cut off shifts the next ones."""
    case = study(process={"observation_noise": (0.3, 0.0)})
    target = torch.tensor([-2.2, 0.0], dtype=case.dtype)  # held by an input near its bound
    u = -torch.linalg.solve(case.process.drift_input, case.process.drift_state @ target)
    assert -20 < u[0] < -16
    drawn = episodes(case, target.expand(900, 2), n=40)
    drawn = replace(drawn, noise=torch.randn(901, 40, 2, generator=stream(1, "noise"), dtype=case.dtype))
    run = track(tracking_pid(case, ([10.0, 10.0], [0.3, 0.3], [0.0, 0.0])), drawn, bounds(case))
    assert (run.u[300:, :, 0] == -20).double().mean() > 0.1
    assert (target - run.x[300:].mean((0, 1)))[0].abs() < 0.05


@pytest.mark.parametrize("kept", [None, 0.8])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_the_network_has_learned_no_offset_stays(case, seed, kept):
    policy = fresh(case, seed, kept)
    with torch.no_grad():
        run = track(policy, episodes(case, case.task.set_point.expand(600, 2), load=0.7), bounds(case))
    assert run.movement[-1].max() < 1e-7, "a random network that is stable here"
    assert run.error[-1].abs().max() < 1e-6
    start = track(tracking_pid(case), episodes(case, case.task.set_point.expand(600, 2), load=0.7), bounds(case))
    assert (run.u[:20] - start.u[:20]).abs().max() > 0.1, "and that does something"


@pytest.mark.parametrize(("seed", "kept"), [(None, None), (0, None), (1, 0.8)])
def test_nothing_winds_up_at_a_bound(case, seed, kept):
    """A set point out of reach, for long or for very long: afterwards the same response."""
    far, near = (torch.tensor(target, dtype=case.dtype) for target in ([-8.0, 4.0], [-1.0, 4.0]))
    responses = []
    for waiting in (300, 900):
        drawn = episodes(case, torch.cat([far.expand(waiting, 2), near.expand(60, 2)]))
        with torch.no_grad():
            run = track(fresh(case, seed, kept), drawn, bounds(case))
        assert torch.equal(run.u[waiting - 1, :, 0], torch.full((3,), -20.0, dtype=case.dtype))
        responses.append(run.x[waiting:])
    torch.testing.assert_close(responses[0], responses[1], rtol=1e-6, atol=1e-6)


def test_every_parameter_is_learned(case):
    policy = fresh(case, 0, kept=0.8)
    run = track(policy, episodes(case, case.task.set_point.expand(30, 2)), bounds(case))
    run.error.square().mean().backward()
    still = [name for name, parameter in policy.named_parameters() if parameter.grad is None or not parameter.grad.any()]
    assert still == []
