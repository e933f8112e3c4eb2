"""Figures of control quality, each with its definition, from trajectories of one controller.

All are of the true state x and of the normalised error e of Eq. 4.2.1, so that set point and earlier steady state are 0 and 1;
step-response figures are about the set point, not the last sample. What is never reached is nan. `evaluation.scores` has overshoot
and rise time of the mean response too, in the number type of the run, to the last bit as notebooks 01 to 04 have always saved them.
"""

import numpy as np
import torch
from torch import Tensor

from helpers.learning.features import FeatureMap
from helpers.plant.task import Trajectories
from helpers.settings.limits import QualityParams

RISE = (0.1, 0.9)
AT_BOUND = 1e-6  # share of the range: an interpolated input may miss its bound by a last digit


def integral_errors(error: Tensor, sampling_time: float) -> dict[str, Tensor]:
    """ISE, IAE and ITAE of each trajectory and loop: sum dt of e^2, |e| and t |e| (Seborg et al. 2016, Section 12.3.2).

    Args:
        error: at t = 1..T, shape (T, K, n_y).

    Returns:
        By name, each (K, n_y); units time, time and time^2.
    """
    time = sampling_time * torch.arange(1, len(error) + 1, dtype=error.dtype)[:, None, None]
    integrands = {"ise": error**2, "iae": error.abs(), "itae": time * error.abs()}
    return {name: sampling_time * integrand.sum(0) for name, integrand in integrands.items()}


def rise_time(response: Tensor, sampling_time: float) -> Tensor:
    """Time between first reaching 10 and first reaching 90 % of the set point change; (T + 1, ...) to (...); nan if never.

    Args:
        response: 1 - e at t = 0..T.
    """
    first = [torch.where((response >= level).any(0), (response >= level).int().argmax(0).double(), torch.nan) for level in RISE]
    return (first[1] - first[0]) * sampling_time


def settling_time(response: Tensor, sampling_time: float, band: float) -> Tensor:
    """First time from which on |1 - response| stays below `band`; (T + 1, ...) to (...); nan if outside at the end."""
    outside = (response - 1).abs() >= band
    count = torch.arange(1, len(response) + 1).reshape(-1, *[1] * (response.ndim - 1))
    settled = (outside * count).amax(0).double()
    return torch.where(settled < len(response), settled * sampling_time, torch.nan)


def overshoot(response: Tensor) -> Tensor:
    """How far the response passes the set point, as a share of the set point change; (T + 1, ...) to (...)."""
    return (response.amax(0) - 1).clamp(min=0)


def worst_mean(values: Tensor, share: float) -> Tensor:
    """Conditional value at risk: the mean of the worst share of the trajectories, at least one; (K, n) to (n,).

    Rockafellar and Uryasev 2000.
    """
    n_worst = max(1, round(share * len(values)))
    return values.sort(dim=0, descending=True).values[:n_worst].mean(0)


def harris_index(deviation: np.ndarray, order: int) -> float:
    """Minimum attainable variance over the mean square deviation from the set point: one is minimum-variance control.

    Harris 1989, for a dead time of one sample: the minimum variance is that of the innovations, estimated by an autoregressive
    model (Desborough and Harris 1992). The mean square counts an offset too.

    Args:
        deviation: y - y_sp of one loop, shape (T,).
        order: of the autoregressive model.
    """
    centred = deviation - deviation.mean()
    past = np.stack([centred[order - lag : len(centred) - lag] for lag in range(1, order + 1)], axis=-1)
    present = centred[order:]
    coefficients = np.linalg.lstsq(past, present, rcond=None)[0]
    innovations = present - past @ coefficients
    variance = innovations @ innovations / (len(present) - order)
    return float(variance / np.mean(deviation[order:] ** 2))


def input_figures(trajectories: Trajectories, low: Tensor, high: Tensor) -> dict[str, Tensor]:
    """Total variation sum_t |u_t - u_(t-1)|, mean over trajectories, and share of samples at a bound; each (n_u,)."""
    u, reach = trajectories.u, AT_BOUND * (high - low)
    at_bound = (u <= low + reach) | (u >= high - reach)
    return {"total_variation": u.diff(dim=0).abs().sum(0).mean(0), "at_bound": at_bound.to(u.dtype).mean((0, 1))}


def quality(
    trajectories: Trajectories, features: FeatureMap, params: QualityParams, loops: tuple[str, ...], inputs: tuple[str, ...]
) -> dict[str, float]:
    """All figures but the Harris index, by name and variable.

    ise, iae, itae and offset (mean e over the last samples): means over the trajectories; iae_worst: `worst_mean` of the IAE.
    overshoot, rise_time and settling_time_<band>: of the mean response; the same with _single: medians over the trajectories in
    which they are defined, and with _reached the share of those.
    """
    dt, task = features.sampling_time, features.task
    on_state = features.on("x")
    error = on_state.errors(trajectories).double()
    response = ((trajectories.x - task.set_point) / task.error_scale + 1).double()
    figures = integral_errors(error, dt)
    rows = {name: values.mean(0) for name, values in figures.items()}
    rows["iae_worst"] = worst_mean(figures["iae"], params.worst)
    rows["offset"] = error[-params.n_last :].mean((0, 1))
    for kind, signal in (("", response.mean(1)), ("_single", response)):
        found = {"overshoot": overshoot(signal), "rise_time": rise_time(signal, dt)}
        found |= {f"settling_time_{100 * band:g}": settling_time(signal, dt, band) for band in params.bands}
        for name, values in found.items():
            rows[f"{name}{kind}"] = values if not kind else values.nanmedian(0).values
            if kind and name != "overshoot":
                rows[f"{name}_reached"] = values.isfinite().double().mean(0)
    scores = {f"{name}:{loop}": value for name, of in rows.items() for loop, value in zip(loops, of.tolist(), strict=True)}
    of_inputs = input_figures(trajectories, task.input_low, task.input_high)
    return scores | {
        f"{name}:{entry}": value for name, of in of_inputs.items() for entry, value in zip(inputs, of.tolist(), strict=True)
    }
