"""Figures of notebook 06, drawn from tables; they compute no result."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from string import ascii_uppercase
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from seaborn import heatmap

from helpers.report.figures import INK, KIND_STYLES, LOOP_COLOURS, MUTED, WIDTH, empty_figure, head
from helpers.report.tables import capital, case_study

LABELS = {
    "expert": "PID (demonstrator)",
    "offline": "offline policy",
    "online": "online policy",
    "online_there": "improved on that plant",
    "clone": "cloning",
    "irl_reinforce": "IRL, then policy gradient",
    "irl_alone": "IRL, then policy gradient without critic",
    "clone_reinforce": "cloning, then policy gradient",
    "csil_reinforce": "CSIL, then policy gradient",
    "scratch_reinforce": "policy gradient from scratch",
    "ppo": "PPO from scratch",
    "recurrent_ppo": "RecurrentPPO from scratch",
    "pid_tuned": "PID, tuned",
    "pid_scheduled": "PID, gains scheduled",
    "one_policy": "one policy, through the model",
    "one_policy_robust": "the same, robust",
    "one_policy_constrained": "the same, constrained",
    "mpc": "offset-free MPC",
    "minimum_variance": "minimum variance on y",
    "minimum_variance_filtered": "minimum variance, filtered y",
    "minimum_variance_x": "minimum variance on x",
    "dynamic_programme_filtered": "programme, filtered y",
    "dynamic_programme": "programme on x",
}
THE_PAPERS = "irl_reinforce"
RIVALS = ("clone_reinforce", "csil_reinforce", "scratch_reinforce", "ppo", "recurrent_ppo", "pid_tuned", "pid_scheduled")
LEARNERS = (THE_PAPERS, "irl_alone", *RIVALS)  # the rivals need no model
LEVELS = ("one_policy", "mpc", "minimum_variance", "expert", "dynamic_programme")
RUNS = {"hot": "hot start", "cloned": "from the clone", "scratch": "from scratch"}
GRIDS = {  # of each group of conditions: title, label of the rows, label of the columns
    "model": ("mismatch of the model", "A, times", "B, times"),
    "noise": ("disturbance and observation noise", "disturbance, times", "observation noise, times"),
    "set_point": ("other set points", "set point of the first loop, times", "set point of the second loop, times"),
    "time": ("dead time and load", "dead time, samples", "load, share of the change"),
}


def gap_figure(gaps: pd.DataFrame) -> Figure:
    """Gaps to the dynamic programme and 95 % intervals (columns case, controller, gap, gap_low, gap_high, in per cent), by case."""
    listed = [name for name in LABELS if name in set(gaps["controller"])][::-1]
    figure = empty_figure(WIDTH, 0.6 + 0.27 * len(listed))
    panels = np.atleast_1d(figure.subplots(1, gaps["case"].nunique(), sharey=True))
    for letter, (case, rows), axes in zip(ascii_uppercase, gaps.groupby("case"), panels, strict=False):
        found = rows.set_index("controller").reindex(listed)
        reach = np.stack([found["gap"] - found["gap_low"], found["gap_high"] - found["gap"]])
        axes.errorbar(found["gap"], range(len(found)), xerr=reach, fmt="o", color=INK, markersize=4, label="gap and 95 % interval")
        axes.axvline(0, color=MUTED, linewidth=1)
        axes.set_yticks(range(len(found)), [LABELS[name] for name in listed])
        head(axes, letter, case_study(case), f"{letter} case {case}", xlabel="gap to the programme (%)")
    return figure


def budget_curves(curves: pd.DataFrame, levels: Mapping[str, float]) -> Figure:
    """The objective against the plant episodes spent, a line for each learner, beside the `levels` of those that do not learn.

    `curves` has the columns learner, episodes, objective, and seed where there are several; the line is then the median and the
    band around it holds the middle half of the seeds.
    """
    figure = empty_figure(WIDTH, 4.4)
    _draw_budget(figure.add_subplot(label="budget"), curves, levels)
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def budget_by_case(curves: pd.DataFrame, levels: Mapping[int, Mapping[str, float]]) -> Figure:
    """`budget_curves` of each case, side by side; `curves` has a column case."""
    figure = empty_figure(WIDTH, 4.2)
    panels = np.atleast_1d(figure.subplots(1, len(levels)))
    for axes, (case, of_case) in zip(panels, levels.items(), strict=True):
        _draw_budget(axes, curves[curves["case"] == case], of_case)
        head(axes, "", case_study(case), f"budget {case}")
        axes.set_ylabel(axes.get_ylabel() if axes is panels[0] else "")
        axes.xaxis.set_major_locator(MaxNLocator(3, integer=True))
    known = {line.get_label(): line for axes in panels for line in axes.lines}
    figure.legend(handles=list(known.values()), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _draw_budget(axes: Axes, curves: pd.DataFrame, levels: Mapping[str, float]) -> None:
    names = [name for name in LEARNERS if name in set(curves["learner"])]
    for index, (name, colour, marker) in enumerate(zip(names, cycle(LOOP_COLOURS), "osv^D*PXh", strict=False)):
        spent = curves[curves["learner"] == name].groupby("episodes")["objective"]
        low, line, high = (spent.quantile(share) for share in (0.25, 0.5, 0.75))
        dash = KIND_STYLES[index // len(LOOP_COLOURS)]
        axes.plot(line.index, line, label=LABELS[name], markersize=4, color=colour, marker=marker, linestyle=dash)
        if (high > low).any():
            axes.fill_between(line.index, low, high, color=colour, alpha=0.15, linewidth=0)
    for name, dash in zip([name for name in LEVELS if name in levels], KIND_STYLES, strict=False):
        axes.axhline(levels[name], label=LABELS[name], color=MUTED, linestyle=dash, linewidth=1.2)
    axes.set(xlabel="plant episodes spent", ylabel="tracking objective $J$ on $x$ (no unit)", ylim=(0, None))


def heat_maps(robustness: pd.DataFrame, group: str, controllers: Sequence[str]) -> Figure:
    """A heat map for each controller: its objective under every condition, coloured by what it has ahead of the PID.

    The colour is the difference to the PID's objective in per cent of the best controller's there; grey: none earns anything.
    `robustness` has the columns group, row, column, controller, objective.
    """
    title, row_label, column_label = GRIDS[group]
    found, across = robustness[robustness["group"] == group], 3
    rows, columns = found["row"].unique(), found["column"].unique()
    table = found.pivot_table(index=["controller", "row"], columns="column", values="objective", sort=False)
    reference = table.loc["expert"].loc[rows, columns]
    down = -(-len(controllers) // across)
    figure = empty_figure(WIDTH, 0.9 + down * (0.55 + 0.26 * len(rows)))
    best = table.groupby("row").max().loc[rows, columns]
    norm, colours = TwoSlopeNorm(0, -100, 100), "PuOr"  # no value can lie beyond
    for index, name in enumerate(controllers):
        axes = figure.add_subplot(down, across, index + 1)
        values = table.loc[name].loc[rows, columns]
        look: Any = {"cmap": colours, "norm": norm, "cbar": False, "annot_kws": {"fontsize": 7.5}}
        heatmap(100 * (values - reference) / best, annot=values, fmt=".1f", ax=axes, **look)
        axes.set(xlabel="", ylabel="", facecolor="#c8c8c8", label=f"{name} {group}")  # grey, where no controller earns anything
        axes.tick_params(labelbottom=index >= len(controllers) - across, labelleft=index % across == 0, labelrotation=0)
        axes.set_title(LABELS[name], fontsize=9, loc="left")
    figure.supxlabel(column_label, fontsize=10)
    figure.supylabel(row_label, fontsize=10)
    label = "$J$ less the PID's, % of the best there"
    figure.colorbar(ScalarMappable(norm, colours), ax=figure.axes, shrink=0.8, aspect=30, label=label)
    figure.suptitle(f"{capital(title)}: $J$ on $x$ of each controller", fontsize=10.5, x=0.02, ha="left")
    return figure


def robustness_figure(shares: pd.DataFrame, groups: Mapping[str, str]) -> Figure:
    """The shares of `limits_report.worst`, a panel for each case, a row for each controller; `groups` are words for the grids."""
    names = [name for name in LABELS if name in set(shares["controller"])]
    heights = pd.Series(range(0, -len(names), -1), names)
    figure = empty_figure(WIDTH, 1.2 + 0.24 * len(names))
    panels = np.atleast_1d(figure.subplots(1, shares["case"].nunique(), sharey=True))
    for axes, (case, rows) in zip(panels, shares.groupby("case"), strict=True):
        medians = rows.pivot_table(index="controller", columns="group", values="value", aggfunc="median").reindex(names)
        for (group, words), colour, shape in zip(groups.items(), LOOP_COLOURS, "osD^v*", strict=False):
            if group in medians:
                found = medians[group].dropna()
                axes.plot(found, heights[found.index], label=words, color=colour, marker=shape, markersize=5, linestyle="")
        axes.axvline(100, color=MUTED, linewidth=1, linestyle=KIND_STYLES[1])
        head(axes, "", case_study(case), f"case {case}", xlabel="% of the PID's $J$ there", xlim=(0, None))
    panels[0].set_yticks(heights, [LABELS[name] for name in names])
    figure.legend(handles=panels[0].lines[: len(set(shares["group"]))], loc="outside lower center", ncols=4, frameon=False)
    return figure


def regret_figure(episodes: pd.DataFrame) -> Figure:
    """What exploring costs beside the PID: the dip at the onset, the worst episode of each epoch, and the cumulative regret.

    `episodes` has the columns run, epoch, episode, objective, expert.
    """
    figure = empty_figure(WIDTH, 3.8)
    dip, left, right = figure.subplots(1, 3)
    for index, (run, group) in enumerate(episodes.groupby("run", sort=False)):
        style: Any = {"color": LOOP_COLOURS[index], "linestyle": KIND_STYLES[index], "label": RUNS[str(run)]}
        by_epoch = group.groupby("epoch")[["objective", "expert"]]
        mean, worst = by_epoch.mean(), by_epoch.min()
        dip.plot(mean.index, 100 * mean["objective"] / mean["expert"], marker="o", markersize=3, **style)
        left.plot(worst.index, worst["objective"], marker="o", markersize=3, **style)
        right.plot(group["episode"], (group["expert"] - group["objective"]).cumsum(), **style)
    dip.axhline(100, color=MUTED, linestyle=KIND_STYLES[3])
    left.plot(worst.index, worst["expert"], color=MUTED, linestyle=KIND_STYLES[3], label="PID, same disturbances")
    for axes in (dip, left):
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    dip.set(xlabel="epoch", ylabel="mean $J$ of the exploring\nepisodes (% of the PID's)")
    left.set(xlabel="epoch", ylabel="$J$ of the worst episode (no unit)")
    right.set(xlabel="plant episode", ylabel="cumulative regret\nagainst the PID (no unit)")
    for axes, letter, name in ((dip, "A", "dip at the onset"), (left, "B", "worst episode"), (right, "C", "regret")):
        head(axes, letter, capital(name), f"{letter} {name}")
    figure.legend(handles=left.lines, loc="outside lower center", ncols=4, frameon=False)
    return figure
