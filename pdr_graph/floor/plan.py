"""The plan of one floor: walkable area, walls, cells and network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
import shapely

from pdr_graph.errors import count
from pdr_graph.floor.cells import OUTLINE, SOLID, Area, Cells, Regions, without_cracks
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.floor.network import Network
from pdr_graph.types import Array, Mask, OneLineRepr

if TYPE_CHECKING:
    from pdr_graph.frames import Frame

FAR_FROM_PLAN = 100.0  # [m] from the plan's bounding box: a walk beyond it is not on this plan


@dataclass(frozen=True)
class FloorPlan(OneLineRepr):
    """One floor, in its own metric frame. `plan_files.FloorPlan` reads it from a file.

    label: the floor's name, "F1"; areas: the outline and everything in it; frame: relates it to latitude and longitude;
    height: above the plan's zero level [m]; notes: features of the file that were skipped or reinterpreted; repairs:
    drawing errors that were repaired; one line each.
    """

    label: str
    areas: tuple[Area, ...]
    frame: Frame
    notes: tuple[str, ...] = ()
    repairs: tuple[str, ...] = ()
    height: float = 0.0

    def _summary(self) -> list[str]:
        width, height = self.corners[1] - self.corners[0]
        return [repr(self.label), count(len(self.areas), "area"), f"{width:.0f} m by {height:.0f} m"]

    def of_kind(self, *kinds: str) -> tuple[Area, ...]:
        """All areas of the given kinds."""
        return tuple(area for area in self.areas if area.kind in kinds)

    @cached_property
    def cells(self) -> Cells:
        """Rooms, corridors and doors, and the passages between them."""
        return Cells.of(self.areas)

    @cached_property
    def regions(self) -> Regions:
        """The regions of the walkable area that doors separate."""
        return Regions.of(self.walkable, self.cells)

    @cached_property
    def walkable(self) -> shapely.Geometry:
        """Walkable area [m]: the union of the cells if the plan has any, else the outline minus everything solid."""
        if len(self.cells):
            return without_cracks([cell.polygon for cell in self.cells.cells])
        solid = [a.shape for a in self.of_kind(*SOLID) if a.is_polygon]
        outline = [a.shape for a in self.of_kind(OUTLINE) if a.is_polygon]
        return shapely.difference(shapely.union_all(outline), shapely.union_all(solid))

    @cached_property
    def _inside(self) -> shapely.Geometry:
        """The walkable area without its edge of 0.05 m, where no walker's centre can be [m]."""
        inside = shapely.buffer(self.walkable, -0.05)
        shapely.prepare(inside)
        return inside

    def nearest_walkable(self, position: Array) -> Array:
        """The position ``(2,)`` [m] in the walkable area nearest to ``position (2,)``."""
        point = shapely.Point(position)
        if shapely.is_empty(self._inside) or shapely.contains(self._inside, point):
            return position
        return shapely.get_coordinates(shapely.shortest_line(self._inside, point))[0]

    def random_places(self, count: int, random: np.random.Generator) -> Array:
        """So many positions ``(count, 2)`` [m], uniformly distributed over the walkable area."""
        inside = self.walkable if shapely.is_empty(self._inside) else self._inside
        low, high = shapely.bounds(inside).reshape(2, 2)
        places = np.empty((0, 2))
        while len(places) < count:
            drawn = random.uniform(low, high, (count, 2))
            places = np.concatenate([places, drawn[shapely.contains_xy(inside, *drawn.T)]])
        return places[:count]

    @property
    def walkable_area(self) -> float:
        """Size of the walkable area [m²]."""
        return float(shapely.area(self.walkable))

    @cached_property
    def distance(self) -> DistanceField:
        """Field of the signed distance to the nearest wall [m], positive inside."""
        is_one_region = len(self.regions) == 1 and not len(self.regions.doors)
        return self.regions.field((0,)) if is_one_region else DistanceField(self.walkable, self.cells.barriers)

    @cached_property
    def network(self) -> Network:
        """Network of intersections and the links between them, as drawn; empty if none are."""
        return Network.drawn(self.areas, self.cells, self.walkable)

    @cached_property
    def corners(self) -> Array:
        """Bounding box of the plan: south-west and north-east corner ``(2, 2)`` [m]."""
        return shapely.total_bounds([a.shape for a in self.areas]).reshape(2, 2)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box [m]."""
        return float(np.hypot(*(self.corners[1] - self.corners[0])))

    def near(self, position: Array) -> Mask:
        """``(n,)`` True for positions ``(n, 2)`` [m] within 100 m of the bounding box."""
        low, high = self.corners
        return np.all((position > low - FAR_FROM_PLAN) & (position < high + FAR_FROM_PLAN), axis=1)

    def within(self, low: Array, high: Array) -> Self:
        """Crop the plan to the areas that touch a box from ``low (2,)`` to ``high (2,)`` [m].

        Cropping to the reach of a walk makes the cost independent of the size of the floor. Returns the whole plan if
        the box has no walkable area.
        """
        bounds = shapely.bounds([area.shape for area in self.areas])
        near = np.all((bounds[:, :2] <= high) & (bounds[:, 2:] >= low), axis=1)
        if near.all() or not near.any():
            return self
        part = replace(self, areas=tuple(area for area, here in zip(self.areas, near, strict=True) if here))
        return self if shapely.is_empty(part.walkable) else part

    def crosses_wall(self, start: Array, end: Array) -> Mask:
        """``(n,)`` True for segments ``start`` to ``end (n, 2)`` [m] that leave the walkable area or cross a wall."""
        shapely.prepare(self.walkable)
        segments = shapely.linestrings(np.stack([start, end], axis=1))
        crossed = ~np.atleast_1d(shapely.covers(self.walkable, segments))
        if not shapely.is_empty(self.cells.barriers):
            shapely.prepare(self.cells.barriers)
            crossed |= np.atleast_1d(shapely.intersects(self.cells.barriers, segments))
        return crossed
