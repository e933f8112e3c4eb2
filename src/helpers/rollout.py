"""Process and controller in closed loop: batched episodes."""

import torch

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
    dtype = task.set_point.dtype
    start = torch.randn(n_trajectories, process.n_states, generator=generator, dtype=dtype)
    disturbance = torch.randn(n_steps, n_trajectories, process.n_states, generator=generator, dtype=dtype)
    observation = torch.randn(n_steps + 1, n_trajectories, process.n_outputs, generator=generator, dtype=dtype)
    x = torch.empty(n_steps + 1, n_trajectories, process.n_states, dtype=dtype)
    y = torch.empty(n_steps + 1, n_trajectories, process.n_outputs, dtype=dtype)
    u = torch.empty(n_steps, n_trajectories, process.n_inputs, dtype=dtype)
    command = torch.empty_like(u)
    x[0] = task.initial_mean + task.initial_std * start
    y[0] = process.observe(x[0], observation[0])
    with torch.no_grad():
        memory = controller.start(n_trajectories, n_steps, generator)
        for t in range(n_steps):
            command[t], memory = controller.act(y[t], memory)
            torch.clamp(command[t], task.input_low, task.input_high, out=u[t])
            x[t + 1] = process.step(x[t], u[t], disturbance[t])
            y[t + 1] = process.observe(x[t + 1], observation[t + 1])
    return Trajectories(x, y, u, command)
