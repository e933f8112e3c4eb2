"""The section of the report on limits and alternatives, where notebook 06 was run: its tables and figures, and what they say."""

from collections.abc import Iterable, Mapping
from itertools import product

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.optimize import lsq_linear

from helpers.report import limits_figures, scorecard
from helpers.report.collection import Results, stacked
from helpers.report.limits_figures import GRIDS, LABELS, RIVALS, RUNS, THE_PAPERS
from helpers.report.tables import NOT_KNOWN, ROMAN, capital, spread, symbol
from helpers.settings.paper import Params

PLACES = 4  # digits after the point that count
WITHOUT_THE_PLANT = {  # columns of notebook 09's summary, all shares of minimum variance
    "Of minimum variance, %": "share",
    "Least at other set points, %": "set points, least",
    "Least at corners of the models, %": "corners, least",
}
NEVER = 1e9  # stands for a time that a response never came to, so that it counts as long
QUALITY = pd.DataFrame(  # of each figure of control quality the table that shows it, and how
    [
        ("ise", "errors", "ISE (time)", 1, 3),
        ("iae", "errors", "IAE (time)", 1, 3),
        ("itae", "errors", "ITAE (time²)", 1, 3),
        ("iae_worst", "errors", "IAE, worst 5 % (time)", 1, 3),
        ("offset", "response", "Offset (%)", 100, 1),
        ("overshoot", "response", "Overshoot (%)", 100, 1),
        ("rise_time", "response", "Rise 10-90 % (time)", 1, 2),
        ("settling_time_2", "response", "Settling, 2 % (time)", 1, 2),
        ("settling_time_5", "response", "Settling, 5 % (time)", 1, 2),
        ("total_variation", "inputs", "Total variation (deviation)", 1, 0),
        ("at_bound", "inputs", "At a bound (% of time)", 100, 1),
        ("harris", "inputs", "Harris index", 1, 2),
    ],
    columns=["figure", "table", "header", "factor", "decimals"],
).set_index("figure")
SAFETY = {  # of the online epochs, with their units
    "episodes": "Episodes",
    "worst": "Worst episode ($J$)",
    "worst_expert": "Of the PID ($J$)",
    "worse": "Worse (share)",
    "regret": "Regret ($J$)",
    "regret_episodes": "Regret (episodes of the PID)",
    "regret_peak": "Greatest on the way ($J$)",
}
LIKE_OTHERS = ("irl_reinforce", "irl_alone", "clone_reinforce", "csil_reinforce", "recurrent_ppo")  # their heat maps are left out
GROUPS = {"model": "model", "noise": "noise", "set_point": "set points", "time": "dead time and load"}


def read(results: Results, part: str, name: str) -> pd.DataFrame:
    """One table of one part of notebook 06 for all cases and seeds, with columns case and seed; empty where none was run."""
    return stacked({(case, seed): stage for (case, seed, of_part), stage in results.limits.items() if of_part == part}, name)


def tabulate(results: Results) -> dict[str, pd.DataFrame]:
    """The tables of the section by name, as text; none where notebook 06 was not run.

    Over several seeds every number is a median, with its interval from as many seeds as make one; the interval of a single
    seed's gap is that of its Monte Carlo.
    """
    gaps = read(results, "attainable", "gaps.csv")
    if gaps.empty:
        return {}
    listed, shares = listed_budgets(results), worst(results)
    pairs = ahead(listed).assign(metric=lambda rows: rows["metric"].map("after {:,}".format))
    there = on_mismatch(results).rename(columns={"plant": "metric", "objective": "value"})
    quality = read(results, "quality", "quality.csv").rename(columns={"figure": "metric"})
    safety = read(results, "safety", "safety.csv").rename(columns={"run": "controller"} | SAFETY)
    return {
        "limits_gaps": _gaps(gaps),
        "limits_attainable": _attainable(gaps),
        "limits_budget": _budget(listed),
        "limits_pairs": _wide(pairs, decimals=2).rename(columns={"controller": "rival"}),
        "limits_robustness": _wide(shares.assign(metric=shares["group"].map(GROUPS)), decimals=0),
        "limits_improved": _wide(there, decimals=1),
        **{f"limits_{table}": _quality(quality, table) for table in ("errors", "response", "inputs")},
        "limits_safety": _wide(safety.melt(["case", "seed", "controller"], var_name="metric")),
        "limits_curves": read(results, "budget", "curves.csv").rename(columns={"learner": "controller", "objective": "value"}),
    }


def without_the_plant(results: Results) -> dict[str, pd.DataFrame]:
    """What notebooks 09 (one policy) and 07 (your own process) came to, medians over seeds, where they were run."""
    found = {}
    if len(results.one_policy):
        rows = results.one_policy.assign(controller=pd.Categorical(results.one_policy["controller"], list(LABELS)))
        medians = rows.groupby(["case", "controller"], observed=True).median(numeric_only=True).reset_index()
        shown = {"case": medians["case"].map(lambda case: ROMAN[case - 1]), "controller": medians["controller"].map(LABELS)}
        shown["$J$"] = medians["J(30)"].map("{:.1f}".format)
        for name, column in WITHOUT_THE_PLANT.items():
            shown[name] = (100 * medians[column]).map("{:.0f}".format).replace("nan", NOT_KNOWN)
        found["one_policy"] = pd.DataFrame(shown)
    if len(results.own_plant):
        figures, place = ["mean |e|", "movement"], ["seed", "controller"]
        means = results.own_plant.groupby(place, sort=False)[figures].mean()
        shares = (100 * means / means.xs("PID of the record", level="controller")).groupby("controller", sort=False).median()
        table = shares.map("{:.0f}".format).rename(columns=lambda name: f"{capital(name)}, % of the record's PID")
        offsets = results.own_plant.groupby(place, sort=False)["offset"].max().groupby("controller", sort=False).median()
        found["own_plant"] = table.assign(**{"Greatest offset, % of the range": (100 * offsets).map("{:.1f}".format)}).reset_index()
    return found


def plant_names(states: Iterable[float], inputs: Iterable[float]) -> list[str]:
    """Plants that are not the model, by their factors of A and B."""
    return [f"A x {state:g}, B x {entry:g}" for state, entry in zip(states, inputs, strict=True)]


def unholdable(results: Results) -> pd.DataFrame:
    """The conditions under which no input within the bounds holds the set point: columns case, group, row, column."""
    robust = read(results, "robustness", "robustness.csv")
    places = robust[robust["group"].isin(["model", "set_point"])][["case", "group", "row", "column"]].drop_duplicates()
    found = [not _holdable(results.params[case], *place) for case, *place in places.itertuples(index=False)]
    return places[np.array(found, dtype=bool)]


def _holdable(params: Params, group: str, row: str, column: str) -> bool:
    """Whether A x + B u = 0 (Eq. 4.1.3b) has a solution within the bounds at the set point of a condition."""
    process, target = params.process, np.array(params.case.set_point)
    state, entry = (float(row), float(column)) if group == "model" else (1.0, 1.0)
    factors = np.array([float(row), *[float(column)] * (len(target) - 1)]) if group == "set_point" else 1.0
    needed = -state * np.array(process.drift_state) @ (factors * target)
    found = lsq_linear(entry * np.array(process.drift_input), needed, (process.input_low, process.input_high))
    return bool(np.linalg.norm(found.fun) <= 1e-6 * np.linalg.norm(needed))


def worst(results: Results) -> pd.DataFrame:
    """The least share of the PID's objective over each grid of conditions: case, seed, controller, group, value (per cent).

    Conditions under which no input within the bounds holds the set point are left out.
    """
    place = ["group", "row", "column"]
    robust = read(results, "robustness", "robustness.csv")
    kept = robust.merge(unholdable(results), how="left", indicator=True).query("_merge == 'left_only'").drop(columns="_merge")
    expert = kept[kept["controller"] == "expert"].drop(columns=["controller", "standard_error"])
    paired = kept.merge(expert, on=["case", "seed", *place], suffixes=("", "_expert"))
    shares = paired.assign(value=100 * paired["objective"] / paired["objective_expert"])
    return shares.groupby(["case", "seed", "controller", "group"], as_index=False)["value"].min()


def on_mismatch(results: Results) -> pd.DataFrame:
    """The objective on the plants that online improvement started on: columns case, seed, plant, controller, objective.

    The controllers that were not measured beside it are those of the grid, on draws of their own.
    """
    there = read(results, "robustness", "improved.csv")
    robust = read(results, "robustness", "robustness.csv")
    grid = robust[robust["group"] == "model"].astype({"row": float, "column": float})
    grid = grid.rename(columns={"row": "state", "column": "input"}).merge(there[["state", "input"]].drop_duplicates())
    every = pd.concat([there, grid[~grid["controller"].isin(there["controller"])]], ignore_index=True)
    return every.assign(plant=plant_names(every["state"], every["input"]))[["case", "seed", "plant", "controller", "objective"]]


def summary(frame: pd.DataFrame) -> pd.DataFrame:
    """Medians over seeds, `scorecard.summary`, of rows with columns case, seed, controller, metric and value."""
    return scorecard.summary(frame.rename(columns={"controller": "stage"})[["case", "seed", "stage", "metric", "value"]])


def _gaps(gaps: pd.DataFrame) -> pd.DataFrame:
    """A row for each controller, a column for each case: the gap to the programme in per cent."""
    found = _with_interval(gaps, "gap", ("gap_low", "gap_high"))
    found = found.assign(cell=[spread(row, decimals=1) for _, row in found.iterrows()])
    table = found.pivot_table(index="controller", columns="case", values="cell", aggfunc="first").rename_axis(columns=None)
    table = table.reindex([name for name in LABELS if name in table.index])
    return table.rename(index=LABELS, columns=lambda case: ROMAN[case - 1]).reset_index()


def _attainable(gaps: pd.DataFrame) -> pd.DataFrame:
    """The objective of the controllers that know the process: a row for each case and controller."""
    known = [name for name in LABELS if name.startswith(("minimum_variance", "dynamic_programme"))]
    found = _with_interval(gaps, "objective", ("low", "high")).set_index(["case", "controller"])
    places = list(product(sorted(gaps["case"].unique()), known))
    rows = [(ROMAN[case - 1], LABELS[name], spread(found.loc[(case, name)], decimals=2)) for case, name in places]
    return pd.DataFrame(rows, columns=["case", "controller", "$J$"])


def _with_interval(gaps: pd.DataFrame, name: str, ends: tuple[str, str]) -> pd.DataFrame:
    """Columns case, controller, median, ci_low, ci_high of one quantity; of a single seed that of its Monte Carlo."""
    if len(set(gaps["seed"])) == 1:
        return gaps.rename(columns={name: "median", ends[0]: "ci_low", ends[1]: "ci_high"})
    return summary(gaps.assign(metric=name, value=gaps[name])).rename(columns={"stage": "controller"})


def _budget(listed: pd.DataFrame) -> pd.DataFrame:
    """The objective at the listed budgets, and its range over the seeds at the last of them."""
    metric = listed["metric"].astype(int).map("J after {:,}".format)
    table = _wide(listed.rename(columns={"learner": "controller"}).assign(metric=metric), decimals=2)
    if len(set(listed["seed"])) == 1:
        return table
    last = listed[listed["metric"] == listed["metric"].iloc[-1]].groupby(["case", "learner"])["value"].agg(["min", "max"])
    spans = {(ROMAN[case - 1], LABELS[name]): f"{low:.2f} to {high:.2f}" for (case, name), (low, high) in last.T.items()}
    places = table[["case", "controller"]].itertuples(index=False, name=None)
    return table.assign(**{"least to greatest at the end": [spans[place] for place in places]})


def ahead(listed: pd.DataFrame) -> pd.DataFrame:
    """How far the paper's learner is ahead of each rival at each of `listed_budgets`: case, seed, metric, controller, value."""
    wide = listed.astype({"metric": int}).pivot_table(index=["case", "seed", "metric"], columns="learner", values="value")
    rivals = [name for name in RIVALS if name in wide and THE_PAPERS in wide]
    return wide[rivals].rsub(wide.get(THE_PAPERS), axis=0).melt(ignore_index=False, var_name="controller").reset_index().dropna()


def listed_budgets(results: Results) -> pd.DataFrame:
    """The objective at the listed budgets: columns case, seed, learner, metric (the budget), value."""
    return read(results, "budget", "budget.csv").melt(["case", "seed", "learner"], var_name="metric")


def _wide(frame: pd.DataFrame, decimals: int | Mapping[str, int] | None = None) -> pd.DataFrame:
    """Medians of long rows (case, seed, controller, metric, value): a row for each case and controller, a column a metric."""
    found = summary(frame.assign(value=frame["value"].round(PLACES))).set_index(["case", "stage", "metric"])  # 1e-90 is nought
    names = {name: words for name, words in (LABELS | RUNS).items() if name in set(frame["controller"])}
    rows = []
    for case, name in product(sorted(frame["case"].unique()), names):
        row = {"case": ROMAN[case - 1], "controller": names[name]}
        for metric in frame["metric"].unique():
            places = decimals[metric] if isinstance(decimals, Mapping) else decimals
            row[metric] = _cell(found.reindex([(case, name, metric)]).iloc[0], places)
        rows.append(row)
    return pd.DataFrame(rows)


def _cell(numbers: pd.Series, decimals: int | None) -> str:
    """A median with its interval; a dash for what was never reached, in most seeds or at the upper end."""
    if numbers["median"] > NEVER / 4:  # half of it where one of the two seeds in the middle came there
        return NOT_KNOWN
    if numbers["ci_high"] > NEVER / 4:
        return f"{numbers['median']:.{decimals}f} [{numbers['ci_low']:.{decimals}f}, {NOT_KNOWN}]"
    return spread(numbers, decimals=decimals)


def _quality(quality: pd.DataFrame, table: str) -> pd.DataFrame:
    """The figures of control quality of a table, a column for each and each variable; what a seed never reached counts as long.

    `quality` has the columns case, seed, controller, metric (figure:variable), value.
    """
    place = ["case", "seed", "controller", "variable"]
    rows = quality.join(quality["metric"].str.partition(":").set_axis(["figure", ":", "variable"], axis=1))
    rises = rows[(rows["figure"] == "rise_time") & rows["value"].notna()]
    rows = rows.join(QUALITY, on="figure", how="inner").query("table == @table")
    arrived = pd.MultiIndex.from_frame(rows[place]).isin(pd.MultiIndex.from_frame(rises[place]))
    overshoots = (rows["figure"] == "overshoot") & ~arrived  # what never comes near the set point overshoots by no number
    header = rows["header"].str.partition(" (")
    names = header[0] + ", " + rows["variable"].map(symbol) + header[1] + header[2]
    rows = rows.assign(metric=names, value=(rows["value"] * rows["factor"]).mask(overshoots).fillna(NEVER))
    return _wide(rows, decimals=rows.set_index("metric")["decimals"].to_dict())


def draw(results: Results) -> dict[str, Figure]:
    """The figures of the section by name, where notebook 06 was run: all cases in one, and a heat map for each grid and case."""
    gaps = read(results, "attainable", "gaps.csv")
    if gaps.empty:
        return {}
    levels = {int(case): rows.groupby("controller")["objective"].median() for case, rows in gaps.groupby("case")}
    ends = _with_interval(gaps, "gap", ("gap_low", "gap_high"))
    ends = ends.rename(columns={"median": "gap", "ci_low": "gap_low", "ci_high": "gap_high"})
    drawn = {
        "limits_budget": limits_figures.budget_by_case(read(results, "budget", "curves.csv"), levels),
        "limits_gaps": limits_figures.gap_figure(ends),
        "limits_robustness": limits_figures.robustness_figure(worst(results), GROUPS),
    }
    place = ["group", "row", "column", "controller"]
    for (case, group), robust in read(results, "robustness", "robustness.csv").groupby(["case", "group"]):
        cells = robust.groupby(place, as_index=False, sort=False)["objective"].median()
        shown = [controller for controller in cells["controller"].unique() if controller not in LIKE_OTHERS]
        drawn[f"limits_{group}_case_{case}"] = limits_figures.heat_maps(cells, group, shown)
    return drawn


def heat_map_names(results: Results) -> list[str]:
    """The heat maps that there are, by grid and case."""
    robust = read(results, "robustness", "robustness.csv").reindex(columns=["case", "group"])
    found = set(robust.itertuples(index=False, name=None))
    return [f"limits_{group}_case_{case}" for case in results.params for group in GRIDS if (case, group) in found]
