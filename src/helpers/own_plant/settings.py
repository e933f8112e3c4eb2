"""Settings of the path from a historian file to a controller: params/own_plant.yaml."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from helpers.settings.leaf import Count, Leaf, Positive, Record, Share, read_yaml, validate


class QualityParams(Record):
    """When a record of a plant is repaired, left out or refused."""

    longest_repair: Annotated[Count, Leaf("samples")]
    frozen: Annotated[Count, Leaf("samples")]
    outlier: Annotated[Positive, Leaf("95 % quantile")]
    outside: Annotated[Share, Leaf("share")]
    jitter: Annotated[Positive, Field(lt=0.5), Leaf("sampling time")]
    least_movement: Annotated[Share, Leaf("input range")]
    collinear: Annotated[Share, Leaf("-")]
    fewest_episodes: Annotated[Count, Leaf("episodes")]
    set_point_band: Annotated[Share, Leaf("error scale")]


class PlantIdentificationParams(Record):
    """How a model is identified and judged."""

    held_out: Annotated[Positive, Field(lt=1), Leaf("share")]
    lags: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("samples")]
    longest: Annotated[Count, Leaf("samples")]
    iterations: Annotated[Count, Leaf("iterations")]
    white: Annotated[Share, Leaf("-")]
    white_lags: Annotated[Count, Leaf("samples")]
    least_fit: Annotated[Share, Leaf("share")]


class PlantLearningParams(Record):
    """How long a policy learns."""

    offline_epochs: Annotated[Count, Leaf("epochs")]
    transfer_epochs: Annotated[Count, Leaf("epochs")]
    online_epochs: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("epochs")]
    online_beta: Annotated[tuple[Positive, ...], Field(min_length=1), Leaf("-")]
    error_unit: Annotated[Positive, Leaf("error scale")]


class OwnPlantParams(Record):
    """params/own_plant.yaml."""

    quality: QualityParams
    identification: PlantIdentificationParams
    learning: PlantLearningParams


def load_own_plant(root: Path) -> OwnPlantParams:
    """The settings from a folder of parameter files."""
    path = root / "own_plant.yaml"
    return validate(OwnPlantParams, read_yaml(path), path)
