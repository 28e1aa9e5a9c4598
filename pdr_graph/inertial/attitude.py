"""Attitude of the phone: how its axes lie in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import vqf
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError
from pdr_graph.types import Array, Recording, Signal

SHORTEST_WALK = 1.0  # [s]
LEAST_GRAVITY, MOST_GRAVITY = 7.0, 13.0  # [m/s²] median |a|; walking raises it a little, other units by far
MOST_GAPS = 10  # times as many samples as recorded, once gaps are filled


@dataclass(frozen=True)
class Attitude:
    """The phone's attitude and its inertial samples on one uniform time grid.

    time: ``(n,)`` [s], ``period`` apart.
    R_world_device: n rotations; world z is up, its x axis points anywhere level (no magnetometer is used).
    acceleration: ``(n, 3)`` device axes, with gravity [m/s²].
    angular_rate: ``(n, 3)`` device axes, bias removed [rad/s].
    """

    time: Array
    period: float
    R_world_device: Rotation
    acceleration: Array
    angular_rate: Array


def vqf_offline(recording: Recording) -> Attitude:
    """Attitude from accelerometer and gyroscope by VQF's acausal form (Laidig & Seel 2023, 6-D).

    Chosen as the default because it needs no start attitude, estimates the gyro's bias in motion and at rest, and
    runs over the log both ways, so that the first second of a short walk is as level as the last.

    Raises InputError if a sensor is missing or the log is shorter than a second.
    """
    accelerometer, gyroscope = _required(recording)
    time, period = _uniform_grid(recording, accelerometer, gyroscope)
    acceleration = _resample(accelerometer, time)
    angular_rate = _resample(gyroscope, time)
    out = vqf.offlineVQF(angular_rate, acceleration, None, period)
    return Attitude(
        time=time,
        period=period,
        R_world_device=Rotation.from_quat(out["quat6D"], scalar_first=True),
        acceleration=acceleration,
        angular_rate=angular_rate - out["bias"],
    )


def _required(recording: Recording) -> tuple[Signal, Signal]:
    """Accelerometer and gyroscope, which must be there, the former with gravity in it."""
    sensors = {"accelerometer": recording.accelerometer, "gyroscope": recording.gyroscope}
    for name, signal in sensors.items():
        if signal is None or len(signal) < 2:
            raise InputError(recording.source, name, "no samples", "its samples over the whole walk")
    accelerometer, gyroscope = recording.accelerometer, recording.gyroscope
    assert accelerometer is not None
    assert gyroscope is not None
    gravity = float(np.median(np.linalg.norm(accelerometer.values, axis=1)))
    if not LEAST_GRAVITY < gravity < MOST_GRAVITY:
        needed = "about 9.8 m/s²: metres per second squared, gravity not removed"
        raise InputError(recording.source, "accelerometer", f"a median magnitude of {gravity:.2f}", needed)
    return accelerometer, gyroscope


def _uniform_grid(recording: Recording, *signals: Signal) -> tuple[Array, float]:
    """The common span of the signals, at the rate of the first."""
    start, end = max(s.time[0] for s in signals), min(s.time[-1] for s in signals)
    if end - start < SHORTEST_WALK:
        found = f"{max(end - start, 0):.2f} s of accelerometer and gyroscope together"
        raise InputError(recording.source, "", found, f"at least {SHORTEST_WALK:.0f} s")
    intervals = np.diff(signals[0].time)
    samples = round((end - start) / float(np.median(intervals[intervals > 0]))) + 1
    if samples > MOST_GAPS * len(signals[0]):
        found = f"{len(signals[0])} samples in {end - start:.0f} s, {samples} at their usual interval"
        raise InputError(recording.source, "accelerometer", found, "a log without such gaps, or times in their unit")
    return np.linspace(start, end, samples), (end - start) / (samples - 1)


def _resample(signal: Signal, time: Array) -> Array:
    return np.stack([np.interp(time, signal.time, axis) for axis in signal.values.T], axis=1)
