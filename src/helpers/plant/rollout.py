"""Process and controller in closed loop: batched episodes."""

import zlib

import numpy as np
import torch
from torch import Tensor

from helpers.plant.controllers import Controller
from helpers.plant.process import Process
from helpers.plant.task import ControlTask, Trajectories


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

    def draw(n_times: int, n_variables: int) -> tuple[Tensor, ...]:
        # In memory the trajectories come last: a step then works on long rows, not on many short ones.
        return torch.randn(n_times, n_variables, n_trajectories, generator=generator, dtype=task.set_point.dtype).mT.unbind(0)

    (start,) = draw(1, process.n_states)
    disturbance, noise = draw(n_steps, process.n_disturbances), draw(n_steps + 1, process.n_outputs)
    x = [task.initial_mean + task.initial_std * start]
    y = [process.observe(x[0], noise[0])]
    u, command = [], []
    with torch.no_grad():
        memory = controller.start(n_trajectories, n_steps, generator)
        for t in range(n_steps):
            asked, memory = controller.act(y[t], memory)
            command.append(asked)
            u.append(torch.clamp(asked, task.input_low, task.input_high))
            x.append(process.step(x[t], u[t], disturbance[t]))
            y.append(process.observe(x[t + 1], noise[t + 1]))
    return Trajectories(*(torch.stack([entry.T for entry in signal]).mT for signal in (x, y, u, command)))


def stream(seed: int, *purpose: str | int) -> torch.Generator:
    """A generator that depends on the seed and on what it is for, and on nothing else.

    Streams with different purposes are independent (numpy's SeedSequence), so that drawing more numbers in one
    stage does not shift those of another.
    """
    words = [zlib.crc32(str(word).encode()) for word in purpose]
    state = np.random.SeedSequence([seed, *words]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))
