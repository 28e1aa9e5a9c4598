"""The causal Kalman filter of a walk, its Rauch–Tung–Striebel smoother, and mixtures of Gaussians.

The fusion of [gps-dr] as one extended Kalman filter over (x, y, θ, R_s, R_d, b), the variables of the graph, over the
same pieces and fixes:

    predict   p ← p + R_s l e(θ + half the turn),  θ ← θ + R_d turn + b time      (Secs. 2, 3: strides, gyro)
              Q from the stride's variance (Sec. 4), and from sway and turn, which are not in the paper
    correct   with validated magnetic headings, R by both tests of the field      (Sec. 3)
              with fixes, R by the receiver's accuracy or HDOP                    (Sec. 4)

The paper has one filter for the heading and another for the position, so its fixes correct neither heading nor stride;
in one state they do. Its magnetometer measures the heading from the first step on; here the first magnetic heading is
carried back to the start by the gyro. A fix beyond the gate is rejected, and where a nearer one may be wrong, the
filter goes on with it and without it, until later fixes decide; so does it with the first fix at the second. After
several rejected in a row it is re-initialised at their position.

An unknown direction, or one from a rough compass, is too uncertain for one linearisation: a mixture of filters, one per
direction, runs in parallel, and measurements decide between them. A measurement beyond the gate of a hypothesis does
not correct it.

The smoother is that of Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
Journal 3(8), 1965. Backwards from the end, each state is corrected by the one after it:

    C_k = P_k F_kᵀ (P⁻_{k+1})⁻¹
    x̂_k = x_k + C_k (x̂_{k+1} − x⁻_{k+1}),      P̂_k = P_k + C_k (P̂_{k+1} − P⁻_{k+1}) C_kᵀ

with the filter's posterior x, P and prediction x⁻, P⁻. It is linearised once, along the filter's walk; the graph is
relinearised along its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.errors import count, expect
from pdr_graph.estimation.factors.base import huber_cost, huber_weight
from pdr_graph.estimation.factors.chain import SIGMA_STILL
from pdr_graph.estimation.factors.start import FRAME_SIGMA, change_sigma
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.initialization import lay_dead_reckoning
from pdr_graph.estimation.results import (
    calibration_of,
    movement_contradictions,
    plan_contradictions,
    stated_probability,
    time_on_steps,
    warnings,
)
from pdr_graph.geometry import differences, interpolate, row_times, wrap_angle
from pdr_graph.priors import FIXES, KALMAN, PRICES, REPORTS, SEARCH
from pdr_graph.types import Array, Estimate, FixReport, Index, Trajectory

FAR = 1e3  # [m, rad] standard deviation of an unknown position or direction
EXACT = 1e-3  # [rad] least sigma for the weights of directions


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
    S = expected + R
    sigmas = np.sqrt(np.einsum("hi,hij,hj->h", gap, np.linalg.inv(S), gap))
    weight = np.where(sigmas < FIXES.outlier, huber_weight(sigmas), 0.0)
    log_weight = bank.log_weight - huber_cost(np.minimum(sigmas, FIXES.outlier)) - 0.5 * np.log(np.linalg.det(S))

    weighted = expected + R / np.where(weight > 0, share * weight, 1.0)[:, None, None]
    K = (weight > 0)[:, None, None] * cross.transpose(0, 2, 1) @ np.linalg.inv(weighted)
    covariance = bank.covariance - K @ cross
    mean = bank.mean + np.einsum("hij,hj->hi", K, gap)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    log_weight -= np.logaddexp.reduce(log_weight)
    return GaussianMixture(mean, covariance, log_weight, bank.origin), sigmas, weight


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
    kept = replace(bank.take(without), log_weight=(updated.log_weight + spared)[without])
    row, whole = np.append(np.arange(len(bank)), without), joined(updated, kept)
    most = np.argsort(-whole.log_weight, kind="stable")[: KALMAN.most]
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
    apart = np.einsum("hi,ij,hj->h", pose, np.linalg.inv(bank.covariance[bank.best, :3, :3]), pose)
    same = apart < KALMAN.same**2
    keep = ~same & (bank.log_weight > np.log(KALMAN.hopeless))
    keep[bank.best] = True
    log_weight = bank.log_weight.copy()
    log_weight[bank.best] = np.logaddexp.reduce(log_weight[same])
    return replace(bank, log_weight=log_weight).take(np.flatnonzero(keep))


def by_direction(wide: GaussianMixture) -> GaussianMixture:
    """Split one hypothesis of uncertain direction into SEARCH.directions narrow ones around the circle.

    Together they have its Gaussian with Huber's tails: directions far from a compass heading keep a small probability.
    The first has the direction of ``wide``.
    """
    V, width = wide.covariance[0, 2, 2], np.pi / SEARCH.directions
    off = np.asarray(wrap_angle(np.linspace(0, 2 * np.pi, SEARCH.directions, endpoint=False)))
    wider, by_heading = max(V - width**2, 0.0), wide.covariance[0, 2] / V
    narrow = wide.covariance[0] - wider * np.outer(by_heading, by_heading)
    all_round = np.zeros(SEARCH.directions, dtype=np.intp)
    log_weight = -huber_cost(np.minimum(np.abs(off) / np.sqrt(max(wider, EXACT**2)), FIXES.outlier))
    log_weight -= np.logaddexp.reduce(log_weight)
    return GaussianMixture(
        wide.mean + off[:, None] * by_heading, np.tile(narrow, (SEARCH.directions, 1, 1)), log_weight, all_round
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

    predicted: before the measurements of this moment; posterior: after them. Hypothesis n of ``predicted`` came from
    ``parent (h,)`` n of the moment before, by a movement whose derivative is ``motion (h, 6, 6)`` n.
    """

    parent: Index
    motion: Array
    predicted: GaussianMixture
    posterior: GaussianMixture
    met: tuple[Meeting, ...]


def kalman_filter(graph: WalkGraph) -> Estimate:
    """The causal estimate at every row: each pose uses the measurements up to its time.

    graph: the same measurements as for ``smooth``; its walls are not used.
    """
    expect("kalman_filter, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")
    states, met, last = list[tuple[Array, Array]](), list[Meeting](), np.zeros(1)
    for moment in moments(graph):  # only the smoother needs all moments at once
        mixture = moment.posterior
        states.append(mixture.about(mixture.mean[mixture.best]))
        met += moment.met
        last = mixture.log_weight
    means, covariances = (np.array(column) for column in zip(*states, strict=True))
    return _estimate(graph, means, covariances, met, last)


def _estimate(graph: WalkGraph, means: Array, covariances: Array, met: list[Meeting], last: Array) -> Estimate:
    """The estimate from states ``(m + 1, 6)`` and covariances ``(m + 1, 6, 6)`` at the start and after each piece.

    met: how fixes were used; last: ``(h,)`` log of the probabilities at the end.
    """
    rows = np.concatenate([[0], graph.pieces.row_end + 1])
    position, heading = means[rows, :2], wrap_angle(means[rows, 2])
    of_segment = graph.pieces.last[np.append(np.flatnonzero(np.diff(graph.segment)), -1)] + 1
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
            *movement_contradictions(graph.steps.stepless, time_on_steps(graph.steps)),
        ),
    )
    return replace(estimate, probability=stated_probability(estimate, graph.floor))


def moments(graph: WalkGraph) -> Iterator[Moment]:
    """Run the filter; yields the start, then the end of each piece."""
    keyframes, fixes = np.arange(1, len(graph.pieces.last) + 1), graph.positions
    used = np.flatnonzero(fixes.used)
    used = used[np.argsort(fixes.keyframe[used], kind="stable")]
    fixes_at = np.split(used, np.searchsorted(fixes.keyframe[used], keyframes))
    later = graph.headings.keyframe[1:]  # `_start` uses the first
    headings_at = np.split(1 + np.arange(len(later)), np.searchsorted(later, keyframes))
    heading, sigma = graph.headings.headings.heading, graph.headings.headings.sigma
    moment, refused = _start(graph), 0
    for keyframe in range(len(fixes_at)):
        if keyframe > 0:
            *before, moment = _predicted(moment.posterior, graph, keyframe - 1)
            yield from before
        for n in fixes_at[keyframe].tolist():
            moment, refused = _fixed(moment, graph, n, refused)
        mixture = moment.posterior
        for n in headings_at[keyframe].tolist():
            mixture = heading_corrected(mixture, OF_HEADING, float(heading[n]), float(sigma[n] ** 2))
        moment = replace(moment, posterior=thinned(mixture))
        yield moment


def _start(graph: WalkGraph) -> Moment:
    """The initial state: near the first fix with a wide covariance, in the compass direction or in any.

    Without fixes at (0, 0), and without a compass with heading 0: the start defines the frame.
    """
    fixes = graph.positions
    fixed, has_heading = fixes.used.any(), len(graph.headings.headings) > 0
    place = FAR if fixed else FRAME_SIGMA
    mean, covariance = np.zeros(6), np.zeros((6, 6))
    mean[:2] = fixes.fixes.position[fixes.used][0] if fixed else 0.0
    mean[3:], covariance[3:, 3:] = graph.prior.mean, graph.prior.covariance
    covariance[:3, :3] = np.diag(np.square([place, place, FAR if fixed or has_heading else FRAME_SIGMA]))
    single = np.zeros(1, dtype=np.intp)
    bank = GaussianMixture(mean[None], covariance[None], np.zeros(1), single)
    if has_heading:
        # The first heading measures θ + R_d turn + b time up to its keyframe
        pieces, headings = graph.pieces, graph.headings.headings
        until = pieces.last[: graph.headings.keyframe[0]]
        H = np.zeros((1, 6))
        H[0, 2], H[0, 4:] = 1.0, pieces.to_end[:, until].sum(axis=1)
        on_the_way = pieces.variance[: len(until) and until[-1] + 1, 2].sum()
        bank = heading_corrected(bank, H, float(headings.heading[0]), float(headings.sigma[0] ** 2 + on_the_way))
    return Moment(single, np.eye(6)[None], bank, by_direction(bank) if fixed or has_heading else bank, ())


def _predicted(bank: GaussianMixture, graph: WalkGraph, i: int) -> list[Moment]:
    """Predict through each piece of interval ``i``: p ← p + R_s l e(θ + half the turn), θ ← θ + R_d turn + b time, c a
    random walk. There are no measurements between, so all pieces are computed at once, ``(k, h, …)``.
    """
    pieces, here = graph.pieces, slice(graph.pieces.first[i], graph.pieces.last[i] + 1)
    length, (turn, time) = pieces.length[here, None], 2 * (pieces.to_end - pieces.to_middle)[:, here, None]
    theta, R_s, R_d, b = bank.mean[:, 2:].T
    turned = R_d * turn + b * time
    heading = np.cumsum(np.concatenate([theta[None], turned]), axis=0)
    course = heading[:-1] + turned / 2
    ahead = np.stack([np.cos(course), np.sin(course)], axis=2)
    aside = ahead[..., ::-1] * [-1, 1]
    left = (R_s * length)[..., None] * aside

    mean = np.tile(bank.mean, (len(length), 1, 1))
    mean[..., :2] += np.cumsum((R_s * length)[..., None] * ahead, axis=0)
    mean[..., 2] = heading[1:]
    F = np.tile(np.eye(6), (*turned.shape, 1, 1))
    by_c = [left, length[..., None] * ahead, left * turn[..., None] / 2, left * time[..., None] / 2]
    F[..., :2, 2:] = np.stack(by_c, axis=3)
    F[..., 2, 4], F[..., 2, 5] = turn, time
    G = np.zeros((*turned.shape, 3, 3))  # by the errors of length, sway and turn
    G[..., :2, 0], G[..., :2, 1], G[..., :2, 2], G[..., 2, 2] = ahead, aside, left / 2, 1.0
    variance = pieces.variance[here] + SIGMA_STILL**2 * np.array([1.0, 1.0, 0.0])
    Q = np.zeros_like(F)
    Q[..., :3, :3] = (G * variance[:, None, None]) @ G.swapaxes(2, 3)

    changes, segment = np.zeros(3), graph.segment[i]
    if i > 0 and segment != graph.segment[i - 1]:
        changes = np.square(change_sigma(graph.prior.change, graph.chain.pace[[segment]])[0])
    rows, P, moments_of_pieces = np.arange(len(bank)), bank.covariance + np.diag(np.append(np.zeros(3), changes)), []
    for m, motion in enumerate(F):
        P = motion @ P @ motion.swapaxes(1, 2) + Q[m]
        after = GaussianMixture(mean[m], P, bank.log_weight, rows)
        moments_of_pieces.append(Moment(rows, motion, after, after, ()))
    return moments_of_pieces


def _fixed(moment: Moment, graph: WalkGraph, n: int, refused: int) -> tuple[Moment, int]:
    """Correct with fix ``n``. refused: number of fixes rejected in a row before it; its new value is returned."""
    fixes = graph.positions
    second = np.flatnonzero(fixes.used)[1:2]
    place, sigma = fixes.fixes.position[n], float(fixes.sigma[n])
    share = float(fixes.sigma[n] / fixes.independent_sigma[n]) ** 2
    bank = moment.posterior
    updated, row, sigmas, weight = corrected(bank, place, sigma, share)
    best = updated.best
    distance = float(np.hypot(*(place - bank.mean[row[best], :2])))
    meeting = Meeting(n, distance, float(sigmas[best]), float(weight[best]), reset=False)
    refused = refused + 1 if meeting.weight == 0.0 else 0
    if refused == KALMAN.patience:
        moment, refused = _lost(moment), 0
        updated, meeting = corrected(moment.posterior, place, sigma, share)[0], replace(meeting, weight=1.0, reset=True)
    elif n in second:  # perhaps the first was wrong, and this is where the walk is
        lost = _lost(moment)
        elsewhere = corrected(lost.posterior, place, sigma, share)[0]
        cost = np.where(weight > 0, huber_cost(np.minimum(sigmas, FIXES.outlier)), PRICES.wrong_fix)
        log_weight = elsewhere.log_weight + np.logaddexp.reduce(updated.log_weight + cost) - PRICES.wrong_fix
        elsewhere = replace(elsewhere, log_weight=log_weight, origin=elsewhere.origin + len(moment.predicted))
        parent, motion = np.append(moment.parent, lost.parent), np.concatenate([moment.motion, lost.motion])
        moment = Moment(parent, motion, joined(moment.predicted, lost.predicted), moment.posterior, moment.met)
        updated = joined(updated, elsewhere)
        updated = updated.take(np.arange(len(updated)))
    return replace(moment, posterior=updated, met=(*moment.met, meeting)), refused


def _lost(moment: Moment) -> Moment:
    """The prediction, which rejected fixes did not change, with an unknown pose and directions around the circle."""
    winner = moment.posterior.origin[[moment.posterior.best]]
    lost = moment.predicted.take(winner)
    forgotten = lost.covariance + np.diag(np.square([FAR, FAR, FAR, 0.0, 0.0, 0.0]))
    anywhere = replace(lost, covariance=forgotten, origin=np.zeros(1, dtype=np.intp))
    return Moment(moment.parent[winner], moment.motion[winner], anywhere, by_direction(anywhere), moment.met)


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
    run = list(moments(graph))
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
    estimate = _estimate(graph, np.array(means[::-1]), np.array(covariances[::-1]), met, last)
    track = estimate.trajectory
    fixes = graph.positions.fixes
    distance = np.hypot(*(fixes.position - interpolate(fixes.time, track.time, track.position)).T)
    reports = tuple(replace(fix, residual=float(d)) for fix, d in zip(estimate.fixes, distance, strict=True))
    return replace(estimate, reports={"fixes": reports})
