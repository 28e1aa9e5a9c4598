"""Published attitude filters, and strapdown navigation with zero-velocity updates, for comparison.

Each is a function from a recording to an `Attitude`. They are causal: each function runs a filter that takes samples
one by one or all at once, with the same result. With a magnetometer the world x axis is magnetic east; without one it
is any horizontal direction. The rest of the package uses `attitude.attitude_of`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import vqf
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError, install
from pdr_graph.geometry import compose
from pdr_graph.inertial.attitude import Attitude, lasting_runs, on_one_grid, running_mean, runs, upright
from pdr_graph.types import STANDARD_GRAVITY, Array, Mask, OneLineRepr, Recording


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
CONVERGED_GAIN = 1e-6  # relative change of the gain below which it is constant


class GravityFilter:
    """[gps-dr] Sec. 2.1: gravity by a Kalman filter with the gyroscope as input and the accelerometer as measurement.

    In the frame of the integrated gyroscope, gravity is constant except for the gyroscope's drift. The filter therefore
    estimates a constant vector, with the same gain on all axes: 1 at the first sample, that of a first-order low pass
    after convergence. Rotation about gravity is that of the gyroscope.
    """

    def __init__(self, period: float):
        self._gyroscope = GyroIntegration(period)
        self._process = GRAVITY_PROCESS**2 * period / (GRAVITY_NOISE**2 * max(period * 50, 1.0))  # in units of noise
        self._variance = np.inf
        self._gravity = np.zeros(3)
        steady = (self._process + np.sqrt(self._process**2 + 4 * self._process)) / 2
        self._gain = steady / (steady + 1)

    def update(self, samples: Samples) -> Rotation:
        """R_world_device of the next samples."""
        drifting = self._gyroscope.update(samples)
        measured = drifting.apply(samples.acceleration)
        gravity = np.empty_like(measured)
        k = 0
        while k < len(measured) and (gain := self._next_gain()) is not None:
            self._gravity = self._gravity + gain * (measured[k] - self._gravity)
            gravity[k] = self._gravity
            k += 1
        if k < len(measured):
            initial = (1 - self._gain) * self._gravity[None]
            gravity[k:] = lfilter([self._gain], [1, self._gain - 1], measured[k:], axis=0, zi=initial)[0]
            self._gravity = gravity[-1]
        return compose(upright(gravity), drifting)

    def _next_gain(self) -> float | None:
        """The gain for the next sample; None after convergence."""
        gain = 1.0 if np.isinf(self._variance) else self._variance / (self._variance + 1)
        if gain - self._gain < CONVERGED_GAIN * self._gain:
            return None
        self._variance = gain + self._process
        return gain


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
        if self._magnetometer:
            for row, *sensors in zip(quaternion, rate, force, samples.magnetic_field, strict=True):
                ahrs.update(*sensors)
                row[:] = ahrs.get_quaternion()
        else:
            for row, *sensors in zip(quaternion, rate, force, strict=True):
                ahrs.update_no_magnetometer(*sensors)
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

    threshold: λ [rad/s], from `rest_threshold`; 0 never switches. shortest: samples at rest before a switch,
    over which both sensors are averaged; 1 in the paper.
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
        rest, up, field = self._at_rest(samples)
        rows = np.flatnonzero(rest)
        at_rest = Rotation.from_quat(drifting.as_quat()[rows].reshape(-1, 4))
        absolute = compose(_level_north(up[rows], field[rows]), at_rest.inv())
        corrections = np.concatenate([self._correction.as_quat()[None], absolute.as_quat().reshape(-1, 4)])
        self._correction = Rotation.from_quat(corrections[-1])
        return compose(Rotation.from_quat(corrections[np.cumsum(rest)]), drifting)

    def _at_rest(self, samples: Samples) -> tuple[Mask, Array, Array]:
        """True where the last `shortest` samples were all at rest, and their means of acceleration and field."""
        pairs = zip(_fields(self._recent), _fields(samples), strict=True)
        window = Samples(*(np.concatenate(pair) for pair in pairs))
        self._recent = Samples(*(values[len(samples.acceleration) :] for values in _fields(window)))
        below = np.linalg.norm(window.angular_rate, axis=1, keepdims=True) <= self._threshold
        means = (below.astype(float), window.acceleration, window.magnetic_field)
        share, up, field = (running_mean(values, self._shortest) for values in means)
        return share[:, 0] == 1, up, field


def accelerometer_magnetometer(recording: Recording) -> Attitude:
    """See `AccelerometerMagnetometer`. Raises InputError if a sensor is missing."""
    return _run(recording, lambda period: AccelerometerMagnetometer(), magnetometer=True)


def gyro_integration(recording: Recording, start: Rotation | None = None) -> Attitude:
    """See `GyroIntegration`. Raises InputError if a sensor is missing."""
    return _run(recording, lambda period: GyroIntegration(period, start))


def gravity_filter(recording: Recording) -> Attitude:
    """See `GravityFilter`. Raises InputError if a sensor is missing."""
    return _run(recording, GravityFilter)


def imu_filter(recording: Recording) -> Attitude:
    """See `Madgwick`. Raises InputError if a sensor is missing."""
    return _run(recording, lambda period: Madgwick(period, magnetometer=False))


def marg_filter(recording: Recording) -> Attitude:
    """See `Madgwick`. Raises InputError if a sensor is missing."""
    return _run(recording, lambda period: Madgwick(period, magnetometer=True), magnetometer=True)


def vqf_6d(recording: Recording) -> Attitude:
    """See `Vqf`. Raises InputError if a sensor is missing."""
    return _run(recording, lambda period: Vqf(period, magnetometer=False))


def vqf_9d(recording: Recording) -> Attitude:
    """See `Vqf`. Raises InputError if a sensor is missing."""
    return _run(recording, lambda period: Vqf(period, magnetometer=True), magnetometer=True)


def switching(recording: Recording, threshold: float, shortest: int = 1) -> Attitude:
    """See `Switching`. Raises InputError if a sensor is missing."""
    return _run(recording, lambda period: Switching(period, threshold, shortest), magnetometer=True)


METHODS: dict[str, Callable[[Recording], Attitude]] = {
    "accelerometer + magnetometer": accelerometer_magnetometer,
    "gyro integration": gyro_integration,
    "gravity filter": gravity_filter,
    "IMU filter": imu_filter,
    "MARG filter": marg_filter,
    "VQF, 6-D": vqf_6d,
    "VQF, 9-D": vqf_9d,
}


def _run(recording: Recording, make: Callable[[float], AttitudeFilter], magnetometer: bool = False) -> Attitude:
    """The attitude of a whole recording. make: builds the filter for a period between samples [s]."""
    names = ["accelerometer", "gyroscope", *(["magnetometer"] if magnetometer else [])]
    time, period, values = on_one_grid(recording, *names)
    samples = Samples(values[0], values[1], values[2] if magnetometer else np.empty((0, 3)))
    return Attitude(time, period, make(period).update(samples), samples.acceleration, samples.angular_rate)


def _level_north(acceleration: Array, field: Array) -> Rotation:
    """R_world_device from acceleration (up) and magnetic field (north and down), both ``(n, 3)`` in device axes."""
    z = acceleration / np.maximum(np.linalg.norm(acceleration, axis=1, keepdims=True), 1e-9)
    x = np.cross(field, z)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))


def _fields(samples: Samples) -> tuple[Array, Array, Array]:
    return samples.acceleration, samples.angular_rate, samples.magnetic_field


def rest_threshold(angular_rate: Array) -> float:
    """λ [rad/s] of [stationary-switch] Sec. 2.5: the largest |ω| of samples ``(n, 3)`` at rest."""
    return float(np.linalg.norm(angular_rate, axis=1).max())


def below_threshold(angular_rate: Array, threshold: float, samples: int = 1) -> Mask:
    """``(n,)`` True at rest by [stationary-switch] Sec. 2.5: |ω| ≤ λ, for at least ``samples`` samples in a row.

    The paper requires one; a rattling cart is below λ for single samples now and then.
    """
    below = np.linalg.norm(angular_rate, axis=1) <= threshold
    return lasting_runs(below, max(1, samples))


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
        acceleration = _without_mean(acceleration, rest)
    integral = np.cumsum(acceleration, axis=0) * attitude.period
    last_rest = np.maximum.accumulate(np.where(rest, np.arange(len(rest)), 0))  # sample from which each movement starts
    velocity = integral - integral[last_rest]
    moved = velocity * attitude.period - acceleration * attitude.period**2 / 2
    return Navigation(velocity, np.cumsum(np.where(rest[:, None], 0.0, moved), axis=0))


def _without_mean(acceleration: Array, rest: Mask) -> Array:
    """Acceleration ``(n, 3)`` minus its mean over each movement between two rests."""
    corrected = acceleration.copy()
    for first, after in zip(*runs(~rest), strict=True):
        if first > 0 and after < len(rest):
            corrected[first:after] -= acceleration[first:after].mean(axis=0)
    return corrected
