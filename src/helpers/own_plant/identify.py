"""A model of a plant from its records, with its order, its dead times and its uncertainty.

Each output has an equation of its own: A(q) y_t = sum_j B_j(q) u_j,t-1-d_j + c + C(q) e_t, an ARMAX model with a dead time for
each input. Its parameters minimise the one-step prediction errors (Ljung 1999, Sections 7.2 and 10.2), which stays consistent
on records of a plant under feedback, where correlations of input and output do not. Order and dead times are those with the
greatest likelihood on records held out. The uncertainty is an ensemble: the same equation on reweighted blocks of the record.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.signal import lfilter
from statsmodels.stats.diagnostic import acorr_ljungbox

from helpers.own_plant.episodes import Stretch
from helpers.own_plant.model import ArmaxModel
from helpers.own_plant.settings import MarginParams, PlantIdentificationParams
from helpers.settings.leaf import InputError

Array = NDArray[np.float64]
BLOCK = 50  # samples that are drawn together into a member of the ensemble
STEPS, RESTARTS = 12, 2  # Gauss-Newton steps of a fit and of one member of the ensemble
LONG = 12  # lags of the autoregression whose residuals stand for the innovations at the start
ENDS = 1.3  # drawn from -1.3 to 1.3 and cut to -1 to 1, almost a quarter of all draws lie at the ends
TOLD = 4.0  # standard errors from zero
FARTHEST = 0.98  # modulus of a zero of C: beyond it the filter 1/C would remember for longer than a record


@dataclass(frozen=True)
class Structure:
    """What an equation looks like: its order n, the dead time of each input in samples, and whether it has a pole at one."""

    order: int
    dead_times: tuple[int, ...]
    integrating: bool = False

    @property
    def n_own(self) -> int:
        """How many coefficients of A are free."""
        return self.order - self.integrating


@dataclass(frozen=True)
class Equation:
    """One output of a plant, fitted; scaled signals.

    Attributes:
        parameters: the free coefficients of A, those of B input by input, c, and those of C.
        spread: of the innovations, (2,): fixed, and the part that grows with the deviation of the output.
    """

    structure: Structure
    parameters: Array
    spread: Array

    @property
    def free(self) -> Array:
        """The free coefficients of A."""
        return self.parameters[: self.structure.n_own]

    @property
    def own(self) -> Array:
        """a_1..a_n of y_t = a_1 y_{t-1} + .., the pole at one included, shape (n,)."""
        return -np.convolve([1.0, -1.0], np.r_[1.0, -self.free])[1:] if self.structure.integrating else self.free

    @property
    def inputs(self) -> Array:
        """b_1..b_n of each input after its dead time, shape (n_u, n)."""
        n, n_u = self.structure.order, len(self.structure.dead_times)
        return self.parameters[self.structure.n_own :][: n * n_u].reshape(n_u, n)

    @property
    def constant(self) -> float:
        """c."""
        return float(self.parameters[-1 - self.structure.order])

    @property
    def innovations(self) -> Array:
        """c_1..c_n of C(q) = 1 + c_1 q^-1 + .., shape (n,)."""
        return self.parameters[-self.structure.order :]

    @property
    def growth(self) -> float:
        """The largest modulus among the free poles."""
        return float(np.abs(np.roots(np.r_[1.0, -self.free])).max(initial=0.0))


def hold_out(pieces: Sequence[Stretch], share: float) -> tuple[list[Stretch], list[Stretch]]:
    """The first part of a record to identify from and the last to judge by; the stretch in between is cut in two."""
    left, first, last = round((1 - share) * sum(map(len, pieces))), [], []
    for piece in pieces:
        part = min(max(left, 0), len(piece))
        first.append(piece[:part])
        last.append(piece[part:])
        left -= len(piece)
    return [piece for piece in first if len(piece) > 1], [piece for piece in last if len(piece) > 1]


def thin_out(pieces: Sequence[Stretch], longest: int, length: int) -> list[Stretch]:
    """At most about `longest` samples: pieces of `length` spread evenly over a longer record."""
    if sum(map(len, pieces)) <= longest:
        return list(pieces)
    cut = [piece[first : first + length] for piece in pieces for first in range(0, len(piece) - 1, length)]
    return [cut[int(index)] for index in np.linspace(0, len(cut) - 1, max(1, longest // length))]


def lagged(signal: Array, lag: int, fill: float | None = None) -> Array:
    """A signal some samples ago; before the record its first value stands for what is not known, or `fill`."""
    return np.concatenate([np.full(lag, signal[0] if fill is None else fill), signal])[: len(signal)]


def stable_zeros(coefficients: Array) -> Array:
    """C(q) with its zeros inside the unit circle: those outside are mirrored, which leaves the spectrum as it was."""
    roots = np.roots(np.r_[1.0, coefficients])
    size = np.abs(roots)
    inside = np.where(size > 1, roots / np.maximum(size, 1e-12) ** 2, roots)
    inside = inside * np.minimum(1, FARTHEST / np.maximum(np.abs(inside), 1e-12))
    return np.real(np.poly(inside))[1:]


class Record:
    """All stretches of a record for one output, scaled: what is regressed on what, for every structure.

    Args:
        pieces: y (n,) and u (n, n_u) of each stretch. first: the sample of a stretch from which on everything that any structure
            looks back at is known; shorter stretches are left out.
    """

    def __init__(self, pieces: Sequence[tuple[Array, Array]], first: int) -> None:
        self.first = max(first, LONG)
        self.pieces = [piece for piece in pieces if len(piece[0]) > 2 * self.first]

    @classmethod
    def of(cls, pieces: Sequence[Stretch], output: int, scales: tuple[Array, Array], params: PlantIdentificationParams) -> "Record":
        """The record of one output, scaled, for every structure that the settings allow."""
        first = max(params.orders) + params.longest_dead_time + 1
        return cls([(piece.y[:, output] / scales[0][output], piece.u / scales[1]) for piece in pieces], first)

    @lru_cache(maxsize=8)  # noqa: B019 - a record lives no longer than its identification
    def regression(self, structure: Structure) -> list[tuple[Array, Array]]:
        """Target (n,) and regressors (n, p) of each stretch: own past, inputs, and one."""
        found, first = [], self.first
        for y, u in self.pieces:
            signal = np.diff(y, prepend=y[:1]) if structure.integrating else y
            past = [lagged(signal, lag) for lag in range(1, structure.n_own + 1)]
            moved = [
                lagged(u[:, j], 1 + dead + lag) for j, dead in enumerate(structure.dead_times) for lag in range(structure.order)
            ]
            found.append((signal[first:], np.column_stack([*past, *moved, np.ones(len(y))])[first:]))
        return found

    def errors(self, structure: Structure, parameters: Array) -> list[Array]:
        """One-step prediction errors of each stretch; the first ones of a stretch start from innovations of zero."""
        n = structure.order
        c = np.r_[1.0, parameters[-n:]]
        return [lfilter([1.0], c, target - past @ parameters[:-n]) for target, past in self.regression(structure)]

    def starts(self, structure: Structure) -> list[Array]:
        """First parameters: after Hannan and Rissanen (1982), with the residuals of a long autoregression as innovations; then with
        all that is left taken for noise of the sensor, C = A; then for disturbance, C = 1.
        """
        regression, n = self.regression(structure), structure.order
        long = self.regression(Structure(LONG, structure.dead_times, structure.integrating))
        coefficients = _least_squares(long)
        rows = [
            (target, _with_innovations(past, late - far @ coefficients, n))
            for (target, past), (late, far) in zip(regression, long, strict=True)
        ]
        white = np.r_[_least_squares(regression), np.zeros(n)]
        own = Equation(structure, white, np.ones(2)).own
        found = [_least_squares(rows), np.r_[white[:-n], -own], white]
        for parameters in found:
            parameters[-n:] = stable_zeros(parameters[-n:])
        return found

    def fit(self, structure: Structure, start: Array | None = None, weights: Array | None = None, steps: int = STEPS) -> Array:
        """The parameters with the least weighted sum of squared prediction errors, by Gauss-Newton with halved steps."""
        if start is None:
            fits = [self.fit(structure, first, weights, steps) for first in self.starts(structure)]
            return min(fits, key=lambda found: sum(float((e**2).sum()) for e in self.errors(structure, found)))
        parameters, n = start, structure.order
        root = np.ones(1) if weights is None else weights**0.5

        def cost_of(trial: Array) -> float:
            return float(((root * np.concatenate(self.errors(structure, trial))) ** 2).sum())

        best = cost_of(parameters)
        for _ in range(steps):
            errors, slopes = self.linearised(structure, parameters)
            step = _solve(root[:, None] * slopes, root * errors)
            share = 1.0
            while share > 1e-2:
                trial = parameters + share * step
                trial[-n:] = stable_zeros(trial[-n:])
                cost = cost_of(trial)
                if cost < best:
                    break
                share /= 2
            else:
                break
            gained, best, parameters = best - cost, cost, trial
            if gained < 1e-6 * best:
                break
        return parameters

    def linearised(self, structure: Structure, parameters: Array) -> tuple[Array, Array]:
        """All one-step errors, (N,), and their slopes in the parameters with the sign changed, (N, p)."""
        errors, c = self.errors(structure, parameters), np.r_[1.0, parameters[-structure.order :]]
        slopes = [
            lfilter([1.0], c, _with_innovations(past, e, structure.order), axis=0)
            for (_, past), e in zip(self.regression(structure), errors, strict=True)
        ]
        return np.concatenate(errors), np.concatenate(slopes)

    def covariance(self, structure: Structure, parameters: Array) -> Array:
        """Of the parameters that were fitted, (p, p)."""
        errors, slopes = self.linearised(structure, parameters)
        return np.var(errors) * np.linalg.pinv(slopes.T @ slopes)


def _with_innovations(past: Array, e: Array, order: int) -> Array:
    """The regressors and the innovations 1..n samples ago, zero before the record."""
    return np.column_stack([past, *(lagged(e, lag, 0.0) for lag in range(1, order + 1))])


def _least_squares(rows: Sequence[tuple[Array, Array]]) -> Array:
    target, past = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return _solve(past, target)


def _solve(past: Array, target: Array) -> Array:
    """Least squares by the normal equations of scaled columns: for many rows and few columns ten times as fast as numpy's."""
    size = np.sqrt((past**2).sum(0)) + 1e-12
    scaled = past / size
    return np.linalg.solve(scaled.T @ scaled + 1e-12 * np.eye(len(size)), scaled.T @ target) / size


def dead_times(record: Record, order: int, integrating: bool, start: tuple[int, ...], longest: int) -> tuple[int, ...]:
    """The dead times with the least squared errors, input by input until none changes."""

    @cache
    def cost(trial: tuple[int, ...]) -> float:
        structure = Structure(order, trial, integrating)
        fitted = record.fit(structure, record.starts(structure)[0], steps=1)
        return float(sum((e**2).sum() for e in record.errors(structure, fitted)))

    found, before = start, None
    while found != before:
        before = found
        for j in range(len(found)):
            found = min(((*found[:j], dead, *found[j + 1 :]) for dead in range(longest + 1)), key=cost)
    return found


def choose(training: Record, held_out: Record, n_inputs: int, params: PlantIdentificationParams) -> Structure:
    """The simplest structure whose likelihood on held-out records is within one standard error of the greatest.

    Of those the simplest with white residuals, if there is one.
    """
    values: dict[Structure, Array] = {}
    for integrating in (False, True):
        dead: tuple[int, ...] = (0,) * n_inputs
        for order in params.orders:
            dead = dead_times(training, order, integrating, dead, params.longest_dead_time)
            structure = Structure(order, dead, integrating)
            fitted = training.fit(structure)
            if Equation(structure, fitted, np.ones(2)).growth < 1:  # nothing is learned on an unstable model
                variance = float(np.mean(np.concatenate(training.errors(structure, fitted)) ** 2))
                e = np.concatenate(held_out.errors(structure, fitted))
                values[structure] = -(e**2 / variance + np.log(2 * np.pi * variance)) / 2  # the log of a normal density
    if not values:
        raise InputError("no stable model describes the record")
    best = max(values, key=lambda s: float(values[s].mean()))
    lost = {s: values[best] - value for s, value in values.items()}
    good = [s for s, less in lost.items() if less.mean() <= less.std() / len(less) ** 0.5]
    simplest_first = sorted(good, key=lambda s: s.n_own + s.order)
    fine = [s for s in simplest_first if not s.integrating or ramps(training, s)] or [best]
    white = [s for s in fine if whiteness(training.errors(s, training.fit(s)), params) >= params.white]
    return (white or fine)[0]


def whiteness(errors: Sequence[Array], params: PlantIdentificationParams) -> float:
    """The p-value of Ljung and Box for residuals."""
    return float(acorr_ljungbox(np.concatenate(errors), [params.white_lags])["lb_pvalue"].iloc[0])


def ramps(record: Record, structure: Structure) -> bool:
    """Whether some input sets the rate of an integrating output: the sum of its coefficients is no chance."""
    parameters, n = record.fit(structure), structure.order
    covariance = record.covariance(structure, parameters)
    first = [structure.n_own + n * j for j in range(len(structure.dead_times))]
    ratios = [parameters[k : k + n].sum() / covariance[k : k + n, k : k + n].sum() ** 0.5 for k in first]
    return max(np.abs(ratios)) > TOLD


@dataclass(frozen=True)
class Margins:
    """How far a plant may be from its model beyond what the record cannot tell: factors of the gain of each input, (n_u,), and of
    the time constants, and further samples of dead time of each input.
    """

    gain: Array
    time: float
    dead_time: tuple[int, ...]

    @classmethod
    def ends(cls, params: MarginParams, n_inputs: int) -> "list[Margins]":
        """Every corner: all gains, the time constants and all dead times at an end of their margins."""
        gains, times = ([1 - margin, 1 + margin] for margin in (params.gain, params.time))
        found = product(gains, times, sorted({0, params.dead_time}))
        return [cls(np.full(n_inputs, gain), time, (dead_time,) * n_inputs) for gain, time, dead_time in found]

    @classmethod
    def draw(cls, params: MarginParams, n_inputs: int, rng: np.random.Generator) -> "Margins":
        """Within the declared margins and often at their ends, so that the corners count too."""
        more = tuple(int(number) for number in rng.integers(0, params.dead_time + 1, n_inputs))
        gain, time = (np.clip(rng.uniform(-ENDS, ENDS, n), -1, 1) for n in (n_inputs, 1))
        return cls(1 + params.gain * gain, 1 + params.time * float(time[0]), more)


def slowed(coefficients: Array, time: float) -> Array:
    """The polynomial 1 - a_1 q^-1 - .. with every time constant multiplied: its roots to the power of 1/time.

    Roots on the negative axis belong to no time constant and stay.
    """
    roots = np.roots(np.r_[1.0, -coefficients]).astype(complex)
    moved = np.where((np.abs(roots.imag) > 1e-9) | (roots.real > 0), roots ** (1 / time), roots)
    return -np.real(np.atleast_1d(np.poly(moved)))[1:]


def apart(equation: Equation, margins: Margins) -> Equation:
    """The equation of a plant that is as far from the identified one as the margins say."""
    own = slowed(equation.free, margins.time)
    speed = (1 - own.sum()) / (1 - equation.free.sum())
    inputs = equation.inputs * speed * margins.gain[:, None]
    zeros = -slowed(-equation.innovations, margins.time)
    dead = tuple(known + more for known, more in zip(equation.structure.dead_times, margins.dead_time, strict=True))
    parameters = np.r_[own, inputs.ravel(), equation.constant * speed, zeros]
    return Equation(replace(equation.structure, dead_times=dead), parameters, equation.spread)


def assemble(plants: Sequence[Sequence[Equation]], scales: tuple[Array, Array]) -> ArmaxModel:
    """Models side by side, each from the equations of its outputs, in deviation variables."""
    y_scale, u_scale = scales
    n_y, n_u = len(y_scale), len(u_scale)
    lags = max(equation.structure.order for plant in plants for equation in plant)
    taps = max(equation.structure.order + max(equation.structure.dead_times) for plant in plants for equation in plant)
    own, innovations = np.zeros((2, len(plants), n_y, lags, n_y))
    inputs = np.zeros((len(plants), n_y, taps, n_u))
    constant, spread = np.zeros((len(plants), n_y)), np.zeros((len(plants), n_y, 2))
    for m, plant in enumerate(plants):
        for i, equation in enumerate(plant):
            n = equation.structure.order
            own[m, i, :n, i], innovations[m, i, :n, i] = equation.own, equation.innovations
            for j, dead in enumerate(equation.structure.dead_times):
                inputs[m, i, dead : dead + n, j] = equation.inputs[j] * y_scale[i] / u_scale[j]
            constant[m, i] = equation.constant * y_scale[i]
            spread[m, i] = equation.spread * (y_scale[i], 1.0)
    flat = [array.reshape(len(plants), n_y, -1) for array in (own, inputs[:, :, 1:], innovations)]
    window, entry = torch.tensor(np.concatenate(flat, axis=-1)), torch.tensor(inputs[:, :, 0])
    return ArmaxModel(window, entry, torch.tensor(constant), torch.tensor(spread), lags, taps)


@dataclass(frozen=True)
class Identified:
    """A model and how it came about.

    Attributes:
        equations: the fitted equation of each output. nominal: the model of them. members: those of each member of the ensemble.
        scales: of outputs and inputs, in whose units the equations stand.
        warnings: what the data cannot carry, in sentences.
    """

    equations: tuple[Equation, ...]
    nominal: ArmaxModel
    members: tuple[tuple[Equation, ...], ...]
    scales: tuple[Array, Array]
    warnings: tuple[str, ...]

    def ensemble(self, margins: MarginParams, n_models: int, seed: int, at_ends: float = 0.0) -> ArmaxModel:
        """Models drawn from the members, each as far off as the margins allow; a share of them `at_ends`, corner after corner."""
        rng = np.random.default_rng(seed)
        drawn = rng.integers(0, len(self.members), n_models)
        n_u = len(self.scales[1])
        ends, n_ends = Margins.ends(margins, n_u), round(at_ends * n_models)
        off = [ends[k % len(ends)] if k < n_ends else Margins.draw(margins, n_u, rng) for k in range(n_models)]
        chosen = zip((self.members[index] for index in drawn), off, strict=True)
        return assemble([[apart(equation, margin) for equation in member] for member, margin in chosen], self.scales)

    def corners(self, margins: MarginParams) -> ArmaxModel:
        """The model with every gain, every time constant and every dead time at an end of its margin."""
        found = Margins.ends(margins, len(self.scales[1]))
        return assemble([[apart(equation, margin) for equation in self.equations] for margin in found], self.scales)


def spread_of(record: Record, structure: Structure, parameters: Array) -> Array:
    """How the standard deviation of the innovations grows with the deviation, (2,): s^2 = fixed^2 + (gain y)^2.

    Least squares on the squared errors with both parts at least zero, weighted once by what the first pass found.
    """
    errors = np.concatenate(record.errors(structure, parameters))
    level = np.concatenate([y[record.first :] for y, _ in record.pieces]) - errors
    design, square, fitted = np.column_stack([np.ones_like(level), level**2]), errors**2, np.ones_like(level)
    for _ in range(2):
        solution, _ = nnls(design / fitted[:, None], square / fitted)
        fitted = np.maximum(design @ solution, 0.05 * square.mean())
    return np.sqrt(solution)


def identify(
    parts: tuple[Sequence[Stretch], Sequence[Stretch]], scales: tuple[Array, Array], names: tuple[Sequence[str], Sequence[str]],
    params: PlantIdentificationParams, members: int, seed: int,
) -> Identified:  # fmt: skip
    """Structure by records held out, then parameters and ensemble from all of them.

    Args:
        parts: stretches to fit and stretches held out, deviation variables. scales: of outputs (n_y,) and inputs (n_u,).
        names: of outputs and inputs, for the warnings. members: of the ensemble.

    Raises:
        InputError: if no stretch is long enough, or no stable model describes the record.
    """
    n_u, rng = len(scales[1]), np.random.default_rng(seed)
    equations, ensembles, warnings = [], [], []
    told = np.zeros(n_u, dtype=bool)
    for i, name in enumerate(names[0]):
        training, held_out = (Record.of(pieces, i, scales, params) for pieces in parts)
        if not (training.pieces and held_out.pieces):
            raise InputError(f"no stretch of the record is longer than {2 * training.first} samples, so no model can be identified")
        structure = choose(training, held_out, n_u, params)
        whole = Record([*training.pieces, *held_out.pieces], training.first)
        parameters = whole.fit(structure)
        spread = spread_of(whole, structure, parameters)
        equations.append(Equation(structure, parameters, spread))
        told |= effects(whole, structure, parameters)
        blocks = np.concatenate([np.arange(len(y) - whole.first) // BLOCK + 1000 * k for k, (y, _) in enumerate(whole.pieces)])
        _, place = np.unique(blocks, return_inverse=True)
        drawn: list[Equation] = []
        for _ in range(4 * members):
            weights = rng.exponential(size=place.max() + 1)[place]
            if len(drawn) < members:
                found = Equation(structure, whole.fit(structure, parameters, weights, RESTARTS), spread)
                drawn += [found] if found.growth < 1 else []
        if len(drawn) < members:
            raise InputError(f"the record does not tell whether {name} is stable, so nothing can be learned on a model of it")
        ensembles.append(drawn)
        if (value := whiteness(whole.errors(structure, parameters), params)) < params.white:
            warnings.append(
                f"the residuals of {name} are not white (p = {value:.1g}) for any model up to order {max(params.orders)}: there is "
                f"a disturbance or a dynamic that the model does not have"
            )
    untold = [name for name, seen in zip(names[1], told, strict=True) if not seen]
    warnings += [f"the data do not tell an effect of {name} on any output from none" for name in untold]
    members_of = tuple(zip(*ensembles, strict=True))
    return Identified(tuple(equations), assemble([equations], scales), members_of, scales, tuple(warnings))


def effects(record: Record, structure: Structure, parameters: Array) -> NDArray[np.bool_]:
    """Which inputs have an effect on the output that is no chance, (n_u,): some coefficient beyond `TOLD` standard errors."""
    ratio = np.abs(parameters) / np.sqrt(np.diag(record.covariance(structure, parameters)))
    n, n_u = structure.order, len(structure.dead_times)
    return np.asarray((ratio[structure.n_own :][: n * n_u].reshape(n_u, n) > TOLD).any(1))


@dataclass(frozen=True)
class Validation:
    """How a model does on records that it was not identified from.

    Attributes:
        fit: 1 - |y - simulated| / |y - mean| over all windows, of each output. measured, simulated: (windows, T, n_y), deviation
            variables. residuals: one-step errors of each output, in units of their spread. p_value: of the test of Ljung and Box.
    """

    fit: Array
    measured: Array
    simulated: Array
    residuals: tuple[Array, ...]
    p_value: Array
    warnings: tuple[str, ...]


def validate_model(
    identified: Identified, pieces: Sequence[Stretch], horizon: int, names: Sequence[str], params: PlantIdentificationParams
) -> Validation:
    """Simulate windows of `horizon` samples from their inputs alone, and test the one-step residuals on held-out stretches.

    A window begins in the state that the model has found by then; after that only the inputs are used.
    """
    model, y_scale = identified.nominal, identified.scales[0]
    records = [Record.of(pieces, i, identified.scales, params) for i in range(len(y_scale))]
    fitted = zip(records, identified.equations, strict=True)
    errors = [record.errors(equation.structure, equation.parameters) for record, equation in fitted]
    begin, warm = records[0].first, 2 * records[0].first
    measured, states, inputs = [], [], []
    for piece, *scaled in zip([piece for piece in pieces if len(piece) > warm], *errors, strict=True):
        innovations = np.column_stack(scaled) * y_scale
        for start in range(warm, len(piece) - horizon + 1, horizon):
            past, entered = piece.y[start - model.lags : start], piece.u[start - model.taps : start - 1]
            noise = innovations[start - begin - model.lags : start - begin]
            states.append(np.concatenate([part[::-1].ravel() for part in (past, entered, noise)]))
            inputs.append(piece.u[start - 1 : start - 1 + horizon])
            measured.append(piece.y[start : start + horizon])
    if not states:
        raise InputError(f"no held-out stretch is as long as {horizon + warm} samples, so the model cannot be validated")
    x, simulated = torch.tensor(np.array(states)), []
    for u in torch.tensor(np.array(inputs)).unbind(1):
        x = model.step(x, u, torch.zeros_like(x))
        simulated.append(model.observe(x, x))
    found, known = torch.stack(simulated, dim=1).numpy(), np.array(measured)
    fit = 1 - np.sqrt(((known - found) ** 2).mean((0, 1))) / known.std((0, 1))
    p_value = np.array([whiteness(error, params) for error in errors])
    warnings = tuple(
        f"the model leaves {100 * (1 - value):.0f} % of the movement of {name} unexplained: too much to learn from"
        for name, value in zip(names, fit, strict=True)
        if value < params.least_fit
    )
    spread = [np.concatenate(error) for error in errors]
    return Validation(fit, known, found, tuple(e / e.std() for e in spread), p_value, warnings)
