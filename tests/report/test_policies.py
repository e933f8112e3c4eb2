"""The policies to take along: each reaches the J on its card, and its ONNX file and C source act as it does."""

import ast
import ctypes
import re
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest
import torch

from helpers.learning.tracking_policy import Gains, TrackingPolicy
from helpers.own_plant.deploy import DeployedPolicy
from helpers.plant.tracking import Bounds
from helpers.report.policies import write_policies
from helpers.runs import policies
from helpers.runs.artifacts import ArtifactError, save_stage
from helpers.runs.policies import FOLDER, load_policy
from helpers.runs.sources import PROJECT

SMOKE = PROJECT / "notebooks/inputs/smoke/seed_0"
PUBLISHED = sorted(path.stem for path in FOLDER.glob("*.safetensors"))


@pytest.fixture(scope="module")
def written(tmp_path_factory, study):
    """The policies of Case III of the committed smoke run, and a made-up one for all cases."""
    first, folder = tmp_path_factory.mktemp("first"), tmp_path_factory.mktemp("policies")
    shutil.copytree(SMOKE / "case_3", first / "case_3")  # C source takes its time: one case will do
    params, task = study(1).params.learning.policy, study(1).task
    target = torch.stack([study(case).task.set_point for case in (1, 2, 3)])
    gains = Gains(*(size * torch.eye(2, dtype=torch.float64) for size in (5.0, 3.0, 0.0)))
    middle, reach = (target.amax(0) + target.amin(0)) / 2, (target.amax(0) - target.amin(0)) / 2
    torch.manual_seed(0)
    bounds = Bounds(task.input_low, task.input_high, reach)
    policy = TrackingPolicy(params, gains, task.set_point.abs(), middle, reach, bounds, kept=0.8)
    torch.nn.init.normal_(policy.output.weight, std=0.1)
    record = {"notebook": "09_one_policy", "seed": 0, "scale": "smoke", "revision": "0"}
    save_stage(first / "case_1/one_policy", record, {}, policy)
    write_policies(first, folder)
    return folder


def holds(name, folder):
    """The score of a policy is that of its card, and its ONNX file asks for the same inputs along the same episodes."""
    trained, file = load_policy(name, folder), DeployedPolicy(folder / f"{name}.onnx")
    assert trained.card == file.notes
    for case, scores in trained.card["scores"].items():
        study = trained.study(int(case))
        run = study.fresh(trained.policy)
        assert study.judge(run)["objective_x"] == pytest.approx(scores["policy"], rel=1e-3)
        before, span = np.zeros(run.u.shape[1:]), (study.task.input_high - study.task.input_low).double().numpy()
        file.reset(run.n_trajectories)
        aim = study.task.set_point.expand_as(run.y[0]).double().numpy()
        for y, u in zip(run.y[:-1].double().numpy(), run.u.double().numpy(), strict=True):
            assert np.abs((file.step(y, aim, before) - u) / span).max() < 1e-4
            before = u


@pytest.mark.parametrize("name", ["case_3_offline", "case_3_online", "one_policy"])
def test_a_written_policy_holds_its_score(written, name):
    holds(name, written)
    if name != "one_policy":
        stage = name.removeprefix("case_3_")
        folder = {"offline": "transfer_improved", "online": "online_improved"}[stage]
        told = pd.read_csv(SMOKE / "case_3" / folder / "scores.csv").set_index(["stage", "metric"])["value"]
        assert load_policy(name, written).card["scores"]["3"]["policy"] == pytest.approx(told[stage, "objective_x"], rel=1e-3)
    card = (written / f"{name}.md").read_text(encoding="utf-8")
    assert all(f"**{word}" in card for word in ("Trained on**", "For set points**", "Measured**", "Not for**"))


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_policy_holds_its_score(name):
    """On its card, and among the raw numbers of all seeds."""
    holds(name, FOLDER)
    every = pd.read_csv(FOLDER.parent / "seeds.csv").query("seed == 0 and metric == 'objective_x'")
    raw = every.set_index(["case", "stage"])["value"]
    for case, scores in load_policy(name).card["scores"].items() if name != "one_policy" else ():
        assert scores["policy"] == pytest.approx(raw[int(case), name.split("_")[-1]], rel=1e-3)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize("name", ["case_3_online", "one_policy"])
def test_the_c_source_acts_as_the_file(written, tmp_path, name):
    library = tmp_path / "policy.so"
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", written / f"{name}.c", "-o", library, "-lm"], check=True)
    function, file = ctypes.CDLL(str(library)).policy, DeployedPolicy(written / f"{name}.onnx")
    y, aim, u, memory = np.array([[0.3, -0.5]]), np.array([[-1.0, 4.0]]), np.zeros((1, 2)), file.memory
    for _ in range(20):
        after, applied = [np.empty_like(entry) for entry in memory], np.empty_like(u)
        function(*(ctypes.c_void_p(array.ctypes.data) for array in (y, aim, u, *memory, applied, *after)))
        assert applied == pytest.approx(file.step(y, aim, u), abs=1e-4)
        y, u, memory = y + 0.1 * (aim - y), applied, after


def test_the_five_lines_of_the_docs_run_as_they_stand(written, monkeypatch, capsys):
    (python,) = re.findall(r"```python\n(.*?)```", (PROJECT / "docs/policies.md").read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.setattr(policies, "FOLDER", written)
    exec(python, {})
    reached, rest = capsys.readouterr().out.split(" ", 1)
    assert float(reached) == pytest.approx(ast.literal_eval(rest)["3"]["policy"])


def test_what_is_no_policy_is_refused_in_one_sentence(written, tmp_path):
    with pytest.raises(ArtifactError, match=r"no such policy; the policies are: case_3_offline, case_3_online, one_policy"):
        load_policy("case_9", written)
    (tmp_path / "text.safetensors").write_text("no policy")
    with pytest.raises(ArtifactError, match=r"text\.safetensors: not a policy of this project"):
        load_policy("text", tmp_path)
