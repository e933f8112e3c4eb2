"""A model identified from records under feedback: the truth is found, the likelihood rises, and poor data are named."""

import numpy as np
import pytest
import torch

from helpers.own_plant.episodes import Stretch
from helpers.own_plant.identify import VectorARX, hold_out, identify, thin_out, validate_model
from helpers.own_plant.model import LinearModel
from helpers.own_plant.settings import load_own_plant
from tests.own_plant.plants import MadeUpPlant


@pytest.fixture(scope="module")
def params(root):
    return load_own_plant(root).identification


def record(plant, breaks=(400, 900)):
    table = plant.table
    y = table[[f"Y{i}.PV" for i in range(plant.n_controlled)]].to_numpy() - plant.steady_y
    u = table[[f"U{i}.OP" for i in range(plant.n_manipulated)]].to_numpy() - plant.steady_u
    return [Stretch(*pair) for pair in zip(np.split(y, breaks), np.split(u, breaks), strict=True)]


def unit_scales(plant):
    return np.ones(plant.n_controlled), np.ones(plant.n_manipulated)


def names(plant):
    return [f"y{i}" for i in range(plant.n_controlled)], [f"u{i}" for i in range(plant.n_manipulated)]


@pytest.mark.parametrize(("n_y", "n_u"), [(1, 1), (2, 2), (3, 2), (2, 3)])
def test_the_truth_lies_within_the_standard_errors(n_y, n_u, params):
    plant = MadeUpPlant(n_y, n_u, n_cycles=60)
    scales = (np.full(n_y, 0.7), np.full(n_u, 3.0))
    found = identify(record(plant), scales, names(plant), params, iterations=15)
    truth = np.hstack([plant.state_step, plant.input_step * 3 / 0.7, np.zeros((n_y, 1))])
    assert found.lags == 1
    assert (np.abs(found.parameters - truth) < 5 * found.errors + 0.01).all()
    assert found.model.state_step.numpy() == pytest.approx(found.parameters[:, :n_y])  # equal scales leave A as it is
    assert found.model.input_step.numpy() == pytest.approx(found.parameters[:, n_y:-1] * 0.7 / 3)
    size = (found.model.disturbance**2 + 0.1 * found.model.disturbance_gain**2).sqrt()
    assert size.numpy() == pytest.approx(0.03, rel=0.5)
    assert not found.warnings


@pytest.mark.parametrize("lags", [1, 2, 3])
def test_no_step_lowers_the_likelihood(lags, params):
    plant = MadeUpPlant(2, 2, n_cycles=10)
    pieces = record(plant, (150,))
    y, u = (np.concatenate([getattr(piece, name) for piece in pieces]) for name in "yu")
    last = np.isin(np.arange(len(y)), [149, len(y) - 1])
    likelihood = VectorARX(y, u, last, lags)
    vector, values = likelihood.least_squares(), []
    for _ in range(12):
        vector, value, _ = likelihood.expectation_maximisation(vector)
        values.append(value)
    assert (np.diff(values) > -1e-6).all()
    assert values[-1] > values[0]


def test_a_second_lag_is_found_and_simulated_as_the_state_space_does(params):
    """A plant with a dead time of one sample: without the second lag of the input its model would be wrong."""
    rng = np.random.default_rng(1)
    u = rng.choice([-1.0, 1.0], size=(1500, 1)).repeat(3, axis=0)[:1500]
    y = np.zeros((1500, 1))
    for t in range(1, 1500):
        y[t] = 0.8 * y[t - 1] + (0.5 * u[t - 2] if t > 1 else 0) + 0.05 * rng.normal()
    pieces = [Stretch(y + 0.02 * rng.normal(size=y.shape), u)]
    first, last = hold_out(pieces, params.held_out)
    found = identify(first, (np.ones(1), np.ones(1)), (["y"], ["u"]), params, iterations=15)
    assert found.lags == 2
    assert found.parameters[0] == pytest.approx([0.8, 0.0, 0.0, 0.5, 0.0], abs=0.06)
    checked = validate_model(found, last, 20, ["y"], params)
    assert checked.fit[0] > 0.85
    assert checked.p_value[0] > params.white
    model: LinearModel = found.model
    assert (model.n_states, model.n_outputs, model.n_inputs) == (3, 1, 1)
    x, outputs = torch.zeros(1, 3, dtype=torch.float64), []
    for command in (1.0, 0.0, 0.0):
        x = model.step(x, torch.tensor([[command]], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64))
        outputs.append(x[0, 0].item())
    a, _, b, late, c = found.parameters[0]
    assert outputs[0] == pytest.approx(b + c)
    assert outputs[1] == pytest.approx(a * outputs[0] + late + c)


def test_a_disturbance_that_grows_with_the_deviation_is_told_from_a_fixed_one(params):
    rng = np.random.default_rng(2)
    u = rng.choice([-1.0, 1.0], size=(3000, 1)).repeat(20, axis=0)[:3000]
    rows = {}
    for kind in ("fixed", "growing"):
        y = np.zeros((3000, 1))
        for t in range(1, 3000):
            size = 0.1 if kind == "fixed" else 0.1 * abs(y[t - 1, 0])
            y[t] = 0.9 * y[t - 1] + 0.2 * u[t - 1] + size * rng.normal()
        model = identify([Stretch(y, u)], (np.ones(1), np.ones(1)), (["y"], ["u"]), params, 10).model
        rows[kind] = (model.disturbance.item(), model.disturbance_gain.item())
    assert rows["fixed"] == pytest.approx((0.1, 0.0), abs=0.035)
    assert rows["growing"] == pytest.approx((0.0, 0.1), abs=0.035)


def test_what_the_data_cannot_carry_is_said(params):
    rng = np.random.default_rng(0)
    plant = MadeUpPlant(1, 1, n_cycles=40)
    pieces = [Stretch(piece.y, np.column_stack([piece.u, rng.normal(size=len(piece))])) for piece in record(plant)]
    found = identify(pieces, (np.ones(1), np.ones(2)), (["y0"], ["u0", "u1"]), params, 5)
    assert found.warnings == ("the data do not tell an effect of u1 on any output from none",)
    noise = [Stretch(rng.normal(size=(600, 1)).cumsum(0) * 0.05, rng.normal(size=(600, 2)))]
    checked = validate_model(found, noise, 30, ["y0"], params)
    assert any("unexplained: too much to learn from" in words for words in checked.warnings)
    assert any("are not white" in words for words in checked.warnings)


def test_the_last_part_is_held_out_and_a_long_record_thinned_out():
    pieces = [Stretch(np.arange(n, dtype=float)[:, None], np.zeros((n, 1))) for n in (60, 40)]
    first, last = hold_out(pieces, 0.25)
    assert [len(piece) for piece in first] == [60, 15]
    assert [len(piece) for piece in last] == [25]
    assert last[0].y[0, 0] == 15
    thin = thin_out(pieces, 40, 10)
    assert [piece.y[0, 0] for piece in thin] == [0, 30, 0, 30]
    assert thin_out(pieces, 100, 10) == pieces
