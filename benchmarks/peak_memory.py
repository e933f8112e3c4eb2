"""Peak memory of learning epochs at one size, in a process of its own: `python -m benchmarks.peak_memory K T`."""

import sys
from pathlib import Path

import torch

from benchmarks.subjects import Workload

STATUS = Path("/proc/self/status")
EPOCHS = 2  # the second meets the optimiser's moments and the allocator's leftovers


def peak_mb() -> float:
    """The largest resident memory of this process so far, MB (10^6 bytes).

    Linux: the high-water mark of this very program. getrusage would not do there: after fork and exec it still holds the
    parent's peak.
    """
    if STATUS.is_file():
        line = next(line for line in STATUS.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / 1e6
    if sys.platform == "win32":
        import psutil  # noqa: PLC0415

        return psutil.Process().memory_info().peak_wset / 1e6
    import resource  # noqa: PLC0415

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # bytes on macOS


def main() -> None:
    """Print the peak before the epochs and after them, MB: what Python and torch take alone, and with the learning."""
    K, T = map(int, sys.argv[1:])
    torch.set_num_threads(1)
    workload = Workload.of()
    workload.epoch(12, 2)()
    before = peak_mb()
    epoch = workload.epoch(K, T)
    for _ in range(EPOCHS):
        epoch()
    print(before, peak_mb())


if __name__ == "__main__":
    main()
