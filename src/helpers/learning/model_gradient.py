"""Improvement through the model: the policy gradient by backpropagation through a differentiable process. Ours, not the paper's.

With every random number drawn beforehand (w of Eq. 4.1.3, v of Eq. 4.1.4), an episode is a smooth function of the policy's
parameters theta, and so is its cost: d J / d theta = E[sum_t d R_t / d u_t' d u_t' / d theta] by the chain rule through the process
(reparameterisation; differentiable predictive control, Drgona et al. 2022, arXiv 2011.03699). REINFORCE, Eq. 3.2.4, estimates the
same gradient from returns alone: it needs no model, but explores, and its variance grows with the episode. This one needs a
process whose `step` torch can differentiate, draws no input at random, and costs no episode of the plant.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from helpers.learning.learner import TrainingError, annealed
from helpers.learning.tracking_policy import TrackingPolicy
from helpers.plant.process import Process
from helpers.plant.tracking import Bounds, Scenarios, Tracked, track

PATIENCE = 5  # steps after each other without a finite gradient
Draw = Callable[[], Scenarios]
Watch = Callable[["GradientRecord"], object]  # called with the record of each step
Measure = Callable[[Scenarios, Tracked], tuple[Tensor, Tensor]]  # of each episode: cost, and movement as a share of what is allowed


@dataclass(frozen=True)
class GradientRecord:
    """One gradient step: mean cost, movement as a share of what is allowed, the price on it, and the length of the gradient."""

    epochs: int
    cost: float
    movement: float
    price: float
    gradient: float


@dataclass(frozen=True)
class Descent:
    """How the steps are taken.

    Attributes:
        steps: how many. rate_start, rate_end: Adam's step size, along half a cosine. longest: of the gradient, cut beyond it.
        price, price_step: on movement at the start, and how far it moves after a step (dual ascent). slack: the share of the
            allowed movement that is aimed at, since the constraint holds on average only.
    """

    steps: int
    rate_start: float = 5e-3
    rate_end: float = 2.5e-4
    longest: float = 1.0
    price: float = 0.1
    price_step: float = 0.05
    slack: float = 0.95


def differentiable(process: Process, x: Tensor, u: Tensor) -> bool:
    """Whether torch can differentiate the step of a process from states (K, n_x) in its inputs (K, n_u)."""
    u = u.detach().clone().requires_grad_()
    try:
        return process.step(x, u, x.new_zeros(len(x), process.n_disturbances)).requires_grad
    except RuntimeError:  # numpy takes no tensor that carries a gradient
        return False


def model_gradient(
    policy: TrackingPolicy, draw: Draw, measure: Measure, bounds: Bounds, descent: Descent, watch: Watch = lambda record: None
) -> list[GradientRecord]:
    """Improve a policy in place: lower the mean cost, with no more movement than allowed.

    Each step draws episodes anew, with set points, loads and models of their own, and goes down the gradient of
    cost + price (movement - slack). The price is a Lagrange multiplier: it rises while the movement exceeds its limit.

    Args:
        draw: gives the episodes of a step. measure: what they cost.

    Raises:
        TrainingError: if cost or gradient are not finite in several steps after each other; a single one is left out.
    """
    optimiser = torch.optim.Adam(policy.parameters(), lr=descent.rate_start)
    price, records, lost = descent.price, [], 0
    for step in range(descent.steps):
        for group in optimiser.param_groups:
            group["lr"] = annealed(descent.rate_start, descent.rate_end, step / max(1, descent.steps - 1))
        scenarios = draw()
        if step == 0 and not differentiable(scenarios.process, scenarios.start, scenarios.before):
            raise TrainingError(
                "torch cannot differentiate this process, so there is no gradient through it: take REINFORCE (Algorithm 1)"
            )
        cost, movement = (part.mean() for part in measure(scenarios, track(policy, scenarios, bounds)))
        optimiser.zero_grad()
        (cost + price * (movement - descent.slack)).backward()
        length = nn.utils.clip_grad_norm_(policy.parameters(), descent.longest)
        lost = 0 if torch.isfinite(cost) and torch.isfinite(length) else lost + 1  # on some model the loop ran away
        if lost > PATIENCE:
            raise TrainingError(f"gradient step {step + 1}: the cost of the policy or its gradient is not finite")
        if lost:
            continue
        optimiser.step()
        records.append(GradientRecord(step + 1, cost.item(), movement.item(), price, length.item()))
        price = max(0.0, price + descent.price_step * (movement.item() - descent.slack))
        watch(records[-1])
    return records
