"""The search for the printed algorithms' best settings, and the sample of weights: `python -m helpers search`.

A run of its own: it takes hours, goes on where it was stopped, and writes reports/reference/search, which the report shows.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from helpers.evidence.printed_search import Search
from helpers.evidence.weights_set import sampled
from helpers.report.figures import INK, LEVEL, LOOP_COLOURS, MUTED, WIDTH, empty_figure, head, lay_out
from helpers.report.tables import case_study, feature_symbol
from helpers.runs.artifacts import code_revision, save_stage
from helpers.runs.identity import versions
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import InputError
from helpers.settings.paper import HEADLINE, PublishedCase, load_published

PARAMS, REFERENCE = PROJECT / "params", PROJECT / "reports/reference"
DECIMALS, FEWEST = 6, 10
WORST = 10.0  # gaps beyond are drawn here


def best_of(trials: pd.DataFrame) -> pd.DataFrame:
    """The settings tried on all seeds, that by hand first: case, setting, number of seeds, median, least and greatest gap.

    `fresh` is the median over the seeds by which the best was not chosen.
    """
    last = trials[trials["rung"] == trials["rung"].max()].groupby(["case", "setting"])["gap"].median().rename("fresh")
    spread = trials.groupby(["case", "setting"])["gap"].agg(["count", "median", "min", "max"])
    return spread.join(last, how="inner").reset_index()


def gap_figure(trials: pd.DataFrame, published: Mapping[int, PublishedCase]) -> Figure:
    """The gap of every trial against the rank of its setting on the first seed; a panel for each case.

    Args:
        trials: as of `Search.run`.
    """
    figure, best = empty_figure(WIDTH, 3.8), best_of(trials)
    cases = sorted(trials["case"].unique())
    for case, axes in zip(cases, figure.subplots(1, len(cases), sharey=True, squeeze=False)[0], strict=True):
        rows = trials[trials["case"] == case].assign(percent=lambda table: 100 * table["gap"].clip(upper=WORST))
        first = rows["seed"] == 0
        place = rows["setting"].map(rows[first].set_index("setting")["percent"].rank(method="first"))
        for which, colour, label in ((~first, LOOP_COLOURS[1], "other seeds"), (first, INK, "first seed")):
            axes.plot(place[which], rows["percent"][which], ".", color=colour, markersize=3, label=label)
        medians = 100 * best[best["case"] == case]["median"].to_numpy()
        axes.axhline(100 * published[case].feature_gap, color=LEVEL, label="the paper's own gap")
        axes.axhline(medians[0], color=MUTED, linestyle="--", label="settings by hand, median over seeds")
        axes.axhline(medians[-1], color=LOOP_COLOURS[3], linestyle=":", label="best settings, median over seeds")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        head(axes, "", case_study(case), f"case {case}")
    figure.supxlabel("rank of the setting on the first seed")
    figure.supylabel("feature gap (%)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def weights_figure(weights: pd.DataFrame, learnt: Mapping[str, pd.DataFrame], published: Mapping[int, PublishedCase]) -> Figure:
    """Weights of three kinds beside the printed ones, a panel for each case: alpha* over seeds, and those of the sample that match.

    Args:
        weights: as of `sampled`. learnt: alpha* by what learnt it, columns case and alpha:<feature>.
    """
    cases, columns = sorted(weights["case"].unique()), [name for name in weights if name.startswith("alpha:")]
    figure = empty_figure(WIDTH, 2.3 * len(cases) + 0.6)
    for case, axes in zip(cases, figure.subplots(len(cases), 1, sharex=True, squeeze=False)[:, 0], strict=True):
        rows, own = weights[weights["case"] == case], published[case].feature_gap
        tried, printed = rows[rows["kind"] != "printed"], rows[rows["kind"] == "printed"]
        within = int((tried["gap"] <= own).sum())
        shown = {f"sampled: all within the paper's gap, the nearest {FEWEST} at least": tried.nsmallest(max(within, FEWEST), "gap")}
        shown |= {label: table[table["case"] == case] for label, table in learnt.items()}
        for place, (label, table) in enumerate(shown.items()):
            x = np.tile(np.arange(len(columns)) + 0.2 * (place - 1), (len(table), 1))
            axes.plot(x.ravel(), table[columns].to_numpy().ravel(), ".", color=LOOP_COLOURS[place], alpha=0.6, label=label)
        axes.plot(range(len(columns)), printed[columns].iloc[0], "D", color=INK, markersize=5, label="printed")
        axes.axhline(0, color=MUTED, linewidth=1)
        axes.set_xticks(range(len(columns)), [feature_symbol(name.removeprefix("alpha:")) for name in columns])
        least, relearnt = 100 * tried["gap"].min(), 100 * printed["gap"].median()
        words = f"gaps of the best policies within {100 * own:.1f} %: {within} of {len(tried)} sampled"
        head(axes, "", f"{case_study(case)}, {words}; the nearest {least:.1f} %; the printed {relearnt:.1f} %", f"case {case}")
        axes.set_ylabel(r"weight $\alpha$")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure


def headline_weights(seeds: Path) -> pd.DataFrame:
    """alpha* of the headline variant over its seeds, from the seeds.csv of a report: case and alpha:<feature>."""
    rows = pd.read_csv(seeds).query("stage == 'offline' and metric.str.startswith('alpha:')")
    return rows.pivot_table(index=["case", "seed"], columns="metric", values="value").reset_index()


def search(scale: str, cases: Sequence[int], results: Path) -> None:
    """Search all cases given; with all of them done, write trials, weights and figures."""
    torch.set_num_threads(1)
    kept, published = Search(PARAMS, scale, results / scale / ".search"), load_published(PARAMS)
    best: dict[int, int] = {}
    trials, weights = [], []
    for case in sorted(cases):
        best[case], table = kept.run(case, best)
        trials.append(table)
        weights.append(sampled(kept, case))
    if set(cases) < set(published):
        return
    tried, drawn = pd.concat(trials), pd.concat(weights)
    tables = {"trials.csv": tried, "weights.csv": drawn, "best.csv": best_of(tried)}
    learnt = {
        r"$\alpha^*$ as printed, best settings": tried[tried["setting"] == tried["case"].map(best)],
        rf"$\alpha^*$, {HEADLINE}": headline_weights(REFERENCE / "seeds.csv"),
    }
    figures = {"gaps": gap_figure(tried, published), "weights": weights_figure(drawn, learnt, published)}
    for figure in figures.values():
        lay_out(figure)
    folder = REFERENCE / "search" if scale == "paper" else results / scale / "search"
    short = {name: table.round(DECIMALS).astype(object) for name, table in tables.items()}  # as they are, and not with 17 digits
    save_stage(folder, {"revision": code_revision(PROJECT), "versions": versions()}, short, figures=figures)
    print(f"written: {folder}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m helpers search", description=__doc__)
    parser.add_argument("cases", nargs="*", type=int, help="all, unless given; a case that starts from another one needs that too")
    parser.add_argument("--scale", default="paper", choices=("paper", "smoke"))
    given = parser.parse_args(arguments)
    try:
        search(given.scale, given.cases or sorted(load_published(PARAMS)), PROJECT / "results")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
