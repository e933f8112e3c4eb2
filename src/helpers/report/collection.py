"""What the stages of all cases and seeds wrote, read and checked, for the report."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from helpers.learning.features import feature_names
from helpers.report import claims, scorecard, search_report
from helpers.runs.artifacts import RECORD, Stage, load_stage
from helpers.runs.freshness import refuse, stale
from helpers.runs.identity import inputs
from helpers.settings.paper import HEADLINE, Params, PublishedCase, load, load_published

ONLINE, BUDGET, EXPERIMENTS = f"online_{HEADLINE}", "online_budget", "experiments"
OFFLINE = {"offline": HEADLINE, "offline_printed": "printed"}  # stage in seeds.csv and the variant behind it
SCORES = ("stage", "metric", "value")  # columns of scores.csv
INFERRED = "inferred_settings"  # which has no case, and stands with the first seed
LIMITS = ("attainable", "budget", "quality", "robustness", "safety")  # the parts of notebook 06, the last one written last
ONE_POLICY, OWN_PLANT = "one_policy", "own_process"  # of notebooks 09 and 07, which are for no case and stand with the first
MADE_BY = {"demonstrations": "01", "offline": "02", "online": "03 (04 for the transfer case)", "transfer": "04"}


@dataclass(frozen=True)
class Results:
    """What the stages of all cases and seeds wrote; a table is empty where it was not run.

    The stages in `seeds`: expert; minimum_variance; offline, online and online_y of the headline variant (offline of a transfer
    case is after the transfer); offline_printed; offline_scratch (the transfer case learned from nothing).
    """

    scale: str
    params: dict[int, Params]  # by case
    published: dict[int, PublishedCase]  # by case
    stages: dict[tuple[int, int, str], Stage]  # by case, seed and folder name
    seeds: pd.DataFrame  # columns case, seed, stage, metric, value; with the ratios of `scorecard.relative`
    claims: pd.DataFrame  # columns `claims.COLUMNS`
    claim_values: pd.DataFrame  # the numbers behind the claims, of `claims.collect`
    budget: pd.DataFrame  # columns seed, case, episodes_per_epoch, objective
    trials: pd.DataFrame  # columns trial, family, description, case, seed, gap
    inferred: Stage | None  # what notebook 00 wrote, if it was run
    limits: Mapping[tuple[int, int, str], Stage]  # by case, seed and part of notebook 06, where it was run to its end
    one_policy: pd.DataFrame  # summary.csv of notebook 09 with a column seed
    own_plant: pd.DataFrame  # scores.csv of notebook 07 with a column seed
    search: Stage | None  # what `make search` wrote, if it was run
    beyond: tuple[Stage, ...]  # every stage beyond the paper's own runs
    made_from: Mapping[str, str]  # `identity.inputs` of the report itself
    missing: tuple[int, ...]  # of the seeds asked for, those of which a stage is missing, where that is allowed
    left_out: tuple[str, ...]  # notebooks with a result among those beyond that was made from other inputs than there are now

    @cached_property
    def n_seeds(self) -> int:
        """How many seeds were run."""
        return len({seed for _, seed, _ in self.stages})

    @cached_property
    def medians(self) -> pd.DataFrame:
        """Every number over its seeds, `scorecard.summary`."""
        return scorecard.summary(self.seeds)

    @cached_property
    def numbers(self) -> pd.DataFrame:
        """The medians by case, stage and metric."""
        return self.medians.set_index(scorecard.KEYS)

    def median(self, case: int, stage: str, metric: str) -> float:
        """The median of one number over the seeds; nan where no seed gave it."""
        return float(self.numbers["median"].get((case, stage, metric), float("nan")))

    def table(self, case: int, folder: str, name: str) -> pd.DataFrame:
        """One table of one stage, that of every seed below the other, with a column `seed`."""
        return stacked({place[:2]: stage for place, stage in self.stages.items() if (place[0], place[2]) == (case, folder)}, name)


def offline_folder(params: Params, variant: str = HEADLINE) -> str:
    """The folder of a case's offline learning."""
    return f"offline_{variant}" if params.case.offline.transfer_from is None else f"transfer_{variant}"


def stacked(stages: Mapping[tuple[int, int], Stage], name: str, columns: tuple[str, ...] = ()) -> pd.DataFrame:
    """A table of several stages, each with these columns, and with seed and case (its own before the stage's); empty for none."""
    tables = {place: stage.table(name, columns) for place, stage in stages.items()}
    frames = [table.assign(case=table.get("case", case), seed=seed) for (case, seed), table in tables.items()]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def collect(
    root: Path, params_root: Path, scale: str, cases: tuple[int, ...], n_seeds: int, missing_allowed: bool = False
) -> Results:
    """Read every stage of every case and seed below `root`; claims, budget, trials and limits where they were run and still hold.

    Where it is allowed, a seed of which a stage is missing is left out, as long as another seed is whole.

    Raises:
        ArtifactError: if a stage is missing or damaged, or one of the paper's own runs was made from other parameters, code,
            package versions or earlier results than there are now.
    """
    params = {case: load(params_root, case) for case in cases}
    published = {case: entry for case, entry in load_published(params_root).items() if case in cases}
    names = {case: _folders(record) for case, record in params.items()}

    def place(case: int, seed: int, folder: str) -> Path:
        return root / scale / f"seed_{seed}" / f"case_{case}" / folder

    seeds_found = list(range(n_seeds))
    if missing_allowed:
        asked = [(case, folder) for case in cases for folder in names[case]]
        whole = [seed for seed in seeds_found if all((place(case, seed, folder) / RECORD).is_file() for case, folder in asked)]
        seeds_found = whole or seeds_found  # without any, the first file that is missing is named below
    stages: dict[tuple[int, int, str], Stage] = {}
    frames = []
    for case, seed in itertools.product(cases, seeds_found):
        for folder, stage_names in names[case].items():
            made_by = f"notebook {MADE_BY[folder.split('_')[0]]} for case {case} and seed {seed}"
            stage = stages[case, seed, folder] = load_stage(place(case, seed, folder), made_by)
            scores = stage.table("scores.csv", SCORES)
            scores = scores.assign(case=case, seed=seed, stage=scores["stage"].map(stage_names))
            frames.append(scores.dropna(subset="stage")[["case", "seed", *SCORES]])
    seeds = pd.concat(frames, ignore_index=True)
    features = feature_names(next(iter(params.values())).process.controlled)
    seeds = pd.concat([seeds, scorecard.relative(seeds, published, features)], ignore_index=True)

    def optional(folder: str, made_by: str, of_cases: tuple[int, ...] = cases) -> dict[tuple[int, int], Stage]:
        """A stage by case and seed, where it was run."""
        found = [key for key in itertools.product(of_cases, seeds_found) if (place(*key, folder) / RECORD).is_file()]
        return {key: load_stage(place(*key, folder), made_by) for key in found}

    inferred = root / scale / "seed_0" / INFERRED
    runs: dict[Any, dict[Any, Stage]] = {
        EXPERIMENTS: optional(EXPERIMENTS, "notebook 08"),
        BUDGET: optional(BUDGET, "the online budget"),
        ONE_POLICY: optional(ONE_POLICY, "notebook 09", (1,)),
        OWN_PLANT: optional(OWN_PLANT, "notebook 07", (1,)),
        LIMITS: {
            (*key, part): load_stage(place(*key, f"limits_{part}"), "notebook 06")
            for key in optional(f"limits_{LIMITS[-1]}", "notebook 06")
            for part in LIMITS
        },
        INFERRED: {INFERRED: load_stage(inferred, "notebook 00")} if (inferred / RECORD).is_file() else {},
    }
    for case, record in params.items():
        for name in record.trials:
            runs[case, name] = optional(offline_folder(record, name), f"the trial '{name}'", (case,))
    changed = stale([*stages.values(), *(stage for run in runs.values() for stage in run.values())], root / scale, params_root)
    refuse({stage.folder: changed[stage.folder] for stage in stages.values() if stage.folder in changed})
    left_out = {stage.record["notebook"] for run in runs.values() for stage in run.values() if stage.folder in changed}
    for name, run in runs.items():
        runs[name] = {key: stage for key, stage in run.items() if stage.record["notebook"] not in left_out}
    known = claims.load_claims(params_root) if runs[EXPERIMENTS] else {}
    claim_values = claims.collect(known, stages | {(*key, EXPERIMENTS): stage for key, stage in runs[EXPERIMENTS].items()})
    return Results(
        scale=scale,
        params=params,
        published=published,
        stages=stages,
        seeds=seeds,
        claims=claims.verdicts(known, claim_values),
        claim_values=claim_values,
        budget=stacked(runs[BUDGET], "scores.csv", ("episodes_per_epoch", "objective")).infer_objects(),  # none: objects
        trials=_trials(params, seeds, runs),
        inferred=runs[INFERRED].get(INFERRED),
        limits=runs[LIMITS],
        one_policy=stacked(runs[ONE_POLICY], "summary.csv"),
        own_plant=stacked(runs[OWN_PLANT], "scores.csv"),
        search=load_stage(search_report.FOUND, "make search") if (search_report.FOUND / RECORD).is_file() else None,
        beyond=tuple(stage for run in runs.values() for stage in run.values()),
        made_from=inputs("05_report", params_root, scale),
        missing=tuple(seed for seed in range(n_seeds) if seed not in seeds_found),
        left_out=tuple(sorted(left_out)),
    )


def _folders(params: Params) -> dict[str, dict[str, str]]:
    """The stages of a case by folder, each with its names in scores.csv and their names in the report."""
    folders = {"demonstrations": {"expert": "expert"}}
    folders[ONLINE] = {name: name for name in ("expert_paired", "online", "online_y", scorecard.MINIMUM_VARIANCE)}
    folders |= {offline_folder(params, variant): {"offline": name} for name, variant in OFFLINE.items()}
    if params.case.offline.transfer_from is not None:  # the same learning without the transfer
        folders[f"offline_{HEADLINE}"] = {"offline": "offline_scratch"}
    return folders


def _trials(params: Mapping[int, Params], seeds: pd.DataFrame, runs: Mapping[Any, Mapping[Any, Stage]]) -> pd.DataFrame:
    """The feature gap of every offline trial that was run, after that of the variants that they are trials of."""
    rows = []
    for case, record in params.items():
        for name, trial in record.trials.items():
            for (_, seed), stage in runs[case, name].items():
                scores = stage.table("scores.csv", SCORES).set_index("metric")["value"]
                rows.append((name, trial.family, trial.title, case, seed, scores["feature_gap"]))
    trials = pd.DataFrame(rows, columns=["trial", "family", "description", "case", "seed", "gap"])
    if trials.empty:
        return trials
    gaps = seeds[(seeds["metric"] == "feature_gap") & seeds["stage"].isin(OFFLINE)].rename(columns={"value": "gap"})
    bases = gaps.assign(trial=gaps["stage"].map(OFFLINE), family="variant", description="as in the other sections")
    return pd.concat([bases[trials.columns], trials], ignore_index=True)
