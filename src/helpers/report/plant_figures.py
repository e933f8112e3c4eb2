"""What the path from a historian file to a controller shows: data quality, the model on held-out records, the responses."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from statsmodels.tsa.stattools import acf

from helpers.own_plant.description import ControlledVariable, PlantDescription, Variable
from helpers.own_plant.identify import Validation
from helpers.own_plant.quality import CleanRecords
from helpers.report.figures import COLOURS, INK, LINE_STYLES, SET_POINT, WIDTH, empty_figure
from helpers.report.tables import symbol
from helpers.settings.leaf import DEVIATION

MEASURED, SIMULATED = COLOURS["controlled", "expert"], COLOURS["controlled", "agent"]
LEFT_OUT, BY_HAND = "#d9d9d9", "#fde0b5"
MODE_COLOURS = {"manual": BY_HAND, "hold": LEFT_OUT, "PID": "#d5ecd4"}
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
        words = variable.description or variable.name
        axis.set_title(f"{words[:1].upper()}{words[1:]} ({variable.tag})", loc="left")
        axis.set_ylabel(variable.unit)
        axis.set_label(variable.tag)
    axes[-1].set_xlabel("sample")
    axes[-1].set_xlim(sample[0], sample[-1])
    axes[-1].xaxis.set_major_locator(MaxNLocator(8, integer=True))
    handles: list[Patch | Line2D] = [Patch(color=LEFT_OUT, label="left out"), Patch(color=BY_HAND, label="not in automatic")]
    handles.append(Line2D([], [], color=SET_POINT, linestyle=LINE_STYLES["set point"], label="set point"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def response_figure(response: pd.DataFrame, description: PlantDescription) -> Figure:
    """Controlled variables above, inputs below, under a policy and as recorded: mean and standard deviation, engineering units.

    Args:
        response: of `stages.response_table`, the policy as the agent and the record as the expert; deviation variables.
    """
    rows = {"controlled": description.controlled, "manipulated": description.manipulated}
    n_columns = max(len(variables) for variables in rows.values())
    figure = empty_figure(max(WIDTH, WIDTH / 2 * n_columns), 5.6)
    grid = figure.subplots(2, n_columns, sharex=True, squeeze=False)
    for axes, (kind, variables) in zip(grid, rows.items(), strict=True):
        for axis in axes[len(variables) :]:
            axis.set_visible(False)
        for axis, variable in zip(axes, variables, strict=False):
            words = variable.description or variable.name
            for controller, source in (("expert", "record"), ("agent", "policy")):
                label = source if kind == "controlled" else f"{source}, input"
                lines = response[(response["variable"] == variable.name) & (response["controller"] == controller)]
                mean, time, colour = lines["mean"] + variable.steady_state, lines["time_index"], COLOURS[kind, controller]
                steps, step = ("steps-post", "post") if kind == "manipulated" else ("default", None)
                axis.plot(time, mean, color=colour, linestyle=LINE_STYLES[controller], drawstyle=steps, label=label)
                axis.fill_between(time, mean - lines["std"], mean + lines["std"], color=colour, alpha=0.2, linewidth=0, step=step)
            if isinstance(variable, ControlledVariable):
                axis.axhline(variable.set_point, color=SET_POINT, linestyle=LINE_STYLES["set point"], label="set point")
            axis.set_title(f"{words[:1].upper()}{words[1:]} ({variable.tag})", loc="left")
            axis.set_ylabel(variable.unit)
            axis.set_xlabel("sample" if kind == "manipulated" else "")
            axis.set_label(variable.name)
    handles = [handle for axes in grid for handle in axes[0].get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


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
        values = acf(validation.residuals[:, index], nlags=20)[1:]
        right.axhspan(
            -1.96 / len(validation.residuals) ** 0.5,
            1.96 / len(validation.residuals) ** 0.5,
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


def with_units(figure: Figure, description: PlantDescription) -> Figure:
    """A figure of responses with the units of this plant; its panels carry the name of their variable as label."""
    words = {variable.name: variable.unit for variable in (*description.controlled, *description.manipulated)}
    for axis in figure.axes:
        names = [name for name in str(axis.get_label()).split() if name in words]
        if names:
            label = axis.get_ylabel().replace("\n", " ").replace(DEVIATION, f"deviation, {words[names[0]]}")
            axis.set_ylabel(label)
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
        words = variable.description or variable.name
        axis.set_title(f"{words[:1].upper()}{words[1:]} ({variable.name})", loc="left")
        axis.set_ylabel(variable.unit)
        axis.set_label(variable.name)
    axes[-1].set_xlabel("sample")
    axes[-1].set_xlim(sample[0], sample[-1])
    handles = [Patch(color=shade, label=mode) for mode, shade in MODE_COLOURS.items()]
    figure.legend(handles=[*handles, axes[0].lines[1]], loc="outside lower center", ncols=len(handles) + 1, frameon=False)
    return figure
