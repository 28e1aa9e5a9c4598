"""The current pose: an extended Kalman filter from the last keyframe through later steps and fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.factors.preintegration import bridge, intervals, preintegrate
from pdr_graph.estimation.kalman import FAR, GaussianMixture, measured
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array

H_POSITION = np.eye(2, 6)  # measurement matrix of a position
LEFT = np.array([[0.0, -1.0], [1.0, 0.0]])  # rotation by 90°
ALONE = np.zeros(1, dtype=np.intp)  # index of the only hypothesis
SHORTEST = 1e-6  # [s] between two times; less is rounding


@dataclass(frozen=True)
class Position:
    """A fix: time [s], position ``(2,)`` [m], sigma [m]; share: of its information that is independent of others."""

    time: float
    position: Array
    sigma: float
    share: float


@dataclass(frozen=True)
class Belief:
    """Mean ``(6,)`` and covariance ``(6, 6)`` of (x, y, θ, R_s, R_d, b), in the output axes."""

    mean: Array
    covariance: Array

    def with_unknown_position(self, near: Array) -> Belief:
        """The state with an unknown position near ``near (2,)`` [m], for a walk without a fix so far."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[:2] = near
        covariance[:2, :], covariance[:, :2] = 0.0, 0.0
        covariance[:2, :2] = FAR**2 * np.eye(2)
        return Belief(mean, covariance)

    def predicted(self, delta: Array, by_c: Array, spread: Array, mean_c: Array) -> Belief:
        """The state after a displacement ``delta (3,)`` at calibration ``mean_c (3,)``, with covariance ``spread``."""
        R = pose_rotation(self.mean[2:3])[0]
        delta = delta + by_c @ (self.mean[3:] - mean_c)
        mean = self.mean.copy()
        mean[:3] += R @ delta
        F = np.eye(6)
        F[:2, 2] = LEFT @ (R[:2, :2] @ delta[:2])
        F[:3, 3:] = R @ by_c
        covariance = F @ self.covariance @ F.T
        covariance[:3, :3] += R @ spread @ R.T
        return Belief(mean, covariance)

    def with_unknown_direction(self, walked: float) -> Belief:
        """The state of a walk of unknown direction, ``walked`` [m] further: position and direction uncorrelated."""
        covariance = self.covariance.copy()
        covariance[:2, 2:] = covariance[2:, :2] = 0.0
        covariance[:2, :2] += walked**2 * np.eye(2)
        return Belief(self.mean, covariance)

    def corrected(self, fix: Position) -> Belief:
        """The state after a fix, with Huber's weight, and weight 0 beyond the gate."""
        mixture = GaussianMixture(self.mean[None], self.covariance[None], np.zeros(1), ALONE)
        gap = (fix.position - self.mean[:2])[None]
        updated, _ = measured(mixture, H_POSITION, gap, fix.sigma**2 * np.eye(2), fix.share)
        return Belief(updated.mean[0], updated.covariance[0])


def predict(
    belief: Belief, whole: Array, start: float, begin: float, end: float, fixes: Sequence[Position], sure: bool
) -> Belief:
    """Predict the state from ``begin`` to ``end`` [s] through the steps and fixes between, in order of time.

    whole, start: of the steps, see `intervals`; sure: the direction of the walk is certain.
    """
    moments = np.unique([*(fix.time for fix in fixes if begin + SHORTEST < fix.time <= end), end])
    if moments[-1] < begin + SHORTEST:
        return belief
    pieces = intervals(whole, start, begin, moments)
    mean_c = belief.mean[3:]
    increments = preintegrate(pieces, np.tile(mean_c, (len(moments), 1)))
    root = bridge(pieces, increments).root
    spread = np.linalg.inv(root.transpose(0, 2, 1) @ root)
    waiting = list(fixes)
    for n, moment in enumerate(moments.tolist()):
        last = pieces.last[n]
        delta = increments.delta[last]
        belief = belief.predicted(delta, increments.by_c[last], spread[n], mean_c)
        while waiting and waiting[0].time <= moment:
            prior = belief if sure else belief.with_unknown_direction(float(np.hypot(*delta[:2])))
            belief = prior.corrected(waiting.pop(0))
    return belief
