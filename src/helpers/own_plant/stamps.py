"""Time stamps as seconds: whichever of day and month comes first, with a date or without."""

import re

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pandas.tseries.api import guess_datetime_format

from helpers.settings.leaf import InputError

Array = NDArray[np.float64]
FIRST_ROW = 2  # of the file: the first holds the names of the columns
DAY, HOUR = 86_400.0, 3_600.0
ABOUT_A_DAY = 12 * HOUR  # a clock that goes back by more has passed midnight
LATE = HOUR  # and one that goes back by less shows a late row
CLEARLY = 0.5  # an order of day and month is taken whose steps are that much more equal than those of any other
DATE = r"(?P<a>\d{1,4})[./-](?P<b>\d{1,2})[./-](?P<c>\d{1,4})"
CLOCK = r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}(?:[.,]\d+)?))?\s*(?P<half>[AaPp])?(?:\.?[Mm]\.?)?"
STAMP = rf"^\s*(?:{DATE})?[T,\s]*(?:{CLOCK})?\s*(?:Z|UTC|GMT|(?P<ahead>[+-]\d{{2}}):?(?P<zone>\d{{2}}))?\s*$"
ORDERS = {"day first": ("c", "b", "a"), "month first": ("c", "a", "b"), "year first": ("a", "b", "c")}  # year, month, day


def seconds(stamps: pd.Series, time_format: str | None) -> Array:
    """Seconds since some moment, (n,), nan where a stamp cannot be read.

    Args:
        stamps: times of day, dates with times of day, or words for either. time_format: as in strptime; found if None.

    Raises:
        InputError: if day and month cannot be told apart, or a clock without a date goes back for another reason than midnight.
    """
    if time_format is not None:
        try:
            found = _instants(pd.to_datetime(stamps.astype(str), format=time_format, errors="coerce", utc=True))
        except ValueError as error:
            raise InputError(f"the 'time_format' {time_format} is none: {error}") from error
        return found if re.search("%[cdDFjxsUuVwW]", time_format) else _past_midnight(found)
    if pd.api.types.is_datetime64_any_dtype(stamps):
        return _instants(pd.to_datetime(stamps, utc=True))  # with or without a zone; a change of the clocks is no gap then
    words = stamps.astype(str)
    found = _instants(pd.to_datetime(words, format="ISO8601", errors="coerce", utc=True))
    if np.isfinite(found).all():
        return found
    parts = words.astype(object).str.extract(STAMP)
    if parts["b"].notna().any():
        return _dated(parts) + _of_day(parts)
    if parts["hour"].notna().any():
        return _past_midnight(_of_day(parts))
    months = words.where(words.str.contains("[A-Za-z]{3}") & ~words.str.contains(r"\d[./-]\d"))  # in words, so that none is guessed
    form = guess_datetime_format(str(months.iloc[0])) or "mixed"
    return _instants(pd.to_datetime(months, format=form, errors="coerce", utc=True))


def _instants(stamps: pd.Series) -> Array:
    numbers = stamps.astype("datetime64[us, UTC]").astype("int64") / 1e6
    return numbers.where(stamps.notna()).to_numpy(dtype=float, na_value=np.nan)


def _of_day(parts: pd.DataFrame) -> Array:
    """Seconds since midnight, in UTC where a zone is named; midnight itself where a stamp is a date alone."""
    hour, minute = (pd.to_numeric(parts[key]).to_numpy(dtype=float) for key in ("hour", "minute"))
    second = pd.to_numeric(parts["second"].str.replace(",", ".")).fillna(0.0).to_numpy(dtype=float)
    half = parts["half"].str.lower()
    hour = np.where(half.isna(), hour, hour % 12 + 12 * (half == "p"))
    within = (hour < 24) & (minute < 60) & (second < 61)
    ahead = pd.to_numeric(parts["ahead"] + parts["zone"]).fillna(0).to_numpy(dtype=float)  # of UTC, +0530
    ahead = np.copysign(HOUR * (abs(ahead) // 100) + 60 * (abs(ahead) % 100), ahead)
    whole = np.where(within, HOUR * hour + 60 * minute + second - ahead, np.nan)
    return np.where(parts["hour"].isna() & parts["b"].notna(), 0.0, whole)


def _dated(parts: pd.DataFrame) -> Array:
    """Seconds to the midnight before each stamp, for the one order of day and month that fits every row and steps evenly."""
    numbers = {key: pd.to_numeric(parts[key]) for key in "abc"}
    years = parts["a"].str.len().max() == 4
    found: dict[str, Array] = {}
    for order, (year, month, day) in ORDERS.items():
        if (order == "year first") != years:
            continue
        date = pd.DataFrame({"year": numbers[year], "month": numbers[month], "day": numbers[day]})
        date["year"] += 2000 * (date["year"] < 100)
        found[order] = _instants(pd.to_datetime(date, errors="coerce", utc=True))
    most = max(np.isfinite(dates).sum() for dates in found.values())
    dates, *others = [dates for dates in found.values() if np.isfinite(dates).sum() == most]
    if not others or not most:
        return dates
    time = _of_day(parts)
    uneven = [_unevenness(one + time) for one in (dates, others[0])]
    if np.nanmax(dates - others[0]) > np.nanmin(dates - others[0]) and not min(uneven) < CLEARLY * max(uneven):
        raise InputError("the stamps read as well with the day first as with the month first: say which by the key 'time_format'")
    return dates if uneven[0] <= uneven[1] else others[0]


def _unevenness(time: Array) -> float:
    step = np.diff(time[np.isfinite(time)])
    return float(np.abs(step - np.median(step)).sum()) if len(step) else 0.0


def _past_midnight(time: Array) -> Array:
    """A clock without a date: where it goes back by about a day a new day begins.

    Raises:
        InputError: if it goes back by hours.
    """
    step = np.diff(time, prepend=time[:1])
    back = np.flatnonzero((step < -LATE) & (step > -ABOUT_A_DAY))
    if len(back):
        raise InputError(
            f"the clock shows no date and goes back by {-step[back[0]] / HOUR:.1f} h in row {back[0] + FIRST_ROW}: "
            f"export the record with dates"
        )
    days = np.cumsum((step <= -ABOUT_A_DAY).astype(float) - (step >= DAY - LATE))  # a late row may stand beyond midnight
    return time + DAY * days
