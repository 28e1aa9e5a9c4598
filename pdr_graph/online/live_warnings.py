"""Contradictions and warnings of a walk under way, as those of `smooth`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.results import (
    ROUTE,
    calibration_warnings,
    contradiction_warnings,
    placement_warnings,
    plan_placement,
    used_fixes,
    wall_crossings,
)
from pdr_graph.floor.building import Building
from pdr_graph.types import Array, Contradiction, Estimate, Trajectory

UNSURE = "the measurements leave open which way the walk went: the most probable one is given"
Reports = Mapping[str, Sequence[Any]]


def contradictions_of(
    smoother: LiveSmoother, plan: Building | None, rows: Trajectory, reports: Reports
) -> tuple[Contradiction, ...]:
    """What sources get wrong; an open direction, or else contradictions of the walk with the plan.

    rows: the walk so far; reports: of its measurements.
    """
    found, graph = smoother.ambiguity.findings.contradictions, smoother.graph
    if graph.has_position and not smoother.sure:
        return (*found, Contradiction(ROUTE, "other routes", float("nan"), "rad", UNSURE, "another fix"))
    if plan is None:
        return found
    walled, places = _placed(plan, reports)
    if not len(places) and (graph.has_position or graph.finalized.anchored):  # by beacons, or by earlier fixes
        places, walled = rows.position[-1:], True
    return (*found, *(plan_placement(plan, walled, places) or wall_crossings(plan, rows)))


def warnings_of(smoother: LiveSmoother, plan: Building | None, estimate: Estimate) -> tuple[str, ...]:
    """The warnings of the smoothed walk; none before the first steps."""
    if not smoother.graph.window.keyframes:
        return ()
    reports, calibration = estimate.reports, estimate.calibration
    fixes, (walled, places) = reports.get("fixes", ()), _placed(plan, reports)
    used = 2 if smoother.sure else len(places)  # a certain walk had fixes, perhaps long ago
    return (
        *placement_warnings(used, bool(reports.get("headings")), bool(len(places)) and plan is not None, walled),
        *(() if calibration is None else calibration_warnings(calibration)),
        *contradiction_warnings(fixes),
        *(() if smoother.sure or not smoother.graph.has_position else (UNSURE,)),
    )


def _placed(plan: Building | None, reports: Reports) -> tuple[bool, Array]:
    """Whether walls are used, and the positions ``(n, 2)`` [m] of the fixes that are used."""
    places = np.array([(fix.x, fix.y) for fix in used_fixes(reports.get("fixes", ()))]).reshape(-1, 2)
    return plan is not None and bool(plan.near(places).any()), places
