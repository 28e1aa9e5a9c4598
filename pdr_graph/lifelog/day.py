"""Data types of a lifelog (day, outing, segment, stay), and slices of trajectories.

Times are seconds from an outing's ``epoch``, positions metres in its frame. A slice ends where a gap begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pdr_graph.errors import count
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Profile
from pdr_graph.geometry import interpolate, length_along, nearest, wrap_angle
from pdr_graph.types import INSTANT, Array, OneLineRepr, Trajectory, time_span

WALKING, STANDING, VEHICLE, GAP = "walking", "standing", "vehicle", "gap"
KINDS = (STANDING, WALKING, VEHICLE, GAP)  # in the order of the numbers in `estimation.gps_track`


@dataclass(frozen=True)
class Segment(OneLineRepr):
    """A part of an outing with one activity; segments are contiguous.

    kind: one of KINDS; a gap has no data. start, end: [s]. distance: along the path [m], 0 for standing and for gaps
    (unknown).
    """

    kind: str
    start: float
    end: float
    distance: float

    def _summary(self) -> list[str]:
        return [self.kind, f"{self.start:.1f} to {self.end:.1f} s", f"{self.distance:.0f} m"]


@dataclass(frozen=True)
class Stay(OneLineRepr):
    """A time at one place, or a slow pass by it.

    start, end: [s]; passing: True for a slow pass; position ``(2,)`` [m] with its covariance ``(2, 2)`` [m²]; heading:
    direction that the person faced [rad], NaN if unknown; floor: the plan's label, empty if unknown.
    facing: (name, probability) of the places that the person may have faced, most probable first; the remainder to 1
    is the probability of no named place. Empty without a plan.
    """

    start: float
    end: float
    passing: bool
    position: Array
    covariance: Array
    heading: float
    floor: str
    facing: tuple[tuple[str, float], ...] = ()

    def _summary(self) -> list[str]:
        x, y = self.position.tolist()
        names = [f"{self.facing[0][0]!r} {self.facing[0][1]:.0%}"] if self.facing else []
        kind = ["passing"] if self.passing else []
        return [*kind, f"{self.start:.1f} to {self.end:.1f} s", f"x {x:.1f} m, y {y:.1f} m", *names]


@dataclass(frozen=True)
class Outing(OneLineRepr):
    """One walk or ride of a person: consecutive recordings in one frame.

    recordings: content hashes, in order; source: name in messages; epoch: Unix time at 0 [s].
    frame: of all positions; plan: path of the floor plan, "" without one.
    trajectory: with covariance, as in ``Estimate``; segments: cover its whole duration; stays: in time order.
    steps: number of steps. notes: warnings, missing: results that could not be estimated, a line each.
    """

    recordings: tuple[str, ...]
    source: str
    epoch: float
    frame: Frame
    plan: str
    trajectory: Trajectory
    segments: tuple[Segment, ...]
    stays: tuple[Stay, ...]
    steps: int
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    def _summary(self) -> list[str]:
        parts = [count(len(self.segments), "segment"), count(len(self.stays), "stay"), count(self.steps, "step")]
        return [repr(self.source), *time_span(self.trajectory), *parts]


@dataclass(frozen=True)
class Day(OneLineRepr):
    """The outings of a person that began on one date.

    date: "2024-05-01", in the lifelog's time zone; profile: of the walker at the end of the day, None if unknown.
    """

    person: str
    date: str
    outings: tuple[Outing, ...]
    profile: Profile | None = None

    def _summary(self) -> list[str]:
        return [repr(self.person), self.date, count(len(self.outings), "outing")]

    def total(self, kind: str) -> tuple[float, float]:
        """Total time [s] and distance [m] of all segments of one kind."""
        own = [s for outing in self.outings for s in outing.segments if s.kind == kind]
        return float(np.sum([s.end - s.start for s in own])), float(np.sum([s.distance for s in own]))


PRIVATE = "private"  # kind of a segment that is hidden in an export
KINDS_WITHOUT_DATA = (GAP, PRIVATE)
Timed = TypeVar("Timed", Segment, Stay)


@dataclass(frozen=True)
class ExportedPart(OneLineRepr):
    """A part of an outing as it is exported; all times are Unix times [s]."""

    start: float
    end: float
    track: Trajectory
    segments: tuple[Segment, ...]
    stays: tuple[Stay, ...]

    def _summary(self) -> list[str]:
        return [f"{self.start:.1f} to {self.end:.1f} s", repr(self.track)]


def shift(item: Timed, by: float) -> Timed:
    """The segment or stay ``by`` seconds later."""
    return replace(item, start=item.start + by, end=item.end + by)


def split_at_gaps(outing: Outing) -> list[tuple[Trajectory, tuple[Segment, ...]]]:
    """Split an outing at its gaps: the rows and segments of each part without a gap."""
    found: list[list[Segment]] = [[]]
    for segment in outing.segments:
        if segment.kind == PRIVATE:  # a blurred part has rows too
            found += [[segment], []]
        elif segment.kind == GAP:
            found.append([])
        else:
            found[-1].append(segment)
    parts = [(_rows_of(outing.trajectory, segments), tuple(segments)) for segments in found if segments]
    return [(track, segments) for track, segments in parts if len(track)]


def without_gap_rows(outing: Outing) -> Trajectory:
    """The rows of an outing's trajectory, without those inside gaps."""
    track = outing.trajectory
    bridge = np.zeros(len(track), dtype=bool)
    for gap in (segment for segment in outing.segments if segment.kind == GAP):
        bridge |= (track.time > gap.start + INSTANT) & (track.time < gap.end - INSTANT)
    return track[~bridge] if bridge.any() else track


def _rows_of(track: Trajectory, segments: Sequence[Segment]) -> Trajectory:
    """Rows of consecutive segments; a private segment shares no row with its neighbours."""
    inside = 2 * INSTANT if segments[0].kind == PRIVATE else 0.0
    return rows_between(track, segments[0].start + inside, segments[-1].end - inside)


def rows_between(track: Trajectory, start: float, end: float) -> Trajectory:
    """Rows from ``start`` to ``end`` [s], both included."""
    first, last = np.searchsorted(track.time, [start - INSTANT, end + INSTANT])
    return track[int(first) : int(last)]


def clipped(track: Trajectory, start: float, end: float) -> Trajectory:
    """Clip a trajectory to ``start`` to ``end`` [s], with interpolated rows at both."""
    start, end = max(start, float(track.time[0])), min(end, float(track.time[-1]))
    between = track.time[(track.time > start + INSTANT) & (track.time < end - INSTANT)]
    return sampled(track, np.unique([start, *between, end])) if start <= end else track[:0]


def sampled(track: Trajectory, time: Array) -> Trajectory:
    """Sample a trajectory at times ``(m,)`` [s]: linear between rows, heading and floor of the nearest row."""
    near = nearest(track.time, time)
    covariance = track.covariance
    if covariance is not None:
        covariance = interpolate(time, track.time, covariance.reshape(len(track), 9)).reshape(-1, 3, 3)
    floor = tuple(track.floor[i] for i in near)
    position = interpolate(time, track.time, track.position)
    return Trajectory(time, position, wrap_angle(track.heading[near]), floor, covariance)


def path_shares(track: Trajectory, time: Sequence[float]) -> Array:
    """Shares ``(m - 1,)`` of the path length in each interval between times ``(m,)`` [s], summing to 1."""
    way = np.interp(time, track.time, length_along(track.position))
    way = way if way[-1] > way[0] else np.asarray(time)
    return np.diff(way) / (way[-1] - way[0])


def floors_visited(track: Trajectory) -> tuple[str, ...]:
    """Labels of the floors visited, in order, without unknown ones and immediate repetitions."""
    known = [label for label in track.floor if label]
    return tuple(label for label, before in zip(known, ["", *known], strict=False) if label != before)
