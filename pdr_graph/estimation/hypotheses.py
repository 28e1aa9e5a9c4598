"""The different ways that a building admits a walk, from the ancestors of a particle filter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from pdr_graph.estimation.cloud import Paths
from pdr_graph.estimation.graph import State, WalkGraph
from pdr_graph.estimation.particles import particle_filter
from pdr_graph.types import Array, Index

MOST_WAYS = 8
APART = 4.0  # [m] between two ways, somewhere: nearer ones lead the optimiser to the same walk
MOMENTS = 60  # at which ways are compared
GLANCED, LEADERS = 8, 5  # moments and bundles at a glance
NEGLECTED = 0.01  # of the particles


def hypotheses(graph: WalkGraph, attempt: int = 0) -> list[State]:
    """Starts for the optimiser, each the middle of a bundle of particles, the thickest bundle first.

    attempt: each has others, and twice as many of them as the one before.
    """
    paths = particle_filter(graph, seed=attempt, times=2**attempt)
    first = graph.segment_first
    return [replace(graph.start, poses=paths.state[:, :3, n], c=paths.state[first + 1, 3:, n]) for n in bundles(paths)]


def bundles(paths: Paths) -> list[int]:
    """The middle path of each bundle of ``paths``, the thickest bundle first."""
    found = list(_bundles(paths.state[_moments(paths, MOMENTS), :2], paths.weight))
    return [n for _, n in sorted(found, reverse=True)[:MOST_WAYS]]


def thickest(paths: Paths) -> list[tuple[float, int]]:
    """The thickest bundles at a glance, for a walk under way: share and middle path of each, the thickest first.

    Those about a few paths taken at random: what has a large share is among them.
    """
    order = np.random.default_rng(0).permutation(len(paths.weight))
    track = paths.state[_moments(paths, GLANCED), :2].take(order, axis=2)
    found = sorted(islice(_bundles(track, paths.weight[order]), LEADERS), reverse=True)
    return [(share, int(order[n])) for share, n in found]


def _moments(paths: Paths, most: int) -> Index:
    """Keyframes, spread evenly, at which paths are compared."""
    return np.unique(np.linspace(0, len(paths.state) - 1, most).astype(int))


def _bundles(track: Array, weight: Array) -> Iterator[tuple[float, int]]:
    """Share and middle path of each bundle. track: ``(k, 2, n)`` [m]; weight: ``(n,)``."""
    number, left = np.arange(len(weight)), weight > 0
    while weight[left].sum() > NEGLECTED:
        track, weight, number = track.compress(left, axis=2), weight[left], number[left]
        near = _apart(track, track[:, :, 0]) < APART**2
        share = np.where(near, weight, 0.0)
        middle = track @ (share / share.sum())
        central = int(np.argmin(np.where(near, _apart(track, middle), np.inf)))
        bundle = _apart(track, track[:, :, central]) < APART**2
        yield float(weight[bundle].sum()), int(number[central])
        left = ~(bundle | near)


def _apart(track: Array, path: Array) -> Array:
    """Square of the greatest distance ``(n,)`` [m²] of each of the tracks ``(k, 2, n)`` from a path ``(k, 2)``."""
    x, y = (track[:, axis] - path[:, axis, None] for axis in (0, 1))
    x *= x
    y *= y
    x += y
    return x.max(axis=0)
