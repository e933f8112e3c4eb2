"""What a run is asked for: the names and values that a notebook may be given. Light to import, for command lines."""

import ast
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from helpers.runs.sources import PROJECT, notebook_path
from helpers.settings.leaf import LESSON, InputError
from helpers.settings.paper import Params, load

NOTEBOOK_PARAMETERS = {
    "case": int,
    "seed": int,
    "seeds": int,
    "missing": int,
    "scale": str,
    "variant": str,
    "input_root": str,
    "output_root": str,
    "params_root": str,
}
TAUGHT = ("01", "02", "03", "04", "10")  # the notebooks that have a lesson
WRITABLE, COMMITTED = ("results", "reports"), ("reports/template", "reports/reference")


class SessionError(InputError):
    """A notebook was given a parameter it does not have, or a value it cannot use."""


def parameter_names(notebook: str) -> list[str]:
    """The names in a notebook's own parameters cell: not every notebook takes every parameter."""
    cells = json.loads(notebook_path(notebook).read_text(encoding="utf-8"))["cells"]
    source = next("".join(cell["source"]) for cell in cells if "parameters" in cell["metadata"].get("tags", []))
    return [
        node.targets[0].id
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    ]


def check_parameters(notebook: str, given: Mapping[str, Any]) -> Params:
    """The parameter files' records for what a notebook was given; what is not given has the notebook's default.

    Raises:
        SessionError, ParameterError: in one sentence, if a name is unknown or a value cannot be used.
    """
    where = f"notebooks/{notebook}.ipynb"
    names = parameter_names(notebook)
    for name in given:
        if name not in names:
            raise SessionError(f"{where}: there is no parameter '{name}'; the parameters are {', '.join(names)}")
    for name, kind in NOTEBOOK_PARAMETERS.items():
        if name in given and type(given[name]) is not kind:
            words = "a whole number" if kind is int else "a text"
            raise SessionError(f"{where}: parameter '{name}': expected {words}, found {given[name]!r}")
    for name, least in (("seed", 0), ("seeds", 1), ("missing", 0)):
        if given.get(name, least) < least:
            raise SessionError(f"{where}: parameter '{name}': expected {least} or more, found {given[name]}")
    check_place("output_root", Path(given.get("output_root") or PROJECT / "results"))
    params = load(Path(given.get("params_root") or PROJECT / "params").resolve(), given.get("case", 1))
    variants = [name for name in params.learning.variants if name not in params.trials]
    scales = [name for name in params.learning.scales if name != LESSON or notebook.startswith(TAUGHT)]
    for name, known, shown in (
        ("scale", scales, scales),
        ("variant", params.learning.variants, [*variants, "a trial of params/trials.yaml"] if params.trials else variants),
    ):
        if name in given and given[name] not in known:
            raise SessionError(f"{where}: parameter '{name}': expected one of {', '.join(shown)}, found '{given[name]}'")
    return params


def check_place(name: str, place: Path) -> None:
    """Refuse a place inside the project that is not among results and reports: no run may write over what it is made of.

    Nor does it write into the committed part of the reports, where people do, and make publish, bench and torture. Links and dots
    are resolved first.
    """
    found = place.resolve()
    inside = [folder for folder in (".", *WRITABLE, *COMMITTED) if found.is_relative_to(PROJECT / folder)]
    if inside and inside[-1] not in WRITABLE:
        where, never = (" and ".join(f"{folder}/" for folder in folders) for folders in (WRITABLE, COMMITTED))
        raise SessionError(f"parameter '{name}': inside the project results go below {where} but not into {never}, not to {found}")
