"""Pictures of verdicts: what is drawn is what was handed in, marked by colour and shape."""

from itertools import product

import numpy as np
import pandas as pd
import pytest

from helpers.report import verdict_figures
from helpers.report.verdict_figures import MARKS

NAMES = ["C_A-I", "T-I", "C_A-II", "T-II"]
VERDICTS = {"expert": "fitted", "policy": "differs", "alpha": "cannot tell"}


def compared(cases=(1, 2)):
    """Ours is a tenth above the published number, the interval reaches from half of it to twice it."""
    table = pd.DataFrame(product(cases, VERDICTS, NAMES), columns=["case", "row", "feature"])
    published = -2.0 - table["feature"].map(NAMES.index)
    table = table.assign(table=table["case"] + 1, published=published, reproduced=0.9 * published)
    verdicts = table["row"].map(VERDICTS).mask(table["feature"] == "T-II", "match")
    return table.assign(pred_low=2 * published, pred_high=published / 2, verdict=verdicts)


def test_every_published_number_is_in_the_picture_with_ours_relative_to_it():
    figure = verdict_figures.comparison_figure(compared())
    assert [axes.get_label() for axes in figure.axes] == ["Table 2", "Table 3"]
    for axes in figure.axes:
        points = {line.get_label(): line for line in axes.lines if line.get_marker() not in ("None", "")}
        assert set(points) == {f"{row} {name}" for row, name in product(VERDICTS, NAMES)}
        assert [line.get_xdata()[0] for line in points.values()] == pytest.approx([10.0] * 12)
        heights = [line.get_ydata()[0] for line in points.values()]
        assert heights == sorted({*heights}, reverse=True)
        spans = [line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 2 and line.get_marker() == "None"][:12]
        np.testing.assert_allclose(spans, [[-100.0, 50.0]] * 12)
        for label, line in points.items():
            verdict = "match" if label.endswith("T-II") else VERDICTS[label.split()[0]]
            assert (line.get_marker(), line.get_color()) == (MARKS[verdict]["marker"], MARKS[verdict]["color"])
    assert len({mark["marker"] for mark in MARKS.values()}) >= 6  # told apart without colours
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["match", "differs", "cannot tell", "fitted"]


def test_the_weights_are_drawn_while_they_are_learned_and_beside_the_printed_ones():
    epochs = np.arange(1, 21)
    runs = [{"epochs": epochs, "seed": seed} | dict.fromkeys((f"alpha:{name}" for name in NAMES), 0.1 * seed) for seed in range(3)]
    history = pd.concat(map(pd.DataFrame, runs))
    figure = verdict_figures.weights_figure(history, compared((1,)))
    first, second, last = figure.axes
    assert [axes.get_label() for axes in figure.axes] == ["A C_A", "B T", "printed"]
    for axes, loop in ((first, "C_A"), (second, "T")):
        assert len(axes.lines) == 4
        np.testing.assert_allclose(axes.lines[0].get_ydata(), 0.1)  # the median over the seeds
        published = compared((1,)).set_index(["row", "feature"])["published"]
        assert [line.get_ydata()[0] for line in axes.lines[1::2]] == [published["alpha", f"{loop}-{kind}"] for kind in ("I", "II")]
    points = {line.get_label(): line.get_xdata()[0] for line in last.lines}
    assert (points["ours T-I"], points["printed T-I"]) == (pytest.approx(-2.7), -3.0)


def test_a_claim_has_a_mark_for_each_case_that_it_speaks_of():
    long = f"Another claim that is {'very ' * 30}long"
    rows = [("One claim", "holds", "in part", ""), (long, "", "does not hold", "cannot tell")]
    judged = pd.DataFrame(rows, columns=["statement", "I", "II", "III"]).assign(section="5", overall="", quantities="")
    (axes,) = verdict_figures.claims_figure(judged).axes
    marks = {(line.get_xdata()[0], line.get_label()): line.get_marker() for line in axes.lines}
    assert len(axes.lines) == 4
    assert [marks[0, "I"], marks[2, "III"]] == [MARKS["holds"]["marker"], MARKS["cannot tell"]["marker"]]
    assert [label.get_text().split()[0] for label in axes.get_yticklabels()] == ["One", "Another"]


def test_the_profile_of_a_setting_is_the_parabola_of_its_interval():
    """The loss rises by ((value - 2) / 0.1)^2; allowed is a rise of 1, so that the interval ends at 1.9 and 2.1."""
    value = np.array([1.5, 2.0, 2.3])
    profiles = pd.DataFrame({"setting": "PID1.integral T", "value": value, "rise": (10 * (value - 2)) ** 2})
    settings = {"setting": ["PID1.integral"], "component": ["T"], "low": [1.9], "high": [2.1], "in_parameter_files": [2.05]}
    (axes, *empty) = verdict_figures.profiles_figure(profiles, pd.DataFrame(settings)).axes
    assert axes.get_title(loc="left") == "PID1 integral gain, $T^*$"
    assert not any(axes.axison for axes in empty)
    curve = next(line for line in axes.lines if line.get_label() == "rise of the loss")
    np.testing.assert_allclose(curve.get_ydata(), (10 * (curve.get_xdata() - 2)) ** 2, atol=1e-9)
    assert curve.get_xdata()[[0, -1]] == pytest.approx([1.78, 2.22])
