"""What a map shows of the current pose: the ways that remain, and a position that does not jump."""

from __future__ import annotations

import numpy as np

from pdr_graph.estimation.kalman import GaussianMixture
from pdr_graph.geometry import wrap_angle
from pdr_graph.online.interface import Mode
from pdr_graph.priors import REPORTS
from pdr_graph.types import Array

FOLLOWED = 2.0  # [s] within which a jump of the pose is caught up


def modes_of(ways: GaussianMixture) -> tuple[Mode, ...]:
    """The ways of a mixture with their probabilities, the most probable first."""
    modes = []
    for n in np.argsort(-ways.log_weight, kind="stable").tolist():
        probability, (x, y, heading) = float(np.exp(ways.log_weight[n])), ways.mean[n, :3].tolist()
        if probability >= REPORTS.least_reported or not modes:
            modes.append(Mode(probability, x, y, float(wrap_angle(heading)), ways.covariance[n, :3, :3]))
    return tuple(modes)


class Display:
    """A position that moves with the walker and catches up jumps of the pose evenly, within FOLLOWED seconds."""

    def __init__(self) -> None:
        self._time, self._walked, self._position, self._speed = np.nan, 0.0, np.zeros(2), 0.0

    def at(self, time: float, position: Array, heading: float, walked: float) -> tuple[float, float]:
        """The position x, y [m] at a time [s], for a pose at ``position (2,)`` [m] after ``walked`` [m]."""
        if np.isnan(self._time):
            self._position = position.copy()
        else:
            ahead = (walked - self._walked) * np.array([np.cos(heading), np.sin(heading)])
            behind = self._position + ahead - position
            self._position = position + self._left(float(np.hypot(*behind)), time - self._time) * behind
        self._time, self._walked = time, walked
        x, y = self._position.tolist()
        return x, y

    def _left(self, distance: float, seconds: float) -> float:
        """The share that is left after ``seconds`` of a ``distance`` [m] to catch up."""
        self._speed = max(self._speed, distance / FOLLOWED)
        if distance <= self._speed * max(seconds, 0.0):
            self._speed = 0.0
            return 0.0
        return 1.0 - self._speed * max(seconds, 0.0) / distance
