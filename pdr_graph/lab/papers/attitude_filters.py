"""Published attitude filters, and strapdown navigation with zero-velocity updates, for comparison.

Each is a function from a recording to an `Attitude`. They are causal: each function runs a filter that takes samples
one by one or all at once, with the same result. With a magnetometer the world x axis is magnetic east; without one it
is any horizontal direction. The rest of the package uses `attitude.attitude_of`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import vqf
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError, install
from pdr_graph.geometry import compose, interpolate
from pdr_graph.inertial.attitude import Attitude, check_gravity, required, runs, uniform_grid, upright
from pdr_graph.types import STANDARD_GRAVITY, Array, Mask, OneLineRepr, Recording


def running_mean(values: Array, count: int) -> Array:
    """Means ``(n - count + 1, k)`` of every ``count`` consecutive rows of ``values (n, k)``."""
    total = np.cumsum(values - values[0], axis=0)
    total[count:] -= total[:-count].copy()
    return values[0] + total[count - 1 :] / count


@dataclass(frozen=True)
class Samples(OneLineRepr, row="sample"):
    """Sensors on one uniform grid, in device axes: acceleration with gravity [m/s²], angular_rate [rad/s] and
    magnetic_field [µT], arrays ``(n, 3)``.
    """

    acceleration: Array
    angular_rate: Array
    magnetic_field: Array

    def _summary(self) -> list[str]:
        return [f"{len(self.acceleration)} samples"]


class AttitudeFilter(Protocol):
    """A causal attitude filter, as it runs on a phone."""

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples, one or many."""
        ...


class AccelerometerMagnetometer:
    """[heading] Sec. 3.1: z along the acceleration, x = m × a, y = z × x, sample by sample.

    The acceleration of the walker is treated as gravity.
    """

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples."""
        return _level_north(samples.acceleration, samples.magnetic_field)


ONLY_GYROSCOPE = {"motionBiasEstEnabled": False, "restBiasEstEnabled": False, "magDistRejectionEnabled": False}


class GyroIntegration:
    """[heading] Sec. 3.2: the angular rate integrated from a start attitude.

    [stationary-switch] Sec. 2.3 with ΔR = Exp(+[ω]× ΔT) (printed there as its transpose), ω the mean of two samples;
    computed by VQF's strapdown integration.

    start: R_world_device of the first sample; by default level by its acceleration.
    """

    def __init__(self, period: float, start: Rotation | None = None):
        self._start = start
        self._last: Array | None = None
        self._vqf = vqf.VQF(period, **ONLY_GYROSCOPE)

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples."""
        if self._start is None:
            self._start = upright(samples.acceleration[:1])[0]
        rate = samples.angular_rate
        before = np.concatenate([-rate[:1] if self._last is None else self._last, rate[:-1]])
        self._last = rate[-1:]
        mean = np.ascontiguousarray((before + rate) / 2)
        integrated = self._vqf.updateBatch(mean, np.zeros_like(mean))["quat6D"]  # VQF ignores accelerations of 0
        return compose(self._start, Rotation.from_quat(integrated, scalar_first=True))


# Standard deviations of GravityFilter, chosen by hand: [m/s²] of gravity per root second; of one walking sample
GRAVITY_PROCESS, GRAVITY_NOISE = 0.02, 2.0


class GravityFilter:
    """[gps-dr] Sec. 2.1: gravity by a Kalman filter with the gyroscope as input and the accelerometer as measurement.

    In the frame of the integrated gyroscope, gravity is constant except for the gyroscope's drift. The filter therefore
    estimates a constant vector, with the same gain on all axes: 1 at the first sample, that of a first-order low pass
    after convergence. Rotation about gravity is that of the gyroscope.
    """

    def __init__(self, period: float):
        self._gyroscope = GyroIntegration(period)
        self._process = GRAVITY_PROCESS**2 * period / (GRAVITY_NOISE**2 * max(period * 50, 1.0))  # in units of noise
        self._gravity, self._gain = np.zeros(3), 1.0

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples."""
        drifting = self._gyroscope.update(samples)
        gravity = drifting.apply(samples.acceleration)
        for row in gravity:
            self._gravity = row[:] = self._gravity + self._gain * (row - self._gravity)
            variance = self._gain + self._process
            self._gain = variance / (variance + 1)
        return compose(upright(gravity), drifting)


class Madgwick:
    """Madgwick's IMU filter ([heading] Sec. 3.3) and MARG filter (Sec. 3.4), by imufusion (extra ``attitude``).

    gain: of the accelerometer's correction. Raises InputError if imufusion is not installed.
    """

    def __init__(self, period: float, magnetometer: bool, gain: float = 0.05):
        try:
            import imufusion
        except ImportError:
            expected = install("attitude")
            raise InputError("imufusion", "", "it is not installed", expected) from None
        settings = imufusion.AhrsSettings()
        settings.convention, settings.gain, settings.sample_rate = imufusion.CONVENTION_ENU, gain, 1 / period
        self._ahrs, self._magnetometer = imufusion.Ahrs(), magnetometer
        self._ahrs.set_settings(settings)

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples."""
        ahrs, rate, force = self._ahrs, np.degrees(samples.angular_rate), samples.acceleration / STANDARD_GRAVITY
        quaternion = np.empty((len(rate), 4))
        update = ahrs.update if self._magnetometer else ahrs.update_no_magnetometer
        sensors = (rate, force, samples.magnetic_field) if self._magnetometer else (rate, force)
        for row, *values in zip(quaternion, *sensors, strict=True):
            update(*values)
            row[:] = ahrs.get_quaternion()
        return Rotation.from_quat(quaternion, scalar_first=True)


class Vqf:
    """VQF (Laidig and Seel 2023), causal. magnetometer: True for 9-D with rejection of disturbances, False for 6-D."""

    def __init__(self, period: float, magnetometer: bool):
        self._vqf, self._magnetometer = vqf.VQF(period), magnetometer

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples."""
        rate, force = samples.angular_rate, samples.acceleration
        if self._magnetometer:
            quaternion = self._vqf.updateBatch(rate, force, samples.magnetic_field)["quat9D"]
        else:
            quaternion = self._vqf.updateBatch(rate, force)["quat6D"]
        return Rotation.from_quat(quaternion, scalar_first=True)


class Switching:
    """[stationary-switch] Sec. 2.5: accelerometer and magnetometer while |ω| ≤ λ, else the gyroscope from there on.

    threshold: λ [rad/s], the largest |ω| at rest; 0 never switches. shortest: samples at rest before a switch, over
    which both sensors are averaged; 1 in the paper.
    """

    def __init__(self, period: float, threshold: float, shortest: int = 1):
        self._gyroscope = GyroIntegration(period)
        self._threshold, self._shortest = threshold, shortest
        nothing = np.zeros((shortest - 1, 3))
        self._recent = Samples(nothing, nothing + np.inf, nothing)
        self._correction: Rotation | None = None

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples."""
        drifting = self._gyroscope.update(samples)
        if self._correction is None:
            start = _level_north(samples.acceleration[:1], samples.magnetic_field[:1])[0]
            self._correction = start * drifting[0].inv()
        # Where the last samples were all at rest, and their means of acceleration and field
        window = {name: np.concatenate([getattr(self._recent, name), values]) for name, values in vars(samples).items()}
        self._recent = Samples(**{name: values[len(drifting) :] for name, values in window.items()})
        below = np.linalg.norm(window["angular_rate"], axis=1, keepdims=True) <= self._threshold
        rest = running_mean(below.astype(float), self._shortest)[:, 0] == 1
        up, field = (running_mean(window[name], self._shortest)[rest] for name in ("acceleration", "magnetic_field"))

        at_rest = Rotation.from_quat(drifting.as_quat()[rest].reshape(-1, 4))
        absolute = compose(_level_north(up, field), at_rest.inv())
        corrections = np.concatenate([self._correction.as_quat()[None], absolute.as_quat().reshape(-1, 4)])
        self._correction = Rotation.from_quat(corrections[-1])
        return compose(Rotation.from_quat(corrections[np.cumsum(rest)]), drifting)


def on_one_grid(recording: Recording, *names: str) -> tuple[Array, float, list[Array]]:
    """The named sensors interpolated on a uniform grid: times ``(n,)`` and period [s], samples ``(n, 3)`` of each.

    The accelerometer is the first name.

    Raises InputError if a sensor is missing, the accelerometer's samples do not contain gravity, or the
    sensors have less than a second in common.
    """
    signals = [required(recording, name) for name in names]
    check_gravity(recording, signals[0])
    start, end = max(s.time[0] for s in signals), min(s.time[-1] for s in signals)
    time, period = uniform_grid(recording, signals[0], start, end)
    return time, period, [interpolate(time, signal.time, signal.values) for signal in signals]


def run_filter(recording: Recording, make: Callable[[float], AttitudeFilter], magnetometer: bool = False) -> Attitude:
    """The attitude of a whole recording by a filter. make: builds it for a period between samples [s].

    Raises InputError if a sensor is missing.
    """
    names = ["accelerometer", "gyroscope", *(["magnetometer"] if magnetometer else [])]
    time, period, values = on_one_grid(recording, *names)
    samples = Samples(values[0], values[1], values[2] if magnetometer else np.empty((0, 3)))
    return Attitude(time, period, make(period).update(samples), samples.acceleration, samples.angular_rate)


def gyro_integration(recording: Recording, start: Rotation | None = None) -> Attitude:
    """See `GyroIntegration`. Raises InputError if a sensor is missing."""
    return run_filter(recording, lambda period: GyroIntegration(period, start))


def imu_filter(recording: Recording) -> Attitude:
    """See `Madgwick`. Raises InputError if a sensor is missing."""
    return run_filter(recording, lambda period: Madgwick(period, magnetometer=False))


def switching(recording: Recording, threshold: float, shortest: int = 1) -> Attitude:
    """See `Switching`. Raises InputError if a sensor is missing."""
    return run_filter(recording, lambda period: Switching(period, threshold, shortest), magnetometer=True)


ATTITUDE_FILTERS: dict[str, Callable[[Recording], Attitude]] = {
    "accelerometer + magnetometer": partial(run_filter, make=lambda _: AccelerometerMagnetometer(), magnetometer=True),
    "gyro integration": gyro_integration,
    "gravity filter": partial(run_filter, make=GravityFilter),
    "IMU filter": imu_filter,
    "MARG filter": partial(run_filter, make=lambda period: Madgwick(period, True), magnetometer=True),
    "VQF, 6-D": partial(run_filter, make=lambda period: Vqf(period, False)),
    "VQF, 9-D": partial(run_filter, make=lambda period: Vqf(period, True), magnetometer=True),
}


def _level_north(acceleration: Array, field: Array) -> Rotation:
    """R_world_device from acceleration (up) and magnetic field (north and down), both ``(n, 3)`` in device axes."""
    z = acceleration / np.maximum(np.linalg.norm(acceleration, axis=1, keepdims=True), 1e-9)
    x = np.cross(field, z)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))


@dataclass(frozen=True)
class Navigation(OneLineRepr, row="sample"):
    """Velocity ``(n, 3)`` [m/s] and position ``(n, 3)`` [m] in the world of the attitude, from rest at the origin."""

    velocity: Array
    position: Array


def strapdown(attitude: Attitude, rest: Mask, look_ahead: bool = False) -> Navigation:
    """Integrate the acceleration twice, [stationary-switch] Sec. 2.2: l += v ΔT + a ΔT²/2, v += a ΔT; v = 0 at rest.

    Gravity is the mean vertical acceleration at rest; standard gravity if there is no rest.

    rest: ``(n,)`` True where the phone is at rest, as of `at_rest`. look_ahead: the velocity at the end of a movement
    is an error that grew since the rest before (an attitude error of 1 mrad adds 1 cm/s² of gravity); it is removed
    linearly. The paper's method is causal and does not.
    """
    acceleration = attitude.R_world_device.apply(attitude.acceleration)
    acceleration[:, 2] -= acceleration[rest, 2].mean() if rest.any() else STANDARD_GRAVITY
    if look_ahead:
        for first, after in np.transpose(runs(~rest)).tolist():
            if first > 0 and after < len(rest):
                acceleration[first:after] -= acceleration[first:after].mean(axis=0)
    integral = np.cumsum(acceleration, axis=0) * attitude.period
    last_rest = np.maximum.accumulate(np.where(rest, np.arange(len(rest)), 0))  # sample from which each movement starts
    velocity = integral - integral[last_rest]
    moved = velocity * attitude.period - acceleration * attitude.period**2 / 2
    return Navigation(velocity, np.cumsum(np.where(rest[:, None], 0.0, moved), axis=0))
