"""Output of a live smoother: current pose, the walk so far with covariance, reports."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pdr_graph.estimation.factors import made_from
from pdr_graph.estimation.factors.base import Itemized
from pdr_graph.estimation.factors.chain import Evaluation
from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.estimation.linear_system import covariance_of_ends
from pdr_graph.estimation.live.finalization import TrajectoryRows
from pdr_graph.estimation.live.live_graph import LiveGraph
from pdr_graph.estimation.live.modes import Modes, after_headings, in_walkable_area
from pdr_graph.estimation.live.particles import ParallelParticleFilter
from pdr_graph.estimation.live.prediction import (
    Belief,
    Position,
    in_any_direction,
    in_output_axes,
    predict,
    single_mode,
)
from pdr_graph.estimation.live.step_buffer import CLOSE, END, ROW
from pdr_graph.estimation.results import prior_sigma
from pdr_graph.priors import LIVE_PATHS
from pdr_graph.types import Array, Calibration, Fixes, Headings, Steps, take


class LiveOutput:
    """Results of a walk under way.

    sure: position and direction of the walk are certain; modes: those that remain until then; particles: beside a
    certain walk on a plan.
    """

    def __init__(self, graph: LiveGraph) -> None:
        self.graph, self.modes, self.sure = graph, Modes(), False
        self.particles: ParallelParticleFilter | None = None
        self._last: tuple[Evaluation, GaussianMixture] | None = None

    def is_placed(self, until: float) -> bool:
        """True if a measurement up to ``until`` [s] has told a position; else the start defines the frame."""
        graph = self.graph
        placed = graph.finalized.anchored or self.modes.mixture is not None or graph.has_position
        return placed or bool(self.fixes_between(-np.inf, until))

    def mixture(self, tail: Steps | None = None, until: float | None = None) -> GaussianMixture:
        """The ways that remain at ``until`` [s], by default now: predicted through the steps and fixes since.

        tail: provisional steps.
        """
        window, modes = self.graph.window, self.modes
        whole = window.steps.with_tail(tail)
        base, at = modes.mixture, modes.time
        if base is None:
            base, at = self.keyframe_belief(), window.times[-1]
        end = float(whole[-1, END]) if len(whole) else at
        end = end if until is None else min(end, until)
        fixes = self.fixes_between(at, end)
        if fixes and modes.mixture is None and not self.graph.has_position:
            base, at, fixes = in_any_direction(base, fixes[0]), fixes[0].time, fixes[1:]
        ways = predict(base, whole, window.steps.start, at, end, fixes)
        if self.sure:
            ways = self._with_others(ways, whole, end)
        elif len(ways) > 1:
            ways = self._weighted(ways, whole, end)
        stated = ways.covariance.copy()
        stated[:, :3, :3] += self.graph.excess.at(np.array([end]))[0]
        return replace(ways, covariance=stated)

    def _with_others(self, ways: GaussianMixture, whole: Array, end: float) -> GaussianMixture:
        """The way of the graph at ``end`` [s], first, and those of particles elsewhere, until the next fix."""
        particles, start = self.particles, self.graph.window.steps.start
        if particles is None or particles.elsewhere is None:
            return ways
        begin = particles.times[-1]
        if begin < start or self.fixes_between(begin, end):  # the steps since have left the window, or a fix decides
            return ways
        others = predict(particles.elsewhere, whole, start, begin, end, [])
        own = max(1.0 - float(np.exp(others.log_weight).sum()), LIVE_PATHS.least_probability)
        every = np.arange(len(ways) + len(others))
        return GaussianMixture(
            np.concatenate([ways.mean, others.mean]),
            np.concatenate([ways.covariance, others.covariance]),
            np.concatenate([ways.log_weight + np.log(own), others.log_weight]),
            every,
        ).take(every)

    def _weighted(self, ways: GaussianMixture, whole: Array, end: float) -> GaussianMixture:
        """The ways at ``end`` [s], weighted by headings that no batch has used, and by walls."""
        log, window = self.graph.log, self.graph.window
        headings, numbers = log.rows(Headings), log.numbers("headings")
        if headings is not None and numbers is not None:
            new = ~np.isin(numbers, self.modes.used) & (headings.time <= end)
            ways = after_headings(ways, whole, window.steps.start, end, take(headings, np.flatnonzero(new)))
        plan = window.located_plan
        return ways if plan is None else in_walkable_area(ways, plan[window.floor].distance)

    def belief(self, tail: Steps | None = None, until: float | None = None) -> Belief:
        """Expectation over the ways that remain, see `mixture`, in the walkable area."""
        return self.expected(self.mixture(tail, until))

    def expected(self, ways: GaussianMixture) -> Belief:
        """Expectation over ways, or the first once the walk is certain, in the walkable area.

        The covariance of all ways is about the position that is given.
        """
        mean, covariance = ways.about(ways.mean[0]) if self.sure else ways.expectation()
        plan = self.graph.window.located_plan
        if plan is None:
            return Belief(mean, covariance)
        moved = mean.copy()
        moved[:2] = plan[self.graph.window.floor].nearest_walkable(mean[:2])
        return Belief(moved, covariance + np.outer(moved - mean, moved - mean))

    def keyframe_belief(self) -> GaussianMixture:
        """State of the last keyframe and its calibration, on the most probable way."""
        graph, window = self.graph, self.graph.window
        if self._last is None or self._last[0] is not graph.at:
            pose = window.pose[-1]
            covariance = in_output_axes(graph.end_covariance(), float(pose[2]))
            self._last = graph.at, single_mode(np.append(pose, window.c[window.segment]), covariance)
        return self._last[1]

    def fixes_between(self, begin: float, end: float) -> list[Position]:
        """The fixes after ``begin`` until ``end`` [s], which have no keyframe yet."""
        rows = self.graph.log.rows(Fixes)
        if rows is None or not ((rows.time > begin + CLOSE) & (rows.time <= end)).any():
            return []
        factor = made_from(Fixes, self.graph.at.measurements)
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
        at = graph.at
        which = np.concatenate(
            [n + interval.row_piece for n, interval in zip(at.pieces.first, window.intervals, strict=True)]
        )
        time = np.concatenate([interval.row_time for interval in window.intervals])
        covariance = covariance_of_ends(at, graph.solution, which)[0][1:] + graph.excess.at(time)
        labels = [interval.label for interval in window.intervals for _ in interval.row_time]
        parts = [first] * window.complete + [TrajectoryRows(time, at.ends[which], covariance, labels)]
        if window.finished and not (len(time) and time[-1] > window.times[-1] - CLOSE):
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
        at, past = self.graph.at, self.graph.finalized.reports
        result = {
            name: tuple(reports.values()) for name, reports in past.items()
        }  # of kinds that left the window whole
        for measurement in at.measurements:
            reports = measurement.reports(at)
            if isinstance(measurement, Itemized):
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
        covariance = self.graph.calibration_covariance()
        start = np.array(
            [min(interval.begin for interval in window.intervals if interval.segment == s) for s in segments]
        )
        return Calibration(start, value, covariance, prior_sigma(self.graph.prior, np.array(segments)))

    def pop_finalized(self) -> list[TrajectoryRows]:
        """Return and remove the finalised rows."""
        return self.graph.finalized.pop_finalized()
