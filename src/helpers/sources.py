"""What a notebook's result is made from: the notebook, the modules behind it and the parameter files. Light to import."""

import ast
import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
PROJECT = PACKAGE.parents[1]


def notebook_path(notebook: str) -> Path:
    """Where a notebook of this name lies."""
    return PROJECT / "notebooks" / f"{notebook}.ipynb"


def modules_behind(notebook: str) -> list[Path]:
    """Every module of this package that a notebook imports, by itself or through another one, in alphabetical order.

    Imports inside functions count: they run too.
    """
    found: set[Path] = set()
    waiting = list(_imported(_code(notebook)))
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported(path.read_text(encoding="utf-8"))
    return sorted(found)


def fingerprint(notebook: str) -> str:
    """A hash of the code behind a notebook's results: its own and that of its modules. Comments and layout do not count."""
    codes = [_code(notebook), *(path.read_text(encoding="utf-8") for path in modules_behind(notebook))]
    return hashlib.sha256("\n".join(ast.dump(ast.parse(code)) for code in codes).encode()).hexdigest()


def _code(notebook: str) -> str:
    cells = json.loads(notebook_path(notebook).read_text(encoding="utf-8"))["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@cache
def _imported(code: str) -> tuple[Path, ...]:
    """The modules of this package that a piece of code names in its import statements."""
    return tuple(path for name in _import_names(code) if (path := PACKAGE / f"{name}.py").is_file())


def _import_names(code: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == PACKAGE.name and len(parts) > 1:
                yield parts[1]
