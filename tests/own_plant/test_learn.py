"""From a historian file to a controller, for any number of controlled and manipulated variables, without a change of code."""

import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers import __main__ as command
from helpers.own_plant import learn, online
from helpers.own_plant.deploy import DeployedPolicy
from helpers.own_plant.description import load_description
from helpers.own_plant.operation import described_gains, recorded_gains
from helpers.own_plant.tank_history import FILE
from helpers.report import plant_report
from helpers.runs.sources import PROJECT
from tests.own_plant.plants import MadeUpPlant
from tests.settings.test_params import edit

LEARNING = {"scales.smoke.epoch_share": 0.02, "scales.smoke.episodes": 16, "policy.hidden_cells": [6, 6]}
OWN_PLANT = {"identification.orders": [1, 2], "identification.longest_dead_time": 2, "rivals.penalties": [1.0, 100.0]}
OWN_PLANT |= {"gate.models": 20, "online.explore": 8, "online.test": 6}


@pytest.fixture(scope="module")
def quick_root(root, tmp_path_factory):
    """The parameter files with a smoke scale that takes seconds."""
    folder = shutil.copytree(root, tmp_path_factory.mktemp("quick") / "params")
    for name, changes in (("learning.yaml", LEARNING), ("own_plant.yaml", OWN_PLANT)):
        edit(folder / name, {f"{key}.value": value for key, value in changes.items()})
    return folder


@pytest.fixture(scope="module")
def opened(tmp_path_factory, quick_root):
    """A made-up plant with so many outputs and inputs, opened: enough epochs, steps and episodes to see that all fits together."""

    def made_up(n_y, n_u, table=None, **changes):
        path = MadeUpPlant(n_y, n_u).write(tmp_path_factory.mktemp("plant"), table, **changes)
        return learn.open_plant(path, quick_root, "smoke", 0)

    return made_up


@pytest.fixture(scope="module")
def trained(opened):
    """The model of a plant with one loop, the workshop of its controllers, and a policy made there."""
    plant = opened(1, 1)
    identified, _ = learn.identify_plant(plant)
    workshop = learn.open_workshop(plant, identified)
    return identified, workshop, learn.learn_policy(workshop, workshop.record)[0]


@pytest.mark.parametrize(("n_y", "n_u"), [(1, 1), (3, 2), pytest.param(2, 3, marks=pytest.mark.torture)])
def test_the_whole_chain_runs_for_any_number_of_variables(n_y, n_u, tmp_path, opened):
    plant = opened(n_y, n_u)
    identified, validation = learn.identify_plant(plant)
    assert (validation.fit > 0.5).all()
    model = identified.nominal.to(plant.dtype)
    task, shown = learn.task_on(plant, model), plant.demonstrations.trajectories
    y, u = shown.y[0].mean(0).tolist(), plant.demonstrations.before.mean(0).tolist()
    begins = [*(y * model.lags), *(u * (model.taps - 1)), *([0.0] * n_y * model.lags)]  # at rest, as the demonstrations did
    assert task.initial_mean.tolist() == pytest.approx(begins)
    study, offline = learn.learn_offline(plant, model, task)
    assert study.features.errors(shown).numpy() == pytest.approx(((task.set_point - shown.y[1:]) / task.error_scale).numpy())
    assert study.features.params.features_on == "y"
    assert len(offline.records) == 6
    assert offline.weights.shape == (3 * n_y,)
    workshop = learn.open_workshop(plant, identified)
    assert workshop.operation.loops == tuple(range(min(n_y, n_u)))
    tuned, predictive = learn.tune(workshop)
    policy, records = learn.learn_policy(workshop, tuned)
    assert len(records) == 4
    verdict = learn.pass_gate(workshop, learn.candidates(workshop, tuned, predictive, policy))
    assert verdict.words.startswith("verdict: ")
    assert np.isfinite(verdict.table.drop(columns="passes").astype(float)).all(axis=None)
    assert plant_report.export_policy(workshop, policy, tmp_path) < 1e-5
    notes = DeployedPolicy(tmp_path / "policy.onnx").notes
    assert [entry["tag"] for entry in notes["controlled"]] == [f"Y{i}.PV" for i in range(n_y)]
    assert notes["set_point_range"][0] == pytest.approx([50.0, max(50.0, 50.0 + MadeUpPlant(n_y, n_u).set_point[0])])


@pytest.mark.parametrize("described", [True, False])
def test_the_pid_of_the_record_is_found_in_it(described, opened):
    table = MadeUpPlant(1, 1).table
    error = (table["Y0.SP"] - table["Y0.PV"]).to_numpy()
    table["U0.OP"] = 20.0 + 0.5 * error + np.concatenate([[0.0], 0.03 * error[1:].cumsum()]) % 0.3
    plant = opened(1, 1, table, **({} if described else {"pid": []}))
    gains, _ = recorded_gains(plant.clean, plant.description, torch.float64)
    assert gains.proportional.item() == pytest.approx(0.5, rel=0.3)
    given = described_gains(plant.description, torch.float64)
    assert (given is not None) == described
    if described:
        assert (given.proportional.item(), given.integral.item()) == (1.0, pytest.approx(0.4))


@pytest.mark.torture
def test_the_command_goes_from_a_file_to_a_controller_and_a_report(tmp_path, quick_root, capsys, monkeypatch):
    path, output = MadeUpPlant(3, 2).write(tmp_path), tmp_path / "out"
    arguments = [str(path), "--output", str(output), "--scale", "smoke", "--params", str(quick_root)]
    # A gate that lets everything through: the policy is there, as ONNX and as C.
    monkeypatch.setattr(plant_report, "pass_gate", lambda *given: replace(learn.pass_gate(*given), released=True))
    assert plant_report.main(arguments) == 0
    pictures = {f"{name}.png" for name in ("gate", "loops", "learning", "model", "quality")}
    assert {file.name for file in output.iterdir()} == {*plant_report.NAMES, *pictures}
    y, u = np.array([[50.0, 51.0, 52.0]]), np.array([[20.0, 21.0]])
    assert DeployedPolicy(output / "policy.onnx").step(y, y, u).shape == (1, 2)
    # A later run whose policy does not pass takes the earlier one away with its report.
    monkeypatch.undo()
    capsys.readouterr()
    assert plant_report.main(arguments) == 0
    said = capsys.readouterr().out
    assert said.startswith("verdict: keep the PID: the policy is not released: ")
    assert "30 episodes of 12 samples" in said
    report = (output / "report.md").read_text(encoding="utf-8")
    assert report.startswith("**Verdict: keep the PID")
    for heading in ("# made up", "## Controllers on models held out", "## Model", "## Reward weights", "## Data quality"):
        assert heading in report
    assert {file.name for file in output.iterdir()} == {"report.md", *pictures}


def test_a_policy_that_does_not_agree_or_a_full_disk_leaves_what_was_there(tmp_path, quick_root, capsys, monkeypatch):
    output = tmp_path / "out"
    output.mkdir()
    (output / "report.md").write_text("old", encoding="utf-8")
    arguments = [str(MadeUpPlant(1, 1).write(tmp_path)), "--scale", "smoke", "--params", str(quick_root), "--output", str(output)]
    monkeypatch.setattr(plant_report, "pass_gate", lambda *given: replace(learn.pass_gate(*given), released=True))
    monkeypatch.setattr(plant_report, "export_c", lambda *_: None)
    monkeypatch.setattr(plant_report, "disagreement", lambda *_: np.nan)
    assert plant_report.main(arguments) == 2
    assert "the exported policy differs from the learned one by nan" in capsys.readouterr().err

    def full(*_):
        raise OSError(28, "No space left on device", "report.md")

    monkeypatch.setattr(plant_report, "work", lambda *_: ("title", None))
    monkeypatch.setattr(plant_report, "write", full)
    assert plant_report.main(arguments) == 1
    assert capsys.readouterr().err == "error: report.md: No space left on device\n"
    assert {file.name: file.read_text(encoding="utf-8") for file in output.iterdir()} == {"report.md": "old"}
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".out")]


@pytest.mark.parametrize(
    ("changes", "output", "status", "says"),
    [
        ({"time_unit": "week"}, "out", 2, "key 'time_unit'"),
        ({"plant": "gymnasium:NoSuch-v0"}, "out", 2, "plant 'gymnasium:NoSuch-v0': "),
        ({}, "plant.yaml/out", 1, "plant.yaml"),
        ({}, PROJECT / "src/helpers", 2, "parameter 'output': inside the project results go below results/ and reports/"),
    ],
)
def test_what_cannot_end_well_is_refused_before_learning(changes, output, status, says, tmp_path, root, capsys, monkeypatch):
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


def test_a_record_with_too_few_episodes_of_one_task_costs_the_weights_only(trained):
    plant = trained[1].plant
    longer = replace(plant, description=plant.description.model_copy(update={"horizon": 300}))
    found, (words,) = plant_report.offline(longer, trained[1])
    assert found == {}
    assert words.startswith("the weights of the record's controller were not found: plant.csv: 0 episodes of 300 samples")


@pytest.mark.parametrize(("worse", "share"), [(1.0, 1.0), (-1.0, 2.0**-online.HALVINGS)])
def test_the_disturbance_is_halved_until_the_exploring_episodes_are_hardly_ever_worse(trained, worse, share):
    _, workshop, policy = trained
    plant = workshop.plant
    settings = plant.params.online.model_copy(update={"worse": 2 * worse})
    plant = replace(plant, params=plant.params.model_copy(update={"online": settings}))
    size = online.gentle(replace(workshop, plant=plant), policy, plant.stream("a test"))
    assert torch.equal(size, share * settings.disturbance * workshop.operation.bounds.span)


def test_a_few_episodes_of_the_plant_change_the_policy_only_for_a_better_one(trained):
    identified, workshop, policy = trained
    improvement = online.improve_on_plant(workshop, identified, policy, workshop.nominal)
    assert improvement.taken == (improvement.policy is not policy)
    assert improvement.words.startswith("20 episodes of the plant: ")
    assert not improvement.taken or improvement.after < improvement.before


def test_the_description_the_command_and_the_loop_of_the_docs_are_read_and_run_as_they_stand(tmp_path, quick_root, monkeypatch):
    page = (PROJECT / "docs/your_own_plant.md").read_text(encoding="utf-8")
    (yaml,), (shell,), (python,) = (re.findall(rf"```{kind}\n(.*?)```", page, re.DOTALL) for kind in ("yaml", "sh", "python"))
    (tmp_path / "plant.yaml").write_text(yaml, encoding="utf-8")
    assert load_description(tmp_path / "plant.yaml").columns == ("TIME", "MODE", "TC1.PV", "TC1.OP", "TC1.SP")
    words = shlex.split(shell, comments=True)
    assert f"{shlex.join(words)}\n" in (PROJECT / "README.md").read_text(encoding="utf-8")  # which shows the same
    assert words[:4] == [".venv/bin/python", "-m", "helpers", "plant"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plant_report, "export_c", lambda static, path: path.touch())  # takes seconds; tested in test_deploy.py
    monkeypatch.setattr(plant_report, "pass_gate", lambda *given: replace(learn.pass_gate(*given), released=True))
    (tmp_path / "notebooks/plant").mkdir(parents=True)
    shutil.copy(PROJECT / "notebooks/plant/tank.yaml", tmp_path / "notebooks/plant")
    rows = FILE.read_text(encoding="utf-8").splitlines(keepends=True)[:3000]  # a quarter of them
    (tmp_path / "notebooks/plant" / FILE.name).write_text("".join(rows), encoding="utf-8")
    assert command.main([*words[3:], "--params", str(quick_root)]) == 0
    assert "## Controllers on models held out" in (tmp_path / "results/tank/report.md").read_text(encoding="utf-8")
    assert DeployedPolicy(tmp_path / "results/tank/policy.onnx").notes["set_point_range"] == [[1.5, 3.0], [350.0, 354.0]]
    namespace = {}
    exec(python, namespace)
    assert namespace["inputs"] == pytest.approx([24.0, 410.0])  # without a jump from what the operator applied
    assert namespace["guard"].mode == "policy"
