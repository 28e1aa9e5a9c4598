"""Link of each step, turns between links, and feasible region of (R_d, R_s): [map-matching] Secs. 3.2–3.6.

R_d multiplies every heading change (Eq. 4), R_s every length (Eq. 5). The feasible region is the set of pairs that keep
the walk within its corridors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import count
from pdr_graph.floor.network import Network
from pdr_graph.geometry import courses, turn_between, unit, wrap_angle
from pdr_graph.types import Array, Index, Mask, Steps

TURNING = np.radians(10)  # heading change of a step above which the walker is turning: gait sways by up to 7°
AROUND = 8  # [steps] before and after a turn that determine its links: the length of a zigzag; chosen by hand
LEAST_TURN = np.radians(25)  # between two links; with less they are one corridor; chosen by hand


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


@dataclass(frozen=True)
class Segments(OneLineRepr):
    """The straight segments of the links of a network.

    start, along: ``(s, 2)`` first point and vector to the last [m]; link: ``(s,)`` number of the link.
    """

    start: Array
    along: Array
    link: Index

    def _summary(self) -> list[str]:
        return [count(len(self.link), "segment"), count(len(np.unique(self.link)), "link")]

    @classmethod
    def of(cls, network: Network) -> Segments:
        """Segments of all links, in order."""
        starts = [line[:-1] for line in network.lines]
        link = np.repeat(np.arange(len(network)), [len(s) for s in starts])
        empty = np.empty((0, 2))
        return cls(
            np.concatenate([*starts, empty]),
            np.concatenate([*(np.diff(li, axis=0) for li in network.lines), empty]),
            link,
        )

    def projected(self, points: Array) -> Array:
        """The nearest point on each segment ``(n, s, 2)`` to points ``(n, 2)``. [m]"""
        to = points[:, None] - self.start
        share = np.sum(to * self.along, axis=2) / np.maximum(np.sum(self.along**2, axis=1), 1e-12)
        return self.start + np.clip(share, 0, 1)[..., None] * self.along

    def nearest(self, point: Array) -> tuple[int, float]:
        """Link nearest to a point ``(2,)`` [m], and its distance [m]."""
        apart = np.hypot(*(self.projected(point[None])[0] - point).T)
        return int(self.link[np.argmin(apart)]), float(apart.min())


def link_costs(segments: Segments, start: Array, end: Array) -> Array:
    """Cost ``(n, l)`` of assigning each step, from ``start`` to ``end (n, 2)`` [m], to each link.

    [map-matching] Sec. 3.3 scores distance and angle and gives no formula. Here the cost is the sum of both squares,
    each divided by its usual value; the cost of a distance saturates beyond two corridor widths, where the track is
    lost. A link has no direction, and the best segment of a bent link counts.
    """
    usual_distance, usual_angle = 3.0, np.radians(30)  # [m], [rad] a corridor's width, a zigzag
    largest = 4.0  # cost of a distance: less than that of a right angle
    apart = np.linalg.norm(segments.projected(end) - end[:, None], axis=2)
    step, along = np.arctan2(*(end - start).T[::-1]), np.arctan2(*segments.along.T[::-1])
    askew = np.abs(wrap_angle(2 * (step[:, None] - along))) / 2
    squared = (apart / usual_distance) ** 2
    cost = squared / (1 + squared / largest) + (askew / usual_angle) ** 2
    begins = np.flatnonzero(np.diff(segments.link, prepend=-1))
    return np.minimum.reduceat(cost, begins, axis=1)


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
    cost, half = link_costs(Segments.of(network), track[:-1], track[1:]), 3  # [steps] half the length of a turn
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
        into, out_of = -_direction(network.leaving(before, node)), _direction(network.leaving(after, node))
        angle = turn_between(into, out_of)
        return cls(node, into, out_of, angle) if abs(angle) > LEAST_TURN else None

    def sharpest(self, track: Array, begin: int, end: int) -> int:
        """The step of [begin, end) up to which the track approaches the node most and after which it leaves it most."""
        moves = np.diff(track[begin : end + 1], axis=0)
        return begin + int(np.argmax(np.cumsum(moves @ (self.into - self.out_of)))) + 1


def _direction(line: Array) -> Array:
    """Unit vector ``(2,)`` of the first segment of a line."""
    ahead = line[1] - line[0]
    return ahead / np.hypot(*ahead)


def _meeting(network: Network, link: int) -> Index:
    """Numbers ``(m,)`` of a link and of the links that share a node with it."""
    return np.flatnonzero(np.isin(network.links, network.links[link]).any(axis=1))


RESOLUTION = 0.005, 0.005  # of R_d and R_s: 0.45° of a right angle, 0.2 m of a corridor of 40 m
LEAST_SCALE, MOST_SCALE = 0.7, 1.4  # limits of R_d and R_s: others are errors of the association; chosen by hand
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
        return set(zip(_counted(self.R_d, 0)[d].tolist(), _counted(self.R_s, 1)[s].tolist(), strict=True))


def calibrated_tracks(steps: Steps, start: Array, heading: float, R_d: Array, R_s: Array) -> Array:
    """Tracks ``(d, s, n + 1, 2)`` with all pairs, from ``start (2,)`` [m] and ``heading`` [rad]: Eqs. (4), (5)."""
    moves = steps.length[:, None] * unit(heading + np.multiply.outer(R_d, courses(steps)))
    track = np.concatenate([np.zeros((len(R_d), 1, 2)), np.cumsum(moves, axis=1)], axis=1)
    return start + R_s[:, None, None] * track[:, None]


def range_of_R_d(turn: Turn, corners: Array, theta: float, before: float, after: float) -> tuple[float, float]:
    """[map-matching] Eq. (6): α/θ ≤ R_d ≤ β/θ, with the turn's estimated heading change θ [rad].

    before, after: as for `range_of_turn`.
    """
    return _ordered(*(angle / theta for angle in range_of_turn(turn, corners, before, after)))


def range_of_turn(turn: Turn, corners: Array, before: float, after: float) -> tuple[float, float]:
    """α and β of [map-matching] Eq. (6): least and greatest angle of a turn, counter-clockwise, the lower first. [rad]

    before, after: length of the walk along the links before and after the turn [m]; the paper uses the whole corridor
    from one intersection to the next. α is that of a path out-in-out: from the outer wall past the inner corner to the
    outer wall. β is that of a path in-out-in.
    """
    bearing = (corners - corners.mean(axis=0)) @ (turn.out_of - turn.into)
    inner, outer = corners[np.argmax(bearing)], corners[np.argmin(bearing)]

    def wall(side: Array, along: Array, reach: float) -> Array:
        return side + (inner - side) @ along * along + reach * along

    def turned(side: Array, by: Array) -> float:
        return turn_between(by - wall(side, turn.into, -before), wall(side, turn.out_of, after) - by)

    return _ordered(turned(outer, inner), turned(inner, outer))


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
    s = lattice((float(np.nanmin(R_s)), float(np.nanmax(R_s))), 1)
    feasible = (s >= R_s[:, :1]) & (s <= R_s[:, 1:])
    d_of, s_of = np.nonzero(feasible)
    tracks = calibrated_tracks(steps, np.zeros(2), heading, R_d, np.ones(1))[d_of, 0] * s[s_of, None, None]
    feasible[d_of, s_of] = stays_within(start + tracks, walls)
    return FeasibleRegion(R_d, s, feasible)


def lattice(limits: tuple[float, float], axis: int) -> Array:
    """Multiples of 0.005 within limits ``(m,)``, for R_d (axis 0) or R_s (axis 1); empty for limits that are NaN."""
    if not np.isfinite(limits).all():
        return np.empty(0)
    low, high = max(limits[0], LEAST_SCALE) / RESOLUTION[axis], min(limits[1], MOST_SCALE) / RESOLUTION[axis]
    return np.arange(np.ceil(low), np.floor(high) + 1) * RESOLUTION[axis]


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


def method_1(newest: FeasibleRegion) -> Pair | None:
    """The centroid of the newest region, since people mostly keep to the middle; None if it is empty."""
    return centroid(newest.pairs)


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


def _counted(values: Array, axis: int) -> Index:
    return np.rint(values / RESOLUTION[axis]).astype(np.intp)


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _ordered(a: float, b: float) -> tuple[float, float]:
    return (a, b) if a <= b else (b, a)
