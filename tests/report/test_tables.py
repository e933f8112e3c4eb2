"""The tables of the report and Markdown, against cases built by hand and the paper's own numbers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from helpers.report import tables
from helpers.settings.paper import load

PARAMS = Path(__file__).resolve().parents[2] / "params"


def test_symbols():
    symbols = {"T": "$T^*$", "C_A": "$C_A^*$", "C_A0": "$C_{A0}^*$", "level_tank_2": r"$\mathrm{level}_{tank,2}^*$"}
    assert {name: tables.symbol(name) for name in symbols} == symbols


def test_table_1_holds_the_conditions_of_the_paper():
    params = {case: load(PARAMS, case) for case in (1, 2, 3)}
    table = tables.table_1({case: entry.case for case, entry in params.items()}, params[1].process)
    loops = ["Concentration of reagent (C_A) control loop", "Reactor temperature (T) control loop"]
    assert list(table.columns) == ["case_study", "system_parameter", *loops]
    expected = []
    for case, *target in (("I", "-1", "4"), ("II", "1", "4"), ("III", "-2.5", "3")):
        expected += [[case, "initial state distribution", "N(0, 0.25)", "N(0, 0.75)"], [case, "set point", *target]]
    assert table.to_numpy().tolist() == expected
    assert "Concentration of reagent ($C_A^*$) control loop" in tables.to_markdown(table)


SPREADS = [((16.84, 16.5, 17.01), {}, "16.8 [16.5, 17.0]"), ((0.0123, 0.0098, 0.0151), {}, "0.0123 [0.0098, 0.0151]")]
SPREADS += [((-0.8, -1.26, 0.04), {}, "-0.80 [-1.26, 0.04]"), ((1957.4, 1954.2, 1958.6), {}, "1957 [1954, 1959]")]
SPREADS += [((0.812, 0.7, 0.95), {"decimals": 1, "unit": " %"}, "0.8 % [0.7, 0.9]"), ((np.nan, np.nan, np.nan), {}, "–")]
SPREADS += [((16.84, np.nan, np.nan), {}, "16.8")]  # too few seeds
SPREADS += [((300.0, 300.0, 300.0), {"decimals": 0}, "300"), ((0.0, 0.0, 0.0), {}, "0")]  # no spread


@pytest.mark.parametrize(("numbers", "style", "text"), SPREADS)
def test_spread(numbers, style, text):
    assert tables.spread(dict(zip(("median", "ci_low", "ci_high"), numbers, strict=True)), **style) == text


def test_results_table_sets_printed_and_own_numbers_together():
    ours = [("expert", "h-I", 10.0), ("expert", "h-II", 11.0), ("policy", "h-I", 11.0), ("policy", "h-II", 12.0)]
    ours += [("alpha", "h-I", 0.61), ("alpha", "h-II", 1.61)]
    compared = pd.DataFrame(ours, columns=["row", "feature", "reproduced"]).assign(pred_low=8.0, pred_high=12.0, verdict="match")
    compared["published"] = compared["reproduced"] + 0.5
    table = tables.results_table(compared, ["h-I", "h-II"])
    assert list(table.columns) == ["quantity", "source", "h-I", "h-II"]
    assert table["quantity"].tolist() == [name for name in ("E[v^E]", "E[v^pi]", "alpha*") for _ in range(4)]
    assert table["source"].tolist() == ["published", "reproduced", "interval of one run", "verdict"] * 3
    assert table["h-I"].tolist()[:4] == ["10.50", "10.00", "8.00 to 12.00", "match"]
    assert table["h-II"].tolist()[8:] == ["2.110", "1.610", "8.000 to 12.000", "match"]
    with pytest.raises(KeyError):
        tables.results_table(compared, ["h-I", "h-III"])


def medians(rows: list[tuple[int, str, str, float]]) -> pd.DataFrame:
    """A summary whose intervals reach a tenth to either side."""
    frame = pd.DataFrame(rows, columns=["case", "stage", "metric", "median"])
    return frame.assign(n_seeds=7, ci_low=0.9 * frame["median"], ci_high=1.1 * frame["median"], greatest=2 * frame["median"])


def test_quality_table_has_a_row_for_each_figure_of_merit_and_a_column_for_each_controller():
    rows = [(1, "expert_paired", "objective_x", 10.0), (1, "online", "objective_x", 18.0), (1, "online", "share", 0.9)]
    rows += [(1, "online", name, value) for name, value in (("overshoot:T", 0.02), ("movement:T_E", 321.0), ("episodes", 2000.0))]
    table = tables.quality_table(medians(rows), load(PARAMS, 1).process).set_index("figure of merit")
    assert list(table) == ["PID", "offline policy", "online policy", "online policy, learned on y", "minimum variance on y"]
    assert table.loc["$J$ on $x$"].tolist() == ["10.00 [9.00, 11.00]", "–", "18.00 [16.20, 19.80]", "–", "–"]
    others = ["$J$ on $x$, % of minimum variance", "overshoot $T^*$, %", "movement $T_E^*$", "plant episodes spent"]
    shown = ["90.0 [81.0, 99.0]", "2.0 [1.8, 2.2]", "321 [289, 353]", "2000 [1800, 2200]"]
    assert table.loc[others, "online policy"].tolist() == shown
    assert len(table) == 3 + 2 * 3 + 2 + 1


def test_variants_table_has_gap_interval_worst_seed_and_cost():
    cost = (("epochs", 300.0), ("chosen_epoch", 250.0), ("episodes", 150000.0), ("gradient_steps", 600.0))
    stages = ((2, "offline_printed", 0.2), (1, "offline", 0.01), (1, "online", 0.5))
    rows = [(case, stage, *number) for case, stage, gap in stages for number in (("feature_gap", gap), *cost)]
    table = tables.variants_table(medians(rows))
    first, second = table.to_numpy().tolist()
    assert first == ["I", "improved", 7, "1.0 [0.9, 1.1]", "2.0", 300, 250, 150000, 600]
    assert second == ["II", "printed", 7, "20.0 [18.0, 22.0]", "40.0", 300, 250, 150000, 600]


def test_trials_table_has_a_row_for_each_trial():
    runs = [("base", 1, 0, 0.02), ("base", 1, 1, 0.03), ("base", 1, 2, 0.10), ("base", 3, 0, 0.04), ("wild", 3, 0, 0.5)]
    trials = pd.DataFrame(runs, columns=["trial", "case", "seed", "gap"]).assign(family="weights")
    trials["description"] = "what " + trials["trial"]
    table = tables.trials_table(trials)
    assert list(table) == ["family", "trial", "description", "case I, %", "case III, %"]
    base, wild = table.to_numpy().tolist()
    assert base == ["weights", "base", "what base", "3.0 (2.0 to 10.0; 3 seeds)", "4.0 (4.0 to 4.0; 1 seed)"]
    assert wild == ["weights", "wild", "what wild", "–", "50.0 (50.0 to 50.0; 1 seed)"]


def test_time_table_has_a_row_for_each_stage():
    seconds = pd.DataFrame([(1, "offline_improved", 44.5), (2, "offline_improved", 35.4), (1, "demonstrations", 2.0)])
    table = tables.time_table(seconds.set_axis(["case", "stage", "seconds"], axis=1))
    assert table.to_numpy().tolist() == [["demonstrations", "2", "–"], ["offline improved", "44", "35"]]
    assert list(table) == ["stage", "Case I", "Case II"]


def test_parameters_table_lists_each_parameter_once_and_readably():
    leaves = [leaf for case in (1, 2) for leaf in load(PARAMS, case).leaves]
    table = tables.parameters_table(leaves)
    assert list(table.columns) == ["file", "key", "value", "unit", "source", "status"]
    assert not table.duplicated(["file", "key"]).any()
    value = table.set_index(["file", "key"])["value"]
    assert value["process.yaml"][["drift_input", "controlled", "horizon"]].tolist() == ["[[0.5, 0], [0, 0.305]]", "[C_A, T]", "50"]
    assert [value[f"case_{case}.yaml", "set_point"] for case in (1, 2)] == ["[-1, 4]", "[1, 4]"]
    flags = [f"variants.{variant}.weights.keep_nearest" for variant in ("improved", "printed")]
    assert value["learning.yaml"][flags].tolist() == ["yes", "no"]


def cells(markdown: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines()]


def test_markdown_numbers():
    frame = pd.DataFrame({"v": [21.23456, -0.0671234, 20000.4, np.nan, -1e-9, 0.0], "n_seeds": [1, 20, 300, 4000, 50000, 1234567]})
    assert tables.to_markdown(frame[:0]).startswith("| V")  # an empty table is a header
    names, _, *shown = cells(tables.to_markdown(frame))
    numbers = ["21.23", "-0.06712", "20000", "–", "-1e-09", "0"]
    assert [names, *shown] == [["V", "N seeds"], *([*row] for row in zip(numbers, frame["n_seeds"].astype(str), strict=True))]
    assert [row[0] for row in cells(tables.to_markdown(frame, digits=2))[2:]] == ["21", "-0.067", "20000", "–", "-1e-09", "0"]


def test_columns_of_numbers_and_intervals_stand_to_the_right():
    numbers = {"number": [1.5, np.nan], "interval": ["0.8 [0.7, 0.9]", "–"], "range": ["3.0 (2.0 to 10.0; 3 seeds)", "1 %"]}
    frame = pd.DataFrame(numbers | {"text": ["match", "2"], "flag": [True, False]})
    assert [cell.endswith(":") for cell in cells(tables.to_markdown(frame))[1]] == [True, True, True, False, False]


def test_markdown_text_is_typeset_or_escaped():
    frame = pd.DataFrame({"C_A-I": ["alpha*", None, "|e| before", "T-II", "a * b <c> $x|y$", "x = 2"], "flag": [True, False] * 3})
    shown = tables.to_markdown(frame, labels={"flag": "Is it so?"})
    assert cells(shown)[0] == ["$C_A^*$-I", "Is it so?"]
    texts = (r"$\alpha^*$", "–", r"\|e\| before", "$T^*$-II", r"a \* b \<c> $x|y$", "x = 2")
    for line, text in zip(shown.splitlines()[2:], texts, strict=True):
        assert line.startswith(f"| {text} ")
    assert [row[-1] for row in cells(shown)[2:]] == ["yes", "no"] * 3


def test_fitted_settings_are_told_in_words_and_a_gain_of_no_size_is_none():
    places = [("sampling_time", "-", 0.04), ("input_bound", "C_A0", 20.0), ("PID1.derivative", "T", 7e-11)]
    found = [{"setting": name, "component": of, "value": value, "low": 0.0, "high": 50.0} for name, of, value in places]
    table = tables.inferred_settings(pd.DataFrame(found).assign(identified="yes", in_parameter_files=1.0))
    assert table["setting"].tolist() == ["sampling time", "bounds ±, $C_{A0}^*$", "PID1 derivative gain, $T^*$"]
    assert table["best value"].tolist() == [0.04, 20.0, 0.0]
