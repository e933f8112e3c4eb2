"""What a record of a plant suffers from: found, named with its rows, repaired by a stated rule and counted, or refused."""

from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label, median_filter

from helpers.own_plant.description import PlantDescription, Variable
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
    record = _Examined(records, description, params)
    columns, breaks = record.columns, record.breaks
    valid = np.ones(len(breaks), dtype=bool)
    pulses = _pulses([columns[tag] for tag in (*(v.tag for v in description.manipulated), *description.set_point_tags)])
    for controlled in description.controlled:
        record.outside(controlled, 0.0)
        record.frozen(controlled.tag)
        record.spikes(controlled.tag, pulses)
        valid &= record.fill(controlled.tag, straight=True)
    for manipulated in description.manipulated:
        values, slack = columns[manipulated.tag], AT_BOUND * (manipulated.high - manipulated.low)
        record.outside(manipulated, slack)
        valid &= record.fill(manipulated.tag, straight=False)
        np.clip(values, manipulated.low, manipulated.high, out=values)
        at_bound = (values <= manipulated.low + slack) | (values >= manipulated.high - slack)
        record.note("input at a bound", manipulated.tag, at_bound, "kept: a controller may saturate")
    for tag in description.set_point_tags:
        valid &= record.fill(tag, straight=False)
        steps = np.flatnonzero((np.abs(np.diff(columns[tag])) > 0) & ~breaks[1:]) + 1
        record.note("set point step", tag, steps, "kept: an episode may begin here")
    if description.mode:
        record.note("not in automatic", description.mode, ~columns["automatic"], "kept for the model, not for episodes")
    record.excitation(valid)
    record.note("of no use", "all", ~valid, "left out: a stretch ends here")
    starts = valid & (~np.roll(valid, 1) | breaks)
    starts[0] = valid[0]
    columns["segment"] = np.where(valid, starts.cumsum() - 1, -1).astype(np.int32)
    return CleanRecords(pd.DataFrame(columns, copy=False), tuple(record.found))


class _Examined:
    """A record while it is repaired.

    Attributes:
        found: what was found so far. columns: in equal steps of time, by name; repaired in place. breaks: where a run begins.
    """

    def __init__(self, records: Records, description: PlantDescription, params: QualityParams) -> None:
        self.description, self.params, self.path = description, params, records.path
        self.found = list(records.findings)
        self.columns = self._regular(records.table)
        self.breaks = np.diff(self.columns["run"], prepend=self.columns["run"][:1]) != 0

    def note(self, check: str, column: str, where: NDArray, rule: str) -> None:
        """A finding about some samples, those left aside that were put in."""
        rows = self.columns["row"][where]
        self.found += finding(check, column, rows[rows > 0], rule)

    def _regular(self, table: pd.DataFrame) -> dict[str, NDArray]:
        """The columns in equal steps of time: short gaps become missing samples, long ones a new run."""
        time, params = self.description.time, self.params
        where = f"{self.path}: column '{time}'"
        row, clock = table["row"].to_numpy(), table["clock"].to_numpy()
        step = np.diff(clock)
        if not (step > 0).any():
            raise PlantDataError(f"{where}: the time of all rows is the same")
        typical = float(np.median(step[step > 0]))
        if abs(typical - 1) > 0.02:
            unit, dt = self.description.time_unit, self.description.sampling_time
            raise PlantDataError(
                f"{where}: rows are {typical * dt:g} {unit} apart, but 'sampling_time' is {dt:g} {unit}: "
                f"the one or the other, or 'time_unit', is wrong"
            )
        keep = np.append(np.rint(step) > 0, True)  # of rows with the same time the last one counts
        if keep.mean() < MOST:
            raise PlantDataError(
                f"{where}: {100 * (1 - keep.mean()):.0f} % of the rows have the time of another one, the first is "
                f"{name_rows(row[~keep][:1])}; export the record with a finer time"
            )
        self.found += finding("doubled row", time, row[~keep], "the last one kept")
        later, step = row[keep][1:], np.diff(clock[keep])
        samples = np.rint(step).astype(np.int64)
        off = np.abs(step - samples) > params.jitter
        if off.mean() > params.outside:
            raise PlantDataError(
                f"{where}: {100 * off.mean():.0f} % of the rows lie between two samples, the first is "
                f"{name_rows(later[off][:1])}; export the record at its sampling time"
            )
        uneven = (np.abs(step - samples) > 0.01 * np.maximum(samples, 1)) & (samples == 1)
        long = samples > params.longest_repair + 1
        self.found += finding("uneven time", time, later[uneven], "moved to the nearest sample")
        self.found += finding("short gap", time, later[(samples > 1) & ~long], f"at most {params.longest_repair} samples put in")
        self.found += finding("long gap", time, later[long], "a stretch ends here")
        place = np.concatenate([[0], np.where(long, 1, samples).cumsum()])
        known, every = table[keep].drop(columns="clock").set_axis(place), np.arange(place[-1] + 1)
        regular = known.reindex(every)
        regular["row"] = known["row"].reindex(every, fill_value=0)
        held = known[["run", "automatic"]].reindex(every, method="ffill")
        regular["run"] = held["run"] + np.isin(every, place[1:][long]).cumsum(dtype=np.int32)
        regular["automatic"] = held["automatic"]
        return {name: values.to_numpy(copy=True) for name, values in regular.items()}

    def outside(self, variable: Variable, slack: float) -> None:
        """Values outside their range become missing; where many are, the unit is wrong."""
        tag, low, high = variable.tag, variable.low - slack, variable.high + slack
        values = self.columns[tag]
        outside = (values < low) | (values > high)
        share = outside.sum() / max(1, np.isfinite(values).sum())
        if share > self.params.outside:
            typical = float(np.nanmedian(values))
            guess = next((words for words, convert in CONVERSIONS.items() if low <= convert(typical) <= high), None)
            hint = f"; it looks like {guess}" if guess and not low <= typical <= high else ""
            rows = self.columns["row"][outside]
            raise PlantDataError(
                f"{self.path}: column '{tag}': {100 * share:.0f} % of the values lie outside {low:g} to {high:g} {variable.unit} "
                f"({name_rows(rows[rows > 0])}), their median is {typical:g}{hint}"
            )
        self.note("outside its range", tag, outside, "missing")
        values[outside] = np.nan

    def frozen(self, tag: str) -> None:
        """A sensor that repeats the very same value for long is frozen: all but the first become missing.

        Long is what chance would hardly bring about, given how often two values are the same elsewhere. A signal that stays the
        same as often as not is coarse, and one that hardly moved before is at rest: there a repetition says nothing.
        """
        values = self.columns[tag]
        move = np.abs(np.diff(values, prepend=np.nan))
        same, known = move == 0, np.isfinite(move)
        elsewhere = known & ~_long_runs(same, self.params.frozen - 1)
        share = float(np.clip(same[elsewhere].mean(), TINY, COARSE)) if elsewhere.any() else TINY
        least = max(self.params.frozen, 1 + int(np.ceil(np.log(BY_CHANCE / len(values)) / np.log(share))))
        equal = _long_runs(same, least - 1)
        at_rest = AT_REST * float(np.median(move[move > 0])) if (move > 0).any() else 0.0
        frozen = equal.copy()
        for (run,) in find_objects(label(equal)[0]):
            near = slice(max(0, run.start - BEFORE), run.start)
            before = move[near][known[near]]
            if share == COARSE or (len(before) and np.median(before) < at_rest):
                frozen[run] = False
            else:
                known[run] = False  # says nothing about what follows
        self.note("equal values", tag, equal & ~frozen, "kept: the signal is coarse or at rest")
        self.note("frozen sensor", tag, frozen, f"{least} or more equal values: all but the first missing")
        values[frozen] = np.nan

    def spikes(self, tag: str, pulses: Array) -> None:
        """A value that departs and returns at once is a spike.

        It sticks out of both neighbours by a multiple of the largest other move nearby and of a usual one: a step, a ramp, a peak,
        an oscillation and the toggling of the last digit move as much before or after. What a pulse of an input may have caused is
        none: a pulse over the whole range of the input moves the output over its whole range, spikes apart.
        """
        values, params = self.columns[tag], self.params
        known = np.flatnonzero(np.isfinite(values))
        if len(known) < max(SPIKE) + 2:
            return
        series, group = values[known], self.breaks.cumsum()[known]
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
        self.note("outlier", tag, known[spike], "missing")
        values[known[spike]] = np.nan

    def fill(self, tag: str, straight: bool) -> Mask:
        """Fill short stretches of missing values, measured ones on a straight line, others by the last value; True where one is."""
        values, group = self.columns[tag], self.breaks.cumsum()
        missing = np.isnan(values)
        known = np.flatnonzero(~missing)
        places = np.flatnonzero(missing & ~_long_runs(missing, self.params.longest_repair + 1))
        places = places[(places > known.min(initial=len(values))) & (places < known.max(initial=0))]
        after = np.searchsorted(known, places)
        before, after = known[after - 1], known[after]
        same = group[before] == group[after if straight else places]
        places, before, after = places[same], before[same], after[same]
        share = (places - before) / (after - before) if straight else np.zeros(len(places))
        values[places] = values[before] + share * (values[after] - values[before])
        self.note("filled", tag, before, f"{'on a straight line' if straight else 'by the last value'}, from the row before")
        return ~np.isnan(values)

    def excitation(self, valid: Mask) -> None:
        """Every input must move, and no two of them as one."""
        if not valid.any():
            raise PlantDataError(f"{self.path}: no row is complete")
        tags = [variable.tag for variable in self.description.manipulated]
        inputs = np.column_stack([self.columns[tag][valid] for tag in tags])
        spans = self.description.values("manipulated", "high") - self.description.values("manipulated", "low")
        for tag, share in zip(tags, inputs.std(0) / spans, strict=True):
            if share < self.params.least_movement:
                raise PlantDataError(
                    f"{self.path}: column '{tag}': too little excitation, its standard deviation is {100 * share:.2g} % of its "
                    f"range, so its effect cannot be identified"
                )
        pairs = np.triu(np.abs(np.atleast_2d(np.corrcoef(inputs, rowvar=False))), 1)
        if pairs.max() > self.params.collinear:
            one, other = (tags[index] for index in np.unravel_index(np.argmax(pairs), pairs.shape))
            raise PlantDataError(
                f"{self.path}: columns '{one}' and '{other}': the inputs move as one, so their effects cannot be told apart"
            )


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


def _long_runs(mask: Mask, least: int) -> Mask:
    """Where a mask is true for at least `least` samples in a row."""
    runs, _ = label(mask)
    return mask & (np.bincount(runs)[runs] >= least)
