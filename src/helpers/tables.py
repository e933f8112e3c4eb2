"""Tables 1-4, the comparison with the paper and the list of parameters, as frames and as Markdown for the report."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from helpers.params import CaseParams, ProcessParams, PublishedCase

ROMAN = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII", "IX", "X")
QUANTITIES = {"expert": "E[v^E]", "policy": "E[v^pi]", "alpha": "alpha*"}  # the rows of Tables 2-4, in their order
RESULT_DECIMALS = (2, 2, 2, 2, 3, 3)  # of the rows of `results_table`, as the paper prints them
REPRODUCED_BY = {"expert": ("expert", "v"), "policy": ("offline", "v"), "alpha": ("offline", "alpha")}  # stage, metric
COMPARISON_COLUMNS = ["table", "case", "row", "feature", "published", "reproduced", "n_seeds"]
TYPESET = {
    "E[v^E]": r"$\mathbb{E}[v^{\gamma,E}]$",
    "E[v^pi]": r"$\mathbb{E}[v^{\gamma,\pi}]$",
    "alpha*": r"$\alpha^*$",
}
FEATURE = re.compile(r"(\w+)-(I{1,3})")
LOOP = re.compile(r"(.*)\((\w+)\) control loop")
NOT_KNOWN = "–"


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


def table_1(cases: Mapping[int, CaseParams], process: ProcessParams) -> pd.DataFrame:
    """Table 1: where each case study starts and where it should go, a column for each loop.

    The second argument of N is printed as in the paper; the parameter files say how it is read.
    """
    loops = [
        f"{description[:1].upper()}{description[1:]} ({name}) control loop"
        for name, description in zip(process.controlled, process.controlled_description, strict=True)
    ]
    rows = []
    for case, params in cases.items():
        numeral = ROMAN[case - 1] if 0 < case <= len(ROMAN) else str(case)
        spread = [f"N({mean:g}, {std:g})" for mean, std in zip(params.initial_mean, params.initial_std, strict=True)]
        rows.append([numeral, "initial state distribution", *spread])
        rows.append([numeral, "set point", *(f"{target:g}" for target in params.set_point)])
    return pd.DataFrame(rows, columns=["case_study", "system_parameter", *loops])


def results_table(
    published: PublishedCase,
    expert: Mapping[str, float] | pd.Series,
    policy: Mapping[str, float] | pd.Series,
    alpha: Mapping[str, float] | pd.Series,
    feature_names: Sequence[str],
) -> pd.DataFrame:
    """Table 2, 3 or 4: each printed row and, below it, ours. Columns: quantity, source, then the features.

    Args:
        expert, policy, alpha: our E[v^E], E[v^pi] and alpha*, by feature name.
    """
    rows = []
    for row, ours in (("expert", expert), ("policy", policy), ("alpha", alpha)):
        printed = dict(zip(feature_names, getattr(published, row), strict=True))
        rows.append({"quantity": QUANTITIES[row], "source": "published", **printed})
        rows.append({"quantity": QUANTITIES[row], "source": "reproduced", **{name: float(ours[name]) for name in feature_names}})
    return pd.DataFrame(rows)


def comparison(published: Mapping[int, PublishedCase], seeds: pd.DataFrame, feature_names: Sequence[str]) -> pd.DataFrame:
    """One row for each published number of Tables 2-4, beside the median of ours over the seeds.

    A number that no seed gave is nan with n_seeds 0.

    Args:
        seeds: columns case, seed, stage, metric, value.
    """
    over_seeds = seeds.groupby(["case", "stage", "metric"])["value"].agg(["median", "count"])
    rows = []
    for case, printed in published.items():
        for row, (stage, metric) in REPRODUCED_BY.items():
            for feature, value in zip(feature_names, getattr(printed, row), strict=True):
                key = (case, stage, f"{metric}:{feature}")
                median, count = over_seeds.loc[key] if key in over_seeds.index else (np.nan, 0)
                rows.append([printed.table, case, row, feature, value, float(median), int(count)])
    return pd.DataFrame(rows, columns=COMPARISON_COLUMNS)


def gaps(seeds: pd.DataFrame, published: Mapping[int, PublishedCase], feature_names: Sequence[str]) -> pd.DataFrame:
    """How near the learned policy comes to the expert, ours and the paper's, and how near our expert comes to the paper's.

    Columns: case; n_seeds; feature_gap, its median over the seeds, with the least and the greatest; published_gap, the
    mean of |v_pi - v_E| / |v_E| over the paper's own rows; expert_error, the mean relative error of our expert row.
    All but the first two are shares of one.
    """
    compared = comparison(published, seeds, feature_names)
    rows = []
    for case, printed in published.items():
        ours = seeds.query("case == @case and stage == 'offline' and metric == 'feature_gap'")["value"]
        row = compared.query("case == @case and row == 'expert'")
        rows.append(
            {
                "case": case,
                "n_seeds": int(ours.count()),
                "feature_gap": ours.median(),
                "feature_gap_least": ours.min(),
                "feature_gap_greatest": ours.max(),
                "published_gap": printed.feature_gap,
                # A feature that is missing makes the mean nan instead of being left out of it.
                "expert_error": ((row["reproduced"] - row["published"]).abs() / row["published"].abs()).mean(skipna=False),
            }
        )
    return pd.DataFrame(rows)


def parameters_table(leaves: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Every parameter once, as text: file, key, value, unit, source, status.

    Args:
        leaves: rows as `params.load` lists them; those of several cases may repeat the shared files.
    """
    rows = [{**leaf, "value": render(leaf["value"])} for leaf in leaves]
    return pd.DataFrame(rows, columns=["file", "key", "value", "unit", "source", "status"]).drop_duplicates(ignore_index=True)


def render(value: Any) -> str:
    """A parameter's value as text: numbers without needless digits, vectors in brackets, yes and no for flags."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(render(entry) for entry in value)}]"
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def to_markdown(
    frame: pd.DataFrame, digits: int = 4, decimals: Sequence[int] | None = None, labels: Mapping[str, str] | None = None
) -> str:
    """A pipe table for pandoc, without the index; numbers to the right.

    Feature names and the quantities of Tables 2-4 are typeset, Markdown's own characters are escaped.

    Args:
        digits: significant digits of a number that is not an integer.
        decimals: instead, digits after the point, one entry for each row.
        labels: headers by column, instead of the column's name with spaces for underscores.
    """
    given = labels or {}
    numeric = [pd.api.types.is_numeric_dtype(kind) and not pd.api.types.is_bool_dtype(kind) for kind in frame.dtypes]
    places: Sequence[int | None] = decimals if decimals is not None else [None] * len(frame)
    cells = pd.DataFrame(
        {
            column: [_cell(value, digits, after) for value, after in zip(frame[column], places, strict=True)]
            for column in frame.columns
        }
    )
    headers = [_text(given[column]) if column in given else _header(str(column)) for column in frame.columns]
    return cells.to_markdown(
        index=False,
        headers=headers,
        disable_numparse=True,
        colalign=["right" if right else "left" for right in numeric] if len(cells) else None,
    )


def _header(name: str) -> str:
    typeset = _text(name)
    if typeset != name or FEATURE.fullmatch(name) or "$" in name:
        return typeset
    words = name.replace("_", " ")
    return words[:1].upper() + words[1:]


def _cell(value: Any, digits: int, decimals: int | None) -> str:
    if value is None or value is pd.NA or (isinstance(value, (float, np.floating)) and np.isnan(value)):
        return NOT_KNOWN
    if isinstance(value, (bool, np.bool_)):
        return render(bool(value))
    if isinstance(value, (int, np.integer)):
        return str(value)
    if isinstance(value, (float, np.floating)):
        return _number(float(value), digits, decimals)
    return _text(str(value))


def _number(value: float, digits: int, decimals: int | None) -> str:
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
