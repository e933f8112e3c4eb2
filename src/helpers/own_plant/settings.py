"""Settings of the path from a historian file to a controller: params/own_plant.yaml."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, Strict

from helpers.settings.leaf import Count, Leaf, Positive, Record, Share, read_yaml, validate


class QualityParams(Record):
    """When a record of a plant is repaired, left out or refused."""

    longest_repair: Annotated[Count, Leaf("samples")]
    frozen: Annotated[Count, Leaf("samples")]
    outlier: Annotated[Positive, Leaf("largest move nearby")]
    outside: Annotated[Share, Leaf("share")]
    jitter: Annotated[Positive, Field(lt=0.5), Leaf("sampling time")]
    least_movement: Annotated[Share, Leaf("input range")]
    collinear: Annotated[Share, Leaf("-")]
    fewest_episodes: Annotated[Count, Leaf("episodes")]
    set_point_band: Annotated[Share, Leaf("error scale")]


class PlantIdentificationParams(Record):
    """How a model is identified and judged."""

    held_out: Annotated[Positive, Field(lt=1), Leaf("share")]
    orders: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("-")]
    longest_dead_time: Annotated[Count, Leaf("samples")]
    longest: Annotated[Count, Leaf("samples")]
    members: Annotated[Count, Leaf("models")]
    white: Annotated[Share, Leaf("-")]
    white_lags: Annotated[Count, Leaf("samples")]
    least_fit: Annotated[Share, Leaf("share")]


class MarginParams(Record):
    """How far the plant may be from its model beyond what its record leaves open."""

    gain: Annotated[Share, Leaf("share")]
    time: Annotated[Share, Leaf("share")]
    dead_time: Annotated[int, Strict(), Field(ge=0), Leaf("samples")]


class OperationParams(Record):
    """What the episodes are like that controllers are trained and judged on."""

    still: Annotated[Share, Leaf("share")]
    reserve: Annotated[Share, Leaf("input range")]
    load: Annotated[Share, Leaf("input range")]
    samples: Annotated[tuple[Count, Count], Leaf("samples")]


class RivalParams(Record):
    """How the rivals are tuned."""

    episodes: Annotated[Count, Leaf("episodes")]
    generations: Annotated[Count, Leaf("generations")]
    population: Annotated[Count, Leaf("candidates")]
    response: Annotated[Count, Leaf("samples")]
    horizon: Annotated[Count, Leaf("samples")]
    penalties: Annotated[tuple[Positive, ...], Field(min_length=1), Leaf("-")]
    observer: Annotated[tuple[Share, ...], Field(min_length=1), Leaf("-")]


class PlantPolicyParams(Record):
    """How the policy for a whole range learns through the model."""

    models: Annotated[Count, Leaf("models")]
    episodes: Annotated[Count, Leaf("episodes")]
    steps: Annotated[Count, Leaf("gradient steps")]
    movement: Annotated[Positive, Leaf("movement of the record's controller")]


class GateParams(Record):
    """What a controller must show on models held out before it is released."""

    models: Annotated[Count, Leaf("models")]
    episodes: Annotated[Count, Leaf("episodes")]
    corner_episodes: Annotated[Count, Field(gt=1), Leaf("episodes")]
    better: Annotated[Share, Leaf("share")]
    offset: Annotated[Share, Leaf("range of the set points")]
    close: Annotated[Share, Leaf("share")]


class PlantOnlineParams(Record):
    """The few episodes of the plant itself, where something stands for it."""

    explore: Annotated[Count, Leaf("episodes")]
    test: Annotated[Count, Leaf("episodes")]
    disturbance: Annotated[Share, Leaf("input range")]
    worse: Annotated[Share, Leaf("share")]
    level: Annotated[Share, Leaf("-")]


class PlantLearningParams(Record):
    """How long the paper's offline learning lasts."""

    offline_epochs: Annotated[Count, Leaf("epochs")]
    error_unit: Annotated[Positive, Leaf("error scale")]


class OwnPlantParams(Record):
    """params/own_plant.yaml."""

    quality: QualityParams
    identification: PlantIdentificationParams
    margins: MarginParams
    operation: OperationParams
    rivals: RivalParams
    policy: PlantPolicyParams
    gate: GateParams
    online: PlantOnlineParams
    learning: PlantLearningParams


def load_own_plant(root: Path) -> OwnPlantParams:
    """The settings from a folder of parameter files."""
    path = root / "own_plant.yaml"
    return validate(OwnPlantParams, read_yaml(path), path)
