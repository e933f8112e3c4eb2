"""Notebooks side by side, more than there are cores: none may be lost to a race for ports, sockets or folders."""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

NOTEBOOK = "01_demonstrations"


@dataclass
class Parallel:
    """How many notebooks were run at once, in how many rounds, and what the lost ones said."""

    at_once: int
    rounds: int
    seconds: float = 0.0
    lost: list[str] = field(default_factory=list)

    @property
    def run(self) -> int:
        """How many notebooks were run."""
        return self.at_once * self.rounds


def side_by_side(at_once: int, rounds: int) -> Parallel:
    """Start `at_once` notebooks at the same moment, wait for all, and do so again, `rounds` times."""
    outcome, began = Parallel(at_once, rounds), time.perf_counter()
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            runs = [_start(Path(folder) / str(number), number, environment) for number in range(at_once)]
            said = [run.communicate()[0].decode() for run in runs]
            for number, (run, words) in enumerate(zip(runs, said, strict=True)):
                record = Path(folder) / f"{number}/smoke/seed_{number}/case_1/demonstrations/record.json"
                if run.returncode != 0 or not record.is_file():
                    outcome.lost.append(words.strip()[-400:])
    outcome.seconds = time.perf_counter() - began
    return outcome


def _start(folder: Path, seed: int, environment: dict[str, str]) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "helpers", "run", NOTEBOOK, str(folder / "01.ipynb"), "-p", "seed", str(seed)]
    command += ["-p", "scale", "smoke", "-p", "output_root", str(folder)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
