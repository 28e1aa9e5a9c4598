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

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import KDTree, Voronoi

from pdr_graph.errors import count
from pdr_graph.floor.cells import CLOSED, DOOR, LINK, OPEN, Area, Cells, without_cracks
from pdr_graph.geometry import length_along, wrap_angle
from pdr_graph.types import Array, Index, OneLineRepr

INTERSECTION_KIND, CORRIDOR_KIND = "intersection", "corridor"
# Tolerances of a drawing, chosen by hand
TOUCH = 0.15  # [m] between a corridor and an intersection that were meant to meet
WALL_THICKNESS = 0.05  # [m] of a wall drawn as a line
SHORTEST_LINK = 1.0  # [m] of a line beyond an intersection; a shorter one is not a link


@dataclass(frozen=True)
class Network(OneLineRepr):
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

    def __len__(self) -> int:
        return len(self.links)

    def _summary(self) -> list[str]:
        length = sum(float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in self.lines)
        return [count(len(self.nodes), "node"), count(len(self), "link"), f"{length:.0f} m"]

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

    def _summary(self) -> list[str]:
        return [count(len(self.link), "segment"), count(len(np.unique(self.link)), "link")]

    @classmethod
    def of(cls, network: Network) -> Segments:
        """Segments of all links, in order."""
        starts = [line[:-1] for line in network.lines]
        link = np.repeat(np.arange(len(network)), [len(s) for s in starts])
        empty = np.empty((0, 2))
        return cls(
            np.concatenate([*starts, empty]),
            np.concatenate([*(np.diff(li, axis=0) for li in network.lines), empty]),
            link,
        )

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
    return shapely.difference(walkable, shapely.buffer(cells.barriers, WALL_THICKNESS, cap_style="flat"))


def _drawn_links(areas: tuple[Area, ...]) -> tuple[Array, Array, Index, list[Array]] | None:
    """Nodes, corners, links and lines from the drawn intersections; None without any.

    Links follow the lines of kind ``link``, or the axes of the corridors if there are none.
    """
    crossings = [a.shape for a in areas if a.kind == INTERSECTION_KIND and a.is_polygon]
    if not crossings:
        return None
    axes = [a.shape for a in areas if a.kind == LINK]
    axes = axes or [_axis(a.shape, crossings) for a in areas if a.kind == CORRIDOR_KIND and a.is_polygon]
    nodes = [shapely.get_coordinates(shapely.centroid(c))[0] for c in crossings]
    corners = [_four_corners(c) for c in crossings]
    links, lines = list[tuple[int, int]](), list[Array]()
    between = shapely.union_all(shapely.difference(axes, shapely.union_all(crossings)))
    for piece in shapely.get_parts(shapely.line_merge(between)):
        line = shapely.get_coordinates(piece)
        ends = [_crossing_at(line[end], crossings) for end in (0, -1)]
        if ends == [None, None] or (None in ends and shapely.length(piece) < SHORTEST_LINK):
            continue
        for end, place in enumerate((line[0], line[-1])):
            if ends[end] is None:  # a dead end
                ends[end] = len(nodes)
                nodes.append(place)
                corners.append(np.full((4, 2), np.nan))
        i, j = (n for n in ends if n is not None)
        if i != j:
            links.append((i, j))
            lines.append(_without_duplicates(np.concatenate([nodes[i][None], line, nodes[j][None]])))
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


def _without_duplicates(line: Array) -> Array:
    """A line without repeated points."""
    simple = shapely.simplify(shapely.linestrings(line), TOUCH / 10)
    return shapely.get_coordinates(simple)


NARROWEST_AISLE = 0.6  # [m] the width of a pair of shoulders; a narrower passage is a slit between shops
SEED_SPACING = 0.3  # [m] half of the narrowest aisle, so that no line crosses a wall
SHORTEST_DEAD_END = 3.0  # [m] from the circle where a branch begins; a shorter branch is a recess; chosen by hand
RECESS = 0.5  # the same as a share of the circle's radius: a corner of a square hall has 0.41


@dataclass(frozen=True)
class Skeleton:
    """The medial axis as a graph.

    position: ``(v, 2)`` of the vertices [m]; clearance: ``(v,)`` distance to the nearest wall [m]; edges: ``(e, 2)``
    indices of vertices.
    """

    position: Array
    clearance: Array
    edges: Index

    def chains(self, stops: Iterable[int] = ()) -> list[Index]:
        """The vertices of each line from one stop to the next; ends, junctions and the vertices ``stops`` are stops."""
        neighbours: dict[int, list[int]] = {}
        for i, j in self.edges.tolist():
            neighbours.setdefault(i, []).append(j)
            neighbours.setdefault(j, []).append(i)
        all_stops = {v for v, near in neighbours.items() if len(near) != 2} | (set(stops) & set(neighbours))
        used: set[tuple[int, int]] = set()
        starts = ((v, w) for v in all_stops for w in neighbours[v])
        found = [_walk(neighbours, all_stops, used, v, w) for v, w in starts if (v, w) not in used]
        for v in neighbours:  # rings without a stop
            if not any((v, w) in used for w in neighbours[v]):
                found.append(_walk(neighbours, {v}, used, v, neighbours[v][0]))
        return found

    def length(self, chain: Index) -> float:
        """Length of the line through vertices ``chain (m,)``. [m]"""
        return float(np.hypot(*np.diff(self.position[chain], axis=0).T).sum())


def skeleton(area: shapely.Geometry) -> Skeleton:
    """The pruned medial axis of a (multi)polygon [m], without passages narrower than 0.6 m."""
    half = NARROWEST_AISLE / 2
    wide = shapely.buffer(shapely.buffer(area, -half, quad_segs=4), half, quad_segs=4)
    return _pruned(_medial_axis(wide))


def _medial_axis(area: shapely.Geometry) -> Skeleton:
    """The medial axis of a (multi)polygon [m], from the Voronoi diagram of points on its border."""
    rings = shapely.get_rings(shapely.get_parts(area))
    seeds = shapely.get_coordinates(shapely.segmentize(rings, SEED_SPACING))
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
    return Skeleton(position, np.asarray(KDTree(seeds).query(position)[0]), edges.reshape(-1, 2))


def _pruned(axis: Skeleton) -> Skeleton:
    """The skeleton without branches that lead nowhere, repeated until there are none."""
    while True:
        chains = axis.chains()
        degree = np.bincount(axis.edges.ravel(), minlength=len(axis.position))
        recesses = [n for n, chain in enumerate(chains) if _is_recess(axis, chain, degree)]
        recesses = _without_longest_of_stars(axis, chains, recesses)
        if not recesses:
            return axis
        pruned = np.concatenate([np.stack([chains[n][:-1], chains[n][1:]], axis=1) for n in recesses])
        size = len(axis.position)
        keep = ~np.isin(_codes(axis.edges, size), _codes(pruned, size))
        axis = replace(axis, edges=axis.edges[keep])


def _is_recess(axis: Skeleton, chain: Index, degree: Index) -> bool:
    """True for a branch with one free end that hardly leaves the circle where it begins."""
    loose = degree[chain[[0, -1]]] == 1
    if loose.sum() != 1:
        return False
    tip, base = (chain[0], chain[-1]) if loose[0] else (chain[-1], chain[0])
    reach = axis.length(chain) + axis.clearance[tip] - axis.clearance[base]
    return bool(reach < max(SHORTEST_DEAD_END, RECESS * axis.clearance[base]))


def _without_longest_of_stars(axis: Skeleton, chains: list[Index], recesses: list[int]) -> list[int]:
    """The recesses, except for the two longest of a star in which all branches are recesses: a hall keeps a line."""
    at: dict[int, list[int]] = {}
    for n, chain in enumerate(chains):
        for v in {int(chain[0]), int(chain[-1])}:
            at.setdefault(v, []).append(n)
    longest: set[int] = set()
    for star in at.values():
        if len(star) > 2 and set(star) <= set(recesses):
            longest |= set(sorted(star, key=lambda n: axis.length(chains[n]))[-2:])
    return [n for n in recesses if n not in longest]


def _walk(
    neighbours: dict[int, list[int]], all_stops: set[int], used: set[tuple[int, int]], start: int, second: int
) -> Index:
    """The vertices from a stop through ``second`` to the next stop."""
    chain = [start, second]
    used |= {(start, second), (second, start)}
    while chain[-1] not in all_stops:
        ahead = next(v for v in neighbours[chain[-1]] if v != chain[-2])
        used |= {(chain[-1], ahead), (ahead, chain[-1])}
        chain.append(ahead)
    return np.array(chain, dtype=np.intp)


def _codes(edges: Index, size: int) -> Index:
    """One number ``(e,)`` per edge, equal for both directions."""
    return edges.min(axis=1) * size + edges.max(axis=1)


@dataclass(frozen=True)
class DerivationSettings:
    """Constants by which a medial axis becomes a network, chosen by hand. Clearances are distances to the nearest wall.

    bend: turn within a corridor that makes a node [rad].
    arm, shortest_arm: length of the part of a line that determines its direction, in clearances, and at least [m].
    sampling: interval at which a line's direction is evaluated [m].
    inner: share of the radius of a circle that is certainly free of walls.
    slack, most_slack: deviation of a simplified line from the medial axis, in clearances, and at most [m].
    parallel: |sin| of the angle up to which two links are of one corridor.
    farthest_corner: distance of a corner from the centre of its intersection, in clearances; a plaza has no corners.
    island: length of a loop around something small, in clearances; a shorter loop is not a link.
    """

    bend: float = np.radians(40)
    arm: float = 1.5
    shortest_arm: float = 1.0
    sampling: float = 0.1
    inner: float = 0.9
    slack: float = 0.4
    most_slack: float = 1.5
    parallel: float = 0.6
    farthest_corner: float = 2.5
    island: float = 4.0


DERIVATION = DerivationSettings()


def derive(area: shapely.Geometry) -> tuple[Array, Array, Index, list[Array]]:
    """Nodes ``(n, 2)``, corners ``(n, 4, 2)``, links ``(l, 2)`` and their lines from a (multi)polygon. [m]"""
    middle = skeleton(area)
    vertex, at = _hubs(middle)
    clearance = middle.clearance[vertex]
    links, chains = list[tuple[int, int]](), list[Index]()
    for chain in middle.chains(np.flatnonzero(at >= 0).tolist()):
        i, j = (int(n) for n in at[chain[[0, -1]]])
        if i != j or middle.length(chain) >= DERIVATION.island * clearance[i]:
            links.append((i, j))
            chains.append(chain)
    lines = [_straightened(middle, vertex[list(ij)], chain, area) for ij, chain in zip(links, chains, strict=True)]
    nodes = _centred(middle.position[vertex], DERIVATION.inner * clearance, links, lines)
    for (i, j), line in zip(links, lines, strict=True):
        line[0], line[-1] = nodes[i], nodes[j]
    widths = [float(np.median(middle.clearance[chain])) for chain in chains]
    corners = np.array([_corners(n, nodes, links, lines, widths) for n in range(len(nodes))]).reshape(-1, 4, 2)
    far = np.hypot(*(corners - nodes[:, None]).T).max(axis=0) > DERIVATION.farthest_corner * clearance
    corners[far] = np.nan
    linked, renumbered = np.unique(np.array(links, dtype=np.intp), return_inverse=True)
    return nodes[linked], corners[linked], renumbered.reshape(-1, 2), lines


def _hubs(middle: Skeleton) -> tuple[Index, Index]:
    """The vertex of each node ``(n,)``, and the node of each vertex ``(v,)``, −1 if none.

    Nodes are junctions, then bends, then ends, by decreasing clearance; each absorbs the later ones within its circle.
    A ring without a bend has a node somewhere on it.
    """
    degree = np.bincount(middle.edges.ravel(), minlength=len(middle.position))
    chains = middle.chains()
    bends = [_bends(middle, chain) for chain in chains]
    rings = [c[:1] for c, bent in zip(chains, bends, strict=True) if degree[c[0]] == 2 and not len(bent)]
    bends = np.concatenate([*bends, *rings, np.empty(0, dtype=np.intp)])
    junctions, ends = np.flatnonzero(degree > 2), np.flatnonzero(degree == 1)
    rank = np.concatenate([np.zeros(len(junctions)), np.ones(len(bends)), np.full(len(ends), 2)])
    candidates = np.concatenate([junctions, bends, ends]).astype(np.intp)
    chosen, at = list[int](), np.full(len(middle.position), -1)
    for v in candidates[np.lexsort((-middle.clearance[candidates], rank))].tolist():
        if at[v] < 0:
            apart = np.hypot(*(middle.position[candidates] - middle.position[v]).T)
            near = apart < DERIVATION.inner * middle.clearance[v]
            absorbed = candidates[near & (at[candidates] < 0)]
            at[absorbed] = len(chosen)
            at[v] = len(chosen)
            chosen.append(v)
    return np.array(chosen, dtype=np.intp), at


def _bends(middle: Skeleton, chain: Index) -> Index:
    """Vertices ``(b,)`` at which a line turns most, by more than 40°, between an arm's length before and after."""
    from scipy.signal import find_peaks  # here: few walks need it and it takes half a second to load

    line = middle.position[chain]
    walked = length_along(line)
    arm = max(DERIVATION.shortest_arm, DERIVATION.arm * float(np.median(middle.clearance[chain])))
    period = walked[-1] if chain[0] == chain[-1] else None
    ends = (0.0, walked[-1]) if period else (arm, walked[-1] - arm)
    at = np.arange(*ends, DERIVATION.sampling)
    if len(at) < 3:
        return np.empty(0, dtype=np.intp)
    before, here, after = (_point_at(s, walked, line, period) for s in (at - arm, at, at + arm))
    heading = [np.arctan2(*(b - a).T[::-1]) for a, b in ((before, here), (here, after))]
    turned = np.abs(wrap_angle(heading[1] - heading[0]))
    rolled = int(np.argmin(turned)) if period else 0  # cut a ring where it is straight
    padded = np.pad(np.roll(turned, -rolled), 1)
    peaks, _ = find_peaks(padded, height=DERIVATION.bend, distance=max(1, arm / DERIVATION.sampling))
    found = at[(peaks - 1 + rolled) % len(at)]
    return chain[np.searchsorted(walked, found).clip(0, len(chain) - 1)]


def _point_at(s: Array, walked: Array, line: Array, period: float | None) -> Array:
    """Points ``(n, 2)`` at arc lengths ``s (n,)`` of a line; period: of a ring, None for an open line. [m]"""
    return np.stack([np.interp(s, walked, axis, period=period) for axis in line.T], axis=1)


def _straightened(middle: Skeleton, ends: Index, chain: Index, area: shapely.Geometry) -> Array:
    """The line of a link, straight within the circles at both ends, simplified between them. [m]

    ends: ``(2,)`` vertices of its nodes; chain: ``(m,)`` vertices from one to the other.
    """
    line = middle.position[chain]
    first, last = 0, len(line) - 1
    for end, v in enumerate(ends):
        centre, radius = middle.position[v], DERIVATION.inner * middle.clearance[v]
        beyond = np.flatnonzero(np.hypot(*(line - centre).T) > radius)
        if end == 0:
            first = max(int(beyond[0]) - 1, 0) if len(beyond) else len(line) // 2
        else:
            last = min(int(beyond[-1]) + 1, len(line) - 1) if len(beyond) else len(line) // 2
    between = line[min(first, last) : max(first, last) + 1]
    slack = min(DERIVATION.slack * float(np.median(middle.clearance[chain])), DERIVATION.most_slack)
    if len(between) > 2:
        simple = shapely.simplify(shapely.linestrings(between), slack)
        if not shapely.covers(area, simple):
            slack = min(slack, float(middle.clearance[chain].min()) / 2)
            simple = shapely.simplify(shapely.linestrings(between), slack)
        between = shapely.get_coordinates(simple)
    return np.concatenate([middle.position[ends[:1]], between, middle.position[ends[1:]]])


def _centred(nodes: Array, radius: Array, links: list[tuple[int, int]], lines: list[Array]) -> Array:
    """Nodes ``(n, 2)`` moved to the crossing of their corridors' centre lines, if it is within their circle. [m]"""
    moved = nodes.copy()
    for n in range(len(nodes)):
        leaving = _leaving(n, links, lines)
        if len(leaving) < 2:
            continue
        at = np.array([line[1] for line, _ in leaving])
        normal = np.array([(-u[1], u[0]) for _, u in leaving])
        if np.abs(np.linalg.det(normal.T @ normal / len(leaving))) < 0.05:  # nearly parallel
            continue
        crossing = np.linalg.solve(normal.T @ normal, normal.T @ np.sum(normal * at, axis=1))
        if np.hypot(*(crossing - nodes[n])) < radius[n]:
            moved[n] = crossing
    return moved


def _leaving(n: int, links: list[tuple[int, int]], lines: list[Array]) -> list[tuple[Array, Array]]:
    """The lines that leave a node, each with its direction ``(2,)`` beyond the node's circle."""
    leaving = []
    for link, line in zip(links, lines, strict=True):
        for end, path in zip(link, (line, line[::-1]), strict=True):
            if end == n:
                far = np.flatnonzero(np.hypot(*(path - path[1]).T) > DERIVATION.shortest_arm)
                far = far[far > 1]
                ahead = path[far[0]] - path[1] if len(far) else path[-1] - path[0]
                leaving.append((path, ahead / max(float(np.hypot(*ahead)), 1e-9)))
    return leaving


def _corners(n: int, nodes: Array, links: list[tuple[int, int]], lines: list[Array], widths: list[float]) -> Array:
    """Corners ``(4, 2)`` of the two corridors that cross at a node, counter-clockwise; NaN if none cross. [m]"""
    directions = [u for _, u in _leaving(n, links, lines)]
    half = [w for link, w in zip(links, widths, strict=True) for end in link if end == n]
    if len(directions) < 2:
        return np.full((4, 2), np.nan)
    across = np.abs([[u[0] * v[1] - u[1] * v[0] for v in directions] for u in directions])
    i, j = np.unravel_index(np.argmax(across), across.shape)
    if across[i, j] < DERIVATION.parallel:
        return np.full((4, 2), np.nan)
    normal = np.array([(-directions[k][1], directions[k][0]) for k in (i, j)])
    reach = [min(h for h, s in zip(half, across[k], strict=True) if s < DERIVATION.parallel) for k in (i, j)]
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    corners = nodes[n] + np.linalg.solve(normal, (signs * reach).T).T
    return corners if shapely.is_ccw(shapely.linearrings(corners)) else corners[::-1]
