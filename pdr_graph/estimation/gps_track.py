"""A smoothed track from positions alone: a GPX track, a watch, a log without an accelerometer.

It is smoothed twice: first loosely, to classify the transport mode, then with the motion model of that mode. Somebody
who stands stays in place however far the receiver wanders; gaps are bridged with a wide covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.estimation.factors.fixes import WITHIN, longest_consistent_chain
from pdr_graph.estimation.factors.gnss_bias import WHITE
from pdr_graph.estimation.gps_smoother import GpsKnots, Motion, SmoothTrack, smooth_track
from pdr_graph.estimation.results import REJECTED
from pdr_graph.estimation.transport_mode import EPOCH, RIDES, STANDS, STATES, WIDEST, moves, straightness
from pdr_graph.geometry import ANY_HEADING, interpolate
from pdr_graph.types import INSTANT, Array, Estimate, Fixes, FixReport, Index, Mask, Trajectory

LOST = len(STATES)  # transport mode where there is no data
FASTEST = 40.0  # [m/s] on the ground
JUMP = 20.0  # fixes needed on either side to accept a faster jump, such as a flight
# a gap is longer than so many of the usual intervals, and than a minute [s]: loggers leave out a few fixes where they
# see few satellites, and in a minute nobody walks round the block
USUAL_INTERVALS, LONGEST = 5.0, 60.0
BRIDGE = 4  # parts of a gap that rows divide: linear between them, its variance lacks a seventh at most
# per axis, of STANDS, WALKS, RIDES and LOST: who walks turns at the next corner, who rides at the one after; errands of
# an unseen hour change
SPEED = np.array([0.05, 0.9, 7.0, 1.0])  # [m/s]
KEEPS = np.array([1.0, 40.0, 100.0, 600.0])  # [s]
AT_FIRST, AFTERWARDS = (8.0, 2.0, 1.0), (1.0, 1.0)  # times the white noise, see `smooth_track`


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


def way_through(fixes: Fixes) -> Way:
    """The most probable track; fixes: at least one, in a metric frame."""
    used = _plausible(fixes)
    fixes = fixes[used]
    seen, lost = _seen(fixes), _lost(fixes)

    # Loosely, as if all of it were a ride
    kind = np.where(lost, LOST, RIDES)
    first = smooth_track(seen, _motion(seen, kind), AT_FIRST)

    # As people move who do what they seem to do, and who knows where in gaps
    kind, seen = _done(seen, first.position, lost)
    rows, of = _with_rows_in_gaps(seen, kind)
    motion, weight = _motion(seen, kind), np.interp(rows.time, seen.time, first.weight)
    way = smooth_track(rows, motion.of(of), AFTERWARDS, weight)
    floor = tuple(fixes.floor[k] for k in (*of, len(fixes) - 1))
    known = np.isfinite(rows.position[:, 0])
    return Way(_trajectory(rows.time, way, floor), kind[of], used, way.weight[known])


def _plausible(fixes: Fixes) -> Index:
    """Indices of the best fix of each moment, without jumps faster than FASTEST and back.

    Most of a receiver's error stays from epoch to epoch, and the rest is small: jumps are outliers.
    """
    order = np.lexsort((fixes.sigma, fixes.time))
    order = order[np.append(True, np.diff(fixes.time[order]) > INSTANT)]
    one = fixes[order]
    way = FASTEST * (one.time - one.time[0])
    return order[longest_consistent_chain(one.position, WITHIN * _seen(one).white, way, JUMP)[1]]


def _seen(fixes: Fixes) -> GpsKnots:
    """Of a receiver's errors most stay for a while, others are independent."""
    independent = np.where(np.array(fixes.source, dtype=str) == "", 1.0, WHITE)
    slow = fixes.sigma * np.sqrt(1 - independent**2)
    return GpsKnots(fixes.time, fixes.position, slow, independent * fixes.sigma)


def _lost(fixes: Fixes) -> Mask:
    """True ``(n - 1,)`` where from one fix to the next nothing was recorded, or too little to tell, or they flew."""
    time, span = fixes.time, np.diff(fixes.time)
    flown = np.hypot(*np.diff(fixes.position, axis=0).T) > FASTEST * (span + LONGEST)  # shorter jumps are receivers'
    lost = flown | (span > max(LONGEST, USUAL_INTERVALS * float(np.median(span)) if len(span) else 0.0))
    for begin, end in _stretches(lost):
        if time[end] - time[begin] < EPOCH:
            lost[begin:end] = True
    return lost


def _stretches(lost: Mask) -> Index:
    """First and last fix ``(s, 2)`` of each stretch that was recorded, of two fixes at least."""
    edge = np.diff(np.concatenate([[True], lost, [True]]).astype(int))
    return np.column_stack([np.flatnonzero(edge < 0), np.flatnonzero(edge > 0)])


def _done(seen: GpsKnots, way: Array, lost: Mask) -> tuple[Index, GpsKnots]:
    """What was done from fix to fix ``(n - 1,)``, and how far each fix errs, with its wander."""
    begins, ends = seen.time[_stretches(lost)].T
    if not len(begins):
        return np.full(len(lost), LOST), seen
    straight = straightness(seen.time, way, begins, ends)
    wander = np.minimum(np.interp(seen.time, straight.time, straight.wander), WIDEST)
    more = np.maximum(wander / np.hypot(seen.slow, seen.white), 1.0)
    seen = replace(seen, slow=np.maximum(seen.slow, wander), white=seen.white * more)
    return np.where(lost, LOST, moves(seen, way, begins, ends, straight)), seen


def _motion(seen: GpsKnots, kind: Index) -> Motion:
    """How people move who do this from fix to fix ``(n - 1,)``; over a gap at least as fast as it takes."""
    takes = np.hypot(*np.diff(seen.position, axis=0).T) / np.diff(seen.time) / np.sqrt(2)
    speed = np.where(kind == LOST, np.maximum(SPEED[LOST], takes), SPEED[kind])
    anew = np.append(False, (kind[1:] != kind[:-1]) | (kind[1:] == LOST))[: len(kind)]
    return Motion(speed, KEEPS[kind], anew)


def _with_rows_in_gaps(seen: GpsKnots, kind: Index) -> tuple[GpsKnots, Index]:
    """The same with knots between that divide each gap, and the interval between fixes that each new one is of."""
    of = np.repeat(np.arange(len(kind)), np.where(kind == LOST, BRIDGE, 1))
    within = np.arange(len(of)) - np.searchsorted(of, of)
    time = seen.time[of] + np.diff(seen.time)[of] * within / np.where(kind == LOST, BRIDGE, 1)[of]
    known = np.append(within == 0, True)
    position = np.full((len(known), 2), np.nan)
    position[known] = seen.position
    of_all = np.append(of, len(kind))
    return GpsKnots(np.append(time, seen.time[-1]), position, seen.slow[of_all], seen.white[of_all]), of


def _trajectory(time: Array, way: SmoothTrack, floor: tuple[str, ...]) -> Trajectory:
    """The way as a trajectory that faces where it goes."""
    variance = way.variances()
    speed = np.hypot(*way.velocity.T)
    covariance = np.zeros((len(time), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = variance[:, 0]
    sigma = np.minimum(ANY_HEADING, np.sqrt(variance[:, 1]) / np.maximum(speed, 1e-9))
    covariance[:, 2, 2] = sigma**2
    return Trajectory(time, way.position, np.arctan2(way.velocity[:, 1], way.velocity[:, 0]), floor, covariance)


TRUSTED = 0.9  # weight above which a fix is reported as "full weight"
TOO_FAST, REPEATED = "too far to be reached in time: not used", "a better fix at the same time: not used"


def follow(fixes: Fixes) -> Estimate:
    """The smoothed track with a report of each fix; jumps faster than FASTEST and back are not used.

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
        reports={"fixes": tuple(map(FixReport, *(column.tolist() for column in columns), reason))},
        iterations=0,
        cost=0.0,
        converged=True,
        warnings=_warnings(way, len(fixes), int((reason == TOO_FAST).sum())),
    )


def _reason(sigmas: float, weight: float) -> str:
    trust = "full weight" if weight > TRUSTED else "reduced weight" if weight >= REJECTED else "outlier"
    return f"{sigmas:.1f} sigma from the smoothed track: {trust}"


def _warnings(way: Way, fixes: int, passed: int) -> tuple[str, ...]:
    """Warnings for the user; passed: how many fixes were too far to be reached in time."""
    lasts, doubted = np.diff(way.trajectory.time), int((way.weight < REJECTED).sum())
    still, seen = (float(lasts[which].sum()) for which in (way.kind == STANDS, way.kind != LOST))
    holds_for = {
        f"{passed} of {fixes} fixes are too far to be reached in time and were not used": passed,
        f"{doubted} of {fixes} fixes contradict those around them and have weight 0": doubted,
        f"the positions lead nowhere for {still / 60:.0f} of {seen / 60:.0f} min: classified as standing": still
        > seen / 2,
    }
    return tuple(text for text, holds in holds_for.items() if holds)
