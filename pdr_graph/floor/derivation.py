"""A walkable network derived from polygons alone: where the middle lines of the walkable area meet, turn and end.

The circle about a point that just touches the walls is free of them, and so is every straight line in it. Hence all
that lies within the circle of one place becomes one node, and lines lead straight from it to the circle's rim: the
kinks that a medial axis makes at every opening vanish, and no line is moved through a wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from pdr_graph.floor.skeleton import Skeleton, skeleton
from pdr_graph.geometry import length_along, wrap_angle
from pdr_graph.types import Array, Index

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
