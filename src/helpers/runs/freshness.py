"""Whether results on disk still are what the present parameters, code, packages and earlier results make."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from helpers.runs.artifacts import RECORD, ArtifactError, Stage
from helpers.runs.identity import UNKNOWN, changes, identity, inputs
from helpers.runs.sources import PROJECT
from helpers.settings.paper import HEADLINE

COMMITTED = PROJECT / "notebooks/inputs"  # made at another commit, on another machine: only their parameters are compared
MOST_NAMED = 5  # of the files in one sentence


def stale(stages: Sequence[Stage], folder: Path, params_root: Path) -> dict[Path, list[str]]:
    """What has changed since each of the stages was made, by folder; those made from what there is now are not among them.

    Args:
        folder: where the stages of all seeds of this scale lie.

    Raises:
        ArtifactError: for a result that does not say what made it.
    """
    committed = folder.parent.resolve() == COMMITTED.resolve()
    content = {stage.folder.relative_to(folder).as_posix(): stage.content for stage in stages}
    now: dict[tuple[str, int | None, str], dict[str, str]] = {}
    changed: dict[Path, list[str]] = {}
    for stage in stages:
        record, place = stage.record, stage.folder.relative_to(folder)
        run: dict[str, Any] = {name: record[name] for name in ("notebook", "case", "seed", "scale", "variant") if name in record}
        if "notebook" not in run:
            raise ArtifactError(f"{stage.folder / RECORD}: this result does not say what made it; run it again")
        key = run["notebook"], run.get("case"), run.get("variant", HEADLINE)
        if key not in now:
            now[key] = inputs(key[0], params_root, folder.name, key[1], key[2])
        found = changes(record, now[key])
        if committed:
            found = [name for name in found if name.startswith(("params/", UNKNOWN))]
        upstream = {name: content.get(f"{place.parts[0]}/{name}", read) for name, read in record.get("upstream", {}).items()}
        found += [f"{place.parts[0]}/{name}" for name, read in upstream.items() if record["upstream"][name] != read]
        if not found and not committed and record.get("identity") != identity(run, now[key], upstream):
            found = ["the record itself"]
        if found:
            changed[stage.folder] = found
    return changed


def refuse(changed: Mapping[Path, list[str]]) -> None:
    """Refuse a mixture: every one of these stages must be made again.

    Raises:
        ArtifactError: in one sentence, which names the files that do not fit, and what has changed since they were made.
    """
    alike: dict[str, list[str]] = {}
    for folder, names in changed.items():
        alike.setdefault(_some(names), []).append(str(folder / RECORD))
    if alike:
        parts = [f"{_some(files)} (changed: {names})" for names, files in alike.items()]
        raise ArtifactError(f"{'; '.join(parts)}: made from other inputs than there are now; run them again, or remove them")


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more
