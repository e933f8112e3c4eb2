"""What may stand for a plant: an identified linear model, a class of the user's own, or a gymnasium environment.

Each is a `process.Process` in deviation variables.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from helpers.own_plant.description import PlantDescription
from helpers.plant.process import Process
from helpers.settings.leaf import InputError

GYMNASIUM = "gymnasium:"
PARAMETERS = ("window", "entry", "constant", "spread")  # of the models side by side


@dataclass
class ArmaxModel:
    """Models of a plant side by side, deviation variables; one step is one sample.

    y_{t+1} = W x_t + V u_t + c + e_{t+1} with x_t = (y_t, y_{t-1}, .., u_{t-1}, .., e_t, e_{t-1}, ..). What is measured is a state,
    and the innovations e carry disturbance and noise of the sensor at once. Their standard deviation has a fixed part and one
    that grows with the deviation, as in Eq. 4.1.3c and 4.1.4b: s(y)^2 = fixed^2 + (gain y)^2.

    Attributes:
        window: W (M, n_y, n_x). entry: V (M, n_y, n_u). constant: c (M, n_y). spread: fixed part and gain of s, (M, n_y, 2).
        lags: of y and of e that x holds. taps: of u, the present one included.
    """

    window: Tensor
    entry: Tensor
    constant: Tensor
    spread: Tensor
    lags: int
    taps: int

    def __post_init__(self) -> None:
        _, self.n_outputs, self.n_inputs = self.entry.shape
        self.n_states, self.n_disturbances = self.window.shape[2], self.n_outputs
        self.growing = bool(self.spread[..., 1].any())

    def __len__(self) -> int:
        return len(self.window)

    def members(self, index: Tensor | slice) -> "ArmaxModel":
        """Some of the models, a model an entry of the index."""
        return replace(self, **{name: getattr(self, name)[index] for name in PARAMETERS})

    def to(self, dtype: torch.dtype) -> "ArmaxModel":
        """The same in another number type."""
        return replace(self, **{name: getattr(self, name).to(dtype) for name in PARAMETERS})

    def step(self, x: Tensor, u: Tensor, noise: Tensor) -> Tensor:
        """The next state, shape (K, n_x), of one model or of one an episode; of the noise the first n_y columns count."""
        n_y, n_u = self.n_outputs, self.n_inputs
        y = self.constant + (self.window @ x[..., None] + self.entry @ u[..., None])[..., 0]
        size = (self.spread[..., 0] ** 2 + (self.spread[..., 1] * y) ** 2).sqrt() if self.growing else self.spread[..., 0]
        e = size * noise[:, :n_y]
        widths = [n_y * self.lags, n_u * (self.taps - 1), n_y * self.lags]
        outputs, inputs, innovations = x.split(widths, dim=-1)
        moved = torch.cat([u, inputs], dim=-1)[:, : widths[1]]
        return torch.cat([y + e, outputs[:, :-n_y], moved, e, innovations[:, :-n_y]], dim=-1)

    def observe(self, x: Tensor, noise: Tensor) -> Tensor:
        """The outputs, shape (K, n_y), which hold their noise already."""
        return x[:, : self.n_outputs]

    def at_rest(self, y: Tensor, held: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """The state (K, n_x), the outputs and the input (K, n_u) at which the undisturbed models rest with some outputs at y.

        Args:
            y: (K, n_y), of which only the outputs in `held` count.
        """
        n_y, n_u = self.n_outputs, self.n_inputs
        own = self.window[..., : n_y * self.lags].unflatten(-1, (self.lags, n_y)).sum(-2)  # sum of the A_i, (M, n_y, n_y)
        gain = self.entry + self.window[..., n_y * self.lags : -n_y * self.lags].unflatten(-1, (-1, n_u)).sum(-2)
        kept = torch.eye(n_y, dtype=own.dtype) - own
        rows = list(held)
        need = (kept[:, rows][..., rows] @ y[:, rows, None])[..., 0] - self.constant[:, rows]
        u = (torch.linalg.pinv(gain[:, rows]) @ need[..., None])[..., 0]
        rest = y.clone()
        for index in set(range(n_y)) - set(rows):
            rest[:, index] = ((gain[:, index] * u).sum(-1) + self.constant[:, index]) / kept[:, index, index]
        x = torch.cat([rest.repeat(1, self.lags), u.repeat(1, self.taps - 1), torch.zeros_like(rest).repeat(1, self.lags)], dim=-1)
        return x, rest, u


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
        self.n_states = self.n_outputs = self.n_disturbances = len(self.steady_y)
        self.n_inputs = len(self.steady_u)
        self._stepped = False
        for name, expected in (("observation", self.n_outputs), ("action", self.n_inputs)):
            space = getattr(self.copies[0], f"{name}_space")
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
    for key in ("n_states", "n_outputs", "n_inputs", "n_disturbances", "step", "observe"):
        if not hasattr(plant, key):
            raise InputError(f"plant '{name}': it lacks '{key}'")
        if getattr(plant, key) != sizes.get(key, getattr(plant, key)):
            raise InputError(f"plant '{name}': '{key}' is {getattr(plant, key)}, the description has {sizes[key]}")
    x, u, y, w = (torch.zeros(1, n) for n in (plant.n_states, plant.n_inputs, plant.n_outputs, plant.n_disturbances))
    for key, found, expected in (("step", plant.step(x, u, w), x), ("observe", plant.observe(x, y), y)):
        if found.shape != expected.shape:
            raise InputError(f"plant '{name}': '{key}' gave the shape {tuple(found.shape)}, expected {tuple(expected.shape)}")
    checked: Process = plant
    return checked
