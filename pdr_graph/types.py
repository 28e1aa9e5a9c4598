"""The nouns of pdr_graph, and its conventions, stated once.

* SI units and radians inside; degrees and compass bearings only in readers, writers and the command line.
* World is East-North-Up about an origin, or the floor plan's own metric frame (x right, y up on the plan).
  Heading is counter-clockwise from +x. ``R_world_device`` maps device to world: inner names cancel.
* Time is float64 seconds from the recording's start; ``Recording.clock_origin`` takes it to the recorder's clock.
* Arrays are samples-first, ``(n, 3)``. Nouns are frozen; functions return new values and never change their inputs.
* Intervals are ``[start, end)``. Uncertainty is a standard deviation ``sigma_*`` or a covariance ``(n, d, d)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from pdr_graph.errors import expect

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]
Complex = NDArray[np.complex128]  # points or moves of the plane
Columns = TypeVar("Columns", "Fixes", "Trajectory")
SENSORS = ("accelerometer", "gyroscope", "magnetometer", "linear_acceleration", "barometer")
MOST_TURNED = 4 * np.pi  # [rad] of a heading, that may be unwrapped; beyond, it is in degrees
INSTANT = 1e-6  # [s]: times closer than this are the same
STANDARD_GRAVITY = 9.80665  # [m/s²]
LONLAT = 4326  # EPSG code of longitude and latitude on WGS 84 [deg]


@dataclass(frozen=True)
class Signal:
    """The samples of one sensor.

    time: ``(n,)`` [s], increasing.
    values: ``(n, 3)``, in the unit of the sensor (m/s² with gravity, rad/s, µT), on the Android device axes
        (x right, y up, z out of the screen); a barometer's are ``(n, 1)`` [hPa].
    """

    time: Array
    values: Array

    def __post_init__(self) -> None:
        """Raise ValueError unless there is a row of values for each time."""
        if np.ndim(self.time) != 1 or np.ndim(self.values) != 2 or len(self.time) != len(self.values):
            found = f"shapes {np.shape(self.time)} and {np.shape(self.values)}"
            raise ValueError(f"Signal: found times and values of {found}, needed (n,) and (n, 3), a barometer's (n, 1)")

    def __len__(self) -> int:
        return len(self.time)

    @property
    def rate(self) -> float:
        """Samples per second, by the usual interval between them; gaps do not lower it. [Hz]"""
        return float(1 / np.median(np.diff(self.time))) if len(self) > 1 else 0.0


@dataclass(frozen=True)
class Sightings:
    """What a radio heard: Bluetooth beacons or Wi-Fi access points.

    time: ``(n,)`` when each was heard [s]; transmitter: its identity, one per row; rssi: ``(n,)`` received power [dBm];
    minor: an iBeacon's own number, one per row, where the log has it.
    """

    time: Array
    transmitter: tuple[str, ...]
    rssi: Array
    minor: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Beacons:
    """Transmitters whose places were surveyed.

    name: of each, as ``Sightings.transmitter`` has it; position: ``(m, 2)`` [m] in the output frame, or in that of
    ``epsg``, NaN where unknown; sigma: ``(m,)`` of the survey [m], per axis; floor: labels, empty where unknown.
    label: what a message calls each.
    """

    name: tuple[str, ...]
    position: Array
    sigma: Array
    floor: tuple[str, ...]
    label: tuple[str, ...]
    epsg: int | None = None

    def __len__(self) -> int:
        return len(self.name)


@dataclass(frozen=True)
class Fixes:
    """Positions measured now and then: GNSS, BLE, Wi-Fi, or given by the user.

    time: ``(n,)`` [s].
    position: ``(n, 2)`` [m] in the output frame, or in that of ``epsg``.
    sigma: ``(n,)`` standard deviation *per axis* [m].
    floor: floor label per fix, empty where unknown; need not be given where all are.
    epsg: None in the output frame; LONLAT where ``position`` is longitude and latitude [deg]; a projection's code.
    source: of each fix, the receiver whose errors stay alike for a while; empty where errors are independent, the
        default.
    """

    time: Array
    position: Array
    sigma: Array
    floor: tuple[str, ...] = ()
    epsg: int | None = None
    source: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError on what would make an estimate NaN or silently wrong."""
        _check_finite(self, "time", "position", "sigma")
        if self.position.shape[1:] != (2,):
            raise ValueError(f"Fixes.position: found shape {self.position.shape}, needed (n, 2)")
        _check("Fixes.sigma", self.sigma > 0, self.sigma, "standard deviations above 0 m")
        if not self.floor:
            object.__setattr__(self, "floor", ("",) * len(self.time))
        if len(self.floor) != len(self.time):
            raise ValueError(f"Fixes.floor: found {len(self.floor)} labels, needed {len(self.time)}")
        if len(self.source) not in (0, len(self.time)):
            raise ValueError(f"Fixes.source: found {len(self.source)} names, needed {len(self.time)}")

    @classmethod
    def none(cls) -> Fixes:
        """No fix at all."""
        return cls(np.empty(0), np.empty((0, 2)), np.empty(0), ())

    @classmethod
    def together(cls, parts: Sequence[Fixes]) -> Fixes:
        """All of them, in one frame, in order of time."""
        some = [part for part in parts if len(part)]
        if len(some) < 2:
            return some[0] if some else cls.none()
        time, position, sigma = (np.concatenate([getattr(p, n) for p in some]) for n in ("time", "position", "sigma"))
        floor, source = (tuple(x for p in some for x in getattr(p, n)) for n in ("floor", "sources"))
        return cls(time, position, sigma, floor, some[0].epsg, source)[np.argsort(time, kind="stable")]

    def later(self, by: float) -> Fixes:
        """The same, so much later [s]."""
        return replace(self, time=self.time + by)

    @property
    def sources(self) -> tuple[str, ...]:
        """The source of every fix ``(n,)``."""
        return self.source or ("",) * len(self)

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, which: int | slice | Mask | Index) -> Fixes:
        """A selection, itself ``Fixes``: ``fixes[0]``, ``fixes[2:5]``, ``fixes[mask]``."""
        return _rows(self, which)


@dataclass(frozen=True)
class Headings:
    """Walking directions measured now and then: by a compass, or given by the user.

    time: ``(n,)`` [s], in order.
    heading: ``(n,)`` counter-clockwise from +x of the output frame [rad].
    sigma: ``(n,)`` [rad]. Errors of different headings are independent.
    """

    time: Array
    heading: Array
    sigma: Array

    def __post_init__(self) -> None:
        """Raise ValueError on what would make an estimate NaN or silently wrong."""
        _check_finite(self, "time", "heading", "sigma")
        _check("Headings.heading", np.abs(self.heading) <= MOST_TURNED, self.heading, "radians, not degrees")
        _check("Headings.sigma", self.sigma > 0, self.sigma, "standard deviations above 0 rad")

    @classmethod
    def none(cls) -> Headings:
        """No heading at all."""
        return cls(np.empty(0), np.empty(0), np.empty(0))

    @classmethod
    def together(cls, parts: Sequence[Headings]) -> Headings:
        """All of them, one after the other."""
        columns = ([getattr(part, name) for part in (cls.none(), *parts)] for name in ("time", "heading", "sigma"))
        return cls(*(np.concatenate(column) for column in columns))

    def later(self, by: float) -> Headings:
        """The same, so much later [s]."""
        return replace(self, time=self.time + by)

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Trajectory:
    """A path over time: an estimate, or the truth.

    time: ``(n,)`` [s].
    position: ``(n, 2)`` [m].
    heading: ``(n,)`` [rad] counter-clockwise from +x, NaN where unknown.
    floor: the plan's label per row, empty where unknown; need not be given where all are.
    covariance: ``(n, 3, 3)`` of (x, y, heading) in the output axes [m, m, rad], or None.
    epsg: of a surveyed truth, as of ``Fixes``; None in the output frame.
    """

    time: Array
    position: Array
    heading: Array
    floor: tuple[str, ...] = ()
    covariance: Array | None = None
    epsg: int | None = None

    def __post_init__(self) -> None:
        """Raise ValueError unless there is a position, a heading and a label for each time."""
        if not self.floor:
            object.__setattr__(self, "floor", ("",) * len(self.time))
        rows = len(self.time)
        if np.shape(self.position) != (rows, 2) or np.shape(self.heading) != (rows,) or len(self.floor) != rows:
            found = f"shapes {np.shape(self.position)} and {np.shape(self.heading)}, and {len(self.floor)} labels"
            raise ValueError(f"Trajectory: found {found} at {rows} times, needed ({rows}, 2), ({rows},) and {rows}")

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, which: int | slice | Mask | Index) -> Trajectory:
        """Some rows, themselves a ``Trajectory``: ``track[0]``, ``track[2:5]``, ``track[mask]``."""
        return _rows(self, which)


@dataclass(frozen=True)
class Recording:
    """What a phone recorded. A sensor that was not recorded is None.

    source: name for messages and titles.
    clock_origin: the recorder's own time [s] at ``t = 0``; outputs are written in that clock.
    epoch: Unix time [s] at ``t = 0``, None if the log has no clock.
    accelerometer: with gravity [m/s²]; gyroscope [rad/s]; magnetometer [µT]; barometer [hPa].
    linear_acceleration: with gravity removed by the recorder; read only where there is no ``accelerometer``.
    fixes: positions inside the recording.
    bluetooth, wifi: what its radios heard; beacons: where the beacons among them are, None where nobody says.
    truth: surveyed positions inside the recording. For scoring and drawing only: no estimate reads it.
    notes: what the reader left out or had to assume, one line each.
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
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise TypeError unless each sensor is a signal."""
        for name in SENSORS:
            expect(f"Recording, {name}", getattr(self, name), Signal, None, instead="Signal(time, values)")

    @property
    def has_acceleration(self) -> bool:
        """Whether there is an acceleration to find steps in."""
        return self.accelerometer is not None or self.linear_acceleration is not None

    @property
    def signals(self) -> dict[str, Signal]:
        """The sensors that were recorded, by name."""
        return {name: signal for name in SENSORS if (signal := getattr(self, name)) is not None}


@dataclass(frozen=True)
class Steps:
    """The walk as the front end saw it, and all that the back end knows of it.

    start, end: first and last sample of the recording [s].
    time: ``(n,)`` end of each step [s], increasing.
    duration: ``(n,)`` time under way [s]; before ``time - duration`` the walker stood still.
    length: ``(n,)`` [m].
    turn: ``(n,)`` heading change since the previous row's time (the first: since ``start``) [rad], counter-clockwise.
    pause_turn: ``(n,)`` the part of ``turn`` made while standing, before the step set off [rad].
    sigma_length: ``(n,)`` [m]; sigma_turn: ``(n,)`` [rad]. Errors of different steps are independent.
    final_turn: heading change from the last step to ``end`` [rad].
    unknown: what the recording could not tell of the steps, a line each.

    A row of length 0 is a gap in the recording: the walker went anywhere within ``sigma_length``.
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
    unknown: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError on what would make an estimate NaN or silently wrong."""
        columns = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
        _check_finite(self, *columns)
        if not (np.isfinite([self.start, self.end, self.final_turn]).all() and self.start < self.end):
            raise ValueError(f"Steps: found start {self.start} and end {self.end}, needed start < end")
        before = np.concatenate([[self.start], self.time[:-1]])
        in_order = (self.time > before) & (self.time <= self.end + INSTANT)
        _check("Steps.time", in_order, self.time, "times that increase, from start to end")
        under_way = (self.duration > 0) & (self.time - self.duration >= before - INSTANT)
        _check("Steps.duration", under_way, self.duration, "steps that begin after the one before has ended")
        _check("Steps.sigma_length", self.sigma_length > 0, self.sigma_length, "standard deviations above 0 m")
        _check("Steps.sigma_turn", self.sigma_turn > 0, self.sigma_turn, "standard deviations above 0 rad")

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Calibration:
    """What the walk taught about walker and gyro, one row per segment of about a hundred steps.

    The coefficients are R_s and R_d of [map-matching] Eqs. (4), (5) and the E_straight of [calibration-walk] Eq. (9)
    written as a gyro drift: true length = R_s × length, true turn = R_d × turn + b × Δt.

    start: ``(s,)`` first instant of each segment [s].
    value: ``(s, 3)`` R_s [-], R_d [-], b [rad/s].
    covariance: ``(s, 3, 3)``.
    prior_sigma: ``(s, 3)`` standard deviations before any measurement.
    """

    start: Array
    value: Array
    covariance: Array
    prior_sigma: Array

    names: ClassVar[tuple[str, ...]] = ("R_s", "R_d", "b")

    @property
    def sigma(self) -> Array:
        """Standard deviations ``(s, 3)``."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def learnt(self) -> Mask:
        """``(s, 3)``: True where the measurements at least halved the prior's variance."""
        return self.sigma**2 < 0.5 * self.prior_sigma**2


@dataclass(frozen=True)
class FixReport:
    """Why one fix was trusted or not.

    residual: distance from the smoothed position [m]; weight: share of its stated information that was used, 0–1.
    """

    time: float
    x: float
    y: float
    sigma: float
    residual: float
    weight: float
    reason: str


@dataclass(frozen=True)
class BeaconReport:
    """What the walk tells of one beacon.

    label: its name in messages; levels: how often it was heard, stretch by stretch; residual: mean distance of these
    levels from those expected [dB]; x, y: where it is, as the walk has it [m]; misplaced: True if that is not where it
    is listed.
    """

    label: str
    levels: int
    residual: float
    x: float
    y: float
    misplaced: bool
    reason: str


@dataclass(frozen=True)
class Estimate:
    """The answer to "which way did this person walk?".

    trajectory: start pose, one row per step at its end, last pose. See design section 4.
    dead_reckoning: the same rows from steps alone, laid on the fixes as a rigid shape.
    calibration: None where the method has none.
    fixes: one report per fix, in the order given; beacons: one per beacon that was heard.
    iterations: of the optimiser; cost: half the sum of squared, robustly weighted errors, NaN where there is none.
    converged: False if the optimiser stopped before the cost settled.
    probability: of this walk, against others that explain the measurements too and go elsewhere.
    warnings: what a user must know before trusting the result.
    """

    trajectory: Trajectory
    dead_reckoning: Trajectory
    calibration: Calibration | None
    fixes: tuple[FixReport, ...]
    iterations: int
    cost: float
    converged: bool
    probability: float = 1.0
    beacons: tuple[BeaconReport, ...] = ()
    warnings: tuple[str, ...] = ()


def _rows(of: Columns, which: int | slice | Mask | Index) -> Columns:
    """Some rows of what has an array or a tuple for each column; a column that is None or empty stays so."""
    index = np.atleast_1d(np.arange(len(of.time))[which])
    taken: dict[str, Array | tuple[str, ...]] = {}
    for name, column in vars(of).items():
        if isinstance(column, np.ndarray):
            taken[name] = column[index]
        elif isinstance(column, tuple) and column:
            taken[name] = tuple(column[i] for i in index)
    return replace(of, **taken)


def _check_finite(of: object, *columns: str) -> None:
    """Columns ``(n, …)`` as arrays of the same length, times first; lists are taken too."""
    rows = len(_as_array(of, columns[0]))
    for name in columns:
        values = _as_array(of, name)
        if len(values) != rows or not np.isfinite(values).all():
            bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1)) if len(values) else []
            place = f"row {bad[0]}: {values[bad[0]]}" if len(bad) else f"{len(values)} rows"
            raise ValueError(f"{type(of).__name__}.{name}: found {place}, needed {rows} finite rows")


def _as_array(of: object, name: str) -> Array:
    """A column as the array that it has to be."""
    given = getattr(of, name)
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(())
    if not values.ndim:
        raise ValueError(f"{type(of).__name__}.{name}: found {type(given).__name__}, needed an array of numbers")
    object.__setattr__(of, name, values)
    return values


def _check(name: str, good: Mask, values: Array, needed: str) -> None:
    if not good.all():
        row = int(np.argmin(good))
        raise ValueError(f"{name}, row {row}: found {values[row]}, needed {needed}")
