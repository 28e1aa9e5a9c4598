"""The current pose: from the last keyframe, through steps and fixes that the graph does not have yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.factors.preintegration import bridge, intervals, preintegrate
from pdr_graph.estimation.kalman import FAR, GaussianMixture, measured
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array

OF_POSITION = np.eye(2, 6)
LEFT = np.array([[0.0, -1.0], [1.0, 0.0]])
ALONE = np.zeros(1, dtype=np.intp)
SHORTEST = 1e-6  # [s] between two moments


@dataclass(frozen=True)
class Position:
    """A fix: time [s], position ``(2,)`` [m], sigma [m]; share: of its information that others do not say too."""

    time: float
    position: Array
    sigma: float
    share: float


@dataclass(frozen=True)
class Belief:
    """Mean ``(6,)`` and covariance ``(6, 6)`` of (x, y, θ, R_s, R_d, b), axes those of the output."""

    mean: Array
    covariance: Array

    def anywhere(self, near: Array) -> Belief:
        """The same with an unknown position, about ``near (2,)`` [m]: for a walk without a fix so far."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[:2] = near
        covariance[:2, :], covariance[:, :2] = 0.0, 0.0
        covariance[:2, :2] = FAR**2 * np.eye(2)
        return Belief(mean, covariance)

    def ahead(self, delta: Array, by_c: Array, spread: Array, mean_c: Array) -> Belief:
        """After steps that lead by ``delta (3,)``, in the mean of c ``mean_c (3,)``, within ``spread (3, 3)``."""
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

    def adrift(self, walked: float) -> Belief:
        """The same of a walk whose direction nobody knows, ``walked`` [m] further: no position tells of it yet."""
        covariance = self.covariance.copy()
        covariance[:2, 2:] = covariance[2:, :2] = 0.0
        covariance[:2, :2] += walked**2 * np.eye(2)
        return Belief(self.mean, covariance)

    def seen(self, fix: Position) -> Belief:
        """After a fix, with Huber's weight and none beyond the gate."""
        bank = GaussianMixture(self.mean[None], self.covariance[None], np.zeros(1), ALONE)
        gap = (fix.position - self.mean[:2])[None]
        known, _ = measured(bank, OF_POSITION, gap, fix.sigma**2 * np.eye(2), fix.share)
        return Belief(known.mean[0], known.covariance[0])


def predicted(
    belief: Belief, whole: Array, start: float, begin: float, end: float, fixes: Sequence[Position], sure: bool
) -> Belief:
    """The belief at ``end`` [s] from that at ``begin``, through steps and fixes in between, in order of time.

    whole, start: of the steps, as of `intervals`; sure: the direction of the walk is known.
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
        belief = belief.ahead(delta, increments.by_c[last], spread[n], mean_c)
        while waiting and waiting[0].time <= moment:
            known = belief if sure else belief.adrift(float(np.hypot(*delta[:2])))
            belief = known.seen(waiting.pop(0))
    return belief
