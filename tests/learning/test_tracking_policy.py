"""The policy for many set points: the PID inside, no offset, no windup."""

from dataclasses import replace

import pytest
import torch

from helpers.learning.tracking_policy import Gains, TrackingPID, TrackingPolicy
from helpers.plant.controllers import PID
from helpers.plant.rollout import rollout, stream
from helpers.plant.tracking import AtSetPoint, Bounds, Scenarios, track
from helpers.settings.paper import GainParams

CALM = {"disturbance": (0.0, 0.0), "observation_noise": (0.0, 0.0)}
PARTS = ([20.0, 25.0], [1.0, 6.0], [0.0, 0.5])


@pytest.fixture
def case(study):
    return study(process=CALM)


def gains(parts=PARTS):
    return Gains(*(torch.tensor(values, dtype=torch.float64).diag() for values in parts))


def paper_pid(case, parts):
    """The paper's PID with the same gains, without derivative action."""
    dt = case.params.process.sampling_time
    integral = tuple(value / dt for value in parts[1])
    return PID(GainParams.model_construct(proportional=parts[0], integral=integral, derivative=parts[2]), case.task.set_point, dt)


def bounds(case, wider=1.0):
    infinite = torch.full_like(case.task.input_low, torch.inf)
    return Bounds(wider * case.task.input_low, wider * case.task.input_high, infinite)


def tracking_pid(case, parts=PARTS, wider=1.0):
    return TrackingPID(gains(parts), bounds(case, wider))


def fresh(case, seed=None, kept=None):
    """A policy whose output layer is zero, or random with a seed; `kept`: of the patient form."""
    torch.manual_seed(0 if seed is None else seed)
    unit = case.task.error_scale.abs()
    policy = TrackingPolicy(case.params.learning.policy, gains(), unit, case.task.set_point, unit, bounds(case), kept)
    if seed is not None:
        with torch.no_grad():
            for parameter in policy.output.parameters():
                parameter.normal_(std=0.1)
    return policy


def episodes(case, set_point, load=0.0, n=3):
    """Episodes without noise from several states; set points (T, 2)."""
    n_steps = len(set_point)
    generator = stream(0, "episodes")
    zero = torch.zeros(n_steps + 1, n, 2, dtype=case.dtype)
    start = 0.3 * torch.randn(n, 2, generator=generator, dtype=case.dtype)
    return Scenarios(
        case.process, set_point[:, None].expand(-1, n, -1), zero[1:] + load, start, zero[0], zero[1:].repeat(1, 1, 4), zero
    )


def test_with_an_output_layer_of_zero_it_is_the_pid(study):
    case, policy = study(), None
    policy = fresh(case)
    drawn = episodes(case, case.task.set_point.expand(40, 2))
    noise = torch.randn(41, 3, 2, generator=stream(1, "noise"), dtype=case.dtype)
    drawn = replace(drawn, noise=noise, disturbance=noise[1:].repeat(1, 1, 4))
    found, expected = (track(tracker, drawn, bounds(case)) for tracker in (policy, tracking_pid(case)))
    torch.testing.assert_close(found.u, expected.u, rtol=1e-10, atol=1e-10)
    for found_part, part in zip(vars(policy.gains).values(), vars(gains()).values(), strict=True):
        torch.testing.assert_close(found_part, part)


def test_away_from_the_bounds_it_is_the_pid_of_the_paper(study):
    """Without derivative action: at the first sample the paper's PID has none, and the form in increments has."""
    case = study(process={"input_low": (-1e4, -1e4), "input_high": (1e4, 1e4)})
    parts = (PARTS[0], PARTS[1], [0.0, 0.0])
    runs = [
        rollout(case.process, controller, case.task, 4, stream(0, "episodes"))
        for controller in (AtSetPoint(tracking_pid(case, parts), case.task), paper_pid(case, parts))
    ]
    torch.testing.assert_close(runs[0].u, runs[1].u, rtol=1e-9, atol=1e-9)


def test_what_keeps_all_that_a_bound_cuts_off_is_the_pid_of_the_paper(study):
    """Which goes on integrating at a bound."""
    case = study()
    with torch.no_grad():
        policy = fresh(case, kept=1 - 1e-13)
        policy.derivative.zero_()
        runs = [
            rollout(case.process, controller, case.task, 4, stream(0, "episodes")).u
            for controller in (AtSetPoint(policy, case.task), paper_pid(case, (PARTS[0], PARTS[1], [0.0, 0.0])))
        ]
    torch.testing.assert_close(*runs, rtol=1e-7, atol=1e-7)


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
