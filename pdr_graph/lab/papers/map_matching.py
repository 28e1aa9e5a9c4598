"""[map-matching]: projection on links, and the correction by (R_d, R_s), which keeps the shape of the track.

R_d multiplies every heading change (Eq. 4), R_s every length (Eq. 5). The feasible region is the set of pairs that keep
the walk within its corridors (Secs. 3.2–3.6). A stretch is the part of a walk from one turn to the end of the next; a
calibration (R_d, R_s) is estimated for each (Secs. 3.4, 3.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pdr_graph.errors import count
from pdr_graph.estimation.factors.corridors import range_of_turn
from pdr_graph.floor.network import Network, Segments, segment_costs
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import courses, row_times, turn_between, unit, wrap_angle
from pdr_graph.priors import TURNS
from pdr_graph.types import STEP_COLUMNS, Array, Index, Mask, OneLineRepr, Steps, Trajectory

TURNING = np.radians(10)  # heading change of a step above which the walker is turning: gait sways by up to 7°
AROUND = 8  # [steps] before and after a turn that determine its links: the length of a zigzag; chosen by hand


@dataclass(frozen=True)
class Turn(OneLineRepr):
    """A turn from one link into another.

    first, last: steps [first, last) of the turn; node: of the network; before, after: the links; into, out_of: unit
    vectors ``(2,)`` along the links towards the node and away from it.
    """

    first: int
    last: int
    node: int
    before: int
    after: int
    into: Array
    out_of: Array

    def _summary(self) -> list[str]:
        angle = np.degrees(turn_between(self.into, self.out_of))
        return [f"steps {self.first} to {self.last}", f"node {self.node}", f"{angle:.0f}°"]


def link_costs(segments: Segments, start: Array, end: Array) -> Array:
    """Cost ``(n, l)`` of assigning each step to each link: that of the best segment of a bent link."""
    begins = np.flatnonzero(np.diff(segments.link, prepend=-1))
    return np.minimum.reduceat(segment_costs(segments, start, end), begins, axis=1)


def straightened(steps: Steps) -> Steps:
    """Set the heading changes between turns to 0, as in the dead reckoning of [map-matching] Sec. 3.2.

    This removes the gyroscope's drift and the sway of the hips between turns, but also a slow bend of a corridor. The
    paper drops every heading change below a threshold; here a small one within a turn is part of it and stays.
    """
    turning, beside = np.abs(steps.turn) > TURNING, 3  # [steps] before and after one that turns; chosen by hand
    near = np.convolve(turning, np.ones(2 * beside + 1), "full")[beside:-beside] > 0 if len(steps) else turning
    return replace(steps, turn=np.where(near, steps.turn, 0.0), pause_turn=np.where(near, steps.pause_turn, 0.0))


def turning_periods(steps: Steps) -> Index:
    """Runs of steps ``(p, 2)``, [first, last), that turn the same way by more than 10° each: [map-matching] Sec. 3.2.

    One step that turns less does not end a run. A zigzag is a sequence of runs to alternating sides.
    """
    side = np.where(np.abs(steps.turn) > TURNING, np.sign(steps.turn), 0)
    gap = np.flatnonzero((side[1:-1] == 0) & (side[:-2] == side[2:])) + 1
    side[gap] = side[gap - 1]
    begins = np.flatnonzero(np.diff(side, prepend=0))
    ends = np.append(begins, len(side))[1:]
    turning = side[begins] != 0
    return np.stack([begins[turning], ends[turning]], axis=1)


def track_link(network: Network, cost: Array, link: int) -> int:
    """The link after steps without a turn, with costs ``(n, l)``, from the link before them.

    It is the cheapest of the present link and its neighbours over the last eight steps.
    """
    for n in range(AROUND, len(cost) + 1):
        near = _meeting(network, link)
        link = int(near[np.argmin(cost[n - AROUND : n, near].sum(axis=0))])
    return link


def find_turn(network: Network, steps: Steps, track: Array, link: int, since: int = 0) -> Turn | None:
    """The first turn of a track ``(n + 1, 2)`` [m] that is on ``link`` at step ``since``; None without one.

    [map-matching] Sec. 3.3: a turn is a turning period after which the walk is on another link, by the cost of the next
    eight steps. The paper compares all links; here only links that meet the present one, to the side of the turn.
    """
    cost, half = link_costs(network.segments, track[:-1], track[1:]), 3  # [steps] half the length of a turn
    for first, last in turning_periods(steps).tolist():
        if first < since or last >= len(steps):
            continue
        link = track_link(network, cost[since:first], link)
        near = _meeting(network, link)
        after = int(near[np.argmin(cost[last : last + AROUND, near].sum(axis=0))])
        bend = _Bend.between(network, link, after)
        if bend is not None and bend.angle * np.sum(steps.turn[first:last]) > 0:
            at = bend.sharpest(track, max(first - AROUND, since), min(last + AROUND, len(steps)))
            begin, end = max(at - half, since), min(at + half, len(steps))
            return Turn(begin, end, bend.node, link, after, bend.into, bend.out_of)
        since = max(since, first)
    return None


@dataclass(frozen=True)
class _Bend:
    """Two links that meet. into, out_of: unit vectors ``(2,)`` to and from their node; angle: of the turn [rad]."""

    node: int
    into: Array
    out_of: Array
    angle: float

    @classmethod
    def between(cls, network: Network, before: int, after: int) -> _Bend | None:
        """The bend between two links; None if they are the same or continue straight."""
        if before == after:
            return None
        node = min(set(network.links[before].tolist()) & set(network.links[after].tolist()))
        into, out_of = -network.direction(before, node), network.direction(after, node)
        angle = turn_between(into, out_of)
        return cls(node, into, out_of, angle) if abs(angle) > TURNS.least else None

    def sharpest(self, track: Array, begin: int, end: int) -> int:
        """The step of [begin, end) up to which the track approaches the node most and after which it leaves it most."""
        moves = np.diff(track[begin : end + 1], axis=0)
        return begin + int(np.argmax(np.cumsum(moves @ (self.into - self.out_of)))) + 1


def _meeting(network: Network, link: int) -> Index:
    """Numbers ``(m,)`` of a link and of the links that share a node with it."""
    return np.flatnonzero(np.isin(network.links, network.links[link]).any(axis=1))


RESOLUTION = 0.005  # of R_d and R_s: 0.45° of a right angle, 0.2 m of a corridor of 40 m
Pair = tuple[float, float]  # R_d, R_s


@dataclass(frozen=True)
class FeasibleRegion(OneLineRepr):
    """The pairs (R_d, R_s) that were tried for one part of a walk.

    R_d: ``(d,)``; R_s: ``(s,)``, both multiples of 0.005; feasible: ``(d, s)`` True if the track crosses no wall.
    """

    R_d: Array
    R_s: Array
    feasible: Mask

    def _summary(self) -> list[str]:
        return [f"{np.count_nonzero(self.feasible)} of {count(self.feasible.size, 'pair')} feasible"]

    @classmethod
    def none(cls) -> FeasibleRegion:
        """An empty region."""
        return cls(np.empty(0), np.empty(0), np.zeros((0, 0), dtype=bool))

    @property
    def pairs(self) -> set[tuple[int, int]]:
        """The feasible pairs, in multiples of 0.005."""
        d, s = np.nonzero(self.feasible)
        R_d, R_s = (np.rint(values / RESOLUTION).astype(int) for values in (self.R_d[d], self.R_s[s]))
        return set(zip(R_d.tolist(), R_s.tolist(), strict=True))


def calibrated_tracks(steps: Steps, start: Array, heading: float, R_d: Array, R_s: Array) -> Array:
    """Tracks ``(d, s, n + 1, 2)`` with all pairs, from ``start (2,)`` [m] and ``heading`` [rad]: Eqs. (4), (5)."""
    moves = steps.length[:, None] * unit(heading + np.multiply.outer(R_d, courses(steps)))
    track = np.concatenate([np.zeros((len(R_d), 1, 2)), np.cumsum(moves, axis=1)], axis=1)
    return start + R_s[:, None, None] * track[:, None]


def range_of_R_d(turn: Turn, corners: Array, theta: float, before: float, after: float) -> tuple[float, float]:
    """[map-matching] Eq. (6): α/θ ≤ R_d ≤ β/θ, with the turn's estimated heading change θ [rad].

    before, after: as for `range_of_turn`.
    """
    low, high = sorted(angle / theta for angle in range_of_turn(turn.into, turn.out_of, corners, before, after))
    return low, high


def range_of_R_s(turn: Turn, corners: Array, start: Array, walked: Array) -> Array:
    """[map-matching] Eq. (7): A/X ≤ R_s ≤ B/X, ``(d, 2)``; NaN where the walk leads away from the corner.

    start: ``(2,)`` of the stretch [m]; walked: ``(d, 2)`` displacement from there to the turn with each R_d [m]; the
    paper has one R_d. X is its projection on the link, A and B are those of the nearest and the farthest corner.
    """
    X = walked @ turn.into
    ends = np.sort((corners - start) @ turn.into)[[0, -1]]
    return np.sort(ends / np.where(X > 0, X, np.nan)[:, None], axis=1)


def feasible_region(steps: Steps, start: Array, heading: float, R_d: Array, R_s: Array, walls: Array) -> FeasibleRegion:
    """All pairs within the ranges, tested exhaustively against ``walls (w, 2, 2)`` [m]: [map-matching] Sec. 3.5.

    start: ``(2,)`` [m] and heading [rad] of the steps; R_d: ``(d,)`` from `lattice`; R_s: ``(d, 2)`` range for each.
    The paper assumes a convex quadrilateral; here no shape is assumed, since the track is not linear in the pair.
    """
    if not len(R_d) or np.isnan(R_s).all():
        return FeasibleRegion.none()
    s = lattice(float(np.nanmin(R_s)), float(np.nanmax(R_s)))
    feasible = (s >= R_s[:, :1]) & (s <= R_s[:, 1:])
    d_of, s_of = np.nonzero(feasible)
    tracks = calibrated_tracks(steps, np.zeros(2), heading, R_d, np.ones(1))[d_of, 0] * s[s_of, None, None]
    feasible[d_of, s_of] = stays_within(start + tracks, walls)
    return FeasibleRegion(R_d, s, feasible)


def lattice(low: float, high: float) -> Array:
    """Multiples of 0.005 ``(m,)`` from ``low`` to ``high``, within 0.7 to 1.4: others are errors of the association.

    Empty for limits that are NaN.
    """
    if not np.isfinite([low, high]).all():
        return np.empty(0)
    first, last = np.ceil(max(low, 0.7) / RESOLUTION), np.floor(min(high, 1.4) / RESOLUTION)
    return np.arange(first, last + 1) * RESOLUTION


def stays_within(tracks: Array, walls: Array) -> Mask:
    """``(p,)`` True for tracks ``(p, n + 1, 2)`` of which no step crosses any of the ``walls (w, 2, 2)`` [m]."""
    left = np.arange(len(tracks))
    low, high = tracks.min(axis=(0, 1), initial=np.inf), tracks.max(axis=(0, 1), initial=-np.inf)
    near = (walls.max(axis=1) >= low).all(axis=1) & (walls.min(axis=1) <= high).all(axis=1)
    for begin, end in walls[near]:
        track = tracks[left]
        before, after = track[:, :-1], track[:, 1:]
        side = _cross(end - begin, track - begin)
        apart = _cross(after - before, begin - before) * _cross(after - before, end - before)
        crossed = (side[:, :-1] * side[:, 1:] <= 0) & (apart <= 0)
        left = left[~crossed.any(axis=1)]
    return np.isin(np.arange(len(tracks)), left)


def method_2(newest: FeasibleRegion, common: set[tuple[int, int]]) -> tuple[Pair | None, set[tuple[int, int]]]:
    """The centroid of the pairs that recent regions have in common, and these pairs.

    common: pairs in common of the earlier regions; if the newest has none of them, its pairs alone are used.
    """
    shared = (newest.pairs & common) or newest.pairs
    return centroid(shared), shared or common


def centroid(pairs: set[tuple[int, int]]) -> Pair | None:
    """The pair (R_d, R_s) of a set nearest to its centroid, which may lie outside the set; None for an empty set."""
    if not pairs:
        return None
    counted = np.array(sorted(pairs))
    R_d, R_s = counted[np.argmin(np.sum((counted - counted.mean(axis=0)) ** 2, axis=1))] * RESOLUTION
    return float(R_d), float(R_s)


def corners_at(corners: Array, node: Array) -> Array:
    """Corners ``(4, 2)`` of an intersection; if it has none, those of a square of 6 m about its node. [m]"""
    square = node + 3.0 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return square if np.isnan(corners).any() else corners


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@dataclass(frozen=True)
class Stretch(OneLineRepr):
    """The walk from one turn to the end of the next, with its calibration.

    first, last: its steps [first, last), whose turns are ``turn`` and the one before; region: the pairs that were
    tried; pair: the (R_d, R_s) chosen, that of the stretch before if the region is empty; slack: distance by which the
    walls had to be moved outwards for any pair to be feasible [m].
    """

    first: int
    last: int
    turn: Turn
    region: FeasibleRegion
    pair: Pair
    slack: float

    def _summary(self) -> list[str]:
        calibration = f"R_d {self.pair[0]:.3f}, R_s {self.pair[1]:.3f}"
        return [f"steps {self.first} to {self.last}", calibration, f"slack {self.slack:g} m"]


@dataclass(frozen=True)
class CalibratedTrack(OneLineRepr, row="position"):
    """The track on the floor, calibrated up to some step. position: ``(n + 1, 2)`` [m]; heading: ``(n + 1,)`` [rad]."""

    position: Array
    heading: Array

    def recalibrated(self, steps: Steps, first: int, pair: Pair) -> CalibratedTrack:
        """The track with all steps from ``first`` on calibrated by a pair (R_d, R_s)."""
        rest, R_d = steps_between(steps, first, len(steps)), pair[0]
        start, heading = self.position[first], self.heading[first]
        track = calibrated_tracks(rest, start, float(heading), np.array([R_d]), np.array([pair[1]]))[0, 0]
        headings = heading + R_d * np.concatenate([[0.0], np.cumsum(rest.turn)])
        position = np.concatenate([self.position[:first], track])
        return CalibratedTrack(position, np.concatenate([self.heading[:first], headings]))


SLACKS = 0.0, 0.25, 0.5, 1.0, 2.0  # [m] by which walls are moved outwards in turn, until a pair is feasible


def feasible_pairs(
    steps: Steps, track: CalibratedTrack, previous: Turn | None, turn: Turn, network: Network
) -> tuple[FeasibleRegion, float]:
    """The pairs of the stretch from one turn to the end of the next, and the slack that the walls needed [m].

    Eq. (6) holds for the turn that ends the stretch and for the one that begins it; a pair is tried if it is in the
    range of either, or between. The paper does not say what to do if every pair crosses a wall. As the error is in the
    track and not in the walls, the pairs that cross them least deeply are used.
    """
    end = evidence_end(turn, steps)
    first, since = (previous.first, previous.last) if previous else (0, 0)
    raw = track.recalibrated(steps, first, (1.0, 1.0)).position
    R_d = _R_d_of(turn, raw, since, end, network)
    if previous:
        R_d += _R_d_of(previous, raw, max(first - AROUND, 0), turn.first, network)
    if not R_d:
        return FeasibleRegion.none(), 0.0
    stretch, start, heading = steps_between(steps, first, end), raw[first], float(track.heading[first])
    d = lattice(min(R_d), max(R_d))
    ends = [turn.first - first, turn.last - first]
    walked = calibrated_tracks(stretch, np.zeros(2), heading, d, np.ones(1))[:, 0, ends]
    corners = corners_at(network.corners[turn.node], network.nodes[turn.node])
    R_s, region = range_of_R_s(turn, corners, start, walked.mean(axis=1)), FeasibleRegion.none()
    for slack in SLACKS:
        region = feasible_region(stretch, start, heading, d, R_s, network.walls(slack))
        if region.feasible.any():
            return region, slack
    return region, SLACKS[-1]


def _R_d_of(turn: Turn, track: Array, begin: int, end: int, network: Network) -> tuple[float, ...]:
    """The range of R_d by Eq. (6) of a turn, from steps ``begin`` to ``end`` of a track; empty for a small turn."""
    before, after = track[turn.first] - track[begin], track[end] - track[turn.last]
    theta = turn_between(before, after)
    if abs(theta) < TURNING:  # it does not determine R_d
        return ()
    corners = corners_at(network.corners[turn.node], network.nodes[turn.node])
    return range_of_R_d(turn, corners, theta, float(np.hypot(*before)), float(np.hypot(*after)))


def evidence_end(turn: Turn, steps: Steps) -> int:
    """The number of steps that are available when a turn is detected."""
    return min(turn.last + AROUND, len(steps))


def steps_between(steps: Steps, first: int, last: int) -> Steps:
    """The steps [first, last)."""
    start = steps.start if first == 0 else float(steps.time[first - 1])
    return replace(steps, start=start, **{name: getattr(steps, name)[first:last] for name in STEP_COLUMNS})


@dataclass(frozen=True)
class MatchedWalk(OneLineRepr):
    """A walk projected on links.

    link: ``(n,)`` of each step; turns: from link to link; trajectory: the projection, rows as of `dead_reckon`.
    """

    link: Index
    turns: tuple[Turn, ...]
    trajectory: Trajectory

    def _summary(self) -> list[str]:
        return [f"{len(self.link)} steps", f"{len(self.turns)} turns"]


@dataclass(frozen=True)
class CorrectedWalk(OneLineRepr):
    """A walk calibrated by the corridors of its floor. stretches: one per turn; notes: one text per problem."""

    trajectory: Trajectory
    stretches: tuple[Stretch, ...]
    notes: tuple[str, ...] = ()

    def _summary(self) -> list[str]:
        return [f"{len(self.trajectory)} rows", f"{len(self.stretches)} stretches"]


def match(steps: Steps, network: Network, start: Array, heading: float) -> MatchedWalk:
    """Map matching by projection, [map-matching] Sec. 3.3: each step ends on the link that fits its vector best.

    start: ``(2,)`` [m]; heading: at the start [rad]. Each step begins at the projection of the one before.

    Raises ValueError if the network has no link.
    """
    segments = _walkable(network).segments
    theta = heading + np.concatenate([[0.0], np.cumsum(steps.turn)])
    moves = steps.length[:, None] * unit(heading + courses(steps))
    links, track = np.empty(len(steps), dtype=np.intp), np.tile(start, (len(steps) + 1, 1))
    for k, move in enumerate(moves):
        end = track[k] + move
        links[k] = np.argmin(link_costs(segments, track[k][None], end[None])[0])
        on_link = segments.projected(end[None])[0][segments.link == links[k]]
        track[k + 1] = on_link[np.argmin(np.sum((on_link - end) ** 2, axis=1))]
    turns, link = list[Turn](), segments.nearest(start)[0]
    while (turn := find_turn(network, steps, track, link, turns[-1].last if turns else 0)) is not None:
        turns.append(turn)
        link = turn.after
    return MatchedWalk(links, tuple(turns), _trajectory(steps, track, theta, 1.0))


def correct(steps: Steps, floor: FloorPlan, start: Array, heading: float, method: Literal[1, 2] = 1) -> CorrectedWalk:
    """[map-matching] Sec. 3: at each turn, calibrate the track since the turn before so that it crosses no wall.

    start: ``(2,)`` [m]; heading: at the start [rad]; method: 1 or 2 of Sec. 3.6. Until the first turn the steps are
    used as measured, from then on with the calibration of the last turn (Sec. 3.7). A stretch includes the turn at its
    beginning: that heading change, times R_d, aligns the track with its corridor. Links are matched to the track with
    the turns as measured, since a wrong R_d of one corner would turn the next one into another link.

    Gyroscope drift along a corridor is not corrected. The paper's dead reckoning has none:
    `straightened`.

    Raises ValueError if the floor has no corridor.
    """
    network = _walkable(floor.network)
    link, distance = network.segments.nearest(start)
    notes = [f"the start is {distance:.1f} m from the nearest link"] if distance > 5 else []
    pair, common = (1.0, 1.0), set[tuple[int, int]]()
    track = CalibratedTrack(start[None], np.array([heading])).recalibrated(steps, 0, pair)
    previous, stretches = None, list[Stretch]()
    while True:
        first, since = (previous.first, previous.last) if previous else (0, 0)
        measured_turns = track.recalibrated(steps, first, (1.0, pair[1]))
        turn = find_turn(network, steps, measured_turns.position, link, since)
        if turn is None:
            break
        region, slack = feasible_pairs(steps, track, previous, turn, network)
        chosen = centroid(region.pairs)  # method 1: people mostly keep to the middle
        if method == 2:
            chosen, common = method_2(region, common)
        pair = chosen or pair
        stretches.append(Stretch(first, evidence_end(turn, steps), turn, region, pair, slack))
        if chosen is None:
            notes.append(f"turn at step {turn.first}: no pair stays within the walls; the calibration before was kept")
        elif slack:
            notes.append(f"turn at step {turn.first}: walls were moved outwards by {slack} m")
        track = track.recalibrated(steps, first, pair)
        previous, link = turn, turn.after
    return CorrectedWalk(_trajectory(steps, track.position, track.heading, pair[0]), tuple(stretches), tuple(notes))


def _walkable(network: Network) -> Network:
    """The network unchanged; raises ValueError if it has no link."""
    if not len(network):
        raise ValueError("the plan has no corridor: found no link, expected one")
    return network


def _trajectory(steps: Steps, track: Array, heading: Array, R_d: float) -> Trajectory:
    """The trajectory of a track ``(n + 1, 2)`` [m], with the rows of `dead_reckon`."""
    heading = np.append(heading, heading[-1] + R_d * steps.final_turn)
    return Trajectory(row_times(steps), np.concatenate([track, track[-1:]]), wrap_angle(heading), ("",) * len(heading))
