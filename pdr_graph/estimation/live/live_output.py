"""Output of a live smoother: the current pose, the modes that remain, the walk so far with covariance, reports.

The current pose is predicted by extended Kalman filters from the last keyframe through later steps and fixes: one if
the direction of the walk is certain, else one per mode that remains (`Modes`). These begin at the first fix, in all
directions; each fix corrects them, the headings known by now what is shown, and each solution of the batch replaces
them. Where no fix came since, particles predict a certain walk and the modes of the batch between the walls of a plan
(`PredictionBetweenWalls`). Modes whose present position is in walls count less, as long as they are there. Before the
first steps, where no steps can be detected and where fixes go away from them, the position is that of the fixes alone
(`FixesAlone`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pdr_graph.estimation.between_steps import joint_of, poses_between
from pdr_graph.estimation.factors.base import CALIBRATION, POSE, Itemized
from pdr_graph.estimation.factors.chain import Evaluation, increment, intervals
from pdr_graph.estimation.factors.registry import made_from
from pdr_graph.estimation.kalman import (
    FAR,
    HOPELESS,
    OF_POSITION,
    GaussianMixture,
    by_direction,
    heading_corrected,
    measured,
    thinned,
)
from pdr_graph.estimation.linear_system import covariance_of_ends
from pdr_graph.estimation.live.finalization import TrajectoryRows
from pdr_graph.estimation.live.live_graph import LiveGraph
from pdr_graph.estimation.live.particles import ParallelParticleFilter, PredictionBetweenWalls
from pdr_graph.estimation.live.window import CLOSE, IS_ROW, TURN_VARIANCE, UNTIL
from pdr_graph.estimation.optimizer import Optimum
from pdr_graph.estimation.results import prior_sigma
from pdr_graph.geometry import (
    ANY_HEADING,
    REGION_95,
    distance_to_box,
    horizontal_sigma,
    pose_rotation,
    squared_distance,
)
from pdr_graph.priors import FIXES, FIXES_ALONE, LIVE_PATHS, MOTION, RECEIVERS
from pdr_graph.types import INSTANT, Array, Calibration, Fixes, Headings, Index, Steps, take

QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])  # rotation by 90°


@dataclass(frozen=True)
class Position:
    """A fix: time [s], position ``(2,)`` [m], sigma [m]; share: of its information that is independent of others.

    source: of the receiver, "" of others.
    """

    time: float
    position: Array
    sigma: float
    share: float
    source: str = ""


@dataclass(frozen=True)
class Receiver:
    """The receiver whose fixes alone tell where a walk is: the filter follows what it would state.

    Its errors are correlated, so that changes of its position are known much better than the position. source: its
    name; sigma: of its first fix [m].
    """

    source: str
    sigma: float

    @property
    def common(self) -> float:
        """Variance of the error that its fixes share. [m²]"""
        return (1 - RECEIVERS.white**2) * self.sigma**2

    @property
    def drift(self) -> float:
        """Growth of the variance of that error while somebody walks. [m²/s]"""
        varying = max(1 - RECEIVERS.white**2 - RECEIVERS.throughout**2, 0.0) * self.sigma**2
        return 2 * varying * (1 / RECEIVERS.standing + FIXES.walking_speed / RECEIVERS.along)

    def seen(self, fix: Position) -> Position:
        """One of its fixes, as a measurement of what it states."""
        return replace(fix, sigma=RECEIVERS.white * fix.sigma, share=1.0)

    @staticmethod
    def of(fix: Position) -> Receiver | None:
        """The receiver of a first fix; None for a position that somebody states."""
        return Receiver(fix.source, fix.sigma) if fix.source else None

    def widened(self, mixture: GaussianMixture) -> GaussianMixture:
        """The mixture of true positions."""
        covariance = mixture.covariance.copy()
        covariance[:, :2, :2] += self.common * np.eye(2)
        return replace(mixture, covariance=covariance)


@dataclass(frozen=True)
class Belief:
    """Mean ``(6,)`` and covariance ``(6, 6)`` of (x, y, θ, R_s, R_d, b), in the output axes."""

    mean: Array
    covariance: Array


def single_mode(mean: Array, covariance: Array) -> GaussianMixture:
    """The mixture of a single Gaussian: mean ``(6,)``, covariance ``(6, 6)`` of (x, y, θ, R_s, R_d, b)."""
    return GaussianMixture(mean[None], covariance[None], np.zeros(1), np.zeros(1, dtype=np.intp))


def in_output_axes(joint: Array, heading: float) -> Array:
    """The joint covariance ``(6, 6)`` of a pose with this heading [rad], in its own axes, and a calibration."""
    T = np.eye(6)
    T[:3, :3] = pose_rotation(np.array([heading]))[0]
    return T @ joint @ T.T


def in_any_direction(at: GaussianMixture, fix: Position) -> GaussianMixture:
    """The mixture of all directions at a first fix; ``at`` has the calibration."""
    mean, covariance = at.mean[0].copy(), np.zeros((6, 6))
    mean[:2] = fix.position
    covariance[:3, :3] = np.diag(np.square([FAR, FAR, FAR]))
    covariance[3:, 3:] = at.covariance[0, 3:, 3:]
    return after_fix(by_direction(single_mode(mean, covariance)), fix)


def after_fix(mixture: GaussianMixture, fix: Position) -> GaussianMixture:
    """The mixture after a fix, with Huber's weight, and weight 0 beyond the gate."""
    R = fix.sigma**2 * np.eye(2)
    return thinned(measured(mixture, OF_POSITION, fix.position - mixture.mean[:, :2], R, fix.share)[0])


def predict(
    mixture: GaussianMixture,
    whole: Array,
    start: float,
    begin: float,
    end: float,
    fixes: Sequence[Position],
    receiver: Receiver | None = None,
) -> GaussianMixture:
    """Predict the mixture from ``begin`` to ``end`` [s] through the steps and fixes between, in order of time.

    After an unknown turn, a single mode is split into all directions.

    whole, start: of the steps, see `intervals`; receiver: of all fixes, if the mixture is of what it states.
    """
    turned = unknown_turns(whole)
    moments = [*(fix.time for fix in fixes), *turned.tolist()]
    moments = sorted({*(moment for moment in moments if begin + INSTANT < moment <= end), end})
    if moments[-1] < begin + INSTANT:
        return mixture
    mean_c = mixture.mean[mixture.best, 3:]
    waiting = [receiver.seen(fix) for fix in fixes] if receiver is not None else list(fixes)
    for before, moment in zip([begin, *moments], moments, strict=False):
        R, (delta, by_c, spread) = pose_rotation(mixture.mean[:, 2]), increment(whole, start, before, moment, mean_c)
        mean, covariance = mixture.mean.copy(), mixture.covariance
        mean[:, :3] += (R @ (delta + (mixture.mean[:, 3:] - mean_c) @ by_c.T)[:, :, None])[:, :, 0]
        F = np.full((len(mean), 6, 6), np.eye(6))
        F[:, :2, 2] = (mean - mixture.mean)[:, :2] @ QUARTER_TURN.T
        F[:, :3, 3:] = R @ by_c
        covariance = F @ covariance @ F.transpose(0, 2, 1)
        covariance[:, :3, :3] += R @ spread @ R.transpose(0, 2, 1)
        if receiver is not None:
            covariance[:, :2, :2] += receiver.drift * (moment - before) * np.eye(2)
        mixture = GaussianMixture(mean, covariance, mixture.log_weight, mixture.origin)
        if len(mixture) == 1 and moment in turned:
            mixture = by_direction(mixture)
        while waiting and waiting[0].time <= moment:
            mixture = after_fix(mixture, waiting.pop(0))
    return mixture


def retraced(mixture: GaussianMixture, whole: Array, start: float, begin: float, end: float) -> GaussianMixture:
    """The mixture of ``begin`` at an earlier time ``end`` [s], back along the steps, with its covariances.

    whole, start: of the steps, see `intervals`.
    """
    delta, _, _ = increment(whole, start, end, begin, mixture.mean[mixture.best, 3:])
    mean = mixture.mean.copy()
    mean[:, 2] -= delta[2]
    mean[:, :2] -= (pose_rotation(mean[:, 2]) @ delta)[:, :2]
    return replace(mixture, mean=mean)


def unknown_turns(whole: Array) -> Array:
    """Ends [s] of the pieces in which the walker may have turned by any angle; whole: see `intervals`."""
    return whole[whole[:, TURN_VARIANCE] > MOTION.gap_turn**2 / 4, UNTIL]


@dataclass
class Modes:
    """Gaussians over (x, y, θ, R_s, R_d, b) with weights, at ``time`` [s]; none before the first fix.

    receiver: what they state is the position that it would state, None if the true one; used: numbers of the headings
    that the batch has used; directed: they are the batch's, each with a direction, so that walls may decide among them.
    """

    mixture: GaussianMixture | None = None
    time: float = np.nan
    receiver: Receiver | None = None
    used: Index = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    directed: bool = False

    def begun(self, at: GaussianMixture, fixes: list[Position]) -> Modes:
        """Modes in all directions at the first of some fixes; ``at`` has the calibration."""
        receiver = Receiver.of(fixes[0])
        first = fixes[0] if receiver is None else receiver.seen(fixes[0])
        return Modes(in_any_direction(at, first), fixes[0].time, receiver, used=self.used)

    def of_all(self, fixes: list[Position]) -> Modes:
        """The modes for which these fixes are measurements: of the true position, unless all are the receiver's."""
        receiver, mixture = self.receiver, self.mixture
        if receiver is None or mixture is None or all(fix.source == receiver.source for fix in fixes):
            return self
        return replace(self, mixture=receiver.widened(mixture), receiver=None)


def after_headings(
    mixture: GaussianMixture, whole: Array, start: float, now: float, headings: Headings
) -> GaussianMixture:
    """The mixture at ``now`` [s] after headings of earlier moments. whole, start: of the steps, see `intervals`."""
    H = np.zeros((1, 6))
    for time, heading, sigma in zip(headings.time.tolist(), headings.heading, headings.sigma, strict=True):
        turned, variance = np.zeros(3), sigma**2  # since then, as a function of (R_s, R_d, b)
        if time <= now - INSTANT:
            pieces = intervals(whole, start, max(time, start), np.array([now]))
            turned, variance = np.append(0.0, pieces.to_end[:, -1]), variance + pieces.variance[:, 1].sum()
        H[0, 2], H[0, 3:] = 1.0, -turned
        mixture = thinned(heading_corrected(mixture, H, heading, variance))
    return mixture


def modes_at_end(optima: list[Optimum], probability: Array) -> GaussianMixture:
    """The last pose and calibration of each solution, with its covariance in the output axes and its probability."""
    mean, covariance = [], []
    for optimum in optima:
        state = optimum.state
        last = (("x", np.array([len(state.poses) - 1])), ("c", np.array([len(state.c) - 1])))
        joint = optimum.solution.joint(*last)[0]
        mean.append(np.append(state.poses[-1], state.c[-1]))
        covariance.append(in_output_axes(joint, float(state.poses[-1, 2])))
    share = probability / probability.max()
    mixture = GaussianMixture(np.array(mean), np.array(covariance), np.log(probability), np.arange(len(mean)))
    return mixture.take(np.flatnonzero(share > HOPELESS))


@dataclass(frozen=True)
class FixesAlone:
    """A Kalman filter of positions.

    time [s], mean ``(2,)`` [m], covariance ``(2, 2)``; sigma: of the last fix [m]; speed: to its place [m/s]; beyond:
    number of fixes in a row that were not used.
    """

    time: float
    mean: Array
    covariance: Array
    sigma: float
    speed: float = 0.0
    beyond: int = 0

    def covariance_at(self, time: float) -> Array:
        """Covariance ``(3, 3)`` of the pose later [s], of any heading; at least that of a fix: their errors repeat."""
        repeated = max(self.sigma**2 - float(np.trace(self.covariance)) / 2, 0.0)
        covariance = (repeated + self.growth(time)) * np.eye(3)
        covariance[:2, :2] += self.covariance
        covariance[2, 2] = ANY_HEADING**2
        return covariance

    def growth(self, time: float) -> float:
        """Variance per axis that the position has gained by then [s]: its owner goes on as before, or walks. [m²]"""
        return (max(self.speed, FIXES.walking_speed) * max(time - self.time, 0.0)) ** 2


def after_fixes(state: FixesAlone | None, fixes: Fixes) -> FixesAlone | None:
    """The state after some fixes; begins at the first.

    A fix beyond the gate is not used; at the third of them in a row, the state restarts. An earlier one than the last,
    which arrived late, says nothing of the present.
    """
    for time, position, sigma in zip(fixes.time.tolist(), fixes.position, fixes.sigma.tolist(), strict=True):
        R = sigma**2 * np.eye(2)
        if state is not None and time < state.time - INSTANT:
            continue
        if state is None:
            state = FixesAlone(time, position.copy(), R, sigma)
            continue
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = state.covariance + state.growth(time) * np.eye(2)
        mixture = single_mode(np.append(state.mean, np.zeros(4)), covariance)
        mixture, _, weight = measured(mixture, OF_POSITION, (position - state.mean)[None], R)
        mean, covariance = mixture.mean[0, :2], mixture.covariance[0, :2, :2]
        if weight[0] == 0.0 and state.beyond + 1 < FIXES_ALONE.given_up:
            state = replace(state, beyond=state.beyond + 1)
            continue
        if weight[0] == 0.0:
            mean, covariance = position.copy(), R
        moved, later = float(np.hypot(*(mean - state.mean))), time - state.time
        speed = min(moved / later, FIXES.driven) if later > INSTANT else state.speed
        state = FixesAlone(time, mean, covariance, sigma, speed)
    return state


@dataclass(frozen=True)
class Away:
    """Fixes in a row that agree and go away from the walk: a slow ride, or steps that are not recognised.

    count: of them; place ``(2,)`` [m], walked [m]: at the first.
    """

    count: int = 0
    place: Array = field(default_factory=lambda: np.zeros(2))
    walked: float = 0.0

    def after(self, alone: FixesAlone, belief: Belief, walked: float) -> Away:
        """The row after one more fix. belief: of the walk at its time; walked: until then [m]."""
        if alone.beyond:
            return self  # it agrees with none before
        apart = alone.mean - belief.mean[:2]
        spread = belief.covariance[:2, :2] + alone.covariance_at(alone.time)[:2, :2]
        if squared_distance(apart, spread) < REGION_95:
            return Away()
        return replace(self, count=self.count + 1) if self.count else Away(1, alone.mean, walked)

    def is_followed(self, alone: FixesAlone, walked: float) -> bool:
        """True if the position is that of the fixes, not of the walk."""
        if self.count < FIXES_ALONE.away:
            return False
        return float(np.hypot(*(alone.mean - self.place))) >= max(FIXES_ALONE.moved, 2 * (walked - self.walked))


class LiveOutput:
    """Results of a walk under way.

    sure: position and direction of the walk are certain; modes: those that remain until then; particles: beside a
    certain walk on a plan.
    """

    def __init__(self, graph: LiveGraph) -> None:
        self.graph, self.modes, self.sure = graph, Modes(), False
        self.particles: ParallelParticleFilter | None = None
        self._last: tuple[Evaluation, GaussianMixture] | None = None
        self._between_walls = PredictionBetweenWalls(graph.prior)

    def is_placed(self, until: float) -> bool:
        """True if a measurement up to ``until`` [s] has told a position; else the start defines the frame."""
        graph = self.graph
        placed = graph.finalized.anchored or self.modes.mixture is not None or graph.has_position
        return placed or bool(self.fixes_between(-np.inf, until))

    def mixture(self, tail: Steps | None = None, until: float | None = None) -> GaussianMixture:
        """The modes that remain at ``until`` [s], by default now: predicted through the steps and fixes since.

        tail: provisional steps.
        """
        window, modes = self.graph.window, self.modes
        whole = window.steps.with_tail(tail)
        if modes.mixture is None:
            modes = Modes(self.keyframe_belief(), window.times[-1])
        end = float(whole[-1, UNTIL]) if len(whole) else modes.time
        end = end if until is None else min(end, until)
        fixes = self.fixes_between(modes.time, end)
        if fixes and self.modes.mixture is None and not self.graph.has_position:
            modes, fixes = modes.begun(self.keyframe_belief(), fixes), fixes[1:]
        modes = modes.of_all(fixes)
        base = self.keyframe_belief() if modes.mixture is None else modes.mixture
        start, plan = window.steps.start, window.located_plan
        known = (self.sure or modes.directed) and not (fixes or (unknown_turns(whole) > modes.time).any())
        if end < modes.time - INSTANT:
            ways = retraced(base, whole, start, modes.time, end)
        elif plan is not None and known and end > modes.time + INSTANT:
            pieces = intervals(whole, start, modes.time, np.array([end]))
            ways = self._between_walls.predict(base, pieces, plan[window.floor].distance)
        else:
            ways = predict(base, whole, start, modes.time, end, fixes, modes.receiver)
        ways = ways if modes.receiver is None else modes.receiver.widened(ways)
        if self.sure:
            ways = self._with_others(ways, whole, end)
        elif len(ways) > 1:
            headings, numbers = self.graph.log.rows_and_numbers(Headings)
            new = ~np.isin(numbers, modes.used) & (headings.time <= end)  # that no batch has used
            ways = after_headings(ways, whole, start, end, take(headings, new))
            if plan is not None and len(ways) > 1:  # ways inside walls count less, by their depth there [σ]
                depth = np.maximum(0.0, -plan[window.floor].distance.exact(ways.mean[:, :2]))
                sigmas = depth / horizontal_sigma(ways.covariance)
                weight = ways.log_weight - np.minimum(0.5 * np.square(sigmas), LIVE_PATHS.wall_price)
                ways = replace(ways, log_weight=weight).take(np.arange(len(ways)))
        stated = ways.covariance.copy()
        stated[:, :3, :3] += self.graph.excess.at(np.array([end]))[0]
        return replace(ways, covariance=stated)

    def _with_others(self, ways: GaussianMixture, whole: Array, end: float) -> GaussianMixture:
        """The mode of the graph at ``end`` [s], first, and those of particles elsewhere, until the next fix."""
        particles, start = self.particles, self.graph.window.steps.start
        if particles is None or particles.elsewhere is None:
            return ways
        begin = particles.times[-1]
        if begin < start or self.fixes_between(begin, end):  # the steps since have left the window, or a fix decides
            return ways
        others = predict(particles.elsewhere, whole, start, begin, end, [])
        own = max(1.0 - float(np.exp(others.log_weight).sum()), LIVE_PATHS.least_probability)
        weight = np.append(np.log(own) + ways.log_weight, others.log_weight)
        every, mean = np.arange(len(weight)), np.concatenate([ways.mean, others.mean])
        covariance = np.concatenate([ways.covariance, others.covariance])
        return GaussianMixture(mean, covariance, weight, every).take(every)

    def belief(self, tail: Steps | None = None, until: float | None = None) -> Belief:
        """Expectation over the modes that remain, see `mixture`, in the walkable area."""
        return self.expected(self.mixture(tail, until))

    def expected(self, ways: GaussianMixture) -> Belief:
        """Expectation over modes, or the first once the walk is certain, in the walkable area.

        The covariance of all modes is about the position that is given.
        """
        mean, covariance = ways.about(ways.mean[0]) if self.sure else ways.expectation()
        plan = self.graph.window.located_plan
        if plan is None or distance_to_box(mean[:2], *plan.corners) > 2 * horizontal_sigma(covariance):  # it left
            return Belief(mean, covariance)
        moved = mean.copy()
        moved[:2] = plan[self.graph.window.floor].nearest_walkable(mean[:2])
        return Belief(moved, covariance + np.outer(moved - mean, moved - mean))

    def keyframe_belief(self) -> GaussianMixture:
        """State of the last keyframe and its calibration, of the most probable mode."""
        graph, window = self.graph, self.graph.window
        if self._last is None or self._last[0] is not graph.at:
            joint, solution = np.zeros((6, 6)), graph.isam
            last, c = (POSE, np.array([len(window.pose) - 1])), (CALIBRATION, np.array([len(graph.at.state.c) - 1]))
            if window.intervals:
                joint = solution.joint(last, c)[0]
            else:  # nothing binds the pose of a window without steps to a calibration
                joint[:3, :3], joint[3:, 3:] = solution.joint(last)[0], solution.joint(c)[0]
            mean = np.append(window.pose[-1], window.c[window.segment])
            self._last = graph.at, single_mode(mean, in_output_axes(joint, float(mean[2])))
        return self._last[1]

    def fixes_between(self, begin: float, end: float) -> list[Position]:
        """The fixes after ``begin`` until ``end`` [s], which have no keyframe yet."""
        fixes, _ = self.graph.log.rows_and_numbers(Fixes)
        which = np.flatnonzero((fixes.time > begin + CLOSE) & (fixes.time <= end))
        if not len(which):
            return []
        new, factor, share = take(fixes, which), made_from(Fixes, self.graph.at.measurements), dict[str, float]()
        if factor is not None:  # of the last fix of each source
            independent = (factor.sigma / factor.independent_sigma) ** 2
            share = {source: float(of) for source, of in zip(factor.fixes.source, independent, strict=True) if source}
        rows = zip(new.time.tolist(), new.position, new.sigma.tolist(), new.source, strict=True)
        return [Position(t, position, sigma, share.get(source, 1.0), source) for t, position, sigma, source in rows]

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
        covariance = covariance_of_ends(at, graph.isam, which)[1:] + graph.excess.at(time)
        labels = [interval.label for interval in window.intervals for _ in interval.row_time]
        parts = [first] * window.complete + [TrajectoryRows(time, at.ends[which], covariance, labels)]
        if window.finished and not (len(time) and time[-1] > window.times[-1] - CLOSE):
            end = graph.covariance(-1)[None]
            parts.append(TrajectoryRows(np.array(window.times[-1:]), window.pose[-1:], end, [window.floor]))
        return TrajectoryRows.joined(parts)

    def poses_at(self, time: Array) -> tuple[Array, Array]:
        """Poses ``(n, 3)`` and covariances ``(n, 3, 3)`` at times ``(n,)`` [s] between keyframes of the window."""
        graph = self.graph
        joint = joint_of(graph.at, graph.isam)
        pose, covariance = poses_between(graph.at, joint, graph.window.prior.mean, time)
        return pose, covariance + graph.excess.at(time)

    def predicted_rows(self, tail: Steps | None = None) -> TrajectoryRows:
        """Predicted rows of the steps since the last keyframe; the last row is the current pose."""
        window = self.graph.window
        whole = window.steps.with_tail(tail)
        ends = whole[(whole[:, UNTIL] > window.times[-1] + CLOSE) & (whole[:, IS_ROW] > 0), UNTIL]
        moments = np.unique(np.append(ends, whole[-1:, UNTIL]))
        moments = moments[moments > window.times[-1] + CLOSE]
        beliefs = [self.belief(tail, until) for until in moments.tolist()]
        pose = np.array([belief.mean[:3] for belief in beliefs]).reshape(-1, 3)
        covariance = np.array([belief.covariance[:3, :3] for belief in beliefs]).reshape(-1, 3, 3)
        return TrajectoryRows(moments, pose, covariance, [window.floor] * len(moments))

    def reports(self) -> dict[str, tuple[Any, ...]]:
        """Reports by kind: of the window, and of finalised measurements since `pop_finalized` was last called."""
        result = {name: tuple(reports.values()) for name, reports in self.graph.finalized.reports.items()}
        for measurement in self.graph.at.measurements:
            reports = measurement.reports(self.graph.at)
            if isinstance(measurement, Itemized):
                numbers = measurement.instances[0].tolist()
                past = self.graph.finalized.reports.get(measurement.name, {})
                reports = tuple({**past, **dict(zip(numbers, reports, strict=True))}.values())
            if reports:
                result[measurement.name] = reports
        return result

    def calibration(self) -> Calibration | None:
        """(R_s, R_d, b) in the segments of the window."""
        window, segments = self.graph.window, self.graph.window.segments
        if not window.intervals:
            return None
        covariance = self.graph.calibration_covariance()
        path, prior = window.path, self.graph.prior_in_force
        return Calibration(path.begin, path.c, covariance, prior_sigma(prior, np.array(segments)), prior.usual)
