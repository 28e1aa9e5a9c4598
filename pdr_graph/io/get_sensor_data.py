"""Logs of GetSensorData, the app of the IPIN competitions, and of the xDR Challenge, which writes the same rows.

One text file: ``%`` comments, then ``TAG;AppTimestamp;SensorTimestamp;…``. AppTimestamp [s] runs from the log's start
and is common to all sensors, but it says when the app got a sample, not when it was taken; SensorTimestamp [s] says
that, in a clock of its own (since boot; GNSS: Unix). Samples are therefore timed by the sensor and laid on the app's
clock as a whole. The xDR dialect has the accelerometer in g, which the door tells by its size. A competition's server
may separate the cells by commas or tabs instead. ``evaal.row_stream`` reads the same rows while they come.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from pdr_graph.io.delimited import TextRows
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, receiver_fixes, surveyed
from pdr_graph.types import LONLAT, Array, Fixes, Recording, Sightings, Trajectory

NAME = "GetSensorData (IPIN, xDR)"
SENSORS = {"ACCE": "accelerometer", "GYRO": "gyroscope", "MAGN": "magnetometer", "PRES": "barometer"}
TAGS = (*SENSORS, "GNSS", "POSI", "BLE4", "WIFI")
SEPARATORS = (";", ",", "\t")
FIRST_ROW = re.compile(rb"^(?:" + "|".join(TAGS).encode() + rb")([;,\t])\s*-?[0-9.]+\1", re.MULTILINE)
LARGEST_WANDER = 1.0  # [s] between the clocks of app and sensor; up to 0.35 s on real logs
UNIX = 1e9  # [s]; a larger time is a Unix time after 2001
MINOR = 3  # of the fields after a beacon's address: rssi, power, major, minor
MAC = re.compile(r"(?:[0-9A-Fa-f]{2}[:-]){5}[0-9A-Fa-f]{2}")


def recognizes(source: Source) -> bool:
    """True if the first lines look like this format."""
    name = source.single
    if name is None:
        return False
    head = source.head(name, 16_384)
    return b"GetSensorData" in head or bool(FIRST_ROW.search(head))


def read(source: Source) -> Recording:
    """Read one log. POSI rows, where the surveyor pressed a button on a landmark, become ``truth``."""
    name = source.single or ""
    rows = rows_by_tag(source.where(name), source.text(name, errors="replace").split("\n"))
    notes: list[str] = []
    tables = {sensor: _sensor(tag, rows[tag], notes) for tag, sensor in SENSORS.items() if tag in rows}
    fixes, unix_zero = _gnss(rows.get("GNSS"), notes)
    return build_recording(
        source.where(name),
        PurePosixPath(name).name,
        tables,
        unix_zero,
        fixes,
        bluetooth=_heard(rows.get("BLE4")),
        wifi=_heard(rows.get("WIFI")),
        truth=_landmarks(rows.get("POSI")),
        notes=notes,
    )


def rows_by_tag(where: str, lines: Sequence[str]) -> dict[str, TextRows]:
    """The rows of each known tag, with their line numbers."""
    found: dict[str, list[str]] = {tag: [] for tag in TAGS}
    numbers: dict[str, list[int]] = {tag: [] for tag in TAGS}
    for number, line in enumerate(lines, start=1):
        tag, separator = line[:4], line[4:5]
        if tag in found and separator in SEPARATORS:
            found[tag].append(line if separator == ";" else line.replace(separator, ";"))
            numbers[tag].append(number)
    return {tag: TextRows(where, found[tag], numbers[tag], ";") for tag in TAGS if found[tag]}


def samples(tag: str, rows: TextRows) -> Array:
    """Columns ``(n, 2 + k)`` of one sensor: the app's time [s], the sensor's time [s] and the values."""
    return rows.floats(range(1, 4 if tag == "PRES" else 6))


def epochs(rows: TextRows) -> Array:
    """Columns ``(n, 6)`` of GNSS rows: app time, receiver time [s], latitude, longitude [deg], accuracy [m],
    satellites.
    """
    return rows.floats((1, 2, 3, 4, 7, 10))


def fixes_of(epochs: Array, notes: list[str]) -> Fixes:
    """Fixes on the app's clock from rows of `epochs`, without duplicate epochs."""
    return receiver_fixes(epochs[:, [0, 2, 3, 4]], notes, satellites=epochs[:, 5])


def sightings(rows: TextRows) -> Sightings:
    """Receptions by MAC address. The address is searched for: network names may contain the delimiter."""
    beacons = rows.lines[0].startswith("BLE4")
    heard: list[tuple[float, str, float, str]] = []
    for line in rows.lines:
        mac = MAC.search(line)
        fields = line[mac.end() + 1 :].rstrip(";\r ").split(";") if mac else []
        level = fields[0 if beacons else -1] if fields else ""
        minor = fields[MINOR].strip() if beacons and len(fields) > MINOR else ""
        try:
            heard.append((float(line.split(";", 2)[1]), mac.group() if mac else "", float(level), minor))
        except (ValueError, IndexError):
            continue
    time, level = (np.array([row[n] for row in heard]) for n in (0, 2))
    return Sightings(time, tuple(row[1] for row in heard), level, tuple(row[3] for row in heard))


def _heard(rows: TextRows | None) -> Sightings | None:
    return None if rows is None else sightings(rows)


def _sensor(tag: str, rows: TextRows, notes: list[str]) -> Array:
    """Columns ``(n, 1 + k)`` of one sensor: time on the app's clock [s] and values."""
    table = samples(tag, rows)
    app, sensor = table[:, 0], table[:, 1]
    lag = (app - sensor)[np.isfinite(app - sensor)]
    usual = float(np.median(lag)) if len(lag) else 0.0
    wander = float(np.percentile(np.abs(lag - usual), 99)) if len(lag) else 0.0
    if wander > LARGEST_WANDER:
        notes.append(f"{SENSORS[tag]}: its clock and the app's differ by {wander:.2f} s; the app's clock is used")
        return np.delete(table, 1, axis=1)
    return np.column_stack([sensor + usual, table[:, 2:]])


def _gnss(rows: TextRows | None, notes: list[str]) -> tuple[Fixes | None, float | None]:
    """Fixes on the app's clock, and the Unix time of its zero [s]. The app writes every epoch twice: one is used."""
    if rows is None:
        return None, None
    table = epochs(rows)
    app, sensor = table[:, 0], table[:, 1]
    _, first = np.unique(sensor, return_index=True)
    first = np.sort(first)
    if len(first) < len(app):
        notes.append(f"GNSS: {len(app) - len(first)} duplicate epochs were left out")
    unix = (sensor > UNIX) & np.isfinite(app)
    return fixes_of(table[first], notes), float(np.median((sensor - app)[unix])) if unix.any() else None


def _landmarks(rows: TextRows | None) -> Trajectory | None:
    if rows is None:
        return None
    table = rows.floats((1, 3, 4))
    whole = np.flatnonzero(np.isfinite(table[:, 0]) & (np.abs(table[:, 1]) <= 90) & (np.abs(table[:, 2]) <= 180))
    whole = whole[np.argsort(table[whole, 0], kind="stable")]
    floors = rows.words(5)
    return surveyed(table[whole, 0], table[whole][:, [2, 1]], tuple(floors[n] for n in whole), LONLAT)
