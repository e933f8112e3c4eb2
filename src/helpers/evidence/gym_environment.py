"""The control task of a case study as a gymnasium environment with the real objective, for learners of other libraries.

It needs the packages of the extra `alternatives`.
"""

from typing import Any

import gymnasium
import numpy as np

from helpers.plant.process import LinearProcess
from helpers.plant.task import ControlTask
from helpers.settings.paper import PolicyParams


class TrackingEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One episode of T samples: Eq. 4.1.3-4.1.4 with the reward of Eq. 5.1.2.1 on the true state.

    Written in numpy, which is faster than torch on single vectors. An agent sees what the policy of Section 3.2 sees (the error
    of each loop in its unit and the previous input, scaled so that the bounds are -1 and 1) and acts in -1..1. The horizon
    belongs to the task, so that its end is terminal.

    Attributes:
        beta: sharpness of the reward; may be changed between episodes.
    """

    def __init__(self, process: LinearProcess, task: ControlTask, policy: PolicyParams, beta: float) -> None:
        self.beta = beta
        self.n_steps = task.n_steps
        self.drift_state, self.drift_input = process.drift_state.double().numpy(), process.drift_input.double().numpy()
        self.integration_steps, self.tau = process.integration_steps, process.tau
        self.disturbance_gain = process.disturbance_gain.double().numpy()
        self.observation_noise = process.observation_noise.double().numpy()
        self.set_point, self.error_scale = task.set_point.double().numpy(), task.error_scale.double().numpy()
        self.initial_mean, self.initial_std = task.initial_mean.double().numpy(), task.initial_std.double().numpy()
        low, high = task.input_low.double().numpy(), task.input_high.double().numpy()
        self.middle, self.half = (high + low) / 2, (high - low) / 2
        self.error_unit = np.array(policy.error_unit)
        n_seen = len(self.set_point) + len(self.middle)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n_seen,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(self.middle),), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """A fresh episode; the input before it was u* = 0."""
        super().reset(seed=seed)
        return self.begin(()), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One sample; `info` holds the true state x, its observation y and the input u as applied."""
        seen, reward = self.advance(action)
        return seen, float(reward), self.over, False, {"x": self.x, "y": self.y, "u": self.u}

    def begin(self, batch: tuple[int, ...]) -> np.ndarray:
        """Begin a batch of episodes; what is seen, shape (*batch, n_y + n_u). The shape () is a single episode."""
        self.t = 0
        self.x = self.initial_mean + self.initial_std * self.np_random.standard_normal((*batch, len(self.initial_mean)))
        self.u = np.zeros((*batch, len(self.middle)))
        return self._seen()

    def advance(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One sample of the whole batch: what is seen, and the rewards of shape batch, from actions (*batch, n_u)."""
        self.u = self.middle + self.half * np.clip(action, -1.0, 1.0)
        pushed = self.u @ self.drift_input.T
        for w in self.np_random.standard_normal((self.integration_steps, *self.x.shape)):
            drift = self.x @ self.drift_state.T + pushed
            self.x = self.x + drift * self.tau + self.disturbance_gain * self.x * self.tau**0.5 * w
        self.t += 1
        return self._seen(), np.exp(-((self.beta * (self.set_point - self.x) / self.error_scale) ** 2)).sum(-1)

    @property
    def over(self) -> bool:
        """Whether the episodes have ended."""
        return self.t == self.n_steps

    def _seen(self) -> np.ndarray:
        self.y = self.x * (1 + self.observation_noise * self.np_random.standard_normal(self.x.shape))
        parts = [(self.set_point - self.y) / self.error_unit, (self.u - self.middle) / self.half]
        return np.concatenate(parts, axis=-1).astype(np.float32)
