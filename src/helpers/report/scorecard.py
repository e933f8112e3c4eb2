"""The reproduction against the paper: medians and intervals over seeds, and a verdict for every published number."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from helpers.report.statistics import median_interval, prediction_interval
from helpers.report.tables import NOT_KNOWN, RESULT_DECIMALS, ROMAN, capital
from helpers.settings.paper import HEADLINE, PublishedCase

REPRODUCED_BY = {"expert": ("expert", "v"), "policy": ("offline", "v"), "alpha": ("offline", "alpha")}  # stage, metric
MINIMUM_VARIANCE = "minimum_variance"  # the stage of the controller to measure online learning by
FITTED = "expert"  # this row's settings were inferred from the very numbers that it is compared with
ROWS = {"expert": "features of the PID", "policy": "features of the policy", "alpha": "weights"}
VERDICTS = ("match", "differs", "cannot tell", "fitted")
WIDEST = 0.25  # half the width of a prediction interval that can still tell, as a share of the published value
PUBLISHED_TRAJECTORIES = 500  # behind a published feature, Section 5.1.1
COLUMNS = ["table", "case", "row", "feature", "published", "reproduced", "n_seeds"]
COLUMNS += ["ci_low", "ci_high", "pred_low", "pred_high", "verdict", "reason"]
KEYS = ["case", "stage", "metric"]


def summary(seeds: pd.DataFrame) -> pd.DataFrame:
    """Every number over its seeds: case, stage, metric, n_seeds, median, ci_low, ci_high, least, p90, greatest.

    ci_low and ci_high are the ends of the 95 % bootstrap interval of the median, nan for too few seeds; p90 is the 90th percentile.
    `seeds` has the columns case, seed, stage, metric, value; a seed without the number (nan) is left out.
    """
    runs = seeds.pivot_table(index=KEYS, columns="seed", values="value")
    columns = ["n_seeds", "median", "ci_low", "ci_high", "least", "p90", "greatest"]
    found = pd.DataFrame(index=runs.index, columns=columns, dtype=float)
    for n_seeds, rows in runs.groupby(runs.count(axis=1)):
        values = rows.to_numpy()[rows.notna().to_numpy()].reshape(len(rows), n_seeds)
        found.loc[rows.index, "n_seeds"] = n_seeds
        found.loc[rows.index, ["ci_low", "ci_high"]] = median_interval(values)
        found.loc[rows.index, ["least", "median", "p90", "greatest"]] = np.quantile(values, [0, 0.5, 0.9, 1], axis=1).T
    return found.astype({"n_seeds": int}).reset_index()


def relative(seeds: pd.DataFrame, published: Mapping[int, PublishedCase], feature_names: Sequence[str]) -> pd.DataFrame:
    """Two ratios of each seed, as further rows of `seeds`.

    Stage expert, metric published_error: the mean relative error of our expert's features against the printed row. Every stage that
    was measured beside minimum-variance control, metric share: its objective on x, divided by that controller's on the same
    disturbances.
    """
    wide = seeds.pivot_table(index=["case", "seed", "stage"], columns="metric", values="value").reset_index("stage")
    rows = []
    for case, printed in published.items():
        expert = wide[(wide.index.get_level_values("case") == case) & (wide["stage"] == "expert")]
        theirs = np.array(printed.expert)
        error = (expert.reindex(columns=[f"v:{name}" for name in feature_names]) - theirs).abs() / np.abs(theirs)
        rows.append(error.mean(axis=1, skipna=False).rename("value").reset_index().assign(stage="expert", metric="published_error"))
    reference = wide.loc[wide["stage"] == MINIMUM_VARIANCE, "objective_x"]
    for stage, own in wide.groupby("stage"):
        share = (own["objective_x"] / reference.reindex(own.index)).dropna()
        rows.append(share.rename("value").reset_index().assign(stage=stage, metric="share"))
    return pd.concat(rows, ignore_index=True)[list(seeds.columns)]


def gaps(medians: pd.DataFrame, published: Mapping[int, PublishedCase]) -> pd.DataFrame:
    """How near the learned policy comes to the expert, and how near online learning to minimum-variance control.

    Columns: case; n_seeds; feature_gap, its median, with the ends of its interval, the 90th percentile and the greatest;
    published_gap, the mean of |v_pi - v_E| / |v_E| over the paper's own rows; printed_gap (of the algorithms as printed),
    expert_error and online_share, medians with the ends of their intervals. All but the first two are shares of one; what no seed
    gave is nan. `medians` are those of `summary`, with the rows of `relative`.
    """
    found, wide = medians.set_index(KEYS), ("median", "ci_low", "ci_high", "p90", "greatest")
    wanted = {  # name: stage, metric, what is shown
        "feature_gap": ("offline", "feature_gap", wide),
        "printed_gap": ("offline_printed", "feature_gap", wide[:3]),
        "expert_error": ("expert", "published_error", wide[:3]),
        "online_share": ("online", "share", wide[:3]),
    }
    rows = []
    for case, printed in published.items():
        row: dict[str, float] = {"case": case, "n_seeds": 0}
        for name, (stage, metric, shown) in wanted.items():
            numbers = found.reindex([(case, stage, metric)]).iloc[0]
            row |= {f"{name}_{what.removeprefix('ci_')}".removesuffix("_median"): numbers[what] for what in shown}
            if name == "feature_gap":
                row |= {"n_seeds": int(np.nan_to_num(numbers["n_seeds"])), "published_gap": printed.feature_gap}
        rows.append(row)
    return pd.DataFrame(rows)


def verdict(row: str, published: float, n_seeds: int, low: float, high: float) -> tuple[str, str]:
    """The verdict on one published number and, in a clause, its reason. The rule:

    `fitted` for the row whose settings were inferred from these numbers; `cannot tell` with fewer than two seeds; otherwise
    `differs` where the published value lies outside the 95 % prediction interval for one run, `low` to `high`, however wide, and
    inside it, its ends included, `match`, or `cannot tell` where it reaches further than a quarter of the value to either side of
    its middle.
    """
    if n_seeds < 2:
        one = ("fitted", "settings inferred from it") if row == FITTED else ("cannot tell", "one seed")
        return one if n_seeds else (one[0], "no seed gave it")
    decimals, reach = RESULT_DECIMALS[row], (high - low) / 2
    inside = low <= published <= high
    if inside:
        reason = f"inside {low:.{decimals}f} to {high:.{decimals}f}"
    else:
        distance = max(published - high, low - published)
        reason = f"{distance:.2g} {'above' if published > high else 'below'} the interval"
    if row == FITTED:
        return "fitted", reason
    if inside and reach > WIDEST * abs(published):
        return "cannot tell", f"one run scatters by {reach:.2g} to either side of {(low + high) / 2:.{decimals}f}"
    return ("match" if inside else "differs"), reason


def comparison(
    published: Mapping[int, PublishedCase],
    seeds: pd.DataFrame,
    medians: pd.DataFrame,
    feature_names: Sequence[str],
    trajectories: Mapping[str, int],
    sampling_errors: Mapping[tuple[int, str], float] | None = None,
) -> pd.DataFrame:
    """One row for each published number of Tables 2-4, beside the median of ours over the seeds.

    ci_low and ci_high are the 95 % bootstrap interval of the median; pred_low and pred_high the 95 % prediction interval for
    one run as the paper reports it. A published feature is a mean over 500 trajectories; ours are means over more, so that the
    sampling variance they lack, s^2 (1/500 - 1/K), is added. Weights carry no such error beyond their run's own.
    A number that no seed gave is nan with n_seeds 0.

    `medians` are the `summary` of the seeds (columns case, seed, stage, metric, value), `trajectories` are K of each row that holds
    features, and `sampling_errors` s/sqrt(500) by case and feature, where another than our own is to be taken.
    """
    found = medians.set_index(KEYS)
    runs = {key: group.dropna().to_numpy() for key, group in seeds.groupby(KEYS)["value"]}
    rows = []
    for case, printed in published.items():
        for row, (stage, metric) in REPRODUCED_BY.items():
            for feature, value in zip(feature_names, getattr(printed, row), strict=True):
                key = (case, stage, f"{metric}:{feature}")
                ours = found.reindex([key]).iloc[0]
                n_seeds, lacking = int(np.nan_to_num(ours["n_seeds"])), 0.0
                if n_seeds and metric == "v":
                    error = (sampling_errors or {}).get((case, feature))
                    variance = PUBLISHED_TRAJECTORIES * error**2 if error else np.mean(runs[case, stage, f"v:{feature}:std"] ** 2)
                    lacking = variance * max(0.0, 1 / PUBLISHED_TRAJECTORIES - 1 / trajectories[row])
                low, high = prediction_interval(runs.get(key, ()), lacking)
                numbers = [ours["median"], n_seeds, ours["ci_low"], ours["ci_high"], low, high]
                rows.append([printed.table, case, row, feature, value, *numbers, *verdict(row, value, n_seeds, low, high)])
    return pd.DataFrame(rows, columns=COLUMNS)


def sampling_errors(prediction: pd.DataFrame, published: Mapping[int, PublishedCase]) -> dict[tuple[int, str], float]:
    """The standard error of a published Type III feature, by case and feature, as the fit of the settings has it.

    There |e| before the first step is each trajectory's own, here its mean, one: the same expectation, but a wider scatter.
    `prediction` has the columns table, feature, published, simulated, deviation (in these errors) of the expert's features.
    """
    case_of = {record.table: case for case, record in published.items()}
    rows = prediction[prediction["feature"].str.endswith("-III") & prediction["table"].isin(case_of)]
    errors = ((rows["simulated"] - rows["published"]) / rows["deviation"]).abs()
    return errors.groupby([rows["table"].map(case_of), rows["feature"]]).median().to_dict()


def changed(compared: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """The published numbers whose verdict another sampling error changes, with both verdicts."""
    both = compared.assign(verdict_with_the_wider_error=other["verdict"])
    columns = ["table", "row", "feature", "published", "reproduced", "verdict", "verdict_with_the_wider_error"]
    return both.loc[compared["verdict"] != other["verdict"], columns].reset_index(drop=True)


def outside(compared: pd.DataFrame) -> dict[str, int]:
    """How many published numbers of each verdict lie outside the prediction interval of one run."""
    beyond = (compared["published"] < compared["pred_low"]) | (compared["published"] > compared["pred_high"])
    return beyond.groupby(compared["verdict"]).sum().reindex(VERDICTS, fill_value=0).to_dict()


def counts(compared: pd.DataFrame) -> pd.DataFrame:
    """How many published numbers have each verdict: a row for each kind of number, a column for each verdict."""
    table = pd.crosstab(compared["row"], compared["verdict"]).reindex(index=list(ROWS), columns=list(VERDICTS), fill_value=0)
    return table.rename(index=ROWS).rename_axis(index="published numbers", columns=None).reset_index()


def nearer_to_expert(compared: pd.DataFrame) -> int:
    """How many features of the policy differ from the printed ones and lie nearer to the printed expert than those do."""
    numbers = compared.set_index(["row", "case", "feature"]).sort_index()
    policy, expert = numbers.loc["policy"], numbers.loc["expert", "published"]
    nearer = (policy["reproduced"] - expert).abs() < (policy["published"] - expert).abs()
    return int((nearer & (policy["verdict"] == "differs")).sum())


def held_out(prediction: pd.DataFrame) -> pd.DataFrame:
    """How far the settings fitted to some tables reproduce each table: a row for each pair of them.

    Columns: fitted_on, table, role (fit or prediction), mean_error and greatest_error (of the features, in per cent),
    greatest_deviation (in sampling errors of a published feature). `prediction` has the columns fitted_on, table, deviation and
    relative_error of each feature, on trajectories that no fit has seen.
    """
    errors = prediction.assign(error=100 * prediction["relative_error"].abs(), deviation=prediction["deviation"].abs())
    shown = {"mean_error, %": ("error", "mean"), "greatest_error, %": ("error", "max"), "greatest_deviation": ("deviation", "max")}
    found = errors.groupby(["fitted_on", "table"], sort=False).agg(**shown)
    fitted = [fitted_on == "parameter files" or str(table) in fitted_on.split() for fitted_on, table in found.index]
    found.insert(0, "role", np.where(fitted, "fit", "prediction"))
    return found.reset_index()


def against_headline(trials: pd.DataFrame) -> dict[str, str]:
    """By trial, the cases in which it is better or worse than the variant `improved`, paired by seed, by the whole interval.

    `trials` has the columns trial, case, seed, gap (a share of one); the variants are among them.
    """
    gaps = trials.pivot_table(index=["case", "seed"], columns="trial", values="gap")
    found = {}
    for name, differences in gaps.drop(columns=HEADLINE).sub(gaps[HEADLINE], axis=0).items():
        cases: dict[str, list[str]] = {"better": [], "worse": []}
        for case, of_case in differences.dropna().groupby("case"):
            low, high = median_interval(of_case.to_numpy())
            if word := "better" if high < 0 else "worse" if low > 0 else "":
                cases[word].append(ROMAN[case - 1])
        found[name] = "; ".join(f"{word} in {', '.join(numerals)}" for word, numerals in cases.items() if numerals) or NOT_KNOWN
    return found


def claims_by_case(claims: pd.DataFrame) -> pd.DataFrame:
    """One row a claim: section, statement, a verdict for each case it is made of, the verdict on the whole, and how it was counted.

    One rule for all sides: `holds` or `does not hold` where every quantity says so, `in part` where both occur, otherwise
    `cannot tell` or `not comparable`. `claims` has the columns id, section, statement, case, quantity, verdict.
    """
    rows = []
    for _, found in claims.groupby("id", sort=False):
        row = {"section": found["section"].iloc[0], "statement": capital(found["statement"].iloc[0])}
        of_case = found.groupby("case")["verdict"].agg(_together)
        row |= {ROMAN[case - 1]: of_case.get(case, "") for case in sorted(claims["case"].unique())}
        counted = found["verdict"].value_counts(sort=False)
        said = ", ".join(f"{count} {verdict}" for verdict, count in counted.items()) if len(found) > 1 else ""
        rows.append(row | {"overall": _together(found["verdict"]), "quantities": said})
    return pd.DataFrame(rows)


def _together(verdicts: pd.Series) -> str:
    """The verdict of several quantities."""
    said = set(verdicts)
    if len(said) == 1:
        return said.pop()
    return "in part" if {"holds", "does not hold"} <= said else "cannot tell"
