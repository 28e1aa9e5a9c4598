"""Regions: the parts of a floor that doors divide, and which of them a walk is in.

Corridors and all that is open to them are one region, every room is one. A wall of 12 cm turns no distance field
negative on a grid of 25 cm, but the field of a region alone does: whoever strays through its wall, however thin, is
outside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pdr_graph.floor.areas import DOOR
from pdr_graph.floor.cells import Cells, without_cracks
from pdr_graph.floor.distance import DistanceField
from pdr_graph.types import Array, Index
from pdr_graph.viterbi import viterbi

STRAY = 0.5  # [m] by which a track errs
OUTSIDE_COST = 4.0  # of a step in no region: nearer than 1.4 m it is rather in the next one
OUTSIDE_PRICE = 0.15  # log-odds of a step in none, once that is settled: shops are entered, plans end
AT_DOOR = 1.5  # [m] from a door that one may go through
WALL_COST = 12.0  # log-odds of a step through a wall: plans err, and two fixes can be right where they do
DOOR_COST, LEAVE_COST = 1.0, 6.0  # of changing region at a door, and to or from none
NOWHERE = -1


@dataclass(frozen=True)
class Regions:
    """The regions of a floor.

    polygons: ``(r,)`` [m]; doors: ``(d,)`` [m]; joins: ``(d, r)`` which regions a door opens; barriers: lines [m].
    """

    polygons: NDArray[np.object_]
    doors: NDArray[np.object_]
    joins: NDArray[np.bool_]
    barriers: shapely.Geometry

    @classmethod
    def of(cls, walkable: shapely.Geometry, cells: Cells) -> Regions:
        """Of a floor with cells; of one without, everything walkable is one region."""
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
        count = int(region.max(initial=NOWHERE)) + 1
        polygons = np.empty(count, dtype=object)
        for r in range(count):
            polygons[r] = _joined(shapes[region == r])
        joins = np.zeros((n, count), dtype=bool)
        for a, b in ((one, other), (other, one)):
            leads = is_door[a] & ~is_door[b]
            joins[a[leads], region[b[leads]]] = True
        return cls(polygons, shapes[is_door], joins[is_door], cells.barriers)

    def __len__(self) -> int:
        return len(self.polygons)

    def along(self, track: Array, stray: Array | float = STRAY, alike: float = 1.0) -> tuple[Index, float]:
        """The region that each point ``(n, 2)`` [m] of a walk is in ``(n,)``, NOWHERE far from all: the likeliest
        sequence, through doors where there are any (Viterbi's). And what its changes and places in none cost.

        stray: by which the track errs, everywhere or at each point ``(n,)`` [m]; alike: points in a row that err alike.
        """
        points, stray = np.asarray(shapely.points(track), dtype=object), np.broadcast_to(stray, len(track))
        near = np.unique(self._tree.query(points, predicate="dwithin", distance=2 * stray)[1])
        if not len(near):
            return np.full(len(track), NOWHERE), OUTSIDE_PRICE * len(track)
        cost = np.full((len(track), len(near) + 1), OUTSIDE_COST)
        for column, r in enumerate(near):
            cost[:, column] = 0.5 * (shapely.distance(self.polygons[r], points) / stray) ** 2 / alike
        states = np.append(near, NOWHERE)
        if len(near) == 1 and cost[:, 0].max() < OUTSIDE_COST:
            return np.full(len(track), near[0]), 0.0
        changes = self._changes(near, points)
        likeliest, _ = viterbi(cost, changes[1:])
        price = changes[np.arange(1, len(track)), likeliest[:-1], likeliest[1:]].sum()
        return states[likeliest], float(price + OUTSIDE_PRICE * np.sum(likeliest == len(near)))

    def walls_along(
        self, track: Array, stray: Array | float = STRAY, alike: float = 1.0
    ) -> tuple[list[DistanceField], Index, float]:
        """The walls about a walk through ``track (n, 2)`` [m]: fields; which of them holds at each point ``(n,)``, −1
        none; and what the regions' changes cost. Where the region changes, both and the door between them hold.

        stray, alike: as of `along`.
        """
        region, price = self.along(track, stray, alike)
        before, after = np.append(region[:1], region[:-1]), np.append(region[1:], region[-1:])
        sets, which = np.unique(np.sort([before, region, after], axis=0), axis=1, return_inverse=True)
        inside = [NOWHERE not in s for s in sets.T]
        fields = [self.field(tuple(np.unique(s).tolist())) for s in sets.T[inside]]
        return fields, np.where(inside, np.cumsum(inside) - 1, NOWHERE)[which.ravel()], price

    def field(self, regions: tuple[int, ...]) -> DistanceField:
        """Signed distance to the walls of some regions, taken together with the doors between them."""
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
        usual = np.full((s, s), WALL_COST)
        usual[:, -1] = usual[-1] = LEAVE_COST
        np.fill_diagonal(usual, 0.0)
        changes = np.tile(usual, (len(points), 1, 1))
        for door, joined in zip(self.doors, self.joins[:, near], strict=True):
            which = np.flatnonzero(joined)
            if len(which) > 1:
                at = np.flatnonzero(shapely.dwithin(door, points, AT_DOOR))
                pairs = [(i, j) for i in which for j in which if i != j]
                for i, j in pairs if len(at) else []:
                    changes[at, i, j] = DOOR_COST
        return changes


def _joined(polygons: NDArray[np.object_]) -> shapely.Geometry:
    return polygons[0] if len(polygons) == 1 else without_cracks(polygons)
