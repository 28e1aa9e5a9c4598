"""Where there are fixes and no steps: a GPX track, or a log without an accelerometer."""

from __future__ import annotations

import numpy as np

from pdr_graph.types import Array, Estimate, Fixes, FixReport, Trajectory

ANY_HEADING = np.pi / np.sqrt(3)  # [rad] standard deviation of a direction that nobody knows


def follow(fixes: Fixes) -> Estimate:
    """The walk as straight lines from fix to fix, each as uncertain as it says; nothing between them is known.

    fixes: at least one, in order of time, in the output frame. Heading is the direction to the next fix.
    """
    heading, sigma_heading = _courses(fixes)
    covariance = np.zeros((len(fixes), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = fixes.sigma**2
    covariance[:, 2, 2] = sigma_heading**2
    track = Trajectory(fixes.time, fixes.position, heading, fixes.floor, covariance)
    columns = np.column_stack([fixes.time, fixes.position, fixes.sigma]).tolist()
    return Estimate(
        trajectory=track,
        dead_reckoning=track,
        calibration=None,
        fixes=tuple(FixReport(t, x, y, s, 0.0, 1.0, "the walk itself: there are no steps") for t, x, y, s in columns),
        iterations=0,
        cost=0.0,
        converged=True,
    )


def _courses(fixes: Fixes) -> tuple[Array, Array]:
    """Direction from each fix to the next [rad] and its standard deviation; the last keeps the one before."""
    if len(fixes) < 2:
        return np.zeros(1), np.array([ANY_HEADING])
    way = np.diff(fixes.position, axis=0)
    across = np.hypot(fixes.sigma[1:], fixes.sigma[:-1])
    sigma = np.minimum(ANY_HEADING, across / np.maximum(np.hypot(*way.T), 1e-9))
    return np.append(c := np.arctan2(way[:, 1], way[:, 0]), c[-1]), np.append(sigma, sigma[-1])
