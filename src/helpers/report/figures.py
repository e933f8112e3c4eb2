"""Figures 3-6, learning curves and the curve of the online budget.

Every table may hold several runs, told apart by a column `seed`: each is then a thin line, their median a thick one.
`drawn_summary`, what was really drawn, is the text form of every figure, which a notebook's later run is compared with.
"""

from collections.abc import Mapping, Sequence
from itertools import cycle
from string import ascii_uppercase
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, NullLocator

from helpers.report.tables import capital, case_study, feature_symbol, symbol
from helpers.settings.leaf import DEVIATION

WIDTH = 9.0  # inches; at the 100 dpi of a screen the 900 pixels of the report
DPI_FILE = 150
STYLE: dict[Any, Any] = {
    "figure.dpi": 100,
    "savefig.dpi": DPI_FILE,
    "font.size": 10,
    "axes.labelsize": 10,
    "axes.titlesize": 10.5,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9.5,
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
    **dict.fromkeys(("axes.edgecolor", "axes.labelcolor", "text.color", "xtick.color", "ytick.color"), "#262626"),
    "axes.linewidth": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#e8e8e8",
    "grid.linewidth": 0.7,
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial", "sans-serif"],
    "mathtext.fontset": "dejavusans",  # in an SVG, letters of \\mathbb and \\mathcal come out as empty boxes: not used
    "svg.fonttype": "none",  # text stays text: it can be searched and read aloud
    "svg.hashsalt": "apprenticeship",  # otherwise the identifiers inside an SVG differ from run to run
}

# The paper's colours; the line styles tell agent and expert apart without them.
COLOURS = {
    ("controlled", "agent"): "#d7191c",
    ("controlled", "expert"): "#00682f",
    ("manipulated", "agent"): "#1f4fd8",
    ("manipulated", "expert"): "#5fc45f",
}
SET_POINT = "#ff8c00"
LEVEL = "#00682f"  # horizontal lines to compare with are the expert's, mostly
LINE_STYLES: dict[str, Any] = {"agent": "-", "expert": (0, (4, 1.6))}
AIM: dict[str, Any] = {"color": SET_POINT, "linestyle": (0, (1, 1.2))}
KIND_STYLES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1.2)), (0, (5, 1.2, 1, 1.2)), (0, (6, 1, 1, 1, 1, 1)))
BAND_OPACITY = 0.2
BAND = "mean ± standard deviation"
SINGLE = "single seeds"
THIN = 0.7  # width of the line of a single seed
LOOP_COLOURS = ("#0173b2", "#de8f05", "#029e73", "#d55e00", "#cc78bc", "#ca9161")  # told apart by the colour-blind too
TIME_LABEL = "control interaction (sample)"
FIRST = 30  # interactions that Figure 4 shows
FEW_POINTS = 40  # a curve of at most that many points shows each of them
MANY_POINTS = 1000  # thin lines of more points become a picture inside the SVG, which would be ten times as large

INK = "#333333"
MUTED = "#6e6e6e"

plt.rcParams.update(STYLE)  # for the whole session: much of it counts only when a figure is written or shown


def control_figure(
    response: pd.DataFrame,
    controlled: Sequence[str],
    manipulated: Sequence[str],
    set_point: Sequence[float],
    descriptions: Mapping[str, str] | None = None,
    agent_label: str = r"agent $\pi^A$, after online learning",
    zoom_from: int | None = 5,
    size: tuple[float, float] | None = None,
) -> Figure:
    """Figures 3, 5 and 6: a column for each loop; response and control above, zoomed response below.

    Response and control have axes of their own that share the time axis, so that no scale can be mistaken for another.
    The zoom leaves out the first samples, which are the way to the set point, and the bands, which would fill it. The band of an
    input that often sits at a bound can pass it: it is a standard deviation, not a range.

    Args:
        response: columns of `stages.response_table`, and `seed` where there are several runs.
        set_point: of each loop, deviation variables.
        zoom_from: first sample of the zoom; None: no zoom.
        size: width and height in inches, where the figure is not as wide as the report.
    """
    n_loops, words = len(controlled), descriptions or {}
    heights = (6, 4) if zoom_from is None else (6, 4, 6)
    figure = empty_figure(*(size or (max(WIDTH, WIDTH / 2 * n_loops), 8.2)))
    grid = figure.add_gridspec(len(heights), n_loops, height_ratios=heights)
    for loop, (output, entry, target) in enumerate(zip(controlled, manipulated, set_point, strict=True)):
        axes = figure.add_subplot(grid[0, loop])
        _draw_response(axes, response, output, words, ascii_uppercase[loop], target)
        axes.set_xlabel("")
        axes.tick_params(labelbottom=False)
        _draw_response(figure.add_subplot(grid[1, loop], sharex=axes), response, entry, words)
        if zoom_from is not None:
            zoom = figure.add_subplot(grid[2, loop])
            _draw_response(zoom, response, output, words, ascii_uppercase[n_loops + loop], target, zoom_from)
    figure.align_ylabels()
    _legend(figure, response, ("controlled", "manipulated"), agent_label, r"PID $\pi^E$")
    return figure


def tracking_figure(
    response: pd.DataFrame,
    controlled: Sequence[str],
    set_point: Sequence[float],
    descriptions: Mapping[str, str] | None = None,
    agent_label: str = r"agent $\pi_\theta$, after offline learning",
    expert_label: str = r"demonstrated $\pi^E$",
) -> Figure:
    """Figure 4: the response of each loop over the first interactions, learned against demonstrated."""
    figure = empty_figure(max(WIDTH, WIDTH / 2 * len(controlled)), 4.0)
    early = response[response["time_index"] <= FIRST]
    for loop, (output, target) in enumerate(zip(controlled, set_point, strict=True)):
        axes = figure.add_subplot(1, len(controlled), loop + 1)
        _draw_response(axes, early, output, descriptions or {}, ascii_uppercase[loop], target)
    _legend(figure, response, ("controlled",), agent_label, expert_label)
    return figure


def learning_curves(
    history: pd.DataFrame,
    marks: Mapping[int, str] | None = None,
    return_levels: Mapping[str, float] | None = None,
    gap_levels: Mapping[str, float] | None = None,
) -> Figure:
    """Mean return, feature gap and reward weights against the epoch; a panel for each that the history holds.

    `history` has the columns epochs and mean_return, and where they exist feature_gap, alpha:<feature> and seed; `marks` are epochs
    worth a vertical line, and why; the levels are horizontal lines by label, such as the expert's return or the paper's gap.
    """
    names = [column.removeprefix("alpha:") for column in history if column.startswith("alpha:")]
    panels = {"Mean return": ("discounted return (no unit)", return_levels or {})}  # label of the axis, horizontal lines
    if "feature_gap" in history and history["feature_gap"].notna().any():
        panels["Feature gap"] = ("gap to the expert (%, log scale)", gap_levels or {})
    if names:
        panels["Reward weights"] = ("weight (no unit)", {})
    figure = empty_figure(max(6.0, WIDTH / 3 * len(panels)), 4.0)
    epochs = history["epochs"]
    points: Any = {"marker": "o" if epochs.nunique() <= FEW_POINTS else "", "markersize": 3}
    for index, (panel, (unit, levels)) in enumerate(panels.items()):
        axes = figure.add_subplot(1, len(panels), index + 1)
        letter, of_weights = ascii_uppercase[index], panel == "Reward weights"
        columns = [f"alpha:{name}" for name in names] if of_weights else [panel.lower().replace(" ", "_")]
        styles = feature_styles(names) if of_weights else {panel.lower(): {"color": INK}}
        for column, (label, style) in zip(columns, styles.items(), strict=True):
            _draw_runs(axes, history, "epochs", column, label=label, **style, **points)
        if panel == "Feature gap":
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(lambda share, _: f"{100 * share:.3g}")
            axes.yaxis.set_minor_formatter(lambda share, _: f"{100 * share:.3g}" if f"{share:.0e}"[0] in "25" else "")
        listed = [*axes.lines] if of_weights else _seed_handles(_n_seeds(history)) if panel == "Mean return" else []
        listed += _draw_levels(axes, epochs, levels)
        for (epoch, name), style in zip((marks or {}).items(), cycle(KIND_STYLES[2:]), strict=False):
            mark = axes.axvline(epoch, color=MUTED, linestyle=style, linewidth=1.2, label=name)
            listed += [] if of_weights else [mark]  # the other panels explain it
        if listed:
            n_columns = len({name.rpartition("-")[2] for name in names}) if of_weights else 1
            place: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.19), "frameon": False}
            legend = axes.legend(handles=listed, ncols=n_columns, columnspacing=1.0, handlelength=2.0, **place)
            for line in legend.get_lines():
                line.set_marker("")  # it would hide the dashes
        title = rf"{panel} $\alpha$" if of_weights else panel
        head(axes, letter if len(panels) > 1 else "", title, f"{letter} {panel.lower()}", xlabel="epoch", ylabel=unit)
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True, steps=[1, 2, 5, 10]))
    return figure


def budget_figure(frame: pd.DataFrame, references: Mapping[int, Mapping[str, float]]) -> Figure:
    """The objective after online learning against the plant episodes that each epoch was given, a panel for each case.

    `frame` has the columns seed, case, episodes_per_epoch, objective; `references` are horizontal lines by case and label.
    """
    cases = sorted(frame["case"].unique())
    figure = empty_figure(max(6.0, WIDTH / 3 * len(cases)), 3.8)
    look: Any = {"color": COLOURS["controlled", "agent"], "label": "online", "marker": "o"}
    for index, (letter, case) in enumerate(zip(ascii_uppercase, cases, strict=False)):
        axes, rows = figure.add_subplot(1, len(cases), index + 1), frame[frame["case"] == case]
        _draw_runs(axes, rows, "episodes_per_epoch", "objective", **look)
        episodes = np.sort(rows["episodes_per_epoch"].unique())
        _draw_levels(axes, episodes, references[case], linewidth=1.2)
        words = {"xlabel": "plant episodes per epoch (log)", "ylabel": "tracking objective $J$ (no unit)"}
        head(axes, letter, case_study(case), f"{letter} case {case}", xscale="log", **words)
        axes.set_xticks(episodes, [f"{number:g}" for number in episodes])
        axes.xaxis.set_minor_locator(NullLocator())
    handles = [*figure.axes[0].lines, *_seed_handles(_n_seeds(frame))[:1]]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _draw_levels(axes: Axes, x: Any, levels: Mapping[str, float], **style: Any) -> list[Line2D]:
    """Horizontal lines to compare with, by label, from the least x to the greatest."""
    found = zip(levels.items(), cycle(KIND_STYLES[1:]), strict=False)
    lines = [axes.plot([min(x), max(x)], [y, y], color=LEVEL, linestyle=dash, label=name, **style) for (name, y), dash in found]
    return [line for (line,) in lines]


def head(axes: Axes, letter: str, title: str, name: str, **others: Any) -> None:
    """The title of a panel, after its letter if any, the name by which `drawn_summary` lists it, and what else `Axes.set` takes."""
    axes.set_title(f"$\\mathbf{{{letter}}}$  {title}" if letter else title, loc="left")
    axes.set(label=name, **others)


def feature_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """A line style for each feature, by its label: one colour a loop, one dash pattern a kind."""
    loops, _, kinds = zip(*(name.rpartition("-") for name in names), strict=True)
    colours = dict(zip(dict.fromkeys(loops), cycle(LOOP_COLOURS), strict=False))
    dashes = dict(zip(dict.fromkeys(kinds), cycle(KIND_STYLES), strict=False))
    places = zip(names, loops, kinds, strict=True)
    return {feature_symbol(name): {"color": colours[loop], "linestyle": dashes[kind]} for name, loop, kind in places}


def drawn_summary(figure: Figure) -> pd.DataFrame:
    """What the figure really shows, read back from its lines and bands: a row for each.

    Columns: panel, artist (its label), points, from and to (least and greatest x), then of y: first, minimum, maximum,
    mean, last. The points of a band are those of its outline. Heat maps are left out: their cells lie where they always do.
    """
    rows = []
    for axes in figure.axes:
        panel = axes.get_label() or axes.get_title(loc="left") or axes.get_title()
        bands = [band for band in axes.collections if not isinstance(band, QuadMesh)]
        outlines = [(band.get_label(), path.vertices) for band in bands for path in band.get_paths()]
        for label, points in [*((line.get_label(), line.get_xydata()) for line in axes.lines), *outlines]:
            x, y = np.asarray(points, dtype=float).T
            rows.append([panel, label, len(y), x.min(), x.max(), y[0], np.nanmin(y), np.nanmax(y), np.nanmean(y), y[-1]])
    columns = ["panel", "artist", "points", "from", "to", "first", "minimum", "maximum", "mean", "last"]
    return pd.DataFrame(rows, columns=columns)


class DrawnFigure(Figure):
    """A figure whose text form holds the numbers that it shows."""

    def __repr__(self) -> str:
        """As usual, and `drawn_summary` below, to six digits, where anything is drawn to scale."""
        drawn = drawn_summary(self)
        numbers = "" if drawn.empty else drawn.to_string(index=False, float_format="{:.6g}".format)
        return f"{super().__repr__()}\n{numbers}".strip()


def empty_figure(width: float, height: float) -> Figure:
    """An empty figure that pyplot forgets at once, so that a notebook shows it once and many figures cost no memory."""
    figure = plt.figure(figsize=(width, height), layout="constrained", FigureClass=DrawnFigure)
    plt.close(figure)
    return figure


def lay_out(figure: Figure) -> None:
    """Lay a figure out for a file of vectors, once and for all: with a layout engine, every file of it would be drawn twice."""
    if (engine := figure.get_layout_engine()) is not None:
        FigureCanvasSVG(figure)
        figure.set_dpi(72)  # as an SVG has it
        engine.execute(figure)
        figure.set_layout_engine(None)


def _draw_response(
    axes: Axes,
    response: pd.DataFrame,
    variable: str,
    words: Mapping[str, str],
    letter: str = "",
    set_point: float | None = None,
    zoom_from: int | None = None,
) -> None:
    """Mean and band of one variable under expert and agent, in a zoom without the band; an input is held until the next sample.

    Of several runs the medians of mean and standard deviation at each sample, and the mean of each run as a thin line.
    """
    response = response if zoom_from is None else response[response["time_index"] >= zoom_from]
    for controller in ("expert", "agent"):
        rows = response[(response["controller"] == controller) & (response["variable"] == variable)]
        if rows.empty:
            raise ValueError(f"response table: expected rows of controller '{controller}' and variable '{variable}', found none")
        kind = rows["kind"].iloc[0]
        colour, label, held = COLOURS[kind, controller], f"{kind}, {controller}", kind == "manipulated"
        if held:
            last = rows["time_index"].max()
            rows = pd.concat([rows, rows[rows["time_index"] == last].assign(time_index=last + 1)])
        style: Any = {"linestyle": LINE_STYLES[controller], "drawstyle": "steps-post" if held else "default"}
        _draw_runs(axes, rows, "time_index", "mean", color=colour, label=label, **style)
        if zoom_from is None:
            middle = rows.groupby("time_index")[["mean", "std"]].median()
            low, high = middle["mean"] - middle["std"], middle["mean"] + middle["std"]
            band: Any = {"alpha": BAND_OPACITY, "linewidth": 0, "step": "post" if held else None}
            axes.fill_between(middle.index, low, high, color=colour, label=f"{label}: {BAND}", **band)
    limits = [response["time_index"].min(), response["time_index"].max()]
    if set_point is not None:
        axes.plot(limits, [set_point, set_point], linewidth=2, label="set point", **AIM)
    title = f"{capital(words.get(variable, ''))} {symbol(variable)}".strip()
    if zoom_from is not None:
        title = f"Zoom of {symbol(variable)} from sample {zoom_from}"
    name = " ".join(part for part in (letter, variable, "" if zoom_from is None else "zoom") if part)
    unit = f"{symbol(variable)} ({DEVIATION})".replace(", ", ",\n")
    head(axes, letter, title, name, xlim=limits, xlabel=TIME_LABEL, ylabel=unit)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, steps=[1, 2, 5, 10]))


def _n_seeds(frame: pd.DataFrame) -> int:
    return int(frame["seed"].nunique()) if "seed" in frame else 1


def _draw_runs(axes: Axes, frame: pd.DataFrame, x: str, y: str, **style: Any) -> None:
    """The median over the runs at every x, and each run as a thin line where there are several; the fainter, the more they are."""
    if (n_seeds := _n_seeds(frame)) > 1:
        lines = [run[[x, y]].to_numpy(dtype=float) for _, run in frame.sort_values(x).groupby("seed")]
        if style.get("drawstyle") == "steps-post":
            lines = [np.column_stack([run[:, 0].repeat(2)[1:], run[:, 1].repeat(2)[:-1]]) for run in lines]
        thin: Any = {"linewidth": THIN, "alpha": max(0.4, 1 / n_seeds**0.5), "rasterized": len(frame) > MANY_POINTS}
        pale = (np.array(to_rgb(style["color"])) + 1) / 2  # many of them on one another stay lighter than the median
        axes.add_collection(LineCollection(lines, label=SINGLE, color=pale, **thin))
    middle = frame.groupby(x)[y].median()
    axes.plot(middle.index, middle, **style)


def _seed_handles(n_seeds: int) -> list[Line2D]:
    """What thin and thick lines mean, for a legend; with one seed there are none."""
    if n_seeds < 2:
        return []
    thin = Line2D([], [], color=INK, linewidth=THIN, label=f"thin: each of {n_seeds} seeds")
    return [thin, Line2D([], [], color=INK, label="thick: their median")]


def _legend(figure: Figure, response: pd.DataFrame, kinds: Sequence[str], agent_label: str, expert_label: str) -> None:
    """Every line and band of the figure, below its panels."""
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=COLOURS[kind, controller], linestyle=LINE_STYLES[controller], label=f"{kind} variable, {label}")
        for kind in kinds
        for controller, label in (("agent", agent_label), ("expert", expert_label))
    ]
    below, over = [Line2D([], [], linewidth=2, label="set point", **AIM)], ""
    if (n_seeds := _n_seeds(response)) > 1:
        below.append(Line2D([], [], color=INK, linewidth=THIN, label="thin lines: the mean of each seed"))
        over = f", medians over {n_seeds} seeds"
    band = Patch(facecolor="#888888", alpha=0.35, label=f"line and band: {BAND}{over}")
    # A legend fills column by column: one for the outputs, one for the inputs, where there are both.
    handles = [*handles[:2], *below, *handles[2:], band]
    narrow: Any = {"fontsize": 8, "labelspacing": 0.2} if figure.get_figwidth() < WIDTH else {}
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, **narrow)
