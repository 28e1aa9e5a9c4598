"""Output of a live smoother: current pose, the walk so far with covariance, reports."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from pdr_graph.estimation.covariance import CovarianceBlocks, covariance_of_pieces
from pdr_graph.estimation.factors.fixes import FixFactor
from pdr_graph.estimation.live.finalization import TrajectoryRows
from pdr_graph.estimation.live.live_graph import LiveGraph
from pdr_graph.estimation.live.prediction import Belief, Position, predict
from pdr_graph.estimation.live.step_buffer import CLOSE, END, ROW
from pdr_graph.estimation.live.window import ALL
from pdr_graph.estimation.results import prior_sigma
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Calibration, Estimate, Fixes, Steps


class LiveOutput:
    """Results of a walk under way; base class of `LiveSmoother`."""

    graph: LiveGraph
    sure: bool
    finished: bool
    _final: Estimate | None

    def __init__(self) -> None:
        self._last: tuple[gtsam.Values, Belief] | None = None

    def belief(self, tail: Steps | None = None, until: float | None = None) -> Belief:
        """State at ``until`` [s], by default now: the last keyframe, predicted through the steps and fixes since.

        tail: provisional steps.
        """
        window = self.graph.window
        whole, at = window.steps.with_tail(tail), window.times[-1]
        end = float(whole[-1, END]) if len(whole) else at
        end = end if until is None else min(end, until)
        fixes, belief = self._fixes_between(at, end), self.keyframe_belief()
        if fixes and not self.graph.has_position:
            belief = belief.with_unknown_position(fixes[0].position)
        predicted = predict(belief, whole, window.steps.start, at, end, fixes, self.sure)
        stated = predicted.covariance.copy()
        stated[:3, :3] += self.graph.excess.at(np.array([end]))[0]
        return Belief(predicted.mean, stated)

    def keyframe_belief(self) -> Belief:
        """State of the last keyframe and its calibration."""
        graph, window = self.graph, self.graph.window
        if self._last is None or self._last[0] is not graph.isam.values:
            T = np.eye(6)
            T[:3, :3] = pose_rotation(window.pose[-1:, 2])[0]
            joint = T @ graph.isam.covariance([X(window.keyframes[-1]), C(window.segment)]) @ T.T
            mean = np.append(window.pose[-1], window.c[window.segment])
            self._last = graph.isam.values, Belief(mean, joint)
        return self._last[1]

    def _fixes_between(self, begin: float, end: float) -> list[Position]:
        """The fixes after ``begin`` until ``end`` [s], which have no keyframe yet."""
        rows = self.graph.log.rows(Fixes)
        if rows is None or not ((rows.time > begin + CLOSE) & (rows.time <= end)).any():
            return []
        factor = next(
            (measurement for measurement in self.graph.current()[1] if isinstance(measurement, FixFactor)), None
        )
        positions = []
        for n in np.flatnonzero((rows.time > begin + CLOSE) & (rows.time <= end)).tolist():
            share = 1.0
            if factor is not None and rows.source[n]:
                same_source = [k for k, source in enumerate(factor.fixes.source) if source == rows.source[n]]
                share = (
                    float((factor.sigma[same_source[-1]] / factor.independent_sigma[same_source[-1]]) ** 2)
                    if same_source
                    else 1.0
                )
            positions.append(Position(float(rows.time[n]), rows.position[n], float(rows.sigma[n]), share))
        return positions

    def pending_rows(self) -> list[TrajectoryRows]:
        """Finalised rows that `pop_finalized` has not returned yet."""
        return self.graph.finalized.rows(self.graph.window.times[0], self.graph.covariance(0))

    def rows(self) -> TrajectoryRows:
        """Rows of the window up to its last keyframe, with the start and end of the walk if they are in it."""
        window, graph = self.graph.window, self.graph
        first = TrajectoryRows(np.array(window.times[:1]), window.pose[:1], graph.covariance(0)[None], [window.floor])
        if not window.intervals:
            return first
        part = window.part(ALL)
        at = part.chain.evaluate(part.state(graph.isam.values, ()))
        linear = graph.isam.graph().linearize(graph.isam.values)
        net = linear.eliminateSequential(gtsam.Ordering.MetisGaussianFactorGraph(linear))
        keys = [(X(interval.i), X(interval.j), C(interval.segment)) for interval in window.intervals]
        which = np.concatenate(
            [n + interval.row_piece for n, interval in zip(at.pieces.first, window.intervals, strict=True)]
        )
        time = np.concatenate([interval.row_time for interval in window.intervals])
        covariance = covariance_of_pieces(CovarianceBlocks(net), keys, at, which) + graph.excess.at(time)
        labels = [interval.label for interval in window.intervals for _ in interval.row_time]
        parts = [first] * window.complete + [TrajectoryRows(time, at.ends[which], covariance, labels)]
        if self.finished and not (len(time) and time[-1] > window.times[-1] - CLOSE):
            end = graph.covariance(-1)[None]
            parts.append(TrajectoryRows(np.array(window.times[-1:]), window.pose[-1:], end, [window.floor]))
        return TrajectoryRows.joined(parts)

    def predicted_rows(self, tail: Steps | None = None) -> TrajectoryRows:
        """Predicted rows of the steps since the last keyframe; the last row is the current pose."""
        window = self.graph.window
        whole = window.steps.with_tail(tail)
        ends = whole[(whole[:, END] > window.times[-1] + CLOSE) & (whole[:, ROW] > 0), END]
        moments = np.unique(np.append(ends, whole[-1:, END]))
        moments = moments[moments > window.times[-1] + CLOSE]
        beliefs = [self.belief(tail, until) for until in moments.tolist()]
        pose = np.array([belief.mean[:3] for belief in beliefs]).reshape(-1, 3)
        covariance = np.array([belief.covariance[:3, :3] for belief in beliefs]).reshape(-1, 3, 3)
        return TrajectoryRows(moments, pose, covariance, [window.floor] * len(moments))

    def reports(self) -> dict[str, tuple[Any, ...]]:
        """Reports by kind: of the window, and of finalised measurements since `pop_finalized` was last called."""
        at, past = self.graph.evaluate(everything=True), self.graph.finalized.reports
        result = {}
        for measurement in at.measurements:
            reports = measurement.reports(at)
            if measurement.instances is not None:
                reports = tuple(
                    {
                        **past.get(measurement.name, {}),
                        **dict(zip(measurement.instances[0].tolist(), reports, strict=True)),
                    }.values()
                )
            if reports:
                result[measurement.name] = reports
        return result

    def calibration(self) -> Calibration | None:
        """(R_s, R_d, b) in the segments of the window."""
        window, segments = self.graph.window, self.graph.window.segments
        if not window.intervals:
            return None
        value = np.array([window.c[segment] for segment in segments])
        covariance = np.array([self.graph.isam.covariance([C(segment)]) for segment in segments])
        start = np.array(
            [min(interval.begin for interval in window.intervals if interval.segment == s) for s in segments]
        )
        return Calibration(start, value, covariance, prior_sigma(self.graph.prior, np.array(segments)))

    @property
    def final(self) -> Estimate | None:
        """The batch's estimate of the whole walk if it ended with all of it in the window, else None."""
        return self._final

    def pop_finalized(self) -> list[TrajectoryRows]:
        """Return and remove the finalised rows."""
        return self.graph.finalized.pop_finalized()
