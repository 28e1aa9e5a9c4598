"""The corridor network of a plan as factors: directions of straight runs along links, and turns from link to link.

A turn has two bounds: [map-matching] Eq. (6) limits its angle, from one corridor into the other; and it happens in the
intersection, between the walls of both corridors. The residual is zero within the bounds and linear outside. Runs and
turns are associated with links and intersections along one walk; the association is data, and the factors never search.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
import shapely

from pdr_graph.estimation.factors.base import FactorBlock, Linearized, Measurement
from pdr_graph.estimation.factors.heading_prior import heading_block
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.network import Network, Segments, segment_costs
from pdr_graph.geometry import length_along, turn_between, wrap_angle
from pdr_graph.priors import CORRIDOR, TURNS
from pdr_graph.types import Array, Headings, Index, OneLineRepr

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Evaluation

LEAST_LENGTH, LEAST_RATIO = 8.0, 3.0  # of a run [m], and in widths of its corridor: a shorter one may cross a plaza


@dataclass(frozen=True)
class Stretch:
    """A straight part of a walk along one link.

    first, last: its places [first, last); bearing: ``(s,)`` of the link at each step, as walked [rad].
    """

    first: int
    last: int
    link: int
    bearing: Array


@dataclass(frozen=True)
class Run(OneLineRepr):
    """A straight run along links.

    first, last: its places [first, last); direction: of the corridor, as walked [rad]; width: of the corridor [m];
    spread: standard deviation of the direction of its links [rad].
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

    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Match the straight runs of the walk ``at``."""
        rows = list[tuple[int, float, float]]()
        for floor, begin, end in self.floor_sequence.spans:
            track = Track.of(at, begin, end)
            for run in straight_runs(track.position, floor.network):  # along its corridor from end to end
                first, last = run.first, run.last - 1
                if (keyframe := track.keyframe(first, last)) is None:
                    continue
                length = float(np.hypot(*(track.position[last] - track.position[first])))
                sigma = np.hypot(np.sqrt(2) * CORRIDOR.side * run.width / length, np.hypot(CORRIDOR.ahead, run.spread))
                rows.append((keyframe, float(wrap_angle(run.direction + track.aside(keyframe, first, last))), sigma))
        numbers, direction, sigmas = np.array(rows).reshape(-1, 3).T
        keyframes = numbers.astype(np.intp)
        return replace(self, keyframe=keyframes, direction=Headings(at.chain.time[keyframes], direction, sigmas))

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One heading for each run."""
        number = at.state.number("x")[self.keyframe]
        return [heading_block(self.name, at, self.keyframe, self.direction, number)]


def stretches_along(track: Array, network: Network) -> list[Stretch]:
    """The links that a walk through places ``track (n, 2)`` [m] follows, in order of time."""
    if len(track) < 2 or not len(network):
        return []
    segments, step, walked = Segments.of(network), np.diff(track, axis=0), length_along(track)
    cost = segment_costs(segments, track[:-1], track[1:])
    nearest = cost.argmin(axis=1)
    along = segments.along[nearest]
    bearing = np.arctan2(*(along * np.where(np.sum(step * along, axis=1) < 0, -1, 1)[:, None]).T[::-1])
    link = np.where(cost.min(axis=1) < CORRIDOR.on_link, segments.link[nearest], -1)
    bends = np.abs(wrap_angle(np.diff(bearing))) > CORRIDOR.straight
    parts = np.split(np.arange(len(link)), np.flatnonzero(bends | (np.diff(link) != 0)) + 1)
    return [
        Stretch(int(part[0]), int(part[-1]) + 2, int(link[part[0]]), bearing[part])
        for part in parts
        if link[part[0]] >= 0 and walked[part[-1] + 1] - walked[part[0]] > CORRIDOR.shortest
    ]


def straight_runs(track: Array, network: Network) -> list[Run]:
    """The long straight runs of a walk through places ``track (n, 2)`` [m] along the links of a network."""
    walked, groups = length_along(track), list[list[Stretch]]()
    for stretch in stretches_along(track, network):
        before = groups[-1][-1] if groups else stretch
        bend = abs(float(wrap_angle(stretch.bearing[0] - before.bearing[-1])))
        near = walked[stretch.first] - walked[before.last - 1] < CORRIDOR.bridged
        if groups and bend < CORRIDOR.straight and near:
            groups[-1].append(stretch)
        else:
            groups.append([stretch])
    runs = list[Run]()
    for parts in groups:
        bearing, (first, last) = np.concatenate([part.bearing for part in parts]), (parts[0].first, parts[-1].last)
        mean = float(np.angle(np.mean(np.exp(1j * bearing))))
        spread = float(np.sqrt(np.mean(wrap_angle(bearing - mean) ** 2)))
        width = float(np.median(network.width[[part.link for part in parts]]))
        length = float(np.hypot(*(track[last - 1] - track[first])))
        if length > max(LEAST_LENGTH, LEAST_RATIO * width) and spread < CORRIDOR.spread:
            runs.append(Run(first, last, mean, width, spread))
    return runs


@dataclass(frozen=True)
class Turn:
    """A turn between two links.

    first, at, last: places of the walk where it enters the link before the turn, turns, and leaves the link after it;
    into, out_of: unit vectors ``(2,)`` along the links, towards the intersection and away from it; corners: ``(4, 2)``
    of the intersection, counter-clockwise [m].
    """

    first: int
    at: int
    last: int
    into: Array
    out_of: Array
    corners: Array


@dataclass(frozen=True, eq=False)
class TurnFactor(Measurement):
    """Turns of a walk at intersections, ``t`` of them.

    floor_sequence: the floor of each piece; before, after: ``(t,)`` keyframes on either side; least, most: ``(t,)``
    heading change from the one to the other, counter-clockwise [rad]; piece: ``(t,)`` of the walk that ends where it
    turns; normal: ``(t, 4, 2)`` outward of the sides of the intersection; edge: ``(t, 4)`` how far along these the
    sides are [m].
    """

    floor_sequence: FloorSequence
    before: Index
    after: Index
    least: Array
    most: Array
    piece: Index
    normal: Array
    edge: Array

    name: ClassVar[str] = "turns"
    on_plan: ClassVar[bool] = True

    @classmethod
    def about(cls, floor_sequence: FloorSequence) -> Self:
        """The networks of the floors that a walk is on, associated with none of its turns yet."""
        none, numbers = np.empty(0), np.empty(0, dtype=np.intp)
        return cls(floor_sequence, numbers, numbers, none, none, numbers, np.empty((0, 4, 2)), np.empty((0, 4)))

    def __len__(self) -> int:
        return len(self.piece)

    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Match the turns of the walk ``at``."""
        rows = list[tuple[int, int, float, float, int, Array, Array]]()
        for floor, begin, end in self.floor_sequence.spans:
            track = Track.of(at, begin, end)
            rows += [row for turn in turns_along(track.position, floor.network) if (row := _bounds(track, turn))]
        if not rows:
            return self.about(self.floor_sequence)
        before, after, least, most, piece, normal, edge = (np.array(column) for column in zip(*rows, strict=True))
        return replace(self, before=before, after=after, least=least, most=most, piece=piece, normal=normal, edge=edge)

    def heading_change(self, heading: Array) -> tuple[Array, Array]:
        """Residual ``(t,)`` of the heading change between keyframes ``(k + 1,)``, and its derivative:

            r = [ max(0, δ − β) − max(0, α − δ) ] / σ,      δ = θ_after − θ_before

        The derivative is by θ_after; by θ_before it is the opposite.
        """
        off = wrap_angle(heading[self.after] - heading[self.before] - (self.least + self.most) / 2)
        beyond = np.maximum(np.abs(off) - (self.most - self.least) / 2, 0.0)
        return np.sign(off) * beyond / TURNS.turned, (beyond > 0) / TURNS.turned

    def outside(self, turning: Linearized) -> Linearized:
        """Residual ``(t, 4)`` of each turn beyond the sides of its intersection: r = max(0, n p − e) / σ.

        For a rectangular intersection the squares add up to that of the distance. turning: poses of the pieces that
        turn.
        """
        beyond = np.einsum("tsk,tk->ts", self.normal, turning.value[:, :2]) - self.edge
        slope = np.zeros((*beyond.shape, 3))
        slope[:, :, :2] = self.normal * (beyond > 0)[:, :, None] / TURNS.place
        value = np.maximum(beyond, 0.0) / TURNS.place
        return Linearized(value, slope @ turning.by_i, slope @ turning.by_j, slope @ turning.by_c)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the heading changes, and of the places of the turns."""
        if not len(self):
            return []
        value, slope = self.heading_change(at.state.poses[:, 2])
        place, interval = self.outside(at.poses_of(self.piece)), at.pieces.interval[self.piece]
        number = at.chain.number[self.after]

        def by_headings() -> list[Array]:
            by = np.zeros((len(self), 1, 3))
            by[:, 0, 2] = slope
            return [-by, by]

        return [
            FactorBlock.uniform(
                f"{self.name}.angle",
                value[:, None],
                [("x", self.before), ("x", self.after)],
                by_headings,
                number,
            ),
            FactorBlock.uniform(
                f"{self.name}.place",
                place.value,
                [("x", interval), ("x", interval + 1), ("c", at.chain.segment[interval])],
                lambda: [place.by_i, place.by_j, place.by_c],
                number,
            ),
        ]


def turns_along(track: Array, network: Network) -> Iterator[Turn]:
    """The turns of a walk through places ``track (n, 2)`` [m], at intersections that have corners."""
    walked = length_along(track)
    for before, after in pairwise(stretches_along(track, network)):
        shared = np.intersect1d(network.links[before.link], network.links[after.link])
        for node in shared[~np.isnan(network.corners[shared, 0, 0])].tolist():
            into, out_of = -network.direction(before.link, node), network.direction(after.link, node)
            low, high = max(before.last - TURNS.overlap, before.first), min(after.first + TURNS.overlap, after.last)
            at = low + int(np.argmax(track[low:high] @ (into - out_of)))  # the sharpest
            turned, around = abs(turn_between(into, out_of)), walked[after.first] - walked[before.last - 1]
            apart = shapely.distance(shapely.polygons(network.corners[node]), shapely.Point(track[at]))
            if (
                before.link != after.link
                and TURNS.least < turned < TURNS.most
                and around < TURNS.longest
                and apart < TURNS.at_node
            ):
                yield Turn(before.first, at, after.last - 1, into, out_of, network.corners[node])


def range_of_turn(into: Array, out_of: Array, corners: Array, before: float, after: float) -> tuple[float, float]:
    """α and β of [map-matching] Eq. (6): least and greatest angle of a turn, counter-clockwise, the lower first. [rad]

    into, out_of: unit vectors ``(2,)`` along the links; corners: ``(4, 2)`` of the intersection; before, after: length
    of the walk along the links before and after the turn [m]; the paper uses the whole corridor from one intersection
    to the next. α is that of a path out-in-out: from the outer wall past the inner corner to the outer wall. β is that
    of a path in-out-in.
    """
    bearing = (corners - corners.mean(axis=0)) @ (out_of - into)
    inner, outer = corners[np.argmax(bearing)], corners[np.argmin(bearing)]

    def wall(side: Array, along: Array, reach: float) -> Array:
        return side + (inner - side) @ along * along + reach * along

    def turned(side: Array, by: Array) -> float:
        return turn_between(by - wall(side, into, -before), wall(side, out_of, after) - by)

    least, most = sorted((turned(outer, inner), turned(inner, outer)))
    return least, most


def _bounds(track: Track, turn: Turn) -> tuple[int, int, float, float, int, Array, Array] | None:
    """The bounds of one turn, by [map-matching] Eq. (6) along the stretches before and after it.

    None if a stretch has no keyframe.
    """
    i, j = track.keyframe(turn.first, turn.at), track.keyframe(turn.at, turn.last)
    if i is None or j is None:
        return None
    come, gone = (float(np.hypot(*(track.position[turn.at] - track.position[n]))) for n in (turn.first, turn.last))
    aside = track.aside(j, turn.at, turn.last) - track.aside(i, turn.first, turn.at)
    least, most = np.array(range_of_turn(turn.into, turn.out_of, turn.corners, come, gone)) + aside
    side = np.roll(turn.corners, -1, axis=0) - turn.corners
    normal = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.hypot(*side.T)[:, None]
    return i, j, float(least), float(most), int(track.piece[turn.at]), normal, np.sum(normal * turn.corners, axis=1)
