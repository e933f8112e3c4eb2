"""What may become the committed reference run, and what goes into it."""

import json
import re
import subprocess
from itertools import product
from pathlib import Path

import pytest

from helpers.report import publish
from helpers.report.publish import PublishError, check, executed_copy
from helpers.runs.sources import PROJECT

REVISION, OTHER = "0123abcd" * 5, "f" * 40
CHANGED = REVISION + "+changes"
GOOD = {"scale": "paper", "revision": REVISION, "revisions_of_stages": [REVISION], "seeds": [0, 1], "missing_seeds": []}
GOOD |= {"stage_seconds": 7200}
REFUSED = {
    "smoke scale": ({"scale": "smoke"}, None, REVISION, "smoke scale"),
    "fewer seeds": ({}, {"seeds": [0, 1, 2]}, REVISION, "2 seeds, the published one 3"),
    "changed code now": ({}, None, CHANGED, "commit"),
    "changed code then": ({"revision": CHANGED}, None, REVISION, "+changes"),
    "one stage of changed code": ({"revisions_of_stages": [REVISION, CHANGED]}, None, REVISION, "+changes"),
    "a report of another commit": ({"revision": OTHER}, None, REVISION, OTHER),
    "seeds that failed": ({"missing_seeds": [3, 7]}, None, REVISION, "lacks the seeds 3, 7"),
    "no checkout": ({"revision": "unknown", "revisions_of_stages": ["unknown"]}, None, "unknown", "unknown"),
}
README = "# Title\n<!-- glance: a -->\nold\n<!-- /glance -->\nmiddle\n<!-- cost: d -->\n<!-- /cost -->\n"
README += "<!-- limits: c -->\n<!-- /limits -->\nend\n"
RUNNING = "# Running it\n<!-- time: b -->\n<!-- /time -->\nend\n"
GAPS = """\
case,n_seeds,feature_gap,feature_gap_low,feature_gap_high,published_gap,expert_error,expert_error_low,expert_error_high,online_share,printed_gap
1,20,0.2,0.15,0.31,0.1,0.01,0.009,0.012,0.951,0.4
2,20,0.03,0.02,0.04,0.137,0.02,0.02,0.02,,
"""
COPY, LATEST = "results/paper/seed_0/case_1/notebooks/02_offline_irl_printed", "reports/latest"
NOWHERE = "nowhere"  # a link to it cannot be copied
FAULTS = {  # what is written, None for a file that is missing; the exit status, and what is said
    "no report": (f"{LATEST}/provenance.json", None, 2, "there is no report"),
    "smoke": (f"{LATEST}/provenance.json", json.dumps(GOOD | {"scale": "smoke"}), 2, "only paper scale is published"),
    "no marks in README": ("README.md", "no marks", 2, "the marks of the block 'glance' must stand on one page, not on 0"),
    "a failed copy": (f"{COPY}.failed", "ZeroDivisionError", 2, f"{COPY}.ipynb: failed when it was run last"),
    "a failed report": (f"{LATEST}/notebooks/05_report.failed", "x", 2, "05_report.ipynb: failed when it was run last"),
    "no claims": ("reports/reference/tables/claims.csv", "", 2, "lacks tables/claims.csv, which the published one has"),
    "no limits": ("reports/reference/tables/limits_gaps.csv", "", 2, "lacks tables/limits_gaps.csv, which the published one has"),
    "a dangling link": (f"{LATEST}/figures/gone.png", NOWHERE, 1, "figures/gone.png: could not be published: "),
    **{
        f"no {part}": (f"{LATEST}/{part}", None, 1, f"{LATEST}/{part}: could not be published: No such file")
        for part in ("figures", "seeds.csv", "tables/time.csv", "notebooks/05_report.ipynb")
    },
}


@pytest.mark.parametrize(("changes", "reference", "revision", "says"), REFUSED.values(), ids=REFUSED)
def test_only_a_clean_run_at_paper_scale_is_accepted(changes, reference, revision, says):
    check(GOOD, {"seeds": [0, 1]}, REVISION)
    with pytest.raises(PublishError, match=rf"\A.*{re.escape(says)}.*\Z"):  # in one line
        check(GOOD | changes, reference, revision)


@pytest.fixture
def project(monkeypatch, tmp_path):
    """A project with a finished run."""
    latest, results = tmp_path / "reports/latest", tmp_path / "results"
    parts = ("report.html", "report.pdf", "report.md", "figures/figure_3.png", "tables/table_2.csv", "comparison.csv")
    files = {part: part for part in parts} | {"tables/gaps.csv": GAPS, "provenance.json": json.dumps(GOOD)}
    files["tables/time.csv"] = "case,stage,seconds\n1,demonstrations,2.4\n2,demonstrations,3.6\n1,offline_improved,20.2\n"
    files["seeds.csv"] = "case,seed,stage,metric,value\n1,0,offline,feature_gap,0.2\n"
    copies = (  # also of a trial, of a killed run, and of another seed
        *("reports/latest/notebooks/05_report", "results/paper/seed_0/notebooks/07_your_own_process"),
        *(f"results/paper/seed_0/case_1/notebooks/02_offline_irl_{variant}" for variant in ("improved", "printed", "whole_return")),
        *(f"results/paper/seed_0/case_3/notebooks/{name}" for name in ("01_demonstrations", ".01_demonstrations.123")),
        "results/paper/seed_1/case_3/notebooks/01_demonstrations",
    )
    pages = {latest / name: text for name, text in files.items()}
    pages |= {tmp_path / f"{copy}.ipynb": json.dumps({"cells": [], "metadata": {"what": copy}}) for copy in copies}
    pages |= {tmp_path / "README.md": README, tmp_path / "docs/running.md": RUNNING}
    for path, text in pages.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    places = {"PROJECT": tmp_path, "LATEST": latest, "REFERENCE": tmp_path / "reports/reference", "RESULTS": results}
    for name, value in (places | {"code_revision": lambda _: REVISION}).items():
        monkeypatch.setattr(publish, name, value)
    return tmp_path


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_publishing_copies_the_report_and_the_first_seed_s_notebooks_and_writes_the_numbers_into_readme(project):
    old = project / "reports/reference/old.txt"
    old.parent.mkdir()
    old.write_text("of the run before")
    (old.parent / "reliability.md").write_text("of make torture")
    assert publish.main([]) == 0
    reference, latest = project / "reports/reference", project / "reports/latest"
    found, report = ({str(path.relative_to(of)) for path in of.rglob("*") if path.is_file()} for of in (reference, latest))
    copies = {"02_offline_irl_case_1", "02_offline_irl_printed_case_1", "01_demonstrations_case_3", "07_your_own_process"}
    assert found == {*report, *(f"notebooks/{name}.ipynb" for name in copies), "reliability.md"}
    copy = json.loads((reference / "notebooks/01_demonstrations_case_3.ipynb").read_text())
    assert copy["metadata"]["what"] == "results/paper/seed_0/case_3/notebooks/01_demonstrations"
    assert sorted(path.name for path in (project / "reports").iterdir()) == ["latest", "reference"]

    lines = (project / "README.md").read_text(encoding="utf-8").splitlines()
    first, second = (cells(line) for line in lines if line.startswith(("| I ", "| II ")))
    assert first == ["I", "1.0 % [0.9, 1.2]", "10.0 %", "20.0 % [15.0, 31.0]", "40.0 %", "95.1 %"]
    assert second == ["II", "2.0 %", "13.7 %", "3.0 % [2.0, 4.0]", "–", "–"]
    assert "(ours: medians and 95 % bootstrap intervals of the median over 20 seeds)" in lines
    assert "and all that `make evidence` runs for 2 seeds 2.0 hours. With two cores, two stages run at a time." in lines
    running = (project / "docs/running.md").read_text(encoding="utf-8").splitlines()
    assert any("offline_improved" in line and " 20 " in line for line in running)
    assert [line for line in lines if line in README.splitlines()] == README.replace("old\n", "").splitlines()


@pytest.fixture
def published(project):
    """The same with an older reference."""
    (project / "reports/reference/tables").mkdir(parents=True)
    (project / "reports/reference/provenance.json").write_text(json.dumps(GOOD | {"seeds": [0]}))
    return project


def content(project):
    return {path: path.read_bytes() for path in project.rglob("*") if path.is_file()}


def test_evidence_like_that_of_the_published_report_is_accepted_and_its_gaps_to_the_optimum_are_written(published):
    rows = ["controller,I,III", "PID (demonstrator),2.0,4.5", 'offset-free MPC,"6.0 [5.0, 7.0]",8.0', "programme on x,0.0,0.0"]
    for folder, table in product(("reference", "latest"), ("claims.csv", "limits_gaps.csv")):
        (published / "reports" / folder / "tables" / table).write_text("\n".join([*rows, ""]))
    assert publish.main([]) == 0
    lines = (published / "README.md").read_text(encoding="utf-8").splitlines()
    first = lines.index("<!-- limits: c -->") + 1
    names, _, *table = map(cells, lines[first : lines.index("<!-- /limits -->")])
    assert names == ["controller", "case I, %", "case III, %"]
    assert table == [["PID (demonstrator)", "2.0", "4.5"], ["offset-free MPC", "6.0 [5.0, 7.0]", "8.0"]]


def refused(capsys, status):
    """The one sentence with which publishing ends."""
    assert publish.main([]) == status
    said = capsys.readouterr().err
    assert re.fullmatch("error: .*\n", said)
    return said


@pytest.mark.parametrize(("path", "text", "status", "says"), FAULTS.values(), ids=FAULTS)
def test_a_run_that_is_refused_or_lacks_a_part_ends_in_a_sentence_and_changes_nothing(published, capsys, path, text, status, says):
    if text is None:
        (published / path).rename(published / "elsewhere")
    elif text == NOWHERE:
        (published / path).symlink_to(text)
    else:
        (published / path).write_text(text)
    before = content(published)
    assert says in refused(capsys, status)
    assert content(published) == before
    assert sorted(found.name for found in (published / "reports").iterdir()) == ["latest", "reference"]


@pytest.mark.parametrize("left", ["partial", "partial and reference aside", "reference aside, new one in place"])
def test_a_kill_at_any_moment_loses_no_reference(published, capsys, left):
    (published / "reports/latest/provenance.json").write_text(json.dumps(GOOD | {"scale": "smoke"}))  # so that nothing is published
    reports, expected = published / "reports", content(published)
    if "partial" in left:
        (reports / ".reference.partial").mkdir()
        (reports / ".reference.partial/report.html").touch()
    if left == "partial and reference aside":
        (reports / "reference").rename(reports / ".reference.old")
    elif left.startswith("reference"):
        (reports / ".reference.old").mkdir()
        (reports / ".reference.old/provenance.json").touch()
    refused(capsys, 2)
    assert content(published) == expected


def test_a_reference_that_cannot_be_replaced_stays(published, capsys, monkeypatch):
    before, rename = content(published), Path.rename

    def refusing(path, target):
        if path.name == ".reference.partial":
            raise OSError(28, "No space left on device", str(target))
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refusing)
    assert "No space left on device" in refused(capsys, 1)
    assert content(published) == before


def test_git_sees_nothing_of_what_a_kill_leaves_beside_the_reference():
    """Otherwise the code would count as changed, and every later publishing be refused."""
    left = [f"reports/.reference.{word}/report.html" for word in ("partial", "old")]
    ignored = subprocess.run(["git", "check-ignore", "--no-index", *left], cwd=PROJECT, capture_output=True, text=True, check=False)
    if ignored.returncode == 128:
        pytest.skip("no checkout")
    assert ignored.stdout.split() == left


LINKS = {"[code](../src/helpers/x.py)": "[code](../../../src/helpers/x.py)"}
LINKS |= {"[next](03_online_improvement.ipynb)": "[next](../../../notebooks/03_online_improvement.ipynb)"}
LINKS |= {"[paper](https://doi.org/10.1002/x)": "[paper](https://doi.org/10.1002/x)"}


@pytest.mark.parametrize(("link", "leads"), LINKS.items())
def test_an_executed_copy_leads_where_the_notebook_led_and_holds_a_table_once(link, leads):
    data = {"text/html": "<table>", "text/plain": "a table"}
    cells = [{"source": f"See {link}, and {link}."}, {"source": "", "outputs": [{"data": data}, {"data": {"text/plain": "7"}}]}]
    told, shown = json.loads(executed_copy(json.dumps({"cells": cells})))["cells"]
    assert told["source"] == f"See {leads}, and {leads}."
    assert [output["data"] for output in shown["outputs"]] == [{"text/html": "<table>"}, {"text/plain": "7"}]
