"""Which modules stand behind a notebook, against what Python itself imports."""

import ast
import json
import subprocess
import sys

import nbformat
import pytest

from helpers.runs import sources

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


def names_behind(notebook):
    """The dotted names of the modules behind a notebook."""
    paths = [path.relative_to(sources.PROJECT / "src").with_suffix("") for path in sources.modules_behind(notebook)]
    return {".".join(path.parts).removesuffix(".__init__") for path in paths}


@pytest.mark.parametrize(
    ("notebook", "among"),
    [
        ("02_offline_irl", {"helpers.learning.algorithm_2", "helpers.runs.session"}),
        pytest.param("05_report", {"helpers.report.collection"}, marks=pytest.mark.torture),
    ],
)
def test_every_module_that_python_imports_is_found_but_for_what_only_shows(notebook, among):
    code = IMPORTS.format(code=import_statements(notebook))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = set(run.stdout.split())
    assert {"helpers.settings.paper"} | among < imported
    shown = {name for name in imported if name.startswith("helpers.report")}
    assert shown
    assert imported - names_behind(notebook) == (set() if notebook == "05_report" else shown)


def test_only_the_report_depends_on_the_room_of_what_is_shown():
    behind = {path.stem: names_behind(path.stem) for path in (sources.PROJECT / "notebooks").glob("0*.ipynb")}
    assert [name for name, names in behind.items() if any(name.startswith("helpers.report") for name in names)] == ["05_report"]
    for name in ("helpers.learning", "helpers.learning.lstm", "helpers.plant.process", "helpers.settings.leaf"):
        assert all(name in names for notebook, names in behind.items() if notebook != "05_report"), name


def test_imports_inside_functions_and_of_the_package_count():
    code = (
        "import helpers.learning.lstm\ndef verb():\n    from helpers import quick\n    from helpers.plant.task import ControlTask\n"
    )
    expected = {"helpers", "helpers.learning", "helpers.learning.lstm", "helpers.quick"}
    expected |= {"helpers.plant", "helpers.plant.task", "helpers.plant.task.ControlTask"}
    assert set(sources._imported(code)) == expected


@pytest.fixture
def project(tmp_path):
    """A project of one notebook, a module behind it and one that is not."""
    for folder in ("src/helpers/room", "src/helpers/report", "notebooks"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "src/helpers/room/__init__.py").write_text('"""A room."""\n')
    (tmp_path / "src/helpers/room/idle.py").write_text("y = 1\n")
    (tmp_path / "src/helpers/report/figures.py").write_text("from helpers.room import idle\n")

    def write(verb="x = 1\n", cell="from helpers.room import verb, nothing\nfrom helpers.report import figures\n", seed="seed = 0"):
        cells = [
            {"cell_type": "code", "source": [source], "outputs": [], "metadata": {"tags": tags}}
            for source, tags in ((seed, ["parameters"]), (cell, []))
        ]
        (tmp_path / "notebooks/01.ipynb").write_text(json.dumps({"cells": cells}), encoding="utf-8")
        (tmp_path / "src/helpers/room/verb.py").write_text(verb, encoding="utf-8")
        return sources.code_behind("01", tmp_path)

    return write


def test_the_code_behind_a_notebook_is_named_and_hashed_without_comments_and_parameters(project):
    first = project()
    assert sorted(first) == ["notebooks/01.ipynb", "src/helpers/room/__init__.py", "src/helpers/room/verb.py"]
    assert project("x = 1  # one\n\n", seed="seed = 1") == first
    assert project('"""What it does."""\nx = 1\n') == first
    assert project("x = 2\n") == first | {"src/helpers/room/verb.py": project("x = 2\n")["src/helpers/room/verb.py"]} != first
    assert project(cell="from helpers.room import verb\nverb.x\n")["src/helpers/room/verb.py"] == first["src/helpers/room/verb.py"]
    assert project(cell="from helpers.room import verb\nverb.x\n") != first
