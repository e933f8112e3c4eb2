"""A linear state-space model with disturbance and noise, identified from the records of a plant by maximum likelihood.

The likelihood is that of statsmodels' Kalman filter. A likelihood of one-step predictions stays consistent on records of a plant
under feedback, where subspace and correlation methods do not (Ljung 1999, Section 13.4).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from statsmodels.stats.diagnostic import acorr_ljungbox
from statsmodels.tsa.statespace.mlemodel import MLEModel

from helpers.own_plant.episodes import Stretch
from helpers.own_plant.model import LinearModel
from helpers.own_plant.settings import PlantIdentificationParams
from helpers.settings.leaf import InputError

Array = NDArray[np.float64]
DIFFUSE = 1e2  # variance of the first state of a stretch, in squared units of the scaled outputs


class VectorARX(MLEModel):
    """z_{t+1} = sum_i A_i z_{t+1-i} + sum_i B_i u_{t+1-i} + c + w_t, y_t = z_t + v_t over stretches apart from each other.

    Scaled signals. The parameters are A_1..A_p, B_1..B_p, c and the square roots of the variances of w and v. At the
    end of a stretch the state is forgotten.

    Args:
        lags: p. y, u: all stretches after each other, (n, n_y) and (n, n_u). last: True at the last sample of a stretch.
    """

    def __init__(self, y: Array, u: Array, last: NDArray[np.bool_], lags: int) -> None:
        self.n_y, self.n_u, self.lags, self.last = y.shape[1], u.shape[1], lags, last
        n_states = self.n_y * lags
        super().__init__(y, k_states=n_states, k_posdef=n_states)
        first = np.roll(last, 1)
        since = np.arange(len(y)) - np.maximum.accumulate(np.where(first, np.arange(len(y)), 0))
        # An input from before the stretch is not known; the first one stands for it.
        self.inputs = np.hstack([u[np.arange(len(u)) - np.minimum(lag, since)] for lag in range(lags)])
        self.ssm["design"] = np.eye(self.n_y, n_states)
        self.ssm["selection"] = np.eye(n_states)
        self.forget = DIFFUSE * np.eye(n_states)
        self.ssm.initialize_known(np.zeros(n_states), self.forget)
        self.ssm["transition"] = np.zeros((n_states, n_states, len(y)))
        self.ssm["state_intercept"] = np.zeros((n_states, len(y)))
        self.ssm["state_cov"] = np.zeros((n_states, n_states, len(y)))

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many parameters A, B, c, w and v have."""
        return self.n_y**2 * self.lags, self.n_y * self.n_u * self.lags, self.n_y, self.n_y, self.n_y

    def split(self, params: Array) -> tuple[Array, Array, Array, Array, Array]:
        """A (n_y, n_y p), B (n_y, n_u p), c, w and v, each (n_y,)."""
        a, b, c, w, v = np.split(params, np.cumsum(self.sizes)[:-1])
        return a.reshape(self.n_y, -1), b.reshape(self.n_y, -1), c, w, v

    def least_squares(self) -> Array:
        """First parameters: least squares on the outputs as they are, most of what is left taken for disturbance."""
        y = np.asarray(self.endog)
        usable = np.flatnonzero(~self.last[:-1])
        for lag in range(1, self.lags):
            usable = usable[usable >= lag]
            usable = usable[~self.last[usable - lag]]
        past = np.hstack([*(y[usable - lag] for lag in range(self.lags)), self.inputs[usable], np.ones((len(usable), 1))])
        known = np.isfinite(past).all(1) & np.isfinite(y[usable + 1]).all(1)
        solution, *_ = np.linalg.lstsq(past[known], y[usable + 1][known], rcond=None)
        left = (y[usable + 1][known] - past[known] @ solution).std(0)
        n_a = self.n_y * self.lags
        return np.concatenate([solution[:n_a].T.ravel(), solution[n_a:-1].T.ravel(), solution[-1], 0.9 * left, 0.3 * left])

    def update(self, params: Array, **kwargs: object) -> None:
        """Put the parameters into the matrices of the filter."""
        a, b, c, w, v = self.split(np.asarray(params))
        n_y, keep = self.n_y, ~self.last
        transition = np.vstack([a, np.eye(n_y * (self.lags - 1), n_y * self.lags)])
        covariance = np.zeros((len(transition), len(transition)))
        covariance[:n_y, :n_y] = np.diag(w**2)
        intercept = np.zeros((len(transition), len(keep)))
        intercept[:n_y] = (b @ self.inputs.T + c[:, None]) * keep
        self.ssm["transition"] = transition[..., None] * keep
        self.ssm["state_intercept"] = intercept
        self.ssm["state_cov"] = np.where(keep, covariance[..., None], self.forget[..., None])
        self.ssm["obs_cov"] = np.diag(v**2)

    def expectation_maximisation(self, params: Array) -> tuple[Array, float, Array]:
        """One step of the EM algorithm (Shumway and Stoffer 1982): it never lowers the likelihood.

        Returns:
            The next parameters, the log-likelihood of the given ones, and the standard errors of A, B and c, as if the
            states were known as well as the smoother knows them, shape (n_y, n_y p + n_u p + 1).
        """
        self.update(params)
        found = self.ssm.smooth()
        n_y, keep = self.n_y, np.flatnonzero(~self.last)
        keep = keep[keep < len(self.last) - 1]
        mean, cov, lagged = found.smoothed_state, found.smoothed_state_cov, found.smoothed_state_autocov
        known = np.vstack([self.inputs[keep].T, np.ones((1, len(keep)))])
        regressor = np.vstack([mean[:, keep], known])
        n_states, n_regressors = len(mean), len(regressor)
        gram = regressor @ regressor.T
        gram[:n_states, :n_states] += cov[..., keep].sum(-1)
        target = mean[:n_y, keep + 1]
        cross = target @ regressor.T
        cross[:, :n_states] += lagged[..., keep].sum(-1)[:n_y]
        solution = np.linalg.solve(gram, cross.T).T
        square = (target**2).sum(1) + np.einsum("iit->i", cov[:n_y, :n_y][..., keep + 1])
        w = np.sqrt(np.maximum(square - (solution * cross).sum(1), 0) / len(keep))
        y = np.asarray(self.endog)
        seen = np.isfinite(y)
        spread = np.einsum("iit->ti", cov[:n_y, :n_y])
        v = np.sqrt(np.where(seen, (np.nan_to_num(y) - mean[:n_y].T) ** 2 + spread, 0).sum(0) / seen.sum(0))
        errors = w[:, None] * np.sqrt(np.diag(np.linalg.inv(gram)))[None, :]
        n_a, n_b = n_y * self.lags, self.n_u * self.lags
        after = np.concatenate([solution[:, :n_a].ravel(), solution[:, n_a : n_a + n_b].ravel(), solution[:, -1], w, v])
        return after, float(found.llf), errors.reshape(n_y, n_regressors)


@dataclass(frozen=True)
class Identified:
    """A model and how it came about.

    Attributes:
        scales: of outputs and inputs, in whose units the likelihood was computed.
        lags: those chosen. criteria: Schwarz's information criterion of each number of lags tried.
        parameters, errors: A, B and c in scaled units, a row for each output, and their standard errors.
        warnings: what the data cannot carry, in sentences.
    """

    model: LinearModel
    scales: tuple[Array, Array]
    lags: int
    criteria: dict[int, float]
    parameters: Array
    vector: Array
    errors: Array
    n_samples: int
    warnings: tuple[str, ...]


def hold_out(pieces: Sequence[Stretch], share: float) -> tuple[list[Stretch], list[Stretch]]:
    """The first part of a record to identify from and the last to judge by; the stretch in between is cut in two."""
    left = round((1 - share) * sum(len(piece) for piece in pieces))
    first: list[Stretch] = []
    last: list[Stretch] = []
    for piece in pieces:
        part = min(max(left, 0), len(piece))
        first += [Stretch(piece.y[:part], piece.u[:part])] if part > 1 else []
        last += [Stretch(piece.y[part:], piece.u[part:])] if len(piece) - part > 1 else []
        left -= len(piece)
    return first, last


def thin_out(pieces: Sequence[Stretch], longest: int, length: int) -> list[Stretch]:
    """At most about `longest` samples: pieces of `length` spread evenly over a longer record."""
    total = sum(len(piece) for piece in pieces)
    if total <= longest:
        return list(pieces)
    cut = [
        Stretch(piece.y[first : first + length], piece.u[first : first + length])
        for piece in pieces
        for first in range(0, len(piece) - 1, length)
    ]
    return [cut[int(index)] for index in np.linspace(0, len(cut) - 1, max(1, longest // length))]


def _model_of(pieces: Sequence[Stretch], scales: tuple[Array, Array], lags: int) -> VectorARX:
    last = np.concatenate([np.arange(len(piece)) == len(piece) - 1 for piece in pieces])
    y, u = (np.concatenate([getattr(piece, name) for piece in pieces]) / scale for name, scale in zip("yu", scales, strict=True))
    return VectorARX(y, u, last, lags)


def identify(
    pieces: Sequence[Stretch], scales: tuple[Array, Array], names: tuple[Sequence[str], Sequence[str]],
    params: PlantIdentificationParams, iterations: int,
) -> Identified:  # fmt: skip
    """The most likely model of each number of lags, and of them the one with the least information criterion.

    Args:
        pieces: deviation variables. scales: what counts as much in outputs (n_y,) and inputs (n_u,).
        names: of outputs and inputs, for the warnings. iterations: of the EM algorithm.
    """
    fits = {}
    n_samples = sum(len(piece) for piece in pieces)
    for lags in params.lags:
        likelihood = _model_of(pieces, scales, lags)
        vector = likelihood.least_squares()
        for _ in range(iterations):
            vector, value, errors = likelihood.expectation_maximisation(vector)
        fits[lags] = (len(vector) * np.log(n_samples) - 2 * value, vector, errors, likelihood)
    lags = min(fits, key=lambda number: float(fits[number][0]))
    _, vector, errors, likelihood = fits[lags]
    a, b, c, _, _ = likelihood.split(vector)
    model = _state_space(likelihood, vector, scales, spread_of(likelihood, vector))
    warnings = []
    largest = float(np.abs(np.linalg.eigvals(model.state_step.numpy())).max())
    if largest >= 1:
        warnings.append(f"the model is not stable: its largest eigenvalue is {largest:.3f}")
    told = np.abs(b) > 2 * errors[:, a.shape[1] : -1]
    for index, name in enumerate(names[1]):
        if not told[:, index :: len(names[1])].any():
            warnings.append(f"the data do not tell an effect of {name} on any output from none")
    return Identified(
        model=model,
        scales=scales,
        lags=lags,
        criteria={number: float(fit[0]) for number, fit in fits.items()},
        parameters=np.hstack([a, b, c[:, None]]),
        vector=vector,
        errors=errors,
        n_samples=n_samples,
        warnings=tuple(warnings),
    )


def spread_of(likelihood: VectorARX, vector: Array) -> Array:
    """How the variance of the one-step errors grows with the deviation, (n_y, 2): a share a + b z^2 of its mean.

    Least squares on the squared residuals with a, b >= 0, weighted once by what the first pass found.
    """
    likelihood.update(vector)
    found = likelihood.ssm.filter()
    variance = np.einsum("iit->ti", found.forecasts_error_cov)
    share = (found.forecasts_error.T**2 / variance)[1:][~likelihood.last[:-1]]
    square = (found.forecasts.T**2)[1:][~likelihood.last[:-1]]
    rows = []
    for values, regressor in zip(share.T, square.T, strict=True):
        design = np.column_stack([np.ones_like(regressor), regressor])
        fitted = np.ones_like(values)
        for _ in range(2):
            solution, _ = nnls(design / fitted[:, None], values / fitted)
            fitted = np.maximum(design @ solution, 0.05 * values.mean())
        rows.append(solution)
    return np.array(rows)


def _state_space(likelihood: VectorARX, vector: Array, scales: tuple[Array, Array], spread: Array) -> LinearModel:
    """The model in deviation variables; with lags the state is (z_t, z_{t-1}, .., u_{t-1}, ..)."""
    a, b, c, w, v = likelihood.split(vector)
    n_y, n_u, lags = likelihood.n_y, likelihood.n_u, likelihood.lags
    y_scale, u_scale = scales
    a = a * y_scale[:, None] / np.tile(y_scale, lags)
    b = b * y_scale[:, None] / np.tile(u_scale, lags)
    n_z, n_x = n_y * lags, n_y * lags + n_u * (lags - 1)
    state_step, input_step = np.zeros((n_x, n_x)), np.zeros((n_x, n_u))
    state_step[:n_y] = np.hstack([a, b[:, n_u:]])
    state_step[n_y:n_z, : n_z - n_y] = np.eye(n_z - n_y)
    state_step[n_z + n_u :, n_z : n_x - n_u] = np.eye(max(0, n_x - n_z - n_u))
    input_step[:n_y] = b[:, :n_u]
    input_step[n_z : n_z + n_u] = np.eye(n_x - n_z, n_u)[:n_u]
    pad = np.zeros(n_x - n_y)
    fixed, gain = np.sqrt(spread).T
    return LinearModel(
        state_step=torch.tensor(state_step),
        input_step=torch.tensor(input_step),
        constant=torch.tensor(np.concatenate([c * y_scale, pad])),
        disturbance=torch.tensor(np.concatenate([w * y_scale * fixed, pad])),
        disturbance_gain=torch.tensor(np.concatenate([w * gain, pad])),
        noise=torch.tensor(v * y_scale * fixed),
        noise_gain=torch.tensor(v * gain),
    )


@dataclass(frozen=True)
class Validation:
    """How a model does on records that it was not identified from.

    Attributes:
        fit: of each output, 1 - rms(y - simulated)/std(y) over windows of one episode simulated from their inputs alone, (n_y,).
        measured, simulated: those windows, (n windows, T, n_y), deviation variables.
        residuals: one-step prediction errors over their predicted standard deviation, (n, n_y).
        p_value: of the Ljung-Box test that they are white, (n_y,). warnings: in sentences.
    """

    fit: Array
    measured: Array
    simulated: Array
    residuals: Array
    p_value: Array
    warnings: tuple[str, ...]


def validate_model(
    identified: Identified, pieces: Sequence[Stretch], horizon: int, names: Sequence[str], params: PlantIdentificationParams
) -> Validation:
    """Simulation fit and whiteness of the residuals on held-out stretches.

    A window begins in the state that the Kalman filter has found by then; after that only the inputs are used.
    """
    likelihood = _model_of(pieces, identified.scales, identified.lags)
    likelihood.update(identified.vector)
    found = likelihood.ssm.filter()
    a, b, c, _, _ = likelihood.split(identified.vector)
    n_y, y_scale = likelihood.n_y, identified.scales[0]
    position = np.concatenate([np.arange(len(piece)) for piece in pieces])
    length = np.concatenate([np.full(len(piece), len(piece)) for piece in pieces])
    warm_up = likelihood.lags + 4  # by then the filter has forgotten where it began
    starts = np.flatnonzero(((position - warm_up) % horizon == 0) & (position >= warm_up) & (position + horizon <= length))
    y = np.asarray(likelihood.endog)
    if not len(starts):
        raise InputError(f"no held-out stretch is as long as {horizon + warm_up} samples, so the model cannot be validated")
    state = found.filtered_state[:, starts]
    simulated = np.empty((horizon, n_y, len(starts)))
    for t in range(horizon):
        simulated[t] = state[:n_y]
        state = np.vstack([a @ state + b @ likelihood.inputs[starts + t].T + c[:, None], state[: len(state) - n_y]])
    measured = y[starts[:, None] + np.arange(horizon)]
    simulated = simulated.transpose(2, 0, 1)
    fit = 1 - np.sqrt(((measured - simulated) ** 2).mean((0, 1))) / measured.std((0, 1))
    usable = position >= warm_up
    spread = np.sqrt(np.einsum("iit->ti", found.forecasts_error_cov))
    residuals = (found.forecasts_error.T / spread)[usable]
    p_value = np.array([float(acorr_ljungbox(column, [params.white_lags])["lb_pvalue"].iloc[0]) for column in residuals.T])
    warnings = [
        f"the model leaves {100 * (1 - value):.0f} % of the movement of {name} unexplained: too much to learn from"
        for name, value in zip(names, fit, strict=True)
        if value < params.least_fit
    ]
    warnings += [
        f"the residuals of {name} are not white (p = {value:.1g}): there is a disturbance or a dynamic that the model does not have"
        for name, value in zip(names, p_value, strict=True)
        if value < params.white
    ]
    return Validation(fit, measured * y_scale, simulated * y_scale, residuals, p_value, tuple(warnings))
