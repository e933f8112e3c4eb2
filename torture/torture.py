"""Kill, crowd and feed nonsense: `python -m torture.torture --help`; `make torture` runs it and writes a report."""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from helpers.report.tables import to_markdown
from helpers.runs.artifacts import code_revision
from helpers.runs.sources import PROJECT
from torture.kernels import Parallel, side_by_side
from torture.kills import Tally, survive, undisturbed
from torture.runs import Place

# Three stages after one another, the last of them with two results, and two beside them.
CHAIN = tuple(
    f"results/smoke/seed_0/case_{place}/record.json" for place in ("3/online_improved", "2/demonstrations", "1/offline_printed")
)
REPORT = PROJECT / "reports/reference/reliability.md"
WHOLE = "The smoke run of three case studies"
PART = "A smoke run of notebooks 01, 02 and 04 (six stages)"
PROPERTIES = PROJECT / "tests/project/test_properties.py"
TITLES = {
    "lost": "finished results damaged, gone or made again after a kill",
    "ending": "results made again because their stage was just ending",
    "differing": "results that differ from the undisturbed run",
    "left": "files left among the results",
    "seconds": "seconds of the undisturbed run",
}


def say(text: str) -> None:
    """A line of progress."""
    print(text, flush=True)


def progress(tally: Tally) -> None:
    """A line after every tenth kill."""
    if (number := sum(tally.kills.values())) % 10 == 0:
        found = f"lost {tally.lost}, differing {tally.differing}, files left {tally.left}"
        say(f"{number} kills, {tally.rounds} runs ended: {found}")


def killed_runs(kills: int, seed: int, whole: bool) -> Tally:
    """A smoke run (`whole`: with everything up to the report), killed and resumed."""
    with tempfile.TemporaryDirectory() as folder:
        place = Place.copied(Path(folder) / "project", targets=() if whole else CHAIN)
        expected, seconds = undisturbed(place)
        say(f"undisturbed: {len(expected)} results in {seconds:.0f} s")
        return survive(place, expected, seconds, kills, seed, progress)


def mutated_input(cases: int) -> tuple[int, float, bool]:
    """So many mutated files and tables for the loaders: how many were tried, the seconds, and whether all ended as they should."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--hypothesis-show-statistics", str(PROPERTIES)]
    began = time.perf_counter()
    done = subprocess.run(
        command, env={**os.environ, "CASES": str(cases)}, cwd=PROJECT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        say(done.stdout[-6000:])
    tried = sum(int(number) for number in re.findall(r"(\d+) passing\b", done.stdout))
    return tried, time.perf_counter() - began, done.returncode == 0


def written(
    kills: Tally | None, parallel: Parallel | None, mutated: tuple[int, float, bool] | None, load: float, whole: bool
) -> str:
    """The report, as Markdown."""
    text = ["# Reliability", f"Written by `make torture` at `{code_revision(PROJECT)}`, load average at the start {load:.1f}."]
    if kills is not None:
        rows = {TITLES.get(name, name): f"{value:.0f}" for name, value in kills.row().items()}
        text += [
            "## Killed and resumed",
            f"{WHOLE if whole else PART}, killed by signal 9 at random moments and resumed by the same command.",
            to_markdown(pd.DataFrame({"what": rows.keys(), "number": rows.values()})),
            "Where a stage was just ending at the moment of the kill, the engine had not noted that it was done, and made it"
            " again: the same to the last bit.",
        ]
    if parallel is not None:
        text += [
            "## Notebooks side by side",
            f"{parallel.at_once} at once on {os.cpu_count()} cores, {parallel.rounds} rounds: {parallel.run} run,"
            f" {len(parallel.lost)} lost, {parallel.seconds:.0f} s.",
        ]
    if mutated is not None:
        tried, seconds, passed = mutated
        words = "each ended in a correct load or in one sentence that names the file" if passed else "NOT all ended as they should"
        text += [
            "## Mutated input",
            f"{tried} mutated parameter files, artifacts and demonstration tables: {words} ({seconds:.0f} s).",
        ]
    return "\n\n".join(text) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m torture.torture", description="Do to the project what it must survive.")
    parser.add_argument("--kills", type=int, default=100, help="kills of a smoke run (default 100; 0: none)")
    parser.add_argument("--whole", action="store_true", help="kill the whole smoke run, which takes three times as long")
    parser.add_argument("--at-once", type=int, default=8, help="notebooks side by side (default 8)")
    parser.add_argument("--rounds", type=int, default=50, help="how often (default 50; 0: never)")
    parser.add_argument("--cases", type=int, default=5000, help="mutated files and tables (default 5000; 0: none)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills (default 0)")
    parser.add_argument("--output", type=Path, default=REPORT, help=f"the report (default {REPORT.relative_to(PROJECT)})")
    given = parser.parse_args(arguments)
    load = os.getloadavg()[0]
    kills = killed_runs(given.kills, given.seed, given.whole) if given.kills else None
    parallel = side_by_side(given.at_once, given.rounds) if given.rounds else None
    mutated = mutated_input(given.cases) if given.cases else None
    text = written(kills, parallel, mutated, load, given.whole)
    given.output.parent.mkdir(parents=True, exist_ok=True)
    given.output.write_text(text, encoding="utf-8")
    say(text)
    survived = (kills is None or kills.clean) and not (parallel and parallel.lost) and (mutated is None or mutated[2])
    return 0 if survived else 1


if __name__ == "__main__":
    sys.exit(main())
