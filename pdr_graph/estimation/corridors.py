"""What the corridors of a floor say of a walk that is laid on it: where it turns, and which way its straight runs lead.

Which corridor, and which turn at which intersection, is asked of one way that the walk may have gone: association is
data, and no factor searches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.preintegration import Pieces
from pdr_graph.estimation.turns import Turns
from pdr_graph.floor.calibrations import range_of_turn
from pdr_graph.floor.ground import Ground
from pdr_graph.floor.links import Turn
from pdr_graph.floor.network import Network
from pdr_graph.floor.runs import Run, straight_runs, turns_between
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Headings, Index

SIGMA_SIDE = 0.3  # of a corridor's width: how far aside a walker is at either end of a run; evenly spread, 1/√12
SIGMA_AHEAD = 0.03  # [rad] between the way from end to end, and the keyframe's heading as its steps tell it


@dataclass(frozen=True)
class Use:
    """Which evidence of corridors is used beside their walls, which tell much of the same."""

    turns: bool = False
    directions: bool = False


@dataclass(frozen=True)
class Corridors:
    """What was matched. turns: None without any; keyframe: ``(r,)`` in each straight run; direction: its heading."""

    turns: Turns | None
    keyframe: Index
    direction: Headings


@dataclass(frozen=True)
class _Laid:
    """A walk on one floor.

    track: ``(n, 2)`` [m] and piece ``(n,)`` of those that moved; keyframe_piece: ``(k + 1,)`` that ends at each
    keyframe; heading: ``(k + 1,)`` there [rad].
    """

    track: Array
    piece: Index
    keyframe_piece: Index
    heading: Array

    def keyframe(self, run: Run) -> int | None:
        """The keyframe nearest to the middle of a run, None if there is none in it."""
        first, last = self.piece[run.first], self.piece[run.last - 1]
        middle = self.piece[(run.first + run.last) // 2]
        nearest = int(np.argmin(np.abs(self.keyframe_piece - middle)))
        return nearest if first <= self.keyframe_piece[nearest] <= last else None

    def aside(self, keyframe: int, begin: int, end: int) -> float:
        """By how much a keyframe's heading is to the left of the way between two places. [rad]"""
        return float(wrap_angle(self.heading[keyframe] - _bearing(self.track[end] - self.track[begin])))


def corridors_along(ground: Ground, pieces: Pieces, poses: Array, heading: Array, use: Use) -> Corridors:
    """The turns and straight runs of the way ``poses (m, 3)`` of all pieces, ``heading (k + 1,)`` [rad] of keyframes.

    Turns are known where the plan draws its intersections. A run that begins or ends with one says its direction by
    this alone.
    """
    turns, directions = list[Turns](), list[tuple[int, float, float]]()
    for floor, begin, end in ground.stretches:
        moved = begin + np.flatnonzero(pieces.length[begin:end] > 0)
        laid = _Laid(poses[moved, :2], moved, np.append(-1, pieces.last), heading)
        runs = [run for run in straight_runs(laid.track, floor.distance) if laid.keyframe(run) is not None]
        network = floor.drawn_network if use.turns else None
        found = list(turns_between(runs, laid.track, network)) if network else []
        turns += [_turn(laid, network, before, after, turn) for before, after, turn in found if network]
        told = [run for before, after, _ in found for run in (before, after)]
        directions += [_direction(laid, run) for run in runs if use.directions and run not in told]
    keyframe, direction, sigma = np.array(directions).reshape(-1, 3).T
    at = keyframe.astype(np.intp)
    return Corridors(Turns.together(turns), at, Headings(pieces.keyframe_time[at], direction, sigma))


def _direction(laid: _Laid, run: Run) -> tuple[int, float, float]:
    """Keyframe, heading and sigma of a straight run: end to end it leads along the corridor."""
    keyframe, ends = laid.keyframe(run), (run.first, run.last - 1)
    assert keyframe is not None
    length = float(np.hypot(*(laid.track[ends[1]] - laid.track[ends[0]])))
    sigma = np.hypot(np.sqrt(2) * SIGMA_SIDE * run.width / length, np.hypot(SIGMA_AHEAD, run.crooked))
    return keyframe, float(wrap_angle(run.direction + laid.aside(keyframe, *ends))), float(sigma)


def _turn(laid: _Laid, network: Network, before: Run, after: Run, turn: Turn) -> Turns:
    """[map-matching] Eq. (6) of the ways from the end of one run to the turn, and on to the end of the next."""
    i, j = laid.keyframe(before), laid.keyframe(after)
    assert i is not None
    assert j is not None
    corners, at = network.corners[turn.node], turn.first
    come, gone = (np.hypot(*(laid.track[at] - laid.track[n])) for n in (before.first, after.last - 1))
    aside = laid.aside(j, at, after.last - 1) - laid.aside(i, before.first, at)
    least, most = np.array(range_of_turn(turn, corners, float(come), float(gone))) + aside
    side = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.hypot(*side.T)[:, None]
    edge = np.sum(normal * corners, axis=1)
    one = (np.array([v]) for v in (i, j, least, most, laid.piece[at], normal, edge))
    return Turns(*one)


def _bearing(way: Array) -> float:
    return float(np.arctan2(way[1], way[0]))
