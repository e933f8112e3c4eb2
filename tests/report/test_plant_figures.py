"""The figures of one's own plant show what is in the tables, with units; the guard's trial runs as planned."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from helpers.learning.model_gradient import GradientRecord
from helpers.learning.tracking_policy import Gains, TrackingPID
from helpers.own_plant import gate, learn
from helpers.own_plant.commissioning import Trial, commission
from helpers.own_plant.guard import Guard
from helpers.own_plant.identify import Equation, Structure, Validation, assemble
from helpers.own_plant.operation import Operation
from helpers.plant.tracking import Bounds
from helpers.report import plant_figures
from helpers.report.figures import drawn_summary
from tests.own_plant.plants import MadeUpPlant


@pytest.fixture(scope="module")
def plant(tmp_path_factory, root):
    made_up = MadeUpPlant(3, 2)
    table = made_up.table.drop(index=range(300, 320))
    table.loc[100:109, "MODE"] = "MAN"
    return learn.open_plant(made_up.write(tmp_path_factory.mktemp("plant"), table), root, "smoke", 0)


@pytest.fixture
def model():
    """Three outputs of first order, each driven by both inputs."""
    equations = [Equation(Structure(1, (0, 0)), np.array([0.9, 0.1, 0.05, 0.0, -0.5]), np.array([0.01, 0.0])) for _ in range(3)]
    return assemble([equations], (np.ones(3), np.ones(2)))


def test_the_quality_figure_has_a_panel_a_variable_with_its_unit(plant):
    figure = plant_figures.quality_figure(plant.clean, plant.description)
    assert [axis.get_label() for axis in figure.axes] == ["y0", "y1", "y2", "u0", "u1"]
    assert {axis.get_ylabel() for axis in figure.axes} == {"%"}
    shown = drawn_summary(figure).set_index(["panel", "artist"])
    assert shown.loc[("y1", "Y1.PV"), "mean"] == pytest.approx(plant.clean.table["Y1.PV"].mean())
    assert shown.loc[("y1", "not in automatic"), ["from", "to"]].to_numpy().ravel().tolist() == [100, 109]
    first = plant_figures.quality_figure(plant.clean, plant.description, first=10, n_samples=50)
    assert drawn_summary(first)["from"].min() == 10


def test_an_episode_is_shown_in_engineering_units_under_every_controller(plant, model):
    one = torch.ones(3)
    bounds = Bounds(torch.tensor([-3.0, -3.0]), torch.tensor([3.0, 3.0]), torch.full((2,), torch.inf))
    record = Gains(*(torch.eye(2, 3) for _ in range(3)))
    workshop = learn.Workshop(plant, Operation((0,), -one, one, one, bounds), record, 1.0, *[model.to(torch.float32)] * 4)
    pid = TrackingPID(record, bounds)
    figure = plant_figures.loops_figure(workshop, {gate.RECORD: pid, gate.POLICY: pid}, plant.description)
    shown = drawn_summary(figure).set_index(["panel", "artist"])
    assert [axis.get_label() for axis in figure.axes] == [*plant.controlled, *plant.manipulated]
    assert ["set point" in shown.loc[output].index for output in ("y0", "y1")] == [True, False]
    policy, pid_s = (shown.loc[("y1", name), "mean"] for name in (gate.POLICY, gate.RECORD))
    assert policy == pytest.approx(pid_s)
    assert abs(policy - plant.description.controlled[1].steady_state) < 10


def test_the_gate_s_figure_shows_the_rivals_and_the_curves_their_levels():
    shares = pd.DataFrame(np.random.default_rng(0).uniform(0.5, 1, (200, 2)), columns=["mean |e|", "movement"])
    shares["controller"] = [*gate.SIMPLEST] * 50
    figure = plant_figures.gate_figure(gate.Verdict(pd.DataFrame(), shares, True, gate.POLICY, ""))
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [gate.TUNED, gate.PREDICTIVE, gate.POLICY]
    assert figure.axes[1].get_xlabel() == "movement, share of the record's PID's"
    curves = plant_figures.progress_figure([GradientRecord(n, 1 / n, 0.9, 0.1, 0.2) for n in range(1, 6)])
    assert curves.axes[0].lines[0].get_ydata()[-1] == pytest.approx(0.2)
    assert {axis.get_xlabel() for axis in curves.axes} == {"gradient step"}


def test_the_validation_figure_shows_a_window_and_the_residuals(plant):
    rng = np.random.default_rng(0)
    measured, simulated = rng.normal(size=(2, 4, 12, 3))
    validation = Validation(np.full(3, 0.9), measured, simulated, tuple(rng.normal(size=(3, 200))), np.full(3, 0.5), ())
    shown = drawn_summary(plant_figures.validation_figure(validation, plant.description)).set_index(["panel", "artist"])
    assert shown.loc[("y2 simulated", "measured"), "mean"] == pytest.approx(measured[0, :, 2].mean())
    assert shown.loc[("y2 simulated", "simulated from the inputs"), "last"] == pytest.approx(simulated[0, -1, 2])
    assert shown.loc[("y0 residuals", "autocorrelation"), "points"] == 20


def test_a_trial_goes_from_manual_to_policy_to_hold_to_pid_and_back(plant, model):
    asking = SimpleNamespace(notes={}, reset=lambda: None, step=lambda y, set_point, u_previous: u_previous + 0.1)
    guard = Guard(asking, plant.description)
    trial = Trial(n_samples=60, hand_over=5, step=8, fault=range(30, 40), faulty=1)
    steps, seconds = commission(guard, model, trial, torch.Generator().manual_seed(0))
    modes = steps["mode"].ne(steps["mode"].shift()).cumsum()
    assert steps.groupby(modes)["mode"].first().tolist() == ["manual", "policy", "hold", "PID", "policy"]
    assert len(seconds) == len(steps) == 60
    assert (steps["y1"].isna().sum(), steps["y0_sp"].nunique()) == (10, 2)
    shown = drawn_summary(plant_figures.guard_figure(steps, plant.description))
    assert shown.query("panel == 'u1' and artist == 'u1'")["last"].item() == pytest.approx(steps["u1"].iloc[-1])
