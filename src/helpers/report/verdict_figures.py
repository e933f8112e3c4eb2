"""Pictures of verdicts: every published number beside ours, the weights, and the paper's claims. They compute no result."""

from collections.abc import Iterable
from string import ascii_uppercase
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator

from helpers.report.figures import INK, MUTED, WIDTH, empty_figure, feature_styles, head
from helpers.report.tables import ROMAN, feature_symbol, setting_words, symbol

# Colour and shape of a verdict, so that it can be read without colours.
MARKS: dict[str, dict[str, Any]] = {
    "match": {"marker": "o", "color": "#17803d"},
    "differs": {"marker": "X", "color": "#c2410c"},
    "cannot tell": {"marker": "s", "color": "#777777", "markerfacecolor": "white"},
    "fitted": {"marker": "^", "color": "#1f4fd8", "markerfacecolor": "white"},
}
MARKS |= {"holds": MARKS["match"], "does not hold": MARKS["differs"], "in part": {"marker": "D", "color": "#b8860b"}}
MARKS |= {"not comparable": {"marker": "_", "color": "#777777"}}
ROWS = {"expert": "PID, features", "policy": "policy, features", "alpha": "weights"}
LINEAR = 10.0  # per cent to either side of the published value that are drawn to scale; beyond, by powers of ten
SMOOTH = 0.05  # of all epochs, over which a curve of weights is averaged
NARROW = 7.6  # inches, of a picture on page one


def _handles(verdicts: Iterable[str], found: Iterable[str]) -> list[Line2D]:
    """The marks of those verdicts that are found, in their order, for a legend."""
    listed = [verdict for verdict in verdicts if verdict in {*found}]
    return [Line2D([], [], linestyle="", label=verdict, markersize=6, **MARKS[verdict]) for verdict in listed]


def comparison_figure(compared: pd.DataFrame) -> Figure:
    """Every published number of Tables 2 to 4 and ours: a panel for each table, a row for each number, marked by its verdict.

    The axis is how far ours lies from the published number, in per cent of it; the line is the 95 % interval for one run, and
    the published number is nought. The comparison with the paper has the columns `scorecard.COLUMNS`.
    """
    printed = sorted(compared["table"].unique())
    numbers = compared[["reproduced", "pred_low", "pred_high"]].sub(compared["published"], axis=0)
    relative = 100 * numbers.div(compared["published"].abs(), axis=0)
    features = list(dict.fromkeys(compared["feature"]))
    heights = {(row, name): -i - 0.9 * j for j, row in enumerate(ROWS) for i, name in enumerate(features, j * len(features))}
    figure = empty_figure(NARROW, 4.0)
    panels = np.atleast_1d(figure.subplots(1, len(printed), sharey=True, sharex=True))
    for axes, table in zip(panels, printed, strict=True):
        rows = compared[compared["table"] == table]
        for index, row in rows.iterrows():
            ours, low, high = relative.loc[index]
            y, mark = heights[row["row"], row["feature"]], MARKS[row["verdict"]]
            axes.plot([low, high], [y, y], color=mark["color"], linewidth=1.3)
            axes.plot([ours], [y], label=f"{row['row']} {row['feature']}", markersize=5.5, **mark)
        axes.axvline(0, color=INK, linewidth=1)
        axes.set_xscale("symlog", linthresh=LINEAR, linscale=1.2)
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(lambda share, _: f"{share:+,.0f}" if share else "0")
        axes.set_title(f"Table {table} (Case {ROMAN[rows['case'].iloc[0] - 1]})", fontsize=9)
        axes.set_label(f"Table {table}")
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="x", labelsize=7, rotation=35)
    panels[0].set_yticks(list(heights.values()), [feature_symbol(name) for _, name in heights], fontsize=7)
    for row, words in ROWS.items():
        middle = np.mean([y for (of_row, _), y in heights.items() if of_row == row])
        place: Any = {"ha": "center", "va": "center", "rotation": 90, "fontsize": 8, "color": MUTED}
        panels[0].text(-0.36, middle, words, transform=panels[0].get_yaxis_transform(), **place)
    figure.supxlabel("ours less the published number, % of it (to scale within ± 10 %)", fontsize=8.5)
    listed = _handles(("match", "differs", "cannot tell", "fitted"), compared["verdict"])
    figure.legend(handles=listed, loc="outside upper center", ncols=4, frameon=False, fontsize=8.5)
    return figure


def claims_figure(judged: pd.DataFrame) -> Figure:
    """The paper's claims as `scorecard.claims_by_case` gives them, a row for each, with a mark for each case study."""
    cases = [column for column in judged if column in ROMAN]
    lines = [fill(statement, 96) for statement in judged["statement"]]
    sizes = np.array([line.count("\n") + 1.4 for line in lines])
    ends = np.cumsum([0, *sizes])
    figure, heights = empty_figure(WIDTH, 0.9 + 0.155 * ends[-1]), -ends[:-1] - sizes / 2
    axes = figure.subplots()
    for x, case in enumerate(cases):
        for y, verdict in zip(heights, judged[case], strict=True):
            if verdict:
                axes.plot([x], [y], label=case, markersize=6.5, linestyle="", **MARKS[verdict])
    axes.set_yticks(heights, lines, fontsize=8)
    axes.set_xticks(range(len(cases)), cases)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    axes.set(xlim=(-0.6, len(cases) - 0.4), ylim=(-ends[-1], 0), label="claims")
    axes.spines[["left", "bottom"]].set_visible(False)
    listed = _handles(("holds", "in part", "does not hold", "cannot tell", "not comparable"), judged[cases].to_numpy().ravel())
    figure.legend(handles=listed, loc="outside upper center", ncols=5, frameon=False)
    return figure


def weights_figure(history: pd.DataFrame, compared: pd.DataFrame) -> Figure:
    """The weights while they are learned, a panel for each loop, and those learned beside the printed ones.

    A curve is the median over seeds, averaged over a twentieth of the epochs; its band holds the middle half of the seeds.
    `history` has the columns epochs, seed and alpha:<feature>; `compared` is one case of the comparison with the paper.
    """
    printed = compared[compared["row"] == "alpha"].set_index("feature")
    loops = list(dict.fromkeys(name.rpartition("-")[0] for name in printed.index))
    figure = empty_figure(WIDTH, 3.6)
    *panels, last = figure.subplots(1, len(loops) + 1)
    styles = feature_styles(list(printed.index))
    width = max(1, round(SMOOTH * history["epochs"].nunique()))
    below: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.17), "frameon": False, "columnspacing": 1}
    for letter, axes, loop in zip(ascii_uppercase, panels, loops, strict=False):
        for name in printed.index[printed.index.str.rpartition("-").get_level_values(0) == loop]:
            runs = history.pivot_table(index="epochs", columns="seed", values=f"alpha:{name}").rolling(width, min_periods=1).mean()
            label, style = feature_symbol(name), styles[feature_symbol(name)]
            axes.plot(runs.index, runs.median(axis=1), label=label, **style)
            low, high = runs.quantile(0.25, axis=1), runs.quantile(0.75, axis=1)
            axes.fill_between(runs.index, low, high, color=style["color"], alpha=0.15, linewidth=0)
            star: Any = {"marker": "*", "markersize": 9, "color": style["color"], "clip_on": False}
            axes.plot([runs.index[-1]], [printed.loc[name, "published"]], **star)
        axes.legend(ncols=3, handlelength=2, **below)
        ylabel = "weight (no unit)" if loop == loops[0] else ""
        head(axes, letter, f"Loop of {symbol(loop)}", f"{letter} {loop}", xlabel="epoch", ylabel=ylabel, ylim=(-1, 1))
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    # Beside them each weight with its interval for one run, by its verdict, and the printed one as a star.
    head(last, ascii_uppercase[len(loops)], "Learned and printed", "printed", xlabel="weight (no unit)")
    heights = range(0, -len(printed), -1)
    for y, (name, row) in zip(heights, printed.iterrows(), strict=True):
        last.plot([row["pred_low"], row["pred_high"]], [y, y], color=MARKS[row["verdict"]]["color"])
        last.plot([row["reproduced"]], [y], label=f"ours {name}", markersize=6, **MARKS[row["verdict"]])
        last.plot([row["published"]], [y], label=f"printed {name}", marker="*", markersize=9, color=INK)
    last.axvline(0, color=MUTED, linewidth=1)
    last.set_yticks(list(heights), [feature_symbol(name) for name in printed.index])
    star = Line2D([], [], marker="*", color=INK, linestyle="", markersize=9, label="printed")
    last.legend(handles=[star, *_handles(printed["verdict"].unique(), printed["verdict"])], ncols=2, **below)
    return figure


def profiles_figure(profiles: pd.DataFrame, settings: pd.DataFrame) -> Figure:
    """How far the loss of notebook 00 rises when one setting is held and all others are fitted again: a panel for each setting.

    Between two fits the root of the rise is taken as linear, which is exact for a parabola, as for the intervals of the table.
    `profiles` has the columns setting, value, rise; `settings` setting, component, low, high, in_parameter_files.
    """
    across = 4
    down = -(-len(settings) // across)
    figure = empty_figure(WIDTH, 1.75 * down + 0.6)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, row in zip(panels, settings.itertuples(), strict=False):
        held = profiles[profiles["setting"] == f"{row.setting} {row.component}"].sort_values("value")
        value, root = held["value"].to_numpy(), np.sqrt(held["rise"].to_numpy())
        reach = 0.6 * (row.high - row.low)
        ends = max(value[0], row.low - reach), min(value[-1], row.high + reach)
        drawn = np.linspace(*ends, 200)
        axes.axvspan(row.low, row.high, color=INK, alpha=0.12, linewidth=0, label="the tables cannot tell")
        axes.plot(drawn, np.interp(drawn, value, root) ** 2, color=INK, label="rise of the loss")
        shown = (value >= ends[0]) & (value <= ends[1])
        axes.plot(value[shown], root[shown] ** 2, "o", color=INK, markersize=3.5, label="fitted again")
        colour = MARKS["differs"]["color"]
        axes.axvline(row.in_parameter_files, label="in the parameter files", color=colour, linestyle=":", linewidth=2)
        axes.set_title(setting_words(row.setting, row.component), fontsize=9, loc="left")
        axes.set(label=f"{row.setting} {row.component}", ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(4))
    for axes in panels[len(settings) :]:
        axes.set_axis_off()
    figure.supxlabel("value of the setting (in its own unit)", fontsize=10)
    figure.supylabel("rise of the loss (no unit)", fontsize=10)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure
