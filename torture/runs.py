"""Smoke runs in a copy of the project: how they are started, what they made, and whether anything was left behind."""

import base64
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from helpers.runs.artifacts import RECORD, load_stage
from helpers.runs.sources import PROJECT

PARTS = ("Snakefile", "rules", "params", "profiles", "src/helpers", "notebooks", "reports/template")
HIDDEN_BUT_KEPT = (".changed",)

Content = dict[str, tuple[Mapping[str, str], Mapping[str, str], str]]  # stage: hashes of its files, its upstream, its identity


@dataclass(frozen=True)
class Place:
    """A copy of the project to run in, where the results go, and what is to be made (all, or some results)."""

    project: Path
    seeds: int = 1
    targets: tuple[str, ...] = ()
    profile: str = "profiles/local"

    @classmethod
    def copied(cls, folder: Path, **settings: Any) -> "Place":
        """A copy of the project's code and parameters in `folder`."""
        for part in PARTS:
            source = PROJECT / part
            if source.is_dir():
                shutil.copytree(source, folder / part, ignore=shutil.ignore_patterns("__pycache__", ".ipynb_checkpoints", "inputs"))
            else:
                folder.mkdir(parents=True, exist_ok=True)
                shutil.copy(source, folder / part)
        return cls(folder, **settings)

    @property
    def results(self) -> Path:
        """Where the stages of all seeds lie."""
        return self.project / "results/smoke"

    def start(self, prefix: Sequence[str] = (), output: Any = subprocess.DEVNULL, **environment: str) -> subprocess.Popen[bytes]:
        """Start or resume the run as `make smoke` does, in a session of its own; `prefix` comes before the command."""
        config = [f"seeds={self.seeds}", "scale=smoke", "reports=results/smoke/report"]
        cores = ["--cores", "2"] if self.profile == "profiles/local" else []
        command = [sys.executable, "-m", "snakemake", "--profile", self.profile, *cores]
        one_thread = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"}
        paths = [str(self.project / "src"), environment.pop("PYTHONPATH", ""), os.environ.get("PYTHONPATH", "")]
        return subprocess.Popen(
            [*prefix, *command, "--config", *config, "--", *self.targets],
            cwd=self.project,
            env={**os.environ, **one_thread, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **environment},
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def clear(self) -> None:
        """Forget everything that was made."""
        for folder in ("results", ".snakemake"):
            shutil.rmtree(self.project / folder, ignore_errors=True)

    def content(self) -> Content:
        """What every stage holds; each file is checked against its hash.

        Raises:
            ArtifactError: if a stage is damaged.
        """
        found: Content = {}
        for path in sorted(self.results.rglob(RECORD)):
            stage = load_stage(path.parent, "this stage")
            place = path.parent.relative_to(self.results).as_posix()
            found[place] = (stage.record["files"], stage.record["upstream"], stage.record["identity"])
        return found

    def finished(self) -> dict[str, float]:
        """The stages that are finished, and the seconds in their records, which differ from run to run."""
        found = {}
        for path in self.results.rglob(RECORD):
            try:
                found[path.parent.relative_to(self.results).as_posix()] = json.loads(path.read_text(encoding="utf-8"))["seconds"]
            except (OSError, ValueError, KeyError):  # being replaced, or damaged
                continue
        return found

    def safe(self) -> dict[str, float]:
        """The finished stages that the engine knows to be finished: a resumed run has no reason to make them again."""
        begun = [base64.b64decode(path.name, b"-_").decode() for path in (self.project / ".snakemake/incomplete").glob("*")]
        return {name: seconds for name, seconds in self.finished().items() if f"results/smoke/{name}/{RECORD}" not in begun}

    def left_behind(self) -> list[str]:
        """Hidden files and folders among the results: of a finished run there should be none."""
        return sorted(
            path.relative_to(self.project).as_posix() for path in self.results.rglob(".*") if path.name not in HIDDEN_BUT_KEPT
        )
