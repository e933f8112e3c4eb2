"""The figures of one's own plant show what is in the tables, with units; the guard's trial runs as planned."""

import pytest
import torch
from matplotlib.figure import Figure

from helpers.own_plant import learn
from helpers.own_plant.commissioning import Trial, commission
from helpers.own_plant.guard import Guard
from helpers.own_plant.model import LinearModel
from helpers.report import plant_figures
from helpers.report.figures import control_figure, drawn_summary
from helpers.runs.study import response_table
from tests.own_plant.plants import MadeUpPlant


@pytest.fixture(scope="module")
def plant(tmp_path_factory, root):
    made_up = MadeUpPlant(3, 2)
    table = made_up.table.drop(index=range(300, 320))
    table.loc[100:109, "MODE"] = "MAN"
    return learn.open_plant(made_up.write(tmp_path_factory.mktemp("plant"), table), root, "smoke", 0)


def test_the_quality_figure_has_a_panel_a_variable_with_its_unit(plant):
    figure = plant_figures.quality_figure(plant.clean, plant.description)
    assert [axis.get_label() for axis in figure.axes] == ["Y0.PV", "Y1.PV", "Y2.PV", "U0.OP", "U1.OP"]
    assert {axis.get_ylabel() for axis in figure.axes} == {"%"}
    shown = drawn_summary(figure).set_index(["panel", "artist"])
    assert shown.loc[("Y1.PV", "Y1.PV"), "mean"] == pytest.approx(plant.clean.table["Y1.PV"].mean())
    assert shown.loc[("Y1.PV", "not in automatic"), ["from", "to"]].to_numpy().ravel().tolist() == [100, 109]
    first = plant_figures.quality_figure(plant.clean, plant.description, first=10, n_samples=50)
    assert drawn_summary(first)["from"].min() == 10


def test_the_response_figure_has_a_panel_a_variable_for_any_number_of_them(plant):
    recorded = plant.demonstrations.trajectories
    response = response_table(recorded, recorded, plant.controlled, plant.manipulated)
    figure = plant_figures.response_figure(response, plant.description)
    shown = drawn_summary(figure).set_index(["panel", "artist"])
    assert [axis.get_label() for axis in figure.axes if axis.get_visible()] == ["y0", "y1", "y2", "u0", "u1"]
    variable = plant.description.controlled[1]
    assert shown.loc[("y1", "record"), "last"] == pytest.approx(variable.steady_state + recorded.y[-1, :, 1].mean().item())
    assert shown.loc[("y1", "set point"), "last"] == variable.set_point
    assert {axis.get_ylabel() for axis in figure.axes if axis.get_visible()} == {"%"}
    assert {"record, input", "policy, input"} <= set(shown.loc["u0"].index)


def test_the_validation_figure_shows_a_window_and_the_residuals(plant):
    _, validation = learn.identify_plant(plant)
    figure = plant_figures.validation_figure(validation, plant.description)
    shown = drawn_summary(figure).set_index(["panel", "artist"])
    assert shown.loc[("y2 simulated", "measured"), "mean"] == pytest.approx(validation.measured[0, :, 2].mean())
    assert shown.loc[("y2 simulated", "simulated from the inputs"), "last"] == pytest.approx(validation.simulated[0, -1, 2])
    assert shown.loc[("y0 residuals", "autocorrelation"), "points"] == 20


def test_responses_carry_the_units_of_the_plant(plant):
    batch = learn.as_measured(plant.demonstrations.trajectories)
    names = plant.controlled[:2], plant.manipulated
    pair = type(batch)(*(getattr(batch, key)[..., :2] for key in ("x", "y", "u", "command")))
    figure = control_figure(response_table(pair, pair, *names), *names, [1.0, 1.0])
    labels = {axis.get_ylabel() for axis in plant_figures.with_units(figure, plant.description).axes}
    assert all("deviation, %" in label for label in labels)


class Asking:
    def reset(self):
        pass

    def step(self, y, set_point, u_previous):
        return u_previous + 0.1


def test_a_trial_goes_from_manual_to_policy_to_hold_to_pid_and_back(plant):
    size, none = 0.1 * torch.ones(3), torch.zeros(3)
    model = LinearModel(0.9 * torch.eye(3), 0.1 * torch.ones(3, 2), none, size, none, size, none)
    guard = Guard(Asking(), plant.description)
    trial = Trial(n_samples=60, hand_over=5, step=8, fault=range(30, 40), faulty=1)
    steps, seconds = commission(guard, model.to(torch.float64), trial, torch.Generator().manual_seed(0))
    modes = steps["mode"].ne(steps["mode"].shift()).cumsum()
    assert steps.groupby(modes)["mode"].first().tolist() == ["manual", "policy", "hold", "PID", "policy"]
    assert len(seconds) == len(steps) == 60
    assert steps["y1"].isna().sum() == 10
    assert steps["y0_sp"].nunique() == 2
    figure = plant_figures.guard_figure(steps, plant.description)
    assert isinstance(figure, Figure)
    shown = drawn_summary(figure)
    assert shown.query("panel == 'u1' and artist == 'u1'")["last"].item() == pytest.approx(steps["u1"].iloc[-1])
