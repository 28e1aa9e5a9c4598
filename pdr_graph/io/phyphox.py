"""CSV exports of phyphox (RWTH Aachen): a folder or a zip of one table per sensor, or one table alone.

Columns are recognised by their unit, since names follow the experiment and the phone's language: seconds, then m/s²,
rad/s, µT, hPa or degrees. Fields may be separated by comma, semicolon or tab and may have decimal commas. Tables count
seconds from the start of the experiment, *without its pauses*; ``meta/time.csv`` has the times of the pauses.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.io import delimited
from pdr_graph.io.delimited import Table
from pdr_graph.io.signatures import PHYPHOX
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, fullest, in_seconds, receiver_fixes
from pdr_graph.types import Array, Fixes, Recording

SENSOR_OF_UNIT = {"m/s2": "accelerometer", "rad/s": "gyroscope", "°/s": "gyroscope", "t": "magnetometer"}
SENSOR_OF_UNIT |= {"hpa": "barometer", "°": "location"}
WITHOUT_GRAVITY = ("linear", "without", "ohne", "sans ", "senza", "sin ")  # in the name of a table or a column
UNIT_PATTERN = re.compile(r"\(([^()]*)\)\s*$")
AXIS = re.compile(r"(?:^|[^a-z])([xyz])(?:[^a-z]|$)")


def read(source: Source) -> Recording:
    """Read one experiment. Raises InputError if a table is damaged."""
    notes: list[str] = []
    clock = _clock(source)
    found: dict[str, dict[str, Array]] = {}
    for name in PHYPHOX.within(source, source.head):
        table = delimited.table(source.where(name), source.utf8(name))
        for sensor, chosen in _sensors(name, table).items():
            values = table.columns([*chosen, *_of_receiver(table)] if sensor == "location" else chosen)
            values = values[np.isfinite(values[:, 1:]).any(axis=1)]  # short columns end in empty cells
            values[:, 0] = clock(values[:, 0])
            found.setdefault(sensor, {})[name] = values
    located = found.pop("location", None)
    fixes = None if located is None else receiver_fixes(_chosen("location", located, None, notes), notes)
    tables = {sensor: _chosen(sensor, candidates, fixes, notes) for sensor, candidates in found.items()}
    return build_recording(str(source.path), source.path.stem, tables, 0.0 if clock.unix else None, fixes, notes=notes)


def _chosen(sensor: str, tables: dict[str, Array], fixes: Fixes | None, notes: list[str]) -> Array:
    """The table of a sensor with the most rows during the fixes, or of all where none has any; others are noted."""
    rows = {name: len(values) for name, values in tables.items()}
    if fixes is not None and len(fixes):
        begin, end = fixes.time[[0, -1]]
        during = {n: int(((v[:, 0] >= begin) & (v[:, 0] <= end)).sum()) for n, v in tables.items()}
        rows = during if any(during.values()) else rows
    name = fullest(rows)
    for other in tables.keys() - {name}:
        used, left_out = (f"{PurePosixPath(n).name} ({len(tables[n])} rows)" for n in (name, other))
        notes.append(f"{sensor}: a second table, {left_out}, was left out; {used} is used")
    return tables[name]


@dataclass(frozen=True)
class ExperimentClock:
    """Converts experiment time, which stops in pauses, to the recorder's clock.

    begins: ``(n,)`` experiment time at which each part begins [s]; offset: ``(n,)`` clock minus experiment time [s].
    unix: True if the clock is Unix time.
    """

    begins: Array
    offset: Array
    unix: bool

    def __call__(self, time: Array) -> Array:
        """Times [s] on the recorder's clock."""
        return time + self.offset[np.maximum(np.searchsorted(self.begins, time, side="right") - 1, 0)]


def _clock(source: Source) -> ExperimentClock:
    """The clock of ``meta/time.csv``; without that file, the experiment time itself."""
    name = source.named("time.csv")
    if name is None:
        return ExperimentClock(np.zeros(1), np.zeros(1), unix=False)
    events = delimited.table(source.where(name), source.utf8(name))
    table = events.rows.floats((1, 2))
    words = events.rows.words(0)[: len(table)]
    starts = table[[word.upper() == "START" for word in words]]
    starts = starts[np.isfinite(starts).all(axis=1)]
    if not len(starts):
        raise InputError(source.where(name), "", "no START event", "a row event,experiment time,system time with START")
    return ExperimentClock(starts[:, 0], in_seconds(starts[:, 1]) - starts[:, 0], unix=True)


def _sensors(name: str, table: Table) -> dict[str, list[int]]:
    """The column numbers of each sensor in a table: the time column to its left, then the values.

    Of three values they are those named x, y and z. Sensors with too few columns are left out.
    """
    units = [_unit(cell) for cell in table.header]
    columns: dict[str, list[int]] = {}
    time = 0
    for k, unit in enumerate(units):
        if unit in ("s", "ms"):
            time = k
        sensor = SENSOR_OF_UNIT.get(unit)
        if sensor == "accelerometer" and any(w in f"{name} {table.header[k]}".lower() for w in WITHOUT_GRAVITY):
            sensor = "linear_acceleration"
        if sensor is not None:
            columns.setdefault(sensor, [time]).append(k)
    size, chosen = {"barometer": 1, "location": 2}, dict[str, list[int]]()
    for sensor, (time, *values) in columns.items():
        number = size.get(sensor, 3)
        if number == 3:
            names = {k: UNIT_PATTERN.sub("", table.header[k]).lower() for k in values}
            named = {axis[1]: k for k in values if (axis := AXIS.search(names[k]))}
            values = [named[axis] for axis in "xyz" if axis in named] or values
        if len(values) >= number:
            chosen[sensor] = [time, *values[:number]]
    return chosen


def _of_receiver(table: Table) -> tuple[int | None, ...]:
    """The columns of horizontal accuracy, speed and direction.

    The accuracy is found by its name, else it is the second in metres, after the height; the direction is the next in
    degrees after the position.
    """
    units = [_unit(cell) for cell in table.header]
    metres, degrees = ([k for k, unit in enumerate(units) if unit == wanted] for wanted in ("m", "°"))
    named = [k for k in metres if re.search("horiz|accuracy|genauigkeit", table.header[k].lower())]
    speeds = [k for k, unit in enumerate(units) if unit == "m/s"]
    return tuple(next(iter(columns), None) for columns in (named or metres[1:], speeds, degrees[2:]))


def _unit(cell: str) -> str:
    """The unit in a column's name, in one spelling: ``m/s2``, and ``t`` for microtesla with any micro sign."""
    unit = UNIT_PATTERN.search(cell.strip().strip('"'))
    plain = unit[1].lower().replace("²", "2").replace("^", "").strip() if unit else ""
    return plain.removeprefix("µ").removeprefix("μ").removeprefix("u") if plain.endswith("t") else plain
