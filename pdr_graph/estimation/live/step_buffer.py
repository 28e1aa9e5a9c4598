"""Buffer of the steps of a walk under way, and their intervals between keyframes."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.factors.chain import (
    DECIMALS,
    Bridge,
    Pieces,
    bridge,
    intervals,
    preintegrate,
    whole_pieces,
)
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.inertial.barometer import with_goings
from pdr_graph.priors import FIXES, MOTION
from pdr_graph.types import INSTANT, Array, Index, Steps

CLOSE = 2 * INSTANT  # [s] within which two times are the same, since times are rounded to DECIMALS
END, LENGTH, VARIANCE, ROW, GAP = 0, 1, 3, 6, 7  # columns of whole pieces


@dataclass
class Interval:
    """The steps between two keyframes.

    i, j: numbers of the keyframes; segment: number of the calibration; pieces, bridge: of its steps; delta: ``(3,)``
    displacement with the prior mean of the calibration; row_time [s], row_piece: of the trajectory rows that end in it;
    fields: distance to the walls of each piece, None without; label: of its floor.
    """

    i: int
    j: int
    segment: int
    pieces: Pieces
    bridge: Bridge
    delta: Array
    row_time: Array
    row_piece: Index
    fields: list[DistanceField | None]
    label: str

    @property
    def begin(self) -> float:
        """Time of the first keyframe. [s]"""
        return float(self.pieces.keyframe_time[0])

    @property
    def end(self) -> float:
        """Time of the last keyframe. [s]"""
        return float(self.pieces.keyframe_time[1])


class StepBuffer:
    """The steps since the first keyframe of the window.

    whole: pieces ``(m, 8)``: columns of `whole_pieces`, then 1 if a trajectory row ends with the piece, 1 if it is a
    gap; start: of the first piece [s]; walked: distance before it [m]; chunks: the steps.
    """

    def __init__(self) -> None:
        self.whole, self.start, self.walked = np.empty((0, 8)), np.nan, 0.0
        self.chunks: list[Steps] = []

    @property
    def end(self) -> float:
        """End of the last certain step. [s]"""
        return float(self.whole[-1, END]) if len(self.whole) else self.start

    @property
    def steps(self) -> Steps:
        """All stored steps."""
        if len(self.chunks) > 1:
            self.chunks = [concatenate_steps(self.chunks)]
        return self.chunks[0]

    def append(self, steps: Steps) -> None:
        """Append the next steps."""
        if not self.chunks:
            self.start = round(steps.start, DECIMALS)
        self.chunks.append(steps)
        self.whole = self.with_tail(steps)

    def set_goings(self, goings: Array) -> float:
        """Give the steps on stairs the length of the treads; returns when the first changed one ended [s], or infinity.

        goings: ``(k, 3)``, see `goings_of`.
        """
        first, whole, chunks = np.inf, self.whole.copy(), list[Steps]()
        for steps in self.chunks:
            chunks.append(with_goings(steps, goings))
            changed = np.flatnonzero(chunks[-1].length != steps.length)
            ends = np.round(steps.time[changed], DECIMALS)
            row = np.minimum(np.searchsorted(whole[:, END], ends - CLOSE), len(whole) - 1)
            stored = np.abs(whole[row, END] - ends) < CLOSE
            row, changed = row[stored], changed[stored]
            whole[row, LENGTH], whole[row, VARIANCE] = chunks[-1].length[changed], chunks[-1].sigma_length[changed] ** 2
            first = min(first, float(whole[row, END].min(initial=np.inf)))
        self.chunks, self.whole = chunks, whole
        return first

    def with_tail(self, tail: Steps | None) -> Array:
        """The whole pieces, followed by those of provisional steps."""
        return self.whole if tail is None else np.concatenate([self.whole, _rows(tail)])

    def walked_by(self, time: float | Array) -> Array:
        """Distance walked by each time [s], with gaps at speed FIXES.driven. [m]"""
        driven = np.where(self.whole[:, GAP] > 0, FIXES.driven * np.diff(self.whole[:, END], prepend=self.start), 0)
        distance = np.append(0.0, np.cumsum(self.whole[:, LENGTH] + driven))
        return np.asarray(self.walked + np.interp(time, np.append(self.start, self.whole[:, END]), distance))

    def rows(self, begin: float, end: float) -> Array:
        """The pieces after ``begin`` and until ``end`` [s] that end with a trajectory row."""
        ends = self.whole[:, END]
        return self.whole[(self.whole[:, ROW] > 0) & (ends > begin + CLOSE) & (ends <= end + CLOSE)]

    def keyframe_ends(self, last: float, marks: list[float]) -> list[float]:
        """Times [s] of the next keyframes after ``last``: at ``marks``, gaps and each PIECES_PER_KEYFRAME pieces."""
        after = self.whole[:, END] > last + CLOSE
        if np.count_nonzero(after) < MOTION.steps_per_keyframe and not marks and not self.whole[after, GAP].any():
            return []
        gaps = np.flatnonzero(after & (self.whole[:, GAP] > 0))
        begins = [self.whole[n - 1, END] if n else self.start for n in gaps]
        required = np.unique([*(t for t in (*begins, *marks) if last + CLOSE < t <= self.end), *self.whole[gaps, END]])
        ends, pieces = list[float](), self.whole[after, END]
        for stop in required.tolist():
            share = np.append(pieces[(pieces > last + CLOSE) & (pieces < stop - CLOSE)], stop)
            parts = -(-len(share) // MOTION.steps_per_keyframe)
            ends += [float(part[-1]) for part in np.array_split(share, parts)]
            last = stop
        rest = pieces[pieces > last + CLOSE]
        return ends + rest[MOTION.steps_per_keyframe - 1 :: MOTION.steps_per_keyframe].tolist()

    def interval(self, i: int, j: int, begin: float, end: float, segment: int, c: Array, label: str) -> Interval:
        """The interval from keyframe i to j, from ``begin`` to ``end`` [s]; c: prior mean of the calibration."""
        pieces = intervals(self.whole, self.start, begin, np.array([end]))
        ends, rows = begin + pieces.to_end[1], self.rows(begin, end)[:, END]
        which = np.minimum(np.searchsorted(ends, rows - CLOSE), len(ends) - 1)
        increments = preintegrate(pieces, c[None])
        bridges, delta = bridge(pieces, increments), increments.delta[-1]
        return Interval(i, j, segment, pieces, bridges, delta, rows, which, [None] * len(ends), label)

    def gap_within(self, begin: float, end: float) -> bool:
        """True if the recording has a gap between ``begin`` and ``end`` [s]."""
        return bool(self.rows(begin, end)[:, GAP].any())

    def forget(self, before: float) -> None:
        """Drop steps that ended before the first keyframe of the window, ``before`` [s]."""
        count = int(np.searchsorted(self.whole[:, END], before + CLOSE))
        if count:
            start = float(self.whole[count - 1, END])
            self.walked, self.start, self.whole = float(self.walked_by(start)), start, self.whole[count:]
        self.chunks = [later_steps(self.steps, before)]

    def copy(self) -> StepBuffer:
        """An independent buffer of the same steps."""
        other = copy(self)
        other.chunks = list(self.chunks)
        return other


def later_steps(steps: Steps, before: float) -> Steps:
    """The steps that end after ``before`` [s]; they start where the step before them ended."""
    count = int(np.searchsorted(steps.time, before))
    if not count:
        return steps
    columns = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
    later = {name: getattr(steps, name)[count:] for name in columns}
    return Steps(start=float(steps.time[count - 1]), end=steps.end, final_turn=steps.final_turn, **later)


def _rows(steps: Steps) -> Array:
    """Whole pieces ``(m, 8)`` of some steps, see `StepBuffer`."""
    whole = whole_pieces(steps)
    row = np.isin(whole[:, END], np.round(steps.time, DECIMALS)).astype(float)
    gap = np.isin(whole[:, END], np.round(steps.time[steps.is_gap], DECIMALS)).astype(float)
    return np.column_stack([whole, row, gap])
