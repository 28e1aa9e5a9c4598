"""Attitude of the phone: how its axes lie in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import vqf
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.inertial.samples import on_one_grid
from pdr_graph.inertial.stationary import at_rest, bias_from_rests
from pdr_graph.types import STANDARD_GRAVITY, Array, Recording

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

    def __getitem__(self, part: slice) -> Attitude:
        """A stretch of it."""
        rate = None if self.angular_rate is None else self.angular_rate[part]
        attitude, acceleration = self.R_world_device[part], self.acceleration[part]
        return replace(
            self, time=self.time[part], R_world_device=attitude, acceleration=acceleration, angular_rate=rate
        )


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
    time, period, (acceleration, angular_rate) = on_one_grid(recording, "accelerometer", "gyroscope")
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
    time, period, (acceleration,) = on_one_grid(recording, "accelerometer")
    level = upright(gaussian_filter1d(acceleration, TILT_SMOOTHING / period, axis=0))
    return Attitude(time, period, level, acceleration, None, (NO_GYROSCOPE,))


def upright(up: Array) -> Rotation:
    """The shortest rotations of vectors ``(n, 3)`` onto z; of one that points straight down, about x."""
    length = np.linalg.norm(up, axis=1)
    w = length + up[:, 2]
    down = w < 1e-9 * (length + 1e-9)
    x, y = np.where(down, 1.0, up[:, 1]), np.where(down, 0.0, -up[:, 0])
    return Rotation.from_quat(np.stack([x, y, np.zeros(len(up)), np.where(down, 0.0, w)], axis=1))


def _with_gravity(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """A recording whose accelerometer has gravity, and what was assumed for it.

    Where the recorder removed gravity: a walker bounces more than they sway, so that the principal axis of what is
    left is vertical, and a phone that is carried looks up or stands upright rather than hanging upside down. On real
    walks with the phone in hand the axis is within 3–9° of the vertical and gives the same steps and turns.
    """
    linear = recording.linear_acceleration
    if recording.accelerometer is not None or linear is None:
        return recording, ()
    up = vertical_of(np.cov(linear.values.T)) if len(linear) > 1 else np.array([0.0, 0.0, 1.0])
    return replace(recording, accelerometer=replace(linear, values=linear.values + STANDARD_GRAVITY * up)), (
        NO_GRAVITY,
    )


def vertical_of(covariance: Array) -> Array:
    """The vertical ``(3,)`` in a device that shakes with this covariance ``(3, 3)``, as of a walker's phone."""
    vertical = np.linalg.eigh(covariance)[1][:, -1]
    return vertical * np.sign(vertical[1:][np.argmax(np.abs(vertical[1:]))] or 1.0)
