"""The steps of a walk under way, cut into intervals between keyframes as they come."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.factors.fixes import DRIVEN
from pdr_graph.estimation.factors.preintegration import (
    DECIMALS,
    PIECES_PER_KEYFRAME,
    Bridge,
    Pieces,
    bridge,
    intervals,
    preintegrate,
    whole_pieces,
)
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.gait.steps import concatenate_steps
from pdr_graph.types import INSTANT, Array, Index, Steps

CLOSE = 2 * INSTANT  # [s]: times are rounded to DECIMALS
END, LENGTH, ROW, GAP = 0, 1, 6, 7  # columns of whole pieces


@dataclass
class Interval:
    """The steps between two keyframes.

    i, j: numbers of these; segment: of its calibration; pieces, bridge: of itself; delta: ``(3,)`` where its steps lead
    by the calibration that is believed beforehand; row_time, row_piece: of the rows of the trajectory that end in it;
    fields: of the walls about each piece, None of none; label: of its floor.
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
        """Time of its first keyframe. [s]"""
        return float(self.pieces.keyframe_time[0])

    @property
    def end(self) -> float:
        """Time of its last keyframe. [s]"""
        return float(self.pieces.keyframe_time[1])


class StepBuffer:
    """The steps since the first keyframe that is kept.

    whole: pieces ``(m, 8)`` as of `whole_pieces`, whether a row of the trajectory ends with each, and whether it is a
    gap; start: of the first [s]; walked: before it [m]; chunks: the steps themselves.
    """

    def __init__(self) -> None:
        self.whole, self.start, self.walked = np.empty((0, 8)), np.nan, 0.0
        self.chunks: list[Steps] = []

    @property
    def end(self) -> float:
        """Until when the steps are known. [s]"""
        return float(self.whole[-1, END]) if len(self.whole) else self.start

    @property
    def steps(self) -> Steps:
        """All steps that are kept."""
        if len(self.chunks) > 1:
            self.chunks = [concatenate_steps(self.chunks)]
        return self.chunks[0]

    def append(self, steps: Steps) -> None:
        """Append the next steps."""
        if not self.chunks:
            self.start = round(steps.start, DECIMALS)
        self.chunks.append(steps)
        self.whole = self.with_tail(steps)

    def with_tail(self, tail: Steps | None) -> Array:
        """The whole pieces, and those of steps that follow but may change yet."""
        return self.whole if tail is None else np.concatenate([self.whole, _rows(tail)])

    def walked_by(self, time: float | Array) -> Array:
        """How far the steps have led by some times. [m]"""
        driven = np.where(self.whole[:, GAP] > 0, DRIVEN * np.diff(self.whole[:, END], prepend=self.start), 0)
        way = np.append(0.0, np.cumsum(self.whole[:, LENGTH] + driven))
        return np.asarray(self.walked + np.interp(time, np.append(self.start, self.whole[:, END]), way))

    def rows(self, begin: float, end: float) -> Array:
        """The whole pieces that end with a row of the trajectory, after ``begin`` and until ``end`` [s]."""
        ends = self.whole[:, END]
        return self.whole[(self.whole[:, ROW] > 0) & (ends > begin + CLOSE) & (ends <= end + CLOSE)]

    def keyframe_ends(self, last: float, marks: list[float]) -> list[float]:
        """The times of the next keyframes after ``last`` [s]: ``marks``, ends of gaps, and after so many pieces."""
        after = self.whole[:, END] > last + CLOSE
        if np.count_nonzero(after) < PIECES_PER_KEYFRAME and not marks and not self.whole[after, GAP].any():
            return []
        gaps = np.flatnonzero(after & (self.whole[:, GAP] > 0))
        begins = [self.whole[n - 1, END] if n else self.start for n in gaps]
        asked = np.unique([*(t for t in (*begins, *marks) if last + CLOSE < t <= self.end), *self.whole[gaps, END]])
        ends, pieces = list[float](), self.whole[after, END]
        for stop in asked.tolist():
            share = np.append(pieces[(pieces > last + CLOSE) & (pieces < stop - CLOSE)], stop)
            parts = -(-len(share) // PIECES_PER_KEYFRAME)
            ends += [float(part[-1]) for part in np.array_split(share, parts)]
            last = stop
        rest = pieces[pieces > last + CLOSE]
        return ends + rest[PIECES_PER_KEYFRAME - 1 :: PIECES_PER_KEYFRAME].tolist()

    def interval(self, i: int, j: int, begin: float, end: float, segment: int, c: Array, label: str) -> Interval:
        """The interval from keyframe i to j. c: as believed before the walk."""
        pieces = intervals(self.whole, self.start, begin, np.array([end]))
        ends, rows = begin + pieces.to_end[1], self.rows(begin, end)[:, END]
        which = np.minimum(np.searchsorted(ends, rows - CLOSE), len(ends) - 1)
        increments = preintegrate(pieces, c[None])
        own, delta = bridge(pieces, increments), increments.delta[-1]
        return Interval(i, j, segment, pieces, own, delta, rows, which, [None] * len(ends), label)

    def gap_within(self, begin: float, end: float) -> bool:
        """Whether the recording has a gap there."""
        return bool(self.rows(begin, end)[:, GAP].any())

    def forget(self, before: float) -> None:
        """Drop what ended before the first keyframe that is kept [s]."""
        gone = int(np.searchsorted(self.whole[:, END], before + CLOSE))
        if gone:
            start = float(self.whole[gone - 1, END])
            self.walked, self.start, self.whole = float(self.walked_by(start)), start, self.whole[gone:]
        self.chunks = [_later(steps, before) for steps in self.chunks if steps.end > before] or self.chunks[-1:]

    def checkpoint(self) -> StepCheckpoint:
        """All that it knows."""
        return StepCheckpoint(self.whole, self.start, self.walked, self.steps if self.chunks else None)

    @classmethod
    def restored(cls, checkpoint: StepCheckpoint) -> StepBuffer:
        """From a checkpoint."""
        own = cls()
        own.whole, own.start, own.walked = checkpoint.whole.reshape(-1, 8), checkpoint.start, checkpoint.walked
        own.chunks = [] if checkpoint.steps is None else [checkpoint.steps]
        return own


@dataclass(frozen=True)
class StepCheckpoint:
    """What a `StepBuffer` knows."""

    whole: Array
    start: float
    walked: float
    steps: Steps | None


def _later(steps: Steps, before: float) -> Steps:
    """The steps that end after a time [s]; they begin where the last of the others ended."""
    gone = int(np.searchsorted(steps.time, before))
    if not gone:
        return steps
    columns = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")
    kept = {name: getattr(steps, name)[gone:] for name in columns}
    return Steps(start=float(steps.time[gone - 1]), end=steps.end, final_turn=steps.final_turn, **kept)


def _rows(steps: Steps) -> Array:
    whole = whole_pieces(steps)
    row = np.isin(whole[:, END], np.round(steps.time, DECIMALS)).astype(float)
    gap = np.isin(whole[:, END], np.round(steps.time[steps.is_gap], DECIMALS)).astype(float)
    return np.column_stack([whole, row, gap])
