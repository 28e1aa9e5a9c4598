"""The plan of one floor: walkable area, walls, cells and network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely

from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import InputError, count
from pdr_graph.floor import formats
from pdr_graph.floor.cells import OUTLINE, SOLID, WALKABLE, Area, Cells, Regions, without_cracks
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.floor.formats.units import check_size
from pdr_graph.floor.network import Network, derived_network, drawn_network
from pdr_graph.floor.plan_limits import check_floor_count, check_neighbours
from pdr_graph.frames import Frame
from pdr_graph.types import Array, Mask

EDGE = 0.05  # [m] of the walkable area along walls where `nearest_walkable` puts no one
FAR_FROM_PLAN = 100.0  # [m] from the plan's bounding box: a walk beyond it is not on this plan


@dataclass(frozen=True)
class FloorPlan(OneLineRepr):
    """One floor, in its own metric frame.

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

    @classmethod
    def load(cls, path: str | Path, floor: str | None = None, scale: float | None = None) -> FloorPlan:
        """Read one floor of a plan in any format (``docs/formats.md``).

        floor: label; required if the plan has several floors, ignored if it has one. scale: metres per unit of a
        drawing or per pixel of a picture.

        Raises InputError for another format, an unknown floor, or a floor without walkable area.
        """
        plans = cls.load_all(path, scale)
        found = ", ".join(plan.label for plan in plans)
        if len(plans) == 1:
            return plans[0]
        if floor is None:
            raise InputError(path, "", f"{len(plans)} floors, {found[:80]}", "the label of one of them")
        chosen = next((plan for plan in plans if plan.label == floor), None)
        if chosen is None:
            raise InputError(path, "", f"the floors {found[:80]}", f"a floor {floor!r}")
        return chosen

    @classmethod
    def load_all(cls, path: str | Path, scale: float | None = None) -> tuple[FloorPlan, ...]:
        """Read all floors of a plan, lowest first; scale: as for `load`.

        Raises InputError for a floor without walkable area, or whose rooms and corridors have impossible widths.
        """
        return cls.of(Path(path), formats.read(Path(path), scale))

    @classmethod
    def of(cls, path: Path, drawing: formats.Drawing) -> tuple[FloorPlan, ...]:
        """The floors of a drawing, lowest first, checked as by `load_all`; path: its file, for messages."""
        check_floor_count(path, len(drawing.floors))
        plans = tuple(
            cls(label, areas, drawing.frame, drawing.notes, drawing.repairs, drawing.heights.get(label, 0.0))
            for label, areas in drawing.floors.items()
        )
        for plan in plans:
            check_neighbours(path, plan.label, [area.shape for area in plan.of_kind(*WALKABLE) if area.is_polygon])
            if shapely.is_empty(plan.walkable):
                expected = "an outline or a corridor that is not all solid"
                raise InputError(path, f"floor {plan.label}" if plan.label else "", "no walkable area", expected)
            check_size(path, plan.walkable)
        return plans

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
        """The walkable area without its edge, where no walker's centre can be [m]."""
        inside = shapely.buffer(self.walkable, -EDGE)
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
        """Network of intersections and corridors, as drawn, else derived from the walkable area."""
        drawn = drawn_network(self.areas, self.cells, self.walkable)
        return derived_network(self.cells, self.walkable) if drawn is None else drawn

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

    def within(self, low: Array, high: Array) -> FloorPlan:
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
