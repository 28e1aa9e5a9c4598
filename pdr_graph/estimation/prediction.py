"""The filter's pose at once: from the last keyframe, through steps and fixes that the graph does not have yet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdr_graph.estimation.bank import Bank, measured
from pdr_graph.estimation.preintegration import bridge, one_interval, preintegrate
from pdr_graph.geometry import pose_rotation
from pdr_graph.types import Array

OF_POSITION = np.eye(2, 6)
LEFT = np.array([[0.0, -1.0], [1.0, 0.0]])
ONE = np.zeros(1, dtype=np.intp)


@dataclass(frozen=True)
class Belief:
    """Mean ``(6,)`` and covariance ``(6, 6)`` of (x, y, θ, R_s, R_d, b), axes those of the output."""

    mean: Array
    covariance: Array

    def after(self, whole: Array, start: float, begin: float, end: float) -> Belief:
        """After the steps between two moments [s], of whole pieces as of `one_interval`."""
        if end - begin < 1e-6:
            return self
        pieces = one_interval(whole, start, begin, end)
        increments = preintegrate(pieces, self.mean[None, 3:])
        root = bridge(pieces, increments).root[0]
        delta, by_c = increments.delta[-1], increments.by_c[-1]
        R = pose_rotation(self.mean[2:3])[0]
        mean = self.mean.copy()
        mean[:3] += R @ delta
        F = np.eye(6)
        F[:2, 2] = LEFT @ (R[:2, :2] @ delta[:2])
        F[:3, 3:] = R @ by_c
        covariance = F @ self.covariance @ F.T
        covariance[:3, :3] += R @ np.linalg.inv(root.T @ root) @ R.T
        return Belief(mean, covariance)

    def adrift(self, walked: float) -> Belief:
        """The same of a walk whose direction nobody knows, ``walked`` [m] further: no position tells of it yet."""
        covariance = self.covariance.copy()
        covariance[:2, 2:] = covariance[2:, :2] = 0.0
        covariance[:2, :2] += walked**2 * np.eye(2)
        return Belief(self.mean, covariance)

    def seen(self, position: Array, sigma: float, share: float) -> Belief:
        """After a fix, with Huber's weight and none beyond the gate. share: of it that others do not say too."""
        bank = Bank(self.mean[None], self.covariance[None], np.zeros(1), ONE)
        known, _ = measured(bank, OF_POSITION, (position - self.mean[:2])[None], sigma**2 * np.eye(2), share)
        return Belief(known.mean[0], known.covariance[0])
