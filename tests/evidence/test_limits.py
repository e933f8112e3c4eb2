"""The verbs of notebook 06, at a size where each can be checked by another route."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from helpers.evidence import equal_budget, exploration, limits, robustness
from helpers.evidence.attainable import Tabulated
from helpers.evidence.scheduled_pid import ScheduledPID
from helpers.learning.evaluation import objective
from helpers.learning.learner import TrainingError
from helpers.plant.controllers import PID
from helpers.report import limits_answer
from helpers.report.limits_figures import LABELS, budget_curves, gap_figure, heat_maps, regret_figure
from helpers.runs.study import Study
from tests.plant.test_controllers import run


@pytest.fixture(scope="module")
def contest(short):
    found = limits.enter(short(2, "06_limits_and_alternatives"))
    small = {"draws": 60, "episodes": 24, "listed": (0, 12, 24), "every": 12, "judged": 20, "grid": 4}
    scale = found.scale.model_copy(update=small)
    params = found.limits.model_copy(update={"scales": {"smoke": scale}})
    params = params.model_copy(update={"tuning": params.tuning.model_copy(update={"episodes": 1})})
    return replace(found, limits=params)


@pytest.fixture(scope="module")
def attained(contest):
    return limits.attainable(contest)


@pytest.fixture(scope="module")
def learned(contest):
    return equal_budget.learn_all(contest) | {"one_policy": limits.through_the_model(contest)}


def test_the_grids_say_whether_they_agree(contest, attained):
    _, grids = attained
    for row in grids.to_dict("records"):
        close = abs(row["difference"]) <= 0.005 and abs(row["change"]) <= 0.005
        least = row["minimum_variance_x"] * (1 - contest.limits.attainable.tolerance)
        assert bool(row["agrees"]) == (close and min(row["value"], row["monte_carlo"]) >= least)
        assert row["value"] == pytest.approx(row["monte_carlo"] * (1 + row["difference"]))


@pytest.mark.torture
def test_every_alternative_has_a_curve_within_its_budget_and_what_does_not_learn_keeps_its_value(contest, learned):
    curves = equal_budget.curves(learned)
    ending = {"irl_alone"} | {f"{start}_reinforce" for start in ("irl", "clone", "csil", "scratch")}
    assert set(learned) == {"clone", *ending, "pid_tuned", "pid_scheduled", "mpc", "one_policy"}
    assert set(learned) < set(LABELS)
    for name, curve in curves.groupby("learner"):
        assert curve["episodes"].min() == 0
        assert curve["episodes"].max() <= contest.scale.episodes, name
        assert curve["episodes"].is_monotonic_increasing
    last = curves.groupby("learner")["episodes"].max()
    assert last[["irl_reinforce", "scratch_reinforce"]].tolist() == [24, 24]
    assert last[["clone", "mpc", "one_policy"]].tolist() == [0, 0, 0]
    assert 0 < last["pid_tuned"] <= 24
    table = equal_budget.at_budgets(curves, contest)
    assert table.columns.tolist() == [0, 12, 24]
    assert (table.loc["mpc"] == table.loc["mpc", 0]).all()
    assert table.notna().all(axis=None)
    returns = contest.returns(contest.session.fresh(contest.session.expert, contest.scale.judged))
    for name in ("pid_tuned", "pid_scheduled"):  # the searches begin with the demonstrator
        assert table.loc[name, 0] == pytest.approx(returns.mean().item())


def test_constant_weights_schedule_nothing_and_others_follow_the_error(contest):
    session, gains = contest.session, {"proportional": (2.0, -3.0), "integral": (0.5, -1.0), "derivative": (0.1, 0.2)}
    given, dt = session.params.demonstrator.model_copy(update=gains), session.params.process.sampling_time
    unit, target = torch.tensor([0.1, 0.4], dtype=torch.float64), session.task.set_point
    observed = torch.randn(6, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def scheduled(weights):
        return ScheduledPID(weights, given, 0.1, unit, target, session.task, dt)

    weights = torch.zeros(2, ScheduledPID.n_weights(2, 3), dtype=torch.float64)
    plain = run(scheduled(weights), observed)
    assert torch.allclose(plain, run(PID(given, target, dt), observed))
    weights[1, -24:] = torch.tensor([0.0, 0.0, 0.0, 2.0], dtype=torch.float64).log1p().repeat(6)  # every constant ln 3
    weights[1, -8:] = 0
    tripled = given.model_copy(update={name: tuple(3 * gain for gain in gains[name]) for name in ("proportional", "integral")})
    both = run(scheduled(weights), observed)
    assert torch.allclose(both[:, :2], plain[:, :2])  # the first of two controllers side by side
    assert torch.allclose(both[:, 2:], run(PID(tripled, target, dt), observed)[:, 2:])
    weights[0, 0], weights[0, -24] = 1.0, 1.0  # a cell that sees the first error, and the first gain that follows it
    error = (target - observed[0]) / unit
    p, _, _ = scheduled(weights).gains(target - observed[0])
    assert torch.allclose(p[:2, 0], 2.0 * torch.tanh(error[:2, 0]).exp())


def test_the_coherent_reward_is_greatest_where_the_clone_acts(contest):
    """As Watson et al. 2023 have it: ln of a ratio of densities, nought where the clone is as likely as an even input."""
    batch, task = contest.demonstrations.trajectories, contest.session.task
    reward = equal_budget.coherent_reward(contest, contest.clone)
    mode = contest.clone(batch.y, batch.u, task)[0].detach()
    spread = (mode - batch.u).square().mean((0, 1)).sqrt()
    span = task.input_high - task.input_low
    best = reward(replace(batch, command=mode))
    assert torch.allclose(best, (span / (spread * (2 * torch.pi) ** 0.5)).log().sum().expand_as(best))
    away = reward(replace(batch, command=mode + torch.tensor([1.0, 2.0]) * spread))
    assert torch.allclose(best - away, torch.full_like(best, 2.5))


def test_the_reward_is_dense_at_first_where_asked(contest):
    assert [contest.sharpness(episodes, True) for episodes in (0, 2, 3, 24)] == [3.0, 3.0, 30.0, 30.0]
    assert contest.sharpness(0, False) == 30.0


def test_a_library_that_is_missing_is_one_sentence(contest, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "stable_baselines3", None)
    monkeypatch.delitem(__import__("sys").modules, "helpers.evidence.library_learners", raising=False)
    monkeypatch.delattr("helpers.evidence.library_learners", raising=False)
    with pytest.raises(equal_budget.PackageError, match=r"ppo needs a package that is not installed .*\[alternatives\]"):
        equal_budget.from_library(contest, "ppo")


def test_gaps_are_to_the_programme_on_the_same_draws(contest, attained, learned):
    optimum, _ = attained
    table = limits.gaps(contest, optimum, learned).set_index("controller")
    best = table.loc["dynamic_programme"]
    assert (best["gap"], best["gap_low"], best["gap_high"]) == (0.0, 0.0, 0.0)
    exact = limits.without_noise(contest.session)
    expected = objective(exact.fresh(Tabulated(optimum), contest.scale.draws), exact.features.on("x"), 30.0).mean()
    assert best["objective"] == pytest.approx(expected.item())
    for _, row in table.iterrows():
        assert row["gap_low"] <= row["gap"] <= row["gap_high"]
    share = table.loc["mpc", "objective"] / best["objective"]
    assert table.loc["mpc", "gap"] == pytest.approx(100 * (1 - share))
    budget = equal_budget.at_budgets(equal_budget.curves(learned), contest)
    assert "below the programme" in limits_answer.answer(table, budget)


def test_the_interval_of_a_gap_covers_as_it_should():
    """Paired ratios of known mean, 400 times."""
    generator, covered = torch.Generator().manual_seed(0), 0
    for _ in range(400):
        common = torch.rand(200, generator=generator, dtype=torch.float64)
        best, values = 20 + common, 0.9 * (20 + common) + torch.randn(200, generator=generator, dtype=torch.float64)
        gap = limits._gap(values, best)
        covered += gap["gap_low"] <= 10.0 <= gap["gap_high"]
    assert 0.92 < covered / 400 < 0.98


def test_the_scorecard_holds_every_figure_of_every_controller(contest, attained):
    optimum = attained[0]
    builds, still = (limits.of_the_paper(contest) | limits.known_process(contest, optimum, flag) for flag in (False, True))
    table = limits.control_quality(contest, builds, still).set_index(["controller", "figure"])["value"]
    figures = {name for controller, name in table.index if controller == "expert"}
    for controller in builds:
        assert {name for one, name in table.index if one == controller} == figures
    assert {"ise:C_A", "settling_time_2_single:T", "harris:T", "at_bound:T_E", "iae_worst:C_A"} <= figures
    assert (table.xs("iae_worst:T", level="figure") >= table.xs("iae:T", level="figure")).all()


def everywhere(contest):
    """The contest under every condition, as at paper scale."""
    scale = contest.scale.model_copy(update={"corners": False})
    return replace(contest, limits=contest.limits.model_copy(update={"scales": {contest.session.scale: scale}}))


def test_conditions_differ_in_what_they_name(contest):
    found = {(one.group, one.row, one.column): one for one in robustness.conditions(everywhere(contest))}
    assert len(found) == 25 + 16 + 16 + 4
    at_the_corners = [(one.group, one.row, one.column) for one in robustness.conditions(contest)]
    assert len(at_the_corners) == 4 * 4
    assert set(at_the_corners) < found.keys()
    nominal = contest.session.process
    scaled = found["model", "1.3", "0.7"].plant.process
    assert torch.allclose(scaled.drift_state, 1.3 * nominal.drift_state)
    assert torch.allclose(scaled.drift_input, 0.7 * nominal.drift_input)
    quiet = found["noise", "0", "4"].plant.process
    assert not quiet.disturbance_gain.any()
    assert torch.allclose(quiet.observation_noise, 4 * nominal.observation_noise)
    told = found["set_point", "0.5", "1.25"]
    assert told.told.task.set_point.tolist() == [0.5, 5.0]
    assert told.told.expert.set_point.tolist() == [0.5, 5.0]
    assert (found["time", "1", "0.03"].dead_time, found["time", "1", "0.03"].load) == (1, 0.03)


def test_nominal_conditions_give_the_nominal_objective(contest):
    table = robustness.robustness(everywhere(contest), {"expert": lambda run: run.expert})
    table = table.set_index(["group", "row", "column"])["objective"]
    returns = contest.returns(contest.session.fresh(contest.session.expert, contest.scale.grid)).mean()
    for key in (("model", "1", "1"), ("noise", "1", "1"), ("set_point", "1", "1"), ("time", "0", "0")):
        assert table[key] == pytest.approx(returns.item())
    assert table["time", "1", "0"] != table["time", "0", "0"]


def test_exploring_is_paired_with_the_pid_on_the_same_draws(contest):
    episodes = exploration.exploring_episodes(contest)
    assert episodes.groupby("run", sort=False).size().tolist() == [2 * contest.batch] * 3  # one epoch in each of two rounds
    hot, cloned, scratch = (group["expert"].to_numpy() for _, group in episodes.groupby("run", sort=False))
    assert hot == pytest.approx(scratch)  # all runs draw from the same stream, whatever their policies do
    assert hot == pytest.approx(cloned)
    found = exploration.safety(episodes).set_index("run").loc["scratch"]
    rows = episodes[episodes["run"] == "scratch"]
    assert found["worst"] == rows["objective"].min()
    assert found["regret"] == pytest.approx((rows["expert"] - rows["objective"]).sum())
    assert found["worse"] == np.mean(rows["expert"] > rows["objective"])


def test_figures_show_the_tables(contest):
    curves = pd.DataFrame({"learner": ["ppo", "ppo"], "episodes": [0, 10], "objective": [1.0, 2.0]})
    (axes,) = budget_curves(curves, {"mpc": 3.0}).axes
    assert [line.get_ydata()[-1] for line in axes.lines] == [2.0, 3.0]
    gaps = pd.DataFrame({"case": 1, "controller": ["expert", "mpc"], "gap": [20.0, 5.0], "gap_low": 1.0, "gap_high": 21.0})
    (axes,) = gap_figure(gaps).axes
    assert axes.lines[0].get_xdata().tolist() == [5.0, 20.0]  # the first controller on top
    robust = robustness.robustness(contest, {"expert": lambda run: run.expert, "mpc": lambda run: run.minimum_variance})
    maps = heat_maps(robust, "time", ["expert", "mpc"])
    texts = [text.get_text() for text in maps.axes[1].texts]
    wanted = robust.query("group == 'time' and controller == 'mpc'")["objective"]
    assert texts == [f"{value:.1f}" for value in wanted]
    episodes = pd.DataFrame({"run": "hot", "epoch": [1, 1, 2], "episode": [1, 2, 3], "objective": [1.0, 5.0, 4.0], "expert": 3.0})
    dip, left, right = regret_figure(episodes).axes
    assert dip.lines[0].get_ydata() == pytest.approx([100.0, 400 / 3])
    assert left.lines[0].get_ydata().tolist() == [1.0, 4.0]
    assert right.lines[0].get_ydata().tolist() == [2.0, 0.0, -1.0]


def test_where_a_plant_earns_nothing_the_policy_stays_as_it_is(contest, monkeypatch):
    def fails(*_):
        raise TrainingError("every episode earned the same reward")

    monkeypatch.setattr(Study, "improve", fails)
    there = robustness.improved_on_mismatch(contest).pivot_table(index=["state", "input"], columns="controller", values="objective")
    assert len(there) == 2
    assert there["online_there"].equals(there["offline"].rename("online_there"))
