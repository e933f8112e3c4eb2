"""The closed loop: draws, bounds, and a plain loop over one episode; random streams depend on their seed and purpose alone."""

import numpy as np
import pytest
import torch

from helpers.learning.policy import PolicyController
from helpers.plant.process import LinearProcess
from helpers.plant.rollout import rollout, stream

F64 = torch.float64
CALM = {"disturbance": (0.0, 0.0), "observation_noise": (0.0, 0.0)}


class Constant:
    """A controller, and a tracker, that always asks for the same inputs and keeps what it is shown."""

    def __init__(self, command):
        self.command, self.seen = torch.tensor(command, dtype=F64), []

    def start(self, n_trajectories, *_):
        return None

    def act(self, observation, *seen):
        self.seen.append(observation)
        return self.command.expand(len(observation), -1), seen[-1]


class Echo:
    """A process whose states and observations are the noise that it is handed; as much of it as the stirred tank takes."""

    n_states, n_outputs, n_inputs, n_disturbances = 2, 2, 2, 8

    def step(self, x, u, noise):
        return noise[:, 6:]

    def observe(self, x, noise):
        return noise


CONTROLLERS = {
    "pid": lambda case: case.pid,
    "constant": lambda case: Constant([3.0, 99.0]),
    "exploring": lambda case: PolicyController(case.policy(), case.task, exploring=True),
    "deployed": lambda case: PolicyController(case.policy(), case.task, exploring=False),
}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_shapes_bounds_and_draws_and_the_same_seed_gives_the_same_episodes_bit_for_bit(case, name):
    """By one controller object: no episode inherits another's memory."""
    controller = CONTROLLERS[name](case)
    batch, other, again = (rollout(case.process, controller, case.task, 7, stream(seed, "rollout")) for seed in (0, 1, 0))
    assert batch.x.shape == batch.y.shape == (51, 7, 2)
    assert batch.u.shape == batch.command.shape == (50, 7, 2)
    assert torch.equal(batch.u, torch.minimum(torch.maximum(batch.command, case.task.input_low), case.task.input_high))
    if name == "pid":  # which meets the bounds; otherwise this would show nothing
        assert (batch.u == case.task.input_low).any()
        assert (batch.u == case.task.input_high).any()
    assert all(torch.equal(getattr(batch, signal), getattr(again, signal)) for signal in ("x", "y", "u", "command"))
    assert not torch.equal(batch.x, other.x)
    found, expected = (rollout(Echo(), each, case.task, 7, stream(0, "draws")) for each in (controller, Constant([0.0, 0.0])))
    assert all(torch.equal(getattr(found, name), getattr(expected, name)) for name in ("x", "y"))  # all meet the same draws


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


def plain_loop(params, x, **reading):
    """States and commands of the demonstrator in plain floats, without noise, under another reading of its law where asked."""
    memory = reading.get("error_memory", 0.0)
    process, gains, target, dt = params.process, params.demonstrator, np.array(params.case.set_point), params.process.sampling_time
    A, B, m = np.array(process.drift_state), np.array(process.drift_input), process.integration_steps
    kp, ki, kd = (np.array(gain) for gain in (gains.proportional, gains.integral, gains.derivative))
    states, commands, total = [np.array(x)], [], np.zeros(2)
    before, last = np.zeros(2) if reading.get("derivative_from_zero") else None, target - states[0]
    for _ in range(process.horizon):
        x = states[-1]
        error, last = (last if reading.get("delay") else target - x), target - x
        tried = total + error * dt
        if reading.get("bounded_integral"):
            tried = np.clip(ki * tried, process.input_low, process.input_high) / ki
        seen = tried - (1 - reading.get("present_error", 1.0)) * error * dt
        smooth = error if before is None else memory * before + (1 - memory) * error
        change = 0.0 if before is None else (smooth - before) / dt
        commands.append(kp * error + ki * seen + kd * change)
        u = np.clip(commands[-1], process.input_low, process.input_high)
        frozen = (u != commands[-1]) & (np.sign(error) == np.sign(commands[-1])) & reading.get("conditional_integration", False)
        total, before = np.where(frozen, total, tried), smooth
        for _ in range(m):
            x = x + (A @ x + B @ u) * dt / m
        states.append(x)
    return np.array(states), np.array(commands)


class FirstSensorFails(LinearProcess):
    """A process whose first trajectory goes another way, which must leave the others as they are."""

    def observe(self, x, noise):
        y = super().observe(x, noise)
        y[0] += 5.0
        return y


@pytest.mark.equation("3.1.6")
def test_without_noise_an_episode_is_a_plain_loop(study):
    """y_t observes x_t, u_t acts on y_t, x_{t+1} follows from x_t and the bounded u_t; the PID integrates beyond the bounds."""
    case = study(process=CALM, case_study={"initial_mean": (0.3, -0.4), "initial_std": (0.0, 0.0)})
    found = rollout(FirstSensorFails(case.params.process, F64), case.pid, case.task, 2, stream(0, "plain"))
    states, commands = plain_loop(case.params, [0.3, -0.4])
    np.testing.assert_allclose(found.x[:, 1], states, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.command[:, 1], commands, rtol=0, atol=1e-8)
    inputs = np.clip(commands, case.params.process.input_low, case.params.process.input_high)
    np.testing.assert_allclose(found.u[:, 1], inputs, rtol=0, atol=1e-8)
    assert torch.equal(found.x[:, 1], found.y[:, 1])
    assert not torch.equal(found.u[:, 1], found.command[:, 1])


def draw(*arguments, n=1000):
    return torch.randn(n, generator=stream(*arguments), dtype=torch.float64)


def test_the_same_purpose_gives_the_same_numbers_bit_for_bit():
    first = draw(3, "case", 1, "rollout")
    torch.manual_seed(99)  # the global generator plays no part
    before = torch.get_rng_state()
    stream(3, "another purpose")
    assert torch.equal(first, draw(3, "case", 1, "rollout"))
    assert torch.equal(before, torch.get_rng_state())
    assert len({draw(seed, "purpose", n=1).item() for seed in range(500)}) == 500


@pytest.mark.parametrize("other", [(4, "case", 1), (3, "case", 2), (3, "cas", "e1"), (3, 1, "case"), (3, "case"), (3,)], ids=str)
def test_another_seed_or_purpose_gives_unrelated_numbers(other):
    first, second = draw(3, "case", 1, n=10_000), draw(*other, n=10_000)
    correlation = np.corrcoef(first, second)[0, 1]
    assert abs(correlation) < 5 / np.sqrt(10_000)
