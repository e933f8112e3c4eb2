"""What `make search` found: the printed algorithms' best settings, and which reward weights lead near the expert."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from helpers.report.figures import INK, LEVEL, LOOP_COLOURS, MUTED, WIDTH, empty_figure, head
from helpers.report.tables import case_study, feature_symbol
from helpers.runs.artifacts import Stage
from helpers.runs.sources import PROJECT
from helpers.settings.paper import HEADLINE, PublishedCase

FOUND = PROJECT / "reports/reference/search"  # a run of its own
FEWEST = 10  # of the sampled weights, shown in any case
WORST = 10.0  # gaps beyond are drawn here


def best_of(trials: pd.DataFrame) -> pd.DataFrame:
    """By case: the setting whose median gap over all seeds is least, number of seeds, median, worst, and median of that by hand."""
    last = trials.groupby(["case", "setting"])["rung"].max() == trials["rung"].max()
    gaps = trials.groupby(["case", "setting"])["gap"].agg(["count", "median", "max"])[last]
    found = gaps.loc[gaps.groupby("case")["median"].idxmin()].reset_index("setting")
    return found.assign(by_hand=gaps["median"].xs(0, level="setting"))


def gap_figure(trials: pd.DataFrame, published: Mapping[int, PublishedCase]) -> Figure:
    """The gap of every trial (as of `Search.run`) against the rank of its setting on the first seed; a panel for each case."""
    figure, best = empty_figure(WIDTH, 3.8), best_of(trials)
    cases = sorted(trials["case"].unique())
    for case, axes in zip(cases, figure.subplots(1, len(cases), sharey=True, squeeze=False)[0], strict=True):
        rows = trials[trials["case"] == case].assign(percent=lambda table: 100 * table["gap"].clip(upper=WORST))
        first = rows["seed"] == 0
        place = rows["setting"].map(rows[first].set_index("setting")["percent"].rank(method="first"))
        for which, colour, label in ((~first, LOOP_COLOURS[1], "other seeds"), (first, INK, "first seed")):
            axes.plot(place[which], rows["percent"][which], ".", color=colour, markersize=3, label=label, rasterized=True)
        axes.axhline(100 * published[case].feature_gap, color=LEVEL, label="the paper's own gap")
        axes.axhline(100 * best.loc[case, "by_hand"], color=MUTED, linestyle="--", label="settings by hand, median over seeds")
        axes.axhline(100 * best.loc[case, "median"], color=LOOP_COLOURS[3], linestyle=":", label="best settings, median over seeds")
        head(axes, "", case_study(case), f"case {case}", yscale="log")
        axes.yaxis.set_major_formatter("{x:g}")
    figure.supxlabel("rank of the setting on the first seed", fontsize=10)
    figure.supylabel("feature gap (%)", fontsize=10)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def weights_figure(weights: pd.DataFrame, learnt: Mapping[str, pd.DataFrame], published: Mapping[int, PublishedCase]) -> Figure:
    """Weights of three kinds beside the printed ones, a panel for each case: alpha* over seeds, and those of the sample that match.

    `weights` are those of `sampled`; `learnt` holds alpha* by what learnt it, columns case and alpha:<feature>.
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
            style: Any = {"color": LOOP_COLOURS[place], "alpha": 0.6, "label": label, "rasterized": True}
            axes.plot(x.ravel(), table[columns].to_numpy().ravel(), ".", **style)
        axes.plot(range(len(columns)), printed[columns].iloc[0], "D", color=INK, markersize=5, label="printed")
        axes.axhline(0, color=MUTED, linewidth=1)
        axes.set_xticks(range(len(columns)), [feature_symbol(name.removeprefix("alpha:")) for name in columns])
        least, relearnt = 100 * tried["gap"].min(), 100 * printed["gap"].median()
        words = f"gaps of the best policies within {100 * own:.1f} %: {within} of {len(tried)} sampled"
        title = f"{case_study(case)}, {words}; the nearest {least:.1f} %; the printed {relearnt:.1f} %"
        head(axes, "", title, f"case {case}", ylabel=r"weight $\alpha$")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    return figure


def draw(found: Stage, published: Mapping[int, PublishedCase], headline: pd.DataFrame) -> dict[str, Figure]:
    """Both figures of a search by name; `headline`: alpha* of that variant over seeds, columns case and alpha:<feature>."""
    trials, weights = found.table("trials.csv"), found.table("weights.csv")
    printed = trials[trials["setting"] == trials["case"].map(best_of(trials)["setting"])]
    learnt = {r"$\alpha^*$ as printed, best settings": printed, rf"$\alpha^*$, {HEADLINE}": headline}
    return {"search_gaps": gap_figure(trials, published), "search_weights": weights_figure(weights, learnt, published)}


def tabulate(found: Stage, published: Mapping[int, PublishedCase]) -> pd.DataFrame:
    """A row for each case: how many settings and trials, gaps in per cent of the settings by hand and of the best, and the weights.

    `within` counts the sampled weights whose best policy lies within the paper's own gap, of `sampled`; `printed` is the gap of the
    policy that is best under the printed weights.
    """
    trials, weights = found.table("trials.csv"), found.table("weights.csv")
    best, of_case = best_of(trials), trials.groupby("case")
    tried, printed = (weights[(weights["kind"] == "printed") == which] for which in (False, True))
    papers = pd.Series({case: record.feature_gap for case, record in published.items()})
    within = (tried["gap"] <= tried["case"].map(papers)).groupby(tried["case"])
    rows = {"settings": of_case["setting"].nunique(), "trials": of_case.size(), "seeds": best["count"]}
    shares = {"paper": papers, "by_hand": best["by_hand"], "best": best["median"], "worst": best["max"]}
    rows |= {name: 100 * gaps for name, gaps in shares.items()}
    rows |= {"within": within.sum(), "sampled": within.size(), "printed": 100 * printed.groupby("case")["gap"].median()}
    return pd.DataFrame(rows).rename_axis("case").reset_index()
