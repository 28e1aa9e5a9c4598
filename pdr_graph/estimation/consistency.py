"""Consistency of an estimate: whether its sources agree. The verdict on a walk, offline and live.

Most contradictions show in the reports of an estimate. Those with the plan need the plan: `plan_contradictions` finds
them when the walk is solved, and `Estimate.contradictions` holds them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pdr_graph.errors import count, percent
from pdr_graph.estimation.factors import locating_kinds
from pdr_graph.estimation.factors.fixes import LOUD_BEACON
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.results import FIRST_ONLY, REPEATED, is_measured, stride_scale, used_fixes
from pdr_graph.floor.building import Building
from pdr_graph.geometry import distance_to_box
from pdr_graph.priors import REPORTS, VERDICTS
from pdr_graph.types import DOUBTFUL, FAILED, Array, Contradiction, Estimate, FixReport, Trajectory, Verdict

ROUTE = "route"  # source of a contradiction that only leaves open where the walk went
STEPS = "steps and the rest"  # what contradicts fixes without another source of positions
CHECK_FIXES = "the fixes, their sigmas and their clock; the list of beacons"
CHECK_LIST = "the list of beacons: another building or floor? moved or swapped ones?"
NO_EVIDENCE = (LOUD_BEACON, REPEATED, FIRST_ONLY)  # reasons of fixes that neither confirm nor contradict a walk
MOST_FIXES = 200  # among which the two farthest apart are searched


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
    state = FAILED if share > VERDICTS.lost else DOUBTFUL
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
        state = FAILED if share >= VERDICTS.failed and other == STEPS else DOUBTFUL
        text += ": where the walk was is a guess" * (state == FAILED)
        yield Contradiction("fixes", other, share, "share", text, CHECK_FIXES, state)


def _other_source(estimate: Estimate) -> str:
    """What determines the walk beside its fixes: the beacons, the ranges, another kind that does, else the steps."""
    locating = locating_kinds()
    return next((kind for kind in estimate.reports if kind in locating and estimate.reports[kind]), STEPS)


def _distant_fixes(estimate: Estimate) -> Iterator[Contradiction]:
    """Fixes whose median distance from the walk is larger than their sigmas allow."""
    used = _evidence(estimate)
    if not used:
        return
    sigmas = np.array([fix.residual / fix.sigma for fix in used])
    independent = len({int(fix.time // VERDICTS.alike) for fix in used})
    median = float(np.median(sigmas))
    if median > VERDICTS.fix_median + VERDICTS.distant * VERDICTS.fix_spread / np.sqrt(independent):
        other = _other_source(estimate)
        lie = "the fix lies" if len(used) == 1 else "half of the fixes lie more than"
        text = f"{lie} {median:.1f} sigma from the walk, against the {other}"
        yield Contradiction(
            "fixes", other, median, "sigma", text, f"the sigmas and clock of the fixes, and the {other}"
        )


def _beacons(estimate: Estimate) -> Iterator[Contradiction]:
    """A list of beacons of which half are elsewhere."""
    moved = [beacon.label for beacon in estimate.beacons if beacon.misplaced]
    if estimate.beacons and len(moved) >= VERDICTS.moved * len(estimate.beacons):
        share = len(moved) / len(estimate.beacons)
        text = f"{len(moved)} of {count(len(estimate.beacons), 'beacon')} are not heard where they are listed"
        yield Contradiction("beacons", "fixes and steps", share, "share", text, CHECK_LIST)


def _headings(estimate: Estimate) -> Iterator[Contradiction]:
    """Headings whose median residual is larger than their sigmas allow."""
    sigmas = np.array([abs(report.residual) / report.sigma for report in estimate.reports.get("headings", ())])
    if len(sigmas) and np.median(
        sigmas
    ) > VERDICTS.heading_median + VERDICTS.distant * VERDICTS.heading_spread / np.sqrt(len(sigmas)):
        median = float(np.median(sigmas))
        text = f"half of the headings differ by more than {median:.1f} sigma from the walk"
        yield Contradiction("headings", "steps and fixes", median, "sigma", text, "magnets and iron near the phone")


def _stride(estimate: Estimate) -> Iterator[Contradiction]:
    """A stride scale of no usual walker, by more than its sigma, that not even three fixes confirm."""
    calibration = estimate.calibration
    scale = None if calibration is None else stride_scale(calibration)
    if (
        calibration is not None
        and scale is not None
        and scale.beyond > scale.sigma
        and not stride_determined(estimate, VERDICTS.checked)
    ):
        sigmas = (scale.value - 1) / float(calibration.prior_sigma[0, 0])
        text = f"{scale}, and too few fixes confirm it"
        check = "the fixes, the start, and the floor plan"
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
    accepted = [fix for fix in _evidence(estimate) if fix.weight > VERDICTS.accepted]
    if len(accepted) >= fewest and _stride_sigma(accepted) <= half:
        return True
    return len(set(_transmitters(estimate))) >= max(fewest, VERDICTS.transmitters)


def teaches_profile(estimate: Estimate) -> bool:
    """True if the walker's profile may be learnt from this estimate: it is "ok", and determines the stride scale."""
    return stride_determined(estimate) and verdict(estimate).ok


def _stride_sigma(fixes: Sequence[FixReport]) -> float:
    """Sigma of the stride scale by the two of these fixes that determine it best, from their distance alone."""
    some = [fixes[n] for n in np.unique(np.linspace(0, len(fixes) - 1, MOST_FIXES).astype(int)).tolist()]
    x, y, sigma = np.array([(fix.x, fix.y, fix.sigma) for fix in some]).T
    apart = np.hypot(x - x[:, None], y - y[:, None])
    return float(np.min(np.hypot(sigma, sigma[:, None]) / np.maximum(apart, 1e-9)))


def _transmitters(estimate: Estimate) -> Iterator[str]:
    """Names of the beacons and anchors that measured positions; of measurements without one, that of their kind."""
    for kind in locating_kinds():
        for report in estimate.reports.get(kind, ()):
            if not getattr(report, "misplaced", False):
                yield str(getattr(report, "anchor", "") or getattr(report, "label", "") or kind)
