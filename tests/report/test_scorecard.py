"""The verdict rule and its edges, and medians, gaps and lists against cases built by hand."""

from itertools import product

import numpy as np
import pandas as pd
import pytest

from helpers.report import scorecard
from helpers.report.statistics import median_interval
from helpers.runs.sources import PROJECT
from helpers.settings.paper import PublishedCase, load_published

PAPER = load_published(PROJECT / "params")
FEATURES = ["C_A-I", "T-I", "C_A-II", "T-II", "C_A-III", "T-III"]
TWO = ["h-I", "h-II"]
SMALL = {4: PublishedCase(table=9, expert=(10.0, -2.0), policy=(11.0, -2.5), alpha=(0.6, -0.8))}
MEASURED = {"expert": 20000, "policy": 2000}
SPREAD = 3.0  # of the features over trajectories
JUDGED = [  # what is published, of how many seeds, the interval, and what is said
    ("policy", 10.0, 20, 10.0, 11.0, "match", "inside 10.00 to 11.00"),  # an end belongs to the interval
    ("policy", 10.0, 20, 9.0, 10.0, "match", "inside 9.00 to 10.00"),
    ("policy", 10.0, 20, 10.01, 11.0, "differs", "0.01 below the interval"),
    ("policy", 10.0, 20, 9.0, 9.6, "differs", "0.4 above the interval"),
    ("policy", -10.0, 20, -9.6, -9.0, "differs", "0.4 below the interval"),
    ("policy", 10.0, 20, 7.5, 12.5, "match", "inside 7.50 to 12.50"),  # a quarter to either side still tells
    ("policy", 10.0, 20, 7.49, 12.51, "cannot tell", "one run scatters by 2.5 to either side of 10.00"),
    ("policy", -10.0, 20, -12.51, -7.49, "cannot tell", "one run scatters by 2.5 to either side of -10.00"),
    ("policy", -10.0, 20, -12.5, -7.5, "match", "inside -12.50 to -7.50"),
    ("policy", 10.0, 20, 12.0, 17.2, "differs", "2 below the interval"),  # outside tells, however wide
    ("policy", 10.0, 1, np.nan, np.nan, "cannot tell", "one seed"),
    ("expert", 10.0, 20, 9.0, 9.6, "fitted", "0.4 above the interval"),  # whatever its interval says
    ("expert", 10.0, 20, 0.0, 20.0, "fitted", "inside 0.00 to 20.00"),
    ("expert", 10.0, 1, np.nan, np.nan, "fitted", "settings inferred from it"),
    ("alpha", 10.0, 0, np.nan, np.nan, "cannot tell", "no seed gave it"),
    ("alpha", 0.5, 2, 0.4, 0.501, "match", "inside 0.400 to 0.501"),
]


def seeds(n_seeds=6):
    """Case 4: policies at 11 and 2.0 more or less; the last seed lacks its weights."""
    rows = []
    for seed in range(n_seeds):
        shift = 0.1 * (seed - (n_seeds - 1) / 2)
        rows += [(4, seed, "expert", "v:h-I", 10.5 + shift), (4, seed, "expert", "v:h-II", -2.2)]
        rows += [(4, seed, "offline", "v:h-I", 11.0 + shift), (4, seed, "offline", "v:h-II", -2.0)]
        rows += [(4, seed, "online", "v:h-I", 99.0), (4, seed, "online", "objective_x", 9.0 + seed / 10)]
        rows += [(4, seed, "offline", "feature_gap", 0.02 + seed / 100), (1, seed, "offline", "feature_gap", 0.9)]
        rows += [(4, seed, "minimum_variance", "objective_x", 10.0)]
        rows += [(4, seed, stage, f"v:{name}:std", SPREAD) for stage in ("expert", "offline") for name in TWO]
        if seed < n_seeds - 1:
            rows += [(4, seed, "offline", "alpha:h-I", 0.61 + shift / 10), (4, seed, "offline", "alpha:h-II", -0.7)]
    return pd.DataFrame(rows, columns=["case", "seed", "stage", "metric", "value"])


def compare(runs, published=SMALL, names=TWO, measured=MEASURED, errors=None):
    return scorecard.comparison(published, runs, scorecard.summary(runs), names, measured, errors)


@pytest.mark.parametrize(("row", "published", "n_seeds", "low", "high", "expected", "reason"), JUDGED)
def test_the_verdict_and_its_reason(row, published, n_seeds, low, high, expected, reason):
    assert scorecard.verdict(row, published, n_seeds, low, high) == (expected, reason)


def test_summary_has_the_median_and_its_interval_for_every_number():
    runs = seeds(7)
    runs.loc[(runs["metric"] == "feature_gap") & (runs["case"] == 1) & (runs["seed"] == 2), "value"] = np.nan
    found = scorecard.summary(runs).set_index(["case", "stage", "metric"])
    assert len(found) == len(runs.drop_duplicates(["case", "stage", "metric"]))
    assert found.loc[[(1, "offline", "feature_gap"), (4, "offline", "alpha:h-I")], "n_seeds"].tolist() == [6, 6]
    row = found.loc[(4, "offline", "feature_gap")]
    assert row[["median", "least", "greatest", "p90"]].tolist() == pytest.approx([0.05, 0.02, 0.08, 0.074])
    interval = median_interval(0.02 + np.arange(7) / 100).tolist()
    assert row[["ci_low", "ci_high"]].tolist() == pytest.approx(interval, abs=1e-12)


def test_comparison_holds_intervals_of_the_median_and_of_one_run():
    table = compare(seeds())
    assert list(table.columns) == scorecard.COLUMNS
    places = [[9, 4, *place] for place in product(("expert", "policy", "alpha"), TWO)]
    assert table[["table", "case", "row", "feature"]].to_numpy().tolist() == places
    numbers = [[10.0, -2.0, 11.0, -2.5, 0.6, -0.8], [6, 6, 6, 6, 5, 5]]
    assert [table[name].tolist() for name in ("published", "n_seeds")] == numbers
    assert table["reproduced"].tolist() == pytest.approx([10.5, -2.2, 11.0, -2.0, 0.605, -0.7])
    assert table["verdict"].tolist() == ["fitted", "fitted", "match", "differs", "match", "differs"]
    assert table.loc[3, ["ci_low", "ci_high"]].tolist() == [-2.0, -2.0]


def test_the_sampling_error_that_ours_lack_is_added_to_features_only():
    """Six runs that are all alike leave the sampling error of 500 trajectories less that of K; normal, so 1.96 of it."""
    table = compare(seeds()).set_index(["row", "feature"])
    for row, measured in MEASURED.items():
        reach = 1.959964 * SPREAD * (1 / 500 - 1 / measured) ** 0.5
        ours = table.loc[(row, "h-II"), "reproduced"]
        assert (table.loc[(row, "h-II"), ["pred_low", "pred_high"]] - ours).tolist() == pytest.approx([-reach, reach], rel=1e-6)
    assert table.loc[("alpha", "h-II"), ["pred_low", "pred_high"]].tolist() == pytest.approx([-0.7, -0.7])
    fewer = compare(seeds(), measured={"expert": 500, "policy": 100})
    assert fewer.loc[3, ["pred_low", "pred_high"]].tolist() == [-2.0, -2.0]  # never less than the runs' own


def test_another_sampling_error_may_change_a_verdict():
    """The policy's h-III is printed 0.5 below ours: beyond 1.96 x 0.13 (its own error), within 1.96 x 0.3 (that of the fit)."""
    names, runs = ["h-I", "h-III"], seeds()
    runs["metric"] = runs["metric"].str.replace("h-II", "h-III")
    prediction = pd.DataFrame({"table": [9, 9, 8], "feature": ["h-III", "h-I", "h-III"]})
    prediction = prediction.assign(published=-2.0, simulated=-1.7, deviation=1.0)
    errors = scorecard.sampling_errors(prediction, SMALL)
    assert errors == {(4, "h-III"): pytest.approx(0.3)}
    ours, wider = (compare(runs, names=names, errors=found) for found in (None, errors))
    found = scorecard.changed(ours, wider)[["row", "feature", "verdict", "verdict_with_the_wider_error"]]
    assert found.to_numpy().tolist() == [["policy", "h-III", "differs", "match"]]
    assert scorecard.outside(ours) == {"match": 0, "differs": 2, "cannot tell": 0, "fitted": 0}


def test_comparison_has_a_row_for_each_published_number_even_if_nobody_reproduced_it():
    """Or if it is nan in every seed."""
    runs = seeds()
    runs.loc[runs["metric"] == "alpha:h-II", "value"] = np.nan
    row = compare(runs).iloc[5]
    assert (row["n_seeds"], row["verdict"], row["reason"]) == (0, "cannot tell", "no seed gave it")
    table = compare(seeds().query("case == 1"), PAPER, FEATURES)
    assert len(table) == 54
    assert table[["reproduced", "ci_low", "pred_high"]].isna().all(axis=None)
    assert [set(table[name]) for name in ("n_seeds", "verdict", "reason")] == [{0}, {"fitted", "cannot tell"}, {"no seed gave it"}]


def with_ratios(runs, published=SMALL, names=TWO):
    return scorecard.summary(pd.concat([runs, scorecard.relative(runs, published, names)], ignore_index=True))


def test_ratios_of_each_seed_and_the_gaps_over_seeds():
    added = scorecard.relative(seeds(2), SMALL, TWO).set_index(["stage", "metric"])["value"]
    assert added["expert", "published_error"].tolist() == pytest.approx([(error / 10 + 0.2 / 2) / 2 for error in (0.45, 0.55)])
    assert added["online", "share"].tolist() == pytest.approx([0.90, 0.91])
    assert added["minimum_variance", "share"].tolist() == [1.0, 1.0]
    assert len(added) == 6
    row = scorecard.gaps(with_ratios(seeds()), SMALL).iloc[0]
    assert (row["case"], row["n_seeds"]) == (4, 6)
    assert row[["feature_gap", "feature_gap_greatest"]].tolist() == pytest.approx([0.045, 0.07])
    assert 0.02 <= row["feature_gap_low"] < 0.045 < row["feature_gap_high"] <= 0.07
    others = [(1 / 10 + 0.5 / 2) / 2, (0.5 / 10 + 0.2 / 2) / 2, 0.925]
    assert row[["published_gap", "expert_error", "online_share"]].tolist() == pytest.approx(others)
    assert row["online_share_low"] < 0.925 < row["online_share_high"]
    table = scorecard.gaps(with_ratios(seeds(1).query("case == 4"), PAPER, FEATURES), PAPER)  # of seeds that are missing
    assert (100 * table["published_gap"]).round(1).tolist() == [3.7, 13.7, 11.5]
    assert table["n_seeds"].tolist() == [0, 0, 0]
    assert table[["feature_gap", "expert_error", "online_share"]].isna().all(axis=None)


def test_verdicts_are_counted_and_so_are_features_that_differ_and_lie_nearer_to_the_printed_expert():
    """h-II of the policy: printed 2.5, ours 2.0, the printed expert 2.0; h-I matches."""
    table = compare(seeds())
    counts = scorecard.counts(table)
    assert list(counts) == ["published numbers", "match", "differs", "cannot tell", "fitted"]
    assert counts.to_numpy()[:, 1:].tolist() == [[0, 0, 0, 2], [1, 1, 0, 0], [1, 1, 0, 0]]
    assert scorecard.nearer_to_expert(table) == 1
    table.loc[3, "reproduced"] = -2.6
    assert scorecard.nearer_to_expert(table) == 0


def test_settings_fitted_to_one_table_predict_the_other():
    rows = [("Table 2 and 4", 2, 1.0, 0.01), ("Table 2 and 4", 2, -3.0, -0.03), ("Table 2", 2, 0.5, 0.01)]
    rows += [("Table 2", 4, 2.0, -0.04), ("parameter files", 4, 2.0, 0.02)]
    found = scorecard.held_out(pd.DataFrame(rows, columns=["fitted_on", "table", "deviation", "relative_error"]))
    assert found["role"].tolist() == ["fit", "fit", "prediction", "fit"]
    numbers = found.loc[0, ["mean_error, %", "greatest_error, %", "greatest_deviation"]]
    assert numbers.tolist() == pytest.approx([2.0, 3.0, 3.0])


def test_trials_are_compared_with_the_headline_on_their_seeds():
    """Seeds differ more than the trials do; of four seeds nothing is said."""
    rows = [("improved", case, seed, 0.1 * (seed + 1)) for case in (1, 2) for seed in range(9)]
    rows += [("x", 1, seed, 0.1 * (seed + 1) - 0.01) for seed in range(5)]
    rows += [("x", 2, seed, 0.1 * (seed + 1) + 0.01) for seed in range(5)]
    rows += [("y", 1, seed, 0.0) for seed in range(4)]
    trials = pd.DataFrame(rows, columns=["trial", "case", "seed", "gap"])
    assert scorecard.against_headline(trials) == {"x": "better in I; worse in II", "y": "–"}


def test_claims_are_put_together_over_cases_and_quantities():
    holds, fails, open_ = "holds", "does not hold", "cannot tell"
    rows = [("a", 1, holds), ("a", 2, holds), ("b", 1, holds), ("b", 2, fails), ("c", 1, fails), ("c", 3, open_), ("d", 1, holds)]
    rows += [("d", 1, open_), ("e", 1, "not comparable"), ("f", 2, fails), ("f", 2, holds), ("g", 3, holds), *[("g", 3, fails)] * 3]
    claims = pd.DataFrame(rows, columns=["id", "case", "verdict"]).assign(section="5.1")
    claims["statement"] = "the claim " + claims["id"]
    found = scorecard.claims_by_case(claims)
    assert list(found) == ["section", "statement", "I", "II", "III", "overall", "quantities"]
    assert found["statement"].tolist() == [f"The claim {name}" for name in "abcdefg"]
    verdicts = ["holds", "in part", "cannot tell", "cannot tell", "not comparable", "in part", "in part"]
    assert found["overall"].tolist() == verdicts  # one rule for all sides: c fails in one case as d holds in one
    assert found.loc[2, ["I", "II", "III"]].tolist() == ["does not hold", "", "cannot tell"]
    assert found.loc[5, "II"] == "in part"
    assert found["quantities"].tolist()[5:] == ["1 does not hold, 1 holds", "1 holds, 3 does not hold"]
