"""Validated, frozen records of the parameter files.

A leaf of a parameter file is a mapping {value, unit, source, status}; the records hold the bare values, checked for type,
unit and range, and `leaves` lists them all for the report. Whatever is wrong with a file is one sentence that names
the file, the key and what was expected.
"""

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, Strict, ValidationError, model_validator
from pydantic_core import PydanticCustomError, core_schema
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent

LEAF_KEYS = ("value", "unit", "source", "status")
STATUSES = ("reported", "inferred", "assumed")
LONGEST = 200  # characters of a file that a message shows


class InputError(ValueError):
    """What a user gave cannot be used; the message is one sentence, on one line, that says all there is to say."""

    def __init__(self, sentence: str) -> None:
        super().__init__(" ".join(sentence.splitlines()))  # it may quote what it met

    def _render_traceback_(self) -> list[str]:
        """What IPython shows: the sentence alone."""
        return [f"{type(self).__name__}: {self}"]


class ParameterError(InputError):
    """A parameter file is unusable; the message names the file and the key."""


@dataclass(frozen=True)
class Leaf:
    """Marks a field whose entry in the file is {value, unit, source, status}, with the unit it must be given in."""

    unit: str

    def unwrap(self, entry: Any) -> Any:
        """The value of a leaf, once its keys, unit and status are right."""
        if not isinstance(entry, dict):
            raise PydanticCustomError("leaf", "expected a leaf with the keys value, unit, source, status")
        for key in LEAF_KEYS:
            if key not in entry:
                raise PydanticCustomError("leaf", "the leaf lacks the key '{key}'", {"key": key})
        for key in entry:
            if key not in LEAF_KEYS:
                raise PydanticCustomError("leaf", "the leaf has the unknown key '{key}'", {"key": str(key)})
        if entry["unit"] != self.unit:
            raise PydanticCustomError(
                "leaf", "expected the unit '{expected}', found '{found}'", {"expected": self.unit, "found": str(entry["unit"])}
            )
        if entry["status"] not in STATUSES:
            raise PydanticCustomError(
                "leaf", "expected a status of reported, inferred, assumed, found '{found}'", {"found": str(entry["status"])}
            )
        if not isinstance(entry["source"], str) or not entry["source"]:
            raise PydanticCustomError("leaf", "expected a source in words")
        return entry["value"]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(self.unwrap, handler(source))


def _not_zero(value: float) -> float:
    if value == 0:
        raise PydanticCustomError("zero", "expected a number other than zero")
    return value


EPISODES_PER_EPOCH = 500  # the size of the paper's batch of demonstrations; no epoch may draw more
DEVIATION = "deviation, unit not given"
Real = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Real, Field(gt=0)]
NotNegative = Annotated[Real, Field(ge=0)]
Count = Annotated[int, Strict(), Field(gt=0)]
Text = Annotated[str, Strict(), Field(min_length=1)]
Vector = Annotated[tuple[Real, ...], Field(min_length=1)]
Share = Annotated[Positive, Field(le=1)]
Memory = Annotated[NotNegative, Field(lt=1)]
NotZero = Annotated[Real, AfterValidator(_not_zero)]
Matrix = Annotated[tuple[Vector, ...], Field(min_length=1)]


class Record(BaseModel):
    """A frozen record that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def _same_length(expected: int, record: BaseModel, *names: str) -> None:
    for name in names:
        if len(getattr(record, name)) != expected:
            raise PydanticCustomError(
                "length",
                "'{name}' has {found} entries, expected {expected}",
                {"name": name, "found": len(getattr(record, name)), "expected": expected},
            )


KEY_MESSAGES = {
    "missing": "the key is missing",
    "extra_forbidden": "the key is unknown",
    "tuple_type": "expected a list in brackets",
    "dict_type": "expected keys and values",
    "model_type": "expected keys and values",
}

R = TypeVar("R", bound=Record)


class BalanceParams(Record):
    """The groups of the material and energy balance behind Eq. 4.1.3b."""

    dilution_rate: Annotated[Positive, Leaf("1/time")]
    rate_constant: Annotated[Positive, Leaf("1/time")]
    heat_exchange: Annotated[Positive, Leaf("1/time")]
    reaction_heat: Annotated[Positive, Leaf("temperature/concentration")]
    rate_sensitivity: Annotated[Positive, Leaf("concentration/(time temperature)")]


class ProcessParams(Record):
    """params/process.yaml: Section 4.1."""

    controlled: Annotated[tuple[Text, ...], Leaf("-")]
    manipulated: Annotated[tuple[Text, ...], Leaf("-")]
    controlled_description: Annotated[tuple[Text, ...], Leaf("-")]
    manipulated_description: Annotated[tuple[Text, ...], Leaf("-")]
    drift_state: Annotated[Matrix, Leaf("1/time")]
    drift_input: Annotated[Matrix, Leaf("1/time")]
    disturbance: Annotated[Vector, Leaf("1/sqrt(time)")]
    observation_noise: Annotated[tuple[NotNegative, ...], Leaf("-")]
    sampling_time: Annotated[Positive, Leaf("time")]
    horizon: Annotated[Count, Leaf("samples")]
    input_low: Annotated[Vector, Leaf(DEVIATION)]
    input_high: Annotated[Vector, Leaf(DEVIATION)]
    balance: BalanceParams | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        n_states = len(self.controlled)
        n_inputs = len(self.manipulated)
        _same_length(n_states, self, "controlled_description", "drift_state", "drift_input")
        _same_length(n_states, self, "disturbance", "observation_noise")
        _same_length(n_inputs, self, "manipulated_description", "input_low", "input_high")
        for name, width in (("drift_state", n_states), ("drift_input", n_inputs)):
            if any(len(row) != width for row in getattr(self, name)):
                raise PydanticCustomError(
                    "length", "'{name}' has a row whose length is not {width}", {"name": name, "width": width}
                )
        if any(low >= high for low, high in zip(self.input_low, self.input_high, strict=True)):
            raise PydanticCustomError("bounds", "'input_low' must lie below 'input_high' for every input")
        return self


class GainParams(Record):
    """Gains of a PID controller, one a control loop."""

    proportional: Annotated[Vector, Leaf("input/output")]
    integral: Annotated[Vector, Leaf("input/(output time)")]
    derivative: Annotated[Vector, Leaf("input time/output")]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _same_length(len(self.proportional), self, "integral", "derivative")
        return self


class FeatureParams(Record):
    """params/features.yaml: Section 4.2."""

    beta: Annotated[Positive, Leaf("-")]
    discount: Annotated[Positive, Field(le=1), Leaf("-")]
    features_on: Annotated[Literal["x", "y"], Leaf("-")]
    initial_error: Annotated[NotNegative, Leaf("-")]


class ExplorationParams(Record):
    """How far the policy explores: its standard deviation at the start of learning and between which limits it is learnt."""

    std_low: Annotated[Positive, Leaf("input range")]
    std_high: Annotated[Positive, Leaf("input range")]
    initial_std: Annotated[Positive, Leaf("input range")]

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.std_low <= self.initial_std <= self.std_high or self.std_low == self.std_high:
            raise PydanticCustomError("std", "expected std_low <= initial_std <= std_high and std_low < std_high")
        return self


class PolicyParams(ExplorationParams):
    """The network and the distribution of the policy, Section 3.2."""

    hidden_cells: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("cells")]
    leaky_slope: Annotated[NotNegative, Leaf("-")]
    error_unit: Annotated[tuple[Positive, ...], Leaf(DEVIATION)]
    initial_output_scale: Annotated[Positive, Leaf("1/sqrt(cells)")]


class ScaleParams(Record):
    """How much is computed: the smoke run or the paper's."""

    number_type: Annotated[Literal["float32", "float64"], Leaf("-")]
    threads: Annotated[Count, Leaf("threads")]
    demonstrations: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    episodes: Annotated[Count, Field(gt=1), Leaf("episodes")]
    measured: Annotated[Count, Field(gt=1), Leaf("episodes")]
    evaluation: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    expert_evaluation: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    epoch_share: Annotated[Share, Leaf("-")]
    checkpoint_interval: Annotated[Positive, Leaf("s")]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.episodes + self.measured > EPISODES_PER_EPOCH:
            raise PydanticCustomError("epoch", "'episodes' and 'measured' exceed {top} an epoch", {"top": EPISODES_PER_EPOCH})
        return self


class LearnerParams(Record):
    """Algorithm 1."""

    credit: Annotated[Literal["whole_return", "reward_to_go"], Leaf("-")]
    credit_decay: Annotated[Share, Leaf("-")]
    passes: Annotated[Count, Leaf("per epoch")]
    minibatches: Annotated[Count, Leaf("per pass")]
    ratio_clip: Annotated[Positive, Leaf("-")]
    learning_rate_start: Annotated[Share, Leaf("-")]
    learning_rate_end: Annotated[Share, Leaf("-")]
    averaging: Annotated[Memory, Leaf("-")]
    patience: Annotated[int, Strict(), Field(ge=0), Leaf("epochs")]
    entropy: Annotated[NotNegative, Leaf("-")] = 0.0
    trust_region: Annotated[Positive, Leaf("nats")] | None = None


class WeightParams(Record):
    """The ascent of Algorithm 2 in the reward weights."""

    iterations: Annotated[Literal["case", "epochs"], Leaf("-")]
    initial: Annotated[Vector, Field(min_length=3, max_length=3), Leaf("-")]
    step: Annotated[Positive, Leaf("-")]
    decay: Annotated[Memory, Leaf("-")]
    bound: Annotated[Positive, Leaf("-")]
    scaled_by_expert: Annotated[bool, Strict(), Leaf("-")]
    averaging: Annotated[Memory, Leaf("-")]
    keep_nearest: Annotated[bool, Strict(), Leaf("-")]
    selection_memory: Annotated[Memory, Leaf("-")]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not any(self.initial):
            raise PydanticCustomError("weights", "'initial' holds zeros only, which have no direction")
        return self


class VariantParams(Record):
    """One variant of Algorithms 1 and 2. Without `exploration` the policy explores as its own parameters say."""

    learner: LearnerParams
    weights: WeightParams
    exploration: ExplorationParams | None = None


class TrialParams(Record):
    """params/trials.yaml: a trial of offline learning, as the changes that it makes to a variant.

    `learner`, `weights` and `exploration` hold the changed leaves as the file has them.
    """

    base: Text
    title: Text
    family: Literal[
        "step size",
        "weights",
        "kept policy",
        "entropy",
        "clipped ratio",
        "natural gradient",
        "exploration",
        "credit",
    ]
    learner: dict[str, Any] = Field(default_factory=dict)
    weights: dict[str, Any] = Field(default_factory=dict)
    exploration: dict[str, Any] = Field(default_factory=dict)

    @property
    def changes(self) -> dict[str, dict[str, Any]]:
        """The changed leaves by part of a variant."""
        return {name: part for name in ("learner", "weights", "exploration") if (part := getattr(self, name))}


class OnlineLearningParams(Record):
    """Algorithm 1 under the real objective."""

    episodes: Annotated[Count, Field(gt=1, le=EPISODES_PER_EPOCH), Leaf("episodes")]
    exploration: ExplorationParams
    learner: LearnerParams


class LearningParams(Record):
    """params/learning.yaml: what the paper's supporting information would have held."""

    policy: PolicyParams
    scales: dict[Text, ScaleParams]
    variants: dict[Text, VariantParams]
    online: OnlineLearningParams

    @property
    def fewest_episodes(self) -> int:
        """Episodes of an epoch at the smallest scale, which every minibatch must share."""
        return min(scale.episodes for scale in self.scales.values())

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        fewest = self.fewest_episodes
        for learner in (self.online.learner, *(variant.learner for variant in self.variants.values())):
            if learner.minibatches > fewest:
                raise PydanticCustomError("batch", "'minibatches' exceeds the {fewest} episodes of a scale", {"fewest": fewest})
        return self


class OfflineParams(Record):
    """The offline half of a case study."""

    epochs: Annotated[Count, Leaf("epochs")]
    iterations: Annotated[Count, Leaf("iterations")]
    transfer_from: Annotated[Count, Leaf("case")] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.iterations > self.epochs:
            raise PydanticCustomError("iterations", "'iterations' exceeds 'epochs'")
        return self


class OnlineParams(Record):
    """The online half of a case study: rounds of epochs, each with its own beta."""

    epochs: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("epochs")]
    beta: Annotated[tuple[Positive, ...], Field(min_length=1), Leaf("-")]
    headline_beta: Annotated[Positive, Leaf("-")]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _same_length(len(self.epochs), self, "beta")
        return self


class CaseParams(Record):
    """params/case_<n>.yaml: Table 1 and the settings of one case study."""

    title: Annotated[Text, Leaf("-")]
    demonstrator: Annotated[Text, Leaf("-")]
    set_point: Annotated[Vector, Leaf(DEVIATION)]
    steady_state: Annotated[Vector, Leaf(DEVIATION)]
    error_scale: Annotated[tuple[NotZero, ...], Leaf(DEVIATION)] | None = None
    initial_mean: Annotated[Vector, Leaf(DEVIATION)]
    initial_std: Annotated[tuple[NotNegative, ...], Leaf(DEVIATION)]
    offline: OfflineParams
    online: OnlineParams

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(self.steady_state) != len(self.set_point):
            raise PydanticCustomError("length", "'set_point' and 'steady_state' differ in length")
        if self.error_scale is not None:
            _same_length(len(self.set_point), self, "error_scale")
        elif any(target == rest for target, rest in zip(self.set_point, self.steady_state, strict=True)):
            raise PydanticCustomError(
                "scale", "'set_point' equals 'steady_state' in a loop, so the error has no scale: give 'error_scale'"
            )
        return self

    @property
    def scale_of_error(self) -> tuple[float, ...]:
        """The denominator of Eq. 4.2.1: y_sp - y_ss, unless the file gives another."""
        if self.error_scale is not None:
            return self.error_scale
        return tuple(target - rest for target, rest in zip(self.set_point, self.steady_state, strict=True))


class PublishedCase(Record):
    """One table of results as the paper prints it."""

    table: Count
    expert: Vector
    policy: Vector
    alpha: Vector

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _same_length(len(self.expert), self, "policy", "alpha")
        return self

    @property
    def feature_gap(self) -> float:
        """The paper's own feature gap: the mean of |v_pi - v_E| / |v_E| over its two printed rows."""
        pairs = list(zip(self.policy, self.expert, strict=True))
        return sum(abs(policy - expert) / abs(expert) for policy, expert in pairs) / len(pairs)


class ComparisonParams(Record):
    """How controllers are compared."""

    n_last: Annotated[Count, Leaf("samples")]
    band: Annotated[Positive, Leaf("share of the set point change")]
    beta: Annotated[Positive, Leaf("-")]


class ExperimentCases(Record):
    """The cases in which an experiment is run."""

    cases: Annotated[tuple[Count, ...], Leaf("case")]


class FrozenWeightsParams(ExperimentCases):
    """A policy from scratch under weights that stay as they are."""

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


class FeatureSetsParams(ExperimentCases):
    """Algorithm 2 on some of the features, and on all of them alike."""

    epochs: Annotated[Count, Leaf("epochs")]


class OtherDemonstratorParams(ExperimentCases):
    """Demonstrators other than the PID."""

    epochs: Annotated[Count, Leaf("epochs")]
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


class FewerDemonstrationsParams(ExperimentCases):
    """Algorithm 2 on a part of the demonstrations."""

    demonstrations: Annotated[tuple[Annotated[Count, Field(gt=1)], ...], Field(min_length=1), Leaf("trajectories")]
    epochs: Annotated[Count, Leaf("epochs")]


class ConditionParams(Record):
    """Conditions that no learning has seen."""

    initial_shift: Annotated[Vector, Leaf("initial_std")]
    set_point_factor: Annotated[tuple[NotZero, ...], Field(min_length=1), Leaf("share of set_point")]
    disturbance_factor: Annotated[Positive, Leaf("share of disturbance")]


class ExperimentParams(Record):
    """params/experiments.yaml: the extra runs behind the claims."""

    comparison: ComparisonParams
    frozen_weights: FrozenWeightsParams
    undiscounted: ExperimentCases
    beta: BetaParams
    budget: BudgetParams
    baseline: BaselineParams
    feature_sets: FeatureSetsParams
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


@dataclass(frozen=True)
class Params:
    """Everything that one stage of one case needs to know, and `leaves`: a row for the report for every leaf read.

    The variants of `learning` include the trials of offline learning; `trials` says which they are. Their leaves are not
    among `leaves`, because no other result depends on them.
    """

    process: ProcessParams
    demonstrator: GainParams
    features: FeatureParams
    learning: LearningParams
    case: CaseParams
    leaves: tuple[dict[str, Any], ...]
    trials: Mapping[str, TrialParams] = field(default_factory=dict)

    def base(self, variant: str) -> str:
        """The variant whose random numbers a variant meets: a trial's base, so that the two can be compared seed by seed."""
        return self.trials[variant].base if variant in self.trials else variant


def load(root: Path, case: int) -> Params:
    """The parameters of a case from a folder of parameter files.

    Raises:
        ParameterError: if a file is missing, damaged or holds a value that cannot be, in one sentence.
    """
    case_file = root / f"case_{case}.yaml"
    if not case_file.is_file():
        known = ", ".join(sorted(path.stem.removeprefix("case_") for path in root.glob("case_*.yaml"))) or "none"
        raise ParameterError(f"{case_file}: there is no case {case}; the cases are {known}")
    names = ("process.yaml", "demonstrators.yaml", "features.yaml", "learning.yaml", case_file.name)
    raw = {name: read_yaml(root / name) for name in names}
    process = validate(ProcessParams, raw["process.yaml"], root / "process.yaml")
    demonstrators = {
        name: validate(GainParams, entry, root / "demonstrators.yaml", name) for name, entry in raw["demonstrators.yaml"].items()
    }
    record = validate(CaseParams, raw[case_file.name], case_file)
    if record.demonstrator not in demonstrators:
        known = ", ".join(demonstrators)
        raise ParameterError(f"{case_file}: key 'demonstrator': expected one of {known}, found '{record.demonstrator}'")
    n_controlled, n_manipulated = len(process.controlled), len(process.manipulated)
    gains = demonstrators[record.demonstrator]
    learning = validate(LearningParams, raw["learning.yaml"], root / "learning.yaml")
    lengths = (
        (case_file, "set_point", record.set_point, n_controlled),
        (case_file, "initial_mean", record.initial_mean, n_controlled),
        (case_file, "initial_std", record.initial_std, n_controlled),
        (root / "demonstrators.yaml", f"{record.demonstrator}.proportional", gains.proportional, n_controlled),
        (root / "learning.yaml", "policy.error_unit", learning.policy.error_unit, n_controlled),
    )
    for path, key, value, expected in lengths:
        if len(value) != expected:
            raise ParameterError(f"{path}: key '{key}': expected {expected} entries, one a variable, found {len(value)}")
    if n_manipulated != n_controlled:
        path = root / "process.yaml"
        raise ParameterError(f"{path}: key 'manipulated': a PID pairs {n_controlled} loops, found {n_manipulated} inputs")
    leaves = tuple(row for name in names for row in list_leaves(raw[name], name))
    trials = load_trials(root)
    variants = {name: _trial_variant(root, name, trial, learning, raw["learning.yaml"]) for name, trial in trials.items()}
    return Params(
        process=process,
        demonstrator=gains,
        features=validate(FeatureParams, raw["features.yaml"], root / "features.yaml"),
        learning=learning.model_copy(update={"variants": learning.variants | variants}),
        case=record,
        leaves=leaves,
        trials=trials,
    )


def load_trials(root: Path) -> dict[str, TrialParams]:
    """The trials of offline learning by name, from trials.yaml."""
    path = root / "trials.yaml"
    trials = {}
    for name, entry in read_yaml(path).items():
        if not re.fullmatch("[a-z][a-z0-9_]*", name):  # it becomes the name of a folder
            raise ParameterError(f"{path}: key '{name}': expected a name of small letters, digits and underscores")
        trials[name] = validate(TrialParams, entry, path, name)
        if not trials[name].changes:
            raise ParameterError(f"{path}: key '{name}': the trial changes nothing")
    return trials


def _trial_variant(root: Path, name: str, trial: TrialParams, learning: LearningParams, raw: dict[str, Any]) -> VariantParams:
    """The variant that a trial's changes make of its base; `raw` is the content of learning.yaml."""
    path = root / "trials.yaml"
    known = ", ".join(learning.variants)
    if name in learning.variants:
        raise ParameterError(f"{path}: key '{name}': a trial needs a name other than those of the variants, {known}")
    if trial.base not in learning.variants:
        raise ParameterError(f"{path}: key '{name}.base': expected one of {known}, found '{trial.base}'")
    base = raw["variants"][trial.base]
    merged = base | {part: base.get(part, {}) | changes for part, changes in trial.changes.items()}
    variant = validate(VariantParams, merged, path, name)
    if variant.learner.minibatches > learning.fewest_episodes:
        key = f"{name}.learner.minibatches"
        raise ParameterError(f"{path}: key '{key}': exceeds the {learning.fewest_episodes} episodes of a scale")
    return variant


def load_published(root: Path) -> dict[int, PublishedCase]:
    """The paper's tables by case, from published.yaml."""
    path = root / "published.yaml"
    published = {}
    for key, entry in read_yaml(path).items():
        number = key.removeprefix("case_")
        if not key.startswith("case_") or not number.isdecimal():
            raise ParameterError(f"{path}: key '{key}': expected case_ and a number")
        published[int(number)] = validate(PublishedCase, entry, path, key)
    return published


def load_experiments(root: Path, params: Params) -> ExperimentParams:
    """The settings of the extra runs, from experiments.yaml, for the process of a case."""
    path = root / "experiments.yaml"
    record = validate(ExperimentParams, read_yaml(path), path)
    if record.demonstrators.by_hand not in params.process.manipulated:
        known, found = ", ".join(params.process.manipulated), record.demonstrators.by_hand
        raise ParameterError(f"{path}: key 'demonstrators.by_hand': expected one of {known}, found '{found}'")
    expected = len(params.process.controlled)
    for name in ("initial_shift", "set_point_factor"):
        value = getattr(record.conditions, name)
        if len(value) != expected:
            key = f"conditions.{name}"
            raise ParameterError(f"{path}: key '{key}': expected {expected} entries, one a variable, found {len(value)}")
    return record


def load_identification(root: Path, params: Params) -> IdentificationParams:
    """How the inferred settings are found, from identification.yaml, for the process of a case."""
    path = root / "identification.yaml"
    record = validate(IdentificationParams, read_yaml(path), path)
    expected = len(params.process.controlled)
    for name in ("input_bound", "proportional", "integral", "derivative"):
        value = getattr(record.search, name)
        if len(value) != expected:
            raise ParameterError(f"{path}: key 'search.{name}': expected {expected} entries, one a loop, found {len(value)}")
    for scale in params.learning.scales:
        if scale not in record.scales:
            raise ParameterError(f"{path}: key 'scales.{scale}': the key is missing")
    return record


def read_yaml(path: Path) -> dict[str, Any]:
    """A parameter file as nested dictionaries; YAML 1.2, so that 1e-3 is a number."""
    if not path.is_file():
        raise ParameterError(f"{path}: the parameter file is missing")
    try:
        content = copy.deepcopy(_parsed(path.read_text(encoding="utf-8")))
    except DuplicateKeyError as error:
        raise ParameterError(f"{path}: {' '.join(str(error.problem).split())}") from error
    except RecursionError as error:
        raise ParameterError(f"{path}: not readable as YAML: its entries are nested too deeply") from error
    except (OSError, YAMLError, UnicodeDecodeError, ValueError) as error:
        raise ParameterError(f"{path}: not readable as YAML: {' '.join(str(error).split())[:LONGEST]}") from error
    if not isinstance(content, dict):
        raise ParameterError(f"{path}: expected keys and values, found {type(content).__name__}")
    for key in content:
        if not isinstance(key, str):
            raise ParameterError(f"{path}: key '{key}': expected a word")
    return content


class _PlainComposer(Composer):
    """Refuses aliases: nine lines of them can stand for more values than there is memory, or for themselves."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node of the document."""
        if self.parser.check_event(AliasEvent):
            event = self.parser.peek_event()
            raise ComposerError("", event.start_mark, f"found the alias '{event.anchor}'; write the value out", event.start_mark)
        return super().compose_node(parent, index)


@cache
def _parsed(text: str) -> Any:
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _PlainComposer
    return yaml.load(text)


def validate(kind: type[R], content: Any, path: Path, prefix: str = "") -> R:
    """The content of a file as a record, or one sentence that names the file and the first key that is wrong."""
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join([prefix, *(str(part) for part in first["loc"])]).strip(".")
        message = KEY_MESSAGES.get(first["type"])
        if message is None:
            found = first["input"]
            shown = "" if isinstance(found, (dict, BaseModel)) else f", found {repr(found)[:LONGEST]}"
            message = first["msg"][:1].lower() + first["msg"][1:] + shown
        where = f"key '{key}': " if key else ""  # a rule between keys names them itself
        raise ParameterError(f"{path}: {where}{message}") from error


def list_leaves(content: Any, file: str, key: str = "") -> list[dict[str, Any]]:
    """Every leaf below `content` as {file, key, value, unit, source, status}."""
    if isinstance(content, dict) and set(content) == set(LEAF_KEYS):
        return [{"file": file, "key": key, **content}]
    if isinstance(content, dict):
        return [row for name, entry in content.items() for row in list_leaves(entry, file, f"{key}.{name}".strip("."))]
    return []
