"""What a record of a plant suffers from: found, named with its rows, repaired by a stated rule and counted, or refused."""

from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from helpers.own_plant.description import PlantDescription
from helpers.own_plant.records import Finding, PlantDataError, Records, finding, name_rows
from helpers.own_plant.settings import QualityParams

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
AT_BOUND = 1e-3  # of the range: as near to a bound as a rounded number may lie
MOST = 0.5  # share of rows with a time of their own: of two exports in one file half
COARSE = 1 / 3  # share of values that equal the one before, above which a signal is coarse
BY_CHANCE = 0.01  # runs of equal values that a record may hold by chance and that are taken for a frozen sensor
BEFORE, AT_REST = 10, 0.02  # moves before such a run, and how small their median is, as a share of the usual move, at rest
TINY = 1e-9
SPIKE = (1, 2)  # samples that a spike may last
NEARBY = 4  # moves before and after a spike that it is compared with
RESPONSE = 12  # samples in which an output answers a pulse of an input
CAUSED = 3.0  # how far a pulse may move an output beyond its share of the range
# What a number in the one unit is in the other: the usual mistakes.
CONVERSIONS = {
    "degrees Celsius for kelvin": lambda v: v + 273.15,
    "kelvin for degrees Celsius": lambda v: v - 273.15,
    "degrees Fahrenheit for degrees Celsius": lambda v: (v - 32) / 1.8,
    "degrees Fahrenheit for kelvin": lambda v: (v - 32) / 1.8 + 273.15,
    "a share for per cent": lambda v: v * 100,
    "per cent for a share": lambda v: v / 100,
    "a unit a thousand times larger": lambda v: v * 1000,
    "a unit a thousand times smaller": lambda v: v / 1000,
}


@dataclass(frozen=True)
class CleanRecords:
    """A record in equal steps of time.

    Attributes:
        table: the columns of `Records.table` and `segment`, which counts the stretches without a break; -1 where a row is of no
            use. `row` is 0 where a sample was put in.
        findings: everything found, that of the reading included.
    """

    table: pd.DataFrame
    findings: tuple[Finding, ...]

    def section(self) -> pd.DataFrame:
        """The findings as a table, a row each."""
        frame = pd.DataFrame([asdict(found) for found in self.findings], columns=["check", "column", "count", "rows", "rule"])
        return frame.assign(rows=[", ".join(map(str, rows)) for rows in frame["rows"]])


def examine(records: Records, description: PlantDescription, params: QualityParams) -> CleanRecords:
    """Look for everything that is wrong with a record and repair what can be repaired.

    Raises:
        PlantDataError: where no rule can help: another sampling time, another unit, an input that hardly moves.
    """
    found = list(records.findings)
    columns = _regular(records, description, params, found)
    row, breaks = columns["row"], np.diff(columns["run"], prepend=columns["run"][:1]) != 0
    valid = np.ones(len(row), dtype=bool)
    pulses = _pulses([columns[tag] for tag in (*(v.tag for v in description.manipulated), *description.set_point_tags)])
    for controlled in description.controlled:
        values = columns[controlled.tag]
        _outside(records, controlled.tag, values, (controlled.low, controlled.high), controlled.unit, row, params, found)
        _frozen(controlled.tag, values, row, params, found)
        _spikes(controlled.tag, values, breaks, pulses, row, params, found)
        valid &= _fill(controlled.tag, values, breaks, row, params, found, straight=True)
    for manipulated in description.manipulated:
        values, span = columns[manipulated.tag], manipulated.high - manipulated.low
        slack = AT_BOUND * span
        limits = (manipulated.low - slack, manipulated.high + slack)
        _outside(records, manipulated.tag, values, limits, manipulated.unit, row, params, found)
        valid &= _fill(manipulated.tag, values, breaks, row, params, found, straight=False)
        np.clip(values, manipulated.low, manipulated.high, out=values)
        at_bound = (values <= manipulated.low + slack) | (values >= manipulated.high - slack)
        found += finding("input at a bound", manipulated.tag, _rows(row, at_bound), "kept: a controller may saturate")
    for tag in description.set_point_tags:
        valid &= _fill(tag, columns[tag], breaks, row, params, found, straight=False)
        steps = np.flatnonzero((np.abs(np.diff(columns[tag])) > 0) & ~breaks[1:]) + 1
        found += finding("set point step", tag, row[steps], "kept: an episode may begin here")
    if description.mode:
        found += finding(
            "not in automatic", description.mode, _rows(row, ~columns["automatic"]), "kept for the model, not for episodes"
        )
    _excitation(records, description, columns, valid, params)
    found += finding("of no use", "all", _rows(row, ~valid), "left out: a stretch ends here")
    starts = valid & (~np.roll(valid, 1) | breaks)
    starts[0] = valid[0]
    columns["segment"] = np.where(valid, starts.cumsum() - 1, -1).astype(np.int32)
    return CleanRecords(pd.DataFrame(columns, copy=False), tuple(found))


def _rows(row: NDArray[np.int32], mask: Mask) -> NDArray[np.int32]:
    """The rows of the file behind some samples, without those that were put in."""
    rows = row[mask]
    return rows[rows > 0]


def _regular(records: Records, description: PlantDescription, params: QualityParams, found: list[Finding]) -> dict[str, NDArray]:
    """The columns in equal steps of time: short gaps become missing samples, long ones a new run."""
    table, path, time = records.table, records.path, description.time
    row, clock = table["row"].to_numpy(), table["clock"].to_numpy()
    step = np.diff(clock)
    if not (step > 0).any():
        raise PlantDataError(f"{path}: column '{time}': the time of all rows is the same")
    typical = float(np.median(step[step > 0]))
    if abs(typical - 1) > 0.02:
        unit, dt = description.time_unit, description.sampling_time
        raise PlantDataError(
            f"{path}: column '{time}': rows are {typical * dt:g} {unit} apart, but 'sampling_time' is {dt:g} {unit}: "
            f"the one or the other, or 'time_unit', is wrong"
        )
    samples = np.rint(step)
    keep = np.append(samples > 0, True)  # of rows with the same time the last one counts
    if keep.mean() < MOST:
        raise PlantDataError(
            f"{path}: column '{time}': {100 * (1 - keep.mean()):.0f} % of the rows have the time of another one, the first is "
            f"{name_rows(row[~keep][:1])}; export the record with a finer time"
        )
    found += finding("doubled row", time, row[~keep], "the last one kept")
    row, clock = row[keep], clock[keep]
    step = np.diff(clock)
    samples = np.rint(step).astype(np.int64)
    off = np.abs(step - samples) > params.jitter
    if off.mean() > params.outside:
        raise PlantDataError(
            f"{path}: column '{time}': {100 * off.mean():.0f} % of the rows lie between two samples, the first is "
            f"{name_rows(row[1:][off][:1])}; export the record at its sampling time"
        )
    uneven = (np.abs(step - samples) > 0.01 * np.maximum(samples, 1)) & (samples == 1)
    found += finding("uneven time", time, row[1:][uneven], "moved to the nearest sample")
    gap = samples > 1
    long = samples > params.longest_repair + 1
    found += finding("short gap", time, row[1:][gap & ~long], f"at most {params.longest_repair} samples put in")
    found += finding("long gap", time, row[1:][long], "a stretch ends here")
    place = np.concatenate([[0], np.where(long, 1, samples).cumsum()])
    length = int(place[-1]) + 1
    columns: dict[str, NDArray] = {}
    for name in table:
        values = table[name].to_numpy()[keep]
        if name == "clock":
            continue
        if name in ("run", "automatic"):
            columns[name] = values[np.searchsorted(place, np.arange(length), side="right") - 1]
        else:
            columns[name] = np.full(length, 0 if name == "row" else np.nan, dtype=values.dtype)
            columns[name][place] = values
    late = np.zeros(length, dtype=np.int32)
    late[place[1:][long]] = 1
    columns["run"] = columns["run"] + late.cumsum(dtype=np.int32)
    return columns


def _outside(
    records: Records, tag: str, values: Array, limits: tuple[float, float], unit: str, row: NDArray, params: QualityParams,
    found: list[Finding],
) -> None:  # fmt: skip
    """Values outside their range become missing; where many are, the unit is wrong."""
    low, high = limits
    outside = (values < low) | (values > high)
    share = outside.sum() / max(1, np.isfinite(values).sum())
    if share > params.outside:
        typical = float(np.nanmedian(values))
        guess = next((words for words, convert in CONVERSIONS.items() if low <= convert(typical) <= high), None)
        hint = f"; it looks like {guess}" if guess and not low <= typical <= high else ""
        raise PlantDataError(
            f"{records.path}: column '{tag}': {100 * share:.0f} % of the values lie outside {low:g} to {high:g} {unit} "
            f"({name_rows(_rows(row, outside))}), their median is {typical:g}{hint}"
        )
    found += finding("outside its range", tag, _rows(row, outside), "missing")
    values[outside] = np.nan


def _frozen(tag: str, values: Array, row: NDArray, params: QualityParams, found: list[Finding]) -> None:
    """A sensor that repeats the very same value for long is frozen: all but the first become missing.

    Long is what chance would hardly bring about, given how often two values are the same elsewhere. A signal that stays the same as
    often as not is coarse, and one that hardly moved before is at rest: there a repetition says nothing.
    """
    move = np.abs(np.diff(values, prepend=np.nan))
    same, known = move == 0, np.isfinite(move)
    elsewhere = known & ~_long_runs(same, params.frozen - 1)
    share = float(np.clip(same[elsewhere].mean(), TINY, COARSE)) if elsewhere.any() else TINY
    least = max(params.frozen, 1 + int(np.ceil(np.log(BY_CHANCE / len(values)) / np.log(share))))
    frozen = _long_runs(same, least - 1)
    at_rest = AT_REST * float(np.median(move[move > 0])) if (move > 0).any() else 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], frozen, [False]]).astype(np.int8)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        near = slice(max(0, first - BEFORE), first)
        before = move[near][known[near]]
        if share == COARSE or (len(before) and np.median(before) < at_rest):
            frozen[first:last] = False
        else:
            known[first:last] = False  # says nothing about what follows
    equal = _long_runs(same, least - 1) & ~frozen
    found += finding("equal values", tag, _rows(row, equal), "kept: the signal is coarse or at rest")
    found += finding("frozen sensor", tag, _rows(row, frozen), f"{least} or more equal values: all but the first missing")
    values[frozen] = np.nan


def _spikes(
    tag: str, values: Array, breaks: Mask, pulses: Array, row: NDArray, params: QualityParams, found: list[Finding]
) -> None:  # fmt: skip
    """A value that departs and returns at once is a spike.

    It sticks out of both neighbours by a multiple of the largest other move nearby and of a usual one: a step, a ramp, a peak,
    an oscillation and the toggling of the last digit move as much before or after. What a pulse of an input may have caused is
    none: a pulse over the whole range of the input moves the output over its whole range, spikes apart.
    """
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < max(SPIKE) + 2:
        return
    series, group = values[known], breaks.cumsum()[known]
    move = np.abs(np.diff(series))
    moves = move[move > 0]
    usual = np.median(moves) if len(moves) else np.inf  # of a coarse signal one step of its resolution
    largest = sliding_window_view(np.pad(move, NEARBY), NEARBY).max(1)  # [i]: of the moves from sample i - NEARBY to sample i
    caused = CAUSED * np.ptp(median_filter(series, size=2 * max(SPIKE) + 1, mode="nearest")) * pulses[known]
    spike = np.zeros(len(known), dtype=bool)
    for width in SPIKE:
        sticks_out = _sticks_out(series, width)
        left = np.arange(len(sticks_out))
        right = left + width + 1
        other = np.maximum.reduce([largest[left], largest[right + NEARBY], np.abs(series[right] - series[left])])
        near = (group[left] == group[right]) & (known[right] - known[left] <= width + 1 + params.longest_repair)
        far = near & (sticks_out > params.outlier * np.maximum(other, usual)) & (sticks_out > caused[left + 1])
        for inside in range(1, width + 1):
            spike[left[far] + inside] = True
    found += finding("outlier", tag, row[known[spike]], "missing")
    values[known[spike]] = np.nan


def _pulses(inputs: list[Array]) -> Array:
    """The largest short pulse of an input or a set point in the samples before each sample, as a share of its range, (n,)."""
    size = np.zeros(len(inputs[0]) + RESPONSE)
    for values in inputs:
        span = np.nanmax(values) - np.nanmin(values)
        for width in SPIKE:
            share = np.nan_to_num(_sticks_out(values, width) / (span or 1.0))
            for inside in range(width):
                part = size[RESPONSE + 1 + inside :][: len(share)]
                np.maximum(part, share, out=part)
    return sliding_window_view(size, RESPONSE)[:-1].max(1)


def _sticks_out(values: Array, width: int) -> Array:
    """By how much samples i + 1 to i + `width` all lie above, or all below, both samples i and i + `width` + 1; for every i."""
    if len(values) < width + 2:
        return np.zeros(0)
    inside = sliding_window_view(values[1:-1], width)
    left, right = values[: -width - 1], values[width + 1 :]
    return np.maximum(inside.min(1) - np.maximum(left, right), np.minimum(left, right) - inside.max(1))


def _fill(tag: str, values: Array, breaks: Mask, row: NDArray, params: QualityParams, found: list[Finding], straight: bool) -> Mask:
    """Fill short stretches of missing values, measured ones on a straight line, others by the last value; True where one is."""
    missing = np.isnan(values)
    if not missing.any():
        return np.ones(len(values), dtype=bool)
    short = missing & ~_long_runs(missing, params.longest_repair + 1)
    known = np.flatnonzero(~missing)
    inner = short & (np.arange(len(values)) > known[0]) & (np.arange(len(values)) < known[-1])
    places = np.flatnonzero(inner)
    before = known[np.searchsorted(known, places) - 1]
    after = known[np.searchsorted(known, places)]
    group = breaks.cumsum()
    same = group[before] == group[after] if straight else group[before] == group[places]
    places, before, after = places[same], before[same], after[same]
    share = (places - before) / (after - before) if straight else np.zeros(len(places))
    values[places] = values[before] + share * (values[after] - values[before])
    rule = "on a straight line" if straight else "by the last value"
    found += (
        [Finding("filled", tag, len(places), tuple(int(r) for r in row[before[:5]]), f"{rule}, from the row before")]
        if len(places)
        else []
    )
    return ~np.isnan(values)


def _long_runs(mask: Mask, least: int) -> Mask:
    """Where a mask is true for at least `least` samples in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    long = last - first >= least
    change = np.zeros(len(mask) + 1, dtype=np.int32)
    change[first[long]] += 1
    change[last[long]] -= 1
    return change.cumsum()[:-1].astype(bool)


def _excitation(
    records: Records, description: PlantDescription, columns: dict[str, NDArray], valid: Mask, params: QualityParams
) -> None:
    """Every input must move, and no two of them as one."""
    if not valid.any():
        raise PlantDataError(f"{records.path}: no row is complete")
    inputs = np.column_stack([columns[variable.tag][valid] for variable in description.manipulated])
    spans = np.array([variable.high - variable.low for variable in description.manipulated])
    spread = inputs.std(0) / spans
    for variable, share in zip(description.manipulated, spread, strict=True):
        if share < params.least_movement:
            raise PlantDataError(
                f"{records.path}: column '{variable.tag}': too little excitation, its standard deviation is {100 * share:.2g} % "
                f"of its range, so its effect cannot be identified"
            )
    correlation = np.abs(np.corrcoef(inputs, rowvar=False)) if inputs.shape[1] > 1 else np.zeros((1, 1))
    first, second = np.unravel_index(np.argmax(np.triu(correlation, 1)), correlation.shape)
    if correlation.ndim and np.triu(correlation, 1).max() > params.collinear:
        one, other = (description.manipulated[index].tag for index in (int(first), int(second)))
        raise PlantDataError(
            f"{records.path}: columns '{one}' and '{other}': the inputs move as one, so their effects cannot be told apart"
        )
