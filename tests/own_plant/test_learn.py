"""From a historian file to a controller, for any number of controlled and manipulated variables, without a change of code."""

import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers import __main__ as command
from helpers.own_plant import learn
from helpers.own_plant.deploy import DeployedPolicy
from helpers.own_plant.description import load_description
from helpers.own_plant.model import LinearModel
from helpers.report import plant_report
from helpers.runs.sources import PROJECT
from helpers.settings.leaf import InputError, ParameterError
from tests.own_plant.plants import HORIZON, MadeUpPlant


def small(plant):
    """A few epochs with a few episodes: enough to see that everything fits together."""
    learning = plant.learning.model_copy(update={"policy": plant.learning.policy.model_copy(update={"hidden_cells": (6, 6)})})
    scale = plant.scale.model_copy(update={"episodes": 16, "measured": 4, "evaluation": 10, "epoch_share": 0.02})
    return replace(plant, scale=scale, learning=learning)


@pytest.mark.parametrize(("n_y", "n_u"), [(1, 1), (3, 2), (2, 3)])
def test_the_whole_chain_runs_for_any_number_of_variables(n_y, n_u, tmp_path, root):
    path = MadeUpPlant(n_y, n_u).write(tmp_path)
    plant = small(learn.open_plant(path, root, "smoke", 0))
    identified, validation = learn.identify_plant(plant)
    assert (validation.fit > 0.5).all()
    model = identified.model.to(plant.dtype)
    task = learn.task_on(plant, model)
    assert task.initial_mean.shape == (model.n_states,)
    offline = learn.learn_offline(plant, model, task)
    assert len(offline.records) == 6
    assert offline.weights.shape == (3 * n_y,)
    online, records = learn.improve_on(plant, offline.policy, model, task)
    assert records[-1].gradient_steps == 32
    judged = learn.judge(plant, task, learn.compare(plant, model, task, {"online": online}))
    assert len([row for row in judged.index if row.startswith("movement:")]) == n_u
    assert np.isfinite(judged["online"].drop([row for row in judged.index if row.startswith("rise_time")])).all()
    assert plant_report.export_policy(plant, online, model, task, tmp_path / "policy.onnx") < 1e-5
    notes = DeployedPolicy(tmp_path / "policy.onnx").notes
    assert [entry["tag"] for entry in notes["controlled"]] == [f"Y{i}.PV" for i in range(n_y)]


def test_the_features_are_those_of_the_record_and_on_y(tmp_path, root):
    plant = learn.open_plant(MadeUpPlant(2, 2).write(tmp_path), root, "smoke", 0)
    found, task = plant.demonstrations, plant.task(torch.zeros(2), torch.zeros(2))
    features = plant.features(task)
    assert features.params.features_on == "y"
    assert found.trajectories.y.shape[0] == HORIZON + 1
    errors = (task.set_point - found.trajectories.y[1:]) / task.error_scale
    assert features.errors(found.trajectories).numpy() == pytest.approx(errors.numpy())
    assert learn.judge(plant, task, {"record": found.trajectories}).loc["feature gap", "record"] == 0


def test_a_lagged_model_begins_at_rest_where_the_demonstrations_began(tmp_path, root):
    plant = learn.open_plant(MadeUpPlant(2, 3).write(tmp_path), root, "smoke", 0)
    identification = plant.params.identification.model_copy(update={"lags": (3,)})
    plant = replace(plant, params=plant.params.model_copy(update={"identification": identification}))
    identified, _ = learn.identify_plant(plant)
    task = learn.task_on(plant, identified.model.to(plant.dtype))
    y, u = plant.demonstrations.trajectories.y[0].mean(0).tolist(), plant.demonstrations.before.mean(0).tolist()
    assert task.initial_mean.tolist() == pytest.approx([*y, *y, *y, *u, *u])


def test_a_transfer_takes_policy_and_weights_to_another_set_point(tmp_path, root):
    made_up = MadeUpPlant(2, 2)
    table = made_up.table.copy()
    half = len(table) // 2
    for index in range(2):  # the second half steps to a set point half as far
        rest = made_up.steady_y[index]
        for tag in (f"Y{index}.SP", f"Y{index}.PV"):
            table.loc[half:, tag] = rest + (table.loc[half:, tag] - rest) / 2
    plant = small(learn.open_plant(made_up.write(tmp_path, table), root, "smoke", 0))
    other = plant.with_set_points({f"y{i}": float(made_up.steady_y[i] + made_up.set_point[i] / 2) for i in range(2)})
    assert plant.demonstrations.trajectories.n_trajectories == other.demonstrations.trajectories.n_trajectories == 15
    identified, _ = learn.identify_plant(plant)
    model = identified.model.to(plant.dtype)
    offline = learn.learn_offline(plant, model, learn.task_on(plant, model))
    transferred = learn.learn_offline(other, model, learn.task_on(other, model), (offline.policy, offline.weights))
    assert len(transferred.records) == 2
    assert transferred.records[0].weights == pytest.approx(offline.weights.tolist())
    with pytest.raises(ParameterError, match="set point of 'z': expected one of y0, y1"):
        plant.with_set_points({"z": 1.0})


@pytest.fixture
def quick_root(root, tmp_path):
    """The parameter files with a smoke scale that takes a second."""
    folder = shutil.copytree(root, tmp_path / "params")
    text = (folder / "learning.yaml").read_text(encoding="utf-8")
    for old, new in (
        ("epoch_share: {value: 0.05,", "epoch_share: {value: 0.02,"),
        ("episodes: {value: 40,", "episodes: {value: 16,"),
        ("evaluation: {value: 100,", "evaluation: {value: 10,"),
        ("hidden_cells: {value: [20, 20]", "hidden_cells: {value: [6, 6]"),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "learning.yaml").write_text(text, encoding="utf-8")
    return folder


@pytest.mark.torture
def test_the_command_goes_from_a_file_to_a_controller_and_a_report(tmp_path, quick_root, capsys):
    path = MadeUpPlant(3, 2).write(tmp_path)
    arguments = [str(path), "--output", str(tmp_path / "out"), "--scale", "smoke", "--params", str(quick_root)]
    assert plant_report.main(arguments) == 0
    said = capsys.readouterr().out
    assert "online learning ran on the identified model: no plant is named" in said
    assert "30 episodes of 12 samples" in said
    report = (tmp_path / "out/report.md").read_text(encoding="utf-8")
    for heading in ("# made up", "## Data quality", "## Model on held-out records", "## Reward weights", "## Controllers"):
        assert heading in report
    pictures = {"quality.png", "model.png", "learning.png", "response.png"}
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"report.md", "policy.onnx", *pictures}
    policy = DeployedPolicy(tmp_path / "out/policy.onnx")
    y, u = np.array([[50.0, 51.0, 52.0]]), np.array([[20.0, 21.0]])
    assert policy.step(y, y, u).shape == (1, 2)


def test_what_cannot_be_used_is_one_sentence_and_a_status(tmp_path, quick_root, capsys):
    path = MadeUpPlant(1, 1, n_cycles=2).write(tmp_path)
    assert plant_report.main([str(path), "--scale", "smoke", "--params", str(quick_root), "--output", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("error: plant.csv: 2 episodes of 12 samples")
    path.write_text(path.read_text(encoding="utf-8").replace("time_unit: s", "time_unit: week"), encoding="utf-8")
    assert plant_report.main([str(path), "--scale", "smoke"]) == 2
    assert "key 'time_unit'" in capsys.readouterr().err


def test_a_policy_that_does_not_agree_leaves_an_earlier_file_as_it_was(tmp_path, root, monkeypatch):
    plant = small(learn.open_plant(MadeUpPlant(1, 1).write(tmp_path), root, "smoke", 0))
    none = torch.zeros(1)
    model = LinearModel(0.9 * torch.eye(1), 0.1 * torch.ones(1, 1), none, none, none, none, none).to(plant.dtype)
    task = learn.task_at_rest(plant, model)
    policy, path = plant.fresh_policy(task), tmp_path / "out/policy.onnx"
    assert plant_report.export_policy(plant, policy, model, task, path) < 1e-5
    before = path.read_bytes()
    for worst in (0.5, np.nan):
        monkeypatch.setattr(plant_report, "disagreement", lambda *_, worst=worst: worst)
        with pytest.raises(InputError, match=r"out/policy\.onnx: the exported policy differs"):
            plant_report.export_policy(plant, plant.fresh_policy(task), model, task, path)
        assert path.read_bytes() == before
        assert [file.name for file in path.parent.iterdir()] == ["policy.onnx"]


@pytest.mark.parametrize(
    ("changes", "output", "status", "says"),
    [
        ({"plant": "gymnasium:NoSuch-v0"}, "out", 2, "plant 'gymnasium:NoSuch-v0': "),
        ({"plant": "no_such_module:Plant"}, "out", 2, "plant 'no_such_module:Plant': "),
        ({"transfer": {"y0": 60.0}}, "out", 2, "plant.csv: 0 episodes of 12 samples"),
        ({}, "plant.yaml/out", 1, "plant.yaml/out: Not a directory"),
        ({}, PROJECT / "src/helpers", 2, "parameter 'output': inside the project results go below results/ and reports/"),
    ],
)
def test_what_cannot_end_well_is_refused_before_anything_is_learned(
    changes, output, status, says, tmp_path, root, capsys, monkeypatch
):
    def too_late(*_):
        raise AssertionError("the model is being identified")

    monkeypatch.setattr(plant_report, "identify_plant", too_late)
    path = MadeUpPlant(1, 1).write(tmp_path, **changes)
    arguments = [str(path), "--scale", "smoke", "--params", str(root), "--output", str(tmp_path / output)]
    assert plant_report.main(arguments) == status
    sentence = capsys.readouterr().err
    assert sentence.startswith("error: ")
    assert says in sentence
    assert sentence.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_report_that_cannot_be_written_is_one_sentence(tmp_path, quick_root, capsys):
    (tmp_path / "out/report.md").mkdir(parents=True)
    path = MadeUpPlant(1, 1).write(tmp_path)
    arguments = [str(path), "--output", str(tmp_path / "out"), "--scale", "smoke", "--params", str(quick_root)]
    assert plant_report.main(arguments) == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"error: {tmp_path / 'out/report.md'}: Is a directory"


def blocks(language):
    """The blocks of README's section on one's own plant that are in this language."""
    section = (PROJECT / "README.md").read_text(encoding="utf-8").split("## Your own plant")[1].split("\n## ")[0]
    return re.findall(rf"```{language}\n(.*?)```", section, re.DOTALL)


def test_readme_s_description_is_one(tmp_path):
    (yaml,) = blocks("yaml")
    (tmp_path / "plant.yaml").write_text(yaml, encoding="utf-8")
    assert load_description(tmp_path / "plant.yaml").columns == ("TIME", "MODE", "TC1.PV", "TC1.OP", "TC1.SP")


def test_readme_s_command_and_loop_run_as_they_stand(tmp_path, quick_root, monkeypatch):
    (shell,), (python,) = blocks("sh"), blocks("python")
    words = shlex.split(shell, comments=True)
    assert words[:4] == [".venv/bin/python", "-m", "helpers", "plant"]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notebooks").symlink_to(PROJECT / "notebooks")
    assert command.main([*words[3:], "--params", str(quick_root)]) == 0
    report = (tmp_path / "results/tank/report.md").read_text(encoding="utf-8")
    assert "## Controllers after the transfer" in report
    aims = [entry["set_point"] for entry in DeployedPolicy(tmp_path / "results/tank/policy_transfer.onnx").notes["controlled"]]
    assert aims == [1.5, 353.0]
    namespace = {}
    exec(python, namespace)
    assert namespace["inputs"] == pytest.approx([24.0, 410.0])  # without a jump from what the operator applied
    assert namespace["guard"].mode == "policy"
