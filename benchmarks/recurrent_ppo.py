"""The same task in a general library: RecurrentPPO of sb3-contrib on a gymnasium environment of the process."""

from dataclasses import replace

import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import DummyVecEnv

from helpers.evidence.gym_environment import TrackingEnv
from helpers.learning.algorithm_2 import initial_weights
from helpers.plant.process import LinearProcess
from helpers.plant.task import ControlTask
from helpers.settings.paper import Params


class ProcessEnv(TrackingEnv):
    """One episode of a case study under the reward of Eq. 4.2.5: what offline learning meets, T steps."""

    def __init__(self, params: Params, n_steps: int) -> None:
        """The task that the parameters describe, with episodes of `n_steps` samples."""
        process, features = LinearProcess(params.process, torch.float64), params.features
        task = replace(ControlTask.from_params(params.process, params.case, torch.float64), n_steps=n_steps)
        super().__init__(process, task, params.learning.policy, features.beta)
        self.sampling_time, self.initial_error = process.sampling_time, features.initial_error
        self.on_state = features.features_on == "x"
        weights = initial_weights(params.learning.variants["improved"].weights, len(self.set_point), torch.float64)
        self.weights = weights.numpy()

    def begin(self, batch: tuple[int, ...]) -> np.ndarray:
        """Begin a batch of episodes; nothing has accumulated yet."""
        seen = super().begin(batch)
        self.accumulated = np.zeros_like(self.x)
        self.magnitude = np.full_like(self.x, self.initial_error)
        return seen

    def advance(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One sample of the whole batch: what is seen, and the weighted features."""
        seen, _ = super().advance(action)
        error = (self.set_point - (self.x if self.on_state else self.y)) / self.error_scale
        magnitude = np.abs(error)
        self.accumulated = self.accumulated + magnitude * self.sampling_time
        rate = (magnitude - self.magnitude) / self.sampling_time
        self.magnitude = magnitude
        features = np.concatenate([np.exp(-((self.beta * error) ** 2)), self.accumulated, rate], axis=-1)
        return seen, features @ self.weights


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
