"""The verdict on an estimate: the contradictions that its reports show, beside those found when it was solved.

It is the same offline and live.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pdr_graph.errors import count, percent
from pdr_graph.estimation.factors.fixes import RAYLEIGH_MEDIAN, alike
from pdr_graph.estimation.factors.registry import locating_kinds
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.results import REPEATED, is_a_guess, is_measured, used_fixes
from pdr_graph.geometry import horizontal_sigma, interpolate, peaks
from pdr_graph.priors import FIXES, PATHS, RECEIVERS, REPORTS, VERDICTS
from pdr_graph.types import (
    DOUBTFUL,
    FAILED,
    LOUD_BEACON,
    Array,
    Contradiction,
    Estimate,
    FixReport,
    Verdict,
)

NORMAL_MEDIAN = 0.67  # [σ] of the size of honest residuals; times √n, this median has a sigma of 0.79
BESIDE_JUMP = 5  # fixes before and after a jump, whose medians are compared
FIRST_ONLY = "not used: dead reckoning takes the first fix only"  # reason in reports
ROUTE, PLACE = "route", "place"  # sources of contradictions that only leave open where the walk went
STEPS_AND_REST = "steps and the rest"  # what contradicts fixes without another source of positions
NO_EVIDENCE = (LOUD_BEACON, REPEATED, FIRST_ONLY)  # reasons of fixes that neither confirm nor contradict a walk
RADIUS_90 = 2.146  # [σ] of a circle that holds 90 % of a Gaussian with this sigma per axis
FIXES_COMPARED = 200  # among which the two farthest apart are searched


def verdict(estimate: Estimate) -> Verdict:
    """The verdict on an estimate: the contradictions found when it was solved, and those that its reports show."""
    found = (_place, _rejected_fixes, _distant_fixes, _jumps, _beacons, _headings, _network, _untimed)
    found = (*found, _stride, _probability, _width, _convergence)
    return Verdict.of((*estimate.contradictions, *(reason for rule in found for reason in rule(estimate))))


def missing_of(estimate: Estimate, fixes: int) -> tuple[str, ...]:
    """Return what could not be estimated for a walk with so many fixes, a line each."""
    if fixes and not (estimate.placed or used_fixes(estimate.fixes)):
        missing = ("a place: no fix lies within the recording",)
    elif is_a_guess(estimate.fixes):
        missing = ("a place: the fixes contradict the steps and one another",)
    else:
        missing = ()
    return missing if estimate.converged else (*missing, "a converged optimum")


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
        check = "the fixes, their sigmas and their clock; the list of beacons"
        yield Contradiction("fixes", other, share, "share", text, check, state)


def _other_source(estimate: Estimate) -> str:
    """What determines the walk beside its fixes: the beacons, the ranges, another kind that does, else the steps."""
    locating = locating_kinds()
    return next((kind for kind in estimate.reports if kind in locating and estimate.reports[kind]), STEPS_AND_REST)


def _distant_fixes(estimate: Estimate) -> Iterator[Contradiction]:
    """Sources whose fixes have a larger median distance from the walk than their sigmas allow."""
    used, other = _evidence(estimate), _other_source(estimate)
    sources = list(dict.fromkeys(fix.source for fix in used))
    for source in sources:
        own = [fix for fix in used if fix.source == source]
        sigmas = np.array([fix.residual / fix.sigma for fix in own])
        independent = len({int(fix.time // VERDICTS.alike) for fix in own})
        if median := _too_large(sigmas, independent, RAYLEIGH_MEDIAN, 1 / RAYLEIGH_MEDIAN):
            of = f" of {source}" * (source != "" and len(sources) > 1)
            away = f"{np.median([fix.residual for fix in own]):.1f} m ({median:.1f} sigma) from the walk"
            lie = f"the fix{of} lies" if len(own) == 1 else f"half of the fixes{of} lie more than"
            check = f"the sigmas and clock of the fixes{of}, and the {other}"
            yield Contradiction("fixes", other, median, "sigma", f"{lie} {away}, against the {other}", check)


def _jumps(estimate: Estimate) -> Iterator[Contradiction]:
    """Receivers that from one fix to the next leave the way of the steps, and do not come back."""
    n, track = BESIDE_JUMP, estimate.trajectory
    used = [fix for fix in _evidence(estimate) if fix.source and track.time[0] <= fix.time <= track.time[-1]]
    for source in dict.fromkeys(fix.source for fix in used):
        own = np.array([(fix.time, fix.sigma, fix.x, fix.y) for fix in used if fix.source == source])
        if len(own) < 2 * n:
            continue
        off = own[:, 2:] - interpolate(own[:, 0], track.time, track.position)
        usual = np.median(sliding_window_view(np.column_stack([off, own[:, 1]]), n, axis=0), axis=-1)
        jump = usual[n:, :2] - usual[:-n, :2]
        sigmas = np.hypot(*jump.T) / np.fmax(usual[n:, 2], usual[:-n, 2])
        gradual = np.hypot(*np.diff(off, axis=0)[n - 1 : 1 - n].T) < np.hypot(*jump.T) / 2  # a ride
        sigmas[gradual | (np.diff(own[:, 0])[n - 1 : 1 - n] > FIXES.seconds)] = 0.0
        at = peaks(sigmas, VERDICTS.jump, n)
        stays = float(np.hypot(*jump[at].sum(axis=0)))
        if stays > VERDICTS.jump * np.median(own[:, 1]):
            most = int(at[np.argmax(sigmas[at])])
            text = f"{source} jumps {stays:.0f} m from the way of the steps at {own[n + most, 0]:.0f} s and stays there"
            check = "where the walk was before and after: one of both is wrong"
            yield Contradiction(source, "steps", stays, "m", text, check)


def _too_large(sigmas: Array, independent: int, median: float, spread: float) -> float:
    """The median of residuals ``(n,)`` [σ], if it is larger than honest residuals have; else 0.

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
        check = "the list of beacons: another building or floor? moved or swapped ones?"
        yield Contradiction("beacons", "fixes and steps", share, "share", text, check)


def _headings(estimate: Estimate) -> Iterator[Contradiction]:
    """Headings whose median residual is larger than their sigmas allow."""
    sigmas = np.array([abs(report.residual) / report.sigma for report in estimate.reports.get("headings", ())])
    if median := _too_large(sigmas, len(sigmas), NORMAL_MEDIAN, 0.79):
        text = f"half of the headings differ by more than {median:.1f} sigma from the walk"
        yield Contradiction("headings", "steps and fixes", median, "sigma", text, "magnets and iron near the phone")


def _network(estimate: Estimate) -> Iterator[Contradiction]:
    """A network that contradicts the steps throughout."""
    if (reports := estimate.reports.get("network")) and not any(report.weight for report in reports):
        text = "the network's velocities contradict the steps throughout: they are not used"
        check = "--learned: its units, axes and order of sensors, and how the network was trained"
        yield Contradiction("network", "steps", 1.0, "share", text, check)


def _untimed(estimate: Estimate) -> Iterator[Contradiction]:
    """Places without a time, too many of which are not on the walk for the fixes to confirm it."""
    rejected = sum(place.weight < REPORTS.rejected for place in estimate.untimed)
    confirming = sum(fix.weight > REPORTS.accepted for fix in estimate.fixes)
    if (share := rejected / max(len(estimate.untimed) + confirming, 1)) > VERDICTS.doubtful:
        text = f"{rejected} of {count(len(estimate.untimed), 'place')} without a time are not on the walk"
        yield Contradiction(
            "visited", STEPS_AND_REST, share, "share", text, "whose places, of which day, on which plan?"
        )


def _stride(estimate: Estimate) -> Iterator[Contradiction]:
    """Strides of no usual walker of that height at that pace, unless independent positions confirm them.

    Strides that are too short or long for any walker are a doubt whatever confirms them: most sources share an error.
    """
    calibration = estimate.calibration
    if calibration is None:
        return
    (low, high), (least, most), stride = REPORTS.stride, VERDICTS.strides, calibration.stride
    unusual = not low <= stride <= high and not low <= calibration.value[:, 0].mean() <= high
    confirmed = not unusual or stride_determined(estimate, PATHS.fewest_fixes)
    if confirmed and least <= stride <= most:
        return
    walked = float(np.hypot(*np.diff(estimate.trajectory.position, axis=0).T).sum())
    steps = max(len(estimate.trajectory) - 2, 1)
    text = f"{walked:.0f} m in {steps} steps, {walked / steps:.2f} m each: {percent(stride)} of what walkers of that "
    text += "height take at that pace" + ", and too few independent positions confirm it" * (not confirmed)
    check = "the height of the walker, their profile, the fixes, the start, and the scale of the floor plan"
    sigmas = (stride - 1) / float(calibration.prior_sigma[0, 0])
    yield Contradiction("stride", "fixes and plan", sigmas, "sigma", text, check)


def _probability(estimate: Estimate) -> Iterator[Contradiction]:
    """A route that is one of several; on a plan beside all fixes (`plan_placement`) its probability is 0."""
    if 0 < estimate.probability < REPORTS.sure:
        text = f"this route has a probability of {percent(estimate.probability)}: another may be right"
        check = "the report's map; another fix would decide"
        yield Contradiction(ROUTE, "other routes", estimate.probability, "probability", text, check)


def _width(estimate: Estimate) -> Iterator[Contradiction]:
    """A measured place that is known less well than "ok" promises, in half of the rows."""
    covariance = estimate.trajectory.covariance
    if covariance is None or not is_measured(estimate):
        return
    radius = RADIUS_90 * float(np.median(horizontal_sigma(covariance)))
    if radius > VERDICTS.widest:
        text = f"the place is known only to {radius:.0f} m (median radius of the 90 % region)"
        check = "the report's map; more positions, a plan or a compass would decide"
        yield Contradiction(PLACE, "other places", radius, "m", text, check)


def _convergence(estimate: Estimate) -> Iterator[Contradiction]:
    if not estimate.converged:
        text = "the optimiser stopped before the cost converged"
        check = "the fixes and the recording: contradictions make the search slow"
        yield Contradiction("optimiser", "all sources", float(estimate.iterations), "iterations", text, check)


def stride_determined(estimate: Estimate, fewest: int = 2) -> bool:
    """True if independent positions determine the stride scale R_s at the end of the walk, not the plan alone.

    These are ``fewest`` or more, see `independent_positions`; and two fixes or beacons so far apart that their sigmas
    alone halve the variance of an unknown walker's R_s, or as many anchors.
    """
    calibration, half = estimate.calibration, np.sqrt(0.5) * Prior().sigma[0]
    if calibration is None or calibration.sigma[-1, 0] > half:
        return False
    number = independent_positions(estimate)
    if sum(number.values()) < fewest:
        return False
    beacons = [
        (beacon.x, beacon.y, VERDICTS.near_beacon)
        for beacon in estimate.beacons
        if beacon.levels and not beacon.misplaced
    ]
    places = [*((fix.x, fix.y, fix.sigma) for fix in _accepted(estimate)), *beacons]
    if len(places) > 1 and _stride_sigma(np.array(places)) <= half:
        return True
    receivers = {fix.source or "fixes" for fix in _accepted(estimate)}
    anchors = sum(number.values()) - sum(number.get(kind, 0.0) for kind in ("beacons", *receivers))
    return anchors >= max(fewest, 3)  # from ranges to three a position follows


def independent_positions(estimate: Estimate) -> dict[str, float]:
    """Effective number of accepted positions with errors of their own: of the user, each receiver, beacons, anchors.

    Fixes of one receiver whose errors are correlated, by the time and the distance between them, count as one.
    """
    accepted, track, number = _accepted(estimate), estimate.trajectory, dict[str, float]()
    walked = np.append(0.0, np.cumsum(np.hypot(*np.diff(track.position, axis=0).T)))
    for source in dict.fromkeys(fix.source for fix in accepted):
        time = np.sort([fix.time for fix in accepted if fix.source == source])
        drifted = time / RECEIVERS.standing + np.interp(time, track.time, walked) / RECEIVERS.along
        first, after = alike(drifted) if source else (np.zeros(len(time)), np.ones(len(time)))
        number[source or "fixes"] = float(np.sum(1.0 / (after - first)))
    for kind in locating_kinds():
        if names := set(_transmitters(estimate, kind)):
            number[kind] = float(len(names))
    return number


def teaches_profile(estimate: Estimate) -> bool:
    """True if the walker's profile may be learnt from this estimate.

    It is "ok" but for how well its place is known, no error of a source explains it, and three or more independent
    positions determine the stride scale.
    """
    sound = all(reason.source == PLACE for reason in verdict(estimate).reasons)
    return not estimate.assumed and stride_determined(estimate, PATHS.fewest_fixes) and sound


def _accepted(estimate: Estimate) -> list[FixReport]:
    return [fix for fix in _evidence(estimate) if fix.weight > REPORTS.accepted]


def _stride_sigma(places: Array) -> float:
    """Sigma of the stride scale by the two positions that determine it best, from their distance alone.

    places: ``(n, 3)`` x, y and sigma [m].
    """
    x, y, sigma = places[np.unique(np.linspace(0, len(places) - 1, FIXES_COMPARED).astype(int))].T
    apart = np.hypot(x - x[:, None], y - y[:, None])
    return float(np.min(np.hypot(sigma, sigma[:, None]) / np.maximum(apart, 1e-9)))


def _transmitters(estimate: Estimate, *kinds: str) -> Iterator[str]:
    """Names of the beacons and anchors that measured positions; of measurements without a name, that of their kind."""
    for kind in kinds or locating_kinds():
        for report in estimate.reports.get(kind, ()):
            if not getattr(report, "misplaced", False):
                yield str(getattr(report, "anchor", "") or getattr(report, "label", "") or kind)
