"""Process and controller in closed loop: batched episodes."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from helpers.controllers import Controller
from helpers.process import Process
from helpers.task import ControlTask
from helpers.trajectories import Trajectories


def rollout(
    process: Process,
    controller: Controller,
    task: ControlTask,
    n_trajectories: int,
    generator: torch.Generator,
) -> Trajectories:
    """Run `n_trajectories` episodes of the task side by side, Eq. 3.1.6.

    Every random number of the process is drawn before the loop: it is faster, and the disturbances that a trajectory
    meets do not depend on the controller, so that two controllers can be compared on the same draws.
    """
    n_steps = task.n_steps

    def batch(n_times: int, n_variables: int, fill: Callable[..., Tensor]) -> Tensor:
        # In memory the trajectories come last: a step then works on long rows, not on many short ones.
        return fill((n_times, n_variables, n_trajectories), dtype=task.set_point.dtype).mT

    draw = partial(torch.randn, generator=generator)
    start = batch(1, process.n_states, draw)[0]
    disturbance = batch(n_steps, process.n_states, draw).unbind(0)
    noise = batch(n_steps + 1, process.n_outputs, draw).unbind(0)
    x, y = batch(n_steps + 1, process.n_states, torch.empty), batch(n_steps + 1, process.n_outputs, torch.empty)
    u, command = batch(n_steps, process.n_inputs, torch.empty), batch(n_steps, process.n_inputs, torch.empty)
    x[0] = state = task.initial_mean + task.initial_std * start
    y[0] = observation = process.observe(state, noise[0])
    with torch.no_grad():
        memory = controller.start(n_trajectories, n_steps, generator)
        for t, (applied, asked) in enumerate(zip(u.unbind(0), command.unbind(0), strict=True)):
            action, memory = controller.act(observation, memory)
            asked.copy_(action)
            torch.clamp(asked, task.input_low, task.input_high, out=applied)
            x[t + 1] = state = process.step(state, applied, disturbance[t])
            y[t + 1] = observation = process.observe(state, noise[t + 1])
    return Trajectories(x, y, u, command)
