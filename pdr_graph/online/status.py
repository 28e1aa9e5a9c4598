"""The state of a live walk in words: how sure, what is missing, what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pdr_graph.errors import count
from pdr_graph.estimation.factors.registry import ways_among
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.results import (
    calibration_warnings,
    contradiction_warnings,
    placement_warnings,
    plan_placement,
    used_places,
    wall_crossings,
)
from pdr_graph.estimation.verdict import ROUTE
from pdr_graph.floor.building import Building
from pdr_graph.geometry import distance_to_box
from pdr_graph.inertial.sensor_stream import Health
from pdr_graph.online.event_checks import AHEAD
from pdr_graph.online.interface import NO_DATA, NO_STEPS
from pdr_graph.types import Array, Contradiction, Estimate, OneLineRepr, Trajectory, Verdict

SENSOR_SILENCE = 2.0  # [s] without samples of a sensor while others have some, until it is an issue
SENSORS_SILENT = 5.0  # [s] by which a fix is later than the last sample, until fixes alone are followed


@dataclass(frozen=True)
class Status(OneLineRepr):
    """State of the navigator.

    state: "waiting" for sensors and fixes, "fixes alone" without steps, where the sensors are silent or where fixes go
    away from the steps, "no absolute position" until the first fix, "initialising heading" until the direction of the
    walk is known, "running".
    sigma: of the current position per axis [m], NaN without an absolute position; missing: what would make the pose
    better, a line each; issues: present problems, a line each; unknown: what the sensors do not measure, a line each;
    sensors: health of each; keyframes: number in the window; fixes: number accepted; late, early: numbers of
    measurements too old for the window or far in the future; restarts: how often fixes contradicted the estimate;
    updates: number of updates of iSAM2; rebuilds: why it was begun anew: an update raised the cost, or threw; judge:
    returns the verdict.
    """

    state: str
    sigma: float
    missing: tuple[str, ...]
    issues: tuple[str, ...]
    unknown: tuple[str, ...]
    sensors: dict[str, Health]
    keyframes: int
    fixes: int
    late: int
    early: int
    restarts: int
    updates: int
    rebuilds: tuple[str, ...]
    judge: Callable[[], Verdict] = field(repr=False, compare=False)

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the walk so far can be trusted, and the reasons if not; computed when it is first read."""
        return self.judge()

    def _summary(self) -> list[str]:
        lines = [count(len(self.issues), "issue")] if self.issues else []
        sigma = [] if np.isnan(self.sigma) else [f"sigma {self.sigma:.2f} m"]
        return [repr(self.state), *sigma, count(self.fixes, "fix"), *lines]


def state_of(walking: bool, located: bool, directed: bool) -> str:
    """The state in words. walking: steps are observed; located: a position is known; directed: the direction is."""
    if not walking:
        return "fixes alone" if located else "waiting"
    if not located:
        return "no absolute position"
    return "running" if directed else "initialising heading"


def missing_inputs(walking: bool, located: bool, directed: bool) -> Iterator[str]:
    """Yield what would make the pose better, a line each; arguments as of `state_of`."""
    if not walking:
        yield "samples of the accelerometer"
    if not located:
        yield "a fix, a beacon or a range: the position is relative to the start"
    elif walking and not directed:
        yield "a second fix, or a few steps for the compass: the direction is not known yet"


def issues_of_times(early: int, late: int) -> Iterator[str]:
    """Yield what is wrong with the times of measurements, a line each. early, late: numbers not used."""
    if early:
        yield f"measurements: {early} have times more than {AHEAD:.0f} s ahead of the sensors: another clock?"
    if late:
        yield f"measurements: {late} came too late, when their time was finalised"


def issues_of(health: Mapping[str, Health], stepless: bool, away: float, silent: float) -> Iterator[str]:
    """Yield the present problems of the sensors, a line each.

    health: of each sensor; stepless: there are fixes and no steps; away: distance of fixes that are followed instead of
    the walk [m]; silent: time for which fixes go on without acceleration [s], else 0.
    """
    if away:
        yield AWAY.format(away) + "; they are followed"
    if stepless:
        yield f"accelerometer: {NO_STEPS}"
    latest = max((sensor.last for sensor in health.values() if np.isfinite(sensor.last)), default=np.nan)
    everything = silent > 0 and not latest - health["accelerometer"].last > SENSOR_SILENCE
    if everything:
        yield SILENT.format(silent, latest)
    for name, sensor in health.items():
        if sensor.samples and latest - sensor.last > SENSOR_SILENCE:
            alone = FIXES_FOLLOWED if silent and name == "accelerometer" else ""
            yield f"{name}: silent for {latest - sensor.last:.0f} s{alone}"
        elif not sensor.samples and np.isfinite(latest):
            yield f"{name}: {NO_DATA}"
        yield from (f"{name}: {count(number, 'sample')} {why}" for why, number in sensor.left_out.items())
        if sensor.clock_resets:
            yield f"{name}: clock reset {sensor.clock_resets} times"


RIDES_NOW = "a ride since {:.0f} s: positions alone are used"
FIXES_FOLLOWED = ": the fixes alone are followed"
SILENT = "all sensors: silent for {:.0f} s, since {:.0f} s" + FIXES_FOLLOWED
AWAY = "the fixes went {:.0f} m from the walk: a slow ride, or steps that are not recognised"


def contradiction_of_fixes(away: float) -> tuple[Contradiction, ...]:
    """The contradiction of fixes that went so far from the walk [m], 0 without."""
    return (Contradiction("steps", "fixes", away, "m", AWAY.format(away), "the units of the sensors"),) if away else ()


UNSURE = "the measurements leave open which way the walk went: the most probable one is given"
Reports = Mapping[str, Sequence[Any]]


def contradictions_of(
    smoother: LiveSmoother, plan: Building | None, rows: Trajectory, reports: Reports
) -> tuple[Contradiction, ...]:
    """What sources get wrong; an open direction, or else contradictions of the walk with the plan.

    rows: the walk so far; reports: of its measurements.
    """
    found, graph = smoother.ambiguity.findings.contradictions, smoother.graph
    if (ways := ways_among(graph.at.measurements)) is not None:
        found = (*found, *ways.contradictions(graph.at, graph.isam))
        outdoors = np.zeros(len(rows)) if plan is None else distance_to_box(rows.position, *plan.corners)
        rows = rows[outdoors == 0]  # ways beside the plan are no evidence against it
    if restarts := smoother.ambiguity.restarts:
        text = f"the walk jumps to fixes that contradicted it, at {restarts[-1]:.0f} s"
        check = "where the walk was before and after: one of both is wrong"
        found = (*found, Contradiction("fixes", "steps", float(len(restarts)), "times", text, check))
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
        *smoother.ambiguity.findings.warnings,
        *(() if smoother.sure or not smoother.graph.has_position else (UNSURE,)),
    )


def _placed(plan: Building | None, reports: Reports) -> tuple[bool, Array]:
    """Whether walls are used, and the positions ``(n, 2)`` [m] of the fixes that are used."""
    places = used_places(reports.get("fixes", ()))
    return plan is not None and bool(plan.near(places).any()), places
