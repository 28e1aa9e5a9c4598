"""[map-matching]: projection on links, and the correction of (R_d, R_s) that keeps the track's shape.

A stretch is a walk from one turn to the end of the next, on which calibrations are tried (Secs. 3.4, 3.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pdr_graph.floor.corridor_turns import (
    AROUND,
    FeasibleRegion,
    Pair,
    Segments,
    Turn,
    corners_at,
    costs,
    feasible_region,
    find_turn,
    lattice,
    method_1,
    method_2,
    range_of_R_d,
    range_of_R_s,
    transformed,
)
from pdr_graph.floor.network import Network
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import courses, row_times, turn_between, unit, wrap_angle
from pdr_graph.types import Array, Index, Steps, Trajectory

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
    region: FeasibleRegion
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


def tried_pairs(
    steps: Steps, laid: Laid, previous: Turn | None, turn: Turn, network: Network
) -> tuple[FeasibleRegion, float]:
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
        return FeasibleRegion.none(), 0.0
    stretch, start, heading = cut(steps, first, last), raw[first], float(laid.heading[first])
    d = lattice((min(R_d), max(R_d)), 0)
    walked = transformed(stretch, np.zeros(2), heading, d, np.ones(1))[:, 0, [turn.first - first, turn.last - first]]
    corners = corners_at(network.corners[turn.node], network.nodes[turn.node])
    R_s, tried = range_of_R_s(turn, corners, start, walked.mean(axis=1)), FeasibleRegion.none()
    for slack in SLACKS:
        tried = feasible_region(stretch, start, heading, d, R_s, network.walls(slack))
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


STRAYED = 5.0  # [m] from every link at which the start is called elsewhere


@dataclass(frozen=True)
class Matched:
    """A walk on the links.

    link: ``(n,)`` of each step; turns: from link to link; trajectory: projected on them, rows as of `dead_reckon`.
    """

    link: Index
    turns: tuple[Turn, ...]
    trajectory: Trajectory


@dataclass(frozen=True)
class Corrected:
    """A walk corrected by its building. stretches: one per turn; notes: what could not be done, a line each."""

    trajectory: Trajectory
    stretches: tuple[Stretch, ...]
    notes: tuple[str, ...] = ()


def match(steps: Steps, network: Network, start: Array, heading: float) -> Matched:
    """Classic map matching, [map-matching] Sec. 3.3: each step ends on the link that fits its vector best.

    start: ``(2,)`` [m]; heading: at the start [rad]. The next step begins where the last one was projected to.

    Raises ValueError if the network has no link.
    """
    segments = Segments.of(_walkable(network))
    theta = heading + np.concatenate([[0.0], np.cumsum(steps.turn)])
    moves = steps.length[:, None] * unit(heading + courses(steps))
    links, track = np.empty(len(steps), dtype=np.intp), np.tile(start, (len(steps) + 1, 1))
    for k, move in enumerate(moves):
        end = track[k] + move
        links[k] = np.argmin(costs(segments, track[k][None], end[None])[0])
        on_link = segments.projected(end[None])[0][segments.link == links[k]]
        track[k + 1] = on_link[np.argmin(np.sum((on_link - end) ** 2, axis=1))]
    turns, link = list[Turn](), segments.nearest(start)[0]
    while (turn := find_turn(network, steps, track, link, turns[-1].last if turns else 0)) is not None:
        turns.append(turn)
        link = turn.after
    return Matched(links, tuple(turns), _trajectory(steps, track, theta, 1.0))


def correct(steps: Steps, floor: FloorPlan, start: Array, heading: float, method: Literal[1, 2] = 1) -> Corrected:
    """[map-matching] Sec. 3: turn by turn, the track since the turn before is calibrated to cross no wall.

    start: ``(2,)`` [m]; heading: at the start [rad]; method: 1 or 2 of Sec. 3.6. Until the first turn the steps are
    believed as they are, from then on as the last turn said (Sec. 3.7). A stretch includes the turn that it begins
    with: that heading change, times R_d, is what lays the track along its corridor. Links are asked of the track with
    the turns as measured: a wrong R_d of one corner would turn the next one into another link.

    Nothing mends a gyroscope that drifts along a corridor. The paper's dead reckoning has none:
    `corridor_turns.straightened`.

    Raises ValueError if the floor has no corridor.
    """
    network = _walkable(floor.network)
    link, astray = Segments.of(network).nearest(start)
    notes = [f"the start lies {astray:.1f} m from the nearest link"] if astray > STRAYED else []
    pair, common = (1.0, 1.0), set[tuple[int, int]]()
    laid = Laid(start[None], np.array([heading])).again(steps, 0, pair)
    previous, stretches = None, list[Stretch]()
    while True:
        first, since = (previous.first, previous.last) if previous else (0, 0)
        as_turned = laid.again(steps, first, (1.0, pair[1]))
        turn = find_turn(network, steps, as_turned.position, link, since)
        if turn is None:
            break
        tried, slack = tried_pairs(steps, laid, previous, turn, network)
        chosen, common = method_2(tried, common) if method == 2 else (method_1(tried), common)
        pair = chosen or pair
        stretches.append(Stretch(first, seen(turn, steps), turn, tried, pair, slack))
        notes += _doubts(turn, chosen, slack)
        laid = laid.again(steps, first, pair)
        previous, link = turn, turn.after
    return Corrected(_trajectory(steps, laid.position, laid.heading, pair[0]), tuple(stretches), tuple(notes))


def _doubts(turn: Turn, chosen: Pair | None, slack: float) -> list[str]:
    """What to say of a turn at which the walls did not leave what they should."""
    if chosen is None:
        return [f"turn at step {turn.first}: no pair keeps within the walls, the one before was kept"]
    return [f"turn at step {turn.first}: the walls had to give by {slack} m"] if slack else []


def _walkable(network: Network) -> Network:
    if not len(network):
        raise ValueError("the plan has no corridor: found no link, expected one")
    return network


def _trajectory(steps: Steps, track: Array, heading: Array, R_d: float) -> Trajectory:
    """Rows as of `dead_reckon`."""
    heading = np.append(heading, heading[-1] + R_d * steps.final_turn)
    return Trajectory(row_times(steps), np.concatenate([track, track[-1:]]), wrap_angle(heading), ("",) * len(heading))
