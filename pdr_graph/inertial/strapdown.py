"""Strapdown inertial navigation with zero-velocity updates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.inertial.attitude import Attitude
from pdr_graph.types import STANDARD_GRAVITY, Array, Mask


@dataclass(frozen=True)
class Navigation:
    """velocity ``(n, 3)`` [m/s] and position ``(n, 3)`` [m] in the attitude's world, from rest at the origin."""

    velocity: Array
    position: Array


def strapdown(attitude: Attitude, rest: Mask) -> Navigation:
    """Twice integrated acceleration, [stationary-switch] Sec. 2.2: l += v ΔT + a ΔT²/2, v += a ΔT; v = 0 at rest.

    Gravity is what the accelerometer says upwards at rest, on average; without any rest the standard's.

    rest: ``(n,)`` when the phone is known to stand still, of `stationary`.
    """
    acceleration = attitude.R_world_device.apply(attitude.acceleration)
    acceleration[:, 2] -= acceleration[rest, 2].mean() if rest.any() else STANDARD_GRAVITY
    gained = np.cumsum(acceleration, axis=0) * attitude.period
    stood = np.maximum.accumulate(np.where(rest, np.arange(len(rest)), 0))  # the sample at rest that each starts from
    velocity = gained - gained[stood]
    moved = velocity * attitude.period - acceleration * attitude.period**2 / 2
    return Navigation(velocity, np.cumsum(np.where(rest[:, None], 0.0, moved), axis=0))
