"""The section of the report on limits and alternatives: tables and figures from what notebook 06 wrote, where it was run."""

from collections.abc import Callable, Mapping

import pandas as pd
from matplotlib.figure import Figure

from helpers import scorecard
from helpers.collection import Results
from helpers.limits_answer import NO_LEARNERS, WITH_MODEL, answer
from helpers.limits_figures import LABELS, budget_curves, gap_figure, heat_maps
from helpers.statistics import FEWEST, median_interval
from helpers.tables import NOT_KNOWN, ROMAN, spread, symbol

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
RIVALS = ("clone_reinforce", "scratch_reinforce", "ppo", "recurrent_ppo", "pid_tuned")
RUNS = {"hot": "hot start", "scratch": "from scratch"}


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
    listed = _listed(results)
    there = read(results, "robustness", "improved.csv")
    plants = [f"A x {state:g}, B x {entry:g}" for state, entry in zip(there["state"], there["input"], strict=True)]
    there = there.assign(metric=plants).rename(columns={"objective": "value"})
    quality = read(results, "quality", "quality.csv").rename(columns={"figure": "metric"})
    safety = read(results, "safety", "safety.csv").melt(["case", "seed", "run"], var_name="metric")
    return {
        "limits_gaps": _gaps(gaps),
        "limits_budget": _wide(listed.rename(columns={"learner": "controller"}), int, "J after {:,}", decimals=2),
        "limits_pairs": _wide(_ahead(listed), int, "after {:,}", decimals=2).rename(columns={"controller": "rival"}),
        "limits_robustness": _wide(_worst(results).rename(columns={"group": "metric"}), str, "{}", GROUPS, decimals=0),
        "limits_improved": _wide(there, str, "{}", decimals=1),
        **{f"limits_{table}": _quality(quality, figures) for table, figures in QUALITY.items()},
        "limits_safety": _wide(safety.rename(columns={"run": "controller"}), str, "{}", SAFETY, RUNS),
    } | ({"limits_curves": budget} if len(budget) else {})


def _worst(results: Results) -> pd.DataFrame:
    """The least share of the PID's objective over each grid of conditions: case, seed, controller, group, value (per cent)."""
    robust = read(results, "robustness", "robustness.csv")
    expert = robust[robust["controller"] == "expert"].drop(columns=["controller", "standard_error"])
    paired = robust.merge(expert, on=["case", "seed", "group", "row", "column"], suffixes=("", "_expert"))
    shares = paired.assign(value=100 * paired["objective"] / paired["objective_expert"])
    return shares.groupby(["case", "seed", "controller", "group"], as_index=False)["value"].min()


def ranges(results: Results) -> str:
    """What the grids of conditions span, in words; empty where notebook 06 was not run."""
    robust = read(results, "robustness", "robustness.csv")
    if robust.empty:
        return ""
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


def price(results: Results) -> dict[int, dict[str, float]]:
    """What online improvement costs in each case, in per cent and medians over seeds; empty where notebook 06 was not run.

    worse: the exploring episodes that were worse than the PID; set_point and model: the least share of the PID's objective that
    the improved policy keeps at set points not trained on and on plants that are not the model.
    """
    safety = read(results, "safety", "safety.csv")
    if safety.empty:
        return {}
    worse = 100 * safety[safety["run"] == "hot"].groupby("case")["worse"].median()
    online = _worst(results).query("controller == 'online'")
    worst = online.pivot_table(index="case", columns="group", values="value", aggfunc="median")
    return worst.reindex(columns=["set_point", "model"]).assign(worse=worse).to_dict("index")


def improved_there(results: Results) -> dict[str, list[int]]:
    """By mismatched plant: the cases in which improving there ends ahead of minimum variance with the wrong model.

    By the whole interval of the difference within seeds; empty where notebook 06 was not run or for too few seeds.
    """
    there = read(results, "robustness", "improved.csv")
    if there.empty or there["seed"].nunique() < FEWEST:
        return {}
    found: dict[str, list[int]] = {}
    for (state, entry, case), rows in there.groupby(["state", "input", "case"], sort=False):
        reached = rows.pivot_table(index="seed", columns="controller", values="objective")
        cases = found.setdefault(f"A x {state:g}, B x {entry:g}", [])
        if _low(reached["online_there"] - reached["minimum_variance"]) > 0:
            cases.append(int(case))
    return found


def _summary(frame: pd.DataFrame) -> pd.DataFrame:
    return scorecard.summary(frame.rename(columns={"controller": "stage"})[["case", "seed", "stage", "metric", "value"]])


def _gaps(gaps: pd.DataFrame) -> pd.DataFrame:
    """A row for each controller, a column for each case and beta: the gap to the programme in per cent."""
    columns: dict[str, dict[str, str]] = {}
    for (case, beta), rows in gaps.groupby(["case", "beta"]):
        column = f"{ROMAN[case - 1]}, $\\beta$ = {beta:g}"
        if len(set(rows["seed"])) == 1:
            found = rows.rename(columns={"gap": "median", "gap_low": "ci_low", "gap_high": "ci_high"}).set_index("controller")
        else:
            found = _summary(rows.assign(metric="gap", value=rows["gap"])).set_index("stage")
        columns[column] = {name: spread(found.loc[name], decimals=1) for name in LABELS if name in found.index}
    return _labelled(pd.DataFrame(columns))


def _ahead(listed: pd.DataFrame) -> pd.DataFrame:
    """How far the paper's learner is ahead of each rival within a seed: columns case, seed, metric (the budget), controller, value.

    Args:
        listed: columns case, seed, learner, metric (the budget), value.
    """
    wide = listed.astype({"metric": int}).pivot_table(index=["case", "seed", "metric"], columns="learner", values="value")
    rivals = [name for name in RIVALS if name in wide and THE_PAPERS in wide]
    return wide[rivals].rsub(wide.get(THE_PAPERS), axis=0).melt(ignore_index=False, var_name="controller").reset_index().dropna()


def standings(results: Results) -> dict[int, dict[str, dict[str, list[int]]]]:
    """By budget and rival: the cases in which the paper's learner is ahead of it, behind it, or where the seeds cannot tell.

    Cases with too few seeds for an interval are left out.
    """
    listed = _listed(results)
    ahead = _ahead(listed) if len(listed) else listed
    found: dict[int, dict[str, dict[str, list[int]]]] = {}
    for row in _summary(ahead).dropna(subset="ci_low").itertuples() if len(ahead) else ():
        word = "ahead" if row.ci_low > 0 else "behind" if row.ci_high < 0 else "not to be told apart"
        found.setdefault(row.metric, {}).setdefault(row.stage, {}).setdefault(word, []).append(row.case)
    return dict(sorted(found.items()))


def _listed(results: Results) -> pd.DataFrame:
    budget = read(results, "budget", "budget.csv")
    return budget.melt(["case", "seed", "learner"], var_name="metric") if len(budget) else budget


def answers(results: Results) -> dict[int, str]:
    """What a practitioner can read off, a sentence or two for each case that notebook 06 was run for.

    Off the medians; with as many seeds as make an interval, learners are compared within seeds, and those that cannot be told
    apart from the best are named.
    """
    gaps, budget = read(results, "attainable", "gaps.csv"), read(results, "budget", "budget.csv")
    found = {}
    for case in sorted(gaps["case"].unique()) if len(gaps) else ():
        headline = results.params[case].case.online.headline_beta
        own = gaps[(gaps["case"] == case) & (gaps["beta"] == headline)]
        listed = budget[budget["case"] == case].drop(columns="case").set_index(["seed", "learner"]).rename(columns=int)
        listed = listed[[episodes for episodes in listed if episodes]]  # nobody has learned from none
        if own["seed"].nunique() < FEWEST:
            medians = listed.groupby("learner", sort=False).median()
            found[int(case)] = answer(own.groupby("controller")[["objective", "gap"]].median(), medians)
        else:
            found[int(case)] = _answer_over_seeds(own, listed)
    return found


def _answer_over_seeds(own: pd.DataFrame, listed: pd.DataFrame) -> str:
    """Who learns best, who cannot be told apart from it, and who passes the controllers that have the exact model instead.

    Args:
        own: columns seed, controller, objective, gap, of one case and beta.
        listed: the objective after so many episodes (columns), index seed and learner.
    """
    reached = own.pivot_table(index="seed", columns="controller", values="objective")
    best, passing = [], []
    for episodes in listed:
        learners = listed.pivot_table(index="seed", columns="learner", values=episodes)
        learners = learners.drop(columns=list(NO_LEARNERS), errors="ignore")
        first = learners.median().idxmax()
        ahead = {name: _low(learners[first] - learners[name]) for name in learners if name != first}
        tied = ", ".join(LABELS[name] for name, low in ahead.items() if low <= 0)
        apart = f"not to be told apart from {tied}" if tied else "ahead of all others"
        best.append(f"after {episodes:,} episodes {LABELS[first]}, $J$ = {learners[first].median():.1f} ({apart})")
        passed = [LABELS[name] for name in learners if _low(learners[name] - reached["mpc"]) > 0]
        passing.append(f"after {episodes:,} {', '.join(passed) or 'none'}")
    medians = own.groupby("controller")[["objective", "gap"]].median()
    known = ", ".join(f"{LABELS[name]} {medians['objective'][name]:.1f} ({medians['gap'][name]:.1f} %)" for name in WITH_MODEL)
    return (
        f"**Learning on the plant**, best in the median: {'; '.join(best)}. **With the exact model** and no episode at all (in "
        f"brackets the gap to the programme): {known}; the demonstrator stands {medians['gap']['expert']:.1f} % below it. "
        f"Learners ahead of offset-free MPC in the same seeds, by the whole interval: {'; '.join(passing)}."
    )


def _low(differences: pd.Series) -> float:
    """The lower end of the interval of the median difference."""
    return float(median_interval(differences.dropna().to_numpy())[0])


def _wide(
    frame: pd.DataFrame,
    kind: Callable,
    header: str,
    words: dict[str, str] | None = None,
    names: dict[str, str] | None = None,
    decimals: int | Mapping[str, int] | None = None,
) -> pd.DataFrame:
    """Medians of long rows (case, seed, controller, metric, value): a row for each case and controller, a column a metric."""
    found = _summary(frame.assign(value=frame["value"].round(PLACES)))  # a reward of 1e-90 is nought
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
    rows["value"] = (rows["value"] * factors).fillna(NEVER)
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
        own = gaps[gaps["case"] == case].groupby(["beta", "controller"], as_index=False).median(numeric_only=True)
        levels = own[own["beta"] == results.params[case].case.online.headline_beta].set_index("controller")["objective"]
        drawn[f"limits_budget_case_{case}"] = budget_curves(curves[curves["case"] == case], levels)
        drawn[f"limits_gaps_case_{case}"] = gap_figure(own)
        cells = robust[robust["case"] == case].groupby(place, as_index=False, sort=False)["objective"].median()
        drawn[f"limits_model_case_{case}"] = heat_maps(cells, "model", list(cells["controller"].unique()))
    return drawn
