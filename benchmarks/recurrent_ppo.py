"""The same task in a general library: RecurrentPPO of sb3-contrib on a gymnasium environment of the process."""

from typing import Any

import gymnasium
import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import DummyVecEnv

from helpers.maxent_irl import initial_weights
from helpers.params import Params


class ProcessEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One episode of a case study: the process of Eq. 4.1.3-4.1.4, the reward of Eq. 4.2.5, T steps.

    Written in numpy, which is faster than torch on single vectors. The agent sees what the policy of this project sees
    (errors in their unit and the previous input, scaled to -1..1) and acts in -1..1, which is mapped onto the bounds.
    """

    def __init__(self, params: Params, n_steps: int) -> None:
        """The task that the parameters describe, with episodes of `n_steps` samples."""
        process, case, features = params.process, params.case, params.features
        dt = process.sampling_time
        self.n_steps = n_steps
        self.sampling_time = dt
        self.state_step = np.eye(len(process.drift_state)) + np.array(process.drift_state) * dt
        self.input_step = np.array(process.drift_input) * dt
        self.disturbance_step = np.array(process.disturbance) * dt**0.5
        self.observation_noise = np.array(process.observation_noise)
        self.initial_mean, self.initial_std = np.array(case.initial_mean), np.array(case.initial_std)
        self.set_point, self.error_scale = np.array(case.set_point), np.array(case.scale_of_error)
        low, high = np.array(process.input_low), np.array(process.input_high)
        self.middle, self.half = (high + low) / 2, (high - low) / 2
        self.error_unit = np.array(params.learning.policy.error_unit)
        self.beta, self.initial_error = features.beta, features.initial_error
        self.on_state = features.features_on == "x"
        weights = initial_weights(params.learning.variants["improved"].weights, len(self.set_point), torch.float64)
        self.weights = weights.numpy()
        n_seen = len(self.set_point) + len(self.middle)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n_seen,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(self.middle),), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """A fresh episode; the input before it was u* = 0."""
        super().reset(seed=seed)
        self.t = 0
        self.x = self.initial_mean + self.initial_std * self.np_random.standard_normal(len(self.initial_mean))
        self.accumulated = np.zeros_like(self.set_point)
        self.magnitude = np.full_like(self.set_point, self.initial_error)
        return self._observe(-self.middle / self.half), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One sample; info holds state, observation and applied input. The horizon belongs to the task: its end is terminal."""
        u = self.middle + self.half * np.clip(action, -1.0, 1.0)
        noise = self.np_random.standard_normal(len(self.x))
        self.x = self.state_step @ self.x + self.input_step @ u + self.disturbance_step * self.x * noise
        seen = self._observe((u - self.middle) / self.half)
        error = (self.set_point - (self.x if self.on_state else self.y)) / self.error_scale
        magnitude = np.abs(error)
        self.accumulated += magnitude * self.sampling_time
        rate = (magnitude - self.magnitude) / self.sampling_time
        self.magnitude = magnitude
        reward = self.weights @ np.concatenate([np.exp(-((self.beta * error) ** 2)), self.accumulated, rate])
        self.t += 1
        return seen, float(reward), self.t == self.n_steps, False, {"x": self.x, "y": self.y, "u": u}

    def _observe(self, previous: np.ndarray) -> np.ndarray:
        self.y = self.x * (1 + self.observation_noise * self.np_random.standard_normal(len(self.x)))
        return np.concatenate([(self.set_point - self.y) / self.error_unit, previous]).astype(np.float32)


def library_learner(params: Params, n_environments: int, n_steps: int, passes: int, episodes: int = 1) -> RecurrentPPO:
    """RecurrentPPO with the layers of this project's policy, in settings that favour its speed.

    The value function is one linear layer on the policy's own LSTM, and the whole batch is one minibatch.

    Args:
        passes: gradient passes over each batch. The library's default is 10; this project's learner takes one.
        episodes: of each environment in a batch.
    """
    cells = params.learning.policy.hidden_cells
    batch = episodes * n_steps
    environment = DummyVecEnv([lambda: ProcessEnv(params, n_steps)] * n_environments)
    return RecurrentPPO(
        "MlpLstmPolicy",
        environment,
        n_steps=batch,
        batch_size=batch * n_environments,
        n_epochs=passes,
        seed=0,
        policy_kwargs={
            "lstm_hidden_size": cells[0],
            "n_lstm_layers": len(cells),
            "net_arch": [],
            "shared_lstm": True,
            "enable_critic_lstm": False,
        },
    )
