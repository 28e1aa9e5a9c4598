"""The current position by fixes alone: before the first steps, and where no steps can be detected."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.kalman import OF_POSITION, measured
from pdr_graph.estimation.live.prediction import single_mode
from pdr_graph.priors import FIXES_ALONE
from pdr_graph.types import Array, Fixes


@dataclass(frozen=True)
class FixesAlone:
    """A Kalman filter of positions.

    time [s], mean ``(2,)`` [m], covariance ``(2, 2)``; beyond: number of fixes in a row that were not used.
    """

    time: float
    mean: Array
    covariance: Array
    beyond: int = 0

    @classmethod
    def begin(cls, time: float, position: Array, sigma: float) -> FixesAlone:
        """Begin at the first fix [s, m]."""
        return cls(time, position.copy(), sigma**2 * np.eye(2))

    def at(self, time: float) -> Array:
        """Covariance ``(2, 2)`` at a time [s]."""
        return self.covariance + FIXES_ALONE.wander**2 * max(time - self.time, 0.0) * np.eye(2)

    def after(self, time: float, position: Array, sigma: float) -> FixesAlone:
        """The state after another fix; one beyond the gate is not used, but for the third in a row."""
        if self.beyond + 1 >= FIXES_ALONE.given_up:
            return FixesAlone.begin(time, position, sigma)
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = self.at(time)
        mixture = single_mode(np.append(self.mean, np.zeros(4)), covariance)
        mixture, surprise = measured(mixture, OF_POSITION, (position - self.mean)[None], sigma**2 * np.eye(2))
        if surprise.weight[0] == 0.0:
            return replace(self, beyond=self.beyond + 1)
        return FixesAlone(max(time, self.time), mixture.mean[0, :2], mixture.covariance[0, :2, :2])


def after_fixes(state: FixesAlone | None, fixes: Fixes) -> FixesAlone | None:
    """The state after some fixes; begins at the first."""
    for time, position, sigma in zip(fixes.time.tolist(), fixes.position, fixes.sigma.tolist(), strict=True):
        state = FixesAlone.begin(time, position, sigma) if state is None else state.after(time, position, sigma)
    return state
