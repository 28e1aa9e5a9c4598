"""What somebody looked at who stood about here and faced about there: shop fronts, stands and rooms, by rays of sight.

Where they stood is a Gaussian of which a fixed set of places is drawn; those behind something solid are left out. From
each of these places rays go all round. A ray's weight is how probable it is that they looked that way, times what is to
be expected of people who linger before things that far away. What the first thing in the way has a name for has the
weight; who stands in a room is at the room. Over all places together, and against those who stop for nothing at all,
these weights are the probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from pdr_graph.floor.areas import CLOSED, Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import unit, wrap_angle
from pdr_graph.types import Array, Index, Mask

FRONTS = ("shop", "place")  # what is solid and looked at; a wall is not, though it may have a name
STAND = 0.5  # [m] half of a stand's width, of which a plan draws the middle
STANDS = 0.5  # [m] per axis by which people shuffle where they "stand", unseen by a step detector
CLOSE, FALL = 1.5, 1.0  # [m] windows and shelves are read from 0.5 to 1.5 m; farther off ever fewer linger for them
SIGHT = 7.0  # [m] where these are one in 250: what is farther is scenery
BODY = 0.6  # [rad] between where the body faces and what is looked at: heads turn by 30-40 degrees without the trunk
ASKEW = 0.1  # of those who linger: the body faces anywhere, as when one talks, or the heading is wrong
NOTHING = 0.05  # stops for nothing with a name, at any place, to one for what is close: a call, a friend, a rest
PLACES, RAYS = 96, 24
LEAST = 1e-3  # probability that is told
ANYWHERE = 20.0  # [m] per axis: who knows no better cannot tell shops apart
INSIDE = 0.01  # [m]
AT_ONCE = 0.05  # [m] within which a front is as near as the wall that it is drawn on
Facing = tuple[tuple[str, float], ...]  # as of `Stay`


@dataclass(frozen=True, eq=False)
class Fronts:
    """What can be looked at on a floor.

    names; start, way: ``(e, 2)`` edges of all that stops a look [m]; owner: ``(e,)`` whose, -1 of nothing with a name;
    solid: ``(e,)`` True where nobody walks through. rooms: polygons with names [m]; room: ``(r,)`` which names.
    walkable: where one can stand [m].
    """

    names: tuple[str, ...]
    start: Array
    way: Array
    owner: Index
    solid: Mask
    rooms: shapely.STRtree
    room: Index
    walkable: shapely.Geometry
    tree: shapely.STRtree

    @classmethod
    def of(cls, floor: FloorPlan) -> Fronts:
        """Of a floor plan. Places that share a name are one place."""
        fronts = [a for a in floor.of_kind(*FRONTS) if a.name]
        rooms = [a for a in floor.of_kind(*CLOSED) if a.name and a.is_polygon]
        names = tuple(dict.fromkeys(a.name for a in (*fronts, *rooms)))
        drawn = [(_outline(a), names.index(a.name), a.is_polygon) for a in fronts]
        drawn += [(shape, -1, True) for shape in (floor.walkable, floor.cells.barriers) if not shapely.is_empty(shape)]
        edges = [_edges(shape) for shape, _, _ in drawn]
        count = [len(e) for e in edges]
        edge = np.concatenate([np.empty((0, 2, 2)), *edges])
        return cls(
            names=names,
            start=edge[:, 0],
            way=edge[:, 1] - edge[:, 0],
            owner=np.repeat(np.array([owner for _, owner, _ in drawn], dtype=np.intp), count),
            solid=np.repeat(np.array([solid for _, _, solid in drawn], dtype=bool), count),
            rooms=shapely.STRtree([a.shape for a in rooms]),
            room=np.array([names.index(a.name) for a in rooms], dtype=np.intp),
            walkable=floor.walkable,
            tree=shapely.STRtree(shapely.get_parts(shapely.linestrings(edge))),
        )

    def facing(self, position: Array, heading: float, covariance: Array, sideways: float = BODY) -> Facing:
        """What was looked at, with probabilities, the most probable first; what they lack to 1 is of nothing.

        position ``(2,)`` [m]; heading, NaN if unknown [rad]; covariance ``(3, 3)`` of both; sideways: standard
        deviation of the direction of the look from the heading's [rad].
        """
        standing = covariance + STANDS**2 * np.diag([1.0, 1.0, 0.0])
        middle, spread = self._on_foot(position, standing[:2, :2])
        if np.trace(spread) > 2 * ANYWHERE**2:
            return ()
        reach = 3 * np.sqrt(np.trace(spread)) + SIGHT
        near = self.tree.query(shapely.box(*(middle - reach), *(middle + reach)))
        places = self._reachable(middle, middle + SPREAD @ np.linalg.cholesky(spread).T, near)
        distance, owner = self._seen(places, near)
        weight = _looks(places - position, heading, standing, sideways) * _lingers(distance)
        rates = np.bincount(owner.ravel() + 1, weight.ravel(), minlength=len(self.names) + 1)[1:]
        inside, room = self.rooms.query(shapely.points(places), predicate="intersects")
        rates += NOTHING * np.bincount(self.room[room], minlength=len(self.names))
        nothing = NOTHING * (len(places) - len(np.unique(inside)))
        probability = rates / (rates.sum() + nothing)
        order = np.argsort(-probability, kind="stable")
        return tuple((self.names[n], float(probability[n])) for n in order if probability[n] > LEAST)

    def _on_foot(self, position: Array, covariance: Array) -> tuple[Array, Array]:
        """The position, or the nearest place to it where one can stand, and its covariance with what that is off."""
        line = shapely.shortest_line(self.walkable, shapely.Point(position))
        middle = shapely.get_coordinates(line)[0]
        off = middle - position
        if not off.any():
            return position, covariance
        return middle + INSIDE * off / np.hypot(*off), covariance + np.outer(off, off)

    def _reachable(self, middle: Array, places: Array, near: Index) -> Array:
        """The places to which one can go straight from the middle; the middle if there is none."""
        walls, way = near[self.solid[near]], places - middle
        hit = _hits(middle[None], way, self.start[walls], self.way[walls])
        clear = places[~np.any(hit < 1, axis=(0, 2))]
        return clear if len(clear) else middle[None]

    def _seen(self, places: Array, near: Index) -> tuple[Array, Index]:
        """How far it is to what stops each ray from each place, and whose that is; both ``(k, RAYS)``."""
        owner = np.append(-1, self.owner[near])
        hit = _hits(places, unit(DIRECTIONS), self.start[near], self.way[near])
        hit += np.where(owner[1:] < 0, AT_ONCE, 0.0)
        hit = np.concatenate([np.full((*hit.shape[:2], 1), np.inf), hit], axis=2)
        first = np.argmin(hit, axis=2)
        return np.take_along_axis(hit, first[:, :, None], axis=2)[:, :, 0], owner[first]


def _outline(area: Area) -> shapely.Geometry:
    """What is seen of a front; of a stand that is drawn as a point, its sides."""
    return area.shape if area.is_polygon else shapely.buffer(area.shape, STAND)


def _edges(shape: shapely.Geometry) -> Array:
    """The straight pieces ``(e, 2, 2)`` of lines, or of the border of polygons. [m]"""
    lines = shapely.get_parts(shapely.boundary(shape) if shapely.get_dimensions(shape) == 2 else shape)
    corner, line = shapely.get_coordinates(lines, return_index=True)
    return np.stack([corner[:-1], corner[1:]], axis=1)[line[:-1] == line[1:]]


def _hits(origin: Array, ray: Array, start: Array, way: Array) -> Array:
    """Where rays meet edges, in lengths of each ray; infinity where they do not.

    origin ``(k, 2)``, ray ``(r, 2)``, edges from ``start (e, 2)`` along ``way (e, 2)``. Returns ``(k, r, e)``.
    """
    gap = start - origin[:, None]
    across = ray[:, None, 0] * way[:, 1] - ray[:, None, 1] * way[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (gap[:, :, 0] * way[:, 1] - gap[:, :, 1] * way[:, 0])[:, None] / across
        share = (gap[:, None, :, 0] * ray[:, None, 1] - gap[:, None, :, 1] * ray[:, None, 0]) / across
    return np.where((along > 0) & (share >= 0) & (share <= 1), along, np.inf)


def _looks(off: Array, heading: float, covariance: Array, sideways: float) -> Array:
    """How probable it is that one looks along each ray ``(k, RAYS)`` from each place, ``off (k, 2)`` the position."""
    if np.isnan(heading):
        return np.full((len(off), RAYS), 1 / RAYS)
    gain = np.linalg.solve(covariance[:2, :2], covariance[:2, 2])  # who stands farther left was heading farther left
    variance = sideways**2 + covariance[2, 2] - gain @ covariance[:2, 2]
    apart = wrap_angle(DIRECTIONS - (heading + off @ gain)[:, None])
    ahead = np.exp(-0.5 * apart**2 / variance)
    return (1 - ASKEW) * ahead / ahead.sum(axis=1, keepdims=True) + ASKEW / RAYS


def _lingers(distance: Array) -> Array:
    """How many linger before what is so far away, to one before what is close."""
    return np.where(distance < SIGHT, np.exp(-np.maximum(distance - CLOSE, 0.0) / FALL), 0.0)


def _spread(count: int) -> Array:
    """Points ``(n, 2)`` that share out a normal distribution evenly, in a spiral by the golden angle."""
    rank = np.arange(count)
    radius = np.sqrt(-2 * np.log1p(-(rank + 0.5) / count))
    return radius[:, None] * unit(rank * np.pi * (3 - np.sqrt(5)))


SPREAD, DIRECTIONS = _spread(PLACES), np.arange(RAYS) * 2 * np.pi / RAYS
