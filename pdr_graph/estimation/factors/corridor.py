"""Directions of straight runs along corridors.

A corridor is where walls on both sides of the walk are parallel to it, so that only the walls near the walk are
examined: the cost depends on its length, not on the floor, and no network is needed. Runs are associated along one
walk; the association is data, and the factor never searches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.columns import OneLineRepr
from pdr_graph.estimation.factors.base import FactorBlock, Measurement
from pdr_graph.estimation.factors.heading_prior import heading_block
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.cells import STRAY
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.geometry import interpolate, length_along, unit, wrap_angle
from pdr_graph.types import Array, Headings, Index, Mask

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Evaluation

SIGMA_SIDE = 0.3  # of a corridor's width, lateral position at either end of a run; 1/√12 if uniformly distributed
SIGMA_AHEAD = 0.03  # [rad] between the line from end to end of a run and the keyframe's dead-reckoned heading


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
class Track:
    """A walk on one floor.

    position: ``(n, 2)`` [m] and piece ``(n,)`` of those that moved; keyframe_piece: ``(k + 1,)`` that ends at each
    keyframe; heading: ``(k + 1,)`` there [rad].
    """

    position: Array
    piece: Index
    keyframe_piece: Index
    heading: Array

    @classmethod
    def of(cls, at: Evaluation, begin: int, end: int) -> Track:
        """The walk ``at``, pieces [begin, end)."""
        moved = begin + np.flatnonzero(at.pieces.length[begin:end] > 0)
        return cls(at.ends[moved, :2], moved, np.append(-1, at.pieces.last), at.state.poses[:, 2])

    def keyframe(self, first: int, last: int) -> int | None:
        """The keyframe nearest to the middle of places ``first`` to ``last``; None if there is none between them."""
        nearest = int(np.argmin(np.abs(self.keyframe_piece - self.piece[(first + last + 1) // 2])))
        return nearest if self.piece[first] <= self.keyframe_piece[nearest] <= self.piece[last] else None

    def aside(self, keyframe: int, begin: int, end: int) -> float:
        """Angle [rad] of a keyframe's heading to the left of the line between two places."""
        along = self.position[end] - self.position[begin]
        return float(wrap_angle(self.heading[keyframe] - np.arctan2(along[1], along[0])))


@dataclass(frozen=True, eq=False)
class CorridorFactor(Measurement):
    """Directions of straight runs.

    floor_sequence: the floor of each piece; keyframe: ``(r,)`` in each run; direction: its heading.
    """

    floor_sequence: FloorSequence
    keyframe: Index
    direction: Headings

    name: ClassVar[str] = "corridors"
    on_plan: ClassVar[bool] = True

    @classmethod
    def about(cls, floor_sequence: FloorSequence) -> CorridorFactor:
        """The corridors of the floors that a walk is on, associated with none of its runs yet."""
        return cls(floor_sequence, np.empty(0, dtype=np.intp), Headings.none())

    def associated(self, at: Evaluation, stray: Array | float = STRAY, alike: float = 1.0) -> Self:
        """Match the straight runs of the walk ``at``."""
        rows = list[tuple[int, float, float]]()
        for floor, begin, end in self.floor_sequence.spans:
            track = Track.of(at, begin, end)
            rows += [row for run in straight_runs(track.position, floor.distance) if (row := _heading(track, run))]
        keyframe, direction, sigma = np.array(rows).reshape(-1, 3).T
        numbers = keyframe.astype(np.intp)
        return replace(self, keyframe=numbers, direction=Headings(at.chain.time[numbers], direction, sigma))

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One heading for each run."""
        number = at.state.number("x")[self.keyframe]
        return [heading_block(self.name, at, self.keyframe, self.direction, number)]


def straight_runs(track: Array, walls: DistanceField) -> list[Run]:
    """The long straight runs along corridors of a walk through places ``track (n, 2)`` [m]."""
    if len(track) < 2:
        return []
    walked = length_along(track)
    beside = _walls_beside(track, walked, walls)
    return [run for run in _joined_runs(beside, walked) if _is_corridor(run, track)]


@dataclass(frozen=True)
class _WallsBeside:
    """The walls on both sides of each place ``(n,)``; NaN unless there are some on both.

    direction: of the walls, as walked [rad]; width: between them [m].
    """

    direction: Array
    width: Array


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


def _heading(track: Track, run: Run) -> tuple[int, float, float] | None:
    """Keyframe, heading and sigma [rad] of a straight run, which leads along its corridor from end to end.

    None if the run has no keyframe.
    """
    first, last = run.first, run.last - 1
    keyframe = track.keyframe(first, last)
    if keyframe is None:
        return None
    length = float(np.hypot(*(track.position[last] - track.position[first])))
    sigma = np.hypot(np.sqrt(2) * SIGMA_SIDE * run.width / length, np.hypot(SIGMA_AHEAD, run.spread))
    return keyframe, float(wrap_angle(run.direction + track.aside(keyframe, first, last))), float(sigma)
