"""What an estimate says beside the walk: its calibration, warnings, and whether its sources agree.

The verdict on a walk is the same offline and live. Most contradictions show in the reports of an estimate. Those with
the plan need the plan: `plan_contradictions` finds them when the walk is solved, and `Estimate.contradictions` holds
them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pdr_graph.errors import count, percent
from pdr_graph.estimation.factors.fixes import DUPLICATE, FROZEN, LOUD_BEACON, OUTSIDE
from pdr_graph.estimation.factors.registry import locating_kinds
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import distance_to_box
from pdr_graph.priors import PATHS, RANGES, REPORTS, VERDICTS
from pdr_graph.types import (
    DOUBTFUL,
    FAILED,
    Array,
    Calibration,
    Contradiction,
    Estimate,
    FixReport,
    Index,
    Trajectory,
    Verdict,
)

FIRST_ONLY = "not used: dead reckoning takes the first fix only"  # reason in reports
REPEATED = "a better fix at the same time: not used"  # reason in reports
POSITIONS_ALONE = "positions alone: the recording has no accelerometer; the track is its smoothed fixes, without steps"
PRIOR_KEPT = " not observable from this walk: prior kept"  # end of a line about coefficients
NAMES = {"R_s": "stride scale R_s", "R_d": "turn scale R_d", "b": "gyro drift b"}


def calibration_of(graph: WalkGraph, value: Array, covariance: Array) -> Calibration:
    """(R_s, R_d, b) in each segment of the walk, from ``(s, 3)`` and ``(s, 3, 3)``."""
    prior = prior_sigma(graph.prior, np.arange(len(value)))
    return Calibration(graph.keyframe_time[graph.chain.segment_first], value, covariance, prior)


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
        *placement_warnings(int(fixes.used.sum()), headings, graph.floor_sequence is not None, graph.walled),
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
    open_ = [NAMES[name] for n, name in enumerate(calibration.names) if not calibration.learnt[:, n].any()]
    unusual = _unusual_stride(calibration)
    return (
        *(() if unusual is None else (unusual[0],)),
        *((f"{', '.join(open_)}{PRIOR_KEPT}",) if open_ else ()),
    )


def _unusual_stride(calibration: Calibration) -> tuple[str, float, float] | None:
    """The mean stride scale R_s of a walk as a text, its value, and by how many of its sigmas it is unusual.

    None if the walk does not determine it, or if usual walkers have it.
    """
    (low, high), value, sigma = REPORTS.stride, calibration.value[:, 0].mean(), calibration.sigma[:, 0].min()
    beyond = max(low - value, value - high)
    if beyond <= 0 or not calibration.learnt[:, 0].any():
        return None
    text = f"the {NAMES['R_s']} is {value:.2f} ± {sigma:.2f}, that of usual walkers {low} to {high}"
    return text, float(value), float(beyond / sigma)


def contradiction_warnings(fixes: Sequence[FixReport]) -> tuple[str, ...]:
    """Warn of fixes that the steps and the other fixes contradict; see `is_a_guess`."""
    rejected, used = _rejected(fixes), len(used_fixes(fixes))
    if rejected <= REPORTS.many * used:
        return ()
    guess = ": where the walk was is a guess" if is_a_guess(fixes) else ""
    return (f"{rejected} of {used} fixes contradict the steps and the other fixes and have weight 0{guess}",)


def missing_of(estimate: Estimate, fixes: int) -> tuple[str, ...]:
    """Return what could not be estimated for a walk with so many fixes, a line each."""
    if fixes and not (estimate.placed or used_fixes(estimate.fixes)):
        missing = ("a place: no fix lies within the recording",)
    elif is_a_guess(estimate.fixes):
        missing = ("a place: the fixes contradict the steps and one another",)
    else:
        missing = ()
    return missing if estimate.converged else (*missing, "a converged optimum")


def used_fixes(fixes: Sequence[FixReport]) -> list[FixReport]:
    """Return the reports without duplicate epochs and fixes outside the recording."""
    return [fix for fix in fixes if fix.reason not in (DUPLICATE, FROZEN, OUTSIDE)]


def is_a_guess(fixes: Sequence[FixReport]) -> bool:
    """True if at least half of the used fixes were rejected."""
    return 2 * _rejected(fixes) >= max(len(used_fixes(fixes)), 1)


def _rejected(fixes: Sequence[FixReport]) -> int:
    """Number of used fixes that were rejected, without the rough fixes of beacons, which are always dropped."""
    return sum(fix.weight < REPORTS.rejected and fix.reason != LOUD_BEACON for fix in used_fixes(fixes))


def is_located(estimate: Estimate) -> bool:
    """True if anything determined the position: fixes, beacons, ranges, another kind that does, or the plan."""
    return is_measured(estimate) or bool(estimate.routes)


def is_measured(estimate: Estimate) -> bool:
    """True if any measurement determined the position, not the plan alone."""
    locating = (used_fixes(estimate.fixes), *(estimate.reports.get(kind) for kind in locating_kinds()))
    return estimate.placed or any(locating)


def stated_probability(estimate: Estimate, floor: FloorPlan | Building | None, *, fits: bool = True) -> float:
    """The probability of a route as stated: NaN without any position, near 0 if the route contradicts the plan.

    It is 0 if no fix lies near the plan, whose walls were not used then. Each row through a wall beyond the usual ones
    divides it by e: on real walks with the right route at most one row does. fits: the walls were used; those of a plan
    that does not fit the walk are no evidence.
    """
    if not is_located(estimate):
        return float("nan")
    if floor is None or not fits:
        return estimate.probability
    building = Building.around(floor)
    places = np.array([(fix.x, fix.y) for fix in used_fixes(estimate.fixes)]).reshape(-1, 2)
    if len(places) and not building.near(places).any():
        return 0.0
    track = estimate.trajectory
    crossed = int(building.crosses_wall(track.position, track.floor).sum())
    return estimate.probability * float(np.exp(-max(0.0, crossed - 1 - REPORTS.crossed_anyway * len(track))))


ROUTE = "route"  # source of a contradiction that only leaves open where the walk went
STEPS_AND_REST = "steps and the rest"  # what contradicts fixes without another source of positions
CHECK_FIXES = "the fixes, their sigmas and their clock; the list of beacons"
CHECK_LIST = "the list of beacons: another building or floor? moved or swapped ones?"
NO_EVIDENCE = (LOUD_BEACON, REPEATED, FIRST_ONLY)  # reasons of fixes that neither confirm nor contradict a walk
FIXES_COMPARED = 200  # among which the two farthest apart are searched


def verdict(estimate: Estimate) -> Verdict:
    """The verdict on an estimate: the contradictions found when it was solved, and those that its reports show."""
    found = (_place, _rejected_fixes, _distant_fixes, _beacons, _headings, _stride, _probability, _convergence)
    return Verdict.of((*estimate.contradictions, *(reason for rule in found for reason in rule(estimate))))


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


def _place(estimate: Estimate) -> Iterator[Contradiction]:
    """Fixes, none of which can be used, and nothing else that measures positions."""
    placed = estimate.placed or used_fixes(estimate.fixes) or any(_transmitters(estimate))
    if estimate.fixes and not placed:
        text = "no fix lies within the recording: where the walk was is unknown"
        yield Contradiction("fixes", "recording", float("nan"), "s", text, "the clock of the fixes", FAILED)


def _evidence(estimate: Estimate) -> list[FixReport]:
    """The fixes that confirm or contradict the walk."""
    return [fix for fix in used_fixes(estimate.fixes) if fix.reason not in NO_EVIDENCE]


def _rejected_fixes(estimate: Estimate) -> Iterator[Contradiction]:
    used = _evidence(estimate)
    rejected = sum(fix.weight < REPORTS.rejected for fix in used)
    share, other = rejected / max(len(used), 1), _other_source(estimate)
    if share > VERDICTS.doubtful:
        text = f"{rejected} of {count(len(used), 'fix')} contradict the {other}, with weight 0"
        state = FAILED if share >= VERDICTS.most and other == STEPS_AND_REST else DOUBTFUL
        text += ": where the walk was is a guess" * (state == FAILED)
        yield Contradiction("fixes", other, share, "share", text, CHECK_FIXES, state)


def _other_source(estimate: Estimate) -> str:
    """What determines the walk beside its fixes: the beacons, the ranges, another kind that does, else the steps."""
    locating = locating_kinds()
    return next((kind for kind in estimate.reports if kind in locating and estimate.reports[kind]), STEPS_AND_REST)


def _distant_fixes(estimate: Estimate) -> Iterator[Contradiction]:
    """Fixes whose median distance from the walk is larger than their sigmas allow."""
    used = _evidence(estimate)
    sigmas = np.array([fix.residual / fix.sigma for fix in used])
    independent = len({int(fix.time // VERDICTS.alike) for fix in used})
    if median := _too_large(sigmas, independent, VERDICTS.fix_median, 1 / VERDICTS.fix_median):
        other = _other_source(estimate)
        lie = "the fix lies" if len(used) == 1 else "half of the fixes lie more than"
        text, check = (
            f"{lie} {median:.1f} sigma from the walk, against the {other}",
            "the sigmas and clock of the fixes",
        )
        yield Contradiction("fixes", other, median, "sigma", text, f"{check}, and the {other}")


def _too_large(sigmas: Array, independent: int, median: float, spread: float) -> float:
    """The median of residuals ``(n,)`` [σ], if it is larger than honest ones have; else 0.

    independent: number of them with errors of their own; median: of honest residuals; spread: its sigma × √n.
    """
    found = float(np.median(sigmas)) if len(sigmas) else 0.0
    return found if independent and found > median + VERDICTS.distant * spread / np.sqrt(independent) else 0.0


def _beacons(estimate: Estimate) -> Iterator[Contradiction]:
    """A list of beacons of which half are elsewhere."""
    moved = [beacon.label for beacon in estimate.beacons if beacon.misplaced]
    if estimate.beacons and len(moved) >= VERDICTS.most * len(estimate.beacons):
        share = len(moved) / len(estimate.beacons)
        text = f"{len(moved)} of {count(len(estimate.beacons), 'beacon')} are not heard where they are listed"
        yield Contradiction("beacons", "fixes and steps", share, "share", text, CHECK_LIST)


def _headings(estimate: Estimate) -> Iterator[Contradiction]:
    """Headings whose median residual is larger than their sigmas allow."""
    sigmas = np.array([abs(report.residual) / report.sigma for report in estimate.reports.get("headings", ())])
    if median := _too_large(sigmas, len(sigmas), VERDICTS.heading_median, VERDICTS.heading_spread):
        text = f"half of the headings differ by more than {median:.1f} sigma from the walk"
        yield Contradiction("headings", "steps and fixes", median, "sigma", text, "magnets and iron near the phone")


def _stride(estimate: Estimate) -> Iterator[Contradiction]:
    """A stride scale of no usual walker, by more than its sigma, that not even three fixes confirm."""
    calibration = estimate.calibration
    unusual = None if calibration is None else _unusual_stride(calibration)
    if calibration is None or unusual is None:
        return
    stated, value, beyond = unusual
    if beyond > 1 and not stride_determined(estimate, PATHS.fewest_fixes):
        sigmas = (value - 1) / float(calibration.prior_sigma[0, 0])
        text, check = f"{stated}, and too few fixes confirm it", "the fixes, the start, and the floor plan"
        yield Contradiction("stride", "fixes and plan", sigmas, "sigma", text, check)


def _probability(estimate: Estimate) -> Iterator[Contradiction]:
    """A route that is one of several; on a plan beside all fixes (`plan_placement`) its probability is 0."""
    limit = REPORTS.sure if estimate.routes and not is_measured(estimate) else VERDICTS.seldom_right
    if 0 < estimate.probability < limit:
        text = f"this route has a probability of {percent(estimate.probability)}: another may be right"
        check = "the report's map; another fix would decide"
        yield Contradiction(ROUTE, "other routes", estimate.probability, "probability", text, check)


def _convergence(estimate: Estimate) -> Iterator[Contradiction]:
    if not estimate.converged:
        text = "the optimiser stopped before the cost converged"
        check = "the fixes and the recording: contradictions make the search slow"
        yield Contradiction("optimiser", "all sources", float(estimate.iterations), "iterations", text, check)


def stride_determined(estimate: Estimate, fewest: int = 2) -> bool:
    """True if measured positions determine the stride scale R_s at the end of the walk, not the plan alone.

    These are ``fewest`` accepted fixes or more, two of them so far apart that their sigmas alone halve the variance of
    an unknown walker's R_s; or as many beacons or anchors.
    """
    calibration, half = estimate.calibration, np.sqrt(0.5) * Prior().sigma[0]
    if calibration is None or calibration.sigma[-1, 0] > half:
        return False
    accepted = [fix for fix in _evidence(estimate) if fix.weight > REPORTS.accepted]
    if len(accepted) >= fewest and _stride_sigma(accepted) <= half:
        return True
    return len(set(_transmitters(estimate))) >= max(fewest, RANGES.fewest)


def teaches_profile(estimate: Estimate) -> bool:
    """True if the walker's profile may be learnt from this estimate: it is "ok", and determines the stride scale."""
    return stride_determined(estimate) and verdict(estimate).ok


def _stride_sigma(fixes: Sequence[FixReport]) -> float:
    """Sigma of the stride scale by the two of these fixes that determine it best, from their distance alone."""
    some = [fixes[n] for n in np.unique(np.linspace(0, len(fixes) - 1, FIXES_COMPARED).astype(int)).tolist()]
    x, y, sigma = np.array([(fix.x, fix.y, fix.sigma) for fix in some]).T
    apart = np.hypot(x - x[:, None], y - y[:, None])
    return float(np.min(np.hypot(sigma, sigma[:, None]) / np.maximum(apart, 1e-9)))


def _transmitters(estimate: Estimate) -> Iterator[str]:
    """Names of the beacons and anchors that measured positions; of measurements without one, that of their kind."""
    for kind in locating_kinds():
        for report in estimate.reports.get(kind, ()):
            if not getattr(report, "misplaced", False):
                yield str(getattr(report, "anchor", "") or getattr(report, "label", "") or kind)
