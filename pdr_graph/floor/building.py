"""A building: its floors, and the stairs and lifts that join them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.errors import expect
from pdr_graph.floor.areas import CONNECTING
from pdr_graph.floor.distance import DistanceField
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.types import Array, Index, Mask


@dataclass(frozen=True, eq=False)
class Connection:
    """Stairs or a lift.

    kind: of CONNECTING; polygon: the same on each floor that it joins [m]; floors: which of the building's, lowest
    first.
    """

    kind: str
    name: str
    polygon: shapely.Geometry
    floors: tuple[int, ...]

    def distance(self, position: Array) -> Array:
        """From positions ``(n, 2)`` [m] to its polygon, 0 in it. ``(n,)`` [m]"""
        return np.asarray(shapely.distance(self.polygon, shapely.points(position)))

    @cached_property
    def field(self) -> DistanceField:
        """Signed distance to its border, positive in it."""
        return DistanceField(self.polygon)


@dataclass(frozen=True)
class Building:
    """All floors of a plan in one frame, lowest first. A plan of one floor is a building with one floor."""

    floors: tuple[FloorPlan, ...]

    def __post_init__(self) -> None:
        """Raise TypeError unless floors are floors."""
        expect("Building, floors", self.floors, tuple, instead="Building.load(path)")

    @classmethod
    def load(cls, path: str | Path) -> Building:
        """A plan of any format. Raises InputError as `FloorPlan.load_all` does."""
        return cls.of(*FloorPlan.load_all(path))

    @classmethod
    def of(cls, *floors: FloorPlan) -> Building:
        """Some floors of one frame, or a single one."""
        return cls(tuple(sorted(floors, key=lambda floor: floor.height)))

    @classmethod
    def around(cls, plan: FloorPlan | Building) -> Building:
        """A single floor as a building, a building as it is."""
        return cls.of(plan) if isinstance(plan, FloorPlan) else plan

    def __getitem__(self, label: str) -> FloorPlan:
        """The floor of that label; a KeyError if there is none."""
        return self.floors[self.index(label)]

    def index(self, label: str) -> int:
        """Which floor has that label; a KeyError if none."""
        if label not in self.labels:
            raise KeyError(f"floor {label!r}: found only {', '.join(self.labels)}")
        return self.labels.index(label)

    def within(self, low: Array, high: Array) -> Building:
        """What of each floor is drawn in or into a box from ``low (2,)`` to ``high (2,)`` [m]."""
        return Building(tuple(floor.within(low, high) for floor in self.floors))

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the floors."""
        return tuple(floor.label for floor in self.floors)

    @property
    def heights(self) -> Array:
        """Of the floors ``(f,)``, above whatever the plan takes for zero. [m]"""
        return np.array([floor.height for floor in self.floors])

    @cached_property
    def connections(self) -> tuple[Connection, ...]:
        """Stairs and lifts that are on several floors."""
        found = []
        for n, floor in enumerate(self.floors):
            for area in floor.of_kind(*CONNECTING):
                on = [k for k, label in enumerate(self.labels) if not area.floors or label in area.floors]
                if area.is_polygon and len(on) > 1 and on[0] == n:  # once, though it is drawn on each
                    found.append(Connection(area.kind, area.name, area.shape, tuple(on)))
        return tuple(found)

    def crosses_wall(self, position: Array, labels: Sequence[str]) -> Mask:
        """Which steps between positions ``(n, 2)`` [m] on floors of these labels lead through a wall. ``(n - 1,)``

        The only floor is any label's; nothing is known of a step on a floor that the building has not.
        """
        on = np.array(labels[:-1], dtype=object)
        crossed = np.zeros(len(on), dtype=bool)
        for floor in self.floors:
            here = np.flatnonzero((on == floor.label) | (len(self.floors) == 1))
            crossed[here] = floor.crosses_wall(position[here], position[here + 1])
        return crossed

    @cached_property
    def parts(self) -> tuple[Index, ...]:
        """Which connected part of the building each cell belongs to, on foot or by lift: ``(n,)`` per floor."""
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
        """The cells of a floor that draw a connection."""
        cells = self.floors[floor].cells.cells
        same = [k for k, cell in enumerate(cells) if (cell.kind, cell.name) == (connection.kind, connection.name)]
        shapes = np.array([cells[k].polygon for k in same], dtype=object)
        shared = shapely.area(shapely.intersection(shapes, connection.polygon))
        return np.array(same, dtype=np.intp)[shared > shapely.area(shapes) / 2]
