"""From timings to what is written: the table, the fitted exponents, the figure, the summary and the machine."""

import os
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import torch
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from benchmarks.subjects import (
    BOUND,
    GATES,
    JAX,
    LIBRARY,
    LIBRARY_SIZES,
    ONE_AT_A_TIME,
    OURS,
    PRODUCT,
    SIDE_BY_SIDE,
    Subject,
)
from helpers.report.figures import INK, MUTED, WIDTH
from helpers.report.tables import to_markdown
from helpers.runs.identity import versions

COLUMNS = [
    "what",
    "threads",
    "K",
    "T",
    "steps_per_s",
    "ratio_to_bound",
    "seconds",
    "seconds_min",
    "seconds_max",
    "rounds",
    "peak_mb",
]
EXTRA = ("gymnasium", "stable_baselines3", "sb3_contrib", "jax", "jaxlib")
COLOURS = ("#d7191c", MUTED)  # of time and memory


def fitted_exponent(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """p and a of values = a sizes^p by least squares in the logarithms; nan with one size, or values that are not positive."""
    if len(set(sizes)) < 2 or min(values) <= 0:
        return float("nan"), float("nan")
    slope, intercept = np.polyfit(np.log(sizes), np.log(values), 1)
    return float(slope), float(np.exp(intercept))


def table(timings: Mapping[Subject, Sequence[float]], memory: Mapping[tuple[int, int], float]) -> pd.DataFrame:
    """The rows of benchmarks.csv.

    `seconds` is the median over the rounds of the time of one run of the subject, `seconds_min` and `seconds_max` its range,
    and steps_per_s follows from the median. The bound of a row is that of its number of threads; two cores can always do
    what one does, so the bound for two threads is not less than the one for one.

    Args:
        timings: seconds of every round by subject.
        memory: peak memory of learning in MB by (K, T), without what Python and torch take alone.
    """
    rows = []
    for subject, seconds in timings.items():
        median = float(np.median(seconds))
        row = {"what": subject.what, "threads": subject.threads, "K": subject.K, "T": subject.T}
        row |= {"steps_per_s": subject.steps / median, "ratio_to_bound": float("nan"), "seconds": median}
        row |= {"seconds_min": min(seconds), "seconds_max": max(seconds), "rounds": len(seconds)}
        rows.append(row | {"peak_mb": memory.get((subject.K, subject.T)) if subject.what == OURS else None})
    frame = pd.DataFrame(rows, columns=COLUMNS)
    bounds = frame[frame["what"] == BOUND].set_index("threads")["steps_per_s"].sort_index().cummax()
    return frame.assign(ratio_to_bound=frame["steps_per_s"] / frame["threads"].map(bounds))


def exponents(scaling: pd.DataFrame, K: int, T: int) -> pd.DataFrame:
    """Fitted exponents of time and memory in K (at this T) and in T (at this K), a row for each line of the figure."""
    rows = []
    for variable, fixed in (("K", scaling["T"] == T), ("T", scaling["K"] == K)):
        for quantity in ("seconds", "peak_mb"):
            exponent, factor = fitted_exponent(scaling.loc[fixed, variable], scaling.loc[fixed, quantity])
            rows.append({"quantity": quantity, "against": variable, "exponent": exponent, "factor": factor})
    return pd.DataFrame(rows)


def scaling_figure(scaling: pd.DataFrame, fits: pd.DataFrame, K: int, T: int) -> Figure:
    """Seconds per epoch and peak memory against K and against T, log-log; the legend states the slopes."""
    figure, grid = plt.subplots(2, 2, figsize=(WIDTH, 6.2), sharex="col", sharey="row", layout="constrained")
    labels = {"K": f"episodes per epoch K (T = {T} steps each)", "T": f"steps per episode T (K = {K} episodes)"}
    slopes = fits.set_index(["quantity", "against"])
    for column, variable in enumerate("KT"):
        rows = (scaling[scaling["T"] == T] if variable == "K" else scaling[scaling["K"] == K]).sort_values(variable)
        for axis, quantity, colour in zip(grid[:, column], ("seconds", "peak_mb"), COLOURS, strict=True):
            slope, factor = slopes.loc[(quantity, variable)]
            axis.plot(rows[variable], rows[quantity], "o", color=colour, label=f"slope {slope:.2f}")
            axis.plot(rows[variable], factor * rows[variable] ** slope, "-", color=colour, linewidth=1.0)
            axis.set(xscale="log", yscale="log")
            axis.legend(frameon=False, loc="upper left")
        spread = rows[["seconds_min", "seconds_max"]].to_numpy().T
        grid[0, column].vlines(rows[variable], *spread, color=COLOURS[0], linewidth=0.8, alpha=0.6)
        ticks = rows[variable].tolist()
        grid[1, column].set_xlabel(labels[variable])
        grid[1, column].set_xticks(ticks, [f"{tick:,}" for tick in ticks], minor=False)
        grid[1, column].minorticks_off()
    grid[0, 0].set_ylabel("time of an epoch (s)")
    grid[1, 0].set_ylabel("peak memory of learning (MB)")
    figure.suptitle(
        "Cost of a learning epoch: medians, ranges over the rounds, and power laws fitted to the medians", color=INK, fontsize=10.5
    )
    return figure


def summary(
    compared: pd.DataFrame,
    scaling: pd.DataFrame,
    fits: pd.DataFrame,
    stages: pd.DataFrame | None,
    flops: int,
    load: tuple[float, ...],
) -> str:
    """Markdown for a reader, ratios first; every number comes from the tables.

    Args:
        flops: floating-point operations of one learnt step.
        load: load average of the machine at the start.
    """
    columns = ["what", "threads", "steps_per_s"]
    rate = {(what, threads): value for what, threads, value in compared[columns].itertuples(index=False)}
    best = {what: max(value for (name, _), value in rate.items() if name == what) for what in compared["what"]}
    threads = 1 if rate[OURS, 1] >= rate[OURS, 2] else 2
    K, T = compared.loc[compared["what"] == OURS, ["K", "T"]].iloc[0]
    others = [LIBRARY.format(environments=environments, passes=passes) for environments, passes in LIBRARY_SIZES]
    against = {what: best[what] for what in (ONE_AT_A_TIME, JAX, *others, BOUND) if what in best}
    against["products and gate functions, one after the other"] = 1 / (1 / best[BOUND] + 1 / best[GATES])
    ratios = [{"our learning epoch, against": what, "ratio": best[OURS] / value} for what, value in against.items()]
    rows, inner, width = PRODUCT
    gflops = [rate[BOUND, n] * flops / 1e9 for n in (1, 2)]
    largest = scaling.loc[scaling["K"].idxmax()]
    text = [
        f"Learnt steps a second, each at its better number of threads (K = {K} episodes of T = {T} steps, one run, medians):",
        to_markdown(pd.DataFrame(ratios), digits=3),
        f"Ours learns from {best[OURS]:,.0f} steps a second at its best, with {threads} thread{'s' if threads > 1 else ''}: a step "
        f"takes {best[BOUND] / best[OURS]:.2f} times as long as the bound allows. The bound is the machine's rate in products "
        f"{rows} × {inner} by {inner} × {width} ({gflops[0]:.0f} GFLOP/s with one thread, {gflops[1]:.0f} with two) over the "
        f"{flops:,} operations of one learnt step: the rollout takes every weight of the network once, its gradient twice. It "
        "leaves out noise, process, features, gate functions and optimiser.",
        "Two seeds side by side, each in a process of one thread, as Snakemake runs them, learn together from "
        f"{best[SIDE_BY_SIDE]:,.0f} steps a second, {best[BOUND] / best[SIDE_BY_SIDE]:.2f} times as long a step as the bound.",
        to_markdown(compared[[*COLUMNS[:9]]], digits=3),
        "Time and memory of an epoch as powers of its size:",
        to_markdown(fits.replace({"seconds": "time", "peak_mb": "peak memory"})[["quantity", "against", "exponent"]], digits=3),
        f"At K = {largest['K']:,} and T = {largest['T']}, learning takes {largest['peak_mb']:,.0f} MB beside what Python and torch "
        "take alone.",
    ]
    if stages is not None:
        text += ["The whole run of one seed by stage, in seconds:", to_markdown(stages, digits=3)]
    if load[0] > 0.5:
        text.append(
            f"The machine was not idle: its load average at the start was {load[0]:.1f}. Ranges over the rounds show what that did."
        )
    return "\n\n".join(text) + "\n"


def machine(load: Mapping[str, tuple[float, ...]], settings: Mapping[str, object]) -> str:
    """The machine, the versions and the state they were met in, as Markdown."""
    known = versions() | {name: metadata.version(name.replace("_", "-")) for name in EXTRA if find_spec(name)}
    rows = {
        "processor": processor(),
        "cores": f"{os.cpu_count()} ({available_cores()} available to this process)",
        "memory": f"{psutil.virtual_memory().total / 1e9:.1f} GB",
        "system": f"{platform.system()} {platform.machine()}",
        "vector instructions of torch": torch.backends.cpu.get_cpu_capability(),
        "load average (1, 5, 15 minutes)": "; ".join(
            f"{when} {', '.join(f'{value:.2f}' for value in loads)}" for when, loads in load.items()
        ),
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
    }
    rows |= {key: str(value) for key, value in settings.items()} | known
    return to_markdown(pd.DataFrame({"what": rows.keys(), "value": rows.values()})) + "\n"


def processor() -> str:
    """The model name of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    names = [entry.partition(":")[2].strip() for entry in lines if entry.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def available_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
