"""Attitude of the phone: how its axes lie in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import vqf
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError
from pdr_graph.inertial.stationary import at_rest, bias_from_rests
from pdr_graph.types import Array, Recording, Signal

STANDARD_GRAVITY = 9.80665  # [m/s²]
SHORTEST_WALK = 1.0  # [s]
LEAST_GRAVITY, MOST_GRAVITY = 7.0, 13.0  # [m/s²] median |a|; walking raises it a little, other units by far
MOST_SAMPLES = 40_000_000  # a day at 400 Hz
TILT_SMOOTHING = 0.5  # [s] of the Gaussian that leaves gravity of an acceleration
# A phone has calibrated its gyroscope and warms up in minutes: VQF's own 0.5°/s that double within 100 s let a swinging
# arm teach it a bias that is not there
PHONE = {"biasSigmaInit": 0.2, "biasForgettingTime": 1000.0}  # [°/s], [s]
NO_GYROSCOPE = "turns: there is no gyroscope"
NO_GRAVITY = "the vertical: the recorder removed gravity, and the axis that shook most was taken for it"


@dataclass(frozen=True)
class Attitude:
    """The phone's attitude and its inertial samples on one uniform time grid.

    time: ``(n,)`` [s], ``period`` apart.
    R_world_device: n rotations; world z is up, its x axis points anywhere level (no magnetometer is used).
    acceleration: ``(n, 3)`` device axes, with gravity [m/s²].
    angular_rate: ``(n, 3)`` device axes, bias removed [rad/s]; None without a gyroscope.
    unknown: what the recording's sensors cannot tell, or only by an assumption; a line each.
    """

    time: Array
    period: float
    R_world_device: Rotation
    acceleration: Array
    angular_rate: Array | None
    unknown: tuple[str, ...] = ()


def attitude_of(recording: Recording) -> Attitude:
    """Attitude by the best method that the recording's sensors allow.

    Raises InputError if there is no accelerometer at all, or the log is shorter than a second.
    """
    complete, unknown = _with_gravity(recording)
    attitude = tilt(complete) if complete.gyroscope is None else vqf_offline(complete)
    return replace(attitude, unknown=(*unknown, *attitude.unknown))


def vqf_offline(recording: Recording) -> Attitude:
    """Attitude from accelerometer and gyroscope by VQF's acausal form (Laidig & Seel 2023, 6-D).

    Chosen as the default because it needs no start attitude, estimates the gyro's bias in motion and at rest, and
    runs over the log both ways, so that the first second of a short walk is as level as the last.

    Raises InputError if a sensor is missing or the log is shorter than a second.
    """
    accelerometer = required(recording, "accelerometer", recording.accelerometer)
    gyroscope = required(recording, "gyroscope", recording.gyroscope)
    check_gravity(recording, accelerometer)
    time, period = uniform_grid(recording, accelerometer, gyroscope)
    acceleration = resample(accelerometer, time)
    angular_rate = resample(gyroscope, time)
    rest = at_rest(angular_rate, acceleration, period)
    angular_rate = angular_rate - bias_from_rests(angular_rate, rest, period)
    out = vqf.offlineVQF(angular_rate, acceleration, None, period, PHONE)
    return Attitude(
        time=time,
        period=period,
        R_world_device=Rotation.from_quat(out["quat6D"], scalar_first=True),
        acceleration=acceleration,
        angular_rate=angular_rate - out["bias"],
    )


def tilt(recording: Recording) -> Attitude:
    """Attitude from the accelerometer alone: what its slow part says of gravity. Its heading means nothing.

    Raises InputError if there is no accelerometer or the log is shorter than a second.
    """
    accelerometer = required(recording, "accelerometer", recording.accelerometer)
    check_gravity(recording, accelerometer)
    time, period = uniform_grid(recording, accelerometer)
    acceleration = resample(accelerometer, time)
    up = gaussian_filter1d(acceleration, TILT_SMOOTHING / period, axis=0)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    half = up + np.array(
        [0.0, 0.0, 1.0]
    )  # the shortest rotation of `up` onto z turns by π about the line halfway between
    half[np.linalg.norm(half, axis=1) < 1e-6] = (1.0, 0.0, 0.0)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    half_turns = Rotation.from_rotvec(np.pi * half)
    level = Rotation.from_rotvec([0.0, 0.0, np.pi]) * half_turns
    return Attitude(time, period, level, acceleration, None, (NO_GYROSCOPE,))


def _with_gravity(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """A recording whose accelerometer has gravity, and what was assumed for it.

    Where the recorder removed gravity: a walker bounces more than they sway, so that the principal axis of what is
    left is vertical, and a phone that is carried looks up or stands upright rather than hanging upside down. On real
    walks with the phone in hand the axis is within 3–9° of the vertical and gives the same steps and turns.
    """
    linear = recording.linear_acceleration
    if recording.accelerometer is not None or linear is None:
        return recording, ()
    _, axes = np.linalg.eigh(np.cov(linear.values.T)) if len(linear) > 1 else (None, np.eye(3))
    vertical = axes[:, -1]
    up = vertical * np.sign(vertical[1:][np.argmax(np.abs(vertical[1:]))] or 1.0)
    return replace(recording, accelerometer=replace(linear, values=linear.values + STANDARD_GRAVITY * up)), (
        NO_GRAVITY,
    )


def required(recording: Recording, name: str, signal: Signal | None) -> Signal:
    """A signal that a method cannot do without."""
    if signal is None or len(signal) < 2:
        raise InputError(recording.source, name, "no samples", "its samples over the whole walk")
    return signal


def check_gravity(recording: Recording, accelerometer: Signal) -> None:
    """Refuse what cannot be an accelerometer with gravity in metres per second squared."""
    gravity = float(np.median(np.linalg.norm(accelerometer.values, axis=1)))
    if not LEAST_GRAVITY < gravity < MOST_GRAVITY:
        needed = "about 9.8 m/s²: metres per second squared, gravity not removed"
        raise InputError(recording.source, "accelerometer", f"a median magnitude of {gravity:.2f}", needed)


def uniform_grid(recording: Recording, *signals: Signal) -> tuple[Array, float]:
    """The common span of the signals, at the rate of the first."""
    start, end = max(s.time[0] for s in signals), min(s.time[-1] for s in signals)
    if end - start < SHORTEST_WALK:
        found = f"{max(end - start, 0):.2f} s that its sensors have in common"
        raise InputError(recording.source, "", found, f"at least {SHORTEST_WALK:.0f} s")
    intervals = np.diff(signals[0].time)
    samples = round((end - start) / float(np.median(intervals[intervals > 0]))) + 1
    if samples > MOST_SAMPLES:
        found = f"{end - start:.0f} s, {samples} samples at their usual interval"
        raise InputError(recording.source, "accelerometer", found, f"up to {MOST_SAMPLES}: are its times in seconds?")
    return np.linspace(start, end, samples), (end - start) / (samples - 1)


def resample(signal: Signal, time: Array) -> Array:
    """A signal ``(n, k)`` at other times."""
    return np.stack([np.interp(time, signal.time, axis) for axis in signal.values.T], axis=1)
