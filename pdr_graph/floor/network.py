"""The walkable network of a floor: intersections and the corridors between them.

[map-matching] Sec. 3.8 describes a building by the positions of its intersections, their four corners and the links
between them. They are taken from the plan if it draws intersections, and derived from its polygons otherwise.

**Derivation**, by the medial axis of the walkable area. Points on the walls are the seeds of a Voronoi diagram. Its
edges between seeds of different walls are equally far from both walls: the medial axis. Every corner and every recess
has a branch of it; branches that lead nowhere are pruned.

The circle around a point that just touches the walls is free of walls, and so is every straight line in it. Therefore
all vertices within one circle become one node, and lines are straight from the node to the circle's rim: this removes
the kinks of the medial axis at openings without moving a line through a wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from scipy.spatial import KDTree, Voronoi

from pdr_graph.floor.cells import CLOSED, DOOR, LINK, OPEN, Area, Cells, without_cracks
from pdr_graph.geometry import length_along, peaks, wrap_angle
from pdr_graph.types import Array, Index, OneLineRepr

AT_A_TIME = 200  # steps that are compared with the segments around them at a time: a town has many
BEYOND = 30.0  # [m] around these: a segment farther off than some corridor widths is none of theirs
TOUCH = 0.15  # [m] between a corridor and an intersection that were meant to meet; chosen by hand


class Lines:
    """Lines that people walk along: the corridors of a floor, or ways outdoors.

    lines: of each, ``(m, 2)`` [m]; width: ``(l,)`` [m].
    """

    lines: tuple[Array, ...]
    width: Any

    def __len__(self) -> int:
        return len(self.lines)

    @cached_property
    def segments(self) -> Segments:
        """The straight segments of all lines, in order."""
        starts = [line[:-1] for line in self.lines]
        link = np.repeat(np.arange(len(self)), [len(s) for s in starts])
        along = [np.diff(line, axis=0) for line in self.lines]
        empty = np.empty((0, 2))
        return Segments(np.concatenate([*starts, empty]), np.concatenate([*along, empty]), link)


@dataclass(frozen=True)
class Network(Lines, OneLineRepr):
    """Nodes and links of a floor.

    nodes: ``(n, 2)`` [m]; corners: ``(n, 4, 2)`` of each intersection, counter-clockwise, NaN at dead ends and where no
    corridors cross [m]; links: ``(l, 2)`` nodes; lines: the centre line of each link, ``(m, 2)`` from its first node to
    its second [m]; width: ``(l,)`` between the walls beside it [m]; area: the polygon that they lie in [m].
    """

    nodes: Array
    corners: Array
    links: Index
    lines: tuple[Array, ...]
    width: Array
    area: shapely.Geometry

    @classmethod
    def within(cls, area: shapely.Geometry, nodes: Array, corners: Array, links: Index, lines: list[Array]) -> Network:
        """The network of an area, with the widths that its border leaves: the median along each link."""
        shapely.prepare(border := shapely.boundary(area))
        points = [shapely.get_coordinates(shapely.segmentize(shapely.linestrings(line), TOUCH * 4)) for line in lines]
        width = [2 * float(np.median(shapely.distance(shapely.points(at), border))) for at in points]
        return cls(nodes, corners, links, tuple(lines), np.array(width), area)

    def walls(self, slack: float = 0.0) -> Array:
        """All wall segments ``(w, 2, 2)`` around the area, moved outwards by ``slack``. [m]

        [map-matching] connects the corners of neighbouring intersections, which is the same for straight corridors.
        """
        area = shapely.buffer(self.area, slack, join_style="mitre") if slack else self.area
        rings = [shapely.get_coordinates(r) for r in shapely.get_rings(shapely.get_parts(area))]
        return np.concatenate([np.stack([r[:-1], r[1:]], axis=1) for r in rings] or [np.empty((0, 2, 2))])

    def leaving(self, link: int, node: int) -> Array:
        """The centre line ``(m, 2)`` of a link, from one of its nodes to the other. [m]"""
        line = self.lines[link]
        return line if self.links[link, 0] == node else line[::-1]

    def direction(self, link: int, node: int) -> Array:
        """Unit vector ``(2,)`` along a link, away from one of its nodes."""
        ahead = np.diff(self.leaving(link, node)[:2], axis=0)[0]
        return ahead / np.hypot(*ahead)


@dataclass(frozen=True)
class Segments(OneLineRepr):
    """The straight segments of the links of a network.

    start, along: ``(s, 2)`` first point and vector to the last [m]; link: ``(s,)`` number of the link.
    """

    start: Array
    along: Array
    link: Index

    def projected(self, points: Array) -> Array:
        """The nearest point on each segment ``(n, s, 2)`` to points ``(n, 2)``. [m]"""
        to = points[:, None] - self.start
        share = np.sum(to * self.along, axis=2) / np.maximum(np.sum(self.along**2, axis=1), 1e-12)
        return self.start + np.clip(share, 0, 1)[..., None] * self.along

    def nearest(self, point: Array) -> tuple[int, float]:
        """Link nearest to a point ``(2,)`` [m], and its distance [m]."""
        apart = np.hypot(*(self.projected(point[None])[0] - point).T)
        return int(self.link[np.argmin(apart)]), float(apart.min())


def segment_costs(segments: Segments, start: Array, end: Array) -> Array:
    """Cost ``(n, s)`` of assigning each step, from ``start`` to ``end (n, 2)`` [m], to each segment.

    [map-matching] Sec. 3.3 scores distance and angle and gives no formula. Here the cost is the sum of both squares,
    each divided by its usual value; the cost of a distance saturates beyond two corridor widths, where the track is
    lost. A segment has no direction.
    """
    usual_distance, usual_angle = 3.0, np.radians(30)  # [m], [rad] a corridor's width, a zigzag
    largest = 4.0  # cost of a distance: less than that of a right angle
    apart = np.linalg.norm(segments.projected(end) - end[:, None], axis=2)
    step, along = np.arctan2(*(end - start).T[::-1]), np.arctan2(*segments.along.T[::-1])
    askew = np.abs(wrap_angle(2 * (step[:, None] - along))) / 2
    squared = (apart / usual_distance) ** 2
    return squared / (1 + squared / largest) + (askew / usual_angle) ** 2


def nearest_segments(segments: Segments, track: Array) -> tuple[Index, Array]:
    """The segment ``(n - 1,)`` of least cost for each step of a walk through places ``track (n, 2)``, and that cost."""
    nearest, cost = np.zeros(len(track) - 1, dtype=np.intp), np.full(len(track) - 1, np.inf)
    low, high = (bound(segments.start, segments.start + segments.along) for bound in (np.minimum, np.maximum))
    for begin in range(0, len(nearest), AT_A_TIME):
        part = track[begin : begin + AT_A_TIME + 1]
        near = (low < part.max(axis=0) + BEYOND).all(axis=1) & (high > part.min(axis=0) - BEYOND).all(axis=1)
        if not near.any():
            continue
        which = np.flatnonzero(near)
        here = Segments(segments.start[which], segments.along[which], segments.link[which])
        costs, rows = segment_costs(here, part[:-1], part[1:]), slice(begin, begin + AT_A_TIME)
        nearest[rows], cost[rows] = which[costs.argmin(axis=1)], costs.min(axis=1)
    return nearest, cost


def drawn_network(areas: tuple[Area, ...], cells: Cells, walkable: shapely.Geometry) -> Network | None:
    """The network that a plan draws; None if it draws no intersections, or links that lead through walls."""
    drawn = _drawn_links(areas)
    if drawn is None:
        return None
    (nodes, corners, links, lines), area = drawn, _network_area(cells, walkable)
    within = shapely.covers(shapely.buffer(area, TOUCH), shapely.MultiLineString(lines))
    return Network.within(area, nodes, corners, links, lines) if within else None


def derived_network(cells: Cells, walkable: shapely.Geometry) -> Network:
    """The network derived from the walkable area; this takes seconds on a large floor."""
    area = _network_area(cells, walkable)
    return Network.within(area, *derive(area))


def _network_area(cells: Cells, walkable: shapely.Geometry) -> shapely.Geometry:
    """The area of the network: the corridors if the plan has rooms and doors, else the whole walkable area."""
    open_cells = {n for n, cell in enumerate(cells.cells) if cell.kind in OPEN}
    has_doors = any(cell.kind in CLOSED for cell in cells.cells) and any(cell.kind == DOOR for cell in cells.cells)
    if open_cells and has_doors:
        beside = [cells.passages[(cells.passages == n).any(axis=1)].ravel().tolist() for n in range(len(cells))]
        doors = {n for n, c in enumerate(cells.cells) if c.kind == DOOR and len(open_cells & set(beside[n])) > 1}
        parts = [cells.cells[n].polygon for n in sorted(open_cells | doors)]
        walkable = shapely.intersection(without_cracks(parts), walkable)
    return shapely.difference(walkable, shapely.buffer(cells.barriers, 0.05, cap_style="flat"))


def _drawn_links(areas: tuple[Area, ...]) -> tuple[Array, Array, Index, list[Array]] | None:
    """Nodes, corners, links and lines from the drawn intersections; None without any.

    Links follow the lines of kind ``link``, or the axes of the corridors if there are none.
    """
    crossings = [a.shape for a in areas if a.kind == "intersection" and a.is_polygon]
    if not crossings:
        return None
    axes = [a.shape for a in areas if a.kind == LINK]
    axes = axes or [_axis(a.shape, crossings) for a in areas if a.kind == "corridor" and a.is_polygon]
    nodes = [shapely.get_coordinates(shapely.centroid(c))[0] for c in crossings]
    corners = [_four_corners(c) for c in crossings]
    links, lines = list[tuple[int, int]](), list[Array]()
    between = shapely.union_all(shapely.difference(axes, shapely.union_all(crossings)))
    for piece in shapely.get_parts(shapely.line_merge(between)):
        line = shapely.get_coordinates(piece)
        ends = [_crossing_at(line[end], crossings) for end in (0, -1)]
        # a line beyond an intersection is a link from 1 m on
        if ends == [None, None] or (None in ends and shapely.length(piece) < 1.0):
            continue
        for end, place in enumerate((line[0], line[-1])):
            if ends[end] is None:  # a dead end
                ends[end] = len(nodes)
                nodes.append(place)
                corners.append(np.full((4, 2), np.nan))
        i, j = (n for n in ends if n is not None)
        if i != j:
            links.append((i, j))
            whole = shapely.linestrings(np.concatenate([nodes[i][None], line, nodes[j][None]]))
            lines.append(shapely.get_coordinates(shapely.simplify(whole, TOUCH / 10)))  # without repeated points
    return np.array(nodes), np.array(corners), np.array(links, dtype=np.intp).reshape(-1, 2), lines


def _crossing_at(point: Array, crossings: list[shapely.Geometry]) -> int | None:
    """The intersection that a point ``(2,)`` touches; None if there is none."""
    return next((n for n, c in enumerate(crossings) if shapely.dwithin(c, shapely.Point(point), TOUCH)), None)


def _axis(corridor: shapely.Geometry, crossings: list[shapely.Geometry]) -> shapely.Geometry:
    """The centre line of a corridor, up to the centres of the intersections at its ends."""
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(corridor))[:4]
    if np.hypot(*(box[1] - box[0])) < np.hypot(*(box[2] - box[1])):
        box = np.roll(box, -1, axis=0)
    ends = [(box[0] + box[3]) / 2, (box[1] + box[2]) / 2]
    for n, end in enumerate(ends):
        at = _crossing_at(end, crossings)
        ends[n] = end if at is None else shapely.get_coordinates(shapely.centroid(crossings[at]))[0]
    return shapely.LineString(ends)


def _four_corners(polygon: shapely.Geometry) -> Array:
    """Corners ``(4, 2)`` of an intersection; of its bounding rectangle if it has more or fewer than four. [m]"""
    corners = shapely.get_coordinates(shapely.normalize(shapely.simplify(polygon, TOUCH / 2)))[:-1]
    if len(corners) != 4:
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))[:4]
    return corners if shapely.is_ccw(shapely.linearrings(corners)) else corners[::-1]


NARROWEST_AISLE = 0.6  # [m] the width of a pair of shoulders; a narrower passage is a slit between shops
SEED_SPACING = NARROWEST_AISLE / 2  # [m] so that no line crosses a wall


@dataclass(frozen=True)
class Skeleton:
    """The medial axis as a graph.

    position: ``(v, 2)`` of the vertices [m]; clearance: ``(v,)`` distance to the nearest wall [m]; edges: ``(e, 2)``
    indices of vertices.
    """

    position: Array
    clearance: Array
    edges: Index

    @property
    def degree(self) -> Index:
        """Number of edges ``(v,)`` at each vertex."""
        return np.bincount(self.edges.ravel(), minlength=len(self.position))

    def chains(self, stops: Sequence[int] = ()) -> list[Index]:
        """The vertices of each line from one stop to the next; ends, junctions and the vertices ``stops`` are stops."""
        if not len(self.edges):
            return []
        merged = shapely.line_merge(shapely.multilinestrings(self.position[self.edges]))
        vertex, degree, chains = KDTree(self.position), self.degree, list[Index]()
        for line in shapely.get_parts(merged):
            chain = np.asarray(vertex.query(shapely.get_coordinates(line))[1], dtype=np.intp)
            first = np.flatnonzero(np.isin(chain, stops))[:1]
            if degree[chain[0]] == 2 and len(first):  # a ring begins at a stop
                chain = np.append(np.roll(chain[:-1], -first[0]), chain[first])
            cuts = [0, *(np.flatnonzero(np.isin(chain[1:-1], stops)) + 1).tolist(), len(chain) - 1]
            chains += [chain[i : j + 1] for i, j in pairwise(cuts)]
        return chains

    def length(self, chain: Index) -> float:
        """Length of the line through vertices ``chain (m,)``. [m]"""
        return float(np.hypot(*np.diff(self.position[chain], axis=0).T).sum())

    def recesses(self) -> list[Index]:
        """Branches with one free end that hardly leave the circle where they begin.

        Of a star in which all branches are recesses, the two longest are not: a hall keeps a line.
        """
        degree, found, at = self.degree, list[Index](), dict[int, list[Index]]()
        for chain in self.chains():
            for end in {int(chain[0]), int(chain[-1])}:
                at.setdefault(end, []).append(chain)
            if (degree[chain[[0, -1]]] == 1).sum() == 1:
                tip, base = chain[[0, -1]] if degree[chain[0]] == 1 else chain[[-1, 0]]
                reach = self.length(chain) + self.clearance[tip] - self.clearance[base]
                # a branch leaves the circle by 3 m and by half the radius: a corner of a square hall does by 0.41
                if reach < max(3.0, self.clearance[base] / 2):
                    found.append(chain)
        recesses, kept = {id(chain) for chain in found}, set[int]()
        for star in at.values():
            if len(star) > 2 and recesses.issuperset(map(id, star)):
                kept |= {id(chain) for chain in sorted(star, key=self.length)[-2:]}
        return [chain for chain in found if id(chain) not in kept]


def skeleton(area: shapely.Geometry) -> Skeleton:
    """The medial axis of a (multi)polygon [m], without passages narrower than 0.6 m and branches that lead nowhere.

    It is taken from the Voronoi diagram of points on the border.
    """
    half = NARROWEST_AISLE / 2
    area = shapely.buffer(shapely.buffer(area, -half, quad_segs=4), half, quad_segs=4)
    seeds = shapely.get_coordinates(shapely.segmentize(shapely.get_rings(shapely.get_parts(area)), SEED_SPACING))
    seeds = seeds[np.unique(np.round(seeds, 3), axis=0, return_index=True)[1]]
    if len(seeds) < 4:
        return Skeleton(np.empty((0, 2)), np.empty(0), np.empty((0, 2), dtype=np.intp))
    middle = seeds.mean(axis=0)  # large coordinates would leave too few digits
    diagram = Voronoi(seeds - middle)
    vertices = diagram.vertices + middle
    edges = np.asarray(diagram.ridge_vertices, dtype=np.intp)
    apart = np.hypot(*(seeds[diagram.ridge_points[:, 0]] - seeds[diagram.ridge_points[:, 1]]).T)
    shapely.prepare(area)
    inside = shapely.contains_xy(area, *vertices.T)
    # An edge is nearest to its two seeds where it passes between them: seeds that are farther apart than neighbours on
    # a wall keep it clear of that wall
    inner = (edges >= 0).all(axis=1) & inside[edges].all(axis=1) & (apart > NARROWEST_AISLE - SEED_SPACING / 4)
    used, edges = np.unique(edges[inner], return_inverse=True)
    position = vertices[used]
    axis = Skeleton(position, np.asarray(KDTree(seeds).query(position)[0]), edges.reshape(-1, 2))
    while recesses := axis.recesses():
        pruned = np.concatenate([np.stack([chain[:-1], chain[1:]], axis=1) for chain in recesses])
        numbers, cut = (np.sort(each, axis=1) @ (len(position), 1) for each in (axis.edges, pruned))
        axis = replace(axis, edges=axis.edges[~np.isin(numbers, cut)])
    return axis


# Constants by which a medial axis becomes a network, chosen by hand
SHORTEST_ARM = 1.0  # [m] least length of the part of a line that determines its direction
INNER = 0.9  # share of the radius of a circle that is certainly free of walls
PARALLEL = 0.6  # |sin| of the angle up to which two links are of one corridor


def derive(area: shapely.Geometry) -> tuple[Array, Array, Index, list[Array]]:
    """Nodes ``(n, 2)``, corners ``(n, 4, 2)``, links ``(l, 2)`` and their lines from a (multi)polygon. [m]"""
    middle = skeleton(area)
    vertex, at = _hubs(middle)
    clearance, nodes = middle.clearance[vertex], middle.position[vertex]
    links, lines, widths = list[tuple[int, int]](), list[Array](), list[float]()
    for chain in middle.chains(np.flatnonzero(at >= 0).tolist()):
        i, j = (int(n) for n in at[chain[[0, -1]]])
        # a shorter loop, in clearances, around something small is not a link
        if i != j or middle.length(chain) >= 4.0 * clearance[i]:
            links.append((i, j))
            lines.append(_straightened(middle, vertex[[i, j]], chain, area))
            widths.append(float(np.median(middle.clearance[chain])))
    corners = np.full((len(nodes), 4, 2), np.nan)
    # the lines that leave each node, their directions beyond its circle, and half the width of their corridors
    leaving = [list[tuple[Array, Array, float]]() for _ in nodes]
    for link, line, width in zip(links, lines, widths, strict=True):
        for n, path in zip(link, (line, line[::-1]), strict=True):
            far = np.flatnonzero(np.hypot(*(path - path[1]).T) > SHORTEST_ARM)
            far = far[far > 1]
            ahead = path[far[0]] - path[1] if len(far) else path[-1] - path[0]
            leaving[n].append((path[1].copy(), ahead / max(float(np.hypot(*ahead)), 1e-9), width))
    for n, paths in enumerate(leaving):
        if len(paths) > 1:
            place, direction, half = (np.array(values) for values in zip(*paths, strict=True))
            normal = direction[:, ::-1] * (-1, 1)
            nodes[n] = _crossing(nodes[n], place, normal, INNER * clearance[n])
            corners[n] = _corners(nodes[n], direction, normal, half)
    for (i, j), line in zip(links, lines, strict=True):
        line[0], line[-1] = nodes[i], nodes[j]
    # farthest corner from the centre of its intersection, in clearances: a plaza has no corners
    far = np.hypot(*(corners - nodes[:, None]).T).max(axis=0) > 2.5 * clearance
    corners[far] = np.nan
    linked, renumbered = np.unique(np.array(links, dtype=np.intp), return_inverse=True)
    return nodes[linked], corners[linked], renumbered.reshape(-1, 2), lines


def _hubs(middle: Skeleton) -> tuple[Index, Index]:
    """The vertex of each node ``(n,)``, and the node of each vertex ``(v,)``, −1 if none.

    Nodes are junctions, then bends, then ends, by decreasing clearance; each absorbs the later ones within its circle.
    A ring without a bend has a node somewhere on it.
    """
    degree, bends = middle.degree, list[Index]()
    for chain in middle.chains():
        bent = _bends(middle, chain)
        bends.append(chain[:1] if degree[chain[0]] == 2 and not len(bent) else bent)
    kinds = [np.flatnonzero(degree > 2), np.concatenate([*bends, np.empty(0, np.intp)]), np.flatnonzero(degree == 1)]
    candidates = np.concatenate(kinds)
    rank = np.repeat([0, 1, 2], [len(kind) for kind in kinds])
    chosen, at = list[int](), np.full(len(middle.position), -1)
    for v in candidates[np.lexsort((-middle.clearance[candidates], rank))].tolist():
        if at[v] < 0:
            apart = np.hypot(*(middle.position[candidates] - middle.position[v]).T)
            near = apart < INNER * middle.clearance[v]
            at[candidates[near & (at[candidates] < 0)]] = at[v] = len(chosen)
            chosen.append(v)
    return np.array(chosen, dtype=np.intp), at


def _bends(middle: Skeleton, chain: Index) -> Index:
    """Vertices ``(b,)`` at which a line turns most, by more than 40°, between an arm's length before and after."""
    line, interval = middle.position[chain], 0.1  # [m] at which the direction is evaluated
    walked = length_along(line)
    arm = max(SHORTEST_ARM, 1.5 * float(np.median(middle.clearance[chain])))
    period = walked[-1] if chain[0] == chain[-1] else None
    at = np.arange(0.0, walked[-1], interval) if period else np.arange(arm, walked[-1] - arm, interval)
    if len(at) < 3:
        return np.empty(0, dtype=np.intp)
    before, here, after = (
        np.stack([np.interp(s, walked, axis, period=period) for axis in line.T], axis=1)
        for s in (at - arm, at, at + arm)
    )
    heading = [np.arctan2(*(b - a).T[::-1]) for a, b in ((before, here), (here, after))]
    turned = np.abs(wrap_angle(heading[1] - heading[0]))
    rolled = int(np.argmin(turned)) if period else 0  # cut a ring where it is straight
    sharpest = peaks(np.roll(turned, -rolled), np.radians(40), max(1, arm / interval))
    return chain[np.searchsorted(walked, at[(sharpest + rolled) % len(at)]).clip(0, len(chain) - 1)]


def _straightened(middle: Skeleton, ends: Index, chain: Index, area: shapely.Geometry) -> Array:
    """The line of a link, straight within the circles at both ends, simplified between them. [m]

    ends: ``(2,)`` vertices of its nodes; chain: ``(m,)`` vertices from one to the other.
    """
    line, half = middle.position[chain], len(chain) // 2
    outside = [np.flatnonzero(np.hypot(*(line - middle.position[v]).T) > INNER * middle.clearance[v]) for v in ends]
    first = max(int(outside[0][0]) - 1, 0) if len(outside[0]) else half
    last = min(int(outside[1][-1]) + 1, len(line) - 1) if len(outside[1]) else half
    between = line[min(first, last) : max(first, last) + 1]
    # deviation of a simplified line from the medial axis, in clearances, and at most [m]
    slack = min(0.4 * float(np.median(middle.clearance[chain])), 1.5)
    if len(between) > 2:
        simple = shapely.simplify(shapely.linestrings(between), slack)
        if not shapely.covers(area, simple):
            slack = min(slack, float(middle.clearance[chain].min()) / 2)
            simple = shapely.simplify(shapely.linestrings(between), slack)
        between = shapely.get_coordinates(simple)
    return np.concatenate([middle.position[ends[:1]], between, middle.position[ends[1:]]])


def _crossing(node: Array, place: Array, normal: Array, radius: float) -> Array:
    """Crossing ``(2,)`` [m] of the centre lines of corridors, if it is within a radius of their node; else the node.

    place, normal: ``(k, 2)`` a point of each centre line, and the unit vector across it.
    """
    square = normal.T @ normal
    if np.abs(np.linalg.det(square / len(normal))) < 0.05:  # nearly parallel
        return node
    crossing = np.linalg.solve(square, normal.T @ np.sum(normal * place, axis=1))
    return crossing if np.hypot(*(crossing - node)) < radius else node


def _corners(node: Array, direction: Array, normal: Array, half: Array) -> Array:
    """Corners ``(4, 2)`` of the two corridors that cross at a node, counter-clockwise; NaN if none cross. [m]

    direction, normal, half: of the links that leave it, unit vectors along and across ``(k, 2)`` and half their width.
    """
    across = np.abs(direction @ normal.T)
    i, j = np.unravel_index(np.argmax(across), across.shape)
    if across[i, j] < PARALLEL:
        return np.full((4, 2), np.nan)
    reach = [half[across[k] < PARALLEL].min() for k in (i, j)]
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    corners = node + np.linalg.solve(normal[[i, j]], (signs * reach).T).T
    return corners if shapely.is_ccw(shapely.linearrings(corners)) else corners[::-1]
