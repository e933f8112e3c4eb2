"""Independent random streams: one for each seed, case, stage and purpose."""

import zlib

import numpy as np
import torch


def stream(seed: int, *purpose: str | int) -> torch.Generator:
    """A generator that depends on the seed and on what it is for, and on nothing else.

    Streams with different purposes are independent (numpy's SeedSequence), so that drawing more numbers in one
    stage does not shift those of another.
    """
    words = [zlib.crc32(str(word).encode()) for word in purpose]
    state = np.random.SeedSequence([seed, *words]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))
