"""Checks at the door: every reader hands its raw columns in here, and a ``Recording`` comes out.

What can be mended for certain is mended and noted with numbers; what cannot is refused. A user reads the notes among
the warnings of ``summary.json``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.types import STANDARD_GRAVITY, Array, Fixes, Mask, Recording, Sightings, Signal, Trajectory

MOST_MISSING = 0.2  # of a sensor's rows without a value: beyond, the file is damaged
MOST_UNORDERED, FARTHEST_BACK = 0.01, 1.0  # share of rows, and [s]: a recorder's threads, not a shuffled file
ABSURD = 1e12  # of a time [s] or a value in any unit: no measurement is as large, nor is what is not finite smaller
WINDOW = 2.0  # [s] over which a walker's own acceleration averages out, a stride or two
GRAVITY = (8.0, 11.5)  # [m/s²] of window means: real walks have 9.5–10.2
GRAVITY_IN_G = (0.85, 1.15)
FASTEST_TURN = 10.0  # [rad/s] median: nobody whirls a phone all along; in degrees, any walk exceeds it
SLOWEST_RATE = 15.0  # [Hz] below which the peaks of steps are cut off
SHORTEST_GAP = 0.5  # [s]
APART = 1.0  # [s] between the starts or ends of two sensors
PASCAL, KILOPASCAL = 2000.0, 200.0  # a pressure above is in Pa, one below in kPa: people walk at 400–1050 hPa
Timed = TypeVar("Timed", Signal, Fixes, Sightings, Trajectory)
INERTIAL = ("accelerometer", "gyroscope", "linear_acceleration")


def admit(
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
    """A recording from a reader's raw columns, all times in the recorder's own clock.

    path: names the files in messages; source: names the recording in titles.
    tables: per sensor ``(n, 1 + k)`` times [s] and values, rows of NaN where a value is missing.
    unix_zero: Unix time [s] where the recorder's clock is zero, None if it is not known.

    Raises InputError if a sensor's rows are damaged, or not in a unit that can be told.
    """
    said = list(notes)
    signals: dict[str, Signal] = {}
    for sensor, table in tables.items():
        cleaned = _clean(path, sensor, table, said)
        if len(cleaned):
            signals[sensor] = Signal(cleaned[:, 0], cleaned[:, 1:])
    signals = _units(path, signals, said)
    _check_rates(signals, said)
    _check_together(path, signals, said)

    starts = [signals[s].time[0] for s in INERTIAL if s in signals] or [s.time[0] for s in signals.values()]
    starts = starts or [part.time[0] for part in (fixes, truth) if part is not None and len(part)]
    if not starts:
        raise InputError(path, "", "no sensor rows and no positions", "the rows of a sensor, or positions")
    origin = float(min(starts))
    _check_fixes(signals, fixes, said)
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
        notes=tuple(said),
    )


def _since(origin: float, part: Timed | None) -> Timed | None:
    """The same with times from ``origin``; None where there is nothing."""
    return replace(part, time=part.time - origin) if part is not None and len(part) else None


def _clean(path: str, sensor: str, table: Array, said: list[str]) -> Array:
    """Rows with a value, in order of time, each once."""
    with np.errstate(invalid="ignore"):
        usual = np.abs(table) < ABSURD
    whole = np.ones(len(table), dtype=bool) if usual.all() else usual.all(axis=1)
    missing = int((~whole).sum())
    if missing > MOST_MISSING * len(table):
        raise InputError(path, sensor, f"{missing} of {len(table)} rows without a value", "rows of finite numbers")
    if missing:
        said.append(f"{sensor}: {missing} rows without a value were left out")
    return _spread(sensor, _without_repeats(sensor, _in_order(path, sensor, table[whole], said), said), said)


def _in_order(path: str, sensor: str, table: Array, said: list[str]) -> Array:
    step = np.diff(table[:, 0])
    back = step < 0
    if not back.any():
        return table
    if back.mean() > MOST_UNORDERED or -step.min() > FARTHEST_BACK:
        row = int(np.argmin(step)) + 1
        found = f"times that go back {int(back.sum())} times, by {-step.min():.3f} s at the sensor's row {row + 1}"
        raise InputError(path, sensor, found, "rows in order of time: the file was shuffled, or its clock was set")
    said.append(f"{sensor}: {int(back.sum())} rows out of order by up to {-step.min():.3f} s were sorted")
    return table[np.argsort(table[:, 0], kind="stable")]


def _without_repeats(sensor: str, table: Array, said: list[str]) -> Array:
    """Rows that say the same of the same instant are one."""
    repeated = np.zeros(len(table), dtype=bool)
    again = np.flatnonzero(table[1:, 0] == table[:-1, 0]) + 1
    repeated[again] = (table[again] == table[again - 1]).all(axis=1)
    if repeated.any():
        said.append(f"{sensor}: {int(repeated.sum())} repeated rows were left out")
    return table[~repeated]


def _spread(sensor: str, table: Array, said: list[str]) -> Array:
    """Different samples at one time come from a clock coarser than the sensor: they share the time to its next tick."""
    if (np.diff(table[:, 0]) > 0).all():
        return table
    ticks, first, count = np.unique(table[:, 0], return_index=True, return_counts=True)
    if len(ticks) == len(table) or len(ticks) < 2:
        return table[first]
    said.append(f"{sensor}: {len(table) - len(ticks)} samples share their time with another and were spread evenly")
    interval = np.minimum(np.diff(ticks, append=2 * ticks[-1] - ticks[-2]), np.median(np.diff(ticks)))
    place = np.arange(len(table)) - np.repeat(first, count)
    time = np.repeat(ticks, count) + place * np.repeat(interval / count, count)
    return np.column_stack([time, table[:, 1:]])


def _units(path: str, signals: dict[str, Signal], said: list[str]) -> dict[str, Signal]:
    """All sensors in SI units, hPa and µT."""
    signals = dict(signals)
    if "accelerometer" in signals:
        signal = signals.pop("accelerometer")
        sensor, factor = unit_of(path, "accelerometer", signal, said)
        signals.setdefault(sensor, _scaled(signal, factor))
    for sensor in ("gyroscope", "barometer"):
        if sensor in signals:
            signals[sensor] = _scaled(signals[sensor], unit_of(path, sensor, signals[sensor], said)[1])
    return signals


def unit_of(path: str, sensor: str, signal: Signal, said: list[str]) -> tuple[str, float]:
    """What a sensor is, by its values, and by what to multiply them for SI units, hPa and µT.

    Raises InputError if an accelerometer's unit cannot be told.
    """
    if sensor == "accelerometer":
        return _acceleration(path, signal, said)
    if sensor == "gyroscope":
        usual = float(np.median(np.linalg.norm(signal.values, axis=1)))
        if usual > FASTEST_TURN:
            said.append(f"gyroscope: a median of {usual:.1f} must be degrees per second and was converted")
            return sensor, np.pi / 180
    if sensor == "barometer":
        usual = float(np.median(signal.values))
        factor = 0.01 if usual > PASCAL else 10.0 if usual < KILOPASCAL else 1.0
        if factor != 1.0:
            said.append(f"barometer: a median of {usual:.5g} was taken for {'Pa' if factor < 1 else 'kPa'}")
        return sensor, factor
    return sensor, 1.0


def _acceleration(path: str, signal: Signal, said: list[str]) -> tuple[str, float]:
    """Whether an accelerometer feels gravity, and what takes it to m/s².

    Over a stride a walker's own acceleration averages out and what is left is gravity.
    """
    gravity, usual = _mean_of_windows(signal), float(np.median(np.linalg.norm(signal.values, axis=1)))
    if GRAVITY[0] <= gravity <= GRAVITY[1]:
        return "accelerometer", 1.0
    if GRAVITY_IN_G[0] <= gravity <= GRAVITY_IN_G[1] and gravity > 0.7 * usual:
        said.append(f"accelerometer: gravity reads {gravity:.3f}, so that it is in g and was converted")
        return "accelerometer", STANDARD_GRAVITY
    if gravity < 0.5 * usual and usual < GRAVITY[0]:
        said.append(f"accelerometer: gravity reads {gravity:.3f} m/s², so that it was removed by the recorder")
        return "linear_acceleration", 1.0
    needed = f"{STANDARD_GRAVITY:.2f} m/s², 1 g, or 0 where the recorder removes it"
    raise InputError(path, "accelerometer", f"gravity of {gravity:.3f} (mean over {WINDOW:.0f} s, median)", needed)


def _mean_of_windows(signal: Signal) -> float:
    """Median length of the mean over windows of two seconds."""
    samples = min(max(1, round(WINDOW * signal.rate)), len(signal))
    windows = len(signal) // samples
    means = signal.values[: windows * samples].reshape(windows, samples, -1).mean(axis=1)
    return float(np.median(np.linalg.norm(means, axis=1)))


def _scaled(signal: Signal, factor: float) -> Signal:
    return replace(signal, values=signal.values * factor)


def _check_rates(signals: dict[str, Signal], said: list[str]) -> None:
    for sensor in (s for s in INERTIAL if s in signals and len(signals[s]) > 1):
        signal = signals[sensor]
        if signal.rate < SLOWEST_RATE:
            said.append(f"{sensor}: {signal.rate:.1f} Hz is too slow to see every step")
        interval = np.diff(signal.time)
        gaps = interval[are_gaps(signal)]
        if len(gaps):
            place = signal.time[int(np.argmax(interval))] - signal.time[0]
            said.append(f"{sensor}: {len(gaps)} gaps, the longest of {gaps.max():.2f} s after {place:.1f} s")


def are_gaps(signal: Signal) -> Mask:
    """Which intervals between samples ``(n - 1,)`` are far longer than the others."""
    return np.diff(signal.time) > max(SHORTEST_GAP, 5 / signal.rate if signal.rate else np.inf)


def _check_together(path: str, signals: dict[str, Signal], said: list[str]) -> None:
    """Accelerometer and gyroscope must be of the same clock."""
    gyroscope = signals.get("gyroscope")
    other = signals.get("accelerometer") or signals.get("linear_acceleration")
    if gyroscope is None or other is None:
        return
    begins, ends = gyroscope.time[0] - other.time[0], gyroscope.time[-1] - other.time[-1]
    if min(gyroscope.time[-1], other.time[-1]) <= max(gyroscope.time[0], other.time[0]):
        raise InputError(path, "gyroscope", f"it begins {begins:.1f} s after the accelerometer", "the same time span")
    if max(abs(begins), abs(ends)) > APART:
        said.append(f"gyroscope: begins {begins:+.1f} s and ends {ends:+.1f} s after the accelerometer")


def _check_fixes(signals: dict[str, Signal], fixes: Fixes | None, said: list[str]) -> None:
    inertial = [signals[s] for s in INERTIAL if s in signals]
    if fixes is None or not len(fixes) or not inertial:
        return
    start, end = min(s.time[0] for s in inertial), max(s.time[-1] for s in inertial)
    if fixes.time[0] > end or fixes.time[-1] < start:
        apart = fixes.time[0] - start
        said.append(
            f"position fixes: they begin {apart:+.1f} s from the sensors' start, of another clock or another day"
        )
