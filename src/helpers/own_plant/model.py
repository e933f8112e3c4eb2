"""What may stand for a plant: an identified linear model, a class of the user's own, or a gymnasium environment.

Each is a `process.Process` in deviation variables.
"""

import importlib
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import torch
from torch import Tensor

from helpers.own_plant.description import PlantDescription
from helpers.plant.process import Process
from helpers.settings.leaf import InputError

GYMNASIUM = "gymnasium:"


@dataclass
class LinearModel:
    """A discrete-time linear state-space model with its disturbance and its measurement noise.

    x_{t+1} = A x_t + B u_t + c + s_w(x_t) w_t, y_t = C x_t + s_v(x_t) v_t with w, v ~ N(0, I); one step is one sample.
    Both standard deviations have a fixed part and one that grows with the deviation as in Eq. 4.1.3c and 4.1.4b:
    s(x)^2 = fixed^2 + (gain x)^2.

    The first n_y states are the outputs without noise, so C is (I, 0); with more than one lag the states also hold
    earlier outputs and inputs.

    Attributes:
        state_step: A (n_x, n_x). input_step: B (n_x, n_u). constant: c (n_x,).
        disturbance, disturbance_gain: of s_w, (n_x,). noise, noise_gain: of s_v, (n_y,).
    """

    state_step: Tensor
    input_step: Tensor
    constant: Tensor
    disturbance: Tensor
    disturbance_gain: Tensor
    noise: Tensor
    noise_gain: Tensor

    def __post_init__(self) -> None:
        self.n_states, self.n_inputs = self.input_step.shape
        self.n_outputs = len(self.noise)

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The next state, shape (K, n_x)."""
        kick = (self.disturbance**2 + (self.disturbance_gain * x) ** 2).sqrt() * noise
        return torch.addmm(self.constant + kick, x, self.state_step.T).addmm_(u, self.input_step.T)

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The outputs, shape (K, n_y)."""
        outputs = x[:, : self.n_outputs]
        return outputs + (self.noise**2 + (self.noise_gain * outputs) ** 2).sqrt() * noise

    def to(self, dtype: torch.dtype) -> "LinearModel":
        """The same in another number type."""
        return LinearModel(*(getattr(self, entry.name).to(dtype) for entry in fields(self)))


class GymnasiumPlant:
    """A gymnasium environment as a process: one copy an episode.

    The observation must be the controlled variables and the action the manipulated ones, in engineering units and in the order
    of the description. An environment keeps its state to itself and draws its own noise and its own first state, seeded by
    the noise handed in; so x is the last observation, and observing without a step before begins new episodes.
    """

    def __init__(self, environment: str, description: PlantDescription) -> None:
        gymnasium = importlib.import_module("gymnasium")
        self.make = partial(gymnasium.make, environment)
        try:
            self.copies: list[Any] = [self.make()]
        except (gymnasium.error.Error, ImportError, AttributeError, TypeError, ValueError) as error:
            raise InputError(f"plant '{GYMNASIUM}{environment}': it cannot be made: {error}") from error
        self.steady_y = description.steady("controlled")
        self.steady_u = description.steady("manipulated")
        self.n_states = self.n_outputs = len(self.steady_y)
        self.n_inputs = len(self.steady_u)
        self._stepped = False
        spaces = {
            "observation": (self.copies[0].observation_space, self.n_outputs),
            "action": (self.copies[0].action_space, self.n_inputs),
        }
        for name, (space, expected) in spaces.items():
            if getattr(space, "shape", None) != (expected,):
                raise InputError(f"{GYMNASIUM}{environment}: expected {name}s of shape ({expected},), found {space}")

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """One step of every environment, shape (K, n_y); one that has ended stays where it was."""
        for index, action in enumerate((u.double() + self.steady_u).numpy()):
            if not self._ended[index]:
                copy = self.copies[index]
                found, _, self._ended[index], _, _ = copy.step(action.astype(copy.action_space.dtype))
                self._y[index] = torch.as_tensor(found, dtype=torch.float64)
        self._stepped = True
        return (self._y - self.steady_y).to(x.dtype)

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The observations as they are, shape (K, n_y); those of fresh environments where no step went before."""
        if not self._stepped:
            self.copies += [self.make() for _ in range(len(x) - len(self.copies))]
            seeds = (noise.double()[:, 0].abs() * 1e6).long().tolist()
            first = [copy.reset(seed=seed)[0] for copy, seed in zip(self.copies, seeds, strict=False)]
            self._y = torch.stack([torch.as_tensor(y, dtype=torch.float64) for y in first])
            self._ended = [False] * len(x)
        self._stepped = False
        return (self._y - self.steady_y).to(x.dtype)


def load_plant(name: str, description: PlantDescription) -> Process:
    """What stands for the plant: `package.module:Class`, called with the description, or `gymnasium:Id`.

    Raises:
        InputError: if it cannot be imported or made, lacks one of the things that a process needs, or has other sizes.
    """
    if name.startswith(GYMNASIUM):
        try:
            return GymnasiumPlant(name.removeprefix(GYMNASIUM), description)
        except ImportError as error:
            raise InputError(f"plant '{name}': gymnasium is not installed; the extra 'bench' has it") from error
    module, _, attribute = name.partition(":")
    try:
        plant = getattr(importlib.import_module(module), attribute)(description)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise InputError(f"plant '{name}': expected package.module:Class that takes the description: {error}") from error
    sizes = {"n_outputs": len(description.controlled), "n_inputs": len(description.manipulated)}
    for key in ("n_states", "n_outputs", "n_inputs", "step", "observe"):
        if not hasattr(plant, key):
            raise InputError(f"plant '{name}': it lacks '{key}'")
        if getattr(plant, key) != sizes.get(key, getattr(plant, key)):
            raise InputError(f"plant '{name}': '{key}' is {getattr(plant, key)}, the description has {sizes[key]}")
    x, u, y = (torch.zeros(1, n) for n in (plant.n_states, plant.n_inputs, plant.n_outputs))
    for key, found, expected in (("step", plant.step(x, u, x), x), ("observe", plant.observe(x, y), y)):
        if found.shape != expected.shape:
            raise InputError(f"plant '{name}': '{key}' gave the shape {tuple(found.shape)}, expected {tuple(expected.shape)}")
    checked: Process = plant
    return checked
