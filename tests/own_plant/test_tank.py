"""The nonlinear parent of Eq. 4.1.3b: its linearisation, its rest, its integration, its noise."""

import numpy as np
import pytest
import torch
from scipy.integrate import odeint

from helpers.own_plant.tank import example, load_tank
from helpers.settings.leaf import ParameterError
from helpers.settings.paper import load


@pytest.fixture(scope="module")
def tank():
    return example()


def at_rest():
    return torch.zeros(1, 2, dtype=torch.float64)


@pytest.mark.equation("4.1.3b")
def test_the_steady_state_is_at_rest_and_the_linearisation_is_the_paper_s(tank, root):
    params = load(root, 1).process
    state, inputs = (torch.from_numpy(part)[None] for part in (tank.steady.controlled, tank.steady.manipulated))

    def slope(index, step=1e-4):
        change = step * torch.eye(4, dtype=torch.float64)[index]
        ahead, behind = (tank.balances(state + s * change[:2], inputs + s * change[2:], 350.0) for s in (1, -1))
        return (ahead - behind)[0].numpy() / (2 * step)

    assert tank.integrate(at_rest(), at_rest()).abs().max() < 1e-9
    jacobian = np.stack([slope(index) for index in range(4)], axis=1)
    assert jacobian[:, :2] == pytest.approx(np.array(params.drift_state), abs=1.2e-3)  # the paper prints three decimals
    assert jacobian[:, 2:] == pytest.approx(np.array(params.drift_input), abs=1e-6)
    far = torch.tensor([[-1.0, 4.0]], dtype=torch.float64)
    linear = far @ torch.linalg.matrix_exp(0.04 * torch.tensor(params.drift_state, dtype=torch.float64)).T
    assert (tank.integrate(far, at_rest()) - linear).abs().max() > 1e-2  # away from rest it is another plant


def test_a_sample_is_that_of_another_integrator(tank):
    x = torch.tensor([[-1.0, 4.0], [0.5, -3.0]], dtype=torch.float64)
    u = torch.tensor([[20.0, -60.0], [-20.0, 60.0]], dtype=torch.float64)
    for start, command, found in zip(x, u, tank.integrate(x, u), strict=True):
        inputs = torch.from_numpy(tank.steady.manipulated) + command

        def right_hand_side(state, _, inputs=inputs):
            return tank.balances(torch.from_numpy(state), inputs, 350.0).numpy()

        ends = odeint(right_hand_side, tank.steady.controlled + start.numpy(), [0, 0.04], rtol=1e-10, atol=1e-10)
        assert found.numpy() == pytest.approx(ends[-1] - tank.steady.controlled, abs=1e-7)


def test_no_concentration_falls_below_zero(tank):
    x = torch.tensor([[-2.9, 0.0]], dtype=torch.float64)
    after = tank.step(x, torch.tensor([[-20.0, 60.0]], dtype=torch.float64), torch.full((1, 2), 8.0, dtype=torch.float64))
    assert after[0, 0].item() == -3.0


def test_noise_has_a_floor_and_a_relative_part(tank):
    noise = torch.ones(1, 2, dtype=torch.float64)
    assert tank.observe(at_rest(), noise)[0].tolist() == pytest.approx([0.005, 0.02])
    far = torch.tensor([[-1.0, 4.0]], dtype=torch.float64)
    assert (tank.observe(far, noise) - far)[0].tolist() == pytest.approx([(0.025**2 + 0.005**2) ** 0.5, (0.1**2 + 0.02**2) ** 0.5])


def test_what_is_missing_ends_in_one_sentence(root, tmp_path):
    params = load(root, 1).process
    text = (root / "nonlinear_tank.yaml").read_text(encoding="utf-8")
    for old, new, says in (
        ("[0.005, 0.02]", "[0.005]", "'sensor_noise': expected 2 entries, found 1"),
        ("value: 3.0", "value: 0.06", "'concentration': 0.06 mol/L is too low for a 'temperature' of 350 K"),
        ("{value: min", "{value: week", "'time_unit'"),
    ):
        assert old in text
        (tmp_path / "nonlinear_tank.yaml").write_text(text.replace(old, new, 1), encoding="utf-8")
        with pytest.raises(ParameterError, match=rf"nonlinear_tank\.yaml: key {says}"):
            load_tank(tmp_path, params)
    with pytest.raises(ParameterError, match="'balance'"):
        load_tank(root, params.model_copy(update={"balance": None}))
