"""Modes of the path distribution on a plan, from the ancestors of a particle filter."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from pdr_graph.estimation.factors.base import State
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.particle_filter import Paths, particle_filter
from pdr_graph.types import Array, Index

MOST_MODES = 8
APART = 4.0  # [m] largest distance between two modes: nearer ones lead the optimiser to the same walk
MOMENTS = 60  # keyframes at which paths are compared
GLANCED, LEADERS = 8, 5  # the same for a walk under way; modes that are computed
NEGLECTED = 0.01  # of the particles


def hypotheses(graph: WalkGraph, attempt: int = 0) -> list[State]:
    """Starts for the optimiser: the middle path of each mode, the heaviest mode first.

    attempt: each draws other particles, twice as many as the one before.
    """
    paths = particle_filter(graph, seed=attempt, times=2**attempt)
    first = graph.chain.segment_first
    return [graph.start.replaced(x=paths.state[:, :3, n], c=paths.state[first + 1, 3:, n]) for n in path_modes(paths)]


def path_modes(paths: Paths) -> list[int]:
    """The middle path of each mode of ``paths``, the heaviest mode first."""
    found = list(_modes(paths.state[_moments(paths, MOMENTS), :2], paths.weight))
    return [n for _, n in sorted(found, reverse=True)[:MOST_MODES]]


def dominant_modes(paths: Paths) -> list[tuple[float, int]]:
    """Share and middle path of the heaviest modes, approximately and fast, for a walk under way.

    Modes are formed around a few random paths; a mode with a large share is among them.
    """
    order = np.random.default_rng(0).permutation(len(paths.weight))
    track = paths.state[_moments(paths, GLANCED), :2].take(order, axis=2)
    found = sorted(islice(_modes(track, paths.weight[order]), LEADERS), reverse=True)
    return [(share, int(order[n])) for share, n in found]


def _moments(paths: Paths, most: int) -> Index:
    """Keyframes, spread evenly, at which paths are compared."""
    return np.unique(np.linspace(0, len(paths.state) - 1, most).astype(int))


def _modes(track: Array, weight: Array) -> Iterator[tuple[float, int]]:
    """Share and middle path of each mode. track: ``(k, 2, n)`` [m]; weight: ``(n,)``."""
    number, left = np.arange(len(weight)), weight > 0
    while weight[left].sum() > NEGLECTED:
        track, weight, number = track.compress(left, axis=2), weight[left], number[left]
        near = _apart(track, track[:, :, 0]) < APART**2
        share = np.where(near, weight, 0.0)
        middle = track @ (share / share.sum())
        central = int(np.argmin(np.where(near, _apart(track, middle), np.inf)))
        mode = _apart(track, track[:, :, central]) < APART**2
        yield float(weight[mode].sum()), int(number[central])
        left = ~(mode | near)


def _apart(track: Array, path: Array) -> Array:
    """Square of the greatest distance ``(n,)`` [m²] of each of the tracks ``(k, 2, n)`` from a path ``(k, 2)``."""
    x, y = (track[:, axis] - path[:, axis, None] for axis in (0, 1))
    x *= x
    y *= y
    x += y
    return x.max(axis=0)
