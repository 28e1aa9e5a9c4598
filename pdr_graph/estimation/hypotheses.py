"""The different ways that a building admits a walk, from the ancestors of a particle filter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pdr_graph.estimation.graph import State, WalkGraph
from pdr_graph.estimation.particles import Paths, particle_filter
from pdr_graph.types import Array

MOST_WAYS = 8
APART = 4.0  # [m] between two ways, somewhere: nearer ones lead the optimiser to the same walk
MOMENTS = 60  # at which ways are compared
NEGLECTED = 0.01  # of the particles


def hypotheses(graph: WalkGraph, attempt: int = 0) -> list[State]:
    """Starts for the optimiser, each the middle of a bundle of particles, the thickest bundle first.

    attempt: each has others, and twice as many of them as the one before.
    """
    paths = particle_filter(graph, seed=attempt, times=2**attempt)
    first = np.flatnonzero(np.diff(graph.segment, prepend=-1))
    return [replace(graph.start, poses=paths.state[:, :3, n], c=paths.state[first + 1, 3:, n]) for n in bundles(paths)]


def bundles(paths: Paths) -> list[int]:
    """The middle path of each bundle of ``paths``, the thickest bundle first."""
    moments = np.unique(np.linspace(0, len(paths.state) - 1, MOMENTS).astype(int))
    found = list(_bundles(paths.state[moments, :2], paths.weight))
    return [n for _, n in sorted(found, reverse=True)[:MOST_WAYS]]


def _bundles(track: Array, weight: Array) -> Iterator[tuple[float, int]]:
    """Share and middle path of each bundle. track: ``(k, 2, n)`` [m]; weight: ``(n,)``."""
    left = np.ones(len(weight), dtype=bool)
    while weight[left].sum() > NEGLECTED:
        leader = int(np.flatnonzero(left)[0])
        near = left & (_apart(track, track[:, :, leader]) < APART)
        middle = np.average(track[:, :, near], axis=2, weights=weight[near])
        central = int(np.argmin(np.where(near, _apart(track, middle), np.inf)))
        bundle = left & (_apart(track, track[:, :, central]) < APART)
        yield float(weight[bundle].sum()), central
        left &= ~(bundle | near)


def _apart(track: Array, path: Array) -> Array:
    """Greatest distance ``(n,)`` [m] of each of the tracks ``(k, 2, n)`` from a path ``(k, 2)``."""
    return np.hypot(*(track - path[:, :, None]).transpose(1, 0, 2)).max(axis=0)
