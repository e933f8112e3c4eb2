"""Behavioural cloning: supervised learning of recorded inputs with the same LSTM policy, to compare apprenticeship with."""

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from helpers.learning.learner import TrainingError, annealed
from helpers.learning.optimiser import Adam
from helpers.learning.policy import LSTMPolicy
from helpers.plant.task import ControlTask, Trajectories
from helpers.settings.evidence import CloningParams


def cloning_loss(policy: LSTMPolicy, demonstrations: Trajectories, rows: Tensor, task: ControlTask) -> Tensor:
    """Mean squared difference between the policy's mode and the recorded input, as a share of the input range; a scalar.

    The policy reads the recorded past, y_0..y_t and u_0..u_{t-1}, not the one that its own inputs would have led to.

    Args:
        rows: which of the trajectories, shape (n,).
    """
    y, u = demonstrations.y[:, rows], demonstrations.u[:, rows]
    mean, _ = policy(y, u, task)
    return (((mean - u) / (task.input_high - task.input_low)) ** 2).mean()


@dataclass(frozen=True)
class Cloning:
    """A cloned policy, the step it was taken from, and its loss on the demonstrations held back for validation."""

    policy: LSTMPolicy
    chosen_step: int
    loss: float


def clone(
    policy: LSTMPolicy,
    demonstrations: Trajectories,
    task: ControlTask,
    params: CloningParams,
    n_steps: int,
    generator: torch.Generator,
) -> Cloning:
    """Fit a policy to recorded inputs by Adam on random batches, and keep the step with the least validation loss.

    No model of the process is used. Part of the demonstrations (the last ones, at least one) is held back for validation.

    Raises:
        TrainingError: if there are fewer than two demonstrations, or the loss is not finite.
    """
    n_all = demonstrations.n_trajectories
    if n_all < 2:
        raise TrainingError(f"cloning needs two demonstrations or more, one of them to validate on, found {n_all}")
    n_held = max(1, round(params.validation * n_all))
    held, used = torch.arange(n_all - n_held, n_all), n_all - n_held
    optimiser = Adam(policy.parameters())
    best = Cloning(policy, 0, float("inf"))
    for step in range(1, n_steps + 1):
        rows = torch.randperm(used, generator=generator)[: params.batch]
        policy.zero_grad()
        cloning_loss(policy, demonstrations, rows, task).backward()
        optimiser.step(annealed(params.learning_rate_start, params.learning_rate_end, (step - 1) / max(1, n_steps - 1)))
        if step % params.check_every == 0 or step == n_steps:
            with torch.no_grad():
                loss = cloning_loss(policy, demonstrations, held, task).item()
            if not math.isfinite(loss):
                raise TrainingError(f"cloning, step {step}: the loss is not finite")
            if loss < best.loss:
                best = Cloning(copy.deepcopy(policy), step, loss)
    return best
