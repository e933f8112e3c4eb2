"""Closed loops with moving set points against the loop of the paper's cases and against definitions by hand."""

from dataclasses import replace

import pytest
import torch

from helpers.plant.rollout import rollout, stream
from helpers.plant.tracking import AtSetPoint, Scenarios, track
from tests.learning.test_tracking_policy import bounds, tracking_pid
from tests.plant.test_rollout import Constant

N, T = 5, 12


@pytest.fixture
def case(study):
    return study(process={"horizon": T}, case_study={"initial_mean": (1.0, -2.0)})


@pytest.fixture
def pid(case):
    return tracking_pid(case, ([9.0, 8.0], [1.0, 3.0], [0.5, 0.2]))


@pytest.fixture
def scenarios(case):
    """The draws that `rollout` makes from the same stream."""
    generator = stream(0, "episodes")
    start, disturbance, noise = (
        torch.randn(n, width, N, generator=generator, dtype=case.dtype).mT for n, width in ((1, 2), (T, 8), (T + 1, 2))
    )
    zero = torch.zeros(T, N, 2, dtype=case.dtype)
    first = case.task.initial_mean + case.task.initial_std * start[0]
    return Scenarios(case.process, case.task.set_point.expand(T, N, 2), zero, first, zero[0], disturbance, noise)


def test_at_a_set_point_that_stands_still_the_loop_is_that_of_the_paper(case, pid, scenarios):
    found = track(pid, scenarios, bounds(case))
    expected = rollout(case.process, AtSetPoint(pid, case.task), case.task, N, stream(0, "episodes"))
    for name in ("x", "y", "u"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-12)


def test_error_and_movement_are_what_they_say(case, pid, scenarios):
    before = torch.full((N, 2), 3.0, dtype=case.dtype)
    run = track(pid, replace(scenarios, before=before), bounds(case))
    torch.testing.assert_close(run.error[3], case.task.set_point - run.y[4])
    torch.testing.assert_close(run.movement[0], (run.u[0] - before).abs())
    torch.testing.assert_close(run.movement[5], (run.u[5] - run.u[4]).abs())


def test_the_input_keeps_its_bounds_and_its_rate(case, scenarios):
    run = track(Constant([1e3, -1e3]), scenarios, bounds(case)._replace(rate=torch.full((2,), 4.0, dtype=case.dtype)))
    assert run.movement.max() <= 4.0 + 1e-12
    torch.testing.assert_close(run.u[:, 0, 0], torch.arange(1, T + 1, dtype=case.dtype).mul(4.0).clamp(max=20.0))
    assert torch.equal(run.u.amin((0, 1))[1], torch.tensor(-48.0, dtype=case.dtype))


def test_a_load_reaches_the_process_and_not_the_controller(case, scenarios):
    load = torch.zeros(T, N, 2, dtype=case.dtype)
    load[4:] = 2.0
    plain, loaded = (track(Constant([1.0, 1.0]), replace(scenarios, load=each), bounds(case)) for each in (0 * load, load))
    assert torch.equal(plain.u, loaded.u)
    assert torch.equal(plain.x[:5], loaded.x[:5])
    first = case.process.step(loaded.x[4], torch.full_like(load[4], 3.0), scenarios.disturbance[4])
    torch.testing.assert_close(loaded.x[5], first, rtol=1e-12, atol=1e-12)
