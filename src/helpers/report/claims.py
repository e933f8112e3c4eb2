"""The claims of the paper: what params/claims.yaml says decides about each, and the verdict over seeds.

The rule: a claim holds where the whole 95 % bootstrap interval of the median over seeds lies on the claimed side of the margin,
does not hold where no part of it does (two that tie are no better than each other), and cannot be told otherwise, or with fewer
than five seeds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import pandas as pd
from pydantic import Field, StringConstraints, model_validator

from helpers.report.statistics import FEWEST, median_interval
from helpers.runs.artifacts import RECORD, load_stage
from helpers.settings.leaf import Count, Real, Record, Text, read_yaml, refusal, validate

HOLDS, FAILS, OPEN, NOT_COMPARABLE = "holds", "does not hold", "cannot tell", "not comparable"
COLUMNS = ("id", "section", "statement", "case", "quantity", "n", "median", "ci_low", "ci_high", "test", "verdict", "reason")
Reference = Annotated[str, StringConstraints(strict=True, pattern=r"^\w+/[\w:]+/[\w:\-]+$")]  # <stage>/<run>/<metric>
Test = Literal["value_above", "value_below", "difference_above", "difference_below", "ratio_above", "ratio_below", "not_comparable"]


class Quantity(Record):
    """One number a seed and case, and the one it is compared with."""

    value: Reference
    against: Reference | None = None


class Claim(Record):
    """One checkable sentence of the paper, and what decides about it."""

    section: Text
    statement: Text
    cases: Annotated[tuple[Count, ...], Field(min_length=1)]
    test: Test
    margin: Real | None = None
    why: Text
    quantities: dict[Text, Quantity] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.test == "not_comparable":
            if self.margin is not None or self.quantities:
                raise refusal("a claim that is not comparable has neither 'margin' nor 'quantities'")
            return self
        if self.margin is None or not self.quantities:
            raise refusal(f"the test '{self.test}' needs 'margin' and 'quantities'")
        for name, quantity in self.quantities.items():
            if (quantity.against is None) != self.test.startswith("value"):
                need = "needs no" if quantity.against else "needs an"
                raise refusal(f"the test '{self.test}' {need} 'against' in '{name}'")
        return self


def load_claims(root: Path) -> dict[str, Claim]:
    """The claims by id, from claims.yaml; raises ParameterError in one sentence."""
    path = root / "claims.yaml"
    return {name: validate(Claim, entry, path, name) for name, entry in read_yaml(path).items()}


def collect(claims: Mapping[str, Claim], results: Path, scale: str, seeds: Sequence[int]) -> pd.DataFrame:
    """Every number that the claims refer to, from the scores.csv of each stage that was run.

    Returns:
        Columns quantity (<stage>/<run>/<metric>), case, seed, value; a row less where a stage or number is missing.

    Raises:
        ArtifactError: if a stage is damaged.
    """
    wanted = {
        (case, reference)
        for claim in claims.values()
        for case in claim.cases
        for quantity in claim.quantities.values()
        for reference in (quantity.value, quantity.against)
        if reference is not None
    }
    frames = []
    for case, name in sorted({(case, reference.split("/")[0]) for case, reference in wanted}):
        for seed in seeds:
            folder = results / scale / f"seed_{seed}" / f"case_{case}" / name
            if (folder / RECORD).is_file():
                scores = load_stage(folder, f"the stage '{name}'").table("scores.csv", ("stage", "metric", "value"))
                quantity = name + "/" + scores["stage"] + "/" + scores["metric"]
                kept = quantity.isin({reference for of_case, reference in wanted if of_case == case})
                frames.append(pd.DataFrame({"quantity": quantity, "case": case, "seed": seed, "value": scores["value"]})[kept])
    columns = ["quantity", "case", "seed", "value"]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)


@dataclass(frozen=True)
class Verdict:
    """How a claim fared on one quantity: seeds, median and 95 % interval of what is compared with the margin, and the verdict."""

    n: int
    median: float
    ci_low: float
    ci_high: float
    verdict: str
    reason: str


def judge(claim: Claim, values: pd.DataFrame) -> Verdict:
    """The verdict on one quantity of a claim in one case.

    Args:
        values: a row for each seed, with the columns `value` and, where the test compares two, `against`.
    """
    kind, _, side = claim.test.partition("_")
    if claim.test == "not_comparable":
        return Verdict(0, np.nan, np.nan, np.nan, NOT_COMPARABLE, claim.why)
    assert claim.margin is not None  # the record's own check
    compared = values["value"]
    if kind == "difference":
        compared = compared - values["against"]
    elif kind == "ratio":
        compared = compared / values["against"]
    found = compared[np.isfinite(compared)].to_numpy(dtype=float)
    if not len(found):
        return Verdict(0, np.nan, np.nan, np.nan, OPEN, "not run")
    low, high = (float(end) for end in median_interval(found))
    sign = 1 if side == "above" else -1
    nearest, farthest = (low, high) if side == "above" else (high, low)
    if len(found) < FEWEST:
        verdict, reason = OPEN, f"{len(found)} seed(s), fewer than {FEWEST}"
    elif sign * nearest > sign * claim.margin:
        verdict, reason = HOLDS, f"the whole interval lies {side} {claim.margin:g}"
    elif sign * farthest <= sign * claim.margin:
        tie = kind != "value" and low == high == claim.margin
        verdict, reason = FAILS, "a tie" if tie else f"no part of the interval lies {side} {claim.margin:g}"
    else:
        verdict, reason = OPEN, f"the interval holds {claim.margin:g}"
    return Verdict(len(found), float(np.median(found)), low, high, verdict, reason)


def verdicts(claims: Mapping[str, Claim], values: pd.DataFrame) -> pd.DataFrame:
    """All claims, a row for each case and quantity, in the order of the file.

    Args:
        values: as `collect` returns them.

    Returns:
        Columns `COLUMNS`; median and interval are those of what the test compares with the margin.
    """
    table = values.pivot_table(index=["case", "quantity"], columns="seed", values="value", aggfunc="first")
    rows = []
    for name, claim in claims.items():
        for case in claim.cases:
            quantities: list[tuple[str, Quantity | None]] = [*claim.quantities.items()] or [("", None)]
            for label, quantity in quantities:
                verdict = judge(claim, _paired(table, case, quantity))
                head = {"id": name, "section": claim.section, "statement": claim.statement, "case": case, "quantity": label}
                rows.append(head | asdict(verdict) | {"test": rule_in_words(claim)})
    return pd.DataFrame(rows, columns=list(COLUMNS))


def rule_in_words(claim: Claim) -> str:
    """The test and its margin: difference above 0."""
    words = claim.test.replace("_", " ")
    return words if claim.margin is None else f"{words} {claim.margin:g}"


def _paired(table: pd.DataFrame, case: int, quantity: Quantity | None) -> pd.DataFrame:
    """The values of a quantity by seed, beside what it is compared with; nan where they were not run."""
    names = ("value", "against")
    return pd.DataFrame({name: table.reindex([(case, getattr(quantity, name, None))]).iloc[0] for name in names})
