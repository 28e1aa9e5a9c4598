"""The filter front end: the walk as it is known at each moment, from what came before.

The fusion of [gps-dr] as one extended Kalman filter over (x, y, θ, R_s, R_d, b), the variables of the graph, over the
same pieces and fixes:

    predict   p ← p + R_s l e(θ + half the turn),  θ ← θ + R_d turn + b time      (Secs. 2, 3: strides, gyro)
              Q from the stride's variance (Sec. 4), and from sway and turn, of which the paper says nothing
    correct   with validated magnetic headings, R by both tests of the field      (Sec. 3)
              with fixes, R by the receiver's accuracy or HDOP                    (Sec. 4)

The paper has one filter for the heading and another for the position, so that its fixes correct no heading and no
stride: with both in one state they do. Its magnetometer tells the heading from the first step on, as our first magnetic
heading does here, carried back by the gyro. A fix beyond the gate is refused; a filter that refuses several in a row is
lost and begins anew where they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.estimation.bank import FAR, GATE, Bank, Surprise, by_direction, measured, thinned
from pdr_graph.estimation.graph import FRAME_SIGMA, WalkGraph
from pdr_graph.estimation.initial import lay_dead_reckoning
from pdr_graph.estimation.preintegration import SIGMA_STILL
from pdr_graph.estimation.reports import calibration_of, fix_reports, warnings
from pdr_graph.geometry import row_times, wrap_angle
from pdr_graph.types import Array, Estimate, FixReport, Index, Trajectory

PATIENCE = 5  # fixes in a row that are refused before the filter takes itself for lost
UNLIKELY = 0.01  # probability below which a user is not told of another walk
OF_POSITION, OF_HEADING = np.eye(2, 6), np.eye(1, 6, 2)


@dataclass(frozen=True)
class Meeting:
    """How one fix met the walk: distance [m] from where it was expected, in sigmas, the weight it was given, and
    whether the filter began anew there.
    """

    fix: int
    distance: float
    sigmas: float
    weight: float
    anew: bool


@dataclass(frozen=True)
class Moment:
    """The walk at the start, or at the end of one piece.

    predicted: before the measurements of this moment, known: after them. Hypothesis n of ``predicted`` came from
    ``parent (h,)`` n of the moment before, by a movement whose derivative is ``motion (h, 6, 6)`` n.
    """

    parent: Index
    motion: Array
    predicted: Bank
    known: Bank
    met: tuple[Meeting, ...]


def kalman_filter(graph: WalkGraph) -> Estimate:
    """The causal estimate at every row: each pose knows the fixes up to its time, and no wall.

    graph: the same measurements as for ``smooth``; its walls are not used.
    """
    expect("kalman_filter, graph", graph, WalkGraph, instead="WalkGraph(steps, fixes)")
    known, met, last = list[tuple[Array, Array]](), list[Meeting](), _start(graph).known
    for moment in moments(graph):
        last = moment.known
        known.append(last.summary())
        met += moment.met
    means, covariances = (np.array(column) for column in zip(*known, strict=True))
    return estimate_of(graph, means, covariances, met, last)


def estimate_of(graph: WalkGraph, means: Array, covariances: Array, met: list[Meeting], last: Bank) -> Estimate:
    """States ``(m + 1, 6)`` and covariances ``(m + 1, 6, 6)`` before and after each piece, as an estimate.

    met: how fixes were met; last: the bank at the end.
    """
    rows = np.concatenate([[0], graph.pieces.row_end + 1])
    position, heading = means[rows, :2], wrap_angle(means[rows, 2])
    of_segment = graph.pieces.last[np.append(np.flatnonzero(np.diff(graph.segment)), -1)] + 1
    calibration = calibration_of(graph, means[of_segment, 3:], covariances[of_segment, 3:, 3:])
    probability, walks = float(np.exp(last.log_weight.max())), int(np.sum(last.log_weight > np.log(UNLIKELY)))
    return Estimate(
        trajectory=Trajectory(row_times(graph.steps), position, heading, graph.floors, covariances[rows, :3, :3]),
        dead_reckoning=lay_dead_reckoning(graph.steps, graph.fixes[graph.fix_believed]),
        calibration=calibration,
        fixes=_reports(graph, met),
        iterations=1,
        cost=float("nan"),
        converged=True,
        probability=probability,
        warnings=(*warnings(graph, walks, probability, True, calibration), *_lost(graph, met)),
    )


def moments(graph: WalkGraph) -> Iterator[Moment]:
    """Once through the walk: its start, then the end of each piece."""
    fixes_at, headings_at = _by_keyframe(graph)
    moment, refused = _start(graph), 0
    for keyframe in range(len(fixes_at)):
        if keyframe > 0:
            *before, moment = _predicted(moment.known, graph, keyframe - 1)
            yield from before
        for n in fixes_at[keyframe].tolist():
            moment, refused = _fixed(moment, graph, n, refused)
        known = moment.known
        for n in headings_at[keyframe].tolist():
            known = _pointed(known, graph, n, OF_HEADING, float(graph.headings.sigma[n] ** 2))
        moment = replace(moment, known=thinned(known))
        yield moment


def _by_keyframe(graph: WalkGraph) -> tuple[list[Index], list[Index]]:
    """The fixes and the headings of each keyframe; the first heading is told before the start."""
    keyframes = np.arange(1, len(graph.pieces.last) + 1)
    used = np.flatnonzero(graph.fix_used)
    used = used[np.argsort(graph.fix_keyframe[used], kind="stable")]
    fixes_at = np.split(used, np.searchsorted(graph.fix_keyframe[used], keyframes))
    later = graph.heading_keyframe[1:]
    return fixes_at, np.split(1 + np.arange(len(later)), np.searchsorted(later, keyframes))


def _start(graph: WalkGraph) -> Moment:
    """Before any fix: everywhere near the first, in the direction that the compass tells, or in any.

    Without a fix at (0, 0), and without a compass with heading 0: the start is the frame.
    """
    fixed, told = graph.fix_used.any(), len(graph.headings) > 0
    place = FAR if fixed else FRAME_SIGMA
    mean, covariance = np.zeros(6), np.zeros((6, 6))
    mean[:2] = graph.fixes.position[graph.fix_used][0] if fixed else 0.0
    mean[3:], covariance[3:, 3:] = graph.prior.mean, graph.prior.covariance
    covariance[:3, :3] = np.diag(np.square([place, place, FAR if fixed or told else FRAME_SIGMA]))
    own = np.zeros(1, dtype=np.intp)
    bank = Bank(mean[None], covariance[None], np.zeros(1), own)
    if told:
        bank = _first_heading(bank, graph)
    return Moment(own, np.eye(6)[None], bank, by_direction(bank) if fixed or told else bank, ())


def _first_heading(bank: Bank, graph: WalkGraph) -> Bank:
    """The first heading, carried back to the start: it measures θ + R_d turn + b time to its own moment."""
    pieces = graph.pieces
    until = pieces.last[: graph.heading_keyframe[0]]
    H = np.zeros((1, 6))
    H[0, 2], H[0, 4:] = 1.0, pieces.to_end[:, until].sum(axis=1)
    on_the_way = pieces.variance[: len(until) and until[-1] + 1, 2].sum()
    return _pointed(bank, graph, 0, H, float(graph.headings.sigma[0] ** 2 + on_the_way))


def _predicted(bank: Bank, graph: WalkGraph, i: int) -> list[Moment]:
    """After each piece of interval ``i``: p ← p + R_s l e(θ + half the turn), θ ← θ + R_d turn + b time, c a random
    walk. Nothing is measured meanwhile, so that what each piece does to a state is known at once, ``(k, h, …)``.
    """
    pieces, here = graph.pieces, slice(graph.pieces.first[i], graph.pieces.last[i] + 1)
    length, (turn, time) = pieces.length[here, None], 2 * (pieces.to_end - pieces.to_middle)[:, here, None]
    theta, R_s, R_d, b = bank.mean[:, 2:].T
    turned = R_d * turn + b * time
    heading = np.cumsum(np.concatenate([theta[None], turned]), axis=0)
    course = heading[:-1] + turned / 2
    ahead = np.stack([np.cos(course), np.sin(course)], axis=2)
    aside = ahead[..., ::-1] * [-1, 1]
    left = (R_s * length)[..., None] * aside

    mean = np.tile(bank.mean, (len(length), 1, 1))
    mean[..., :2] += np.cumsum((R_s * length)[..., None] * ahead, axis=0)
    mean[..., 2] = heading[1:]
    F = np.tile(np.eye(6), (*turned.shape, 1, 1))
    by_c = [left, length[..., None] * ahead, left * turn[..., None] / 2, left * time[..., None] / 2]
    F[..., :2, 2:] = np.stack(by_c, axis=3)
    F[..., 2, 4], F[..., 2, 5] = turn, time
    G = np.zeros((*turned.shape, 3, 3))  # by the errors of length, sway and turn
    G[..., :2, 0], G[..., :2, 1], G[..., :2, 2], G[..., 2, 2] = ahead, aside, left / 2, 1.0
    variance = pieces.variance[here] + SIGMA_STILL**2 * np.array([1.0, 1.0, 0.0])
    Q = np.zeros_like(F)
    Q[..., :3, :3] = (G * variance[:, None, None]) @ G.swapaxes(2, 3)

    own, P, found = np.arange(len(bank)), bank.covariance + np.diag(np.append(np.zeros(3), _changed(graph, i))), []
    for m, motion in enumerate(F):
        P = motion @ P @ motion.swapaxes(1, 2) + Q[m]
        after = Bank(mean[m], P, bank.log_weight, own)
        found.append(Moment(own, motion, after, after, ()))
    return found


def _changed(graph: WalkGraph, i: int) -> Array:
    """Variance ``(3,)`` by which the calibration changes before interval ``i``: where another segment begins."""
    begins = i > 0 and graph.segment[i] != graph.segment[i - 1]
    return np.square(graph.prior.change) if begins else np.zeros(3)


def _fixed(moment: Moment, graph: WalkGraph, n: int, refused: int) -> tuple[Moment, int]:
    """After fix ``n``, where ``refused`` before it were refused in a row; and how many now are."""
    place, R = graph.fixes.position[n], graph.fix_sigma[n] ** 2 * np.eye(2)
    share = float(graph.fix_sigma[n] / graph.fix_sigma_together[n]) ** 2
    bank = moment.known
    known, surprise = measured(bank, OF_POSITION, place - bank.mean[:, :2], R, share)
    meeting = _meeting(n, np.hypot(*(place - bank.mean[known.best, :2])), surprise, known.best)
    refused = refused + 1 if meeting.weight == 0.0 else 0
    if refused == PATIENCE:
        moment, refused = _anew(moment), 0
        bank = moment.known
        known, _ = measured(bank, OF_POSITION, place - bank.mean[:, :2], R, share)
        meeting = replace(meeting, weight=1.0, anew=True)
    return replace(moment, known=known, met=(*moment.met, meeting)), refused


def _meeting(n: int, distance: float, surprise: Surprise, best: int) -> Meeting:
    return Meeting(n, float(distance), float(surprise.sigmas[best]), float(surprise.weight[best]), anew=False)


def _anew(moment: Moment) -> Moment:
    """A lost filter before the fix that it believes again: anywhere, in the direction that it has or in any other.

    What it refused changed nothing, so that this is the prediction with its pose forgotten.
    """
    own = moment.known.origin[[moment.known.best]]
    lost = moment.predicted.take(own)
    forgotten = lost.covariance + np.diag(np.square([FAR, FAR, FAR, 0.0, 0.0, 0.0]))
    anywhere = replace(lost, covariance=forgotten, origin=np.zeros(1, dtype=np.intp))
    return Moment(moment.parent[own], moment.motion[own], anywhere, by_direction(anywhere), moment.met)


def _pointed(bank: Bank, graph: WalkGraph, n: int, H: Array, variance: float) -> Bank:
    """After heading ``n``, of which H ``(1, 6)`` depends on the state."""
    gap = np.asarray(wrap_angle(graph.headings.heading[n] - bank.mean @ H.T))
    return measured(bank, H, gap, np.array([[variance]]))[0]


def _reports(graph: WalkGraph, met: list[Meeting]) -> tuple[FixReport, ...]:
    """What became of every fix; those outside the recording were not met."""
    distance, sigmas, weight = (np.full(len(graph.fixes), fill) for fill in (np.nan, np.nan, 0.0))
    for one in met:
        distance[one.fix], sigmas[one.fix], weight[one.fix] = one.distance, one.sigmas, one.weight
    reports = list(fix_reports(graph, distance, sigmas, weight, "where it was expected"))
    for one in met:
        if one.anew:
            reason = f"{one.sigmas:.1f} sigma from where it was expected, as those before it: the filter begins anew"
            reports[one.fix] = replace(reports[one.fix], reason=reason)
    return tuple(reports)


def _lost(graph: WalkGraph, met: list[Meeting]) -> tuple[str, ...]:
    """What a user must know of the gate."""
    refused = sum(one.weight == 0.0 for one in met)
    anew = [f"{graph.fixes.time[one.fix]:.1f} s" for one in met if one.anew]
    said = {
        f"{refused} fixes more than {GATE:.0f} sigma from where they were expected were refused": refused > 0,
        f"the filter was lost and began anew at {', '.join(anew)}": bool(anew),
    }
    return tuple(text for text, holds in said.items() if holds)
