"""Run the notebooks at their defaults and store the outputs in them: `python -m helpers refresh`.

The committed notebooks are the smoke run on the small inputs in notebooks/inputs. Those are made first, by the smoke run.
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


def make_inputs() -> None:
    """Run all stages at smoke scale into a fresh folder and put what they wrote into notebooks/inputs."""
    with tempfile.TemporaryDirectory() as folder:
        config = ["seeds=1", "scale=smoke", f"results={folder}/results", f"reports={folder}/report"]
        snakemake = [sys.executable, "-m", "snakemake", "--profile", "profiles/local", "--cores", str(os.cpu_count()), "--nolock"]
        more = f"{folder}/results/smoke/seed_0/case_1/one_policy/record.json"  # notebook 06 reads it
        subprocess.run([*snakemake, "--config", *config, "--", "all", more], cwd=PROJECT, check=True)
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
