"""Run the notebooks at their defaults and store the outputs in them: `python -m helpers refresh`.

The committed notebooks are the lesson (01 to 04 and 10) and the smoke run (the others), on the small inputs in notebooks/inputs.
Those are made first: all of the smoke run, and of the lesson what other notebooks read.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from helpers.runs.run import NOTEBOOKS, execute
from helpers.runs.sources import PROJECT

INPUTS = NOTEBOOKS / "inputs"
LESSON = ("case_1/online_improved", "case_2/online_improved", "case_3/demonstrations")  # and what they are made from


def make_inputs() -> None:
    """Run the stages at both scales into a fresh folder and put what they wrote into notebooks/inputs."""
    with tempfile.TemporaryDirectory() as folder:
        place = f"{folder}/results/{{}}/seed_0/{{}}/record.json"
        lesson = [place.format("lesson", stage) for stage in LESSON]
        for scale, targets in (("smoke", ["all", place.format("smoke", "case_1/one_policy")]), ("lesson", lesson)):  # 06 reads it
            config = ["seeds=1", f"scale={scale}", f"results={folder}/results", f"reports={folder}/report"]
            options = ["--profile", "profiles/local", "--cores", str(os.cpu_count()), "--nolock", "--config"]
            subprocess.run([sys.executable, "-m", "snakemake", *options, *config, "--", *targets], cwd=PROJECT, check=True)
        shutil.rmtree(INPUTS, ignore_errors=True)
        shutil.copytree(Path(folder) / "results", INPUTS, ignore=shutil.ignore_patterns("notebooks"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Refresh inputs and notebooks; returns the exit status."""
    argparse.ArgumentParser(prog="python -m helpers refresh", description=__doc__).parse_args(arguments)
    os.environ["TQDM_DISABLE"] = "1"
    os.environ.pop("MPLBACKEND", None)  # the kernel's own, which puts pictures into the notebook
    make_inputs()
    for path in sorted(NOTEBOOKS.glob("[0-9]*.ipynb")):
        with tempfile.TemporaryDirectory(prefix=".refresh_", dir=NOTEBOOKS) as folder:  # a run that fails leaves the notebook alone
            copy = Path(folder) / path.name
            execute(path.stem, copy, {})
            copy.replace(path)
        print(f"refreshed: {path.relative_to(PROJECT)}")
    return 0
