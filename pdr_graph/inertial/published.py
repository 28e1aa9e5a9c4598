"""Attitude by the methods of the papers, each a function from a recording to an `Attitude`, to be compared or chosen.

They are causal, and like a live system they know nothing of the walk to come. Those with a magnetometer give attitudes
whose world x axis is magnetic east; without one it points anywhere level. The default is `attitude.vqf_offline`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import vqf
from scipy.ndimage import minimum_filter1d, uniform_filter1d
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError
from pdr_graph.inertial.attitude import Attitude, upright
from pdr_graph.inertial.samples import on_one_grid
from pdr_graph.inertial.stationary import below_threshold
from pdr_graph.types import STANDARD_GRAVITY, Array, Recording

GRAVITY_PROCESS, GRAVITY_NOISE = 0.02, 2.0  # [m/s²] per root second; of one walking sample: gravity_filter's sigmas
FIRST = 0.5  # [s] of samples that the first attitude is taken from
LONGEST_BLOCK = 512  # samples of the integration that are multiplied one after the other


@dataclass(frozen=True)
class _Samples:
    """Sensors on one uniform grid; arrays ``(n, 3)`` in device axes."""

    time: Array
    period: float
    acceleration: Array
    angular_rate: Array
    magnetic_field: Array

    def attitude(self, R_world_device: Rotation) -> Attitude:
        """These samples with their attitude."""
        return Attitude(self.time, self.period, R_world_device, self.acceleration, self.angular_rate)


def accelerometer_magnetometer(recording: Recording) -> Attitude:
    """[heading] Sec. 3.1: z along the acceleration, x = m × a, y = z × x, sample by sample; a walker's own acceleration
    is taken for gravity. Raises InputError if a sensor is missing.
    """
    samples = _samples(recording, magnetometer=True)
    return samples.attitude(_level_north(samples.acceleration, samples.magnetic_field))


def gyro_integration(recording: Recording, start: Rotation | None = None) -> Attitude:
    """[heading] Sec. 3.2: the angular rate integrated from a start attitude, [stationary-switch] Sec. 2.3 with
    ΔR = Exp(+[ω]× ΔT) (the print has its transpose).

    start: R_world_device of the first sample; by default level by the first half second. Raises InputError if a sensor
    is missing.
    """
    samples = _samples(recording)
    return samples.attitude(_integrated(samples.angular_rate, samples.period, start or _first(samples)))


def gravity_filter(recording: Recording) -> Attitude:
    """[gps-dr] Sec. 2.1: gravity by a Kalman filter that the gyroscope drives and the accelerometer corrects.

    In the frame that the integrated gyroscope spans gravity stands still but for the gyroscope's drift, so that the
    filter is one of a constant vector with the same gain on all axes: a first-order low pass once it has settled. The
    turn about gravity is the gyroscope's. Raises InputError if a sensor is missing.
    """
    samples = _samples(recording)
    drifting = _integrated(samples.angular_rate, samples.period, _first(samples))
    measured = drifting.apply(samples.acceleration)
    process, noise = GRAVITY_PROCESS**2 * samples.period, GRAVITY_NOISE**2 * max(samples.period * 50, 1.0)
    gain = (np.sqrt(process**2 + 4 * process * noise) - process) / (2 * noise)  # of the settled filter
    begun = measured[: max(1, round(FIRST / samples.period))].mean(axis=0)
    gravity = lfilter([gain], [1, gain - 1], measured, axis=0, zi=(1 - gain) * begun[None])[0]
    return samples.attitude(upright(gravity) * drifting)


def imu_filter(recording: Recording, gain: float = 0.05) -> Attitude:
    """[heading] Sec. 3.3: Madgwick's filter of gyroscope and accelerometer, by imufusion (extra ``attitude``).

    gain: how fast the accelerometer levels. Raises InputError if a sensor is missing.
    """
    samples = _samples(recording)
    return samples.attitude(_madgwick(samples, gain))


def marg_filter(recording: Recording, gain: float = 0.05) -> Attitude:
    """[heading] Sec. 3.4: the same with a magnetometer. Raises InputError if a sensor is missing."""
    samples = _samples(recording, magnetometer=True)
    return samples.attitude(_madgwick(samples, gain, samples.magnetic_field))


def vqf_6d(recording: Recording) -> Attitude:
    """Laidig and Seel 2023, causal, without a magnetometer. Raises InputError if a sensor is missing."""
    samples = _samples(recording)
    out = vqf.VQF(samples.period).updateBatch(samples.angular_rate, samples.acceleration)
    return samples.attitude(Rotation.from_quat(out["quat6D"], scalar_first=True))


def vqf_9d(recording: Recording) -> Attitude:
    """The same with a magnetometer, whose disturbances it rejects. Raises InputError if a sensor is missing."""
    samples = _samples(recording, magnetometer=True)
    out = vqf.VQF(samples.period).updateBatch(samples.angular_rate, samples.acceleration, samples.magnetic_field)
    return samples.attitude(Rotation.from_quat(out["quat9D"], scalar_first=True))


def switching(recording: Recording, threshold: float, shortest: int = 1) -> Attitude:
    """[stationary-switch] Sec. 2.5: accelerometer and magnetometer where |ω| ≤ λ, else the gyroscope from there on.

    threshold: λ [rad/s], from `learnt_threshold`; 0 never switches. shortest: rest in samples, over which the two
    sensors are then averaged. Raises InputError if a sensor is missing.
    """
    samples = _samples(recording, magnetometer=True)
    rest = below_threshold(samples.angular_rate, threshold, shortest)
    calm = [uniform_filter1d(v, shortest, axis=0) for v in (samples.acceleration, samples.magnetic_field)]
    absolute = _level_north(*calm)
    drifting = _integrated(samples.angular_rate, samples.period, absolute[0])
    settled = minimum_filter1d(rest, shortest)  # what was averaged was all at rest
    last = np.maximum.accumulate(np.where(settled, np.arange(len(rest)), 0))  # the sample that each starts from
    corrected = (absolute * drifting.inv()).as_quat()[last]
    return samples.attitude(Rotation.from_quat(corrected) * drifting)


METHODS: dict[str, Callable[[Recording], Attitude]] = {
    "accelerometer + magnetometer": accelerometer_magnetometer,
    "gyro integration": gyro_integration,
    "gravity filter": gravity_filter,
    "IMU filter": imu_filter,
    "MARG filter": marg_filter,
    "VQF, 6-D": vqf_6d,
    "VQF, 9-D": vqf_9d,
}


def _samples(recording: Recording, magnetometer: bool = False) -> _Samples:
    names = ["accelerometer", "gyroscope", *(["magnetometer"] if magnetometer else [])]
    time, period, values = on_one_grid(recording, *names)
    return _Samples(time, period, values[0], values[1], values[2] if magnetometer else np.empty((0, 3)))


def _first(samples: _Samples) -> Rotation:
    """Level by the first samples; its heading is the device's own."""
    begun = samples.acceleration[: max(1, round(FIRST / samples.period))].mean(axis=0)
    return upright(begun[None])[0]


def _level_north(acceleration: Array, field: Array) -> Rotation:
    """R_world_device from what points up and what points north and down, both ``(n, 3)``."""
    z = acceleration / np.maximum(np.linalg.norm(acceleration, axis=1, keepdims=True), 1e-9)
    x = np.cross(field, z)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1))


def _integrated(angular_rate: Array, period: float, start: Rotation) -> Rotation:
    """Rotations one after the other, many blocks at a time: as exact as a loop, and a hundred times as fast."""
    mean = (angular_rate[:-1] + angular_rate[1:]) / 2 * period
    size = max(1, min(LONGEST_BLOCK, round(np.sqrt(len(mean) or 1))))
    blocks = -(-len(mean) // size)
    padded = np.zeros((blocks * size, 3))
    padded[: len(mean)] = mean
    within = [Rotation.from_rotvec(padded[0::size])]
    for k in range(1, size):
        within.append(within[-1] * Rotation.from_rotvec(padded[k::size]))
    begun = [start]
    for turn in within[-1]:
        begun.append(begun[-1] * turn)
    before = Rotation.concatenate(begun[:-1])
    after = np.stack([(before * turn).as_quat() for turn in within], axis=1).reshape(-1, 4)[: len(mean)]
    return Rotation.from_quat(np.concatenate([start.as_quat()[None], after]))


def _madgwick(samples: _Samples, gain: float, field: Array | None = None) -> Rotation:
    try:
        import imufusion
    except ImportError:
        needed = "pip install 'pdr_graph[attitude]'"
        raise InputError("imufusion", "", "it is not installed", needed) from None
    filter_, settings = imufusion.Ahrs(), imufusion.AhrsSettings()
    settings.convention, settings.gain, settings.sample_rate = imufusion.CONVENTION_ENU, gain, 1 / samples.period
    filter_.set_settings(settings)
    rate, force = np.degrees(samples.angular_rate), samples.acceleration / STANDARD_GRAVITY
    quaternion = np.empty((len(rate), 4))
    for k in range(len(rate)):
        if field is None:
            filter_.update_no_magnetometer(rate[k], force[k])
        else:
            filter_.update(rate[k], force[k], field[k])
        quaternion[k] = filter_.get_quaternion()
    return Rotation.from_quat(quaternion, scalar_first=True)
