"""The phone's attitude by VQF: causal as samples arrive, acausal over a recording; the gyroscope's bias at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import vqf
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.sensor_stream import SensorStream
from pdr_graph.inertial.units import GravityRestorer
from pdr_graph.priors import REST
from pdr_graph.types import Array, Index, Mask, OneLineRepr, Recording, Signal

# Phones have calibrated gyroscopes [°/s] (0.5 follows a swinging arm) that warm up in minutes [s]
VQF_OPTIONS = {"biasSigmaInit": 0.2, "biasForgettingTime": 1000.0}
SHORTEST_WALK = 1.0  # [s] of samples, or there is nothing to detect a step in


def required(recording: Recording, name: str) -> Signal:
    """The signal of a sensor; raises InputError if it has fewer than two samples."""
    signal = recording.signals.get(name)
    if signal is None or len(signal) < 2:
        raise InputError(recording.source, name, "no samples", "its samples over the whole walk")
    return signal


def check_gravity(recording: Recording, accelerometer: Signal) -> None:
    """Raise InputError if the median magnitude is far from that of gravity: walking raises it a little, a run more."""
    magnitude = np.linalg.norm(accelerometer.values, axis=1)
    gravity = float(np.median(magnitude))
    if not 7.0 < gravity < 13.0 + 2 * magnitude.std():
        expected = "about 9.8 m/s²: metres per second squared, gravity not removed"
        raise InputError(recording.source, "accelerometer", f"a median magnitude of {gravity:.2f}", expected)


def uniform_grid(recording: Recording, accelerometer: Signal, start: float, end: float) -> tuple[Array, float]:
    """Times ``(n,)`` and period [s] of a grid from ``start`` to ``end`` [s] at the rate of the accelerometer."""
    if end - start < SHORTEST_WALK:
        found = f"{max(end - start, 0):.2f} s in which all of its sensors ran"
        raise InputError(recording.source, "", found, f"at least {SHORTEST_WALK:.0f} s")
    intervals = np.diff(accelerometer.time)
    samples = round((end - start) / float(np.median(intervals[intervals > 0]))) + 1
    most = 40_000_000  # a day at 400 Hz
    if samples > most:
        found = f"{end - start:.0f} s, {samples} samples at their median interval"
        raise InputError(recording.source, "accelerometer", found, f"up to {most} samples: milliseconds?")
    return np.linspace(start, end, samples), (end - start) / (samples - 1)


def runs(mask: Mask) -> tuple[Index, Index]:
    """First index ``(r,)`` and index after the last ``(r,)`` of each run of True."""
    if not mask.any():
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    return np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)


def at_rest(angular_rate: Array, acceleration: Array, period: float) -> Mask:
    """``(n,)`` True where the phone lies still: neither sensor's samples spread more than on a table.

    A phone in a standing person's hand is not at rest. Only the spread is used, not the mean, so that a bias or a scale
    error does not matter, except that a mean rate above 0.2 rad/s is not rest.

    angular_rate ``(n, 3)`` [rad/s], acceleration ``(n, 3)`` [m/s²], period: between samples [s].
    """
    samples = max(3, round(REST.window / period))
    still = _spread(angular_rate, samples) < REST.rate
    still &= _spread(acceleration, samples) < REST.acceleration
    still &= np.linalg.norm(uniform_filter1d(angular_rate, samples, axis=0), axis=1) < REST.largest_bias
    return lasting_runs(still, max(1, round(REST.shortest / period)))


def hung(angular_rate: Array, acceleration: Array, period: float) -> Mask:
    """``(n,)`` True where a gyroscope hung: it repeats one value exactly while the phone moves. See `at_rest`."""
    shortest = round(REST.shortest / period) - 1
    same = lasting_runs((angular_rate == np.roll(angular_rate, 1, axis=0)).all(axis=1), shortest)
    if not same.any():  # as good as always: what follows is as long as the rest
        return same
    moves = _spread(acceleration, max(3, round(REST.window / period))) > REST.acceleration
    return lasting_runs(same & moves, shortest)


def bias_from_rests(angular_rate: Array, rest: Mask, period: float) -> Array:
    """Bias of the gyroscope ``(n, 3)`` [rad/s]: its mean at rest, linear between rests; 0 without a rest."""
    if not rest.any():
        return np.zeros_like(angular_rate)
    samples, resting = max(1, round(REST.drift_time / period)), np.flatnonzero(rest)
    weight = uniform_filter1d(rest.astype(float), samples, mode="constant")
    weighted = uniform_filter1d(angular_rate * rest[:, None], samples, axis=0, mode="constant")
    bias = weighted[resting] / weight[resting, None]
    return interpolate(np.arange(float(len(rest))), resting.astype(float), bias)


def lasting_runs(mask: Mask, samples: int) -> Mask:
    """``(n,)`` True in the runs of True that have at least ``samples`` samples."""
    lasting = np.zeros(len(mask), dtype=bool)
    for first, after in zip(*runs(mask), strict=True):
        lasting[first:after] = after - first >= samples
    return lasting


def _spread(values: Array, samples: int) -> Array:
    """Standard deviation ``(n,)`` of all axes together in a moving window."""
    level = values - np.median(values, axis=0)
    mean = uniform_filter1d(level, samples, axis=0, mode="nearest")
    square = uniform_filter1d(level**2, samples, axis=0, mode="nearest")
    return np.sqrt(np.maximum(square - mean**2, 0).sum(axis=1))


NO_GYROSCOPE = "turns: there is no gyroscope, or it stopped"
NO_GRAVITY = "the vertical: the recorder removed gravity; the axis of the largest motion is used instead"


@dataclass(frozen=True)
class Attitude(OneLineRepr, row="sample"):
    """The phone's attitude and its inertial samples on one uniform time grid.

    time: ``(n,)`` [s], ``period`` apart.
    R_world_device: n rotations; world z is up, its x axis points anywhere level (no magnetometer is used).
    acceleration: ``(n, 3)`` device axes, with gravity [m/s²].
    angular_rate: ``(n, 3)`` device axes, bias removed [rad/s]; NaN where the gyroscope did not run or hung.
    unknown: quantities that the sensors do not measure, or only under an assumption; one line each.
    """

    time: Array
    period: float
    R_world_device: Rotation
    acceleration: Array
    angular_rate: Array
    unknown: tuple[str, ...] = ()

    def __getitem__(self, part: slice) -> Attitude:
        """A part of the samples."""
        parts = {name: getattr(self, name)[part] for name in ("time", "R_world_device", "acceleration", "angular_rate")}
        return replace(self, **parts)


def attitude_of(recording: Recording) -> Attitude:
    """The attitude in an uninterrupted recording by VQF's acausal form (Laidig & Seel 2023, 6-D).

    It needs no start attitude, estimates the gyroscope's bias in motion and at rest, and runs over the log forwards and
    backwards, so that the first second of a short walk is as accurate as the last. Where the gyroscope did not run, the
    vertical follows the accelerometer, and the heading is constant.

    Raises InputError if there is no accelerometer at all, or the log is shorter than a second.
    """
    linear, unknown = recording.linear_acceleration, ()
    if recording.accelerometer is None and linear is not None:
        restored = replace(linear, values=GravityRestorer().restored(linear.values))
        recording, unknown = replace(recording, accelerometer=restored), (NO_GRAVITY,)
    accelerometer = required(recording, "accelerometer")
    check_gravity(recording, accelerometer)
    gyroscope, signal = SensorStream(), recording.gyroscope
    if signal is not None:
        gyroscope = SensorStream(signal.time, signal.values)
    start, end = gyroscope.segment_start(float(accelerometer.time[0])), float(accelerometer.time[-1])
    end = min(end, gyroscope.last) if gyroscope.last > end - REST.longest_bridged else end
    time, period = uniform_grid(recording, accelerometer, start, end)
    acceleration = interpolate(time, accelerometer.time, accelerometer.values)

    angular_rate = gyroscope.sampled(time)
    rate = np.nan_to_num(angular_rate)
    measured = np.isfinite(angular_rate) & ~hung(rate, acceleration, period)[:, None]
    rate = np.where(measured, rate, 0.0)
    rest = at_rest(rate, acceleration, period) & measured[:, 0]
    rate = np.where(measured, rate - bias_from_rests(rate, rest, period), 0.0)
    options = {"motionBiasEstEnabled": bool(measured.any()), "restBiasEstEnabled": bool(measured.any())}
    out = vqf.offlineVQF(rate, acceleration, None, period, VQF_OPTIONS | options)
    level = Rotation.from_quat(out["quat6D"], scalar_first=True)
    return Attitude(time, period, level, acceleration, np.where(measured, rate - out["bias"], np.nan), unknown)


def upright(up: Array) -> Rotation:
    """The shortest rotations from vectors ``(n, 3)`` to z; about x for a vector that points straight down."""
    length = np.linalg.norm(up, axis=1)
    w = length + up[:, 2]
    down = w < 1e-9 * (length + 1e-9)
    x, y = np.where(down, 1.0, up[:, 1]), np.where(down, 0.0, -up[:, 0])
    return Rotation.from_quat(np.stack([x, y, np.zeros(len(up)), np.where(down, 0.0, w)], axis=1))


class AttitudeStream:
    """The phone's attitude as samples arrive.

    period: between samples [s]; bias: ``(3,)`` start value of the gyroscope's bias [rad/s].
    """

    def __init__(self, period: float, bias: Array | None = None):
        self.rest_bias = np.zeros(3)  # [rad/s] mean rate of the last rest
        self.recent = np.empty((0, 6))  # last samples of gyroscope and accelerometer
        self._period, self._samples = period, max(3, round(REST.shortest / period))
        options: dict[str, Any] = VQF_OPTIONS
        self._vqf = vqf.VQF(period, **options)
        if bias is not None:
            self._vqf.setBiasEstimate(np.array(bias))

    def update(self, acceleration: Array, angular_rate: Array) -> tuple[Array, Array]:
        """Quaternions ``(n, 4)`` from device to world, scalar last, and angular rates ``(n, 3)`` without bias [rad/s].

        acceleration ``(n, 3)`` [m/s²]; angular_rate ``(n, 3)`` [rad/s], NaN while the gyroscope does not run. Then the
        vertical follows the accelerometer, and the bias stays.
        """
        measured = np.isfinite(angular_rate)
        if measured.all():  # learn the bias at rest if it is too large for VQF, which follows 1 °/s and stops at 2 °/s
            recent = np.concatenate([self.recent, np.concatenate([angular_rate, acceleration], axis=1)])
            self.recent = recent = recent[-self._samples :]
            rate, bias = recent[:, :3], recent[:, :3].mean(axis=0)
            measured &= not hung(rate, recent[:, 3:], self._period)[-1]
            known = len(recent) == self._samples and at_rest(rate, recent[:, 3:], self._period).all()
            if known and np.linalg.norm(bias - self.rest_bias) > np.radians(1.0):
                self.rest_bias = bias
                self._vqf.setBiasEstimate(np.zeros(3))
        ran = bool(measured.all())
        angular_rate = np.where(measured, angular_rate, self.bias)
        self._vqf.setMotionBiasEstEnabled(ran)
        self._vqf.setRestBiasEstEnabled(ran)
        rate = np.ascontiguousarray(angular_rate - self.rest_bias)
        out = self._vqf.updateBatch(rate, np.ascontiguousarray(acceleration))
        return np.roll(out["quat6D"], -1, axis=1), np.where(measured, rate - out["bias"], np.nan)

    @property
    def bias(self) -> Array:
        """Present bias of the gyroscope ``(3,)``. [rad/s]"""
        return self.rest_bias + np.array(self._vqf.state["bias"])
