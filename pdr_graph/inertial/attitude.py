"""Attitude of the phone: how its axes lie in the world.

Also what every attitude method needs: the sensors on one uniform time grid, when the phone is at rest, the gyroscope's
bias then, and means over windows of samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import vqf
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.errors import InputError
from pdr_graph.geometry import interpolate
from pdr_graph.types import STANDARD_GRAVITY, Array, Index, Mask, Recording, Signal

SHORTEST_WALK = 1.0  # [s]
LONGEST_BRIDGED = 1.0  # [s] of missing samples that are interpolated: a step or two
LEAST_GRAVITY, MOST_GRAVITY = 7.0, 13.0  # [m/s²] median |a|; walking raises it a little, other units by far
MOST_SAMPLES = 40_000_000  # a day at 400 Hz


def on_one_grid(recording: Recording, *names: str) -> tuple[Array, float, list[Array]]:
    """Times ``(n,)`` and the period between them [s], and the named sensors' samples ``(n, 3)``, accelerometer first.

    Raises InputError if a sensor is missing, gravity is not in the accelerometer's samples, or they have less than a
    second in common.
    """
    signals = [_required(recording, name) for name in names]
    _check_gravity(recording, signals[0])
    time, period = _uniform_grid(recording, signals)
    return time, period, [interpolate(time, signal.time, signal.values) for signal in signals]


def _required(recording: Recording, name: str) -> Signal:
    signal = recording.signals.get(name)
    if signal is None or len(signal) < 2:
        raise InputError(recording.source, name, "no samples", "its samples over the whole walk")
    return signal


def _check_gravity(recording: Recording, accelerometer: Signal) -> None:
    gravity = float(np.median(np.linalg.norm(accelerometer.values, axis=1)))
    if not LEAST_GRAVITY < gravity < MOST_GRAVITY:
        expected = "about 9.8 m/s²: metres per second squared, gravity not removed"
        raise InputError(recording.source, "accelerometer", f"a median magnitude of {gravity:.2f}", expected)


def _uniform_grid(recording: Recording, signals: list[Signal]) -> tuple[Array, float]:
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


def running_mean(values: Array, count: int) -> Array:
    """Means ``(n - count + 1, k)`` of every ``count`` consecutive rows of ``values (n, k)``."""
    total = np.cumsum(values - values[0], axis=0)
    total[count:] -= total[:-count].copy()
    return values[0] + total[count - 1 :] / count


def runs(mask: Mask) -> tuple[Index, Index]:
    """First samples ``(r,)``, and those after the last ``(r,)``, of each run of True."""
    if not mask.any():
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    edges = np.diff(mask.astype(np.int8), prepend=0, append=0)
    return np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)


WINDOW = 0.5  # [s] over which the spread of the samples is taken
STILL_RATE, STILL_ACCELERATION = 0.012, 0.10  # [rad/s], [m/s²] spread on a table: twice the noise of cheap sensors
SHORTEST_REST = 1.5  # [s]; for a moment anything is at rest
LARGEST_BIAS = 0.2  # [rad/s]; a phone that turns as evenly as a table stands is on a turntable, or in a car
DRIFT_TIME = 60.0  # [s] over which a bias is the mean of what was seen of it: it follows the temperature


def at_rest(angular_rate: Array, acceleration: Array, period: float) -> Mask:
    """Rest ``(n,)`` without any calibration: neither sensor's samples spread more than on a table.

    A phone in a standing person's hand is not at rest. The level of neither sensor is used, so that a bias or a
    scale error does not matter; what turns evenly by more than LARGEST_BIAS is not at rest either.

    angular_rate ``(n, 3)`` [rad/s], acceleration ``(n, 3)`` [m/s²], period: between samples [s].
    """
    samples = max(3, round(WINDOW / period))
    still = _spread(angular_rate, samples) < STILL_RATE
    still &= _spread(acceleration, samples) < STILL_ACCELERATION
    still &= np.linalg.norm(uniform_filter1d(angular_rate, samples, axis=0), axis=1) < LARGEST_BIAS
    return _lasting(still, max(1, round(SHORTEST_REST / period)))


def learnt_threshold(angular_rate: Array) -> float:
    """λ [rad/s] of [stationary-switch] Sec. 2.5: the largest |ω| of samples ``(n, 3)`` that were taken at rest."""
    return float(np.linalg.norm(angular_rate, axis=1).max())


def below_threshold(angular_rate: Array, threshold: float, samples: int = 1) -> Mask:
    """Rest ``(n,)`` as [stationary-switch] Sec. 2.5 has it: |ω| ≤ λ, for at least so many samples in a row.

    The paper has one; a rattling cart is below λ for single samples now and then.
    """
    below = np.linalg.norm(angular_rate, axis=1) <= threshold
    return _lasting(below, max(1, samples))


def bias_from_rests(angular_rate: Array, rest: Mask, period: float) -> Array:
    """Bias ``(n, 3)`` of a gyroscope [rad/s]: what it says at rest, followed linearly between rests; 0 without one."""
    if not rest.any():
        return np.zeros_like(angular_rate)
    samples, seen = max(1, round(DRIFT_TIME / period)), np.flatnonzero(rest)
    weight = uniform_filter1d(rest.astype(float), samples, mode="constant")
    weighted = uniform_filter1d(angular_rate * rest[:, None], samples, axis=0, mode="constant")
    said = weighted[seen] / weight[seen, None]
    return interpolate(np.arange(float(len(rest))), seen.astype(float), said)


def _lasting(mask: Mask, samples: int) -> Mask:
    """The runs of True that are at least so long."""
    lasting = np.zeros(len(mask), dtype=bool)
    for first, after in zip(*runs(mask), strict=True):
        lasting[first:after] = after - first >= samples
    return lasting


def _spread(values: Array, samples: int) -> Array:
    """Standard deviation ``(n,)`` over a moving window, of all axes together."""
    level = values - np.median(values, axis=0)
    mean = uniform_filter1d(level, samples, axis=0, mode="nearest")
    square = uniform_filter1d(level**2, samples, axis=0, mode="nearest")
    return np.sqrt(np.maximum(square - mean**2, 0).sum(axis=1))


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
