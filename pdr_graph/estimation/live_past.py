"""What of a walk under way has left the window."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdr_graph.estimation.factors import Evaluation
from pdr_graph.estimation.graph import FRAME_SIGMA
from pdr_graph.estimation.live_way import Interval
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array, FixReport

SPARSE = 5.0  # [s] between the covariances of rows that leave the window


@dataclass(frozen=True)
class Rows:
    """Rows of a trajectory: time ``(n,)``, poses ``(n, 3)``, covariances ``(n, 3, 3)``, floors."""

    time: Array
    pose: Array
    covariance: Array
    floor: list[str]

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """Rows that follow one another."""
        names = ("time", "pose", "covariance")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls(**columns, floor=[label for part in parts for label in part.floor])


class Past:
    """Rows and reports since they were handed out.

    settled: rows with their covariance; left: the last ones, with the spread about their keyframes alone; anchored: it
    has been known for sure where the walk was: until then all goes with the start of the window, which was ``hinge``.
    """

    def __init__(self) -> None:
        self.settled, self.left, self.reports = list[Rows](), list[Rows](), list[FixReport]()
        self.anchored, self.hinge = False, np.zeros(3)
        self.edge = 0.0, np.eye(3) * FRAME_SIGMA**2  # when the first keyframe's covariance was asked for; what it was

    def take(self, leaving: Sequence[Interval], own: Evaluation, start: Array | None) -> None:
        """The rows of intervals that leave, where ``own`` has them; start: the pose at the walk's, if that is there."""
        if start is not None:
            at_start = np.array([leaving[0].begin])
            self.left.append(Rows(at_start, start[None], np.zeros((1, 3, 3)), [leaving[0].label]))
        for n, one in enumerate(leaving):
            pose = own.ends[own.pieces.first[n] + one.row_piece]
            R = pose_rotation(np.full(len(pose), own.pose_i[n, 2]))
            spread = R @ one.bridge.spread[one.row_piece] @ R.transpose(0, 2, 1)
            self.left.append(Rows(one.row_time, pose, spread, [one.label] * len(pose)))

    def rows(self, time: float, covariance: Array) -> list[Rows]:
        """All of them. time, covariance: of the first keyframe that is in the window.

        Between two keyframes that left, the covariance changes evenly.
        """
        (before, one), found = self.edge, list(self.settled)
        for rows in self.left:
            share = ((rows.time - before) / (time - before))[:, None, None]
            found.append(replace(rows, covariance=(1 - share) * one + share * covariance + rows.covariance))
        return found

    def settle(self, time: float, covariance: Array) -> None:
        """Give the rows that have left their covariance, as `rows`."""
        self.settled = self.rows(time, covariance)
        self.left, self.edge = [], (time, covariance)

    def move(self, after: Array) -> None:
        """The start of the window is laid at a pose ``(3,)``: what left it before that was sure goes with it."""
        before, self.hinge = self.hinge, after
        turn = after[2] - before[2]
        R = pose_rotation(np.array([turn]))[0]
        for past in (self.settled, self.left):
            for k, rows in enumerate(past):
                moved = (rows.pose[:, :2] - before[:2]) @ R[:2, :2].T + after[:2]
                pose = np.column_stack([moved, rows.pose[:, 2] + turn])
                past[k] = replace(rows, pose=pose, covariance=R @ rows.covariance @ R.T)

    def hand_out(self) -> list[Rows]:
        """The rows that are settled, once; none while nothing has told for sure where the walk was."""
        if not self.anchored:
            return []
        handed, self.settled, self.reports = self.settled, [], []
        return handed

    def state(self) -> dict[str, Any]:
        """All that it knows but the reports, as numbers."""
        rows = {name: [vars(part) for part in getattr(self, name)] for name in ("settled", "left")}
        return {**rows, "anchored": self.anchored, "hinge": self.hinge, "edge": list(self.edge)}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        self.settled, self.left = (_rows(state[name]) for name in ("settled", "left"))
        self.anchored, self.hinge = bool(state["anchored"]), np.array(state["hinge"])
        self.edge = float(state["edge"][0]), np.array(state["edge"][1])


def _rows(states: Iterable[dict[str, Any]]) -> list[Rows]:
    return [Rows(**one) for one in states]
