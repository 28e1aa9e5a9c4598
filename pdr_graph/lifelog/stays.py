"""Stays and slow passes of a walk, with probabilities of the places that the person faced.

Places are shop fronts, stands and rooms, found by ray casting. The position is a Gaussian, represented by a fixed set
of sample points; points behind solid walls are dropped. Rays leave each point in all directions. The weight of a ray
is the probability of looking that way times the expected rate of lingering at that distance. It goes to the first
named place that the ray hits; a person in a room is at the room. Weights summed over all points, normalised with the
rate of stops for no named place, are the probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import numpy as np
import shapely

from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import CLOSED, Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import length_along, row_times, unit, wrap_angle
from pdr_graph.lifelog.day import STANDING, Segment, Stay, at
from pdr_graph.types import INSTANT, Array, Index, Mask, Steps, Trajectory

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
class VisiblePlaces:
    """Visible places on a floor.

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
    def of(cls, floor: FloorPlan) -> VisiblePlaces:
        """Construct from a floor plan; places with the same name are one place."""
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
        """Probabilities of the places faced, most probable first; the remainder to 1 is no named place.

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


SHORTEST = 5.0  # [s] of a stay: who lets somebody pass or looks about is sooner off again
ON_THE_WAY = 60.0  # [s] of waiting where no plan has a name for anything: at a crossing, for a bus
MOMENT = 1.0  # [s] of standing between steps that is more than their rhythm
SHUFFLE, BACK = 1.5, 20.0  # [m] and [s] at most between two halts of one stay: a shift along a shelf, a restarted log
UNSEEN_LOOK = 1.2  # [rad] of which way one turned while standing where nobody measured it
USUAL = 0.75  # quantile of a walk's speeds that is its usual one: much of it may be slow
SLOW = 0.7  # of that speed: people stroll at 0.8 of it and browse at half
STEADY = 4.0  # [s] under way over which speed is taken: several strides
PIECE = 3.0  # [m] of a slow way that are looked at at a time: half of a small shop's front
PASSING = 1.2  # [rad] between the way and the look of who passes fronts on either side
NAMED = 0.5  # probability that a slow way led past something with a name; else it is just slow


def stays_of(
    steps: Steps, trajectory: Trajectory, building: Building | None, looks: Array | None = None
) -> tuple[Stay, ...]:
    """Stays and slow passes of a walk, in order of time.

    trajectory: of these steps with covariance, rows as of `row_times`. looks: ``(n + 1,)`` how far the walker had
    turned while standing before each step and after the last, since the step before [rad]; None if nobody knows.

    Raises ValueError where rows do not belong together.
    """
    _check(steps, trajectory, looks)
    fronts = _fronts(building, trajectory)
    found = _stays(steps, trajectory, fronts, looks) + _passes(steps, trajectory, fronts)
    return tuple(sorted(found, key=lambda stay: stay.start))


def stays_of_positions(
    trajectory: Trajectory, segments: tuple[Segment, ...], building: Building | None
) -> tuple[Stay, ...]:
    """The stays of a day of positions alone: its segments of standing. Which way somebody faced is not known.

    trajectory: with covariance.
    """
    fronts, found = _fronts(building, trajectory), list[Stay]()
    for segment in segments:
        if segment.kind != STANDING:
            continue
        first, after = np.searchsorted(trajectory.time, [segment.start, segment.end + INSTANT])
        track = at(trajectory, np.append(trajectory.time[first:after], (segment.start + segment.end) / 2))
        pose = track.position.mean(axis=0), np.nan, _covariance(track).mean(axis=0)
        stay = _stay(segment.start, segment.end, False, *pose, track.floor[-1], fronts)
        found += [stay] if _lasts(stay, fronts) else []
    return tuple(found)


def _check(steps: Steps, trajectory: Trajectory, looks: Array | None) -> None:
    if len(trajectory) != len(steps) + 2:
        raise ValueError(f"trajectory: found {len(trajectory)} rows, expected {len(steps) + 2}, two more than steps")
    if looks is not None and len(looks) != len(steps) + 1:
        raise ValueError(f"looks: found {len(looks)}, expected {len(steps) + 1}, one more than steps")


def _covariance(trajectory: Trajectory) -> Array:
    if trajectory.covariance is None:
        raise ValueError("trajectory: found no covariance, expected one of each row")
    return trajectory.covariance


def _fronts(building: Building | None, trajectory: Trajectory) -> dict[str, VisiblePlaces]:
    """What can be looked at, by the labels of the trajectory's floors; none of a floor where nothing has a name."""
    if building is None:
        return {}
    labels, only = set(trajectory.floor), len(building.labels) == 1
    floors = {
        label: building.floors[0] if only else building[label] for label in labels if only or label in building.labels
    }
    made = {label: VisiblePlaces.of(floor) for label, floor in floors.items()}
    return {label: own for label, own in made.items() if own.names}


def _stay(
    start: float,
    end: float,
    passing: bool,
    position: Array,
    heading: float,
    covariance: Array,
    floor: str,
    fronts: dict[str, VisiblePlaces],
) -> Stay:
    """A stay at a pose, covariance ``(3, 3)``, with what it was at."""
    facing = ()
    if floor in fronts:
        facing = fronts[floor].facing(position, heading, covariance, PASSING if passing else BODY)
    return Stay(start, end, passing, position, covariance[:2, :2], heading, floor, facing)


def _lasts(stay: Stay, fronts: dict[str, VisiblePlaces]) -> bool:
    return stay.end - stay.start >= (SHORTEST if stay.floor in fronts else ON_THE_WAY)


def _stays(steps: Steps, track: Trajectory, fronts: dict[str, VisiblePlaces], looks: Array | None) -> list[Stay]:
    """Halts, with those joined between which somebody only shuffled."""
    begin, end = row_times(steps)[:-1], np.append(steps.time - steps.duration, steps.end)
    lasted = end - begin
    halts = np.flatnonzero(lasted > MOMENT)
    apart = np.hypot(*np.diff(track.position[halts], axis=0).T) > SHUFFLE
    apart |= begin[halts[1:]] - end[halts[:-1]] > BACK
    unseen = UNSEEN_LOOK**2 * np.diag([0.0, 0.0, 1.0]) if looks is None else 0.0
    found = list[Stay]()
    for rows in np.split(halts, np.flatnonzero(apart) + 1) if len(halts) else []:
        longest = rows[np.argmax(lasted[rows])]
        heading = track.heading[longest] + (0.0 if looks is None else looks[longest])
        position, covariance = _together(track, rows, lasted[rows])
        pose = position, float(wrap_angle(heading)), covariance + unseen
        span = float(begin[rows[0]]), float(end[rows[-1]])
        found.append(_stay(*span, False, *pose, track.floor[longest], fronts))
    return [stay for stay in found if _lasts(stay, fronts)]


def _together(track: Trajectory, rows: Index, weight: Array) -> tuple[Array, Array]:
    """Mean position ``(2,)`` of some rows by weight, and the covariance ``(3, 3)`` of a pose at any of them."""
    share = weight / weight.sum()
    position = share @ track.position[rows]
    off = track.position[rows] - position
    covariance = np.tensordot(share, _covariance(track)[rows], axes=1)
    covariance[:2, :2] += (share * off.T) @ off
    return position, covariance


def _passes(steps: Steps, track: Trajectory, fronts: dict[str, VisiblePlaces]) -> list[Stay]:
    """Slow stretches of the way past something with a name, one for each name that was the likeliest for a while."""
    found = list[Stay]()
    for taken in _slow(steps) if fronts else []:
        along = length_along(track.position[taken + 1])
        cuts = np.unique(np.searchsorted(along, np.arange(PIECE, along[-1], PIECE)))
        pieces = np.split(taken, cuts)
        passed = [_pass(steps, piece, track, fronts).facing for piece in pieces]
        likeliest = [facing[0][0] if facing else "" for facing in passed]
        for _, same in groupby(zip(likeliest, pieces, strict=True), key=itemgetter(0)):
            whole = _pass(steps, np.concatenate([piece for _name, piece in same]), track, fronts)
            if _lasts(whole, fronts) and sum(p for _, p in whole.facing) > NAMED:
                found.append(whole)
    return found


def _pass(steps: Steps, taken: Index, track: Trajectory, fronts: dict[str, VisiblePlaces]) -> Stay:
    """What some neighbouring steps led past."""
    rows, first, last = taken + 1, taken[0], taken[-1]
    position, covariance = _together(track, rows, steps.duration[taken])
    heading = float(np.angle(np.exp(1j * track.heading[rows]).sum()))
    start, end = float(steps.time[first] - steps.duration[first]), float(steps.time[last])
    return _stay(start, end, True, position, heading, covariance, track.floor[rows[len(rows) // 2]], fronts)


def _slow(steps: Steps) -> list[Index]:
    """Which steps, for each stretch that is long enough, were slow and without a halt between.

    By the steps themselves: within a walk they compare well, where the trajectory is bent to what else is known.
    """
    under_way = np.concatenate([[0.0], np.cumsum(steps.duration)])
    walking = ~steps.is_gap
    if under_way[-1] < STEADY or not walking.any():
        return []
    way = np.concatenate([[0.0], np.cumsum(steps.length)])
    before, after = (np.clip(under_way[1:] + side * STEADY / 2, 0.0, under_way[-1]) for side in (-1, 1))
    speed = (np.interp(after, under_way, way) - np.interp(before, under_way, way)) / (after - before)
    slow = np.flatnonzero(walking & (speed < SLOW * np.quantile(speed[walking], USUAL)))
    halted = (steps.time - steps.duration - row_times(steps)[:-2] > MOMENT)[slow[1:]]
    stretches = np.split(slow, np.flatnonzero((np.diff(slow) > 1) | halted) + 1)
    return [taken for taken in stretches if steps.duration[taken].sum() >= SHORTEST]
