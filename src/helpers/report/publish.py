"""Copy the last report to reports/reference, where it is committed: `python -m helpers publish`."""

import argparse
import json
import re
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from helpers.report.limits_figures import LABELS
from helpers.report.policies import write_policies
from helpers.report.tables import NOT_KNOWN, ROMAN, spread
from helpers.runs.artifacts import code_revision
from helpers.runs.sources import PROJECT

LATEST, REFERENCE, RESULTS = PROJECT / "reports/latest", PROJECT / "reports/reference", PROJECT / "results"
LIMITS = "tables/limits_gaps.csv"
SHOWN = ["expert", "online", "irl_reinforce", "scratch_reinforce", "ppo", "recurrent_ppo", "pid_tuned"]  # of README's gaps
SHOWN += ["one_policy", "mpc", "minimum_variance", "dynamic_programme_filtered"]
LEARNT, VARIANTS = re.compile(r"0[24]_(?:offline_irl|knowledge_transfer)_(\w+)"), ("improved", "printed")
LINK = re.compile(r"\]\((?:(\.\./)|(?=\d\d_\w+\.ipynb\)))")
GLANCE = {  # of tables/gaps.csv, and its headers in README
    "expert_error": "expert error",
    "published_gap": "feature gap, paper",
    "feature_gap": "feature gap, ours",
    "printed_gap": "the same, algorithms as printed",
    "online_share": "online objective, share of minimum variance",
}
ENDS = {"median": "", "ci_low": "_low", "ci_high": "_high"}
APART = ("benchmarks", "inferred_settings", "plants.csv", "plants.md", "reliability.md", "search")  # runs of their own, which stay
PARTS = ("report.html", "report.pdf", "report.md", "figures", "tables", "comparison.csv", "seeds.csv", "provenance.json")


class PublishError(RuntimeError):
    """The last run may not become the reference; one sentence says why."""


def read_provenance(folder: Path) -> dict[str, Any]:
    """The provenance of a report."""
    path = folder / "provenance.json"
    if not path.is_file():
        raise PublishError(f"{path}: there is no report; run make reports first")
    return dict(json.loads(path.read_text(encoding="utf-8")))


def check(latest: dict[str, Any], reference: dict[str, Any] | None, revision: str) -> None:
    """Refuse by PublishError a run at smoke scale, of uncommitted or other code, or with fewer seeds than published or asked for.

    A stage may be of an earlier commit: the report has made sure that nothing behind it has changed since.
    """
    if latest["scale"] != "paper":
        raise PublishError(f"reports/latest was run at {latest['scale']} scale; only paper scale is published")
    committed = all(name.isalnum() and name != "unknown" for name in (revision, *latest["revisions_of_stages"]))
    if latest["revision"] != revision or not committed:
        found = ", ".join(sorted({latest["revision"], *latest["revisions_of_stages"], revision}))
        raise PublishError(f"run and code must be committed alike, found {found}; commit, run make reports again, then publish")
    if missing := latest.get("missing_seeds"):
        raise PublishError(f"the run lacks the seeds {', '.join(map(str, missing))}; run make reports again")
    if reference is not None and len(latest["seeds"]) < len(reference["seeds"]):
        raise PublishError(f"the run has {len(latest['seeds'])} seeds, the published one {len(reference['seeds'])}")


def glance(gaps: pd.DataFrame) -> str:
    """README's comparison at a glance, as Markdown, from tables/gaps.csv: one row a case study."""
    rows = []
    for numbers in gaps.to_dict("records"):
        row = {"case study": ROMAN[int(numbers["case"]) - 1]}
        for name, header in GLANCE.items():  # in per cent, with the ends of the interval where there is one
            found = {key: 100 * numbers.get(name + end, float("nan")) for key, end in ENDS.items()}
            row[header] = spread(found, decimals=1, unit=" %")
        rows.append(row)
    n_seeds = int(gaps["n_seeds"].min())
    intervals = " and 95 % bootstrap intervals of the median" if gaps["feature_gap_low"].notna().all() else ""
    seeds = "one seed" if n_seeds == 1 else f"medians{intervals} over {n_seeds} seeds"
    return f"{pd.DataFrame(rows).to_markdown(index=False)}\n\n(ours: {seeds})"


def time_by_stage(time: pd.DataFrame) -> str:
    """README's seconds by stage and case, as Markdown, from tables/time.csv."""
    wide = time.pivot_table(index="stage", columns="case", values="seconds")
    wide.columns = [f"case {case}, s" for case in wide.columns]
    cells = wide.map(lambda seconds: NOT_KNOWN if pd.isna(seconds) else f"{seconds:.0f}").reset_index()
    return f"Seconds inside each stage's notebook, medians over seeds, two stages at a time:\n\n{cells.to_markdown(index=False)}"


def limits_at_a_glance(gaps: pd.DataFrame) -> str:
    """README's gaps to the optimum, as Markdown, from tables/limits_gaps.csv."""
    shown = gaps[gaps["controller"].isin([LABELS[name] for name in SHOWN])]
    headers = {case: f"case {case}, %" for case in gaps.columns[1:]}
    return str(shown.rename(columns=headers).to_markdown(index=False, disable_numparse=True))


def filled(paths: Iterable[Path], blocks: Mapping[str, str]) -> dict[Path, str]:
    """The pages, with the content of each block between its marks, wherever they stand."""
    pages = {path: path.read_text(encoding="utf-8") for path in paths}
    for block, content in blocks.items():
        between = re.compile(rf"(<!-- {block}:[^>]*-->\n).*?(?=<!-- /{block} -->)", re.DOTALL)
        found = [path for path, text in pages.items() if between.search(text)]
        if len(found) != 1:
            raise PublishError(f"README.md and docs: the marks of the block '{block}' must stand on one page, not on {len(found)}")
        head, mark, tail = between.split(pages[found[0]])
        pages[found[0]] = f"{head}{mark}{content}\n{tail}"
    return pages


def cost(time: pd.DataFrame, provenance: Mapping[str, Any]) -> str:
    """README's sentence on what the run has cost, from tables/time.csv and its provenance."""
    minutes, hours = time["seconds"].sum() / 60, provenance["stage_seconds"] / 3600
    return (
        f"On the machine of the published run, what `make reports` runs took {minutes:.1f} minutes of processor time,\n"
        f"and all that `make evidence` runs for {len(provenance['seeds'])} seeds {hours:.1f} hours. "
        "With two cores, two stages run at a time."
    )


def executed_copies(first: Path) -> dict[str, Path]:
    """The executed copies to publish, by their published names; `first` is the folder of the first seed's results.

    Those of the trials of offline learning stay behind: their numbers stand in a table of the report.
    """
    copies = {
        f"{path.stem.removesuffix('_improved')}_{path.parents[1].name}.ipynb": path
        for path in sorted(first.glob("case_*/notebooks/[!.]*.ipynb"))
        if not (found := LEARNT.fullmatch(path.stem)) or found[1] in VARIANTS
    }
    of_no_case = [LATEST / "notebooks/05_report.ipynb", *sorted((first / "notebooks").glob("[!.]*.ipynb"))]
    return copies | {path.name: path for path in of_no_case}


def executed_copy(text: str) -> str:
    """A notebook whose links lead from the folder of the executed copies to where they led from notebooks/.

    Of a table that is there as a page its plain twin is left out.
    """
    notebook = json.loads(LINK.sub(lambda found: "](../../../" if found[1] else "](../../../notebooks/", text))
    for output in (output for cell in notebook["cells"] for output in cell.get("outputs", [])):
        if "text/html" in output.get("data", {}):
            output["data"].pop("text/plain", None)
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


def publish() -> None:
    """Put the last run in the place of the reference and its numbers into README and docs; PublishError where that must not be."""
    latest = read_provenance(LATEST)
    reference = read_provenance(REFERENCE) if (REFERENCE / "provenance.json").is_file() else None
    check(latest, reference, code_revision(PROJECT))
    evidence = [name for name in ("tables/claims.csv", LIMITS) if (REFERENCE / name).exists()]
    if missing := [name for name in evidence if not (LATEST / name).exists()]:
        raise PublishError(f"{LATEST}: the run lacks {' and '.join(missing)}, which the published one has; run make evidence")
    first = RESULTS / latest["scale"] / f"seed_{latest['seeds'][0]}"
    copies = executed_copies(first)
    if failed := [path for path in copies.values() if path.with_suffix(".failed").exists()]:  # a mark beside a copy
        raise PublishError(f"{', '.join(map(str, failed))}: failed when it was run last; run make reports or make evidence again")
    time = pd.read_csv(LATEST / "tables/time.csv")
    blocks = {"glance": glance(pd.read_csv(LATEST / "tables/gaps.csv")), "cost": cost(time, latest), "time": time_by_stage(time)}
    if (LATEST / LIMITS).exists():
        blocks["limits"] = limits_at_a_glance(pd.read_csv(LATEST / LIMITS))
    pages = filled([PROJECT / "README.md", *sorted((PROJECT / "docs").glob("*.md"))], blocks)
    partial, old = _beside("partial"), _beside("old")
    write_policies(first, partial / "policies")
    for part in PARTS:
        _copy(LATEST / part, partial / part)
    for name, path in copies.items():
        target = partial / "notebooks" / name
        _copy(path, target)
        target.write_text(executed_copy(target.read_text(encoding="utf-8")), encoding="utf-8")
    if (first / "inferred_settings").is_dir():
        shutil.copytree(first / "inferred_settings", partial / "inferred_settings", ignore=shutil.ignore_patterns("*.png"))
    for part in APART:
        if (REFERENCE / part).exists() and not (partial / part).exists():
            _copy(REFERENCE / part, partial / part)
    if REFERENCE.exists():
        REFERENCE.rename(old)
    partial.rename(REFERENCE)
    for path, text in pages.items():
        path.write_text(text, encoding="utf-8")


def _beside(word: str) -> Path:
    """A hidden folder beside the reference, which git ignores."""
    return REFERENCE.with_name(f".reference.{word}")


def _copy(source: Path, target: Path) -> None:
    """Copy a file or a folder, with its times."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy2(source, target)


def _tidy() -> None:
    """Remove what a publish left half done; the old reference comes back where the new one did not take its place."""
    shutil.rmtree(_beside("partial"), ignore_errors=True)
    if _beside("old").is_dir() and not REFERENCE.exists():
        _beside("old").rename(REFERENCE)
    shutil.rmtree(_beside("old"), ignore_errors=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Publish; returns the exit status."""
    argparse.ArgumentParser(prog="python -m helpers publish", description=__doc__).parse_args(arguments)
    try:
        _tidy()  # after one that was killed
        try:
            publish()
        finally:
            _tidy()
    except PublishError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except shutil.Error as error:  # of a folder: source, target and reason of each file; the first will do
        source, _, why = error.args[0][0]
        print(f"error: {source}: could not be published: {why}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {error.filename or LATEST}: could not be published: {error.strerror or error}", file=sys.stderr)
        return 1
    print(f"published: {REFERENCE}")
    return 0
