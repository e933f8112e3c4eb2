"""What the path from a historian file to a controller shows: data quality, the model on held-out records, the responses."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import seaborn
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from statsmodels.tsa.stattools import acf

from helpers.learning.model_gradient import GradientRecord
from helpers.own_plant.description import PlantDescription, Variable
from helpers.own_plant.gate import POLICY, RECORD, SIMPLEST, TUNED, Verdict
from helpers.own_plant.identify import Validation
from helpers.own_plant.learn import Workshop
from helpers.own_plant.quality import CleanRecords
from helpers.plant.tracking import Tracker, track
from helpers.report.figures import AIM, COLOURS, INK, LINE_STYLES, LOOP_COLOURS, WIDTH, empty_figure, head
from helpers.report.tables import capital, symbol

MEASURED, SIMULATED = COLOURS["controlled", "expert"], COLOURS["controlled", "agent"]
SHADES = {"left out": "#d9d9d9", "not in automatic": "#fde0b5"}
MODE_SHADES = {"manual": SHADES["not in automatic"], "hold": SHADES["left out"], "PID": "#d5ecd4"}
CANDIDATES = ("#6e6e6e", LOOP_COLOURS[4], LOOP_COLOURS[2], LOOP_COLOURS[0])  # in the order of `gate.SIMPLEST`
SHARES = {"mean |e|": "mean |e|, share of the record's PID's", "movement": "movement, share of the record's PID's"}
CURVES = {"cost": "cost (no unit)", "movement": "movement (share of what is allowed)", "price": "price on movement (no unit)"}
MOST_POINTS = 4000  # of a line: more cannot be told apart on a page


def quality_figure(clean: CleanRecords, description: PlantDescription, first: int = 0, n_samples: int | None = None) -> Figure:
    """A record after its repair from sample `first` on, a panel for each variable; engineering units; a long one is thinned out."""
    table = clean.table.iloc[first : None if n_samples is None else first + n_samples]
    table = table.iloc[:: max(1, len(table) // MOST_POINTS)]
    where = {"left out": table["segment"] < 0, "not in automatic": ~table["automatic"]}
    figure, panels = _panels(description, 1.7, 0.6)
    for axis, variable, look in panels:
        values = table[variable.tag].where(~where["left out"])
        axis.plot(table.index, values, linewidth=1.0, label=variable.tag, **look)
        if (tag := getattr(variable, "set_point_tag", None)) is not None:
            axis.plot(table.index, table[tag], linewidth=1.6, label=tag, **AIM)
        _shade(axis, SHADES, where)
    axis.set_xlim(*table.index[[0, -1]])
    axis.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    shades = [Patch(color=shade, label=label) for label, shade in SHADES.items()]
    _legend(figure, [*shades, Line2D([], [], label="set point", **AIM)])
    return figure


def loops_figure(workshop: Workshop, candidates: Mapping[str, Tracker], description: PlantDescription) -> Figure:
    """One episode of a model held out under every controller, a panel for each variable; engineering units."""
    scenarios = workshop.draw(workshop.held_out, 1, workshop.plant.stream("figure"))
    with torch.no_grad():
        runs = {name: track(tracker, scenarios, workshop.operation.bounds) for name, tracker in candidates.items()}
    figure, panels = _panels(description, 1.7, 0.7)
    for index, (axis, variable, look) in enumerate(panels):
        if index in workshop.operation.loops:
            aim = scenarios.set_point[:, 0, index].double() + variable.steady_state
            axis.plot(aim, drawstyle="steps-post", label="set point", **AIM)
        for (name, run), colour in zip(runs.items(), CANDIDATES, strict=False):
            signal = [*run.y[:, 0].T, *run.u[:, 0].T][index].double() + variable.steady_state
            dash = LINE_STYLES["expert"] if name == TUNED else "-"
            axis.plot(signal, linewidth=1.8 if name == POLICY else 1.1, linestyle=dash, label=name, **look | {"color": colour})
    _legend(figure, figure.axes[0].get_legend_handles_labels()[0], 5)
    return figure


def gate_figure(verdict: Verdict) -> Figure:
    """Every model of the gate: mean |e| and movement of each controller as shares of those of the record's PID."""
    figure = empty_figure(WIDTH, 3.4)
    frame, order = verdict.models[verdict.models["controller"] != RECORD], [name for name in SIMPLEST if name != RECORD]
    for axis, (what, label) in zip(figure.subplots(1, 2), SHARES.items(), strict=True):
        look = {"order": order, "hue": "controller", "hue_order": order, "palette": list(CANDIDATES[1:]), "legend": False}
        seaborn.boxenplot(frame, x=what, y="controller", ax=axis, **look)
        axis.axvline(1.0, color=INK, linewidth=1.0, linestyle="--")
        axis.set(xlabel=label, ylabel="")
    return figure


def progress_figure(records: Sequence[GradientRecord]) -> Figure:
    """Over the gradient steps the cost (mean |e|, a share of the record's PID's, any excess many times), movement and its price."""
    frame = pd.DataFrame([vars(record) for record in records])
    figure = empty_figure(WIDTH, 3.0)
    for axis, (column, name) in zip(figure.subplots(1, 3), CURVES.items(), strict=True):
        axis.plot(frame.index + 1, frame[column], color=SIMULATED, linewidth=1.0, label=name)
        if column != "price":
            axis.axhline(1.0, color=INK, linewidth=1.0, linestyle="--", label="the record's PID, or what it allows")
        head(axis, "", name, name, xlabel="gradient step")
    return figure


def validation_figure(validation: Validation, description: PlantDescription) -> Figure:
    """The identified model on held-out records: the first window simulated from its inputs, and the residuals' autocorrelation."""
    variables = description.controlled
    figure = empty_figure(WIDTH, 2.6 * len(variables) + 0.5)
    axes = figure.subplots(len(variables), 2, squeeze=False)
    measured, simulated = validation.measured[0], validation.simulated[0]
    for index, (variable, (left, right)) in enumerate(zip(variables, axes, strict=True)):
        left.plot(measured[:, index], color=MEASURED, linestyle=LINE_STYLES["expert"], label="measured")
        left.plot(simulated[:, index], color=SIMULATED, label="simulated from the inputs")
        title = f"{symbol(variable.name)}: fit {100 * validation.fit[index]:.0f} % over {len(validation.measured)} windows"
        head(left, "", title, f"{variable.name} simulated", ylabel=f"deviation ({variable.unit})")
        values, reach = acf(validation.residuals[index], nlags=20)[1:], 1.96 / len(validation.residuals[index]) ** 0.5
        right.axhspan(-reach, reach, color=SHADES["left out"], label="95 % of white noise")
        lags = np.arange(1, len(values) + 1)
        right.bar(lags, values, width=0.2, color=INK)
        right.plot(lags, values, "o", color=INK, markersize=3, label="autocorrelation")
        title = f"{symbol(variable.name)}: residuals, Ljung-Box p = {validation.p_value[index]:.2g}"
        head(right, "", title, f"{variable.name} residuals", ylabel="autocorrelation (no unit)")
        right.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes[-1, 0].set_xlabel("sample of the window")
    axes[-1, 1].set_xlabel("lag (samples)")
    _legend(figure, [handle for axis in axes[0] for handle in axis.get_legend_handles_labels()[0]], 4)
    return figure


def guard_figure(steps: pd.DataFrame, description: PlantDescription) -> Figure:
    """A guarded policy sample by sample, a panel for each variable; engineering units. The shade says who sets the inputs.

    `steps` has a row a sample; columns mode, a name for each variable, and `<name>_sp` for the set points.
    """
    here = {mode: steps["mode"].eq(mode) for mode in MODE_SHADES}
    where = {mode: mask | mask.shift(fill_value=False) for mode, mask in here.items()}
    figure, panels = _panels(description, 1.6, 0.7)
    for axis, variable, look in panels:
        axis.plot(steps.index, steps[variable.name], label=variable.name, **look)
        if variable in description.controlled:
            axis.plot(steps.index, steps[f"{variable.name}_sp"], drawstyle="steps-post", label="set point", **AIM)
        _shade(axis, MODE_SHADES, where, step="post")
    axis.set_xlim(*steps.index[[0, -1]])
    _legend(figure, [*(Patch(color=shade, label=mode) for mode, shade in MODE_SHADES.items()), figure.axes[0].lines[1]])
    return figure


def _panels(description: PlantDescription, each: float, beside: float) -> tuple[Figure, list[tuple[Axes, Variable, Any]]]:
    """A panel for each variable, `each` inches high, with the look of its line: an input is held until the next sample."""
    variables: list[Variable] = [*description.controlled, *description.manipulated]
    figure = empty_figure(WIDTH, each * len(variables) + beside)
    axes = figure.subplots(len(variables), 1, sharex=True, squeeze=False)[:, 0]
    looks = []
    for axis, variable in zip(axes, variables, strict=True):
        words = capital(variable.description or variable.name)
        head(axis, "", f"{words} ({variable.tag})", variable.name, ylabel=variable.unit)
        held = variable not in description.controlled
        colour = COLOURS["manipulated" if held else "controlled", "agent"]
        looks.append({"color": colour, "drawstyle": "steps-post" if held else "default"})
    axes[-1].set_xlabel("sample")
    return figure, list(zip(axes, variables, looks, strict=True))


def _shade(axis: Axes, shades: Mapping[str, str], where: Mapping[str, pd.Series], **style: Any) -> None:
    """The background of the samples of which something is so."""
    low, high = axis.get_ylim()
    for label, shade in shades.items():
        mask = where[label]
        axis.fill_between(mask.index, low, high, where=mask, color=shade, linewidth=0, zorder=0, label=label, **style)
    axis.set_ylim(low, high)


def _legend(figure: Figure, handles: Sequence[Artist], columns: int | None = None) -> None:
    """What is drawn, below the panels."""
    figure.legend(handles=handles, loc="outside lower center", ncols=columns or len(handles), frameon=False)
