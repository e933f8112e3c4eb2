"""One policy for every set point of the paper's process, by the gradient through the model: notebook 09. Ours, not the paper's."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from helpers.learning.features import closeness, discounts
from helpers.plant.process import LinearProcess
from helpers.plant.tracking import Bounds, Scenarios, Tracked


@dataclass(frozen=True)
class Range:
    low: Tensor
    high: Tensor
    least: Tensor
    initial_std: Tensor
    margin: float
    load: float
    T: int

    def scale(self, sp):
        """y_sp - y_ss of Eq. 4.2.1, no smaller than the least."""
        return torch.where(sp < 0, -1.0, 1.0) * sp.abs().maximum(self.least)


def draw(process: LinearProcess, r: Range, bounds: Bounds, K, gen) -> Scenarios:
    def uni(*shape): return torch.rand(*shape, generator=gen, dtype=r.low.dtype)
    def nrm(*shape): return torch.randn(*shape, generator=gen, dtype=r.low.dtype)
    n = process.n_states
    if r.margin:
        f = 1 + r.margin * (2 * uni(2, K) - 1)
        process = process.scaled(f[0], f[1])
    sp = r.low + (r.high - r.low) * uni(K, n)
    when = (uni(K) * r.T * 2).long()  # half without
    load = r.load * bounds.span * nrm(K, process.n_inputs)
    load = load * (torch.arange(r.T)[:, None] >= when)[..., None]
    return Scenarios(process, sp.expand(r.T, K, n), load, r.initial_std * nrm(K, n), sp.new_zeros(K, process.n_inputs), nrm(r.T, K, n), nrm(r.T + 1, K, n))


def lost(scenarios: Scenarios, run: Tracked, r: Range, beta: float, gamma: float) -> Tensor:
    """What an episode loses against a perfect one; expectation over the disturbance of each step."""
    scale = r.scale(scenarios.set_point)
    p = scenarios.process
    x = run.x[:-1]
    s = p._disturbance_step * x / scale
    mean = (run.set_point - (run.x[1:] - p._disturbance_step * x * scenarios.disturbance)) / scale
    wide = 1 + 2 * (beta * s) ** 2
    reward = (torch.exp(-((beta * mean) ** 2) / wide) / wide.sqrt()).sum(-1)
    return 1-(discounts(r.T, gamma, reward) @ reward) / 40
