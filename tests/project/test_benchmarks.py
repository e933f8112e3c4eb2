"""The benchmarks: their arithmetic, their baselines against the project's own code, and what they write. No time is asserted."""

import json
import platform
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks import benchmark, outcome, subjects, whole_run
from benchmarks.one_at_a_time import OneAtATime
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


def test_the_bound_counts_what_a_learnt_step_cannot_do_without(workload):
    """Two operations a multiply-add; every weight in the rollout and twice in its gradient, but for the gradient in the inputs."""
    policy = workload.learner(2, 5)[0].policy
    weights = sum(parameter.numel() for name, parameter in policy.named_parameters() if "weight" in name)
    assert subjects.flops_of_a_learnt_step(workload.params) == 2 * (3 * weights - policy.layers[0].weight_ih_l0.numel()) == 30560
    assert workload.bound(1, 7).steps * 30560 == pytest.approx(7 * 2 * 500 * 40 * 80)
    assert workload.gates(1, 3).steps * 200 == pytest.approx(3 * 500 * 100)  # five functions of forty cells in the rollout


def test_rates_and_ratios_follow_from_the_median_and_the_bound_of_as_many_threads():
    timings = {
        Subject(subjects.BOUND, 1, 500, 1, 100, print): [1.0, 2.0, 9.0],  # 50 a second
        Subject(subjects.BOUND, 2, 500, 1, 100, print): [4.0],  # slower with two threads: one thread's bound holds
        Subject(subjects.OURS, 1, 10, 5, 50, print): [2.0],
        Subject(subjects.OURS, 2, 10, 5, 50, print): [5.0, 5.0],
    }
    frame = outcome.table(timings, {(10, 5): 3.0})
    assert list(frame.columns[:6]) == FIRST_COLUMNS
    assert [frame[name].tolist() for name in FIRST_COLUMNS[4:]] == [[50, 25, 25, 10], [1, 0.5, 0.5, 0.2]]
    assert frame.loc[0, ["seconds", "seconds_min", "seconds_max", "rounds"]].tolist() == [2, 1, 9, 3]
    assert frame["peak_mb"].fillna(0).tolist() == [0, 0, 3, 3]


def test_every_round_meets_every_subject_once_after_a_warm_up_and_a_busy_machine_ends_them_early(monkeypatch):
    calls = []
    pair = [Subject(name, 1, 1, 1, 1, lambda name=name: calls.append(name)) for name in "ab"]
    assert [len(seconds) for seconds in benchmark.in_rounds(pair, 2).values()] == [2, 2]
    assert calls == ["a", "b"] * 3
    monkeypatch.setattr(benchmark, "ENOUGH_SECONDS", 0.0)
    assert [len(seconds) for seconds in benchmark.in_rounds(pair, 9).values()] == [benchmark.FEWEST_ROUNDS] * 2


def test_exponents_of_time_and_memory_are_fitted_along_both_axes():
    size = replace(subjects.QUICK, many_episodes=(10, 20, 40), many_steps=(2, 4, 8), K=20, T=4)
    pairs = subjects.scaling_sizes(size)
    assert pairs == [(10, 4), (20, 4), (40, 4), (20, 2), (20, 8)]
    made = {Subject(subjects.OURS, 1, K, T, K * T, print): [K * T**2] for K, T in pairs}
    scaled = outcome.table(made, {(K, T): K**0.5 * T for K, T in pairs})
    fits = outcome.exponents(scaled, 20, 4)
    assert fits["exponent"].tolist() == pytest.approx([1, 0.5, 2, 1])  # seconds and memory in K, then in T
    assert fits["factor"].tolist() == pytest.approx([16, 4, 20, 20**0.5])
    figure = outcome.scaling_figure(scaled, fits, 20, 4)
    outcome.plt.close(figure)
    legends = [text.get_text() for axis in figure.axes for text in axis.get_legend().get_texts()]
    assert legends == ["slope 1.00", "slope 2.00", "slope 0.50", "slope 1.00"]
    assert all(axis.get_xscale() == axis.get_yscale() == "log" for axis in figure.axes)
    assert np.isnan([outcome.fitted_exponent([5, 5], [1.0, 2.0]), outcome.fitted_exponent([5, 6], [0.0, 2.0])]).all()


def shaken(workload, K, T, dtype, credit="reward_to_go"):
    """A learner away from the initial standard deviation, which is the same everywhere, and its reward."""
    learner, reward = workload.learner(K, T, workload.learner_params.model_copy(update={"credit": credit}), dtype)
    with torch.no_grad():
        for parameter in learner.policy.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=stream(1, "shake"), dtype=F64))
    return learner, reward


def project_gradient(learner, reward, batch):
    """The surrogate of the project's own learner on a batch, and the gradient in the parameters of its policy, which hold it."""
    log_probability = learner.policy.log_probability(batch.y, batch.u, batch.command, learner.features.task)
    gain = surrogate(log_probability, learner.advantage(reward(batch), batch))
    gain.backward()
    return gain.item(), {name: parameter.grad for name, parameter in learner.policy.named_parameters()}


@pytest.mark.parametrize("credit", ["reward_to_go", "whole_return"])
def test_one_episode_at_a_time_has_the_loss_and_the_gradient_of_the_batch_and_leaves_the_given_policy_alone(workload, credit):
    learner, reward = shaken(workload, 14, 6, F64, credit)
    other = OneAtATime(learner)
    gain, batch = other.gain(reward)
    gain.backward()
    expected, gradient = project_gradient(learner, reward, batch)
    assert batch.x.shape == (7, 14, 2)
    assert gain.item() == pytest.approx(expected, rel=1e-10, abs=1e-10)
    before = learner.policy.output.bias.detach().clone()
    for name, parameter in other.policy.named_parameters():
        torch.testing.assert_close(parameter.grad, gradient[name], rtol=1e-10, atol=1e-10)
        assert parameter.grad.abs().max() > 0
    other.epoch(reward)
    assert torch.equal(learner.policy.output.bias, before)
    assert not torch.equal(other.policy.output.bias, before)


@pytest.mark.skipif(not subjects.installed("jax"), reason="needs the extra 'bench'")
def test_the_epoch_in_jax_has_the_gradient_of_the_batch(workload):
    from benchmarks.jax_epoch import JaxLearner, jax  # noqa: PLC0415

    learner, reward = shaken(workload, 40, 6, torch.float32)
    other = JaxLearner(learner, reward.keywords["weights"])
    noise = other.noise(jax.random.key(1))
    log_probability, signals = other.episodes(other.theta, noise)
    x, y, u, command = (torch.from_numpy(np.array(signals[name])) for name in ("x", "y", "u", "command"))
    batch = Trajectories(torch.cat([x[:1], x]), torch.cat([y, y[-1:]]), u, command)  # x_0 and y_T play no part
    expected = learner.policy.log_probability(batch.y, u, command, learner.features.task).detach()
    np.testing.assert_allclose(log_probability, expected, rtol=1e-3, atol=1e-3)
    found, gradient = other.gradient(other.theta, noise), project_gradient(learner, reward, batch)[1]
    for name, value in gradient.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-3, atol=1e-3 * value.abs().max())
    other.epoch()
    assert not np.array_equal(other.theta["output.bias"], learner.policy.output.bias.detach())


@LIBRARY
@pytest.mark.parametrize("signal", ["x", "y"])
def test_the_environment_is_the_process_with_its_reward(workload, signal):
    from benchmarks.recurrent_ppo import ProcessEnv  # noqa: PLC0415

    given = workload.params
    params = type(given)(**{**vars(given), "features": given.features.model_copy(update={"features_on": signal})})
    learner, reward = Workload(params, workload.learner_params).learner(2, 8, dtype=F64)
    process = learner.process
    env, draws, actions = ProcessEnv(params, 8), np.random.default_rng(), np.random.default_rng(1)
    env.reset(seed=3)
    draws.bit_generator.state = env.np_random.bit_generator.state
    xs, ys, us, rewards = [env.x], [env.y], [], []
    for action in actions.uniform(-1.5, 1.5, (8, 2)):
        noise = draws.standard_normal((process.integration_steps + 1, 2))  # of the process, then of the observation
        _, gained, ended, _, info = env.step(action)
        expected = process.step(*(torch.tensor(value)[None] for value in (xs[-1], info["u"], noise[:-1].ravel())))
        np.testing.assert_allclose(info["x"], expected[0], rtol=1e-12)
        np.testing.assert_allclose(info["y"], process.observe(expected, torch.tensor(noise[-1])[None])[0], rtol=1e-12)
        xs, ys, us, rewards = [*xs, info["x"]], [*ys, info["y"]], [*us, info["u"]], [*rewards, gained]
    assert ended
    x, y, u = (torch.tensor(np.array(values))[:, None] for values in (xs, ys, us))
    np.testing.assert_allclose(rewards, reward(Trajectories(x, y, u, u))[:, 0], rtol=1e-10)


@LIBRARY
def test_the_library_learns_with_our_layers_one_batch_a_run(workload):
    subject = workload.library(3, 4, 1)
    model = subject.run.func.__self__
    assert (model.policy.lstm_actor.hidden_size, model.policy.lstm_actor.num_layers) == (20, 2)
    subject.run()
    before = model.num_timesteps
    subject.run()
    assert model.num_timesteps - before == subject.steps == 12


@pytest.mark.torture
def test_a_quick_run_writes_everything_and_peak_memory_is_that_of_learning_alone(tmp_path, monkeypatch):
    assert 0 <= benchmark.peak_memory([(12, 4)])[12, 4] < 50  # MB, without the hundreds that Python and torch take
    monkeypatch.setattr(benchmark, "peak_memory", lambda sizes: {(K, T): 0.1 * K * T for K, T in sizes})  # a process a size
    monkeypatch.setattr(benchmark, "code_revision", lambda _: "abc+changes" if any(tmp_path.iterdir()) else "abc")
    assert benchmark.main(["--quick", "--out", str(tmp_path)]) == 0
    tables, texts = {"benchmarks.csv", "exponents.csv"}, ["summary.md", "machine.md", "scaling.svg"]
    assert {path.name for path in tmp_path.iterdir()} == {*tables, *texts}
    frame = pd.read_csv(tmp_path / "benchmarks.csv")
    compared = frame[~frame["what"].str.startswith("scaling")]
    rows = set(compared[["what", "threads"]].itertuples(index=False, name=None))
    of_ours = product((subjects.OURS, subjects.OURS_AS_SET, subjects.BOUND, subjects.GATES), (1, 2))
    assert {*of_ours, (subjects.SIDE_BY_SIDE, 2)} <= rows
    assert len(compared) == 10 + 4 * subjects.library_installed() + subjects.installed("jax")
    assert len(frame) - len(compared) == len(subjects.scaling_sizes(subjects.QUICK))
    assert (frame[["steps_per_s", "ratio_to_bound", "seconds_min"]] > 0).all(axis=None)
    assert frame["seconds"].between(frame["seconds_min"], frame["seconds_max"]).all()
    summary, machine, drawing = ((tmp_path / name).read_text(encoding="utf-8") for name in texts)
    assert summary.index("Ratio") < summary.index("Seconds")
    assert subjects.ONE_AT_A_TIME in summary
    places = (Path.home(), subjects.PROJECT, platform.node())
    assert [place for place in places if str(place) in summary + machine + drawing] == []
    row = next(line for line in machine.splitlines() if "code" in line.lower())
    assert row.split("|")[2].strip() == "abc"  # what a run writes is no change of the code that it measured


def test_stages_are_read_from_the_records_of_the_run(tmp_path):
    """One stage with two results is one row; the report has no record of its own."""
    log = "results/paper/seed_0/case_3/notebooks/04_knowledge_transfer_improved.ipynb"
    job, report = ({"log": [path]} for path in (log, "reports/notebooks/05_report.ipynb"))
    files = {f".snakemake/metadata/{name}": job | {"starttime": 20.0, "endtime": 32.0} for name in "bc"}
    files[".snakemake/metadata/a"] = report | {"starttime": 40.0, "endtime": 45.0}
    for folder, seconds in (("transfer_improved", 5.0), ("online_improved", 7.5), ("transfer_printed", 9.0)):
        record = {"notebook": "04_knowledge_transfer", "variant": folder.partition("_")[2], "seconds": seconds}
        files[f"results/paper/seed_0/case_3/{folder}/record.json"] = record
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(json.dumps(content))
    transfer, report = ([row[name] for name in whole_run.COLUMNS] for row in whole_run.stage_times(tmp_path))
    assert transfer == ["04_knowledge_transfer", 3, "improved", 12.0, 7.5, 4.5]
    assert report == ["05_report", None, "", 5.0, 0.0, 5.0]
