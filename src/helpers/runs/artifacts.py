"""Results on disk: one folder a stage, written whole or not at all, checked when it is read."""

import hashlib
import json
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import nn

from helpers.learning.policy import LSTMPolicy
from helpers.plant.task import ControlTask, Trajectories
from helpers.runs.identity import digest
from helpers.runs.scratch import beside, sweep
from helpers.settings.leaf import InputError
from helpers.settings.paper import LearningParams

RECORD = "record.json"
FLOATS = "%.17g"  # enough digits to read back the very same number


class ArtifactError(InputError):
    """A result on disk is missing, damaged or of another shape; one sentence names it and what to do."""


@dataclass(frozen=True)
class Stage:
    """A finished stage on disk, every file checked against the hash in its record."""

    folder: Path
    record: dict[str, Any]

    @property
    def content(self) -> str:
        """A hash of all files of the stage, without its record."""
        return digest(self.record["files"])

    def path(self, name: str) -> Path:
        """The path of one of the stage's files."""
        if name not in self.record["files"]:
            raise ArtifactError(f"{self.folder / name}: the stage did not write this file; run it again")
        return self.folder / name

    def table(self, name: str, columns: tuple[str, ...] = ()) -> pd.DataFrame:
        """A CSV table of the stage, which must have at least these columns."""
        path = self.path(name)
        try:
            frame = pd.read_csv(path)
        except (OSError, OverflowError, ValueError) as error:  # pandas' own errors are kinds of the last
            raise ArtifactError(f"{path}: not a table: {' '.join(str(error).split())}; run the stage again") from error
        for column in columns:
            if column not in frame:
                raise ArtifactError(f"{path}: the column '{column}' is missing; run the stage again")
        return frame

    def policy(self, params: LearningParams, task: ControlTask) -> LSTMPolicy:
        """The stage's policy, in the number type of the task."""
        policy = LSTMPolicy(params.policy, len(task.set_point), len(task.input_low)).to(task.set_point.dtype)
        self.into(policy)
        return policy

    def into(self, policy: nn.Module) -> None:
        """Put the parameters of the stage's policy into a policy of its kind, without executing code."""
        path = self.path("policy.safetensors")
        expected = policy.state_dict()
        try:
            found = load_tensors(path.read_bytes())
        except (OSError, KeyError, SafetensorError) as error:  # KeyError: a number type that torch does not have
            raise ArtifactError(f"{path}: not a policy file: {error}") from error
        for name in sorted({*expected, *found}):
            shapes = [tuple(tensors[name].shape) if name in tensors else None for tensors in (found, expected)]
            if shapes[0] != shapes[1]:
                raise ArtifactError(
                    f"{path}: key '{name}': a policy of another shape, params/learning.yaml asks for {shapes[1]}, found {shapes[0]}"
                )
            if not found[name].isfinite().all():
                raise ArtifactError(f"{path}: key '{name}': expected finite numbers; run the stage again")
        policy.load_state_dict(found)  # in the number type of the policy


def save_stage(
    folder: Path,
    record: Mapping[str, Any],
    tables: Mapping[str, pd.DataFrame] | None = None,
    policy: nn.Module | None = None,
    figures: Mapping[str, Figure] | None = None,
) -> Stage:
    """Write a stage's results into `folder`, all of them or none, and return what was written.

    Everything is written beside it first; then each file takes the place of an older one, the record last, which gains the
    hash of each file. Whoever reads meanwhile, or after a kill in between, finds the older results, the new ones, or a record
    that does not fit its files, which `load_stage` refuses. Two processes that write the same results do not disturb each
    other: the notebook of a killed run may live on beside the resumed one.

    Args:
        tables: file names ending in .csv and their tables; `figures`: names without ending, written as SVG and PNG.
    """
    folder = folder.resolve()
    for name in (*(tables or {}), *(figures or {})):
        if Path(name).name != name or name == "..":
            raise ArtifactError(f"{folder}: the file name '{name}' leads out of the stage's folder")
    partial = beside(folder)
    try:
        sweep(folder)
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        for name, frame in (tables or {}).items():
            frame.to_csv(partial / name, index=False, float_format=FLOATS)
        if policy is not None:
            (partial / "policy.safetensors").write_bytes(save_tensors(policy.state_dict()))
        for name, figure in (figures or {}).items():
            figure.savefig(partial / f"{name}.svg", metadata={"Date": None})
            figure.savefig(partial / f"{name}.png")
        files = {path.name: _hash(path) for path in sorted(partial.iterdir())}
        sealed = json.dumps({**record, "files": files}, indent=1, sort_keys=True)
        (partial / RECORD).write_text(sealed + "\n", encoding="utf-8")
        folder.mkdir(exist_ok=True)
        for name in (*files, RECORD):
            (partial / name).replace(folder / name)
        for path in folder.iterdir():
            if path.name not in (*files, RECORD):
                path.unlink()
    except OSError as error:
        raise ArtifactError(f"{folder}: the results could not be written: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return load_stage(folder, "this stage")


def load_stage(folder: Path, made_by: str) -> Stage:
    """A finished stage, every file checked.

    Raises:
        ArtifactError: if the stage is missing or any of its files is missing or changed since it was written.
    """
    path = folder / RECORD
    if not path.is_file():
        raise ArtifactError(f"{path}: this result is missing; run {made_by} first")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        files = record["files"]
        whole = all(isinstance(expected, str) and Path(name).name == name for name, expected in files.items())
    except (AttributeError, KeyError, OSError, RecursionError, TypeError, ValueError) as error:
        raise ArtifactError(f"{path}: this result is damaged; run {made_by} again") from error
    if not whole:
        raise ArtifactError(f"{path}: key 'files': expected file names and their hashes; run {made_by} again")
    for name, expected in files.items():
        file = folder / name
        if not file.is_file():
            raise ArtifactError(f"{file}: this file is missing; run {made_by} again")
        try:
            found = _hash(file)
        except OSError as error:
            raise ArtifactError(f"{file}: this file cannot be read: {error.strerror}") from error
        if found != expected:
            raise ArtifactError(f"{file}: this file has changed since it was written; run {made_by} again")
    return Stage(folder, record)


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def trajectories_to_table(
    trajectories: Trajectories, controlled: tuple[str, ...], manipulated: tuple[str, ...], sampling_time: float
) -> pd.DataFrame:
    """One long table, a row for each trajectory and sample.

    Columns: trajectory, sample, time, then `x_<name>` and `y_<name>` of each controlled and `u_<name>` and
    `command_<name>` of each manipulated variable. The last sample of a trajectory has no input.
    """
    n_samples, n_trajectories = trajectories.x.shape[:2]
    sample = np.tile(np.arange(n_samples), n_trajectories)
    columns = {"trajectory": np.repeat(np.arange(n_trajectories), n_samples), "sample": sample, "time": sample * sampling_time}
    for prefix, names in _signals(controlled, manipulated).items():
        values = getattr(trajectories, prefix).double()
        padded = torch.cat([values, torch.full((n_samples - len(values), *values.shape[1:]), torch.nan, dtype=torch.float64)])
        columns |= {f"{prefix}_{name}": padded[..., index].T.flatten().numpy() for index, name in enumerate(names)}
    return pd.DataFrame(columns)


def _signals(controlled: tuple[str, ...], manipulated: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """The signals of a trajectory and the names of their variables."""
    return {"x": controlled, "y": controlled, "u": manipulated, "command": manipulated}


def trajectories_from_table(
    table: pd.DataFrame, controlled: tuple[str, ...], manipulated: tuple[str, ...], dtype: torch.dtype, path: Path
) -> Trajectories:
    """The trajectories of a long table; `path` is named in errors.

    Raises:
        ArtifactError: if a column is missing, the trajectories differ in length, or a number is not finite.
    """
    groups = _signals(controlled, manipulated)
    columns = ["trajectory", "sample", *(f"{prefix}_{name}" for prefix, names in groups.items() for name in names)]
    for column in columns:
        if column not in table:
            raise ArtifactError(f"{path}: the column '{column}' is missing")
    table = table[columns].apply(pd.to_numeric, errors="coerce")  # a word becomes nan
    ordered = table.sort_values(["trajectory", "sample"])
    n_trajectories = ordered["trajectory"].nunique()
    n_samples = len(ordered) // max(1, n_trajectories)
    expected = list(range(n_samples)) * n_trajectories
    if n_samples < 2 or ordered["sample"].tolist() != expected:
        raise ArtifactError(f"{path}: column 'sample': expected every trajectory to hold the samples 0 to {n_samples - 1} once")
    signals = {}
    for prefix, names in groups.items():
        columns = [f"{prefix}_{name}" for name in names]
        values = torch.tensor(ordered[columns].to_numpy(dtype=float)).reshape(n_trajectories, n_samples, len(names))
        values = values.transpose(0, 1)[: n_samples - (prefix in ("u", "command"))].to(dtype)
        if not torch.isfinite(values).all():
            raise ArtifactError(f"{path}: columns {', '.join(columns)}: expected finite numbers")
        signals[prefix] = values.contiguous()
    return Trajectories(**signals)


def code_revision(root: Path) -> str:
    """The commit of the code, with '+changes' if files differ from it; 'unknown' outside a checkout."""
    try:
        commit, changed = (
            subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain"])
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit + ("+changes" if changed else "")
