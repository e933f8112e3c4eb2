"""Offset-free MPC: its plan against a general solver, no offset under a load, and other controllers as special cases."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from helpers.evidence.mismatch import LoadStep
from helpers.evidence.mpc import OffsetFreeMPC
from helpers.plant.rollout import rollout, stream


def test_the_plan_minimises_the_cost_inside_the_bounds(case):
    """The cost simulated step by step and minimised by L-BFGS-B, from a state where bounds are active."""
    controller = OffsetFreeMPC(case.process, case.task, 4, 0.01, 0.1)
    A, B = case.process.state_step.numpy(), case.process.input_step.numpy()
    target, scale = case.task.set_point.numpy(), case.task.error_scale.numpy()
    low, high = case.task.input_low.numpy(), case.task.input_high.numpy()
    x0, d, before = np.array([0.2, 1.0]), np.array([0.01, -0.05]), np.array([3.0, -10.0])

    def cost(plan):
        x, previous, total = x0, before, 0.0
        for u in plan.reshape(4, 2):
            x = A @ x + B @ u + d
            total += (((x - target) / scale) ** 2).sum() + 0.01 * (((u - previous) / (high - low)) ** 2).sum()
            previous = u
        return total

    bounds = list(zip(np.tile(low, 4), np.tile(high, 4), strict=True))
    expected = minimize(
        cost, np.tile(before, 4), bounds=bounds, method="L-BFGS-B", options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 5000}
    )
    plan = controller.plan(np.concatenate([x0, d, before, [1.0]])[None])[0]
    assert ((plan >= np.tile(low, 4) - 1e-6) & (plan <= np.tile(high, 4) + 1e-6)).all()
    assert (np.isclose(plan, np.tile(low, 4)) | np.isclose(plan, np.tile(high, 4))).any()
    assert cost(plan) <= expected.fun * (1 + 1e-6)


def test_no_offset_remains_after_an_unmeasured_load(study):
    quiet = {"disturbance": (1e-6, 1e-6), "observation_noise": (0.0, 0.0), "horizon": 200}
    case = study(1, process=quiet, case_study={"initial_std": (0.0, 0.0)})
    load = 0.03 * case.task.error_scale
    ends = {}
    for name, controller in {"mpc": OffsetFreeMPC(case.process, case.task, 10, 0.01, 0.1), "known": case.minimum_variance}.items():
        batch = rollout(LoadStep(case.process, case.task, load), controller, case.task, 1, stream(0, "load"))
        ends[name] = ((batch.x[-1, 0] - case.task.set_point) / case.task.error_scale).abs().max().item()
    assert ends["mpc"] < 1e-3
    assert ends["known"] == pytest.approx(0.03, rel=1e-3)  # one step of the load, for ever


def test_a_short_horizon_without_move_penalty_is_minimum_variance(case):
    controller = OffsetFreeMPC(case.process, case.task, 1, 1e-9, 0.1)
    x = torch.tensor([[-0.95, 3.9]], dtype=torch.float64)
    rest = torch.zeros(1, 2, dtype=torch.float64)
    plan = controller.plan(torch.cat([x, rest, rest, torch.ones(1, 1, dtype=torch.float64)], 1).numpy())
    assert plan == pytest.approx(case.minimum_variance.act(x, None)[0].numpy(), rel=1e-3)


def test_single_precision_changes_little(study):
    """The number type of the paper's scale, in which a covariance is symmetric to its last digit but one."""
    gains = [OffsetFreeMPC(case.process, case.task, 10, 0.01, 0.1).filter_gain for case in (study(1, torch.float32), study(1))]
    torch.testing.assert_close(*gains, rtol=1e-4, atol=1e-6)
