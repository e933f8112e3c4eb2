"""The Kalman filter in front of a controller, against the textbook recursion."""

import numpy as np
import pytest
import torch

from helpers.evidence.kalman import Filtered
from helpers.plant.rollout import stream
from tests.plant.test_rollout import Constant


def test_two_steps_by_hand(case):
    """Written out in numpy, with the covariance update in Joseph's form, for the second of two trajectories."""
    spy = Constant([5.0, 5.0])
    controller = Filtered(spy, case.process, case.task)
    readings = np.array([[0.3, -0.5], [0.1, 0.4]])
    memory = controller.start(2, 2, stream(0))
    for y in readings:
        _, memory = controller.act(torch.tensor(np.array([-3 * y, y])), memory)
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
        assert seen[1].numpy() == pytest.approx(mean, rel=1e-9)
        for _ in range(m):
            P, mean = A @ P @ A.T + np.diag(d * (mean**2 + P.diagonal())), A @ mean + B @ np.full(2, 5.0)
    assert memory[0][1].numpy() == pytest.approx(mean)
    assert memory[1][1].numpy() == pytest.approx(P)
