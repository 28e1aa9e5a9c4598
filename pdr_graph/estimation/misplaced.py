"""Beacons that are not where a list says they are: moved, or swapped with another.

A beacon's levels, heard and *not* heard, are held against every place it could be, along a walk that all of them and
the other measurements lay. That a near beacon is silent tells more than how loud a far one is: of the three published
IPIN walks it is what finds the two entries that were swapped.
"""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from pdr_graph.estimation.beacons import HIGH, LEVEL_SIGMA, OWN_SIGMA, Levels
from pdr_graph.types import Array

WEAKEST = -97.0  # [dBm] that phones hear
DOUBTED = 4.5  # log-odds at which one level has said all it can
MOVED, APART = 8.0, 15.0  # log-odds at which a beacon is taken to be elsewhere, and how far [m]
GRID, BESIDE = 5.0, 20.0  # [m] between places that are tried, and how far beside the walk
OFFSETS = np.arange(-12.0, 12.5, 3.0)  # [dB] of a beacon's own power


def misplaced(levels: Levels, keyframe_time: Array, position: Array, q: Array) -> list[int]:
    """The surveyed beacons that must be elsewhere. position: ``(k, 2)`` of the walk at its keyframes; q: (P, n, k)."""
    stretch, of = np.unique(levels.time, return_inverse=True)
    track = np.stack([np.interp(stretch, keyframe_time, axis) for axis in position.T], axis=1)
    listed, surveyed = levels.position, np.flatnonzero(np.isfinite(levels.position[:, 0]))
    places = np.concatenate([listed[surveyed], _grid(track)])
    square = np.sum((track - places[:, None]) ** 2, axis=2) + HIGH**2
    expected = q[0] - 5 * q[1] * np.log10(square)
    found = list[int]()
    for m in surveyed:
        level = np.full(len(stretch), np.nan)
        own = levels.beacon == m
        level[of[own]] = levels.rssi[own]
        surprise = np.array([_surprise(level, at) for at in expected])
        near = np.hypot(*(places - listed[m]).T) < APART
        if surprise[near].min() - surprise.min() > MOVED:
            found.append(int(m))
    return found


def _grid(track: Array) -> Array:
    """Places ``(n, 2)`` about a walk."""
    low, high = track.min(axis=0) - BESIDE, track.max(axis=0) + BESIDE
    axes = (np.arange(a, b, GRID) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _surprise(level: Array, expected: Array) -> float:
    """What levels ``(n,)``, NaN where nothing was heard, have against those expected, at the best power."""
    heard = np.isfinite(level)
    off = (level[heard] - expected[heard] - OFFSETS[:, None]) / LEVEL_SIGMA
    silent = -log_ndtr((WEAKEST - expected[~heard] - OFFSETS[:, None]) / LEVEL_SIGMA)
    total = np.minimum(0.5 * off**2, DOUBTED).sum(axis=1) + np.minimum(silent, DOUBTED).sum(axis=1)
    return float(np.min(total + 0.5 * (OFFSETS / OWN_SIGMA) ** 2))
