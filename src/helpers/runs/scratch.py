"""Names for what is being written: a process writes beside its target and renames, and what killed ones left is swept away."""

import os
import platform
import shutil
from pathlib import Path

import psutil


def beside(path: Path) -> Path:
    """A hidden name of this process's own in the folder of `path`, on the same file system, from which it can be renamed."""
    return path.with_name(f"{_prefix(path)}{os.getpid()}{path.suffix}")


def sweep(path: Path) -> None:
    """Remove what processes of this machine that are no more left beside `path` under such names."""
    prefix = _prefix(path)
    if not path.parent.is_dir():
        return
    for left in path.parent.iterdir():
        process = left.name.removeprefix(prefix).removesuffix(path.suffix)
        if left.name.startswith(prefix) and process.isdecimal() and not psutil.pid_exists(int(process)):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)


def _prefix(path: Path) -> str:
    return f".{path.stem}.{platform.node()}."
