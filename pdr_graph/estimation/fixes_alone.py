"""Where there are fixes and no steps: a GPX track, or a log without an accelerometer."""

from __future__ import annotations

import numpy as np

from pdr_graph.estimation.reach import WITHIN, chained
from pdr_graph.estimation.receivers import WHITE
from pdr_graph.geometry import interpolate
from pdr_graph.types import Array, Estimate, Fixes, FixReport, Trajectory

ANY_HEADING = np.pi / np.sqrt(3)  # [rad] standard deviation of a direction that nobody knows
FASTEST = 40.0  # [m/s] on the ground
REASON = {1.0: "the walk itself: there are no steps", 0.0: "where nobody gets so fast: passed by"}
JUMP = 20.0  # fixes on either side that it takes to believe that someone went faster, or flew


def follow(fixes: Fixes) -> Estimate:
    """The walk as straight lines from fix to fix, each as uncertain as it says; nothing between them is known.

    fixes: at least one, in order of time, in the output frame. Heading is the direction to the next fix. What lies
    where nobody gets so fast, and back, is passed by: most of a receiver's error stays from epoch to epoch (``WHITE``
    does not), so that jumps are wild.
    """
    way = FASTEST * (fixes.time - fixes.time[0])
    _, believed = chained(fixes.position, WITHIN * WHITE * fixes.sigma, way, JUMP)
    every, fixes, jumps = fixes, fixes[believed], int((~believed).sum())
    heading, sigma_heading = _courses(fixes)
    covariance = np.zeros((len(fixes), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = fixes.sigma**2
    covariance[:, 2, 2] = sigma_heading**2
    track = Trajectory(fixes.time, fixes.position, heading, fixes.floor, covariance)
    residual = np.hypot(*(every.position - interpolate(every.time, fixes.time, fixes.position)).T)
    columns = np.column_stack([every.time, every.position, every.sigma, residual, believed]).tolist()
    return Estimate(
        trajectory=track,
        dead_reckoning=track,
        calibration=None,
        fixes=tuple(FixReport(t, x, y, s, d, w, REASON[w]) for t, x, y, s, d, w in columns),
        iterations=0,
        cost=0.0,
        converged=True,
        warnings=(f"{jumps} of {len(every)} fixes lie where nobody gets so fast, and were passed by",) if jumps else (),
    )


def _courses(fixes: Fixes) -> tuple[Array, Array]:
    """Direction from each fix to the next [rad] and its standard deviation; the last keeps the one before."""
    if len(fixes) < 2:
        return np.zeros(1), np.array([ANY_HEADING])
    way = np.diff(fixes.position, axis=0)
    across = np.hypot(fixes.sigma[1:], fixes.sigma[:-1])
    sigma = np.minimum(ANY_HEADING, across / np.maximum(np.hypot(*way.T), 1e-9))
    return np.append(c := np.arctan2(way[:, 1], way[:, 0]), c[-1]), np.append(sigma, sigma[-1])
