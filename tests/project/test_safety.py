"""Nothing that is loaded executes code, nothing of ours speaks to a network, no name leads out of results and reports."""

import ast
import re
import shutil

import pytest

from helpers.runs.request import SessionError, check_place
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import ParameterError
from helpers.settings.paper import load_trials

MODULES = sorted((PROJECT / "src/helpers").rglob("*.py"))
NETWORK = {"socket", "urllib", "http", "requests", "httpx", "ftplib", "smtplib", "ssl", "telnetlib", "xmlrpc"}
LOADS_CODE = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "runpy", "code"}
CALLS = {"eval", "exec", "compile", "__import__", "load_module", "read_pickle", "unsafe_load", "full_load", "system", "popen"}
KEPT = ["src/x.ipynb", "notebooks/x.ipynb", "results/../x.ipynb", "reports/template", "reports/latest/../reference"]


def imported(tree):
    """The top names of all imports of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.split(".")[0]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_a_module_has_no_way_to_a_network_and_no_loader_that_runs_code(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not (NETWORK | LOADS_CODE) & set(imported(tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            owner = getattr(getattr(node.func, "value", None), "id", "")
            assert name not in CALLS or owner in ("re", "expression", "to_c", "typst"), ast.unparse(node)
            given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            if name == "load" and owner in ("torch", "np", "numpy"):
                assert given.get("weights_only") == "True", ast.unparse(node)
            assert "shell" not in given, ast.unparse(node)
            if name == "YAML":
                assert given["typ"] == "'safe'"


def test_no_name_of_a_trial_can_lead_out_of_the_results(tmp_path):
    """What else names a folder is one of a few words or a number: the wrong ones are in tests/runs/test_session.py."""
    shutil.copytree(PROJECT / "params", tmp_path, dirs_exist_ok=True)
    text = (tmp_path / "trials.yaml").read_text(encoding="utf-8")
    for name in ("../escape", "a/b", ".", "A", ".hidden"):
        (tmp_path / "trials.yaml").write_text(text.replace("constant_step:", f'"{name}":', 1), encoding="utf-8")
        with pytest.raises(ParameterError, match=f"key '{re.escape(name)}': expected a name of small letters"):
            load_trials(tmp_path)


@pytest.mark.parametrize("place", KEPT)
def test_no_run_writes_over_what_the_project_is_made_of_nor_what_it_keeps(tmp_path, place):
    (tmp_path / "link").symlink_to(PROJECT)
    for project in (PROJECT, tmp_path / "link"):
        with pytest.raises(SessionError, match="'output': inside the project results go below results/ and reports/ but not into"):
            check_place("output", project / place)
    for accepted in (PROJECT / "results", PROJECT / "reports/latest/notebooks/05.ipynb", tmp_path, tmp_path / "src"):
        check_place("output", accepted)
