"""Figures of control quality: by hand, and step-response figures against python-control."""

import control
import numpy as np
import pytest
import torch

from helpers.learning.control_quality import harris_index, input_figures, integral_errors, quality, settling_time, worst_mean
from helpers.learning.evaluation import overshoot, rise_time
from helpers.plant.rollout import rollout, stream
from helpers.plant.task import Trajectories
from helpers.settings.limits import load_limits

DT = 0.04
TIME = np.arange(0, 201) * DT


@pytest.mark.parametrize(("frequency", "damping"), [(3.0, 0.2), (2.0, 0.5), (4.0, 0.9), (1.5, 1.5)])
@pytest.mark.parametrize("band", [0.02, 0.05])
def test_step_response_figures_are_those_of_python_control(frequency, damping, band):
    """A second-order system without noise, about the set point of one."""
    system = control.tf([frequency**2], [1, 2 * damping * frequency, frequency**2])
    _, y = control.step_response(system, TIME)
    expected = control.step_info(y, TIME, yfinal=1.0, SettlingTimeThreshold=band)
    error = 1 - torch.from_numpy(y.copy())[:, None]
    assert overshoot(error).item() == pytest.approx(expected["Overshoot"] / 100, abs=1e-12)
    assert rise_time(error, DT).item() == pytest.approx(expected["RiseTime"], abs=1e-9)
    assert settling_time(error, DT, band).item() == pytest.approx(expected["SettlingTime"], abs=1e-9)


def test_quality_reads_the_mean_response_and_single_ones_of_both_loops(study, root):
    """Without noise, so that all responses are one; about the set point, not the last sample: one loop comes back to it."""
    quiet = {"disturbance": (1e-9, 1e-9), "observation_noise": (0.0, 0.0)}
    case = study(1, process=quiet, case_study={"initial_std": (0.0, 0.0)})
    batch = rollout(case.process, case.pid, case.task, 2, stream(0, "quiet"))
    params, dt = load_limits(root, case.params).quality, case.params.process.sampling_time
    names = (case.params.process.controlled, case.params.process.manipulated)
    found = quality(batch, case.features, params, *names)
    error = 1 - batch.x[:, 0] / case.task.set_point  # the steady state is the origin
    expected = {"overshoot": overshoot(error), "rise_time": rise_time(error, dt)}
    expected |= {f"settling_time_{100 * band:g}": settling_time(error, dt, band) for band in params.bands}
    for name, values in expected.items():
        for kind in ("", "_single"):
            loops = [found[f"{name}{kind}:{loop}"] for loop in names[0]]
            assert loops == pytest.approx(values.tolist(), abs=1e-6, nan_ok=True), name
    assert expected["overshoot"].max() > 0.01


def test_other_figures_by_hand():
    never = 1 - torch.tensor([[0.0, 0.0], [0.5, 0.95], [0.8, 1.2]])
    assert rise_time(never, DT).isnan().tolist() == [True, False]
    assert settling_time(never, DT, 0.05).isnan().all()
    assert overshoot(never).tolist() == [0.0, pytest.approx(0.2)]
    errors = {name: value.item() for name, value in integral_errors(torch.tensor([[[1.0]], [[-0.5]], [[0.25]]]), 0.1).items()}
    assert errors == pytest.approx({"ise": 0.1 * 1.3125, "iae": 0.1 * 1.75, "itae": 0.1 * (0.1 + 0.2 * 0.5 + 0.3 * 0.25)})
    values = torch.arange(40.0)[torch.randperm(40, generator=stream(0))][:, None]
    assert worst_mean(values, 0.05).tolist() == [38.5]
    assert worst_mean(values[:3], 0.05).item() == values[:3].max().item()
    u = torch.tensor([[0.0, 1.0], [2.0, 1.0], [-1.0, 1.0]])[:, None]
    batch = Trajectories(torch.zeros(4, 1, 2), torch.zeros(4, 1, 2), u, u)
    found = input_figures(batch, torch.tensor([-1.0, -1.0]), torch.tensor([2.0, 3.0]))
    assert found["total_variation"].tolist() == [5.0, 0.0]
    assert found["at_bound"].tolist() == pytest.approx([2 / 3, 0.0])


@pytest.mark.parametrize("memory", [0.0, 0.6, 0.9])
def test_the_harris_index_of_an_autoregression_is_known(memory):
    """e_t = m e_(t-1) + w_t has variance var(w) / (1 - m^2), so that its index is 1 - m^2; an offset lowers it."""
    noise = torch.randn(40_000, generator=stream(0, "harris"), dtype=torch.float64).numpy()
    e = np.zeros_like(noise)
    for t in range(1, len(e)):
        e[t] = memory * e[t - 1] + noise[t]
    assert harris_index(e, 20) == pytest.approx(1 - memory**2, rel=0.05)
    assert harris_index(e + 2 * e.std(), 20) == pytest.approx((1 - memory**2) / 5, rel=0.06)
