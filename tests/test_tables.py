"""Tables 1-4, the comparison and Markdown, against cases built by hand and the paper's own numbers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from helpers import tables
from helpers.params import PublishedCase, load, load_published

PARAMS = Path(__file__).resolve().parents[1] / "params"
FEATURES = ["C_A-I", "T-I", "C_A-II", "T-II", "C_A-III", "T-III"]
TWO = ["h-I", "h-II"]
SMALL = {4: PublishedCase(table=9, expert=(10.0, -2.0), policy=(11.0, -2.5), alpha=(0.6, -0.8))}


def seeds() -> pd.DataFrame:
    """Case 4 with three seeds; the last one lacks its weights."""
    rows = []
    for seed, shift in enumerate((0.0, 1.0, 5.0)):
        rows += [
            (4, seed, "expert", "v:h-I", 10.5 + shift),
            (4, seed, "expert", "v:h-II", -2.2),
            (4, seed, "offline", "v:h-I", 20.0 + shift),
            (4, seed, "offline", "v:h-II", -1.0 - shift),
            (4, seed, "online", "v:h-I", 99.0),
            (4, seed, "offline", "feature_gap", 0.02 + shift / 100),
            (4, seed, "online", "feature_gap", 0.5),
            (1, seed, "offline", "feature_gap", 0.9),
        ]
        if seed < 2:
            rows += [(4, seed, "offline", "alpha:h-I", 0.5 + shift / 10), (4, seed, "offline", "alpha:h-II", -0.7)]
    return pd.DataFrame(rows, columns=["case", "seed", "stage", "metric", "value"])


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("T", "$T^*$"),
        ("C_A", "$C_A^*$"),
        ("C_A0", "$C_{A0}^*$"),
        ("T_E", "$T_E^*$"),
        ("level_tank_2", r"$\mathrm{level}_{tank,2}^*$"),
    ],
)
def test_symbols(name: str, expected: str) -> None:
    assert tables.symbol(name) == expected


def test_feature_symbols() -> None:
    assert [tables.feature_symbol(name) for name in ("C_A-I", "T-III")] == ["$C_A^*$-I", "$T^*$-III"]


def test_table_1_holds_the_conditions_of_the_paper() -> None:
    params = {case: load(PARAMS, case) for case in (1, 2, 3)}
    table = tables.table_1({case: entry.case for case, entry in params.items()}, params[1].process)
    assert list(table.columns) == [
        "case_study",
        "system_parameter",
        "Concentration of reagent (C_A) control loop",
        "Reactor temperature (T) control loop",
    ]
    start = ["initial state distribution", "N(0, 0.25)", "N(0, 0.75)"]
    assert table.to_numpy().tolist() == [
        ["I", *start],
        ["I", "set point", "-1", "4"],
        ["II", *start],
        ["II", "set point", "1", "4"],
        ["III", *start],
        ["III", "set point", "-2.5", "3"],
    ]
    assert "Concentration of reagent ($C_A^*$) control loop" in tables.to_markdown(table)


def test_results_table_sets_printed_and_own_rows_together() -> None:
    table = tables.results_table(
        SMALL[4], {"h-I": 10.5, "h-II": -2.2}, pd.Series({"h-II": -1.0, "h-I": 20.0}), {"h-I": 0.5, "h-II": -0.7}, TWO
    )
    assert list(table.columns) == ["quantity", "source", "h-I", "h-II"]
    assert table.to_numpy().tolist() == [
        ["E[v^E]", "published", 10.0, -2.0],
        ["E[v^E]", "reproduced", 10.5, -2.2],
        ["E[v^pi]", "published", 11.0, -2.5],
        ["E[v^pi]", "reproduced", 20.0, -1.0],
        ["alpha*", "published", 0.6, -0.8],
        ["alpha*", "reproduced", 0.5, -0.7],
    ]
    with pytest.raises(KeyError):
        tables.results_table(SMALL[4], {"h-I": 1.0}, {"h-I": 1.0}, {"h-I": 1.0}, TWO)


def test_comparison_takes_the_median_over_the_seeds_of_the_right_stage() -> None:
    table = tables.comparison(SMALL, seeds(), TWO)
    assert list(table.columns) == ["table", "case", "row", "feature", "published", "reproduced", "n_seeds"]
    assert table.to_numpy().tolist() == [
        [9, 4, "expert", "h-I", 10.0, 11.5, 3],
        [9, 4, "expert", "h-II", -2.0, -2.2, 3],
        [9, 4, "policy", "h-I", 11.0, 21.0, 3],
        [9, 4, "policy", "h-II", -2.5, -2.0, 3],
        [9, 4, "alpha", "h-I", 0.6, pytest.approx(0.55), 2],
        [9, 4, "alpha", "h-II", -0.8, -0.7, 2],
    ]


def test_comparison_has_a_row_for_each_published_number() -> None:
    published = {case: load_published(PARAMS)[case] for case in (1, 2, 3)}
    table = tables.comparison(published, seeds().query("case == 2"), FEATURES)
    assert len(table) == 54
    assert table["reproduced"].isna().all()
    assert (table["n_seeds"] == 0).all()
    assert not table.duplicated(["table", "case", "row", "feature"]).any()
    assert table.query("table == 3 and row == 'alpha' and feature == 'T-III'")["published"].tolist() == [-0.545]
    assert table.query("case == 3 and row == 'policy' and feature == 'C_A-II'")["published"].tolist() == [9.37]


def test_gaps() -> None:
    row = tables.gaps(seeds(), SMALL, TWO).iloc[0]
    assert (row["case"], row["n_seeds"]) == (4, 3)
    assert row[["feature_gap", "feature_gap_least", "feature_gap_greatest"]].tolist() == pytest.approx([0.03, 0.02, 0.07])
    assert row["published_gap"] == pytest.approx((1 / 10 + 0.5 / 2) / 2)
    assert row["expert_error"] == pytest.approx((1.5 / 10 + 0.2 / 2) / 2)


def test_gaps_of_the_paper_and_of_seeds_that_are_missing() -> None:
    table = tables.gaps(seeds().query("case == 2"), {case: load_published(PARAMS)[case] for case in (1, 2, 3)}, FEATURES)
    assert (100 * table["published_gap"]).round(1).tolist() == [3.7, 13.7, 11.5]
    assert table["n_seeds"].tolist() == [0, 0, 0]
    assert table[["feature_gap", "expert_error"]].isna().all(axis=None)


def test_parameters_table_lists_each_parameter_once_and_readably() -> None:
    leaves = [leaf for case in (1, 2) for leaf in load(PARAMS, case).leaves]
    table = tables.parameters_table(leaves)
    assert list(table.columns) == ["file", "key", "value", "unit", "source", "status"]
    assert not table.duplicated(["file", "key"]).any()
    value = table.set_index(["file", "key"])["value"]
    assert value["process.yaml", "drift_input"] == "[[0.5, 0], [0, 0.305]]"
    assert value["process.yaml", "controlled"] == "[C_A, T]"
    assert value["case_1.yaml", "set_point"] == "[-1, 4]"
    assert value["case_2.yaml", "set_point"] == "[1, 4]"
    assert value["learning.yaml", "variants.improved.weights.keep_nearest"] == "yes"


@pytest.mark.parametrize(
    ("value", "text"), [(True, "yes"), (False, "no"), (0.0001, "0.0001"), (300, "300"), ("x", "x"), ([1.0, [-2.5]], "[1, [-2.5]]")]
)
def test_render(value: object, text: str) -> None:
    assert tables.render(value) == text


def cells(markdown: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines()]


def test_markdown_numbers() -> None:
    frame = pd.DataFrame({"v": [21.23456, -0.0671234, 20000.4, np.nan, -1e-9, 0.0], "n_seeds": [1, 20, 300, 4000, 50000, 1234567]})
    shown = cells(tables.to_markdown(frame))
    assert shown[0] == ["V", "N seeds"]
    assert shown[1][0].endswith("-:")
    assert shown[1][1].endswith("-:")
    assert [row[0] for row in shown[2:]] == ["21.23", "-0.06712", "20000", "–", "-1e-09", "0"]
    assert [row[1] for row in shown[2:]] == ["1", "20", "300", "4000", "50000", "1234567"]
    assert [row[0] for row in cells(tables.to_markdown(frame, digits=2))[2:]] == ["21", "-0.067", "20000", "–", "-1e-09", "0"]
    fixed = cells(tables.to_markdown(frame, decimals=[1, 2, 3, 3, 2, 1]))
    assert [row[0] for row in fixed[2:]] == ["21.2", "-0.07", "20000.400", "–", "0.00", "0.0"]
    with pytest.raises(ValueError, match="zip"):
        tables.to_markdown(frame, decimals=[1])


def test_the_printed_rows_come_out_as_printed() -> None:
    same = dict.fromkeys(FEATURES, 0.0)
    table = tables.results_table(load_published(PARAMS)[1], same, same, same, FEATURES)
    shown = cells(tables.to_markdown(table, decimals=tables.RESULT_DECIMALS))
    assert shown[2][2:] == ["21.63", "20.68", "4.08", "7.93", "-22.87", "-22.43"]
    assert shown[6][2:] == ["0.137", "0.652", "-0.067", "-0.630", "-0.194", "-0.343"]


def test_markdown_text_is_typeset_or_escaped() -> None:
    frame = pd.DataFrame({"C_A-I": ["alpha*", None, "|e| before", "T-II", "a * b <c> $x|y$", "x = 2"], "flag": [True, False] * 3})
    lines = tables.to_markdown(frame, labels={"flag": "Is it so?"}).splitlines()
    assert lines[0].startswith("| $C_A^*$-I")
    assert "Is it so?" in lines[0]
    for line, expected in zip(
        lines[2:], (r"$\alpha^*$", "–", r"\|e\| before", "$T^*$-II", r"a \* b \<c> $x|y$", "x = 2"), strict=True
    ):
        assert line.startswith(f"| {expected} ")
    assert [row[-1] for row in cells("\n".join(lines[2:]))] == ["yes", "no"] * 3


def test_markdown_becomes_a_table_with_maths_in_html() -> None:
    pypandoc = pytest.importorskip("pypandoc")
    expert, policy, alpha = (dict.fromkeys(FEATURES, value) for value in (1.0, 2.0, np.nan))
    table = tables.results_table(load_published(PARAMS)[1], expert, policy, alpha, FEATURES)
    html = pypandoc.convert_text(tables.to_markdown(table), "html", format="markdown", extra_args=["--mathml"])
    assert html.count("<tr") == 7
    assert html.count("<math") == 6 + 6
    assert "–" in html
    assert "-0.067" in html.replace("−", "-")


def test_an_empty_table_is_a_header() -> None:
    assert tables.to_markdown(pd.DataFrame({"file": [], "key": []})).startswith("| File")
