"""A historian file read into one table of numbers, with what could not be read counted."""

import codecs
import csv as text
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as arrow
from pyarrow import compute, csv, parquet

from helpers.own_plant.description import SECONDS, PlantDescription
from helpers.own_plant.stamps import FIRST_ROW, seconds
from helpers.settings.leaf import InputError

SHOWN = 5  # rows named in a finding
HEAD = 1 << 16  # characters of a CSV file that show how it is written
SEPARATORS = (",", ";", "\t", "|")
NAMES = {"\t": "tab"}


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
    raw = _read(path, description)
    if not len(raw):
        raise PlantDataError(f"{path}: the file holds no rows")
    rows = np.arange(FIRST_ROW, FIRST_ROW + len(raw), dtype=np.int32)
    found: list[Finding] = []
    columns: dict[str, np.ndarray] = {"row": rows, "clock": _clock(raw.pop(description.time), path, description)}
    columns["run"] = pd.factorize(raw.pop(description.episode))[0] if description.episode else np.zeros(len(raw), dtype=np.int32)
    known = raw.pop(description.mode).astype(str).isin(description.automatic) if description.mode else None
    columns["automatic"] = np.ones(len(raw), dtype=bool) if known is None else known.to_numpy(dtype=bool)
    for tag in list(raw):
        column = raw.pop(tag)
        numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
        bad = ~np.isfinite(numbers)
        if bad.all():
            shown = str(column.iloc[0])[:40]
            raise PlantDataError(f"{path}: column '{tag}': holds no number, the first is '{shown}' (keys 'separator', 'decimal')")
        numbers = np.where(bad, np.nan, numbers) if bad.any() else numbers
        found += finding("no number", tag, rows[bad], "missing")
        columns[tag] = numbers
    late = np.flatnonzero(np.diff(columns["clock"]) < 0) + 1
    found += finding("out of order", description.time, rows[late], "sorted by time")
    table = pd.DataFrame(columns, copy=False)
    if len(late):
        table = table.sort_values("clock", kind="stable", ignore_index=True)
    # Up by one wherever the episode changes, in the order of time: one late row must not cut its run into pieces.
    table["run"] = table["run"].diff().fillna(0).ne(0).cumsum().astype(np.int32)
    return Records(path, table, tuple(found))


def _read(path: Path, description: PlantDescription) -> pd.DataFrame:
    if not path.is_file():
        raise PlantDataError(f"{path}: the historian file is missing")
    columns, kind = list(description.columns), "Parquet" if path.suffix == ".parquet" else "CSV"
    try:
        if kind == "Parquet":
            _expect(columns, parquet.read_schema(path).names, path)
            found = parquet.read_table(path, columns=columns)
        else:
            found = _read_text(path, description, columns)
    except UnicodeError as error:
        raise PlantDataError(f"{path}: not readable by the 'encoding' {description.encoding}: {error}") from error
    except (arrow.ArrowInvalid, OSError) as error:
        words = " ".join(str(error).split())[:200]
        hint = "; the keys 'separator', 'decimal' and 'encoding' say what is not found right" if kind == "CSV" else ""
        raise PlantDataError(f"{path}: not readable as {kind}: {words}{hint}") from error
    return found.to_pandas(types_mapper=pd.ArrowDtype, self_destruct=True)


def _read_text(path: Path, description: PlantDescription, columns: list[str]) -> arrow.Table:
    """A CSV file, read as its description says, or else as its head shows."""
    encoding = description.encoding or _encoding(path)
    with path.open(encoding=encoding, newline="") as file:
        head = file.read(HEAD).removeprefix("\ufeff").splitlines() or [""]
    head = head[: max(1, len(head) - 1)]  # the last line may be cut
    separator: str | None = "\t" if description.separator == "tab" else description.separator
    separator = separator or max(SEPARATORS, key=lambda mark: len({*columns} & {*_cells(head[:1], mark)[0]}))
    decimal = description.decimal or _decimal(_cells(head, separator), description.tags)
    reading = csv.ReadOptions(encoding=encoding)
    parsing = csv.ParseOptions(delimiter=separator)
    with csv.open_csv(path, reading, parsing) as file:
        _expect(columns, file.schema.names, path, f", separated by {NAMES.get(separator, separator)!r} (key 'separator')")
    as_text = {description.time: arrow.string()} if description.time_format else {}
    options = csv.ConvertOptions(include_columns=columns, decimal_point=decimal, column_types=as_text)
    found = csv.read_csv(path, reading, parsing, options)
    if decimal == ",":  # a word among the numbers leaves them text
        for tag in description.tags:
            if arrow.types.is_string(found[tag].type):
                place = found.column_names.index(tag)
                found = found.set_column(place, tag, compute.replace_substring(found[tag], ",", "."))
    return found


def _expect(columns: list[str], known: list[str], path: Path, how: str = "") -> None:
    for column in columns:
        if column not in known:
            raise PlantDataError(f"{path}: there is no column '{column}'; the columns are {', '.join(known)}{how}")


def _encoding(path: Path) -> str:
    """UTF-8 or UTF-16 where the file is that throughout, and otherwise what Western European programs write."""
    with path.open("rb") as file:
        if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            return "utf-16"
    try:
        with path.open(encoding="utf-8") as words:
            while words.read(1 << 20):
                pass
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _cells(lines: list[str], separator: str) -> list[list[str]]:
    return list(text.reader(lines, delimiter=separator)) or [[]]


def _decimal(rows: list[list[str]], tags: tuple[str, ...]) -> str:
    """What stands before the decimals of most of the numbers."""
    places = [place for place, name in enumerate(rows[0]) if name in tags]
    cells = [row[place].strip() for row in rows[1:] for place in places if place < len(row)]
    marks = [found[1] for cell in cells if (found := re.fullmatch(r"[+-]?\d*([,.])\d+([eE][+-]?\d+)?", cell))]
    return "," if marks.count(",") > marks.count(".") else "."


def _clock(time: pd.Series, path: Path, description: PlantDescription) -> np.ndarray:
    """Time in samples since the first row: stamps, or numbers in the unit of the description."""
    where = f"{path}: column '{description.time}'"
    if pd.api.types.is_numeric_dtype(time) and not description.time_format:
        numbers = time.to_numpy(dtype=float, na_value=np.nan)
    else:
        try:
            numbers = seconds(time, description.time_format) / SECONDS[description.time_unit]
        except InputError as error:
            raise PlantDataError(f"{where}: {error}") from error
    bad = np.flatnonzero(~np.isfinite(numbers)) + FIRST_ROW
    if len(bad):
        how = f"of the 'time_format' {description.time_format}" if description.time_format else "(keys 'time_format', 'decimal')"
        raise PlantDataError(f"{where}: no time in {name_rows(bad)} {how}")
    return (numbers - numbers.min()) / description.sampling_time
