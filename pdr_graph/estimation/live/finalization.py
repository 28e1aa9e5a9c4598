"""Finalised part of a walk under way: rows and reports that have left the window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.factors.start import FRAME_SIGMA
from pdr_graph.estimation.live.step_buffer import Interval
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array

SPARSE = 5.0  # [s] between the covariances of rows that leave the window


@dataclass(frozen=True)
class TrajectoryRows:
    """Rows of a trajectory: time ``(n,)``, poses ``(n, 3)``, covariances ``(n, 3, 3)``, floors."""

    time: Array
    pose: Array
    covariance: Array
    floor: list[str]

    @classmethod
    def joined(cls, parts: Sequence[TrajectoryRows]) -> TrajectoryRows:
        """Rows that follow one another."""
        names = ("time", "pose", "covariance")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls(**columns, floor=[label for part in parts for label in part.floor])


@dataclass(frozen=True)
class FinalizedCheckpoint:
    """What a `FinalizedTrajectory` knows, but for the reports."""

    final: list[TrajectoryRows]
    left: list[TrajectoryRows]
    anchored: bool
    hinge: Array
    edge_time: float
    edge: Array


class FinalizedTrajectory:
    """Finalised rows and reports that were not taken yet.

    final: rows with their covariance; left: the last ones, with the spread about their keyframes alone; reports: by
    kind and number of the instance; anchored: it has been known for sure where the walk was: until then all goes with
    the start of the window, which was ``hinge``; edge: when the first keyframe's covariance was last taken, and it.
    """

    def __init__(self) -> None:
        self.final, self.left = list[TrajectoryRows](), list[TrajectoryRows]()
        self.reports: dict[str, dict[int, Any]] = {}
        self.anchored, self.hinge = False, np.zeros(3)
        self.edge = 0.0, np.eye(3) * FRAME_SIGMA**2

    def take(self, leaving: Sequence[Interval], at: Evaluation, start: Array | None) -> None:
        """Take the rows of intervals that leave, as ``at`` has them; start: the pose at the walk's, if that leaves."""
        if start is not None:
            at_start = np.array([leaving[0].begin])
            self.left.append(TrajectoryRows(at_start, start[None], np.zeros((1, 3, 3)), [leaving[0].label]))
        for n, one in enumerate(leaving):
            pose = at.ends[at.pieces.first[n] + one.row_piece]
            R = pose_rotation(np.full(len(pose), at.pose_i[n, 2]))
            spread = R @ one.bridge.spread[one.row_piece] @ R.transpose(0, 2, 1)
            self.left.append(TrajectoryRows(one.row_time, pose, spread, [one.label] * len(pose)))

    def rows(self, time: float, covariance: Array) -> list[TrajectoryRows]:
        """All rows. time, covariance: of the first keyframe that is in the window.

        Between two keyframes that left, the covariance changes evenly.
        """
        (before, one), found = self.edge, list(self.final)
        for rows in self.left:
            share = ((rows.time - before) / (time - before))[:, None, None]
            found.append(replace(rows, covariance=(1 - share) * one + share * covariance + rows.covariance))
        return found

    def finalize(self, time: float, covariance: Array) -> None:
        """Give the rows that have left their covariance, as `rows`."""
        self.final = self.rows(time, covariance)
        self.left, self.edge = [], (time, covariance)

    def move(self, after: Array) -> None:
        """Move with the start of the window, now at a pose ``(3,)``, what left it before that was sure."""
        before, self.hinge = self.hinge, after
        turn = after[2] - before[2]
        R = pose_rotation(np.array([turn]))[0]
        for past in (self.final, self.left):
            for k, rows in enumerate(past):
                moved = (rows.pose[:, :2] - before[:2]) @ R[:2, :2].T + after[:2]
                pose = np.column_stack([moved, rows.pose[:, 2] + turn])
                past[k] = replace(rows, pose=pose, covariance=R @ rows.covariance @ R.T)

    def hand_out(self) -> list[TrajectoryRows]:
        """Return the final rows, once; none until the position of the walk is certain."""
        if not self.anchored:
            return []
        handed, self.final, self.reports = self.final, [], {}
        return handed

    def checkpoint(self) -> FinalizedCheckpoint:
        """All that it knows but the reports."""
        return FinalizedCheckpoint(list(self.final), list(self.left), self.anchored, self.hinge, *self.edge)

    def restore(self, checkpoint: FinalizedCheckpoint) -> None:
        """Go on from a checkpoint."""
        self.final, self.left = list(checkpoint.final), list(checkpoint.left)
        self.anchored, self.hinge = checkpoint.anchored, checkpoint.hinge
        self.edge = checkpoint.edge_time, checkpoint.edge
