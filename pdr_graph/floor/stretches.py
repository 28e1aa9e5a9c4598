"""A walk from one turn to the end of the next, and the calibrations tried on it: [map-matching] Secs. 3.4, 3.5."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.floor.calibrations import (
    Pair,
    Region,
    corners_at,
    lattice,
    range_of_R_d,
    range_of_R_s,
    region,
    transformed,
)
from pdr_graph.floor.links import AROUND, Turn
from pdr_graph.floor.network import Network
from pdr_graph.geometry import turn_between
from pdr_graph.types import Array, Steps

LEAST_THETA = np.radians(10)  # of an estimated turn: less says nothing of R_d
SLACKS = 0.0, 0.25, 0.5, 1.0, 2.0  # [m] by which walls give, one after the other, until some pair keeps within them


@dataclass(frozen=True)
class Stretch:
    """The walk from one turn to the end of the next, as calibrated at that end.

    first, last: its steps [first, last), whose turns are ``turn`` and the one before; region: the pairs tried; pair:
    (R_d, R_s) chosen, or kept from before where the region is empty; slack: by which the walls had to be moved
    outwards for any pair to keep within them [m].
    """

    first: int
    last: int
    turn: Turn
    region: Region
    pair: Pair
    slack: float


@dataclass(frozen=True)
class Laid:
    """The walk as laid on the floor so far. position: ``(n + 1, 2)`` [m]; heading: ``(n + 1,)`` [rad]."""

    position: Array
    heading: Array

    def again(self, steps: Steps, first: int, pair: Pair) -> Laid:
        """With all from step ``first`` on laid again, calibrated by a pair."""
        rest, R_d = cut(steps, first, len(steps)), pair[0]
        start, heading = self.position[first], self.heading[first]
        track = transformed(rest, start, float(heading), np.array([R_d]), np.array([pair[1]]))[0, 0]
        turned = heading + R_d * np.concatenate([[0.0], np.cumsum(rest.turn)])
        return Laid(np.concatenate([self.position[:first], track]), np.concatenate([self.heading[:first], turned]))


def tried_pairs(steps: Steps, laid: Laid, previous: Turn | None, turn: Turn, network: Network) -> tuple[Region, float]:
    """The pairs of the stretch from one turn to the end of the next, and the slack that the walls needed [m].

    Eq. (6) holds of the turn that ends the stretch and of the one that begins it; a pair is tried if it is in the range
    of either, or between. Where every pair crosses a wall the paper does not say what then. As the error is in the
    track and the walls are where they are, the pairs that cross them least deeply are taken.
    """
    first, since, last = (previous.first, previous.last, seen(turn, steps)) if previous else (0, 0, seen(turn, steps))
    raw = laid.again(steps, first, (1.0, 1.0)).position
    R_d = _R_d_of(turn, raw, since, last, network)
    if previous:
        R_d += _R_d_of(previous, raw, max(first - AROUND, 0), turn.first, network)
    if not R_d:
        return Region.none(), 0.0
    stretch, start, heading = cut(steps, first, last), raw[first], float(laid.heading[first])
    d = lattice((min(R_d), max(R_d)), 0)
    walked = transformed(stretch, np.zeros(2), heading, d, np.ones(1))[:, 0, [turn.first - first, turn.last - first]]
    corners = corners_at(network.corners[turn.node], network.nodes[turn.node])
    R_s, tried = range_of_R_s(turn, corners, start, walked.mean(axis=1)), Region.none()
    for slack in SLACKS:
        tried = region(stretch, start, heading, d, R_s, network.walls(slack))
        if tried.feasible.any():
            return tried, slack
    return tried, SLACKS[-1]


def _R_d_of(turn: Turn, track: Array, begin: int, end: int, network: Network) -> tuple[float, ...]:
    """Eq. (6) of a turn seen from step ``begin`` to step ``end`` of a track; nothing of one hardly estimated."""
    come, gone = track[turn.first] - track[begin], track[end] - track[turn.last]
    theta = turn_between(come, gone)
    if abs(theta) < LEAST_THETA:
        return ()
    corners = corners_at(network.corners[turn.node], network.nodes[turn.node])
    return range_of_R_d(turn, corners, theta, float(np.hypot(*come)), float(np.hypot(*gone)))


def seen(turn: Turn, steps: Steps) -> int:
    """The end of the steps that are known when a turn is."""
    return min(turn.last + AROUND, len(steps))


def cut(steps: Steps, first: int, last: int) -> Steps:
    """The steps [first, last)."""
    columns = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
    start = steps.start if first == 0 else float(steps.time[first - 1])
    return replace(steps, start=start, **{name: getattr(steps, name)[first:last] for name in columns})
