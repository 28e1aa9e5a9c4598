"""What an estimate says beside the walk: its calibration, warnings, probability, and contradictions with the plan.

Contradictions that the reports of an estimate show are found later, see `estimation.verdict`; those with the plan need
the plan: `plan_contradictions` finds them when the walk is solved, and `Estimate.contradictions` holds them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdr_graph.errors import count, percent
from pdr_graph.estimation.factors.registry import locating_kinds
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import distance_to_box
from pdr_graph.priors import BOUT, MOVEMENT, REPORTS, VERDICTS
from pdr_graph.types import (
    DOUBTFUL,
    DUPLICATE,
    FAILED,
    FROZEN,
    LOUD_BEACON,
    OUTSIDE,
    Array,
    Calibration,
    Contradiction,
    Estimate,
    FixReport,
    Index,
    Steps,
    Trajectory,
    UntimedFixReport,
)

REPEATED = "a better fix at the same time: not used"  # reason in reports
POSITIONS_ALONE = "positions alone: the recording has no accelerometer; the track is its smoothed fixes, without steps"
MOVED = "it moved for {:.0f} s, and no steps were recognised"
MOST_NAMED_FIXES = 3  # rejected fixes that a warning names
PRIOR_KEPT = " not observable from this walk: prior kept"  # end of a line about coefficients
COEFFICIENT_NAMES = {"R_s": "stride scale R_s", "R_d": "turn scale R_d", "b": "gyro drift b"}


def calibration_of(graph: WalkGraph, value: Array, covariance: Array) -> Calibration:
    """(R_s, R_d, b) in each segment of the walk, from ``(s, 3)`` and ``(s, 3, 3)``."""
    prior = prior_sigma(graph.prior, np.arange(len(value)))
    return Calibration(graph.keyframe_time[graph.chain.segment_first], value, covariance, prior, graph.prior.usual)


def prior_sigma(prior: Prior, segment: Index) -> Array:
    """Standard deviations ``(s, 3)`` of (R_s, R_d, b) in segments ``(s,)`` before any measurement."""
    return np.sqrt(np.square(prior.sigma) + segment[:, None] * np.square(prior.change))


def placement_warnings(used: int, headings: bool, plan: bool, walled: bool) -> tuple[str, ...]:
    """Warn of an unknown position or direction, and of a plan that is elsewhere.

    used: number of fixes; headings, plan: True if there are any; walled: walls of the plan were used.
    """
    if walled:
        return ("no position fix: the place was sought on the whole plan",) if used == 0 else ()
    warned = {
        "no position fix: the track starts at (0, 0) along x": used == 0,
        "one position fix: the direction of the walk is unknown; it starts along x": used == 1 and not headings,
        "no fix lies near the floor plan: its walls were not used": used > 0 and plan,
    }
    return tuple(text for text, holds in warned.items() if holds)


def warnings(
    graph: WalkGraph, walks: int, probability: float, converged: bool, calibration: Calibration
) -> tuple[str, ...]:
    """Warn of what a user must know before trusting the result.

    walks: number of distinct solutions; probability: of the path of the estimate.
    """
    fixes, headings = graph.positions, len(graph.headings.headings) > 0
    warned = {
        f"{walks} different walks explain the measurements, this route with a probability of {percent(probability)}; "
        "the covariance spans them": walks > 1,
        f"the walk fits the plan poorly, this route with a probability of {percent(probability)}: "
        "another is possible": (walks == 1 and probability < REPORTS.sure),
        "the optimiser had not converged": not converged,
    }
    outside, frozen = fixes.fixes.time[~fixes.used & ~fixes.duplicate & ~fixes.still], int(fixes.still.sum())
    held = f"{frozen} fixes of a receiver that held its position while the walk went on were not used"
    return (
        *placement_warnings(
            int(fixes.used.sum()) + len(graph.sought), headings, graph.floor_sequence is not None, graph.walled
        ),
        *outside_warnings(outside, graph.steps.start, graph.steps.end),
        *((held,) if frozen else ()),
        *(text for text, holds in warned.items() if holds),
        *calibration_warnings(calibration),
    )


def outside_warnings(time: Array, start: float, end: float) -> tuple[str, ...]:
    """Warn of fixes that were not used since their times ``(n,)`` lie outside the recording. [s]"""
    if not len(time):
        return ()
    least = float(np.min(np.maximum(start - time, time - end)))
    return (f"{len(time)} fixes lie outside the recording, by {least:.0f} s or more, and were not used",)


def is_usual(warning: str) -> bool:
    """True if a warning is no reason to doubt a walk: it holds for most, or for all of such recordings."""
    return warning.endswith(PRIOR_KEPT) or warning == POSITIONS_ALONE


def calibration_warnings(calibration: Calibration) -> tuple[str, ...]:
    """Warn of coefficients that the walk does not determine, and of a stride scale of no usual walker."""
    open_ = [COEFFICIENT_NAMES[name] for n, name in enumerate(calibration.names) if not calibration.learnt[:, n].any()]
    unusual = unusual_stride(calibration)
    return (
        *(() if unusual is None else (unusual[0],)),
        *((f"{', '.join(open_)}{PRIOR_KEPT}",) if open_ else ()),
    )


def unusual_stride(calibration: Calibration) -> tuple[str, float, float] | None:
    """The mean stride scale R_s of a walk as a text, its value, and by how many of its sigmas it is unusual.

    None if the walk does not determine it, or if usual walkers have it.
    """
    (low, high), value, sigma = REPORTS.stride, calibration.value[:, 0].mean(), calibration.sigma[:, 0].min()
    if abs(np.log(calibration.stride)) < abs(np.log(max(value, 1e-9))):  # unusual by the profile alone
        value, sigma = calibration.stride, sigma / calibration.usual
    beyond = max(low - value, value - high)
    if beyond <= 0 or not calibration.learnt[:, 0].any():
        return None
    text = f"the {COEFFICIENT_NAMES['R_s']} is {value:.2f} ± {sigma:.2f}, that of usual walkers {low} to {high}"
    return text, float(value), float(beyond / sigma)


def contradiction_warnings(fixes: Sequence[FixReport]) -> tuple[str, ...]:
    """Warn of fixes that the steps and the other fixes contradict; see `is_a_guess`. Few of them are listed."""
    rejected, used = _rejected(fixes), len(used_fixes(fixes))
    if len(rejected) > REPORTS.many * used and (len(rejected) > 1 or is_a_guess(fixes)):
        guess = ": where the walk was is a guess" if is_a_guess(fixes) else ""
        return (f"{len(rejected)} of {used} fixes contradict the steps and the other fixes and have weight 0{guess}",)
    farthest = sorted(rejected, key=lambda fix: -fix.residual)[:MOST_NAMED_FIXES]
    places = "; ".join(f"at {fix.time:.0f} s, {fix.residual:.0f} m from the walk" for fix in farthest)
    more = f"; and {len(rejected) - MOST_NAMED_FIXES} more" * (len(rejected) > MOST_NAMED_FIXES)
    return (f"{count(len(rejected), 'fix')} rejected, weight 0: {places}{more}",) if rejected else ()


def place_warnings(places: Sequence[UntimedFixReport]) -> tuple[str, ...]:
    """Name the places without a time that are not on the walk."""
    away = [place for place in places if place.weight < REPORTS.rejected]
    text = "; ".join(f"{place.label}, {place.distance:.0f} m from the walk" for place in away[:MOST_NAMED_FIXES])
    more = f"; and {len(away) - MOST_NAMED_FIXES} more" * (len(away) > MOST_NAMED_FIXES)
    return (f"{count(len(away), 'place')} without a time not visited, weight 0: {text}{more}",) if away else ()


def used_fixes(fixes: Sequence[FixReport]) -> list[FixReport]:
    """Return the reports without duplicate epochs and fixes outside the recording."""
    return [fix for fix in fixes if fix.reason not in (DUPLICATE, FROZEN, OUTSIDE)]


def used_places(fixes: Sequence[FixReport]) -> Array:
    """Positions ``(n, 2)`` [m] of the used fixes."""
    return np.array([(fix.x, fix.y) for fix in used_fixes(fixes)]).reshape(-1, 2)


def is_a_guess(fixes: Sequence[FixReport]) -> bool:
    """True if at least half of the used fixes were rejected."""
    return 2 * len(_rejected(fixes)) >= max(len(used_fixes(fixes)), 1)


def _rejected(fixes: Sequence[FixReport]) -> list[FixReport]:
    """The used fixes that were rejected, without the rough fixes of beacons, which are always dropped."""
    return [fix for fix in used_fixes(fixes) if fix.weight < REPORTS.rejected and fix.reason != LOUD_BEACON]


def is_located(estimate: Estimate) -> bool:
    """True if anything determined the position: fixes, beacons, ranges, another kind that does, or the plan."""
    return is_measured(estimate) or bool(estimate.routes)


def is_measured(estimate: Estimate) -> bool:
    """True if any measurement determined the position, not the plan alone."""
    locating = (used_fixes(estimate.fixes), *(estimate.reports.get(kind) for kind in locating_kinds()))
    return estimate.placed or any(locating)


def stated_probability(estimate: Estimate, floor: FloorPlan | Building | None, *, fits: bool = True) -> float:
    """The probability of a route as stated: NaN without any position, near 0 if the route contradicts the plan.

    It is 0 if no fix lies near the plan, whose walls were not used then. Each row through a wall beyond the usual rows
    divides it by e: on real walks with the right route at most one row does. fits: the walls were used; those of a plan
    that does not fit the walk are no evidence.
    """
    if not is_located(estimate):
        return float("nan")
    if floor is None or not fits:
        return estimate.probability
    building, places = Building.around(floor), used_places(estimate.fixes)
    if len(places) and not building.near(places).any():
        return 0.0
    track = estimate.trajectory
    crossed = int(building.crosses_wall(track.position, track.floor).sum())
    return estimate.probability * float(np.exp(-max(0.0, crossed - 1 - REPORTS.crossed_anyway * len(track))))


def movement_contradictions(stepless: float, missing: float, walked: float, number: int) -> tuple[Contradiction, ...]:
    """Contradiction of steps with an accelerometer that moved for longer without steps than on steps, or like steps
    where none was recognised.

    stepless: time of movement without a step [s]; missing: that of movement like steps [s]; walked: time on steps [s];
    number: of steps.
    """
    check = "how the phone was carried; a ride? shuffling steps?"
    if stepless > walked:
        return (Contradiction("steps", "accelerometer", stepless, "s", MOVED.format(stepless), check),)
    lost = missing * number / walked if number else 0.0
    if lost < max(BOUT.fewest, MOVEMENT.missing * number):
        return ()
    text = f"about {lost:.0f} steps may be missing: it moved like steps for {missing:.0f} s without one"
    return (Contradiction("steps", "accelerometer", lost, "", text, check),)


def missing_steps(steps: Steps) -> tuple[Contradiction, ...]:
    """`movement_contradictions` of the steps of a walk."""
    number = int((~steps.is_gap).sum())
    return movement_contradictions(steps.stepless, steps.missing, time_on_steps(steps), number)


def time_on_steps(steps: Steps) -> float:
    """Time on steps, without gaps. [s]"""
    return float(steps.duration[~steps.is_gap].sum())


def plan_contradictions(graph: WalkGraph, trajectory: Trajectory | None = None) -> tuple[Contradiction, ...]:
    """Contradictions of a walk with its plan; none without a plan.

    trajectory: as estimated with the walls of the plan, None for a method that does not use them.
    """
    if graph.floor is None:
        return ()
    building, positions = Building.around(graph.floor), graph.positions
    walled = graph.walled and not (graph.unplaced and trajectory is None)
    placed = plan_placement(building, walled, positions.fixes.position[positions.used])
    return placed or (() if trajectory is None else wall_crossings(building, trajectory))


def plan_placement(building: Building, walled: bool, places: Array) -> tuple[Contradiction, ...]:
    """A plan without a position on it.

    walled: its walls were used; places: ``(n, 2)`` [m] of the fixes that were used.
    """
    if walled:
        return ()
    if not len(places):
        text = "no position says where on the floor plan the walk was: it starts at (0, 0), and no wall was used"
        check = "give one position on the plan (--fixes), or leave the plan out"
        return (Contradiction("plan", "start", float("nan"), "m", text, check, FAILED),)
    away = float(distance_to_box(places, *building.corners).min())
    text = f"all fixes lie outside the floor plan, the nearest by {away:.0f} m: its walls were not used"
    return (Contradiction("plan", "fixes", away, "m", text, "the floor plan and its position, and the fixes"),)


def wall_crossings(building: Building, trajectory: Trajectory) -> tuple[Contradiction, ...]:
    """A walk through walls, although these were used."""
    crossed = building.crosses_wall(trajectory.position, trajectory.floor)
    share, number = float(np.mean(crossed)) if len(crossed) else 0.0, int(crossed.sum())
    if share <= VERDICTS.crossed or number < VERDICTS.fewest_crossings:
        return ()
    text = f"the walk leads through walls at {number} of {len(crossed)} rows ({share:.0%})"
    check = "the floor plan (another floor? an older one?), the fixes, and the floor where the walk starts"
    state = FAILED if share > VERDICTS.most else DOUBTFUL
    return (Contradiction("plan", "steps and fixes", share, "share", text, check, state),)
