"""Activities of an outing, by steps or by positions alone: walking, standing, rides and gaps.

Positions alone tell vehicles from walkers, and the jumps of a receiver from both (`follow_positions`); but runners from
cyclists, and a bumpy road from a pavement, steps and positions tell together: a ride within a walk is where positions
tell of a way that the steps beside them cannot have led.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from pdr_graph.estimation.factors.fixes import DRIVEN, STRETCHED, WITHIN
from pdr_graph.estimation.gps_track import LOST, way_through
from pdr_graph.estimation.transport_mode import RIDES, STANDS, WALKS
from pdr_graph.gait.steps import GAP_SIGMA_TURN
from pdr_graph.geometry import distance_walked, interpolate, length_along
from pdr_graph.lifelog.day import GAP, KINDS, VEHICLE, Segment
from pdr_graph.types import INSTANT, Array, Fixes, Index, Mask, Steps, Trajectory

# A bout of walking ends with a rest of 3 s and has two strides of either foot at least (Kluge et al., "Consensus based
# framework for digital mobility monitoring", PLOS ONE 16(8), 2021); a detector may miss the first and the last step
PAUSE = 5.0  # [s]
FEWEST = 4  # steps: fewer between two pauses are shuffling


def follow_positions(fixes: Fixes) -> tuple[Trajectory, tuple[Segment, ...]]:
    """The way through positions alone, as of `way_through`, and its segments from the first fix to the last."""
    way = way_through(fixes)
    gone = np.diff(length_along(way.trajectory.position))
    return way.trajectory, _segments(way.kind, way.trajectory.time, gone)


def segments_of(steps: Steps, trajectory: Trajectory, rides: Array) -> tuple[Segment, ...]:
    """The segments from ``steps.start`` to ``steps.end``.

    trajectory: of these steps, with rows as of `row_times`: what was walked or ridden is as long as the way in it.
    rides: ``(r, 2)`` from when to when [s], in ``steps`` a row each (`without_rides`).
    """
    kind = np.where(steps.is_gap, LOST, WALKS)
    kind[_within(steps, rides)] = RIDES

    # Before every row and after the last one a pause, which may be none
    edge = np.column_stack([steps.time - steps.duration, steps.time]).ravel()
    edge = np.concatenate([[steps.start], edge, [steps.end]])
    parts = np.full(len(edge) - 1, STANDS)
    parts[1::2] = kind
    parts[::2] = np.where(np.diff(edge)[::2] > PAUSE, STANDS, _between(kind))
    moved, distance = np.diff(length_along(trajectory.position)), np.zeros(len(parts))
    distance[1::2], distance[-1] = moved[:-1], moved[-1]

    lasting = np.diff(edge) > INSTANT
    parts, distance, edge = parts[lasting], distance[lasting], np.append(edge[:-1][lasting], edge[-1])
    return _segments(_without_shuffling(parts, distance), edge, distance)


def _segments(parts: Index, edge: Array, gone: Array) -> tuple[Segment, ...]:
    """Runs of parts ``(p,)`` of one kind; from edge to edge ``(p + 1,)`` [s] each has gone so far [m]."""
    return tuple(
        Segment(KINDS[parts[a]], float(edge[a]), float(edge[b]), _distance(parts[a], gone[a:b]))
        for a, b in pairwise(_changes(parts))
    )


def _within(steps: Steps, rides: Array) -> Mask:
    """Which rows ``(n,)`` lie within a ride."""
    begins, ends = (steps.time - steps.duration)[:, None], steps.time[:, None]
    return np.any((begins >= rides[:, 0] - INSTANT) & (ends <= rides[:, 1] + INSTANT), axis=1)


def _between(kind: Index) -> Index:
    """What short pauses before each row and after the last one are part of ``(n + 1,)``: of a walk, if one is near."""
    if not len(kind):
        return np.array([STANDS])
    before, after = np.append(kind[0], kind), np.append(kind, kind[-1])
    return np.where((before == WALKS) | (after == WALKS), WALKS, before)


def _without_shuffling(parts: Index, distance: Array) -> Index:
    """The parts, with a few steps between two pauses as a part of these."""
    parts, edge = parts.copy(), _changes(parts)
    for a, b in pairwise(edge):
        around = {parts[k] for k in (a - 1, b) if 0 <= k < len(parts)}
        if parts[a] == WALKS and around == {STANDS} and np.count_nonzero(distance[a:b]) < FEWEST:
            parts[a:b] = STANDS
    return parts


def _changes(parts: Index) -> list[int]:
    """Where runs of one kind begin, and the end."""
    return [*np.flatnonzero(np.diff(parts, prepend=-1)).tolist(), len(parts)]


def _distance(kind: int, gone: Array) -> float:
    return float(gone.sum()) if kind in (WALKS, RIDES) else 0.0


SPEED = 10.0  # [m/s] standard deviation per axis of where a ride takes them: traffic in a town
SHORTEST = 150.0  # [m] that someone rides
BOARDING = 30.0  # [s] at either end of a ride in which nobody steps, and it begins or has ended slowly
CHANGING = 30  # steps at least of a walk between two rides
STOP, STEPPED = 600.0, 30.0  # [s] and [m] walked at most between two rides that are one: a jam, a bus stop, a platform


def rides(steps: Steps, fixes: Fixes) -> Array:
    """From when to when ``(r, 2)`` [s] the walker of these steps rode, in order.

    fixes: in order of time, in a metric frame.
    """
    fixes = fixes[(fixes.time >= steps.start) & (fixes.time <= steps.end)]
    if len(fixes) < 2:
        return np.empty((0, 2))
    way, segments = follow_positions(fixes)
    fast = [s for s in segments if s.kind in (VEHICLE, GAP)]
    spans = np.reshape([(s.start, s.end) for s in fast], (-1, 2))
    far = np.array([_crossed(way, s) if s.kind == GAP else s.distance for s in fast])
    spans = spans[far > np.maximum(_led(steps, spans) + WITHIN * _worst(fixes, spans), SHORTEST)]
    return _boarded(steps, _without_walks(_joined(steps, spans), _explained(steps, way)))


def without_rides(steps: Steps, spans: Array) -> Steps:
    """The steps, with one row of length 0 for each span ``(r, 2)`` [s] and none in it: who rides goes anywhere."""
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
        "sigma_length": SPEED * long,
        "sigma_turn": np.full(len(spans), GAP_SIGMA_TURN),
    }
    columns = {name: np.append(getattr(steps, name)[~ridden], row) for name, row in rows.items()}
    order = np.argsort(columns["time"], kind="stable")
    return replace(steps, **{name: column[order] for name, column in columns.items()})


def _crossed(way: Trajectory, gap: Segment) -> float:
    """How far from where a gap began it ended. [m]"""
    begin, end = interpolate(np.array([gap.start, gap.end]), way.time, way.position)
    return float(np.hypot(*(end - begin)))


def _led(steps: Steps, spans: Array) -> Array:
    """How far the steps may have led in each span [m]: anywhere while the recording has a gap."""
    length = np.where(steps.is_gap, DRIVEN * steps.duration, steps.length)
    return STRETCHED * np.diff(distance_walked(steps, spans, length), axis=1)[:, 0]


def _worst(fixes: Fixes, spans: Array) -> Array:
    """The largest sigma of the fixes in each span. [m]"""
    first = np.searchsorted(fixes.time, spans[:, 0])
    after = np.searchsorted(fixes.time, spans[:, 1], side="right")
    return np.array([fixes.sigma[a:b].max(initial=0.0) for a, b in zip(first, after, strict=True)])


def _joined(steps: Steps, spans: Array) -> Array:
    """The spans, with those joined between which nobody walks anywhere."""
    if len(spans) < 2:
        return spans
    leave, board = spans[:-1, 1], spans[1:, 0]
    apart = (board - leave > STOP) | (distance_walked(steps, board) - distance_walked(steps, leave) > STEPPED)
    return np.column_stack([spans[np.append(True, apart), 0], spans[np.append(apart, True), 1]])


def _explained(steps: Steps, way: Trajectory) -> Array:
    """Bouts of walking ``(b, 2)`` [s] that lead as far as the positions went."""
    begins, ends = steps.time - steps.duration, steps.time
    first = np.flatnonzero(np.append(np.inf, begins[1:] - ends[:-1])[: len(steps)] > PAUSE)
    after = np.append(first[1:], len(steps))[: len(first)]
    bouts = np.column_stack([begins[first], ends[after - 1]])
    gone = np.diff(np.interp(bouts, way.time, length_along(way.position)), axis=1)[:, 0]
    led = np.diff(distance_walked(steps, bouts), axis=1)[:, 0]
    return bouts[(gone < STRETCHED * led) & (led < STRETCHED * gone) & (after - first >= CHANGING)]


def _without_walks(spans: Array, walks: Array) -> Array:
    """The spans, without the walks within them: from one bus to the next."""
    inside = (walks[:, 0] > spans[:, :1]) & (walks[:, 1] < spans[:, 1:])
    return np.sort(np.append(spans, walks[inside.any(axis=0)])).reshape(-1, 2)


def _boarded(steps: Steps, spans: Array) -> Array:
    """The spans, each from the last step before it to the first after it where these are near."""
    ends, begins = np.append(steps.start, steps.time), np.append(steps.time - steps.duration, steps.end)
    last = ends[np.searchsorted(ends, spans[:, 0], side="right") - 1]
    next_ = begins[np.minimum(np.searchsorted(begins, spans[:, 1]), len(begins) - 1)]
    return np.column_stack([np.maximum(last, spans[:, 0] - BOARDING), np.minimum(next_, spans[:, 1] + BOARDING)])
