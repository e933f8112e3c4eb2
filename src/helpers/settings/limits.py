"""Validated, frozen records of params/limits.yaml: what is attainable, and the alternatives."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, Strict

from helpers.settings.leaf import (
    Count,
    Leaf,
    Memory,
    NotNegative,
    ParameterError,
    Positive,
    Record,
    Rules,
    Share,
    Text,
    load_record,
)
from helpers.settings.paper import Params

Several = Field(min_length=1)


class AttainableParams(Record):
    """The dynamic programme."""

    margin: Annotated[NotNegative, Leaf("share of the range")]
    nodes: Annotated[Count, Leaf("nodes")]
    tolerance: Annotated[Positive, Leaf("-")]


class PredictiveParams(Record):
    """The predictive controller."""

    horizon: Annotated[Count, Leaf("samples")]
    move_penalty: Annotated[Positive, Leaf("-")]
    disturbance_std: Annotated[Positive, Leaf("share of the process noise")]


class LibraryParams(Record):
    """A learner of a library."""

    passes: Annotated[Count, Leaf("per batch")]
    minibatches: Annotated[Count, Leaf("per pass")]
    learning_rate: Annotated[Share, Leaf("-")]
    gae_decay: Annotated[Memory, Leaf("-")]
    initial_std: Annotated[Positive, Leaf("input range")]
    network: Annotated[tuple[Count, ...], Several, Leaf("cells")]


class TuningParams(Record):
    """Tuning the gains of a PID, or a network that schedules them, on the real objective."""

    episodes: Annotated[Count, Leaf("episodes a candidate")]
    initial_step: Annotated[Positive, Leaf("ln of the gains")]
    integral_factors: Annotated[tuple[Positive, ...], Several, Leaf("share of the integral action")]
    cells: Annotated[Count, Leaf("cells")]
    derivative_unit: Annotated[Positive, Leaf("proportional gain times sampling time")]


class DenseParams(Record):
    """The denser reward with which learning from scratch begins."""

    beta: Annotated[Positive, Leaf("-")]
    share: Annotated[Memory, Leaf("share of the episodes")]


class QualityParams(Record):
    """The figures of control quality."""

    n_last: Annotated[Count, Leaf("samples")]
    bands: Annotated[tuple[Positive, ...], Several, Leaf("share of the set point change")]
    worst: Annotated[Share, Leaf("share of the trajectories")]
    order: Annotated[Count, Leaf("samples")]


class RobustnessParams(Record):
    """Plants and set points that no learning has seen."""

    state_factors: Annotated[tuple[Positive, ...], Several, Leaf("share of A")]
    input_factors: Annotated[tuple[Positive, ...], Several, Leaf("share of B")]
    disturbance_factors: Annotated[tuple[NotNegative, ...], Several, Leaf("share of the disturbance")]
    noise_factors: Annotated[tuple[NotNegative, ...], Several, Leaf("share of the observation noise")]
    set_point_factors: Annotated[tuple[Positive, ...], Several, Leaf("share of the set point")]
    dead_time: Annotated[Count, Leaf("samples")]
    load: Annotated[NotNegative, Leaf("share of the set point change per sample")]
    improve_state: Annotated[tuple[Positive, ...], Several, Leaf("share of A")]
    improve_input: Annotated[tuple[Positive, ...], Several, Leaf("share of B")]

    def _rules(self) -> Rules:
        yield len(self.improve_state) != len(self.improve_input), "'improve_state' and 'improve_input' differ in length"


class LimitsScaleParams(Record):
    """How much of it is computed."""

    draws: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    states: Annotated[tuple[Annotated[Count, Field(gt=4)], ...], Several, Leaf("grid points a state")]
    inputs: Annotated[tuple[Annotated[Count, Field(gt=2)], ...], Several, Leaf("values an input")]
    episodes: Annotated[Count, Leaf("episodes")]
    listed: Annotated[tuple[Annotated[int, Strict(), Field(ge=0)], ...], Several, Leaf("episodes")]
    every: Annotated[Count, Leaf("episodes")]
    judged: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    at_rest: Annotated[Count, Field(gt=1), Leaf("samples")]
    grid: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    corners: Annotated[bool, Strict(), Leaf("-")]
    library: Annotated[bool, Strict(), Leaf("-")]

    def _rules(self) -> Rules:
        yield len(self.states) != len(self.inputs), "'states' and 'inputs' differ in length"
        beyond = any(number > self.episodes or number % self.every for number in self.listed)
        yield beyond, "'listed' must hold multiples of 'every' up to 'episodes'"


class LimitsParams(Record):
    """params/limits.yaml; `seeds`: how many, from the first on, notebook 06 is run for, whatever the number of the others."""

    seeds: Annotated[Count, Leaf("seeds")]
    attainable: AttainableParams
    predictive: PredictiveParams
    ppo: LibraryParams
    recurrent_ppo: LibraryParams
    tuning: TuningParams
    dense: DenseParams
    quality: QualityParams
    robustness: RobustnessParams
    scales: dict[Text, LimitsScaleParams]


def load_limits(root: Path, params: Params) -> LimitsParams:
    """The settings of notebook 06, from limits.yaml, for the process and the scales of a case."""
    path = root / "limits.yaml"
    record = load_record(LimitsParams, path, params.learning.scales)
    for name, scale_params in record.scales.items():
        if record.quality.order >= scale_params.at_rest // 2:
            raise ParameterError(f"{path}: key 'quality.order': needs more than twice as many samples as 'scales.{name}.at_rest'")
    if record.quality.n_last > params.process.horizon:
        raise ParameterError(f"{path}: key 'quality.n_last': exceeds the horizon of {params.process.horizon} samples")
    return record
