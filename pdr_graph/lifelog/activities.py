"""Activities of an outing, from steps or from positions alone: walking, standing, rides and gaps.

Positions alone separate vehicles from walkers, and the jumps of a receiver from both (`follow_positions`). Runners and
cyclists, or a bumpy road and a pavement, can only be separated by steps and positions together: a ride within a walk is
a time in which the positions move farther than the steps can have led.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pdr_graph.estimation.gps_track import LOST, RIDES, STANDS, WALKS, way_through
from pdr_graph.geometry import distance_walked, interpolate, length_along
from pdr_graph.lifelog.day import GAP, KINDS, VEHICLE, Segment
from pdr_graph.lifelog.observation import StatedActivity
from pdr_graph.priors import FIXES, MOTION
from pdr_graph.types import INSTANT, Array, Fixes, Index, Mask, Steps, Trajectory

# A bout of walking ends with a rest of 3 s and has at least two strides of either foot (Kluge et al., "Consensus based
# framework for digital mobility monitoring", PLOS ONE 16(8), 2021); a detector may miss the first and the last step
LONGEST_PAUSE = 5.0  # [s] within a bout
MIN_STEPS = 4  # of a bout; fewer between two pauses are shuffling


def follow_positions(fixes: Fixes, stated: Sequence[StatedActivity] = ()) -> tuple[Trajectory, tuple[Segment, ...]]:
    """The path through positions alone, as of `way_through`, and its segments from the first fix to the last.

    stated: activities that the person states.
    """
    way = way_through(fixes, [(start, end, KINDS.index(kind)) for start, end, kind in stated])
    gone = np.diff(length_along(way.trajectory.position))
    return way.trajectory, _segments(way.kind, way.trajectory.time, gone)


def segments_of(steps: Steps, trajectory: Trajectory, rides: Array) -> tuple[Segment, ...]:
    """The segments from ``steps.start`` to ``steps.end``.

    trajectory: of these steps, with rows as of `row_times`; distances are measured along it. rides: ``(r, 2)`` start
    and end of each [s], in ``steps`` a row each (`without_rides`).
    """
    kind = np.where(steps.is_gap, LOST, WALKS)
    kind[_is_ridden(steps, rides)] = RIDES

    # Before every row and after the last one a pause, which may be none
    edge = np.column_stack([steps.time - steps.duration, steps.time]).ravel()
    edge = np.concatenate([[steps.start], edge, [steps.end]])
    parts = np.full(len(edge) - 1, STANDS)
    parts[1::2] = kind
    parts[::2] = np.where(np.diff(edge)[::2] > LONGEST_PAUSE, STANDS, _pause_kinds(kind))
    moved, distance = np.diff(length_along(trajectory.position)), np.zeros(len(parts))
    distance[1::2], distance[-1] = moved[:-1], moved[-1]

    lasting = np.diff(edge) > INSTANT
    parts, distance, edge = parts[lasting], distance[lasting], np.append(edge[:-1][lasting], edge[-1])
    return _segments(_without_shuffling(parts, distance), edge, distance)


def _segments(parts: Index, edge: Array, gone: Array) -> tuple[Segment, ...]:
    """The runs of parts of one kind as segments.

    parts: ``(p,)`` kinds; edge: ``(p + 1,)`` their bounds [s]; gone: ``(p,)`` the distance of each [m].
    """
    return tuple(
        Segment(KINDS[parts[a]], float(edge[a]), float(edge[b]), _path_length(parts[a], gone[a:b]))
        for a, b in pairwise(_run_starts(parts))
    )


def _is_ridden(steps: Steps, rides: Array) -> Mask:
    """Mask ``(n,)`` of the rows that lie within a ride."""
    begins, ends = (steps.time - steps.duration)[:, None], steps.time[:, None]
    return np.any((begins >= rides[:, 0] - INSTANT) & (ends <= rides[:, 1] + INSTANT), axis=1)


def _pause_kinds(kind: Index) -> Index:
    """Kind ``(n + 1,)`` of the short pauses before each row and after the last: walking if a step is beside it."""
    if not len(kind):
        return np.array([STANDS])
    before, after = np.append(kind[0], kind), np.append(kind, kind[-1])
    return np.where((before == WALKS) | (after == WALKS), WALKS, before)


def _without_shuffling(parts: Index, distance: Array) -> Index:
    """The parts, with fewer than MIN_STEPS between two pauses as standing."""
    parts, edge = parts.copy(), _run_starts(parts)
    for a, b in pairwise(edge):
        around = {parts[k] for k in (a - 1, b) if 0 <= k < len(parts)}
        if parts[a] == WALKS and around == {STANDS} and np.count_nonzero(distance[a:b]) < MIN_STEPS:
            parts[a:b] = STANDS
    return parts


def _run_starts(parts: Index) -> list[int]:
    """Index of the first part of each run of one kind, and the number of parts."""
    return [*np.flatnonzero(np.diff(parts, prepend=-1)).tolist(), len(parts)]


def _path_length(kind: int, gone: Array) -> float:
    return float(gone.sum()) if kind in (WALKS, RIDES) else 0.0


# Chosen by hand
RIDE_SPEED = 10.0  # [m/s] standard deviation per axis of the velocity of a ride: traffic in a town
LONGEST_BOARDING = 30.0  # [s] without steps at either end of a ride, while it is slow


def detect_rides(steps: Steps, fixes: Fixes) -> Array:
    """Start and end ``(r, 2)`` [s] of the rides of the walker of these steps, in order.

    fixes: in order of time, in a metric frame.
    """
    fixes = fixes[(fixes.time >= steps.start) & (fixes.time <= steps.end)]
    if len(fixes) < 2:
        return np.empty((0, 2))
    way, segments = follow_positions(fixes)
    fast = [s for s in segments if s.kind in (VEHICLE, GAP)]
    spans = np.reshape([(s.start, s.end) for s in fast], (-1, 2))
    far = np.array([_gap_distance(way, s) if s.kind == GAP else s.distance for s in fast])
    # shortest ride [m]
    spans = spans[far > np.maximum(_reach_of_steps(steps, spans) + FIXES.within * _largest_sigma(fixes, spans), 150.0)]
    return _extended_to_steps(steps, _without_walks(_merge_rides(steps, spans), _confirmed_walks(steps, way)))


def with_stated_rides(rides: Array, steps: Steps, stated: Sequence[StatedActivity]) -> Array:
    """The rides ``(r, 2)`` [s] of a walk, with those that the person states and without times of other activities."""
    for start, end, kind in stated:
        start, end = max(start, steps.start), min(end, steps.end)
        if start >= end:
            continue
        before, after = np.minimum(rides, start), np.maximum(rides, end)
        rides = np.concatenate([before, after])
        rides = rides[rides[:, 1] - rides[:, 0] > INSTANT]
        if kind == VEHICLE:
            rides = np.append(rides, [[start, end]], axis=0)
        rides = rides[np.argsort(rides[:, 0])]
    return rides


def without_rides(steps: Steps, spans: Array) -> Steps:
    """The steps, with one row of length 0 and a wide sigma instead of those within each ride ``(r, 2)`` [s]."""
    if not len(spans):
        return steps
    begins, ends = steps.time - steps.duration, steps.time
    ridden = np.any((ends[:, None] > spans[:, 0] + INSTANT) & (begins[:, None] < spans[:, 1] - INSTANT), axis=1)
    long, nothing = spans[:, 1] - spans[:, 0], np.zeros(len(spans))
    rows = {
        "time": spans[:, 1],
        "duration": long,
        "length": nothing,
        "turn": nothing,
        "pause_turn": nothing,
        "sigma_length": RIDE_SPEED * long,
        "sigma_turn": np.full(len(spans), MOTION.gap_turn),
    }
    columns = {name: np.append(getattr(steps, name)[~ridden], row) for name, row in rows.items()}
    order = np.argsort(columns["time"], kind="stable")
    return replace(steps, **{name: column[order] for name, column in columns.items()})


def _gap_distance(way: Trajectory, gap: Segment) -> float:
    """Distance between the positions before and after a gap [m]."""
    begin, end = interpolate(np.array([gap.start, gap.end]), way.time, way.position)
    return float(np.hypot(*(end - begin)))


def _reach_of_steps(steps: Steps, spans: Array) -> Array:
    """Largest distance that the steps can have led in each span [m]; gaps count with a vehicle's speed."""
    length = np.where(steps.is_gap, FIXES.driven * steps.duration, steps.length)
    return FIXES.stretched * np.diff(distance_walked(steps, spans, length), axis=1)[:, 0]


def _largest_sigma(fixes: Fixes, spans: Array) -> Array:
    """The largest sigma of the fixes in each span [m]."""
    first = np.searchsorted(fixes.time, spans[:, 0])
    after = np.searchsorted(fixes.time, spans[:, 1], side="right")
    return np.array([fixes.sigma[a:b].max(initial=0.0) for a, b in zip(first, after, strict=True)])


def _merge_rides(steps: Steps, spans: Array) -> Array:
    """The spans, merged where the walker does not leave the place of a stop between them."""
    if len(spans) < 2:
        return spans
    leave, board = spans[:-1, 1], spans[1:, 0]
    # farthest at stop [m]: walked during such a stop
    apart = (board - leave > 600.0) | (  # longest stop [s] between two parts of one ride: a jam, a bus stop, a platform
        distance_walked(steps, board) - distance_walked(steps, leave) > 30.0
    )
    return np.column_stack([spans[np.append(True, apart), 0], spans[np.append(apart, True), 1]])


def _confirmed_walks(steps: Steps, way: Trajectory) -> Array:
    """Start and end ``(b, 2)`` [s] of the bouts of walking that lead as far as the positions move."""
    begins, ends = steps.time - steps.duration, steps.time
    first = np.flatnonzero(np.append(np.inf, begins[1:] - ends[:-1])[: len(steps)] > LONGEST_PAUSE)
    after = np.append(first[1:], len(steps))[: len(first)]
    bouts = np.column_stack([begins[first], ends[after - 1]])
    gone = np.diff(np.interp(bouts, way.time, length_along(way.position)), axis=1)[:, 0]
    led = np.diff(distance_walked(steps, bouts), axis=1)[:, 0]
    # least steps between rides of a walk that separates two rides
    return bouts[(gone < FIXES.stretched * led) & (led < FIXES.stretched * gone) & (after - first >= 30)]


def _without_walks(spans: Array, walks: Array) -> Array:
    """The spans, split at the walks within them (from one bus to the next)."""
    inside = (walks[:, 0] > spans[:, :1]) & (walks[:, 1] < spans[:, 1:])
    return np.sort(np.append(spans, walks[inside.any(axis=0)])).reshape(-1, 2)


def _extended_to_steps(steps: Steps, spans: Array) -> Array:
    """The spans, extended to the steps before and after, by LONGEST_BOARDING at most."""
    ends, begins = np.append(steps.start, steps.time), np.append(steps.time - steps.duration, steps.end)
    last = ends[np.searchsorted(ends, spans[:, 0], side="right") - 1]
    next_ = begins[np.minimum(np.searchsorted(begins, spans[:, 1]), len(begins) - 1)]
    return np.column_stack(
        [np.maximum(last, spans[:, 0] - LONGEST_BOARDING), np.minimum(next_, spans[:, 1] + LONGEST_BOARDING)]
    )
