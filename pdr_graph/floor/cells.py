"""Areas of a plan, cells of a floor (rooms, corridors, doors), the regions that doors separate, and a walk's regions.

Walls are implied by cells. A room is enclosed except at its doors; corridors, intersections and stairs are open to each
other; a line of kind ``wall`` is a wall without thickness. Thin walls therefore block a walk whatever the grid of the
distance field. A plan with rooms but no doors does not show how rooms are entered: they are open to all neighbours.

All connected corridors form one region, every room is one. A wall of 12 cm does not make a distance field on a grid of
25 cm negative. The field of a single region does: a track that strays through its wall is outside the region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.geometry import viterbi
from pdr_graph.priors import PLANS, REGIONS
from pdr_graph.types import Array, Index, OneLineRepr

OUTLINE = "floor"
OPEN = ("corridor", "intersection", "stairs")  # open to each other
CLOSED = ("room", "lift")  # enclosed by walls, except at doors
CONNECTING = ("stairs", "lift")  # join floors
DOOR = "door"
ENTRANCE = "entrance"  # property of a door that leads outside
WALKABLE = (*OPEN, *CLOSED, DOOR)
WALL = "wall"
SOLID = (WALL, "shop", "place")
LINK, BEACON = "link", "beacon"
CELL_KINDS = (OUTLINE, *WALKABLE, *SOLID, LINK, BEACON)


@dataclass(frozen=True)
class Area(OneLineRepr):
    """One feature of a plan.

    kind: one of CELL_KINDS; shape: a polygon; a wall or door may be a line; a door, place or beacon may be a point; a
    link is a line that people walk along [m]; properties: all other properties in the file; floors: labels of its
    floors, empty if it is on all.
    """

    kind: str
    name: str
    shape: shapely.Geometry
    properties: dict[str, Any] = field(default_factory=dict)
    floors: tuple[str, ...] = ()

    @property
    def is_polygon(self) -> bool:
        """True if the shape is two-dimensional."""
        return shapely.get_dimensions(self.shape) == 2


@dataclass(frozen=True)
class Cell(OneLineRepr):
    """One room, corridor, intersection, stairs, lift or door, or an outline. polygon: its free area [m]."""

    kind: str
    name: str
    polygon: shapely.Geometry

    @property
    def is_closed(self) -> bool:
        """True if its border is a wall."""
        return self.kind in CLOSED


@dataclass(frozen=True)
class Cells(OneLineRepr):
    """All cells of a floor, in the order of the plan; barriers: walls without thickness, lines [m]."""

    cells: tuple[Cell, ...]
    barriers: shapely.Geometry

    @classmethod
    def of(cls, areas: tuple[Area, ...]) -> Cells:
        """Construct the cells of a floor from its areas."""
        drawn = [a for a in areas if a.kind in WALKABLE]
        within = [a.shape for a in drawn if a.kind in CONNECTING]
        if within and all(a.kind in (*CONNECTING, DOOR) for a in drawn):  # the outline around stairs and lifts
            outlines = [a for a in areas if a.kind == OUTLINE and a.is_polygon]
            connecting = shapely.union_all(within)
            drawn = [*(replace(a, shape=shapely.difference(a.shape, connecting)) for a in outlines), *drawn]
        doors = [_opening(a) for a in drawn if a.kind == DOOR]
        opened = shapely.union_all(doors)
        solid = shapely.difference(
            shapely.union_all([a.shape for a in areas if a.kind in SOLID and a.is_polygon]), opened
        )
        shapely.prepare(solid)
        cells = []
        for area in drawn:
            shape = _opening(area) if area.kind == DOOR else area.shape
            if shapely.get_dimensions(shape) == 2:
                free = shapely.difference(shape, solid) if shapely.intersects(solid, shape) else shape
                cells.append(Cell(area.kind, area.name, free))
        lines = [a.shape for a in areas if a.kind == WALL and not a.is_polygon]
        if doors:
            lines += [shapely.boundary(c.polygon) for c in cells if c.is_closed]
        return cls(tuple(cells), shapely.difference(shapely.union_all(lines), shapely.buffer(opened, PLANS.crack / 2)))

    def __len__(self) -> int:
        return len(self.cells)

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree([c.polygon for c in self.cells])

    def at(self, points: Array) -> Index:
        """Index of the cell of each point ``(n, 2)`` [m], −1 for none; doors take precedence over rooms. ``(n,)``"""
        if not self.cells:
            return np.full(len(points), -1)
        point, cell = self._tree.query(shapely.points(points), predicate="intersects")
        found = np.full(len(points), -1)
        order = np.argsort([self.cells[c].kind == DOOR for c in cell], kind="stable")
        found[point[order]] = cell[order]
        return found

    @cached_property
    def passages(self) -> Index:
        """Pairs of cells ``(p, 2)`` with a passage between them."""
        if not self.cells:
            return np.empty((0, 2), dtype=np.intp)
        polygons = [c.polygon for c in self.cells]
        one, other = self._tree.query(polygons, predicate="dwithin", distance=PLANS.crack)
        pairs = [(i, j) for i, j in zip(one.tolist(), other.tolist(), strict=True) if i < j and self._has_passage(i, j)]
        return np.array(pairs, dtype=np.intp).reshape(-1, 2)

    def _has_passage(self, i: int, j: int) -> bool:
        """True if a door or a sufficiently wide open border joins two touching cells."""
        one, other = self.cells[i], self.cells[j]
        if DOOR in (one.kind, other.kind):
            return True
        if self._has_doors and (one.is_closed or other.is_closed):
            return False
        reach = shapely.buffer(one.polygon, PLANS.crack, cap_style="flat", join_style="mitre")
        border = shapely.intersection(reach, shapely.boundary(other.polygon))
        return float(shapely.length(shapely.difference(border, self._wide_barriers))) > PLANS.narrowest

    @cached_property
    def _has_doors(self) -> bool:
        return any(cell.kind == DOOR for cell in self.cells)

    @cached_property
    def _wide_barriers(self) -> shapely.Geometry:
        return shapely.buffer(self.barriers, PLANS.crack, cap_style="flat")


def without_cracks(polygons: Sequence[shapely.Geometry] | NDArray[np.object_]) -> shapely.Geometry:
    """Union of polygons, with gaps of up to 0.1 m between neighbours closed."""
    wider = shapely.buffer(shapely.union_all(polygons), PLANS.crack / 2, join_style="mitre")
    return shapely.buffer(wider, -PLANS.crack / 2, join_style="mitre")


def overlap(one: shapely.Geometry, other: shapely.Geometry) -> bool:
    """True if two polygons share more than half of the smaller."""
    shared = shapely.area(shapely.intersection(one, other))
    return bool(shared > min(shapely.area(one), shapely.area(other)) / 2)


def _opening(door: Area) -> shapely.Geometry:
    """The polygon in which a door opens the walls."""
    dimensions = shapely.get_dimensions(door.shape)
    if dimensions == 2:
        return door.shape
    if dimensions == 1:
        return shapely.buffer(door.shape, PLANS.door_reach, cap_style="flat")
    return shapely.buffer(door.shape, PLANS.door_width / 2)


NOWHERE = -1  # index of no region


def stray_of(stray: Array | float | None) -> Array | float:
    """Sigma of a track [m]: as stated, else the usual one."""
    return REGIONS.stray if stray is None else stray


@dataclass(frozen=True)
class Regions(OneLineRepr):
    """The regions of a floor.

    polygons: ``(r,)`` [m]; doors: ``(d,)`` [m]; joins: ``(d, r)`` which regions a door opens; barriers: lines [m].
    """

    polygons: NDArray[np.object_]
    doors: NDArray[np.object_]
    joins: NDArray[np.bool_]
    barriers: shapely.Geometry

    @classmethod
    def of(cls, walkable: shapely.Geometry, cells: Cells) -> Regions:
        """Construct the regions of a floor; without cells all walkable area is one region."""
        is_door = np.array([cell.kind == DOOR for cell in cells.cells], dtype=bool)
        shapes = np.array([cell.polygon for cell in cells.cells], dtype=object)
        if not len(shapes):
            nothing = np.empty(0, dtype=object)
            return cls(np.array([walkable], dtype=object), nothing, np.empty((0, 1), dtype=bool), cells.barriers)
        one, other = cells.passages.T
        between = is_door[one] | is_door[other]
        n, open_pairs = len(shapes), (one[~between], other[~between])
        links = coo_array((np.ones(np.count_nonzero(~between)), open_pairs), shape=(n, n))
        part = connected_components(links, directed=False)[1]
        region = np.full(n, NOWHERE)
        region[~is_door] = np.unique(part[~is_door], return_inverse=True)[1]
        regions = int(region.max(initial=NOWHERE)) + 1
        polygons = np.empty(regions, dtype=object)
        for r in range(regions):
            polygons[r] = _joined(shapes[region == r])
        joins = np.zeros((n, regions), dtype=bool)
        for a, b in ((one, other), (other, one)):
            leads = is_door[a] & ~is_door[b]
            joins[a[leads], region[b[leads]]] = True
        return cls(polygons, shapes[is_door], joins[is_door], cells.barriers)

    def __len__(self) -> int:
        return len(self.polygons)

    def along(self, track: Array, stray: Array | float | None = None, alike: float = 1.0) -> tuple[Index, float]:
        """Most probable sequence of regions (Viterbi) along points ``(n, 2)`` [m], and its cost.

        Returns the region of each point ``(n,)``, NOWHERE far from all, and the cost of changes of region and of points
        in none. stray: standard deviation of the track, scalar or ``(n,)`` [m]; alike: number of consecutive points
        with the same error.
        """
        points, stray = np.asarray(shapely.points(track), dtype=object), np.broadcast_to(stray_of(stray), len(track))
        near = np.unique(self._tree.query(points, predicate="dwithin", distance=2 * stray)[1])
        if not len(near):
            return np.full(len(track), NOWHERE), REGIONS.outside_price * len(track)
        cost = np.full((len(track), len(near) + 1), REGIONS.outside_cost)
        for column, r in enumerate(near):
            cost[:, column] = 0.5 * (shapely.distance(self.polygons[r], points) / stray) ** 2 / alike
        states = np.append(near, NOWHERE)
        if len(near) == 1 and cost[:, 0].max() < REGIONS.outside_cost:
            return np.full(len(track), near[0]), 0.0
        changes = self._changes(near, points)
        likeliest, _ = viterbi(cost, changes[1:])
        price = changes[np.arange(1, len(track)), likeliest[:-1], likeliest[1:]].sum()
        return states[likeliest], float(price + REGIONS.outside_price * np.sum(likeliest == len(near)))

    def walls_along(
        self, track: Array, stray: Array | float | None = None, alike: float = 1.0
    ) -> tuple[list[DistanceField], Index, float]:
        """Associate each point ``(n, 2)`` [m] of a track with the walls of its region.

        Returns distance fields, the index of the field of each point ``(n,)``, −1 for none, and the cost of changes of
        region. At a change, the field is of both regions and the door between them. stray, alike: as for `along`.
        """
        region, price = self.along(track, stray, alike)
        before, after = np.append(region[:1], region[:-1]), np.append(region[1:], region[-1:])
        sets, which = np.unique(np.sort([before, region, after], axis=0), axis=1, return_inverse=True)
        inside = [NOWHERE not in s for s in sets.T]
        fields = [self.field(tuple(np.unique(s).tolist())) for s in sets.T[inside]]
        return fields, np.where(inside, np.cumsum(inside) - 1, NOWHERE)[which.ravel()], price

    def field(self, regions: tuple[int, ...]) -> DistanceField:
        """Field of the signed distance to the walls of the union of regions and the doors between them."""
        if regions not in self._fields:
            between = self.joins[:, list(regions)].sum(axis=1) > 1
            shape = _joined(np.append(self.polygons[list(regions)], self.doors[between]))
            self._fields[regions] = DistanceField(shape, self.barriers)
        return self._fields[regions]

    @cached_property
    def _fields(self) -> dict[tuple[int, ...], DistanceField]:
        return {}

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree(self.polygons)

    def _changes(self, near: Index, points: NDArray[np.object_]) -> Array:
        """Cost ``(n, s, s)`` of changing from one of the regions ``near``, or none, to another at each point."""
        s = len(near) + 1
        usual = np.full((s, s), REGIONS.wall_cost)
        usual[:, -1] = usual[-1] = REGIONS.leave_cost
        np.fill_diagonal(usual, 0.0)
        changes = np.tile(usual, (len(points), 1, 1))
        for door, joined in zip(self.doors, self.joins[:, near], strict=True):
            which = np.flatnonzero(joined)
            if len(which) > 1:
                at = np.flatnonzero(shapely.dwithin(door, points, REGIONS.at_door))
                pairs = [(i, j) for i in which for j in which if i != j]
                for i, j in pairs if len(at) else []:
                    changes[at, i, j] = REGIONS.door_cost
        return changes


def _joined(polygons: NDArray[np.object_]) -> shapely.Geometry:
    """The union of at least one polygon."""
    return polygons[0] if len(polygons) == 1 else without_cracks(polygons)
