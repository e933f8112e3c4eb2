"""Whether results on disk still are what the present parameters, code, packages and earlier results make."""

from collections.abc import Sequence
from pathlib import Path

from helpers.artifacts import RECORD, ArtifactError, Stage
from helpers.identity import changes, inputs
from helpers.sources import PROJECT

COMMITTED = PROJECT / "notebooks/inputs"  # made at another commit, on another machine: only their parameters are compared
MOST_NAMED = 5  # of the files in one sentence


def check(stages: Sequence[Stage], folder: Path, params_root: Path) -> None:
    """Refuse a mixture: every stage must be made from the parameters, the code, the packages and the earlier results of now.

    Args:
        folder: where the stages of all seeds of this scale lie.

    Raises:
        ArtifactError: in one sentence, which names the files that do not fit, and what has changed since they were made.
    """
    committed = folder.parent.resolve() == COMMITTED.resolve()
    now: dict[tuple[str, int | None, str], dict[str, str]] = {}
    content = {stage.folder.relative_to(folder).as_posix(): stage.content for stage in stages}
    stale: dict[str, list[str]] = {}
    for stage in stages:
        record, place = stage.record, stage.folder.relative_to(folder)
        key = record.get("notebook", ""), record.get("case"), record.get("variant", "improved")
        if not key[0]:
            raise ArtifactError(f"{stage.folder / RECORD}: this result does not say what made it; run it again")
        if key not in now:
            now[key] = inputs(key[0], params_root, folder.name, key[1], key[2])
        found = changes(record, now[key])
        if committed:
            found = [name for name in found if name.startswith("params/")]
        for name, read in record.get("upstream", {}).items():
            source = (Path(place.parts[0]) / name).as_posix()
            if content.get(source, read) != read:
                found.append(source)
        if found:
            stale.setdefault(", ".join(found), []).append(str(stage.folder / RECORD))
    if stale:
        parts = [f"{_some(files)} (changed: {_some(names.split(', '))})" for names, files in stale.items()]
        raise ArtifactError(f"{'; '.join(parts)}: made from other inputs than there are now; run them again, or remove them")


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more
