"""A model identified from records under feedback: order, dead times and gains are found, and poor data are named."""

import numpy as np
import pytest
import torch

from helpers.own_plant import identify
from helpers.own_plant.episodes import Stretch
from helpers.own_plant.identify import Equation, Margins, Structure, apart, assemble, hold_out
from helpers.own_plant.settings import load_own_plant
from helpers.settings.leaf import InputError

FIRST = ([0.2], [1.0, -0.9])  # gain 2


@pytest.fixture(scope="module")
def params(root):
    quick = {"orders": (1, 2), "longest_dead_time": 5}
    return load_own_plant(root).identification.model_copy(update=quick)


def record(channels, gains, n_samples=2400, hold=60):
    """A stretch of loops under PI control with dead times; deviation variables.

    Args:
        channels: of each output and input numerator and denominator in q^-1 (first entries for q^0, the held input counts from the
            next sample on) and dead time. gains: P and I per sample of each loop.
    """
    rng, gains, n_y, n_u, n_loops = np.random.default_rng(0), np.array(gains), len(channels), len(channels[0]), len(gains)
    y, u, parts = np.zeros((n_samples, n_y)), np.zeros((n_samples + 1, n_u)), np.zeros((n_samples, n_y, n_u))
    set_points, error = rng.uniform(-5, 5, (n_samples // hold + 1, n_loops)), np.zeros((n_samples + 1, n_loops))
    disturbance = 0.0
    for t in range(n_samples):
        for i, row in enumerate(channels):
            for j, (b, a, dead) in enumerate(row):
                past = sum(value * (u[t - k - dead, j] if t - k - dead >= 0 else 0) for k, value in enumerate(b))
                parts[t, i, j] = past + sum(-value * (parts[t - k, i, j] if t >= k else 0) for k, value in enumerate(a[1:], 1))
        disturbance = 0.9 * disturbance + 0.02 * rng.normal()
        y[t] = parts[t].sum(1) + disturbance + 0.02 * rng.normal(size=n_y)
        error[t] = set_points[t // hold] - y[t, :n_loops]
        u[t + 1] = u[t]
        u[t + 1, :n_loops] += gains[:, 0] * (error[t] - error[t - 1]) + gains[:, 1] * error[t]  # error[-1] is zero at first
    return Stretch(y, u[1:])


def modelled(parts, params, members=8):
    n_y, n_u = parts[0][0].y.shape[1], parts[0][0].u.shape[1]
    names = [f"y{i}" for i in range(n_y)], [f"u{j}" for j in range(n_u)]
    return identify.identify(parts, (np.ones(n_y), np.ones(n_u)), names, params, members, seed=0)


def found(channels, gains, params):
    return modelled(hold_out([record(channels, gains)], 0.25), params)


def gain(equation):
    return equation.inputs.sum(1) / (1 - equation.own.sum())


def delay(equation, j=0):
    """The dead time up to the first coefficient that counts."""
    b = equation.inputs[j]
    return equation.structure.dead_times[j] + int(np.argmax(np.abs(b) > 0.2 * np.abs(b).max()))


@pytest.mark.parametrize("dead", [0, 3])
def test_a_dead_time_and_a_gain_are_found_under_feedback(dead, params):
    model = found([[(*FIRST, dead)]], [(0.3, 0.03)], params)
    (equation,) = model.equations
    assert delay(equation) == dead
    assert gain(equation) == pytest.approx([2.0], rel=0.03)
    assert max(abs(np.roots([1, *-equation.own]))) == pytest.approx(0.9, abs=0.02)
    assert not model.warnings
    gains = np.array([gain(member[0])[0] for member in model.members])  # they scatter about the truth and are stable
    assert 0 < gains.std() < 0.2
    assert abs(gains.mean() - 2.0) < 4 * gains.std() + 0.02
    assert all(member[0].growth < 1 for member in model.members)


def test_each_input_has_a_dead_time_of_its_own(params):
    channels = [[(*FIRST, 1), ([0.1], [1.0, -0.8], 4)], [([0.05], [1.0, -0.9], 3), ([0.15], [1.0, -0.85], 0)]]
    model = found(channels, [(0.3, 0.03), (0.4, 0.04)], params)
    assert [[delay(equation, j) for j in range(2)] for equation in model.equations] == [[1, 4], [3, 0]]
    assert np.array([gain(equation) for equation in model.equations]) == pytest.approx(np.array([[2.0, 0.5], [0.5, 1.0]]), abs=0.05)


def test_an_integrating_plant_is_told_from_a_slow_one(params):
    (equation,) = found([[([0.05], [1.0, -1.0], 1)]], [(1.0, 0.03)], params).equations
    assert equation.structure.integrating
    assert equation.own.sum() == pytest.approx(1.0)
    assert equation.inputs.sum() / (1 - equation.parameters[: equation.structure.n_own].sum()) == pytest.approx(0.05, rel=0.05)
    assert not found([[([0.02], [1.0, -0.98], 1)]], [(1.0, 0.03)], params).equations[0].structure.integrating


def test_the_poles_of_an_underdamped_plant_are_found(params):
    poles = 0.9 * np.exp(1j * np.array([0.3, -0.3]))
    denominator = np.real(np.poly(poles))
    (equation,) = found([[([0.1 * denominator.sum() * 10], list(denominator), 0)]], [(0.1, 0.02)], params).equations
    roots = np.roots([1, *-equation.own])
    assert np.abs(roots[:, None] - poles).min(0) == pytest.approx([0, 0], abs=0.02)


def test_no_step_of_the_fit_raises_the_errors():
    piece = record([[(*FIRST, 2)]], [(0.3, 0.03)])
    given, structure = identify.Record([(piece.y[:, 0], piece.u)], 12), Structure(2, (1,))
    starts = [float(sum((e**2).sum() for e in given.errors(structure, start))) for start in given.starts(structure)]
    costs = [float(sum((e**2).sum() for e in given.errors(structure, given.fit(structure, steps=n)))) for n in (1, 3, 12)]
    assert min(starts) >= costs[0] >= costs[1] >= costs[2]


def test_margins_change_gain_time_and_dead_time_and_nothing_else():
    first = Equation(Structure(1, (2,)), np.array([0.9, 0.2, 0.01, -0.5]), np.array([0.1, 0.0]))
    other = apart(first, Margins(np.array([1.3]), 2.0, (1,)))
    assert other.structure == Structure(1, (3,))
    assert other.own == pytest.approx([0.9**0.5])
    assert gain(other) == pytest.approx(1.3 * gain(first))
    assert other.constant / (1 - other.own.sum()) == pytest.approx(0.01 / 0.1)
    same = apart(first, Margins(np.ones(1), 1.0, (0,)))
    assert same.parameters == pytest.approx(first.parameters)


def test_the_model_of_the_equations_is_their_recursion():
    equations = (
        Equation(Structure(2, (1, 0)), np.array([0.5, 0.2, 1.0, 2.0, 3.0, 4.0, 0.1, 0.3, 0.4]), np.array([0.5, 0.0])),
        Equation(Structure(1, (0, 2)), np.array([0.7, 5.0, 6.0, 0.2, -0.6]), np.array([0.0, 0.5])),
    )
    model = assemble([equations], (np.ones(2), np.ones(2)))
    rng = np.random.default_rng(0)
    u, noise = rng.normal(size=(20, 2)), rng.normal(size=(20, 2))
    x, y, e = torch.zeros(1, model.n_states, dtype=torch.float64), np.zeros((21, 2)), np.zeros((21, 2))

    def past(signal, t, column):
        return signal[t, column] if t >= 0 else 0.0

    for t in range(20):
        kick = torch.zeros(1, model.n_states, dtype=torch.float64)
        kick[0, :2] = torch.tensor(noise[t])
        x = model.step(x, torch.tensor(u[t])[None], kick)
        y0 = 0.5 * y[t, 0] + 0.2 * past(y, t - 1, 0) + past(u, t - 1, 0) + 2 * past(u, t - 2, 0)
        y0 += 3 * u[t, 1] + 4 * past(u, t - 1, 1) + 0.1 + 0.3 * e[t, 0] + 0.4 * past(e, t - 1, 0)
        y1 = 0.7 * y[t, 1] + 5 * u[t, 0] + 6 * past(u, t - 2, 1) + 0.2 - 0.6 * e[t, 1]
        e[t + 1] = 0.5 * noise[t, 0], 0.5 * abs(y1) * noise[t, 1]
        y[t + 1] = y0 + e[t + 1, 0], y1 + e[t + 1, 1]
        assert model.observe(x, x)[0].numpy() == pytest.approx(y[t + 1])


def test_at_rest_the_undisturbed_model_stays_where_it_is():
    equations = [
        [Equation(Structure(2, (1, 3)), np.array([0.5, 0.2, 1.0, 2.0, g, 0.1, 0.1, 0.3, 0.4]), np.ones(2)) for g in (0.3, 2.0)]
        + [Equation(Structure(1, (0, 2)), np.array([0.7, 5.0, 6.0, 0.2, -0.6]), np.ones(2))]
    ]
    model = assemble(equations, (np.ones(3), np.ones(2)))
    aim = torch.tensor([[1.0, -2.0, 0.0]], dtype=torch.float64)
    x, y, u = model.at_rest(aim, (0, 1))
    assert y[0, :2].tolist() == [1.0, -2.0]
    assert model.step(x, u, torch.zeros_like(x))[0].numpy() == pytest.approx(x[0].numpy())


def test_a_disturbance_that_grows_with_the_deviation_is_told_from_a_fixed_one(params):
    rng = np.random.default_rng(2)
    u = rng.choice([-1.0, 1.0], size=(3000, 1)).repeat(20, axis=0)[:3000]
    for size, expected in ((lambda y: 0.1, (0.1, 0.0)), (lambda y: 0.1 * abs(y), (0.0, 0.1))):
        y = np.zeros((3000, 1))
        for t in range(1, 3000):
            mean = 0.9 * y[t - 1, 0] + 0.2 * u[t - 1, 0]
            y[t] = mean + size(mean) * rng.normal()
        model = modelled(hold_out([Stretch(y, u)], 0.25), params, members=4)
        assert model.equations[0].spread == pytest.approx(expected, abs=0.035)


def test_what_the_data_cannot_carry_is_said(params):
    piece = record([[(*FIRST, 1)]], [(0.3, 0.03)])
    given = Stretch(piece.y, np.column_stack([piece.u, 0.1 * np.random.default_rng(0).normal(size=len(piece))]))
    model = modelled(hold_out([given], 0.25), params, members=4)
    assert model.warnings == ("the data do not tell an effect of u1 on any output from none",)
    good = identify.validate_model(model, [given], 30, ["y"], params)
    assert good.fit[0] > 0.8
    assert not good.warnings
    rng = np.random.default_rng(0)
    noise = [Stretch(rng.normal(size=(600, 1)).cumsum(0) * 0.05, rng.normal(size=(600, 2)))]
    assert "unexplained: too much to learn from" in identify.validate_model(model, noise, 30, ["y"], params).warnings[0]
    short = [given[:20]]
    with pytest.raises(InputError, match="no stretch of the record is longer than"):
        modelled((short, short), params)


def test_the_last_part_is_held_out_and_a_long_record_thinned_out():
    pieces = [Stretch(np.arange(n, dtype=float)[:, None], np.zeros((n, 1))) for n in (60, 40)]
    first, last = hold_out(pieces, 0.25)
    assert [len(piece) for piece in first] == [60, 15]
    assert [len(piece) for piece in last] == [25]
    assert last[0].y[0, 0] == 15
    thin = identify.thin_out(pieces, 40, 10)
    assert [piece.y[0, 0] for piece in thin] == [0, 30, 0, 30]
    assert identify.thin_out(pieces, 100, 10) == pieces
