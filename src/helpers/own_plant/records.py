"""A historian file read into one table of numbers, with what could not be read counted."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pandera.pandas as pa
import pyarrow as arrow
from pyarrow import csv, parquet

from helpers.own_plant.description import SECONDS, PlantDescription
from helpers.settings.leaf import InputError

FIRST_ROW = 2  # of the file: the first holds the names of the columns
SHOWN = 5  # rows named in a finding


class PlantDataError(InputError):
    """A record of a plant cannot be used; one sentence names the file, the column and the rows."""


@dataclass(frozen=True)
class Finding:
    """Something that a record suffers from.

    Attributes:
        check: what was looked for. column: where. count: how many rows have it. rows: the first of them, as rows of the file.
        rule: what was done about it.
    """

    check: str
    column: str
    count: int
    rows: tuple[int, ...]
    rule: str


def finding(check: str, column: str, rows: np.ndarray, rule: str) -> list[Finding]:
    """A finding about these rows of the file, or none if there are none."""
    return [Finding(check, column, len(rows), tuple(int(row) for row in rows[:SHOWN]), rule)] if len(rows) else []


def name_rows(rows: np.ndarray | tuple[int, ...]) -> str:
    """The first of some rows in words."""
    shown = ", ".join(str(row) for row in rows[:SHOWN])
    return f"row {shown}" if len(rows) == 1 else f"rows {shown}{' and more' if len(rows) > SHOWN else ''}"


@dataclass(frozen=True)
class Records:
    """The rows of a historian file in the order of time.

    Attributes:
        table: `row` (of the file), `clock` (time in samples since the first), `run` (changes with the episode column),
            `automatic`, and a column of numbers for each tag, nan where the file holds something else.
        findings: what the reading met with.
    """

    path: Path
    table: pd.DataFrame
    findings: tuple[Finding, ...]


def read_records(path: Path, description: PlantDescription) -> Records:
    """Read a CSV or Parquet file as its description says.

    Raises:
        PlantDataError: if the file or a column is missing, a column holds no number, or the time cannot be read.
    """
    raw = _read(path, description.columns)
    if not len(raw):
        raise PlantDataError(f"{path}: the file holds no rows")
    rows = np.arange(FIRST_ROW, FIRST_ROW + len(raw))
    found: list[Finding] = []
    columns: dict[str, np.ndarray] = {"row": rows.astype(np.int32), "clock": _clock(raw.pop(description.time), path, description)}
    columns["run"] = pd.factorize(raw.pop(description.episode))[0] if description.episode else np.zeros(len(raw), dtype=np.int32)
    known = raw.pop(description.mode).astype(str).isin(description.automatic) if description.mode else None
    columns["automatic"] = np.ones(len(raw), dtype=bool) if known is None else known.to_numpy(dtype=bool)
    for tag in list(raw):
        column = raw.pop(tag)
        numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        bad = ~np.isfinite(numbers)
        if bad.all():
            raise PlantDataError(f"{path}: column '{tag}': holds no number")
        numbers = np.where(bad, np.nan, numbers) if bad.any() else numbers
        found += finding("no number", tag, rows[bad], "missing")
        columns[tag] = numbers
    order = np.argsort(columns["clock"], kind="stable")
    late = np.flatnonzero(np.diff(columns["clock"]) < 0) + 1
    found += finding("out of order", description.time, rows[late], "sorted by time")
    if len(late):
        columns = {name: values[order] for name, values in columns.items()}
    columns["run"] = _changes(columns["run"])  # in the order of time: one late row must not cut its run into pieces
    table = pd.DataFrame(columns, copy=False)
    return Records(path, _schema(description).validate(table), tuple(found))


def _read(path: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    if not path.is_file():
        raise PlantDataError(f"{path}: the historian file is missing")
    try:
        if path.suffix == ".parquet":
            known = parquet.read_schema(path).names
        else:
            with csv.open_csv(path) as head:
                known = head.schema.names
        for column in columns:
            if column not in known:
                raise PlantDataError(f"{path}: there is no column '{column}'; the columns are {', '.join(known)}")
        if path.suffix == ".parquet":
            found = parquet.read_table(path, columns=list(columns))
        else:
            found = csv.read_csv(path, convert_options=csv.ConvertOptions(include_columns=list(columns)))
    except (arrow.ArrowInvalid, OSError) as error:
        words = " ".join(str(error).split())[:200]
        raise PlantDataError(f"{path}: not readable as {'Parquet' if path.suffix == '.parquet' else 'CSV'}: {words}") from error
    return found.to_pandas(types_mapper=pd.ArrowDtype, self_destruct=True)


def _clock(time: pd.Series, path: Path, description: PlantDescription) -> np.ndarray:
    """Time in samples since the first row: stamps with a date, or numbers in the unit of the description."""
    if not pd.api.types.is_numeric_dtype(time):
        known = time if pd.api.types.is_datetime64_any_dtype(time) else time.astype(str)
        stamps = pd.to_datetime(known, errors="coerce", utc=True)  # with or without a zone; a change of the clocks is no gap then
        seconds = stamps.astype("datetime64[ns, UTC]").astype("int64") / 1e9
        numbers = seconds.where(stamps.notna()).to_numpy(dtype=float, na_value=np.nan) / SECONDS[description.time_unit]
    else:
        numbers = time.to_numpy(dtype=float, na_value=np.nan)
    bad = np.flatnonzero(~np.isfinite(numbers)) + FIRST_ROW
    if len(bad):
        raise PlantDataError(f"{path}: column '{description.time}': no time in {name_rows(bad)}")
    return (numbers - numbers.min()) / description.sampling_time


def _changes(codes: np.ndarray) -> np.ndarray:
    """A number that goes up by one wherever the code of the episode changes."""
    return np.concatenate([[0], (np.diff(codes) != 0).cumsum()]).astype(np.int32)


def _schema(description: PlantDescription) -> pa.DataFrameSchema:
    """What the table must be, whatever the file was."""
    tags = set(description.columns) - {description.time, description.episode, description.mode}
    numbers = {tag: pa.Column(float, nullable=True) for tag in sorted(tags)}
    clock = pa.Column(float, pa.Check(lambda clock: clock.is_monotonic_increasing))
    return pa.DataFrameSchema(
        {
            "row": pa.Column("int32", unique=True),
            "clock": clock,
            "run": pa.Column("int32"),
            "automatic": pa.Column(bool),
            **numbers,
        },
        strict=True,
    )
