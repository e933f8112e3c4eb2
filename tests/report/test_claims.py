"""Claims: the file, the rule of the verdict, and the numbers it is given."""

import re
from itertools import product

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from helpers.report.claims import COLUMNS, Claim, collect, judge, load_claims, verdicts
from helpers.runs.artifacts import load_stage, save_stage
from helpers.runs.request import PROJECT
from helpers.settings.leaf import ParameterError

BASE = {"section": "1", "statement": "so it is", "cases": (1,), "margin": 0.0, "why": "because"}
MISTAKES = [
    ({"margin": None}, "key 'hot_start': the test 'difference_below' needs 'margin' and 'quantities'"),
    ({"test": "larger"}, "key 'hot_start.test'"),
    ({"test": "value_below"}, "key 'hot_start': the test 'value_below' needs no 'against'"),
    ({"test": "not_comparable"}, "key 'hot_start': the test 'not_comparable' has neither 'margin' nor 'quantities'"),
    ({"changed": "because"}, "key 'hot_start.changed'"),
    ({"margins": 1}, "key 'hot_start.margins': the key is unknown"),
    ({"quantities": {"x": {"value": "no reference"}}}, "key 'hot_start.quantities.x.value'"),
    ({"quantities": {"x": {"value": "a/b/c"}}}, "key 'hot_start': the test 'difference_below' needs an 'against' in 'x'"),
]


def claim(test="difference_below", **changes):
    quantity = {"value": "s/r/m"} | ({} if test.startswith("value") else {"against": "s/r/n"})
    return Claim(**{**BASE, "test": test, "quantities": {"two": quantity}, **changes})


def paired(value, against=0.0):
    return pd.DataFrame({"value": np.asarray(value, float), "against": np.broadcast_to(np.asarray(against, float), len(value))})


def test_every_number_of_the_ordinary_stages_is_one_that_they_write(root):
    """Those of notebook 08 are checked with its verbs, in test_experiments."""
    claims = load_claims(root)
    folders = (PROJECT / "notebooks/inputs/smoke/seed_0").glob("case_*/*_*")
    judged = [folder for folder in folders if (folder / "scores.csv").is_file()]
    stages = {(int(folder.parent.name[-1]), 0, folder.name): load_stage(folder, "refresh") for folder in judged}
    known = set(collect(claims, stages).index)
    for name, entry in claims.items():
        assert set(entry.cases) <= {1, 2, 3}
        references = {reference for quantity in entry.quantities.values() for _, reference in quantity if reference}
        needed = {reference for reference in references if not reference.startswith("experiments/")}
        assert set(product(entry.cases, needed)) <= known, name


@pytest.mark.parametrize(("changes", "sentence"), MISTAKES)
def test_a_mistake_is_one_sentence_that_names_file_and_key(root, tmp_path, changes, sentence):
    yaml = YAML(typ="safe", pure=True)
    content = yaml.load(root / "claims.yaml")
    content["hot_start"] |= changes
    yaml.dump(content, tmp_path / "claims.yaml")
    with pytest.raises(ParameterError, match=rf"\A{re.escape(f'{tmp_path}/claims.yaml: {sentence}')}.*\Z"):  # in one line
        load_claims(tmp_path)


FOUR = [-1, -2, -3, -4]  # seeds are too few
SAID = [([*FOUR, -5], "holds"), ([*FOUR, -5, np.nan], "holds"), ([1, 2, 3, 4, 5], "does not hold")]
SAID += [([0, 0, 0, 0, 0], "does not hold")]  # no better is not better
SAID += [(values, "cannot tell") for values in ([-3, -2, 1, 2, 3], FOUR, [*FOUR, np.nan], [])]


@pytest.mark.parametrize(("values", "verdict"), SAID)
@pytest.mark.parametrize("shift", [0.0, 3.5])
def test_verdicts_of_a_difference_below(values, verdict, shift):
    found = judge(claim(), paired(np.add(values, shift), shift))
    assert found.verdict == verdict
    # Mirrored, the same numbers say the same of a difference above, except where nothing differs.
    mirrored = judge(claim("difference_above"), paired(np.subtract(shift, values), shift))
    assert mirrored.verdict == verdict
    assert mirrored.median == pytest.approx(-found.median, nan_ok=True)
    assert (found.reason == "a tie") == (values == [0, 0, 0, 0, 0])


JUDGED = [("ratio_above", 0.9, 2.0, "holds"), ("ratio_below", 0.9, 2.0, "does not hold"), ("ratio_below", 1.25, 2.0, "cannot tell")]
JUDGED += [("value_above", 1.9, 0.0, "holds"), ("value_below", 1.9, 0.0, "does not hold")]


@pytest.mark.parametrize(("test", "margin", "against", "verdict"), JUDGED)
def test_margins_ratios_and_values(test, margin, against, verdict):
    found = judge(claim(test, margin=margin), paired([2.0, 2.2, 2.4, 2.6, 2.8, 3.0], against))
    assert (found.verdict, found.n) == (verdict, 6)


def test_what_no_number_decides():
    for test, verdict in (("not_comparable", "not comparable"), ("by_definition", "holds")):
        assert judge(claim(test, margin=None, quantities={}), paired([]))[:3] == (verdict, "because", 0)


def test_seeds_are_compared_in_pairs():
    """The seeds differ much more among each other than the two from each other; pairing shows the difference all the same."""
    level = np.array([1.0, 50.0, 200.0, 900.0, 3000.0, 9000.0])
    found = judge(claim(), paired(level - 0.1, level))
    assert found.verdict == "holds"
    assert found.median == pytest.approx(-0.1)
    assert found.ci_low <= found.median <= found.ci_high < 0


@pytest.fixture
def stages(tmp_path):
    """Six seeds of a stage with two numbers, written in different orders; the fourth lacks one of them."""
    for seed in range(6):
        rows = [("r", "m", 1.0 * seed), ("r", "n", 1.0 * seed + 1), ("r", "unasked", 0.0)][:: 1 if seed % 2 else -1]
        frame = pd.DataFrame(rows, columns=["stage", "metric", "value"])
        save_stage(tmp_path / str(seed), {}, {"scores.csv": frame[(frame["metric"] != "n") | (seed != 4)]})
    return {(1, seed, "s"): load_stage(tmp_path / str(seed), "a test") for seed in range(6)}


def test_from_files_to_verdicts(stages):
    claims = {
        "less": claim(changed="2026-11-29: as it was"),
        "elsewhere": claim(cases=(2,)),
        "never": claim(quantities={"x": {"value": "t/r/m", "against": "t/r/n"}}),
        "silent": claim("not_comparable", margin=None, quantities={}),
    }
    values = collect(claims, stages)
    assert (values.index.tolist(), values.notna().to_numpy().sum()) == ([(1, "s/r/m"), (1, "s/r/n")], 11)
    table = verdicts(claims, values)
    assert table.columns.tolist() == COLUMNS
    assert table["changed"].tolist() == ["2026-11-29: as it was", "", "", ""]
    assert table["verdict"].tolist() == ["holds", "cannot tell", "cannot tell", "not comparable"]
    assert table["reason"].tolist() == ["the whole interval lies below 0", "not run", "not run", "because"]
    assert table.loc[0, ["n", "median", "test", "quantity"]].tolist() == [5, -1.0, "difference below 0", "two"]
    nothing = verdicts(claims, collect(claims, {}))
    assert nothing.loc[0, ["n", "verdict", "reason"]].tolist() == [0, "cannot tell", "not run"]
