"""Validated, frozen records of what the paper needs: process, demonstrators, features, learning, cases and the printed tables."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from helpers.settings.leaf import (
    DEVIATION,
    EPISODES_PER_EPOCH,
    Count,
    Leaf,
    Matrix,
    Memory,
    NotNegative,
    NotZero,
    ParameterError,
    Positive,
    Record,
    Rules,
    Share,
    Text,
    Vector,
    check_length,
    list_leaves,
    read_yaml,
    validate,
)

HEADLINE = "improved"  # the variant of Algorithms 1 and 2 behind the report's numbers, with which all others are compared


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
    integration_steps: Annotated[Count, Leaf("steps")]
    horizon: Annotated[Count, Leaf("samples")]
    input_low: Annotated[Vector, Leaf(DEVIATION)]
    input_high: Annotated[Vector, Leaf(DEVIATION)]
    balance: BalanceParams | None = None

    def _rules(self) -> Rules:
        n_states, n_inputs = len(self.controlled), len(self.manipulated)
        states = ("controlled_description", "drift_state", "drift_input", "disturbance", "observation_noise")
        yield from self._lengths(n_states, *states)
        yield from self._lengths(n_inputs, "manipulated_description", "input_low", "input_high")
        for name, width in (("drift_state", n_states), ("drift_input", n_inputs)):
            yield any(len(row) != width for row in getattr(self, name)), f"'{name}' has a row whose length is not {width}"
        crossed = any(low >= high for low, high in zip(self.input_low, self.input_high, strict=True))
        yield crossed, "'input_low' must lie below 'input_high' for every input"


class GainParams(Record):
    """Gains of a PID controller, one a control loop."""

    proportional: Annotated[Vector, Leaf("input/output")]
    integral: Annotated[Vector, Leaf("input/(output time)")]
    derivative: Annotated[Vector, Leaf("input time/output")]

    def _rules(self) -> Rules:
        yield from self._lengths(len(self.proportional), "integral", "derivative")


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

    def _rules(self) -> Rules:
        ordered = self.std_low <= self.initial_std <= self.std_high and self.std_low != self.std_high
        yield not ordered, "expected std_low <= initial_std <= std_high and std_low < std_high"


class PolicyParams(ExplorationParams):
    """The network and the distribution of the policy, Section 3.2."""

    hidden_cells: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("cells")]
    leaky_slope: Annotated[NotNegative, Leaf("-")]
    error_unit: Annotated[tuple[Positive, ...], Leaf(DEVIATION)]
    initial_output_scale: Annotated[Positive, Leaf("1/sqrt(cells)")]


class ScaleParams(Record):
    """How much is computed: the smoke run, the lesson or the paper's. Of online epochs the `online_share`, if there is one."""

    number_type: Annotated[Literal["float32", "float64"], Leaf("-")]
    threads: Annotated[Count, Leaf("threads")]
    demonstrations: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    episodes: Annotated[Count, Field(gt=1), Leaf("episodes")]
    measured: Annotated[Count, Field(gt=1), Leaf("episodes")]
    evaluation: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    expert_evaluation: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    epoch_share: Annotated[Share, Leaf("-")]
    online_share: Annotated[Share, Leaf("-")] | None = None

    def _rules(self) -> Rules:
        yield self.episodes + self.measured > EPISODES_PER_EPOCH, f"'episodes' and 'measured' exceed {EPISODES_PER_EPOCH} an epoch"


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
    critic: Annotated[NotNegative, Field(le=1), Leaf("share of the gradient")] = 0.0


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

    def _rules(self) -> Rules:
        yield not any(self.initial), "'initial' holds zeros only, which have no direction"


class VariantParams(Record):
    """One variant of Algorithms 1 and 2.

    Without `exploration` and `initial_output_scale` the policy is as its own parameters say. An epoch has the scale's episodes, or
    `episodes` if they are fewer.
    """

    learner: LearnerParams
    weights: WeightParams
    exploration: ExplorationParams | None = None
    initial_output_scale: Annotated[Positive, Leaf("1/sqrt(cells)")] | None = None
    episodes: Annotated[Count, Field(gt=1), Leaf("episodes")] | None = None


class TrialParams(Record):
    """params/trials.yaml: a trial of offline learning, as the changes that it makes to a variant.

    `learner` and `weights` hold the changed leaves as the file has them; `cases` is where `make evidence` runs it.
    """

    cases: Annotated[tuple[Count, ...], Field(min_length=1)] = (1, 3)
    base: Text
    title: Text
    family: Literal["step size", "weights", "kept policy", "entropy", "clipped ratio", "credit"]
    learner: dict[str, Any] = Field(default_factory=dict)
    weights: dict[str, Any] = Field(default_factory=dict)

    @property
    def changes(self) -> dict[str, dict[str, Any]]:
        """The changed leaves by part of a variant."""
        return {name: part for name in ("learner", "weights") if (part := getattr(self, name))}


class OnlineLearningParams(Record):
    """Algorithm 1 under the real objective."""

    episodes: Annotated[Count, Field(gt=1, le=EPISODES_PER_EPOCH), Leaf("episodes")]
    exploration: ExplorationParams
    from_scratch: ExplorationParams
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

    def _rules(self) -> Rules:
        most = max(learner.minibatches for learner in (self.online.learner, *(of.learner for of in self.variants.values())))
        yield most > self.fewest_episodes, f"'minibatches' exceeds the {self.fewest_episodes} episodes of a scale"


class OfflineParams(Record):
    """The offline half of a case study."""

    epochs: Annotated[Count, Leaf("epochs")]
    iterations: Annotated[Count, Leaf("iterations")]
    transfer_from: Annotated[Count, Leaf("case")] | None = None

    def _rules(self) -> Rules:
        yield self.iterations > self.epochs, "'iterations' exceeds 'epochs'"


class OnlineParams(Record):
    """The online half of a case study: rounds of epochs, each with its own beta."""

    epochs: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("epochs")]
    beta: Annotated[tuple[Positive, ...], Field(min_length=1), Leaf("-")]
    headline_beta: Annotated[Positive, Leaf("-")]

    def _rules(self) -> Rules:
        yield from self._lengths(len(self.epochs), "beta")


class CaseParams(Record):
    """params/case_<n>.yaml: Table 1 and the settings of one case study.

    `variants` holds the leaves in which a variant of learning.yaml differs in this case, as the file has them.
    """

    title: Annotated[Text, Leaf("-")]
    demonstrator: Annotated[Text, Leaf("-")]
    set_point: Annotated[Vector, Leaf(DEVIATION)]
    steady_state: Annotated[Vector, Leaf(DEVIATION)]
    error_scale: Annotated[tuple[NotZero, ...], Leaf(DEVIATION)] | None = None
    initial_mean: Annotated[Vector, Leaf(DEVIATION)]
    initial_std: Annotated[tuple[NotNegative, ...], Leaf(DEVIATION)]
    offline: OfflineParams
    online: OnlineParams
    variants: dict[Text, dict[Text, dict[str, Any]]] = Field(default_factory=dict, repr=False)

    def _rules(self) -> Rules:
        yield len(self.steady_state) != len(self.set_point), "'set_point' and 'steady_state' differ in length"
        equal = "'set_point' equals 'steady_state' in a loop, so the error has no scale: give 'error_scale'"
        yield not all(self.scale_of_error), equal
        yield from self._lengths(len(self.set_point), *([] if self.error_scale is None else ["error_scale"]))

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

    def _rules(self) -> Rules:
        yield from self._lengths(len(self.expert), "policy", "alpha")

    @property
    def feature_gap(self) -> float:
        """The paper's own feature gap: the mean of |v_pi - v_E| / |v_E| over its two printed rows."""
        pairs = list(zip(self.policy, self.expert, strict=True))
        return sum(abs(policy - expert) / abs(expert) for policy, expert in pairs) / len(pairs)


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
        check_length(path, key, value, expected)
    if n_manipulated != n_controlled:
        path = root / "process.yaml"
        raise ParameterError(f"{path}: key 'manipulated': a PID pairs {n_controlled} loops, found {n_manipulated} inputs")
    leaves = tuple(row for name in names for row in list_leaves(raw[name], name))
    trials, bases = load_trials(root), raw["learning.yaml"]["variants"]
    variants = {
        name: _variant(bases, name, changes, learning, case_file, f"variants.{name}") for name, changes in record.variants.items()
    }
    for name, trial in trials.items():
        if name in bases:
            path, known = root / "trials.yaml", ", ".join(bases)
            raise ParameterError(f"{path}: key '{name}': a trial needs a name other than those of the variants, {known}")
        variants[name] = _variant(bases, trial.base, trial.changes, learning, root / "trials.yaml", name, f"{name}.base")
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


def _variant(
    bases: Mapping[str, Any],
    name: str,
    changes: Mapping[str, Mapping[str, Any]],
    learning: LearningParams,
    path: Path,
    key: str,
    named: str | None = None,
) -> VariantParams:
    """What changes in a file make of a variant as learning.yaml has it; `named`: the key that names the variant, if not `key`."""
    if name not in bases:
        raise ParameterError(f"{path}: key '{named or key}': expected one of {', '.join(bases)}, found '{name}'")
    variant = validate(
        VariantParams, bases[name] | {part: bases[name].get(part, {}) | new for part, new in changes.items()}, path, key
    )
    if variant.learner.minibatches > learning.fewest_episodes:
        raise ParameterError(f"{path}: key '{key}.learner.minibatches': exceeds the {learning.fewest_episodes} episodes of a scale")
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
