"""The filter front end: the walk as it is known at each moment, from what came before.

An extended Kalman filter over (x, y, θ, R_s, R_d, b), the variables of the graph, over the same pieces and fixes
([gps-dr] Sec. 4 with the walker's calibration as further states). A direction that nobody knows is not Gaussian: a bank
of filters starts in as many directions, and the fixes decide between them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pdr_graph.estimation.graph import FRAME_SIGMA, STEPS_PER_SEGMENT, Prior, WalkGraph
from pdr_graph.estimation.initial import lay_dead_reckoning
from pdr_graph.estimation.reports import fix_reports, warnings
from pdr_graph.estimation.robust import HUBER_WIDTH, gripping
from pdr_graph.geometry import row_times, wrap_angle
from pdr_graph.types import Array, Calibration, Estimate, Index, Trajectory

DIRECTIONS = 12
FAR = 1e3  # [m] standard deviation of a position before the first fix
HOPELESS = 1e-6  # probability at which a direction is given up


@dataclass(frozen=True)
class Bank:
    """Gaussian hypotheses.

    mean: ``(h, 6)`` x, y, θ, R_s, R_d, b; covariance: ``(h, 6, 6)``; log_weight: ``(h,)`` log of the probability.
    """

    mean: Array
    covariance: Array
    log_weight: Array

    def summary(self) -> tuple[Array, Array]:
        """Pose ``(3,)`` of the most probable hypothesis, and the covariance ``(3, 3)`` of all about it."""
        weight = np.exp(self.log_weight)
        best = self.mean[np.argmax(weight), :3]
        apart = self.mean[:, :3] - best
        apart[:, 2] = wrap_angle(apart[:, 2])
        spread = self.covariance[:, :3, :3] + apart[:, :, None] * apart[:, None, :]
        return best, np.einsum("h,hij->ij", weight, spread)


@dataclass(frozen=True)
class Surprise:
    """One fix as it came in: distance [m] from where it was expected, in sigmas, and the weight it was given."""

    distance: float
    sigmas: float
    weight: float


def kalman_filter(graph: WalkGraph) -> Estimate:
    """The causal estimate at every row: each pose knows the fixes up to its time, and no wall.

    graph: the same measurements as for ``smooth``; its walls are not used.
    """
    poses, covariances, bank, surprises = _run(graph)
    rows = np.concatenate([[0], graph.pieces.row_end + 1])
    position, heading = poses[rows, :2], wrap_angle(poses[rows, 2])
    final = int(np.argmax(bank.log_weight))
    calibration = Calibration(
        start=np.array([graph.steps.start]),
        value=bank.mean[final, None, 3:],
        covariance=bank.covariance[final][None, 3:, 3:],
        prior_sigma=np.array([graph.prior.sigma]),
    )
    seen = [surprises.get(n, Surprise(np.nan, np.nan, 0.0)) for n in range(len(graph.fixes))]
    distance, sigmas, weight = (np.array([getattr(s, f.name) for s in seen]) for f in fields(Surprise))
    return Estimate(
        trajectory=Trajectory(row_times(graph.steps), position, heading, graph.floors, covariances[rows]),
        dead_reckoning=lay_dead_reckoning(graph.steps, graph.fixes[graph.fix_used]),
        calibration=calibration,
        fixes=fix_reports(graph, distance, sigmas, weight, "where it was expected"),
        iterations=1,
        cost=float("nan"),
        converged=True,
        warnings=warnings(graph, 1, 1.0, True, calibration),
    )


def _run(graph: WalkGraph) -> tuple[Array, Array, Bank, dict[int, Surprise]]:
    """Once through the walk: pose and covariance before and after each piece, the final bank, how fixes were met."""
    pieces, surprises = graph.pieces, dict[int, Surprise]()
    used = np.flatnonzero(graph.fix_used)
    used = used[np.argsort(graph.fix_keyframe[used], kind="stable")]
    fixes_at = np.split(used, np.searchsorted(graph.fix_keyframe[used], np.arange(1, len(pieces.last) + 1)))
    headings_at = np.searchsorted(graph.heading_keyframe, np.arange(len(pieces.last) + 2))
    turns, times = 2 * (pieces.to_end - pieces.to_middle)
    bank = _update(_start(graph), graph, fixes_at[0], surprises)
    bank = _point(bank, graph, *headings_at[:2])
    known = [bank.summary()]
    for m, interval in enumerate(pieces.interval):
        bank = _predict(bank, pieces.length[m], turns[m], times[m], pieces.variance[m], graph.prior)
        if m == pieces.last[interval]:
            bank = _update(bank, graph, fixes_at[interval + 1], surprises)
            bank = _point(bank, graph, *headings_at[interval + 1 : interval + 3])
        known.append(bank.summary())
    poses, covariances = (np.array(column) for column in zip(*known, strict=True))
    return poses, covariances, bank, surprises


def _start(graph: WalkGraph) -> Bank:
    """Before any measurement: everywhere near the first fix, in any direction; at (0, 0) with heading 0 without one."""
    known = not graph.fix_used.any()
    count = 1 if known else DIRECTIONS
    mean = np.zeros((count, 6))
    mean[:, :2] = 0.0 if known else graph.fixes.position[graph.fix_used][0]
    mean[:, 2] = np.arange(count) * 2 * np.pi / count
    mean[:, 3:] = graph.prior.mean
    covariance = np.zeros((6, 6))
    covariance[range(3), range(3)] = np.square([FRAME_SIGMA] * 3 if known else [FAR, FAR, np.pi / count])
    covariance[3:, 3:] = graph.prior.covariance
    return Bank(mean, np.tile(covariance, (count, 1, 1)), np.full(count, -np.log(count)))


def _predict(bank: Bank, length: float, turn: float, time: float, variance: Array, prior: Prior) -> Bank:
    """One piece further: p ← p + R_s l e(θ + half the turn), θ ← θ + R_d turn + b time, c a random walk."""
    theta, R_s, R_d, b = bank.mean[:, 2:].T
    turned = R_d * turn + b * time
    cos, sin = np.cos(theta + turned / 2), np.sin(theta + turned / 2)
    forward = length * np.stack([cos, sin], axis=1)
    left = R_s[:, None] * length * np.stack([-sin, cos], axis=1)

    mean = bank.mean.copy()
    mean[:, :2] += R_s[:, None] * forward
    mean[:, 2] += turned
    F = np.tile(np.eye(6), (len(mean), 1, 1))
    F[:, :2, 2:] = np.stack([left, forward, left * turn / 2, left * time / 2], axis=2)
    F[:, 2, 4:] = turn, time
    G = np.zeros((len(mean), 6, 3))  # by the errors of length, sway and turn
    G[:, :2, 0], G[:, :2, 1], G[:, :2, 2] = np.stack([cos, sin], 1), np.stack([-sin, cos], 1), left / 2
    G[:, 2, 2] = 1.0
    Q = (G * variance) @ G.transpose(0, 2, 1)
    Q[:, range(3, 6), range(3, 6)] += np.square(prior.change) / STEPS_PER_SEGMENT if length > 0 else 0.0
    return Bank(mean, F @ bank.covariance @ F.transpose(0, 2, 1) + Q, bank.log_weight)


def _update(bank: Bank, graph: WalkGraph, fixes: Index, surprises: dict[int, Surprise]) -> Bank:
    """Take in fixes one by one, each with Huber's weight; note how each was met by the most probable hypothesis."""
    for n in fixes.tolist():
        gap = graph.fixes.position[n] - bank.mean[:, :2]
        P = bank.covariance
        R = graph.fix_sigma[n] ** 2 * np.eye(2)
        sigmas = np.sqrt(np.einsum("hi,hij,hj->h", gap, np.linalg.inv(P[:, :2, :2] + R), gap))
        weight = gripping(sigmas, HUBER_WIDTH)
        best = int(np.argmax(bank.log_weight))
        surprises[n] = Surprise(float(np.hypot(*gap[best])), float(sigmas[best]), float(weight[best]))

        S = P[:, :2, :2] + R / weight[:, None, None]
        bank = _corrected(bank, P[:, :, :2] @ np.linalg.inv(S), P[:, :2, :], gap, sigmas, S)
    return bank


def _point(bank: Bank, graph: WalkGraph, first: int, after: int) -> Bank:
    """Take in some headings, each with Huber's weight."""
    for heading, sigma in zip(graph.headings.heading[first:after], graph.headings.sigma[first:after], strict=True):
        gap = wrap_angle(heading - bank.mean[:, 2])[:, None]
        P, R = bank.covariance, sigma**2
        sigmas = np.abs(gap[:, 0]) / np.sqrt(P[:, 2, 2] + R)
        weight = gripping(sigmas, HUBER_WIDTH)
        S = (P[:, 2, 2] + R / weight)[:, None, None]
        bank = _corrected(bank, P[:, :, 2:3] / S, P[:, 2:3, :], gap, sigmas, S)
    return bank


def _corrected(bank: Bank, K: Array, seen: Array, gap: Array, sigmas: Array, S: Array) -> Bank:
    """The bank after a measurement, without the hypotheses that it makes hopeless.

    K: gains ``(h, 6, d)``; seen: rows ``(h, d, 6)`` of the covariance that were measured; gap ``(h, d)``, of variance S
    ``(h, d, d)`` and ``sigmas (h,)`` large.
    """
    inner, outer = np.minimum(sigmas, HUBER_WIDTH), np.maximum(sigmas - HUBER_WIDTH, 0.0)
    log_weight = bank.log_weight - 0.5 * (inner**2 + np.log(np.linalg.det(S))) - HUBER_WIDTH * outer
    log_weight -= np.logaddexp.reduce(log_weight)
    covariance = bank.covariance - K @ seen
    keep = log_weight > np.log(HOPELESS)
    return Bank(
        (bank.mean + np.einsum("hij,hj->hi", K, gap))[keep],
        ((covariance + covariance.transpose(0, 2, 1)) / 2)[keep],
        log_weight[keep],
    )
