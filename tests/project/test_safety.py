"""Nothing that is loaded executes code, nothing of ours speaks to a network, no name leads out of results and reports."""

import ast

import pytest

from helpers.runs.request import SessionError, check_parameters, check_place
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import ParameterError

MODULES = sorted((PROJECT / "src/helpers").rglob("*.py"))
NETWORK = {"socket", "urllib", "http", "requests", "httpx", "ftplib", "smtplib", "ssl", "telnetlib", "xmlrpc"}
LOADS_CODE = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "runpy", "code"}
CALLS = {"eval", "exec", "compile", "__import__", "load_module", "read_pickle", "unsafe_load", "full_load", "system", "popen"}


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


ESCAPES = {
    "variant": ["../../../etc", "improved/../../x", "/x", "..", ""],
    "scale": ["../paper", "smoke/..", "/", ""],
    "seed": ["0/../../x", "../1", -1, 1.0],
    "case": ["../1", "1/../../x", -1, 0, 10**9],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in ESCAPES.items() for value in values])
def test_no_parameter_that_names_a_folder_can_lead_out_of_it(name, value):
    with pytest.raises((SessionError, ParameterError)):
        check_parameters("02_offline_irl", {name: value})


def test_no_name_of_a_trial_can_lead_out_either(tmp_path):
    for path in (PROJECT / "params").glob("*.yaml"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    text = (tmp_path / "trials.yaml").read_text(encoding="utf-8")
    for name in ("../escape", "a/b", ".", "A", ".hidden"):
        (tmp_path / "trials.yaml").write_text(text.replace("constant_step:", f'"{name}":', 1), encoding="utf-8")
        with pytest.raises(ParameterError, match="expected a name of small letters"):
            check_parameters("02_offline_irl", {"params_root": str(tmp_path)})


def test_results_reports_and_folders_elsewhere_are_accepted(tmp_path):
    for place in (PROJECT / "results", PROJECT / "reports/latest/notebooks/05.ipynb", tmp_path, tmp_path / "src"):
        check_place("output_root", place)
