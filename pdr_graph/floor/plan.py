"""A floor of a building: where one can walk, and where not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor import formats
from pdr_graph.floor.areas import OUTLINE, SOLID, Area
from pdr_graph.floor.cells import Cells, without_cracks
from pdr_graph.floor.distance import DistanceField
from pdr_graph.floor.network import Network, derived_network, drawn_network
from pdr_graph.floor.regions import Regions
from pdr_graph.frames import Frame
from pdr_graph.types import Array, Mask

FAR_FROM_PLAN = 100.0  # [m] outside everything drawn, where its walls say nothing


@dataclass(frozen=True)
class FloorPlan:
    """One floor, in its own metric frame.

    label: the floor's name, "F1"; areas: the outline and everything in it; frame: its way to latitude and longitude;
    height: above whatever the plan takes for zero [m]; notes: what was left out of the file or taken for
    something, mended: what was drawn wrongly and put right, one line each.
    """

    label: str
    areas: tuple[Area, ...]
    frame: Frame
    notes: tuple[str, ...] = ()
    mended: tuple[str, ...] = ()
    height: float = 0.0

    @classmethod
    def load(cls, path: str | Path, floor: str | None = None) -> FloorPlan:
        """One floor of a plan: our GeoJSON, a Microsoft floor folder, or a file of IPIN21 polygons.

        floor: its label, of a plan with several floors; a plan with one has it whatever its label.

        Raises InputError if the file is none of these, has no such floor, or leaves nowhere to walk.
        """
        plans = cls.load_all(path)
        found = ", ".join(plan.label for plan in plans)
        if len(plans) == 1:
            return plans[0]
        if floor is None:
            raise InputError(path, "", f"{len(plans)} floors, {found[:80]}", "the label of one")
        chosen = next((plan for plan in plans if plan.label == floor), None)
        if chosen is None:
            raise InputError(path, "", f"the floors {found[:80]}", f"a floor {floor!r}")
        return chosen

    @classmethod
    def load_all(cls, path: str | Path) -> tuple[FloorPlan, ...]:
        """All floors of a plan, in one frame, lowest first. Raises InputError if one of them leaves nowhere to walk."""
        drawing = formats.read(Path(path))
        plans = tuple(
            cls(label, areas, drawing.frame, drawing.notes, drawing.mended, drawing.heights.get(label, 0.0))
            for label, areas in drawing.floors.items()
        )
        for plan in plans:
            if shapely.is_empty(plan.walkable):
                needed = "an outline or a corridor that is not all solid"
                raise InputError(path, f"floor {plan.label}" if plan.label else "", "no walkable area", needed)
        return plans

    def of_kind(self, *kinds: str) -> tuple[Area, ...]:
        """The areas of some kinds."""
        return tuple(area for area in self.areas if area.kind in kinds)

    @cached_property
    def cells(self) -> Cells:
        """Rooms, corridors and doors, and which of them one can step between."""
        return Cells.of(self.areas)

    @cached_property
    def regions(self) -> Regions:
        """The parts that doors divide."""
        return Regions.of(self.walkable, self.cells)

    @cached_property
    def walkable(self) -> shapely.Geometry:
        """Where one can stand: the cells where the plan has them, else the outline minus everything solid. [m]"""
        if len(self.cells):
            return without_cracks([cell.polygon for cell in self.cells.cells])
        solid = [a.shape for a in self.of_kind(*SOLID) if a.is_polygon]
        outline = [a.shape for a in self.of_kind(OUTLINE) if a.is_polygon]
        return shapely.difference(shapely.union_all(outline), shapely.union_all(solid))

    @property
    def walkable_area(self) -> float:
        """Area where one can walk. [m²]"""
        return float(shapely.area(self.walkable))

    @cached_property
    def distance(self) -> DistanceField:
        """Signed distance to the nearest wall."""
        only = len(self.regions) == 1 and not len(self.regions.doors)
        return self.regions.field((0,)) if only else DistanceField(self.walkable, self.cells.barriers)

    @cached_property
    def network(self) -> Network:
        """Intersections and the corridors between them, as drawn or else derived."""
        drawn = self.drawn_network
        return derived_network(self.cells, self.walkable) if drawn is None else drawn

    @cached_property
    def drawn_network(self) -> Network | None:
        """Intersections and the corridors between them, if the plan draws them."""
        return drawn_network(self.areas, self.cells, self.walkable)

    @cached_property
    def corners(self) -> Array:
        """South-west and north-east corner ``(2, 2)`` of everything drawn. [m]"""
        return shapely.total_bounds([a.shape for a in self.areas]).reshape(2, 2)

    @property
    def size(self) -> float:
        """Diagonal of everything drawn. [m]"""
        return float(np.hypot(*(self.corners[1] - self.corners[0])))

    def near(self, position: Array) -> Mask:
        """Which positions ``(n, 2)`` [m] lie on or about the plan. ``(n,)`` bool"""
        low, high = self.corners
        return np.all((position > low - FAR_FROM_PLAN) & (position < high + FAR_FROM_PLAN), axis=1)

    def within(self, low: Array, high: Array) -> FloorPlan:
        """What is drawn in or into a box from ``low (2,)`` to ``high (2,)`` [m]; there its walls are the whole's.

        A walk asks only what is within its reach, so that nothing grows with the floor. The whole, if nowhere in the
        box can be walked.
        """
        bounds = shapely.bounds([area.shape for area in self.areas])
        near = np.all((bounds[:, :2] <= high) & (bounds[:, 2:] >= low), axis=1)
        if near.all() or not near.any():
            return self
        part = replace(self, areas=tuple(area for area, here in zip(self.areas, near, strict=True) if here))
        return self if shapely.is_empty(part.walkable) else part

    def crosses_wall(self, start: Array, end: Array) -> Mask:
        """Which segments from ``start (n, 2)`` to ``end (n, 2)`` leave the walkable area or go through a wall."""
        shapely.prepare(self.walkable)
        segments = shapely.linestrings(np.stack([start, end], axis=1))
        crossed = ~np.atleast_1d(shapely.covers(self.walkable, segments))
        if not shapely.is_empty(self.cells.barriers):
            shapely.prepare(self.cells.barriers)
            crossed |= np.atleast_1d(shapely.intersects(self.cells.barriers, segments))
        return crossed
