"""Which pairs (R_d, R_s) keep a walk within its corridors: [map-matching] Secs. 3.4 to 3.6.

R_d multiplies every heading change (Eq. 4), R_s every length (Eq. 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.floor.links import Turn
from pdr_graph.geometry import courses, turn_between, unit
from pdr_graph.types import Array, Index, Mask, Steps

RASTER = 0.005, 0.005  # of R_d and R_s: 0.45° of a right angle, 0.2 m of a corridor of 40 m
LEAST, MOST = 0.7, 1.4  # of either: what is beyond is no calibration but a mistake
OPEN = 3.0  # [m] to either side of a node without corners
Pair = tuple[float, float]  # R_d, R_s


@dataclass(frozen=True)
class Region:
    """The pairs tried for one stretch of a walk.

    R_d: ``(d,)``; R_s: ``(s,)``, both multiples of RASTER; feasible: ``(d, s)`` whose track crosses no wall.
    """

    R_d: Array
    R_s: Array
    feasible: Mask

    @classmethod
    def none(cls) -> Region:
        """No pair at all."""
        return cls(np.empty(0), np.empty(0), np.zeros((0, 0), dtype=bool))

    @property
    def pairs(self) -> set[tuple[int, int]]:
        """The feasible pairs, counted in RASTER."""
        d, s = np.nonzero(self.feasible)
        return set(zip(_counted(self.R_d, 0)[d].tolist(), _counted(self.R_s, 1)[s].tolist(), strict=True))


def transformed(steps: Steps, start: Array, heading: float, R_d: Array, R_s: Array) -> Array:
    """Tracks ``(d, s, n + 1, 2)`` of all pairs, from ``start (2,)`` [m] and ``heading`` [rad]: Eqs. (4), (5)."""
    moves = steps.length[:, None] * unit(heading + np.multiply.outer(R_d, courses(steps)))
    track = np.concatenate([np.zeros((len(R_d), 1, 2)), np.cumsum(moves, axis=1)], axis=1)
    return start + R_s[:, None, None] * track[:, None]


def range_of_R_d(turn: Turn, corners: Array, theta: float, before: float, after: float) -> tuple[float, float]:
    """Eq. (6): α/θ ≤ R_d ≤ β/θ, θ the turn's estimated heading change [rad]; the others as of `range_of_turn`."""
    return _ordered(*(angle / theta for angle in range_of_turn(turn, corners, before, after)))


def range_of_turn(turn: Turn, corners: Array, before: float, after: float) -> tuple[float, float]:
    """α and β of Eq. (6), counter-clockwise, the lower first. [rad]

    before, after: how far the walk was seen along the links on either side [m]. α, the least that one can turn, is
    out-in-out: from the outer wall past the inner corner to the outer wall. β, the greatest, is in-out-in. The paper's
    corridors are seen from one intersection to the other.
    """
    bearing = (corners - corners.mean(axis=0)) @ (turn.out_of - turn.into)
    inner, outer = corners[np.argmax(bearing)], corners[np.argmin(bearing)]

    def wall(side: Array, along: Array, reach: float) -> Array:
        return side + (inner - side) @ along * along + reach * along

    def turned(side: Array, by: Array) -> float:
        return turn_between(by - wall(side, turn.into, -before), wall(side, turn.out_of, after) - by)

    return _ordered(turned(outer, inner), turned(inner, outer))


def range_of_R_s(turn: Turn, corners: Array, start: Array, walked: Array) -> Array:
    """Eq. (7): A/X ≤ R_s ≤ B/X, ``(d, 2)``.

    start: ``(2,)`` of the stretch [m]; walked: ``(d, 2)`` displacement from there to the turn as estimated with each
    R_d [m], which the paper takes for one. X is its projection on the link, A and B the same of the nearest and the
    farthest corner. NaN where one would walk away from the corner.
    """
    X = walked @ turn.into
    ends = np.sort((corners - start) @ turn.into)[[0, -1]]
    return np.sort(ends / np.where(X > 0, X, np.nan)[:, None], axis=1)


def region(steps: Steps, start: Array, heading: float, R_d: Array, R_s: Array, walls: Array) -> Region:
    """All pairs of the ranges, tried exhaustively against ``walls (w, 2, 2)`` [m]: Sec. 3.5.

    start: ``(2,)`` [m] and heading [rad] of the steps; R_d: ``(d,)`` of `lattice`; R_s: ``(d, 2)`` range with each.
    The paper sees a convex quadrilateral; as the track is not linear in the pair, no shape is assumed.
    """
    if not len(R_d) or np.isnan(R_s).all():
        return Region.none()
    s = lattice((float(np.nanmin(R_s)), float(np.nanmax(R_s))), 1)
    feasible = (s >= R_s[:, :1]) & (s <= R_s[:, 1:])
    d_of, s_of = np.nonzero(feasible)
    tracks = transformed(steps, np.zeros(2), heading, R_d, np.ones(1))[d_of, 0] * s[s_of, None, None]
    feasible[d_of, s_of] = keeps_within(start + tracks, walls)
    return Region(R_d, s, feasible)


def lattice(limits: tuple[float, float], axis: int) -> Array:
    """Multiples of RASTER of R_d (axis 0) or R_s (1) within some limits ``(m,)``; none of limits that are none."""
    if not np.isfinite(limits).all():
        return np.empty(0)
    low, high = max(limits[0], LEAST) / RASTER[axis], min(limits[1], MOST) / RASTER[axis]
    return np.arange(np.ceil(low), np.floor(high) + 1) * RASTER[axis]


def keeps_within(tracks: Array, walls: Array) -> Mask:
    """Which tracks ``(p, n + 1, 2)`` cross none of the ``walls (w, 2, 2)``, step by step: ``(p,)``."""
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


def method_1(newest: Region) -> Pair | None:
    """The centroid of the newest region: people mostly keep to the middle. None of an empty one."""
    return centroid(newest.pairs)


def method_2(newest: Region, common: set[tuple[int, int]]) -> tuple[Pair | None, set[tuple[int, int]]]:
    """The centroid of what recent regions have in common, and that; of the newest alone where they have nothing.

    common: of the regions before.
    """
    shared = (newest.pairs & common) or newest.pairs
    return centroid(shared), shared or common


def centroid(pairs: set[tuple[int, int]]) -> Pair | None:
    """The pair (R_d, R_s) of a set that is nearest to its centroid, which itself may lie outside; None of none."""
    if not pairs:
        return None
    counted = np.array(sorted(pairs))
    R_d, R_s = counted[np.argmin(np.sum((counted - counted.mean(axis=0)) ** 2, axis=1))] * RASTER
    return float(R_d), float(R_s)


def corners_at(corners: Array, node: Array) -> Array:
    """Corners ``(4, 2)`` of an intersection; about a node without any, those of a square. [m]"""
    square = node + OPEN * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return square if np.isnan(corners).any() else corners


def _counted(values: Array, axis: int) -> Index:
    return np.rint(values / RASTER[axis]).astype(np.intp)


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _ordered(a: float, b: float) -> tuple[float, float]:
    return (a, b) if a <= b else (b, a)
