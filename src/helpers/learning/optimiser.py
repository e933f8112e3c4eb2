"""Adam without torch's compiler: the class `torch.optim.Adam` loads it, which takes longer than many a stage's own work."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import nn
from torch.optim.adam import adam

# One kernel for all parameters (`fused`) takes a fifth of the time of one for each.
DEFAULTS: Any = {
    "amsgrad": False,
    "beta1": 0.9,
    "beta2": 0.999,
    "weight_decay": 0.0,
    "eps": 1e-8,
    "maximize": False,
    "fused": True,
    "foreach": False,
}


class Adam:
    """The optimiser of Kingma and Ba (2015) by torch's own functional `adam`: the numbers of torch's class with `fused`."""

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        self.parameters = list(parameters)
        # First and second moment of the gradient, and the number of steps.
        self.state = [(torch.zeros_like(p.data), torch.zeros_like(p.data), torch.tensor(0.0)) for p in self.parameters]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move the parameters against the gradients that they hold, at this learning rate; one without a gradient stays."""
        held = [(p, p.grad, *state) for p, state in zip(self.parameters, self.state, strict=True) if p.grad is not None]
        if held:
            parameters, gradients, means, squares, counts = (list(column) for column in zip(*held, strict=True))
            adam(parameters, gradients, means, squares, [], counts, lr=rate, **DEFAULTS)
