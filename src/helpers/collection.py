"""What the stages of all cases and seeds wrote, read and checked, for the report."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd

from helpers import claims, scorecard
from helpers.artifacts import RECORD, ArtifactError, Stage, load_stage
from helpers.features import feature_names
from helpers.params import Params, PublishedCase, load, load_published
from helpers.session import parameters_hash

DEMONSTRATIONS, ONLINE, BUDGET, EXPERIMENTS = "demonstrations", "online_improved", "online_budget", "experiments"
OFFLINE = {"offline": "improved", "offline_printed": "printed"}  # stage in seeds.csv and the variant behind it
INFERRED = "inferred_settings"  # which has no case, and stands with the first seed
SCRATCH = "offline_improved"  # of a case that starts from another: the same learning without the transfer
MADE_BY = {"demonstrations": "01", "offline": "02", "online": "03 (04 for the transfer case)", "transfer": "04"}


@dataclass(frozen=True)
class Results:
    """What the stages of all cases and seeds wrote.

    Attributes:
        params, published: by case.
        stages: by case, seed and folder name.
        seeds: columns case, seed, stage, metric, value. The stages: expert; minimum_variance; offline, online and online_y of
            the headline variant (offline of a transfer case is after the transfer); offline_printed; offline_scratch (the
            transfer case learned from nothing). The ratios of `scorecard.relative` are among the rows.
        claims: columns `claims.COLUMNS`; budget: seed, case, episodes_per_epoch, objective; trials: trial, family,
            description, case, seed, gap. Each is empty where it was not run. inferred: what notebook 00 wrote, if it was run.
    """

    scale: str
    params: dict[int, Params]
    published: dict[int, PublishedCase]
    stages: dict[tuple[int, int, str], Stage]
    seeds: pd.DataFrame
    claims: pd.DataFrame
    budget: pd.DataFrame
    trials: pd.DataFrame
    inferred: Stage | None = None

    @cached_property
    def feature_names(self) -> list[str]:
        """Names of the features in their order."""
        return feature_names(next(iter(self.params.values())).process.controlled)

    @cached_property
    def n_seeds(self) -> int:
        """How many seeds were run."""
        return len({seed for _, seed, _ in self.stages})

    @cached_property
    def medians(self) -> pd.DataFrame:
        """Every number over its seeds, `scorecard.summary`."""
        return scorecard.summary(self.seeds)

    def median(self, case: int, stage: str, metric: str) -> float:
        """The median of one number over the seeds; nan where no seed gave it."""
        rows = self.medians.query("case == @case and stage == @stage and metric == @metric")
        return float(rows["median"].iloc[0]) if len(rows) else float("nan")

    def offline_folder(self, case: int, variant: str = "improved") -> str:
        """The folder of a case's offline learning."""
        return _offline_folder(self.params[case], variant)

    def table(self, case: int, folder: str, name: str) -> pd.DataFrame:
        """One table of one stage, that of every seed below the other, with a column `seed`."""
        found = {seed: stage for (number, seed, stage_name), stage in self.stages.items() if (number, stage_name) == (case, folder)}
        return pd.concat([stage.table(name).assign(seed=seed) for seed, stage in found.items()], ignore_index=True)


def _offline_folder(params: Params, variant: str) -> str:
    return f"offline_{variant}" if params.case.offline.transfer_from is None else f"transfer_{variant}"


def collect(root: Path, params_root: Path, scale: str, cases: tuple[int, ...], n_seeds: int) -> Results:
    """Read every stage of every case and seed below `root`; claims, budget and trials where they were run.

    Raises:
        ArtifactError: if a stage is missing, damaged or was made with other parameters than the files now hold.
    """
    params = {case: load(params_root, case) for case in cases}
    published = {case: entry for case, entry in load_published(params_root).items() if case in cases}
    stages: dict[tuple[int, int, str], Stage] = {}
    frames = []
    for case, record in params.items():
        folders = {DEMONSTRATIONS: {"expert": "expert"}}
        folders[ONLINE] = {name: name for name in ("expert_paired", "online", "online_y", scorecard.MINIMUM_VARIANCE)}
        folders |= {_offline_folder(record, variant): {"offline": name} for name, variant in OFFLINE.items()}
        if record.case.offline.transfer_from is not None:
            folders[SCRATCH] = {"offline": "offline_scratch"}
        for seed in range(n_seeds):
            for folder, names in folders.items():
                notebook = MADE_BY[folder.split("_")[0]]
                path = root / scale / f"seed_{seed}" / f"case_{case}" / folder
                stage = load_stage(path, f"notebook {notebook} for case {case} and seed {seed}")
                if stage.record.get("parameters") != parameters_hash(record):
                    raise ArtifactError(f"{path / RECORD}: made with other parameters than {params_root} holds now; run it again")
                stages[case, seed, folder] = stage
                scores = stage.table("scores.csv", ("stage", "metric", "value"))
                frames.append(scores.assign(case=case, seed=seed, stage=scores["stage"].map(names)).dropna(subset="stage"))
    seeds = pd.concat(frames, ignore_index=True)[["case", "seed", "stage", "metric", "value"]]
    features = feature_names(next(iter(params.values())).process.controlled)
    seeds = pd.concat([seeds, scorecard.relative(seeds, published, features)], ignore_index=True)
    inferred = root / scale / "seed_0" / INFERRED
    return Results(
        scale=scale,
        params=params,
        published=published,
        stages=stages,
        seeds=seeds,
        claims=_claims(root, params_root, scale, cases, n_seeds),
        budget=_budget(root / scale, cases, n_seeds),
        trials=_trials(root / scale, params, seeds, n_seeds),
        inferred=load_stage(inferred, "notebook 00") if (inferred / RECORD).is_file() else None,
    )


def _finished(root: Path, cases: tuple[int, ...], n_seeds: int, folder: str, made_by: str) -> dict[tuple[int, int], Stage]:
    """An optional stage by case and seed, where it was run."""
    paths = {(case, seed): root / f"seed_{seed}" / f"case_{case}" / folder for case in cases for seed in range(n_seeds)}
    return {key: load_stage(path, made_by) for key, path in paths.items() if (path / RECORD).is_file()}


def _claims(root: Path, params_root: Path, scale: str, cases: tuple[int, ...], n_seeds: int) -> pd.DataFrame:
    """The verdicts on the claims, where the experiments behind them were run for any seed."""
    if not _finished(root / scale, cases, n_seeds, EXPERIMENTS, "notebook 08"):
        return pd.DataFrame(columns=list(claims.COLUMNS))
    known = claims.load_claims(params_root)
    return claims.verdicts(known, claims.collect(known, root, scale, range(n_seeds)))


def _budget(root: Path, cases: tuple[int, ...], n_seeds: int) -> pd.DataFrame:
    """The objective after online learning by the episodes of an epoch, where that was run."""
    columns = ("episodes_per_epoch", "objective")
    frames = [
        stage.table("scores.csv", columns).assign(seed=seed, case=case)
        for (case, seed), stage in _finished(root, cases, n_seeds, BUDGET, "the online budget").items()
    ]
    order = ["seed", "case", *columns]
    return pd.concat(frames, ignore_index=True)[order] if frames else pd.DataFrame(columns=order)


def _trials(root: Path, params: Mapping[int, Params], seeds: pd.DataFrame, n_seeds: int) -> pd.DataFrame:
    """The feature gap of every offline trial that was run, after that of the variants that they are trials of."""
    rows = []
    for case, record in params.items():
        for name, trial in record.trials.items():
            found = _finished(root, (case,), n_seeds, _offline_folder(record, name), f"the trial '{name}'")
            for (_, seed), stage in found.items():
                scores = stage.table("scores.csv", ("stage", "metric", "value")).set_index("metric")["value"]
                rows.append((name, trial.family, trial.title, case, seed, scores["feature_gap"]))
    trials = pd.DataFrame(rows, columns=["trial", "family", "description", "case", "seed", "gap"])
    if trials.empty:
        return trials
    gaps = seeds[(seeds["metric"] == "feature_gap") & seeds["stage"].isin(OFFLINE)].rename(columns={"value": "gap"})
    bases = gaps.assign(trial=gaps["stage"].map(OFFLINE), family="variant", description="as in the other sections")
    return pd.concat([bases[trials.columns], trials], ignore_index=True)
