"""The PID law by hand, and that no episode inherits another's memory."""

import numpy as np
import pytest
import torch

from helpers.controllers import PID
from helpers.randomness import stream

DT = 0.5


@pytest.fixture
def pid(study):
    gains = study().params.demonstrator.model_copy(
        update={"proportional": (2.0, 10.0), "integral": (3.0, 0.0), "derivative": (0.25, 1.0)}
    )
    return PID(gains, torch.tensor([1.0, -1.0], dtype=torch.float64), DT)


def run(pid, observations):
    """Commands (T, K, n_u) for observations (T, K, n_y), from a fresh memory."""
    memory, commands = pid.start(observations.shape[1], len(observations), stream(0)), []
    for observation in observations:
        command, memory = pid.act(observation, memory)
        commands.append(command)
    return torch.stack(commands)


def test_hand_computed_sequence(pid):
    # First loop: e = 1, 0.5, -0.5; sum(e) dt = 0.5, 0.75, 0.5; change / dt = none, -1, -2.
    # Second loop: e = -1, -1, 1; no integral action; change / dt = none, 0, 4.
    y = torch.tensor([[[0.0, 0.0]], [[0.5, 0.0]], [[1.5, -2.0]]], dtype=torch.float64)
    expected = [[[2 + 1.5, -10.0]], [[1 + 2.25 - 0.25, -10.0]], [[-1 + 1.5 - 0.5, 10 + 4.0]]]
    np.testing.assert_allclose(run(pid, y), expected, rtol=1e-14)


def test_the_first_sample_has_integral_action_but_no_derivative(pid):
    y = torch.tensor([[[-9.0, 9.0]]], dtype=torch.float64)
    np.testing.assert_allclose(run(pid, y)[0, 0], [2 * 10 + 3 * 10 * DT, 10 * -10.0], rtol=1e-14)


def test_the_integral_goes_on_beyond_any_bound(pid):
    y = torch.full((1000, 1, 2), -99.0, dtype=torch.float64)
    np.testing.assert_allclose(run(pid, y)[-1, 0, 0], 2 * 100 + 3 * 100 * 1000 * DT, rtol=1e-12)


def test_episodes_do_not_share_memory(pid):
    y = torch.randn(20, 3, 2, generator=stream(0, "y"), dtype=torch.float64)
    first = run(pid, y)
    assert torch.equal(first, run(pid, y))  # a fresh start after another episode
    interleaved, other = pid.start(3, 20, stream(0)), pid.start(3, 20, stream(0))
    for observation, command in zip(y, first, strict=True):
        _, other = pid.act(-5 * observation, other)
        found, interleaved = pid.act(observation, interleaved)
        assert torch.equal(found, command)


def test_trajectories_of_a_batch_do_not_see_each_other(pid):
    y = torch.randn(20, 4, 2, generator=stream(0, "y"), dtype=torch.float64)
    together = run(pid, y)
    for row in range(4):
        assert torch.equal(together[:, row : row + 1], run(pid, y[:, row : row + 1]))


def test_the_memory_of_a_step_is_not_overwritten(pid):
    memory = pid.start(1, 2, stream(0))
    _, second = pid.act(torch.ones(1, 2, dtype=torch.float64), memory)
    assert memory.previous is None
    assert torch.equal(memory.integral, torch.zeros(1, 2, dtype=torch.float64))
    kept = second.integral.clone()
    pid.act(torch.zeros(1, 2, dtype=torch.float64), second)
    assert torch.equal(second.integral, kept)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_number_type_follows_the_set_point(study, dtype):
    case = study(1, dtype)
    command, _ = case.pid.act(torch.zeros(3, 2, dtype=dtype), case.pid.start(3, 1, stream(0)))
    assert command.dtype == dtype
    assert command.shape == (3, 2)
