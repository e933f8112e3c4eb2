"""Two seeds learning side by side, each in a process of its own with one thread, as Snakemake runs them."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import torch

PROCESSES = 2
_epoch: Callable[[], object] | None = None  # of this process


def _set_up(K: int, T: int) -> None:
    global _epoch  # noqa: PLW0603 (a process of a pool keeps what its initialiser made)
    from benchmarks.subjects import Workload  # noqa: PLC0415 (which imports this module)

    torch.set_num_threads(1)
    _epoch = Workload.of().epoch(K, T)


def _learn(epochs: int) -> None:
    assert _epoch is not None
    for _ in range(epochs):
        _epoch()


class SideBySide:
    """Epochs of two learners at once; the processes start with the first call and end with this one."""

    def __init__(self, K: int, T: int, epochs: int) -> None:
        """Episodes, their steps, and the epochs of each learner in one call."""
        self.epochs = epochs
        self.pool = ProcessPoolExecutor(PROCESSES, get_context("spawn"), _set_up, (K, T))

    def __call__(self) -> None:
        """Both learners' epochs; returns when the slower one has finished."""
        list(self.pool.map(_learn, [self.epochs] * PROCESSES))
