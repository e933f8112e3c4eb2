"""The closed loop: draws, bounds, and a plain loop over one episode."""

import numpy as np
import pytest
import torch

from helpers.learning.policy import PolicyController
from helpers.plant.controllers import PID
from helpers.plant.rollout import rollout, stream

F64 = torch.float64


class Constant:
    """A controller that always asks for the same inputs."""

    def __init__(self, command):
        self.command = torch.tensor(command, dtype=F64)

    def start(self, n_trajectories, n_steps, generator):
        return n_trajectories

    def act(self, observation, memory):
        return self.command.expand(memory, -1), memory


class Echo:
    """A process whose states and observations are the noise that it is handed."""

    n_states, n_outputs, n_inputs = 2, 2, 2

    def step(self, x, u, noise):
        return noise

    def observe(self, x, noise):
        return noise


def controllers(case):
    return {
        "pid": case.pid,
        "constant": Constant([3.0, 99.0]),
        "exploring": PolicyController(case.policy(), case.task, exploring=True),
        "deployed": PolicyController(case.policy(), case.task, exploring=False),
    }


NAMES = ("pid", "constant", "exploring", "deployed")


@pytest.mark.parametrize("name", NAMES)
def test_shapes_bounds_and_commands(study, name):
    case = study()
    batch = rollout(case.process, controllers(case)[name], case.task, 7, stream(0, "rollout"))
    assert batch.x.shape == batch.y.shape == (51, 7, 2)
    assert batch.u.shape == batch.command.shape == (50, 7, 2)
    assert torch.equal(batch.u, torch.minimum(torch.maximum(batch.command, case.task.input_low), case.task.input_high))


def test_the_pid_meets_the_bounds(study):
    """Otherwise the test of the bounds would show nothing."""
    case = study()
    batch = rollout(case.process, case.pid, case.task, 7, stream(0, "rollout"))
    assert (batch.u == case.task.input_low).any()
    assert (batch.u == case.task.input_high).any()
    assert not torch.equal(batch.u, batch.command)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_episodes_bit_for_bit(study, name):
    case = study()
    first, second, other = (
        rollout(case.process, controllers(case)[name], case.task, 7, stream(seed, "rollout")) for seed in (0, 0, 1)
    )
    assert all(torch.equal(getattr(first, signal), getattr(second, signal)) for signal in ("x", "y", "u", "command"))
    assert not torch.equal(first.x, other.x)


@pytest.mark.parametrize("name", NAMES)
def test_every_controller_meets_the_same_draws(study, name):
    case = study()
    reference = rollout(Echo(), Constant([0.0, 0.0]), case.task, 7, stream(0, "draws"))
    found = rollout(Echo(), controllers(case)[name], case.task, 7, stream(0, "draws"))
    assert torch.equal(reference.x, found.x)
    assert torch.equal(reference.y, found.y)


def test_draws_are_standard_normal_and_independent(study):
    batch = rollout(Echo(), Constant([0.0, 0.0]), study().task, 4000, stream(0, "draws"))
    draws = torch.cat([batch.x[1:].flatten(), batch.y.flatten()]).numpy()
    assert abs(draws.mean()) < 5 / np.sqrt(len(draws))
    assert abs(draws.var() - 1) < 5 * np.sqrt(2 / len(draws))
    table = torch.cat([batch.x[1:], batch.y[1:]], dim=-1).reshape(-1, 4).numpy()
    correlation = np.corrcoef(table.T) - np.eye(4)
    assert np.abs(correlation).max() < 5 / np.sqrt(len(table))
    for signal in (batch.x[1:], batch.y):  # no draw is used twice
        assert abs(np.corrcoef(signal[:-1].flatten(), signal[1:].flatten())[0, 1]) < 5 / np.sqrt(signal[1:].numel())


def test_initial_states_follow_table_1(study):
    case = study(case_study={"initial_mean": (1.0, -2.0)})
    x = rollout(case.process, case.pid, case.task, 40_000, stream(0, "initial")).x[0].numpy()
    spread = np.array([0.25, 0.75])
    np.testing.assert_array_less(np.abs(x.mean(0) - [1.0, -2.0]), 5 * spread / np.sqrt(len(x)))
    np.testing.assert_allclose(x.std(0), spread, rtol=5 / np.sqrt(2 * len(x)))


@pytest.mark.equation("3.1.6")
def test_without_noise_an_episode_is_a_plain_loop(study):
    """y_t observes x_t, u_t acts on y_t, x_{t+1} follows from x_t and the bounded u_t."""
    case = study(
        process={"disturbance": (0.0, 0.0), "observation_noise": (0.0, 0.0)},
        case_study={"initial_mean": (0.3, -0.4), "initial_std": (0.0, 0.0)},
    )
    found = rollout(case.process, case.pid, case.task, 2, stream(0, "plain"))
    params, gains = case.params.process, case.params.demonstrator
    a, b, dt = np.array(params.drift_state), np.array(params.drift_input), params.sampling_time
    kp, ki, kd = (np.array(gain) for gain in (gains.proportional, gains.integral, gains.derivative))
    x, total, before = np.array([0.3, -0.4]), np.zeros(2), None
    for t in range(50):
        np.testing.assert_allclose(found.x[t, 1], x, rtol=0, atol=1e-11)
        error = np.array([-1.0, 4.0]) - x
        total = total + error * dt
        change = 0 if before is None else (error - before) / dt
        command, before = kp * error + ki * total + kd * change, error
        u = np.clip(command, params.input_low, params.input_high)
        np.testing.assert_allclose(found.command[t, 1], command, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.u[t, 1], u, rtol=0, atol=1e-8)
        x = x + (a @ x + b @ u) * dt
    np.testing.assert_allclose(found.x[50, 1], x, rtol=0, atol=1e-11)
    assert torch.equal(found.x, found.y)


@pytest.mark.equation("4.1.3")
@pytest.mark.equation("4.1.4")
def test_the_recorded_signals_obey_the_process(study):
    """The disturbances and observation errors recovered from a batch are standard normal, whatever the controller."""
    case = study()
    batch = rollout(case.process, case.pid, case.task, 2000, stream(0, "recover"))
    x, y, u, params = batch.x.numpy(), batch.y.numpy(), batch.u.numpy(), case.params.process
    drift = x[:-1] @ np.array(params.drift_state).T + u @ np.array(params.drift_input).T
    step = (x[1:] - x[:-1] - drift * params.sampling_time) / (np.array(params.disturbance) * x[:-1] * params.sampling_time**0.5)
    read = (y / x - 1) / np.array(params.observation_noise)
    for noise in (step, read):
        assert abs(noise.mean()) < 5 / np.sqrt(noise.size)
        assert abs(noise.var() - 1) < 5 * np.sqrt(2 / noise.size)


def test_rows_of_a_batch_are_independent(study):
    """A trajectory that starts elsewhere leaves the others as they were."""
    case = study()

    class Shifted(type(case.process)):
        def observe(self, x, noise):
            y = super().observe(x, noise)
            y[0] += 5.0  # the sensor of the first trajectory fails
            return y

    shifted = Shifted(case.params.process, F64)
    plain = rollout(case.process, case.pid, case.task, 4, stream(0, "rows"))
    disturbed = rollout(shifted, case.pid, case.task, 4, stream(0, "rows"))
    assert torch.equal(plain.x[:, 1:], disturbed.x[:, 1:])
    assert not torch.equal(plain.x[:, 0], disturbed.x[:, 0])


@pytest.mark.parametrize(("n_controlled", "n_manipulated"), [(1, 1), (3, 3), (3, 2), (2, 4)])
def test_any_number_of_variables(synthetic, n_controlled, n_manipulated):
    case = synthetic(n_controlled, n_manipulated)
    batch = rollout(case.process, PolicyController(case.policy(), case.task, exploring=True), case.task, 6, stream(0))
    assert batch.x.shape == (13, 6, n_controlled)
    assert batch.u.shape == (12, 6, n_manipulated)
    assert case.features.trajectory(batch).shape == (6, 3 * n_controlled)
    if n_controlled == n_manipulated:
        pid = PID(case.params.demonstrator, case.task.set_point, case.process.sampling_time)
        assert rollout(case.process, pid, case.task, 6, stream(0)).u.shape == (12, 6, n_manipulated)
