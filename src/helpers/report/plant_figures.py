"""What the path from a historian file to a controller shows: data quality, the model on held-out records, the responses."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import seaborn
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from statsmodels.tsa.stattools import acf

from helpers.learning.model_gradient import GradientRecord
from helpers.own_plant.description import PlantDescription, Variable
from helpers.own_plant.gate import POLICY, RECORD, SIMPLEST, Verdict
from helpers.own_plant.identify import Validation
from helpers.own_plant.learn import Workshop
from helpers.own_plant.quality import CleanRecords
from helpers.plant.tracking import Tracker, track
from helpers.report.figures import COLOURS, INK, LINE_STYLES, LOOP_COLOURS, SET_POINT, WIDTH, empty_figure
from helpers.report.tables import symbol

MEASURED, SIMULATED = COLOURS["controlled", "expert"], COLOURS["controlled", "agent"]
LEFT_OUT, BY_HAND = "#d9d9d9", "#fde0b5"
MODE_COLOURS = {"manual": BY_HAND, "hold": LEFT_OUT, "PID": "#d5ecd4"}
CANDIDATES = ("#6e6e6e", LOOP_COLOURS[4], LOOP_COLOURS[2], LOOP_COLOURS[0])  # in the order of `gate.SIMPLEST`
SHARES = {"mean |e|": "mean |e|, share of the record's PID's", "movement": "movement, share of the record's PID's"}
CURVES = {
    "cost": "mean |e|, share of the record's PID's",
    "movement": "movement, share of what is allowed",
    "price": "price on movement",
}
MOST_POINTS = 4000  # of a line: more cannot be told apart on a page


def quality_figure(clean: CleanRecords, description: PlantDescription, first: int = 0, n_samples: int | None = None) -> Figure:
    """A record after its repair, a panel for each variable; engineering units.

    Args:
        first, n_samples: which samples; all of them without. A long record is thinned out evenly.
    """
    table = clean.table.iloc[first : None if n_samples is None else first + n_samples]
    table = table.iloc[:: max(1, len(table) // MOST_POINTS)]
    sample = table.index.to_numpy()
    variables: list[Variable] = [*description.controlled, *description.manipulated]
    figure = empty_figure(WIDTH, 1.7 * len(variables) + 0.6)
    axes = figure.subplots(len(variables), 1, sharex=True, squeeze=False)[:, 0]
    for axis, variable in zip(axes, variables, strict=True):
        controlled = variable in description.controlled
        values = table[variable.tag].where(table["segment"] >= 0)
        colour = COLOURS["controlled" if controlled else "manipulated", "agent"]
        axis.plot(
            sample, values, color=colour, linewidth=1.0, drawstyle="default" if controlled else "steps-post", label=variable.tag
        )
        tag = getattr(variable, "set_point_tag", None)
        if tag is not None:
            axis.plot(sample, table[tag], color=SET_POINT, linestyle=LINE_STYLES["set point"], linewidth=1.6, label=tag)
        for mask, shade, label in (
            (table["segment"] < 0, LEFT_OUT, "left out"),
            (~table["automatic"], BY_HAND, "not in automatic"),
        ):
            low, high = axis.get_ylim()
            axis.fill_between(sample, low, high, where=mask.to_numpy(), color=shade, linewidth=0, zorder=0, label=label)
            axis.set_ylim(low, high)
        _title(axis, variable)
    axes[-1].set_xlabel("sample")
    axes[-1].set_xlim(sample[0], sample[-1])
    axes[-1].xaxis.set_major_locator(MaxNLocator(8, integer=True))
    handles: list[Patch | Line2D] = [Patch(color=LEFT_OUT, label="left out"), Patch(color=BY_HAND, label="not in automatic")]
    handles.append(Line2D([], [], color=SET_POINT, linestyle=LINE_STYLES["set point"], label="set point"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def loops_figure(workshop: Workshop, candidates: Mapping[str, Tracker], description: PlantDescription) -> Figure:
    """One episode of a model held out under every controller, a panel for each variable; engineering units."""
    scenarios = workshop.draw(workshop.held_out, 1, workshop.plant.stream("figure"))
    with torch.no_grad():
        runs = {name: track(tracker, scenarios, workshop.operation.bounds) for name, tracker in candidates.items()}
    variables: list[Variable] = [*description.controlled, *description.manipulated]
    figure = empty_figure(WIDTH, 1.7 * len(variables) + 0.7)
    axes = figure.subplots(len(variables), 1, sharex=True, squeeze=False)[:, 0]
    for index, (axis, variable) in enumerate(zip(axes, variables, strict=True)):
        controlled, place = index < len(description.controlled), index % len(description.controlled)
        place = index if controlled else index - len(description.controlled)
        if place in workshop.operation.loops and controlled:
            aim = scenarios.set_point[:, 0, place].double() + variable.steady_state
            axis.plot(aim, color=SET_POINT, linestyle=LINE_STYLES["set point"], drawstyle="steps-post", label="set point")
        for (name, run), colour in zip(runs.items(), CANDIDATES, strict=False):
            signal = (run.y if controlled else run.u)[:, 0, place].double() + variable.steady_state
            style, width = "default" if controlled else "steps-post", 1.8 if name == POLICY else 1.1
            axis.plot(signal, color=colour, drawstyle=style, linewidth=width, label=name)
        _title(axis, variable)
    axes[-1].set_xlabel("sample")
    figure.legend(handles=axes[0].get_legend_handles_labels()[0], loc="outside lower center", ncols=5, frameon=False)
    return figure


def gate_figure(verdict: Verdict) -> Figure:
    """Every model of the gate: mean |e| and movement of each controller as shares of those of the record's PID."""
    figure = empty_figure(WIDTH, 3.4)
    for axis, (what, label) in zip(figure.subplots(1, 2), SHARES.items(), strict=True):
        frame = verdict.models[verdict.models["controller"] != RECORD]
        order = [name for name in SIMPLEST if name != RECORD]
        seaborn.boxenplot(
            frame, x=what, y="controller", hue="controller", order=order, hue_order=order, palette=list(CANDIDATES[1:]),
            legend=False, ax=axis,
        )  # fmt: skip
        axis.axvline(1.0, color=INK, linewidth=1.0, linestyle="--")
        axis.set_xlabel(label)
        axis.set_ylabel("")
    return figure


def progress_figure(records: Sequence[GradientRecord]) -> Figure:
    """Cost, movement and its price over the gradient steps."""
    frame = pd.DataFrame([vars(record) for record in records]).rename(columns=CURVES)
    figure = empty_figure(WIDTH, 3.0)
    for axis, (name, level) in zip(figure.subplots(1, 3), zip(CURVES.values(), (1.0, 1.0, None), strict=True), strict=True):
        axis.plot(frame.index + 1, frame[name], color=SIMULATED, linewidth=1.0, label=name)
        if level is not None:
            axis.axhline(level, color=INK, linewidth=1.0, linestyle="--", label="the PID")
        axis.set_title(name, loc="left")
        axis.set_xlabel("gradient step")
    return figure


def _title(axis: Axes, variable: Variable) -> None:
    words = variable.description or variable.name
    axis.set_title(f"{words[:1].upper()}{words[1:]} ({variable.tag})", loc="left")
    axis.set_ylabel(variable.unit)
    axis.set_label(variable.name)


def validation_figure(validation: Validation, description: PlantDescription, window: int = 0) -> Figure:
    """The identified model on held-out records: one window simulated from its inputs, and the residuals' autocorrelation."""
    variables = description.controlled
    figure = empty_figure(WIDTH, 2.6 * len(variables) + 0.5)
    axes = figure.subplots(len(variables), 2, squeeze=False)
    measured, simulated = validation.measured[window], validation.simulated[window]
    for index, (variable, (left, right)) in enumerate(zip(variables, axes, strict=True)):
        left.plot(measured[:, index], color=MEASURED, linestyle=LINE_STYLES["expert"], label="measured")
        left.plot(simulated[:, index], color=SIMULATED, label="simulated from the inputs")
        left.set_title(
            f"{symbol(variable.name)}: fit {100 * validation.fit[index]:.0f} % over {len(validation.measured)} windows", loc="left"
        )
        left.set_ylabel(f"deviation, {variable.unit}")
        values = acf(validation.residuals[index], nlags=20)[1:]
        right.axhspan(
            -1.96 / len(validation.residuals[index]) ** 0.5,
            1.96 / len(validation.residuals[index]) ** 0.5,
            color=LEFT_OUT,
            label="95 % of white noise",
        )
        lags = np.arange(1, len(values) + 1)
        right.bar(lags, values, width=0.2, color=INK)
        right.plot(lags, values, "o", color=INK, markersize=3, label="autocorrelation")
        right.set_title(f"{symbol(variable.name)}: residuals, Ljung-Box p = {validation.p_value[index]:.2g}", loc="left")
        right.set_ylabel("autocorrelation")
        right.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        left.set_label(f"{variable.name} simulated")
        right.set_label(f"{variable.name} residuals")
    axes[-1, 0].set_xlabel("sample of the window")
    axes[-1, 1].set_xlabel("lag (samples)")
    handles = [*axes[0, 0].get_legend_handles_labels()[0], *axes[0, 1].get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure


def guard_figure(steps: pd.DataFrame, description: PlantDescription) -> Figure:
    """A guarded policy sample by sample, a panel for each variable; engineering units. The shade says who sets the inputs.

    Args:
        steps: a row a sample; columns mode, a name for each variable, and `<name>_sp` for the set points.
    """
    variables: list[Variable] = [*description.controlled, *description.manipulated]
    figure = empty_figure(WIDTH, 1.6 * len(variables) + 0.7)
    axes = figure.subplots(len(variables), 1, sharex=True, squeeze=False)[:, 0]
    sample = steps.index.to_numpy()
    for axis, variable in zip(axes, variables, strict=True):
        controlled = variable in description.controlled
        colour = COLOURS["controlled" if controlled else "manipulated", "agent"]
        style = "default" if controlled else "steps-post"
        axis.plot(sample, steps[variable.name], color=colour, drawstyle=style, label=variable.name)
        if controlled:
            axis.plot(
                sample,
                steps[f"{variable.name}_sp"],
                color=SET_POINT,
                linestyle=LINE_STYLES["set point"],
                drawstyle="steps-post",
                label="set point",
            )
        low, high = axis.get_ylim()
        for mode, shade in MODE_COLOURS.items():
            here = steps["mode"].eq(mode)
            where = (here | here.shift(fill_value=False)).to_numpy()
            axis.fill_between(sample, low, high, where=where, color=shade, linewidth=0, zorder=0, step="post", label=mode)
        axis.set_ylim(low, high)
        _title(axis, variable)
    axes[-1].set_xlabel("sample")
    axes[-1].set_xlim(sample[0], sample[-1])
    handles = [Patch(color=shade, label=mode) for mode, shade in MODE_COLOURS.items()]
    figure.legend(handles=[*handles, axes[0].lines[1]], loc="outside lower center", ncols=len(handles) + 1, frameon=False)
    return figure
