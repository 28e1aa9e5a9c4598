"""Rides within a walk: times in which the positions move farther than the steps can have led.

Positions alone do not separate a cyclist from a runner, nor a bumpy road from a pavement; steps and positions together
do. The steps of a ride are shaking: a gap takes their place, through which the fixes alone carry the walk.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdr_graph.estimation.gps_track import RIDES, Stated, way_through
from pdr_graph.gait.step_chunks import gap
from pdr_graph.geometry import distance_walked, length_along, without
from pdr_graph.priors import FIXES, RIDING
from pdr_graph.types import INSTANT, STEP_COLUMNS, Array, Fixes, Mask, Steps


def detect_rides(steps: Steps, fixes: Fixes) -> Array:
    """Start and end ``(r, 2)`` [s] of the rides of the walker of these steps, in order.

    fixes: in order of time, in a metric frame.
    """
    fixes = fixes[(fixes.time >= steps.start) & (fixes.time <= steps.end)]
    if len(fixes) < 2:
        return np.empty((0, 2))
    way = way_through(fixes, [(fixes.time[0], fixes.time[-1], RIDES)])
    time, place = way.trajectory.time, way.trajectory.position
    along = length_along(place)

    # Times in which the positions move farther than the steps can have led, and not by one jump of a receiver
    length = np.where(steps.is_gap, FIXES.driven * steps.duration, steps.length)
    moved, reach = np.diff(along), FIXES.stretched * np.diff(distance_walked(steps, time, length))
    excess, noise = moved - reach - RIDING.slowest * np.diff(time), FIXES.outlier * float(np.median(fixes.sigma))
    rows = largest_sums(excess, max(noise, RIDING.gradual))
    score, jump = (np.array([of(excess[a:b]) for a, b in rows]) for of in (np.sum, np.max))
    rides = (score > max(noise, RIDING.shortest)) | (score - jump > max(noise, RIDING.gradual))
    spans = time[np.array(rows, dtype=np.intp).reshape(-1, 2)[rides.astype(bool)]]

    # One ride where the walker does not leave the place of a stop
    if len(spans) > 1:
        leave, board = spans[:-1, 1], spans[1:, 0]
        walked = distance_walked(steps, board) - distance_walked(steps, leave)
        apart = (board - leave > RIDING.longest_stop) | (walked > RIDING.at_stop)
        spans = np.column_stack([spans[np.append(True, apart), 0], spans[np.append(apart, True), 1]])

    # Rides without the bouts of walking that lead as far as the positions move: between two buses, or at either end
    begins, ends = steps.time - steps.duration, steps.time
    first = np.flatnonzero(np.append(np.inf, begins[1:] - ends[:-1])[: len(steps)] > RIDING.pause)
    after = np.append(first[1:], len(steps))[: len(first)]
    walks = np.column_stack([begins[first], ends[after - 1]])
    gone, led = (
        np.diff(np.interp(walks, time, along), axis=1)[:, 0],
        np.diff(distance_walked(steps, walks), axis=1)[:, 0],
    )
    agrees = (gone < FIXES.stretched * led) & (led < FIXES.stretched * gone)
    walks = walks[agrees & (after - first >= RIDING.fewest_steps)]
    spans = np.array([part for span in spans for part in without(span, walks)]).reshape(-1, 2)
    spans = spans[np.diff(np.interp(spans, time, along), axis=1)[:, 0] > RIDING.gradual]

    # Extended to the steps before and after
    ends, begins = np.append(steps.start, steps.time), np.append(begins, steps.end)
    last = ends[np.searchsorted(ends, spans[:, 0], side="right") - 1]
    next_ = begins[np.minimum(np.searchsorted(begins, spans[:, 1]), len(begins) - 1)]
    return np.column_stack(
        [np.maximum(last, spans[:, 0] - RIDING.boarding), np.minimum(next_, spans[:, 1] + RIDING.boarding)]
    )


def largest_sums(values: Array, least: float) -> list[tuple[int, int]]:
    """The parts of values ``(n,)`` that have the largest sums, disjoint, above ``least``: their bounds, in order."""
    total = np.append(0.0, np.cumsum(values))
    rise = total - np.minimum.accumulate(total)
    end = int(np.argmax(rise))
    if rise[end] <= least:
        return []
    begin = int(np.argmin(total[:end]))
    after = [(a + end, b + end) for a, b in largest_sums(values[end:], least)]
    return [*largest_sums(values[:begin], least), (begin, end), *after]


def with_stated_rides(rides: Array, steps: Steps, stated: Stated) -> Array:
    """The rides ``(r, 2)`` [s] of a walk, with those that are stated and without times of other stated modes."""
    for start, end, kind in stated:
        start, end = max(start, steps.start), min(end, steps.end)
        if start >= end:
            continue
        before, after = np.minimum(rides, start), np.maximum(rides, end)
        rides = np.concatenate([before, after])
        rides = rides[rides[:, 1] - rides[:, 0] > INSTANT]
        if kind == RIDES:
            rides = np.append(rides, [[start, end]], axis=0)
        rides = rides[np.argsort(rides[:, 0])]
    return rides


def ridden(begins: Array, ends: Array, rides: Array) -> Mask:
    """True for times from ``begins (n,)`` to ``ends (n,)`` [s] that are in part within one of the rides ``(r, 2)``."""
    return np.any((ends[:, None] > rides[:, 0] + INSTANT) & (begins[:, None] < rides[:, 1] - INSTANT), axis=1)


def without_rides(steps: Steps, rides: Array, fixes: Fixes) -> Steps:
    """The steps, with a gap instead of those within each ride ``(r, 2)`` [s], a row to each fix in it."""
    if not len(rides):
        return steps
    walked = ~ridden(steps.time - steps.duration, steps.time, rides)
    gaps = [gap(start, end, speed=RIDING.speed, rows=fixes.time) for start, end in rides.tolist()]
    columns = {
        name: np.concatenate([getattr(steps, name)[walked], *(getattr(ride, name) for ride in gaps)])
        for name in STEP_COLUMNS
    }
    order = np.argsort(columns["time"], kind="stable")
    return replace(steps, **{name: column[order] for name, column in columns.items()})
