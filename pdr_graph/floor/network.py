"""The walkable network of a floor: intersections and the corridors between them.

[map-matching] Sec. 3.8 describes a building by the positions of its intersections, their four corners and the links
between them. They are taken from the plan if it draws intersections, and derived from its polygons otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import count
from pdr_graph.floor import network_derivation
from pdr_graph.floor.cells import CLOSED, DOOR, LINK, OPEN, Area, Cells, without_cracks
from pdr_graph.types import Array, Index

INTERSECTION, CORRIDOR = "intersection", "corridor"
# Tolerances of a drawing, chosen by hand
TOUCH = 0.15  # [m] between a corridor and an intersection that were meant to meet
WALL_THICKNESS = 0.05  # [m] of a wall drawn as a line
SHORTEST_LINK = 1.0  # [m] of a line beyond an intersection; a shorter one is not a link


@dataclass(frozen=True)
class Network(OneLineRepr):
    """Nodes and links of a floor.

    nodes: ``(n, 2)`` [m]; corners: ``(n, 4, 2)`` of each intersection, counter-clockwise, NaN at dead ends and where no
    corridors cross [m]; links: ``(l, 2)`` nodes; lines: the centre line of each link, ``(m, 2)`` from its first node to
    its second [m]; area: the polygon that they lie in [m].
    """

    nodes: Array
    corners: Array
    links: Index
    lines: tuple[Array, ...]
    area: shapely.Geometry

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

    def links_at(self, node: int) -> Index:
        """Numbers ``(m,)`` of the links that begin or end at a node."""
        return np.flatnonzero((self.links == node).any(axis=1))

    def leaving(self, link: int, node: int) -> Array:
        """The centre line ``(m, 2)`` of a link, from one of its nodes to the other. [m]"""
        line = self.lines[link]
        return line if self.links[link, 0] == node else line[::-1]


def drawn_network(areas: tuple[Area, ...], cells: Cells, walkable: shapely.Geometry) -> Network | None:
    """The network that a plan draws; None if it draws no intersections, or links that lead through walls."""
    drawn = _drawn_links(areas)
    if drawn is None:
        return None
    (nodes, corners, links, lines), area = drawn, _network_area(cells, walkable)
    within = shapely.covers(shapely.buffer(area, TOUCH), shapely.MultiLineString(lines))
    return Network(nodes, corners, links, tuple(lines), area) if within else None


def derived_network(cells: Cells, walkable: shapely.Geometry) -> Network:
    """The network derived from the walkable area; this takes seconds on a large floor."""
    area = _network_area(cells, walkable)
    nodes, corners, links, lines = network_derivation.derive(area)
    return Network(nodes, corners, links, tuple(lines), area)


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
    crossings = [a.shape for a in areas if a.kind == INTERSECTION and a.is_polygon]
    if not crossings:
        return None
    axes = [a.shape for a in areas if a.kind == LINK]
    axes = axes or [_axis(a.shape, crossings) for a in areas if a.kind == CORRIDOR and a.is_polygon]
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
