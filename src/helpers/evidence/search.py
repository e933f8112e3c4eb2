"""The search for the printed algorithms' best settings, and the sample of weights: `python -m helpers search`.

A run of its own: it takes hours, goes on where it was stopped, and writes reports/reference/search, which the report shows.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch

from helpers.evidence.printed_search import Search
from helpers.evidence.weights_set import sampled
from helpers.runs.artifacts import code_revision, save_stage
from helpers.runs.identity import versions
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import InputError
from helpers.settings.paper import load_published

PARAMS = PROJECT / "params"
DECIMALS = 6


def search(scale: str, cases: Sequence[int], results: Path) -> None:
    """Search all cases given; with all of them done, write trials and weights."""
    torch.set_num_threads(1)
    kept, published = Search(PARAMS, scale, results / scale / ".search"), load_published(PARAMS)
    best: dict[int, int] = {}
    trials, weights = [], []
    for case in sorted(cases):
        best[case], table = kept.run(case, best)
        trials.append(table)
        weights.append(sampled(kept, case))
    if set(cases) < set(published):
        return
    tables = {"trials.csv": pd.concat(trials), "weights.csv": pd.concat(weights)}
    folder = PROJECT / "reports/reference/search" if scale == "paper" else results / scale / "search"
    short = {name: table.round(DECIMALS).astype(object) for name, table in tables.items()}  # as they are, and not with 17 digits
    save_stage(folder, {"revision": code_revision(PROJECT), "versions": versions()}, short)
    print(f"written: {folder}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m helpers search", description=__doc__)
    parser.add_argument("cases", nargs="*", type=int, help="all, unless given; a case that starts from another one needs that too")
    parser.add_argument("--scale", default="paper", choices=("paper", "smoke"))
    given = parser.parse_args(arguments)
    try:
        search(given.scale, given.cases or sorted(load_published(PARAMS)), PROJECT / "results")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
