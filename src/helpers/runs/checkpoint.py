"""The state of an unfinished training on disk, so that it goes on after an interruption as if there had been none.

A state is a nested structure of dictionaries, lists, numbers, texts and tensors. The tensors go into a safetensors file and
the rest into its header as JSON, so that nothing that is read executes code. A checkpoint belongs to one training: its name
and its header hold a hash of all that the training starts from. That of another training, or of other code, is never read.
"""

import hashlib
import json
import math
import shutil
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from helpers.runs.scratch import beside, sweep

State = dict[str, Any]
TENSOR = "tensor:"  # marks, in the JSON, the place of a tensor


@dataclass
class Checkpoints:
    """The checkpoints of one run of a notebook, in a hidden folder beside its results.

    Attributes:
        identity: hash of what the run is made from.
        interval: seconds of computing before the first checkpoint, and between two of a training.
    """

    folder: Path
    identity: str
    interval: float
    started: float = field(default_factory=time.perf_counter)
    last: float = -math.inf  # when one was written

    def due(self, finished: bool) -> bool:
        """Whether it is time for one. The end of a training is always worth one, because the next training follows it."""
        now = time.perf_counter()
        return now - (self.started if finished else max(self.started, self.last)) >= self.interval

    def of(self, *start: Any) -> "Checkpoint":
        """The checkpoint of the training that starts from these objects: tensors, or what has a complete `repr`."""
        content = hashlib.sha256(self.identity.encode())
        for part in start:
            content.update(part.detach().numpy().tobytes() if isinstance(part, Tensor) else repr(part).encode())
        return Checkpoint(self, content.hexdigest())

    def remove(self) -> None:
        """Remove them all: the results are written."""
        shutil.rmtree(self.folder, ignore_errors=True)


@dataclass(frozen=True)
class Checkpoint:
    """One training's place on disk, see `Checkpoints.of`."""

    owner: Checkpoints
    training: str

    @property
    def path(self) -> Path:
        """The file."""
        return self.owner.folder / f"{self.training[:16]}.safetensors"

    def recall(self) -> State | None:
        """The last state kept; None where there is none, or none of this training."""
        try:
            with safe_open(self.path, "pt") as file:
                header = file.metadata() or {}
                if header.get("training") != self.training:
                    return None
                tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dictionary)
                state: State = _assemble(json.loads(header["state"]), tensors)
                return state
        except (OSError, SafetensorError, KeyError, ValueError):  # missing or damaged: the training starts anew
            return None

    def keep(self, state: Callable[[], State], finished: bool = False) -> None:
        """Write the state, if it is time. On a full disk the training goes on: a checkpoint only saves time."""
        if not self.owner.due(finished):
            return
        self.owner.last = time.perf_counter()
        tensors: dict[str, Tensor] = {}
        plain = json.dumps(_take_apart(state(), tensors))
        partial = beside(self.path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            sweep(self.path)
            partial.write_bytes(save(tensors, {"training": self.training, "state": plain}))
            partial.replace(self.path)
        except OSError as error:
            warnings.warn(f"{self.path}: no checkpoint could be written: {error.strerror}", stacklevel=2)
            with suppress(OSError):
                partial.unlink()


def _take_apart(value: Any, tensors: dict[str, Tensor]) -> Any:
    """The same structure with the name of a tensor in place of each, and the tensors by these names."""
    if isinstance(value, Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().clone().contiguous()
        return TENSOR + name
    if isinstance(value, dict):
        return {str(key): _take_apart(entry, tensors) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_take_apart(entry, tensors) for entry in value]
    return value


def _assemble(value: Any, tensors: dict[str, Tensor]) -> Any:
    """The inverse of `_take_apart`; tuples come back as lists."""
    if isinstance(value, str) and value.startswith(TENSOR):
        return tensors[value.removeprefix(TENSOR)]
    if isinstance(value, dict):
        return {key: _assemble(entry, tensors) for key, entry in value.items()}
    if isinstance(value, list):
        return [_assemble(entry, tensors) for entry in value]
    return value
