"""The verbs of the notebooks at smoke scale, on the committed inputs: what they return, what they cost, that they repeat."""

import copy
import hashlib
import os
import subprocess
import sys

import pandas as pd
import pytest
import torch
from safetensors.torch import save as save_tensors

from helpers.learning.policy import LSTMPolicy
from helpers.runs.artifacts import ArtifactError
from helpers.runs.session import open_session
from helpers.runs.sources import PROJECT
from helpers.runs.study import cost, history_table, score_table, weight_table

EPOCHS_OF_THE_PAPER = {1: (300, [10, 10]), 2: (250, [10, 10]), 3: (80, [10, 10])}
COST = {"epochs", "episodes", "gradient_steps"}
FEATURES = {"C_A-I", "T-I", "C_A-II", "T-II", "C_A-III", "T-III"}
CONTROL = {"objective", "objective_x", "objective_y", "movement:C_A0", "movement:T_E"}
CONTROL |= {f"{kind}:{loop}" for kind in ("overshoot", "offset", "rise_time") for loop in ("C_A", "T")}
CONTROL |= {f"v:{name}{what}" for name in FEATURES for what in ("", ":std")}


def session(case=1, variant="improved", scale="smoke", **given):
    roots = dict.fromkeys(("input_root", "output_root", "params_root"), "")
    return open_session("02_offline_irl", {"case": case, "seed": 0, "scale": scale, "variant": variant, **roots, **given})


def learn(case=1, variant="improved"):
    """Offline, then online, as notebooks 02 and 03 do; a hash of all that was learned comes with it."""
    run = session(case, variant)
    demonstrations = run.load_demonstrations()
    offline = run.imitate(demonstrations, run.fresh_policy())
    online = run.improve(copy.deepcopy(offline.policy), "x")
    learned = b"".join(save_tensors(result.policy.state_dict()) for result in (offline, online)) + offline.weights.numpy().tobytes()
    return run, demonstrations, offline, online, hashlib.sha256(learned).hexdigest()


@pytest.fixture(scope="module")
def learned():
    return learn()


def test_demonstrations_are_what_notebook_01_recorded(learned):
    run, demonstrations, *_ = learned
    found = demonstrations.trajectories
    expected = (run.scale_params.demonstrations, run.params.process.horizon, run.dtype)
    assert (found.n_trajectories, found.n_steps, found.x.dtype) == expected
    rows = pd.read_csv(run.folder(run.input_root, "demonstrations") / "scores.csv").set_index("metric")["value"]
    # The few recorded trajectories and the many fresh ones are of one controller.
    known, true = demonstrations.features(run.features), demonstrations.true_features(run.feature_names)
    assert true.tolist() == pytest.approx([rows[f"v:{name}"] for name in run.feature_names])
    torch.testing.assert_close(known.double(), true.double(), rtol=0.15, atol=0)


def test_figures_of_merit_have_the_names_that_the_report_reads(learned):
    run, demonstrations, offline, online, _ = learned
    trajectories = run.fresh(offline.policy)
    imitation = run.judge_imitation(trajectories, demonstrations, offline)
    of_features = {f"{kind}:{name}" for kind in ("gap", "alpha") for name in FEATURES}
    assert imitation.keys() == CONTROL | COST | {"feature_gap", "chosen_epoch"} | of_features
    gaps = [abs(imitation[f"gap:{name}"]) for name in FEATURES]
    assert imitation["feature_gap"] == pytest.approx(sum(gaps) / len(gaps))
    assert sum(imitation[f"alpha:{name}"] ** 2 for name in FEATURES) == pytest.approx(1)
    improvement = run.judge(trajectories) | cost(online.records[-1])
    assert improvement.keys() == CONTROL | COST
    table = score_table({"offline": imitation, "online": improvement})
    assert (list(table), len(table)) == (["stage", "metric", "value"], len(imitation) + len(improvement))
    assert table["value"].map(lambda value: isinstance(value, (int, float))).all()


def test_the_steps_that_notebook_02_shows_are_those_of_the_verb(learned):
    """Its stored results come from the loop in its cell, maybe on another machine."""
    run, _, offline, *_ = learned
    stored = run.load("offline_improved", "02_offline_irl")
    assert stored.table("weights.csv")["alpha"].tolist() == pytest.approx(offline.weights.tolist(), rel=1e-6)
    history, own = stored.table("history.csv"), history_table(offline.records, run.feature_names)
    assert list(history) == list(own)
    assert history.to_numpy() == pytest.approx(own.to_numpy(), rel=1e-6)
    kept = stored.policy(run.params.learning, run.task).state_dict()
    for name, parameter in offline.policy.state_dict().items():
        torch.testing.assert_close(kept[name], parameter, rtol=1e-6, atol=1e-9)


def test_records_of_learning_become_tables(learned):
    run, _, offline, online, _ = learned
    history = history_table(offline.records, run.feature_names)
    counted = ["iteration", "epochs", "episodes", "gradient_steps"]
    assert list(history)[:4] == counted
    assert {"mean_return", "feature_gap", "learning_rate", "policy_std", *(f"alpha:{name}" for name in FEATURES)} <= set(history)
    assert (history[counted].diff().iloc[1:] > 0).all(axis=None)
    assert list(history_table(online.records, run.feature_names)["epochs"]) == [1, 2]
    weights = weight_table(run.feature_names, offline.weights)
    assert [weights["feature"].tolist(), weights["alpha"].tolist()] == [run.feature_names, offline.weights.tolist()]


def test_every_controller_meets_the_same_disturbances(learned):
    run, _, offline, *_ = learned
    expert, agent = (run.fresh(controller) for controller in (run.expert, run.deploy(offline.policy)))
    assert expert.n_trajectories == run.scale_params.evaluation
    assert [torch.equal(getattr(expert, name)[0], getattr(agent, name)[0]) for name in "xyu"] == [True, True, False]


def test_a_policy_comes_with_its_weights_also_from_another_case():
    run = session(case=3)
    policy, weights = run.load_policy("offline_improved", "02_offline_irl", 1)
    rows = pd.read_csv(run.folder(run.input_root, "offline_improved", 1) / "weights.csv").set_index("feature")["alpha"]
    assert (type(policy), weights.tolist()) == (LSTMPolicy, [rows[name] for name in run.feature_names])


def test_a_missing_upstream_result_names_file_and_notebook(tmp_path):
    run, says = session(input_root=str(tmp_path)), r"record\.json: this result is missing; run {} for case 1 first"
    with pytest.raises(ArtifactError, match=says.format("01_demonstrations")):
        run.load_demonstrations()
    with pytest.raises(ArtifactError, match=says.format("02_offline_irl")):
        run.load_policy("offline_improved", "02_offline_irl")


@pytest.mark.parametrize(("case", "variant"), [(1, "improved"), (3, "printed")])
def test_what_was_spent_stays_within_the_budget(learned, case, variant):
    run, _, offline, online, _ = learned if (case, variant) == (1, "improved") else learn(case, variant)
    epochs, rounds = EPOCHS_OF_THE_PAPER[case]
    budget, share = run.scale_params.episodes + run.scale_params.measured, run.scale_params.epoch_share
    assert budget <= 500
    for records, parts in ((offline.records, [epochs]), (online.records, rounds)):
        assert records[-1].epochs <= sum(max(1, round(part * share)) for part in parts)
        assert all(record.episodes <= budget * record.epochs for record in records)
    assert 1 <= offline.chosen_epoch <= offline.records[-1].epochs
    if variant == "printed":
        assert all(record.gradient_steps == record.epochs for record in offline.records)
        assert len(offline.records) <= run.params.case.offline.iterations


def test_a_rerun_is_bit_equal(learned):
    assert learn()[-1] == learned[-1]


@pytest.mark.torture
def test_a_rerun_with_another_number_of_threads_is_bit_equal(learned):
    """Other processes, whatever their environment says: the scale sets the threads."""
    environment = os.environ | {"OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2", "TQDM_DISABLE": "1"}
    command = [sys.executable, "-c", "from tests.runs import test_study; print(test_study.learn()[-1])"]
    done = subprocess.run(command, cwd=PROJECT, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == learned[-1]
