"""Corridors as measurements: turns at intersections, and directions of straight runs.

A turn matched to an intersection has two bounds: [map-matching] Eq. (6) limits its angle, from one corridor into the
other; and it happens in the intersection, between the walls of both corridors. The residual is zero within the bounds
and linear outside. Corridors and intersections are associated along one walk; the association is data, and no factor
searches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from pdr_graph.estimation.factors.base import EXACT, FactorBlock, Linearized, Measurement
from pdr_graph.estimation.factors.heading_prior import heading_block
from pdr_graph.estimation.factors.start import CorridorUse
from pdr_graph.floor.building import FloorSequence
from pdr_graph.floor.corridor_runs import Run, straight_runs, turns_between
from pdr_graph.floor.corridor_turns import Turn, range_of_turn
from pdr_graph.floor.network import Network
from pdr_graph.geometry import wrap_angle
from pdr_graph.types import Array, Headings, Index

if TYPE_CHECKING:
    from pdr_graph.estimation.factors.chain import Evaluation

SIGMA_TURNED = 0.05  # [rad] of a heading change: few steps of a turn are straight in a corridor
SIGMA_PLACE = 0.5  # [m] outside the intersection: corners are cut, and the step nearest to the turn is half a step off
SIGMA_SIDE = 0.3  # of a corridor's width, lateral position at either end of a run; 1/√12 if uniformly distributed
SIGMA_AHEAD = 0.03  # [rad] between the line from end to end of a run and the keyframe's dead-reckoned heading


@dataclass(frozen=True, eq=False)
class Turns:
    """Turns of a walk at intersections, ``t`` of them.

    before, after: ``(t,)`` keyframes in the corridors on either side; least, most: ``(t,)`` heading change from the one
    to the other, counter-clockwise [rad]; piece: ``(t,)`` of the walk that ends where it turns; normal: ``(t, 4, 2)``
    outward of the sides of the intersection; edge: ``(t, 4)`` how far along these the sides are [m].
    """

    before: Index
    after: Index
    least: Array
    most: Array
    piece: Index
    normal: Array
    edge: Array

    def __len__(self) -> int:
        return len(self.piece)

    @classmethod
    def together(cls, turns: Sequence[Turns]) -> Turns:
        """Concatenate; empty for an empty list."""
        none, numbers = np.empty(0), np.empty(0, dtype=np.intp)
        empty = cls(numbers, numbers, none, none, numbers, np.empty((0, 4, 2)), np.empty((0, 4)))
        columns = [[getattr(turn, column.name) for turn in (empty, *turns)] for column in fields(cls)]
        return cls(*(np.concatenate(column) for column in columns))

    def heading_change(self, heading: Array) -> tuple[Array, Array]:
        """Residual ``(t,)`` of the heading change between keyframes ``(k + 1,)``, and its derivative:

            r = [ max(0, δ − β) − max(0, α − δ) ] / σ,      δ = θ_after − θ_before

        The derivative is by θ_after; by θ_before it is the opposite.
        """
        off = wrap_angle(heading[self.after] - heading[self.before] - (self.least + self.most) / 2)
        beyond = np.maximum(np.abs(off) - (self.most - self.least) / 2, 0.0)
        return np.sign(off) * beyond / SIGMA_TURNED, (beyond > 0) / SIGMA_TURNED

    def outside(self, turning: Linearized) -> Linearized:
        """Residual ``(t, 4)`` of each turn beyond the sides of its intersection: r = max(0, n p − e) / σ.

        For a rectangular intersection the squares add up to that of the distance. turning: poses of the pieces that
        turn.
        """
        beyond = np.einsum("tsk,tk->ts", self.normal, turning.value[:, :2]) - self.edge
        slope = np.zeros((*beyond.shape, 3))
        slope[:, :, :2] = self.normal * (beyond > 0)[:, :, None] / SIGMA_PLACE
        value = np.maximum(beyond, 0.0) / SIGMA_PLACE
        return Linearized(value, slope @ turning.by_i, slope @ turning.by_j, slope @ turning.by_c)


@dataclass(frozen=True, eq=False)
class CorridorFactor(Measurement):
    """Turns at intersections, and directions of straight runs.

    floor_sequence: the floor of each piece; use: which evidence it adds; turns; keyframe: ``(r,)`` in each run;
    direction: its heading.
    """

    floor_sequence: FloorSequence
    use: CorridorUse
    turns: Turns
    keyframe: Index
    direction: Headings

    name: ClassVar[str] = "corridors"
    on_plan: ClassVar[bool] = True

    @classmethod
    def about(cls, floor_sequence: FloorSequence, use: CorridorUse) -> CorridorFactor:
        """The corridors of the floors that a walk is on, associated with none of its runs yet."""
        return cls(floor_sequence, use, Turns.together([]), np.empty(0, dtype=np.intp), Headings.none())

    def associated(self, at: Evaluation, stray: Array | float | None = None, alike: float = 1.0) -> Self:
        """Match the turns and straight runs of the walk ``at``.

        Turns need a plan with drawn intersections. A run that begins or ends with a matched turn adds no direction.
        """
        turns, directions, pieces = list[Turns](), list[tuple[int, float, float]](), at.pieces
        for floor, begin, end in self.floor_sequence.spans:
            moved = begin + np.flatnonzero(pieces.length[begin:end] > 0)
            track = _Track(at.ends[moved, :2], moved, np.append(-1, pieces.last), at.state.poses[:, 2])
            runs = [run for run in straight_runs(track.position, floor.distance) if track.keyframe(run) is not None]
            network = floor.drawn_network if self.use.turns else None
            matched = list(turns_between(runs, track.position, network)) if network else []
            turns += [_turn(track, network, before, after, turn) for before, after, turn in matched if network]
            turning = [run for before, after, _ in matched for run in (before, after)]
            directions += [_direction(track, run) for run in runs if self.use.directions and run not in turning]
        keyframe, direction, sigma = np.array(directions).reshape(-1, 3).T
        rows = keyframe.astype(np.intp)
        headings = Headings(at.chain.time[rows], direction, sigma)
        return replace(self, turns=Turns.together(turns), keyframe=rows, direction=headings)

    def factors(self, at: Evaluation) -> Sequence[FactorBlock]:
        """Factors of the directions of runs, and of the heading changes and places of turns."""
        number = at.state.number("x")[self.keyframe]
        directions = heading_block(f"{self.name}.direction", at, self.keyframe, self.direction, number)
        return [directions, *self._turns(at)] if len(self.turns) else [directions]

    def _turns(self, at: Evaluation) -> list[FactorBlock]:
        turns, number = self.turns, at.chain.number[self.turns.after]
        value, slope = turns.heading_change(at.state.poses[:, 2])
        turning = at.poses_of(turns.piece)
        corner, interval = turns.outside(turning), at.pieces.interval[turns.piece]

        def by_headings() -> list[Array]:
            by = np.zeros((len(turns), 1, 3))
            by[:, 0, 2] = slope
            return [-by, by]

        ends = [("x", turns.before), ("x", turns.after)]
        place = [("x", interval), ("x", interval + 1), ("c", at.chain.segment[interval])]
        return [
            FactorBlock.uniform(
                f"{self.name}.turn",
                value[:, None],
                ends,
                by_headings,
                number,
                signature=EXACT * (turns.least + turns.most),
            ),
            FactorBlock.uniform(
                f"{self.name}.intersection",
                corner.value,
                place,
                lambda: [corner.by_i, corner.by_j, corner.by_c],
                number,
                signature=EXACT * turns.edge.sum(axis=1),
            ),
        ]


@dataclass(frozen=True)
class _Track:
    """A walk on one floor.

    position: ``(n, 2)`` [m] and piece ``(n,)`` of those that moved; keyframe_piece: ``(k + 1,)`` that ends at each
    keyframe; heading: ``(k + 1,)`` there [rad].
    """

    position: Array
    piece: Index
    keyframe_piece: Index
    heading: Array

    def keyframe(self, run: Run) -> int | None:
        """The keyframe nearest to the middle of a run; None if the run has none."""
        first, last = self.piece[run.first], self.piece[run.last - 1]
        middle = self.piece[(run.first + run.last) // 2]
        nearest = int(np.argmin(np.abs(self.keyframe_piece - middle)))
        return nearest if first <= self.keyframe_piece[nearest] <= last else None

    def aside(self, keyframe: int, begin: int, end: int) -> float:
        """Angle [rad] of a keyframe's heading to the left of the line between two positions, by index."""
        return float(wrap_angle(self.heading[keyframe] - _bearing(self.position[end] - self.position[begin])))


def _direction(track: _Track, run: Run) -> tuple[int, float, float]:
    """Keyframe, heading and sigma [rad] of a straight run, which leads along its corridor from end to end."""
    keyframe, ends = track.keyframe(run), (run.first, run.last - 1)
    assert keyframe is not None
    length = float(np.hypot(*(track.position[ends[1]] - track.position[ends[0]])))
    sigma = np.hypot(np.sqrt(2) * SIGMA_SIDE * run.width / length, np.hypot(SIGMA_AHEAD, run.spread))
    return keyframe, float(wrap_angle(run.direction + track.aside(keyframe, *ends))), float(sigma)


def _turn(track: _Track, network: Network, before: Run, after: Run, turn: Turn) -> Turns:
    """The bounds of one turn, by [map-matching] Eq. (6) along the runs before and after it."""
    i, j = track.keyframe(before), track.keyframe(after)
    assert i is not None
    assert j is not None
    corners, at = network.corners[turn.node], turn.first
    come, gone = (np.hypot(*(track.position[at] - track.position[n])) for n in (before.first, after.last - 1))
    aside = track.aside(j, at, after.last - 1) - track.aside(i, before.first, at)
    least, most = np.array(range_of_turn(turn, corners, float(come), float(gone))) + aside
    side = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.hypot(*side.T)[:, None]
    edge = np.sum(normal * corners, axis=1)
    columns = (i, j, least, most, track.piece[at], normal, edge)
    return Turns(*(np.array([column]) for column in columns))


def _bearing(way: Array) -> float:
    return float(np.arctan2(way[1], way[0]))
