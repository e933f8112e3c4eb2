"""The identity of a result: a hash of what it is made from. Light to import, for command lines and the Snakefile.

What a result is made from are the values in its parameter files, the code of its notebook and of the modules behind it, the
versions of the packages that shape numbers, the results of earlier stages and the run's own parameters. A commit is not among
them: many commits make the same result, and uncommitted changes make another one.
"""

import hashlib
import json
import sys
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from helpers.runs.sources import PROJECT, REPORT, code_behind
from helpers.settings.leaf import LEAF_KEYS, read_yaml
from helpers.settings.paper import HEADLINE

PACKAGES = ("torch", "numpy", "scipy", "pandas", "cma", "safetensors", "sympy", "pydantic", "ruamel.yaml", "matplotlib", "seaborn")
DRAWING = ("matplotlib", "seaborn")  # they shape what the report shows and no result
UNREAD = {  # sections of learning.yaml
    "01_demonstrations": ("policy", "variants", "online"),
    "02_offline_irl": ("online",),
    "03_online_improvement": ("variants",),
}
OF_ALL_CASES = ("00_inferred_settings", "05_report", "09_one_policy")
MORE_FILES = {
    "00_inferred_settings": ("identification", "published"),
    "05_report": ("published", "claims", "trials"),
    "06_limits_and_alternatives": ("experiments", "limits", "one_policy", "published"),
    "07_your_own_process": ("nonlinear_tank", "own_plant"),
    "08_claims": ("experiments", "published"),
    "09_one_policy": ("limits", "one_policy", "published"),
}
UNKNOWN = "everything (an older kind of record)"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that shape the results."""
    return {"python": sys.version.split()[0], **{name: metadata.version(name) for name in PACKAGES}}


def digest(content: Any) -> str:
    """A hash of plain content; the order of keys does not count."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def inputs(
    notebook: str,
    params_root: Path,
    scale: str,
    case: int | None = None,
    variant: str = HEADLINE,
    project: Path = PROJECT,
) -> dict[str, str]:
    """What a notebook's results are made from beside earlier results: file or package, and its hash or version.

    Of the parameter files only the values count that a run of this scale, case and variant reads. `project` is the checkout.

    Raises:
        ParameterError: if a parameter file is missing or damaged.
    """
    found = versions() | code_behind(notebook, project)
    if notebook != REPORT:
        found = {name: what for name, what in found.items() if name not in DRAWING}
    for name in _files(notebook, params_root, case, variant):
        values = dict(_values(read_yaml(params_root / f"{name}.yaml")))
        if notebook not in OF_ALL_CASES:
            values = _read_by(notebook, name, values, params_root, scale, case, variant)
        elif notebook != REPORT and name.startswith("case_"):  # what learns there is of no variant
            values = {key: value for key, value in values.items() if not key.startswith("variants.")}
        found[f"params/{name}.yaml"] = digest(values)
    return found


def identity(run: Mapping[str, Any], made_from: Mapping[str, str], upstream: Mapping[str, str]) -> str:
    """The identity of a result: its run (notebook, seed, scale, case, variant), its `inputs` and the earlier results it read."""
    return digest([run, made_from, upstream])


def changes(record: Mapping[str, Any], made_from: Mapping[str, str]) -> list[str]:
    """What a result was made from that is otherwise now, by name; a record of an older kind has changed in everything."""
    before = record.get("inputs")
    if not isinstance(before, dict):
        return [UNKNOWN]
    return sorted(name for name in {*before, *made_from} if before.get(name) != made_from.get(name))


def _files(notebook: str, params_root: Path, case: int | None, variant: str) -> list[str]:
    """The parameter files that a notebook reads, without ending."""
    names = ["process", "demonstrators", "features", "learning", *MORE_FILES.get(notebook, ())]
    if notebook in OF_ALL_CASES:
        return [*names, *sorted(path.stem for path in params_root.glob("case_*.yaml"))]
    return [*names, f"case_{case}", *(["trials"] if _is_trial(params_root, variant) else [])]


def _is_trial(params_root: Path, variant: str) -> bool:
    return not any(key.startswith(f"variants.{variant}.") for key, _ in _values(read_yaml(params_root / "learning.yaml")))


def _read_by(
    notebook: str, name: str, values: Mapping[str, Any], params_root: Path, scale: str, case: int | None, variant: str
) -> dict[str, Any]:
    """The values of one file that a run reads: its own scale, variant and demonstrator, not those of others."""
    base = variant
    if _is_trial(params_root, variant):
        base = str(dict(_values(read_yaml(params_root / "trials.yaml"))).get(f"{variant}.base"))
    only = {"scales": scale, "variants": base} if name == "learning" or name.startswith("case_") else {}
    if name == "learning":
        values = {key: value for key, value in values.items() if key.split(".")[0] not in UNREAD.get(notebook, ())}
    elif name == "demonstrators":
        own = dict(_values(read_yaml(params_root / f"case_{case}.yaml"))).get("demonstrator")
        values = {key: value for key, value in values.items() if key.split(".")[0] == own}
    elif name == "trials":
        values = {key: value for key, value in values.items() if key.split(".")[0] == variant}
    parts = {key: key.split(".") for key in values}
    return {
        key: value
        for key, value in values.items()
        if (len(parts[key]) < 2 or only.get(parts[key][0], parts[key][1]) == parts[key][1])
    }


def _values(content: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of a parameter file by its key; of a leaf only the value, not its unit, source and status."""
    if isinstance(content, dict) and set(content) == set(LEAF_KEYS):
        yield key, content["value"]
    elif isinstance(content, dict):
        for name, entry in content.items():
            yield from _values(entry, f"{key}.{name}".strip("."))
    else:
        yield key, content
