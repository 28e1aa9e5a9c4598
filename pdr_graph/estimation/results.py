"""Calibration, warnings and missing results of an estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdr_graph.errors import percent
from pdr_graph.estimation.factors import locating_kinds
from pdr_graph.estimation.factors.fixes import DUPLICATE, FROZEN, LOUD_BEACON, OUTSIDE
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.floor.building import Building
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.priors import REPORTS
from pdr_graph.types import Array, Calibration, Estimate, FixReport, Index

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


@dataclass(frozen=True)
class Placement:
    """What determined the position: number of used fixes; True for headings, a plan, walls that were used."""

    used: int
    headings: bool
    plan: bool
    walled: bool

    def warnings(self) -> tuple[str, ...]:
        """Warn of an unknown position or direction, and of a plan that is elsewhere."""
        warned = {
            "no position fix: the track starts at (0, 0) along x": self.used == 0 and not self.walled,
            "no position fix: the place was sought on the whole plan": self.used == 0 and self.walled,
            "one position fix: the direction of the walk is unknown; it starts along x": self.used == 1
            and not self.walled
            and not self.headings,
            "no fix lies near the floor plan: its walls were not used": bool(self.used)
            and self.plan
            and not self.walled,
        }
        return tuple(text for text, holds in warned.items() if holds)


def warnings(
    graph: WalkGraph, walks: int, probability: float, converged: bool, calibration: Calibration
) -> tuple[str, ...]:
    """Warn of what a user must know before trusting the result.

    walks: number of distinct solutions; probability: of the path of the estimate.
    """
    fixes, headings = graph.positions, len(graph.headings.headings) > 0
    placement = Placement(int(fixes.used.sum()), headings, graph.floor_sequence is not None, graph.walled)
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
        *placement.warnings(),
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
    scale = stride_scale(calibration)
    return (
        *((str(scale),) if scale is not None and scale.unusual else ()),
        *((f"{', '.join(open_)}{PRIOR_KEPT}",) if open_ else ()),
    )


@dataclass(frozen=True)
class StrideScale:
    """The mean stride scale R_s of a walk, with its sigma."""

    value: float
    sigma: float

    @property
    def unusual(self) -> bool:
        """True if usual walkers have another stride scale."""
        return self.beyond > 0

    @property
    def beyond(self) -> float:
        """Difference to the nearest stride scale of usual walkers."""
        return max(REPORTS.stride[0] - self.value, self.value - REPORTS.stride[1], 0.0)

    def __str__(self) -> str:
        low, high = REPORTS.stride
        return f"the {NAMES['R_s']} is {self.value:.2f} ± {self.sigma:.2f}, that of usual walkers {low} to {high}"


def stride_scale(calibration: Calibration) -> StrideScale | None:
    """The mean stride scale of a walk; None if the walk does not determine it."""
    if not calibration.learnt[:, 0].any():
        return None
    return StrideScale(float(calibration.value[:, 0].mean()), float(calibration.sigma[:, 0].min()))


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
