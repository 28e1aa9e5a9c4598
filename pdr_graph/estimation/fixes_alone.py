"""The estimate of a walk of which there are fixes and no steps: a GPX track, or a log without an accelerometer."""

from __future__ import annotations

import numpy as np

from pdr_graph.estimation.moves import STANDS
from pdr_graph.estimation.positions import LOST, Way, way_through
from pdr_graph.estimation.reports import DOUBTED
from pdr_graph.geometry import interpolate
from pdr_graph.types import Estimate, Fixes, FixReport

TRUSTED = 0.9  # weight from which on a fix is said to count fully
TOO_FAST, REPEATED = "where nobody gets so fast: passed by", "beside a better one of the same moment: not used"


def follow(fixes: Fixes) -> Estimate:
    """The smoothed way with a report of each fix; what lies where nobody gets so fast, and back, is passed by.

    fixes: at least one, in order of time, in the output frame.
    """
    way = way_through(fixes)
    track, weight = way.trajectory, np.zeros(len(fixes))
    weight[way.used] = way.weight
    residual = np.hypot(*(fixes.position - interpolate(fixes.time, track.time, track.position)).T)
    reason = np.where(np.isin(fixes.time, fixes.time[way.used]), REPEATED, TOO_FAST).astype(object)
    reason[way.used] = [_reason(*own) for own in zip((residual / fixes.sigma)[way.used], way.weight, strict=True)]
    columns = (fixes.time, *fixes.position.T, fixes.sigma, residual, weight)
    return Estimate(
        trajectory=track,
        dead_reckoning=track,
        calibration=None,
        fixes=tuple(map(FixReport, *(column.tolist() for column in columns), reason)),
        iterations=0,
        cost=0.0,
        converged=True,
        warnings=_warnings(way, len(fixes), int((reason == TOO_FAST).sum())),
    )


def _reason(sigmas: float, weight: float) -> str:
    trust = "full weight" if weight > TRUSTED else "weighted down" if weight >= DOUBTED else "taken for wild"
    return f"{sigmas:.1f} sigma from the smoothed way: {trust}"


def _warnings(way: Way, fixes: int, passed: int) -> tuple[str, ...]:
    """What a user must know; passed: how many of the fixes were passed by."""
    lasts, doubted = np.diff(way.trajectory.time), int((way.weight < DOUBTED).sum())
    still, seen = (float(lasts[which].sum()) for which in (way.kind == STANDS, way.kind != LOST))
    said = {
        f"{passed} of {fixes} fixes lie where nobody gets so fast, and were passed by": passed,
        f"{doubted} of {fixes} fixes contradict those around them and counted for nothing": doubted,
        f"the positions lead nowhere for {still / 60:.0f} of {seen / 60:.0f} min: taken for standing": still > seen / 2,
    }
    return tuple(text for text, holds in said.items() if holds)
