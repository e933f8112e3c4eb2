"""The notebooks as they are committed, and proof that their regression tests can fail."""

import ast
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch
from xml.etree import ElementTree as ET

import nbformat
import pytest

from helpers.runs.sources import PROJECT

NOTEBOOKS = {path.stem: path for path in sorted((PROJECT / "notebooks").glob("*.ipynb"))}
LONGEST = 80  # lines of code, without blank lines and comments
MACHINE = re.compile(r"(?<![\w.])/(home|root|tmp|work|Users|private|var)/|[A-Z]:\\\\|site-packages|ipykernel_\d")
LINK = re.compile(r"\[([^\]]+)\]\((?!https?:)([^)#]+)\)")
REFUSED = {
    "stripped": (lambda code: [cell.update(execution_count=None, outputs=[]) for cell in code], "not every code cell was executed"),
    "outputs only": (lambda code: [cell.update(outputs=[]) for cell in code], "fewer than"),
    "in another order": (lambda code: code[3].update(execution_count=5), "in order"),
}

_specification = importlib.util.spec_from_file_location("notebook_guard", PROJECT / "notebooks/conftest.py")
guard = importlib.util.module_from_spec(_specification)
with patch.dict(os.environ):  # the guard sets up the environment of the kernels; here it is only examined
    _specification.loader.exec_module(guard)
OUTPUT, LAYOUT = guard.Output, guard.Layout


@pytest.fixture(params=NOTEBOOKS)
def notebook(request):
    return nbformat.read(NOTEBOOKS[request.param], as_version=4)


def code_of(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_a_notebook_tells_a_story_defines_nothing_and_was_executed_whole(notebook):
    nbformat.validate(notebook)
    told, cells = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"], code_of(notebook)
    assert notebook.cells[0].source == told[0]
    assert told[0].startswith("# ")
    assert len(told) >= 3
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    code = [cell.source for cell in cells]
    lines = [line for source in code for line in source.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(lines) <= LONGEST
    nodes = [node for source in code for node in ast.walk(ast.parse(source))]
    assert not [node for node in nodes if isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.AsyncFunctionDef))]
    # papermill does not compute again what is derived from an injected value in the cell of the parameters.
    tagged = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert tagged == cells[:1]
    assert all(isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant) for node in ast.parse(code[0]).body)


def test_a_notebook_holds_nothing_of_the_machine_the_moment_or_the_tests(notebook):
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    for cell in notebook.cells:
        assert set(cell.metadata) <= {"tags", "jupyter"}  # the latter folds what few will read
        for output in cell.get("outputs", []):
            assert output.output_type in ("execute_result", "display_data"), "errors, warnings and printed text do not belong here"
            text = json.dumps({kind: data for kind, data in output.data.items() if not kind.startswith("image/png")})
            assert MACHINE.search(text) is None
            assert "widget" not in text
        assert MACHINE.search(cell.source) is None
        assert "drawn_summary" not in cell.source


def stored(name, words, row):
    """The numbers of a row of a table that a committed notebook shows in the cell whose code holds these words."""
    (cell,) = [cell for cell in code_of(nbformat.read(NOTEBOOKS[name], as_version=4)) if words in cell.source]
    (line,) = [line for line in cell.outputs[-1].data["text/plain"].splitlines() if line.strip().startswith(row)]
    return [float(number) for number in guard.NUMBER.findall(line.split(row, 1)[1])]


def test_the_committed_lesson_tells_the_papers_story():
    """Imitation comes near the expert, and improving on the process passes the PID; also after the transfer."""
    for name in ("02_offline_irl", "04_knowledge_transfer"):
        assert stored(name, "session.outcome(", "feature gap, %")[0] < 10
    for name in ("03_online_improvement", "04_knowledge_transfer"):
        pid, offline, online, online_on_y, best = stored(name, "tables.quality_table(", "$J$ on $x$ ")
        assert offline < pid < min(online, online_on_y)
        assert 0.97 * best < min(online, online_on_y)


def test_every_link_of_a_notebook_leads_somewhere(notebook):
    texts = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]
    if 'scale = "lesson"' in code_of(notebook)[0].source:  # of the others some were not part of the last published run
        texts += [output.data.get("text/markdown", "") for cell in code_of(notebook) for output in cell.outputs]
    targets = [target for text in texts for _, target in LINK.findall(text)]
    assert [target for target in targets if not (PROJECT / "notebooks" / target).exists()] == []


# Numbers may be 2e-6 off, not 1e-3; of the end of a search words and layout are compared.
SAME = {OUTPUT: [("gap 12.3456", "gap   12.3456\n"), ("gap 286.4421", "gap 286.4426"), ("1e-05", "0.00001"), ("0", "1e-12")]}
SAME |= {LAYOUT: [("loss 12.3456  yes", "loss 9.1  no"), ("loss nan", "loss 1.5")]}
OTHER = {OUTPUT: [("gap 286.4421", "gap 286.7285"), ("gap 1", "loss 1"), ("1 2 3", "1 2"), ("1 2", "2 1"), ("nan", "1.0")]}
OTHER |= {LAYOUT: [("loss 12.3456", "gap 12.3456"), ("loss 1 2 3", "loss 1 2")]}
OTHER[OUTPUT] += [("C_A0", "C_A1")]
COMPARED = [(kind, *pair, found is SAME) for found in (SAME, OTHER) for kind, pairs in found.items() for pair in pairs]


@pytest.mark.parametrize(("kind", "stored", "found", "same"), COMPARED)
def test_words_are_compared_exactly_and_numbers_within_the_tolerance(kind, stored, found, same):
    assert (kind(stored) == kind(found)) is same
    assert (kind(stored) != found) is not same


def test_only_the_notebook_of_searches_has_cells_of_which_the_numbers_are_not_compared(notebook):
    tagged = [cell for cell in code_of(notebook) if guard.SEARCH in cell.metadata.get("tags", [])]
    compared = [cell for cell in code_of(notebook) if cell.outputs and cell not in tagged]
    assert len(compared) >= guard.FEWEST_COMPARED
    if tagged:
        assert notebook.cells[0].source.startswith("# 00 Inferred settings")
        assert any("never worse than where it began" in cell.source for cell in code_of(notebook))


class Copy:
    """A copy of a notebook, to change, with its guard beside it; results go beside it too. Proof that the tests can fail."""

    def __init__(self, name, folder):
        shutil.copy(PROJECT / "notebooks/conftest.py", folder)
        self.path = Path(folder) / f"{name}.ipynb"
        self.content = nbformat.read(NOTEBOOKS[name], as_version=4)
        self.code = code_of(self.content)
        self.replace('output_root = ""', f"output_root = {str(folder)!r}")

    def replace(self, old, new):
        """Change a line of the parameters cell."""
        assert old in self.code[0].source
        self.code[0].source = self.code[0].source.replace(old, new)

    def cell(self, words):
        """The number and the content of the cell whose code holds these words."""
        (found,) = [(number, cell) for number, cell in enumerate(self.code) if words in cell.source]
        return found

    def shown(self, words, line):
        """Let a cell change what it shows by a line of code."""
        number, cell = self.cell(words)
        lines, last = cell.source.splitlines(), ast.parse(cell.source).body[-1].lineno - 1
        cell.source = "\n".join([*lines[:last], "shown = (", *lines[last:], ")", line, "shown"])
        return number

    def scale_stored(self, words, factor):
        """Multiply the last number with a fraction in the stored output of a cell, in text and HTML."""
        number, cell = self.cell(words)
        (output,) = cell.outputs
        for kind in ("text/plain", "text/html"):
            last = re.findall(r"-?\d+\.\d+", output.data[kind])[-1]
            assert float(last) != 0
            before, _, after = output.data[kind].rpartition(last)
            output.data[kind] = f"{before}{float(last) * factor:.9g}{after}"
        return number

    def run(self):
        """Exit status of nbval, the numbers of the cells that failed, and what it said."""
        nbformat.write(self.content, self.path)
        folder = self.path.parent
        options = ["-p", "helpers.runs.quick_start", "-p", "no:cacheprovider", "--rootdir", folder]
        options += ["--junitxml", folder / "result.xml", "--nbval", self.path]
        done = subprocess.run([sys.executable, "-m", "pytest", *options], cwd=folder, capture_output=True, text=True, check=False)
        cases = ET.parse(folder / "result.xml").getroot().iter("testcase")
        outcome = {int(case.get("name").removeprefix("Cell ")): case.find("failure") is not None for case in cases}
        assert list(outcome) in ([], list(range(len(self.code))))  # none if the guard refuses the notebook
        return done.returncode, [number for number, failed in outcome.items() if failed], done.stdout + done.stderr


def test_changed_numbers_fail_and_changed_style_and_last_digits_pass(tmp_path):
    """All in one run, for each cell is judged alone."""
    copy = Copy("10_sliders", tmp_path)
    wrong = copy.scale_stored("places = {", 1 + 1e-3)
    copy.scale_stored("target = ", 1 + 2e-6)
    copy.shown("elsewhere(session, target)", "_ = [line.set(color='k', linewidth=4) for axis in shown.axes for line in axis.lines]")
    louder = "shown.axes[0].lines[0].set_ydata(shown.axes[0].lines[0].get_ydata() * 1.001)"
    plotted = copy.shown('observation noise × 3"], ', louder)
    status, failed, said = copy.run()
    assert status == 1, said
    assert failed == [wrong, plotted], said


@pytest.mark.torture
def test_another_learning_rate_fails(tmp_path):
    path = shutil.copytree(PROJECT / "params", tmp_path / "params") / "learning.yaml"
    text, rate = path.read_text(encoding="utf-8"), "learning_rate_start: {value: 1.0e-2"
    assert rate in text
    path.write_text(text.replace(rate, "learning_rate_start: {value: 0.9e-2", 1), encoding="utf-8")
    copy = Copy("02_offline_irl", tmp_path)
    copy.replace('params_root = ""', f"params_root = {str(path.parent)!r}")
    learning, _ = copy.cell("algorithm_1(learner")
    status, failed, said = copy.run()
    assert status == 1, said
    assert failed[0] == learning, said
    assert len(failed) >= 5


@pytest.mark.parametrize(("change", "says"), REFUSED.values(), ids=REFUSED)
@pytest.mark.parametrize("run", [False, pytest.param(True, marks=pytest.mark.torture)], ids=["refused", "fails"])
def test_a_notebook_without_outputs_or_run_in_another_order_fails_instead_of_passing_unseen(tmp_path, change, says, run):
    copy = Copy("05_report", tmp_path)
    change(copy.code)
    if run:
        status, _, said = copy.run()
        assert status not in (0, 5)
        assert says in said
    else:
        nbformat.write(copy.content, copy.path)
        with pytest.raises(pytest.UsageError, match=says):
            guard.check_executed(copy.path)
