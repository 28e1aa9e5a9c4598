"""A smoothed track from positions alone: a GPX track, a watch, a log without an accelerometer.

It is smoothed twice: first with a loose motion model, to classify the transport mode, then with the motion model of
that mode. While standing, the track stays in place however far the receiver's positions wander; gaps have a wide
covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.factors.fixes import longest_consistent_chain
from pdr_graph.estimation.gps_smoother import GpsKnots, Motion, SmoothTrack, smooth_track
from pdr_graph.estimation.results import REPEATED
from pdr_graph.estimation.transport_mode import RIDES, STANDS, STATES, moves, straightness
from pdr_graph.geometry import ANY_HEADING, interpolate
from pdr_graph.priors import FIXES, RECEIVERS, REPORTS, TRACK, TRAVEL
from pdr_graph.types import INSTANT, Array, Estimate, Fixes, FixReport, Index, Mask, Trajectory

LOST = len(STATES)  # transport mode where there is no data
BRIDGE = 4  # parts of a gap: with linear interpolation between their ends, the variance is a seventh too low at most


@dataclass(frozen=True)
class Way:
    """A smoothed track with covariance: a row per used fix and some in gaps, ``n`` of them.

    kind: ``(n - 1,)`` transport mode from row to row: STANDS, WALKS, RIDES, LOST; used: ``(m,)`` indices of the fixes
    used, in order of time, and weight: ``(m,)`` of each, 0–1.
    """

    trajectory: Trajectory
    kind: Index
    used: Index
    weight: Array


Stated = Sequence[tuple[float, float, int]]  # start and end [s] of a transport mode that is known


def way_through(fixes: Fixes, stated: Stated = ()) -> Way:
    """The smoothed track of fixes: at least one, in a metric frame.

    stated: transport modes that are known, in place of those by the positions; where a stay begins or ends, the track
    may jump.
    """
    used = _plausible(fixes)
    fixes = fixes[used]
    knots, lost = _knots(fixes), _lost(fixes)

    # First pass: everything is a ride
    kind = np.where(lost, LOST, RIDES)
    first = smooth_track(knots, _motion(knots, kind), TRACK.first_scales)

    # Second pass: the motion model of each transport mode, with rows in gaps
    kind, knots = _classified(knots, first.position, lost, stated)
    kind, jumps = _with_stated(knots.time, kind, stated)
    rows, of = _with_rows_in_gaps(knots, kind)
    motion, weight = _motion(knots, kind, jumps), np.interp(rows.time, knots.time, first.weight)
    way = smooth_track(rows, motion.of(of), TRACK.final_scales, weight)
    floor = tuple(fixes.floor[k] for k in (*of, len(fixes) - 1))
    is_fix = np.isfinite(rows.position[:, 0])
    return Way(_trajectory(rows.time, way, floor), kind[of], used, way.weight[is_fix])


def _plausible(fixes: Fixes) -> Index:
    """Indices of the best fix at each time, without jumps faster than TRACK.fastest and back.

    Most of a receiver's error is constant from epoch to epoch, and the rest is small, so jumps are outliers.
    """
    order = np.lexsort((fixes.sigma, fixes.time))
    order = order[np.append(True, np.diff(fixes.time[order]) > INSTANT)]
    first = fixes[order]
    way = TRACK.fastest * (first.time - first.time[0])
    return order[longest_consistent_chain(first.position, FIXES.within * _knots(first).white, way, TRACK.jump)[1]]


def _knots(fixes: Fixes) -> GpsKnots:
    """Knots at the fixes; fixes with a source have a slowly varying error, others are independent."""
    independent = np.where(np.array(fixes.source, dtype=str) == "", 1.0, RECEIVERS.white)
    slow = fixes.sigma * np.sqrt(1 - independent**2)
    return GpsKnots(fixes.time, fixes.position, slow, independent * fixes.sigma)


def without_data(time: Array) -> Mask:
    """True ``(n - 1,)`` between two times of fixes ``(n,)`` [s] with a gap."""
    span = np.diff(time)
    return span > max(TRACK.longest, TRACK.usual_intervals * float(np.median(span)) if len(span) else 0.0)


def _lost(fixes: Fixes) -> Mask:
    """True ``(n - 1,)`` between two fixes with a gap, a flight, or a stretch shorter than an epoch."""
    time, span = fixes.time, np.diff(fixes.time)
    # Shorter jumps are receivers'
    flown = np.hypot(*np.diff(fixes.position, axis=0).T) > TRACK.fastest * (span + TRACK.longest)
    lost = flown | without_data(fixes.time)
    for begin, end in _stretches(lost):
        if time[end] - time[begin] < TRAVEL.epoch:
            lost[begin:end] = True
    return lost


def _stretches(lost: Mask) -> Index:
    """First and last fix ``(s, 2)`` of each recorded stretch, which has at least two fixes."""
    edge = np.diff(np.concatenate([[True], lost, [True]]).astype(int))
    return np.column_stack([np.flatnonzero(edge < 0), np.flatnonzero(edge > 0)])


def _classified(knots: GpsKnots, way: Array, lost: Mask, stated: Stated) -> tuple[Index, GpsKnots]:
    """The transport mode from fix to fix ``(n - 1,)``, and the knots with sigmas widened by the receiver's wander.

    Stays that are stated do not count: their fixes do not wander.
    """
    stays = [(start, end) for start, end, mode in stated if mode == STANDS]
    middle = (knots.time[1:] + knots.time[:-1]) / 2
    apart = lost | np.any([(middle > start) & (middle < end) for start, end in stays], axis=0) if stays else lost
    begins, ends = knots.time[_stretches(lost if apart.all() else apart)].T
    if not len(begins):
        return np.full(len(lost), LOST), knots
    straight = straightness(knots.time, way, begins, ends)
    wander = np.minimum(np.interp(knots.time, straight.time, straight.wander), TRAVEL.widest)
    more = np.maximum(wander / np.hypot(knots.slow, knots.white), 1.0)
    knots = replace(knots, slow=np.maximum(knots.slow, wander), white=knots.white * more)
    return np.where(lost, LOST, moves(knots, way, begins, ends, straight)), knots


def _with_stated(time: Array, kind: Index, stated: Stated) -> tuple[Index, Mask]:
    """The modes ``(n - 1,)`` with stated ones in their place, except in gaps; True where a stated stay begins or ends.

    time: ``(n,)`` of the knots [s].
    """
    kind, jumps = kind.copy(), np.zeros(len(kind), dtype=bool)
    for start, end, mode in stated:
        middle = (time[1:] + time[:-1]) / 2
        kind[(middle >= start) & (middle <= end) & (kind != LOST)] = mode
        for bound in (start, end) if mode == STANDS else ():
            jumps |= (time[:-1] < bound + INSTANT) & (time[1:] > bound - INSTANT)
    return kind, jumps


def _motion(knots: GpsKnots, kind: Index, jumps: Mask | bool = False) -> Motion:
    """The motion model per interval ``(n - 1,)`` of a mode; over a gap, its speed is at least that required.

    Over a jump it is TRACK.free times as much, so that positions before and after a stated stay do not pull at it.
    """
    takes = np.hypot(*np.diff(knots.position, axis=0).T) / np.diff(knots.time) / np.sqrt(2)
    speed = np.where(kind == LOST, np.maximum(np.array(TRACK.speed)[LOST], takes), np.array(TRACK.speed)[kind])
    speed = np.where(jumps, np.maximum(speed, TRACK.free * takes), speed)
    jumps = jumps & np.ones(len(kind), dtype=bool)
    changed = np.append(False, (kind[1:] != kind[:-1]) | (kind[1:] == LOST) | jumps[:-1])[: len(kind)] | jumps
    return Motion(speed, np.where(jumps, np.array(TRACK.keeps)[LOST], np.array(TRACK.keeps)[kind]), changed)


def _with_rows_in_gaps(knots: GpsKnots, kind: Index) -> tuple[GpsKnots, Index]:
    """The knots with BRIDGE - 1 more in each gap, and the original interval of each new interval."""
    of = np.repeat(np.arange(len(kind)), np.where(kind == LOST, BRIDGE, 1))
    within = np.arange(len(of)) - np.searchsorted(of, of)
    time = knots.time[of] + np.diff(knots.time)[of] * within / np.where(kind == LOST, BRIDGE, 1)[of]
    is_fix = np.append(within == 0, True)
    position = np.full((len(is_fix), 2), np.nan)
    position[is_fix] = knots.position
    of_all = np.append(of, len(kind))
    return GpsKnots(np.append(time, knots.time[-1]), position, knots.slow[of_all], knots.white[of_all]), of


def _trajectory(time: Array, way: SmoothTrack, floor: tuple[str, ...]) -> Trajectory:
    """The trajectory of a smoothed track, with the heading of its velocity."""
    variance = way.variances()
    speed = np.hypot(*way.velocity.T)
    covariance = np.zeros((len(time), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = variance[:, 0]
    sigma = np.minimum(ANY_HEADING, np.sqrt(variance[:, 1]) / np.maximum(speed, 1e-9))
    covariance[:, 2, 2] = sigma**2
    return Trajectory(time, way.position, np.arctan2(way.velocity[:, 1], way.velocity[:, 0]), floor, covariance)


TRUSTED = 0.9  # weight above which a fix is reported as "full weight"
TOO_FAST = "too far to be reached in time: not used"  # reason in reports


def follow(fixes: Fixes) -> Estimate:
    """The smoothed track with a report of each fix; jumps faster than TRACK.fastest and back are not used.

    fixes: at least one, in order of time, in the output frame.
    """
    way = way_through(fixes)
    track, weight = way.trajectory, np.zeros(len(fixes))
    weight[way.used] = way.weight
    residual = np.hypot(*(fixes.position - interpolate(fixes.time, track.time, track.position)).T)
    reason = np.where(np.isin(fixes.time, fixes.time[way.used]), REPEATED, TOO_FAST).astype(object)
    reason[way.used] = [_reason(*values) for values in zip((residual / fixes.sigma)[way.used], way.weight, strict=True)]
    columns = (fixes.time, *fixes.position.T, fixes.sigma, residual, weight)
    return Estimate(
        trajectory=track,
        dead_reckoning=track,
        calibration=None,
        reports={"fixes": tuple(map(FixReport, *(column.tolist() for column in columns), reason))},
        iterations=0,
        cost=0.0,
        converged=True,
        warnings=_warnings(way, len(fixes), int((reason == TOO_FAST).sum())),
    )


def _reason(sigmas: float, weight: float) -> str:
    trust = (
        "full weight" if weight > REPORTS.full_weight else "reduced weight" if weight >= REPORTS.rejected else "outlier"
    )
    return f"{sigmas:.1f} sigma from the smoothed track: {trust}"


def _warnings(way: Way, fixes: int, passed: int) -> tuple[str, ...]:
    """Warnings for the user; passed: how many fixes were too far to be reached in time."""
    lasts, doubted = np.diff(way.trajectory.time), int((way.weight < REPORTS.rejected).sum())
    still, recorded = (float(lasts[which].sum()) for which in (way.kind == STANDS, way.kind != LOST))
    holds_for = {
        f"{passed} of {fixes} fixes are too far to be reached in time and were not used": passed,
        f"{doubted} of {fixes} fixes contradict those around them and have weight 0": doubted,
        f"the positions lead nowhere for {still / 60:.0f} of {recorded / 60:.0f} min: classified as standing": still
        > recorded / 2,
    }
    return tuple(text for text, holds in holds_for.items() if holds)
