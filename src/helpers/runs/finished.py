"""Trainings that need not be repeated: what each one of a run gave is kept on disk until the run's results are written.

A state is a nested structure of dictionaries, lists, numbers, texts and tensors; torch reads it back without executing code. A file
belongs to one training: its name and content hold a hash of all that the training starts from. That of another training, or of
other code, is never taken for it.
"""

import hashlib
import io
import shutil
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from helpers.runs.scratch import beside, sweep

State = dict[str, Any]


@dataclass(frozen=True)
class Finished:
    """The trainings that a run of a notebook has finished, in a hidden folder beside its results.

    An interrupted run so loses no more than the training that it was in.

    Attributes:
        identity: hash of what the run is made from.
    """

    folder: Path
    identity: str

    def once(self, train: Callable[[], State], *start: Any) -> State:
        """What the training that starts from these objects gives: as an interrupted run has left it, or computed now and kept.

        Args:
            start: tensors, or what has a complete `repr`.
        """
        content = hashlib.sha256(self.identity.encode())
        for part in start:
            content.update(part.detach().numpy().tobytes() if isinstance(part, Tensor) else repr(part).encode())
        training = content.hexdigest()
        path = self.folder / f"{training[:16]}.pt"
        if (state := _read(path, training)) is None:
            state = train()
            _write(path, training, state)
        return state

    def remove(self) -> None:
        """Remove them all: the results are written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _read(path: Path, training: str) -> State | None:
    """The state in a file; None where there is none, or none of this training."""
    try:
        kept = torch.load(path, weights_only=True)
        return dict(kept["state"]) if kept["training"] == training else None
    except Exception:  # missing or damaged, for which torch has many kinds of errors: the training is repeated
        return None


def _write(path: Path, training: str, state: State) -> None:
    """Keep a state. On a full disk the run goes on: it only saves time."""
    content, partial = io.BytesIO(), beside(path)
    torch.save({"training": training, "state": state}, content)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path)
        partial.write_bytes(content.getvalue())
        partial.replace(path)
    except OSError as error:
        warnings.warn(f"{path}: a finished training could not be kept: {error.strerror}", stacklevel=2)
        with suppress(OSError):
            partial.unlink()
