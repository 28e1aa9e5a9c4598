"""Strapdown inertial navigation with zero-velocity updates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.windows import runs
from pdr_graph.types import STANDARD_GRAVITY, Array, Mask


@dataclass(frozen=True)
class Navigation:
    """velocity ``(n, 3)`` [m/s] and position ``(n, 3)`` [m] in the attitude's world, from rest at the origin."""

    velocity: Array
    position: Array


def strapdown(attitude: Attitude, rest: Mask, look_ahead: bool = False) -> Navigation:
    """Twice integrated acceleration, [stationary-switch] Sec. 2.2: l += v ΔT + a ΔT²/2, v += a ΔT; v = 0 at rest.

    Gravity is what the accelerometer says upwards at rest, on average; without any rest the standard's.

    rest: ``(n,)`` when the phone is known to stand still, of `stationary`. look_ahead: the velocity with which the
    phone comes to rest is an error that grew all the way from the rest before (an attitude that is off by 1 mrad
    lets 1 cm/s² of gravity into it): it is taken back evenly. The paper is live and forgets it.
    """
    acceleration = attitude.R_world_device.apply(attitude.acceleration)
    acceleration[:, 2] -= acceleration[rest, 2].mean() if rest.any() else STANDARD_GRAVITY
    if look_ahead:
        acceleration = _coming_to_rest(acceleration, rest)
    gained = np.cumsum(acceleration, axis=0) * attitude.period
    stood = np.maximum.accumulate(np.where(rest, np.arange(len(rest)), 0))  # the sample at rest that each starts from
    velocity = gained - gained[stood]
    moved = velocity * attitude.period - acceleration * attitude.period**2 / 2
    return Navigation(velocity, np.cumsum(np.where(rest[:, None], 0.0, moved), axis=0))


def _coming_to_rest(acceleration: Array, rest: Mask) -> Array:
    """Acceleration ``(n, 3)`` whose mean over every movement between two rests is 0."""
    corrected = acceleration.copy()
    for first, after in zip(*runs(~rest), strict=True):
        if first > 0 and after < len(rest):
            corrected[first:after] -= acceleration[first:after].mean(axis=0)
    return corrected
