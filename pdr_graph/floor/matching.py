"""A walk and its building: [map-matching], the projection on links and the correction that keeps the track's shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pdr_graph.floor.calibrations import Pair, method_1, method_2
from pdr_graph.floor.links import Segments, Turn, costs, find_turn
from pdr_graph.floor.network import Network
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.floor.stretches import Laid, Stretch, seen, tried_pairs
from pdr_graph.geometry import courses, row_times, unit, wrap_angle
from pdr_graph.types import Array, Index, Steps, Trajectory

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

    Nothing mends a gyroscope that drifts along a corridor. The paper's dead reckoning has none: `links.straightened`.

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
        raise ValueError("the plan has no corridor: found no link, needed one")
    return network


def _trajectory(steps: Steps, track: Array, heading: Array, R_d: float) -> Trajectory:
    """Rows as of `dead_reckon`."""
    heading = np.append(heading, heading[-1] + R_d * steps.final_turn)
    return Trajectory(row_times(steps), np.concatenate([track, track[-1:]]), wrap_angle(heading), ("",) * len(heading))
