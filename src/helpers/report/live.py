"""What notebook 10 shows: the controllers of a case side by side, wherever a reader moves set point, disturbance and noise."""

from collections.abc import Mapping, Sequence

import ipywidgets as widgets
from IPython.display import display
from matplotlib.figure import Figure

from helpers.learning.policy import LSTMPolicy
from helpers.plant.task import Trajectories
from helpers.report.figures import BAND, BAND_OPACITY, LOOP_COLOURS, SET_POINT, TIME_LABEL, WIDTH, empty_figure, head, symbol
from helpers.runs.study import Study
from helpers.settings.leaf import DEVIATION

N_TRAJECTORIES = 200
CONTROLLERS = LOOP_COLOURS[:1] + LOOP_COLOURS[2:]  # without that of the set point


def elsewhere(study: Study, set_point: Sequence[float], disturbance: float = 1.0, noise: float = 1.0) -> Study:
    """The case at a set point, (n_y,) in deviation variables, with its disturbance and observation noise times a factor each.

    Errors are still counted in the units of the case's own set point, so that objectives can be compared.
    """
    case, process = study.params.case, study.params.process
    return study.varied(
        case={"set_point": tuple(set_point), "error_scale": case.scale_of_error},
        process={
            "disturbance": tuple(disturbance * gain for gain in process.disturbance),
            "observation_noise": tuple(noise * std for std in process.observation_noise),
        },
    )


def runs(study: Study, policies: Mapping[str, LSTMPolicy]) -> dict[str, Trajectories]:
    """Trajectories of the PID and of each policy, which all meet the same disturbances, by name."""
    expert = {"PID": study.fresh(study.expert, N_TRAJECTORIES)}
    return expert | {name: study.fresh(policy, N_TRAJECTORIES) for name, policy in policies.items()}


def objectives(study: Study, policies: Mapping[str, LSTMPolicy]) -> dict[str, float]:
    """The tracking objective J on the true state of the PID and of each policy, by name."""
    return {name: study.judge(batch)["objective_x"] for name, batch in runs(study, policies).items()}


def side_by_side(study: Study, policies: Mapping[str, LSTMPolicy]) -> Figure:
    """Mean and standard deviation of every output and input under the PID and each policy."""
    process, found = study.params.process, runs(study, policies)
    labels = [f"{name}: J = {study.judge(batch)['objective_x']:.1f}" for name, batch in found.items()]
    figure = empty_figure(WIDTH, 5.6)
    grid = figure.subplots(2, max(len(process.controlled), len(process.manipulated)), squeeze=False, sharex=True)
    for row, (names, kind) in zip(grid, ((process.controlled, "x"), (process.manipulated, "u")), strict=True):
        for loop, (axes, name) in enumerate(zip(row, names, strict=False)):
            for colour, label, batch in zip(CONTROLLERS, labels, found.values(), strict=False):
                signal = getattr(batch, kind)[..., loop].double()
                low, mean, high = (signal.mean(1) + side * signal.std(1) for side in (-1, 0, 1))
                axes.fill_between(range(len(mean)), low, high, color=colour, alpha=BAND_OPACITY, linewidth=0, label=BAND)
                axes.plot(mean, color=colour, label=label)
            if kind == "x":
                axes.axhline(study.params.case.set_point[loop], color=SET_POINT, linestyle=":", label="set point")
            head(axes, "", symbol(name), name, ylabel=DEVIATION.replace(", ", ",\n"))
    lines = grid[0, 0].lines
    figure.supxlabel(TIME_LABEL)
    figure.legend(handles=lines, loc="outside upper center", ncols=len(lines), frameon=False)
    return figure


def panel(study: Study, policies: Mapping[str, LSTMPolicy]) -> widgets.VBox:
    """Sliders for set point, disturbance and noise, and `side_by_side` for where they stand."""
    process = study.params.process
    words = dict(zip(process.controlled, process.controlled_description, strict=True))
    style = {"continuous_update": False, "style": {"description_width": "11em"}, "layout": {"width": "30em"}}
    sliders, factors = {}, {}
    for name, value in zip(process.controlled, study.params.case.set_point, strict=True):
        ends = {"min": -2 * abs(value), "max": 2 * abs(value), "step": abs(value) / 10}
        sliders[name] = widgets.FloatSlider(value, description=words[name], **ends, **style)
    for name, what in (("disturbance", "disturbance"), ("noise", "observation noise")):
        factors[name] = widgets.FloatSlider(1.0, min=0.0, max=4.0, step=0.25, description=f"{what} ×", **style)

    def show(disturbance: float, noise: float, **set_point: float) -> None:
        display(side_by_side(elsewhere(study, list(set_point.values()), disturbance, noise), policies))

    shown = widgets.interactive_output(show, {**sliders, **factors})
    return widgets.VBox([widgets.HBox(list(sliders.values())), widgets.HBox(list(factors.values())), shown])
