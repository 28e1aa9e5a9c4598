"""The parts of an outing: walking, standing, rides and gaps; stays and slow passes with the places that a person faced.

**Segments** come from steps or from positions alone. Positions alone separate vehicles from walkers, and the jumps of a
receiver from both (`follow_positions`). Rides within a walk are those of `estimation.rides`.

**Places that a person faced** are shop fronts, stands and rooms, found by ray casting. The position is a Gaussian,
represented by a fixed set of sample points; points behind solid walls are dropped. Rays leave each point in all
directions. The weight of a ray is the probability of looking that way times the expected rate of lingering at that
distance. It goes to the first named place that the ray hits; a person in a room is at the room. Weights summed over all
points, normalised with the rate of stops for no named place, are the probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby, pairwise
from operator import itemgetter

import numpy as np
import shapely

from pdr_graph.apps.lifelog.day import ACTIVITIES, STANDING, Segment, Stay, sampled
from pdr_graph.errors import count
from pdr_graph.estimation.gps_track import LOST, RIDES, STANDS, WALKS, way_through
from pdr_graph.estimation.rides import ridden
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import CLOSED, Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import length_along, row_times, unit, wrap_angle
from pdr_graph.priors import RIDING
from pdr_graph.types import INSTANT, Array, Fixes, Index, Mask, OneLineRepr, Steps, Trajectory

# A bout has at least two strides of either foot (Kluge et al., "Consensus based framework for digital mobility
# monitoring", PLOS ONE 16(8), 2021); a detector may miss the first and the last step
MIN_STEPS = 4  # of a bout; fewer between two pauses are shuffling


def follow_positions(fixes: Fixes) -> tuple[Trajectory, tuple[Segment, ...]]:
    """The path through positions alone, as of `way_through`, and its segments from the first fix to the last.

    A gap lasts from one fix to the next.
    """
    way = way_through(fixes)
    track, at_fix = way.trajectory, np.isin(way.trajectory.time[:-1], fixes.time[way.used])
    return track, _segments(way.kind, track.time, np.diff(length_along(track.position)), at_fix)


def segments_of(steps: Steps, trajectory: Trajectory, rides: Array) -> tuple[Segment, ...]:
    """The segments from ``steps.start`` to ``steps.end``.

    trajectory: of these steps, with rows as of `row_times`; distances are measured along it. rides: ``(r, 2)`` start
    and end of each [s], in ``steps`` a row each (`without_rides`).
    """
    in_ride = ridden(steps.time - steps.duration, steps.time, rides)
    kind = np.where(in_ride, RIDES, np.where(steps.is_gap, LOST, WALKS))

    # Before every row and after the last one a pause, which may be none; a short one beside a step is walking
    edge = np.column_stack([steps.time - steps.duration, steps.time]).ravel()
    edge = np.concatenate([[steps.start], edge, [steps.end]])
    parts = np.full(len(edge) - 1, STANDS)
    parts[1::2] = kind
    if len(kind):
        before, after = np.append(kind[0], kind), np.append(kind, kind[-1])
        pause = np.where((before == WALKS) | (after == WALKS), WALKS, before)
        parts[::2] = np.where(np.diff(edge)[::2] > RIDING.pause, STANDS, pause)
    moved, distance = np.diff(length_along(trajectory.position)), np.zeros(len(parts))
    distance[1::2], distance[-1] = moved[:-1], moved[-1]

    lasting = np.diff(edge) > INSTANT
    parts, distance, edge = parts[lasting], distance[lasting], np.append(edge[:-1][lasting], edge[-1])

    # Fewer than MIN_STEPS between two pauses are standing
    for a, b in pairwise(_run_starts(parts)):
        around = {parts[k] for k in (a - 1, b) if 0 <= k < len(parts)}
        if parts[a] == WALKS and around == {STANDS} and np.count_nonzero(distance[a:b]) < MIN_STEPS:
            parts[a:b] = STANDS
    return _segments(parts, edge, distance)


def _segments(parts: Index, edge: Array, gone: Array, seen: Mask | bool = False) -> tuple[Segment, ...]:
    """The runs of parts of one kind as segments.

    parts: ``(p,)`` kinds; edge: ``(p + 1,)`` their bounds [s]; gone: ``(p,)`` the distance of each [m]; seen: ``(p,)``
    True for parts that begin at a fix, which ends a gap.
    """
    starts = np.flatnonzero((np.diff(parts, prepend=-1) != 0) | (seen & (parts == LOST)))
    return tuple(
        Segment(
            ACTIVITIES[parts[a]],
            float(edge[a]),
            float(edge[b]),
            float(gone[a:b].sum()) if parts[a] in (WALKS, RIDES) else 0.0,
        )
        for a, b in pairwise([*starts.tolist(), len(parts)])
    )


def _run_starts(parts: Index) -> list[int]:
    """Index of the first part of each run of one kind, and the number of parts."""
    return [*np.flatnonzero(np.diff(parts, prepend=-1)).tolist(), len(parts)]


FRONT_KINDS = ("shop", "place")  # kinds of areas that are solid and looked at; walls are not, even if they have names

# The model of facing; chosen by hand
STAND_HALF_WIDTH = 0.5  # [m] of a stand, which a plan draws as its middle
SHUFFLE_SIGMA = 0.5  # [m] per axis by which a standing person moves without a detected step
NEAR_DISTANCE = 1.5  # [m] up to which people linger at the full rate: windows and shelves are read from 0.5 to 1.5 m
DECAY_DISTANCE = 1.0  # [m] over which the rate falls to 1/e beyond
MAX_DISTANCE = 7.0  # [m] at which the rate is 1/250; farther places are scenery
LOOK_SIGMA = 0.6  # [rad] of the look from the body's direction: heads turn by 30 to 40 degrees without the trunk
RANDOM_LOOK_SHARE = 0.1  # of people who linger and face anywhere: they talk, or the heading is wrong
UNNAMED_RATE = 0.05  # of stops for no named place (a call, a friend, a rest), relative to stops for a near place
SAMPLE_POINTS, RAYS = 96, 24  # sample points of the position; rays from each

Facing = tuple[tuple[str, float], ...]  # as of `Stay`


@dataclass(frozen=True, eq=False)
class VisiblePlaces(OneLineRepr):
    """Visible places on a floor.

    names: of the places; start, way: ``(e, 2)`` start and vector of all edges that stop a look [m]; owner: ``(e,)``
    number of the edge's place, -1 without a name; solid: ``(e,)`` True for edges that nobody walks through; rooms:
    polygons with names [m]; room: ``(r,)`` number of each room's place; walkable: the area in which people stand [m];
    tree: of the edges.
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

    def _summary(self) -> list[str]:
        return [count(len(self.names), "place"), count(len(self.start), "edge"), count(len(self.room), "room")]

    @classmethod
    def of(cls, floor: FloorPlan) -> VisiblePlaces:
        """Construct from a floor plan; places with the same name are one place."""
        fronts = [a for a in floor.of_kind(*FRONT_KINDS) if a.name]
        rooms = [a for a in floor.of_kind(*CLOSED) if a.name and a.is_polygon]
        names = tuple(dict.fromkeys(a.name for a in (*fronts, *rooms)))
        drawn = [(_outline(a), names.index(a.name), a.is_polygon) for a in fronts]
        drawn += [(shape, -1, True) for shape in (floor.walkable, floor.cells.barriers) if not shapely.is_empty(shape)]
        edges = [_edges(shape) for shape, _, _ in drawn]
        numbers = [len(e) for e in edges]
        edge = np.concatenate([np.empty((0, 2, 2)), *edges])
        return cls(
            names=names,
            start=edge[:, 0],
            way=edge[:, 1] - edge[:, 0],
            owner=np.repeat(np.array([owner for _, owner, _ in drawn], dtype=np.intp), numbers),
            solid=np.repeat(np.array([solid for _, _, solid in drawn], dtype=bool), numbers),
            rooms=shapely.STRtree([a.shape for a in rooms]),
            room=np.array([names.index(a.name) for a in rooms], dtype=np.intp),
            walkable=floor.walkable,
            tree=shapely.STRtree(shapely.get_parts(shapely.linestrings(edge))),
        )

    def facing(self, position: Array, heading: float, covariance: Array, sideways: float = LOOK_SIGMA) -> Facing:
        """Probabilities of the places faced, most probable first; the remainder to 1 is no named place.

        position ``(2,)`` [m]; heading, NaN if unknown [rad]; covariance ``(3, 3)`` of both; sideways: standard
        deviation of the direction of the look from the heading's [rad].
        """
        standing = covariance + SHUFFLE_SIGMA**2 * np.diag([1.0, 1.0, 0.0])
        # The nearest walkable position, with the covariance enlarged by the distance to it
        line = shapely.shortest_line(self.walkable, shapely.Point(position))
        middle, spread = shapely.get_coordinates(line)[0], standing[:2, :2]
        off = middle - position
        if off.any():
            # inset [m] by which a position off the plan is moved into it
            middle, spread = middle + 0.01 * off / np.hypot(*off), spread + np.outer(off, off)
        else:
            middle = position
        # most position sigma [m] per axis; a less certain position does not determine a place
        if np.trace(spread) > 2 * 20.0**2:
            return ()
        reach = 3 * np.sqrt(np.trace(spread)) + MAX_DISTANCE
        near = self.tree.query(shapely.box(*(middle - reach), *(middle + reach)))

        # Sample points that no solid wall separates from the middle; the middle if there is none
        places = middle + NORMAL_POINTS @ np.linalg.cholesky(spread).T
        walls = near[self.solid[near]]
        hit = _ray_distances(middle[None], places - middle, self.start[walls], self.way[walls])
        places = places[~np.any(hit < 1, axis=(0, 2))]
        places = places if len(places) else middle[None]

        # Distance to the first edge on each ray from each point, and the number of its place
        number = np.append(-1, self.owner[near])
        hit = _ray_distances(places, unit(DIRECTIONS), self.start[near], self.way[near])
        # wall offset [m] that walls are moved back, so that a front drawn on a wall is hit first
        hit += np.where(number[1:] < 0, 0.05, 0.0)
        hit = np.concatenate([np.full((*hit.shape[:2], 1), np.inf), hit], axis=2)
        first = np.argmin(hit, axis=2)
        distance, owner = np.take_along_axis(hit, first[:, :, None], axis=2)[:, :, 0], number[first]

        # Probability of looking along each ray, given the heading at the point, times the rate of lingering
        look = np.full((len(places), RAYS), 1 / RAYS)
        if not np.isnan(heading):
            gain = np.linalg.solve(standing[:2, :2], standing[:2, 2])
            variance = sideways**2 + standing[2, 2] - gain @ standing[:2, 2]
            apart = wrap_angle(DIRECTIONS - (heading + (places - position) @ gain)[:, None])
            ahead = np.exp(-0.5 * apart**2 / variance)
            look = (1 - RANDOM_LOOK_SHARE) * ahead / ahead.sum(axis=1, keepdims=True) + RANDOM_LOOK_SHARE / RAYS
        linger = np.exp(-np.maximum(distance - NEAR_DISTANCE, 0.0) / DECAY_DISTANCE)
        weight = look * np.where(distance < MAX_DISTANCE, linger, 0.0)
        rates = np.bincount(owner.ravel() + 1, weight.ravel(), minlength=len(self.names) + 1)[1:]
        inside, room = self.rooms.query(shapely.points(places), predicate="intersects")
        rates += UNNAMED_RATE * np.bincount(self.room[room], minlength=len(self.names))
        nothing = UNNAMED_RATE * (len(places) - len(np.unique(inside)))
        probability = rates / (rates.sum() + nothing)
        order = np.argsort(-probability, kind="stable")
        # least probability of a place that is reported
        return tuple((self.names[n], float(probability[n])) for n in order if probability[n] > 1e-3)


def _outline(area: Area) -> shapely.Geometry:
    """The visible outline of a front; a stand drawn as a point or a line gets a width."""
    return area.shape if area.is_polygon else shapely.buffer(area.shape, STAND_HALF_WIDTH)


def _edges(shape: shapely.Geometry) -> Array:
    """The straight pieces ``(e, 2, 2)`` of lines, or of the boundary of polygons [m]."""
    lines = shapely.get_parts(shapely.boundary(shape) if shapely.get_dimensions(shape) == 2 else shape)
    corner, line = shapely.get_coordinates(lines, return_index=True)
    return np.stack([corner[:-1], corner[1:]], axis=1)[line[:-1] == line[1:]]


def _ray_distances(origin: Array, ray: Array, start: Array, way: Array) -> Array:
    """Distance at which rays meet edges, in lengths of each ray; infinity where they do not.

    origin ``(k, 2)``, ray ``(r, 2)``, edges from ``start (e, 2)`` along ``way (e, 2)``. Returns ``(k, r, e)``.
    """
    gap = start - origin[:, None]
    across = ray[:, None, 0] * way[:, 1] - ray[:, None, 1] * way[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (gap[:, :, 0] * way[:, 1] - gap[:, :, 1] * way[:, 0])[:, None] / across
        share = (gap[:, None, :, 0] * ray[:, None, 1] - gap[:, None, :, 1] * ray[:, None, 0]) / across
    return np.where((along > 0) & (share >= 0) & (share <= 1), along, np.inf)


# Points ``(n, 2)`` of equal weight that represent a standard normal distribution: a golden-angle spiral
_RANK = np.arange(SAMPLE_POINTS)
NORMAL_POINTS = np.sqrt(-2 * np.log1p(-(_RANK + 0.5) / SAMPLE_POINTS))[:, None] * unit(_RANK * np.pi * (3 - np.sqrt(5)))
DIRECTIONS = np.arange(RAYS) * 2 * np.pi / RAYS


# Detection of stays and slow passes; chosen by hand
SHORTEST_STAY = 5.0  # [s]; shorter halts are for letting somebody pass or for looking around
SHORTEST_UNNAMED_STAY = 60.0  # [s] on a floor without names; shorter ones are at crossings
SHORTEST_HALT = 1.0  # [s] between two steps; shorter pauses are part of the gait
PASS_SPEED_WINDOW = 4.0  # [s] of walking over which a speed is measured: several strides
PASS_PIECE = 3.0  # [m] of a slow pass with one result: half of a small shop's front


def stays_of(
    steps: Steps, trajectory: Trajectory, building: Building | None, looks: Array | None = None
) -> tuple[Stay, ...]:
    """Stays and slow passes of a walk, in time order.

    trajectory: of these steps with covariance, rows as of `row_times`. looks: ``(n + 1,)`` turn of the walker while
    standing before each step and after the last, relative to the step before [rad]; None if it was not measured.

    Raises ValueError if the numbers of rows do not match.
    """
    if len(trajectory) != len(steps) + 2:
        raise ValueError(f"trajectory: found {len(trajectory)} rows, expected {len(steps) + 2}, two more than steps")
    if looks is not None and len(looks) != len(steps) + 1:
        raise ValueError(f"looks: found {len(looks)}, expected {len(steps) + 1}, one more than steps")
    fronts = _visible_places(building, trajectory)
    found = _stays(steps, trajectory, fronts, looks) + _passes(steps, trajectory, fronts)
    return tuple(sorted(found, key=lambda stay: stay.start))


def stays_of_positions(
    trajectory: Trajectory, segments: tuple[Segment, ...], building: Building | None
) -> tuple[Stay, ...]:
    """Stays of a day of positions alone: its segments of standing, with unknown heading.

    trajectory: with covariance.
    """
    fronts, found = _visible_places(building, trajectory), list[Stay]()
    for segment in segments:
        if segment.kind != STANDING:
            continue
        first, after = np.searchsorted(trajectory.time, [segment.start, segment.end + INSTANT])
        track = sampled(trajectory, np.append(trajectory.time[first:after], (segment.start + segment.end) / 2))
        pose = track.position.mean(axis=0), np.nan, _covariance(track).mean(axis=0)
        stay = _stay(segment.start, segment.end, False, *pose, track.floor[-1], fronts)
        found += [stay] if _is_long_enough(stay, fronts) else []
    return tuple(found)


def _covariance(trajectory: Trajectory) -> Array:
    """The covariance of each row. Raises ValueError without any."""
    if trajectory.covariance is None:
        raise ValueError("trajectory: found no covariance, expected one of each row")
    return trajectory.covariance


def _visible_places(building: Building | None, trajectory: Trajectory) -> dict[str, VisiblePlaces]:
    """The visible places by the labels of the trajectory's floors, without floors on which nothing has a name."""
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
    """A stay at a pose with covariance ``(3, 3)``, and the places that it faces."""
    facing = ()
    if floor in fronts:
        # passing look sigma [rad] of the look from the walking direction during a slow pass
        facing = fronts[floor].facing(position, heading, covariance, 1.2 if passing else LOOK_SIGMA)
    return Stay(start, end, passing, position, covariance[:2, :2], heading, floor, facing)


def _is_long_enough(stay: Stay, fronts: dict[str, VisiblePlaces]) -> bool:
    """True if a stay lasts SHORTEST_STAY, or SHORTEST_UNNAMED_STAY on a floor without names."""
    return stay.end - stay.start >= (SHORTEST_STAY if stay.floor in fronts else SHORTEST_UNNAMED_STAY)


def _stays(steps: Steps, track: Trajectory, fronts: dict[str, VisiblePlaces], looks: Array | None) -> list[Stay]:
    """Stays: halts of a walk, merged where the walker only shuffles between them."""
    begin, end = row_times(steps)[:-1], np.append(steps.time - steps.duration, steps.end)
    lasted = end - begin
    halts = np.flatnonzero(lasted > SHORTEST_HALT)
    # shuffle distance [m] between two halts of one stay, along a shelf
    apart = np.hypot(*np.diff(track.position[halts], axis=0).T) > 1.5
    # shuffle duration [s] between two halts of one stay, or of a restarted recorder
    apart |= begin[halts[1:]] - end[halts[:-1]] > 20.0
    # unknown turn sigma [rad] of the turn during a stay where it was not measured
    unseen = 1.2**2 * np.diag([0.0, 0.0, 1.0]) if looks is None else 0.0
    found = list[Stay]()
    for rows in np.split(halts, np.flatnonzero(apart) + 1) if len(halts) else []:
        longest = rows[np.argmax(lasted[rows])]
        heading = track.heading[longest] + (0.0 if looks is None else looks[longest])
        position, covariance = _mean_pose(track, rows, lasted[rows])
        pose = position, float(wrap_angle(heading)), covariance + unseen
        span = float(begin[rows[0]]), float(end[rows[-1]])
        found.append(_stay(*span, False, *pose, track.floor[longest], fronts))
    return [stay for stay in found if _is_long_enough(stay, fronts)]


def _mean_pose(track: Trajectory, rows: Index, weight: Array) -> tuple[Array, Array]:
    """Weighted mean position ``(2,)`` of some rows, and the covariance ``(3, 3)`` of the pose at any of them."""
    share = weight / weight.sum()
    position = share @ track.position[rows]
    off = track.position[rows] - position
    covariance = np.tensordot(share, _covariance(track)[rows], axes=1)
    covariance[:2, :2] += (share * off.T) @ off
    return position, covariance


def _passes(steps: Steps, track: Trajectory, fronts: dict[str, VisiblePlaces]) -> list[Stay]:
    """Slow passes of named places, one for each run of pieces with the same most probable place."""
    found = list[Stay]()
    for numbers in _slow_runs(steps) if fronts else []:
        along = length_along(track.position[numbers + 1])
        cuts = np.unique(np.searchsorted(along, np.arange(PASS_PIECE, along[-1], PASS_PIECE)))
        pieces = np.split(numbers, cuts)
        passed = [_pass_of(steps, piece, track, fronts).facing for piece in pieces]
        likeliest = [facing[0][0] if facing else "" for facing in passed]
        for _, same in groupby(zip(likeliest, pieces, strict=True), key=itemgetter(0)):
            whole = _pass_of(steps, np.concatenate([piece for _name, piece in same]), track, fronts)
            # least named probability that a slow pass led past a named place; otherwise it is just slow
            if _is_long_enough(whole, fronts) and sum(p for _, p in whole.facing) > 0.5:
                found.append(whole)
    return found


def _pass_of(steps: Steps, numbers: Index, track: Trajectory, fronts: dict[str, VisiblePlaces]) -> Stay:
    """The pass of some consecutive steps, by their numbers."""
    rows, first, last = numbers + 1, numbers[0], numbers[-1]
    position, covariance = _mean_pose(track, rows, steps.duration[numbers])
    heading = float(np.angle(np.exp(1j * track.heading[rows]).sum()))
    start, end = float(steps.time[first] - steps.duration[first]), float(steps.time[last])
    return _stay(start, end, True, position, heading, covariance, track.floor[rows[len(rows) // 2]], fronts)


def _slow_runs(steps: Steps) -> list[Index]:
    """Numbers of the steps of each slow run without a halt that lasts SHORTEST_STAY.

    Speeds are those of the steps, which are comparable within a walk; the trajectory is bent by other measurements.
    """
    under_way = np.concatenate([[0.0], np.cumsum(steps.duration)])
    walking = ~steps.is_gap
    if under_way[-1] < PASS_SPEED_WINDOW or not walking.any():
        return []
    way = np.concatenate([[0.0], np.cumsum(steps.length)])
    before, after = (np.clip(under_way[1:] + side * PASS_SPEED_WINDOW / 2, 0.0, under_way[-1]) for side in (-1, 1))
    speed = (np.interp(after, under_way, way) - np.interp(before, under_way, way)) / (after - before)
    # usual speed quantile of a walk's speeds, since much of the walk may be slow
    # slow share of the usual speed: people stroll at 0.8 of it and browse at half of it
    slow = np.flatnonzero(walking & (speed < 0.7 * np.quantile(speed[walking], 0.75)))
    halted = (steps.time - steps.duration - row_times(steps)[:-2] > SHORTEST_HALT)[slow[1:]]
    split_at_gaps = np.split(slow, np.flatnonzero((np.diff(slow) > 1) | halted) + 1)
    return [numbers for numbers in split_at_gaps if steps.duration[numbers].sum() >= SHORTEST_STAY]
