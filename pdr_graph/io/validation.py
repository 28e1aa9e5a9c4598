"""Input validation: builds a ``Recording`` from the raw columns of any reader, and fixes from a receiver's rows.

Damage that can be repaired with certainty is repaired and noted with numbers; other damage raises InputError. The notes
appear among the warnings of ``summary.json``. The same rules hold for all recorders.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, TypeVar

import numpy as np

from pdr_graph.errors import InputError, slow_rate
from pdr_graph.types import (
    INERTIAL,
    LONLAT,
    STANDARD_GRAVITY,
    Array,
    Fixes,
    Mask,
    Recording,
    Sightings,
    Signal,
    Trajectory,
)

IMPLAUSIBLE = 1e12  # times [s] and values in any unit from here on are damage, as are NaN and infinity
Timed = TypeVar("Timed", Signal, Fixes, Sightings, Trajectory)


@dataclass(frozen=True)
class DamageLimits:
    """Limits between damage that is repaired and damage that raises InputError. Chosen by hand.

    missing: share of a sensor's rows without a value; unordered: share of its rows out of time order, and
    back: by how much [s]: the threads of a recorder write so, a shuffled file exceeds both.
    """

    missing: float = 0.2
    unordered: float = 0.01
    back: float = 1.0


DAMAGE = DamageLimits()


def build_recording(
    path: str,
    source: str,
    tables: Mapping[str, Array],
    unix_zero: float | None,
    fixes: Fixes | None = None,
    bluetooth: Sightings | None = None,
    wifi: Sightings | None = None,
    truth: Trajectory | None = None,
    notes: Sequence[str] = (),
) -> Recording:
    """Build the recording from a reader's raw columns, all times on the recorder's own clock.

    path: name of the files in messages; source: name of the recording in titles.
    tables: per sensor ``(n, 1 + k)`` times [s] and values, rows of NaN where a value is missing.
    unix_zero: Unix time at which the recorder's clock is zero [s], None if unknown.

    Raises InputError if a sensor's rows are damaged, or their unit is not recognised.
    """
    notes = list(notes)
    signals: dict[str, Signal] = {}
    for sensor, table in tables.items():
        cleaned = _clean(path, sensor, table, notes)
        if len(cleaned):
            # Copies, since columns of a table are slow to pass over
            signals[sensor] = Signal(cleaned[:, 0].copy(), cleaned[:, 1:].copy())
    check_times(path, signals)
    check_one_unit(path, signals)
    signals = _units(path, signals, notes)
    note_clipping(signals, notes)
    _check_rates(signals, notes)
    _check_clocks(path, signals, notes)

    starts = [signals[s].time[0] for s in INERTIAL if s in signals] or [s.time[0] for s in signals.values()]
    starts = starts or [part.time[0] for part in (fixes, truth) if part is not None and len(part)]
    if not starts:
        raise InputError(path, "", "no sensor rows and no positions", "the rows of a sensor, or positions")
    origin = float(min(starts))
    _check_fixes(signals, fixes, notes)
    return Recording(
        source=source,
        clock_origin=origin,
        epoch=None if unix_zero is None else unix_zero + origin,
        accelerometer=_since(origin, signals.get("accelerometer")),
        gyroscope=_since(origin, signals.get("gyroscope")),
        magnetometer=_since(origin, signals.get("magnetometer")),
        linear_acceleration=_since(origin, signals.get("linear_acceleration")),
        barometer=_since(origin, signals.get("barometer")),
        fixes=_since(origin, fixes) or Fixes.none(),
        bluetooth=_since(origin, bluetooth),
        wifi=_since(origin, wifi),
        truth=_since(origin, truth),
        notes=tuple(notes),
    )


def _since(origin: float, part: Timed | None) -> Timed | None:
    """`part` with times relative to ``origin`` [s]; None without rows."""
    return replace(part, time=part.time - origin) if part is not None and len(part) else None


def _clean(path: str, sensor: str, table: Array, notes: list[str]) -> Array:
    """The rows with a value, sorted by time, without duplicates; repairs are added to `notes`."""
    with np.errstate(invalid="ignore"):
        plausible = np.abs(table) < IMPLAUSIBLE
    valid = np.ones(len(table), dtype=bool) if plausible.all() else plausible.all(axis=1)
    missing = int((~valid).sum())
    if missing > DAMAGE.missing * len(table):
        found, expected = f"{missing} of {len(table)} rows without a value", "rows of finite numbers"
        if (late := np.isfinite(table[:, 0]) & (np.abs(table[:, 0]) >= IMPLAUSIBLE)).mean() > DAMAGE.missing:
            found = f"{late.sum()} times from {table[late, 0].min():.3g} s on"
            expected = "times in the recorder's unit (are these in a smaller one?)"
        raise InputError(path, sensor, found, expected)
    if missing:
        notes.append(f"{sensor}: {missing} rows without a value were left out")
    ordered = _in_order(path, sensor, table[valid] if missing else table, notes)
    return _spread(sensor, _without_repeats(sensor, ordered, notes), notes)


def _in_order(path: str, sensor: str, table: Array, notes: list[str]) -> Array:
    """The rows sorted by time; raises InputError if too many are out of order."""
    step = np.diff(table[:, 0])
    back = step < 0
    if not back.any():
        return table
    if back.mean() > DAMAGE.unordered or -step.min() > DAMAGE.back:
        row = int(np.argmin(step)) + 1
        found = f"times that go back {int(back.sum())} times, by {-step.min():.3f} s at the sensor's row {row + 1}"
        expected = "rows in order of time (a shuffled file, or a clock that was set while recording?)"
        raise InputError(path, sensor, found, expected)
    notes.append(f"{sensor}: {int(back.sum())} rows out of order by up to {-step.min():.3f} s were sorted")
    return table[np.argsort(table[:, 0], kind="stable")]


def _without_repeats(sensor: str, table: Array, notes: list[str]) -> Array:
    """The rows without repeats of the row before: same time and values."""
    repeated = np.zeros(len(table), dtype=bool)
    again = np.flatnonzero(table[1:, 0] == table[:-1, 0]) + 1
    repeated[again] = (table[again] == table[again - 1]).all(axis=1)
    if not repeated.any():
        return table
    notes.append(f"{sensor}: {int(repeated.sum())} repeated rows were left out")
    return table[~repeated]


def _spread(sensor: str, table: Array, notes: list[str]) -> Array:
    """The rows with samples of equal time spread evenly to the next tick: the clock is coarser than the sensor."""
    if (np.diff(table[:, 0]) > 0).all():
        return table
    ticks, first, count = np.unique(table[:, 0], return_index=True, return_counts=True)
    if len(ticks) == len(table) or len(ticks) < 2:
        return table[first]
    notes.append(f"{sensor}: {len(table) - len(ticks)} samples share their time with another and were spread evenly")
    interval = np.minimum(np.diff(ticks, append=2 * ticks[-1] - ticks[-2]), np.median(np.diff(ticks)))
    number = np.arange(len(table)) - np.repeat(first, count)
    time = np.repeat(ticks, count) + number * np.repeat(interval / count, count)
    return np.column_stack([time, table[:, 1:]])


def _units(path: str, signals: dict[str, Signal], notes: list[str]) -> dict[str, Signal]:
    """The signals converted to SI units, hPa and µT; an accelerometer without gravity gets its own name."""
    signals = dict(signals)
    if "accelerometer" in signals:
        signal = signals.pop("accelerometer")
        sensor, factor = unit_of(path, "accelerometer", signal, notes)
        signals.setdefault(sensor, _scaled(signal, factor))
    for sensor in ("gyroscope", "barometer"):
        if sensor in signals:
            signals[sensor] = _scaled(signals[sensor], unit_of(path, sensor, signals[sensor], notes)[1])
    return signals


PASCAL_FROM, KILOPASCAL_TO = 2000.0, 200.0  # a larger pressure is in Pa, a smaller in kPa: people walk at 400–1050 hPa


def unit_of(path: str, sensor: str, signal: Signal, notes: list[str]) -> tuple[str, float]:
    """The kind of a sensor by its values, and the factor that converts them to SI units, hPa and µT.

    Raises InputError if an accelerometer's unit is not recognised.
    """
    if sensor == "accelerometer":
        return _acceleration(path, signal, notes)
    if sensor == "gyroscope":
        median = float(np.median(np.linalg.norm(signal.values, axis=1)))
        if median > FASTEST_TURN:
            notes.append(f"gyroscope: a median of {median:.1f} can only be degrees per second; converted to rad/s")
            return sensor, np.pi / 180
    if sensor == "barometer":
        median = float(np.median(signal.values))
        factor = 0.01 if median > PASCAL_FROM else 10.0 if median < KILOPASCAL_TO else 1.0
        if factor != 1.0:
            unit = "Pa" if factor < 1 else "kPa"
            notes.append(f"barometer: a median of {median:.5g} can only be in {unit}; converted to hPa")
        return sensor, factor
    return sensor, 1.0


def _acceleration(path: str, signal: Signal, notes: list[str]) -> tuple[str, float]:
    """The kind of an accelerometer, with or without gravity, and the factor that converts it to m/s².

    Over a stride the walker's own acceleration averages out, and gravity remains.
    """
    gravity = float(np.median(mean_magnitudes(signal)))
    median = float(np.median(np.linalg.norm(signal.values, axis=1)))
    if GRAVITY[0] <= gravity <= GRAVITY[1]:
        return "accelerometer", 1.0
    if GRAVITY_IN_G[0] <= gravity <= GRAVITY_IN_G[1] and gravity > 0.7 * median:
        notes.append(f"accelerometer: gravity is {gravity:.3f}: the unit is g; converted to m/s²")
        return "accelerometer", STANDARD_GRAVITY
    if gravity < 0.5 * median and median < GRAVITY[0]:
        notes.append(f"accelerometer: gravity is {gravity:.3f} m/s²: the recorder removed it")
        return "linear_acceleration", 1.0
    expected = f"{STANDARD_GRAVITY:.2f} m/s², 1 g, or 0 where the recorder removes it"
    raise InputError(path, "accelerometer", f"gravity of {gravity:.3f} (median of {WINDOW:.0f} s means)", expected)


def _scaled(signal: Signal, factor: float) -> Signal:
    return signal if factor == 1.0 else replace(signal, values=signal.values * factor)


def _check_rates(signals: dict[str, Signal], notes: list[str]) -> None:
    """Note inertial sensors that are slow or have gaps."""
    for sensor in (s for s in INERTIAL if s in signals and len(signals[s]) > 1):
        signal = signals[sensor]
        if signal.rate < 15.0:  # slowest rate [Hz] below which peaks of steps are missed
            notes.append(f"{sensor}: {signal.rate:.1f} Hz is too slow to detect every step{slow_rate(signal.rate)}")
        interval = np.diff(signal.time)
        gaps = interval[are_gaps(signal)]
        if len(gaps):
            place = signal.time[int(np.argmax(interval))] - signal.time[0]
            notes.append(f"{sensor}: {len(gaps)} gaps, the longest of {gaps.max():.2f} s after {place:.1f} s")


def are_gaps(signal: Signal) -> Mask:
    """True for intervals between samples ``(n - 1,)`` longer than 0.5 s and than five median intervals."""
    return np.diff(signal.time) > max(0.5, 5 / signal.rate if signal.rate else np.inf)


def _check_clocks(path: str, signals: dict[str, Signal], notes: list[str]) -> None:
    """Raise InputError unless accelerometer and gyroscope overlap in time; note different spans."""
    gyroscope = signals.get("gyroscope")
    other = signals.get("accelerometer") or signals.get("linear_acceleration")
    if gyroscope is None or other is None:
        return
    begins, ends = gyroscope.time[0] - other.time[0], gyroscope.time[-1] - other.time[-1]
    if min(gyroscope.time[-1], other.time[-1]) <= max(gyroscope.time[0], other.time[0]):
        raise InputError(
            path,
            "gyroscope",
            f"a start {begins:.1f} s after the accelerometer's, without overlap",
            "sensors on one clock that overlap in time",
        )
    # noted difference [s] between the starts or ends of two sensors from which it is noted
    if max(abs(begins), abs(ends)) > 1.0:
        notes.append(f"gyroscope: begins {begins:+.1f} s and ends {ends:+.1f} s after the accelerometer")


def _check_fixes(signals: dict[str, Signal], fixes: Fixes | None, notes: list[str]) -> None:
    """Note fixes that do not overlap the sensors in time."""
    inertial = [signals[s] for s in INERTIAL if s in signals]
    if fixes is None or not len(fixes) or not inertial:
        return
    start, end = min(s.time[0] for s in inertial), max(s.time[-1] for s in inertial)
    if fixes.time[0] > end or fixes.time[-1] < start:
        apart = fixes.time[0] - start
        notes.append(f"position fixes: they begin {apart:+.1f} s from the sensors' start (another clock or day?)")


RADIUS_68 = 1.51  # [σ per axis] radius of 68 % of a circular normal distribution: a phone's "accuracy"


@dataclass(frozen=True)
class ReceiverErrors:
    """The errors of a phone's receiver where its rows do not state them.

    accuracy: 68 % radius outdoors [m], if a row has none; satellites: fewest for a position; extrapolated: factor of
    true over stated error with fewer, measured on real walks.
    """

    accuracy: float = 7.5
    satellites: int = 4
    extrapolated: float = 1.5


RECEIVER = ReceiverErrors()


def receiver_fixes(table: Array, notes: list[str], source: str = "GNSS", satellites: Array | None = None) -> Fixes:
    """Fixes, sorted by time, from a receiver's rows.

    table: ``(n, 4)`` time [s], latitude and longitude [deg], accuracy (68 % radius) [m], in any order. satellites:
    ``(n,)`` number used for each position, NaN if unknown; it matters only where there are too few: on real walks it
    adds nothing to a stated accuracy otherwise.

    Left out and noted: rows without a valid position, rows with a negative accuracy (iOS's mark of an invalid
    position), and duplicate epochs. An accuracy of zero or NaN counts as unknown.
    """
    if satellites is not None:
        factor = np.where(satellites < RECEIVER.satellites, RECEIVER.extrapolated, 1.0)
        table = np.column_stack([table[:, :3], factor * table[:, 3]])
    time, lat, lon, accuracy = table.T
    valid = np.isfinite(table[:, :3]).all(axis=1) & (np.abs(lat) <= 90) & (np.abs(lon) <= 180)
    valid &= ~(accuracy < 0) & ~((lat == 0) & (lon == 0))
    if not valid.all():
        notes.append(f"{source}: {int((~valid).sum())} of {len(table)} positions are invalid or missing")
    table = table[valid][np.argsort(time[valid], kind="stable")]
    repeated = np.zeros(len(table), dtype=bool)
    repeated[1:] = np.diff(table[:, 0]) == 0
    if repeated.any():
        notes.append(f"{source}: {int(repeated.sum())} duplicate epochs were left out")
    time, lat, lon, accuracy = table[~repeated].T
    unknown = ~(accuracy > 0) | np.isinf(accuracy)
    if unknown.any():
        assumed = f"{RECEIVER.accuracy} m (68 %) is assumed"
        notes.append(f"{source}: {int(unknown.sum())} positions have no accuracy: {assumed}")
    sigma = np.where(unknown, RECEIVER.accuracy, accuracy) / RADIUS_68
    return Fixes(time, np.column_stack([lon, lat]), sigma, ("",) * len(time), LONLAT, (source,) * len(time))


def surveyed(time: Array, position: Array, floor: tuple[str, ...] | None = None, epsg: int | None = None) -> Trajectory:
    """Ground truth from surveyed positions ``(n, 2)`` at times ``(n,)`` [s]; its headings are NaN."""
    return Trajectory(time, position, np.full(len(time), np.nan), floor or ("",) * len(time), epsg=epsg)


def float_of(value: Any) -> float:
    """A number, or a text that is one, from untrusted JSON or XML; NaN for others."""
    try:
        return math.nan if isinstance(value, bool) or value is None else float(value)
    except (ValueError, TypeError, OverflowError):
        return math.nan


def iso_time(value: Any) -> float:
    """Unix time [s] of an ISO 8601 text, UTC without an offset; NaN for others."""
    try:
        time = datetime.fromisoformat(value)
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    except (TypeError, ValueError, OverflowError):
        return math.nan


GRAVITY = (8.0, 11.5)  # [m/s²] accepted means over WINDOW; 9.5–10.2 on real walks
GRAVITY_IN_G = (0.85, 1.15)  # [g] the same range for a recorder that writes g
WINDOW = 2.0  # [s] one or two strides, over which the walker's own acceleration averages out
FASTEST_TURN = 10.0  # [rad/s] median angular rate; larger values can only be deg/s


@dataclass(frozen=True)
class Windows:
    """A signal in windows of WINDOW. time: ``(w,)`` begin of each [s]; typical: median magnitude; mean: magnitude of
    the mean vector; both in the unit of the signal; swing: standard deviation of the magnitude over its median.
    """

    time: Array
    typical: Array
    mean: Array
    swing: Array

    @classmethod
    def of(cls, signal: Signal) -> Windows:
        """The windows of a signal; its last samples that fill none are left out, unless there is none."""
        parts = _parts(signal)
        number, samples, _ = parts.shape
        size = np.linalg.norm(parts, axis=2)
        typical = np.median(size, axis=1)
        swing = size.std(axis=1) / np.maximum(typical, np.finfo(float).tiny)
        return cls(signal.time[: number * samples : samples], typical, mean_magnitudes(signal), swing)


def _parts(signal: Signal) -> Array:
    """The values ``(w, k, 3)`` of each window."""
    samples = min(max(1, round(WINDOW * signal.rate)), len(signal))
    number = len(signal) // samples
    return signal.values[: number * samples].reshape(number, samples, -1)


def mean_magnitudes(signal: Signal) -> Array:
    """Magnitude ``(w,)`` of the mean vector in windows of WINDOW, as of `Windows`."""
    return np.linalg.norm(_parts(signal).mean(axis=1), axis=1)


FEWEST_WINDOWS = 2  # windows in the other unit
TYPICAL_SPREAD = 1.4  # factor between gravity and the median magnitude of a walk's acceleration, at most
DEG_PER_RAD = 180 / np.pi
RATIO = (DEG_PER_RAD / 2, DEG_PER_RAD * 2)  # of angular rates in windows of two units, in deg/s and in rad/s
SIMILAR_SWING = 1.5  # factor between the acceleration in windows of two units: else a ride and a run in deg/s


def check_one_unit(path: str, signals: dict[str, Signal]) -> None:
    """Raise InputError if a sensor's unit changes: acceleration from m/s² to g, angular rate from rad/s to deg/s, or
    back. Windows without gravity or steps fit both units and are not counted.
    """
    if "accelerometer" not in signals:
        return
    felt = Windows.of(signals["accelerometer"])
    metric, in_g = (_shows_gravity(felt, limits) for limits in (GRAVITY, GRAVITY_IN_G))
    _refuse_mixture(path, "accelerometer", felt, metric, in_g, ("m/s²", "g"))
    if "gyroscope" in signals:
        turns = Windows.of(signals["gyroscope"])
        swing = np.interp(turns.time, felt.time, felt.swing)
        # walking: swing of the acceleration in windows with steps: a phone that lies or is held still turns slowly
        walking = swing > 0.1
        degrees = walking & (turns.typical > FASTEST_TURN)
        radians = walking & (turns.typical <= FASTEST_TURN) & (turns.typical > 0)
        if degrees.any() and radians.any():
            ratio, effort = (np.median(v[degrees]) / np.median(v[radians]) for v in (turns.typical, swing))
            if RATIO[0] < ratio < RATIO[1] and 1 / SIMILAR_SWING < effort < SIMILAR_SWING:
                _refuse_mixture(path, "gyroscope", turns, radians, degrees, ("rad/s", "deg/s"))


def _shows_gravity(windows: Windows, limits: tuple[float, float]) -> Mask:
    """True for windows ``(w,)`` whose mean and whose typical magnitude are gravity in one unit."""
    mean = (windows.mean >= limits[0]) & (windows.mean <= limits[1])
    spread = (windows.typical >= limits[0] / TYPICAL_SPREAD) & (windows.typical <= limits[1] * TYPICAL_SPREAD)
    return mean & spread


def _refuse_mixture(
    path: str, sensor: str, windows: Windows, first: Mask, second: Mask, units: tuple[str, str]
) -> None:
    """Raise InputError if there are windows in both units."""
    if min(first.sum(), second.sum()) < FEWEST_WINDOWS:
        return
    known = np.flatnonzero(first | second)
    change = known[np.flatnonzero(np.diff(second[known].astype(int)))[0] + 1]
    (before, after) = units if second[change] else units[::-1]
    at, value = windows.time[change] - windows.time[0], windows.typical[change]
    found = f"values in {before}, and from {at:.0f} s on in {after}: a median of {value:.3g}"
    raise InputError(path, sensor, found, "one unit throughout (two recordings in one file?)")


LONGEST_GAP = 14 * 86_400.0  # [s] without samples in one recording
FASTEST_RATE = 20_000.0  # [Hz]; sensors of phones have up to 500, research units some thousand


def check_times(path: str, signals: dict[str, Signal]) -> None:
    """Raise InputError for a sensor whose clock leaps ahead by more than LONGEST_GAP, or that is above FASTEST_RATE:
    times in a larger unit than the recorder's.
    """
    for sensor, signal in signals.items():
        step = np.diff(signal.time)
        if step.max(initial=0.0) > LONGEST_GAP:
            row = int(np.argmax(step)) + 1
            found = f"times that leap ahead by {step.max() / 86_400:.0f} days at the sensor's row {row + 1}"
            raise InputError(path, sensor, found, "one recording (a clock that was set, or another unit of time?)")
        if signal.rate > FASTEST_RATE:
            found = f"{signal.rate:.3g} samples per second"
            raise InputError(
                path, sensor, found, f"at most {FASTEST_RATE:.0f} (times in another unit than the recorder's?)"
            )


SMALLEST_RANGE = {"accelerometer": 15.0, "gyroscope": 4.0}  # [m/s², rad/s] sensors have 2 g and 250 deg/s, or more


def note_clipping(signals: dict[str, Signal], notes: list[str]) -> None:
    """Note inertial sensors whose range was exceeded: `signals` in SI units."""
    for sensor, smallest in SMALLEST_RANGE.items():
        if sensor in signals and (largest := np.abs(signals[sensor].values).max()) > smallest:
            number = sum(clipped(axis) for axis in signals[sensor].values.T)
            if number > 0.001 * len(signals[sensor]):  # noted share of a sensor's samples that are clipped
                unit = "m/s²" if sensor == "accelerometer" else "rad/s"
                notes.append(f"{sensor}: {number} samples at the end of its range, {largest:.1f} {unit} (saturated)")


def clipped(values: Array) -> int:
    """Count samples of one axis in runs at its largest or smallest value; 0 for a constant axis."""
    if np.ptp(values) == 0:
        return 0
    edge = np.flatnonzero(
        np.diff(np.concatenate([[False], (values == values.max()) | (values == values.min()), [False]]))
    )
    length = edge[1::2] - edge[::2]
    # clipped: consecutive samples at the extreme value: an unclipped peak has one, two by rounding
    return int(length[length >= 3].sum())
