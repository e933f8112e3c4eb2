"""The verbs of notebook 00: fit the settings, compare readings, profile the loss, predict one table from another.

Sampling time and bounds are fitted together with the gains of the demonstrator that stands in two tables. Gains are then fitted
once more at the sampling time and the bounds of the parameter files, which are round numbers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from helpers.features import feature_names
from helpers.identification import Fit, Problem, Profile, polish, profile, refit
from helpers.params import Params
from helpers.randomness import stream
from helpers.readings import GAINS, READINGS, TIME, Key, Reading, Values, Vector, simulate
from helpers.session import IdentificationSession


@dataclass(frozen=True)
class Study:
    """What every fit starts from: the session, and the sampling errors of the published rows at the settings of the files."""

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

    def ends(self, *settings: str) -> dict[Key, float]:
        """The end of the search of each of these settings; that of a lower bound is negative."""
        process, search = self.any_params.process, self.session.identification.search
        ends: dict[Key, float] = {}
        for setting in settings:
            if setting == TIME[0]:
                ends[TIME] = search.sampling_time
            elif setting in GAINS:
                ends |= {(setting, loop): end for loop, end in zip(process.controlled, getattr(search, setting), strict=True)}
            else:
                sign = -1 if setting == "input_low" else 1
                ends |= {(setting, name): sign * end for name, end in zip(process.manipulated, search.input_bound, strict=True)}
        return ends

    def filed(self, demonstrator: str) -> dict[Key, float]:
        """The settings in the parameter files, bounds by side and as one."""
        process, gains = self.any_params.process, next(iter(self.cases(demonstrator).values())).demonstrator.model_dump()
        values = {TIME: process.sampling_time}
        for index, name in enumerate(process.manipulated):
            values |= {("input_low", name): process.input_low[index], ("input_high", name): process.input_high[index]}
            values[("input_bound", name)] = process.input_high[index]
        return values | {(kind, loop): gains[kind][i] for kind in GAINS for i, loop in enumerate(process.controlled)}

    def problem(self, demonstrator: str, *settings: str, reading: Reading = READINGS[0], overdamped: bool | None = None) -> Problem:
        """These settings and the gains of a demonstrator, to be fitted to its tables."""
        cases, options = self.cases(demonstrator), self.session.identification
        held = demonstrator == self.second if overdamped is None else overdamped
        return Problem(
            cases=cases,
            published={case: self.session.published[case].expert for case in cases},
            sampling_error=self.sampling_error,
            free=self.ends(*settings, *GAINS),
            seed=self.session.seed,
            reading=reading,
            overshoot_unit=options.overshoot_unit if held else None,
        )

    def joint(self) -> Problem:
        """Sampling time, bounds and gains of the first demonstrator."""
        return self.problem(self.first, TIME[0], "input_bound")

    def best(self, problem: Problem, fits: Sequence[Fit]) -> Fit:
        """The best of several fits, polished on many draws."""
        return polish(problem, fits[0].z, self.session.scale_params.iterations, self.session.scale_params.draws_final)

    def compared(
        self, case: int, values: Values, n_trajectories: int, purpose: str, reading: Reading = READINGS[0]
    ) -> pd.DataFrame:
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


def study(session: IdentificationSession) -> Study:
    """The sampling errors of the published rows: those of the demonstrators in the parameter files."""
    errors = {}
    for case, params in session.params.items():
        draws = stream(session.seed, case, "sampling error")
        simulated = simulate(params, {}, READINGS[0], session.scale_params.draws_final, draws)
        errors[case] = simulated.sampling_error(session.identification.sample)
    return Study(session, errors)


def rows_table(study: Study) -> pd.DataFrame:
    """What is fitted: the published expert rows, each with its sampling error; a column for each feature."""
    rows = {}
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


def compare_readings(study: Study, joint: Fit, second: Fit) -> pd.DataFrame:
    """The loss and the mean relative error of every reading, each at its own best settings.

    The first demonstrator is fitted with sampling time and bounds, the second at those. Tables are named by their numbers.
    """
    session, scale, manipulated = study.session, study.session.scale_params, study.any_params.process.manipulated
    rows = []
    for reading in READINGS:
        bounds = ("input_bound",) if reading.symmetric_bounds else ("input_low", "input_high")
        sides = {
            (side, name): sign * joint.settings[("input_bound", name)]
            for side, sign in (("input_low", -1), ("input_high", 1))
            for name in manipulated
        }
        problem = study.problem(study.first, TIME[0], *bounds, reading=reading)
        found = refit(problem, {**sides, **joint.settings}, scale)
        shared = {key: value for key, value in found.settings.items() if key[0] not in GAINS}
        other = replace(study.problem(study.second, reading=reading), fixed=shared)
        row: dict[str, object] = {"reading": reading.name}
        for target, best in ((problem, found), (other, refit(other, second.settings, scale))):
            tables = [study.compared(case, best.settings, scale.draws, "readings", reading) for case in target.cases]
            row |= {f"loss_{'_'.join(str(session.published[case].table) for case in target.cases)}": best.loss}
            row |= {f"error_{table['table'].iloc[0]}": table["relative_error"].abs().mean() for table in tables}
        row["sampling_time"] = shared[TIME]
        for name in manipulated:
            bound = shared.get(("input_bound", name), float("nan"))
            row |= {f"low {name}": shared.get(("input_low", name), -bound), f"high {name}": shared.get(("input_high", name), bound)}
        rows.append(row)
    return pd.DataFrame(rows)


def dispersion(study: Study, joint: Fit, second: Fit) -> float:
    """The loss per degree of freedom of the best fits: one if only the sampling error of the rows kept the loss from zero."""
    rows = sum(len(study.sampling_error[case]) for case in study.session.params)
    settings = len(study.joint().free) + len(study.problem(study.second).free)
    return max(1.0, (joint.loss + second.loss) / max(1, rows - settings))


def profiles(study: Study, joint: Fit, gains: Mapping[str, Fit], rise: float) -> dict[str, Profile]:
    """The profiles of all settings, by name: sampling time and bounds, each side of the bounds, and the gains.

    Sampling time and bounds: all else is fitted again to the first demonstrator's tables. A side of a bound: the gains of both are
    fitted again to all tables, with sampling time and other bounds as in the parameter files. A gain: the same demonstrator's
    other gains are fitted again, with sampling time and bounds as in the files.
    """
    scale = study.session.scale_params
    found: dict[str, Profile] = {}

    def add(name: str, problems: list[Problem], fits: list[Fit], key: Key, end: float) -> None:
        polished = [
            polish(problem, problem.position(best.settings), scale.iterations, scale.draws)
            for problem, best in zip(problems, fits, strict=True)
        ]
        found[name] = profile(problems, polished, key, end, rise, scale)

    problem = study.joint()
    for key, end in study.ends(TIME[0], "input_bound").items():
        add(" ".join(key), [problem], [joint], key, end)
    at_files = {name: study.problem(name) for name in gains}
    for key, end in study.ends("input_low", "input_high").items():
        value = {key: study.filed(study.first)[key]}
        add(" ".join(key), [problem.holding(value) for problem in at_files.values()], list(gains.values()), key, end)
    for name, problem in at_files.items():
        for key, end in study.ends(*GAINS).items():
            add(f"{name}.{key[0]} {key[1]}", [problem], [gains[name]], key, end)
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


def predictions(study: Study, gains: Mapping[str, Fit]) -> pd.DataFrame:
    """Every table on fresh trajectories: from the fits to all tables, from the files, and from the fit to one table alone.

    Columns: fitted_on, then those of `Study.compared`. Sampling time and bounds are those of the files throughout.
    """
    session, scale = study.session, study.session.scale_params
    sources: list[tuple[str, Sequence[int], Values]] = []
    for name, best in gains.items():
        cases = list(study.cases(name))
        tables = " and ".join(str(session.published[case].table) for case in cases)
        sources += [(f"Table {tables}", cases, best.settings), ("parameter files", cases, {})]
        if len(cases) > 1:
            problem = study.problem(name)
            for case in cases:
                alone = replace(problem, cases={case: session.params[case]})
                sources.append((f"Table {session.published[case].table}", cases, refit(alone, best.settings, scale).settings))
    frames = [
        study.compared(case, values, scale.fresh, "fresh").assign(fitted_on=name)
        for name, cases, values in sources
        for case in cases
    ]
    return pd.concat(frames, ignore_index=True)[["fitted_on", *frames[0].columns[:-1]]]


def settings_table(study: Study, joint: Fit, gains: Mapping[str, Fit], found: Mapping[str, Profile], rise: float) -> pd.DataFrame:
    """What was found. Columns: setting, component, value, low, high, identified, in_parameter_files.

    From low to high the loss lies no more than `rise` above its least.
    """
    rows = []
    named = {
        f"{key[0]} {key[1]}": (key, joint.settings[key], study.filed(study.first)[key])
        for key in study.ends(TIME[0], "input_bound")
    }
    for key in study.ends("input_low", "input_high"):
        name = " ".join(key)
        one, filed = found[name], study.filed(study.first)[key]
        named[name] = (key, float(one.grid[one.losses.argmin()]), filed)
    for demonstrator, best in gains.items():
        filed_gains = study.filed(demonstrator)
        for key in study.ends(*GAINS):
            named[f"{demonstrator}.{key[0]} {key[1]}"] = (key, best.settings[key], filed_gains[key])
    share = study.session.identification.identified
    for name, (key, value, filed) in named.items():
        low, high = found[name].interval(rise)
        identified = max(abs(value - low), abs(high - value)) <= share * abs(value)
        rows.append(
            {
                "setting": name.removesuffix(f" {key[1]}"),
                "component": key[1],
                "value": value,
                "low": low,
                "high": high,
                "identified": "yes" if identified else "no",
                "in_parameter_files": filed,
            }
        )
    return pd.DataFrame(rows)
