"""How well the levels of listed beacons fit their places: which are not where the list has them.

A beacon that is not at its listed position, moved or swapped with another, is detected by comparing its levels,
received and *not* received, with those expected at every possible place: that a near beacon is not received is stronger
evidence than the level of a far one.
"""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from pdr_graph.measurements import Levels
from pdr_graph.priors import BEACONS
from pdr_graph.types import Array, Index

POWERS = np.arange(-12.0, 12.5, 3.0)  # [dB] candidate powers of a beacon
MOST_STRETCHES = 400  # of a walk by which a list is judged, evenly spaced: a kilometre; more repeat the same fading
MOST_AT_ONCE = 1_000_000  # costs of places, powers and stretches in memory


def placement_costs(levels: Levels, keyframe_time: Array, position: Array, q: Array) -> tuple[Index, Array, Array]:
    """How well the levels of each surveyed beacon fit each place.

    Returns the ``m`` surveyed beacons; places ``(p, 2)`` [m], first those listed for them; costs ``(m, p)`` [nats].
    """
    track, table = level_table(levels, keyframe_time, position)
    every = -(-len(track) // MOST_STRETCHES)
    track, table = track[::every], table[:, ::every]
    surveyed = np.flatnonzero(np.isfinite(levels.position[:, 0]))
    places = np.concatenate([levels.position[surveyed], _grid(track)])
    square = np.sum((track - places[:, None]) ** 2, axis=2) + BEACONS.height**2
    expected = q[0] - 5 * q[1] * np.log10(square)
    parts = np.array_split(expected, 1 + expected.size * len(POWERS) // MOST_AT_ONCE)
    return surveyed, places, np.concatenate([_negative_log_likelihood(table[surveyed], part) for part in parts], axis=1)


def level_table(levels: Levels, keyframe_time: Array, position: Array) -> tuple[Array, Array]:
    """Places ``(s, 2)`` [m] of the stretches of a walk; levels ``(m, s)`` of the beacons, NaN where not received."""
    stretch, of = np.unique(levels.time, return_inverse=True)
    track = np.stack([np.interp(stretch, keyframe_time, axis) for axis in position.T], axis=1)
    table = np.full((len(levels.position), len(stretch)), np.nan)
    table[levels.beacon, of] = levels.rssi
    return track, table


def _grid(track: Array) -> Array:
    """Candidate positions ``(n, 2)`` [m] around a walk."""
    low, high = track.min(axis=0) - BEACONS.beside, track.max(axis=0) + BEACONS.beside
    axes = (np.arange(a, b, BEACONS.grid) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _negative_log_likelihood(levels: Array, expected: Array) -> Array:
    """Negative log-likelihood ``(m, p)`` of the levels of each beacon at each place, at its most likely power.

    levels: ``(m, s)`` of each stretch, NaN where not received; expected: ``(p, s)``.
    """
    silent = _bounded(-log_ndtr((BEACONS.weakest - expected[:, None] - POWERS[:, None]) / BEACONS.level_sigma))
    least = np.empty((len(levels), len(expected)))
    for m, received in enumerate(np.isfinite(levels)):
        expected_here = np.compress(received, expected, axis=1)[:, None]
        off = (levels[m, received] - expected_here - POWERS[:, None]) / BEACONS.level_sigma
        total = _bounded(0.5 * off**2).sum(axis=2) + np.compress(~received, silent, axis=2).sum(axis=2)
        least[m] = np.min(total + 0.5 * (POWERS / BEACONS.power_sigma) ** 2, axis=1)
    return least


def _bounded(cost: Array) -> Array:
    """Costs of levels, each at most MOST_EVIDENCE."""
    return np.minimum(cost, BEACONS.most_evidence)
