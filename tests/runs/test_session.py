"""What a notebook knows of its run: wrong parameters end in one sentence; defaults hold from any working directory."""

import json
import shutil
import time

import pandas as pd
import pytest
import torch

from helpers.runs.opening import open_report, readable
from helpers.runs.request import NOTEBOOK_PARAMETERS, SessionError, check_parameters
from helpers.runs.session import open_session
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import ParameterError
from tests.runs.test_study import session as opened

NOTEBOOKS = sorted(path.stem for path in (PROJECT / "notebooks").glob("[0-9]*.ipynb"))
OFFLINE, REPORT = "02_offline_irl", "05_report"
TAUGHT = [name for name in NOTEBOOKS if name[:2] in ("01", "02", "03", "04", "10")]
OF_ALL_CASES = {REPORT: ("seeds",), "00_inferred_settings": ("seed",), "07_your_own_process": ("seed",), "09_one_policy": ("seed",)}
SHOWN = {"alpha:C_A-I": "alpha of <i>C</i><sub>A</sub>-I", "rise_time:T": "rise time of T", "C_A0": "<i>C</i><sub>A0</sub>"}
SHOWN |= {"a < b": "a &lt; b", **{same: same for same in ("params/case_1.yaml", "$C_{A0}^*$", "12:30:00")}}
TABLE = {"t.csv": pd.DataFrame({"value": [1.0]})}


def defaults(notebook):
    """The variables that a notebook's parameters cell defines."""
    cells = json.loads((PROJECT / f"notebooks/{notebook}.ipynb").read_text(encoding="utf-8"))["cells"]
    (cell,) = [cell for cell in cells if "parameters" in cell["metadata"].get("tags", [])]
    namespace = {}
    exec("".join(cell["source"]), {}, namespace)
    return namespace


def globals_of_a_kernel(notebook, **given):
    """A notebook's globals after its parameters cell, with what IPython and papermill add."""
    ipython = {"__name__": "__main__", "In": [""], "Out": {}, "_": "", "_i1": "case = 1", "quit": exit}
    return {**ipython, **defaults(notebook), "scale": "smoke", **given}


def refusal(action, *arguments):
    with pytest.raises((SessionError, ParameterError)) as caught:
        action(*arguments)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert caught.value._render_traceback_() == [f"{type(caught.value).__name__}: {sentence}"]  # what IPython shows
    return sentence


@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_the_parameters_cell_names_known_parameters_of_the_right_type(notebook):
    found = defaults(notebook)
    assert set(found) <= set(NOTEBOOK_PARAMETERS)
    assert {"scale", "input_root", "output_root", "params_root"} <= set(found)
    assert set(OF_ALL_CASES.get(notebook, ("case", "seed"))) == {"case", "seed", "seeds"} & set(found)
    assert found["scale"] == ("lesson" if notebook in TAUGHT else "smoke")
    check_parameters(notebook, found)


WRONG = [({"sed": 3}, ["'sed'", "seed"]), ({"rounds": [1, 2]}, ["'rounds'"]), ({"params_root": "/nowhere"}, ["/nowhere"])]
WRONG += [({"seed": seed}, ["'seed'", "a whole number", repr(seed)]) for seed in ("0/../../x", 1.5)]
WRONG += [({"seed": -1}, ["'seed'", "0 or more", "-1"]), ({"scale": 1}, ["'scale'", "a text", "1"])]
WRONG += [({"case": case}, ["'case'", "a whole number", repr(case)]) for case in ("1/../../x", True)]
WRONG += [({"case": 9}, ["case_9.yaml"])]
WRONG += [({"scale": scale}, ["'scale': expected one of", "smoke", f"found '{scale}'"]) for scale in ("large", "smoke/..", "")]
KNOWN = "expected one of improved, printed, a trial of params/trials.yaml, found"
WRONG += [({"variant": name}, [f"{KNOWN} '{name}'"]) for name in ("best", "improved/../../x", "/x", "")]
OF_OTHERS = [("01_demonstrations", {"seeds": 3}, ["'seeds'"])]  # for `-p seed 3` it would otherwise run seed 0 without a word
OF_OTHERS += [("01_demonstrations", {"variant": "printed"}, ["'variant'"]), (REPORT, {"seed": 1}, ["'seed'"])]
OF_OTHERS += [(REPORT, {"seeds": 0}, ["'seeds': expected 1 or more, found 0"])]
NO_LESSON = ({"scale": "lesson"}, ["'scale': expected one of paper, smoke, found"])
OF_OTHERS += [(name, *NO_LESSON) for name in NOTEBOOKS if name not in TAUGHT]


@pytest.mark.parametrize(("notebook", "given", "says"), [*((OFFLINE, *case) for case in WRONG), *OF_OTHERS])
def test_a_wrong_parameter_ends_in_one_sentence(notebook, given, says):
    sentence = refusal(check_parameters, notebook, given)
    assert all(part in sentence for part in says), sentence
    assert refusal(open_session, notebook, globals_of_a_kernel(notebook, **given)) == sentence


@pytest.mark.parametrize(("scale", "shown"), [("smoke", "results/smoke/report"), ("paper", "reports/latest"), ("lesson", "")])
def test_default_roots_do_not_depend_on_the_working_directory(monkeypatch, tmp_path, scale, shown):
    monkeypatch.chdir(tmp_path)
    session = opened(scale=scale)
    came_from = PROJECT / ("results" if scale == "paper" else "notebooks/inputs")
    assert (session.input_root, session.output_root, session.params_root) == (came_from, PROJECT / "results", PROJECT / "params")
    if shown:
        report = open_report(REPORT, globals_of_a_kernel(REPORT, scale=scale))
        assert (report.input_root, report.output_root, report.cases) == (came_from, PROJECT / shown, (1, 2, 3))


def test_given_roots_are_resolved_once(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    session = opened(input_root="here", output_root=str(tmp_path / "there"))
    monkeypatch.chdir("/")
    assert session.folder(session.input_root, "stage") == tmp_path / "here/smoke/seed_0/case_1/stage"
    assert session.folder(session.output_root, "stage", 3) == tmp_path / "there/smoke/seed_0/case_3/stage"


def test_the_opening_cell_may_be_run_again_among_other_variables():
    namespace = globals_of_a_kernel(OFFLINE)
    first = open_session(OFFLINE, namespace)
    namespace |= {"n_rounds": 3, "rows": [1], "session": first}
    assert open_session(OFFLINE, namespace).params == first.params
    assert "'seed'" in refusal(open_session, OFFLINE, namespace | {"seed": -1})  # the parameters are still checked


def test_the_scale_fixes_number_type_and_threads():
    torch.set_num_threads(2)
    session = opened()
    assert torch.get_num_threads() == 1
    assert session.dtype == session.task.set_point.dtype == torch.float64
    assert opened(scale="paper").dtype == torch.float32


def test_streams_differ_by_seed_case_and_purpose():
    runs = (({}, "a"), ({}, "a"), ({}, "b"), ({"seed": 1}, "a"), ({"case": 2}, "a"))
    streams = [opened(**given).stream(purpose) for given, purpose in runs]
    first, again, *others = (tuple(torch.randn(3, generator=stream).tolist()) for stream in streams)
    assert first == again
    assert len({first, *others}) == 4


@pytest.mark.parametrize(("label", "shown"), SHOWN.items())
def test_a_table_is_shown_in_words_and_four_digits(label, shown):
    text = readable(pd.DataFrame({label: [1.23456789, float("nan"), 123456.7]}, index=["first", label, "last"]))
    assert text.count(f"<th>{shown}</th>") == 2
    assert all(f"<td>{value}</td>" in text for value in ("1.235", "–", "123,457"))


@pytest.mark.parametrize(("scale", "says"), [("lesson", "This is the lesson"), ("smoke", "smoke run"), ("paper", "scale `paper`")])
def test_the_banner_says_what_kind_of_run_it_is_and_links_the_full_one(scale, says):
    shown = opened(scale=scale, case=2).banner().data
    assert says in shown
    assert ("(../reports/reference/notebooks/02_offline_irl_case_2.ipynb)" in shown) is (scale != "paper")
    assert "reports/reference/report.html" in open_report(REPORT, globals_of_a_kernel(REPORT)).banner().data


def test_a_saved_stage_records_where_it_comes_from(tmp_path):
    session = opened(seed=4, output_root=str(tmp_path))
    table = pd.DataFrame({"value": [1 / 3, 123456.789012345]})
    record = session.save("offline_improved", {"t.csv": table}).record
    assert {"notebook": OFFLINE, "case": 1, "seed": 4, "scale": "smoke", "variant": "improved"}.items() <= record.items()
    assert record["inputs"] == session.inputs_now()
    assert {"identity", "upstream", "revision", "versions", "seconds"} <= record.keys()
    loaded = opened(seed=4, input_root=str(tmp_path)).load("offline_improved", "02")
    assert loaded.record == record
    assert loaded.table("t.csv").equals(table)  # display options, which a session sets, do not reach the files


def test_the_seconds_of_the_results_of_one_run_add_up_to_its_own(tmp_path):
    session, began = opened(output_root=str(tmp_path)), time.process_time()
    first = session.save("offline_improved", TABLE, last=False).record["seconds"]
    while time.process_time() < began + 0.2:
        pass
    second = session.save("offline_printed", TABLE).record["seconds"]
    assert first > 0
    assert second > 0.1
    assert first + second <= time.process_time() - session.clock[0]


def test_a_run_under_which_code_or_parameters_change_saves_nothing(tmp_path):
    """As the notebook of a killed run may do, that lives on while its user edits and starts again."""
    params = shutil.copytree(PROJECT / "params", tmp_path / "params")
    session = opened(params_root=str(params), output_root=str(tmp_path / "out"))
    learning = params / "learning.yaml"
    before = learning.read_text(encoding="utf-8")
    learning.write_text(before.replace("leaky_slope: {value: 0.01", "leaky_slope: {value: 0.02"), encoding="utf-8")
    assert "params/learning.yaml changed during the run; run it again" in refusal(session.save, "offline_improved", TABLE)
    assert not (tmp_path / "out").exists()
    learning.write_text(f"# a comment\n{before}", encoding="utf-8")
    assert session.save("offline_improved", TABLE).record["inputs"] == session.made_from


def test_a_result_names_the_earlier_results_that_it_read(tmp_path):
    session = opened(output_root=str(tmp_path))
    read = session.load("demonstrations", "01_demonstrations")
    first, second = session.save("first", TABLE, last=False), session.save("second", {"t.csv": 2 * TABLE["t.csv"]})
    assert first.record["upstream"] == {"case_1/demonstrations": read.content}
    assert second.record["upstream"] == {"case_1/demonstrations": read.content, "case_1/first": first.content}
    assert first.record["identity"] != second.record["identity"]
