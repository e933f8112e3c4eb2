"""What a notebook's result is made from: the notebook, the modules behind it and the parameter files. Light to import."""

import ast
import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
PACKAGE = "helpers"


def notebook_path(notebook: str, project: Path = PROJECT) -> Path:
    """Where a notebook of this name lies."""
    return project / "notebooks" / f"{notebook}.ipynb"


def modules_behind(notebook: str, project: Path = PROJECT) -> list[Path]:
    """Every module of this package that a notebook imports, by itself or through another one, in alphabetical order.

    Imports inside functions count: they run too.
    """
    package = project / "src" / PACKAGE
    found: set[Path] = set()
    waiting = [package / f"{name}.py" for name in _imported(_code(notebook, project))]
    while waiting:
        path = waiting.pop()
        if path not in found and path.is_file():
            found.add(path)
            waiting += [package / f"{name}.py" for name in _imported(path.read_text(encoding="utf-8"))]
    return sorted(found)


def code_behind(notebook: str, project: Path = PROJECT) -> dict[str, str]:
    """A hash of the code of a notebook and of each module behind it, by path.

    Comments and layout do not count, nor does the notebook's cell of parameters, whose values are another part of a run.
    """
    codes = {notebook_path(notebook, project): _code(notebook, project)}
    codes |= {path: path.read_text(encoding="utf-8") for path in modules_behind(notebook, project)}
    return {path.relative_to(project).as_posix(): _hash(code) for path, code in codes.items()}


@cache
def _hash(code: str) -> str:
    return hashlib.sha256(ast.dump(ast.parse(code)).encode()).hexdigest()


def _code(notebook: str, project: Path) -> str:
    cells = json.loads(notebook_path(notebook, project).read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code" and "parameters" not in cell["metadata"].get("tags", [])]
    return "\n".join("".join(cell["source"]) for cell in code)


@cache
def _imported(code: str) -> tuple[str, ...]:
    """What a piece of code names of this package in its import statements: modules, and names that may be none."""
    return tuple(_import_names(code))


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
            if parts[0] == PACKAGE and len(parts) > 1:
                yield parts[1]
