"""The rows of a diary from the fine entries of a timeline: visits, and the legs between them.

Visits are stay points as in Li et al., "Mining user similarity based on location history", ACM GIS 2008: a time within
a radius of a place. Two differences: the place is the mean of the halts on the smoothed track, not the first fix; and a
silence joins the halts before and after it where nobody can have gone far meanwhile. What is joined so is counted as
not observed.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, pairwise
from operator import itemgetter

import numpy as np

from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING, Outing, without_gap_rows
from pdr_graph.apps.lifelog.facts import (
    ACTIVITY,
    AEROPLANE,
    END,
    LEAST_RIDE_SPEED,
    SHORTEST_FLIGHT,
    SLOWEST_FLIGHT,
    VISIT,
    Guess,
)
from pdr_graph.apps.lifelog.timeline import STAY, TimelineEntry
from pdr_graph.geometry import horizontal_sigma, without
from pdr_graph.priors import TRACK, TRAVEL
from pdr_graph.types import Array, Mask

# The usual stay points have 100 to 200 m and 5 to 30 min; the others were chosen by hand
VISIT_RADIUS = 100.0  # [m] of a place
SHORTEST_VISIT = 300.0  # [s]
LONGEST_BRIDGED = TRACK.silence  # [s] that a visit bridges
SHORTEST_SILENCE = 600.0  # [s] a shorter silence on the way belongs to the walk or ride
MOVING = (WALKING, VEHICLE)
HALT_SIGMA = 20.0  # [m] per axis: such a halt counts half as much as an exact one for the middle of a visit


@dataclass(frozen=True)
class Track:
    """Where a person was, over all outings that are georeferenced.

    time ``(n,)`` Unix times [s], in order; lonlat ``(n, 2)`` [deg]; plan ``(n,)`` True on a floor plan; stepped
    ``(n,)`` True where steps were measured; sigma ``(n,)`` per axis [m].
    """

    time: Array
    lonlat: Array
    plan: Mask
    stepped: Mask
    sigma: Array

    @classmethod
    def of(cls, outings: Sequence[Outing]) -> Track:
        """Construct from outings; those that are not georeferenced are left out."""
        parts = [(outing, without_gap_rows(outing)) for outing in outings if outing.frame.georeferenced]
        columns = [
            (
                rows.time + outing.epoch,
                outing.frame.to_lonlat(rows.position),
                np.tile([bool(outing.plan), outing.steps > 0], (len(rows), 1)),
                np.zeros(len(rows)) if rows.covariance is None else horizontal_sigma(rows.covariance),
            )
            for outing, rows in parts
            if len(rows)
        ]
        return cls._of_columns(columns)

    @classmethod
    def concatenate(cls, tracks: Sequence[Track]) -> Track:
        """One track of several."""
        marks = [np.column_stack([track.plan, track.stepped]) for track in tracks]
        return cls._of_columns(
            [(track.time, track.lonlat, own, track.sigma) for track, own in zip(tracks, marks, strict=True)]
        )

    @classmethod
    def _of_columns(cls, parts: Sequence[tuple[Array, Array, Mask, Array]]) -> Track:
        """The track of parts with columns time, lonlat, plan and stepped ``(n, 2)``, and sigma, in any order."""
        nothing = np.empty(0), np.empty((0, 2)), np.empty((0, 2), bool), np.empty(0)
        time, lonlat, marks, sigma = map(np.concatenate, zip(nothing, *parts, strict=True))
        order = np.argsort(time, kind="stable")
        plan, stepped = marks[order].T
        return cls(time[order], lonlat[order], plan, stepped, sigma[order])

    @cached_property
    def sphere(self) -> Array:
        """The places ``(n, 3)`` on a sphere [m]."""
        return on_sphere(self.lonlat)

    @cached_property
    def along(self) -> Array:
        """Length ``(n,)`` of the path so far [m]."""
        return np.cumsum(arc(np.linalg.norm(np.diff(self.sphere, axis=0, prepend=self.sphere[:1]), axis=1)))

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


EARTH_RADIUS = 6_371_000.0  # [m] of a sphere: distances within a place need no ellipsoid


def arc(chord: Array) -> Array:
    """Distances along the sphere [m] of distances through it."""
    return 2 * EARTH_RADIUS * np.arcsin(np.minimum(chord / (2 * EARTH_RADIUS), 1.0))


def on_sphere(lonlat: Array) -> Array:
    """Points ``(n, 3)`` on a sphere [m] of longitudes and latitudes ``(n, 2)`` [deg]; distances are chords."""
    lon, lat = np.radians(lonlat).T
    return EARTH_RADIUS * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)


def lonlat_of(point: Array) -> tuple[float, float]:
    """Longitude and latitude [deg] of a point ``(3,)`` on the sphere, or inside it."""
    x, y, z = (point / np.linalg.norm(point)).tolist()
    return float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arcsin(z)))


@dataclass(frozen=True)
class _Halt:
    """A time at one place. start, end: Unix times [s]; middle ``(3,)`` on the sphere [m]; sigma: standard deviation per
    axis of the place [m].
    """

    start: float
    end: float
    middle: Array
    sigma: float


def visits_of(entries: Sequence[TimelineEntry], track: Track) -> list[TimelineEntry]:
    """The visits of a person, as stays without parts, in time order.

    entries: of the fine timeline; track: of the same outings.
    """
    found: list[_Halt] = []
    for halt in _halts(entries, track):
        if found and _is_one_place(found[-1], halt, track):
            found[-1] = _joined(found[-1], halt)
        else:
            found.append(halt)
    visits = list[TimelineEntry]()
    for visit in (visit for visit in found if visit.end - visit.start >= SHORTEST_VISIT):
        lon, lat = lonlat_of(visit.middle)
        visits.append(TimelineEntry(STAY, visit.start, visit.end, latitude=lat, longitude=lon, sigma=visit.sigma))
    return visits


def _halts(entries: Sequence[TimelineEntry], track: Track) -> Iterator[_Halt]:
    """Stands, and silences in which nobody can have gone far, as visits of any duration; none on a floor plan."""
    for n, entry in enumerate(entries):
        rows = track.between(entry.start, entry.end)
        if entry.kind in (STAY, STANDING) and rows.stop > rows.start and not track.plan[rows].any():
            points = track.sphere[rows]
            spread = float(np.sqrt(np.mean((points - points.mean(axis=0)) ** 2) * 1.5))  # of two axes, not three
            sigma = float(np.hypot(np.nan_to_num(entry.sigma), spread))
            ordered, half = np.sort(points, axis=0), len(points) // 2
            median = (ordered[half] + ordered[-1 - half]) / 2  # as `np.median`, which takes ten times as long
            yield _Halt(entry.start, entry.end, median, sigma)
        elif entry.kind == GAP:
            before, after = track.between(-np.inf, entry.start).stop - 1, track.between(entry.end, np.inf).start
            if before < 0 or after >= len(track.time) or track.plan[[before, after]].any():
                continue
            if max(entry.start - track.time[before], track.time[after] - entry.end) > SHORTEST_VISIT:
                continue  # something without positions was between
            ends = track.sphere[[before, after]]
            beside = [entries[k].kind if 0 <= k < len(entries) else "" for k in (n - 1, n + 1)]
            yield from _silent_halt(entry, ends, beside)


def _silent_halt(silence: TimelineEntry, ends: Array, beside: Sequence[str]) -> Iterator[_Halt]:
    """The halt in a silence, if there is one: beside a walk or ride without the time that the way to its end needs.

    ends: ``(2, 3)`` places on the sphere [m]; beside: kinds of the entries before and after.
    """
    if silence.duration > LONGEST_BRIDGED:
        return
    apart = float(np.linalg.norm(ends[1] - ends[0]))
    moving = [kind in MOVING for kind in beside]
    if moving[0] != moving[1] and not {GAP, ""} & set(beside):
        # On foot along streets, of which the ends show the straight line
        needed = apart / (TRAVEL.ride if VEHICLE in beside else TRAVEL.walk - TRAVEL.walk_spread)
        start, end = (silence.start + needed, silence.end) if moving[0] else (silence.start, silence.end - needed)
        if start < end and needed < SHORTEST_SILENCE:
            yield _Halt(start, end, ends[int(moving[0])], HALT_SIGMA)
    # silent radius [m] between the ends of a silence at one place: receivers need minutes to find satellites
    # silent speed [m/s] between its ends at most: faster, and the person was on the way
    elif apart <= min(300.0, 0.25 * silence.duration):
        yield _Halt(silence.start, silence.end, ends.mean(axis=0), max(apart / 2, HALT_SIGMA))


def _is_one_place(visit: _Halt, halt: _Halt, track: Track) -> bool:
    """True if a halt is at the place of the visit before it, and the person did not leave that place between them."""
    if np.linalg.norm(halt.middle - visit.middle) > VISIT_RADIUS + min(max(halt.sigma, visit.sigma), HALT_SIGMA):
        return False
    between = track.between(visit.end, halt.start)
    if np.diff([visit.end, *track.time[between], halt.start]).max() > LONGEST_BRIDGED:
        return False
    farthest = np.linalg.norm(track.sphere[between] - visit.middle, axis=1).max(initial=0.0)
    # longest excursion [s] beyond VISIT_RADIUS that is still part of a visit: mostly an error of the receiver
    return bool(farthest <= VISIT_RADIUS or (farthest <= 2 * VISIT_RADIUS and halt.start - visit.end <= 180.0))


def _joined(visit: _Halt, halt: _Halt) -> _Halt:
    """One visit of two, with the mean place by time and certainty."""
    weight = [(v.end - v.start) / (HALT_SIGMA**2 + v.sigma**2) for v in (visit, halt)]
    share = weight[1] / (weight[0] + weight[1]) if weight[0] + weight[1] else 0.5
    middle = (1 - share) * visit.middle + share * halt.middle
    apart = np.linalg.norm(halt.middle - visit.middle) / 2
    variance = (1 - share) * visit.sigma**2 + share * halt.sigma**2 + share * (1 - share) * apart**2
    return _Halt(visit.start, halt.end, middle, float(np.sqrt(variance)))


def rows_of(fine: Sequence[TimelineEntry], visits: Sequence[TimelineEntry], track: Track) -> list[TimelineEntry]:
    """The rows of a diary: a stay for each visit, with all entries of its time as parts, and the legs between visits.

    fine: entries of the timeline; visits and track: of the same outings. Entries on a floor plan remain.
    """
    begins = [visit.start for visit in visits]
    bounds = sorted({time for visit in visits for time in (visit.start, visit.end)})
    on_plan, on_the_way = -2, -1

    def group_of(piece: TimelineEntry) -> int:
        """Number of the visit of a piece; on_plan for one that remains as it is, on_the_way between visits."""
        middle = (piece.start + piece.end) / 2
        n = bisect_right(begins, middle) - 1
        if n >= 0 and middle < visits[n].end:
            return n
        seen = track.plan[track.between(piece.start, piece.end)]
        return on_plan if piece.kind != GAP and (not len(seen) or seen.any()) else on_the_way

    rows: list[TimelineEntry] = []
    for group, own in groupby((piece for entry in fine for piece in cut(entry, bounds, track)), key=group_of):
        parts = tuple(own)
        if group == on_plan:
            rows += parts
        elif group == on_the_way:
            rows += _legs(parts, track)
        else:
            floor = tuple(dict.fromkeys(label for part in parts for label in part.floor))
            inside = float(sum(part.distance for part in parts))
            rows.append(replace(visits[group], floor=floor, distance=inside, observed=_observed(parts), parts=parts))
    return rows


def cut(entry: TimelineEntry, times: Sequence[float], track: Track) -> list[TimelineEntry]:
    """The entry, and its parts, in pieces between some times [s]; the distance is divided by the path's length.

    times: in order, each once.
    """
    inside = times[bisect_right(times, entry.start) : bisect_left(times, entry.end)]
    if not inside:
        return [entry]
    edge = [entry.start, *inside, entry.end]
    length = np.array([track.length(a, b) for a, b in pairwise(edge)])
    share = length / length.sum() if length.sum() > 0 else np.diff(edge) / (entry.end - entry.start)
    parts = [piece for part in entry.parts for piece in cut(part, times, track)]
    found = []
    for (start, end), of in zip(pairwise(edge), share.tolist(), strict=True):
        own = tuple(part for part in parts if start <= part.start and part.end <= end)
        piece = replace(entry, start=start, end=end, distance=of * entry.distance, parts=own)
        if own:
            distance = float(sum(part.distance for part in own)) if entry.distance else 0.0
            piece = replace(piece, distance=distance, observed=_observed(own))
        found.append(piece)
    return found


def _legs(pieces: Sequence[TimelineEntry], track: Track) -> Iterator[TimelineEntry]:
    """The walks, rides and long silences between two visits, as a row each.

    A piece that makes no leg by itself belongs to the leg before it if that is a walk or a ride, else to the one after.
    """
    longest = max((p.duration for p in pieces if p.kind in MOVING), default=0.0)
    kinds = [_leg_kind(piece, longest, track) for piece in pieces]
    if not any(kinds) and all(piece.kind == GAP for piece in pieces):  # by speed: nobody saw how the person went
        start, end = pieces[0].start, pieces[-1].end
        fast = track.length(start, end) > LEAST_RIDE_SPEED * (end - start)
        kinds = [VEHICLE if fast else WALKING] * len(pieces)
    for n, piece in enumerate(pieces):  # what was recorded of a flight beside a silence
        if piece.kind == VEHICLE and piece.distance > TRACK.fastest * piece.duration:
            kinds[n] = AEROPLANE if AEROPLANE in kinds[max(n - 1, 0) : n + 2] else kinds[n]
    named = list[tuple[str, TimelineEntry]]()
    for n, piece in enumerate(pieces):
        beside = [next(filter(None, side), "") for side in (reversed(kinds[:n]), kinds[n + 1 :])]
        moving = [kind for kind in beside if kind in MOVING]
        named.append((next(filter(None, (kinds[n], *moving, *beside)), piece.kind), piece))
    for kind, own in groupby(named, key=lambda pair: pair[0]):
        parts = [piece for _, piece in own]
        if kind == AEROPLANE:
            start, end = parts[0].start, parts[-1].end
            far = track.length(start, end)
            yield TimelineEntry(VEHICLE, start, end, far, observed=_observed(parts), mode=AEROPLANE)
            continue
        if len(parts) == 1 and parts[0].kind == kind:
            yield parts[0]
            continue
        start, end, distance, observed = parts[0].start, parts[-1].end, 0.0, 1.0
        if kind != GAP:  # a short silence counts with the straight line between its ends
            for n, part in enumerate(parts):
                if part.kind == GAP:
                    length = track.length(part.start, part.end)
                    parts[n] = replace(part, kind=kind, distance=length, observed=0.0)
            distance, observed = float(sum(part.distance for part in parts)), _observed(parts)
        yield TimelineEntry(kind, start, end, distance, observed=observed, parts=tuple(parts))


def _leg_kind(piece: TimelineEntry, longest: float, track: Track) -> str:
    """Kind of the leg that a piece makes by itself; "" if it belongs to the leg beside it."""
    lasted, far = piece.duration, track.length(piece.start, piece.end) if piece.kind == GAP else 0.0
    if far > max(SHORTEST_FLIGHT, SLOWEST_FLIGHT * lasted):
        return AEROPLANE
    # shortest jump [m] over a short silence, from which a fast one is a ride
    if far > max(LEAST_RIDE_SPEED * lasted, 300.0):
        return VEHICLE if lasted < SHORTEST_SILENCE else GAP
    if piece.kind in MOVING:
        # shortest leg [s]: a shorter walk or ride beside a longer one belongs to it
        return piece.kind if lasted >= min(45.0, longest) else ""
    return GAP if piece.kind == GAP and lasted >= SHORTEST_SILENCE else ""


def _observed(parts: Sequence[TimelineEntry]) -> float:
    """Share of the time of parts with data."""
    lasted = np.array([part.duration for part in parts])
    seen = np.array([0.0 if part.kind == GAP else part.observed for part in parts])
    return float(lasted @ seen / max(lasted.sum(), 1e-9))


# Time [s] of a row by positions alone that was something else, mostly at its ends, whatever its length, and what that
# was, the likelier first: `scripts/reproduce lifelog`
OTHERWISE = {WALKING: (130.0, VEHICLE, STAY), VEHICLE: (49.0, WALKING, STAY), STAY: (330.0, WALKING, VEHICLE)}
LIKELIER = 0.6  # share of the likelier


def with_likely(rows: Sequence[TimelineEntry], track: Track) -> list[TimelineEntry]:
    """The rows with what they are at a moment of theirs, and its probability; none where steps were measured."""
    found = list[TimelineEntry]()
    for row in rows:
        here, kind = track.between(row.start, row.end), STAY if row.kind == STANDING else row.kind
        seen = row.observed == 0 or here.stop > here.start
        if kind in OTHERWISE and seen and not (track.plan[here] | track.stepped[here]).any():
            lasts, likelier, other = OTHERWISE[kind]
            wrong = lasts / (row.duration + lasts)
            likely = (kind, 1 - wrong), (likelier, LIKELIER * wrong), (other, (1 - LIKELIER) * wrong)
            row = replace(row, likely=tuple(sorted(likely, key=itemgetter(1), reverse=True)))
        found.append(row)
    return found


GUESSED_SIGMA = 75.0  # [m] per axis of a place that another program guessed; as of its processed paths
SHORTEST_GUESS = 60.0  # [s]


def with_guesses(rows: Sequence[TimelineEntry], guesses: Sequence[Guess]) -> list[TimelineEntry]:
    """The rows, with what other programs guessed where there are no data, marked as such.

    Of guesses of one time the longest counts: a visit before the visits inside it. The guess of most of a recorded stay
    is named beside it.
    """
    known = [row for row in rows if row.kind != GAP]
    taken = sorted((row.start, row.end) for row in known)  # without overlap, so in order of their ends too
    starts = np.array([guess.start for guess in guesses])
    ended = np.maximum.accumulate([guess.stop for guess in guesses])  # of all guesses up to each
    found = list[TimelineEntry]()
    for guess in sorted(
        (guess for guess in guesses if guess.kind != END),
        key=lambda guess: (guess.start - guess.stop, guess.start, guess.source),
    ):
        first = bisect_right(taken, guess.start, key=itemgetter(1))
        inside = taken[first : bisect_left(taken, guess.stop, key=itemgetter(0))]
        parts = without(np.array([guess.start, guess.stop]), np.array(inside).reshape(-1, 2))
        later = guesses[at] if (at := int(np.searchsorted(starts, guess.stop))) < len(guesses) else guess
        for start, end in parts.tolist():
            if end - start >= SHORTEST_GUESS:
                found.append(_guessed(guess, start, end, later))
                insort(taken, (start, end))
    named = list[TimelineEntry]()
    for row in known:
        first, after = np.searchsorted(ended, row.start), np.searchsorted(starts, row.end)
        kind = VISIT if row.kind == STAY else ACTIVITY if row.mode == AEROPLANE else ""
        near = guesses[int(first) : int(after)] if kind else ()
        same = [guess for guess in near if guess.kind == kind and _overlap(guess, row) > row.duration / 2]
        named.append(replace(row, guess=max(same, key=lambda g: _overlap(g, row)).text) if same else row)
    filled = list[TimelineEntry]()
    for row in sorted([*named, *found], key=lambda row: row.start):
        if filled and row.start > filled[-1].end:
            filled.append(TimelineEntry(GAP, filled[-1].end, row.start))
        filled.append(row)
    return filled


def _guessed(guess: Guess, start: float, end: float, later: Guess) -> TimelineEntry:
    """The row of a part of a guess; later: the guess after it, at the end of a way."""
    if guess.kind == VISIT:
        row = TimelineEntry(STAY, start, end, latitude=guess.latitude, longitude=guess.longitude, sigma=GUESSED_SIGMA)
        return replace(row, observed=0.0, guess=guess.text)
    ends = on_sphere(np.array([[g.longitude, g.latitude] for g in (guess, later)]))
    far = float(np.nan_to_num(np.linalg.norm(ends[1] - ends[0]))) * (end - start) / (guess.stop - guess.start)
    kind = guess.activity(far / (end - start))
    return TimelineEntry(kind, start, end, far if kind in MOVING else 0.0, observed=0.0, guess=guess.text)


def _overlap(guess: Guess, row: TimelineEntry) -> float:
    """Duration of a guess within a row [s]."""
    return min(guess.stop, row.end) - max(guess.start, row.start)
