"""The ground of a walk: on which floor each of its steps is, and the walls about each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from pdr_graph.floor.building import Building, Connection
from pdr_graph.floor.distance import DistanceField
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.floor.regions import NOWHERE, STRAY
from pdr_graph.types import Array, Index, Mask


@dataclass(frozen=True, eq=False)
class Ground:
    """Floors, and which of them each piece of a walk is on: level ``(m,)``."""

    building: Building
    level: Index

    @classmethod
    def of(cls, plan: FloorPlan | Building, labels: Sequence[str]) -> Ground:
        """Of a single floor, or of a building with the floor's label for each of the pieces.

        Raises ValueError if a building has several floors and the labels do not say which.
        """
        building = Building.around(plan)
        if len(building.floors) == 1:
            return cls(building, np.zeros(len(labels), dtype=np.intp))
        unknown = sorted(set(labels) - set(building.labels))
        if unknown:
            raise ValueError(f"floors: found {unknown[0]!r}, needed labels out of {', '.join(building.labels)}")
        return cls(building, np.array([building.index(label) for label in labels], dtype=np.intp))

    def within(self, low: Array, high: Array) -> Ground:
        """Of the floors only what is drawn in or into a box from ``low (2,)`` to ``high (2,)`` [m]."""
        return Ground(self.building.within(low, high), self.level)

    def near(self, position: Array) -> Mask:
        """Which positions ``(n, 2)`` [m] lie on or about any floor. ``(n,)``"""
        return np.any([floor.near(position) for floor in self.building.floors], axis=0)

    @property
    def size(self) -> float:
        """Diagonal of the widest floor. [m]"""
        return max(floor.size for floor in self.building.floors)

    def field(self, piece: int) -> DistanceField:
        """Distance to all walls of the floor that a piece is on."""
        return self.building.floors[self.level[piece]].distance

    @cached_property
    def changes(self) -> dict[int, tuple[Connection, ...]]:
        """The pieces that begin on another floor than the one before, and the stairs and lifts that lead there."""
        found = {}
        for piece in (np.flatnonzero(np.diff(self.level)) + 1).tolist():
            floors = {int(self.level[piece - 1]), int(self.level[piece])}
            found[piece] = tuple(c for c in self.building.connections if floors <= set(c.floors))
        return found

    def walls_along(
        self, track: Array, moved: Mask, stray: Array | float = STRAY, alike: float = 1.0
    ) -> tuple[tuple[DistanceField, ...], Index, float]:
        """The walls about a walk through ``track (m, 2)`` [m], a point for each piece; moved: which led anywhere;
        stray, alike: by how much the track errs, see ``Regions.along``.

        Returns signed distances to the walls of a region, of two and the door between them, or of stairs; which of
        them holds for each piece ``(m,)``, −1 none; and what the regions' changes cost.
        """
        number, of_piece, total = dict[DistanceField, int](), np.full(len(track), NOWHERE), 0.0
        stray = np.broadcast_to(stray, len(track))
        for floor, begin, end in self.stretches:
            fields, which, price = floor.regions.walls_along(track[begin:end], stray[begin:end], alike)
            numbers = np.array([*(number.setdefault(field, len(number)) for field in fields), NOWHERE])
            of_piece[begin:end] = numbers[which]
            total += price
        for piece, ways in self.changes.items():
            before = np.flatnonzero(moved[:piece])
            if len(before) and ways:
                nearest = min(ways, key=lambda way: way.distance(track[before[-1:]])[0])
                of_piece[before[-1]] = number.setdefault(nearest.field, len(number))
        return tuple(number), of_piece, total

    def walled_off(self, one: Array, other: Array, pieces: Index) -> bool:
        """Whether walls stand between two ways ``(n, 2)`` [m], where these pieces end: else they are one way, gone
        faster or slower.
        """
        return all(self.crossed(a, _nearest(a, b), pieces).any() for a, b in ((one, other), (other, one)))

    def crossed(self, one: Array, other: Array, pieces: Index) -> Mask:
        """Whether a wall stands between places ``(n, 2)`` [m] and others, on the floors of these pieces ``(n,)``."""
        level, found = self.level[pieces], np.zeros(len(one), dtype=bool)
        for n in np.unique(level):
            here = level == n
            found[here] = self.building.floors[n].crosses_wall(one[here], other[here])
        return found

    @property
    def stretches(self) -> list[tuple[FloorPlan, int, int]]:
        """The pieces [begin, end) that are on one floor after the other."""
        begins = [0, *self.changes]
        ends = [*begins[1:], len(self.level)]
        return [(self.building.floors[self.level[b]], b, e) for b, e in zip(begins, ends, strict=True)]


def _nearest(places: Array, way: Array) -> Array:
    """What of a way through ``way (n, 2)`` is nearest to each of some places ``(m, 2)``. [m]"""
    line = shapely.linestrings(way) if len(way) > 1 else shapely.points(way[0])
    between = shapely.shortest_line(shapely.points(places), line)
    return shapely.get_coordinates(between).reshape(-1, 2, 2)[:, 1]
