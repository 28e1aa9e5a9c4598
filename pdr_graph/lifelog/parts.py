"""Parts of an outing's trajectory: what nobody recorded between them is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pdr_graph.geometry import interpolate, length_along, nearest, wrap_angle
from pdr_graph.lifelog.day import GAP, Outing, Segment, Stay
from pdr_graph.types import INSTANT, Array, Trajectory

PRIVATE = "private"  # kind of a segment that an export leaves out at its user's wish
UNSEEN = (GAP, PRIVATE)
Timed = TypeVar("Timed", Segment, Stay)


@dataclass(frozen=True)
class Part:
    """A part of an outing as it is shown; all times are Unix times."""

    start: float
    end: float
    track: Trajectory
    segments: tuple[Segment, ...]
    stays: tuple[Stay, ...]


def later(what: Timed, by: float) -> Timed:
    """The same, so much later [s]."""
    return replace(what, start=what.start + by, end=what.end + by)


def stretches(outing: Outing) -> list[tuple[Trajectory, tuple[Segment, ...]]]:
    """The rows of each time that was recorded without a break, with the segments it is made of."""
    found: list[list[Segment]] = [[]]
    for segment in outing.segments:
        if segment.kind == PRIVATE:  # what is blurred has rows too
            found += [[segment], []]
        elif segment.kind == GAP:
            found.append([])
        else:
            found[-1].append(segment)
    runs = [(_rows_of(outing.trajectory, segments), tuple(segments)) for segments in found if segments]
    return [(track, segments) for track, segments in runs if len(track)]


def recorded(outing: Outing) -> Trajectory:
    """The rows of a trajectory but for those that bridge gaps, which nobody saw."""
    track = outing.trajectory
    bridge = np.zeros(len(track), dtype=bool)
    for gap in (segment for segment in outing.segments if segment.kind == GAP):
        bridge |= (track.time > gap.start + INSTANT) & (track.time < gap.end - INSTANT)
    return track[~bridge] if bridge.any() else track


def _rows_of(track: Trajectory, segments: Sequence[Segment]) -> Trajectory:
    """Those of neighbouring segments; a private one has none of its neighbours'."""
    inside = 2 * INSTANT if segments[0].kind == PRIVATE else 0.0
    return within(track, segments[0].start + inside, segments[-1].end - inside)


def within(track: Trajectory, start: float, end: float) -> Trajectory:
    """The rows from ``start`` to ``end`` [s], both included."""
    first, last = np.searchsorted(track.time, [start - INSTANT, end + INSTANT])
    return track[int(first) : int(last)]


def part(track: Trajectory, start: float, end: float) -> Trajectory:
    """A trajectory from ``start`` to ``end`` [s], or from where it begins to where it ends, with a row at both."""
    start, end = max(start, float(track.time[0])), min(end, float(track.time[-1]))
    between = track.time[(track.time > start + INSTANT) & (track.time < end - INSTANT)]
    return at(track, np.unique([start, *between, end])) if start <= end else track[:0]


def at(track: Trajectory, time: Array) -> Trajectory:
    """A trajectory at some times ``(m,)``: linear between rows, with the heading and floor of the nearest."""
    near = nearest(track.time, time)
    covariance = track.covariance
    if covariance is not None:
        covariance = interpolate(time, track.time, covariance.reshape(len(track), 9)).reshape(-1, 3, 3)
    floor = tuple(track.floor[i] for i in near)
    position = interpolate(time, track.time, track.position)
    return Trajectory(time, position, wrap_angle(track.heading[near]), floor, covariance)


def shares(track: Trajectory, time: Sequence[float]) -> Array:
    """Shares ``(m - 1,)`` of the way from the first to the last of times ``(m,)``, as a trajectory's line has it."""
    way = np.interp(time, track.time, length_along(track.position))
    way = way if way[-1] > way[0] else np.asarray(time)
    return np.diff(way) / (way[-1] - way[0])


def floors_along(track: Trajectory) -> tuple[str, ...]:
    """The floors that are known of a trajectory, one after the other."""
    known = [label for label in track.floor if label]
    return tuple(label for label, before in zip(known, ["", *known], strict=False) if label != before)


def sigma(covariance: Array) -> Array:
    """Standard deviation per axis ``(n,)`` [m] of covariances ``(n, 2, 2)`` or larger: the mean of both axes'."""
    return np.sqrt((covariance[..., 0, 0] + covariance[..., 1, 1]) / 2)
