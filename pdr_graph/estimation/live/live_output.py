"""Output of a live smoother: current pose, the walk so far with its covariance, reports."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.covariance import CovarianceBlocks, covariance_of_pieces
from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.live.finalization import TrajectoryRows
from pdr_graph.estimation.live.live_graph import LiveGraph
from pdr_graph.estimation.live.prediction import Belief, Position, predicted
from pdr_graph.estimation.live.step_buffer import CLOSE, END, ROW
from pdr_graph.estimation.live.window import ALL
from pdr_graph.estimation.results import prior_sigma
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Calibration, Estimate, Fixes, Steps


class LiveOutput:
    """Results for a walk under way."""

    graph: LiveGraph
    sure: bool
    finished: bool
    _final: Estimate | None

    def __init__(self) -> None:
        self._last: tuple[gtsam.Values, Belief] | None = None

    def belief(self, tail: Steps | None = None, until: float | None = None) -> Belief:
        """The current belief: that of the last keyframe, through the steps and fixes since.

        tail: steps that may change yet; until: a moment [s], the present by default.
        """
        window = self.graph.window
        whole, at = window.steps.with_tail(tail), window.times[-1]
        end = float(whole[-1, END]) if len(whole) else at
        end = end if until is None else min(end, until)
        fixes, known = self._fixes_between(at, end), self.last_belief()
        if fixes and not self.graph.placed:
            known = known.anywhere(fixes[0].position)
        return predicted(known, whole, window.steps.start, at, end, fixes, self.sure)

    def last_belief(self) -> Belief:
        """The belief about the last keyframe and its calibration."""
        graph, window = self.graph, self.graph.window
        if self._last is None or self._last[0] is not graph.isam.values:
            T = np.eye(6)
            T[:3, :3] = pose_rotation(window.pose[-1:, 2])[0]
            joint = T @ graph.isam.covariance([X(window.keyframes[-1]), C(window.segment)]) @ T.T
            mean = np.append(window.pose[-1], window.c[window.segment])
            self._last = graph.isam.values, Belief(mean, joint)
        return self._last[1]

    def _fixes_between(self, begin: float, end: float) -> list[Position]:
        """The fixes that have no keyframe yet, each with the share of information that others do not have too."""
        rows = self.graph.log.rows(Fixes)
        if rows is None or not ((rows.time > begin + CLOSE) & (rows.time <= end)).any():
            return []
        known = next((one for one in self.graph.current()[1] if isinstance(one, FixFactor)), None)
        found = []
        for n in np.flatnonzero((rows.time > begin + CLOSE) & (rows.time <= end)).tolist():
            share = 1.0
            if known is not None and rows.source[n]:
                own = [k for k, source in enumerate(known.fixes.source) if source == rows.source[n]]
                share = float((known.sigma[own[-1]] / known.independent_sigma[own[-1]]) ** 2) if own else 1.0
            found.append(Position(float(rows.time[n]), rows.position[n], float(rows.sigma[n]), share))
        return found

    def rows_past(self) -> list[TrajectoryRows]:
        """Rows that have left the window and were not taken yet."""
        return self.graph.past.rows(self.graph.window.times[0], self.graph.covariance(0))

    def rows(self) -> TrajectoryRows:
        """The walk in the window until its last keyframe, with its start and its end where these are in it."""
        window, graph = self.graph.window, self.graph
        first = TrajectoryRows(np.array(window.times[:1]), window.pose[:1], graph.covariance(0)[None], [window.floor])
        if not window.intervals:
            return first
        part = window.part(ALL)
        at = part.chain.evaluate(part.state(graph.isam.values, ()))
        linear = graph.isam.graph().linearize(graph.isam.values)
        net = linear.eliminateSequential(gtsam.Ordering.MetisGaussianFactorGraph(linear))
        keys = [(X(one.i), X(one.j), C(one.segment)) for one in window.intervals]
        which = np.concatenate([n + one.row_piece for n, one in zip(at.pieces.first, window.intervals, strict=True)])
        covariance = covariance_of_pieces(CovarianceBlocks(net), keys, at, which)
        time = np.concatenate([one.row_time for one in window.intervals])
        labels = [one.label for one in window.intervals for _ in one.row_time]
        parts = [first] * window.complete + [TrajectoryRows(time, at.ends[which], covariance, labels)]
        if self.finished and not (len(time) and time[-1] > window.times[-1] - CLOSE):
            end = graph.covariance(-1)[None]
            parts.append(TrajectoryRows(np.array(window.times[-1:]), window.pose[-1:], end, [window.floor]))
        return TrajectoryRows.joined(parts)

    def rows_ahead(self, tail: Steps | None = None) -> TrajectoryRows:
        """Predicted rows of the steps since the last keyframe; the last row is the present."""
        window = self.graph.window
        whole = window.steps.with_tail(tail)
        ends = whole[(whole[:, END] > window.times[-1] + CLOSE) & (whole[:, ROW] > 0), END]
        moments = np.unique(np.append(ends, whole[-1:, END]))
        moments = moments[moments > window.times[-1] + CLOSE]
        beliefs = [self.belief(tail, until) for until in moments.tolist()]
        pose = np.array([one.mean[:3] for one in beliefs]).reshape(-1, 3)
        covariance = np.array([one.covariance[:3, :3] for one in beliefs]).reshape(-1, 3, 3)
        return TrajectoryRows(moments, pose, covariance, [window.floor] * len(moments))

    def reports(self) -> dict[str, tuple[Any, ...]]:
        """Reports of each measurement by kind; of those outside the window, since rows were last taken."""
        at, past = self.graph.evaluate(everything=True), self.graph.past.reports
        found = {}
        for one in at.measurements:
            reports = one.reports(at)
            if one.instances is not None:
                reports = tuple(
                    {**past.get(one.name, {}), **dict(zip(one.instances[0].tolist(), reports, strict=True))}.values()
                )
            if reports:
                found[one.name] = reports
        return found

    def calibration(self) -> Calibration | None:
        """(R_s, R_d, b) in the segments of the window."""
        window, segments = self.graph.window, self.graph.window.segments
        if not window.intervals:
            return None
        value = np.array([window.c[segment] for segment in segments])
        covariance = np.array([self.graph.isam.covariance([C(segment)]) for segment in segments])
        start = np.array([min(one.begin for one in window.intervals if one.segment == s) for s in segments])
        return Calibration(start, value, covariance, prior_sigma(self.graph.prior, np.array(segments)))

    @property
    def final(self) -> Estimate | None:
        """The batch's estimate of the whole walk, once it has ended with all of it in the window."""
        return self._final

    def hand_out(self) -> list[TrajectoryRows]:
        """The rows that are final, once."""
        return self.graph.past.hand_out()
