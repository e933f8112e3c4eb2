"""The settings that the paper leaves out, inferred from the expert rows of its Tables 2-4.

The process under PID control is simulated with candidate settings, always on the same random draws, so that the features are an
almost smooth function of the settings. The loss is the sum over the published rows of their squared deviations, each in units of
the sampling error of the 500 trajectories behind the row. A search by CMA-ES (Hansen, The CMA evolution strategy: a tutorial,
arXiv:1604.00772, 2016) finds the valley, least squares its floor.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cma
import numpy as np
from scipy.optimize import least_squares

from helpers.evidence.readings import MAIN, Key, Reading, Values, Vector, simulate
from helpers.plant.rollout import stream
from helpers.settings.evidence import IdentificationScaleParams
from helpers.settings.paper import Params

SHARED = ("sampling_time", "input_bound", "input_low", "input_high")  # of all controllers; none can be zero
LEAST = 0.1  # lower end of the search for what cannot be zero, in the units of the search
WORST = 1.0e4  # sampling errors; an unstable loop has no finite features
SPREAD = 0.1  # first standard deviation of CMA-ES, in the units of the search
STARTS = (0.1, 0.8)  # where random points lie, in the units of the search
SCREENED = 1 / 6  # share of the evaluations that a start spends on random points, to begin at the best of them
POPULATION = 16  # of CMA-ES, twice its default for six settings: fewer starts end in a side valley
DIFFERENCE = 3.0e-3  # relative step of the slopes of the least squares; smaller ones meet the kinks of single trajectories
FIRST_STEP, GROWTH = 0.015, 1.9  # steps of a profile, in the units of the search


@dataclass(frozen=True)
class Fit:
    """Settings found, where they lie in the units of the search, and their loss."""

    settings: Values
    z: Vector
    loss: float


@dataclass(frozen=True)
class Problem:
    """Settings of one demonstrator to be fitted to its published rows.

    The search runs over z in [0, 1] for each free setting: value = end z^2, for gains and bounds act over orders of magnitude.

    Attributes:
        cases: the parameters of the cases fitted, all with the same demonstrator.
        published: the expert row of each case; `sampling_error`: that of its entries, shape (d,).
        free: the settings to find, with the end of their search; `fixed`: settings other than those of the files.
        overshoot_unit: overshoot of the mean response that costs one unit of loss; None where it may overshoot.
    """

    cases: Mapping[int, Params]
    published: Mapping[int, Sequence[float]]
    sampling_error: Mapping[int, Vector]
    free: Values
    seed: int
    fixed: Values = field(default_factory=dict)
    reading: Reading = MAIN
    overshoot_unit: float | None = None

    @property
    def lower(self) -> Vector:
        """The lower end of the search: gains may be zero, sampling time and bounds may not."""
        return np.array([LEAST if setting in SHARED else 0.0 for setting, _ in self.free])

    def settings(self, z: Vector) -> dict[Key, float]:
        """The settings at a point of the search."""
        return {**self.fixed, **{key: end * float(w) ** 2 for (key, end), w in zip(self.free.items(), z, strict=True)}}

    def position(self, values: Values) -> Vector:
        """The point of the search at these settings, inside its ends."""
        z = np.sqrt([values[key] / end for key, end in self.free.items()])
        return np.clip(z, self.lower, 1.0)

    def residuals(self, z: Vector, n_trajectories: int) -> Vector:
        """Deviations from the published rows in sampling errors; the overshoots come last where they cost."""
        parts = []
        for case, params in self.cases.items():
            draws = stream(self.seed, case, "inferred_settings")  # the same at every call: common random numbers
            simulated = simulate(params, self.settings(z), self.reading, n_trajectories, draws)
            parts.append((simulated.mean - np.asarray(self.published[case])) / self.sampling_error[case])
            if self.overshoot_unit is not None:
                parts.append(simulated.overshoot.numpy() / self.overshoot_unit)
        return np.nan_to_num(np.concatenate(parts), nan=WORST).clip(-WORST, WORST)

    def loss(self, z: Vector, n_trajectories: int) -> float:
        """The sum of the squared residuals."""
        return float((self.residuals(z, n_trajectories) ** 2).sum())

    def holding(self, values: Values) -> "Problem":
        """The same with some settings held at given values."""
        free = {key: end for key, end in self.free.items() if key not in values}
        return replace(self, free=free, fixed={**self.fixed, **values})


def search(problem: Problem, start: Vector, evaluations: int, n_trajectories: int, generator: np.random.Generator) -> Vector:
    """The best point that CMA-ES finds from a start."""
    options = {
        "bounds": [problem.lower.tolist(), 1.0],
        "maxfevals": evaluations,
        "popsize": POPULATION,
        "seed": np.nan,  # numpy's global generator is neither seeded nor used
        "randn": lambda *shape: generator.standard_normal(shape),
        "verbose": -9,
    }
    strategy = cma.CMAEvolutionStrategy(start, SPREAD, options)
    while not strategy.stop():
        points = strategy.ask()
        strategy.tell(points, [problem.loss(point, n_trajectories) for point in points])
    return np.asarray(strategy.result.xbest)


def polish(problem: Problem, start: Vector, iterations: int, n_trajectories: int, tolerance: float = 1e-5) -> Fit:
    """The settings at the floor of the valley of a start, by least squares; `tolerance`: relative, of the loss."""
    if not problem.free:
        return Fit(problem.settings(start), start, problem.loss(start, n_trajectories))
    found = least_squares(
        problem.residuals,
        start,
        bounds=(problem.lower, 1.0),
        diff_step=DIFFERENCE,
        ftol=tolerance,
        xtol=tolerance,
        max_nfev=iterations,
        args=(n_trajectories,),
    )
    return Fit(problem.settings(found.x), found.x, float(2 * found.cost))


def fit(problem: Problem, scale: IdentificationScaleParams, start: int) -> Fit:
    """The fit from one random start, which is the best of many random points; `start` numbers it."""
    generator = np.random.default_rng([problem.seed, start])
    n_points = round(SCREENED * scale.evaluations)
    points = generator.uniform(*STARTS, (n_points, len(problem.free)))
    begin = min(points, key=lambda z: problem.loss(z, scale.draws_search))
    found = search(problem, begin, scale.evaluations - n_points, scale.draws_search, generator)
    return polish(problem, found, scale.iterations, scale.draws)


def refit(problem: Problem, values: Values, scale: IdentificationScaleParams) -> Fit:
    """The fit in reach of given settings: in their own valley, or in a better one that a short search from them finds."""
    begin = problem.position(values)
    found = search(problem, begin, scale.evaluations_reading, scale.draws_search, np.random.default_rng(problem.seed))
    start = min((begin, found), key=lambda z: problem.loss(z, scale.draws))
    return polish(problem, start, scale.iterations, scale.draws)


@dataclass(frozen=True)
class Profile:
    """Least loss over all other settings as a function of one, its points in ascending order."""

    grid: Vector
    losses: Vector

    def interval(self, rise: float) -> tuple[float, float]:
        """Where the loss lies no more than `rise` above its least; the last point where it never rises that far.

        Between two points the root of the rise is taken as linear, which is exact for a parabola.
        """
        root = np.sqrt(np.clip(self.losses - self.losses.min(), 0, None))
        centre = int(np.argmin(self.losses))
        return self._edge(root, rise**0.5, range(centre, -1, -1)), self._edge(root, rise**0.5, range(centre, len(root)))

    def _edge(self, root: Vector, level: float, order: Sequence[int]) -> float:
        for inner, outer in pairwise(order):
            if root[outer] > level:
                share = (level - root[inner]) / (root[outer] - root[inner])
                return float(self.grid[inner] + share * (self.grid[outer] - self.grid[inner]))
        return float(self.grid[order[-1]])


def steps(begin: float, lower: float, n_steps: int, sign: int) -> Iterator[float]:
    """Points of a profile to one side, in growing steps, at most to the end of the search."""
    z = begin
    for index in range(n_steps):
        z = float(np.clip(z + sign * FIRST_STEP * GROWTH**index, lower, 1.0))
        if z == begin:
            return
        yield z
        if z in (lower, 1.0):
            return


def profile(problem: Problem, best: Fit, key: Key, rise: float, scale: IdentificationScaleParams) -> Profile:
    """The profile of one setting: the others are fitted again at each of its values, from where they were at the last one.

    Args:
        best: the fit of the problem on `scale.draws` trajectories.
        rise: the walk to a side ends where the loss has risen by more.
    """
    index, end = list(problem.free).index(key), problem.free[key]
    points = {best.settings[key]: best.loss}
    for sign in (-1, 1):
        last = best
        for z in steps(float(best.z[index]), float(problem.lower[index]), scale.profile_steps, sign):
            held = problem.holding({key: end * z**2})
            last = polish(held, held.position(last.settings), scale.iterations, scale.draws)
            points[end * z**2] = last.loss
            if last.loss > best.loss + rise:
                break
    ordered = sorted(points)
    return Profile(np.array(ordered), np.array([points[value] for value in ordered]))
