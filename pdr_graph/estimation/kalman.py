"""The causal Kalman filter of a walk, its Rauch–Tung–Striebel smoother, and mixtures of Gaussians.

The fusion of [gps-dr] as one extended Kalman filter over (x, y, θ, R_s, R_d, b), the variables of the graph, over the
same pieces and fixes:

    predict   p ← p + R_s l e(θ + half the turn),  θ ← θ + R_d turn + b time      (Secs. 2, 3: strides, gyro)
              Q from the stride's variance (Sec. 4), across too, and from the turn's: both are not in the paper
    correct   with validated magnetic headings, R by both tests of the field      (Sec. 3)
              with fixes, R by the receiver's accuracy or HDOP                    (Sec. 4)

The paper has one filter for the heading and another for the position, so its fixes correct neither heading nor stride;
in one state they do. Its magnetometer measures the heading from the first step on; here the first magnetic heading is
carried back to the start by the gyro. A fix beyond the gate is rejected, and where a nearer fix may be wrong, the
filter goes on with it and without it, until later fixes decide; so does it with the first fix at the second. After
several rejected in a row it is re-initialised at their position.

An unknown direction, or that of a rough compass, is too uncertain for one linearisation: a mixture of filters, one per
direction, runs in parallel, and measurements decide between them. A measurement beyond the gate of a hypothesis does
not correct it.

The smoother is that of Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
Journal 3(8), 1965. Backwards from the end, each state is corrected by the state after it:

    C_k = P_k F_kᵀ (P⁻_{k+1})⁻¹
    x̂_k = x_k + C_k (x̂_{k+1} − x⁻_{k+1}),      P̂_k = P_k + C_k (P̂_{k+1} − P⁻_{k+1}) C_kᵀ

with the filter's posterior x, P and prediction x⁻, P⁻. It is linearised once, along the filter's walk; the graph is
relinearised along its own.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

import numpy as np

from pdr_graph.errors import count, expect
from pdr_graph.estimation.factors.base import huber_cost, huber_weight
from pdr_graph.estimation.factors.chain import DECIMALS, SIGMA_STILL, Pieces, intervals, whole_pieces
from pdr_graph.estimation.factors.fixes import drift_of
from pdr_graph.estimation.factors.start import FRAME_SIGMA, Prior, change_sigma
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import OPEN_DIRECTIONS, lay_dead_reckoning
from pdr_graph.estimation.results import (
    calibration_of,
    missing_steps,
    plan_contradictions,
    stated_probability,
    warnings,
)
from pdr_graph.gait.step_chunks import concatenate_steps
from pdr_graph.geometry import differences, interpolate, row_times, wrap_angle
from pdr_graph.priors import FIXES, KALMAN, MOTION, PRICES, RECEIVERS, REPORTS, STEP, TREADS
from pdr_graph.types import Array, Estimate, Fixes, FixReport, Index, Steps, Trajectory

HOPELESS, MOST_HYPOTHESES = 1e-6, 24  # probability below which a hypothesis is dropped; most of them
FAR = 1e3  # [m, rad] standard deviation of an unknown position or direction
EXACT = 1e-3  # [rad] least sigma for the weights of directions
HELD_BACK = 2.0  # [s] by which a measurement may come late: receivers state where they were a second ago
LONGEST_CARRY = 60.0  # [s] over which turns carry a heading of earlier steps
MOST_ARRIVALS = 1000  # of a receiver of which a history is kept
NO_CHANGE = np.zeros(3)


@dataclass(frozen=True)
class GaussianMixture:
    """Hypotheses, each an extended Kalman filter.

    mean: ``(h, 6)`` x, y, θ, R_s, R_d, b; covariance: ``(h, 6, 6)``; log_weight: ``(h,)`` log of the probability;
    origin: ``(h,)`` index of each before the measurements of this moment.
    """

    mean: Array
    covariance: Array
    log_weight: Array
    origin: Index

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def best(self) -> int:
        """The most probable hypothesis."""
        return int(np.argmax(self.log_weight))

    def expectation(self) -> tuple[Array, Array]:
        """Mean ``(6,)`` and covariance ``(6, 6)`` of the whole mixture; the mean of directions is circular."""
        weight = np.exp(self.log_weight)
        mean = weight @ self.mean
        mean[2] = np.angle(weight @ np.exp(1j * self.mean[:, 2]))
        return self.about(mean)

    def about(self, mean: Array) -> tuple[Array, Array]:
        """``mean (6,)``, and the covariance ``(6, 6)`` of the mixture about it."""
        if len(self) == 1:
            return self.mean[0], self.covariance[0]
        apart = differences(self.mean, mean)
        spread = self.covariance + apart[:, :, None] * apart[:, None, :]
        return mean, np.einsum("h,hij->ij", np.exp(self.log_weight), spread)

    def take(self, rows: Index) -> GaussianMixture:
        """Select hypotheses and normalise their probabilities."""
        log_weight = self.log_weight[rows]
        log_weight = log_weight - np.logaddexp.reduce(log_weight)
        return GaussianMixture(self.mean[rows], self.covariance[rows], log_weight, self.origin[rows])


def measured(
    bank: GaussianMixture, H: Array, gap: Array, R: Array, share: float = 1.0
) -> tuple[GaussianMixture, Array, Array]:
    """Correct the mixture with a measurement, with Huber's weight up to the gate and weight 0 beyond.

    Returns the mixture, and the innovation [σ] and the weight of the measurement under each hypothesis ``(h,)``.

    H: ``(d, 6)`` measurement matrix; gap: ``(h, d)`` innovation; R: ``(d, d)``; share: of its information that is
    independent of other measurements; it scales R for the gain, not for the gate.
    An innovation beyond the gate costs a hypothesis as much as one at the gate, so an outlier decides nothing.
    """
    cross = H @ bank.covariance
    expected = cross @ H.T
    inverse, determinant = inverted(expected + R)
    sigmas = np.sqrt(((gap[:, None] @ inverse)[:, 0] * gap).sum(axis=1))
    weight = np.where(sigmas < FIXES.outlier, huber_weight(sigmas), 0.0)
    log_weight = bank.log_weight - huber_cost(np.minimum(sigmas, FIXES.outlier)) - 0.5 * np.log(determinant)

    weighted = expected + R / np.where(weight > 0, share * weight, 1.0)[:, None, None]
    K = (weight > 0)[:, None, None] * cross.transpose(0, 2, 1) @ inverted(weighted)[0]
    covariance = bank.covariance - K @ cross
    mean = bank.mean + (K @ gap[:, :, None])[:, :, 0]
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    log_weight -= np.logaddexp.reduce(log_weight)
    return GaussianMixture(mean, covariance, log_weight, bank.origin), sigmas, weight


def inverted(matrices: Array) -> tuple[Array, Array]:
    """Inverses ``(h, d, d)`` and determinants ``(h,)`` for d of 1 or 2, by formula: LAPACK would take them in turn."""
    if matrices.shape[1] == 1:
        return 1 / matrices, matrices[:, 0, 0]
    determinant = matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]
    adjugate = matrices[:, ::-1, ::-1].transpose(0, 2, 1) * [[1, -1], [-1, 1]]
    return adjugate / determinant[:, None, None], determinant


def corrected(
    bank: GaussianMixture, place: Array, sigma: float, share: float
) -> tuple[GaussianMixture, Index, Array, Array]:
    """Correct the mixture with a fix at ``place (2,)`` [m]; where it may be wrong, hypotheses go on without it too.

    sigma [m]; share: see `measured`. Returns the mixture, and of each of its hypotheses ``(h,)`` that before, the
    innovation [σ] and the weight of the fix.
    """
    updated, sigmas, weight = measured(bank, OF_POSITION, place - bank.mean[:, :2], sigma**2 * np.eye(2), share)
    spared = huber_cost(np.minimum(sigmas, FIXES.outlier)) - PRICES.wrong_fix  # [nats] if the fix is wrong
    gone = weight == 0.0
    updated = replace(updated, log_weight=updated.log_weight + np.where(gone, spared, 0.0))
    without = np.flatnonzero(~gone & (spared > np.log(KALMAN.left_out)))
    if len(bank) == 1 and not len(without):
        return updated.take(np.zeros(1, dtype=np.intp)), np.zeros(1, dtype=np.intp), sigmas, weight
    kept = replace(bank.take(without), log_weight=(updated.log_weight + spared)[without])
    row, whole = np.append(np.arange(len(bank)), without), joined(updated, kept)
    most = np.argsort(-whole.log_weight, kind="stable")[:MOST_HYPOTHESES]
    return whole.take(most), row[most], sigmas[row][most], np.append(weight, np.zeros(len(without)))[most]


def joined(first: GaussianMixture, second: GaussianMixture) -> GaussianMixture:
    """All hypotheses of two mixtures, with their weights as they are."""
    names = ("mean", "covariance", "log_weight", "origin")
    return GaussianMixture(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


def heading_corrected(bank: GaussianMixture, H: Array, heading: float, variance: float) -> GaussianMixture:
    """Correct the mixture with a heading [rad]. H: ``(1, 6)`` measurement matrix; variance [rad²]."""
    gap = np.asarray(wrap_angle(heading - bank.mean @ H.T))
    return measured(bank, H, gap, np.array([[variance]]))[0]


def thinned(bank: GaussianMixture) -> GaussianMixture:
    """Drop improbable hypotheses, and merge those near the best with it."""
    if len(bank) == 1:
        return bank
    pose = differences(bank.mean, bank.mean[bank.best])[:, :3]
    apart = (pose @ np.linalg.inv(bank.covariance[bank.best, :3, :3]) * pose).sum(axis=1)
    same = apart < KALMAN.same**2
    keep = ~same & (bank.log_weight > np.log(HOPELESS))
    keep[bank.best] = True
    log_weight = bank.log_weight.copy()
    log_weight[bank.best] = np.logaddexp.reduce(log_weight[same])
    return replace(bank, log_weight=log_weight).take(np.flatnonzero(keep))


def by_direction(wide: GaussianMixture) -> GaussianMixture:
    """Split one hypothesis of uncertain direction into OPEN_DIRECTIONS narrow ones around the circle.

    Together they have its Gaussian with Huber's tails: directions far from a compass heading keep a small probability.
    The first has the direction of ``wide``.
    """
    V, width = wide.covariance[0, 2, 2], np.pi / OPEN_DIRECTIONS
    off = np.asarray(wrap_angle(np.linspace(0, 2 * np.pi, OPEN_DIRECTIONS, endpoint=False)))
    wider, by_heading = max(V - width**2, 0.0), wide.covariance[0, 2] / V
    narrow = wide.covariance[0] - wider * np.outer(by_heading, by_heading)
    all_round = np.zeros(OPEN_DIRECTIONS, dtype=np.intp)
    log_weight = -huber_cost(np.minimum(np.abs(off) / np.sqrt(max(wider, EXACT**2)), FIXES.outlier))
    log_weight -= np.logaddexp.reduce(log_weight)
    return GaussianMixture(
        wide.mean + off[:, None] * by_heading, np.tile(narrow, (OPEN_DIRECTIONS, 1, 1)), log_weight, all_round
    )


OF_POSITION, OF_HEADING = np.eye(2, 6), np.eye(1, 6, 2)


@dataclass(frozen=True)
class Meeting:
    """How one fix was used: its index, distance [m] and innovation [σ] from the prediction, weight, and True if the
    filter was re-initialised there.
    """

    fix: int
    distance: float
    sigmas: float
    weight: float
    reset: bool


@dataclass(frozen=True)
class Moment:
    """State of the filter at the start, or at the end of one piece.

    time [s]; predicted: before the measurements of this moment; posterior: after them. Hypothesis n of ``predicted``
    came from ``parent (h,)`` n of the moment before, by a movement whose derivative is ``motion (h, 6, 6)`` n.
    """

    time: float
    parent: Index
    motion: Array
    predicted: GaussianMixture
    posterior: GaussianMixture
    met: tuple[Meeting, ...] = ()

    @classmethod
    def of(cls, time: float, mixture: GaussianMixture) -> Moment:
        """The start of a filter at a time [s]."""
        return cls(time, np.zeros(1, dtype=np.intp), np.eye(6)[None], mixture, mixture)


FIX_ARRIVES, HEADING_ARRIVES, CHANGE = range(3)  # kinds of arrivals, in the order in which those of one moment are used


@dataclass(frozen=True, order=True)
class Arrival:
    """What waits for the steps of its time.

    time [s]; kind: FIX_ARRIVES, HEADING_ARRIVES or CHANGE; number: of the fix; value: ``(2,)`` [m] of a fix, [rad] of a
    heading, change of pace of a calibration that begins, see `pace_changes`; sigma [m, rad]; source: of a fix.
    """

    time: float
    kind: int
    number: int
    value: Any = field(compare=False)
    sigma: float = field(default=0.0, compare=False)
    source: str = field(default="", compare=False)


class CalibrationWatch:
    """Says, from the steps so far, after which of them a new calibration begins: after MOTION.steps_per_segment steps,
    a gap, or a change of pace, which is known MOTION.pace_steps steps later.
    """

    def __init__(self) -> None:
        self._steps, self._paced = 0, deque[tuple[float, float]](maxlen=2 * MOTION.pace_steps)
        self._began = False

    def after(self, duration: float, length: float, on_stairs: bool, is_gap: bool) -> float | None:
        """The change of pace if a calibration begins after this step, see `pace_changes`; None if none begins."""
        self._steps += 1
        pace = 0.0 if is_gap or self._steps >= MOTION.steps_per_segment else None
        if length > 0 and not on_stairs:
            self._paced.append((float(np.log(duration)), length / duration))
            pace = self._change() or pace
        self._steps = self._steps if pace is None else 0
        return pace

    def _change(self) -> float:
        """The change of pace from the last steps but MOTION.pace_steps to these; 0 if it is the same pace."""
        n, paced = MOTION.pace_steps, list(self._paced)
        if len(paced) < n:
            return 0.0
        now, speed = (median(column) for column in zip(*paced[-n:], strict=True))
        if not self._began:
            self._began = True
            return MOTION.run_change * (now - float(np.log(STEP.usual))) if speed > MOTION.run_speed else 0.0
        if len(paced) < 2 * n:
            return 0.0
        before, slower = (median(column) for column in zip(*paced[:n], strict=True))
        if abs(now - before) < MOTION.pace_change:
            return 0.0
        for _ in range(n):
            self._paced.popleft()
        return (MOTION.run_change if (speed > MOTION.run_speed) != (slower > MOTION.run_speed) else 1.0) * (
            now - before
        )


@dataclass
class SourceHistory:
    """What the filter remembers of a receiver.

    drifts: of its last fixes with about the error of the next, see `drift`; place ``(2,)`` [m]: the first of those
    within RECEIVERS.still, track: dead-reckoned there [m]; away: farthest from there since [m].
    """

    drifts: deque[float]
    place: Array
    track: complex
    away: float = 0.0


class KalmanFilter:
    """The filter of a walk under way: takes steps, fixes and headings; nothing comes back from a graph.

    prior: of the calibration; start: of the walk, by default anywhere in any direction; watched: calibrations begin as
    `CalibrationWatch` says, False: as told by `begin_calibration`; most_waiting: measurements that wait for the steps
    of their time, of more the oldest are dropped.

    It follows steps HELD_BACK after they ended: so a fix that comes late by less is used at its time, exactly. One
    that is later is skipped, and a later heading is carried on by the turns since. A measurement of the future waits
    for its steps. Cost of a moment and memory do not depend on the length of the walk.

    moment: after the steps that it has followed, None before; located: True after the first fix; skipped: number of
    fixes that came too late; walked: distance [m].
    """

    def __init__(
        self,
        prior: Prior,
        start: GaussianMixture | None = None,
        watched: bool = True,
        most_waiting: float = np.inf,
    ):
        self.prior, self._most_waiting = prior, most_waiting
        self._begin = by_direction(start_mixture(prior, np.zeros(2), (FAR, FAR))) if start is None else start
        self.moment: Moment | None = None
        self.located, self.skipped, self.walked = start is not None, 0, 0.0
        self._waiting, self._fixes, self._refused = deque[Arrival](), 0, 0
        self._watch = CalibrationWatch() if watched else None
        self._change = NO_CHANGE  # variances of the change of the calibration before the next piece
        self._sources = dict[str, SourceHistory]()
        self._track, self._heading = 0j, 0.0  # dead-reckoned
        self._held = list[Steps]()  # steps that it has not followed yet
        self._turned = deque[tuple[float, float, float]]()  # time [s], turn [rad] and its variance since the start

    @property
    def time(self) -> float:
        """End of the steps that it has followed, NaN before the first steps. [s]"""
        return np.nan if self.moment is None else self.moment.time

    @property
    def mixture(self) -> GaussianMixture:
        """The present hypotheses."""
        return self._begin if self.moment is None else self.moment.posterior

    @property
    def state(self) -> tuple[Array, Array]:
        """Most probable state ``(6,)``, and the covariance ``(6, 6)`` of all hypotheses about it."""
        return self.mixture.about(self.mixture.mean[self.mixture.best])

    def add_fixes(self, fixes: Fixes, number: Index | None = None) -> None:
        """Add fixes; number: ``(f,)`` of each, for its `Meeting`."""
        numbers = np.arange(len(fixes)) if number is None else number
        rows = zip(
            fixes.time.tolist(), numbers.tolist(), fixes.position, fixes.sigma.tolist(), fixes.source, strict=True
        )
        for time, n, place, sigma, source in rows:
            if time <= self.time:
                self.skipped += 1
            else:
                self._wait(Arrival(time, FIX_ARRIVES, n, place, sigma, source))

    def add_heading(self, time: float, heading: float, sigma: float) -> None:
        """Add a heading at a time [s]; heading, sigma [rad]."""
        self._wait(Arrival(time, HEADING_ARRIVES, 0, heading, sigma))

    def begin_calibration(self, time: float, pace: float) -> None:
        """A new calibration begins at a time [s]; pace: change of pace, see `pace_changes`."""
        self._wait(Arrival(time, CHANGE, 0, pace))

    def _wait(self, arrival: Arrival) -> None:
        insort(self._waiting, replace(arrival, time=round(arrival.time, DECIMALS)))
        if len(self._waiting) > self._most_waiting:
            self._waiting.popleft()

    def extend(self, steps: Steps) -> None:
        """Take the next steps; follow those that ended more than HELD_BACK before, several at once."""
        self._held.append(steps)
        if self._held[0].end < steps.end - 2 * HELD_BACK:
            early = [part for part in self._held if part.end < steps.end - HELD_BACK]
            self._held = self._held[len(early) :]
            self._follow(early)

    def present(self, tail: Steps | None = None) -> KalmanFilter:
        """A second filter at the end of all steps so far, and of provisional steps."""
        other = copy(self)
        other._turned, other._sources, other._watch = self._turned.copy(), deepcopy(self._sources), None
        other._waiting = self._waiting.copy()
        other._follow([*self._held, *([] if tail is None else [tail])])
        return other

    def _follow(self, parts: Sequence[Steps]) -> None:
        """Follow consecutive steps."""
        if parts:
            deque(self.advance(concatenate_steps(parts)), maxlen=0)

    def advance(self, steps: Steps) -> Iterator[Moment]:
        """Follow the next steps; yields the state at the start of the walk, and at the end of each piece."""
        start, end, whole = round(steps.start, DECIMALS), round(steps.end, DECIMALS), whole_pieces(steps)
        if self.moment is None:
            yield self._measured(Moment.of(start, self._begin))
        begin = self.time
        if not end > begin:
            return
        moments = np.unique([*(arrival.time for arrival in self._waiting if begin < arrival.time < end), end])
        pieces = intervals(whole, min(start, begin), begin, moments)
        ends = np.union1d(whole[(whole[:, 0] > begin) & (whole[:, 0] < end), 0], moments).tolist()
        changes = self._changes(steps)
        for i, moment in enumerate(moments.tolist()):
            here = pieces.between(i, i + 1)
            *before, last = self._predicted(here, ends[pieces.first[i] : pieces.last[i] + 1], changes)
            yield from before
            self._reckon(here, moment)
            yield self._measured(last)

    def _predicted(self, pieces: Pieces, ends: list[float], changes: Mapping[float, Array]) -> list[Moment]:
        """Predict through the pieces up to ``ends (k,)`` [s]: p ← p + R_s l e(θ + half the turn), θ ← θ + R_d turn +
        b time, c a random walk. There are no measurements between, so all pieces are computed at once, ``(k, h, …)``.

        changes: variances ``(3,)`` of the changes of the calibration at the ends of pieces.
        """
        mixture, length = self.mixture, pieces.length[:, None]
        turn, time = 2 * (pieces.to_end - pieces.to_middle)[:, :, None]
        theta, R_s, R_d, b = mixture.mean[:, 2:].T
        turned = R_d * turn + b * time
        heading = theta + np.cumsum(turned, axis=0)
        course, stride = heading - turned / 2, R_s * length
        ahead = np.stack([np.cos(course), np.sin(course)], axis=2)
        left = stride[..., None] * np.stack([-ahead[..., 1], ahead[..., 0]], axis=2)

        mean = np.empty((*course.shape, 6))
        mean[..., :2] = mixture.mean[:, :2] + np.cumsum(stride[..., None] * ahead, axis=0)
        mean[..., 2], mean[..., 3:] = heading, mixture.mean[:, 3:]
        F = np.zeros((*course.shape, 6, 6))
        F[..., range(6), range(6)] = 1.0
        F[..., :2, 2], F[..., :2, 3] = left, length[..., None] * ahead
        F[..., :2, 4], F[..., :2, 5] = left * turn[..., None] / 2, left * time[..., None] / 2
        F[..., 2, 4], F[..., 2, 5] = turn, time
        swing = np.concatenate([left / 2, np.ones_like(turned)[..., None]], axis=2)  # by the error of the turn
        Q = np.zeros_like(F)
        Q[..., :3, :3] = pieces.variance[:, 1, None, None, None] * swing[..., None] * swing[..., None, :]
        Q[..., range(2), range(2)] += pieces.variance[:, 0, None, None] + SIGMA_STILL**2

        rows, P, moments, calibration = np.arange(len(mixture)), mixture.covariance, [], np.arange(3, 6)
        for m, (end, motion) in enumerate(zip(ends, F, strict=True)):
            if self._change.any():
                P = P.copy()
                P[:, calibration, calibration] += self._change
            P = motion @ P @ motion.swapaxes(1, 2) + Q[m]
            after = GaussianMixture(mean[m], P, mixture.log_weight, rows)
            moments.append(Moment(end, rows, motion, after, after))
            self._change = changes.get(end, NO_CHANGE)
        return moments

    def _changes(self, steps: Steps) -> dict[float, Array]:
        """Variances ``(3,)`` of the changes of the calibration, by the time at which a step ends [s]."""
        if self._watch is None:
            return {}
        ends, on_stairs = np.round(steps.time, DECIMALS).tolist(), (steps.sigma_length == TREADS.sigma).tolist()
        columns = steps.duration.tolist(), steps.length.tolist(), on_stairs, steps.is_gap.tolist()
        begun = [self._watch.after(*row) for row in zip(*columns, strict=True)]
        return {end: self._by_pace(pace) for end, pace in zip(ends, begun, strict=True) if pace is not None}

    def _by_pace(self, pace: float) -> Array:
        """Variances ``(3,)`` of the change of the calibration with this change of pace."""
        return np.square(change_sigma(self.prior.change, np.array([pace]))[0])

    def _reckon(self, pieces: Pieces, time: float) -> None:
        """Add the pieces up to a time [s] to dead reckoning and to the turns."""
        course = self._heading + pieces.to_middle[0]
        self._track += complex(pieces.length @ np.exp(1j * course))
        self._heading += float(pieces.to_end[0, -1])
        self.walked += float(pieces.length.sum())
        variance = self._turned[-1][2] if self._turned else 0.0
        self._turned.append((time, self._heading, variance + float(pieces.variance[:, 1].sum())))
        while self._turned[0][0] < time - LONGEST_CARRY:
            self._turned.popleft()

    def _measured(self, moment: Moment) -> Moment:
        """Correct with the arrivals up to a moment, which wait no longer; this is the present moment then."""
        due = list[Arrival]()
        while self._waiting and self._waiting[0].time <= moment.time:
            due.append(self._waiting.popleft())
        for arrival in due:
            if arrival.kind == FIX_ARRIVES:
                moment = self._fixed(moment, arrival)
            elif arrival.kind == HEADING_ARRIVES:
                H, variance = self._carried(arrival, moment.time)
                mixture = heading_corrected(moment.posterior, H, arrival.value, variance)
                moment = replace(moment, posterior=mixture)
            else:
                self._change = self._by_pace(arrival.value)
        self.moment = replace(moment, posterior=thinned(moment.posterior)) if due else moment
        return self.moment

    def _carried(self, heading: Arrival, now: float) -> tuple[Array, float]:
        """Measurement matrix ``(1, 6)`` and variance [rad²] at ``now`` [s] of a heading, which may be earlier."""
        H, variance = OF_HEADING, heading.sigma**2
        if self._turned and heading.time < now:
            times, turns, variances = zip(*self._turned, strict=True)
            H = H.copy()
            H[0, 4:] = np.interp(heading.time, times, turns) - turns[-1], heading.time - now
            variance += variances[-1] - float(np.interp(heading.time, times, variances))
        return H, variance

    def _independent_share(self, fix: Arrival) -> float:
        """The share of the information of a fix that is independent of earlier fixes of its receiver; 0 if the receiver
        holds its position while the steps lead away.
        """
        if not fix.source:
            return 1.0
        history = self._sources.setdefault(
            fix.source, SourceHistory(deque(maxlen=MOST_ARRIVALS), fix.value, self._track)
        )
        if np.hypot(*(fix.value - history.place)) >= RECEIVERS.still:
            history.place, history.track, history.away = fix.value, self._track, 0.0
        history.away = max(history.away, abs(self._track - history.track))
        if history.away > RECEIVERS.away:
            return 0.0
        drifted = drift_of(fix.time, self.walked)
        history.drifts.append(drifted)
        while history.drifts[0] <= drifted - 1.0:
            history.drifts.popleft()
        while len(self._sources) > MOST_ARRIVALS:
            del self._sources[next(iter(self._sources))]
        return 1.0 / (2 * len(history.drifts) - 1)  # as many later fixes will have about its error

    def _fixed(self, moment: Moment, fix: Arrival) -> Moment:
        """Correct with a fix."""
        overhang, share = max(moment.time - fix.time, 0.0), self._independent_share(fix)
        if overhang > FIXES.longest_overhang or not share:
            return moment
        place, sigma = fix.value, float(np.hypot(fix.sigma, FIXES.walking_speed * overhang))
        if not self.located:
            moment = replace(moment, predicted=moved(moment.predicted, place), posterior=moved(moment.posterior, place))
        self.located, self._fixes = True, self._fixes + 1
        bank = moment.posterior
        updated, row, sigmas, weight = corrected(bank, place, sigma, share)
        best = updated.best
        distance = float(np.hypot(*(place - bank.mean[row[best], :2])))
        meeting = Meeting(fix.number, distance, float(sigmas[best]), float(weight[best]), reset=False)
        self._refused = self._refused + 1 if meeting.weight == 0.0 else 0
        if self._refused == KALMAN.patience:
            moment, self._refused = _lost(moment), 0
            updated = corrected(moment.posterior, place, sigma, share)[0]
            meeting = replace(meeting, weight=1.0, reset=True)
        elif self._fixes == 2:  # perhaps the first was wrong, and this is where the walk is
            lost = _lost(moment)
            elsewhere = corrected(lost.posterior, place, sigma, share)[0]
            cost = np.where(weight > 0, huber_cost(np.minimum(sigmas, FIXES.outlier)), PRICES.wrong_fix)
            log_weight = elsewhere.log_weight + np.logaddexp.reduce(updated.log_weight + cost) - PRICES.wrong_fix
            elsewhere = replace(elsewhere, log_weight=log_weight, origin=elsewhere.origin + len(moment.predicted))
            parent, motion = np.append(moment.parent, lost.parent), np.concatenate([moment.motion, lost.motion])
            predicted = joined(moment.predicted, lost.predicted)
            moment = replace(moment, parent=parent, motion=motion, predicted=predicted)
            updated = joined(updated, elsewhere)
            updated = updated.take(np.arange(len(updated)))
        return replace(moment, posterior=updated, met=(*moment.met, meeting))


def _lost(moment: Moment) -> Moment:
    """The prediction, which rejected fixes did not change, with an unknown pose and directions around the circle."""
    winner = moment.posterior.origin[[moment.posterior.best]]
    lost = moment.predicted.take(winner)
    forgotten = lost.covariance + np.diag(np.square([FAR, FAR, FAR, 0.0, 0.0, 0.0]))
    anywhere = replace(lost, covariance=forgotten, origin=np.zeros(1, dtype=np.intp))
    return replace(
        moment,
        parent=moment.parent[winner],
        motion=moment.motion[winner],
        predicted=anywhere,
        posterior=by_direction(anywhere),
    )


def moved(mixture: GaussianMixture, by: Array) -> GaussianMixture:
    """The mixture moved by ``(2,)`` [m]."""
    return replace(mixture, mean=mixture.mean + np.append(by, np.zeros(4)))


def start_mixture(prior: Prior, place: Array, sigmas: tuple[float, float]) -> GaussianMixture:
    """A start at ``place (2,)`` [m] with heading 0; sigmas: of position [m] and heading [rad]."""
    mean, covariance = np.append(place, [0.0, *prior.mean]), np.zeros((6, 6))
    covariance[:3, :3] = np.diag(np.square([sigmas[0], sigmas[0], sigmas[1]]))
    covariance[3:, 3:] = prior.covariance
    return GaussianMixture(mean[None], covariance[None], np.zeros(1), np.zeros(1, dtype=np.intp))


def kalman_filter(graph: WalkGraph) -> Estimate:
    """The causal estimate at every row: each pose uses the measurements up to its time.

    graph: the same measurements as for ``smooth``; its walls are not used.
    """
    expect("kalman_filter, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")
    times, states, met, last = list[float](), list[tuple[Array, Array]](), list[Meeting](), np.zeros(1)
    for moment in moments(graph):  # only the smoother needs all moments at once
        mixture = moment.posterior
        times.append(moment.time)
        states.append(mixture.about(mixture.mean[mixture.best]))
        met += moment.met
        last = mixture.log_weight
    means, covariances = (np.array(column) for column in zip(*states, strict=True))
    return _estimate(graph, np.array(times), means, covariances, met, last)


def _estimate(
    graph: WalkGraph, times: Array, means: Array, covariances: Array, met: list[Meeting], last: Array
) -> Estimate:
    """The estimate from states ``(m, 6)`` and covariances ``(m, 6, 6)`` at ``times (m,)`` [s].

    met: how fixes were used; last: ``(h,)`` log of the probabilities at the end.
    """
    rows = np.searchsorted(times, np.round(row_times(graph.steps), DECIMALS))
    position, heading = means[rows, :2], wrap_angle(means[rows, 2])
    last_interval = np.append(np.flatnonzero(np.diff(graph.segment)), len(graph.segment) - 1)
    of_segment = np.searchsorted(times, graph.keyframe_time[last_interval + 1])
    calibration = calibration_of(graph, means[of_segment, 3:], covariances[of_segment, 3:, 3:])
    probability, walks = float(np.exp(last.max())), int(np.sum(last > np.log(REPORTS.least_reported)))
    refused = sum(meeting.weight == 0.0 for meeting in met)
    resets = [f"{graph.positions.fixes.time[meeting.fix]:.1f} s" for meeting in met if meeting.reset]
    lost = {
        f"{count(refused, 'fix')} rejected: more than {FIXES.outlier:.0f} sigma from the expected position": refused,
        f"the filter was lost and re-initialised at {', '.join(resets)}": resets,
    }
    warned = (*warnings(graph, walks, probability, True, calibration), *(text for text, holds in lost.items() if holds))
    estimate = Estimate(
        trajectory=Trajectory(row_times(graph.steps), position, heading, graph.floors, covariances[rows, :3, :3]),
        dead_reckoning=lay_dead_reckoning(graph.steps, graph.positions.fixes[graph.positions.consistent]),
        calibration=calibration,
        reports={graph.positions.name: _reports(graph, met)},
        iterations=1,
        cost=float("nan"),
        converged=True,
        probability=probability,
        warnings=warned,
        contradictions=(
            *plan_contradictions(graph),
            *missing_steps(graph.steps),
        ),
    )
    return replace(estimate, probability=stated_probability(estimate, graph.floor))


def moments(graph: WalkGraph, watched: bool = True) -> Iterator[Moment]:
    """Run the filter; yields the start, then the end of each piece.

    watched: calibrations begin as in a live walk; False: as in the graph.
    """
    walk, fixes, headings = KalmanFilter(graph.prior, _start(graph), watched), graph.positions, graph.headings
    used, times = np.flatnonzero(fixes.used), graph.keyframe_time
    reached = replace(fixes.fixes, time=times[fixes.keyframe], sigma=fixes.sigma)
    walk.add_fixes(reached[used], used)
    table = headings.headings
    for n in range(1, len(table)):  # `_start` uses the first
        time = float(times[headings.keyframe[n]])
        walk.add_heading(time, float(table.heading[n]), float(table.sigma[n]))
    for n in np.flatnonzero(np.diff(graph.segment)) + 1 if not watched else ():
        walk.begin_calibration(float(times[n]), float(graph.chain.pace[graph.segment[n]]))
    return walk.advance(graph.steps)


def _start(graph: WalkGraph) -> GaussianMixture:
    """The initial state: near the first fix with a wide covariance, in the compass direction or in any.

    Without fixes at (0, 0), and without a compass with heading 0: the start defines the frame.
    """
    fixes = graph.positions
    fixed, has_heading = fixes.used.any(), len(graph.headings.headings) > 0
    place = fixes.fixes.position[fixes.used][0] if fixed else np.zeros(2)
    sigmas = FAR if fixed else FRAME_SIGMA, FAR if fixed or has_heading else FRAME_SIGMA
    bank = start_mixture(graph.prior, place, sigmas)
    if has_heading:
        # The first heading measures θ + R_d turn + b time up to its keyframe
        pieces, headings = graph.pieces, graph.headings.headings
        until = pieces.last[: graph.headings.keyframe[0]]
        H = np.zeros((1, 6))
        H[0, 2], H[0, 4:] = 1.0, pieces.to_end[:, until].sum(axis=1)
        on_the_way = pieces.variance[: len(until) and until[-1] + 1, 1].sum()
        bank = heading_corrected(bank, H, float(headings.heading[0]), float(headings.sigma[0] ** 2 + on_the_way))
    return by_direction(bank) if fixed or has_heading else bank


def _reports(graph: WalkGraph, met: list[Meeting]) -> tuple[FixReport, ...]:
    """Reports of all fixes; those outside the recording were not used."""
    distance, sigmas, weight = (np.full(len(graph.positions), fill) for fill in (np.nan, np.nan, 0.0))
    for m in met:
        distance[m.fix], sigmas[m.fix], weight[m.fix] = m.distance, m.sigmas, m.weight
    reports = list(graph.positions.reported(distance, sigmas, weight, "where it was expected"))
    again = "sigma from where it was expected, as those before: the filter is re-initialised"
    for m in met:
        if m.reset:
            reports[m.fix] = replace(reports[m.fix], reason=f"{m.sigmas:.1f} {again}")
    return tuple(reports)


def kalman_smoother(graph: WalkGraph) -> Estimate:
    """The smoothed walk at every row, along the filter's most probable hypothesis.

    graph: the same measurements as for ``smooth``; its walls are not used. Rejected fixes stay rejected.
    """
    expect("kalman_smoother, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")
    run = list(moments(graph, watched=False))
    hypothesis = run[-1].posterior.best
    mean, P = run[-1].posterior.mean[hypothesis], run[-1].posterior.covariance[hypothesis]
    means, covariances = [mean], [P]
    for before, after in zip(run[-2::-1], run[:0:-1], strict=True):
        n = after.posterior.origin[hypothesis]
        hypothesis, F, predicted = after.parent[n], after.motion[n], after.predicted
        filtered = before.posterior
        C = np.linalg.solve(predicted.covariance[n], F @ filtered.covariance[hypothesis]).T
        mean = filtered.mean[hypothesis] + C @ (mean - predicted.mean[n])
        P = filtered.covariance[hypothesis] + C @ (P - predicted.covariance[n]) @ C.T
        means.append(mean)
        covariances.append(P)
    met = [meeting for moment in run for meeting in moment.met]
    last = run[-1].posterior.log_weight
    times = np.array([moment.time for moment in run])
    estimate = _estimate(graph, times, np.array(means[::-1]), np.array(covariances[::-1]), met, last)
    track = estimate.trajectory
    fixes = graph.positions.fixes
    distance = np.hypot(*(fixes.position - interpolate(fixes.time, track.time, track.position)).T)
    reports = tuple(replace(fix, residual=float(d)) for fix, d in zip(estimate.fixes, distance, strict=True))
    return replace(estimate, reports={"fixes": reports})
