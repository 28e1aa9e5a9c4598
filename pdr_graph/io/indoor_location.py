"""Recordings of the Indoor Location Competition 2.0 (Microsoft Research and XYZ10), Android.

One text file per walk: tab separated, ``#`` header lines first and an ``# endTime`` line last, Unix milliseconds in
the first column and a ``TYPE_…`` name in the second. Sensors are in Android units and axes. Rows of *different*
sensors are interleaved out of time order, rows of one sensor are in order; a file where they are not was damaged.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.types import Array, Recording, Signal, Trajectory

NAME = "Indoor Location Competition 2.0 (.txt)"
SENSORS = ("TYPE_ACCELEROMETER", "TYPE_GYROSCOPE", "TYPE_MAGNETIC_FIELD")
WAYPOINT = "TYPE_WAYPOINT"
Rows = list[tuple[int, str]]  # line numbers and lines


def recognizes(path: Path) -> bool:
    """True if the first lines look like this format."""
    if path.is_dir():
        return False
    with path.open("rb") as file:
        head = file.read(4096)
    return b"\tTYPE_" in head or head.startswith(b"#\tstartTime:")


def read(path: Path) -> Recording:
    """Read one walk. Waypoints become ``truth``: the surveyor's taps on the map, straight between them.

    Raises InputError naming the line if the file is cut off, shuffled, not text, or holds a value that is no number.
    """
    rows, note = _rows_by_kind(path, _lines(path))
    tables = {kind: _table(path, kind, numbered) for kind, numbered in rows.items()}
    starts = [tables[kind][0, 0] for kind in SENSORS if len(tables[kind])]
    if not starts:
        raise InputError(path, "", "no accelerometer and no gyroscope rows", "the rows of an inertial sensor")
    first = min(starts)  # [ms]: differences are taken before the division, which loses digits of a Unix time

    def signal(kind: str) -> Signal | None:
        table = tables[kind]
        return Signal((table[:, 0] - first) / 1000, table[:, 1:4]) if len(table) else None

    return Recording(
        source=path.name,
        clock_origin=first / 1000,
        epoch=first / 1000,
        truth=_truth(tables[WAYPOINT], first),
        accelerometer=signal("TYPE_ACCELEROMETER"),
        gyroscope=signal("TYPE_GYROSCOPE"),
        magnetometer=signal("TYPE_MAGNETIC_FIELD"),
        notes=(note,) if note else (),
    )


def _lines(path: Path) -> list[str]:
    """The lines of a complete file."""
    try:
        lines = path.read_bytes().decode("utf-8").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(path, f"byte {error.start}", "bytes that are not UTF-8", "a text file") from None
    last = next((n for n in range(len(lines) - 1, -1, -1) if lines[n].strip()), 0)
    if not lines[last].startswith("#\tendTime:"):
        raise InputError(
            path,
            f"line {last + 1}, the last",
            repr(lines[last][:40]),
            "a closing '# endTime' line: the file is cut off",
        )
    return lines


def _rows_by_kind(path: Path, lines: list[str]) -> tuple[dict[str, Rows], str]:
    """The rows that are used, with their line numbers; and a note on lines that are no rows."""
    rows: dict[str, Rows] = {kind: [] for kind in (*SENSORS, WAYPOINT)}
    strangers: list[int] = []
    for number, line in enumerate(lines, start=1):
        second = line.find("\t") + 1
        end = line.find("\t", second)
        kind = line[second:end] if end > 0 else line[second:]
        if kind in rows:
            rows[kind].append((number, line))
        elif line and line[0] != "#" and not kind.startswith("TYPE_"):
            strangers.append(number)
    note = f"{path.name}: {len(strangers)} lines are no rows (the first: line {strangers[0]})" if strangers else ""
    return rows, note


def _table(path: Path, kind: str, rows: Rows) -> Array:
    """Time [ms] and values of one kind of row, ``(n, 1 + k)``; finite and in time order."""
    width = 2 if kind == WAYPOINT else 3
    columns = (0, *range(2, 2 + width))
    if not rows:
        return np.empty((0, 1 + width))
    try:
        table = np.loadtxt([line for _, line in rows], delimiter="\t", usecols=columns, comments=None, ndmin=2)
    except ValueError:
        raise _bad_number(path, kind, width, rows) from None
    if not np.isfinite(table).all():
        raise _bad_number(path, kind, width, rows)
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    if len(back):
        place = f"line {rows[back[0] + 1][0]}"
        found = f"a {kind} row {(table[back[0], 0] - table[back[0] + 1, 0]) / 1000:.3f} s before the one above it"
        raise InputError(path, place, found, "the rows of one sensor in time order: the file was shuffled or damaged")
    return table


def _bad_number(path: Path, kind: str, width: int, rows: Rows) -> InputError:
    """The complaint about the first row that does not hold a time and ``width`` finite numbers."""
    split = [(number, line.split("\t")) for number, line in rows]
    wanted = [(number, [fields[0], *fields[2 : 2 + width]]) for number, fields in split]
    bad = (row for row in wanted if len(row[1]) != 1 + width or not all(map(_is_number, row[1])))
    number, values = next(bad, wanted[0])
    found = " ".join(values)[:80]
    return InputError(path, f"line {number}, {kind}", repr(found), f"a time and {width} finite numbers")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _truth(waypoints: Array, first: float) -> Trajectory | None:
    if not len(waypoints):
        return None
    return Trajectory(
        time=(waypoints[:, 0] - first) / 1000,
        position=waypoints[:, 1:3],
        heading=np.full(len(waypoints), np.nan),
        floor=("",) * len(waypoints),
    )
