"""Which modules stand behind a notebook, against what Python itself imports."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import sources

IMPORTS = """
import sys
{code}
print("\\n".join(sorted(name for name in sys.modules if name.startswith("helpers."))))
"""


@pytest.mark.parametrize(
    ("notebook", "code"),
    [
        ("02_offline_irl", "from helpers import figures, stages\nfrom helpers.session import open_session"),
        ("05_report", "from helpers import report, tables\nfrom helpers.session import open_report"),
    ],
)
def test_every_module_that_python_imports_is_found(notebook, code):
    run = subprocess.run([sys.executable, "-c", IMPORTS.format(code=code)], capture_output=True, text=True, check=True)
    imported = {name.removeprefix("helpers.") for name in run.stdout.split()}
    assert {"params", "session"} < imported
    assert imported <= {path.stem for path in sources.modules_behind(notebook)}


def test_a_stage_does_not_depend_on_what_only_the_report_needs():
    assert "report" not in {path.stem for path in sources.modules_behind("02_offline_irl")}


def test_imports_inside_functions_and_of_the_package_count():
    code = "import helpers.lstm\ndef verb():\n    from helpers import policy, nothing\n    from helpers.task import ControlTask\n"
    assert sorted(Path(path).stem for path in sources._imported(code)) == ["lstm", "policy", "task"]


def test_the_fingerprint_follows_the_code_and_not_the_comments(tmp_path, monkeypatch):
    package, notebooks = tmp_path / "src/helpers", tmp_path / "notebooks"
    package.mkdir(parents=True)
    notebooks.mkdir()
    cell = {"cell_type": "code", "source": ["from helpers import verb\n"], "outputs": [], "metadata": {}}
    (notebooks / "01.ipynb").write_text(json.dumps({"cells": [cell]}), encoding="utf-8")
    monkeypatch.setattr(sources, "PACKAGE", package)
    monkeypatch.setattr(sources, "PROJECT", tmp_path)

    def fingerprint(verb, idle="y = 1\n"):
        (package / "verb.py").write_text(verb, encoding="utf-8")
        (package / "idle.py").write_text(idle, encoding="utf-8")
        sources._imported.cache_clear()
        return sources.fingerprint("01")

    first = fingerprint("x = 1\n")
    assert fingerprint("x = 1  # one\n\n") == first
    assert fingerprint("x = 1\n", "y = 2\n") == first  # no module behind the notebook
    assert fingerprint("x = 2\n") != first
    sources._imported.cache_clear()
