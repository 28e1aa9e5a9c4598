"""Input validation: builds a ``Recording`` from the raw columns of any reader, and fixes from a receiver's rows.

Damage that can be repaired with certainty is repaired and noted with numbers; other damage raises InputError. The notes
appear among the warnings of ``summary.json``. The same rules hold for all recorders.
"""

from __future__ import annotations

import math
import re
import time as clock
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, TypeVar

import numpy as np

from pdr_graph.errors import InputError, count, slow_rate
from pdr_graph.geometry import wrap_angle
from pdr_graph.inertial.units import BY_PLATFORM, IMPLAUSIBLE, axis_scales, check_one_unit, unit_of
from pdr_graph.types import (
    DAY_LENGTH,
    GNSS,
    INERTIAL,
    LONLAT,
    Array,
    Fixes,
    Mask,
    Recording,
    Sightings,
    Signal,
    Trajectory,
)

Timed = TypeVar("Timed", Signal, Fixes, Sightings, Trajectory)


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
    counted: Array | None = None,
    sign_odds: float = -BY_PLATFORM,
) -> Recording:
    """Build the recording from a reader's raw columns, all times on the recorder's own clock.

    path: name of the files in messages; source: name of the recording in titles.
    tables: per sensor ``(n, 1 + k)`` times [s] and values, rows of NaN where a value is missing.
    unix_zero: Unix time at which the recorder's clock is zero [s], None if unknown.
    counted: ``(n, 2)`` times [s] and the number of steps by the phone's own counter; NaN where unknown.
    sign_odds: as of ``Recording``; by default the recorder is known to have Android's sign, or the reader converted it.

    Raises InputError if a sensor's rows are damaged, or their unit is not recognised.
    """
    notes = list(notes)
    signals: dict[str, Signal] = {}
    if fixes is not None and unix_zero is not None and not (valid := plausible_times(unix_zero + fixes.time)).all():
        notes.append(f"position fixes: {int((~valid).sum())} with times before 1970 or after tomorrow left out")
        fixes = fixes[valid]
    for sensor, table in tables.items():
        cleaned = _clean(path, sensor, table, notes)
        if len(cleaned):
            # Copies, since columns of a table are slow to pass over
            signals[sensor] = Signal(cleaned[:, 0].copy(), cleaned[:, 1:].copy())
    check_one_unit(path, signals)
    for sensor in ("accelerometer", "gyroscope", "magnetometer", "barometer"):
        if sensor in signals:
            signal = signals.pop(sensor)
            if sensor == "accelerometer" and (scales := axis_scales(signal)) is not None:
                signal = replace(signal, values=signal.values * scales)
                factors = ", ".join(f"{scale:.2f}" for scale in scales)
                notes.append(f"accelerometer: gravity is not 9.81 m/s²: its axes are multiplied by {factors}")
            kind, factor = unit_of(path, sensor, signal, notes)
            signals.setdefault(kind, signal if factor == 1.0 else replace(signal, values=signal.values * factor))
    if "gyroscope" in signals and (noise := white_noise(signals["gyroscope"])) > MOST_NOISE:
        notes.append(f"gyroscope: not used: {noise:.0%} of it is noise from sample to sample")
        del signals["gyroscope"]
    _note_quality(signals, notes)
    _check_clocks(path, signals, fixes, notes)

    starts = [signals[s].time[0] for s in INERTIAL if s in signals] or [s.time[0] for s in signals.values()]
    counter = None if counted is None else _counter(counted)
    starts = starts or [part.time[0] for part in (counter, fixes, truth) if part is not None and len(part)]
    if not starts:
        raise InputError(path, "", "no sensor rows and no positions", "the rows of a sensor, or positions")
    origin = float(min(starts))
    return Recording(
        source=source,
        clock_origin=origin,
        epoch=None if unix_zero is None else unix_zero + origin,
        accelerometer=_since(origin, signals.get("accelerometer")),
        gyroscope=_since(origin, signals.get("gyroscope")),
        magnetometer=_since(origin, signals.get("magnetometer")),
        linear_acceleration=_since(origin, signals.get("linear_acceleration")),
        barometer=_since(origin, signals.get("barometer")),
        step_counter=_since(origin, counter),
        fixes=_since(origin, fixes) or Fixes.none(),
        bluetooth=_since(origin, bluetooth),
        wifi=_since(origin, wifi),
        truth=_since(origin, truth),
        notes=tuple(notes),
        sign_odds=sign_odds,
    )


def _counter(rows: Array) -> Signal:
    """The readings of a step counter in order of time; of several at one time the largest."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.lexsort(rows.T[::-1])]
    rows = rows[np.diff(rows[:, 0], append=np.inf) > 0]
    return Signal(rows[:, 0].copy(), rows[:, 1:].copy())


def fullest(rows: Mapping[str, int]) -> str:
    """The name of the table of a sensor to use: the first with at least half of the rows of the longest.

    rows: number of rows by name, in order of preference.
    """
    most = max(rows.values())
    return next(name for name, number in rows.items() if 2 * number >= most)


def _since(origin: float, part: Timed | None) -> Timed | None:
    """`part` with times relative to ``origin`` [s]; None without rows."""
    return replace(part, time=part.time - origin) if part is not None and len(part) else None


def _clean(path: str, sensor: str, table: Array, notes: list[str]) -> Array:
    """The rows with a value, sorted by time, without duplicates; repairs are added to `notes`.

    Raises InputError for more damage than a recorder does: a fifth of the rows without a value, 1 % of the rows out of
    order or one by more than a second, a clock that leaps ahead, or a rate that no sensor has.
    """
    with np.errstate(invalid="ignore"):
        plausible = np.abs(table) < IMPLAUSIBLE
    valid = np.ones(len(table), dtype=bool) if plausible.all() else plausible.all(axis=1)
    missing, most = int((~valid).sum()), 0.2 * len(table)
    if missing > most:
        found, expected = f"{missing} of {len(table)} rows without a value", "rows of finite numbers"
        if (late := np.isfinite(table[:, 0]) & (np.abs(table[:, 0]) >= IMPLAUSIBLE)).sum() > most:
            found = f"{late.sum()} times from {table[late, 0].min():.3g} s on"
            expected = "times in the recorder's unit (are these in a smaller one?)"
        raise InputError(path, sensor, found, expected)
    if missing:
        notes.append(f"{sensor}: {missing} rows without a value were left out")
        table = table[valid]

    step = np.diff(table[:, 0])
    if (back := step < 0).any():
        by, times = f"{-step.min():.3f} s", int(back.sum())
        if back.mean() > 0.01 or -step.min() > 1.0:  # the threads of a recorder write rows less out of order
            found = f"times that go back {times} times, by {by} at the sensor's row {np.argmin(step) + 2}"
            expected = "rows in order of time (a shuffled file, or a clock that was set while recording?)"
            raise InputError(path, sensor, found, expected)
        notes.append(f"{sensor}: {times} rows out of order by up to {by} were sorted")
        table = table[np.argsort(table[:, 0], kind="stable")]

    repeated = np.zeros(len(table), dtype=bool)
    again = np.flatnonzero(table[1:, 0] == table[:-1, 0]) + 1
    repeated[again] = (table[again] == table[again - 1]).all(axis=1)
    if repeated.any():
        notes.append(f"{sensor}: {int(repeated.sum())} repeated rows were left out")
        table = table[~repeated]

    step = np.diff(table[:, 0])
    if not (step > 0).all():  # the clock is coarser than the sensor: samples are spread evenly to the next tick
        ticks, first, count = np.unique(table[:, 0], return_index=True, return_counts=True)
        if len(ticks) < 2:
            return table[first]
        shared = len(table) - len(ticks)
        notes.append(f"{sensor}: {shared} samples share their time with another and were spread evenly")
        interval = np.minimum(np.diff(ticks, append=2 * ticks[-1] - ticks[-2]), np.median(np.diff(ticks)))
        number = np.arange(len(table)) - np.repeat(first, count)
        time = np.repeat(ticks, count) + number * np.repeat(interval / count, count)
        table, step = np.column_stack([time, table[:, 1:]]), np.diff(time)

    if step.max(initial=0.0) > 14 * DAY_LENGTH:
        found = f"times that leap ahead by {step.max() / DAY_LENGTH:.0f} days at the sensor's row {np.argmax(step) + 2}"
        raise InputError(path, sensor, found, "one recording (a clock that was set, or another unit of time?)")
    # sensors of phones have up to 500 Hz, research units some thousand
    if len(step) and (rate := 1 / np.median(step)) > 20_000:
        found = f"{rate:.3g} samples per second"
        raise InputError(path, sensor, found, "at most 20000 (times in another unit than the recorder's?)")
    return table


def _note_quality(signals: dict[str, Signal], notes: list[str]) -> None:
    """Note inertial sensors that are slow, have gaps, or whose range was exceeded."""
    for sensor in (s for s in INERTIAL if s in signals and len(signals[s]) > 1):
        signal = signals[sensor]
        # sensors have a range of 2 g and 250 deg/s, or more
        smallest, unit = (15.0, "m/s²") if sensor == "accelerometer" else (4.0, "rad/s")
        if (largest := np.abs(signal.values).max()) > smallest and sensor != "linear_acceleration":
            number = sum(clipped(axis) for axis in signal.values.T)
            if number > 0.001 * len(signal):
                notes.append(f"{sensor}: {number} samples at the end of its range, {largest:.1f} {unit} (saturated)")
        if signal.rate < 15.0:  # slowest rate [Hz] below which peaks of steps are missed
            notes.append(f"{sensor}: {signal.rate:.1f} Hz is too slow to detect every step{slow_rate(signal.rate)}")
        interval = np.diff(signal.time)
        gaps = interval[are_gaps(signal)]
        if len(gaps):
            place = signal.time[int(np.argmax(interval))] - signal.time[0]
            notes.append(f"{sensor}: {count(len(gaps), 'gap')}, the longest of {gaps.max():.2f} s after {place:.1f} s")


MOST_NOISE = 0.5  # share of a gyroscope's variation: at most 0.13 in 130 recordings of ten phones at 50 Hz and more


def white_noise(signal: Signal) -> float:
    """Standard deviation of the independent errors of samples, by their fourth differences, over that of the samples.

    0 for few and slow samples, and for a gyroscope at rest.
    """
    if len(signal) < 50 or signal.rate < 40.0:  # [Hz] below which the motion of a walker changes as fast
        return 0.0
    rough = np.diff(signal.values, n=4, axis=0)  # have 70 times the variance of independent errors
    varies = float(np.sqrt(np.mean(np.var(signal.values, axis=0))))
    return float(np.sqrt(np.mean(rough**2) / 70)) / varies if varies > 0.1 else 0.0


def are_gaps(signal: Signal) -> Mask:
    """True for intervals between samples ``(n - 1,)`` longer than 0.5 s and than five median intervals."""
    return np.diff(signal.time) > max(0.5, 5 / signal.rate if signal.rate else np.inf)


def clipped(values: Array) -> int:
    """Count samples of one axis in runs of three or more at its largest or smallest value; 0 for a constant axis."""
    if np.ptp(values) == 0:
        return 0
    at_end = (values == values.max()) | (values == values.min())
    begin, end = np.flatnonzero(np.diff(np.pad(at_end, 1).astype(int))).reshape(-1, 2).T
    length = end - begin
    return int(length[length >= 3].sum())


def _check_clocks(path: str, signals: dict[str, Signal], fixes: Fixes | None, notes: list[str]) -> None:
    """Raise InputError unless accelerometer and gyroscope overlap in time; note different spans, also of the fixes."""
    inertial = [signals[s] for s in INERTIAL if s in signals]
    other = signals.get("accelerometer") or signals.get("linear_acceleration")
    if other is not None and (gyroscope := signals.get("gyroscope")) is not None:
        begins, ends = gyroscope.time[0] - other.time[0], gyroscope.time[-1] - other.time[-1]
        if min(gyroscope.time[-1], other.time[-1]) <= max(gyroscope.time[0], other.time[0]):
            found = f"a start {begins:.1f} s after the accelerometer's, without overlap"
            raise InputError(path, "gyroscope", found, "sensors on one clock that overlap in time")
        span, beside, same = np.ptp(gyroscope.time), np.ptp(other.time), len(gyroscope) / len(other)
        if abs(same - 1) < 0.02 < abs(span / beside - 1) - 0.03:  # of sensors that were sampled together
            found = f"{len(gyroscope)} samples in {span:.1f} s, of the accelerometer in {beside:.1f} s"
            raise InputError(path, "gyroscope", found, "sensors on one clock")
        if max(abs(begins), abs(ends)) > 1.0:
            notes.append(f"gyroscope: begins {begins:+.1f} s and ends {ends:+.1f} s after the accelerometer")
    if fixes is not None and len(fixes) and inertial:
        start, end = min(s.time[0] for s in inertial), max(s.time[-1] for s in inertial)
        if fixes.time[0] > end or fixes.time[-1] < start:
            apart = fixes.time[0] - start
            notes.append(f"position fixes: they begin {apart:+.1f} s from the sensors' start (another clock or day?)")


MOST_SPEED = 1000.0  # [m/s] that a receiver states
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


def receiver_fixes(table: Array, notes: list[str], source: str = GNSS, satellites: Array | None = None) -> Fixes:
    """Fixes, sorted by time, from a receiver's rows.

    table: ``(n, 4)`` time [s], latitude and longitude [deg], accuracy (68 % radius) [m], in any order; with up to four
    more columns: speed [m/s], course [deg] clockwise from north, and their accuracies (one sigma), NaN or negative
    where unknown. satellites: ``(n,)`` number used for each position, NaN if unknown; it matters only where there are
    too few: on real walks it adds nothing to a stated accuracy otherwise.

    Left out and noted: rows without a valid position, rows with a negative accuracy (iOS's mark of an invalid
    position), and duplicate epochs. An accuracy of zero or NaN counts as unknown.
    """
    if satellites is not None:
        factor = np.where(satellites < RECEIVER.satellites, RECEIVER.extrapolated, 1.0)
        table = np.column_stack([table[:, :3], factor * table[:, 3], table[:, 4:]])
    time, lat, lon, accuracy = table[:, :4].T
    valid = np.isfinite(table[:, :3]).all(axis=1) & (np.abs(lat) <= 90) & (np.abs(lon) <= 180)
    valid &= ~(accuracy < 0) & ~((lat == 0) & (lon == 0))
    if not valid.all():
        notes.append(f"{source}: {int((~valid).sum())} of {len(table)} positions are invalid or missing")
    table = table[valid][np.argsort(time[valid], kind="stable")]
    repeated = np.zeros(len(table), dtype=bool)
    repeated[1:] = np.diff(table[:, 0]) == 0
    if repeated.any():
        notes.append(f"{source}: {int(repeated.sum())} duplicate epochs were left out")
    table = np.column_stack([table[~repeated], np.full((int((~repeated).sum()), 8 - table.shape[1]), np.nan)])
    time, lat, lon, accuracy, speed, bearing, speed_sigma, bearing_sigma = table.T
    unknown = ~(accuracy > 0) | np.isinf(accuracy)
    if unknown.any():
        assumed = f"{RECEIVER.accuracy} m (68 %) is assumed"
        notes.append(f"{source}: {int(unknown.sum())} positions have no accuracy: {assumed}")
    sigma = np.where(unknown, RECEIVER.accuracy, accuracy) / RADIUS_68
    return Fixes(
        time,
        np.column_stack([lon, lat]),
        sigma,
        epsg=LONLAT,
        source=(source,) * len(time),
        speed=np.where((speed >= 0) & (speed < MOST_SPEED), speed, np.nan),
        course=wrap_angle(np.pi / 2 - np.radians(np.where((bearing >= 0) & (bearing <= 360), bearing, np.nan))),
        speed_sigma=np.where((speed_sigma > 0) & (speed_sigma < MOST_SPEED), speed_sigma, np.nan),
        course_sigma=np.radians(np.where((bearing_sigma > 0) & (bearing_sigma <= 360), bearing_sigma, np.nan)),
    )


def surveyed(
    time: Array,
    position: Array,
    floor: tuple[str, ...] | None = None,
    epsg: int | None = None,
    sigma: float | None = None,
) -> Trajectory:
    """Ground truth from surveyed positions ``(n, 2)`` at times ``(n,)`` [s]; its headings are NaN.

    sigma: of the positions per axis [m], None if unknown.
    """
    covariance = None if sigma is None else isotropic(np.full(len(time), sigma))
    return Trajectory(time, position, np.full(len(time), np.nan), floor or ("",) * len(time), covariance, epsg)


def plausible_times(time: Array) -> Mask:
    """True for Unix times ``(n,)`` [s] from 1970 to tomorrow, by a clock here that may not be set: 2027 at least."""
    return (time >= 0) & (time < max(clock.time(), 1.8e9) + DAY_LENGTH)


def isotropic(sigma: Array) -> Array:
    """Covariances ``(n, 3, 3)`` of (x, y, heading) from the sigmas ``(n,)`` [m] of positions per axis."""
    return sigma[:, None, None] ** 2 * np.diag([1.0, 1.0, 0.0])


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


def unix_time(value: Any) -> float:
    """Unix time [s] of one number in s, ms, µs or ns, or of an ISO 8601 text (UTC without an offset); else NaN."""
    number = float_of(value)
    return float(in_seconds(np.array([number]))[0]) if math.isfinite(number) else iso_time(value)


# UTC times as most programs write them, which numpy parses all at once
PLAIN_TIMES = re.compile(r"(?:\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z )*", re.ASCII)


def unix_times(values: Sequence[Any]) -> Array:
    """`unix_time` of each ``(n,)`` [s]."""
    with suppress(ValueError, TypeError):
        if PLAIN_TIMES.fullmatch(" ".join([*values, ""])):
            return np.array([text[:-1] for text in values], dtype="datetime64[ms]").astype(float) / 1000
    return np.array([unix_time(value) for value in values], dtype=float)


LOST_WEEKS = "1024 weeks early, as of a receiver whose weeks overflowed: put right"
ROLLOVER = 1024 * 7 * 86400.0  # [s] after which GPS counts its weeks anew: some receivers then lose them
MAYBE_LOST = "if the receiver lost 1024 weeks"
OVERFLOW = 1_554_508_800.0  # Unix time of the last overflow [s]: 2019-04-06


def rolls_over(leap: Array) -> Mask:
    """True for leaps of time [s] that are 1024 weeks back, with a pause of the track of half a day at most."""
    return (leap + ROLLOVER > -3600.0) & (leap + ROLLOVER < 43_200.0)


def without_rollover(time: Array, name: str, notes: list[str]) -> Array:
    """Times ``(n,)`` [s] of a track that leaps back by 1024 weeks and on again, put right. name: for the note."""
    leaps = np.diff(time, prepend=time[:1])
    missing = np.cumsum(np.select([rolls_over(leaps), rolls_over(leaps - 2 * ROLLOVER)], [1, -1], 0))
    missing = missing - missing.min(initial=0)  # the first may be among them
    if missing.any():
        times = count(int((missing > 0).sum()), "time")
        notes.append(f"{name}: {times} {LOST_WEEKS}")
    time = time + ROLLOVER * missing
    if len(time) and OVERFLOW <= time.max() + ROLLOVER < clock.time():
        dates = (datetime.fromtimestamp(t, UTC).date() for t in (time.max(), time.max() + ROLLOVER))
        notes.append("{}: until {}, or until {} {}".format(name, *dates, MAYBE_LOST))
    return time


def zoneless(texts: Iterable[Any]) -> Mask:
    """True for each text ``(n,)`` that is a time of day without a zone."""
    return np.array([isinstance(text, str) and ZONELESS.search(text) is not None for text in texts], dtype=bool)


ZONELESS = re.compile(r"[T ]\d\d:\d\d(?::\d\d(?:[.,]\d+)?)?\Z")
NO_ZONE = "times without a zone were taken as UTC"
TIME_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # a larger Unix time is in ns, µs, ms


def in_seconds(time: Array) -> Array:
    """Unix times ``(n,)`` [s], whatever of s, ms, µs and ns each is in."""
    scale = np.ones(len(time))
    for least, unit in TIME_UNITS:
        scale = np.where((np.abs(time) >= least) & (scale == 1), unit, scale)
    return time * scale
