"""Recordings of the Indoor Location Competition 2.0 (Microsoft Research and XYZ10), Android.

One text file per walk: tab separated, ``#`` header lines first and an ``# endTime`` line last, Unix milliseconds in
the first column and a ``TYPE_…`` name in the second. Sensors are in Android units and axes. Rows of *different*
sensors are interleaved out of time order; rows of one sensor are in order, else the file was damaged.
"""

from __future__ import annotations

from pathlib import PurePosixPath

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io.delimited import TextRows, rows_by_kind
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, surveyed
from pdr_graph.types import Array, Recording, Sightings

SENSOR_TYPES = {
    "TYPE_ACCELEROMETER": "accelerometer",
    "TYPE_GYROSCOPE": "gyroscope",
    "TYPE_MAGNETIC_FIELD": "magnetometer",
}
WAYPOINT = "TYPE_WAYPOINT"
WAYPOINT_SIGMA = 0.66 / np.sqrt(2)  # [m] per axis: surveyors tap on a map where they believe to be
RECORD_TYPES = (*SENSOR_TYPES, WAYPOINT, "TYPE_BEACON", "TYPE_WIFI")


def read(source: Source) -> Recording:
    """Read one walk. Waypoints, the surveyor's taps on the map, become ``truth``, with straight lines between them.

    Raises InputError naming the line if the file is cut off, shuffled, not text, or a value is not a number.
    """
    name = source.single or ""
    where = source.where(name)
    lines = source.text(name).split("\n")
    last = next((n for n in range(len(lines) - 1, -1, -1) if lines[n].strip()), 0)
    if not lines[last].startswith("#\tendTime:"):
        found, expected = repr(lines[last][:40]), "a closing '# endTime' line: the file is cut off"
        raise InputError(where, f"line {last + 1}, the last", found, expected)
    rows = rows_by_kind(where, lines, RECORD_TYPES, lambda line: line.partition("\t")[2].partition("\t")[0], "\t")
    unknown = [n for n, line in enumerate(lines, 1) if line and line[0] != "#" and "\tTYPE_" not in line[:40]]
    notes = [f"{len(unknown)} lines are not rows (the first: line {unknown[0]})"] if unknown else []
    tables = {sensor: _table(kind, rows[kind]) for kind, sensor in SENSOR_TYPES.items() if kind in rows}
    truth = _table(WAYPOINT, rows[WAYPOINT]) if WAYPOINT in rows else None
    if not {"accelerometer", "gyroscope"} & set(tables):
        raise InputError(where, "", "no accelerometer and no gyroscope rows", "the rows of an inertial sensor")
    return build_recording(
        where,
        PurePosixPath(name).name,
        tables,
        0.0,
        bluetooth=_sightings(rows.get("TYPE_BEACON"), transmitter=8, rssi=6),
        wifi=_sightings(rows.get("TYPE_WIFI"), transmitter=3, rssi=4, last_seen=6),
        truth=None if truth is None else surveyed(truth[:, 0], truth[:, 1:], sigma=WAYPOINT_SIGMA),
        notes=notes,
    )


def _table(kind: str, rows: TextRows) -> Array:
    """Unix time [s] and values of one kind of row; raises InputError if they are not finite or not in time order."""
    table = rows.floats((0, *range(2, 4 if kind == WAYPOINT else 5)), cut_off_allowed=False)
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        found = repr(rows.lines[row][:80])
        raise InputError(rows.where, f"line {rows.numbers[row]}, {kind}", found, "a time and finite numbers")
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    if len(back):
        place = f"line {rows.numbers[back[0] + 1]}"
        found = f"a {kind} row {(table[back[0], 0] - table[back[0] + 1, 0]) / 1000:.3f} s before the one above it"
        expected = "the rows of one sensor in time order: the file was shuffled or damaged"
        raise InputError(rows.where, place, found, expected)
    table[:, 0] /= 1000
    return table


def _sightings(rows: TextRows | None, transmitter: int, rssi: int, last_seen: int | None = None) -> Sightings | None:
    """Receptions with time, transmitter and level; rows without them are left out.

    transmitter, rssi, last_seen: column numbers. last_seen: the time of the reception [ms], where rows repeat
    receptions for minutes; each is returned once.
    """
    sightings: set[tuple[float, str, float]] = set()
    for line in rows.lines if rows else ():
        fields = line.split("\t")
        try:
            written, level = float(fields[0]) / 1000, float(fields[rssi])
            received = written if last_seen is None else float(fields[last_seen]) / 1000
            # a reception is up to five minutes old when its row is written; an older time is from another clock
            time = received if 0 <= written - received <= 300.0 else written
            sightings.add((time, fields[transmitter], level))
        except (ValueError, IndexError):
            continue
    times, transmitters, levels = zip(*sorted(sightings), strict=True) if sightings else ((), (), ())
    return Sightings(np.array(times), transmitters, np.array(levels))
