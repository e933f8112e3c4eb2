"""The search for the settings that the paper leaves out: readings against hand calculations, fits against known answers."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.integrate import solve_ivp

from helpers.evidence.identification import Fit, Problem, Profile, polish, profile, refit, search, steps
from helpers.evidence.readings import GAINS, MAIN, READINGS, TIME, Reading, ReadProcess, simulate, with_settings
from helpers.plant.rollout import rollout, stream
from helpers.runs.request import PROJECT
from helpers.settings.evidence import load_identification
from helpers.settings.leaf import ParameterError
from helpers.settings.paper import load
from tests.plant.test_rollout import CALM, plain_loop

ROOT = PROJECT / "params"
CASES = {case: load(ROOT, case) for case in (1, 2, 3)}
FIRST = CASES[1]
BOUND_T = ("input_bound", "T_E")
TRUTH = {TIME: 0.05, BOUND_T: 45.0}
AS_FILED = Reading(first_error=None)
REFERENCE = PROJECT / "reports/reference/inferred_settings"


def draws(seed=0, case=1):
    return stream(seed, case, "inferred_settings")


def features(reading, params=FIRST):
    """v of a case's demonstrator under a reading, with the settings of the files, on the same draws."""
    return simulate(params, {}, reading, 40, draws()).v


@pytest.mark.parametrize("case", CASES)
def test_the_first_reading_without_settings_is_the_demonstrator_of_the_parameter_files(study, case):
    filed = study(case)
    expected = filed.features.trajectory(rollout(filed.process, filed.pid, filed.task, 40, draws()))
    torch.testing.assert_close(features(AS_FILED, CASES[case]), expected, rtol=0, atol=0)


def test_settings_take_the_place_of_those_of_the_files():
    values = {TIME: 0.03, BOUND_T: 50.0, ("input_low", "C_A0"): -7.0, ("integral", "T"): 99.0}
    params = with_settings(FIRST, values, Reading(noise_as_variance=True, start_as_variance=True, samples=49, integration_steps=3))
    changes = {"sampling_time": 0.03, "input_low": (-7.0, -50.0), "input_high": (FIRST.process.input_high[0], 50.0)}
    changes |= {"horizon": 49, "integration_steps": 3, "observation_noise": params.process.observation_noise}
    assert params.process == FIRST.process.model_copy(update=changes)  # nothing else; and the files' record stays as it was
    integral = FIRST.demonstrator.integral[0], 99.0
    assert params.demonstrator == FIRST.demonstrator.model_copy(update={"integral": integral})
    assert [value**2 for value in params.process.observation_noise] == pytest.approx(FIRST.process.observation_noise)
    assert [value**2 for value in params.case.initial_std] == pytest.approx(FIRST.case.initial_std)


def test_the_exact_drift_is_the_solution_of_the_undisturbed_equation():
    """Against a numerical solution over one sampling interval with the input held."""
    process = FIRST.process
    A, B = np.array(process.drift_state), np.array(process.drift_input)
    x, u = np.array([0.7, -1.3]), np.array([9.0, -31.0])
    solved = solve_ivp(lambda _, z: A @ z + B @ u, (0, process.sampling_time), x, rtol=1e-10, atol=1e-12).y[:, -1]
    exact = ReadProcess(process, Reading(exact_drift=True), torch.Generator())
    found = exact.step(torch.tensor(x)[None], torch.tensor(u)[None], torch.zeros(1, 8).double())[0]
    np.testing.assert_allclose(found.numpy(), solved, rtol=1e-8)


def test_the_error_of_the_initial_state_takes_the_place_of_the_number(study):
    """Type III at t = 1 by hand from the true states; all later ones stay."""
    filed = study(1)
    start = rollout(filed.process, filed.pid, filed.task, 40, draws()).x[0]
    first = ((filed.task.set_point - start) / filed.task.set_point).abs()
    given, own = features(AS_FILED), features(MAIN)
    torch.testing.assert_close(own[:, :4], given[:, :4])
    torch.testing.assert_close(own[:, 4:] - given[:, 4:], (FIRST.features.initial_error - first) / FIRST.process.sampling_time)


@pytest.mark.parametrize(
    "changes",
    [{name: True} for name in ("conditional_integration", "derivative_from_zero", "bounded_integral", "delay")]
    + [{name: 0.5} for name in ("present_error", "error_memory")],
)
def test_the_pid_of_a_reading_without_noise(changes, monkeypatch):
    process = FIRST.process.model_copy(update=CALM)
    calm = replace(FIRST, process=process, case=FIRST.case.model_copy(update={"initial_std": (0.0, 0.0)}))
    seen = []

    def watched(*arguments):
        seen.append(rollout(*arguments))
        return seen[-1]

    monkeypatch.setattr("helpers.evidence.readings.rollout", watched)
    simulate(calm, {}, Reading(first_error=None, **changes), 2, draws())
    np.testing.assert_allclose(seen[0].command[:, 0].numpy(), plain_loop(FIRST, [0.0, 0.0], **changes)[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, lambda x, z, s, w, dt: z + x * s * w),
        ({"disturbance": "behind"}, lambda x, z, s, w, dt: z * (1 + s * w)),
        ({"disturbance": "once"}, lambda x, z, s, w, dt: z * (1 + s * w)),
        ({"disturbance": "milstein"}, lambda x, z, s, w, dt: z + x * (s * w + s**2 * (w**2 - 1) / 2)),
        ({"disturbance_power": 1.0}, lambda x, z, s, w, dt: z + x * s * w * dt**0.5),
        ({"one_disturbance": True}, lambda x, z, s, w, dt: z + x * s * w[0]),
    ],
)
def test_one_step_of_a_reading_by_hand(changes, expected):
    process = FIRST.process.model_copy(update={"integration_steps": 1})
    A, B, dt = np.array(process.drift_state), np.array(process.drift_input), process.sampling_time
    x, u, w = np.array([0.7, -1.3]), np.array([9.0, -31.0]), np.array([0.4, -1.7])
    found = ReadProcess(process, Reading(**changes), torch.Generator()).step(*(torch.tensor(v)[None] for v in (x, u, w)))[0]
    spread = np.array(process.disturbance) * dt**0.5
    np.testing.assert_allclose(found.numpy(), expected(x, x + (A @ x + B @ u) * dt, spread, w, dt), rtol=1e-12)


def test_the_disturbance_of_several_steps_comes_once_at_the_end_and_as_wide():
    generator = torch.Generator().manual_seed(0)
    x, noise = torch.ones(100_000, 2).double(), torch.randn(100_000, 8, generator=generator, dtype=torch.float64)
    mean = ReadProcess(FIRST.process, MAIN, generator).step(x, x, torch.zeros_like(noise))
    found = ReadProcess(FIRST.process, Reading(disturbance="once"), generator).step(x, x, noise)
    expected = np.array(FIRST.process.disturbance) * FIRST.process.sampling_time**0.5
    np.testing.assert_allclose((found / mean - 1).std(0).numpy(), expected, rtol=2e-2)


def test_what_the_controller_sees_and_what_the_types_are_taken_of():
    x, noise = torch.ones(4, 2, dtype=torch.float64), torch.ones(4, 2, dtype=torch.float64)
    acts, observed = (
        ReadProcess(FIRST.process, Reading(**{name: True}), torch.Generator()) for name in ("acts_on_state", "observed_state")
    )
    assert acts.observe(x, noise).equal(x)
    assert observed.observe(x, noise).equal(x)
    still = torch.zeros(4, 8).double()
    assert (observed.step(x, x, still) / acts.step(x, x, still) - 1).abs().min() > 0
    of_x, of_y = features(MAIN), features(Reading(features_on="y"))
    assert features(Reading(accumulated_on="y")).equal(torch.cat([of_x[:, :2], of_y[:, 2:4], of_x[:, 4:]], 1))
    assert features(Reading(rate_on="y")).equal(torch.cat([of_x[:, :4], of_y[:, 4:]], 1))
    assert len({reading.name for reading in READINGS}) == len({replace(reading, name="") for reading in READINGS}) == len(READINGS)


def test_an_unstable_loop_costs_much_and_stays_finite(problem):
    unstable = problem.holding({TIME: 0.5})
    assert 1e4 < unstable.loss(unstable.position(TRUTH), 20) < np.inf


@pytest.fixture(scope="module")
def problem():
    """A problem whose rows were made with known settings, on the same draws: its loss is zero there."""
    rows = {case: simulate(CASES[case], TRUTH, AS_FILED, 60, draws(case=case)) for case in (1, 3)}
    return Problem(
        cases={case: CASES[case] for case in rows},
        published={case: row.mean for case, row in rows.items()},
        sampling_error={case: row.sampling_error(500) for case, row in rows.items()},
        free={TIME: 0.1, BOUND_T: 200.0},
        seed=0,
        reading=AS_FILED,
    )


def test_the_loss_counts_squared_sampling_errors(problem):
    v = simulate(CASES[1], TRUTH, AS_FILED, 60, draws()).v.numpy()
    np.testing.assert_allclose(problem.sampling_error[1], np.std(v, axis=0, ddof=1) / np.sqrt(500))
    z = problem.position(TRUTH)
    assert problem.loss(z, 60) == pytest.approx(0.0, abs=1e-18)
    shifted = {case: np.asarray(row) + 2 * problem.sampling_error[case] for case, row in problem.published.items()}
    assert replace(problem, published=shifted).loss(z, 60) == pytest.approx(12 * 4)


def test_overshoot_costs_where_it_is_not_allowed(problem):
    mean = [simulate(CASES[case], TRUTH, AS_FILED, 60, draws(case=case)).overshoot.numpy() for case in (1, 3)]
    assert max(values.max() for values in mean) > 0.1
    expected = sum(((values / 0.02) ** 2).sum() for values in mean)
    assert replace(problem, overshoot_unit=0.02).loss(problem.position(TRUTH), 60) == pytest.approx(expected)


def test_known_settings_are_found_again(problem):
    size = {"evaluations_reading": 60, "draws_search": 60, "draws": 60, "iterations": 30}
    scale = load_identification(ROOT, FIRST).scales["smoke"].model_copy(update=size)
    found = refit(problem, {TIME: 0.04, BOUND_T: 60.0}, scale)
    assert found.loss < 1e-3
    assert found.settings == pytest.approx(TRUTH, rel=1e-3)


def test_the_search_uses_no_global_randomness_and_repeats_itself(problem):
    np.random.seed(3)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    found = [search(problem, np.array([0.6, 0.6]), 18, 20, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002
    assert (found[0] == found[1]).all()
    assert (found[0] != found[2]).any()


def test_what_is_held_is_neither_searched_nor_lost(problem):
    held = problem.holding({BOUND_T: 45.0})
    assert list(held.free) == [TIME]
    found = polish(held, held.position({TIME: 0.045}), 30, 60)
    assert found.settings == pytest.approx(TRUTH, rel=1e-3)
    assert held.holding({TIME: 0.05}).holding({}).settings(np.array([])) == TRUTH


def test_the_interval_of_a_parabola_is_exact():
    grid = np.array([1.0, 2.0, 3.5, 5.0, 9.0])
    parabola = Profile(grid, 7 + 4 * (grid - 3.5) ** 2)
    assert parabola.interval(4.0) == pytest.approx((2.5, 4.5))
    assert parabola.interval(16.0) == pytest.approx((1.5, 5.5))
    assert parabola.interval(1000.0) == (1.0, 9.0)


def test_a_profile_fits_the_other_settings_again(problem):
    """Its points lie below those of a cut through the loss, and its floor is where the settings are."""
    scale = load_identification(ROOT, FIRST).scales["smoke"].model_copy(update={"draws": 60, "iterations": 20})
    truth = Fit(TRUTH, problem.position(TRUTH), 0.0)
    found = profile(problem, truth, TIME, 1e9, scale)
    cut = [problem.holding({TIME: time, BOUND_T: 45.0}).loss(np.array([]), 60) for time in found.grid]
    assert found.grid[1] == pytest.approx(0.05)
    assert (np.diff(found.grid) > 0).all()
    assert (found.losses <= np.array(cut) + 1e-9).all()
    assert (found.losses[[0, 2]] > 1).all()
    assert found.losses[0] < cut[0] - 1
    below = problem.holding({("input_low", "T_E"): -30.0})
    assert below.settings(below.position(TRUTH))[("input_low", "T_E")] == -30.0
    side = replace(problem, free={("input_low", "T_E"): -200.0})
    assert side.settings(side.position({("input_low", "T_E"): -30.0}))[("input_low", "T_E")] == pytest.approx(-30.0)


def test_the_steps_of_a_profile_grow_and_end_at_the_ends_of_the_search():
    up, down = list(steps(0.5, 0.1, 50, 1)), list(steps(0.5, 0.1, 50, -1))
    assert up[-1] == 1.0
    assert down[-1] == 0.1
    assert (np.diff(np.diff(up[:-1])) > 0).all()
    assert list(steps(1.0, 0.1, 50, 1)) == []


def test_a_wrong_file_is_one_sentence(tmp_path):
    text = (ROOT / "identification.yaml").read_text(encoding="utf-8")
    for old, new, words in (
        ("[40.0, 120.0]", "[40.0]", ["search.input_bound", "2 entries"]),
        ("  paper:", "  large:", ["scales.paper", "missing"]),
        ("settled_by:", "settled:", ["settled"]),
    ):
        assert text.count(old) == 1
        (tmp_path / "identification.yaml").write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(ParameterError, match=re.escape("identification.yaml")) as caught:
            load_identification(tmp_path, FIRST)
        assert all(word in str(caught.value) for word in words)
        assert "\n" not in str(caught.value)


@pytest.mark.skipif(not REFERENCE.is_dir(), reason="no run was published yet")
def test_the_parameter_files_hold_what_the_reference_run_inferred():
    """Sampling time and bounds are round numbers, gains the fitted ones: all inside the interval in which the tables cannot tell.

    Gains lie within a tenth of its width of the fit. They cannot be the fit to the last digit: the sampling errors that weigh
    the rows are those of the controller in the files, so a new fit moves a little with every change of the files.
    """
    found = pd.read_csv(REFERENCE / "settings.csv").set_index(["setting", "component"])
    process = FIRST.process
    filed = {TIME: process.sampling_time}
    for name, low, high in zip(process.manipulated, process.input_low, process.input_high, strict=True):
        if ("input_bound", name) in found.index:
            assert low == -high
            filed[("input_bound", name)] = high
        else:
            filed |= {("input_low", name): low, ("input_high", name): high}
    for name, case in (("PID1", 1), ("PID2", 2)):
        gains = CASES[case].demonstrator.model_dump()
        filed |= {(f"{name}.{kind}", loop): gains[kind][i] for kind in GAINS for i, loop in enumerate(process.controlled)}
    assert set(found.index) == set(filed)
    for key, value in filed.items():
        row = found.loc[key]
        assert row["in_parameter_files"] == value
        assert row["low"] <= value <= row["high"], key
        if key[0].startswith("PID"):
            assert abs(value - row["value"]) <= 0.1 * (row["high"] - row["low"]), key
    assert CASES[3].demonstrator == CASES[1].demonstrator
