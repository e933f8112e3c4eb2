"""Validated, frozen records of params/search.yaml: the search for settings of the printed algorithms."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, Strict

from helpers.settings.leaf import Count, Leaf, Positive, Record, Share, Text, Vector, load_record, refusal


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] >= ends[1]:
        raise refusal("expected the lower end first")
    return ends


Ends = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]


class RangeParams(Record):
    """What is searched: between two ends, evenly in the logarithm, or one of several."""

    learning_rate: Annotated[Ends, Leaf("-")]
    weight_step: Annotated[Ends, Leaf("-")]
    episodes: Annotated[Ends, Leaf("episodes")]
    std_high: Annotated[Ends, Leaf("input range")]
    std_share: Annotated[Ends, Leaf("share of the way")]
    output_scale: Annotated[Ends, Leaf("1/sqrt(cells)")]
    patience: Annotated[tuple[Annotated[int, Strict(), Field(ge=0)], ...], Field(min_length=1), Leaf("epochs")]
    initial: Annotated[tuple[Vector, ...], Field(min_length=1), Leaf("-")]


class SettingParams(Record):
    """One setting, by the names of `RangeParams`."""

    learning_rate: Annotated[Share, Leaf("-")]
    weight_step: Annotated[Positive, Leaf("-")]
    episodes: Annotated[Count, Leaf("episodes")]
    std_high: Annotated[Share, Leaf("input range")]
    std_share: Annotated[Share, Leaf("share of the way")]
    output_scale: Annotated[Positive, Leaf("1/sqrt(cells)")]
    patience: Annotated[int, Strict(), Field(ge=0), Leaf("epochs")]
    initial: Annotated[Vector, Field(min_length=3, max_length=3), Leaf("-")]


class SearchScaleParams(Record):
    """How much is searched: settings for one seed, the best for a few, the `last` of them for all; and the sample of weights.

    `last` has an entry a case; of further cases the final one holds.
    """

    settings: Annotated[Count, Leaf("settings")]
    finalists: Annotated[Count, Leaf("settings")]
    finalist_seeds: Annotated[Count, Leaf("seeds")]
    last: Annotated[tuple[Count, ...], Field(min_length=1), Leaf("settings")]
    seeds: Annotated[Count, Leaf("seeds")]
    batches: Annotated[Count, Leaf("batches")]
    anywhere: Annotated[Count, Leaf("weights a batch")]
    near: Annotated[Count, Leaf("weights a batch")]
    steps: Annotated[Count, Leaf("gradient steps")]
    episodes: Annotated[Count, Leaf("episodes")]


class PrintedSearchParams(Record):
    """params/search.yaml."""

    ranges: RangeParams
    by_hand: SettingParams
    scales: dict[Text, SearchScaleParams]


def load_search(root: Path) -> PrintedSearchParams:
    """The settings of the search, from search.yaml."""
    return load_record(PrintedSearchParams, root / "search.yaml")
