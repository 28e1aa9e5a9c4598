"""Visits: times at one place, from the halts and silences of the person's track.

Stay points as in Li et al., "Mining user similarity based on location history", ACM GIS 2008: a time within a radius of
a place. Two differences: the place is the mean of the halts on the smoothed track, not the first fix; and a silence
joins the halts before and after it where nobody can have gone far meanwhile. What is joined so is counted as not
observed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdr_graph.lifelog.day import GAP, STANDING, Outing, without_gap_rows
from pdr_graph.lifelog.timeline import STAY, TimelineEntry, duration_text
from pdr_graph.types import Array, Mask, OneLineRepr

# The usual stay points have 100 to 200 m and 5 to 30 min; the others were chosen by hand
VISIT_RADIUS = 100.0  # [m] of a place
SHORTEST_VISIT = 300.0  # [s]
EDGE_RADIUS = 50.0  # [m] about the place: walking there belongs to the visit
LONGEST_SILENCE = 18 * 3600.0  # [s] that a visit bridges: a night and a long morning
SURE = 20.0  # [m] per axis: a halt this certain counts half as much as an exact one for the middle of a visit


@dataclass(frozen=True)
class Track:
    """Where a person was, over all outings that are georeferenced.

    time ``(n,)`` Unix times [s], in order; lonlat ``(n, 2)`` [deg]; sphere ``(n, 3)`` the same on a sphere [m]; along
    ``(n,)`` length of the path so far [m]; plan ``(n,)`` True on a floor plan.
    """

    time: Array
    lonlat: Array
    sphere: Array
    along: Array
    plan: Mask

    @classmethod
    def of(cls, outings: Sequence[Outing]) -> Track:
        """Construct from outings; those that are not georeferenced are left out."""
        parts = [(outing, without_gap_rows(outing)) for outing in outings if outing.frame.georeferenced]
        parts = [(outing, rows) for outing, rows in parts if len(rows)]
        time = np.concatenate([np.empty(0), *(rows.time + outing.epoch for outing, rows in parts)])
        lonlat = np.concatenate([np.empty((0, 2)), *(o.frame.to_lonlat(rows.position) for o, rows in parts)])
        plan = np.repeat([bool(o.plan) for o, _ in parts], [len(rows) for _, rows in parts]).astype(bool)
        return cls._of_columns(time, lonlat, plan)

    @classmethod
    def concatenate(cls, tracks: Sequence[Track]) -> Track:
        """One track of several."""
        time = np.concatenate([np.empty(0), *(track.time for track in tracks)])
        lonlat = np.concatenate([np.empty((0, 2)), *(track.lonlat for track in tracks)])
        return cls._of_columns(time, lonlat, np.concatenate([np.empty(0, bool), *(track.plan for track in tracks)]))

    @classmethod
    def _of_columns(cls, time: Array, lonlat: Array, plan: Mask) -> Track:
        order = np.argsort(time, kind="stable")
        sphere = on_sphere(lonlat[order])
        moved = np.linalg.norm(np.diff(sphere, axis=0, prepend=sphere[:1]), axis=1)
        return cls(time[order], lonlat[order], sphere, np.cumsum(moved), plan[order])

    def between(self, start: float, end: float) -> slice:
        """The rows from `start` to `end`, both included."""
        first, last = np.searchsorted(self.time, [start - 1e-3, end + 1e-3]).tolist()
        return slice(first, last)

    def length(self, start: float, end: float) -> float:
        """Length of the path from `start` to `end` [m], with straight lines over silences."""
        if not len(self.time):
            return 0.0
        first, last = np.interp([start, end], self.time, self.along)
        return float(last - first)


def on_sphere(lonlat: Array) -> Array:
    """Points ``(n, 3)`` on a sphere [m] of longitudes and latitudes ``(n, 2)`` [deg]; distances are chords."""
    lon, lat = np.radians(lonlat).T
    # earth radius [m] of a sphere: distances within a place need no ellipsoid
    return 6_371_000.0 * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)


def lonlat_of(point: Array) -> tuple[float, float]:
    """Longitude and latitude [deg] of a point ``(3,)`` on the sphere, or inside it."""
    x, y, z = (point / np.linalg.norm(point)).tolist()
    return float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arcsin(z)))


@dataclass(frozen=True)
class Visit(OneLineRepr):
    """A time at one place. start, end: Unix times [s]; middle ``(3,)`` on the sphere [m], NaN if unknown.

    sigma: standard deviation per axis of the place [m]; observed: share of the time with data; name: on the plan, "" if
    it has none.
    """

    start: float
    end: float
    middle: Array
    sigma: float
    observed: float = 1.0
    name: str = ""

    @property
    def duration(self) -> float:
        """Its duration [s]."""
        return self.end - self.start

    def _summary(self) -> list[str]:
        return [*filter(None, [self.name]), duration_text(self.duration), f"± {self.sigma:.0f} m"]


def visits_of(entries: Sequence[TimelineEntry], track: Track) -> list[Visit]:
    """The visits of a person, in time order. entries: of the fine timeline; track: of the same outings."""
    found: list[Visit] = []
    for halt in _halts(entries, track):
        if found and _is_one_place(found[-1], halt, track):
            found[-1] = _joined(found[-1], halt)
        else:
            found.append(halt)
    limits = [-np.inf, *(visit.end for visit in found)], [*(visit.start for visit in found), np.inf]
    found = [_with_edges(visit, track, limits[0][n], limits[1][n + 1]) for n, visit in enumerate(found)]
    return [visit for visit in _without_overlap(found) if visit.duration >= SHORTEST_VISIT]


def _halts(entries: Sequence[TimelineEntry], track: Track) -> Iterator[Visit]:
    """Stands, and silences in which nobody can have gone far, as visits of any duration; none on a floor plan."""
    for entry in entries:
        rows = track.between(entry.start, entry.end)
        if entry.kind in (STAY, STANDING) and rows.stop > rows.start and not track.plan[rows].any():
            points = track.sphere[rows]
            spread = float(np.sqrt(np.mean((points - points.mean(axis=0)) ** 2) * 1.5))  # of two axes, not three
            sigma = float(np.hypot(np.nan_to_num(entry.sigma), spread))
            yield Visit(entry.start, entry.end, np.median(points, axis=0), sigma)
        elif entry.kind == GAP:
            yield from _silence(entry, track)


def _silence(gap: TimelineEntry, track: Track) -> Iterator[Visit]:
    """The visit of a silence, if its ends are near each other and nobody was on the way between them."""
    before, after = track.between(-np.inf, gap.start).stop - 1, track.between(gap.end, np.inf).start
    if before < 0 or after >= len(track.time) or track.plan[[before, after]].any():
        return
    ends, lasted = track.sphere[[before, after]], gap.end - gap.start
    if max(gap.start - track.time[before], track.time[after] - gap.end) > SHORTEST_VISIT:
        return  # something without positions was between
    apart = float(np.linalg.norm(ends[1] - ends[0]))
    # silent radius [m] between the ends of a silence at one place: receivers need minutes to find satellites
    # silent speed [m/s] between its ends at most: faster, and the person was on the way
    if apart <= min(300.0, 0.25 * lasted) and lasted <= LONGEST_SILENCE:
        yield Visit(gap.start, gap.end, ends.mean(axis=0), max(apart / 2, SURE), 0.0)


def _is_one_place(visit: Visit, halt: Visit, track: Track) -> bool:
    """True if a halt is at the place of the visit before it, and the person did not leave that place between them."""
    if np.linalg.norm(halt.middle - visit.middle) > VISIT_RADIUS + min(max(halt.sigma, visit.sigma), SURE):
        return False
    between = track.between(visit.end, halt.start)
    if np.diff([visit.end, *track.time[between], halt.start]).max() > LONGEST_SILENCE:
        return False
    off = np.linalg.norm(track.sphere[between] - visit.middle, axis=1)
    farthest = off.max(initial=0.0)
    # longest excursion [s] beyond VISIT_RADIUS that is still part of a visit: mostly an error of the receiver
    return bool(farthest <= VISIT_RADIUS or (farthest <= 2 * VISIT_RADIUS and halt.start - visit.end <= 180.0))


def _joined(visit: Visit, halt: Visit) -> Visit:
    """One visit of two, with the mean place by time and certainty."""
    weight = [v.duration / (SURE**2 + v.sigma**2) for v in (visit, halt)]
    share = weight[1] / (weight[0] + weight[1]) if weight[0] + weight[1] else 0.5
    middle = (1 - share) * visit.middle + share * halt.middle
    apart = np.linalg.norm(halt.middle - visit.middle) / 2
    variance = (1 - share) * visit.sigma**2 + share * halt.sigma**2 + share * (1 - share) * apart**2
    silent = sum((1 - v.observed) * v.duration for v in (visit, halt))
    observed = 1 - silent / max(halt.end - visit.start, 1e-9)
    return Visit(visit.start, halt.end, middle, float(np.sqrt(variance)), float(observed))


def _with_edges(visit: Visit, track: Track, earliest: float, latest: float) -> Visit:
    """The visit with the walking within EDGE_RADIUS just before and after it; earliest, latest: limits [s]."""
    first, last = track.between(visit.start, visit.end).start, track.between(visit.start, visit.end).stop - 1
    start, end = visit.start, visit.end
    while first > 0 and _is_at(visit, track, first - 1) and track.time[first - 1] > earliest:
        first -= 1
        start = float(track.time[first])
    while last + 1 < len(track.time) and _is_at(visit, track, last + 1) and track.time[last + 1] < latest:
        last += 1
        end = float(track.time[last])
    silent = (1 - visit.observed) * visit.duration
    return replace(visit, start=start, end=end, observed=1 - silent / max(end - start, 1e-9))


def _is_at(visit: Visit, track: Track, row: int) -> bool:
    off = track.sphere[row] - visit.middle
    return not track.plan[row] and bool(off @ off <= EDGE_RADIUS**2)


def _without_overlap(visits: Sequence[Visit]) -> list[Visit]:
    """The visits; one that begins before the end of the last begins there."""
    found: list[Visit] = []
    for visit in visits:
        start = max(visit.start, found[-1].end) if found else visit.start
        found += [replace(visit, start=start)] if visit.end > start else []
    return found
