"""Places that were seen again: moments of different walks, or of one, at which the radios heard about the same.

[map-matching] and [calibration-walk] know one walk at a time. What a phone hears is a place's own, so that scans that
are alike tie the places where they were heard. How far apart such places are, by how unlike the scans are, is learnt
from the walks themselves, as they are known so far. Walkers shade a radio on one side, and hold it otherwise the next
day: closures of the same two walks err alike for a while, and together are worth one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.closures import Closures
from pdr_graph.estimation.fingerprints import Scans, unlikeness
from pdr_graph.estimation.radio_map import ENOUGH, FINEST, NEAR, variance_by_distance
from pdr_graph.geometry import interpolate, length_along, nearest
from pdr_graph.types import Array, Index, Mask, Trajectory

EVERY = 3.0  # [m] of a walk that one scan speaks for: phones hear the same for seconds
ALONG = 30.0  # [m] of a walk in which closures to the same other walk err alike, by metres
LATER = 60.0  # [s] after which a walk sees a place *again*
ACCEPTED = 0.8  # of the pairs at places that are near by the walks so far: less alike ones tell nothing
USUALLY_ALIKE, USUALLY_APART = 0.3, 5.0  # [m] σ: pairs in two malls, where the walks are too little known to tell


@dataclass(frozen=True)
class _Heard:
    """Scans of all walks, thinned: walk, time [s], how far along it [m], level ``(n, m)``, position ``(n, 2)`` [m]
    and floor.
    """

    walk: Index
    time: Array
    way: Array
    level: Array
    position: Array
    floor: tuple[str, ...]


def revisits(walks: Sequence[tuple[Trajectory, Scans]]) -> Closures:
    """Closures between the moments of walks in one frame that were spent at one place.

    walks: each as it is known so far, and what was heard. Of each pair of walks, every few metres of the one that has
    them, the moment of the other that sounds most alike.
    """
    if not any(len(scans) for _, scans in walks):
        return Closures.of([])
    heard = _heard(walks)
    pairs = np.array([pair for pair in _most_alike(heard)]).reshape(-1, 3)
    one, other, distance = pairs[:, 0].astype(int), pairs[:, 1].astype(int), pairs[:, 2]
    apart = heard.position[other] - heard.position[one]
    taken, sigma = _believed(distance, apart)
    one, other = one[taken], other[taken]
    sigma *= np.sqrt(_alike(heard.walk[one] * len(walks) + heard.walk[other], heard.way[one]))
    return Closures(
        np.stack([heard.time[one], heard.time[other]], axis=1),
        sigma,
        np.stack([heard.walk[one], heard.walk[other]], axis=1),
    )


def _believed(distance: Array, apart: Array) -> tuple[Mask, Array]:
    """Which pairs ``(p,)`` are of one place, and the sigma of each that does [m].

    distance: ``(p,)`` how unlike their scans are; apart: ``(p, 2)`` from one to the other, by the walks so far [m].
    """
    known = np.hypot(*apart.T) < NEAR
    if known.sum() < ENOUGH:
        taken = distance < USUALLY_ALIKE
        return taken, np.full(np.count_nonzero(taken), USUALLY_APART)
    least, most = np.quantile(distance[known], [1 - ACCEPTED, ACCEPTED])
    taken = distance <= most
    at = distance[taken].clip(least)
    v_0, v_1 = variance_by_distance(at, apart[taken])
    return taken, np.sqrt((v_0 + v_1 * at**2).clip(FINEST**2))


def _alike(pair: Index, way: Array) -> Array:
    """How many closures of the same two walks err like each ``(l,)``, itself among them: together they are worth one.

    way: along one of the walks [m].
    """
    near = (pair[:, None] == pair) & (np.abs(way[:, None] - way) < ALONG)
    return near.sum(axis=1)


def _heard(walks: Sequence[tuple[Trajectory, Scans]]) -> _Heard:
    """What all walks heard, a scan every few metres."""
    thinned = [_thinned(track, scans) for track, scans in walks]
    names = sorted({name for scans in thinned for name in scans.transmitter})
    position = [interpolate(s.time, track.time, track.position) for (track, _), s in zip(walks, thinned, strict=True)]
    rows = [nearest(track.time, s.time) for (track, _), s in zip(walks, thinned, strict=True)]
    return _Heard(
        walk=np.repeat(np.arange(len(walks)), [len(scans) for scans in thinned]),
        time=np.concatenate([scans.time for scans in thinned]),
        way=np.concatenate([_way(track, scans) for (track, _), scans in zip(walks, thinned, strict=True)]),
        level=np.concatenate([scans.of(names) for scans in thinned]),
        position=np.concatenate(position),
        floor=tuple(track.floor[r] for (track, _), own in zip(walks, rows, strict=True) for r in own.tolist()),
    )


def _thinned(track: Trajectory, scans: Scans) -> Scans:
    """One scan in every few metres of the walk."""
    scans = scans[(scans.time >= track.time[0]) & (scans.time <= track.time[-1])]
    return scans[np.unique(np.floor(_way(track, scans) / EVERY), return_index=True)[1]]


def _way(track: Trajectory, scans: Scans) -> Array:
    """How far along the walk each scan was. [m]"""
    return np.interp(scans.time, track.time, length_along(track.position))


def _most_alike(heard: _Heard) -> Iterator[tuple[int, int, float]]:
    """Of each scan the most alike one of each walk that is not earlier; and how unlike they are."""
    distance = unlikeness(heard.level, heard.level)
    floor = np.array(heard.floor)
    apart = (floor[:, None] != floor) & (floor != "")[:, None] & (floor != "")
    same = heard.walk[:, None] == heard.walk
    soon = same & (heard.time - heard.time[:, None] < LATER)
    distance = np.where(apart | soon | (heard.walk < heard.walk[:, None]), 1.0, distance)
    first = np.flatnonzero(np.diff(heard.walk, prepend=-1))
    for begin, end in zip(first.tolist(), [*first[1:].tolist(), len(heard.walk)], strict=True):
        best = begin + np.argmin(distance[:, begin:end], axis=1)
        for one in np.flatnonzero(distance[np.arange(len(best)), best] < 1).tolist():
            yield one, int(best[one]), float(distance[one, best[one]])
