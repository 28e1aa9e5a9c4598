"""Guesses at the cause of wrong times, headers and numbers, as the ends of messages; empty where none is evident."""

from __future__ import annotations

import re
from collections.abc import Sequence

CLOCK_MARGIN = 5.0  # [s] by which a fix or a truth may lie outside the recording; chosen by hand
LARGEST_TIME_ZONE = 14.0  # [h]
FIRST_UNIX_TIME = 1e8  # [s] of the year 1973: smaller times count from the start of a recording
LAST_UNIX_TIME = 1e10  # [s] of the year 2286
DAY = 86_400.0  # [s]
UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}  # in which times are written, per second
NUMBER = re.compile(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?")


def clock_hint(found: tuple[float, float], expected: tuple[float, float]) -> str:
    """The likely cause of times that miss the recording, as the end of a message; empty if none is evident.

    found, expected: first and last time of the file and of the recording [s].
    """
    (first, last), (start, end) = found, expected
    offset = (first + last - start - end) / 2
    hours, open_ = round(offset / 1800) / 2, (end - start) / 2 + CLOCK_MARGIN
    direction = "late" if offset > 0 else "early"
    if 0 < abs(hours) <= LARGEST_TIME_ZONE and abs(offset - 3600 * hours) <= open_:
        inside = start - CLOCK_MARGIN <= first - 3600 * hours and last - 3600 * hours <= end + CLOCK_MARGIN
        return f" ({'exactly ' if inside else ''}{abs(hours):g} h {direction}: time zone?)"
    if end < FIRST_UNIX_TIME <= first < LAST_UNIX_TIME:
        return " (Unix times, while the recorder's clock counts from another moment?)"
    for unit, factor in UNITS.items():
        if start - CLOCK_MARGIN <= first / factor <= end + CLOCK_MARGIN:
            return f" ({unit}? seconds are expected)" if unit != "milliseconds" else " (milliseconds?)"
    if last < FIRST_UNIX_TIME <= start:
        return " (seconds from the start instead of the recorder's clock?)"
    days = round(offset / DAY)
    if days and abs(offset - DAY * days) <= open_ and min(first, start) > FIRST_UNIX_TIME:
        return f" (exactly {abs(days)} days {direction}: another date?)"
    return ""


def header_hint(header: Sequence[str], required: Sequence[Sequence[str]]) -> str:
    """The likely cause of a header without the columns that are expected. required: alternative sets of columns."""
    if all(NUMBER.fullmatch(name) for name in header):
        return " (is the header missing?)"
    if len(header) == 1 and len(header[0].split()) > 1:
        return " (columns between spaces? write commas)"
    if {"lng", "long", "latitude", "longitude"} & set(header):
        return " (lat and lon are the names of latitude and longitude)"
    if "accuracy" in header and any("sigma" in names for names in required):
        return " (sigma is a phone's accuracy divided by 1.51)"
    closest = min(required, key=lambda names: len(set(names) - set(header)))
    absent = [name for name in closest if name not in header]
    if len(absent) == len(closest):
        return ""
    return f" ({', '.join(absent)} {'is' if len(absent) == 1 else 'are'} missing)"


def number_hint(cell: str) -> str:
    """The likely cause of a cell that is no number."""
    if "°" in cell or re.fullmatch(r"[\d.]+\s*[NSEW]", cell):
        return " (degrees and minutes? write decimal degrees, south and west negative)"
    if re.fullmatch(r"[-+]?\d+(?:\.\d+)?\s*[a-zA-Z]+", cell):
        return " (a unit in the cell? write it nowhere)"
    if re.fullmatch(r"\d+,\d+", cell):
        return " (a decimal comma? write a point)"
    if re.fullmatch(r"\d{1,4}[./-]\d{1,2}[./-]\d{1,4}.*", cell) or re.fullmatch(r"\d{1,2}:\d{2}(:\d{2})?.*", cell):
        return " (a date or a clock time? write seconds or ISO 8601, 2024-05-01T12:00:00Z)"
    return ""
