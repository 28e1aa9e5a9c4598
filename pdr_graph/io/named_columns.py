"""Tables of one file in which the columns' names say what they hold: one table of words for all such recorders.

Units, spaces, dots, underscores and capitals of a name do not count. The names and units are those of

- SensorLog (Bernd Thomas, iOS; v1.9 to v5.3): headers with units, as quoted in many data sets; G with the signs of iOS,
  each sensor with a time since boot (the altimeter's since 2001), and ``loggingTime``.
- W3C DeviceMotion, by pages in browsers and in Cordova: attributes of the event, flattened as in Emscripten's html5.h
  (``accelerationIncludingGravityX``, ``rotationRateAlpha``), milliseconds, °/s. alpha is about x, beta about y, gamma
  about z in Chrome, Firefox and Safari, and in the specification since w3c/deviceorientation#43; its older texts say
  z, x, y. Safari has the signs of iOS (expo/expo#3277, gyronorm.js#54).
- Movella DOT (user manual XD0502P, sections 4.2.2 and 4.2.5): °/s, µs that wrap at 2³². Xsens MT Manager (MTi manual
  MT0605P section 4.9.3, MTw manual): rad/s, ticks of 0.1 ms that wrap too. Magnetic fields are in units of the field at
  calibration, which the walk's is not, and are not read.
- A counter: ``time`` and ``steps``, the number of steps since any moment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.inertial.units import BY_PLATFORM
from pdr_graph.io import delimited
from pdr_graph.io.delimited import Table
from pdr_graph.io.sensor_logger import sign_by_posture
from pdr_graph.io.signatures import ABOVE_HEADER, NAMED_COLUMNS, plain
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, float_of, in_seconds, iso_time, receiver_fixes
from pdr_graph.types import DAY_LENGTH, STANDARD_GRAVITY, Array, Recording

FIRST_DATE = 2 * 365 * DAY_LENGTH  # [s] a later time is a Unix time: a phone runs for less since it booted
DOT, MTI = 1e-6, 1e-4  # [s] ticks of SampleTimeFine
LARGEST_TICK = 2000  # of DOT at 120 Hz are 8333 ticks from sample to sample, of an MTi at 5 Hz 2000
SLOWEST_COUNT = 100.0  # [s] a step where somebody walks: more are milliseconds
DEGREE = np.pi / 180


def axes(name: str, names: str = "xyz") -> tuple[str, ...]:
    """The columns of a vector."""
    return tuple(name + axis for axis in names)


@dataclass(frozen=True)
class Words:
    """The columns of one kind of table.

    sensors: of each the columns that have it, the best first, as the column
    of its times, "" for that of the table, and those of the values, or of two vectors that are added; factor: of each
    sensor to SI units and Android's signs; counter: the times and the numbers of counted steps.
    """

    sensors: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = field(default_factory=dict)
    factor: dict[str, float] = field(default_factory=dict)
    counter: tuple[str, str] = ("", "")


SENSORLOG, DEVICE_MOTION, MOVELLA, COUNTER = NAMED_COLUMNS  # Movella of which Xsens is a part
POSITIONS = "location"
BOOT = "timestampsincereboot"
RECEIVER_WORDS = ("latitude", "longitude", "horizontalaccuracy", "speed", "course", "speedaccuracy", "courseaccuracy")
TABLES_OF = {
    SENSORLOG: Words(
        {
            "accelerometer": (
                (f"accelerometer{BOOT}", axes("accelerometeracceleration")),
                (f"motion{BOOT}", axes("motiongravity") + axes("motionuseracceleration")),
            ),
            "gyroscope": (
                (f"motion{BOOT}", axes("motionrotationrate")),
                (f"gyro{BOOT}", axes("gyrorotation")),
            ),
            "magnetometer": (
                (f"motion{BOOT}", axes("motionmagneticfield")),
                (f"magnetometer{BOOT}", axes("magnetometer")),
            ),
            "barometer": ((f"altimeter{BOOT}", ("altimeterpressure",)),),
            POSITIONS: (("locationtimestampsince1970", tuple(f"location{name}" for name in RECEIVER_WORDS)),),
        },
        {"accelerometer": -STANDARD_GRAVITY, "barometer": 10.0},
        ("pedometerenddate", "pedometernumberofsteps"),
    ),
    DEVICE_MOTION: Words(
        {
            "accelerometer": (("", axes("accelerationincludinggravity")),),
            "linear_acceleration": (("", axes("acceleration")),),
            "gyroscope": (("", ("rotationratealpha", "rotationratebeta", "rotationrategamma")),),
            POSITIONS: (("", ("latitude", "longitude", "accuracy", "speed", "heading")),),
        },
        {"gyroscope": DEGREE},
    ),
    MOVELLA: Words(
        {
            "accelerometer": (("", axes("acc")),),
            "gyroscope": (("", axes("gyr")),),
            "barometer": (("", ("pressure",)),),
        },
    ),
    COUNTER: Words(counter=("time", "steps")),
}


def read(source: Source) -> Recording:
    """Read one table. Raises InputError if it is damaged, or does not say when its samples were taken."""
    name = source.single or ""
    where, content = source.where(name), source.utf8(name, errors="replace")
    above = ABOVE_HEADER.match(content)
    table = delimited.table(where, content[above.end() :] if above else content)
    columns, notes, sign_odds = {plain(name): k for k, name in enumerate(table.header)}, list[str](), -BY_PLATFORM
    kind = next(kind for kind, marks in NAMED_COLUMNS.items() if columns.keys() >= set(marks))
    words = TABLES_OF[kind]
    logged, unit = _times(table, columns, kind, above[0].decode("utf-8", "replace") if above else "")
    tables = dict[str, Array]()
    for sensor, choices in words.sensors.items():
        for time, values in choices:
            if {time, *values[: 2 if sensor == POSITIONS else None]} - {""} <= columns.keys():
                rows = _rows(table, [columns.get(name) for name in (time, *values)], logged, sensor == POSITIONS)
                if len(rows) and sensor not in tables:
                    tables[sensor] = rows * np.append(1.0, np.full(rows.shape[1] - 1, words.factor.get(sensor, 1.0)))
    if unit == DOT and "gyroscope" in tables:
        tables["gyroscope"][:, 1:] *= DEGREE
    if kind == DEVICE_MOTION and "accelerometer" in tables:
        sign, sign_odds, system = sign_by_posture(tables["accelerometer"])
        tables["accelerometer"][:, 1:] *= sign
        notes.append(f"accelerometer: the signs of {system} assumed from gravity's sign")
    located, counted = tables.pop(POSITIONS, None), None
    if set(words.counter) <= columns.keys():
        number = table.rows.floats([columns[words.counter[1]]])[:, 0]
        changed = np.flatnonzero(np.diff(number, prepend=np.nan) != 0)
        ended = table.rows.words(columns[words.counter[0]]) if kind == SENSORLOG else ()
        times = np.array([iso_time(_iso(ended[row])) for row in changed]) if ended else logged[changed]
        counted = np.column_stack([np.maximum(times, logged[0]), number[changed]])
    return build_recording(
        where,
        PurePosixPath(name).name,
        tables,
        0.0 if len(logged) and np.nanmedian(logged) > FIRST_DATE else None,
        None if located is None else receiver_fixes(located, notes),
        notes=notes,
        counted=counted,
        sign_odds=sign_odds,
    )


def _rows(table: Table, columns: Sequence[int | None], logged: Array, located: bool) -> Array:
    """The samples of a sensor ``(n, 1 + k)``, times as those at which the table's rows were logged ``(n,)`` [s].

    columns: of its own times, None without, and of its values. With own times each row of the table has the sensor's
    last sample, or zeros; so has a page's row the last position. Times since some moment are shifted to the log's.
    """
    rows = table.columns(columns)
    if columns[0] is None:
        rows[:, 0] = logged[: len(rows)]
    if not located and len(columns) == 7:
        rows = np.column_stack([rows[:, 0], rows[:, 1:4] + rows[:, 4:]])
    if columns[0] is None and not located:
        return rows
    key = rows[:, 1:3] if columns[0] is None else rows[:, :1]
    fresh = np.append(True, (np.diff(key, axis=0) != 0).any(axis=1))[: len(rows)]
    fresh &= (np.nan_to_num(rows[:, 0]) > 0) & (np.nan_to_num(rows[:, 1:]) != 0).any(axis=1)
    rows = rows[fresh]
    if columns[0] is not None and not located and len(rows):
        rows[:, 0] += np.nanmedian(logged[: len(fresh)][fresh] - rows[:, 0])
    return rows


def _times(table: Table, columns: Mapping[str, int], kind: str, above: str) -> tuple[Array, float]:
    """The time of each row ``(n,)`` [s], and the unit of its column [s].

    above: the lines above the header. Raises InputError if a table of Movella does not determine it.
    """
    if kind == MOVELLA:
        return _ticks(table, columns, above)
    name = next((name for name in ("loggingtime", "timestamp", "time") if name in columns), None)
    if name is None:
        found = f"the columns {', '.join(table.header)[:80]}"
        raise InputError(table.rows.where, "the header", found, "a column timestamp")
    cells = table.rows.words(columns[name])
    if cells and np.isnan(float_of(cells[0])) and not np.isnan(iso_time(_iso(cells[0]))):
        return np.array([iso_time(_iso(cell)) for cell in cells]), 1.0
    time = table.rows.floats([columns[name]])[:, 0]
    if kind == COUNTER:
        passed, counted = np.diff(time), np.diff(table.rows.floats([columns["steps"]])[:, 0])
        walked = counted > 0
        if walked.any() and np.median(passed[walked] / counted[walked]) > SLOWEST_COUNT:
            return time * 1e-3, 1e-3
    if kind != DEVICE_MOTION:
        return in_seconds(time), 1.0
    return time * 1e-3, 1e-3


def _iso(text: str) -> str:
    """ISO 8601 of "2018-05-21 18:08:26.434 +0200", as SensorLog 1.9 writes it."""
    return re.sub(r" (?=[+-]\d\d:?\d\d$)", "", text)


def _ticks(table: Table, columns: Mapping[str, int], above: str) -> tuple[Array, float]:
    """The time of each row of Movella's tables ``(n,)`` [s], and the unit of its ticks [s]."""
    ticks = table.columns([columns.get("sampletimefine"), columns["packetcounter"]])
    known = np.isfinite(ticks[:, 0]).any()
    steps = np.diff(ticks[:, 0 if known else 1]) % (1 << 32 if known else 1 << 16)
    elapsed = np.append(0.0, np.cumsum(np.nan_to_num(steps)))[: len(ticks)]
    if known:
        unit = DOT if np.nanmedian(steps) > LARGEST_TICK else MTI
        return elapsed * unit, unit
    rate = re.search(r"(?:Update ?Rate|OutputRate)\W+([\d.]+) ?Hz", above)
    if rate is None:
        expected = "a column SampleTimeFine, or a line Update Rate above the header (export it in MT Manager)"
        raise InputError(table.rows.where, "the times", "packets by number alone", expected)
    return elapsed / float(rate[1]), 1 / float(rate[1])
