"""Every verdict again from the CSV files of a report: of the published one, and of a copy in which one is wrong."""

import shutil

import pandas as pd
import pytest

from helpers.report.verdicts import main, recomputed
from helpers.runs.sources import PROJECT

REFERENCE, PARAMS = PROJECT / "reports/reference", PROJECT / "params"
NUMBERS = ["published", "reproduced", "ci_low", "ci_high", "pred_low", "pred_high"]


@pytest.fixture
def folder(tmp_path):
    """The published numbers of Case I seed by seed, six of one claim, and the verdicts that follow from them."""
    shutil.copy2(REFERENCE / "provenance.json", tmp_path)
    seeds = pd.read_csv(REFERENCE / "seeds.csv").query("case == 1 and stage in ('expert', 'offline')")
    seeds.to_csv(tmp_path / "seeds.csv", index=False)
    (tmp_path / "tables").mkdir()
    rows = [[1, f"experiments/{run}/objective_x", *range(least, least + 6)] for run, least in (("hot", 2), ("scratch", 1))]
    values = pd.DataFrame(rows, columns=["case", "quantity", *range(6)])
    values.to_csv(tmp_path / "tables/claims_seeds.csv", index=False)
    for name, table in recomputed(tmp_path, PARAMS).items():
        table.to_csv(tmp_path / name, index=False, float_format="%.10g")
    return tmp_path


def test_the_verdicts_follow_from_the_numbers_of_single_seeds_and_one_that_does_not_is_named(folder, capsys):
    claims = pd.read_csv(folder / "tables/claims.csv").set_index(["id", "case"])
    first = claims.loc[("hot_start_outcome", 1)].iloc[0]
    assert (first["n"], first["median"], first["verdict"]) == (6, 1.0, "holds")
    assert claims.loc[("hot_start_outcome", 2), "reason"].unique().tolist() == ["not run"]
    published, again = (pd.read_csv(place / "comparison.csv").query("case == 1")[NUMBERS] for place in (REFERENCE, folder))
    pd.testing.assert_frame_equal(again, published, rtol=1e-8)
    assert main([str(folder)]) == 0
    assert "54 of 54 verdicts" in capsys.readouterr().out
    path = folder / "tables/claims.csv"
    path.write_text(path.read_text(encoding="utf-8").replace(",holds,the whole", ",does not hold,the whole", 1), encoding="utf-8")
    assert main([str(folder)]) == 1
    assert "hot_start_outcome" in capsys.readouterr().out
    (folder / "seeds.csv").unlink()
    assert main([str(folder)]) == 2
    assert "seeds.csv" in capsys.readouterr().err


@pytest.mark.skipif(not (REFERENCE / "tables/claims_seeds.csv").is_file(), reason="published before single seeds were kept")
def test_every_published_verdict_follows_from_the_published_numbers():
    assert main([]) == 0
