"""What the numbers of notebook 06 say over cases and seeds, for the words of the report; every number comes from its tables."""

from typing import Any

import pandas as pd

from helpers.report.collection import Results
from helpers.report.limits_figures import LABELS, LEARNERS, RIVALS
from helpers.report.limits_report import ahead, listed_budgets, on_mismatch, plant_names, read, summary, unholdable, worst
from helpers.report.statistics import FEWEST, median_interval
from helpers.report.tables import symbol

STEADY = 0.9  # of the best median of a case
LOST = 0.2  # of the set point change: an offset of a loop that was not found
TUNED = 1.05  # of the objective it began with, for a search to have found other gains
END_IN_GRADIENT = ("online", "irl_reinforce", "irl_alone", "clone_reinforce", "csil_reinforce", "scratch_reinforce")


def find(results: Results) -> dict[str, Any]:
    """What the section says, by the name of the function below that found it; nothing where notebook 06 was not run.

    seeds: how many of each case; agreement: how far at most the programme's value is from that of its policy by Monte Carlo, in %.
    """
    gaps, grids = (read(results, "attainable", name) for name in ("gaps.csv", "grids.csv"))
    if gaps.empty:
        return {}
    parts = (attainable, standings, tuned, practice, not_found, ranges, left_out, there, out_of_reach, price)
    last = grids.drop_duplicates(["case", "seed"], keep="last")
    found = {"seeds": gaps.groupby("case")["seed"].nunique().to_dict(), "agreement": 100 * last["difference"].abs().max()}
    return found | {part.__name__: part(results) for part in parts}


def attainable(results: Results) -> dict[int, dict[str, float]]:
    """By case, medians in per cent of the programme's objective.

    look_ahead: what it gains over one-step control; noise: what it loses behind a filter; filter: what filtering gives one-step
    control on y.
    """
    gaps = read(results, "attainable", "gaps.csv")
    gap = gaps.pivot_table(index="case", columns="controller", values="gap", aggfunc="median")
    known = {"look_ahead": gap["minimum_variance_x"], "noise": gap["dynamic_programme_filtered"]}
    return pd.DataFrame(known | {"filter": gap["minimum_variance"] - gap["minimum_variance_filtered"]}).to_dict("index")


def standings(results: Results) -> dict[int, dict[str, dict[str, list[int]]]]:
    """By budget and rival: the cases in which IRL, then policy gradient, is ahead of it, behind it, or where the seeds cannot tell.

    Cases with too few seeds for an interval are left out.
    """
    found: dict[int, dict[str, dict[str, list[int]]]] = {}
    differences = summary(ahead(listed_budgets(results)))
    for row in differences.dropna(subset="ci_low").itertuples():
        word = "ahead" if row.ci_low > 0 else "behind" if row.ci_high < 0 else "level"
        found.setdefault(row.metric, {}).setdefault(row.stage, {}).setdefault(word, []).append(row.case)
    return dict(sorted(found.items()))


def tuned(results: Results) -> dict[int, dict[str, float]]:
    """By case, how the searches for gains of the PID ended: in how many seeds above `TUNED`, and the range of the objective."""
    curves = read(results, "budget", "curves.csv").query("learner == 'pid_tuned'").sort_values("episodes")
    ends = curves.groupby(["case", "seed"])["objective"].agg(["first", "last"])
    by_case = ends.assign(better=ends["last"] > TUNED * ends["first"]).groupby("case")
    found = by_case.agg(better=("better", "sum"), seeds=("last", "size"), least=("last", "min"), greatest=("last", "max"))
    return found.to_dict("index")


def practice(results: Results) -> dict[str, Any]:
    """What helps to choose.

    with_model: by case, minimum variance on y in per cent of the best learner at the last budget; never_below: the controllers
    that no condition puts below the PID; least: the range of what those that end in a policy gradient keep of the PID's objective
    at other set points, in per cent; without_model: by budget the best that needs none, with its cases; budget: the last one. All
    in the median; but steady: the learners that with every seed keep `STEADY` of the best median in each case.
    """
    listed = listed_budgets(results).astype({"metric": int})
    gaps, budget = read(results, "attainable", "gaps.csv"), int(max(listed["metric"]))
    known = gaps[gaps["controller"] == "minimum_variance"].groupby("case")["objective"].median()
    medians = listed.pivot_table(index=["metric", "case"], columns="learner", values="value", aggfunc="median")
    rivals = medians[medians.index.get_level_values("metric") > 0].reindex(columns=RIVALS).dropna(how="all")
    without_model: dict[int, dict[str, list[int]]] = {}
    for (spent, case), best in rivals.idxmax(axis=1).items():
        without_model.setdefault(spent, {}).setdefault(LABELS[best], []).append(case)
    ends = listed[(listed["metric"] == budget) & listed["learner"].isin(LEARNERS)].groupby(["case", "learner"])["value"]
    steady = (ends.min() / ends.median().groupby("case").transform("max") >= STEADY).groupby("learner").all()
    shares = worst(results)
    kept = shares.pivot_table(index="controller", columns=["case", "group"], values="value", aggfunc="median").drop(index="expert")
    points = shares[(shares["group"] == "set_point") & shares["controller"].isin(END_IN_GRADIENT)]
    least = points.groupby(["case", "controller"])["value"].median()
    return {
        "with_model": (100 * known / medians.loc[budget].reindex(columns=LEARNERS).max(axis=1)).to_dict(),
        "never_below": [LABELS[name] for name in LABELS if name in kept.index and (kept.loc[name] >= 100).all()],
        "least": (least.min(), least.max()),
        "without_model": without_model,
        "budget": budget,
        "steady": [LABELS[name] for name in LEARNERS if steady.get(name, False)],
        "kept": STEADY,
    }


def not_found(results: Results) -> dict[int, list[str]]:
    """By case, the learners with a loop whose mean response ends further off than `LOST` in most seeds, and that loop."""
    quality = read(results, "quality", "quality.csv")
    ends = quality[quality["figure"].str.startswith("offset:") & quality["controller"].isin(LEARNERS)]
    missed = ends.assign(missed=ends["value"].abs() > LOST).groupby(["case", "controller", "figure"], sort=False)["missed"].mean()
    found: dict[int, list[str]] = {}
    for case, controller, figure in missed[missed > 0.5].index:
        found.setdefault(int(case), []).append(f"{LABELS[controller]} ({symbol(figure.partition(':')[2])})")
    return found


def ranges(results: Results) -> str:
    """What the grids of conditions span, in words."""
    words = {
        "model": "A and B times {:g} to {:g} and {:g} to {:g}",
        "noise": "disturbance times {:g} to {:g} and observation noise times {:g} to {:g}",
        "set_point": "the set points of the two loops times {:g} to {:g} and {:g} to {:g}",
        "time": "dead time of {:g} to {:g} samples and a load step of {:g} to {:g} of the set point change per sample",
    }
    robust = read(results, "robustness", "robustness.csv").astype({"row": float, "column": float})
    ends = robust.groupby("group")[["row", "column"]].agg(["min", "max"])
    return "; ".join(text.format(*ends.loc[group]) for group, text in words.items() if group in ends.index)


def left_out(results: Results) -> dict[str, dict[int, tuple[int, int]]]:
    """By group and case, how many of how many conditions were left out because no input within the bounds holds the set point."""
    robust = read(results, "robustness", "robustness.csv")
    total = robust.drop_duplicates(["case", "group", "row", "column"]).groupby(["group", "case"]).size()
    out = unholdable(results).groupby(["group", "case"]).size()
    groups = out.index.unique("group")
    return {group: {case: (count, total[group, case]) for case, count in out[group].items()} for group in groups}


def out_of_reach(results: Results) -> dict[str, list[int]]:
    """By mismatched plant that was improved on, the cases of which no input within the bounds holds the set point there."""
    out = unholdable(results).query("group == 'model'")
    out = out.assign(plant=plant_names(out["row"].astype(float), out["column"].astype(float)))
    return out[out["plant"].isin(on_mismatch(results)["plant"])].groupby("plant")["case"].agg(list).to_dict()


def there(results: Results) -> dict[str, dict[int, list[str] | None]]:
    """By mismatched plant and case, the controllers that improving on that plant is not ahead of; None where it is ahead of none.

    By the whole interval of the difference within seeds; nothing for too few seeds.
    """
    found: dict[str, dict[int, list[str] | None]] = {}
    for (plant, case), rows in on_mismatch(results).groupby(["plant", "case"], sort=False):
        reached = rows.pivot_table(index="seed", columns="controller", values="objective")
        if len(reached) >= FEWEST:
            others = [name for name in LABELS if name in reached and name != "online_there"]
            ahead_by = {name: (reached["online_there"] - reached[name]).dropna().to_numpy() for name in others}
            behind = [LABELS[name] for name, differences in ahead_by.items() if median_interval(differences)[0] <= 0]
            found.setdefault(plant, {})[int(case)] = behind if len(behind) < len(others) else None
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
