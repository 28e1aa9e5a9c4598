"""A walkable network derived from polygons alone, by the medial axis of the walkable area.

Points on the walls are the seeds of a Voronoi diagram; its edges between seeds of different walls are the lines as far
from one wall as from the other (the medial axis). Every corner and every recess sends out a branch of its own; those
that lead nowhere are pruned.

The circle about a point that just touches the walls is free of them, and so is every straight line in it. Hence all
that lies within the circle of one place becomes one node, and lines lead straight from it to the circle's rim: the
kinks that a medial axis makes at every opening vanish, and no line is moved through a wall.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import KDTree, Voronoi

from pdr_graph.geometry import length_along, wrap_angle
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


BEND = np.radians(40)  # a turn in a corridor that makes it two
SLACK, MOST_SLACK = 0.4, 1.5  # of the clearance, [m]: by which a line may leave the very middle
INNER = 0.9  # of the circle that is surely free
PARALLEL = 0.6  # |sin| of the angle between links of one corridor
ARM, SHORTEST_ARM = 1.5, 1.0  # clearances, [m]: of a line that tell its direction
RASTER = 0.1  # [m]
WIDEST_CORNER = 2.5  # clearances that a corner lies from the middle of its intersection, or it is a plaza without any
ISLAND = 4.0  # clearances that a way round something small is long


@dataclass(frozen=True)
class _Hubs:
    """The nodes to be. vertex: ``(n,)`` of the skeleton; at: ``(v,)`` the node that swallowed a vertex, −1 if none."""

    vertex: Index
    at: Index


def derive(ways: shapely.Geometry) -> tuple[Array, Array, Index, list[Array]]:
    """Nodes ``(n, 2)``, corners ``(n, 4, 2)``, links ``(l, 2)`` and their lines, of a (multi)polygon [m]."""
    middle = skeleton(ways)
    hubs = _hubs(middle)
    links, chains = _links(middle, hubs)
    lines = [_straightened(middle, hubs, link, chain, ways) for link, chain in zip(links, chains, strict=True)]
    clearance = middle.clearance[hubs.vertex]
    nodes = _where_lines_cross(middle.position[hubs.vertex], INNER * clearance, links, lines)
    for (i, j), line in zip(links, lines, strict=True):
        line[0], line[-1] = nodes[i], nodes[j]
    widths = [float(np.median(middle.clearance[chain])) for chain in chains]
    corners = np.array([_corners(n, nodes, links, lines, widths) for n in range(len(nodes))]).reshape(-1, 4, 2)
    far = np.hypot(*(corners - nodes[:, None]).T).max(axis=0) > WIDEST_CORNER * clearance
    corners[far] = np.nan
    linked, renumbered = np.unique(np.array(links, dtype=np.intp), return_inverse=True)
    return nodes[linked], corners[linked], renumbered.reshape(-1, 2), lines


def _hubs(middle: Skeleton) -> _Hubs:
    """Junctions, bends and ends, the roomiest first; each swallows those within its circle."""
    degree = np.bincount(middle.edges.ravel(), minlength=len(middle.position))
    bends = np.concatenate([_bends(middle, chain) for chain in middle.chains()] or [np.empty(0, dtype=np.intp)])
    junctions, ends = np.flatnonzero(degree > 2), np.flatnonzero(degree == 1)
    rank = np.concatenate([np.zeros(len(junctions)), np.ones(len(bends)), np.full(len(ends), 2)])
    candidates = np.concatenate([junctions, bends, ends]).astype(np.intp)
    chosen, at = list[int](), np.full(len(middle.position), -1)
    for v in candidates[np.lexsort((-middle.clearance[candidates], rank))].tolist():
        if at[v] < 0:
            near = np.hypot(*(middle.position[candidates] - middle.position[v]).T) < INNER * middle.clearance[v]
            swallowed = candidates[near & (at[candidates] < 0)]
            at[swallowed] = len(chosen)
            at[v] = len(chosen)
            chosen.append(v)
    return _Hubs(np.array(chosen, dtype=np.intp), at)


def _bends(middle: Skeleton, chain: Index) -> Index:
    """Where a line turns by more than BEND from one arm's length before to one after, and by more than beside it."""
    from scipy.signal import find_peaks  # here, since few walks need it and it takes half a second to load

    line = middle.position[chain]
    walked = length_along(line)
    arm = max(SHORTEST_ARM, ARM * float(np.median(middle.clearance[chain])))
    period = walked[-1] if chain[0] == chain[-1] else None
    ends = (0.0, walked[-1]) if period else (arm, walked[-1] - arm)
    at = np.arange(*ends, RASTER)
    if len(at) < 3:
        return np.empty(0, dtype=np.intp)
    before, here, after = (_point_at(s, walked, line, period) for s in (at - arm, at, at + arm))
    heading = [np.arctan2(*(b - a).T[::-1]) for a, b in ((before, here), (here, after))]
    turned = np.abs(wrap_angle(heading[1] - heading[0]))
    rolled = int(np.argmin(turned)) if period else 0  # a ring is cut where it is straight
    peaks, _ = find_peaks(np.pad(np.roll(turned, -rolled), 1), height=BEND, distance=max(1, arm / RASTER))
    found = at[(peaks - 1 + rolled) % len(at)]
    return chain[np.searchsorted(walked, found).clip(0, len(chain) - 1)]


def _point_at(s: Array, walked: Array, line: Array, period: float | None) -> Array:
    """Points ``(n, 2)`` at lengths ``s (n,)`` of a line [m]."""
    return np.stack([np.interp(s, walked, axis, period=period) for axis in line.T], axis=1)


def _links(middle: Skeleton, hubs: _Hubs) -> tuple[list[tuple[int, int]], list[Index]]:
    """Chains from hub to hub; those that stay within one or go round something small are none."""
    links, chains = list[tuple[int, int]](), list[Index]()
    for chain in middle.chains(np.flatnonzero(hubs.at >= 0).tolist()):
        i, j = (int(n) for n in hubs.at[chain[[0, -1]]])
        if i == j and middle.length(chain) < ISLAND * middle.clearance[hubs.vertex[i]]:
            continue
        links.append((i, j))
        chains.append(chain)
    return links, chains


def _straightened(middle: Skeleton, hubs: _Hubs, link: tuple[int, int], chain: Index, ways: shapely.Geometry) -> Array:
    """The line of a link: straight within the circles at both ends, simplified between them. [m]"""
    line = middle.position[chain]
    first, last = 0, len(line) - 1
    for end, n in enumerate(link):
        centre, radius = middle.position[hubs.vertex[n]], INNER * middle.clearance[hubs.vertex[n]]
        beyond = np.flatnonzero(np.hypot(*(line - centre).T) > radius)
        if end == 0:
            first = max(int(beyond[0]) - 1, 0) if len(beyond) else len(line) // 2
        else:
            last = min(int(beyond[-1]) + 1, len(line) - 1) if len(beyond) else len(line) // 2
    between = line[min(first, last) : max(first, last) + 1]
    slack = min(SLACK * float(np.median(middle.clearance[chain])), MOST_SLACK)
    if len(between) > 2:
        simple = shapely.simplify(shapely.linestrings(between), slack)
        if not shapely.covers(ways, simple):
            simple = shapely.simplify(
                shapely.linestrings(between), min(slack, float(middle.clearance[chain].min()) / 2)
            )
        between = shapely.get_coordinates(simple)
    return np.concatenate(
        [middle.position[hubs.vertex[link[0]]][None], between, middle.position[hubs.vertex[link[1]]][None]]
    )


def _where_lines_cross(nodes: Array, radius: Array, links: list[tuple[int, int]], lines: list[Array]) -> Array:
    """Each node moved to where the middles of its corridors cross, if that lies within its circle. [m]"""
    moved = nodes.copy()
    for n in range(len(nodes)):
        ways = _leaving(n, links, lines)
        if len(ways) < 2:
            continue
        at = np.array([way[1] for way, _ in ways])
        normal = np.array([(-u[1], u[0]) for _, u in ways])
        if np.abs(np.linalg.det(normal.T @ normal / len(ways))) < 0.05:
            continue
        crossing = np.linalg.solve(normal.T @ normal, normal.T @ np.sum(normal * at, axis=1))
        if np.hypot(*(crossing - nodes[n])) < radius[n]:
            moved[n] = crossing
    return moved


def _leaving(n: int, links: list[tuple[int, int]], lines: list[Array]) -> list[tuple[Array, Array]]:
    """The lines that leave a node, each with its direction beyond the node's circle."""
    ways = []
    for link, line in zip(links, lines, strict=True):
        for end, way in zip(link, (line, line[::-1]), strict=True):
            if end == n:
                far = np.flatnonzero(np.hypot(*(way - way[1]).T) > SHORTEST_ARM)
                far = far[far > 1]
                ahead = way[far[0]] - way[1] if len(far) else way[-1] - way[0]
                ways.append((way, ahead / max(float(np.hypot(*ahead)), 1e-9)))
    return ways


def _corners(n: int, nodes: Array, links: list[tuple[int, int]], lines: list[Array], widths: list[float]) -> Array:
    """Where the walls of the two corridors that meet at a node cross ``(4, 2)``, counter-clockwise. [m]"""
    ways = [u for _, u in _leaving(n, links, lines)]
    half = [w for link, w in zip(links, widths, strict=True) for end in link if end == n]
    if len(ways) < 2:
        return np.full((4, 2), np.nan)
    across = np.abs([[u[0] * v[1] - u[1] * v[0] for v in ways] for u in ways])
    i, j = np.unravel_index(np.argmax(across), across.shape)
    if across[i, j] < PARALLEL:
        return np.full((4, 2), np.nan)
    normal = np.array([(-ways[k][1], ways[k][0]) for k in (i, j)])
    reach = [min(h for h, s in zip(half, across[k], strict=True) if s < PARALLEL) for k in (i, j)]
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    corners = nodes[n] + np.linalg.solve(normal, (signs * reach).T).T
    return corners if shapely.is_ccw(shapely.linearrings(corners)) else corners[::-1]
