"""Cells: the rooms, corridors and doors of a floor, and which of them one can step between.

A wall need not be drawn to be one. A room is closed all round but for its doors; corridors, intersections and stairs
are open to each other; a line of kind ``wall`` is a wall without thickness. So a thin wall cannot be walked through,
whatever the grid of the distance field. A plan that draws rooms and no doors does not say how its rooms are entered:
they are open to what they touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.floor.areas import CLOSED, CONNECTING, DOOR, OUTLINE, SOLID, WALKABLE, WALL, Area
from pdr_graph.types import Array, Index

CRACK = 0.1  # [m] between neighbours that were meant to touch
DOOR_REACH = 0.15  # [m] by which a door drawn as a line opens the walls on either side
DOOR_WIDTH = 0.9  # [m] of a door drawn as a point
NARROWEST_WAY = 0.3  # [m] of open border that one can step through


@dataclass(frozen=True)
class Cell:
    """One room, corridor, intersection, stairs, lift or door, or an outline. polygon: what of it is not solid [m]."""

    kind: str
    name: str
    polygon: shapely.Geometry

    @property
    def is_closed(self) -> bool:
        """True if its border is a wall."""
        return self.kind in CLOSED


@dataclass(frozen=True)
class Cells:
    """All cells of a floor.

    cells: in the order of the plan; barriers: walls without thickness, lines [m].
    """

    cells: tuple[Cell, ...]
    barriers: shapely.Geometry

    @classmethod
    def of(cls, areas: tuple[Area, ...]) -> Cells:
        """The cells of a floor's areas."""
        drawn = _drawn(areas)
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
        return cls(tuple(cells), shapely.difference(shapely.union_all(lines), shapely.buffer(opened, CRACK / 2)))

    def __len__(self) -> int:
        return len(self.cells)

    @cached_property
    def _tree(self) -> shapely.STRtree:
        return shapely.STRtree([c.polygon for c in self.cells])

    def at(self, points: Array) -> Index:
        """The cell that each point ``(n, 2)`` [m] is in ``(n,)``, −1 in none; a door before the room it opens."""
        if not self.cells:
            return np.full(len(points), -1)
        point, cell = self._tree.query(shapely.points(points), predicate="intersects")
        found = np.full(len(points), -1)
        order = np.argsort([self.cells[c].kind == DOOR for c in cell], kind="stable")
        found[point[order]] = cell[order]
        return found

    @cached_property
    def passages(self) -> Index:
        """Pairs of cells ``(p, 2)`` that one can step between."""
        if not self.cells:
            return np.empty((0, 2), dtype=np.intp)
        polygons = [c.polygon for c in self.cells]
        one, other = self._tree.query(polygons, predicate="dwithin", distance=CRACK)
        pairs = [(i, j) for i, j in zip(one.tolist(), other.tolist(), strict=True) if i < j and self._joined(i, j)]
        return np.array(pairs, dtype=np.intp).reshape(-1, 2)

    def _joined(self, i: int, j: int) -> bool:
        one, other = self.cells[i], self.cells[j]
        if DOOR in (one.kind, other.kind):
            return True
        if self._has_doors and (one.is_closed or other.is_closed):
            return False
        reach = shapely.buffer(one.polygon, CRACK, cap_style="flat", join_style="mitre")
        border = shapely.intersection(reach, shapely.boundary(other.polygon))
        return float(shapely.length(shapely.difference(border, self._wide_barriers))) > NARROWEST_WAY

    @cached_property
    def _has_doors(self) -> bool:
        return any(cell.kind == DOOR for cell in self.cells)

    @cached_property
    def _wide_barriers(self) -> shapely.Geometry:
        return shapely.buffer(self.barriers, CRACK, cap_style="flat")

    @cached_property
    def parts(self) -> Index:
        """Which connected part of the floor each cell ``(n,)`` belongs to."""
        n = len(self.cells)
        i, j = self.passages.T
        return connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)[1].astype(
            np.intp
        )


def _drawn(areas: tuple[Area, ...]) -> list[Area]:
    """The areas that are cells. Where only stairs, lifts and doors are, the outline about them is one, too."""
    drawn = [a for a in areas if a.kind in WALKABLE]
    within = [a.shape for a in drawn if a.kind in CONNECTING]
    if not within or any(a.kind not in (*CONNECTING, DOOR) for a in drawn):
        return drawn
    outlines = [a for a in areas if a.kind == OUTLINE and a.is_polygon]
    return [replace(a, shape=shapely.difference(a.shape, shapely.union_all(within))) for a in outlines] + drawn


def without_cracks(polygons: Sequence[shapely.Geometry] | NDArray[np.object_]) -> shapely.Geometry:
    """Their union, with the hairlines between neighbours closed."""
    wider = shapely.buffer(shapely.union_all(polygons), CRACK / 2, join_style="mitre")
    return shapely.buffer(wider, -CRACK / 2, join_style="mitre")


def _opening(door: Area) -> shapely.Geometry:
    """The polygon in which a door opens walls."""
    dimensions = shapely.get_dimensions(door.shape)
    if dimensions == 2:
        return door.shape
    if dimensions == 1:
        return shapely.buffer(door.shape, DOOR_REACH, cap_style="flat")
    return shapely.buffer(door.shape, DOOR_WIDTH / 2)
