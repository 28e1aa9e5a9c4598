"""Checks of a sensor over its whole recording: one unit, a clock that does not leap, a sufficient range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.types import Array, Mask, Signal

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


FEWEST = 2  # windows in the other unit
TYPICAL_SPREAD = 1.4  # factor between gravity and the median magnitude of a walk's acceleration, at most
DEGREES = 180 / np.pi
WALKING = 0.1  # swing of the acceleration in windows with steps: a phone that lies or is held still turns slowly
RATIO = (DEGREES / 2, DEGREES * 2)  # of angular rates in windows of two units, in deg/s and in rad/s
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
        walking = swing > WALKING
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
    if min(first.sum(), second.sum()) < FEWEST:
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


CLIPPED = 3  # consecutive samples at the extreme value: an unclipped peak has one, two by rounding
SMALLEST_RANGE = {"accelerometer": 15.0, "gyroscope": 4.0}  # [m/s², rad/s] sensors have 2 g and 250 deg/s, or more
NOTED_SHARE = 0.001  # of a sensor's samples that are clipped


def note_clipping(signals: dict[str, Signal], notes: list[str]) -> None:
    """Note inertial sensors whose range was exceeded: `signals` in SI units."""
    for sensor, smallest in SMALLEST_RANGE.items():
        if sensor in signals and (largest := np.abs(signals[sensor].values).max()) > smallest:
            number = sum(clipped(axis) for axis in signals[sensor].values.T)
            if number > NOTED_SHARE * len(signals[sensor]):
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
    return int(length[length >= CLIPPED].sum())
