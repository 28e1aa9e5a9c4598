"""Logs of GetSensorData, the app of the IPIN competitions, and of the xDR Challenge, which writes the same rows.

One text file: ``%`` comments, then ``TAG;AppTimestamp;SensorTimestamp;…``. AppTimestamp [s] counts from the start of
the log and is common to all sensors, but it is the time at which the app received a sample. SensorTimestamp [s] is the
time at which it was measured, on the sensor's own clock (since boot; GNSS: Unix). Samples therefore keep the sensor's
times, shifted to the app's clock by one offset per sensor. The xDR dialect has the accelerometer in g; `io.validation`
recognises that by the magnitude. A competition's server may separate the cells by commas or tabs instead.
``scripts/examples/evaal`` reads the same rows live.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from pdr_graph.io.delimited import TextRows, rows_by_kind
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, receiver_fixes, surveyed
from pdr_graph.types import LONLAT, Array, Fixes, Recording, Sightings, Trajectory

SENSOR_TAGS = {"ACCE": "accelerometer", "GYRO": "gyroscope", "MAGN": "magnetometer", "PRES": "barometer"}
TAGS = (*SENSOR_TAGS, "GNSS", "POSI", "BLE4", "WIFI")
MAXIMUM_CLOCK_DRIFT = 1.0  # [s] between the clocks of app and sensor; up to 0.35 s on real logs


def read(source: Source) -> Recording:
    """Read one log. POSI rows, the surveyor's button presses at landmarks, become ``truth``."""
    name = source.single or ""
    rows = rows_by_tag(source.where(name), source.text(name, errors="replace").split("\n"))
    notes: list[str] = []
    tables = {sensor: _sensor(tag, rows[tag], notes) for tag, sensor in SENSOR_TAGS.items() if tag in rows}
    fixes, unix_zero = _gnss(rows.get("GNSS"), notes)
    return build_recording(
        source.where(name),
        PurePosixPath(name).name,
        tables,
        unix_zero,
        fixes,
        bluetooth=sightings(rows["BLE4"]) if "BLE4" in rows else None,
        wifi=sightings(rows["WIFI"]) if "WIFI" in rows else None,
        truth=_landmarks(rows.get("POSI")),
        notes=notes,
    )


def rows_by_tag(where: str, lines: Sequence[str]) -> dict[str, TextRows]:
    """The rows of each tag of TAGS, with their line numbers."""
    tagged = ((line, line[4:5]) for line in lines)
    same = (line.replace(cut, ";") if cut in (",", "\t") and line[:4] in TAGS else line for line, cut in tagged)
    return rows_by_kind(where, same, TAGS, lambda line: line[:4] if line[4:5] == ";" else "", ";")


def samples(tag: str, rows: TextRows) -> Array:
    """Columns ``(n, 2 + k)`` of one sensor: app time [s], sensor time [s] and ``k`` values."""
    return rows.floats(range(1, 4 if tag == "PRES" else 6))


def epochs(rows: TextRows) -> Array:
    """Columns ``(n, 8)`` of GNSS rows: app, receiver time [s], latitude, longitude [deg], accuracy [m], then speed
    [m/s], bearing [deg], and the number of satellites.
    """
    return rows.floats((1, 2, 3, 4, 7, 8, 6, 10))


def fixes_of(epochs: Array, notes: list[str]) -> Fixes:
    """Fixes on the app's clock [s] from rows of `epochs`; duplicate epochs are left out."""
    return receiver_fixes(epochs[:, [0, 2, 3, 4, 5, 6]], notes, satellites=epochs[:, 7])


MAC_ADDRESS = re.compile(r"(?:[0-9A-Fa-f]{2}[:-]){5}[0-9A-Fa-f]{2}")
MINOR_FIELD = 3  # after a beacon's address: rssi, power, major, minor


def sightings(rows: TextRows) -> Sightings:
    """Receptions by MAC address, which is found by its pattern: network names may contain the delimiter."""
    beacons = rows.lines[0].startswith("BLE4")
    receptions: list[tuple[float, str, float, str]] = []
    for line in rows.lines:
        mac = MAC_ADDRESS.search(line)
        fields = line[mac.end() + 1 :].rstrip(";\r ").split(";") if mac else []
        level = fields[0 if beacons else -1] if fields else ""
        minor = fields[MINOR_FIELD].strip() if beacons and len(fields) > MINOR_FIELD else ""
        try:
            receptions.append((float(line.split(";", 2)[1]), mac.group() if mac else "", float(level), minor))
        except (ValueError, IndexError):
            continue
    time, level = (np.array([row[n] for row in receptions]) for n in (0, 2))
    return Sightings(time, tuple(row[1] for row in receptions), level, tuple(row[3] for row in receptions))


def _sensor(tag: str, rows: TextRows, notes: list[str]) -> Array:
    """Columns ``(n, 1 + k)`` of one sensor: time on the app's clock [s] and ``k`` values."""
    table = samples(tag, rows)
    app, sensor = table[:, 0], table[:, 1]
    lag = (app - sensor)[np.isfinite(app - sensor)]
    offset = float(np.median(lag)) if len(lag) else 0.0
    drift = float(np.percentile(np.abs(lag - offset), 99)) if len(lag) else 0.0
    if drift > MAXIMUM_CLOCK_DRIFT:
        notes.append(f"{SENSOR_TAGS[tag]}: its clock and the app's differ by {drift:.2f} s; the app's clock is used")
        return np.delete(table, 1, axis=1)
    return np.column_stack([sensor + offset, table[:, 2:]])


def _gnss(rows: TextRows | None, notes: list[str]) -> tuple[Fixes | None, float | None]:
    """Fixes on the app's clock, and the Unix time of its zero [s]. The app writes each epoch twice; one is used."""
    if rows is None:
        return None, None
    table = epochs(rows)
    app, sensor = table[:, 0], table[:, 1]
    _, first = np.unique(sensor, return_index=True)
    first = np.sort(first)
    if len(first) < len(app):
        notes.append(f"GNSS: {len(app) - len(first)} duplicate epochs were left out")
    # a receiver time above 1e9 s is a Unix time after 2001, not a time since boot
    unix = (sensor > 1e9) & np.isfinite(app)
    return fixes_of(table[first], notes), float(np.median((sensor - app)[unix])) if unix.any() else None


def _landmarks(rows: TextRows | None) -> Trajectory | None:
    """The surveyed positions (longitude, latitude) of POSI rows, sorted by time; None without rows."""
    if rows is None:
        return None
    table = rows.floats((1, 3, 4))
    valid = np.flatnonzero(np.isfinite(table[:, 0]) & (np.abs(table[:, 1]) <= 90) & (np.abs(table[:, 2]) <= 180))
    valid = valid[np.argsort(table[valid, 0], kind="stable")]
    floors = rows.words(5)
    return surveyed(table[valid, 0], table[valid][:, [2, 1]], tuple(floors[n] for n in valid), LONLAT)
