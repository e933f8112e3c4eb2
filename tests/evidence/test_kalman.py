"""The Kalman filter in front of a controller: against the textbook recursion, and that it estimates better than the reading."""

import numpy as np
import pytest
import torch

from helpers.evidence.kalman import Filtered
from helpers.plant.rollout import rollout, stream


class Spy:
    """A controller that keeps what it is shown."""

    def __init__(self):
        self.seen = []

    def start(self, n_trajectories, n_steps, generator):
        return None

    def act(self, observation, memory):
        self.seen.append(observation)
        return torch.full_like(observation, 5.0), memory


def test_two_steps_by_hand(study):
    """Written out in numpy for one trajectory, with the covariance update in Joseph's form."""
    case = study(1)
    spy = Spy()
    controller = Filtered(spy, case.process, case.task)
    readings = np.array([[0.3, -0.5], [0.1, 0.4]])
    memory = controller.start(1, 2, stream(0))
    for y in readings:
        _, memory = controller.act(torch.tensor(y)[None], memory)
    process, m = case.params.process, case.params.process.integration_steps
    tau = process.sampling_time / m
    A, B = np.eye(2) + tau * np.array(process.drift_state), tau * np.array(process.drift_input)
    mean, P = case.task.initial_mean.numpy(), np.diag(case.task.initial_std.numpy() ** 2)
    d, r = np.array(process.disturbance) ** 2 * tau, np.array(process.observation_noise) ** 2
    for y, seen in zip(readings, spy.seen, strict=True):
        R = np.diag(r * (mean**2 + P.diagonal()))
        K = P @ np.linalg.inv(P + R)
        mean = mean + K @ (y - mean)
        P = (np.eye(2) - K) @ P @ (np.eye(2) - K).T + K @ R @ K.T
        assert seen[0].numpy() == pytest.approx(mean, rel=1e-9)
        for _ in range(m):
            P, mean = A @ P @ A.T + np.diag(d * (mean**2 + P.diagonal())), A @ mean + B @ np.full(2, 5.0)
    assert memory[0][0].numpy() == pytest.approx(mean)
    assert memory[1][0].numpy() == pytest.approx(P)


def test_the_estimate_is_nearer_to_the_state_than_the_reading(study):
    case = study(2)
    spy = Spy()
    batch = rollout(case.process, Filtered(spy, case.process, case.task), case.task, 4000, stream(0, "kalman"))
    estimate = torch.stack(spy.seen)
    mine, reading = ((signal[5:] - batch.x[5:-1]).square().mean((0, 1)) for signal in (estimate, batch.y[:-1]))
    assert (mine < 0.97 * reading).all()
