"""What a notebook's result is made from: the notebook, the modules behind it and the parameter files. Light to import."""

import ast
import hashlib
import itertools
import json
from functools import cache
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[3]
PACKAGE = "helpers"
REPORT, SHOWN = "05_report", "helpers.report"
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def notebook_path(notebook: str, project: Path = PROJECT) -> Path:
    """Where a notebook of this name lies."""
    return project / "notebooks" / f"{notebook}.ipynb"


def modules_behind(notebook: str, project: Path = PROJECT) -> list[Path]:
    """Every module of this package that a notebook's results may depend on, in alphabetical order.

    That is what it imports, by itself or through another module; imports inside functions count, for they run too. What is shown
    changes no result: the room `report` counts for the report's own notebook alone.
    """
    source = project / "src"
    found: set[Path] = set()
    waiting = list(_imported(_code(notebook, project)))
    while waiting:
        name = waiting.pop()
        if name.startswith(SHOWN) and notebook != REPORT:
            continue
        path = source / f"{name.replace('.', '/')}.py"
        path = path if path.is_file() else path.with_suffix("") / "__init__.py"
        if path not in found and path.is_file():
            found.add(path)
            waiting += _imported(path.read_text(encoding="utf-8"))
    return sorted(found)


def code_behind(notebook: str, project: Path = PROJECT) -> dict[str, str]:
    """A hash of the code of a notebook and of each module behind it, by path.

    Comments, docstrings and layout do not count, nor does the notebook's cell of parameters, whose values are another part of a
    run.
    """
    codes = {notebook_path(notebook, project): _code(notebook, project)}
    codes |= {path: path.read_text(encoding="utf-8") for path in modules_behind(notebook, project)}
    return {path.relative_to(project).as_posix(): _hash(code) for path, code in codes.items()}


@cache
def _hash(code: str) -> str:
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _code(notebook: str, project: Path) -> str:
    cells = json.loads(notebook_path(notebook, project).read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code" and "parameters" not in cell["metadata"].get("tags", [])]
    return "\n".join("".join(cell["source"]) for cell in code)


@cache
def _imported(code: str) -> tuple[str, ...]:
    """What a piece of code names of this package in its import statements: rooms, modules, and names that may be none."""
    names: list[str] = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    own = [name.split(".") for name in names if name.split(".")[0] == PACKAGE]
    return tuple(path for parts in own for path in itertools.accumulate(parts, "{}.{}".format))  # the rooms on the way too
