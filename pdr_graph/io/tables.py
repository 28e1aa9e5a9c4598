"""Readers of tables: fixes, truth, trajectories (TUM's format too), beacons, anchors and ranges to these."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from pdr_graph.errors import InputError, expect
from pdr_graph.frames import Frame
from pdr_graph.geometry import wrap_angle
from pdr_graph.io import delimited
from pdr_graph.io.delimited import MISSING, Table, TextRows
from pdr_graph.io.signatures import FIX_FORMATS, function, recognized
from pdr_graph.io.source import Source
from pdr_graph.io.validation import MOST_SPEED, float_of, in_seconds, iso_time, isotropic
from pdr_graph.types import (
    DAY_LENGTH,
    FARTHEST,
    FINEST,
    LONLAT,
    Array,
    Beacons,
    Fixes,
    Mask,
    Ranges,
    Recording,
    Trajectory,
    UntimedFixes,
    minor_number,
)

if TYPE_CHECKING:
    from pdr_graph.floor.cells import Area
    from pdr_graph.floor.plan import FloorPlan


AN_EXCEL_FILE, AS_CSV = "an Excel file", "CSV: save each table as CSV, or export CSV from the app"
CLOCK_MARGIN = 5.0  # [s] by which a fix or a truth may lie outside the recording; chosen by hand
FIRST_UNIX_TIME = 1e8  # [s] of the year 1973: smaller times count from the start of a recording
NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"


def workbook_columns(path: Path) -> dict[str, Array]:
    """The columns of numbers of a workbook's first sheet, by name; NaN where a cell is empty.

    Raises InputError if the workbook is damaged.
    """
    try:
        from python_calamine import CalamineError, CalamineWorkbook
    except ImportError:
        expected = f"{AS_CSV} (a walk of RIDI: pip install '.[bench]' in a clone)"
        raise InputError(path, "", AN_EXCEL_FILE, expected) from None
    try:
        head, *rows = CalamineWorkbook.from_path(path).get_sheet_by_index(0).to_python() or [[]]
    except CalamineError:
        raise InputError(path, "", AN_EXCEL_FILE, AS_CSV) from None
    columns = zip(map(str, head), zip(*rows, strict=True), strict=True) if rows else ()
    return {
        name: np.array([float_of(cell) for cell in column])
        for name, column in columns
        if name and all(cell == "" or isinstance(cell, int | float) for cell in column)
    }


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
    if end < FIRST_UNIX_TIME <= first < 1e10:  # [s] until the year 2286
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


def read_fixes(
    path: str | Path, recording: Recording, frame: Frame | None = None, notes: list[str] | None = None
) -> Fixes:
    """Read position fixes from a table, a GPX track, a GeoLife ``.plt`` or a file of IPIN21's simulated fixes.

    A table has ``time,x,y,sigma[,floor][,source]`` in the output frame, or ``time,lat,lon,sigma[,floor][,source]``:
    time on the recorder's clock [s] or ISO 8601; sigma one standard deviation *per axis* [m] (a phone's 68 % radius
    divided by 1.51); source of each, if any. Rows may be in any order. The other formats have Unix times. frame: into
    which the fixes are transformed, None to keep theirs; notes: a list to which texts about omissions and assumptions
    are appended.

    Raises InputError naming the line; also if no fix lies within the recording, for example with another clock.
    """
    expect("read_fixes, path", path, str, Path)
    expect("read_fixes, recording", recording, Recording, instead="load(path)")
    expect("read_fixes, frame", frame, Frame, None, instead="FloorPlan.load(path).frame")
    path = Path(path)
    source, notes = _one_file(path), [] if notes is None else notes
    if (row := recognized(source, FIX_FORMATS)) is None:
        fixes = _tabular_fixes(path, recording)
        fixes = replace(fixes, time=fixes.time - recording.clock_origin)
    elif recording.epoch is not None:
        fixes = function(row.reader)(source, notes)
        fixes = replace(fixes, time=fixes.time - recording.epoch)
    else:
        raise InputError(path, "time", "Unix times", f"a recording with a clock: {recording.source} has none")
    check_clock(path, fixes.time, recording)
    return frame.place(fixes) if frame else fixes


def _tabular_fixes(path: Path, recording: Recording) -> Fixes:
    """Read the fixes of a table, sorted by time on the recorder's clock [s]."""
    required = [("time", "x", "y", "sigma"), ("time", "lat", "lon", "sigma")]
    optional = ("speed", "course")
    numbers, words = read_table(path, required, optional, words=("floor", "source"), recording=recording)
    geodetic = "lat" in numbers
    names = ("lon", "lat") if geodetic else ("x", "y")
    order = np.argsort(numbers["time"], kind="stable")
    position = np.stack([numbers[n] for n in names], axis=1)
    needed = f"a standard deviation of {FINEST:g} m or more"
    check_rows(path, numbers["sigma"] < FINEST, numbers["sigma"], "sigma", needed)
    if geodetic:
        check_geodetic(path, numbers)
    epsg = LONLAT if geodetic else None
    motion = {name: numbers[name] for name in optional if name in numbers}
    for name, most in (("speed", MOST_SPEED), ("course", 360.0)):
        values = motion.get(name, np.zeros(1))
        check_rows(path, (values < 0) | (values > most), values, name, f"0 to {most:.0f}, or an empty cell")
    if "course" in motion:
        motion["course"] = wrap_angle(np.pi / 2 - np.radians(motion["course"]))
    source = words["source"] if any(words["source"]) or "speed" not in motion else ()  # else that of `Fixes`
    return Fixes(numbers["time"], position, numbers["sigma"], words["floor"], epsg, source, **motion)[order]


def check_geodetic(path: str | Path, numbers: dict[str, Array]) -> None:
    """Raise InputError unless all latitudes are within ±90° and all longitudes within ±180°."""
    swapped = " (latitude and longitude swapped?)" if (np.abs(numbers["lon"]) <= 90).all() else ""
    check_rows(path, np.abs(numbers["lat"]) > 90, numbers["lat"], "lat", f"a latitude within ±90°{swapped}")
    check_rows(path, np.abs(numbers["lon"]) > 180, numbers["lon"], "lon", "a longitude within ±180°")


def read_trajectory(path: str | Path, recording: Recording | None = None, geodetic: bool = False) -> Trajectory:
    """Read a trajectory or truth ``time,x,y[,heading][,floor]``, or in TUM's format, rows in time order.

    recording: if given, times of the file are on its clock and the result counts from its start [s], as estimates do;
    else times are those of the file, Unix times also in ms, µs or ns. If `geodetic`, columns ``lat,lon`` are read
    instead of ``x,y`` where they are there.
    Covariance columns, as in ``trajectory.csv``, are read if they are all there; else ``sigma`` of the positions per
    axis [m], an empty cell as 0. Raises InputError naming the line.
    """
    expect("read_trajectory, recording", recording, Recording, None, instead="load(path)")
    source = _one_file(Path(path))
    if is_tum(text := source.text(source.single or "")):
        poses = read_tum(str(path), text)
        time = in_seconds(poses.time) if recording is None else poses.time - recording.clock_origin
        return replace(poses, time=time)
    optional = ("heading", "sigma_x", "sigma_y", "cov_xy", "sigma_heading")
    columns = [("time", "lat", "lon"), ("time", "x", "y")] if geodetic else [("time", "x", "y")]
    numbers, words = read_table(Path(path), columns, (*optional, "sigma"), ("floor",), recording)
    if on_earth := "lat" in numbers:
        check_geodetic(path, numbers)
    time = numbers["time"]
    back = np.diff(time, prepend=-np.inf) <= 0
    check_rows(path, back, time, "time", "times that increase from row to row")
    covariance = None
    if all(name in numbers for name in optional):
        covariance = np.zeros((len(time), 3, 3))
        for axis, name in enumerate(("sigma_x", "sigma_y", "sigma_heading")):
            covariance[:, axis, axis] = numbers[name] ** 2
        covariance[:, 0, 1] = covariance[:, 1, 0] = numbers["cov_xy"]
    elif "sigma" in numbers:
        covariance = isotropic(np.nan_to_num(numbers["sigma"]))
    return Trajectory(
        time=in_seconds(time) if recording is None else time - recording.clock_origin,
        position=np.stack([numbers[name] for name in (("lon", "lat") if on_earth else ("x", "y"))], axis=1),
        heading=numbers.get("heading", np.full(len(time), np.nan)),
        floor=words["floor"],
        covariance=covariance,
        epsg=LONLAT if on_earth else None,
    )


TIMES = ("time", "earliest", "latest")  # columns that may have ISO 8601
ALIASES = {"timestamp": "time", "yaw": "heading"}  # names in the PDR Benchmark's tools: ours


def read_table(
    path: Path,
    required: list[tuple[str, ...]],
    optional: tuple[str, ...] = (),
    words: tuple[str, ...] = (),
    recording: Recording | None = None,
    unknown: bool = False,
) -> tuple[dict[str, Array], dict[str, tuple[str, ...]]]:
    """Read columns of numbers ``(n,)`` and of texts by name from a table with a header.

    required: alternative sets of columns, of which the first complete one is read; words: columns of text. Empty cells
    are allowed in optional columns (NaN) and in columns of text only; unknown: also in required ones of a row. Times
    may be ISO 8601: they become seconds on the clock of `recording`, without one Unix times.

    Raises InputError naming the line.
    """
    source = _one_file(path)
    table = delimited.table(str(path), source.text(source.single or ""))
    header = [ALIASES.get(name.lower(), name.lower()) for name in table.header]
    present = next((names for names in required if set(names) <= set(header)), None)
    if present is None:
        found = f"{','.join(header)[:60]}{header_hint(header, required)}"
        raise InputError(path, "line 1", found, "a header with " + " or ".join(",".join(r) for r in required))
    rows, width = table.rows, len(header)
    if not len(rows):
        raise InputError(path, "line 2", "the end of the file", "at least one row")
    for number, line in zip(rows.numbers, rows.lines, strict=True):  # more from decimal commas, fewer if cut off
        if line.count(rows.delimiter) != width - 1 and (found := len(delimited.split(line, rows.delimiter))) != width:
            raise InputError(path, f"line {number}", f"{found} fields", f"{width} as in the header")
    names = [*present, *(name for name in optional if name in header)]
    dated = {name: _iso_times(path, table, header.index(name), recording) for name in names if name in TIMES}
    times = {name: time for name, time in dated.items() if time is not None}
    plain = [name for name in names if name not in times]
    for name in plain:
        cell = table.rows.words(header.index(name))[0]
        if cell.lower() not in MISSING and np.isnan(float_of(cell)):  # in the first row, with the likely cause
            found = f"{cell[:40]!r}{number_hint(cell)}"
            raise InputError(path, f"line {table.rows.numbers[0]}, {name}", found, "a number")
    values = table.rows.floats([header.index(name) for name in plain], cut_off_allowed=False)
    numbers = dict(zip(plain, values.T, strict=True)) | times
    cells = [rows.words(header.index(name)) for name in present if unknown]
    blank = np.all([[not cell for cell in column] for column in cells], axis=0) if cells else np.zeros(len(rows), bool)
    for name in present:
        for row in np.flatnonzero(np.isnan(numbers[name]) & ~blank)[:1]:
            cell = table.rows.words(header.index(name))[row]
            raise InputError(path, f"line {table.rows.numbers[row]}, {name}", repr(cell[:40]), "a finite number")
    for name in {"x", "y"}.intersection(present):
        check_rows(path, np.abs(numbers[name]) > FARTHEST, numbers[name], name, f"a place within {FARTHEST:.0e} m")
    empty = ("",) * len(values)
    return numbers, {w: tuple(table.rows.words(header.index(w))) if w in header else empty for w in words}


def _iso_times(path: Path, table: Table, column: int, recording: Recording | None) -> Array | None:
    """A column of ISO 8601 times as seconds on the recorder's clock ``(n,)``; None if its first cell is none.

    Empty cells are NaN where the column is optional. Raises InputError naming the line, or if the recording has no
    clock.
    """
    cells = table.rows.words(column)
    empty = np.array([table.header[column].lower() != "time" and cell.lower() in MISSING for cell in cells])
    first = next((cell for cell, missing in zip(cells, empty, strict=True) if not missing), "")
    if np.isnan(iso_time(first)) or not np.isnan(float_of(first)):
        return None
    times = np.array([np.nan if missing else iso_time(cell) for cell, missing in zip(cells, empty, strict=True)])
    for row in np.flatnonzero(np.isnan(times) & ~empty)[:1]:
        expected = "ISO 8601 as in the first row, 2024-05-01T12:00:00Z"
        raise InputError(path, f"line {table.rows.numbers[row]}, time", repr(cells[row][:40]), expected)
    if recording is None:
        return times
    if recording.epoch is None:
        expected = f"seconds of the recorder's clock: {recording.source} does not state its date"
        raise InputError(path, f"line {table.rows.numbers[0]}, time", repr(cells[0][:40]), expected)
    return times - recording.epoch + recording.clock_origin


def _one_file(path: Path) -> Source:
    """The source of a path; raises InputError unless it is one file."""
    if not path.exists():
        raise InputError(path, "", "no such file", "a table, a GPX track or a GeoLife file")
    source = Source(path)
    if source.single is None:
        raise InputError(path, "", f"{len(source.names)} files", "one file")
    return source


def check_rows(path: str | Path, wrong: Mask, values: Array, name: str, expected: str) -> None:
    """Raise InputError at the first row that is wrong."""
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(path, f"data row {row + 1}, {name}", f"{values[row]:.15g}", expected)


def check_clock(path: str | Path, time: Array, recording: Recording, span: tuple[float, float] | None = None) -> None:
    """Raise InputError unless at least one time ``(n,)`` [s] lies within the recording or CLOCK_MARGIN of it.

    span: first and last time of the recording [s], by default of its sensors.
    """
    signals = list(recording.signals.values())
    if span is None and not signals:
        return
    start, end = span or (float(min(s.time[0] for s in signals)), float(max(s.time[-1] for s in signals)))
    if not ((time >= start - CLOCK_MARGIN) & (time <= end + CLOCK_MARGIN)).any():
        span = time.min() + recording.clock_origin, time.max() + recording.clock_origin
        expected = start + recording.clock_origin, end + recording.clock_origin
        found = f"{span[0]:.3f} to {span[1]:.3f}{clock_hint(span, expected)}"
        raise InputError(path, "time", found, f"times within the recording, {expected[0]:.3f} to {expected[1]:.3f}")


COLUMNS = 8
TUM_CELL = rf"(?:{NUMBER}|[-+]?(?i:nan|inf))"  # lost tracking is nan
TUM_ROW = re.compile(
    rf"(?:[ \t\r]*(?:#[^\n]*)?\n)*[ \t]*{NUMBER}(?:[ \t]+{TUM_CELL}){{{COLUMNS - 1}}}[ \t\r]*(?:\n|\Z)"
)


def is_tum(text: str) -> bool:
    """True if the first line that is no comment has eight numbers between spaces."""
    return TUM_ROW.match(text) is not None


def read_tum(where: str, text: str) -> Trajectory:
    """The poses of a text; heading is the rotation about z [rad], NaN if no row has a rotation.

    where: name of the file in messages. Raises InputError naming the line.
    """
    lines = [" ".join(line.split()) for line in text.splitlines()]
    numbers = [n for n, line in enumerate(lines, 1) if line and not line.startswith("#")]
    table = TextRows.of(where, [lines[n - 1] for n in numbers], numbers, " ").floats(range(COLUMNS), False)
    wrong = np.flatnonzero(~np.isfinite(table[:, :3]).all(axis=1))
    if len(wrong):
        found = f"{lines[numbers[wrong[0]] - 1][:60]!r}"
        raise InputError(where, f"line {numbers[wrong[0]]}", found, "time x y z qx qy qz qw: leave out rows of nan")
    back = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(back):
        row = int(back[0]) + 1
        found = f"{table[row, 0]:.6f} after {table[row - 1, 0]:.6f}"
        raise InputError(where, f"line {numbers[row]}, time", found, "times that increase from row to row")
    x, y, z, w = table[:, 4:].T
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    if not np.nanmax(np.abs(table[:, 4:7]), initial=0.0) >= 1e-9:
        heading = np.full(len(table), np.nan)
    return Trajectory(table[:, 0], table[:, 1:3], heading, ("",) * len(table))


BEACON_LIST = "BLE_Locations.csv"  # the list that the organisers of IPIN competitions put in the folder of a log
SURVEY_SIGMA = 1.0  # [m] per axis, of a position without a stated sigma; chosen by hand


def beside(recording: Path) -> Path | None:
    """The path of the BEACON_LIST in the folder of a recording file; None without one."""
    path = recording.parent / BEACON_LIST
    return path if recording.is_file() and path.is_file() else None


def read_beacons(path: str | Path, recording: Recording | None = None, unstated: float = SURVEY_SIGMA) -> Beacons:
    """Read a table of beacons.

    Columns are ``beacon,x,y[,sigma][,floor]`` in the output frame, ``beacon,lat,lon[,sigma][,floor]``, or IPIN's
    ``bleID,Lat,Lon,floor``. ``beacon`` is the address as in the recording, or a name that ends in the minor number of
    an iBeacon, such as BLE3. Without a recording the names stay as in the list. unstated: sigma of places without a
    stated one [m]. A row without coordinates is a beacon whose place is unknown (NaN).

    Raises InputError naming the line.
    """
    required = [("x", "y"), ("lat", "lon")]
    texts = ("beacon", "bleid", "floor")
    numbers, words = read_table(Path(path), required, optional=("sigma",), words=texts, unknown=True)
    geodetic = "lat" in numbers
    if geodetic:
        check_geodetic(path, numbers)
    label = words["beacon"] if any(words["beacon"]) else words["bleid"]
    position = np.stack([numbers[n] for n in (("lon", "lat") if geodetic else ("x", "y"))], axis=1)
    sigma = np.nan_to_num(numbers.get("sigma", np.full(len(label), np.nan)), nan=unstated)
    before = set[str]()
    for n, name in enumerate(label):
        if not name or name in before:
            found = f"{name[:40]!r} twice" if name else "no name"
            raise InputError(path, f"data row {n + 1}", found, "one row for each beacon, with its name")
        before.add(name)
    epsg = LONLAT if geodetic else None
    # at least 1 mm per axis; chosen by hand
    return Beacons(_names(label, recording), position, np.maximum(sigma, 1e-3), words["floor"], label, epsg)


def drawn_beacons(
    drawn: Sequence[tuple[Area, str]], recording: Recording | None, unstated: float = SURVEY_SIGMA
) -> Beacons:
    """The beacons drawn in a plan, named by their id, mac, uuid or name. drawn: areas and the label of their floor."""
    names = ([a.properties.get(key) for key in ("id", "mac", "uuid")] for a, _ in drawn)
    label = tuple(str(next(filter(None, each), a.name)) for each, (a, _) in zip(names, drawn, strict=True))
    position = np.array([shapely.get_coordinates(area.shape).mean(axis=0) for area, _ in drawn])
    sigma = np.full(len(label), unstated)
    return Beacons(_names(label, recording), position, sigma, tuple(floor for _, floor in drawn), label)


def _names(label: Sequence[str], recording: Recording | None) -> tuple[str, ...]:
    """The transmitter in the recording for each label, by address or minor number; else the label itself."""
    received = None if recording is None else recording.bluetooth
    by_address, by_number = dict[str, str](), dict[str, str]()
    if received is not None:
        by_address = {name.lower(): name for name in received.transmitter}
        by_number = dict(zip(received.minor, received.transmitter, strict=False))
    return tuple(by_address.get(name.lower()) or by_number.get(minor_number(name), name) for name in label)


RANGE_SIGMA = 0.3  # [m] of a range with line of sight, if the table has no sigma; chosen by hand
ANCHOR_SIGMA = 0.1  # [m] per axis of an anchor's place whose list states none: tape or laser; chosen by hand
MAXIMUM_RANGE = 1000.0  # [m]; a larger distance is in other units


def read_ranges(path: Path, recording: Recording, anchors: Beacons) -> Ranges:
    """Read a table of ranges ``time,anchor,range[,sigma]``, sorted by time.

    time: on the recorder's clock [s]; anchor: a name in the list of anchors; range, sigma: [m]. anchors: in the frame
    of the walk. Raises InputError naming the row, also if no range lies within the recording.
    """
    numbers, words = read_table(path, [("time", "range")], optional=("sigma",), words=("anchor",), recording=recording)
    time, distance = numbers["time"] - recording.clock_origin, numbers["range"]
    sigma = np.nan_to_num(numbers.get("sigma", np.full(len(time), np.nan)), nan=RANGE_SIGMA)
    least_most = f"metres, from 0 to {MAXIMUM_RANGE:.0f}"
    check_rows(path, (distance < 0) | (distance > MAXIMUM_RANGE), distance, "range", least_most)
    check_rows(path, sigma <= 0, sigma, "sigma", "a standard deviation above 0 m")
    number = {label.lower(): m for m, label in enumerate(anchors.label)}
    anchor = np.array([number.get(name.lower(), -1) for name in words["anchor"]], dtype=np.intp)
    if (anchor < 0).any():
        unknown = words["anchor"][int(np.argmax(anchor < 0))]
        expected = f"one of {', '.join(anchors.label)[:80]}"
        raise InputError(path, f"data row {int(np.argmax(anchor < 0)) + 1}, anchor", f"{unknown[:40]!r}", expected)
    order = np.argsort(time, kind="stable")
    check_clock(path, time, recording)
    measured = time[order], anchor[order], distance[order], sigma[order]
    return Ranges(*measured, anchors.label, anchors.position, anchors.sigma)


VISIT_SIGMA = 1.0  # [m] per axis of a place without a size, if the table has no sigma; chosen by hand


def read_visited(path: Path, recording: Recording, floors: Sequence[FloorPlan] = ()) -> tuple[UntimedFixes, int | None]:
    """Read places that were visited at unknown times, and the projection of their positions.

    Columns are ``x,y`` in the output frame, ``lat,lon``, or ``place``, the name of an area of the plan; beside them
    ``place`` as a label, ``earliest``, ``latest`` on the recorder's clock [s] or ISO 8601, empty cells for the whole
    recording, and ``sigma`` per axis [m]. An area is uniform: its sigma per axis is that of a square of its size, and
    what is not walkable, as a shop, is visited at its nearest walkable point. floors: of the plan.

    Raises InputError naming the line; also for names that no area has, or several apart.
    """
    optional = ("earliest", "latest", "sigma")
    numbers, words = read_table(path, [("x", "y"), ("lat", "lon"), ()], optional, ("place",), recording)
    label, count = words["place"], len(words["place"])
    epsg, unstated = None, np.full(count, VISIT_SIGMA)
    if "lat" in numbers:
        check_geodetic(path, numbers)
        position, epsg = np.stack([numbers["lon"], numbers["lat"]], axis=1), LONLAT
    elif "x" in numbers:
        position = np.stack([numbers["x"], numbers["y"]], axis=1)
    elif not any(label):
        raise InputError(path, "line 1", "no place", "place (a name on the plan), x,y or lat,lon in each row")
    else:
        found = [named_area(path, row, name, floors) for row, name in enumerate(label)]
        position, unstated = np.array([place for place, _ in found]), np.array([sigma for _, sigma in found])
    sigma = numbers.get("sigma", np.full(count, np.nan))
    sigma = np.where(np.isnan(sigma), unstated, sigma)
    check_rows(path, sigma < FINEST, sigma, "sigma", f"a standard deviation of {FINEST:g} m or more")
    signals = list(recording.signals.values())
    span = (min(s.time[0] for s in signals), max(s.time[-1] for s in signals)) if signals else (0.0, DAY_LENGTH)
    time = np.empty((count, 2))
    for column, name in enumerate(("earliest", "latest")):
        given = numbers.get(name, np.full(count, np.nan)) - recording.clock_origin
        time[:, column] = np.where(np.isnan(given), span[column], given)
    for row in np.flatnonzero((time[:, 0] > span[1] + CLOCK_MARGIN) | (time[:, 1] < span[0] - CLOCK_MARGIN))[:1]:
        both = time[row] + recording.clock_origin
        begin, end = np.array(span) + recording.clock_origin
        found = f"{both[0]:.0f} to {both[1]:.0f}{clock_hint((both[0], both[1]), (begin, end))}"
        expected = f"times within the recording, {begin:.0f} to {end:.0f}, or a row less"
        raise InputError(path, f"data row {row + 1}, earliest", found, expected)
    check_rows(path, time[:, 0] > time[:, 1], time[:, 0] + recording.clock_origin, "earliest", "a time before latest")
    named = tuple(name or f"place {row + 1}" for row, name in enumerate(label))
    return UntimedFixes(time, position, sigma, named), epsg


def named_area(path: Path, row: int, name: str, floors: Sequence[FloorPlan]) -> tuple[Array, float]:
    """Position ``(2,)`` and sigma [m] of the area with a name, or of several that are parts of one."""
    wanted = name.strip().casefold()
    areas = [(floor, area) for floor in floors for area in floor.areas]
    found = [(floor, area) for floor, area in areas if area.name.strip().casefold() == wanted]
    where, place = f"data row {row + 1}, place", repr(name[:40])
    if not floors:
        raise InputError(path, where, place, "--map, a plan with the places' names; or x,y or lat,lon in each row")
    shapes = [area.shape for _, area in found]
    hull = shapely.convex_hull(shapely.union_all(shapes))
    parts = len({floor.label for floor, _ in found}) == 1 and shapely.area(hull) <= 2 * float(
        np.sum(shapely.area(shapes))
    )
    if not (len(found) == 1 or parts) or not wanted:
        names = list(dict.fromkeys(area.name for _, area in areas if area.name))
        alike = ", ".join(get_close_matches(name, names, 3, 0.4) or names[:3]) or "no area of the plan has one"
        several = f" of {len(found)} areas" if found else ""
        raise InputError(path, where, f"{place}{several}", f"the name of one area of the plan ({alike}), or x,y")
    middle = shapely.get_coordinates(shapely.point_on_surface(hull))[0]
    return found[0][0].nearest_walkable(middle), max(float(np.sqrt(shapely.area(hull) / 12)), VISIT_SIGMA)
