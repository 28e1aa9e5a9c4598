"""The way that somebody takes along the corners of a route: rounded, weaving, zigzagging, up stairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pdr_graph.geometry import interpolate, length_along
from pdr_graph.simulation.noise import slow
from pdr_graph.types import Array

SPACING = 0.05  # [m] between points of a way
ROUNDING = 0.45  # [m] over which a corner is rounded
WEAVE, WEAVE_LENGTH = 0.12, 6.0  # [m] to the side of the straight line, and over which way it changes
CLEARANCE = 0.35  # [m] that people keep from walls
Clearance = Callable[[Array], Array]  # distance to the nearest wall [m] of positions (n, 2)


@dataclass(frozen=True)
class Way:
    """A curve on the floor.

    along: ``(n,)`` length from its start [m]; position: ``(n, 2)`` [m]; height: ``(n,)`` [m];
    heading: ``(n,)`` of its tangent, unwrapped [rad].
    """

    along: Array
    position: Array
    height: Array
    heading: Array

    @property
    def length(self) -> float:
        """Its length. [m]"""
        return float(self.along[-1])

    def turned(self, begin: float, end: float) -> float:
        """Change of heading between two places on the way. [rad]"""
        before, after = np.interp([begin, end], self.along, self.heading)
        return float(after - before)


def way_along(
    corners: Array,
    heights: Array,
    zigzag: Array,
    random: np.random.Generator,
    clearance: Clearance | None = None,
) -> Way:
    """Somebody's way along ``corners (k, 2)`` [m] at ``heights (k,)`` [m].

    zigzag: ``(k - 1,)`` amplitude of swinging from side to side on each leg [m], about every 6 m.
    clearance: distance to the nearest wall; the way sways less where that leaves less than CLEARANCE.
    """
    length = length_along(corners)
    count = max(3, round(length[-1] / SPACING) + 1)
    s = np.linspace(0.0, length[-1], count)
    straight = interpolate(s, length, corners)
    rounded = gaussian_filter1d(straight, min(ROUNDING, length[-1] / 8) / SPACING, axis=0, mode="nearest")
    rounded = rounded + _ends(s, straight[0] - rounded[0], straight[-1] - rounded[-1])
    offset = slow(random, count, WEAVE_LENGTH / SPACING, WEAVE)[:, 0]
    leg = np.clip(np.searchsorted(length, s, side="right") - 1, 0, len(zigzag) - 1)
    swinging = np.sin(2 * np.pi * s / random.uniform(5, 7) + random.uniform(0, 2 * np.pi))
    offset = offset + gaussian_filter1d(zigzag[leg], 1.0 / SPACING, mode="nearest") * swinging
    offset *= np.clip(np.minimum(s, s[-1] - s) / 1.5, 0, 1)  # it begins and ends where it is told
    position = _swayed(rounded, offset, clearance)
    position = gaussian_filter1d(position, 0.3 / SPACING, axis=0, mode="nearest")
    position = position + _ends(s, corners[0] - position[0], corners[-1] - position[-1])
    tangent = np.gradient(position, SPACING, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return Way(length_along(position), position, np.interp(s, length, heights), heading)


def _ends(s: Array, at_start: Array, at_end: Array) -> Array:
    """A correction that fades over half a metre from both ends."""
    fade = [np.clip(1 - d / 0.5, 0, 1)[:, None] for d in (s, s[-1] - s)]
    return fade[0] * at_start + fade[1] * at_end


def _swayed(line: Array, offset: Array, clearance: Clearance | None) -> Array:
    """The line moved to its left by ``offset``, halved where that comes too near to a wall."""
    tangent = np.gradient(line, axis=0)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    left /= np.maximum(np.hypot(*left.T), 1e-9)[:, None]
    offset = offset.copy()
    for _ in range(5):
        if clearance is not None:
            offset[clearance(line + offset[:, None] * left) < CLEARANCE] /= 2
    return line + offset[:, None] * left
