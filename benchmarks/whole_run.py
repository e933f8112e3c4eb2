"""The time of a whole run of one seed, stage by stage, with what a stage spends before and after its own work."""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pandas as pd
from jupyter_client.manager import start_new_kernel

from benchmarks.subjects import PROJECT

COLUMNS = ["stage", "case", "variant", "seconds", "work", "around"]
FIXED_COSTS = {  # what every stage pays: commands of one process each
    "start of Python": "pass",
    "import of the stage's command line": "import helpers.runs.run",
    "import of torch": "import torch",
    "import of the notebooks' modules": "import helpers.runs.session, helpers.runs.study, helpers.report.figures",
    "import of the report's modules": "import helpers.report.report",
}


class WholeRunError(RuntimeError):
    """The run did not finish; the message holds the end of what it said."""


def whole_run(scale: str, cores: int) -> pd.DataFrame:
    """Run one seed of all cases in a fresh folder and read back where the time went.

    Returns:
        A row for each stage in the order of its start: `seconds` from the start of its process to its end, `work` from the
        opening of the session in the notebook to its last result, `around` what is left, that is the starts of Python and
        of the kernel, imports, and writing the executed notebook. The report opens no such session. The last row is the
        whole run; with several cores it is shorter than the sum.

    Raises:
        WholeRunError: if a stage failed.
    """
    with tempfile.TemporaryDirectory(prefix="bench") as folder:
        root = Path(folder)
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(PROJECT / "Snakefile"), "--directory", folder]
        command += ["--profile", str(PROJECT / "profiles/local"), "--cores", str(cores)]
        command += ["--config", "seeds=1", f"scale={scale}", "results=results", "reports=reports"]
        started = time.perf_counter()
        done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - started
        if done.returncode:
            raise WholeRunError(f"the whole run failed:\n{(done.stdout + done.stderr)[-2000:]}")
        rows = stage_times(root)
    total: dict[str, Any] = {"stage": f"whole run, {cores} stage(s) at a time", "variant": "", "seconds": seconds}
    total |= {name: sum(row[name] for row in rows) for name in ("work", "around")}
    return pd.DataFrame([*rows, total], columns=COLUMNS).astype({"case": "Int64"})


def stage_times(root: Path) -> list[dict[str, Any]]:
    """A row for each stage that Snakemake's own records in a working directory tell of."""
    jobs: dict[str, dict[str, Any]] = {}
    for path in (root / ".snakemake/metadata").rglob("*"):
        if path.is_file():
            job = json.loads(path.read_text(encoding="utf-8"))
            jobs[job["log"][0]] = job  # a stage with two results has two records and one log
    rows = []
    for log, job in sorted(jobs.items(), key=lambda item: item[1]["starttime"]):
        number, _, rest = Path(log).stem.partition("_")
        name, variant = next(
            ((rest.removesuffix(f"_{word}"), word) for word in ("improved", "printed") if rest.endswith(word)), (rest, "")
        )
        case = Path(log).parents[1].name.removeprefix("case_")
        seconds = job["endtime"] - job["starttime"]
        records = [json.loads(path.read_text(encoding="utf-8")) for path in (root / log).parents[1].glob("*/record.json")]
        work = max((found["seconds"] for found in records if belongs(found, f"{number}_{name}", variant)), default=0.0)
        row: dict[str, Any] = {"stage": f"{number}_{name}", "case": int(case) if case.isdigit() else None, "variant": variant}
        rows.append(row | {"seconds": seconds, "work": work, "around": seconds - work})
    return rows


def belongs(record: dict[str, Any], notebook: str, variant: str) -> bool:
    """Whether a stage's record was written by this notebook in this variant."""
    return record["notebook"] == notebook and variant in ("", record["variant"])


def fixed_costs(rounds: int) -> pd.DataFrame:
    """What every stage pays before its work, in medians of several starts: columns as of `whole_run`."""
    rows = []
    for stage, code in FIXED_COSTS.items():
        seconds = [timed_process(code) for _ in range(rounds)]
        rows.append({"stage": stage, "seconds": statistics.median(seconds)})
    rows.append({"stage": "start of a kernel", "seconds": statistics.median(timed_kernel() for _ in range(rounds))})
    return pd.DataFrame(rows, columns=COLUMNS)


def timed_process(code: str) -> float:
    """Seconds of a Python process that runs this code and ends."""
    started = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - started


def timed_kernel() -> float:
    """Seconds until a fresh Jupyter kernel answers."""
    started = time.perf_counter()
    manager, client = start_new_kernel(stderr=subprocess.DEVNULL)
    seconds = time.perf_counter() - started
    client.stop_channels()
    manager.shutdown_kernel(now=True)
    return seconds
