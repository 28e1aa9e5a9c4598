"""Logs of Google's GnssLogger for Android: comma-separated rows of many kinds in one text file.

The header comment names the columns of each kind, ``# Fix,Provider,LatitudeDegrees,…``; older versions have fewer.
Sensor times are ``elapsedRealtimeNanos``, which never jumps, shifted to ``utcTimeMillis`` by one offset per sensor.
"""

from __future__ import annotations

from pathlib import PurePosixPath

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io.delimited import Table, rows_by_kind
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, fullest, receiver_fixes
from pdr_graph.types import Array, Fixes, Recording

SENSOR_ROWS = {
    "accelerometer": ("Accel", "UncalAccel"),
    "gyroscope": ("Gyro", "UncalGyro"),
    "magnetometer": ("Mag", "UncalMag"),
}
ROW_KINDS = ("Fix", *(kind for kinds in SENSOR_ROWS.values() for kind in kinds))
PROVIDERS = ("gps", "fused", "flp", "network", "nlp")  # of one receiver, the best first; one is used


def read(source: Source) -> Recording:
    """Read one log: sensors and fixes. Raw GNSS measurements are not used."""
    name = source.single or ""
    tables = _tables(source.where(name), source.text(name, errors="replace"))
    notes: list[str] = []
    sensors = {}
    for sensor, kinds in SENSOR_ROWS.items():
        if found := {kind: len(tables[kind].rows.numbers) for kind in kinds if kind in tables}:
            sensors[sensor] = _sensor(tables[fullest(found)])
    fixes = _fixes(tables["Fix"], notes) if "Fix" in tables else None
    return build_recording(source.where(name), PurePosixPath(name).name, sensors, 0.0, fixes, notes=notes)


def _tables(where: str, text: str) -> dict[str, Table]:
    """A table of each kind of row, with the column names of the header comment."""
    lines = text.split("\n")
    named = (tuple(name.strip() for name in line[1:].split(",")) for line in lines if line.startswith("#"))
    headers = {names[0]: names for names in named}
    rows = rows_by_kind(where, lines, ROW_KINDS, lambda line: line[: line.find(",")], ",")
    for kind in rows:
        if kind not in headers:
            found = f"{kind} rows, without a comment that names their columns"
            raise InputError(where, f"line {rows[kind].numbers[0]}", found, f"a comment '# {kind},…' above")
    return {kind: Table(headers[kind], rows[kind]) for kind in rows}


def _sensor(table: Table) -> Array:
    """Columns ``(n, 4)``: Unix time [s] and values, from which Android's estimated bias is subtracted."""
    biased = table.header[0].startswith("Uncal") and len(table.header) >= 9
    rows = table.rows.floats(range(1, 9 if biased else 6))
    utc, elapsed = rows[:, 0] * 1e-3, rows[:, 1] * 1e-9
    values = rows[:, 2:5] - (np.nan_to_num(rows[:, 5:]) if biased else 0.0)
    offset = float(np.nanmedian(utc - elapsed)) if np.isfinite(utc - elapsed).any() else 0.0
    return np.column_stack([elapsed + offset, values])


def _fixes(table: Table, notes: list[str]) -> Fixes:
    """Fixes of the best provider, at Unix times [s]."""
    lat = table.find(lambda name: name.startswith("lat"))
    lon = table.find(lambda name: name.startswith("lon"))
    accuracy = table.find(lambda name: name.startswith("acc"))
    time = table.find(lambda name: "timeinms" in name or "unixtime" in name)
    if lat is None or lon is None or accuracy is None or time is None:
        found = f"Fix columns {', '.join(table.header)[:80]}"
        raise InputError(table.rows.where, "the header", found, "latitude, longitude, accuracy and Unix time")
    begins = ("speed", "bearing", "speedaccuracy", "bearingaccuracy")
    motion = [table.find(lambda n, w=w: n.startswith(w) and ("accuracy" in n) == ("accuracy" in w)) for w in begins]
    rows = table.columns((time, lat, lon, accuracy, *motion)) * (1e-3, *[1] * 7)
    providers = np.array([word.lower() for word in table.rows.words(1)[: len(rows)]])
    named = [p for p in PROVIDERS if p in providers] or providers[:1].tolist()
    best = fullest({p: int((providers == p).sum()) for p in named}) if named else ""
    others = int((providers != best).sum())
    if others:
        notes.append(f"GNSS: {others} fixes of other providers than {best!r} left out: they repeat the same receiver")
    return receiver_fixes(rows[providers == best], notes)
