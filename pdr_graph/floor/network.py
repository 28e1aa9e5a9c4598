"""The corridor network that a plan draws: its intersections and the links between them.

[map-matching] Sec. 3.8 describes a building by the positions of its intersections, their four corners and the links
between them. Links follow the drawn lines of kind ``link``, else the axes of the corridors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely

from pdr_graph.floor.cells import CLOSED, DOOR, LINK, OPEN, Area, Cells, without_cracks
from pdr_graph.geometry import wrap_angle
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

    nodes: ``(n, 2)`` [m]; corners: ``(n, 4, 2)`` of each intersection, counter-clockwise, NaN at dead ends [m]; links:
    ``(l, 2)`` nodes; lines: the centre line of each link, ``(m, 2)`` from its first node to its second [m]; width:
    ``(l,)`` between the walls beside it [m]; area: the polygon that they lie in [m].
    """

    nodes: Array
    corners: Array
    links: Index
    lines: tuple[Array, ...]
    width: Array
    area: shapely.Geometry

    @classmethod
    def drawn(cls, areas: tuple[Area, ...], cells: Cells, walkable: shapely.Geometry) -> Network:
        """The network of a plan; empty if it draws no intersections, or links that lead through walls.

        The width of a link is that between the walls beside it: the median along its line.
        """
        nodes, corners, links, lines = _drawn_links(areas)
        area = corridor_area(cells, walkable)
        if not lines or not shapely.covers(shapely.buffer(area, TOUCH), shapely.MultiLineString(lines)):
            nodes, corners, links, lines = _drawn_links(())
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

    def direction(self, link: int, node: int) -> Array:
        """Unit vector ``(2,)`` along a link, away from one of its nodes."""
        line = self.lines[link] if self.links[link, 0] == node else self.lines[link][::-1]
        ahead = line[1] - line[0]
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


def corridor_area(cells: Cells, walkable: shapely.Geometry) -> shapely.Geometry:
    """The polygon of the corridors [m] if the plan has rooms and doors, else of the whole walkable area."""
    open_cells = {n for n, cell in enumerate(cells.cells) if cell.kind in OPEN}
    has_doors = any(cell.kind in CLOSED for cell in cells.cells) and any(cell.kind == DOOR for cell in cells.cells)
    if open_cells and has_doors:
        beside = [cells.passages[(cells.passages == n).any(axis=1)].ravel().tolist() for n in range(len(cells))]
        doors = {n for n, c in enumerate(cells.cells) if c.kind == DOOR and len(open_cells & set(beside[n])) > 1}
        parts = [cells.cells[n].polygon for n in sorted(open_cells | doors)]
        walkable = shapely.intersection(without_cracks(parts), walkable)
    return shapely.difference(walkable, shapely.buffer(cells.barriers, 0.05, cap_style="flat"))


def _drawn_links(areas: tuple[Area, ...]) -> tuple[Array, Array, Index, list[Array]]:
    """Nodes ``(n, 2)``, corners ``(n, 4, 2)``, links ``(l, 2)`` and their lines, from the drawn intersections."""
    crossings = [a.shape for a in areas if a.kind == "intersection" and a.is_polygon]
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
    numbers = np.array(links, dtype=np.intp).reshape(-1, 2)
    return np.array(nodes).reshape(-1, 2), np.array(corners).reshape(-1, 4, 2), numbers, lines


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
