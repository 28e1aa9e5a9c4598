"""Exports of Sensor Logger (Kelvin Choi): a folder or a zip of one table per sensor, Android or iOS.

Every table has ``time`` (Unix nanoseconds) and, since 2022, ``seconds_elapsed``; columns are found by name: their order
varies.
``Accelerometer`` is without gravity. On iOS ``Accelerometer``, ``Gravity`` and ``AccelerometerUncalibrated`` have the
opposite sign, unless "Standardise Units & Frames" was set; ``Metadata.csv`` has that setting.
Source: UNITS.md, COORDINATES.md and CROSSPLATFORM.md of tszheichoi/awesome-sensor-logger.
"""

from __future__ import annotations

from pathlib import PurePosixPath

import numpy as np

from pdr_graph.geometry import interpolate
from pdr_graph.inertial.units import BY_PLATFORM, BY_UNIT, LEAST_ODDS, METRIC, WEB, AccelerationSign
from pdr_graph.io import delimited
from pdr_graph.io.delimited import Table
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, fullest, receiver_fixes
from pdr_graph.types import Array, Recording, Sightings, Signal

XYZ = ("x", "y", "z")
NANOSECOND = 1e-9  # [s]
PLAIN_FILES = {
    "gyroscope": ("Gyroscope.csv", "GyroscopeUncalibrated.csv"),
    "magnetometer": ("Magnetometer.csv", "MagnetometerUncalibrated.csv"),
}
LOCATIONS = "Location.csv", "LocationGps.csv", "LocationNetwork.csv"


def read(source: Source) -> Recording:
    """Read one recording. Raises InputError if a table is damaged."""
    notes: list[str] = []
    tables, sign_odds = _accelerations(source, notes)
    for sensor, files in PLAIN_FILES.items():
        if (table := _samples(source, *_longest_first(source, files, notes))) is not None:
            tables[sensor] = table
    if (table := _samples(source, "Barometer.csv", values=("pressure",))) is not None:
        tables["barometer"] = table
    fixes = None
    if (location := _table(source, *_longest_first(source, LOCATIONS, notes))) is not None:
        optional = ("horizontalAccuracy", "speed", "bearing", "speedAccuracy", "bearingAccuracy")
        rows = location.floats("time", "latitude", "longitude", optional=optional)
        fixes = receiver_fixes(rows * (NANOSECOND, *[1] * 7), notes)
    return build_recording(
        str(source.path),
        source.path.stem,
        tables,
        0.0,
        fixes,
        bluetooth=_sightings(source, "Bluetooth.csv", "id", "rssi"),
        wifi=_sightings(source, "WiFi.csv", "bssid", "level"),
        notes=notes,
        counted=_samples(source, "Pedometer.csv", values=("steps",)),
        sign_odds=sign_odds,
    )


def _accelerations(source: Source, notes: list[str]) -> tuple[dict[str, Array], float]:
    """Acceleration with gravity [m/s²] in Android's signs, from the tables recorded; else the one without gravity.

    Also the log-odds that the sign is wrong.
    """
    total = _samples(source, "TotalAcceleration.csv")
    if total is not None:  # written on Android only; the other tables need not be read
        return {"accelerometer": total}, -BY_PLATFORM
    linear, gravity = _samples(source, "Accelerometer.csv"), _samples(source, "Gravity.csv")
    raw = _samples(source, "AccelerometerUncalibrated.csv")
    if linear is None and raw is None and source.single:
        total = _samples(source, PurePosixPath(source.single).name)  # one table, renamed by its user
        return ({} if total is None else {"accelerometer": total}), BY_UNIT[METRIC]
    valid = np.empty((0, 4)) if gravity is None else gravity[np.isfinite(gravity).all(axis=1)]
    if linear is not None and len(linear) and len(valid):
        at_linear = interpolate(linear[:, 0], valid[:, 0], valid[:, 1:])
        total = np.column_stack([linear[:, 0], linear[:, 1:] + at_linear])
    else:
        total = raw
    sign, odds = _sign(source, total, notes)
    if total is not None:
        return {"accelerometer": total * (1, sign, sign, sign)}, odds
    return ({} if linear is None else {"linear_acceleration": linear * (1, sign, sign, sign)}), odds


def _sign(source: Source, total: Array | None, notes: list[str]) -> tuple[float, float]:
    """−1 if accelerations have the signs of iOS, else 1, and the log-odds that this is wrong.

    Without metadata the accelerations with gravity decide.
    """
    if (table := _table(source, "Metadata.csv")) is not None:
        about = {key.lower(): table.rows.words(k)[0].lower() for k, key in enumerate(table.header)}
        if "platform" in about:
            ios = about["platform"] == "ios" and about.get("standardisation") != "true"
            return -1.0 if ios else 1.0, -BY_PLATFORM
    total = np.empty((0, 4)) if total is None else total[np.isfinite(total).all(axis=1)]
    if not len(total):
        return 1.0, -BY_PLATFORM
    sign, odds, system = sign_by_posture(total)
    notes.append(f"accelerometer: no Metadata.csv, so the phone is unknown; {system} assumed from gravity's sign")
    return sign, odds


def sign_by_posture(rows: Array) -> tuple[float, float, str]:
    """Sign of accelerations with gravity, log-odds that it is wrong, and the system that has it.

    rows: ``(n, 4)`` times [s] and values of a recorder that runs on Android and on iOS. Where the phone was not held,
    the screen that faces up a little decides.
    """
    rows = rows[np.isfinite(rows).all(axis=1)]
    found = AccelerationSign.of(Signal(rows[:, 0], rows[:, 1:]), WEB)
    down = np.median(rows[:, 3]) < 0 if abs(found.log_odds) < LEAST_ODDS and len(rows) else found.sign < 0
    return (-1.0, -abs(found.log_odds), "iOS") if down else (1.0, -abs(found.log_odds), "Android")


def _longest_first(source: Source, files: tuple[str, ...], notes: list[str]) -> tuple[str, ...]:
    """The files of one sensor, in the order in which they are preferred, but none before one of twice its size."""
    sizes = {file: source.size(name) for file in files if (name := source.named(file)) is not None}
    if not sizes:
        return files
    first, best = next(iter(sizes)), fullest(sizes)
    if best != first:
        notes.append(f"{best} is used: {first} has less than half of its size")
    return (best, *files)


def _table(source: Source, *files: str) -> Table | None:
    """The table of the first of some files that exists and has rows; None without one."""
    for file in files:
        name = source.named(file)
        if name is not None and source.head(name, 1):
            table = delimited.table(source.where(name), source.utf8(name))
            if table.rows.content.strip():
                return table
    return None


def _samples(source: Source, *files: str, values: tuple[str, ...] = XYZ) -> Array | None:
    """Unix time [s] and values of a sensor; None if it was not recorded."""
    table = _table(source, *files)
    return None if table is None else table.floats("time", *values) * ([NANOSECOND] + len(values) * [1.0])


def _sightings(source: Source, file: str, identity: str, level: str) -> Sightings | None:
    """Receptions of one radio; rows without a level are left out."""
    table = _table(source, file)
    column = table.find(identity.__eq__) if table else None
    if table is None or column is None:
        return None
    rows = table.floats("time", level)
    valid = np.flatnonzero(np.isfinite(rows).all(axis=1))
    names = table.rows.words(column)
    return Sightings(rows[valid, 0] * NANOSECOND, tuple(names[n] for n in valid), rows[valid, 1])
