"""Measure how fast learning is: `python -m benchmarks.benchmark --help`; `make bench` installs what it needs and runs it."""

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import psutil
import torch
from matplotlib import pyplot as plt

from benchmarks import outcome, whole_run
from benchmarks.subjects import (
    FULL,
    PROJECT,
    QUICK,
    Subject,
    Workload,
    comparison,
    flops_of_a_learnt_step,
    installed,
    library_installed,
    scaling,
    scaling_sizes,
)
from helpers.runs.artifacts import code_revision

FLOATS = "%.6g"
ENOUGH_SECONDS = 75.0  # no further round begins after that long, on a machine that is slow or busy
FEWEST_ROUNDS = 3


def timed(subject: Subject) -> float:
    """Seconds of one run of a subject, with its number of threads."""
    torch.set_num_threads(subject.threads)
    started = time.perf_counter()
    subject.run()
    return time.perf_counter() - started


def in_rounds(subjects: Sequence[Subject], rounds: int) -> dict[Subject, list[float]]:
    """Seconds of every subject in every round.

    Each round meets every subject once, so that what else happens on the machine falls on all alike. An extra round
    before them is not counted: it warms caches and allocators. On a slow or busy machine there are fewer rounds.
    """
    timings: dict[Subject, list[float]] = {subject: [] for subject in subjects}
    begun = 0.0
    for number in range(rounds + 1):
        if number > FEWEST_ROUNDS and time.perf_counter() - begun > ENOUGH_SECONDS:
            say("  enough: the machine is slow or busy")
            break
        started = time.perf_counter()
        if number == 1:  # the warm-up, in which compilers work, takes no round's time
            begun = started
        for subject in subjects:
            seconds = timed(subject)
            if number:
                timings[subject].append(seconds)
        say(f"  {'warm-up' if number == 0 else f'round {number} of {rounds}'}: {time.perf_counter() - started:.1f} s")
    return timings


def peak_memory(sizes: Sequence[tuple[int, int]]) -> dict[tuple[int, int], float]:
    """Peak memory of learning at each (K, T), MB beside what Python and torch take, each in a process of its own."""
    found = {}
    for K, T in sizes:
        command = [sys.executable, "-m", "benchmarks.peak_memory", str(K), str(T)]
        before, after = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True).stdout.split()
        found[K, T] = float(after) - float(before)
    return found


def say(text: str) -> None:
    """A line of progress."""
    print(text, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.benchmark",
        description="Time the learning epoch against the machine's bound, one episode at a time, JAX, and RecurrentPPO.",
    )
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it runs; the numbers mean nothing")
    parser.add_argument("--whole", action="store_true", help="also run one seed of all cases (minutes) and time its stages")
    parser.add_argument("--cores", type=int, default=2, metavar="N", help="stages at a time in the run of --whole (default 2)")
    parser.add_argument(
        "--out",
        type=Path,
        default=PROJECT / "reports/reference/benchmarks",
        metavar="DIR",
        help="where the results go (default reports/reference/benchmarks)",
    )
    given = parser.parse_args(arguments)
    size = QUICK if given.quick else FULL
    load, revision = {"at the start": psutil.getloadavg()}, code_revision(PROJECT)  # before what is written here changes it
    workload = Workload.of()
    if not library_installed():
        say("stable-baselines3 and sb3-contrib are not installed (the extra 'bench'): RecurrentPPO is left out")
    if not installed("jax"):
        say("jax is not installed (the extra 'bench'): the epoch in JAX is left out")
    say(f"comparison at K = {size.K}, T = {size.T}")
    timings = in_rounds(comparison(workload, size), size.rounds)
    say("scaling in K and T")
    scaling_timings = in_rounds(scaling(workload, size), size.scaling_rounds)
    say("peak memory")
    memory = peak_memory(scaling_sizes(size))
    stages = None
    if given.whole:
        say("the whole run of one seed")
        run = whole_run.whole_run("smoke" if given.quick else "paper", given.cores)
        stages = pd.concat([run, whole_run.fixed_costs(3)], ignore_index=True)
    load["at the end"] = psutil.getloadavg()

    both = outcome.table(timings | scaling_timings, memory)
    compared, scaled = both.iloc[: len(timings)], both.iloc[len(timings) :]
    fits = outcome.exponents(scaled, size.K, size.T)
    flops = flops_of_a_learnt_step(workload.params)
    given.out.mkdir(parents=True, exist_ok=True)
    both.assign(what=[*compared["what"], *("scaling: " + scaled["what"])]).to_csv(
        given.out / "benchmarks.csv", index=False, float_format=FLOATS
    )
    fits.to_csv(given.out / "exponents.csv", index=False, float_format=FLOATS)
    if stages is not None:
        stages.to_csv(given.out / "stages.csv", index=False, float_format=FLOATS)
    figure = outcome.scaling_figure(scaled, fits, size.K, size.T)
    figure.savefig(given.out / "scaling.svg", metadata={"Date": None})
    plt.close(figure)
    text = outcome.summary(compared, scaled, fits, stages, flops, load["at the start"])
    (given.out / "summary.md").write_text(text, encoding="utf-8")
    settings = {"code": revision, "number type": workload.dtype, "operations of a learnt step": flops}
    (given.out / "machine.md").write_text(outcome.machine(load, settings), encoding="utf-8")
    say(f"\n{text}\nwritten: {given.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
