"""Results on disk: written whole or not at all, read back to the last bit, and refused in one sentence when damaged."""

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import torch

from helpers.plant.rollout import rollout, stream
from helpers.runs import artifacts
from helpers.runs.artifacts import ArtifactError, load_stage, save_stage, trajectories_from_table, trajectories_to_table
from helpers.runs.scratch import beside

AWKWARD = pd.DataFrame({"number": [0.1, 1 / 3, 1e-300, np.pi * 1e17, -0.0, np.nan], "name": list("abcdef")})
NAMES = (("C_A", "T"), ("C_A0", "T_E"))
# A file, what it holds when it is damaged, if it is there at all, and what is said.
DAMAGED = [("table.csv", "1,g\n", "file has changed since it was written"), ("table.csv", None, "file is missing")]
NO_RECORDS = ("", '{"files": {"a', "null", "[]", "{}", '{"files": 3}', "\udcff")
DAMAGED += [("record.json", None, "result is missing"), *(("record.json", text, "result is damaged") for text in NO_RECORDS)]
BROKEN_TABLES = {
    "a column is missing": (lambda table: table.drop(columns="u_T_E"), "the column 'u_T_E' is missing"),
    "a sample is missing": (lambda table: table.drop(index=5), "column 'sample'"),
    "a sample stands twice": (lambda table: pd.concat([table, table.iloc[[5]]]), "column 'sample'"),
    "a trajectory is cut": (lambda table: table.iloc[:-1], "column 'sample'"),
    "no rows": (lambda table: table.iloc[:0], "column 'sample'"),
    "a hole": (lambda table: table.assign(x_T=table["x_T"].where(table["sample"] != 3)), "finite"),
    "an infinite input": (lambda table: table.assign(u_T_E=np.inf), "finite"),
    "a word for a number": (lambda table: table.assign(y_T=["high", *table["y_T"].iloc[1:]]), "y_T"),
    "a word for a sample": (lambda table: table.assign(sample=["first", *table["sample"].iloc[1:]]), "sample"),
}


def refusal(action, *arguments, **named):
    with pytest.raises(ArtifactError) as caught:
        action(*arguments, **named)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def saved(tmp_path):
    return save_stage(tmp_path / "results/stage", {"seed": 3}, {"table.csv": AWKWARD, "µ.csv": AWKWARD})


def test_tables_come_back_to_the_last_bit_and_new_ones_take_the_place_of_all_older_ones(saved):
    found = load_stage(saved.folder, "notebook 01").table("table.csv", ("number", "name"))
    assert found["number"].to_numpy().tobytes() == AWKWARD["number"].to_numpy().tobytes()
    assert saved.record["seed"] == 3
    assert sorted(saved.record["files"]) == ["table.csv", "µ.csv"]
    assert [path.name for path in save_stage(saved.folder, {}, {"other.csv": AWKWARD}).folder.glob("*.csv")] == ["other.csv"]


@pytest.mark.parametrize("kind", ["tables", "figures"])
@pytest.mark.parametrize(("error", "raised"), [(KeyError("bug"), KeyError), (OSError(28, "No space left"), ArtifactError)])
def test_a_failure_in_the_middle_leaves_the_older_results_alone_or_nothing(saved, tmp_path, kind, error, raised):
    before = {path.name: path.read_bytes() for path in saved.folder.iterdir()}
    broken = Mock(**{"to_csv.side_effect": error, "savefig.side_effect": error})
    for folder in (saved.folder, tmp_path / "first/stage"):
        with pytest.raises(raised, match=r"bug|No space left"):
            save_stage(folder, {"seed": 4}, **{kind: {"new.csv": broken}})
    assert {path.name: path.read_bytes() for path in saved.folder.iterdir()} == before
    assert [path.name for path in saved.folder.parent.iterdir()] == ["stage"]
    assert list((tmp_path / "first").iterdir()) == []


@pytest.mark.parametrize("name", ["../table.csv", "/table.csv", "deep/table.csv", ".."])
def test_a_file_name_cannot_lead_out_of_the_folder(tmp_path, name):
    assert "leads out" in refusal(save_stage, tmp_path / "results/stage", {}, {name: AWKWARD})
    assert not (tmp_path / "results").exists()


def test_what_dead_processes_left_is_swept_and_what_living_ones_write_is_not(saved):
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True, check=True)
    left = [beside(saved.folder).name.replace(str(os.getpid()), number) for number in (dead.stdout.strip(), str(os.getppid()))]
    for name in left:
        (saved.folder.parent / name).mkdir()
    save_stage(saved.folder, {}, {"a.csv": AWKWARD})
    assert {path.name for path in saved.folder.parent.iterdir()} == {"stage", left[1]}


@pytest.mark.torture
def test_whoever_reads_while_the_same_results_are_written_again_finds_them(saved):
    """As a killed run's notebook does that lives on beside the resumed one: whole results at every moment."""
    code = """if True:
        import sys
        from helpers.runs.artifacts import Path, pd, save_stage
        table = pd.read_csv(sys.argv[2])
        for number in range(150):
            save_stage(Path(sys.argv[1]), {"seed": number}, {"table.csv": table, "µ.csv": table})
    """
    writers = [subprocess.Popen([sys.executable, "-c", code, saved.folder, saved.path("table.csv")]) for _ in range(2)]
    reads = 0
    while any(writer.poll() is None for writer in writers):
        assert load_stage(saved.folder, "this").content == saved.content
        reads += 1
    assert [writer.wait() for writer in writers] == [0, 0]
    assert reads > 0


def test_a_kill_between_two_files_is_never_taken_for_a_result(saved, monkeypatch):
    """After any number of the renames, the folder holds the older results, the new ones, or is refused."""
    new = {"table.csv": AWKWARD.assign(number=1.0), "other.csv": AWKWARD}
    rename, left = Path.replace, 0

    def dying(path, target):
        nonlocal left
        left -= 1
        return rename(path, target) if left >= 0 else pytest.fail("killed")

    monkeypatch.setattr(Path, "replace", dying)
    # Renamed so far: nothing; a file that the older record does not name; one that it does, with another hash.
    for number, whole in enumerate([True, True, False]):
        left = number
        with pytest.raises(pytest.fail.Exception, match="killed"):
            save_stage(saved.folder, {}, new)
        if whole:
            assert load_stage(saved.folder, "this").content == saved.content
        else:
            refusal(load_stage, saved.folder, "this")
    left = 9
    assert save_stage(saved.folder, {}, new).content != saved.content


@pytest.mark.parametrize("below", ["", "seed_0/stage"])
def test_a_place_that_cannot_be_written_is_named(tmp_path, below):
    (tmp_path / "file").write_text("in the way")
    assert str(tmp_path / "file") in refusal(save_stage, tmp_path / "file" / below, {}, {"a.csv": AWKWARD})


@pytest.mark.parametrize("files", ['{"table.csv": 3}', '{"../table.csv": "a hash"}'])
def test_a_record_of_what_are_no_file_names_and_hashes_is_refused(saved, files):
    (saved.folder / "record.json").write_text(f'{{"files": {files}}}')
    assert "record.json: key 'files': expected file names and their hashes" in refusal(load_stage, saved.folder, "notebook 01")


@pytest.mark.parametrize(("name", "text", "says"), DAMAGED)
def test_a_stage_of_which_a_file_is_damaged_or_gone_is_refused(saved, name, text, says):
    path = saved.folder / name
    path.unlink()
    if text is not None:
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
    word = "first" if says == "result is missing" else "again"
    assert refusal(load_stage, saved.folder, "notebook 01") == f"{path}: this {says}; run notebook 01 {word}"


def test_what_was_never_written_or_is_no_table_is_refused(saved):
    assert "other.csv: the stage did not write this file" in refusal(saved.table, "other.csv")
    assert "table.csv: the column 'value' is missing" in refusal(saved.table, "table.csv", ("value",))
    for text in ("", 'a,b\n1\n2,3,4\n"x'):  # empty, ragged
        saved.path("table.csv").write_text(text)
        assert "table.csv: not a table: " in refusal(saved.table, "table.csv")


def recorded(study, dtype=torch.float64):
    case = study(1, dtype)
    return rollout(case.process, case.pid, case.task, 4, stream(0, "artifacts"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_trajectories_come_back_to_the_last_bit_from_where_the_header_says(study, tmp_path, dtype):
    batch = recorded(study, dtype)
    table = trajectories_to_table(batch, *NAMES, 0.04)
    assert (list(table)[:3], len(table)) == (["trajectory", "sample", "time"], batch.n_trajectories * (batch.n_steps + 1))
    row = table.query("trajectory == 2 and sample == 7").iloc[0]
    assert row["time"] == pytest.approx(0.28)
    found = [row[name] for name in ("x_T", "y_C_A", "u_T_E", "command_C_A0")]
    assert found == [batch.x[7, 2, 1], batch.y[7, 2, 0], batch.u[7, 2, 1], batch.command[7, 2, 0]]
    stage = save_stage(tmp_path, {}, {"t.csv": table.sample(frac=1, random_state=0)})  # whatever the order of the rows
    found = trajectories_from_table(stage.table("t.csv"), *NAMES, dtype, stage.path("t.csv"))
    assert all(signal.dtype == dtype and torch.equal(signal, getattr(batch, name)) for name, signal in vars(found).items())


@pytest.mark.parametrize(("change", "says"), BROKEN_TABLES.values(), ids=BROKEN_TABLES)
def test_a_broken_table_of_trajectories_is_refused(study, tmp_path, change, says):
    path = tmp_path / "demonstrations.csv"
    change(trajectories_to_table(recorded(study), *NAMES, 0.04)).to_csv(path, index=False)
    sentence = refusal(trajectories_from_table, pd.read_csv(path), *NAMES, torch.float64, path)
    assert sentence.startswith(f"{path}: ")
    assert says in sentence


@pytest.fixture
def with_policy(study, tmp_path):
    case = study(1)
    policy = case.policy()
    return save_stage(tmp_path / "results/stage", {}, policy=policy), policy, case


def test_a_policy_comes_back_to_the_last_bit_and_in_another_shape_not_at_all(with_policy):
    stage, policy, case = with_policy
    learning = case.params.learning
    found = stage.policy(learning, case.task)
    assert all(torch.equal(found.state_dict()[name], tensor) for name, tensor in policy.state_dict().items())
    assert torch.equal(found.error_unit, policy.error_unit)
    wider = learning.policy.model_copy(update={"hidden_cells": (20, 21)})
    sentence = refusal(stage.policy, learning.model_copy(update={"policy": wider}), case.task)
    parts = ("policy.safetensors", "key 'layers.1", "another shape", "(84,", "(80,", "params/learning.yaml")
    assert [part for part in parts if part not in sentence] == []


class Bomb:
    """What a pickled file may hold: code that runs when it is loaded."""

    def __reduce__(self):
        return Path.touch, (Path("exploded"),)


def test_a_damaged_policy_file_is_refused_and_runs_no_code(with_policy, monkeypatch, tmp_path):
    """When the stage is loaded, and even after that: a forged record would not help."""
    monkeypatch.chdir(tmp_path)
    stage, _, case = with_policy
    path = stage.path("policy.safetensors")
    for damaged in (path.read_bytes()[:-7], b"", bytes(range(256)) * 8, pickle.dumps(Bomb())):
        path.write_bytes(damaged)
        assert "policy.safetensors: this file has changed" in refusal(load_stage, stage.folder, "notebook 02")
        assert "policy.safetensors: not a policy file" in refusal(stage.policy, case.params.learning, case.task)
        assert not Path("exploded").exists()


def test_code_revision_tells_a_commit_from_changed_files_and_from_no_checkout(tmp_path):
    assert artifacts.code_revision(tmp_path) == "unknown"
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    for command in (["init", "-q"], [*identity, "commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    clean = artifacts.code_revision(tmp_path)
    assert re.fullmatch("[0-9a-f]{40}", clean)
    (tmp_path / "new.py").touch()
    assert artifacts.code_revision(tmp_path) == clean + "+changes"
