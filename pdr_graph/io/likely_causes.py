"""Guesses at what is wrong with an input: times, headers, numbers, and files that no reader takes for a recording."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

from pdr_graph.io.source import Source
from pdr_graph.types import DAY_LENGTH

CLOCK_MARGIN = 5.0  # [s] by which a fix or a truth may lie outside the recording; chosen by hand
FIRST_UNIX_TIME = 1e8  # [s] of the year 1973: smaller times count from the start of a recording
NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"


def clock_hint(found: tuple[float, float], expected: tuple[float, float]) -> str:
    """The likely cause of times that miss the recording, as the end of a message; empty if none is evident.

    found, expected: first and last time of the file and of the recording [s].
    """
    (first, last), (start, end) = found, expected
    offset = (first + last - start - end) / 2
    hours, open_ = round(offset / 1800) / 2, (end - start) / 2 + CLOCK_MARGIN
    direction = "late" if offset > 0 else "early"
    if 0 < abs(hours) <= 14.0 and abs(offset - 3600 * hours) <= open_:  # largest time zone [h]
        inside = start - CLOCK_MARGIN <= first - 3600 * hours and last - 3600 * hours <= end + CLOCK_MARGIN
        return f" ({'exactly ' if inside else ''}{abs(hours):g} h {direction}: time zone?)"
    if end < FIRST_UNIX_TIME <= first < 1e10:  # last unix time [s] of the year 2286
        return " (Unix times, while the recorder's clock counts from another moment?)"
    for unit, factor in {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}.items():
        if start - CLOCK_MARGIN <= first / factor <= end + CLOCK_MARGIN:
            return f" ({unit}? seconds are expected)" if unit != "milliseconds" else " (milliseconds?)"
    if last < FIRST_UNIX_TIME <= start:
        return " (seconds from the start instead of the recorder's clock?)"
    days = round(offset / DAY_LENGTH)
    if days and abs(offset - DAY_LENGTH * days) <= open_ and min(first, start) > FIRST_UNIX_TIME:
        return f" (exactly {abs(days)} days {direction}: another date?)"
    return ""


def header_hint(header: Sequence[str], required: Sequence[Sequence[str]]) -> str:
    """The likely cause of a header without the columns that are expected. required: alternative sets of columns."""
    if all(re.fullmatch(NUMBER, name) for name in header):
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


QUOTED = 80  # characters of a file's header that are quoted
AN_ARCHIVE = "a zip, a folder or a file (unpack it, or pack it again as zip)"
A_RECORDING = "a recording (is this a floor plan? --map takes it)"
# First bytes of a file: what it is, what to do
MARKS: tuple[tuple[bytes, str, str], ...] = (
    (b"Rar!", "a RAR archive", AN_ARCHIVE),
    (b"7z\xbc\xaf", "a 7z archive", AN_ARCHIVE),
    (b"\x1f\x8b", "a gzip archive", AN_ARCHIVE),
    (b"BZh", "a bzip2 archive", AN_ARCHIVE),
    (b"SQLite format 3", "a database of SQLite", "a recording (is this a lifelog? pdr-graph lifelog show)"),
    (b"\xff\xd8\xff", "a JPEG picture", A_RECORDING),
    (b"\x89PNG", "a PNG picture", A_RECORDING),
    (b"%PDF", "a PDF", A_RECORDING),
    (b"\xd0\xcf\x11\xe0", "an old Excel file", "CSV: save each table as CSV"),
)


def description(source: Source, readers: str) -> tuple[str, str]:
    """What was found in the files, and what is expected. readers: names of all recorders."""
    expected = f"a recording of a supported recorder: {readers}"
    names = source.names
    if not names:
        return "an empty folder", expected
    if source.single is None:
        if "summary.json" in names and "trajectory.csv" in names:
            return "a result of pdr-graph", "the recording that it was made from"
        if "[Content_Types].xml" in names and any(name.startswith("xl/") for name in names):
            return "an Excel file", "CSV: save each table as CSV, or export CSV from the app"
        kinds = sorted({PurePosixPath(name).suffix or "no ending" for name in names})
        return f"{len(names)} files ({', '.join(kinds[:4])}), {', '.join(names[:3])[:QUOTED]}", expected
    head = source.head(source.single)
    if not head.strip(b"\0"):
        return ("an empty file" if not head else "bytes that are all 0", expected)
    for mark, name, instead in MARKS:
        if head.startswith(mark):
            return name, instead
    text = head.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    if text[:200].lower().startswith(("<!doctype html", "<html")):
        return "a web page (was the download a login page or a message?)", expected
    if text.startswith("{") and ('"FeatureCollection"' in text or '"features"' in text):
        return "GeoJSON", A_RECORDING
    if text.lower().startswith("<?xml") or text.startswith("<"):
        return f"XML of another kind, {text[:QUOTED]!r}", expected
    if "\ufffd" in text[:200] or "\0" in text[:200]:
        return f"the bytes {head[:24]!r}", expected
    first = text.split("\n", 1)[0].strip()
    ending = " named .zip" if source.path.suffix.lower() == ".zip" else ""
    names = {cell.strip().strip('"').lower() for cell in re.split(r"[,;\t]", first)}
    if len(names) < 2 or all(re.fullmatch(NUMBER, name) for name in names):
        return f"a text{ending} that begins with {first[:QUOTED]!r}", expected
    if "time" in names and ({"x", "y"} <= names or {"lat", "lon"} <= names):
        if "sigma" in names:
            expected = "a recording (are these fixes? smooth RECORDING --fixes takes them)"
        elif "z" not in names:
            expected = "a recording (is this a trajectory? evaluate and --truth take it)"
    elif any(name.startswith(("time", "seconds")) for name in names):
        header = "Time (s),X (m/s^2),Y (m/s^2),Z (m/s^2)"
        expected = f"a recording; a table of an accelerometer has phyphox's header: {header}"
    return f"a text{ending} with the header {first[:QUOTED]}", expected
