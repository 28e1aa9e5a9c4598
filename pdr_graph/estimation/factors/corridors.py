"""The links that a plan draws as factors: directions of straight runs along links, and turns from link to link.

A turn has two bounds: [map-matching] Eq. (6) limits its angle, from one corridor into the other; and it happens in the
intersection, between the walls of both corridors. The residual is zero within the bounds and linear outside. Runs and
turns are associated with links and intersections along one walk; the association is data, and the factors never search.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
import shapely

from pdr_graph.errors import percent
from pdr_graph.estimation.factors.base import AnyArray, FactorBlock, Linearized, OnPlan, Remembered, RobustLoss
from pdr_graph.estimation.factors.gnss_bias import GnssBias
from pdr_graph.estimation.factors.heading_prior import heading_block
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.network import Lines, Network, nearest_segments
from pdr_graph.floor.paths import PathNetwork, match
from pdr_graph.geometry import interpolate, length_along, nearest, pose_rotation, turn_between, wrap_angle
from pdr_graph.priors import CORRIDOR, FIXES, REPORTS, TURNS, VERDICTS, WAYS
from pdr_graph.types import INSTANT, KEYFRAME, Array, Contradiction, Headings, Index, Mask

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Chain, Evaluation
    from pdr_graph.estimation.linear_system import Solution

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
class Run:
    """A straight run along links.

    first, last: its places [first, last); direction: of the corridor, as walked [rad]; width: of the corridor [m];
    spread: standard deviation of the direction of its links [rad].
    """

    first: int
    last: int
    direction: float
    width: float
    spread: float


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

    def time(self, at: Evaluation) -> Array:
        """Times ``(n,)`` of the places. [s]"""
        return at.chain.time[at.pieces.interval[self.piece]] + at.pieces.to_end[1, self.piece]

    def keyframe(self, first: int, last: int) -> int | None:
        """The keyframe nearest to the middle of places ``first`` to ``last``; None if there is none between them."""
        nearest = int(np.argmin(np.abs(self.keyframe_piece - self.piece[(first + last + 1) // 2])))
        return nearest if self.piece[first] <= self.keyframe_piece[nearest] <= self.piece[last] else None

    def aside(self, keyframe: int, begin: int, end: int) -> float:
        """Angle [rad] of a keyframe's heading to the left of the line between two places."""
        along = self.position[end] - self.position[begin]
        return float(wrap_angle(self.heading[keyframe] - np.arctan2(along[1], along[0])))


@dataclass(frozen=True, eq=False)
class CorridorFactor(OnPlan):
    """Directions of straight runs.

    floor_sequence: the floor of each piece; keyframe: ``(r,)`` in each run; direction: its heading.
    """

    floor_sequence: FloorSequence
    keyframe: Index = field(metadata=KEYFRAME)
    direction: Headings

    name: ClassVar[str] = "corridors"

    @classmethod
    def about(cls, floor_sequence: FloorSequence) -> CorridorFactor:
        """The corridors of the floors that a walk is on, associated with none of its runs yet."""
        return cls(floor_sequence, np.empty(0, dtype=np.intp), Headings.none())

    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Match the straight runs of the walk ``at``."""
        spans = ((floor.network, Track.of(at, begin, end)) for floor, begin, end in self.floor_sequence.spans)
        rows = [row for network, track in spans for row in directions_of(track, straight_runs(track.position, network))]
        keyframe, direction = _headings(at, rows)
        return replace(self, keyframe=keyframe, direction=direction)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """One heading for each run."""
        number = at.state.number("x")[self.keyframe]
        return [heading_block(self.name, at, self.keyframe, self.direction, number)]


def directions_of(track: Track, runs: Sequence[Run]) -> Iterator[tuple[int, float, float]]:
    """Keyframe, heading there [rad] and its sigma [rad] of each run that has a keyframe."""
    for run in runs:  # along its corridor from end to end
        first, last = run.first, run.last - 1
        if (keyframe := track.keyframe(first, last)) is None:
            continue
        length = float(np.hypot(*(track.position[last] - track.position[first])))
        sigma = np.hypot(np.sqrt(2) * CORRIDOR.side * run.width / length, np.hypot(CORRIDOR.ahead, run.spread))
        yield keyframe, float(wrap_angle(run.direction + track.aside(keyframe, first, last))), float(sigma)


def _headings(at: Evaluation, rows: Sequence[tuple[int, float, float]]) -> tuple[Index, Headings]:
    """Keyframes, and headings there."""
    numbers, direction, sigmas = np.array(rows).reshape(-1, 3).T
    keyframes = numbers.astype(np.intp)
    return keyframes, Headings(at.chain.time[keyframes], direction, sigmas)


def stretches_along(track: Array, network: Lines) -> list[Stretch]:
    """The links that a walk through places ``track (n, 2)`` [m] follows, in order of time."""
    if len(track) < 2 or not len(network):
        return []
    segments, step, walked = network.segments, np.diff(track, axis=0), length_along(track)
    nearest, cost = nearest_segments(segments, track)
    along = segments.along[nearest]
    bearing = np.arctan2(*(along * np.where(np.sum(step * along, axis=1) < 0, -1, 1)[:, None]).T[::-1])
    link = np.where(cost < CORRIDOR.on_link, segments.link[nearest], -1)
    bends = np.abs(wrap_angle(np.diff(bearing))) > CORRIDOR.straight
    parts = np.split(np.arange(len(link)), np.flatnonzero(bends | (np.diff(link) != 0)) + 1)
    return [
        Stretch(int(part[0]), int(part[-1]) + 2, int(link[part[0]]), bearing[part])
        for part in parts
        if link[part[0]] >= 0 and walked[part[-1] + 1] - walked[part[0]] > CORRIDOR.shortest
    ]


def straight_runs(track: Array, network: Lines) -> list[Run]:
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


@dataclass(frozen=True, eq=False)
class PathFactor(Remembered):
    """Distances of keyframes from the ways that a walk followed outdoors, and directions along these ways:

        r = n (p − a) / (w √m)

    a: a point of the way, n: its normal, w: sigma of a walker across it, m: number of keyframes that share this error.
    Which ways these are is found by `match`; off every way there are no factors.

    network: within reach; route: ``(n, 6)`` time [s], a [m], n and w √m [m] at each place of the matched walk, NaN off
    every way, and after its end; followed: ``(r,)`` keyframes on ways; row: ``(r,)`` of the route at each; along:
    keyframes of directions; direction: there; price: see `WayMatch` [nats]; others: ``(n, 9)`` time [s] and place [m]
    of the matched walk, then `WayMatch.others`.
    """

    network: PathNetwork
    route: Array
    followed: Index
    row: Index
    along: Index
    direction: Headings
    price: float = 0.0
    others: Array = field(default_factory=lambda: np.empty((0, 9)))

    name: ClassVar[str] = "paths"

    @classmethod
    def about(cls, network: PathNetwork) -> Self:
        """The ways around a walk, none of which it follows yet."""
        numbers = np.empty(0, dtype=np.intp)
        return cls(network, np.empty((0, 6)), numbers, numbers, numbers, Headings.none())

    def __len__(self) -> int:
        return len(self.followed)

    @property
    def foot(self) -> Array:
        """Points ``(r, 2)`` of the ways [m]."""
        return self.route[self.row, 1:3]

    def decisions(self) -> dict[str, AnyArray]:
        """The ways that the walk followed, for a walk under way."""
        return {"route": self.route} if len(self.route) else {}

    def continued(self, decisions: Mapping[str, AnyArray]) -> Self:
        """Follow the ways that an earlier part of this walk was matched to, without their directions.

        A run along a way would give its direction again at each match, at another keyframe.
        """
        return replace(self.about(self.network), **decisions)

    def bind(self, chain: Chain) -> Self:
        """Find the keyframes of ``chain`` on ways."""
        row = np.searchsorted(self.route[:, 0], chain.time + INSTANT, side="right") - 1
        followed = np.flatnonzero((row >= 0) & np.isfinite(np.append(self.route[:, 5], np.nan)[row]))
        return replace(self, followed=followed, row=row[followed])

    def outdoors(self, at: Chain) -> Mask:
        """True ``(m,)`` for the pieces of a walk that are on ways, or within a station of one: a door is between."""
        moment = at.time[at.pieces.interval] + at.pieces.to_end[1]
        row = np.searchsorted(self.route[:, 0], moment + INSTANT, side="right") - 1
        on = np.flatnonzero((row >= 0) & np.isfinite(np.append(self.route[:, 5], np.nan)[row]))
        if not len(on):
            return np.zeros(len(moment), dtype=bool)
        walked = np.cumsum(at.pieces.length)
        return np.abs(walked[on][nearest(walked[on], walked)] - walked) <= WAYS.station

    def contradictions(self, at: Evaluation, solution: Solution) -> Sequence[Contradiction]:
        """Sources that are off to one side throughout, as the ways show."""
        found = list[Contradiction]()
        for kind in at.measurements if len(self) else ():
            for name, symbol, row in kind.offsets(at) if isinstance(kind, GnssBias) else ():
                offset = at.state[symbol][row, :2]
                covariance = solution.joint((symbol, np.array([row])))[0, :2, :2]
                size, sigma = float(np.hypot(*offset)), float(np.sqrt(np.trace(covariance) / 2))
                if size > VERDICTS.displaced * sigma:
                    text = f"{name} is off by {size:.0f} ± {sigma:.0f} m throughout, as the ways on which it leads show"
                    found.append(Contradiction(name, "paths", round(size, 1), "m", text, "the receiver, and the ways"))
        return found

    def warnings(self) -> tuple[str, ...]:
        """Warn if other ways, or none, fit about as well."""
        doubtful = self.others[:, 3] > 1 - REPORTS.sure
        if len(time := self.others[doubtful, 0]) == 0 or np.ptp(time) < 2 * WAYS.station / FIXES.walking_speed:
            return ()
        share = percent(float(self.others[doubtful, 3].mean()))
        span = f"between {time[0]:.0f} and {time[-1]:.0f} s"
        return (f"other ways, or none, fit as well {span}: probability {share}, there {percent(doubtful.mean())}",)

    def widened(self, time: Array, position: Array, covariance: Array) -> Array:
        """Covariances ``(n, 2, 2)`` about places ``(n, 2)`` at times ``(n,)``, in which other ways are counted."""
        if not len(self.others):
            return covariance
        place, share, mean, square = np.split(
            interpolate(time, self.others[:, 0], self.others[:, 1:]), [2, 3, 5], axis=1
        )
        off, square = position - place, square[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        cross = mean[:, :, None] * off[:, None, :]
        share = share[:, :, None]
        spread = square - cross - cross.transpose(0, 2, 1) + share * off[:, :, None] * off[:, None, :]
        return (1 - share) * covariance + spread

    def matched(self, at: Evaluation, sigma: Array, askew: Array) -> Self:
        """Find the ways that the walk ``at`` followed. sigma, askew: ``(k + 1,)`` of its keyframes [m, rad]."""
        track = Track.of(at, 0, len(at.pieces.length))
        none = self.about(self.network)
        if len(track.position) < 2 or not len(self.network):
            return none
        keyframe = at.pieces.interval[track.piece] + 1
        way = match(self.network, track.position, sigma[keyframe], askew[keyframe])
        corrected = replace(track, position=track.position + way.displacement)
        found = none._along(at, track, corrected, way.on)
        others = np.column_stack([track.time(at), track.position, way.others])
        return replace(found, price=way.price, others=others)

    def _along(self, at: Evaluation, track: Track, corrected: Track, on: Mask) -> Self:
        """The factors of a walk along the ways on which its places are, once moved there. on: ``(n,)``."""
        time = track.time(at)
        route, directions = np.full((len(time) + 1, 6), np.nan), list[tuple[int, float, float]]()
        route[:, 0] = [*time, at.chain.time[-1] + 2 * INSTANT]
        for begin, end in np.flatnonzero(np.diff(on, prepend=False, append=False)).reshape(-1, 2).tolist():
            part = corrected.position[begin:end]
            runs = straight_runs(part, self.network)
            runs = [replace(run, first=run.first + begin, last=run.last + begin) for run in runs]
            directions += directions_of(track, runs)
            for stretch in stretches_along(part, self.network):
                line = shapely.linestrings(self.network.lines[stretch.link])
                here = slice(stretch.first + begin, stretch.last + begin)
                along = shapely.line_locate_point(line, shapely.points(corrected.position[here]))
                bearing = np.append(stretch.bearing, stretch.bearing[-1])
                route[here, 1:3] = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
                route[here, 3], route[here, 4] = -np.sin(bearing), np.cos(bearing)
                route[here, 5] = self.network.sigma[stretch.link]
        found = replace(self, route=route).bind(at.chain)
        if not len(found):
            return self
        group = (length_along(track.position) // WAYS.alike).astype(np.intp)
        number = np.maximum(np.bincount(group[found.row], minlength=int(group[-1]) + 1), 1)  # with the same error
        route[:-1, 5] *= np.sqrt(number[group])
        along, direction = _headings(at, directions)
        return replace(found, along=along, direction=direction)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """A distance for each keyframe on a way, and a heading for each straight run along it."""
        if not len(self):
            return []
        pose, (normal, sigma) = at.state.poses[self.followed], np.split(self.route[self.row, 3:], [2], axis=1)
        value = np.sum(normal * (pose[:, :2] - self.foot), axis=1, keepdims=True) / sigma

        def jacobian() -> list[Array]:
            by = np.zeros((len(self), 1, 3))
            by[:, 0, :2] = np.einsum("ri,rij->rj", normal, pose_rotation(pose[:, 2])[:, :2, :2])
            return [by / sigma[:, :, None]]

        number, loss = at.state.number("x"), RobustLoss(np.zeros(len(self), dtype=bool))
        variables = [("x", self.followed)]
        return [
            FactorBlock.uniform(self.name, value, variables, jacobian, number[self.followed], loss=loss),
            heading_block(f"{self.name}.direction", at, self.along, self.direction, number[self.along]),
        ]


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
class TurnFactor(OnPlan):
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
            is_turn = TURNS.least < abs(turn_between(into, out_of)) < TURNS.most
            around = walked[after.first] - walked[before.last - 1]
            apart = shapely.distance(shapely.polygons(network.corners[node]), shapely.Point(track[at]))
            if is_turn and around < TURNS.longest and apart < TURNS.at_node:
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
