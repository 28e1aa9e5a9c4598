"""A day of a person's past, which ``lifelog import`` writes: positions of many exports, and Wi-Fi receptions, as CSV.

The rows are in order of time, each with the 68 % radius and the source of its position. All numbers are whole, so that
a day that is written, read and written again is the same to the byte.
"""

from __future__ import annotations

import io
import re
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdr_graph.errors import InputError
from pdr_graph.io.source import Source
from pdr_graph.io.validation import receiver_fixes
from pdr_graph.types import Fixes

# time: Unix time [ms]; lat, lon: [1e-7 deg]; accuracy: 68 % radius [cm], NO_ACCURACY if unknown; source: in SOURCES
POSITION = np.dtype([("time", "i8"), ("lat", "i4"), ("lon", "i4"), ("accuracy", "i4"), ("source", "u1")])
# time: Unix time [ms]; mac: address of an access point as a number; rssi: received power [dBm]
SIGHTING = np.dtype([("time", "i8"), ("mac", "i8"), ("rssi", "i1")])
Rows = NDArray[np.void]  # of POSITION or SIGHTING

GPS, PHONE, TRACKED, GOOGLE_WIFI, GOOGLE_CELL, GOOGLE_PATH, RECEPTIONS = range(7)
# phone: its fused position; track: GPX, KML and FIT; google-path: processed by Google; wifi: computed from receptions
SOURCES = ("gps", "phone", "track", "google-wifi", "google-cell", "google-path", "wifi")
NO_ACCURACY = 2**31 - 1
E7, MS, CM = 1e7, 1e3, 1e2  # stored units per degree, second and metre

MARK = "# pdr_graph past"
# Unix time [ms], [1e-7 deg], 68 % radius [cm] or -1, a name; Unix time [ms], address as a number, [dBm]
COLUMN_LINES = "milliseconds,lat_e7,lon_e7,accuracy_cm,source\n", "milliseconds,mac,rssi\n"
HEAD_LINE = re.compile(rf"{MARK}, (\d+) positions, (\d+) receptions, (.*)\n", re.ASCII)
TEXT_ROW = [("time", "i8"), ("lat", "i8"), ("lon", "i8"), ("accuracy", "i8"), ("source", "U16")]
SIGHTING_ROW = [("time", "i8"), ("mac", "i8"), ("rssi", "i8")]


def read_fixes(source: Source, notes: list[str]) -> Fixes:
    """Read the positions as fixes at Unix times [s]; of several at one time, the most accurate."""
    name = source.single or ""
    rows, _ = from_text(source.where(name), source.text(name))
    rows = rows[np.lexsort((rows["accuracy"], rows["time"]))]
    rows = rows[np.append(True, np.diff(rows["time"]) > 0)[: len(rows)]]
    accuracy = np.where(rows["accuracy"] == NO_ACCURACY, np.nan, rows["accuracy"] / CM)
    time = rows["time"] / MS
    table = np.column_stack([time, rows["lat"] / E7, rows["lon"] / E7, accuracy])
    fixes = receiver_fixes(table, notes, "imported past")
    sources = rows["source"][np.searchsorted(time, fixes.time)].tolist()
    return Fixes(fixes.time, fixes.position, fixes.sigma, fixes.floor, fixes.epsg, tuple(SOURCES[n] for n in sources))


def to_text(person: str, positions: Rows, sightings: Rows) -> str:
    """The content of a day's file; person: for whom it is, which makes the content different for another."""
    lines = [f"{MARK}, {len(positions)} positions, {len(sightings)} receptions, {person}\n", COLUMN_LINES[0]]
    radius = np.where(positions["accuracy"] == NO_ACCURACY, -1, positions["accuracy"])
    source = np.array(SOURCES, object)[positions["source"]]
    columns = positions["time"], positions["lat"], positions["lon"], radius, source
    lines.append(_formatted("%d,%d,%d,%d,%s\n", *columns))
    if len(sightings):
        lines += [COLUMN_LINES[1], _formatted("%d,%d,%d\n", *(sightings[name] for name in SIGHTING.names or ()))]
    return "".join(lines)


def _formatted(row: str, *columns: NDArray[Any]) -> str:
    """A row of text for each row of the columns; one operation on all, which is five times as fast as one on each."""
    return (
        row * len(columns[0]) % tuple(chain.from_iterable(zip(*(column.tolist() for column in columns), strict=True)))
    )


def from_text(where: str, text: str) -> tuple[Rows, Rows]:
    """Positions and receptions of a day's file. Raises InputError if it is damaged."""
    match = HEAD_LINE.match(text)
    body = text[match.end() :] if match else ""
    parts = body.removeprefix(COLUMN_LINES[0]).split(COLUMN_LINES[1])
    if match is None or not body.startswith(COLUMN_LINES[0]) or len(parts) > 2:
        raise InputError(where, "line 1", repr(text[:60]), f"{MARK} …")
    try:
        rows = _loaded(parts[0], TEXT_ROW)
        heard = _loaded(parts[1] if len(parts) > 1 else "", SIGHTING_ROW)
        positions, sightings = np.zeros(len(rows), POSITION), np.zeros(len(heard), SIGHTING)
        for name in ("time", "lat", "lon"):
            positions[name] = rows[name]
        positions["accuracy"] = np.where(rows["accuracy"] < 0, NO_ACCURACY, rows["accuracy"])
        names, code = np.unique(rows["source"], return_inverse=True)
        positions["source"] = np.array([SOURCES.index(name) for name in names.tolist()], np.uint8)[code]
        for name in SIGHTING.names or ():
            sightings[name] = heard[name]
    except (ValueError, OverflowError) as error:
        raise InputError(where, "", f"{error}", "an undamaged day: delete it and import the exports again") from None
    if (len(positions), len(sightings)) != (int(match[1]), int(match[2])):
        found = f"{len(positions)} positions and {len(sightings)} receptions"
        raise InputError(where, "", found, f"{match[1]} and {match[2]}: delete the file and import the exports again")
    return positions, sightings


def _loaded(text: str, kind: list[tuple[str, str]]) -> NDArray[np.void]:
    """The rows of a table as a structured array."""
    return (
        np.loadtxt(io.StringIO(text), delimiter=",", dtype=kind, ndmin=1, comments=None) if text else np.empty(0, kind)
    )
