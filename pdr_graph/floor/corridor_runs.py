"""Straight runs of a walk along corridors, and the turns from one into the next.

The walk is already laid on the floor, and only the walls beside it are asked: a corridor is where there are some on
either side that lead the same way. So a run costs what the walk is long, however large the floor, and no network.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely

from pdr_graph.floor.corridor_turns import LEAST_TURN, Turn
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.floor.network import Network
from pdr_graph.geometry import interpolate, length_along, unit, wrap_angle
from pdr_graph.types import Array, Index, Mask

CHORD = 2.5  # [m] before and after a place that tell which way one walks there: the length of a zigzag
REACH = 6.0  # [m] to the wall of a corridor on either side: one still walks along it
LEAST_WALL = 1.0  # [m] of wall that tells a direction: less is a pillar or a door frame
ASKEW = np.radians(30)  # from a corridor's direction: as `corridor_turns.ASKEW`
STRAIGHT = np.radians(10)  # between walls of one corridor
CROOKED = np.radians(4)  # by which walls along a run differ: more, and it is no straight corridor
SHORTEST = 1.5  # [m] of walk along walls, or they are only passed
BRIDGED = 6.0  # [m] of walk between two parts of one run: across an intersection, past an open shop
LEAST_LENGTH, LEAST_RATIO = 8.0, 3.0  # [m] of a run, and widths of its corridor: a shorter one may lead across a plaza
IN_TURN = 6  # places of a run, before its end or after its begin, that may be in the turn already
MOST_CORNER = 8.0  # [m] of walk from run to run about an intersection
MOST_TURN = np.radians(150)  # at an intersection: back is a turn of its own kind
AT_NODE = 2.0  # [m] from an intersection at which a turn is one of it


@dataclass(frozen=True)
class Run:
    """A straight run.

    first, last: its places [first, last); direction: of the corridor, as walked [rad]; width: of the corridor [m];
    crooked: by how much its walls differ in direction [rad].
    """

    first: int
    last: int
    direction: float
    width: float
    crooked: float


@dataclass(frozen=True)
class _Beside:
    """The walls on both sides of each place. direction: of both, as walked [rad]; width [m]; NaN where not on both."""

    direction: Array
    width: Array


def straight_runs(track: Array, walls: DistanceField) -> list[Run]:
    """The runs of a walk through places ``track (n, 2)`` [m] that are straight, long, and in a corridor."""
    if len(track) < 2:
        return []
    walked = length_along(track)
    beside = _walls_beside(track, walked, walls)
    return [run for run in _joined(beside, walked) if _is_corridor(run, track)]


def turns_between(runs: list[Run], track: Array, network: Network) -> Iterator[tuple[Run, Run, Turn]]:
    """The turns at intersections with corners, from one of the ``runs`` straight into the next.

    Their steps [first, last) are counted in places of the track; none are in it: one turns at a place.
    """
    for before, after in pairwise(runs):
        angle = abs(float(wrap_angle(after.direction - before.direction)))
        between = np.diff(track[before.last - 1 : after.first + 1], axis=0)
        if LEAST_TURN < angle < MOST_TURN and np.hypot(*between.T).sum() < MOST_CORNER:
            into, out_of = unit(np.array(before.direction)), unit(np.array(after.direction))
            at = _sharpest(track, before, after, into - out_of)
            if (node := _intersection(track[at], network)) is not None:
                come, gone = _leaving(network, node, -into), _leaving(network, node, out_of)
                if come is not None and gone is not None:
                    yield before, after, Turn(at, at, node, come, gone, into, out_of)


def _walls_beside(track: Array, walked: Array, walls: DistanceField) -> _Beside:
    """Of the walls that lead the way one walks, the nearest to the left and to the right of each place."""
    place, wall = walls.walls_near(track, REACH)
    course = interpolate(walked + CHORD, walked, track) - interpolate(walked - CHORD, walked, track)
    course = np.arctan2(*course.T[::-1])[place]
    leading = wall[:, 1] - wall[:, 0]
    length = np.hypot(*leading.T)
    askew = wrap_angle(2 * (course - np.arctan2(leading[:, 1], leading[:, 0]))) / 2
    ahead, to = unit(course), track[place] - wall[:, 0]
    share = np.sum(to * leading, axis=1) / np.maximum(length**2, 1e-12)
    foot = np.clip(share, 0.0, 1.0)[:, None] * leading - to
    aside = ahead[:, 0] * foot[:, 1] - ahead[:, 1] * foot[:, 0]
    leads = (np.abs(askew) < ASKEW) & (length > LEAST_WALL) & (np.abs(aside) > np.abs(np.sum(ahead * foot, axis=1)))
    found = [_nearest(place, aside * side, leads, len(track)) for side in (1, -1)]
    both = (found[0] >= 0) & (found[1] >= 0)
    left, right = (f[both] for f in found)
    apart = wrap_angle(2 * (askew[left] - askew[right])) / 2
    weight = length[left] / (length[left] + length[right])
    direction, width = np.full(len(track), np.nan), np.full(len(track), np.nan)
    direction[both] = np.where(np.abs(apart) < STRAIGHT, course[right] - askew[right] - weight * apart, np.nan)
    width[both] = aside[left] - aside[right]
    return _Beside(wrap_angle(direction), width)


def _nearest(place: Index, away: Array, counts: Mask, places: int) -> Index:
    """Of the pairs that count and lie to this side, which is nearest to each place ``(places,)``; −1 none."""
    pairs = np.flatnonzero(counts & (away > 0))
    pairs = pairs[np.argsort(-away[pairs])]  # the last written is the nearest
    nearest = np.full(places, -1)
    nearest[place[pairs]] = pairs
    return nearest


def _joined(beside: _Beside, walked: Array) -> Iterator[Run]:
    """Places between walls of one direction, one after the other, as runs."""
    turned = np.abs(wrap_angle(np.diff(beside.direction, prepend=np.nan)))
    begins = np.flatnonzero(~(turned < STRAIGHT))
    parts = np.split(np.arange(len(walked)), begins[begins > 0])
    in_one = [p for p in parts if not np.isnan(beside.direction[p[0]]) and walked[p[-1]] - walked[p[0]] > SHORTEST]
    run = list[Index]()
    for part in in_one:
        if run and not _continues(beside, walked, run[-1][-1], part[0]):
            yield _run(beside, np.concatenate(run))
            run.clear()
        run.append(part)
    if run:
        yield _run(beside, np.concatenate(run))


def _continues(beside: _Beside, walked: Array, last: int, first: int) -> bool:
    """Whether a run that was between walls up to a place goes on at the next that is between any."""
    bend = abs(float(wrap_angle(beside.direction[first] - beside.direction[last])))
    return bend < STRAIGHT and walked[first] - walked[last] < BRIDGED


def _run(beside: _Beside, places: Index) -> Run:
    direction = beside.direction[places]
    mean = float(np.angle(np.mean(np.exp(1j * direction))))
    crooked = float(np.sqrt(np.mean(wrap_angle(direction - mean) ** 2)))
    return Run(int(places[0]), int(places[-1]) + 1, mean, float(np.median(beside.width[places])), crooked)


def _is_corridor(run: Run, track: Array) -> bool:
    length = float(np.hypot(*(track[run.last - 1] - track[run.first])))
    return length > max(LEAST_LENGTH, LEAST_RATIO * run.width) and run.crooked < CROOKED


def _sharpest(track: Array, before: Run, after: Run, back: Array) -> int:
    """The place between two runs, or in their ends, that lies furthest in the direction ``back (2,)``."""
    begin, end = max(before.last - IN_TURN, before.first), min(after.first + IN_TURN, after.last)
    return begin + int(np.argmax(track[begin:end] @ back))


def _intersection(place: Array, network: Network) -> int | None:
    """The intersection with corners that a place ``(2,)`` lies in or at."""
    cornered = np.flatnonzero(~np.isnan(network.corners[:, 0, 0]))
    if not len(cornered):
        return None
    apart = shapely.distance(shapely.polygons(network.corners[cornered]), shapely.Point(place))
    return int(cornered[np.argmin(apart)]) if np.min(apart) < AT_NODE else None


def _leaving(network: Network, node: int, way: Array) -> int | None:
    """The link that leaves a node in a direction ``(2,)``."""
    for link in network.links_at(node).tolist():
        ahead = np.diff(network.leaving(link, node)[:2], axis=0)[0]
        if ahead @ way > np.cos(ASKEW) * np.hypot(*ahead):
            return link
    return None
