"""Figures: what is drawn is what was handed in; colours, labels and units; style does not change the data."""

from itertools import combinations

import matplotlib
import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D

from helpers.plant.task import Trajectories
from helpers.report import drawings, figures
from helpers.runs.study import response_table
from helpers.settings.leaf import DEVIATION

OUTPUTS = ("C_A", "T", "level_tank")
INPUTS = ("C_A0", "T_E", "F_in")
SET_POINTS = (-1.0, 4.0, 0.5)
WORDS = {"C_A": "concentration of reagent", "T": "reactor temperature", "T_E": "jacket temperature"}
N_STEPS = 40


def response(n_loops=2):
    generator = torch.Generator().manual_seed(0)
    signals = zip(*(torch.randn(2, n, 7, n_loops, generator=generator) for n in (N_STEPS + 1, N_STEPS)), strict=True)
    return response_table(*(Trajectories(x, x + 1, u, 2 * u) for x, u in signals), OUTPUTS[:n_loops], INPUTS[:n_loops])


def draw(n_loops=2, table=None):
    table = response(n_loops) if table is None else table
    return figures.control_figure(table, OUTPUTS[:n_loops], INPUTS[:n_loops], SET_POINTS[:n_loops], WORDS)


def history(n_epochs=60):
    epochs = np.arange(1, n_epochs + 1)
    frame = pd.DataFrame({"iteration": epochs, "epochs": epochs, "mean_return": np.sqrt(epochs), "feature_gap": 1 / epochs})
    for index, feature in enumerate(("C_A-I", "T-I", "C_A-II", "T-II", "C_A-III", "T-III")):
        frame[f"alpha:{feature}"] = np.cos(index + epochs / 50)
    return frame


def rows_of(table, controller, variable):
    return table.query("controller == @controller and variable == @variable")


def texts(figure):
    """All text of a figure, line breaks as spaces."""
    figure.draw_without_rendering()
    return " ".join(text.get_text() for text in figure.findobj(matplotlib.text.Text)).replace("\n", " ")


def test_response_table_holds_mean_and_deviation_of_true_states_and_applied_inputs():
    x, u = torch.tensor([[[1.0], [3.0]], [[2.0], [2.0]]]), torch.tensor([[[5.0], [7.0]]])
    table = response_table(*(Trajectories(k * x, x + 100, k * u, u + 100) for k in (1, 10)), ("T",), ("T_E",))
    assert list(table.columns) == ["controller", "variable", "kind", "time_index", "mean", "std"]
    for controller, k in (("agent", 1), ("expert", 10)):
        rows = [["T", "controlled", 0, 2.0 * k, pytest.approx(k * 2**0.5)], ["T", "controlled", 1, 2.0 * k, 0.0]]
        rows += [["T_E", "manipulated", 0, 6.0 * k, pytest.approx(k * 2**0.5)]]
        assert table.query(f"controller == '{controller}'").to_numpy()[:, 1:].tolist() == rows


@pytest.mark.parametrize("n_loops", [1, 2, 3])
def test_control_figure_draws_every_response_as_given_and_names_it(n_loops):
    table = response(n_loops)
    figure = draw(n_loops, table)
    axes, shown = figure.axes, texts(figure)
    assert len(axes) == 3 * n_loops  # response, control and zoom of each loop
    assert all(DEVIATION in panel.get_ylabel().replace("\n", " ") for panel in axes)
    assert shown.count("control interaction (sample)") == 2 * n_loops
    parts = ("$C_{A0}^*$", "agent", "PID", "set point", "standard deviation", "manipulated variable")
    assert all(part in shown for part in (*parts, *(rf"\mathbf{{{letter}}}" for letter in "ABCDEF"[: 2 * n_loops])))
    assert ("Jacket temperature $T_E^*$" in shown) is (n_loops > 1)
    for loop in range(n_loops):
        shown_in = [(OUTPUTS[loop], 0), (INPUTS[loop], 0), (OUTPUTS[loop], 5)]
        for panel, (variable, start) in zip(axes[3 * loop : 3 * loop + 3], shown_in, strict=True):
            lines = {str(line.get_label()): line for line in panel.lines}
            bands = {str(band.get_label()): band for band in panel.collections if isinstance(band, PolyCollection)}
            for controller in ("agent", "expert"):
                expected = rows_of(table, controller, variable).query("time_index >= @start")
                label = f"{expected['kind'].iloc[0]}, {controller}"
                points = lines[label].get_xydata()
                np.testing.assert_array_equal(points[: len(expected)], expected[["time_index", "mean"]])
                if start:  # a band would fill the zoom
                    assert bands == {}
                else:
                    outline = np.asarray(bands[f"{label}: {figures.BAND}"].get_paths()[0].vertices)
                    for edge in (expected["mean"] - expected["std"], expected["mean"] + expected["std"]):
                        assert np.isin(edge, outline[:, 1]).all()
                if variable in INPUTS:  # the last input acts until sample T, where it is drawn once more
                    assert points[-1].tolist() == [N_STEPS, points[-2, 1]]
                    assert len(points) == N_STEPS + 1
                    assert lines[label].get_drawstyle() == "steps-post"
                else:
                    assert lines["set point"].get_xydata().tolist() == [[start, SET_POINTS[loop]], [N_STEPS, SET_POINTS[loop]]]


def test_control_figure_has_the_colours_of_the_paper_and_styles_that_differ():
    """Red and blue of the agent, dark and light green of the PID, orange of the set point."""
    drawn = draw()
    handles = zip(drawn.legends[0].get_texts(), drawn.legends[0].legend_handles, strict=True)
    lines = {text.get_text().split(r" $\pi")[0]: line for text, line in handles if isinstance(line, Line2D)}
    look = {label: (line.get_color(), line.get_linestyle()) for label, line in lines.items()}
    expected = {"controlled variable, agent": ("#d7191c", "-"), "controlled variable, PID": ("#00682f", "--")}
    expected |= {"manipulated variable, agent": ("#1f4fd8", "-"), "manipulated variable, PID": ("#5fc45f", "--")}
    assert look == expected | {"set point": ("#ff8c00", "--")}
    for axes in drawn.axes:  # the legend speaks of the lines that are drawn
        assert {line.get_color() for line in axes.lines} <= {colour for colour, _ in look.values()}


def budget_figure():
    rows = [(s, c, n, c + s + n / 500) for s in range(3) for c in (1, 2) for n in (500, 20, 100)]
    budget = pd.DataFrame(rows, columns=["seed", "case", "episodes_per_epoch", "objective"])
    levels = {"PID": 1.5, "offline policy": 1.2, "minimum variance on y": 5.0}
    return figures.budget_figure(budget, {1: levels, 2: levels})


KINDS = {"control": lambda: draw(3), "budget": budget_figure, "mdp": drawings.mdp_figure, "framework": drawings.framework_figure}
KINDS |= {"seeds": lambda: draw(2, several(response(), ["mean"])), "network": lambda: drawings.network_figure((20, 20), 2, 2, 0.01)}
KINDS |= {"tracking": lambda: figures.tracking_figure(response(), OUTPUTS[:2], SET_POINTS[:2], WORDS)}
KINDS |= {"curves": lambda: figures.learning_curves(history(), {40: "policy kept"}, {"PID": 3.0}, {"paper": 0.1})}
KINDS |= {"online": lambda: figures.learning_curves(history()[["epochs", "mean_return"]], {10: "second round"}, {"PID": 3.0})}


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.torture if kind != "control" else ()) for kind in KINDS])
def test_nothing_is_cut_off_and_no_panels_overlap(kind):
    figure = KINDS[kind]()
    figure.draw_without_rendering()
    drawn = figure.get_tightbbox()
    assert (drawn.min >= -0.01).all()
    assert (drawn.max <= figure.get_size_inches() + 0.01).all()
    panels = [axes.get_tightbbox() for axes in figure.axes] + [legend.get_window_extent() for legend in figure.legends]
    groups = [panels, *([text.get_window_extent() for text in axes.texts] for axes in figure.axes)]
    for group in groups:
        for one, other in combinations(group, 2):
            assert min(one.x1, other.x1) - max(one.x0, other.x0) < 1 or min(one.y1, other.y1) - max(one.y0, other.y0) < 1


@pytest.mark.parametrize("n_loops", [2, 3])
def test_tracking_figure_draws_the_first_interactions_of_the_controlled_variables(n_loops):
    table = response(n_loops)
    figure = figures.tracking_figure(table, OUTPUTS[:n_loops], SET_POINTS[:n_loops], WORDS)
    assert len(figure.axes) == n_loops
    for axes, variable in zip(figure.axes, OUTPUTS, strict=False):
        lines = {line.get_label(): line for line in axes.lines}
        assert set(lines) == {"controlled, agent", "controlled, expert", "set point"}
        for controller in ("agent", "expert"):
            expected = rows_of(table, controller, variable)["mean"][:31]
            np.testing.assert_array_equal(lines[f"controlled, {controller}"].get_ydata(), expected)
        assert DEVIATION in axes.get_ylabel().replace("\n", " ")
    shown = texts(figure)
    assert [word in shown for word in ("after offline learning", "demonstrated", "manipulated")] == [True, True, False]


def test_a_response_without_a_variable_is_refused():
    with pytest.raises(ValueError, match="controller 'agent' and variable 'T_E'"):
        draw(2, response().query("controller == 'expert' or variable != 'T_E'"))


def several(table, columns):
    """The table for four seeds, its columns shifted by 0, 1, 2 and 10."""
    shifts = enumerate((0.0, 1.0, 2.0, 10.0))
    frames = [table.assign(seed=seed, **{name: table[name] + shift for name in columns}) for seed, shift in shifts]
    return pd.concat(frames, ignore_index=True)


def test_several_seeds_are_thin_lines_about_their_median_and_an_input_is_held_until_the_next_sample():
    table = response()
    figure = draw(2, several(table, ["mean", "std"]))
    expected = rows_of(table, "agent", "T")
    panel, of_input = ({axes.get_label(): axes for axes in figure.axes}[name] for name in ("B T", "T_E"))
    (line,) = [line for line in panel.lines if line.get_label() == "controlled, agent"]
    np.testing.assert_allclose(line.get_ydata(), expected["mean"] + 1.5)
    summary = figures.drawn_summary(figure).query("panel == 'B T' and artist == @figures.SINGLE")
    assert len(summary) == 2 * 4  # of expert and agent
    assert np.isin(np.round(expected["mean"].max() + np.array([0.0, 1, 2, 10]), 9), summary["maximum"].round(9)).all()
    band = next(c for c in panel.collections if c.get_label() == f"controlled, agent: {figures.BAND}")
    edge = expected["mean"] + 1.5 + expected["std"] + 1.5
    outline = np.asarray(band.get_paths()[0].vertices)[:, 1]
    assert np.isclose(edge.to_numpy()[:, None], outline, rtol=0, atol=1e-9).any(1).all()
    assert all(words in texts(figure) for words in ("medians over 4 seeds", "the mean of each seed"))
    held = next(collection for collection in of_input.collections if collection.get_label() == figures.SINGLE)
    points = np.asarray(held.get_paths()[0].vertices)
    assert points[-1, 0] == N_STEPS
    assert ((np.diff(points[:, 0]) == 0) | (np.diff(points[:, 1]) == 0)).all()


def test_learning_curves_of_several_seeds_show_each_and_their_median():
    table = history()
    figure = figures.learning_curves(several(table, ["mean_return", "alpha:T-I"]), {40: "policy kept"})
    returns, _, weights = figure.axes
    np.testing.assert_allclose(returns.lines[0].get_ydata(), table["mean_return"] + 1.5)
    np.testing.assert_allclose(weights.lines[1].get_ydata(), table["alpha:T-I"] + 1.5)
    assert [len(axes.collections) for axes in figure.axes] == [1, 1, 6]
    assert all(len(collection.get_paths()) == 4 for axes in figure.axes for collection in axes.collections)
    assert "each of 4 seeds" in texts(figure)


def test_the_budget_curve_shows_median_seeds_and_references():
    figure = budget_figure()
    for case, axes in enumerate(figure.axes, 1):
        assert axes.lines[0].get_xydata().tolist() == pytest.approx(np.array([[n, case + 1 + n / 500] for n in (20, 100, 500)]))
        assert [line.get_ydata()[0] for line in axes.lines[1:]] == [1.5, 1.2, 5.0]
        assert (len(axes.collections[0].get_paths()), axes.get_xscale()) == (3, "log")
    shown = texts(figure)
    parts = ("Case Study II", "plant episodes per epoch", "PID", "offline policy", "minimum variance", "each of 3 seeds", "500")
    assert all(part in shown for part in parts)


def test_learning_curves_draw_return_gap_and_every_weight():
    table = history()
    figure = figures.learning_curves(table, {40: "policy kept"}, {"PID": 3.0}, {"the paper": 0.037})
    returns, gap, weights = figure.axes
    np.testing.assert_array_equal(returns.lines[0].get_xydata(), table[["epochs", "mean_return"]])
    np.testing.assert_array_equal(gap.lines[0].get_xydata(), table[["epochs", "feature_gap"]])
    assert (gap.get_yscale(), gap.get_ylabel()) == ("log", "gap to the expert (%, log scale)")
    labels = [r"$C_A^*$-I", "$T^*$-I", r"$C_A^*$-II", "$T^*$-II", r"$C_A^*$-III", "$T^*$-III"]
    assert [line.get_label() for line in weights.lines[:6]] == labels
    for line, column in zip(weights.lines, (name for name in table if name.startswith("alpha:")), strict=False):
        np.testing.assert_array_equal(line.get_ydata(), table[column])
    assert [[*line.get_ydata()] for line in (returns.lines[1], gap.lines[1])] == [[3.0, 3.0], [0.037, 0.037]]
    assert all([*axes.lines[-1].get_xdata()] == [40, 40] for axes in figure.axes)
    shown = texts(figure)
    assert all(part in shown for part in (*labels, "PID", "the paper", "policy kept", "epoch", "discounted return"))
    names = [f"{loop}-{kind}" for kind in ("I", "II", "III") for loop in OUTPUTS]
    assert len({str(style) for style in figures.feature_styles(names).values()}) == 9  # each has one of its own
    fewer = table[["epochs", "mean_return", "feature_gap"]]  # a panel for what the history holds
    for number, found in ((2, fewer), (1, fewer.drop(columns="feature_gap")), (1, fewer.assign(feature_gap=np.nan))):
        assert len(figures.learning_curves(found).axes) == number


def test_the_drawing_of_a_network_names_its_layers_and_their_cells():
    shown = texts(drawings.network_figure((12, 34, 56), 3, 5, 0.02))
    parts = r"layer 3|12 cells|34 cells|56 cells|56 → 10|slope 0.02|ReLU6|(3)|(5)|\sigma_t|u_{max}"
    assert all(part in shown for part in parts.split("|"))


def test_drawn_summary_reads_back_what_was_drawn_and_figures_are_left_to_the_caller():
    table = response()
    summary = figures.drawn_summary(draw(2, table)).set_index(["panel", "artist"])
    assert matplotlib.pyplot.get_fignums() == []
    mean, std = rows_of(table, "agent", "T")[["mean", "std"]].to_numpy().T
    numbers = [N_STEPS + 1, 0, N_STEPS, mean[0], mean.min(), mean.max(), mean.mean(), mean[-1]]
    assert summary.loc[("B T", "controlled, agent")].tolist() == pytest.approx(numbers)
    assert summary.loc[("D T zoom", "set point"), "mean"] == 4.0
    band = summary.loc[("B T", f"controlled, agent: {figures.BAND}")]
    assert band[["minimum", "maximum"]].tolist() == pytest.approx([(mean - std).min(), (mean + std).max()])
    assert sum("standard deviation" in label for _, label in summary.index) == 8
    assert len(summary) == 12 + 8 + 4


@pytest.mark.torture
def test_svg_is_the_same_each_time_and_its_text_is_text(tmp_path):
    one, two = tmp_path / "one.svg", tmp_path / "two.svg"
    for path in (one, two):
        draw().savefig(path, metadata={"Date": None})
    assert one.read_bytes() == two.read_bytes()
    assert "control interaction (sample)" in one.read_text(encoding="utf-8")
