"""Which way the walker went: the walking direction since the first sample, by every method under one signature.

A method takes an `Attitude` and the usual duration of a step and returns a `Direction`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from pdr_graph.gait.reholds import Rehold, reholds
from pdr_graph.geometry import compose
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.windows import running_mean
from pdr_graph.types import Array

WINDOW = 2.6  # [s] of the principal components: N = 65 samples at 25 Hz
REHOLD_SIGMA = 0.35  # [rad] what is not known of the walker's turn meanwhile


@dataclass(frozen=True)
class Direction:
    """The walking direction over time.

    heading: ``(n,)`` since the first sample, not wrapped [rad].
    variance: ``(n,)`` of what the method itself knows to be unsure, never falling [rad²]; a difference of two is the
        variance of the turn between them. It comes on top of what any gyroscope and walker add.
    axis: the first sample's heading in the attitude's world, give or take half a turn [rad]; None where a method tells
        turns alone.
    """

    heading: Array
    variance: Array
    axis: float | None = None


def walking_direction(attitude: Attitude, step: float) -> Direction:
    """The default: for a phone held anyhow, and taken otherwise in mid-walk.

    The turn of the phone's attitude, averaged over a stride, is the walker's: gait moves the phone to and fro, and a
    swing in an ellipse turns the integrated rate about gravity by its solid angle (coning), but not the attitude from
    one stride to the next. Within a stride the rate about gravity tells more. Where the phone was taken otherwise
    (`reholds`) it says nothing of the walker, who turned as gait has it, or else went straight on, give or take
    REHOLD_SIGMA.
    """
    samples = max(1, round(step / attitude.period))
    steady = _mean_attitude(attitude.R_world_device, 2 * samples)
    turned = np.concatenate([[0.0], np.cumsum(compose(steady[1:], steady[:-1].inv()).as_rotvec()[:, 2])])
    rate_integral = _rate_integral(attitude)
    coning = uniform_filter1d(rate_integral, 2 * samples, mode="nearest") - turned
    heading = without_gait(rate_integral, samples) - coning
    heading -= heading[0]
    turn, doubt = without_reholds(heading, reholds(attitude, steady.inv().apply([0.0, 0.0, 1.0]), heading, step))
    return Direction(np.cumsum(turn), np.cumsum(doubt))


def accumulate_turn(attitude: Attitude, step: float) -> Direction:
    """The angular rate about gravity, added up: [heading] Sec. 4.3, Eq. (1): θ_i = θ_{i-1} + ω_{z,i} ΔT_i.

    As in the paper it sways with the gait; `step` is not used.
    """
    heading = _rate_integral(attitude)
    return Direction(heading, np.zeros(len(heading)))


def acceleration_axis(attitude: Attitude, step: float, window: float = WINDOW, axes: int = 2) -> Direction:
    """[heading] Sec. 4.1, [gps-dr] Sec. 2: the first principal component of the last seconds' acceleration.

    The half turn that a component leaves open is taken nearer to the sample before. It lags by half the window, and
    where it once comes out on the wrong side it stays there; `step` is not used.

    window [s]; axes: 2 for level components, as [gps-dr] has it and the figure of [heading] draws it; 3 as the text of
    [heading] says, where the first component of most walks is their bounce.
    """
    samples = attitude.R_world_device.apply(attitude.acceleration)
    return _principal(samples[:, :axes], 0, round(window / attitude.period))


def angular_rate_axis(attitude: Attitude, step: float, window: float = WINDOW, axes: int = 2) -> Direction:
    """[heading] Sec. 4.2: the second principal component of the last seconds' angular rate; as `acceleration_axis`."""
    assert attitude.angular_rate is not None, "there is a gyroscope"
    samples = attitude.R_world_device.apply(attitude.angular_rate)
    return _principal(samples[:, :axes], 1, round(window / attitude.period))


def without_gait(heading: Array, samples_per_step: int) -> Array:
    """Heading without most of the sway of the gait, which the paper names as accumulation's defect.

    A centred mean over one step: it does not lag. What is left alternates from step to step and does not add up; a mean
    over a whole stride would remove that too, but cuts the corners of real turns.
    """
    return uniform_filter1d(heading, max(1, samples_per_step), mode="nearest")


def _principal(samples: Array, component: int, window: int) -> Direction:
    """The course of a principal component of trailing windows of samples ``(n, 2 or 3)``, seen from above."""
    axes, window = samples.shape[1], max(2, min(window, len(samples)))
    products = np.einsum("ni,nj->nij", samples, samples).reshape(-1, axes**2)
    mean, square = _trailing_mean(samples, window), _trailing_mean(products, window)
    covariance = square.reshape(-1, axes, axes) - np.einsum("ni,nj->nij", mean, mean)
    axis = np.linalg.eigh(covariance)[1][:, :, axes - 1 - component]
    course = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]), period=np.pi)
    return Direction(course - course[0], np.zeros(len(course)), float(course[0]))


def _trailing_mean(values: Array, window: int) -> Array:
    """Means ``(n, k)`` of the last ``window`` samples; before there are so many, of the first window."""
    full = running_mean(values, window)
    return np.concatenate([np.repeat(full[:1], window - 1, axis=0), full])


def _rate_integral(attitude: Attitude) -> Array:
    assert attitude.angular_rate is not None, "there is a gyroscope"
    rate_z = attitude.R_world_device.apply(attitude.angular_rate)[:, 2]
    turned = np.cumsum(rate_z) * attitude.period
    return turned - turned[0]


def _mean_attitude(attitude: Rotation, samples: int) -> Rotation:
    """Attitudes averaged over so many samples: for swings of less than 90° the means of their quaternions."""
    quaternion = attitude.as_quat()
    turned_round = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0))
    quaternion[1:] *= turned_round[:, None]
    return Rotation.from_quat(uniform_filter1d(quaternion, samples, axis=0, mode="nearest"))


def without_reholds(heading: Array, found: list[Rehold]) -> tuple[Array, Array]:
    """The walker's turn since the sample before, and what is unsure of it, both ``(n,)``. [rad], [rad²]"""
    turn, doubt = np.diff(heading, prepend=heading[:1]), np.zeros(len(heading))
    for rehold in found:
        during = slice(rehold.first + 1, rehold.last + 1)
        count = rehold.last - rehold.first
        turn[during] = rehold.turn / count
        doubt[during] = REHOLD_SIGMA**2 / count
    return turn, doubt
