"""The verbs of notebook 00: fit the settings, compare readings, profile the loss, predict one table from another.

Sampling time and bounds are fitted together with the gains of the demonstrator that stands in two tables. Gains are then fitted
once more at the sampling time and the bounds of the parameter files, which are round numbers.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from helpers.evidence.identification import Fit, Problem, Profile, fit, polish, profile, refit
from helpers.evidence.readings import GAINS, MAIN, READINGS, TIME, Key, Reading, Values, Vector, simulate
from helpers.learning.features import feature_names
from helpers.plant.rollout import stream
from helpers.runs.finished import State
from helpers.runs.opening import IdentificationSession
from helpers.settings.paper import Params

FINAL_TOLERANCE = 1.0e-7
READING_TOLERANCE = 1.0e-3
TWO_SIDED = ("T_E",)  # inputs whose bounds are fitted side by side; PID1 never meets the upper bound of the other


@dataclass(frozen=True)
class Fitting:
    """What every fit starts from: the session, and the sampling errors of the published rows at the settings of the files.

    The search takes half an hour, so every fit and profile that is finished is kept: an interrupted run goes on behind the last.
    """

    session: IdentificationSession
    sampling_error: Mapping[int, Vector]

    @property
    def first(self) -> str:
        """The demonstrator whose tables settle sampling time and bounds."""
        return self.session.identification.settled_by

    @property
    def second(self) -> str:
        """The demonstrator whose response is overdamped."""
        return self.session.identification.overdamped

    @property
    def any_params(self) -> Params:
        """The parameters of some case, for what all cases share."""
        return next(iter(self.session.params.values()))

    @property
    def feature_names(self) -> list[str]:
        """Names of the features in their order."""
        return feature_names(self.any_params.process.controlled)

    def cases(self, demonstrator: str) -> dict[int, Params]:
        """The cases of a demonstrator."""
        return {case: params for case, params in self.session.params.items() if params.case.demonstrator == demonstrator}

    def gain_ends(self) -> dict[Key, float]:
        """The end of the search of each gain."""
        loops, search = self.any_params.process.controlled, self.session.identification.search
        return {(kind, loop): end for kind in GAINS for loop, end in zip(loops, getattr(search, kind), strict=True)}

    def shared_ends(self, reading: Reading = MAIN) -> dict[Key, float]:
        """The end of the search of what all demonstrators share: sampling time and bounds; that of a lower bound is negative."""
        options = self.session.identification
        ends: dict[Key, float] = {TIME: options.search.sampling_time}
        for name, end in zip(self.any_params.process.manipulated, options.search.input_bound, strict=True):
            if name in TWO_SIDED and not reading.symmetric_bounds:
                ends |= {("input_low", name): -end, ("input_high", name): end}
            else:
                ends[("input_bound", name)] = end
        return ends

    def filed(self, demonstrator: str) -> dict[Key, float]:
        """The settings in the parameter files."""
        process, gains = self.any_params.process, next(iter(self.cases(demonstrator).values())).demonstrator.model_dump()
        values = {TIME: process.sampling_time}
        for name, low, high in zip(process.manipulated, process.input_low, process.input_high, strict=True):
            values |= {("input_low", name): low, ("input_high", name): high, ("input_bound", name): high}
        return values | {(kind, loop): gains[kind][i] for kind in GAINS for i, loop in enumerate(process.controlled)}

    def problem(self, demonstrator: str, shared: bool = False, reading: Reading = MAIN, overdamped: bool | None = None) -> Problem:
        """The gains of a demonstrator, and what all share if asked for, to be fitted to its tables."""
        cases, options = self.cases(demonstrator), self.session.identification
        held = demonstrator == self.second if overdamped is None else overdamped
        return Problem(
            cases=cases,
            published={case: self.session.published[case].expert for case in cases},
            sampling_error=self.sampling_error,
            free={**(self.shared_ends(reading) if shared else {}), **self.gain_ends()},
            seed=self.session.seed,
            reading=reading,
            overshoot_unit=options.overshoot_unit if held else None,
        )

    def joint(self) -> Problem:
        """Sampling time, bounds and gains of the first demonstrator."""
        return self.problem(self.first, shared=True)

    def fit(self, problem: Problem) -> list[Fit]:
        """The fits from random starts, best first."""
        scale = self.session.scale_params
        fits = [self._fitted(problem, partial(fit, problem, scale, start), start) for start in range(scale.starts)]
        return sorted(fits, key=lambda found: found.loss)

    def refit(self, problem: Problem, values: Values) -> Fit:
        """The fit in reach of given settings."""
        return self._fitted(problem, partial(refit, problem, values, self.session.scale_params), tuple(values.items()))

    def polish(self, problem: Problem, values: Values) -> Fit:
        """The fit in the valley of given settings, to a thousandth of its loss."""
        scale = self.session.scale_params
        polished = partial(polish, problem, problem.position(values), scale.iterations, scale.draws, READING_TOLERANCE)
        return self._fitted(problem, polished, "polish", tuple(values.items()))

    def profile(self, problem: Problem, best: Fit, key: Key, rise: float) -> Profile:
        """The profile of one setting about the fit of a problem."""

        def compute() -> State:
            found = profile(problem, best, key, rise, self.session.scale_params)
            return {"grid": found.grid.tolist(), "losses": found.losses.tolist()}

        kept = self.session.finished.once(compute, _what(problem), key, rise)
        return Profile(np.array(kept["grid"]), np.array(kept["losses"]))

    def _fitted(self, problem: Problem, compute: Callable[[], Fit], *start: Any) -> Fit:
        kept = self.session.finished.once(
            lambda: {"z": (found := compute()).z.tolist(), "loss": found.loss}, _what(problem), *start
        )
        return Fit(problem.settings(z := np.array(kept["z"])), z, kept["loss"])

    def best(self, problem: Problem, fits: Sequence[Fit]) -> Fit:
        """The best of several fits, polished on many draws to a finer tolerance."""
        scale = self.session.scale_params
        return polish(problem, fits[0].z, scale.iterations, scale.draws_final, FINAL_TOLERANCE)

    def compared(self, case: int, values: Values, n_trajectories: int, purpose: str, reading: Reading = MAIN) -> pd.DataFrame:
        """The features of a case's demonstrator beside its published row.

        Columns: table, feature, published, simulated, deviation (in sampling errors), relative_error.
        """
        session = self.session
        draws = stream(session.seed, case, purpose)
        simulated = simulate(session.params[case], values, reading, n_trajectories, draws).mean
        published = np.array(session.published[case].expert)
        return pd.DataFrame(
            {
                "table": session.published[case].table,
                "feature": self.feature_names,
                "published": published,
                "simulated": simulated,
                "deviation": (simulated - published) / self.sampling_error[case],
                "relative_error": simulated / published - 1,
            }
        )


def _what(problem: Problem) -> tuple[Any, ...]:
    """What tells one problem of a run from another."""
    return tuple(problem.cases), problem.free, problem.fixed, problem.reading, problem.overshoot_unit


def study(session: IdentificationSession) -> Fitting:
    """What every fit starts from."""
    return Fitting(session, sampling_errors(session, MAIN))


def sampling_errors(session: IdentificationSession, reading: Reading) -> dict[int, Vector]:
    """The sampling errors of the published rows: those of the demonstrators in the parameter files, under a reading."""
    errors = {}
    for case, params in session.params.items():
        draws = stream(session.seed, case, "sampling error")
        simulated = simulate(params, {}, reading, session.scale_params.draws_final, draws)
        errors[case] = simulated.sampling_error(session.identification.sample)
    return errors


def rows_table(study: Fitting) -> pd.DataFrame:
    """What is fitted: the published expert rows, each with its sampling error; a column for each feature."""
    rows: dict[tuple[str, str], Sequence[float] | Vector] = {}
    for case, row in study.session.published.items():
        rows[(f"Table {row.table}", "published")] = row.expert
        rows[(f"Table {row.table}", "sampling error")] = study.sampling_error[case]
    return pd.DataFrame(rows, index=study.feature_names).T


def fits_table(fits: Mapping[str, Sequence[Fit]]) -> pd.DataFrame:
    """Every start of every fit, best first: fit, loss, then a column for each setting and variable."""
    rows = [
        {"fit": name, "loss": found.loss, **{" ".join(key): value for key, value in found.settings.items()}}
        for name, several in fits.items()
        for found in several
    ]
    return pd.DataFrame(rows)


def compare_readings(study: Fitting, joint: Fit, second: Fit) -> pd.DataFrame:
    """Every reading at its own best settings. Columns: reading; loss and mean relative error by table; then the settings.

    The first demonstrator is fitted with sampling time and bounds, the second at those, both by least squares from the best fit of
    the first reading, and judged on fresh trajectories. A reading may change the sampling errors s of the rows: its loss then
    counts 2 log(s / s of the first reading) for every row, as a normal likelihood does.
    """
    session, scale, manipulated = study.session, study.session.scale_params, study.any_params.process.manipulated
    start = {**study.filed(study.first), **joint.settings}
    rows = []
    for reading in READINGS[: scale.readings]:
        errors = sampling_errors(session, reading)
        problem = replace(study.problem(study.first, shared=True, reading=reading), sampling_error=errors)
        found = study.polish(problem, start)
        shared = {key: value for key, value in found.settings.items() if key[0] not in GAINS}
        other = replace(study.problem(study.second, reading=reading), fixed=shared, sampling_error=errors)
        row: dict[str, object] = {"reading": reading.name}
        for target, best in ((problem, found), (other, study.polish(other, second.settings))):
            tables = [
                study.compared(case, best.settings, scale.fresh, "readings", reading).assign(error=errors[case])
                for case in target.cases
            ]
            loss = sum((((t["simulated"] - t["published"]) / t["error"]) ** 2).sum() for t in tables)
            wider = sum(2 * np.log(errors[case] / study.sampling_error[case]).sum() for case in target.cases)
            row["loss_" + "_".join(str(session.published[case].table) for case in target.cases)] = loss + wider
            row |= {f"error_{table['table'].iloc[0]}": table["relative_error"].abs().mean() for table in tables}
        row["sampling_time"] = shared[TIME]
        for name in manipulated:
            bound = shared.get(("input_bound", name), np.nan)
            row |= {f"low {name}": shared.get(("input_low", name), -bound), f"high {name}": shared.get(("input_high", name), bound)}
        rows.append(row | {f"{study.first} {kind} {loop}": found.settings[kind, loop] for kind, loop in study.gain_ends()})
    return pd.DataFrame(rows)


def chance(study: Fitting, joint: Fit) -> float:
    """The loss that chance exceeds once in twenty, were a reading the authors' own: chi-square, the rows less the settings."""
    rows = sum(len(study.sampling_error[case]) for case in study.cases(study.first))
    return float(chi2.ppf(0.95, rows - len(joint.settings)))


def dispersion(study: Fitting, joint: Fit, second: Fit) -> float:
    """The least loss a row: about one, or less, if only the sampling error of the rows kept the loss from zero."""
    rows = sum(len(study.sampling_error[case]) for case in study.session.params)
    return max(1.0, (joint.loss + second.loss) / rows)


def profiles(study: Fitting, joint: Fit, gains: Mapping[str, Fit], rise: float) -> dict[str, Profile]:
    """The profiles of all settings, by name.

    Sampling time and bounds: all else is fitted again to the first demonstrator's tables. A gain: the same demonstrator's other
    gains are fitted again, with sampling time and bounds as in the parameter files.
    """
    scale = study.session.scale_params
    plans = [("", study.joint(), joint, list(study.shared_ends()))]
    plans += [(f"{name}.", study.problem(name), best, list(study.gain_ends())) for name, best in gains.items()]
    found: dict[str, Profile] = {}
    for prefix, problem, best, keys in plans:
        polished = polish(problem, problem.position(best.settings), scale.iterations, scale.draws)
        found |= {f"{prefix}{key[0]} {key[1]}": study.profile(problem, polished, key, rise) for key in keys}
    return found


def profiles_table(found: Mapping[str, Profile]) -> pd.DataFrame:
    """All profiles in one table. Columns: setting, value, loss, rise (of the loss above its least)."""
    return pd.concat(
        [
            pd.DataFrame({"setting": name, "value": one.grid, "loss": one.losses, "rise": one.losses - one.losses.min()})
            for name, one in found.items()
        ],
        ignore_index=True,
    )


def predictions(study: Fitting, gains: Mapping[str, Fit]) -> pd.DataFrame:
    """Every table on fresh trajectories: from the fits to all tables, from the files, and from the fit to one table alone.

    Columns: fitted_on, then those of `Fitting.compared`. Sampling time and bounds are those of the files throughout.
    """
    session, scale = study.session, study.session.scale_params
    sources: list[tuple[str, Sequence[int], Values]] = []
    for name, best in gains.items():
        cases = list(study.cases(name))
        tables = " and ".join(str(session.published[case].table) for case in cases)
        sources += [(f"Table{'s' * (len(cases) > 1)} {tables}", cases, best.settings), ("parameter files", cases, {})]
        if len(cases) > 1:
            problem = study.problem(name)
            for case in cases:
                alone = replace(problem, cases={case: session.params[case]})
                sources.append((f"Table {session.published[case].table}", cases, study.refit(alone, best.settings).settings))
    frames = [
        study.compared(case, values, scale.fresh, "fresh").assign(fitted_on=name)
        for name, cases, values in sources
        for case in cases
    ]
    return pd.concat(frames, ignore_index=True)[["fitted_on", *frames[0].columns[:-1]]]


def settings_table(study: Fitting, joint: Fit, gains: Mapping[str, Fit], found: Mapping[str, Profile], rise: float) -> pd.DataFrame:
    """What was found. Columns: setting, component, value, low, high, identified, in_parameter_files.

    From low to high the loss lies no more than `rise` above its least. Identified: neither end lies further from the value than a
    share of it.
    """
    share, rows = study.session.identification.identified, []
    sources = [("", joint, study.first, study.shared_ends())]
    sources += [(f"{name}.", best, name, study.gain_ends()) for name, best in gains.items()]
    for prefix, best, demonstrator, keys in sources:
        filed = study.filed(demonstrator)
        for key in keys:
            value = best.settings[key]
            ends = found[f"{prefix}{key[0]} {key[1]}"].interval(rise)
            low, high = min(*ends, value), max(*ends, value)  # the profile has fewer draws than the value
            identified = max(abs(value - low), abs(high - value)) <= share * abs(value)
            rows.append([prefix + key[0], key[1], value, low, high, "yes" if identified else "no", filed[key]])
    columns = ["setting", "component", "value", "low", "high", "identified", "in_parameter_files"]
    return pd.DataFrame(rows, columns=columns)
