# A result says in its record.json what it was made from. Where that is otherwise now, the file CHANGED is among the inputs of
# its rule, and newer than the result; so what is run again does not depend on the times of files that git or an editor touched.
import json
import time
from collections import Counter
from functools import cache

from helpers.runs.identity import changes, inputs

CHANGED = f"{RESULTS}/{SCALE}/.changed"
AGAIN = {}  # the results to be made again, and what they were made from that has changed
if Path(CHANGED).parent.is_dir():
    Path(CHANGED).touch()  # before Snakemake looks into the folder, which it does only once


@cache
def present(notebook, case, variant):
    """What a result would be made from now."""
    return inputs(notebook, ROOT / "params", SCALE, case, variant, ROOT)


def made_from(notebook, record, case=None):
    """An input function: the file CHANGED where the result with this record was made from something else than there is now.

    `case`: whose parameters it reads, where no wildcard says so.
    """

    def changed(wildcards):
        path = Path(record.format(**dict(wildcards.items())))
        of_case, variant = getattr(wildcards, "case", case), getattr(wildcards, "variant", HEADLINE)
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return []
        except ValueError:
            before = {}  # damaged: made again
        if found := changes(before, present(notebook, int(of_case) if of_case else None, variant)):
            if not AGAIN:
                Path(CHANGED).parent.mkdir(parents=True, exist_ok=True)  # the results may have been removed
                Path(CHANGED).write_text(f"{time.time_ns()}\n", encoding="utf-8")
            AGAIN[str(path)] = (notebook, ", ".join(found[:3]) + (f" and {len(found) - 3} more" if len(found) > 3 else ""))
        return [CHANGED] if found else []

    return changed


def failures():
    """What every stage that failed said, by the place of its executed copy."""
    folders = [Path(RESULTS) / SCALE / f"seed_{seed}" for seed in SEEDS]
    paths = [path for folder in folders for path in sorted(folder.glob("**/notebooks/*.failed"))]
    return {str(path): path.read_text(encoding="utf-8").strip() for path in [*paths, *Path(REPORTS).glob("notebooks/*.failed")]}


onstart:
    for (notebook, why), number in Counter(AGAIN.values()).items():
        print(f"again: {notebook}, {number} result(s); changed: {why}", file=sys.stderr)


onerror:
    found = failures()
    what = f"{len(found)} notebook(s) failed" if found else "No notebook failed, what went wrong stands above"
    print(f"\n{what}; what is finished is kept and not run again.", file=sys.stderr)
    for sentence in found.values():
        print(f"  {sentence}", file=sys.stderr)
    if found:
        print("A report of the seeds that are whole: the same command with missing=1 (make reports MISSING=1).", file=sys.stderr)
