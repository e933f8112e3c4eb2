"""The benchmarks: their arithmetic, their baselines against the project's own code, and what they write. No time is asserted."""

import platform
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks import benchmark, outcome, subjects, whole_run
from benchmarks.one_at_a_time import OneAtATime, weighed
from benchmarks.subjects import Subject, Workload
from helpers.learning.learner import surrogate
from helpers.plant.rollout import stream
from helpers.plant.task import Trajectories

F64 = torch.float64
LIBRARY = pytest.mark.skipif(not subjects.library_installed(), reason="needs the extra 'bench'")
FIRST_COLUMNS = ["what", "threads", "K", "T", "steps_per_s", "ratio_to_bound"]


@pytest.fixture(scope="module")
def workload(root):
    return Workload.of(root)


# The arithmetic


def test_operations_of_a_learnt_step_from_the_parameters_of_the_network(workload):
    """Every weight takes part in one multiply-add a step; counted here from the policy itself."""
    policy = workload.parts(5)[0]
    weights = sum(parameter.numel() for name, parameter in policy.named_parameters() if "weight" in name)
    assert subjects.multiply_adds(workload.params) == weights == 5200
    assert subjects.flops_of_a_learnt_step(workload.params) == 4 * 2 * weights


def test_the_bound_counts_two_operations_a_multiply_add(workload):
    bound = workload.bound(1, 7)
    assert bound.steps * subjects.flops_of_a_learnt_step(workload.params) == pytest.approx(7 * 2 * 500 * 40 * 80)
    gates = workload.gates(1, 3)
    assert gates.steps * 2 * 200 == pytest.approx(3 * 500 * 100)  # two passes through five functions of forty cells


def test_exponent_of_a_power_law():
    sizes = np.array([100, 300, 1000, 3000])
    assert outcome.fitted_exponent(sizes, 0.02 * sizes**1.25) == pytest.approx((1.25, 0.02))
    assert np.isnan(outcome.fitted_exponent([5, 5], [1.0, 2.0])).all()
    assert np.isnan(outcome.fitted_exponent([5, 6], [0.0, 2.0])).all()


def test_rates_and_ratios_follow_from_the_median_and_the_bound_of_as_many_threads():
    timings = {
        Subject(subjects.BOUND, 1, 500, 1, 100, print): [1.0, 2.0, 9.0],  # 50 a second
        Subject(subjects.BOUND, 2, 500, 1, 100, print): [4.0],  # slower with two threads: one thread's bound holds
        Subject(subjects.OURS, 1, 10, 5, 50, print): [2.0],
        Subject(subjects.OURS, 2, 10, 5, 50, print): [5.0, 5.0],
    }
    frame = outcome.table(timings, {(10, 5): 3.0})
    assert list(frame.columns[:6]) == FIRST_COLUMNS
    assert frame["steps_per_s"].tolist() == [50, 25, 25, 10]
    assert frame["ratio_to_bound"].tolist() == [1, 0.5, 0.5, 0.2]
    assert frame.loc[0, ["seconds", "seconds_min", "seconds_max", "rounds"]].tolist() == [2, 1, 9, 3]
    assert frame["peak_mb"].tolist()[2:] == [3, 3]
    assert frame["peak_mb"][:2].isna().all()


def test_a_busy_machine_ends_the_rounds_early_but_not_too_early(monkeypatch):
    monkeypatch.setattr(benchmark, "ENOUGH_SECONDS", 0.0)
    timings = benchmark.in_rounds([Subject("a", 1, 1, 1, 1, int)], 9)
    assert [len(seconds) for seconds in timings.values()] == [benchmark.FEWEST_ROUNDS]


def test_every_round_meets_every_subject_once_after_a_warm_up():
    calls = []
    pair = [Subject(name, 1, 1, 1, 1, lambda name=name: calls.append(name)) for name in "ab"]
    timings = benchmark.in_rounds(pair, 2)
    assert calls == ["a", "b"] * 3
    assert [len(seconds) for seconds in timings.values()] == [2, 2]


def test_exponents_of_time_and_memory_are_fitted_along_both_axes(workload):
    size = replace(subjects.QUICK, many_episodes=(10, 20, 40), many_steps=(2, 4, 8), K=20, T=4)
    pairs = subjects.scaling_sizes(size)
    assert pairs == [(10, 4), (20, 4), (40, 4), (20, 2), (20, 8)]
    made = {Subject(subjects.OURS, threads, K, T, K * T, print): [K * T**2 / threads] for K, T in pairs for threads in (1, 2)}
    scaled = outcome.table(made, {(K, T): K**0.5 * T for K, T in pairs})
    fits = outcome.exponents(scaled, 20, 4).set_index(["quantity", "against", "threads"])["exponent"]
    assert fits.to_dict() == pytest.approx(
        {
            ("seconds", "K", 1): 1,
            ("seconds", "K", 2): 1,
            ("peak_mb", "K", 1): 0.5,
            ("seconds", "T", 1): 2,
            ("seconds", "T", 2): 2,
            ("peak_mb", "T", 1): 1,
        }
    )
    figure = outcome.scaling_figure(scaled, outcome.exponents(scaled, 20, 4), 20, 4)
    legends = [text.get_text() for axis in figure.axes for text in axis.get_legend().get_texts()]
    slopes = [float(re.search(r"slope ([\d.]+)", text)[1]) for text in legends]
    assert slopes == [1, 1, 2, 2, 0.5, 1]
    assert all(axis.get_xscale() == axis.get_yscale() == "log" for axis in figure.axes)
    outcome.plt.close(figure)


# The baselines against the project's own code


@pytest.mark.parametrize("credit", ["reward_to_go", "whole_return"])
def test_one_episode_at_a_time_has_the_loss_and_the_gradient_of_the_batch(workload, credit):
    policy, process, features, reward = workload.parts(6, F64)
    with torch.no_grad():  # away from the initial standard deviation, which is the same everywhere
        for parameter in policy.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=stream(1, "shake"), dtype=F64))
    params = workload.learner_params.model_copy(update={"credit": credit})
    learner = OneAtATime(policy, process, features, params, 14, stream(0, "episodes"))
    gain, batch = learner.gain(reward)
    gain.backward()
    log_probability = policy.log_probability(batch.y, batch.u, batch.command, features.task)
    ours = surrogate(log_probability, weighed(batch, reward, features, params))
    ours.backward()
    assert batch.x.shape == (7, 14, 2)
    assert gain.item() == pytest.approx(ours.item(), rel=1e-10, abs=1e-10)
    theirs = dict(learner.policy.named_parameters())
    for name, parameter in policy.named_parameters():
        torch.testing.assert_close(theirs[name].grad, parameter.grad, rtol=1e-10, atol=1e-10)
        assert parameter.grad.abs().max() > 0


def test_one_episode_at_a_time_takes_a_step_and_leaves_the_given_policy_alone(workload):
    policy, process, features, reward = workload.parts(3)
    before = policy.output.bias.detach().clone()
    learner = OneAtATime(policy, process, features, workload.learner_params, 2, stream(0, "episodes"))
    learner.epoch(reward)
    assert torch.equal(policy.output.bias, before)
    assert not torch.equal(learner.policy.output.bias, before)


@LIBRARY
@pytest.mark.parametrize("signal", ["x", "y"])
def test_the_environment_is_the_process_with_its_reward(workload, signal):
    from benchmarks.recurrent_ppo import ProcessEnv  # noqa: PLC0415

    given = workload.params
    params = type(given)(**{**vars(given), "features": given.features.model_copy(update={"features_on": signal})})
    policy, process, features, reward = Workload(params, workload.learner_params).parts(8, F64)
    env, draws, actions = ProcessEnv(params, 8), np.random.default_rng(), np.random.default_rng(1)
    env.reset(seed=3)
    draws.bit_generator.state = env.np_random.bit_generator.state
    env_again = ProcessEnv(params, 8)
    seen, _ = env_again.reset(seed=3)
    xs, ys, us, rewards, views = [env.x], [env.y], [], [], [seen]
    for t in range(8):
        action = actions.uniform(-1.5, 1.5, 2)
        noise = draws.standard_normal((2, 2))  # of the process, then of the observation
        seen, gained, ended, truncated, info = env.step(action)
        expected = process.step(*(torch.tensor(value)[None] for value in (xs[-1], info["u"], noise[0])))
        np.testing.assert_allclose(info["x"], expected[0], rtol=1e-12)
        np.testing.assert_allclose(info["y"], process.observe(expected, torch.tensor(noise[1])[None])[0], rtol=1e-12)
        assert (ended, truncated) == (t == 7, False)
        xs, ys, us, rewards, views = [*xs, info["x"]], [*ys, info["y"]], [*us, info["u"]], [*rewards, gained], [*views, seen]
    x, y, u = (torch.tensor(np.array(values))[:, None] for values in (xs, ys, us))
    np.testing.assert_allclose(rewards, reward(Trajectories(x, y, u, u))[:, 0], rtol=1e-10)
    previous = torch.cat([torch.zeros_like(u[:1]), u])
    np.testing.assert_allclose(np.array(views), policy.scaling(features.task).inputs(y, previous)[:, 0], rtol=1e-5, atol=1e-6)


@LIBRARY
def test_the_library_learns_with_our_layers_one_batch_a_run(workload):
    subject = workload.library(3, 4, 1)
    model = subject.run.func.__self__
    assert [(layer.hidden_size, layer.num_layers) for layer in [model.policy.lstm_actor]] == [(20, 2)]
    subject.run()
    before = model.num_timesteps
    subject.run()
    assert model.num_timesteps - before == subject.steps == 12


# The whole


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmarks")
    with pytest.MonkeyPatch.context() as patch:  # one process a size takes long; the next test starts one
        patch.setattr(benchmark, "peak_memory", lambda sizes: {(K, T): 0.1 * K * T for K, T in sizes})
        patch.setattr(benchmark, "code_revision", lambda _: "abc+changes" if any(out.iterdir()) else "abc")
        assert benchmark.main(["--quick", "--out", str(out)]) == 0
    return out


@pytest.mark.torture
def test_peak_memory_is_that_of_learning_alone():
    """Without the hundreds of MB that Python and torch take."""
    assert 0 <= benchmark.peak_memory([(12, 4)])[12, 4] < 50


@pytest.mark.torture
def test_a_quick_run_writes_everything(written):
    frame = pd.read_csv(written / "benchmarks.csv")
    size = subjects.QUICK
    assert list(frame.columns[:6]) == FIRST_COLUMNS
    compared = frame[~frame["what"].str.startswith("scaling")]
    rows = set(compared[["what", "threads"]].itertuples(index=False, name=None))
    for what in (subjects.OURS, subjects.OURS_AS_SET, subjects.BOUND, subjects.GATES):
        assert {(what, 1), (what, 2)} <= rows
    assert (subjects.SIDE_BY_SIDE, 2) in rows
    assert len(compared) == 10 + 4 * subjects.library_installed()
    assert len(frame) - len(compared) == len(subjects.scaling_sizes(size))
    assert (frame[["steps_per_s", "ratio_to_bound", "seconds_min"]] > 0).all(axis=None)
    assert frame["seconds"].between(frame["seconds_min"], frame["seconds_max"]).all()
    assert {path.name for path in written.iterdir()} == {
        "benchmarks.csv",
        "exponents.csv",
        "machine.md",
        "scaling.png",
        "scaling.svg",
        "summary.md",
    }


@pytest.mark.torture
def test_the_summary_begins_with_ratios_and_no_file_names_a_place(written):
    text = (written / "summary.md").read_text(encoding="utf-8")
    assert text.index("Ratio") < text.index("Seconds")
    assert subjects.ONE_AT_A_TIME in text
    for name in ("summary.md", "machine.md", "scaling.svg"):
        content = (written / name).read_text(encoding="utf-8")
        assert str(Path.home()) not in content
        assert str(subjects.PROJECT) not in content
        assert platform.node() not in content


@pytest.mark.torture
def test_what_a_run_writes_is_no_change_of_the_code_it_measured(written):
    row = next(line for line in (written / "machine.md").read_text(encoding="utf-8").splitlines() if "code" in line.lower())
    assert row.split("|")[2].strip() == "abc"


def test_stages_are_read_from_the_records_of_the_run(tmp_path):
    """One stage with two results is one row; the report has no record of its own."""
    log = "results/paper/seed_0/case_3/notebooks/04_knowledge_transfer_improved.ipynb"
    metadata = tmp_path / ".snakemake/metadata"
    metadata.mkdir(parents=True)
    jobs = {"b": (log, 20.0, 32.0), "c": (log, 20.0, 32.0), "a": ("reports/notebooks/05_report.ipynb", 40.0, 45.0)}
    for name, (path, start, end) in jobs.items():
        (metadata / name).write_text(f'{{"log": ["{path}"], "starttime": {start}, "endtime": {end}}}')
    for folder, notebook, variant, seconds in (
        ("transfer_improved", "04_knowledge_transfer", "improved", 5.0),
        ("online_improved", "04_knowledge_transfer", "improved", 7.5),
        ("transfer_printed", "04_knowledge_transfer", "printed", 9.0),
    ):
        path = tmp_path / "results/paper/seed_0/case_3" / folder / "record.json"
        path.parent.mkdir(parents=True)
        path.write_text(f'{{"notebook": "{notebook}", "variant": "{variant}", "seconds": {seconds}}}')
    names = ("stage", "case", "variant", "seconds", "work", "around")
    assert [tuple(row[name] for name in names) for row in whole_run.stage_times(tmp_path)] == [
        ("04_knowledge_transfer", 3, "improved", 12.0, 7.5, 4.5),
        ("05_report", None, "", 5.0, 0.0, 5.0),
    ]
