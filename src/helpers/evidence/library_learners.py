"""PPO and RecurrentPPO of stable-baselines3 and sb3-contrib on the real objective.

It needs the packages of the extra `alternatives`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from torch import Tensor

from helpers.evidence.gym_environment import TrackingEnv
from helpers.learning.policy import Scaling
from helpers.plant.process import LinearProcess
from helpers.plant.task import ControlTask
from helpers.settings.limits import LibraryParams
from helpers.settings.paper import PolicyParams

NAMES = ("ppo", "recurrent_ppo")


class HeadStartPolicy(RecurrentActorCriticPolicy):
    """The library's recurrent policy without its loop over time.

    The library goes step by step through every batch in which an episode starts, because the state has to be reset there. In a
    batch of whole episodes they start at the head of a sequence only: with the state reset before, one call of the LSTM will do.
    """

    @staticmethod
    def _process_sequence(
        features: Tensor, lstm_states: tuple[Tensor, Tensor], episode_starts: Tensor, lstm: torch.nn.LSTM
    ) -> tuple[Tensor, Tensor]:
        starts = episode_starts.reshape(lstm_states[0].shape[1], -1)
        if not starts[:, 1:].any():
            kept = (1 - starts[:, 0])[None, :, None]
            lstm_states = (kept * lstm_states[0], kept * lstm_states[1])
            episode_starts = torch.zeros_like(episode_starts)
        output: tuple[Tensor, Tensor] = RecurrentActorCriticPolicy._process_sequence(features, lstm_states, episode_starts, lstm)
        return output


class TrackingEnvs(VecEnv):
    """Episodes side by side as the library wants them, stepped as one batch and not one after the other."""

    def __init__(self, env: TrackingEnv, n_episodes: int) -> None:
        super().__init__(n_episodes, env.observation_space, env.action_space)
        self.env = env

    def reset(self) -> VecEnvObs:
        """Fresh episodes; those begun after `seed` was called are the same every time."""
        self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return self.env.begin((self.num_envs,))

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One sample of every episode. All end together, and the next begin at once."""
        seen, rewards = self.env.advance(self._actions)
        over = self.env.over
        infos: list[dict[str, Any]] = [{"terminal_observation": last} for last in seen] if over else [{} for _ in seen]
        return self.env.begin((self.num_envs,)) if over else seen, rewards, np.full(self.num_envs, over), infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, the same in every episode."""
        return [getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute for all episodes."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method once, for all episodes."""
        return [getattr(self.env, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No episode is wrapped."""
        return [False] * self.num_envs


@dataclass
class LibraryMemory:
    """The network's own state, if it has one, and the input applied last (K, n_u)."""

    state: Any
    u_previous: Tensor
    first: bool


class LibraryController:
    """The mode of a learned policy of the library, as a controller of this project."""

    def __init__(self, model: OnPolicyAlgorithm, task: ControlTask, scaling: Scaling) -> None:
        self.model = model
        self.task = task
        self.scaling = scaling

    def start(self, n_trajectories: int, n_steps: int, generator: torch.Generator) -> LibraryMemory:
        """No state yet, and the input at u* = 0."""
        return LibraryMemory(None, self.task.input_low.new_zeros(n_trajectories, len(self.task.input_low)), True)

    def act(self, observation: Tensor, memory: LibraryMemory) -> tuple[Tensor, LibraryMemory]:
        """The network's action mapped from -1..1 onto the bounds."""
        seen = self.scaling.inputs(observation, memory.u_previous).float().numpy()
        starts = np.full(len(seen), memory.first)
        action, state = self.model.predict(seen, state=memory.state, episode_start=starts, deterministic=True)
        low, high = self.task.input_low, self.task.input_high
        u = (high + low) / 2 + (high - low) / 2 * torch.from_numpy(action).to(observation.dtype)
        return u, LibraryMemory(state, u, False)


class _BetweenEpochs(BaseCallback):
    """Calls `visit` with the number of finished episodes before each batch is collected, and sets the sharpness of the reward."""

    def __init__(self, visit: Callable[[int], None], beta_at: Callable[[int], float], n_steps: int) -> None:
        super().__init__()
        self.visit = visit
        self.beta_at = beta_at
        self.n_steps_of_episode = n_steps

    def _on_rollout_start(self) -> None:
        episodes = self.num_timesteps // self.n_steps_of_episode
        self.training_env.set_attr("beta", self.beta_at(episodes))
        self.visit(episodes)

    def _on_step(self) -> bool:
        return True


def library_learner(
    name: str,
    process: LinearProcess,
    task: ControlTask,
    policy: PolicyParams,
    params: LibraryParams,
    discount: float,
    episodes: int,
    seed: int,
) -> OnPolicyAlgorithm:
    """A fresh learner: PPO with a network of its own without memory, or RecurrentPPO with the layers of Section 3.2.

    Args:
        episodes: of a batch, each in an environment of its own.
    """
    environments = TrackingEnvs(TrackingEnv(process, task, policy, 1.0), episodes)
    deviation = math.log(2 * params.initial_std)  # the actions' range is two
    common: dict[str, Any] = {
        "n_steps": task.n_steps,
        "batch_size": max(2, task.n_steps * episodes // params.minibatches),
        "n_epochs": params.passes,
        "learning_rate": lambda remaining: remaining * params.learning_rate,
        "gamma": discount,
        "gae_lambda": params.gae_decay,
        "seed": seed,
        "device": "cpu",
    }
    if name == "ppo":
        return PPO("MlpPolicy", environments, policy_kwargs={"net_arch": list(params.network), "log_std_init": deviation}, **common)
    cells = policy.hidden_cells
    layers = {"lstm_hidden_size": cells[0], "n_lstm_layers": len(cells), "net_arch": [], "log_std_init": deviation}
    return RecurrentPPO(HeadStartPolicy, environments, policy_kwargs=layers, **common)


def learn(
    model: OnPolicyAlgorithm, task: ControlTask, n_episodes: int, beta_at: Callable[[int], float], visit: Callable[[int], None]
) -> None:
    """Learn from so many episodes; `visit` is called with the episodes spent, before each batch and at the end."""
    model.learn(n_episodes * task.n_steps, callback=_BetweenEpochs(visit, beta_at, task.n_steps))
    visit(model.num_timesteps // task.n_steps)
