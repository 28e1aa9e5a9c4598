"""A floor of a building: where one can walk, and where not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor import formats
from pdr_graph.floor.areas import OUTLINE, SOLID, WALKABLE, Area
from pdr_graph.floor.distance import DistanceField
from pdr_graph.frames import Frame
from pdr_graph.types import Array, Mask

FAR_FROM_PLAN = 100.0  # [m] outside everything drawn, where its walls say nothing


@dataclass(frozen=True)
class FloorPlan:
    """One floor, in its own metric frame.

    label: the floor's name, "F1"; areas: the outline and everything in it; frame: its way to latitude and longitude.
    """

    label: str
    areas: tuple[Area, ...]
    frame: Frame

    @classmethod
    def load(cls, path: str | Path) -> FloorPlan:
        """Read a plan: our GeoJSON, or a Microsoft floor folder (``floor_info.json`` and ``geojson_map.json``).

        Raises InputError if it is neither, or leaves nowhere to walk.
        """
        plan = cls(*formats.read(Path(path)))
        if shapely.is_empty(plan.walkable):
            raise InputError(path, "", "no walkable area", "an outline or a corridor that is not all solid")
        return plan

    def union(self, *kinds: str) -> shapely.Geometry:
        """All areas of some kinds, joined. [m]"""
        return shapely.union_all([a.polygon for a in self.areas if a.kind in kinds])

    @cached_property
    def walkable(self) -> shapely.Geometry:
        """Corridors, rooms and doors where the plan has them, else the outline; minus everything solid."""
        drawn = self.union(*WALKABLE)
        return shapely.difference(self.union(OUTLINE) if shapely.is_empty(drawn) else drawn, self.union(*SOLID))

    @property
    def walkable_area(self) -> float:
        """Area where one can walk. [m²]"""
        return float(shapely.area(self.walkable))

    @cached_property
    def distance(self) -> DistanceField:
        """Signed distance to the nearest wall."""
        return DistanceField(self.walkable)

    @cached_property
    def corners(self) -> Array:
        """South-west and north-east corner ``(2, 2)`` of everything drawn. [m]"""
        return shapely.total_bounds([a.polygon for a in self.areas]).reshape(2, 2)

    @property
    def size(self) -> float:
        """Diagonal of everything drawn. [m]"""
        return float(np.hypot(*(self.corners[1] - self.corners[0])))

    def near(self, position: Array) -> Mask:
        """Which positions ``(n, 2)`` [m] lie on or about the plan. ``(n,)`` bool"""
        low, high = self.corners
        return np.all((position > low - FAR_FROM_PLAN) & (position < high + FAR_FROM_PLAN), axis=1)

    def crosses_wall(self, start: Array, end: Array) -> Mask:
        """Which segments from ``start (n, 2)`` to ``end (n, 2)`` leave the walkable area. ``(n,)`` bool"""
        shapely.prepare(self.walkable)
        segments = shapely.linestrings(np.stack([start, end], axis=1))
        return ~np.atleast_1d(shapely.covers(self.walkable, segments))
