"""What the report shows as tables: Tables 1-4, control quality, variants, trials and parameters, also as Markdown."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from helpers.settings.paper import CaseParams, ProcessParams

ROMAN = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII", "IX", "X")
QUANTITIES = {"expert": "E[v^E]", "policy": "E[v^pi]", "alpha": "alpha*"}  # the rows of Tables 2-4, in their order
RESULT_DECIMALS = {"expert": 2, "policy": 2, "alpha": 3}  # of each row, as the paper prints them
CONTROLLERS = {
    "expert_paired": "PID",
    "offline": "offline policy",
    "online": "online policy",
    "online_y": "online policy, learned on y",
    "minimum_variance": "minimum variance on y",
}
LEARNING = {"offline": "improved", "offline_printed": "printed", "offline_scratch": "improved, from scratch"}
COSTS = ("epochs", "chosen_epoch", "episodes", "gradient_steps")
TYPESET = {"E[v^E]": r"$\mathbb{E}[v^E]$", "E[v^pi]": r"$\mathbb{E}[v^\pi]$", "alpha*": r"$\alpha^*$"}
NOT_KNOWN = "–"
FEATURE = re.compile(r"(\w+)-(I{1,3})")
NUMBER = re.compile(rf"-?[\d.]+(e-?\d+)?( %)?( \[.*\]| \(.*\))?|{NOT_KNOWN}|inf")
VARIABLE = re.compile(r"(?<![A-Za-z_])(C_A0|C_A|T_E)(?![A-Za-z0-9_])")
LOOP = re.compile(r"(.*)\((\w+)\) control loop")
BOUNDS = {"input_bound": "bounds ±", "input_low": "lower bound", "input_high": "upper bound"}  # settings of notebook 00 in words
NOISE = 1e-6  # a fitted gain below it is none


def case_study(case: int) -> str:
    """A case as the paper calls it."""
    return f"Case Study {ROMAN[case - 1]}"


def capital(words: str) -> str:
    """Words as a sentence begins; what follows stays as it is."""
    return words[:1].upper() + words[1:]


def symbol(name: str) -> str:
    """A variable in TeX: C_A0 becomes $C_{A0}^*$; the star marks a deviation variable, as in the paper."""
    letter, _, index = name.partition("_")
    letter = letter if len(letter) == 1 else rf"\mathrm{{{letter}}}"
    index = index.replace("_", ",")
    return f"${letter}_{{{index}}}^*$" if len(index) > 1 else f"${letter}_{index}^*$" if index else f"${letter}^*$"


def feature_symbol(name: str) -> str:
    """A feature with its variable in TeX: C_A-I becomes $C_A^*$-I."""
    variable, _, kind = name.rpartition("-")
    return f"{symbol(variable)}-{kind}"


def setting_words(setting: str, component: str) -> str:
    """A setting of notebook 00 as a reader knows it: PID1.integral of T becomes PID1 integral gain, $T^*$."""
    controller, _, kind = setting.rpartition(".")
    words = f"{controller} {kind} gain" if controller else BOUNDS.get(kind, kind.replace("_", " "))
    return words if component == "-" else f"{words}, {symbol(component)}"


def inferred_settings(settings: pd.DataFrame) -> pd.DataFrame:
    """The settings that notebook 00 fitted (columns setting, component, value, low, high, in_parameter_files), in words."""
    names = [setting_words(*place) for place in settings[["setting", "component"]].itertuples(index=False)]
    numbers = settings[["value", "low", "high", "in_parameter_files"]]
    found = settings.assign(setting=names, **numbers.where(numbers.abs() > NOISE, 0.0))
    return found.drop(columns="component").rename(columns={"value": "best value"})


def table_1(cases: Mapping[int, CaseParams], process: ProcessParams) -> pd.DataFrame:
    """Table 1: where each case study starts and where it should go, a column for each loop.

    The second argument of N is printed as in the paper; the parameter files say how it is read.
    """
    loops = zip(process.controlled, process.controlled_description, strict=True)
    rows = []
    for case, params in cases.items():
        start = zip(params.initial_mean, params.initial_std, strict=True)
        rows.append([ROMAN[case - 1], "initial state distribution", *(f"N({mean:g}, {std:g})" for mean, std in start)])
        rows.append([ROMAN[case - 1], "set point", *(f"{target:g}" for target in params.set_point)])
    headers = [f"{capital(description)} ({name}) control loop" for name, description in loops]
    return pd.DataFrame(rows, columns=["case_study", "system_parameter", *headers])


def spread(numbers: Mapping[str, Any] | pd.Series, decimals: int | None = None, unit: str = "") -> str:
    """A median with its interval as text: 16.8 [16.5, 17.0]; the median alone where there is no interval or no spread at all.

    `numbers` holds median, ci_low and ci_high, shown with so many decimals or, without, three significant digits of the greatest.
    """
    values = [float(numbers[name]) for name in ("median", "ci_low", "ci_high")]
    if np.isnan(values[0]):
        return NOT_KNOWN
    if decimals is None:
        size = np.nanmax(np.abs(values))
        decimals = max(0, 2 - int(np.floor(np.log10(size)))) if size > 0 else 0
    median, low, high = (_number(value, decimals=decimals) for value in values)
    bare = np.isnan(values[1:]).any() or values[1] == values[2]
    return f"{median}{unit}" if bare else f"{median}{unit} [{low}, {high}]"


def results_table(compared: pd.DataFrame, feature_names: Sequence[str]) -> pd.DataFrame:
    """Table 2, 3 or 4 as text, from one case of the comparison: printed row, our median, the interval of a run, the verdict."""
    rows = []
    for row, decimals in RESULT_DECIMALS.items():
        numbers = compared[compared["row"] == row].set_index("feature").loc[list(feature_names)]
        shown = numbers.select_dtypes("number").map(_cell, decimals=decimals)
        lines = {
            "published": shown["published"],
            "reproduced": shown["reproduced"],
            "interval of one run": (shown["pred_low"] + " to " + shown["pred_high"]).where(numbers["pred_low"].notna(), NOT_KNOWN),
            "verdict": numbers["verdict"],
        }
        for source, line in lines.items():
            if (line != NOT_KNOWN).any():
                rows.append({"quantity": QUANTITIES[row], "source": source, **line.to_dict()})
    return pd.DataFrame(rows)


def quality_table(medians: pd.DataFrame, process: ProcessParams) -> pd.DataFrame:
    """Control quality of one case (columns stage, metric, median, ci_low, ci_high) as text: figures of merit by controller."""
    labels: dict[str, tuple[str, int, int | None]] = {  # of each metric its label, factor and digits after the point
        "objective_x": ("$J$ on $x$", 1, 2),
        "share": ("$J$ on $x$, % of minimum variance", 100, 1),
        "objective_y": ("$J$ on $y$", 1, 2),
    }
    for name in process.controlled:
        labels |= {f"{what}:{name}": (f"{what} {symbol(name)}, %", 100, 1) for what in ("overshoot", "offset")}
        labels[f"rise_time:{name}"] = (f"rise time {symbol(name)}, time", 1, 2)
    labels |= {f"movement:{name}": (f"movement {symbol(name)}", 1, None) for name in process.manipulated}
    labels["episodes"] = ("plant episodes spent", 1, 0)
    values = medians.set_index(["metric", "stage"])[["median", "ci_low", "ci_high"]]
    rows = []
    for metric, (label, factor, decimals) in labels.items():
        row = {"figure of merit": label}
        for stage, name in CONTROLLERS.items():
            of_the_model = metric == "episodes" and stage == "offline"
            row[name] = NOT_KNOWN if of_the_model else spread(factor * values.reindex([(metric, stage)]).iloc[0], decimals=decimals)
        rows.append(row)
    return pd.DataFrame(rows)


def variants_table(medians: pd.DataFrame) -> pd.DataFrame:
    """Gap in per cent (median, 95 % interval, worst seed) and cost of each way of offline learning, from a `scorecard.summary`."""
    rows = []
    for (case, stage), group in medians[medians["stage"].isin(LEARNING)].groupby(["case", "stage"]):
        found = group.set_index("metric")
        gap = 100 * found.loc["feature_gap", ["median", "ci_low", "ci_high", "greatest"]].astype(float)
        row = {"case": ROMAN[int(case) - 1], "learning": LEARNING[stage], "seeds": found.loc["feature_gap", "n_seeds"]}
        row |= {"feature gap, %": spread(gap, decimals=1), "worst seed, %": _number(gap["greatest"], decimals=1)}
        rows.append(row | {name.replace("_", " "): round(found.loc[name, "median"]) for name in COSTS})
    return pd.DataFrame(rows).sort_values(["case", "learning"], ignore_index=True)


def trials_table(trials: pd.DataFrame) -> pd.DataFrame:
    """What was tried offline, a row for each trial: what it changes and for each case the feature gap in per cent.

    A cell holds the median over the seeds with the least and the greatest, and how many they are. `trials` has the columns trial,
    family, description, case, seed, gap (a share of one).
    """
    over_seeds = trials.groupby(["trial", "case"])["gap"].agg(["median", "min", "max", "count"])
    rows = []
    for trial in trials.drop_duplicates("trial").to_dict("records"):
        row = {name: trial[name] for name in ("family", "trial", "description")}
        for case in sorted(trials["case"].unique()):
            middle, least, most, n_seeds = over_seeds.reindex([(trial["trial"], case)]).iloc[0]
            shown = f"{100 * middle:.1f} ({100 * least:.1f} to {100 * most:.1f}; {n_seeds:.0f} seed{'s' * (n_seeds > 1)})"
            row[f"case {ROMAN[case - 1]}, %"] = NOT_KNOWN if np.isnan(middle) else shown
        rows.append(row)
    return pd.DataFrame(rows)


def time_table(seconds: pd.DataFrame) -> pd.DataFrame:
    """Seconds of each stage (rows) in each case (columns), from columns case, stage, seconds."""
    wide = seconds.pivot_table(index="stage", columns="case", values="seconds").map(_cell, decimals=0)
    wide = wide.rename(index=lambda stage: stage.replace("_", " "), columns=lambda case: f"Case {ROMAN[case - 1]}")
    return wide.reset_index()


def parameters_table(leaves: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Every parameter once, as text: file, key, value, unit, source, status; the leaves of several cases repeat shared files."""
    rows = [{**leaf, "value": render(leaf["value"])} for leaf in leaves]
    return pd.DataFrame(rows, columns=["file", "key", "value", "unit", "source", "status"]).drop_duplicates(ignore_index=True)


def render(value: Any) -> str:
    """A parameter's value as text: numbers without needless digits, vectors in brackets, yes and no for flags."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(render(entry) for entry in value)}]"
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def to_markdown(frame: pd.DataFrame, digits: int = 4, labels: Mapping[str, str] | None = None) -> str:
    """A pipe table for pandoc, without the index; columns of numbers, with or without an interval, to the right.

    Feature names and the quantities of Tables 2-4 are typeset, Markdown's own characters are escaped. A number that is not an
    integer has so many significant digits; `labels` are headers by column, instead of its name with spaces for underscores.
    """
    cells = pd.DataFrame({column: [_cell(value, digits) for value in frame[column]] for column in frame.columns})
    align = ["right" if all(map(NUMBER.fullmatch, cells[column])) else "left" for column in cells] if len(cells) else None
    headers = [_text(labels[column]) if labels and column in labels else _header(str(column)) for column in frame.columns]
    return cells.to_markdown(index=False, headers=headers, disable_numparse=True, colalign=align)


def _header(name: str) -> str:
    typeset = _text(name)
    if typeset != name or "$" in name:
        return typeset
    parts = VARIABLE.sub(lambda found: symbol(found[0]), name).split(" ")
    return capital(" ".join(part if "$" in part else part.replace("_", " ") for part in parts))


def _cell(value: Any, digits: int = 4, decimals: int | None = None) -> str:
    if isinstance(value, str):
        return _text(value)
    if pd.isna(value):
        return NOT_KNOWN
    if isinstance(value, (float, np.floating)):
        return _number(float(value), digits, decimals)
    return render(bool(value) if isinstance(value, np.bool_) else value)


def _number(value: float, digits: int = 4, decimals: int | None = None) -> str:
    """Fixed decimals, or significant digits without an exponent for a large number; no minus before a zero."""
    if decimals is not None:
        return f"{round(value, decimals) + 0.0:.{decimals}f}"
    return f"{value:.0f}" if 10**digits <= abs(value) < np.inf else f"{value + 0.0:.{digits}g}"


def _text(text: str) -> str:
    """Text as Markdown: names that are known are typeset, maths stays, and everything else is escaped."""
    if text in TYPESET:
        return TYPESET[text]
    if FEATURE.fullmatch(text):
        return feature_symbol(text)
    if loop := LOOP.fullmatch(text):
        return f"{loop[1]}({symbol(loop[2])}) control loop"
    parts = re.split(r"(\$[^$]+\$)", text)
    return "".join(part if index % 2 else re.sub(r"([\\|*<^~`])", r"\\\1", part) for index, part in enumerate(parts))
