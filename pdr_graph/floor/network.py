"""The walkable network of a floor: intersections, and the corridors that lead from one to the next.

[map-matching] Sec. 3.8 asks of a building the positions of its intersections, the four corners of each, and which are
linked. A plan that draws intersections and corridors says so itself; of any other the network is derived.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from pdr_graph.floor import network_derivation
from pdr_graph.floor.cells import CLOSED, DOOR, LINK, OPEN, Area, Cells, without_cracks
from pdr_graph.types import Array, Index

INTERSECTION, CORRIDOR = "intersection", "corridor"
TOUCH = 0.15  # [m] between a corridor and an intersection that were meant to meet
THIN = 0.05  # [m] given to a wall without thickness
STUB = 1.0  # [m] of a line beyond an intersection that is no way of its own


@dataclass(frozen=True)
class Network:
    """Nodes and links.

    nodes: ``(n, 2)`` [m]; corners: ``(n, 4, 2)`` of each intersection's area, counter-clockwise, NaN where a way ends
    or no corridors meet [m]; links: ``(l, 2)`` nodes; lines: the middle of each link, ``(m, 2)`` from its first node to
    its second [m]; ways: the polygon that they lie in [m].
    """

    nodes: Array
    corners: Array
    links: Index
    lines: tuple[Array, ...]
    ways: shapely.Geometry

    def __len__(self) -> int:
        return len(self.links)

    def walls(self, slack: float = 0.0) -> Array:
        """All segments ``(w, 2, 2)`` that bound the ways, moved outwards by ``slack``. [m]

        [map-matching] joins the corners of neighbouring intersections, which is the same where corridors are straight.
        """
        ways = shapely.buffer(self.ways, slack, join_style="mitre") if slack else self.ways
        rings = [shapely.get_coordinates(r) for r in shapely.get_rings(shapely.get_parts(ways))]
        return np.concatenate([np.stack([r[:-1], r[1:]], axis=1) for r in rings] or [np.empty((0, 2, 2))])

    def links_at(self, node: int) -> Index:
        """The links that begin or end at a node."""
        return np.flatnonzero((self.links == node).any(axis=1))

    def leaving(self, link: int, node: int) -> Array:
        """The line of a link ``(m, 2)`` as it leaves one of its nodes. [m]"""
        line = self.lines[link]
        return line if self.links[link, 0] == node else line[::-1]


def drawn_network(areas: tuple[Area, ...], cells: Cells, walkable: shapely.Geometry) -> Network | None:
    """The network that a plan draws; None if it draws none, or one that leads through walls."""
    drawn = _drawn(areas)
    if drawn is None:
        return None
    (nodes, corners, links, lines), ways = drawn, _ways(cells, walkable)
    within = shapely.covers(shapely.buffer(ways, TOUCH), shapely.MultiLineString(lines))
    return Network(nodes, corners, links, tuple(lines), ways) if within else None


def derived_network(cells: Cells, walkable: shapely.Geometry) -> Network:
    """The network derived from where one can walk: seconds on a large floor."""
    ways = _ways(cells, walkable)
    nodes, corners, links, lines = network_derivation.derive(ways)
    return Network(nodes, corners, links, tuple(lines), ways)


def _ways(cells: Cells, walkable: shapely.Geometry) -> shapely.Geometry:
    """Where the network lies: the corridors of a plan that has rooms and doors, else all that is walkable."""
    open_cells = {n for n, cell in enumerate(cells.cells) if cell.kind in OPEN}
    shut = any(cell.kind in CLOSED for cell in cells.cells) and any(cell.kind == DOOR for cell in cells.cells)
    if open_cells and shut:
        beside = [cells.passages[(cells.passages == n).any(axis=1)].ravel().tolist() for n in range(len(cells))]
        doors = {n for n, c in enumerate(cells.cells) if c.kind == DOOR and len(open_cells & set(beside[n])) > 1}
        parts = [cells.cells[n].polygon for n in sorted(open_cells | doors)]
        walkable = shapely.intersection(without_cracks(parts), walkable)
    return shapely.difference(walkable, shapely.buffer(cells.barriers, THIN, cap_style="flat"))


def _drawn(areas: tuple[Area, ...]) -> tuple[Array, Array, Index, list[Array]] | None:
    """Intersections as drawn; links along lines of kind ``link``, else along the corridors' axes."""
    crossings = [a.shape for a in areas if a.kind == INTERSECTION and a.is_polygon]
    if not crossings:
        return None
    ways = [a.shape for a in areas if a.kind == LINK]
    ways = ways or [_axis(a.shape, crossings) for a in areas if a.kind == CORRIDOR and a.is_polygon]
    nodes = [shapely.get_coordinates(shapely.centroid(c))[0] for c in crossings]
    corners = [_four_corners(c) for c in crossings]
    links, lines = list[tuple[int, int]](), list[Array]()
    between = shapely.union_all(shapely.difference(ways, shapely.union_all(crossings)))
    for piece in shapely.get_parts(shapely.line_merge(between)):
        line = shapely.get_coordinates(piece)
        ends = [_crossing_at(line[end], crossings) for end in (0, -1)]
        if ends == [None, None] or (None in ends and shapely.length(piece) < STUB):
            continue
        for end, place in enumerate((line[0], line[-1])):
            if ends[end] is None:  # a dead end
                ends[end] = len(nodes)
                nodes.append(place)
                corners.append(np.full((4, 2), np.nan))
        i, j = (n for n in ends if n is not None)
        if i != j:
            links.append((i, j))
            lines.append(_without_doubles(np.concatenate([nodes[i][None], line, nodes[j][None]])))
    return np.array(nodes), np.array(corners), np.array(links, dtype=np.intp).reshape(-1, 2), lines


def _crossing_at(point: Array, crossings: list[shapely.Geometry]) -> int | None:
    """The intersection that a point ``(2,)`` lies at, None at none."""
    return next((n for n, c in enumerate(crossings) if shapely.dwithin(c, shapely.Point(point), TOUCH)), None)


def _axis(corridor: shapely.Geometry, crossings: list[shapely.Geometry]) -> shapely.Geometry:
    """The middle line of a corridor, through the intersections at its ends."""
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(corridor))[:4]
    if np.hypot(*(box[1] - box[0])) < np.hypot(*(box[2] - box[1])):
        box = np.roll(box, -1, axis=0)
    ends = [(box[0] + box[3]) / 2, (box[1] + box[2]) / 2]
    for n, end in enumerate(ends):
        at = _crossing_at(end, crossings)
        ends[n] = end if at is None else shapely.get_coordinates(shapely.centroid(crossings[at]))[0]
    return shapely.LineString(ends)


def _four_corners(polygon: shapely.Geometry) -> Array:
    """Corners ``(4, 2)`` of an intersection, of its narrowest rectangle if it has another number. [m]"""
    corners = shapely.get_coordinates(shapely.normalize(shapely.simplify(polygon, TOUCH / 2)))[:-1]
    if len(corners) != 4:
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))[:4]
    return corners if shapely.is_ccw(shapely.linearrings(corners)) else corners[::-1]


def _without_doubles(line: Array) -> Array:
    simple = shapely.simplify(shapely.linestrings(line), TOUCH / 10)
    return shapely.get_coordinates(simple)
