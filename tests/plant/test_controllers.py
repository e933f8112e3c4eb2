"""The reference controllers by other routes; the PID law is checked by a plain loop in test_rollout.py."""

import numpy as np
import torch

from helpers.plant.controllers import Operator, SaturatedLQ
from helpers.plant.rollout import stream


def run(pid, observations):
    """Commands (T, K, n_u) for observations (T, K, n_y), from a fresh memory."""
    memory, commands = pid.start(observations.shape[1], len(observations), stream(0)), []
    for observation in observations:
        command, memory = pid.act(observation, memory)
        commands.append(command)
    return torch.stack(commands)


def test_episodes_do_not_share_memory(study):
    pid = study().pid
    y = torch.randn(20, 3, 2, generator=stream(0, "y"), dtype=torch.float64)
    first = run(pid, y)
    interleaved, other = pid.start(3, 20, stream(0)), pid.start(3, 20, stream(0))
    for observation, command in zip(y, first, strict=True):
        _, other = pid.act(-5 * observation, other)
        found, interleaved = pid.act(observation, interleaved)
        assert torch.equal(found, command)


def test_minimum_variance_expects_the_next_state_at_the_set_point(study):
    case = study(2)
    controller = case.minimum_variance
    x = torch.tensor([[0.0, 0.0], [0.9, 4.2], [3.0, -7.0]], dtype=torch.float64)
    command, _ = controller.act(x, controller.start(3, 1, stream(0)))
    reached = case.process.step(x, command, torch.zeros(3, case.process.n_disturbances, dtype=x.dtype))
    torch.testing.assert_close(reached, case.task.set_point.expand_as(x), rtol=1e-10, atol=1e-10)


def test_predictive_law_against_the_plan_written_out(study):
    """The whole plan of N moves as one least-squares problem, its first move taken."""
    case, horizon, penalty = study(2), 4, 0.3
    process, task = case.process, case.task
    A, B = process.state_step.numpy(), process.input_step.numpy()
    span = (task.input_high - task.input_low).numpy()
    observation, last = np.array([0.9, 3.9]), np.array([11.0, 40.0])

    def residuals(moves):
        x, u, parts = observation, last, []
        for move in moves.reshape(horizon, 2):
            u = u + move
            x = A @ x + B @ u
            parts += [(x - task.set_point.numpy()) / task.error_scale.numpy(), np.sqrt(penalty) * move / span]
        return np.concatenate(parts)

    free = residuals(np.zeros(2 * horizon))
    effect = np.column_stack([residuals(move) - free for move in np.eye(2 * horizon)])
    plan = np.linalg.lstsq(effect, -free, rcond=None)[0]
    controller = SaturatedLQ(process.state_step, process.input_step, task, horizon, penalty)
    command, memory = controller.act(torch.tensor(observation[None]), torch.tensor(last[None]))
    np.testing.assert_allclose(command[0], last + plan[:2], rtol=1e-9)
    assert torch.equal(memory, command.clamp(task.input_low, task.input_high))


def test_predictive_law_rests_at_the_set_point(study):
    case = study(2)
    controller = SaturatedLQ(case.process.state_step, case.process.input_step, case.task, 10, 0.1)
    at_rest = controller.input_at_rest[None]
    x = case.task.set_point[None]
    torch.testing.assert_close(case.process.step(x, at_rest, torch.zeros(len(x), case.process.n_disturbances, dtype=x.dtype)), x)
    torch.testing.assert_close(controller.act(x, at_rest)[0], at_rest)
    start = controller.start(3, 5, stream(0))
    assert torch.equal(start, torch.zeros(3, 2, dtype=x.dtype))
    far = controller.act(torch.zeros(3, 2, dtype=x.dtype) - 99, start)
    assert (far[0] > case.task.input_high).any()  # asked for beyond the bounds, remembered within
    assert (far[1] <= case.task.input_high).all()


def test_operator_takes_over_beyond_the_threshold_only(study):
    case = study(1)  # set points -1 and 4
    held = torch.tensor([torch.nan, -30.0], dtype=torch.float64)
    operator = Operator(case.pid, case.task, 0.25, held)
    y = torch.tensor([[[0.0, 0.0]], [[-2.0, 4.9]], [[-2.0, 5.1]], [[-1.0, 5.2]], [[-1.0, 4.9]]], dtype=torch.float64)
    alone, commands = run(case.pid, y), run(operator, y)
    assert operator.by_hand(y)[:, 0].tolist() == [[False, False]] * 2 + [[False, True]] * 2 + [[False, False]]
    expected = alone.clone()
    expected[2:4, 0, 1] = -30.0
    assert torch.equal(commands, expected)  # the PID goes on computing: after hand control it is where it would have been
