"""Copy the last report to reports/reference, where it is committed: `python -m helpers.publish`."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from helpers.artifacts import code_revision
from helpers.session import PROJECT

LATEST, REFERENCE, RESULTS = PROJECT / "reports/latest", PROJECT / "reports/reference", PROJECT / "results"
PARTS = ("report.html", "figures", "tables", "comparison.csv", "seeds.csv", "provenance.json")


class PublishError(RuntimeError):
    """The last run may not become the reference; one sentence says why."""


def read_provenance(folder: Path) -> dict[str, Any]:
    """The provenance of a report."""
    path = folder / "provenance.json"
    if not path.is_file():
        raise PublishError(f"{path}: there is no report; run make reports first")
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def check(latest: dict[str, Any], reference: dict[str, Any] | None, revision: str) -> None:
    """Refuse what must not be published.

    Raises:
        PublishError: for a run at smoke scale, with uncommitted code, of another revision than the one checked out, or with
            fewer seeds than the published one.
    """
    if latest["scale"] != "paper":
        raise PublishError(f"reports/latest was run at {latest['scale']} scale; only paper scale is published")
    revisions = {latest["revision"], *latest["revisions_of_stages"], revision}
    if len(revisions) > 1 or not revision.isalnum() or revision == "unknown":
        raise PublishError(
            f"run and code must be one commit, found {', '.join(sorted(revisions))}; commit, run make reports again, then publish"
        )
    if reference is not None and len(latest["seeds"]) < len(reference["seeds"]):
        raise PublishError(f"the run has {len(latest['seeds'])} seeds, the published one {len(reference['seeds'])}")


def main() -> int:
    """Publish; returns the exit status."""
    try:
        latest = read_provenance(LATEST)
        reference = read_provenance(REFERENCE) if (REFERENCE / "provenance.json").is_file() else None
        check(latest, reference, code_revision(PROJECT))
    except PublishError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    partial = REFERENCE.with_name(".reference.partial")
    shutil.rmtree(partial, ignore_errors=True)
    for part in PARTS:
        copy = shutil.copytree if (LATEST / part).is_dir() else shutil.copy2
        partial.mkdir(parents=True, exist_ok=True)
        copy(LATEST / part, partial / part)
    (partial / "notebooks").mkdir()
    first = RESULTS / latest["scale"] / f"seed_{latest['seeds'][0]}"
    for path in sorted(first.glob("case_*/notebooks/*.ipynb")):
        case = path.parents[1].name
        shutil.copy2(path, partial / "notebooks" / f"{path.stem.removesuffix('_improved')}_{case}.ipynb")
    shutil.copy2(LATEST / "notebooks/05_report.ipynb", partial / "notebooks")
    shutil.rmtree(REFERENCE, ignore_errors=True)
    partial.rename(REFERENCE)
    print(f"published: {REFERENCE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
