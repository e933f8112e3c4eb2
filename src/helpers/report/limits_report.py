"""The section of the report on limits and alternatives, where notebook 06 was run: its tables and figures, and what they say."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.optimize import lsq_linear

from helpers.report import scorecard
from helpers.report.collection import Results
from helpers.report.limits_answer import NO_LEARNERS, WITH_MODEL, answer
from helpers.report.limits_figures import GRIDS, LABELS, LEARNERS, RUNS, budget_curves, gap_figure, heat_maps
from helpers.report.statistics import FEWEST, median_interval
from helpers.report.tables import NOT_KNOWN, ROMAN, spread, symbol
from helpers.settings.paper import Params

PLACES = 4  # digits after the point that count
NEVER = 1e9  # stands for a time that a response never came to, so that it counts as long
# Of each table of control quality its figures: header with unit, factor, digits after the point.
QUALITY: dict[str, dict[str, tuple[str, int, int]]] = {
    "errors": {
        "ise": ("ISE (time)", 1, 3),
        "iae": ("IAE (time)", 1, 3),
        "itae": ("ITAE (time²)", 1, 3),
        "iae_worst": ("IAE, worst 5 % (time)", 1, 3),
    },
    "response": {
        "offset": ("Offset (%)", 100, 1),
        "overshoot": ("Overshoot (%)", 100, 1),
        "rise_time": ("Rise 10-90 % (time)", 1, 2),
        "settling_time_2": ("Settling, 2 % (time)", 1, 2),
        "settling_time_5": ("Settling, 5 % (time)", 1, 2),
    },
    "inputs": {
        "total_variation": ("Total variation (deviation)", 1, 0),
        "at_bound": ("At a bound (% of time)", 100, 1),
        "harris": ("Harris index", 1, 2),
    },
}
SAFETY = {  # of the online epochs, with their units
    "episodes": "Episodes",
    "worst": "Worst episode ($J$)",
    "worst_expert": "Of the PID ($J$)",
    "worse": "Worse (share)",
    "regret": "Regret ($J$)",
    "regret_episodes": "Regret (episodes of the PID)",
    "regret_peak": "Greatest on the way ($J$)",
}
GROUPS = {"model": "model", "noise": "noise", "set_point": "set points", "time": "dead time and load"}
THE_PAPERS = "irl_reinforce"
RIVALS = tuple(name for name in LEARNERS if name != THE_PAPERS)  # they need no model
TUNED = 1.05  # of the objective it began with, for a search to have found other gains
END_IN_REINFORCE = ("online", "irl_reinforce", "clone_reinforce", "csil_reinforce", "scratch_reinforce")


def read(results: Results, part: str, name: str) -> pd.DataFrame:
    """One table of one part of notebook 06 for all cases and seeds, with columns case and seed; empty where none was run."""
    stages = {(case, seed): stage for (case, seed, of_part), stage in results.limits.items() if of_part == part}
    frames = [stage.table(name).assign(case=case, seed=seed) for (case, seed), stage in stages.items()]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def tabulate(results: Results) -> dict[str, pd.DataFrame]:
    """The tables of the section by name, as text; none where notebook 06 was not run.

    Over several seeds every number is a median, with its interval from as many seeds as make one; the interval of a single
    seed's gap is that of its Monte Carlo.
    """
    gaps = read(results, "attainable", "gaps.csv")
    if gaps.empty:
        return {}
    budget = read(results, "budget", "curves.csv").rename(columns={"learner": "controller", "objective": "value"})
    listed = listed_budgets(results)
    there = on_mismatch(results).rename(columns={"plant": "metric", "objective": "value"})
    quality = read(results, "quality", "quality.csv").rename(columns={"figure": "metric"})
    safety = read(results, "safety", "safety.csv").melt(["case", "seed", "run"], var_name="metric")
    return {
        "limits_gaps": _gaps(gaps),
        "limits_attainable": _attainable(gaps),
        "limits_budget": _budget(listed),
        "limits_pairs": _wide(ahead(listed), int, "after {:,}", decimals=2).rename(columns={"controller": "rival"}),
        "limits_robustness": _wide(worst(results).rename(columns={"group": "metric"}), str, "{}", GROUPS, decimals=0),
        "limits_improved": _wide(there, str, "{}", decimals=1),
        **{f"limits_{table}": _quality(quality, figures) for table, figures in QUALITY.items()},
        "limits_safety": _wide(safety.rename(columns={"run": "controller"}), str, "{}", SAFETY, RUNS),
    } | ({"limits_curves": budget} if len(budget) else {})


def sharpest(results: Results, gaps: pd.DataFrame) -> pd.DataFrame:
    """The gaps under the headline beta of their case."""
    return gaps[gaps["beta"] == gaps["case"].map(lambda case: results.params[case].case.online.headline_beta)]


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
    """A row for each controller, a column for each case and beta: the gap to the programme in per cent."""
    columns: dict[str, dict[str, str]] = {}
    for (case, beta), rows in _with_interval(gaps, "gap", ("gap_low", "gap_high")).groupby(["case", "beta"]):
        found = rows.set_index("controller")
        column = f"{ROMAN[case - 1]}, $\\beta$ = {beta:g}"
        columns[column] = {name: spread(found.loc[name], decimals=1) for name in LABELS if name in found.index}
    return _labelled(pd.DataFrame(columns))


def _attainable(gaps: pd.DataFrame) -> pd.DataFrame:
    """The objective of the controllers that know the process: a row for each case and controller, a column for each beta."""
    known = [name for name in LABELS if name.startswith(("minimum_variance", "dynamic_programme"))]
    found = _with_interval(gaps, "objective", ("low", "high")).set_index(["case", "controller", "beta"])
    rows = []
    for case in sorted(gaps["case"].unique()):
        for name in known:
            places = {beta: (case, name, beta) for beta in sorted(gaps["beta"].unique()) if (case, name, beta) in found.index}
            cells = {f"$J$, $\\beta$ = {beta:g}": spread(found.loc[place], decimals=2) for beta, place in places.items()}
            rows.append({"case": ROMAN[case - 1], "controller": LABELS[name]} | cells)
    return pd.DataFrame(rows)


def _with_interval(gaps: pd.DataFrame, name: str, ends: tuple[str, str]) -> pd.DataFrame:
    """Columns case, beta, controller, median, ci_low, ci_high of one quantity; of a single seed that of its Monte Carlo."""
    if len(set(gaps["seed"])) == 1:
        return gaps.rename(columns={name: "median", ends[0]: "ci_low", ends[1]: "ci_high"})
    found = [summary(rows.assign(metric=name, value=rows[name])).assign(beta=beta) for beta, rows in gaps.groupby("beta")]
    return pd.concat(found, ignore_index=True).rename(columns={"stage": "controller"})


def _budget(listed: pd.DataFrame) -> pd.DataFrame:
    """The objective at the listed budgets, and its range over the seeds at the last of them."""
    table = _wide(listed.rename(columns={"learner": "controller"}), int, "J after {:,}", decimals=2)
    if len(set(listed["seed"])) == 1:
        return table
    last = listed[listed["metric"] == listed["metric"].iloc[-1]].groupby(["case", "learner"])["value"].agg(["min", "max"])
    spans = {(ROMAN[case - 1], LABELS[name]): f"{low:.2f} to {high:.2f}" for (case, name), (low, high) in last.T.items()}
    places = table[["case", "controller"]].itertuples(index=False, name=None)
    return table.assign(**{"least to greatest at the end": [spans[place] for place in places]})


def ahead(listed: pd.DataFrame) -> pd.DataFrame:
    """How far the paper's learner is ahead of each rival within a seed: columns case, seed, metric (the budget), controller, value.

    Args:
        listed: columns case, seed, learner, metric (the budget), value.
    """
    wide = listed.astype({"metric": int}).pivot_table(index=["case", "seed", "metric"], columns="learner", values="value")
    rivals = [name for name in RIVALS if name in wide and THE_PAPERS in wide]
    return wide[rivals].rsub(wide.get(THE_PAPERS), axis=0).melt(ignore_index=False, var_name="controller").reset_index().dropna()


def listed_budgets(results: Results) -> pd.DataFrame:
    """The objective at the listed budgets: columns case, seed, learner, metric (the budget), value."""
    budget = read(results, "budget", "budget.csv")
    return budget.melt(["case", "seed", "learner"], var_name="metric") if len(budget) else budget


def _wide(
    frame: pd.DataFrame,
    kind: Callable,
    header: str,
    words: dict[str, str] | None = None,
    names: dict[str, str] | None = None,
    decimals: int | Mapping[str, int] | None = None,
) -> pd.DataFrame:
    """Medians of long rows (case, seed, controller, metric, value): a row for each case and controller, a column a metric."""
    found = summary(frame.assign(value=frame["value"].round(PLACES)))  # a reward of 1e-90 is nought
    order, rows = list(dict.fromkeys(frame["metric"])), []
    for case in sorted(frame["case"].unique()):
        numbers = found[found["case"] == case].set_index(["stage", "metric"])
        for name, label in (names or LABELS).items():
            if name in set(frame["controller"]):
                shown = {}
                for metric in order:
                    places = decimals[metric] if isinstance(decimals, Mapping) else decimals
                    cell = _cell(numbers.reindex([(name, metric)]).iloc[0], places)
                    shown[header.format(kind((words or {}).get(metric, metric)))] = cell
                rows.append({"case": ROMAN[case - 1], "controller": label} | shown)
    return pd.DataFrame(rows)


def _cell(numbers: pd.Series, decimals: int | None) -> str:
    """A median with its interval; a dash for what was never reached, in most seeds or at the upper end."""
    if numbers["median"] > NEVER / 4:  # half of it where one of the two seeds in the middle came there
        return NOT_KNOWN
    if numbers["ci_high"] > NEVER / 4:
        return f"{numbers['median']:.{decimals}f} [{numbers['ci_low']:.{decimals}f}, {NOT_KNOWN}]"
    return spread(numbers, decimals=decimals)


def _quality(quality: pd.DataFrame, figures: Mapping[str, tuple[str, int, int]]) -> pd.DataFrame:
    """Some figures of control quality, a column for each figure and variable; what a seed never reached counts as long.

    Args:
        quality: columns case, seed, controller, metric (figure:variable), value.
        figures: header with its unit, factor and digits after the point by figure.
    """
    parts = quality["metric"].str.partition(":")
    rows = quality.assign(figure=parts[0], variable=parts[2])[parts[0].isin(figures)]
    factors = [figures[figure][1] for figure in rows["figure"]]
    place = ["case", "seed", "controller", "variable"]
    rises = quality.assign(variable=parts[2])[(parts[0] == "rise_time") & quality["value"].notna()]
    arrived = pd.MultiIndex.from_frame(rows[place]).isin(pd.MultiIndex.from_frame(rises[place]))
    overshoots = (rows["figure"] == "overshoot") & ~arrived  # what never comes near the set point overshoots by no number
    rows["value"] = (rows["value"] * factors).mask(overshoots).fillna(NEVER)
    headers, decimals = {}, {}
    for row in rows.drop_duplicates("metric").itertuples():
        header, _, decimals[row.metric] = figures[row.figure]
        words, bracket, unit = header.partition(" (")
        headers[row.metric] = f"{words}, {symbol(row.variable)}{bracket}{unit}"
    return _wide(rows, str, "{}", headers, decimals=decimals)


def _labelled(table: pd.DataFrame) -> pd.DataFrame:
    ordered = table.reindex([name for name in LABELS if name in table.index])
    return ordered.rename(index=LABELS).rename_axis("controller").reset_index()


def draw(results: Results) -> dict[str, Figure]:
    """The figures of the section by name, for each case that notebook 06 was run for."""
    curves, gaps = read(results, "budget", "curves.csv"), read(results, "attainable", "gaps.csv")
    robust, place = read(results, "robustness", "robustness.csv"), ["group", "row", "column", "controller"]
    drawn = {}
    for case in sorted(gaps["case"].unique()) if len(gaps) else ():
        own = gaps[gaps["case"] == case]
        levels = sharpest(results, own).groupby("controller")["objective"].median()
        drawn[f"limits_budget_case_{case}"] = budget_curves(curves[curves["case"] == case], levels)
        shown = _with_interval(own, "gap", ("gap_low", "gap_high"))
        shown = shown.rename(columns={"median": "gap", "ci_low": "gap_low", "ci_high": "gap_high"})
        drawn[f"limits_gaps_case_{case}"] = gap_figure(shown)
        cells = robust[robust["case"] == case].groupby(place, as_index=False, sort=False)["objective"].median()
        for group in GRIDS if len(cells) else ():
            if group in set(cells["group"]):
                drawn[f"limits_{group}_case_{case}"] = heat_maps(cells, group, list(cells["controller"].unique()))
    return drawn


# What the numbers say over cases and seeds, for the words of the report; every number comes from the tables.


def find(results: Results) -> dict[str, Any]:
    """What the section says, by the name of the function below that found it; nothing where notebook 06 was not run."""
    if read(results, "attainable", "gaps.csv").empty:
        return {}
    learning = (seeds, attainable, agreement, answers, standings, tuned, visited, practice, not_found)
    parts = (*learning, ranges, left_out, there, out_of_reach, price)
    return {part.__name__: part(results) for part in parts}


def seeds(results: Results) -> dict[int, int]:
    """How many seeds there are of each case."""
    found: dict[int, int] = read(results, "attainable", "gaps.csv").groupby("case")["seed"].nunique().to_dict()
    return found


def attainable(results: Results) -> dict[int, dict[str, float]]:
    """By case, medians in per cent of the programme's objective.

    look_ahead: what it gains over one-step control; noise: what it loses behind a filter; filter: what filtering gives one-step
    control on y.
    """
    gaps = _sharp(results).pivot_table(index="case", columns="controller", values="gap", aggfunc="median")
    return {
        int(case): {
            "look_ahead": row["minimum_variance_x"],
            "noise": row["dynamic_programme_filtered"],
            "filter": row["minimum_variance"] - row["minimum_variance_filtered"],
        }
        for case, row in gaps.iterrows()
    }


def _sharp(results: Results) -> pd.DataFrame:
    return sharpest(results, read(results, "attainable", "gaps.csv"))


def agreement(results: Results) -> float:
    """The largest difference between the programme's value and that of its policy by Monte Carlo, in per cent."""
    grids = read(results, "attainable", "grids.csv").drop_duplicates(["case", "seed", "beta"], keep="last")
    return 100 * float(grids["difference"].abs().max())


def answers(results: Results) -> dict[int, str]:
    """What a practitioner can read off, a sentence or two for each case that notebook 06 was run for.

    Off the medians; with as many seeds as make an interval, learners are compared within seeds, and those that cannot be told
    apart from the best are named.
    """
    gaps, budget = _sharp(results), read(results, "budget", "budget.csv")
    found = {}
    for case, own in gaps.groupby("case"):
        listed = budget[budget["case"] == case].drop(columns="case").set_index(["seed", "learner"]).rename(columns=int)
        listed = listed[[episodes for episodes in listed if episodes]]  # nobody has learned from none
        if own["seed"].nunique() < FEWEST:
            medians = listed.groupby("learner", sort=False).median()
            found[int(case)] = answer(own.groupby("controller")[["objective", "gap"]].median(), medians)
        else:
            found[int(case)] = _answer_over_seeds(own, listed)
    return found


def standings(results: Results) -> dict[int, dict[str, dict[str, list[int]]]]:
    """By budget and rival: the cases in which the paper's learner is ahead of it, behind it, or where the seeds cannot tell.

    Cases with too few seeds for an interval are left out.
    """
    found: dict[int, dict[str, dict[str, list[int]]]] = {}
    for row in summary(ahead(listed_budgets(results))).dropna(subset="ci_low").itertuples():
        word = "ahead" if row.ci_low > 0 else "behind" if row.ci_high < 0 else "not to be told apart"
        found.setdefault(row.metric, {}).setdefault(row.stage, {}).setdefault(word, []).append(row.case)
    return dict(sorted(found.items()))


def tuned(results: Results) -> dict[int, dict[str, float]]:
    """By case, how the searches for gains of the PID ended: in how many seeds above `TUNED`, and the range of the objective."""
    curves = read(results, "budget", "curves.csv").query("learner == 'pid_tuned'").sort_values("episodes")
    found = {}
    for case, rows in curves.groupby("case"):
        ends = rows.groupby("seed")["objective"].agg(["first", "last"])
        better = int((ends["last"] > TUNED * ends["first"]).sum())
        found[int(case)] = {"better": better, "seeds": len(ends), "least": ends["last"].min(), "greatest": ends["last"].max()}
    return found


def visited(results: Results) -> list[int]:
    """After how many episodes the tuned PID was judged last before each listed budget."""
    spent = read(results, "budget", "curves.csv").query("learner == 'pid_tuned'")["episodes"]
    budgets = sorted(set(listed_budgets(results)["metric"].astype(int)))
    return [int(spent[spent <= budget].max()) for budget in budgets if budget]


def practice(results: Results) -> dict[str, Any]:
    """What helps to choose.

    model_ahead: the cases in which minimum variance on y lies above every learner at the last budget; never_below: the controllers
    that no condition puts below the PID; least: the range of what those that end in REINFORCE keep of the PID's objective at other
    set points, in per cent; without_model: by budget the best that needs none, with its cases. All in the median.
    """
    listed = listed_budgets(results).astype({"metric": int})
    medians = listed.groupby(["case", "metric", "learner"])["value"].median()
    reached = _sharp(results).groupby(["case", "controller"])["objective"].median()
    model_ahead: list[int] = []
    without_model: dict[int, dict[str, list[int]]] = {}
    for (case, budget), row in medians.unstack("learner").iterrows():  # noqa: PD010
        if budget == max(listed["metric"]) and reached[case, "minimum_variance"] > row.reindex(LEARNERS).max():
            model_ahead.append(int(case))
        if budget and (others := row.reindex(RIVALS).dropna()).size:
            without_model.setdefault(int(budget), {}).setdefault(LABELS[others.idxmax()], []).append(int(case))
    shares = worst(results)
    kept = shares.pivot_table(index="controller", columns=["case", "group"], values="value", aggfunc="median").drop(index="expert")
    points = shares[(shares["group"] == "set_point") & shares["controller"].isin(END_IN_REINFORCE)]
    least = points.groupby(["case", "controller"])["value"].median()
    return {
        "model_ahead": model_ahead,
        "never_below": [LABELS[name] for name in LABELS if name in kept.index and (kept.loc[name] >= 100).all()],
        "least": (least.min(), least.max()),
        "without_model": without_model,
    }


def not_found(results: Results) -> dict[int, list[str]]:
    """By case, the learners with a loop whose mean response comes to no 90 % of the change in most seeds, and that loop."""
    quality = read(results, "quality", "quality.csv")
    rises = quality[quality["figure"].str.startswith("rise_time:") & quality["controller"].isin(LEARNERS)]
    missed = rises.assign(missed=rises["value"].isna()).groupby(["case", "controller", "figure"], sort=False)["missed"].mean()
    found: dict[int, list[str]] = {}
    for case, controller, figure in missed[missed > 0.5].index:
        found.setdefault(int(case), []).append(f"{LABELS[controller]} ({symbol(figure.partition(':')[2])})")
    return found


def ranges(results: Results) -> str:
    """What the grids of conditions span, in words."""
    robust = read(results, "robustness", "robustness.csv")
    words = {
        "model": "A and B times {} and {}",
        "noise": "disturbance times {} and observation noise times {}",
        "set_point": "the set points of the two loops times {} and {}",
        "time": "dead time of {} samples and a load step of {} of the set point change per sample",
    }
    spans = robust.astype({"row": float, "column": float}).groupby("group")[["row", "column"]].agg(["min", "max"])
    found = []
    for group, text in words.items():
        if group in spans.index:
            ends = spans.loc[group]
            found.append(text.format(*(f"{ends[axis, 'min']:g} to {ends[axis, 'max']:g}" for axis in ("row", "column"))))
    return "; ".join(found)


def left_out(results: Results) -> dict[str, dict[int, tuple[int, int]]]:
    """By group and case, how many of how many conditions were left out because no input within the bounds holds the set point."""
    robust = read(results, "robustness", "robustness.csv")
    place = ["case", "group", "row", "column"]
    total = robust[place].drop_duplicates().groupby(["group", "case"]).size()
    out = unholdable(results).groupby(["group", "case"]).size()
    found: dict[str, dict[int, tuple[int, int]]] = {}
    for (group, case), count in out.items():
        found.setdefault(group, {})[int(case)] = (int(count), int(total[group, case]))
    return found


def out_of_reach(results: Results) -> dict[str, list[int]]:
    """By mismatched plant that was improved on, the cases of which no input within the bounds holds the set point there."""
    out = unholdable(results).query("group == 'model'")
    out = out.assign(plant=plant_names(out["row"].astype(float), out["column"].astype(float)))
    found: dict[str, list[int]] = out[out["plant"].isin(on_mismatch(results)["plant"])].groupby("plant")["case"].agg(list).to_dict()
    return found


def there(results: Results) -> dict[str, dict[int, list[str]]]:
    """By mismatched plant and case, the controllers that improving on that plant is not ahead of.

    By the whole interval of the difference within seeds; nothing for too few seeds.
    """
    every = on_mismatch(results)
    found: dict[str, dict[int, list[str]]] = {}
    for (plant, case), rows in every.groupby(["plant", "case"], sort=False):
        reached = rows.pivot_table(index="seed", columns="controller", values="objective")
        if len(reached) >= FEWEST:
            others = [name for name in LABELS if name in reached and name != "online_there"]
            behind = [LABELS[name] for name in others if _low(reached["online_there"] - reached[name]) <= 0]
            found.setdefault(plant, {})[int(case)] = behind
    return found


def price(results: Results) -> dict[int, dict[str, float]]:
    """What online improvement costs in each case, in per cent and medians over seeds.

    worse: the exploring episodes that were worse than the PID; set_point and model: the least share of the PID's objective that
    the improved policy reaches at set points not trained on and on plants that are not the model, where the bounds allow it.
    """
    safety = read(results, "safety", "safety.csv")
    worse = 100 * safety[safety["run"] == "hot"].groupby("case")["worse"].median()
    online = worst(results).query("controller == 'online'")
    kept = online.pivot_table(index="case", columns="group", values="value", aggfunc="median")
    return kept.reindex(columns=["set_point", "model"]).assign(worse=worse).to_dict("index")


def _answer_over_seeds(own: pd.DataFrame, listed: pd.DataFrame) -> str:
    """Who learns best, who cannot be told apart from it, and who passes the controllers that have the exact model instead.

    Args:
        own: columns seed, controller, objective, gap, of one case and beta.
        listed: the objective after so many episodes (columns), index seed and learner.
    """
    best, passing = [], []
    for episodes in listed:
        reached = listed.pivot_table(index="seed", columns="learner", values=episodes)
        learners = reached.drop(columns=list(NO_LEARNERS), errors="ignore")
        first = learners.median().idxmax()
        ahead = {name: _low(learners[first] - learners[name]) for name in learners if name != first}
        tied = ", ".join(LABELS[name] for name, low in ahead.items() if low <= 0)
        apart = f"not to be told apart from {tied}" if tied else "ahead of all others"
        best.append(f"after {episodes:,} episodes {LABELS[first]}, $J$ = {learners[first].median():.1f} ({apart})")
        passed = [LABELS[name] for name in learners if _low(learners[name] - reached["mpc"]) > 0]
        passing.append(f"after {episodes:,} {', '.join(passed) or 'none'}")
    medians = own.groupby("controller")[["objective", "gap"]].median()
    model = medians.reindex(WITH_MODEL).dropna()
    known = ", ".join(f"{LABELS[name]} {row['objective']:.1f} ({row['gap']:.1f} %)" for name, row in model.iterrows())
    return (
        f"**Learning on the plant**, best in the median: {'; '.join(best)}. **With the exact model** and no episode at all (in "
        f"brackets the gap to the programme): {known}; the demonstrator stands {medians['gap']['expert']:.1f} % below it. "
        f"Learners ahead of offset-free MPC in the same seeds, by the whole interval: {'; '.join(passing)}."
    )


def _low(differences: pd.Series) -> float:
    """The lower end of the interval of the median difference."""
    return float(median_interval(differences.dropna().to_numpy())[0])
