"""Which modules stand behind a notebook, against what Python itself imports."""

import ast
import json
import subprocess
import sys

import nbformat
import pytest

from helpers import sources

IMPORTS = """
import sys
{code}
print("\\n".join(sorted(name for name in sys.modules if name.startswith("helpers."))))
"""


def import_statements(notebook):
    """The import statements in the cells of a notebook, as they stand there."""
    cells = nbformat.read(sources.PROJECT / f"notebooks/{notebook}.ipynb", as_version=4).cells
    nodes = [node for cell in cells if cell.cell_type == "code" for node in ast.walk(ast.parse(cell.source))]
    return "\n".join(ast.unparse(node) for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom)))


@pytest.mark.parametrize(
    ("notebook", "among"), [("02_offline_irl", {"drawings"}), pytest.param("05_report", {"collection"}, marks=pytest.mark.torture)]
)
def test_every_module_that_python_imports_is_found(notebook, among):
    code = IMPORTS.format(code=import_statements(notebook))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = {name.removeprefix("helpers.") for name in run.stdout.split()}
    assert {"params", "session"} | among < imported
    assert imported <= {path.stem for path in sources.modules_behind(notebook)}


def test_a_stage_does_not_depend_on_what_only_the_report_needs():
    assert "report" not in {path.stem for path in sources.modules_behind("02_offline_irl")}


def test_imports_inside_functions_and_of_the_package_count():
    code = "import helpers.lstm\ndef verb():\n    from helpers import policy\n    from helpers.task import ControlTask\n"
    assert sorted(sources._imported(code)) == ["lstm", "policy", "task"]


@pytest.fixture
def project(tmp_path):
    """A project of one notebook, a module behind it and one that is not."""
    for folder in ("src/helpers", "notebooks"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "src/helpers/idle.py").write_text("y = 1\n")

    def write(verb="x = 1\n", cell="from helpers import verb, nothing\n", seed="seed = 0"):
        cells = [
            {"cell_type": "code", "source": [source], "outputs": [], "metadata": {"tags": tags}}
            for source, tags in ((seed, ["parameters"]), (cell, []))
        ]
        (tmp_path / "notebooks/01.ipynb").write_text(json.dumps({"cells": cells}), encoding="utf-8")
        (tmp_path / "src/helpers/verb.py").write_text(verb, encoding="utf-8")
        return sources.code_behind("01", tmp_path)

    return write


def test_the_code_behind_a_notebook_is_named_and_hashed_without_comments_and_parameters(project):
    first = project()
    assert sorted(first) == ["notebooks/01.ipynb", "src/helpers/verb.py"]
    assert project("x = 1  # one\n\n", seed="seed = 1") == first
    assert project("x = 2\n") == first | {"src/helpers/verb.py": project("x = 2\n")["src/helpers/verb.py"]} != first
    assert project(cell="from helpers import verb\nverb.x\n")["src/helpers/verb.py"] == first["src/helpers/verb.py"]
    assert project(cell="from helpers import verb\nverb.x\n") != first
