"""The data types of pdr_graph and its conventions, stated once.

* SI units and radians inside; degrees and compass bearings only in readers, writers and the command line.
* World is East-North-Up about an origin, or the floor plan's own metric frame (x right, y up on the plan).
  Heading is counter-clockwise from +x. ``R_world_device`` maps device to world: adjacent frame names cancel.
* Time is float64 seconds from the recording's start; ``Recording.clock_origin`` takes it to the recorder's clock.
* Arrays are samples-first, ``(n, 3)``. Data types are frozen; functions return new values and never change inputs.
* Intervals are ``[start, end)``. Uncertainty is a standard deviation ``sigma_*`` or a covariance ``(n, d, d)``.
* A table of measurements for the graph is a frozen dataclass with ``time``, ``(n,)`` or ``(n, 2)`` for pairs [s], rows
  sorted by time. It may state, as class variables: ``limits``, least and largest value of a column (a live walk leaves
  out rows beyond them, and rows that are not finite); ``optional``, the columns that may be NaN; ``most``, rows that a
  live walk uses in a quarter of a second; ``reference``, the column that has, for each row, its place in a list of
  beacons or anchors: ``label`` and the other fields declared TABLE.
* An array, a tuple or a table in a field is a column with a value per row (ROW), empty where nothing is known. What
  belongs to the table as a whole is declared ``field(metadata=TABLE)``; numbers, texts and other values always do.
  The same holds for kinds of measurement, whose keyframe ``(n,)`` per row is declared ``field(metadata=KEYFRAME)``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from enum import StrEnum
from functools import cache, cached_property
from math import isfinite
from typing import Any, ClassVar, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pdr_graph.errors import count, expect, one_line

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]
Complex = NDArray[np.complex128]  # vectors in the plane: x + iy
LARGEST_HEADING = 4 * np.pi  # [rad]: headings may be unwrapped; a larger number is in degrees
LARGEST_DRIFT = 1.0  # [rad/s] of a gyroscope: a larger one is in other units
INSTANT = 1e-6  # [s]: times closer than this are the same instant
FARTHEST = 1e8  # [m] largest coordinate and sigma of a usable position: eastings with their zone have up to 6e7
FINEST = 1e-4  # [m] least sigma of a measured position; squares of much smaller ones overflow
Limits = dict[str, tuple[float, float]]  # least and largest value of a column, by its name
DAY_LENGTH = 86_400.0  # [s]
STANDARD_GRAVITY = 9.80665  # [m/s²]
GNSS = "GNSS"  # source of fixes from a phone's receiver
NONE: Any = ()  # a column of which nothing is known
DECLARED_AS = "pdr_graph.column"  # in the metadata of a field: how it is declared
ROW = {DECLARED_AS: "row"}
KEYFRAME = {DECLARED_AS: "keyframe"}
TABLE = {DECLARED_AS: "table"}
LONLAT = 4326  # EPSG code of longitude and latitude on WGS 84 [deg]
UTM_32N = 32632  # EPSG code of a UTM zone [m], in which IPIN 2021 gave plans and positions
Table = TypeVar("Table", bound=Any)


class OneLineRepr:
    """Base of data types: their `repr` is ``Name(part, part)`` on one line, never a dump of arrays.

    row: the noun for one row, in the singular.
    """

    _row: ClassVar[str] = "row"

    def __init_subclass__(cls, row: str = "row", **options: object):
        super().__init_subclass__(**options)
        cls._row = row
        cls.__repr__ = OneLineRepr.__repr__  # in the class itself: `dataclass` replaces an inherited one

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._summary())})"

    def _repr_html_(self) -> str:
        """A table of the fields, and a picture of paths, plans and sensors: what a notebook shows."""
        from pdr_graph.notebook_html import html_of  # imports shapely

        return html_of(self)

    def _summary(self) -> list[str]:
        """Parts of the `repr`: the number of rows and the span of their times; without these, a part for each field."""
        if hasattr(self, "time") or hasattr(self, "position"):
            return [count(len(getattr(self, "time", getattr(self, "position", ()))), self._row), *time_span(self)]
        parts = list[str]()
        for name in getattr(self, "__dataclass_fields__", ()):
            value = getattr(self, name)
            if isinstance(value, str):
                parts += [repr(one_line(value))] if value else []
            elif isinstance(value, tuple | dict | list | np.ndarray):
                parts.append(f"{len(value)} {name}")
        return parts


class Rows(OneLineRepr):
    """Base of tables with a row for each time."""

    time: Array

    def __len__(self) -> int:
        return len(self.time)


def time_span(record: object) -> list[str]:
    """The first and last time of a record's rows as a text, ``0.0 to 243.1 s``; empty without rows."""
    time = np.asarray(getattr(record, "time", ()))
    return [f"{time.min():.1f} to {time.max():.1f} s"] if time.size else []


def check_finite(record: object, *columns: str) -> None:
    """Store the named columns of `record` as float arrays ``(n, …)`` of equal length; lists are converted.

    The first column is the time. If it is a number, the record has one row, and its columns are lifted to arrays of one
    row. Raises ValueError unless all values are finite.
    """
    if isinstance(getattr(record, columns[0]), float | int | np.number):
        for name in columns:
            object.__setattr__(record, name, [getattr(record, name)])
    rows = len(_stored_array(record, columns[0]))
    for name in columns:
        values = _stored_array(record, name)
        if len(values) != rows or not np.isfinite(values).all():
            bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1)) if len(values) else []
            found = f"row {bad[0]}: {values[bad[0]]}" if len(bad) else f"{len(values)} rows"
            raise ValueError(f"{type(record).__name__}.{name}: found {found}, expected {rows} finite rows")


def _stored_array(record: object, name: str) -> Array:
    """Convert a column to an array, store it in the frozen record and return it."""
    column = getattr(record, name)
    try:
        values = np.asarray(column, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(())
    if not values.ndim:
        raise ValueError(f"{type(record).__name__}.{name}: found {type(column).__name__}, expected an array of numbers")
    object.__setattr__(record, name, values)
    return values


def check_each(name: str, valid: Mask, values: Array, expected: str) -> None:
    """Raise ValueError at the first row that is not valid; `expected` says what a valid row is."""
    if not valid.all():
        row = int(np.argmin(valid))
        raise ValueError(f"{name}, row {row}: found {values[row]}, expected {expected}")


def fill_labels(record: Any, *names: str) -> None:
    """Store an empty text per row if a column of texts was left empty; raise ValueError if its length is wrong."""
    rows = len(record.time)
    for name in names:
        labels = getattr(record, name) or ("",) * rows
        labels = (labels,) if isinstance(labels, str) else labels
        if len(labels) != rows:
            raise ValueError(f"{type(record).__name__}.{name}: found {len(labels)} labels, expected {rows}")
        object.__setattr__(record, name, labels)


def fill_unknown(record: Any, *names: str) -> None:
    """Store NaN per row if a column of numbers was left empty; raise ValueError if its length is wrong."""
    rows = len(record.time)
    for name in names:
        if not np.ndim(getattr(record, name)):
            object.__setattr__(record, name, [getattr(record, name)])
        values = _stored_array(record, name)
        if len(values) not in (0, rows):
            raise ValueError(f"{type(record).__name__}.{name}: found {len(values)} rows, expected {rows}")
        object.__setattr__(record, name, values if len(values) else np.full(rows, np.nan))


class Sensor(StrEnum):
    """A sensor of a phone; each is equal to its name: ``Sensor.ACCELEROMETER == "accelerometer"``.

    The names are accelerometer, gyroscope, magnetometer, linear_acceleration and barometer.
    ``Sensor(value)`` is the sensor of a name. Raises ValueError for an unknown name, with the known ones.
    """

    ACCELEROMETER = "accelerometer"
    GYROSCOPE = "gyroscope"
    MAGNETOMETER = "magnetometer"
    LINEAR_ACCELERATION = "linear_acceleration"
    BAROMETER = "barometer"

    @classmethod
    def _missing_(cls, value: object) -> Sensor:
        raise ValueError(f"Sensor: {unknown_sensor(value)}")


SENSORS = tuple(sensor.value for sensor in Sensor)
INERTIAL = ("accelerometer", "gyroscope", "linear_acceleration")


def unknown_sensor(value: object) -> str:
    """What is wrong with a name that no sensor has, and which it may mean: for messages."""
    begin = str(value).lower()[:3]
    close = [name for name in SENSORS if len(begin) == 3 and name.startswith(begin)]
    hint = f" ({close[0]}?)" if close else ""
    return f"found {one_line(repr(value))}{hint}, expected one of {', '.join(SENSORS)}"


@dataclass(frozen=True)
class Signal(Rows):
    """The samples of one sensor.

    time: ``(n,)`` [s], increasing; values: ``(n, 3)``, in the unit of the sensor (m/s² with gravity, rad/s, µT), on the
    Android device axes (x right, y up, z out of the screen); a barometer's are ``(n, 1)`` [hPa].
    """

    time: Array
    values: Array

    def __post_init__(self) -> None:
        """Raise ValueError unless there is a row of values for each time."""
        if np.ndim(self.time) != 1 or np.ndim(self.values) != 2 or len(self.time) != len(self.values):
            shapes = f"{np.shape(self.time)} and {np.shape(self.values)}"
            raise ValueError(f"Signal: found times and values of shapes {shapes}, expected (n,) and (n, 3) or (n, 1)")

    @cached_property
    def rate(self) -> float:
        """Sampling rate from the median interval; gaps do not lower it. [Hz]"""
        return float(1 / np.median(np.diff(self.time))) if len(self) > 1 else 0.0

    def _summary(self) -> list[str]:
        return [f"{len(self)} samples", f"{self.rate:.0f} Hz", *time_span(self)]


@dataclass(frozen=True)
class Sightings(Rows, row="reception"):
    """Received signal strengths of Bluetooth beacons or Wi-Fi access points.

    time: ``(n,)`` of each reception [s]; transmitter: its identifier, one per row; rssi: ``(n,)`` received power [dBm];
    minor: an iBeacon's minor number, one per row, if the log has it.
    """

    time: Array
    transmitter: tuple[str, ...]
    rssi: Array
    minor: tuple[str, ...] = ()


@dataclass(frozen=True)
class Beacons(OneLineRepr, row="beacon"):
    """Transmitters at surveyed positions.

    name: the identifier, as in ``Sightings.transmitter``; position: ``(m, 2)`` in the output frame [m], or in the frame
    of ``epsg``, NaN where unknown; sigma: ``(m,)`` standard deviation of the survey per axis [m]; floor: labels, empty
    where unknown; label: the name in messages.
    """

    name: tuple[str, ...]
    position: Array
    sigma: Array
    floor: tuple[str, ...]
    label: tuple[str, ...]
    epsg: int | None = None

    def __len__(self) -> int:
        return len(self.name)


def minor_number(label: str) -> str:
    """The number at the end of a beacon's name, as in ``Sightings.minor``; empty without one."""
    number = re.search(r"\d+$", label)
    return str(int(number.group())) if number else ""


@dataclass(frozen=True)
class Fixes(Rows, row="fix"):
    """Position fixes: from GNSS, BLE, Wi-Fi or the user.

    time: ``(n,)`` [s].
    position: ``(n, 2)`` in the output frame [m], or in the frame of ``epsg``.
    sigma: ``(n,)`` standard deviation *per axis* [m].
    floor: floor label per fix, empty where unknown; optional.
    epsg: None in the output frame; LONLAT if ``position`` is longitude and latitude [deg]; else a projection's code.
    source: the receiver of each fix if its errors are correlated over time; empty if independent. Default: GNSS where
    ``epsg`` is LONLAT or a speed is known, since such positions are a receiver's, else empty.
    speed: ``(n,)`` over ground, as the receiver measures it by Doppler [m/s]; course: ``(n,)`` its direction,
    counter-clockwise from +x, or from east in LONLAT [rad]; speed_sigma, course_sigma: of both [m/s, rad]. NaN where
    unknown; optional. A speed is used together with its course.
    """

    time: Array
    position: Array
    sigma: Array
    floor: tuple[str, ...] = ()
    epsg: int | None = None
    source: tuple[str, ...] = ()
    speed: Array = NONE
    course: Array = NONE
    speed_sigma: Array = NONE
    course_sigma: Array = NONE

    limits: ClassVar[Limits] = {"position": (-FARTHEST, FARTHEST), "sigma": (FINEST, FARTHEST)}
    optional: ClassVar[tuple[str, ...]] = ("speed", "course", "speed_sigma", "course_sigma")
    most: ClassVar[int] = 2

    def __post_init__(self) -> None:
        """Raise ValueError on values that would make an estimate NaN or silently wrong."""
        check_finite(self, "time", "position", "sigma")
        if self.position.shape[1:] != (2,):
            raise ValueError(f"Fixes.position: found shape {self.position.shape}, expected (n, 2)")
        check_each("Fixes.sigma", self.sigma > 0, self.sigma, "standard deviations above 0 m")
        if "speed" in vars(self):  # else decoded from bytes of an earlier version
            fill_unknown(self, *self.optional)
            for name in ("speed", "speed_sigma", "course_sigma"):
                values = getattr(self, name)
                check_each(f"Fixes.{name}", ~(values < 0), values, "numbers of 0 or more, or NaN")
            valid = ~(np.abs(self.course) > LARGEST_HEADING)
            check_each("Fixes.course", valid, self.course, "radians counter-clockwise from +x, not degrees")
        if (self.epsg == LONLAT or np.isfinite(self.speed).any()) and not self.source:
            object.__setattr__(self, "source", (GNSS,) * len(self.time))
        fill_labels(self, "floor", "source")

    @classmethod
    def none(cls) -> Fixes:
        """No fixes: 0 rows."""
        return cls(np.empty(0), np.empty((0, 2)), np.empty(0), ())

    @classmethod
    def concatenate(cls, parts: Sequence[Fixes]) -> Fixes:
        """The fixes of all parts, which are in one frame, sorted by time."""
        some = [part for part in parts if len(part)]
        whole = concatenate(some or [cls.none()])
        return whole if len(some) < 2 else whole[np.argsort(whole.time, kind="stable")]

    def shifted(self, seconds: float) -> Fixes:
        """The fixes at times that are `seconds` later."""
        return replace(self, time=self.time + seconds)

    def __getitem__(self, which: int | slice | Mask | Index) -> Fixes:
        """A selection of rows as ``Fixes``: ``fixes[0]``, ``fixes[2:5]``, ``fixes[mask]``."""
        return take(self, which)


START = "start"  # source of the start heading of a user


@dataclass(frozen=True)
class Headings(Rows, row="heading"):
    """Measured walking directions: from a compass or the user.

    time: ``(n,)`` [s], increasing; heading: ``(n,)`` counter-clockwise from +x of the output frame [rad].
    sigma: ``(n,)`` of independent errors [rad]; source: of each, "start" if the user states it, "" for the compass.
    """

    time: Array
    heading: Array
    sigma: Array
    source: tuple[str, ...] = ()

    limits: ClassVar[Limits] = {"heading": (-LARGEST_HEADING, LARGEST_HEADING), "sigma": (FINEST, 1e3)}
    most: ClassVar[int] = 1

    def __post_init__(self) -> None:
        """Raise ValueError on values that would make an estimate NaN or silently wrong."""
        check_finite(self, "time", "heading", "sigma")
        if "source" in vars(self):  # else decoded from such bytes
            fill_labels(self, "source")
        check_each("Headings.heading", np.abs(self.heading) <= LARGEST_HEADING, self.heading, "radians, not degrees")
        check_each("Headings.sigma", self.sigma > 0, self.sigma, "standard deviations above 0 rad")

    @classmethod
    def none(cls) -> Headings:
        """No headings: 0 rows."""
        return cls(np.empty(0), np.empty(0), np.empty(0))

    @classmethod
    def concatenate(cls, parts: Sequence[Headings]) -> Headings:
        """The headings of all parts, in the order of the parts."""
        return concatenate([cls.none(), *parts])

    @property
    def stated(self) -> Mask:
        """True ``(n,)`` for start headings that a user states."""
        return np.array([source == START for source in self.source], dtype=bool)

    def shifted(self, seconds: float) -> Headings:
        """The headings at times that are `seconds` later."""
        return replace(self, time=self.time + seconds)


@dataclass(frozen=True)
class Drifts(Rows, row="drift"):
    """Measured drifts of the gyroscope about the vertical, which its own bias estimate has left.

    time: ``(n,)`` [s], increasing; drift: ``(n,)`` b, by which turns are too small per time, counter-clockwise [rad/s].
    sigma: ``(n,)`` of independent errors [rad/s].
    """

    time: Array
    drift: Array
    sigma: Array

    limits: ClassVar[Limits] = {"drift": (-LARGEST_DRIFT, LARGEST_DRIFT), "sigma": (FINEST, 1e3)}
    most: ClassVar[int] = 1

    def __post_init__(self) -> None:
        """Raise ValueError on values that would make an estimate NaN or silently wrong."""
        check_finite(self, "time", "drift", "sigma")
        check_each("Drifts.drift", np.abs(self.drift) <= LARGEST_DRIFT, self.drift, "radians per second")
        check_each("Drifts.sigma", self.sigma > 0, self.sigma, "standard deviations above 0 rad/s")


@dataclass(frozen=True)
class Trajectory(Rows):
    """A path over time: an estimate or ground truth.

    time: ``(n,)`` [s]; position: ``(n, 2)`` [m]; heading: ``(n,)`` [rad] counter-clockwise from +x, NaN where unknown.
    floor: the plan's label per row, empty where unknown; optional.
    covariance: ``(n, 3, 3)`` of (x, y, heading) in the output axes [m, m, rad], or None.
    epsg: the frame of a surveyed truth, as in ``Fixes``; None in the output frame.
    """

    time: Array
    position: Array
    heading: Array
    floor: tuple[str, ...] = ()
    covariance: Array | None = None
    epsg: int | None = None

    def __post_init__(self) -> None:
        """Raise ValueError unless there is a position, a heading and a label for each time."""
        rows = len(self.time)
        if np.shape(self.position) != (rows, 2) or np.shape(self.heading) != (rows,):
            found = f"shapes {np.shape(self.position)} and {np.shape(self.heading)}"
            raise ValueError(f"Trajectory: found {found} at {rows} times, expected ({rows}, 2) and ({rows},)")
        fill_labels(self, "floor")

    def __getitem__(self, which: int | slice | Mask | Index) -> Trajectory:
        """A selection of rows as a ``Trajectory``: ``track[0]``, ``track[2:5]``, ``track[mask]``."""
        return take(self, which)


Between: TypeAlias = Callable[[Array], tuple[Array, Array]]
"""Poses ``(n, 3)`` and covariances ``(n, 3, 3)`` in the output axes at times ``(n,)`` [s]."""


@dataclass(frozen=True)
class Recording(OneLineRepr):
    """The recording of one phone. A sensor that was not recorded is None.

    source: name for messages and titles.
    clock_origin: the recorder's clock at ``t = 0`` [s]; outputs are written in that clock.
    epoch: Unix time at ``t = 0`` [s], None if the log has no absolute time.
    accelerometer: with gravity [m/s²]; gyroscope [rad/s]; magnetometer [µT]; barometer [hPa].
    linear_acceleration: gravity removed by the recorder [m/s²]; used only without an ``accelerometer``.
    step_counter: ``(n, 1)`` number of steps by the phone's own counter; used only without any acceleration.
    fixes: position fixes inside the recording.
    bluetooth, wifi: receptions; beacons: the surveyed positions of Bluetooth beacons, None if unknown.
    truth: surveyed positions inside the recording, for scoring and plots only: no estimate reads it.
    measurements: tables of any other kind, such as ``Levels``.
    notes: what the reader left out or assumed, one line each.
    sign_odds: log-odds that the accelerations have the sign opposite to Android's, by what the reader knows of the
    recorder; None if it knows nothing: then posture, magnetic field and fixes tell.
    """

    source: str
    clock_origin: float
    epoch: float | None
    accelerometer: Signal | None = None
    gyroscope: Signal | None = None
    magnetometer: Signal | None = None
    linear_acceleration: Signal | None = None
    barometer: Signal | None = None
    fixes: Fixes = field(default_factory=Fixes.none)
    bluetooth: Sightings | None = None
    wifi: Sightings | None = None
    beacons: Beacons | None = None
    truth: Trajectory | None = None
    measurements: tuple[Any, ...] = ()
    notes: tuple[str, ...] = ()
    step_counter: Signal | None = None
    sign_odds: float | None = None

    def __post_init__(self) -> None:
        """Raise TypeError unless each sensor is a `Signal`."""
        for name in SENSORS:
            expect(f"Recording, {name}", getattr(self, name), Signal, None, instead="Signal(time, values)")

    @property
    def has_acceleration(self) -> bool:
        """True if there is an acceleration to detect steps in."""
        return self.accelerometer is not None or self.linear_acceleration is not None

    @property
    def signals(self) -> dict[str, Signal]:
        """The recorded sensors, by name."""
        return {name: signal for name in SENSORS if (signal := getattr(self, name)) is not None}

    def _summary(self) -> list[str]:
        parts = [part for part in (*self.signals.values(), self.fixes, self.truth) if part is not None and len(part)]
        spans = [(part.time[0], part.time[-1]) for part in parts]
        duration = [f"{max(end for _, end in spans) - min(start for start, _ in spans):.0f} s"] if spans else ["empty"]
        rates = [f"{name} {signal.rate:.0f} Hz" for name, signal in self.signals.items()]
        return [*duration, *rates, *([count(len(self.fixes), "fix")] if len(self.fixes) else [])]


STEP_COLUMNS = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn", "confidence")


@dataclass(frozen=True)
class Steps(Rows):
    """The steps of a walk: the output of the front end and the odometry input of the estimators.

    start, end: first and last sample of the recording [s].
    time: ``(n,)`` end of each step [s], increasing.
    duration: ``(n,)`` time in motion [s]; before ``time - duration`` the walker stood still.
    length: ``(n,)`` [m].
    turn: ``(n,)`` heading change since the previous row's time (first row: since ``start``), counter-clockwise [rad].
    pause_turn: ``(n,)`` the part of ``turn`` made while standing, before the step began [rad].
    sigma_length: ``(n,)`` along the step, and as much to the side [m]; sigma_turn: ``(n,)`` [rad]. Errors of different
    steps are independent.
    final_turn: heading change from the last step to ``end`` [rad].
    stepless: time in which the device moved as a carried one does, and no step was recognised [s].
    missing: time in which it moved like the walker's steps without one [s]; sigmas of the next steps have it.
    unknown: quantities that the sensors do not determine, one line each.
    confidence: ``(n,)`` probability that each is a step, by the detector; 1 if it is not stated.

    A row of length 0 is a gap in the recording (`is_gap`): the displacement is 0 ± ``sigma_length`` per axis.
    """

    start: float
    end: float
    time: Array
    duration: Array
    length: Array
    turn: Array
    pause_turn: Array
    sigma_length: Array
    sigma_turn: Array
    final_turn: float = 0.0
    unknown: tuple[str, ...] = field(default=(), metadata=TABLE)
    stepless: float = 0.0
    missing: float = 0.0
    confidence: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Raise ValueError on values that would make an estimate NaN or silently wrong."""
        if self.confidence is None:
            object.__setattr__(self, "confidence", np.ones(len(self.time)))
        check_finite(self, *STEP_COLUMNS)
        if not (np.isfinite([self.start, self.end, self.final_turn]).all() and self.start < self.end):
            raise ValueError(f"Steps: found start {self.start} and end {self.end}, expected start < end")
        before = np.concatenate([[self.start], self.time[:-1]])
        in_order = (self.time > before) & (self.time <= self.end + INSTANT)
        check_each("Steps.time", in_order, self.time, "times that increase, from start to end")
        under_way = (self.duration > 0) & (self.time - self.duration >= before - INSTANT)
        check_each("Steps.duration", under_way, self.duration, "steps that begin after the end of the previous step")
        check_each("Steps.sigma_length", self.sigma_length > 0, self.sigma_length, "standard deviations above 0 m")
        probable = (self.confidence >= 0) & (self.confidence <= 1)
        check_each("Steps.confidence", probable, self.confidence, "probabilities from 0 to 1")
        check_each("Steps.sigma_turn", self.sigma_turn > 0, self.sigma_turn, "standard deviations above 0 rad")

    @property
    def is_gap(self) -> Mask:
        """``(n,)``: True for rows that are gaps in the recording."""
        return self.length == 0

    def _summary(self) -> list[str]:
        gaps = int(np.count_nonzero(self.is_gap))
        some = [count(len(self) - gaps, "step"), f"{self.length.sum():.1f} m", f"{self.start:.1f} to {self.end:.1f} s"]
        return [*some, *([count(gaps, "gap")] if gaps else [])]


class Measured(Protocol):
    """A table of measurements. time: of each row [s]."""

    @property
    def time(self) -> Array: ...  # noqa: D102


@dataclass(frozen=True)
class Levels(Rows, row="level"):
    """Mean signal strengths of beacons over parts of a walk; ``l`` levels, ``m`` beacons.

    time: ``(l,)`` [s]; beacon: ``(l,)`` its row in the table of beacons; rssi: ``(l,)`` mean [dBm].
    label: name of each beacon; position: ``(m, 2)`` [m], NaN where unknown; sigma: ``(m,)`` per axis [m].
    """

    time: Array
    beacon: Index
    rssi: Array
    label: tuple[str, ...] = field(metadata=TABLE)
    position: Array = field(metadata=TABLE)
    sigma: Array = field(metadata=TABLE)

    reference: ClassVar[str] = "beacon"
    limits: ClassVar[Limits] = {
        "rssi": (-200.0, 200.0),
        "position": (-FARTHEST, FARTHEST),
        "sigma": (FINEST, FARTHEST),
    }
    most: ClassVar[None] = None  # as many as there are beacons


@dataclass(frozen=True)
class Closures(Rows, row="closure"):
    """Loop closures: ``l`` pairs of times at which the walker was at one place. Some may be wrong.

    time: ``(l, 2)`` both times of each pair [s]; sigma: ``(l,)`` per axis of the distance between both places [m].
    walk: ``(l, 2)`` number of the walk of each time, if there are several walks.
    """

    time: Array
    sigma: Array
    walk: Index

    limits: ClassVar[Limits] = {"sigma": (FINEST, FARTHEST)}
    most: ClassVar[int] = 2

    @classmethod
    def of(cls, rows: Sequence[tuple[float, float, float]], walks: Sequence[tuple[int, int]] = ()) -> Closures:
        """Closures from rows of two times [s] and a sigma [m]; all in walk 0 by default."""
        table = np.array(rows, dtype=float).reshape(-1, 3)
        walk = np.array(walks, dtype=np.intp).reshape(-1, 2) if walks else np.zeros((len(table), 2), np.intp)
        return cls(table[:, :2], table[:, 2], walk)

    @classmethod
    def concatenate(cls, parts: Sequence[Closures]) -> Closures:
        """The closures of all parts, in their order; 0 rows for an empty list."""
        return concatenate([cls.of([]), *parts])

    def shifted(self, begins: Array) -> Closures:
        """Closures of one walk: the times of walk ``w`` are ``begins[w]`` [s] later, and every walk number is 0."""
        return replace(self, time=self.time + begins[self.walk], walk=np.zeros_like(self.walk))


@dataclass(frozen=True)
class Ranges(Rows, row="range"):
    """Distances to anchors: UWB, Wi-Fi RTT, BLE ranging; ``n`` ranges, ``m`` anchors.

    time: ``(n,)`` [s]; anchor: ``(n,)`` its row in the table of anchors; range: ``(n,)`` [m]; sigma: ``(n,)`` with line
    of sight [m].
    label: of each anchor; position: ``(m, 2)`` [m]; position_sigma: ``(m,)`` of its survey, per axis [m].
    """

    time: Array
    anchor: Index
    range: Array
    sigma: Array
    label: tuple[str, ...] = field(metadata=TABLE)
    position: Array = field(metadata=TABLE)
    position_sigma: Array = field(metadata=TABLE)

    reference: ClassVar[str] = "anchor"
    limits: ClassVar[Limits] = {
        "range": (0.0, FARTHEST),
        "sigma": (FINEST, FARTHEST),
        "position": (-FARTHEST, FARTHEST),
        "position_sigma": (FINEST, FARTHEST),
    }
    most: ClassVar[int] = 10

    def __post_init__(self) -> None:
        """Raise ValueError on what would make an estimate NaN or silently wrong."""
        for name in ("time", "range", "sigma", "position", "position_sigma"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"Ranges.{name}: found a value that is not finite, expected finite numbers")
        if (self.sigma <= 0).any() or (self.range < 0).any() or (self.position_sigma <= 0).any():
            raise ValueError("Ranges: found a range below 0 m or a sigma not above 0 m, expected distances and sigmas")


@dataclass(frozen=True)
class UntimedFixes(Rows, row="place"):
    """Places where the walker was at an unknown time: receipts, photos, rooms of a calendar. Some may be wrong.

    time: ``(n, 2)`` earliest and latest [s]; position: ``(n, 2)`` in the output frame [m]; sigma: ``(n,)`` per axis
    [m]; label: of each place.
    """

    time: Array
    position: Array
    sigma: Array
    label: tuple[str, ...]

    limits: ClassVar[Limits] = {"position": (-FARTHEST, FARTHEST), "sigma": (FINEST, FARTHEST)}
    most: ClassVar[int] = 2

    def __post_init__(self) -> None:
        """Raise ValueError on what would make an estimate NaN or silently wrong."""
        check_finite(self, "time", "position", "sigma")
        if self.time.shape[1:] != (2,) or self.position.shape[1:] != (2,):
            found = f"{self.time.shape}, {self.position.shape}"
            raise ValueError(f"UntimedFixes.time, position: found shapes {found}, expected (n, 2) of both")
        check_each("UntimedFixes.sigma", self.sigma > 0, self.sigma, "standard deviations above 0 m")
        late = self.time[:, 0] <= self.time[:, 1]
        check_each("UntimedFixes.time", late, self.time[:, 0], "an earliest time that is not after the latest")


@dataclass(frozen=True)
class UntimedFixReport:
    """How a place without a time was used.

    time: when the walk was nearest [s]; distance: from the walk then [m]; weight: share of its information that was
    used, 0-1; others: further times at which it is about as near, as of a walker who comes back the same way [s].
    """

    label: str
    time: float
    x: float
    y: float
    sigma: float
    distance: float
    weight: float
    reason: str
    others: tuple[float, ...] = ()


@dataclass(frozen=True)
class RangeReport:
    """How one range was used.

    residual: measured minus expected [m], positive if the range is too long; weight: share of its information that was
    used, 0-1.
    """

    time: float
    anchor: str
    range: float
    sigma: float
    residual: float
    weight: float
    reason: str


OK, DOUBTFUL, FAILED = "ok", "doubtful", "failed"
STATES = (OK, DOUBTFUL, FAILED)  # from the best to the worst


@dataclass(frozen=True)
class Contradiction(OneLineRepr):
    """What one source of a walk says against the others, or what keeps its estimate from being determined.

    source: "fixes", "GNSS", "beacons", "plan", "stride", "start", "headings", …; against: the sources that it
    contradicts; amount, unit: how much ("sigma", "m", "share"); text: one sentence for the user; check: what the user
    should check; state: of the estimate with this contradiction, "doubtful", or "failed" if nothing is consistent.
    """

    source: str
    against: str
    amount: float
    unit: str
    text: str
    check: str
    state: str = DOUBTFUL

    def describe(self) -> dict[str, Any]:
        """Return the contradiction for `summary.json`; an unknown amount is None."""
        return asdict(self) | {"amount": self.amount if isfinite(self.amount) else None}

    def _summary(self) -> list[str]:
        return [f"{self.source} against {self.against}", f"{self.amount:.3g} {self.unit}".strip(), self.state]


@dataclass(frozen=True)
class Verdict(OneLineRepr):
    """Whether an estimate can be trusted.

    state: "ok"; "doubtful" if something contradicts something else; "failed" if nothing is consistent. reasons: the
    contradictions, empty for "ok".
    """

    state: str
    reasons: tuple[Contradiction, ...] = ()

    @classmethod
    def of(cls, reasons: Iterable[Contradiction]) -> Verdict:
        """The verdict with these reasons: the worst of their states, "ok" without any. The worst reasons come first."""
        ordered = sorted(dict.fromkeys(reasons), key=lambda reason: -STATES.index(reason.state))
        return cls(ordered[0].state if ordered else OK, tuple(ordered))

    @property
    def ok(self) -> bool:
        """True if nothing contradicts the estimate."""
        return self.state == OK

    def describe(self) -> dict[str, Any]:
        """Return the verdict for `summary.json`."""
        return {"state": self.state, "reasons": [reason.describe() for reason in self.reasons]}

    def __str__(self) -> str:
        return f"{self.state}: {'; '.join(reason.text for reason in self.reasons) or 'no reason for doubt found'}"

    def _summary(self) -> list[str]:
        return [self.state, *([count(len(self.reasons), "reason")] if self.reasons else [])]


@dataclass(frozen=True)
class Calibration(OneLineRepr):
    """Estimated calibration of walker and gyroscope, one row per segment of about a hundred steps.

    The coefficients are R_s and R_d of [map-matching] Eqs. (4), (5) and the E_straight of [calibration-walk] Eq. (9)
    written as a gyro drift: true length = R_s × length, true turn = R_d × turn + b × Δt.

    start: ``(s,)`` start of each segment [s]; value: ``(s, 3)`` R_s [-], R_d [-], b [rad/s].
    covariance: ``(s, 3, 3)``; prior_sigma: ``(s, 3)`` prior standard deviations; usual: R_s of a usual walker, 1 unless
    a profile has corrected the steps.
    """

    start: Array
    value: Array
    covariance: Array
    prior_sigma: Array
    usual: float = 1.0

    names: ClassVar[tuple[str, ...]] = ("R_s", "R_d", "b")

    @property
    def stride(self) -> float:
        """Mean R_s of the walk as a share of that of a usual walker; above 0."""
        return max(float(self.value[:, 0].mean()) / self.usual, 1e-9)

    @property
    def sigma(self) -> Array:
        """Standard deviations ``(s, 3)`` of `value`."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def learnt(self) -> Mask:
        """``(s, 3)``: True where the measurements at least halved the prior's variance."""
        return self.sigma**2 < 0.5 * self.prior_sigma**2

    def _summary(self) -> list[str]:
        last = [f"{n} {v:.4g} ± {s:.2g}" for n, v, s in zip(self.names, self.value[-1], self.sigma[-1], strict=True)]
        return [count(len(self.start), "segment"), f"last: {', '.join(last)}"]


DUPLICATE, OUTSIDE = "duplicate epoch: not used twice", "outside the recording: not used"  # reasons in reports
FROZEN = "the receiver held its position while the walk went on: not used"
LOUD_BEACON = "a loud beacon: used only to find where to start"


@dataclass(frozen=True)
class FixReport:
    """Residual and weight of one fix, and the reason for the weight.

    residual: distance from the smoothed position [m]; weight: share of its stated information that was used, 0–1;
    x, y, sigma: of the fix [m]; source: its receiver, as in `Fixes`.
    """

    time: float
    x: float
    y: float
    sigma: float
    residual: float
    weight: float
    reason: str
    source: str = ""


@dataclass(frozen=True)
class BeaconReport:
    """Estimate of one beacon.

    label: its name in messages; levels: number of its mean signal strengths; residual: mean absolute residual of these
    levels [dB]; x, y: estimated position [m]; misplaced: True if it differs from the listed position.
    """

    label: str
    levels: int
    residual: float
    x: float
    y: float
    misplaced: bool
    reason: str


@dataclass(frozen=True)
class Estimate(OneLineRepr):
    """The estimated walk.

    trajectory: start pose, one row per step at its end, last pose; dead_reckoning: the same rows from the steps alone,
    rigidly aligned to the fixes; calibration: None if the method has none; reports: of each measurement by kind:
    "fixes" in input order, "beacons".
    iterations: of the optimiser; cost: half the sum of squared, robustly weighted residuals, NaN if not defined;
    converged: False if the optimiser stopped before the cost converged; probability: of this route, against other
    routes that also explain the measurements, NaN if it is unknown; routes: probability and path of each route, this
    one first, empty if nothing but the fixes determines it.
    warnings: what a user must know before trusting the result; contradictions: between its sources, see `verdict`;
    placed: the place of a live walk was certain before the first report; assumed: the errors of sources by which this
    walk is explained, as "kind: error".
    graph: the `WalkGraph` that was smoothed, with all decisions about its measurements, at its optimum; None of other
    methods, and where the estimate was copied or pickled.
    """

    trajectory: Trajectory
    dead_reckoning: Trajectory
    calibration: Calibration | None
    reports: Mapping[str, tuple[Any, ...]]
    iterations: int
    cost: float
    converged: bool
    probability: float = np.nan
    warnings: tuple[str, ...] = ()
    contradictions: tuple[Contradiction, ...] = ()
    routes: tuple[tuple[float, Trajectory], ...] = ()
    placed: bool = False
    assumed: tuple[str, ...] = ()
    graph: Any = field(default=None, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """All fields but the graph, which is as large as the walk: who made the estimate has it."""
        return {name: value for name, value in vars(self).items() if name not in ("graph", "_between")}

    def at(self, time: float | Array) -> Trajectory:
        """Poses with covariance at any times [s] from start to end, a row for each; at the time of a row, that row.

        Between rows it is the marginal of the graph: the step is split there. An estimate without its graph (of the
        filter, of a live walk, or copied) is linear between rows, see `interpolated`.
        Raises ValueError for times outside the walk.
        """
        return interpolated(self.trajectory, np.atleast_1d(np.asarray(time, dtype=float)), self._between)

    @cached_property
    def _between(self) -> Between | None:
        """Poses and covariances by the graph at its optimum; None without it."""
        return None if self.graph is None else self.graph.between()

    @property
    def fixes(self) -> tuple[FixReport, ...]:
        """A report of each fix, in input order."""
        return self.reports.get("fixes", ())

    @property
    def beacons(self) -> tuple[BeaconReport, ...]:
        """A report of each received beacon."""
        return self.reports.get("beacons", ())

    @property
    def untimed(self) -> tuple[UntimedFixReport, ...]:
        """A report of each place without a time."""
        return self.reports.get("untimed", ())

    def _summary(self) -> list[str]:
        state, kinds = "converged" if self.converged else "not converged", self.reports.items()
        counts = [f"{len(rows)} {kind}" for kind, rows in kinds if rows]
        return [count(len(self.trajectory), "pose"), *time_span(self.trajectory), *counts, state]


@cache
def declarations(record_type: type) -> dict[str, str]:
    """How each field of a data type or measurement kind is declared: "row", "keyframe", "table"; "" if it is not."""
    columns = fields(record_type) if is_dataclass(record_type) else ()
    return {each.name: each.metadata.get(DECLARED_AS, "") for each in columns}


def declared(record_type: type, column: dict[str, str]) -> list[str]:
    """The names of the fields of a data type or measurement kind that are declared ROW, KEYFRAME or TABLE."""
    return [name for name, declaration in declarations(record_type).items() if declaration == column[DECLARED_AS]]


def keyframes_of(kind: Any) -> Index | None:
    """The keyframe ``(n,)`` of each instance of a measurement kind; None if no field is declared KEYFRAME."""
    name = next(iter(declared(type(kind), KEYFRAME)), "")
    return getattr(kind, name) if name else None


def row_columns(record: Any) -> dict[str, Any]:
    """The columns of a table or measurement kind that have a value per row, by name.

    Raises ValueError if a column has another number of values than the record has rows. Empty columns are left out.
    """
    keyframe, columns = keyframes_of(record), dict[str, Any]()
    rows = len(record) if keyframe is None else len(keyframe)
    for name, declaration in declarations(type(record)).items():
        values = getattr(record, name)
        is_column = isinstance(values, (np.ndarray, tuple)) or "time" in declarations(type(values))
        if declaration == TABLE[DECLARED_AS] or not is_column:
            continue
        if len(values) == rows:
            columns[name] = values
        elif len(values):
            hint = "what belongs to the table as a whole is declared field(metadata=TABLE)"
            raise ValueError(f"{type(record).__name__}.{name}: found {len(values)} rows, expected {rows}; {hint}")
    return columns


def rows_of(column: Any, index: Index) -> Any:
    """The rows ``index (n,)`` of a column: an array, a tuple or a table."""
    if isinstance(column, np.ndarray):
        return column[index]
    return tuple(map(column.__getitem__, index.tolist())) if isinstance(column, tuple) else take(column, index)


def wrap_angle(angle: Array | float) -> Array:
    """The angle wrapped to [-π, π). [rad]"""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def differences(poses: Array, others: Array) -> Array:
    """Differences ``(n, m)`` of poses or states, that of headings, the third column, wrapped."""
    apart = poses - others
    apart[:, 2] = wrap_angle(apart[:, 2])
    return apart


def interpolated(track: Trajectory, time: Array, between: Between | None = None) -> Trajectory:
    """Rows of a track at times ``(n,)`` [s] between its first and its last row.

    between: poses and covariances at any times, in the output axes. Rows may have more than these: other solutions,
    widened covariances; the difference is linear between two rows, so that the result at a row is that row. Without it
    all is linear: half-way through a step of 0.7 m that turns by 0.5 rad, a position is then off by 4 cm.

    Raises ValueError for other times.
    """
    n, (start, end) = len(track), track.time[[0, -1]].tolist() if len(track) else (np.nan, np.nan)
    if not ((time >= start) & (time <= end)).all():
        found = f"times from {time.min():.3f} to {time.max():.3f} s"
        raise ValueError(f"at: found {found}, expected those of the walk, {start:.3f} to {end:.3f} s")
    before = np.clip(np.searchsorted(track.time, time, side="right") - 1, 0, max(n - 2, 0))
    after = np.minimum(before + 1, n - 1)
    elapsed = track.time[after] - track.time[before]
    share = np.divide(time - track.time[before], elapsed, out=np.zeros(len(time)), where=elapsed > 0)
    rows = np.column_stack([track.position, track.heading])
    pose = rows[before] + share[:, None] * differences(rows[after], rows[before])
    covariance = track.covariance
    if covariance is not None:
        covariance = covariance[before] + share[:, None, None] * (covariance[after] - covariance[before])
    if between is not None and len(time):
        (here, i, j), (P, P_i, P_j) = (
            column.reshape(3, len(time), *column.shape[1:])
            for column in between(np.concatenate([time, track.time[before], track.time[after]]))
        )
        pose += differences(here, i) - share[:, None] * differences(j, i)
        if covariance is not None:
            covariance += P - P_i - share[:, None, None] * (P_j - P_i)
    label = np.searchsorted(track.time, time).tolist()
    floor = tuple(track.floor[row] for row in label)
    return Trajectory(time, pose[:, :2], wrap_angle(pose[:, 2]), floor, covariance)


def take(data: Table, which: int | slice | Mask | Index) -> Table:
    """The rows `which` of a table; what belongs to the table as a whole is kept, as `row_columns` says."""
    size = len(data)
    index = np.arange(*which.indices(size)) if isinstance(which, slice) else np.atleast_1d(np.arange(size)[which])
    return _with_columns(data, {name: rows_of(column, index) for name, column in row_columns(data).items()})


def _with_columns(data: Table, columns: Mapping[str, Any]) -> Table:
    """The table with other columns, whose rows were validated when their tables were made."""
    table = object.__new__(type(data))
    for name in declarations(type(data)):
        object.__setattr__(table, name, columns[name] if name in columns else getattr(data, name))
    return table


def repeated(kind: Table, which: Index, keyframe: Index) -> Table:
    """The instances ``which (n,)`` of a measurement kind, any of them several times, bound to keyframes ``(n,)``."""
    columns = {name: rows_of(column, which) for name, column in row_columns(kind).items()}
    return replace(kind, **columns | dict.fromkeys(declared(type(kind), KEYFRAME), keyframe))


def appended(data: Table, more: Table) -> Table:
    """The rows of `data` and then of `more`, of the same type; what belongs to the whole table is taken from `more`."""
    both = {name: _stacked([getattr(data, name), getattr(more, name)]) for name in row_columns(data)}
    return _with_columns(more, both)


def with_offset(data: Table, seconds: float) -> Table:
    """The table with `seconds` added to its times."""
    return replace(data, time=data.time + seconds)


def concatenate(parts: Sequence[Table]) -> Table:
    """The rows of at least one table, all of one type, in the order of the parts.

    The list that rows refer to is merged: a label names one beacon or anchor, described by the first part that has it.
    """
    parts = [part for part in parts if len(part)] or list(parts[:1])
    first = parts[0]
    if len(parts) == 1:
        return first
    joined = {name: _stacked([getattr(part, name) for part in parts]) for name in row_columns(first)}
    reference = getattr(type(first), "reference", None)
    if reference is not None:
        named: dict[tuple[str, int], tuple[Table, int]] = {}
        keys = [list(_keys(part)) for part in parts]
        for part, of_part in zip(parts, keys, strict=True):
            for m, key in enumerate(of_part):
                named.setdefault(key, (part, m))
        row_of = {key: row for row, key in enumerate(named)}
        rows = [np.array([row_of[key] for key in of_part], dtype=np.intp) for of_part in keys]
        numbers = [row[getattr(part, reference)] for row, part in zip(rows, parts, strict=True)]
        joined[reference] = np.concatenate(numbers)
        for name in declared(type(first), TABLE):
            values = [getattr(part, name)[m] for part, m in named.values()]
            joined[name] = tuple(values) if isinstance(getattr(first, name), tuple) else np.array(values)
    return replace(first, **joined)


def by_type(tables: Sequence[Any]) -> tuple[Any, ...]:
    """The tables with all of one type concatenated, in the order in which the types first appear."""
    kinds = dict.fromkeys(type(table) for table in tables)
    return tuple(concatenate([table for table in tables if type(table) is kind]) for kind in kinds)


def last_time(data: Any) -> Array:
    """The time ``(n,)`` at which each row is complete: its only time, or the later of two. [s]"""
    return data.time if data.time.ndim == 1 else data.time.max(axis=1)


def _stacked(columns: Sequence[Any]) -> Any:
    """Columns of several tables below each other: arrays or tuples."""
    if isinstance(columns[0], np.ndarray):
        return np.concatenate(columns)
    return tuple(value for column in columns for value in column)


def _keys(part: Any) -> Iterator[tuple[str, int]]:
    """The label of each beacon or anchor of a part, and how often it stands before in its list.

    A label that stands several times in one list names several things, in the order of the list.
    """
    before = Counter[str]()
    for label in part.label:
        yield label, before[label]
        before[label] += 1
