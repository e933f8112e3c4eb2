"""Every verdict of a report once more, from its CSV files and the parameter files alone: `python -m helpers verdicts`."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from helpers.learning.features import feature_names
from helpers.report import claims, scorecard
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import InputError
from helpers.settings.paper import load, load_published

KEYS = {"comparison.csv": ["table", "row", "feature"], "tables/claims.csv": ["id", "case", "quantity"]}


def recomputed(folder: Path, params_root: Path) -> dict[str, pd.DataFrame]:
    """comparison.csv and tables/claims.csv of a report from the numbers of single seeds, in seeds.csv and tables/claims_seeds.csv.

    OSError where a file is missing, InputError where a parameter file is wrong.
    """
    params, seeds = load(params_root, 1), pd.read_csv(folder / "seeds.csv")
    scale = params.learning.scales[json.loads((folder / "provenance.json").read_text(encoding="utf-8"))["scale"]]
    trajectories = {"expert": scale.expert_evaluation, "policy": scale.evaluation}
    printed, names = load_published(params_root), feature_names(params.process.controlled)
    values = pd.read_csv(folder / "tables/claims_seeds.csv", index_col=claims.INDEX)
    return {
        "comparison.csv": scorecard.comparison(printed, seeds, scorecard.summary(seeds), names, trajectories),
        "tables/claims.csv": claims.verdicts(claims.load_claims(params_root), values),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Say how many verdicts of a report come out as it has them, and which do not; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m helpers verdicts", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=PROJECT / "reports/reference", help="of a report")
    folder = parser.parse_args(arguments).folder
    agree = True
    try:
        for name, table in recomputed(folder, PROJECT / "params").items():
            stored = pd.read_csv(folder / name, keep_default_na=False)
            pair = [frame.set_index(KEYS[name])["verdict"] for frame in (table, stored)]
            both = pd.concat(pair, axis=1, keys=["recomputed", "stored"])
            other = both[both["recomputed"] != both["stored"]]
            print(f"{folder / name}: {len(both) - len(other)} of {len(both)} verdicts come out as they stand there")
            if len(other):
                print(other.to_string())
            agree &= other.empty
    except (OSError, InputError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if agree else 1
