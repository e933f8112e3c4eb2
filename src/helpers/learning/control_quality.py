"""Figures of control quality, each with its definition, from trajectories of one controller.

All are of the true state x and of the normalised error e of Eq. 4.2.1, so that set point and earlier steady state are 0 and 1;
step-response figures are about the set point, not the last sample. What is never reached is nan. `evaluation.scores` has overshoot
and rise time of the mean response too, in the number type of the run, to the last bit as notebooks 01 to 04 have always saved them.
"""

import numpy as np
import torch
from torch import Tensor

from helpers.learning.evaluation import overshoot, rise_time, total_variation
from helpers.learning.features import FeatureMap, normalised_error
from helpers.plant.task import Trajectories
from helpers.settings.limits import QualityParams

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


def settling_time(error: Tensor, sampling_time: float, band: float) -> Tensor:
    """First time from which on |e| stays below `band`; e at t = 0..T, (T + 1, ...) to (...); nan if outside at the end."""
    count = torch.arange(1, len(error) + 1).reshape(-1, *[1] * (error.ndim - 1))
    settled = ((error.abs() >= band) * count).amax(0).double()
    return torch.where(settled < len(error), settled * sampling_time, torch.nan)


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
    return {"total_variation": total_variation(u), "at_bound": at_bound.to(u.dtype).mean((0, 1))}


def quality(
    trajectories: Trajectories, features: FeatureMap, params: QualityParams, loops: tuple[str, ...], inputs: tuple[str, ...]
) -> dict[str, float]:
    """All figures but the Harris index, by name and variable.

    ise, iae, itae and offset (mean e over the last samples): means over the trajectories; iae_worst: `worst_mean` of the IAE.
    overshoot, rise_time and settling_time_<band>: of the mean response; the same with _single: medians over the trajectories in
    which they are defined, and with _reached the share of those.
    """
    dt, task = features.sampling_time, features.task
    error = normalised_error(trajectories.x, task.set_point, task.error_scale).double()
    figures = integral_errors(error[1:], dt)
    rows = {name: values.mean(0) for name, values in figures.items()}
    rows["iae_worst"] = worst_mean(figures["iae"], params.worst)
    rows["offset"] = error[-params.n_last :].mean((0, 1))
    for kind, signal in (("", error.mean(1)), ("_single", error)):
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
