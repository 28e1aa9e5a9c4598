"""What an outing was made of, by its steps or by positions alone: walking, standing, rides and gaps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pdr_graph.estimation.moves import RIDES, STANDS, WALKS
from pdr_graph.estimation.positions import LOST, way_through
from pdr_graph.geometry import length_along
from pdr_graph.lifelog.day import KINDS, Segment
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
    kind = np.where(steps.length == 0, LOST, WALKS)
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
