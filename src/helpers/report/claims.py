"""The claims of the paper: what params/claims.yaml says decides about each, and the verdict over seeds.

The rule: a claim holds where the whole 95 % bootstrap interval of the median over seeds lies on the claimed side of the margin,
does not hold where no part of it does (two that tie are no better than each other), and cannot be told otherwise, or with fewer
than five seeds.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import numpy as np
import pandas as pd
from pydantic import Field, StringConstraints, model_validator

from helpers.report.statistics import FEWEST, median_interval
from helpers.runs.artifacts import Stage
from helpers.settings.leaf import Count, Real, Record, Text, read_yaml, refusal, validate

HOLDS, FAILS, OPEN, NOT_COMPARABLE = "holds", "does not hold", "cannot tell", "not comparable"
WITHOUT_RUNS = {"not_comparable": NOT_COMPARABLE, "by_definition": HOLDS}  # tests that no number decides
COLUMNS = ["id", "section", "statement", "case", "quantity", "n", "median", "ci_low", "ci_high"]
COLUMNS += ["test", "verdict", "reason", "changed"]
INDEX = ["case", "quantity"]
Reference = Annotated[str, StringConstraints(strict=True, pattern=r"^\w+/[\w:]+/[\w:\-]+$")]  # <stage>/<run>/<metric>
Dated = Annotated[str, StringConstraints(strict=True, pattern=r"^\d{4}-\d\d-\d\d: \S")]
TESTS = rf"^(value|difference|ratio)_(above|below)$|^({'|'.join(WITHOUT_RUNS)})$"


class Quantity(Record):
    """One number a seed and case, and the one it is compared with."""

    value: Reference
    against: Reference | None = None


class Claim(Record):
    """One checkable sentence of the paper, and what decides about it."""

    section: Text
    statement: Text
    cases: Annotated[tuple[Count, ...], Field(min_length=1)]
    test: Annotated[str, StringConstraints(strict=True, pattern=TESTS)]
    margin: Real | None = None
    why: Text
    quantities: dict[Text, Quantity] = Field(default_factory=dict)
    changed: Dated | None = None  # when and why the test was changed after results were known

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        needed = self.test not in WITHOUT_RUNS
        if {self.margin is not None, bool(self.quantities)} != {needed}:
            rule = "needs 'margin' and 'quantities'" if needed else "has neither 'margin' nor 'quantities'"
            raise refusal(f"the test '{self.test}' {rule}")
        for name, quantity in self.quantities.items():
            if (quantity.against is None) != self.test.startswith("value"):
                need = "needs no" if quantity.against else "needs an"
                raise refusal(f"the test '{self.test}' {need} 'against' in '{name}'")
        return self


def load_claims(root: Path) -> dict[str, Claim]:
    """The claims by id, from claims.yaml; raises ParameterError in one sentence."""
    path = root / "claims.yaml"
    return {name: validate(Claim, entry, path, name) for name, entry in read_yaml(path).items()}


def collect(claims: Mapping[str, Claim], stages: Mapping[tuple[int, int, str], Stage]) -> pd.DataFrame:
    """Every number that the claims refer to, by case and quantity (<stage>/<run>/<metric>), a column a seed; nan where not run."""
    pairs = ((claim.cases, quantity) for claim in claims.values() for quantity in claim.quantities.values())
    wanted = {(case, reference) for cases, quantity in pairs for case in cases for _, reference in quantity if reference}
    rows = [pd.DataFrame(columns=[*INDEX, "seed", "value"])]
    for (case, seed, name), stage in stages.items():
        scores = stage.table("scores.csv", ("stage", "metric", "value"))
        quantity = name + "/" + scores["stage"] + "/" + scores["metric"]
        rows.append(pd.DataFrame({"case": case, "quantity": quantity, "seed": seed, "value": scores["value"]}))
    table = pd.concat(rows, ignore_index=True).pivot_table(index=INDEX, columns="seed", values="value", aggfunc="first")
    return table[table.index.isin(wanted)].astype(float)


class Verdict(NamedTuple):
    """How a claim fared on one quantity: seeds, median and 95 % interval of what is compared with the margin, and the verdict."""

    verdict: str
    reason: str
    n: int = 0
    median: float = np.nan
    ci_low: float = np.nan
    ci_high: float = np.nan


def judge(claim: Claim, values: pd.DataFrame) -> Verdict:
    """The verdict on one quantity of a claim, from a row a seed: the columns `value` and, where two are compared, `against`."""
    kind, _, side = claim.test.partition("_")
    if claim.test in WITHOUT_RUNS:
        return Verdict(WITHOUT_RUNS[claim.test], claim.why)
    assert claim.margin is not None  # the record's own check
    compared = values["value"]
    if kind == "difference":
        compared = compared - values["against"]
    elif kind == "ratio":
        compared = compared / values["against"]
    found = compared[np.isfinite(compared)].to_numpy(dtype=float)
    if not len(found):
        return Verdict(OPEN, "not run")
    low, high = (float(end) for end in median_interval(found))
    ahead = sorted(end - claim.margin if side == "above" else claim.margin - end for end in (low, high))
    if len(found) < FEWEST:
        verdict, reason = OPEN, f"{len(found)} seed(s), fewer than {FEWEST}"
    elif ahead[0] > 0:
        verdict, reason = HOLDS, f"the whole interval lies {side} {claim.margin:g}"
    elif ahead[1] <= 0:
        tie = kind != "value" and low == high == claim.margin
        verdict, reason = FAILS, "a tie" if tie else f"no part of the interval lies {side} {claim.margin:g}"
    else:
        verdict, reason = OPEN, f"the interval holds {claim.margin:g}"
    return Verdict(verdict, reason, len(found), float(np.median(found)), low, high)


def verdicts(claims: Mapping[str, Claim], values: pd.DataFrame) -> pd.DataFrame:
    """All claims with the columns `COLUMNS`, a row for each case and quantity, in the order of the file.

    `values` are those of `collect`; median and interval are those of what the test compares with the margin.
    """
    rows = []
    for name, claim in claims.items():
        rule = claim.test.replace("_", " ") + ("" if claim.margin is None else f" {claim.margin:g}")
        words = {"id": name, "section": claim.section, "statement": claim.statement, "test": rule, "changed": claim.changed or ""}
        for case in claim.cases:
            quantities: list[tuple[str, Quantity | None]] = [*claim.quantities.items()] or [("", None)]
            for label, quantity in quantities:
                pair = {kind: values.reindex([(case, reference)]).iloc[0] for kind, reference in quantity or ()}
                verdict = judge(claim, pd.DataFrame(pair))
                rows.append(words | {"case": case, "quantity": label} | verdict._asdict())
    return pd.DataFrame(rows, columns=COLUMNS)
