"""Results on disk: written whole or not at all, read back to the last bit, and refused in one sentence when damaged."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from helpers.plant.rollout import rollout, stream
from helpers.runs import artifacts
from helpers.runs.artifacts import ArtifactError, load_stage, save_stage, trajectories_from_table, trajectories_to_table
from helpers.runs.scratch import beside

AWKWARD = pd.DataFrame({"number": [0.1, 1 / 3, 1e-300, np.pi * 1e17, -0.0, np.nan], "name": list("abcdef")})


def refusal(action, *arguments, **named):
    """The sentence with which an action is refused."""
    with pytest.raises(ArtifactError) as caught:
        action(*arguments, **named)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "results" / "stage"


@pytest.fixture
def saved(folder):
    return save_stage(folder, {"seed": 3}, {"table.csv": AWKWARD, "µ.csv": AWKWARD})


def test_tables_come_back_to_the_last_bit(saved):
    found = load_stage(saved.folder, "notebook 01").table("table.csv", ("number", "name"))
    assert found["number"].to_numpy().tobytes() == AWKWARD["number"].to_numpy().tobytes()
    assert saved.record["seed"] == 3
    assert sorted(saved.record["files"]) == ["table.csv", "µ.csv"]


class FaultError(RuntimeError):
    """Something that goes wrong in the middle of writing."""


class Broken:
    """A table, or a figure, that cannot be written."""

    def __init__(self, error):
        self.error = error

    def to_csv(self, *_, **__):
        raise self.error

    savefig = to_csv


@pytest.mark.parametrize("kind", ["tables", "figures"])
@pytest.mark.parametrize(
    ("error", "raised"), [(FaultError("bug"), FaultError), (OSError(28, "No space left on device"), ArtifactError)]
)
def test_a_failure_in_the_middle_leaves_the_older_results_alone(saved, kind, error, raised):
    before = {path.name: path.read_bytes() for path in saved.folder.iterdir()}
    with pytest.raises(raised, match=r"bug|No space left"):
        save_stage(saved.folder, {"seed": 4}, **{kind: {"new.csv": Broken(error)}})
    assert {path.name: path.read_bytes() for path in saved.folder.iterdir()} == before
    assert [path.name for path in saved.folder.parent.iterdir()] == ["stage"]


def test_a_failure_in_the_middle_of_a_first_run_leaves_nothing(folder):
    with pytest.raises(FaultError):
        save_stage(folder, {}, {"a.csv": AWKWARD, "b.csv": Broken(FaultError())})
    assert list(folder.parent.iterdir()) == []


def test_new_results_take_the_place_of_all_older_ones(saved):
    assert [path.name for path in save_stage(saved.folder, {}, {"other.csv": AWKWARD}).folder.glob("*.csv")] == ["other.csv"]


@pytest.mark.parametrize("name", ["../table.csv", "/table.csv", "deep/table.csv", ".."])
def test_a_file_name_cannot_lead_out_of_the_folder(folder, name):
    assert "leads out" in refusal(save_stage, folder, {}, {name: AWKWARD})
    assert not folder.parent.exists()


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
        if left < 0:
            raise FaultError
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", dying)
    # Renamed so far: nothing; a file that the older record does not name; one that it does, with another hash.
    for number, found in enumerate([saved.content, saved.content, None]):
        left = number
        with pytest.raises(FaultError):
            save_stage(saved.folder, {}, new)
        assert load_or_none(saved.folder) == found
    left = 9
    assert save_stage(saved.folder, {}, new).content != saved.content


def load_or_none(folder):
    """The content of a stage, or None if it is refused."""
    try:
        return load_stage(folder, "this").content
    except ArtifactError:
        return None


@pytest.mark.parametrize("below", ["", "seed_0/stage"])
def test_a_place_that_cannot_be_written_is_named(tmp_path, below):
    (tmp_path / "file").write_text("in the way")
    assert str(tmp_path / "file") in refusal(save_stage, tmp_path / "file" / below, {}, {"a.csv": AWKWARD})


def test_a_missing_stage_names_the_file_and_the_notebook_to_run(folder):
    assert refusal(load_stage, folder, "notebook 01") == f"{folder}/record.json: this result is missing; run notebook 01 first"


@pytest.mark.parametrize("text", ["", '{"files": {"a', "null", "[]", "{}", '{"files": 3}', "\udcff"])
def test_a_damaged_record_is_refused(saved, text):
    (saved.folder / "record.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    assert "record.json: this result is damaged; run notebook 01 again" in refusal(load_stage, saved.folder, "notebook 01")


def test_a_changed_file_is_refused(saved):
    with (saved.folder / "table.csv").open("a") as file:
        file.write("1,g\n")
    assert "table.csv: this file has changed since it was written" in refusal(load_stage, saved.folder, "notebook 01")


def test_a_file_that_is_gone_is_refused(saved):
    (saved.folder / "table.csv").unlink()
    assert "table.csv: this file is missing" in refusal(load_stage, saved.folder, "notebook 01")


def test_a_file_or_column_that_was_never_written_is_refused(saved):
    assert "other.csv: the stage did not write this file" in refusal(saved.table, "other.csv")
    assert "table.csv: the column 'value' is missing" in refusal(saved.table, "table.csv", ("value",))


@pytest.mark.parametrize("text", ["", 'a,b\n1\n2,3,4\n"x'], ids=["empty", "ragged"])
def test_a_file_that_is_no_table_is_refused(folder, text):
    stage = save_stage(folder, {}, {"table.csv": AWKWARD})
    stage.path("table.csv").write_text(text)
    assert "table.csv" in refusal(stage.table, "table.csv")


# Trajectories --------------------------------------------------------------------------------------------------------

NAMES = (("C_A", "T"), ("C_A0", "T_E"))


def recorded(study, dtype=torch.float64):
    case = study(1, dtype)
    return rollout(case.process, case.pid, case.task, 4, stream(0, "artifacts"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_trajectories_come_back_to_the_last_bit(study, folder, dtype):
    batch = recorded(study, dtype)
    table = trajectories_to_table(batch, *NAMES, 0.04)
    assert list(table)[:3] == ["trajectory", "sample", "time"]
    assert len(table) == batch.n_trajectories * (batch.n_steps + 1)
    stage = save_stage(folder, {}, {"t.csv": table.sample(frac=1, random_state=0)})  # whatever the order of the rows
    found = trajectories_from_table(stage.table("t.csv"), *NAMES, dtype, stage.path("t.csv"))
    for name in ("x", "y", "u", "command"):
        assert getattr(found, name).dtype == dtype
        assert torch.equal(getattr(found, name), getattr(batch, name)), name


def test_the_long_table_holds_each_signal_where_its_header_says(study):
    batch = recorded(study)
    row = trajectories_to_table(batch, *NAMES, 0.04).query("trajectory == 2 and sample == 7").iloc[0]
    assert row["time"] == pytest.approx(0.28)
    assert [row["x_T"], row["y_C_A"]] == [batch.x[7, 2, 1], batch.y[7, 2, 0]]
    assert [row["u_T_E"], row["command_C_A0"]] == [batch.u[7, 2, 1], batch.command[7, 2, 0]]


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


@pytest.mark.parametrize(("change", "says"), BROKEN_TABLES.values(), ids=BROKEN_TABLES)
def test_a_broken_table_of_trajectories_is_refused(study, tmp_path, change, says):
    path = tmp_path / "demonstrations.csv"
    change(trajectories_to_table(recorded(study), *NAMES, 0.04)).to_csv(path, index=False)
    sentence = refusal(trajectories_from_table, pd.read_csv(path), *NAMES, torch.float64, path)
    assert sentence.startswith(f"{path}: ")
    assert says in sentence


# Policies ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def with_policy(study, folder):
    case = study(1)
    policy = case.policy()
    return save_stage(folder, {}, policy=policy), policy, case


def test_a_policy_comes_back_to_the_last_bit(with_policy):
    stage, policy, case = with_policy
    found = stage.policy(case.params.learning, case.task)
    assert all(torch.equal(found.state_dict()[name], tensor) for name, tensor in policy.state_dict().items())
    assert torch.equal(found.error_unit, policy.error_unit)


def test_a_policy_of_another_shape_is_refused_naming_file_key_and_both_shapes(with_policy):
    stage, _, case = with_policy
    wider = case.params.learning.policy.model_copy(update={"hidden_cells": (20, 21)})
    sentence = refusal(stage.policy, case.params.learning.model_copy(update={"policy": wider}), case.task)
    for part in ("policy.safetensors", "key 'layers.1", "another shape", "(84,", "(80,", "params/learning.yaml"):
        assert part in sentence


class Bomb:
    """What a pickled file may hold: code that runs when it is loaded."""

    def __reduce__(self):
        return Path.touch, (Path("exploded"),)


DAMAGED_POLICIES = {
    "cut short": lambda good: good[:-7],
    "header only": lambda good: good[:20],
    "empty": lambda good: b"",
    "garbage": lambda good: bytes(range(256)) * 8,
    "pickled code": lambda good: pickle.dumps(Bomb()),
}


@pytest.mark.parametrize("damage", DAMAGED_POLICIES.values(), ids=DAMAGED_POLICIES)
def test_a_damaged_policy_file_is_refused_and_runs_no_code(with_policy, monkeypatch, tmp_path, damage):
    """When the stage is loaded, and even after that: a forged record would not help."""
    monkeypatch.chdir(tmp_path)
    stage, _, case = with_policy
    path = stage.path("policy.safetensors")
    path.write_bytes(damage(path.read_bytes()))
    assert "policy.safetensors: this file has changed" in refusal(load_stage, stage.folder, "notebook 02")
    assert "policy.safetensors: not a policy file" in refusal(stage.policy, case.params.learning, case.task)
    assert not Path("exploded").exists()


# Where the code stands -----------------------------------------------------------------------------------------------


def test_code_revision_tells_a_commit_from_changed_files_and_from_no_checkout(tmp_path):
    assert artifacts.code_revision(tmp_path) == "unknown"
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    for command in (["init", "-q"], [*identity, "commit", "-q", "--allow-empty", "-m", "x"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    clean = artifacts.code_revision(tmp_path)
    assert len(clean) == 40
    assert clean.isalnum()
    (tmp_path / "new.py").touch()
    assert artifacts.code_revision(tmp_path) == clean + "+changes"
