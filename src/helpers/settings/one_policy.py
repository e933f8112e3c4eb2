"""Validated, frozen records of params/one_policy.yaml: one policy for every set point of the paper's process."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from helpers.settings.leaf import Count, Leaf, Memory, NotNegative, Positive, Record, Share, Text, load_record
from helpers.settings.paper import Params


class EpisodeParams(Record):
    """What is drawn for each episode beside its set point."""

    near: Annotated[NotNegative, Field(le=1), Leaf("share")]
    margin: Annotated[Memory, Leaf("share of A and of B")]
    load: Annotated[NotNegative, Leaf("input range")]


class DescentParams(Record):
    """The gradient steps."""

    episodes: Annotated[Count, Leaf("episodes")]
    rate_start: Annotated[Share, Leaf("-")]
    rate_end: Annotated[Share, Leaf("-")]
    movement: Annotated[Positive, Leaf("movement of the record's controller")]
    kept: Annotated[Memory, Leaf("share")]


class HotStartParams(Record):
    """The comparison of starts."""

    first_beta: Annotated[Positive, Leaf("-")]
    share: Annotated[Share, Leaf("share of the steps")]
    level: Annotated[Share, Leaf("share of minimum variance")]


class OnePolicyScaleParams(Record):
    """How much of it is computed."""

    steps: Annotated[Count, Leaf("gradient steps")]
    start_steps: Annotated[Count, Leaf("gradient steps")]
    every: Annotated[Count, Leaf("gradient steps")]
    judged: Annotated[Count, Field(gt=1), Leaf("trajectories")]
    grid: Annotated[Count, Field(gt=1), Leaf("trajectories")]


class OnePolicyParams(Record):
    """params/one_policy.yaml."""

    episodes: EpisodeParams
    descent: DescentParams
    hot_start: HotStartParams
    scales: dict[Text, OnePolicyScaleParams]


def load_one_policy(root: Path, params: Params) -> OnePolicyParams:
    """The settings of notebook 09, from one_policy.yaml."""
    return load_record(OnePolicyParams, root / "one_policy.yaml", params.learning.scales)
