"""The middle lines of a walkable area: what is left of it when it burns from its walls inwards.

Points on the walls are the seeds of a Voronoi diagram; its edges between seeds of different walls are the lines as far
from one wall as from the other (the medial axis). Every corner and every recess sends out a branch of its own; those
that lead nowhere are pruned.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import KDTree, Voronoi

from pdr_graph.types import Array, Index

NARROWEST_AISLE = 0.6  # [m] the width of a pair of shoulders and no more: what is narrower is a slit between shops
SPACING = 0.3  # [m] between seeds: no more than half of the narrowest aisle would need, so that no line cuts a wall
DEAD_END = 3.0  # [m] by which a way leaves the place where it begins, or it is a recess
RECESS = 0.5  # of the clearance where it begins: a corner of a square hall reaches 0.41 of it


@dataclass(frozen=True)
class Skeleton:
    """Middle lines as a graph.

    position: ``(v, 2)`` [m]; clearance: ``(v,)`` to the nearest wall [m]; edges: ``(e, 2)`` indices into them.
    """

    position: Array
    clearance: Array
    edges: Index

    def chains(self, stops: Iterable[int] = ()) -> list[Index]:
        """Its lines, each the vertices from one stop to the next. Ends, junctions and ``stops`` are stops."""
        neighbours: dict[int, list[int]] = {}
        for i, j in self.edges.tolist():
            neighbours.setdefault(i, []).append(j)
            neighbours.setdefault(j, []).append(i)
        halts = {v for v, near in neighbours.items() if len(near) != 2} | (set(stops) & set(neighbours))
        used: set[tuple[int, int]] = set()
        found = [_walk(neighbours, halts, used, v, w) for v in halts for w in neighbours[v] if (v, w) not in used]
        for v in neighbours:  # rings without a stop
            if not any((v, w) in used for w in neighbours[v]):
                found.append(_walk(neighbours, {v}, used, v, neighbours[v][0]))
        return found

    def length(self, chain: Index) -> float:
        """Of a line. [m]"""
        return float(np.hypot(*np.diff(self.position[chain], axis=0).T).sum())


def skeleton(ways: shapely.Geometry) -> Skeleton:
    """The middle lines of a (multi)polygon [m], pruned."""
    half = NARROWEST_AISLE / 2
    open_enough = shapely.buffer(shapely.buffer(ways, -half, quad_segs=4), half, quad_segs=4)
    return _pruned(_medial_axis(open_enough))


def _medial_axis(area: shapely.Geometry) -> Skeleton:
    rings = shapely.get_rings(shapely.get_parts(area))
    seeds = shapely.get_coordinates(shapely.segmentize(rings, SPACING))
    seeds = seeds[np.unique(np.round(seeds, 3), axis=0, return_index=True)[1]]
    if len(seeds) < 4:
        return Skeleton(np.empty((0, 2)), np.empty(0), np.empty((0, 2), dtype=np.intp))
    middle = seeds.mean(axis=0)  # coordinates of a whole country would leave too few digits
    diagram = Voronoi(seeds - middle)
    vertices = diagram.vertices + middle
    edges = np.asarray(diagram.ridge_vertices, dtype=np.intp)
    apart = np.hypot(*(seeds[diagram.ridge_points[:, 0]] - seeds[diagram.ridge_points[:, 1]]).T)
    shapely.prepare(area)
    inside = shapely.contains_xy(area, *vertices.T)
    # An edge is nearest to its two seeds where it passes between them: seeds farther apart than neighbours keep it
    # clear of the wall on which they lie
    kept = (edges >= 0).all(axis=1) & inside[edges].all(axis=1) & (apart > NARROWEST_AISLE - SPACING / 4)
    used, edges = np.unique(edges[kept], return_inverse=True)
    position = vertices[used]
    return Skeleton(position, np.asarray(KDTree(seeds).query(position)[0]), edges.reshape(-1, 2))


def _pruned(whole: Skeleton) -> Skeleton:
    """Without the branches that lead nowhere; what they left is looked at again."""
    while True:
        chains = whole.chains()
        degree = np.bincount(whole.edges.ravel(), minlength=len(whole.position))
        doomed = [n for n, chain in enumerate(chains) if _leads_nowhere(whole, chain, degree)]
        doomed = _without_last(whole, chains, doomed)
        if not doomed:
            return whole
        gone = np.concatenate([np.stack([chains[n][:-1], chains[n][1:]], axis=1) for n in doomed])
        size = len(whole.position)
        keep = ~np.isin(_codes(whole.edges, size), _codes(gone, size))
        whole = replace(whole, edges=whole.edges[keep])


def _leads_nowhere(whole: Skeleton, chain: Index, degree: Index) -> bool:
    """True of a branch with one loose end that goes hardly further than one can see from where it begins."""
    loose = degree[chain[[0, -1]]] == 1
    if loose.sum() != 1:
        return False
    tip, base = (chain[0], chain[-1]) if loose[0] else (chain[-1], chain[0])
    reach = whole.length(chain) + whole.clearance[tip] - whole.clearance[base]
    return bool(reach < max(DEAD_END, RECESS * whole.clearance[base]))


def _without_last(whole: Skeleton, chains: list[Index], doomed: list[int]) -> list[int]:
    """Of a star of branches that would all go, the two longest stay: a hall is no corridor, but it is there."""
    at: dict[int, list[int]] = {}
    for n, chain in enumerate(chains):
        for v in {int(chain[0]), int(chain[-1])}:
            at.setdefault(v, []).append(n)
    spared: set[int] = set()
    for meeting in at.values():
        if len(meeting) > 2 and set(meeting) <= set(doomed):
            spared |= set(sorted(meeting, key=lambda n: whole.length(chains[n]))[-2:])
    return [n for n in doomed if n not in spared]


def _walk(
    neighbours: dict[int, list[int]], halts: set[int], used: set[tuple[int, int]], start: int, second: int
) -> Index:
    """The vertices from a stop by way of ``second`` to the next stop."""
    chain = [start, second]
    used |= {(start, second), (second, start)}
    while chain[-1] not in halts:
        ahead = next(v for v in neighbours[chain[-1]] if v != chain[-2])
        used |= {(chain[-1], ahead), (ahead, chain[-1])}
        chain.append(ahead)
    return np.array(chain, dtype=np.intp)


def _codes(edges: Index, size: int) -> Index:
    """One number per edge, whichever way round."""
    return edges.min(axis=1) * size + edges.max(axis=1)
