"""Our own drawings of Figures 1 and 2 of the paper and of the policy network."""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.path import Path

from helpers.report.figures import INK, MUTED, WIDTH, empty_figure

REWARD = "#b2332a"
FILLS = {"plain": "#ffffff", "data": "#fdf1dc", "agent": "#dfe9fb", "process": "#e0f0e3", "reward": "#fbe3e1"}


def mdp_figure() -> Figure:
    """Figure 1 drawn anew: process control as a Markov decision process."""
    figure, axes = _canvas(8.0, 3.7)
    policy = r"$u_t \sim \pi(u_t \mid y_t, \ldots\,; \theta)$"
    dynamics = "$x_{t+1} \\sim p(x_{t+1} \\mid x_t, u_t)$\n$y_{t+1} \\sim p(y_{t+1} \\mid x_{t+1})$"
    _box(axes, 4.15, 3.0, 3.4, 1.0, f"Controller (agent)\n{policy}", "agent")
    _box(axes, 4.15, 0.8, 3.4, 1.3, f"Process (environment)\ntrue state $x_t$, not seen by the agent\n{dynamics}", "process")
    _path(axes, [(5.85, 3.0), (7.7, 3.0), (7.7, 0.8), (5.85, 0.8)])
    _note(axes, 7.6, 1.95, "control action $u_t$", "right")
    _path(axes, [(2.45, 1.05), (1.25, 1.05), (1.25, 3.2), (2.45, 3.2)])
    _note(axes, 1.15, 2.25, "observation\n$y_{t+1}$", "right")
    _path(axes, [(2.45, 0.55), (1.85, 0.55), (1.85, 2.8), (2.45, 2.8)], REWARD)
    _note(axes, 1.97, 2.25, "reward\n$R_{t+1}$", "left", REWARD)
    _note(axes, 2.3, 1.66, "next sample: $t + 1$ becomes $t$", "left", MUTED)
    axes.annotate("", (0.9, 1.66), (2.24, 1.66), arrowprops={"arrowstyle": "-", "color": MUTED, "linestyle": ":", "linewidth": 1.4})
    return figure


def framework_figure() -> Figure:
    """Figure 2 drawn anew: offline apprenticeship from process data, online improvement, transfer to a new set point."""
    figure, axes = _canvas(WIDTH, 4.75)
    for left, width, title in ((0.1, 5.1, "Offline: apprenticeship learning"), (5.8, 3.1, "Online: policy improvement")):
        shape = "round,pad=0,rounding_size=0.12"
        axes.add_patch(FancyBboxPatch((left, 1.15), width, 3.5, boxstyle=shape, facecolor="#f6f6f6", edgecolor="#bbbbbb"))
        _note(axes, left + 0.15, 4.42, title, "left", weight="bold")
    _box(axes, 1.0, 3.65, 1.55, 0.95, "Process data\nunder the existing\ncontroller $\\pi^E$", "data")
    _path(axes, [(1.775, 3.65), (2.6, 3.65)])
    _note(axes, 2.17, 3.83, "$v^E$", "center")
    _box(axes, 3.75, 3.65, 2.3, 0.75, "MaxEnt IRL (Algorithm 2)\nreward weights $\\alpha$", "reward")
    _box(axes, 3.75, 2.3, 2.3, 0.75, "REINFORCE (Algorithm 1)\npolicy $\\pi_\\theta$, process model", "agent")
    _path(axes, [(3.45, 3.275), (3.45, 2.675)])
    _note(axes, 3.36, 2.97, "reward\n$R_t = \\alpha\\cdot\\phi_t$", "right")
    _path(axes, [(4.05, 2.675), (4.05, 3.275)])
    _note(axes, 4.14, 2.97, "features\n$\\mathrm{E}[v^{\\pi}]$", "left")
    _path(axes, [(3.75, 1.925), (3.75, 1.75)])
    _box(axes, 3.75, 1.53, 2.3, 0.44, "weights $\\alpha^*$, policy $\\pi_\\theta$", "plain")
    _path(axes, [(4.9, 1.53), (5.5, 1.53), (5.5, 3.65), (6.05, 3.65)])
    _note(axes, 5.5, 2.6, "policy\nas start", "center", background="#ffffff")
    _box(axes, 7.35, 3.65, 2.6, 0.75, "REINFORCE (Algorithm 1)\npolicy $\\pi_\\theta$, real objective", "agent")
    _box(axes, 7.35, 2.3, 2.6, 0.75, "Process", "process")
    _path(axes, [(7.05, 3.275), (7.05, 2.675)])
    _note(axes, 6.96, 2.97, "$u_t$", "right")
    _path(axes, [(7.65, 2.675), (7.65, 3.275)])
    _note(axes, 7.74, 2.97, "$y_{t+1}$, $R_{t+1}$", "left")
    _path(axes, [(7.35, 1.925), (7.35, 1.75)])
    _box(axes, 7.35, 1.53, 2.6, 0.44, "improved policy $\\pi^A$", "plain")
    _path(axes, [(3.75, 1.31), (3.75, 0.75)])
    _box(axes, 3.75, 0.45, 2.3, 0.6, "Knowledge transfer\nto a new set point", "data")
    _path(axes, [(2.6, 0.45), (2.2, 0.45), (2.2, 2.3), (2.6, 2.3)])
    _path(axes, [(2.2, 2.3), (2.2, 3.42), (2.6, 3.42)])
    _note(axes, 2.1, 1.9, "weights and\npolicy as start", "right")
    return figure


def network_figure(hidden_cells: Sequence[int], n_controlled: int, n_manipulated: int, leaky_slope: float) -> Figure:
    """The policy as a network: what it sees, its layers and activations, and how its outputs become a distribution."""
    pitch, middle = 1.85, 1.35  # inches from layer to layer; height of the signal's way
    figure, axes = _canvas(5.4 + pitch * len(hidden_cells), 2.95)
    _box(axes, 0.85, middle + 0.7, 1.5, 0.95, f"errors $y_{{sp}} - y_t$\nof the loops\n({n_controlled})", "data")
    _box(axes, 0.85, middle - 0.7, 1.5, 0.95, f"previous\ninputs $u_{{t-1}}$\n({n_manipulated})", "data")
    left = 1.95
    for height in (0.7, -0.7):
        _path(axes, [(1.6, middle + height), (left, middle + height * 0.35)])
    for layer, cells in enumerate(hidden_cells, start=1):
        _box(axes, left + 0.5, middle, 1.0, 1.7, f"LSTM\nlayer {layer}\n\n{cells} cells", "agent")
        top = middle + 0.85
        _path(axes, [(left + 0.8, top), (left + 0.8, top + 0.3), (left + 0.2, top + 0.3), (left + 0.2, top)])
        _note(axes, left + 0.5, top + 0.47, "$h_{t-1},\\ c_{t-1}$", "center")
        _activation(axes, left + 1.0, middle, f"leaky ReLU, slope {leaky_slope:g}")
        _path(axes, [(left + 1.49, middle), (left + pitch, middle)])
        left += pitch
    _box(axes, left + 0.5, middle, 1.0, 1.7, f"output\nlayer\n\n{hidden_cells[-1]} → {n_manipulated + n_manipulated}", "agent")
    _activation(axes, left + 1.0, middle, "ReLU6: 0 to 6")
    for height, name, low, high in (
        (0.75, "mean $\\mu_t$", "u_{min}", "u_{max}"),
        (-0.75, "standard\ndeviation $\\sigma_t$", "\\sigma_{min}", "\\sigma_{max}"),
    ):
        _path(axes, [(left + 1.49, middle + height * 0.35), (left + 1.85, middle + height)])
        text = f"{name} ({n_manipulated})\n0 to 6 mapped to\n${low}$ to ${high}$"
        _box(axes, left + 2.6, middle + height, 1.5, 1.05, text, "process")
    _note(axes, left + 2.6, middle, "$u_t \\sim N(\\mu_t,\\ \\mathrm{diag}\\,\\sigma_t^2)$", "center")
    return figure


def _canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure for a drawing, whose coordinates are inches from its lower left corner."""
    figure = empty_figure(width, height)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.set_axis_off()
    return figure, axes


def _box(axes: Axes, x: float, y: float, width: float, height: float, text: str, fill: str, **style: Any) -> None:
    """A rounded box about the centre (x, y)."""
    corner, shape = (x - width / 2, y - height / 2), "round,pad=0,rounding_size=0.08"
    look: Any = {"boxstyle": shape, "facecolor": FILLS[fill], "edgecolor": INK, "linewidth": 1.1}
    axes.add_patch(FancyBboxPatch(corner, width, height, zorder=3, **look))
    axes.text(x, y, text, ha="center", va="center", color=INK, linespacing=1.35, zorder=4, **{"fontsize": 10, **style})


def _path(axes: Axes, corners: Sequence[tuple[float, float]], colour: str = INK) -> None:
    """A straight or bent line through the corners, with an arrow head at the last."""
    path = Path(list(corners))
    arrow = FancyArrowPatch(path=path, arrowstyle="-|>", mutation_scale=11, color=colour, linewidth=1.2, joinstyle="miter")
    arrow.set_fill(True)
    axes.add_patch(arrow)


def _note(axes: Axes, x: float, y: float, text: str, align: str, colour: str = INK, **style: Any) -> None:
    """Text beside a line, or upon it if it has a background."""
    behind: Any = {"facecolor": style.pop("background", "none"), "edgecolor": "none", "pad": 2}
    axes.text(x, y, text, ha=align, va="center", color=colour, fontsize=10, linespacing=1.3, zorder=4, bbox=behind, **style)


def _activation(axes: Axes, x: float, y: float, text: str) -> None:
    """An activation on the way out of the layer whose right edge is at x."""
    _path(axes, [(x, y), (x + 0.15, y)])
    _box(axes, x + 0.32, y, 0.34, 1.7, text, "reward", rotation=90, fontsize=9.5)
