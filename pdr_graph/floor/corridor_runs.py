"""Straight runs of a walk along corridors, and the turns from one into the next.

The walk is already placed on the floor. A corridor is where walls on both sides of the walk are parallel to it, so that
only the walls near the walk are examined: the cost depends on its length, not on the floor, and no network is needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely

from pdr_graph.columns import OneLineRepr
from pdr_graph.floor.corridor_turns import LEAST_TURN, Turn
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.floor.network import Network
from pdr_graph.geometry import interpolate, length_along, unit, wrap_angle
from pdr_graph.types import Array, Index, Mask


@dataclass(frozen=True)
class RunSettings:
    """Constants by which straight runs are found, chosen by hand.

    chord: length of the walk before and after a place that determines its direction there [m]: that of a zigzag.
    reach: distance of a corridor's wall to either side [m].
    shortest_wall: length of a wall that has a direction [m]: a shorter one is a pillar or a door frame.
    askew: largest angle between walk and walls [rad]: that of a zigzag.
    straight: largest angle between the walls of one corridor [rad]; spread: the same as a standard deviation along a
        run.
    shortest: least length of the walk between walls [m].
    bridged: length of the walk between two parts of one run [m]: across an intersection, past an open shop.
    least_length, least_ratio: least length of a run [m], and in widths of its corridor: a shorter one may cross a
        plaza.
    """

    chord: float = 2.5
    reach: float = 6.0
    shortest_wall: float = 1.0
    askew: float = np.radians(30)
    straight: float = np.radians(10)
    spread: float = np.radians(4)
    shortest: float = 1.5
    bridged: float = 6.0
    least_length: float = 8.0
    least_ratio: float = 3.0


RUN = RunSettings()


@dataclass(frozen=True)
class TurnSettings:
    """Constants by which the turns between runs are found, chosen by hand.

    overlap: number of places at the end or the beginning of a run that may belong to the turn.
    longest: length of the walk from run to run around an intersection [m].
    largest: turn at an intersection [rad]: a larger one is a reversal.
    at_node: distance from an intersection [m].
    """

    overlap: int = 6
    longest: float = 8.0
    largest: float = np.radians(150)
    at_node: float = 2.0


TURN = TurnSettings()


@dataclass(frozen=True)
class Run(OneLineRepr):
    """A straight run along a corridor.

    first, last: its places [first, last); direction: of the corridor, as walked [rad]; width: of the corridor [m];
    spread: standard deviation of the direction of its walls [rad].
    """

    first: int
    last: int
    direction: float
    width: float
    spread: float

    def _summary(self) -> list[str]:
        direction = f"{np.degrees(self.direction):.0f}° ± {np.degrees(self.spread):.1f}°"
        return [f"places {self.first} to {self.last}", direction, f"corridor of {self.width:.1f} m"]


@dataclass(frozen=True)
class _WallsBeside:
    """The walls on both sides of each place ``(n,)``; NaN unless there are some on both.

    direction: of the walls, as walked [rad]; width: between them [m].
    """

    direction: Array
    width: Array


def straight_runs(track: Array, walls: DistanceField) -> list[Run]:
    """The long straight runs along corridors of a walk through places ``track (n, 2)`` [m]."""
    if len(track) < 2:
        return []
    walked = length_along(track)
    beside = _walls_beside(track, walked, walls)
    return [run for run in _joined_runs(beside, walked) if _is_corridor(run, track)]


def turns_between(runs: list[Run], track: Array, network: Network) -> Iterator[tuple[Run, Run, Turn]]:
    """The turns from one run into the next at intersections that have corners.

    ``first`` and ``last`` of a turn are the same place of the track: the turn is at that place.
    """
    for before, after in pairwise(runs):
        angle = abs(float(wrap_angle(after.direction - before.direction)))
        between = np.diff(track[before.last - 1 : after.first + 1], axis=0)
        if LEAST_TURN < angle < TURN.largest and np.hypot(*between.T).sum() < TURN.longest:
            into, out_of = unit(np.array(before.direction)), unit(np.array(after.direction))
            at = _sharpest(track, before, after, into - out_of)
            if (node := _intersection(track[at], network)) is not None:
                come, gone = _link_towards(network, node, -into), _link_towards(network, node, out_of)
                if come is not None and gone is not None:
                    yield before, after, Turn(at, at, node, come, gone, into, out_of)


def _walls_beside(track: Array, walked: Array, walls: DistanceField) -> _WallsBeside:
    """The nearest walls to the left and right of each place that are parallel to the walk."""
    place, wall = walls.walls_near(track, RUN.reach)
    course = interpolate(walked + RUN.chord, walked, track) - interpolate(walked - RUN.chord, walked, track)
    course = np.arctan2(*course.T[::-1])[place]
    along = wall[:, 1] - wall[:, 0]
    length = np.hypot(*along.T)
    askew = wrap_angle(2 * (course - np.arctan2(along[:, 1], along[:, 0]))) / 2
    ahead, to = unit(course), track[place] - wall[:, 0]
    share = np.sum(to * along, axis=1) / np.maximum(length**2, 1e-12)
    foot = np.clip(share, 0.0, 1.0)[:, None] * along - to
    aside = ahead[:, 0] * foot[:, 1] - ahead[:, 1] * foot[:, 0]
    is_beside = np.abs(aside) > np.abs(np.sum(ahead * foot, axis=1))
    parallel = (np.abs(askew) < RUN.askew) & (length > RUN.shortest_wall) & is_beside
    found = [_nearest(place, aside * side, parallel, len(track)) for side in (1, -1)]
    both = (found[0] >= 0) & (found[1] >= 0)
    left, right = (f[both] for f in found)
    apart = wrap_angle(2 * (askew[left] - askew[right])) / 2
    weight = length[left] / (length[left] + length[right])
    direction, width = np.full(len(track), np.nan), np.full(len(track), np.nan)
    direction[both] = np.where(np.abs(apart) < RUN.straight, course[right] - askew[right] - weight * apart, np.nan)
    width[both] = aside[left] - aside[right]
    return _WallsBeside(wrap_angle(direction), width)


def _nearest(place: Index, distance: Array, parallel: Mask, places: int) -> Index:
    """The pair ``(places,)`` of each place with its nearest parallel wall at a positive distance; −1 if none."""
    pairs = np.flatnonzero(parallel & (distance > 0))
    pairs = pairs[np.argsort(-distance[pairs])]  # assignment below keeps the last pair of a place, the nearest
    nearest = np.full(places, -1)
    nearest[place[pairs]] = pairs
    return nearest


def _joined_runs(beside: _WallsBeside, walked: Array) -> Iterator[Run]:
    """Runs of consecutive places between walls of one direction."""
    turned = np.abs(wrap_angle(np.diff(beside.direction, prepend=np.nan)))
    begins = np.flatnonzero(~(turned < RUN.straight))
    parts = np.split(np.arange(len(walked)), begins[begins > 0])
    long = [p for p in parts if not np.isnan(beside.direction[p[0]]) and walked[p[-1]] - walked[p[0]] > RUN.shortest]
    run = list[Index]()
    for part in long:
        if run and not _continues(beside, walked, run[-1][-1], part[0]):
            yield _run(beside, np.concatenate(run))
            run.clear()
        run.append(part)
    if run:
        yield _run(beside, np.concatenate(run))


def _continues(beside: _WallsBeside, walked: Array, last: int, first: int) -> bool:
    """True if the part that ends at place ``last`` and the one that begins at ``first`` are one run."""
    bend = abs(float(wrap_angle(beside.direction[first] - beside.direction[last])))
    return bend < RUN.straight and walked[first] - walked[last] < RUN.bridged


def _run(beside: _WallsBeside, places: Index) -> Run:
    direction = beside.direction[places]
    mean = float(np.angle(np.mean(np.exp(1j * direction))))
    spread = float(np.sqrt(np.mean(wrap_angle(direction - mean) ** 2)))
    return Run(int(places[0]), int(places[-1]) + 1, mean, float(np.median(beside.width[places])), spread)


def _is_corridor(run: Run, track: Array) -> bool:
    """True if a run is long enough, and its walls are straight enough, for a corridor."""
    length = float(np.hypot(*(track[run.last - 1] - track[run.first])))
    return length > max(RUN.least_length, RUN.least_ratio * run.width) and run.spread < RUN.spread


def _sharpest(track: Array, before: Run, after: Run, direction: Array) -> int:
    """The place between two runs, or at their ends, that is farthest in a direction ``(2,)``."""
    begin, end = max(before.last - TURN.overlap, before.first), min(after.first + TURN.overlap, after.last)
    return begin + int(np.argmax(track[begin:end] @ direction))


def _intersection(place: Array, network: Network) -> int | None:
    """The node of an intersection with corners within 2 m of a place ``(2,)``; None if there is none."""
    cornered = np.flatnonzero(~np.isnan(network.corners[:, 0, 0]))
    if not len(cornered):
        return None
    apart = shapely.distance(shapely.polygons(network.corners[cornered]), shapely.Point(place))
    return int(cornered[np.argmin(apart)]) if np.min(apart) < TURN.at_node else None


def _link_towards(network: Network, node: int, direction: Array) -> int | None:
    """The link that leaves a node in a direction ``(2,)``; None if there is none."""
    for link in network.links_at(node).tolist():
        ahead = np.diff(network.leaving(link, node)[:2], axis=0)[0]
        if ahead @ direction > np.cos(RUN.askew) * np.hypot(*ahead):
            return link
    return None
