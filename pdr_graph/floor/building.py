"""A building: floors, stairs and lifts, and the floor and walls of each piece of a walk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.errors import count, expect
from pdr_graph.floor.cells import CONNECTING, NOWHERE, overlap, stray_of
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.priors import REGIONS
from pdr_graph.types import Array, Index, Mask, OneLineRepr


@dataclass(frozen=True, eq=False)
class Connection(OneLineRepr):
    """Stairs or a lift.

    kind: one of CONNECTING; polygon: the union of its shapes on the floors that it joins [m]; floors: indices of these
    floors in the building, lowest first.
    """

    kind: str
    name: str
    polygon: shapely.Geometry
    floors: tuple[int, ...]

    def distance(self, position: Array) -> Array:
        """Distance ``(n,)`` [m] of positions ``(n, 2)`` [m] to the polygon, 0 inside."""
        return np.asarray(shapely.distance(self.polygon, shapely.points(position)))

    @cached_property
    def field(self) -> DistanceField:
        """Field of the signed distance to the border of the polygon [m], positive inside."""
        return DistanceField(self.polygon)


@dataclass(frozen=True)
class Building(OneLineRepr):
    """All floors of a plan in one frame, lowest first. A plan of one floor is a building with one floor.

    `plan_files.Building` reads it from a file.
    """

    floors: tuple[FloorPlan, ...]

    def __post_init__(self) -> None:
        """Raise TypeError unless floors are floors."""
        expect("Building, floors", self.floors, tuple, instead="Building.load(path)")

    def _summary(self) -> list[str]:
        return [count(len(self.floors), "floor"), ", ".join(repr(label) for label in self.labels)]

    @classmethod
    def of(cls, *floors: FloorPlan) -> Self:
        """A building with these floors, which are in one frame."""
        return cls(tuple(sorted(floors, key=lambda floor: floor.height)))

    @classmethod
    def around(cls, plan: FloorPlan | Building) -> Building:
        """Convert a single floor to a building; a building is returned unchanged."""
        return cls.of(plan) if isinstance(plan, FloorPlan) else plan

    def __getitem__(self, label: str) -> FloorPlan:
        """The floor with that label. Raises KeyError if there is none."""
        return self.floors[self.index(label)]

    def index(self, label: str) -> int:
        """Index of the floor with that label. Raises KeyError if there is none."""
        if label not in self.labels:
            raise KeyError(f"floor {label!r}: found only {', '.join(self.labels)}")
        return self.labels.index(label)

    def within(self, low: Array, high: Array) -> Self:
        """Crop each floor to a box from ``low (2,)`` to ``high (2,)`` [m]."""
        return replace(self, floors=tuple(floor.within(low, high) for floor in self.floors))

    def near(self, position: Array) -> Mask:
        """``(n,)`` True for positions ``(n, 2)`` [m] on or near any floor plan."""
        return np.any([floor.near(position) for floor in self.floors], axis=0)

    @property
    def corners(self) -> Array:
        """Box around all floors: south-west and north-east corner ``(2, 2)`` [m]."""
        corners = np.array([floor.corners for floor in self.floors])
        return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the floors, lowest first."""
        return tuple(floor.label for floor in self.floors)

    @property
    def heights(self) -> Array:
        """Heights of the floors ``(f,)`` above the plan's zero level [m]."""
        return np.array([floor.height for floor in self.floors])

    @cached_property
    def connections(self) -> tuple[Connection, ...]:
        """Stairs and lifts that join several floors: drawn once for all, or once per floor where these overlap."""
        drawn = [
            (n, area) for n, floor in enumerate(self.floors) for area in floor.of_kind(*CONNECTING) if area.is_polygon
        ]
        tree, pairs = shapely.STRtree([area.shape for _, area in drawn]), list[tuple[int, int]]()
        for i, (low, area) in enumerate(drawn):
            next_floor = None  # above: the lowest with the same feature, or one of its kind that overlaps
            for j in sorted(int(k) for k in tree.query(area.shape) if k > i):
                high, other = drawn[j]
                if high == low or other.kind != area.kind or next_floor not in (None, high):
                    continue
                if other is area or overlap(area.shape, other.shape):
                    next_floor = high
                    pairs.append((i, j))
        pairs = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(drawn), len(drawn)))
        shaft = connected_components(links, directed=False)[1] if drawn else np.empty(0, dtype=np.intp)
        connections = []
        for number in dict.fromkeys(shaft.tolist()):
            parts = [drawn[k] for k in np.flatnonzero(shaft == number)]
            floors = tuple(dict.fromkeys(n for n, _ in parts))
            if len(floors) > 1:
                areas = [area for _, area in parts]
                name = next((area.name for area in areas if area.name), "")
                same = all(area.shape is areas[0].shape for area in areas)
                polygon = areas[0].shape if same else shapely.union_all([area.shape for area in areas])
                connections.append(Connection(areas[0].kind, name, polygon, floors))
        return tuple(connections)

    def crosses_wall(self, position: Array, labels: Sequence[str]) -> Mask:
        """``(n - 1,)`` True where the segment between consecutive positions ``(n, 2)`` [m] crosses a wall.

        labels: floor of each position. A single floor stands for every label; segments on unknown floors are False.
        """
        on = np.array(labels[:-1], dtype=object)
        crossed = np.zeros(len(on), dtype=bool)
        for floor in self.floors:
            here = np.flatnonzero((on == floor.label) | (len(self.floors) == 1))
            crossed[here] = floor.crosses_wall(position[here], position[here + 1])
        return crossed

    @cached_property
    def parts(self) -> tuple[Index, ...]:
        """Number of the connected component (on foot or by lift) of each cell: ``(n,)`` per floor."""
        first = np.cumsum([0, *(len(floor.cells) for floor in self.floors)])
        pairs = [floor.cells.passages + begin for floor, begin in zip(self.floors, first[:-1], strict=True)]
        for connection in self.connections:
            drawn = np.concatenate([first[n] + self._cells_of(connection, n) for n in connection.floors])
            pairs.append(np.stack([drawn[:-1], drawn[1:]], axis=1))
        i, j = np.concatenate(pairs).T
        joined = coo_array((np.ones(len(i)), (i, j)), shape=(first[-1], first[-1]))
        parts = connected_components(joined, directed=False)[1] if first[-1] else np.empty(0)
        return tuple(np.split(parts.astype(np.intp), first[1:-1]))

    def _cells_of(self, connection: Connection, floor: int) -> Index:
        """Indices of the cells of a floor that belong to a connection."""
        cells = self.floors[floor].cells.cells
        same = [k for k, cell in enumerate(cells) if cell.kind == connection.kind]
        shapes = np.array([cells[k].polygon for k in same], dtype=object)
        shared = shapely.area(shapely.intersection(shapes, connection.polygon))
        return np.array(same, dtype=np.intp)[shared > shapely.area(shapes) / 2]


@dataclass(frozen=True, eq=False)
class FloorSequence(OneLineRepr):
    """The floor of each piece of a walk: ``level (m,)`` is its index in the floors of a building.

    outdoors: ``(m,)`` True where it is on ways outside, which is no evidence against the plan.
    """

    building: Building
    level: Index
    outdoors: Mask | None = None

    @classmethod
    def of(cls, plan: FloorPlan | Building, labels: Sequence[str]) -> FloorSequence:
        """Look up the floor of each piece by its label; a plan of a single floor needs no labels.

        Raises ValueError if a building has several floors and the labels do not say which.
        """
        building = Building.around(plan)
        if len(building.floors) == 1:
            return cls(building, np.zeros(len(labels), dtype=np.intp))
        unknown = sorted(set(labels) - set(building.labels))
        if unknown:
            raise ValueError(f"floors: found {unknown[0]!r}, expected labels out of {', '.join(building.labels)}")
        return cls(building, np.array([building.index(label) for label in labels], dtype=np.intp))

    def within(self, low: Array, high: Array) -> FloorSequence:
        """Crop every floor to a box from ``low (2,)`` to ``high (2,)`` [m]."""
        return FloorSequence(self.building.within(low, high), self.level)

    @property
    def size(self) -> float:
        """Diagonal of the widest floor. [m]"""
        return max(floor.size for floor in self.building.floors)

    def field(self, piece: int) -> DistanceField:
        """Distance field of all walls on the floor of a piece."""
        return self.building.floors[self.level[piece]].distance

    @cached_property
    def changes(self) -> dict[int, tuple[Connection, ...]]:
        """Floor changes: first piece on a new floor -> stairs and lifts that lead there."""
        found = {}
        for piece in (np.flatnonzero(np.diff(self.level)) + 1).tolist():
            floors = {int(self.level[piece - 1]), int(self.level[piece])}
            found[piece] = tuple(c for c in self.building.connections if floors <= set(c.floors))
        return found

    def walls_along(
        self, track: Array, moved: Mask, stray: Array | float | None = None, alike: float = 1.0
    ) -> tuple[tuple[DistanceField, ...], Index, float]:
        """Associate each piece with the walls of the region that it is in.

        track: ``(m, 2)`` [m] a point for each piece; moved: ``(m,)`` False for pieces of length 0; stray, alike: error
        model of the track, see ``Regions.along``.

        Returns distance fields (of a region, of two regions with the door between them, or of stairs), the index of
        the field of each piece ``(m,)``, −1 for none, and the cost of all changes of region.
        """
        number, of_piece, total = dict[DistanceField, int](), np.full(len(track), NOWHERE), 0.0
        stray = np.broadcast_to(stray_of(stray), len(track))
        for floor, begin, end in self.spans:
            fields, which, price = floor.regions.walls_along(track[begin:end], stray[begin:end], alike)
            numbers = np.array([*(number.setdefault(field, len(number)) for field in fields), NOWHERE])
            of_piece[begin:end] = numbers[which]
            total += price
        for piece, connections in self.changes.items():
            before = np.flatnonzero(moved[:piece])
            if len(before) and connections:
                nearest = min(connections, key=lambda c: c.distance(track[before[-1:]])[0])
                of_piece[before[-1]] = number.setdefault(nearest.field, len(number))
        if self.outdoors is not None:
            total -= REGIONS.outside_price * np.count_nonzero(self.outdoors & (of_piece == NOWHERE))
        return tuple(number), of_piece, float(total)

    def walled_off(self, first: Array, second: Array, pieces: Index) -> bool:
        """True if walls separate two paths ``(n, 2)`` [m] at the ends of these pieces.

        Paths that no wall separates are one route, walked faster or slower.
        """
        return all(self.crossed(a, _nearest(a, b), pieces).any() for a, b in ((first, second), (second, first)))

    def crossed(self, first: Array, second: Array, pieces: Index) -> Mask:
        """``(n,)`` True where a wall lies between ``first`` and ``second (n, 2)`` [m] on the floors of ``pieces``."""
        level, found = self.level[pieces], np.zeros(len(first), dtype=bool)
        for n in np.unique(level):
            here = level == n
            found[here] = self.building.floors[n].crosses_wall(first[here], second[here])
        return found

    @property
    def spans(self) -> list[tuple[FloorPlan, int, int]]:
        """Consecutive pieces ``[begin, end)`` on one floor, as (floor, begin, end), in time order."""
        begins = [0, *self.changes]
        ends = [*begins[1:], len(self.level)]
        return [(self.building.floors[self.level[b]], b, e) for b, e in zip(begins, ends, strict=True)]


def _nearest(points: Array, path: Array) -> Array:
    """Nearest point ``(m, 2)`` [m] on the line through ``path (n, 2)`` to each of ``points (m, 2)``."""
    line = shapely.linestrings(path) if len(path) > 1 else shapely.points(path[0])
    between = shapely.shortest_line(shapely.points(points), line)
    return shapely.get_coordinates(between).reshape(-1, 2, 2)[:, 1]
