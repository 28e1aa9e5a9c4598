"""What has left the window of a walk under way: rows and reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.start import FRAME_SIGMA
from pdr_graph.estimation.live.window import Interval
from pdr_graph.geometry import pose_rotation, rotation
from pdr_graph.types import Array


@dataclass(frozen=True)
class TrajectoryRows:
    """Rows of a trajectory: time ``(n,)``, poses ``(n, 3)``, covariances ``(n, 3, 3)``, floors."""

    time: Array
    pose: Array
    covariance: Array
    floor: list[str]

    @classmethod
    def joined(cls, parts: Sequence[TrajectoryRows]) -> TrajectoryRows:
        """Concatenate rows that follow one another."""
        names = ("time", "pose", "covariance")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls(**columns, floor=[label for part in parts for label in part.floor])


@dataclass(frozen=True)
class Excess:
    """Covariance ``(n, 3, 3)`` at times ``(n,)`` [s] to add to that of the solver, in the output axes; 0 by default."""

    time: Array = field(default_factory=lambda: np.zeros(1))
    covariance: Array = field(default_factory=lambda: np.zeros((1, 3, 3)))

    def at(self, time: Array) -> Array:
        """The covariances ``(n, 3, 3)`` at times ``(n,)`` [s]; constant before the first and after the last."""
        place = np.interp(time, self.time, np.arange(len(self.time)))
        before = place.astype(np.intp)
        after, share = np.minimum(before + 1, len(self.time) - 1), (place - before)[:, None, None]
        return (1 - share) * self.covariance[before] + share * self.covariance[after]


def moved(pose: Array, before: Array, after: Array) -> Array:
    """Move poses ``(n, 3)`` rigidly, as pose ``before (3,)`` moves to ``after (3,)``."""
    turn = after[2] - before[2]
    return np.column_stack([(pose[:, :2] - before[:2]) @ rotation(turn).T + after[:2], pose[:, 2] + turn])


class FinalizedTrajectory:
    """Finalised rows and reports that `pop_finalized` has not returned yet.

    rows: with covariance; reports: by kind and number of the instance; anchored: the position of the walk has been
    certain once; until then all rows move with the start of the window, whose last pose was ``hinge``; edge: time [s]
    and covariance of the first keyframe of the window.
    """

    def __init__(self) -> None:
        self.rows = list[TrajectoryRows]()
        self.reports: dict[str, dict[int, Any]] = {}
        self.anchored, self.hinge = False, np.zeros(3)
        self.edge = 0.0, np.eye(3) * FRAME_SIGMA**2

    def begin(self, start: Array, after: Array, covariance: Array) -> None:
        """Set the covariance of the first pose of a walk whose position is measured; otherwise it defines the frame.

        The solver has marginalised it: it is that of the first keyframe in the window, moved back rigidly, which
        neglects the errors of the few steps between them. start, after ``(3,)``: the poses of both; covariance
        ``(3, 3)``: of the keyframe.
        """
        by = np.eye(3)
        by[:2, 2] = rotation(np.pi / 2) @ (start[:2] - after[:2])
        self.edge = self.edge[0], by @ covariance @ by.T

    def take(self, leaving: Sequence[Interval], at: Evaluation, start: Array | None, covariance: Array) -> None:
        """Append the rows of intervals that leave the window.

        Covariances between keyframes are interpolated from the edge to the new edge, whose ``covariance`` is
        ``(3, 3)``. start: first pose of the walk if it leaves with them.
        """
        (begin, before), end = self.edge, leaving[-1].end
        if start is not None:
            label = [leaving[0].label]
            self.rows.append(TrajectoryRows(np.array([leaving[0].begin]), start[None], before[None], label))
        for n, interval in enumerate(leaving):
            pose = at.ends[at.pieces.first[n] + interval.row_piece]
            R = pose_rotation(np.full(len(pose), at.pose_i[n, 2]))
            spread = R @ interval.bridge.spread[interval.row_piece] @ R.transpose(0, 2, 1)
            share = ((interval.row_time - begin) / (end - begin))[:, None, None]
            spread = (1 - share) * before + share * covariance + spread
            self.rows.append(TrajectoryRows(interval.row_time, pose, spread, [interval.label] * len(pose)))
        self.edge = end, covariance

    def move(self, after: Array) -> None:
        """Move all rows rigidly with the start of the window, which is now at pose ``after (3,)``."""
        before, self.hinge = self.hinge, after
        R = pose_rotation(after[2:] - before[2])[0]
        for k, rows in enumerate(self.rows):
            self.rows[k] = replace(rows, pose=moved(rows.pose, before, after), covariance=R @ rows.covariance @ R.T)

    def pop_finalized(self) -> list[TrajectoryRows]:
        """Return and remove the rows; none until the position of the walk is certain."""
        if not self.anchored:
            return []
        rows, self.rows, self.reports = self.rows, [], {}
        return rows
