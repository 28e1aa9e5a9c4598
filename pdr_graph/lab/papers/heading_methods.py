"""Published methods for the walking direction, for comparison; the product uses `heading.walking_direction`.

They have the signatures of `gait.heading`: a forward-axis method returns a `Forward`, a direction method a `Direction`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.gait.heading import (
    UNKNOWN,
    Direction,
    Forward,
    at_step_frequency,
    level_and_vertical,
    push,
)
from pdr_graph.inertial.attitude import Attitude, running_mean
from pdr_graph.priors import FORWARD
from pdr_graph.types import Array, Mask

PRINCIPAL_WINDOW = 2.6  # [s] of the principal components: [heading] has N = 65 samples at 25 Hz


@dataclass(frozen=True)
class PrincipalDirection(Direction):
    """A direction by a principal component. axis: heading of the first sample in the world, modulo π [rad]."""

    axis: float


def principal_axis(attitude: Attitude, heading: Array, walking: Mask, step: float) -> Forward:
    """[gps-dr] Sec. 2: the first principal component of the level acceleration over a short straight walk.

    Its half turn, which the paper does not mention, is resolved by the step pattern of its Sec. 2.2 (after the
    vertical + → − the forward − → +), by the lead as in `braking_axis`.
    """
    if not walking.any():
        return UNKNOWN
    level = level_and_vertical(attitude, heading)[0][walking]
    level = level - level.mean()
    doubled = np.mean(level**2)  # the axis of the largest variance, at twice its angle
    roundness = 1 - np.abs(doubled) / np.mean(np.abs(level) ** 2)  # 1 if the variance is equal in all directions
    axis = np.exp(0.5j * np.angle(doubled))
    harmonic, vertical = (signal[walking] for signal in at_step_frequency(attitude, heading, step))
    ahead = np.real(push(harmonic, vertical) / axis)
    angle = np.angle(axis * (1 if ahead > 0 else -1))
    return Forward(float(angle), float(np.hypot(FORWARD.gait_sigma, roundness * np.pi / 4)))


def accumulate_turn(attitude: Attitude, step: float) -> Direction:
    """Integrate the angular rate about gravity: [heading] Sec. 4.3, Eq. (1): θ_i = θ_{i-1} + ω_{z,i} ΔT_i.

    As in the paper it includes the sway of the gait; `step` is not used.
    """
    heading = np.cumsum(attitude.R_world_device.apply(attitude.angular_rate)[:, 2]) * attitude.period
    return Direction(heading - heading[0], np.zeros(len(heading)))


def acceleration_axis(
    attitude: Attitude, step: float, window: float = PRINCIPAL_WINDOW, axes: int = 2
) -> PrincipalDirection:
    """[heading] Sec. 4.1, [gps-dr] Sec. 2: the first principal component of the last seconds' acceleration.

    Its half-turn ambiguity is resolved towards the sample before, so that one wrong side persists. It lags by half the
    window; `step` is not used.

    window [s]; axes: 2 for level components, as in [gps-dr] and in the figure of [heading]; 3 as in the text of
    [heading], with which the first component of most walks is their bounce.
    """
    samples = attitude.R_world_device.apply(attitude.acceleration)
    return _principal(samples[:, :axes], 0, round(window / attitude.period))


def angular_rate_axis(
    attitude: Attitude, step: float, window: float = PRINCIPAL_WINDOW, axes: int = 2
) -> PrincipalDirection:
    """[heading] Sec. 4.2: the second principal component of the last seconds' angular rate; as `acceleration_axis`."""
    samples = attitude.R_world_device.apply(attitude.angular_rate)
    return _principal(samples[:, :axes], 1, round(window / attitude.period))


def _principal(samples: Array, component: int, window: int) -> PrincipalDirection:
    """The horizontal direction of a principal component of trailing windows of samples ``(n, 2 or 3)``."""
    axes, window = samples.shape[1], max(2, min(window, len(samples)))
    products = np.einsum("ni,nj->nij", samples, samples).reshape(-1, axes**2)
    mean, square = _trailing_mean(samples, window), _trailing_mean(products, window)
    covariance = square.reshape(-1, axes, axes) - np.einsum("ni,nj->nij", mean, mean)
    axis = np.linalg.eigh(covariance)[1][:, :, axes - 1 - component]
    course = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]), period=np.pi)
    return PrincipalDirection(course - course[0], np.zeros(len(course)), float(course[0]))


def _trailing_mean(values: Array, window: int) -> Array:
    """Means ``(n, k)`` of the last ``window`` samples; the first window's mean before it is full."""
    full = running_mean(values, window)
    return np.concatenate([np.repeat(full[:1], window - 1, axis=0), full])
