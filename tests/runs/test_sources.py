"""Which modules stand behind a notebook, against what Python itself imports."""

import ast
import subprocess
import sys

import nbformat
import pytest

from helpers.runs import sources

TELL = "\nimport sys\nprint(*(name for name in sys.modules if name.startswith('helpers.')))"
LEARNING, REPORT = {"helpers.learning.algorithm_2", "helpers.runs.session"}, {"helpers.report.collection"}
NOTEBOOKS = [("02_offline_irl", LEARNING), pytest.param("05_report", REPORT, marks=pytest.mark.torture)]


def import_statements(notebook):
    """The import statements in the cells of a notebook, as they stand there."""
    cells = nbformat.read(sources.PROJECT / f"notebooks/{notebook}.ipynb", as_version=4).cells
    nodes = [node for cell in cells if cell.cell_type == "code" for node in ast.walk(ast.parse(cell.source))]
    return "\n".join(ast.unparse(node) for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom)))


def names_behind(notebook):
    """The dotted names of the modules behind a notebook."""
    paths = [path.relative_to(sources.PROJECT / "src").with_suffix("") for path in sources.modules_behind(notebook)]
    return {".".join(path.parts).removesuffix(".__init__") for path in paths}


@pytest.mark.parametrize(("notebook", "among"), NOTEBOOKS)
def test_every_module_that_python_imports_is_found_but_for_what_only_shows(notebook, among):
    run = subprocess.run([sys.executable, "-c", import_statements(notebook) + TELL], capture_output=True, text=True, check=True)
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
    inside = "    from helpers import quick\n    from helpers.plant.task import ControlTask\n"
    expected = {"helpers", "helpers.learning", "helpers.learning.lstm", "helpers.quick"}
    expected |= {"helpers.plant", "helpers.plant.task", "helpers.plant.task.ControlTask"}
    assert set(sources._imported(f"import helpers.learning.lstm\ndef verb():\n{inside}")) == expected
