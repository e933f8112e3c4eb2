"""Validated, frozen records of the extra runs behind the claims and of how the inferred settings are found."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from helpers.settings.leaf import (
    DEVIATION,
    EPISODES_PER_EPOCH,
    Count,
    Leaf,
    NotNegative,
    NotZero,
    ParameterError,
    Positive,
    Real,
    Record,
    Share,
    Text,
    Vector,
    check_length,
    load_record,
)
from helpers.settings.paper import Params


class ComparisonParams(Record):
    """How controllers are compared."""

    n_last: Annotated[Count, Leaf("samples")]
    band: Annotated[Positive, Leaf("share of the set point change")]
    reached: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("samples")]
    beta: Annotated[Positive, Leaf("-")]


class ExperimentCases(Record):
    """The cases in which an experiment is run, and for how many seeds, from the first on; without `seeds` for all."""

    cases: Annotated[tuple[Count, ...], Leaf("case")]
    seeds: Annotated[Count, Leaf("seeds")] | None = None

    def planned(self, case: int, seed: int) -> bool:
        """Whether it is to be run for this case and seed."""
        return case in self.cases and (self.seeds is None or seed < self.seeds)


class LearnedParams(ExperimentCases):
    """A policy learned offline, in fewer epochs than the case's."""

    epochs: Annotated[Count, Leaf("epochs")]


class BetaParams(ExperimentCases):
    """Online learning at several values of beta."""

    betas: Annotated[tuple[Positive, ...], Field(min_length=1), Leaf("-")]


class BudgetParams(ExperimentCases):
    """Online learning with several numbers of plant episodes an epoch."""

    episodes: Annotated[tuple[Annotated[Count, Field(gt=1, le=EPISODES_PER_EPOCH)], ...], Field(min_length=1), Leaf("episodes")]


class BaselineParams(ExperimentCases):
    """The spread of the policy gradient with and without the baseline of Algorithm 1."""

    batches: Annotated[Count, Field(gt=1), Leaf("batches")]
    episodes: Annotated[Count, Field(gt=1), Leaf("episodes")]


class OtherDemonstratorParams(LearnedParams):
    """Demonstrators other than the PID."""

    horizon: Annotated[Count, Leaf("samples")]
    move_penalty: Annotated[Positive, Leaf("-")]
    by_hand: Annotated[Text, Leaf("-")]
    held: Annotated[Real, Leaf(DEVIATION)]
    threshold: Annotated[NotNegative, Leaf("-")]
    rest_std: Annotated[Share, Leaf("share of initial_std")]


class CloningParams(ExperimentCases):
    """Behavioural cloning."""

    demonstrations: Annotated[tuple[Annotated[Count, Field(gt=1)], ...], Field(min_length=1), Leaf("trajectories")]
    steps: Annotated[Count, Leaf("gradient steps")]
    batch: Annotated[Count, Leaf("trajectories")]
    learning_rate_start: Annotated[Share, Leaf("-")]
    learning_rate_end: Annotated[Share, Leaf("-")]
    validation: Annotated[Positive, Field(lt=1), Leaf("share")]
    check_every: Annotated[Count, Leaf("gradient steps")]


class FewerDemonstrationsParams(LearnedParams):
    """Algorithm 2 on a part of the demonstrations."""

    demonstrations: Annotated[tuple[Annotated[Count, Field(gt=1)], ...], Field(min_length=1), Leaf("trajectories")]


class ConditionParams(Record):
    """Conditions that no learning has seen."""

    initial_shift: Annotated[Vector, Leaf("initial_std")]
    set_point_factor: Annotated[tuple[NotZero, ...], Field(min_length=1), Leaf("share of set_point")]
    disturbance_factor: Annotated[Positive, Leaf("share of disturbance")]


class ExperimentParams(Record):
    """params/experiments.yaml: the extra runs behind the claims."""

    comparison: ComparisonParams
    frozen_weights: LearnedParams
    undiscounted: ExperimentCases
    offline_beta: ExperimentCases
    sparse_reward: BetaParams
    budget: BudgetParams
    baseline: BaselineParams
    feature_sets: LearnedParams
    demonstrators: OtherDemonstratorParams
    cloning: CloningParams
    fewer_demonstrations: FewerDemonstrationsParams
    conditions: ConditionParams


class SearchParams(Record):
    """Upper ends of the search for the inferred settings, one entry an input or a control loop."""

    sampling_time: Annotated[Positive, Leaf("time")]
    input_bound: Annotated[tuple[Positive, ...], Leaf(DEVIATION)]
    proportional: Annotated[tuple[Positive, ...], Leaf("input/output")]
    integral: Annotated[tuple[Positive, ...], Leaf("input/(output time)")]
    derivative: Annotated[tuple[Positive, ...], Leaf("input time/output")]


class IdentificationScaleParams(Record):
    """How much the search for the inferred settings computes."""

    starts: Annotated[Count, Leaf("starts")]
    evaluations: Annotated[Count, Leaf("evaluations")]
    evaluations_reading: Annotated[Count, Leaf("evaluations")]
    draws_search: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    draws: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    draws_final: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    iterations: Annotated[Count, Leaf("iterations")]
    profile_steps: Annotated[Count, Leaf("steps to each side")]
    fresh: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    readings: Annotated[Count, Leaf("readings")]


class IdentificationParams(Record):
    """params/identification.yaml: how the settings that the paper leaves out are inferred."""

    sample: Annotated[Count, Leaf("trajectories")]
    settled_by: Annotated[Text, Leaf("-")]
    overdamped: Annotated[Text, Leaf("-")]
    overshoot_unit: Annotated[Positive, Leaf("share of the set point change")]
    interval: Annotated[Positive, Leaf("-")]
    identified: Annotated[Positive, Leaf("share of the value")]
    search: SearchParams
    scales: dict[Text, IdentificationScaleParams]


def load_experiments(root: Path, params: Params) -> ExperimentParams:
    """The settings of the extra runs, from experiments.yaml, for the process of a case."""
    path = root / "experiments.yaml"
    record = load_record(ExperimentParams, path)
    if record.demonstrators.by_hand not in params.process.manipulated:
        known, found = ", ".join(params.process.manipulated), record.demonstrators.by_hand
        raise ParameterError(f"{path}: key 'demonstrators.by_hand': expected one of {known}, found '{found}'")
    for name in ("initial_shift", "set_point_factor"):
        check_length(path, f"conditions.{name}", getattr(record.conditions, name), len(params.process.controlled))
    return record


def load_identification(root: Path, params: Params) -> IdentificationParams:
    """How the inferred settings are found, from identification.yaml, for the process of a case."""
    path = root / "identification.yaml"
    record = load_record(IdentificationParams, path, params.learning.scales)
    for name in ("input_bound", "proportional", "integral", "derivative"):
        check_length(path, f"search.{name}", getattr(record.search, name), len(params.process.controlled), "loop")
    return record
