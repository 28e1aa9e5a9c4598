"""The causal Kalman filter beside the smoother: its pose, and where both disagree.

The filter takes the same certain steps, fixes and headings, and nothing of the graph: no plan, no beacons, no search.
So two estimates of one walk share its data but not their search, and a disagreement shows that one of both is lost.

Errors of both are positively correlated, since their data are the same. So the covariance of their difference is at
most the sum of both, P_a + P_b, and the test dᵀ (P_a + P_b)⁻¹ d > REGION_99 holds at most as often as it should; where
it holds, each position is outside the 99 % region of the other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.kalman import KalmanFilter
from pdr_graph.estimation.live.live_output import Belief
from pdr_graph.geometry import REGION_99, squared_distance, wrap_angle
from pdr_graph.online.interface import Pose, modes_of
from pdr_graph.types import FINEST, Array, Contradiction, Fixes, Headings, Steps, Trajectory

COMPARE_EVERY = 5.0  # [s] between comparisons
SUSTAINED = 10.0  # [s] of disagreement from which it is said
MORE_INFORMATION = 0.25  # share by which the same heading must know more, to be used again
SAID = "the Kalman filter beside the smoother is {:.0f} m away since {:.0f} s, outside both 99 % regions"
MOST_WAITING_MEASUREMENTS = 1000  # measurements that wait for the steps of their time: without steps, none may come
PAST = "the Kalman filter beside the smoother was {:.0f} m away from {:.0f} to {:.0f} s, outside both 99 % regions"
CHECK = "the sources since then: one of both estimates follows a wrong one"


def disagree(a: Array, P_a: Array, b: Array, P_b: Array) -> bool:
    """True if positions ``(2,)`` [m] with covariances ``(2, 2)`` are each outside the 99 % region of the other."""
    least = FINEST**2 * np.eye(2)  # of two estimates without errors
    return bool(squared_distance(a - b, P_a + P_b + least) > REGION_99)


def belief_of_rows(track: Trajectory, time: float) -> Belief:
    """The belief of the last row up to a time [s], with an unknown calibration."""
    row = max(int(np.searchsorted(track.time, time, side="right")) - 1, 0)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = 0.0 if track.covariance is None else track.covariance[row]
    return Belief(np.array([*track.position[row], track.heading[row], 0.0, 0.0, 0.0]), covariance)


class FilterBeside:
    """The filter of a live walk, compared with the smoother every COMPARE_EVERY seconds.

    filter: see `KalmanFilter`; apart: present distance of both positions [m] if they disagree, else 0.
    """

    def __init__(self, prior: Prior):
        self.filter, self.apart = KalmanFilter(prior, most_waiting=MOST_WAITING_MEASUREMENTS), 0.0
        self._since, self._compared = np.nan, -np.inf  # [s] begin of the disagreement; of the last comparison
        self._heading = np.nan, 0.0  # number of the last, and its information [1/rad²]
        self._ended: tuple[float, float, float] | None = None  # the last disagreement that was said: [m], from, to [s]

    def add(self, data: Any) -> None:
        """Add fixes or headings in the frame of the walk; the filter takes no other kind."""
        if isinstance(data, Fixes):
            self.filter.add_fixes(data)
        elif isinstance(data, Headings):
            for row in zip(data.time.tolist(), data.heading.tolist(), data.sigma.tolist(), strict=True):
                self.add_heading(*row)

    def add_heading(self, time: float, heading: float, sigma: float, number: float = np.nan) -> None:
        """Add a heading [rad] at a time [s]; later ones of the same number are better values of the same heading."""
        information, (last, before) = sigma**-2, self._heading
        more = information - before if number == last else information
        if more > MORE_INFORMATION * information:
            self.filter.add_heading(time, heading, more**-0.5)
            self._heading = number, information

    def pose(self, tail: Steps | None, floor: str) -> Pose | None:
        """The pose of the filter after provisional steps; None before its first fix."""
        after = self.filter.present(tail)
        if not after.located:
            return None
        mean, covariance = after.state
        x, y, heading = mean[:3].tolist()
        return Pose(after.time, x, y, float(wrap_angle(heading)), floor, covariance[:3, :3], modes_of(after.mixture))

    def compare(self, now: float, belief: Callable[[float], Belief]) -> None:
        """Compare with the smoother every COMPARE_EVERY seconds, at ``now`` [s]; belief: its belief at a time [s]."""
        if not now < self._compared + COMPARE_EVERY:
            self._compared = now
            self.judge(belief)

    def judge(self, belief: Callable[[float], Belief]) -> None:
        """Compare with the smoother at the end of the steps. belief: of the smoother at a time [s]."""
        present = self.filter.present()
        if not present.located:
            return
        (mean, covariance), smoothed, before = present.state, belief(present.time), self.apart
        self.apart = 0.0
        if disagree(mean[:2], covariance[:2, :2], smoothed.mean[:2], smoothed.covariance[:2, :2]):
            self.apart = float(np.hypot(*(mean - smoothed.mean)[:2]))
            self._since = self._since if before else present.time
        if self.sustained:
            self._ended = self.apart, self._since, present.time

    @property
    def sustained(self) -> bool:
        """True if both have disagreed for SUSTAINED seconds."""
        return self.apart > 0 and self._compared - self._since >= SUSTAINED

    def issues(self) -> tuple[str, ...]:
        """What the status says while both disagree."""
        return (SAID.format(self.apart, self._since),) if self.sustained else ()

    def contradictions(self) -> tuple[Contradiction, ...]:
        """The present disagreement."""
        return tuple(Contradiction("filter", "smoother", self.apart, "m", text, CHECK) for text in self.issues())

    def warnings(self) -> tuple[str, ...]:
        """The last disagreement, if it is over."""
        return () if self.sustained or self._ended is None else (PAST.format(*self._ended),)
