"""[map-matching]: projection on links, and the correction by (R_d, R_s), which keeps the shape of the track.

A stretch is the part of a walk from one turn to the end of the next; a calibration (R_d, R_s) is estimated for each
(Secs. 3.4, 3.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pdr_graph.columns import OneLineRepr
from pdr_graph.floor.corridor_turns import (
    AROUND,
    FeasibleRegion,
    Pair,
    Segments,
    Turn,
    calibrated_tracks,
    corners_at,
    feasible_region,
    find_turn,
    lattice,
    link_costs,
    method_1,
    method_2,
    range_of_R_d,
    range_of_R_s,
)
from pdr_graph.floor.network import Network
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import courses, row_times, turn_between, unit, wrap_angle
from pdr_graph.types import Array, Index, Steps, Trajectory


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
    d = lattice((min(R_d), max(R_d)), 0)
    ends = [turn.first - first, turn.last - first]
    walked = calibrated_tracks(stretch, np.zeros(2), heading, d, np.ones(1))[:, 0, ends]
    corners = corners_at(network.corners[turn.node], network.nodes[turn.node])
    R_s, region = range_of_R_s(turn, corners, start, walked.mean(axis=1)), FeasibleRegion.none()
    for slack in SLACKS:
        region = feasible_region(stretch, start, heading, d, R_s, network.walls(slack))
        if region.feasible.any():
            return region, slack
    return region, SLACKS[-1]


MINIMUM_THETA = np.radians(10)  # of an estimated turn; a smaller one does not determine R_d


def _R_d_of(turn: Turn, track: Array, begin: int, end: int, network: Network) -> tuple[float, ...]:
    """The range of R_d by Eq. (6) of a turn, from steps ``begin`` to ``end`` of a track; empty for a small turn."""
    before, after = track[turn.first] - track[begin], track[end] - track[turn.last]
    theta = turn_between(before, after)
    if abs(theta) < MINIMUM_THETA:
        return ()
    corners = corners_at(network.corners[turn.node], network.nodes[turn.node])
    return range_of_R_d(turn, corners, theta, float(np.hypot(*before)), float(np.hypot(*after)))


def evidence_end(turn: Turn, steps: Steps) -> int:
    """The number of steps that are available when a turn is detected."""
    return min(turn.last + AROUND, len(steps))


def steps_between(steps: Steps, first: int, last: int) -> Steps:
    """The steps [first, last)."""
    columns = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
    start = steps.start if first == 0 else float(steps.time[first - 1])
    return replace(steps, start=start, **{name: getattr(steps, name)[first:last] for name in columns})


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
    segments = Segments.of(_walkable(network))
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


FAR_START = 5.0  # [m] distance of the start from the nearest link that is noted


def correct(steps: Steps, floor: FloorPlan, start: Array, heading: float, method: Literal[1, 2] = 1) -> CorrectedWalk:
    """[map-matching] Sec. 3: at each turn, calibrate the track since the turn before so that it crosses no wall.

    start: ``(2,)`` [m]; heading: at the start [rad]; method: 1 or 2 of Sec. 3.6. Until the first turn the steps are
    used as measured, from then on with the calibration of the last turn (Sec. 3.7). A stretch includes the turn at its
    beginning: that heading change, times R_d, aligns the track with its corridor. Links are matched to the track with
    the turns as measured, since a wrong R_d of one corner would turn the next one into another link.

    Gyroscope drift along a corridor is not corrected. The paper's dead reckoning has none:
    `corridor_turns.straightened`.

    Raises ValueError if the floor has no corridor.
    """
    network = _walkable(floor.network)
    link, distance = Segments.of(network).nearest(start)
    notes = [f"the start is {distance:.1f} m from the nearest link"] if distance > FAR_START else []
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
        chosen, common = method_2(region, common) if method == 2 else (method_1(region), common)
        pair = chosen or pair
        stretches.append(Stretch(first, evidence_end(turn, steps), turn, region, pair, slack))
        notes += _notes(turn, chosen, slack)
        track = track.recalibrated(steps, first, pair)
        previous, link = turn, turn.after
    return CorrectedWalk(_trajectory(steps, track.position, track.heading, pair[0]), tuple(stretches), tuple(notes))


def _notes(turn: Turn, chosen: Pair | None, slack: float) -> list[str]:
    """A note if no pair was feasible at a turn, or only with walls moved outwards."""
    if chosen is None:
        return [f"turn at step {turn.first}: no pair stays within the walls; the calibration before was kept"]
    return [f"turn at step {turn.first}: walls were moved outwards by {slack} m"] if slack else []


def _walkable(network: Network) -> Network:
    """The network unchanged; raises ValueError if it has no link."""
    if not len(network):
        raise ValueError("the plan has no corridor: found no link, expected one")
    return network


def _trajectory(steps: Steps, track: Array, heading: Array, R_d: float) -> Trajectory:
    """The trajectory of a track ``(n + 1, 2)`` [m], with the rows of `dead_reckon`."""
    heading = np.append(heading, heading[-1] + R_d * steps.final_turn)
    return Trajectory(row_times(steps), np.concatenate([track, track[-1:]]), wrap_angle(heading), ("",) * len(heading))
