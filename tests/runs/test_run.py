"""One stage = one notebook: the command line, plain papermill, and the order of the stages in the Snakefile."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections import Counter
from functools import cache
from pathlib import Path

import nbformat
import pytest

from helpers.runs import identity, run
from helpers.runs.artifacts import load_stage
from helpers.runs.sources import PROJECT, code_behind
from torture.runs import Place

SLOW = pytest.mark.torture
SUMMARIES = {"smoke": "\n1 notebook(s) failed; ", "huge": "\nNo notebook failed, what went wrong stands above; "}
ADDED = ""  # in place of words to replace: a line at the beginning
WRONG_ARGUMENTS = {  # the notebook, the copy and parameters; those of a notebook by hand are in test_session.py
    "an unknown case": (["01_demonstrations", "copies/x.ipynb", "-p", "case", "9"], "case_9.yaml"),
    "a strange digit": (["01_demonstrations", "copies/x.ipynb", "-p", "seed", "²"], "'seed'"),
    "an unknown notebook": (["06_oracle", "copies/x.ipynb"], "06_oracle.ipynb"),
    "a notebook elsewhere": (["../notebooks/01_demonstrations", "copies/x.ipynb"], "there is no such notebook"),
    "a copy among the code": (["05_report", str(PROJECT / "results/../src/x.ipynb")], "'output'"),
    "results among the code": (["01_demonstrations", "x.ipynb", "-p", "output_root", str(PROJECT / "src")], "'output_root'"),
}


def everything_below(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def change(path, old, new):
    """Change a file in one place; the text before."""
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return text


@pytest.fixture
def here(monkeypatch, tmp_path):
    """A working directory that is not the project's, in which `run.main` may not leave its setting behind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TQDM_DISABLE", "1")
    monkeypatch.setenv("MPLBACKEND", "agg")
    return tmp_path


@pytest.fixture
def toy(monkeypatch, here):
    """Write a notebook of one cell, perhaps with others before it, in a folder that stands for the project's."""
    path = here / "notebooks/02_offline_irl.ipynb"
    path.parent.mkdir()
    monkeypatch.setattr(run, "NOTEBOOKS", path.parent)

    def write(code, *before):
        given = nbformat.v4.new_code_cell("case = 1", metadata={"tags": ["parameters"]})
        nbformat.write(nbformat.v4.new_notebook(cells=[*before, given, nbformat.v4.new_code_cell(code)]), path)
        return path

    return write


def test_a_warning_in_an_executed_copy_names_no_folder_of_the_machine(tmp_path):
    path = tmp_path / "copy.ipynb"
    text = f"{sysconfig.get_path('purelib')}/package/file.py:1: UserWarning: {PROJECT}/src/helpers/runs/run.py\n"
    cell = nbformat.v4.new_code_cell("warn()", outputs=[nbformat.v4.new_output("stream", name="stderr", text=text)])
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), path)
    run.strip_machine(path)
    said = nbformat.read(path, as_version=4).cells[0].outputs[0].text
    assert said == "package/file.py:1: UserWarning: src/helpers/runs/run.py\n"


def test_a_stage_starts_without_the_grammar_of_addresses_that_no_notebook_needs():
    command = "import sys, helpers.runs.run; print(sys.modules['rfc3987_syntax'])"  # a second of every stage
    assert subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True).stdout == "None\n"


def test_a_notebook_runs_from_any_directory_and_leaves_no_trace_of_the_machine(here, capfd):
    arguments = ["01_demonstrations", "copies/01.ipynb", "-p", "case", "2", "-p", "seed", "5", "-p", "scale", "smoke"]
    arguments += ["-p", "output_root", str(here / "out")]
    assert run.main(arguments) == 0
    assert capfd.readouterr().out.strip() == "done: 01_demonstrations case=2 seed=5 scale=smoke"
    stage = load_stage(here / "out/smoke/seed_5/case_2/demonstrations", "notebook 01")
    assert {"notebook": "01_demonstrations", "case": 2, "seed": 5, "scale": "smoke"}.items() <= stage.record.items()
    assert everything_below(here / "copies") == ["01.ipynb"]
    copy = nbformat.read("copies/01.ipynb", as_version=4)
    assert not {"papermill", "execution"} & {*copy.metadata, *(name for cell in copy.cells for name in cell.metadata)}
    assert all(cell.cell_type == "markdown" or cell.execution_count for cell in copy.cells)
    # Of an executed notebook all text; in its pictures the names would only match by accident.
    text = re.sub(r'"image/png": "[^"]*"', "", Path("copies/01.ipynb").read_text(encoding="utf-8"))
    assert [place for place in (here, PROJECT, Path.home(), "ipykernel") if f"{place}/" in text] == []


@pytest.mark.parametrize(("arguments", "says"), WRONG_ARGUMENTS.values(), ids=WRONG_ARGUMENTS)
def test_wrong_arguments_end_at_once_with_nothing_run_and_nothing_written(monkeypatch, here, capfd, arguments, says):
    monkeypatch.setattr(run.papermill, "execute_notebook", lambda *_, **__: pytest.fail("the notebook was run"))
    assert run.main(arguments) == 2
    assert re.fullmatch(f"error: .*{re.escape(says)}.*\n", capfd.readouterr().err)
    assert everything_below(here) == []


def test_roots_are_those_of_the_callers_directory(monkeypatch, here):
    """The kernel works elsewhere; a folder may also be named like a number."""
    handed = {}
    monkeypatch.setattr(run.papermill, "execute_notebook", lambda *_, parameters, **__: handed.update(parameters))
    shutil.copytree(PROJECT / "params", here / "2024")
    roots = [["params_root", "2024"], ["output_root", "out"], ["input_root", str(here / "in")]]
    assert run.main(["01_demonstrations", "x.ipynb", *(word for root in roots for word in ("-p", *root))]) == 0
    assert handed == {name: str(here / Path(folder).name) for name, folder in roots}


def test_a_damaged_parameter_file_is_marked_for_the_summary_and_the_older_copy_stays(monkeypatch, here, capfd):
    monkeypatch.setattr(run.papermill, "execute_notebook", lambda *_, **__: None)
    params = shutil.copytree(PROJECT / "params", here / "params") / "process.yaml"
    good = change(params, ADDED, "extra: 1\n")
    (here / "01.ipynb").write_text("an older run")
    arguments = ["01_demonstrations", "01.ipynb", "-p", "case", "2", "-p", "params_root", "params"]
    assert run.main(arguments) == 2
    said = (here / "01.failed").read_text()
    assert said.startswith(f"01_demonstrations case=2: {params}: ")
    assert capfd.readouterr().err == f"error: {said}"
    assert (here / "01.ipynb").read_text() == "an older run"
    params.write_text(good, encoding="utf-8")
    assert run.main(arguments) == 0
    assert not (here / "01.failed").exists()


def test_a_notebook_that_raises_keeps_its_traceback_in_place_of_an_older_copy_and_a_kernel_that_dies_is_told(here, toy, capfd):
    toy("good = 1\nbad = good / 0")
    (here / "02.ipynb").write_text("an older run")
    assert run.main(["02_offline_irl", "02.ipynb"]) == 1
    said = capfd.readouterr().err.splitlines()[-1]
    assert said == f"error: {(here / '02.failed').read_text().strip()}"
    assert "02_offline_irl: ZeroDivisionError: division by zero (executed copy with the traceback: 02.ipynb)" in said
    (error,) = [output for cell in nbformat.read("02.ipynb", 4).cells for output in cell.get("outputs", [])]
    traceback = re.sub(r"\x1b\[[\d;]*m", "", "\n".join(error.traceback))
    assert "----> 2 bad = good / 0" in traceback
    toy("import os\nos._exit(1)")
    assert run.main(["02_offline_irl", "02.ipynb"]) == 1
    assert "error: 02_offline_irl: the kernel died" in capfd.readouterr().err
    assert everything_below(here) == ["02.failed", "02.ipynb", "notebooks", "notebooks/02_offline_irl.ipynb"]
    toy("good = 1")
    assert run.main(["02_offline_irl", "02.ipynb"]) == 0
    assert everything_below(here) == ["02.ipynb", "notebooks", "notebooks/02_offline_irl.ipynb"]


@pytest.mark.torture
def test_plain_papermill_refuses_a_misspelt_parameter(here):
    """papermill itself only warns; the notebook's first cell ends the run."""
    given = ["-p", "case", "1", "-p", "sed", "3", "-p", "output_root", str(here / "out")]
    command = [sys.executable, "-m", "papermill", PROJECT / "notebooks/01_demonstrations.ipynb", "01.ipynb", *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "notebooks/01_demonstrations.ipynb: there is no parameter 'sed'; the parameters are case, seed" in done.stderr
    assert everything_below(here) == ["01.ipynb"]


@pytest.fixture
def source(tmp_path):
    """A copy of what results are made from and of what plans them, to be changed."""
    return Place.copied(tmp_path / "copy").project


@pytest.fixture
def plan(source):
    """The jobs that the Snakefile would run in that copy, by rule."""

    def dry_run(*targets, **config):
        settings = [f"{name}={value}" for name, value in ({"scale": "smoke", "reports": "report"} | config).items()]
        snakemake = [sys.executable, "-m", "snakemake", "-n", "--profile", "profiles/local", "--cores", "1", "--nolock"]
        command = [*snakemake, "--config", *settings, "--", *targets]
        done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        counts = re.findall(r"^(\w+) +(\d+)$", done.stdout + done.stderr, re.MULTILINE)
        return {rule: int(count) for rule, count in counts if rule not in ("all", "total")}

    return dry_run


@pytest.fixture
def finished(plan, source):
    """The same after a finished run, whose results were made from what the copy holds."""
    shutil.copytree(PROJECT / "notebooks/inputs", source / "results")
    (source / "report").mkdir()
    for path in (source / "results").rglob("record.json"):
        record = json.loads(path.read_text(encoding="utf-8"))
        run = [record[name] for name in ("notebook", "scale", "case", "variant")]
        record["inputs"] = identity.inputs(run[0], source / "params", *run[1:], source)
        path.write_text(json.dumps(record), encoding="utf-8")
    made_from = identity.inputs("05_report", source / "params", "smoke", project=source)
    (source / "report/provenance.json").write_text(json.dumps({"inputs": made_from}), encoding="utf-8")
    (source / "report/report.html").touch()
    in_order = ["*", "record.json", "offline_*/record.json", "transfer_*/record.json", "online_*/record.json", "report/*.*"]
    for time, pattern in enumerate(in_order, 1000):  # as stages finish one after the other, then the report
        for path in source.rglob(pattern):
            os.utime(path, (time, time))
    return plan


IMPROVED_AND_PRINTED = [(1, "improved"), (1, "printed"), (2, "improved"), (2, "printed"), (3, "improved")]
RESULTS = {  # by rule of the Snakefile: the notebook, case and variant of each of its results
    "demonstrations": [("01_demonstrations", case, "improved") for case in (1, 2, 3)],
    "offline": [("02_offline_irl", *run) for run in IMPROVED_AND_PRINTED],
    "online": [("03_online_improvement", case, "improved") for case in (1, 2)],
    "transfer": [("04_knowledge_transfer", 3, "improved")],
    "transfer_alone": [("04_knowledge_transfer", 3, "printed")],
    "report": [("05_report", None, "improved")],
}
ONE_SEED = {rule: len(results) for rule, results in RESULTS.items()}
LEARNT = {rule: number for rule, number in ONE_SEED.items() if rule != "report"}
ONLINE = {rule: number for rule, number in ONE_SEED.items() if rule not in ("demonstrations", "offline")}
STAGE = "results/smoke/seed_0/case_{}/{}/record.json"
NEEDED = [
    ([], 1, ONE_SEED),
    ([STAGE.format(3, "transfer_printed")], 1, {"demonstrations": 2, "offline": 1, "transfer_alone": 1}),
    pytest.param([], 2, {rule: 2 * number for rule, number in LEARNT.items()} | {"report": 1}, marks=SLOW),
    pytest.param([STAGE.format(2, "demonstrations")], 1, {"demonstrations": 1}, marks=SLOW),
    pytest.param([STAGE.format(2, "online_improved")], 1, {"demonstrations": 1, "offline": 1, "online": 1}, marks=SLOW),
    pytest.param([STAGE.format(3, "online_improved")], 1, {"demonstrations": 2, "offline": 1, "transfer": 1}, marks=SLOW),
]
NAMES = ["all", "transfer alone", "two seeds", "recording", "online", "transfer"]


@pytest.mark.parametrize(("targets", "n_seeds", "jobs"), NEEDED, ids=NAMES)
def test_a_run_needs_each_stage_of_each_seed_and_a_stage_alone_only_what_it_reads(plan, targets, n_seeds, jobs):
    assert plan(*targets, seeds=n_seeds) == jobs


@pytest.mark.torture
def test_finished_stages_are_skipped_and_what_is_damaged_or_gone_is_made_again(finished, source):
    assert finished() == {}
    record = source / STAGE.format(2, "online_improved")
    record.write_text("{")
    assert finished() == {"online": 1, "report": 1}
    record.unlink()
    (source / "report/report.html").unlink()
    assert finished() == {"online": 1, "report": 1}
    assert finished(missing=1) == {"report": 1}  # of the seeds that are whole, only when asked


EDITS = [
    ("params/case_2.yaml", "250", "249", {"demonstrations": 1, "offline": 2, "online": 1, "report": 1}),
    ("params/case_3.yaml", "_start: {value: 0.", "_start: {value: 0.1", {"transfer_alone": 1, "report": 1}),
    ("params/learning.yaml", "std_high: {value: 0.25", "std_high: {value: 0.3", ONLINE),
    ("params/learning.yaml", "episodes: {value: 400", "episodes: {value: 300", {"report": 1}),  # of another scale
    ("params/published.yaml", "21.63", "21.64", {"report": 1}),
    ("notebooks/02_offline_irl.ipynb", '"seed = 0 ', '"seed = 1 ', {}),  # in the cell of parameters
    ("notebooks/04_knowledge_transfer.ipynb", "offline_response = ", "response_before = ", {"transfer": 1, "transfer_alone": 1}),
    ("src/helpers/learning/algorithm_2.py", ADDED, "# a comment\n", {}),
    ("src/helpers/learning/algorithm_2.py", '"""Algorithm 2', '"""The algorithm 2', {}),  # a docstring
    ("src/helpers/evidence/mpc.py", ADDED, "x = 1\n", {}),  # behind none of these notebooks
    ("src/helpers/report/tables.py", "def ", "def _(): ...\n\n\ndef ", {"report": 1}),
    ("reports/template/report.md.jinja", "# The reproduction", "# A reproduction", {}),  # Snakemake looks at it by itself
    ("src/helpers/learning/algorithm_2.py", "return project(self.mean)", "return project(self.mean.clone())", LEARNT),
    ("src/helpers/report/report.py", "RUNNERS = (", "RUNNERS = (*(),", {"report": 1}),
    ("src/helpers/report/figures.py", "MUTED = ", "MUTED: str = ", {"report": 1}),
]
RUN_AGAIN = [
    EDITS[0],
    pytest.param("src/helpers/learning/algorithm_2.py", "(self.mean)", "(+self.mean)", ONE_SEED, marks=SLOW),
    pytest.param("reports/template/report.md.jinja", "# The reproduction", "# A reproduction", {"report": 1}, marks=SLOW),
]


def test_a_change_makes_exactly_the_results_stale_that_are_made_from_it(monkeypatch, source):
    monkeypatch.setattr(identity, "versions", dict)  # which stay; to ask for them takes its time

    def made_from():
        monkeypatch.setattr(identity, "code_behind", cache(code_behind))
        results = [(rule, *run) for rule, runs in RESULTS.items() for run in runs]
        return {(rule, *run): identity.inputs(run[0], source / "params", "smoke", *run[1:], source) for rule, *run in results}

    before = made_from()
    for changed, old, new, stale in EDITS:
        text = change(source / changed, old, new)
        after = made_from()
        assert Counter(result[0] for result in before if after[result] != before[result]) == stale, (changed, new)
        (source / changed).write_text(text, encoding="utf-8")


@pytest.mark.parametrize(("changed", "old", "new", "jobs"), RUN_AGAIN)
def test_what_is_stale_is_run_again_with_all_that_read_it(finished, source, changed, old, new, jobs):
    before = change(source / changed, old, new)
    assert finished() == jobs
    (source / changed).write_text(before, encoding="utf-8")
    if not changed.startswith("reports/template"):  # of which Snakemake looks at the time
        assert finished() == {}  # whatever the times of the files


@pytest.mark.torture
def test_what_make_bench_wrote_last_goes_into_the_report_and_results_that_were_removed_are_made_again(finished, source):
    folder = source / "reports/reference/benchmarks"
    folder.mkdir(parents=True)
    for name in ("summary.md", "machine.md", "scaling.svg"):
        (folder / name).touch()
        assert finished() == {"report": 1}
        os.utime(folder / name, (1000, 1000))
        assert finished() == {}
    shutil.rmtree(source / "results")
    change(source / "src/helpers/report/report.py", "RUNNERS = (", "RUNNERS = (*(),")
    assert finished() == ONE_SEED  # whatever else has changed


@pytest.mark.torture
@pytest.mark.parametrize(("scale", "says"), SUMMARIES.items())
def test_the_summary_tells_what_was_refused_before_it_ran(plan, source, scale, says):
    """In a parameter file, or in the command."""
    if scale == "smoke":
        change(source / "params/case_2.yaml", ADDED, "extra: 1\n")
    command = [sys.executable, "-m", "snakemake", "--profile", "profiles/local", "--cores", "1", "--config", f"scale={scale}"]
    target = f"results/{scale}/seed_0/case_2/demonstrations/record.json"
    environment = {**os.environ, "PYTHONPATH": str(source / "src")}
    done = subprocess.run([*command, "--", target], cwd=source, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert says in done.stderr
    said = done.stderr[done.stderr.index(says) :]
    assert ("case_2.yaml: " in said) is (scale == "smoke")
