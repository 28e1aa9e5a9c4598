"""Days as they may be shown to others: without the places that the user named, and without what would tell them.

What would tell a place, and what is done:

* where tracks end: what is hidden is wider than the place, and off its middle (`private_places`);
* where they point as they end: the hidden stretch goes on, up to as far again as the hidden area is wide from its
  middle, until the track does not point at the area. Who walks straight at a place from further away shows that;
* when: the time between a last and a first row says how far somebody may have been, that from a recording's start to
  its first row how far from home it began. Nothing is left of a hidden start or end, and a track beside a hidden
  stretch is moved in time as a whole, so that it begins on a quarter of an hour: durations and speeds stay. It begins
  and ends with what was recorded: a gap beside it would say how long the unseen way was;
* how far and how many steps: both are of what is shown;
* names: that of a hidden stay is taken out of all others, and so are those that the user said;
* the frame: its origin is often the first position of all. A local frame gets another;
* sources, plans, hashes and notes: left out.

Cut is left out. Blurred is one row for each quarter of an hour, in the middle of a square of a grid that is the same
everywhere and always (one about the place would give its middle away), with the covariance of a square; its stays have
no name, and begin and end on the quarter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pdr_graph.frames import enu
from pdr_graph.geometry import ANY_HEADING
from pdr_graph.lifelog.day import PRIVATE, WALKING, Day, Outing, Part, Segment, Stay, later, recorded, shares
from pdr_graph.lifelog.private_places import PrivatePlace, hides, same_name
from pdr_graph.types import INSTANT, Array, Index, Mask, Trajectory

SHORTEST = 60.0  # [s] between two hidden stretches for which it is worth showing anything
LEG = 30.0  # [m] over which a track's direction is taken
AT_ONCE = 50  # rows that are looked at, from the end of a track on
MOST_BEHIND = 1000  # rows among which a leg begins: it takes half a kilometre of steps to stand for so many


@dataclass(frozen=True)
class Hidden:
    """What of an outing's rows is hidden. cut, blurred: ``(n,)``; broken: ``(n - 1,)`` between rows; lonlat [deg]."""

    lonlat: Array
    cut: Mask
    blurred: Mask
    broken: Mask


@dataclass(frozen=True)
class Run:
    """Rows from ``first`` to ``last`` that are shown; beside: at its start, at its end, is what is hidden."""

    first: int
    last: int
    beside: tuple[bool, bool]


def hidden_rows(outing: Outing, cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace]) -> Hidden:
    """What some places hide of an outing, in which nothing is both cut and blurred."""
    lonlat = outing.frame.to_lonlat(outing.trajectory.position)
    nothing = np.zeros(len(lonlat), dtype=bool)
    of_cut = np.any([nothing, *(place.hides(lonlat) for place in cut)], axis=0)
    of_blur = np.any([nothing, *(place.hides(lonlat) for place in blur)], axis=0) & ~of_cut
    broken = np.any([nothing[1:], *(place.crossed(lonlat) for place in (*cut, *blur))], axis=0)
    return Hidden(lonlat, of_cut, of_blur, broken)


def shown_runs(track: Trajectory, hidden: Hidden, places: Sequence[PrivatePlace]) -> list[Run]:
    """What is shown, in order."""
    shown = np.flatnonzero(~(hidden.cut | hidden.blurred))
    apart = np.flatnonzero((np.diff(shown) > 1) | hidden.broken[shown[:-1]])
    runs = [
        Run(first := int(r[0]), last := int(r[-1]), (first > 0, last < len(track) - 1))
        for r in np.split(shown, apart + 1)
        if len(r)
    ]
    turned = [_turned(track, run, hidden.lonlat, places) for run in runs if _is_long(track, run)]
    return [run for run in turned if _is_long(track, run)]


def _is_long(track: Trajectory, run: Run) -> bool:
    return not any(run.beside) or float(track.time[run.last] - track.time[run.first]) >= SHORTEST


def _turned(track: Trajectory, run: Run, lonlat: Array, places: Sequence[PrivatePlace]) -> Run:
    """A run without what at its ends points at what is hidden there."""
    own = np.arange(run.first, run.last + 1)
    if run.beside[1]:
        own = _turned_away(track.position, lonlat, own, places)
    if run.beside[0]:
        own = _turned_away(track.position, lonlat, own[::-1], places)[::-1]
    return replace(run, first=int(own[0]), last=int(own[-1])) if len(own) else replace(run, last=run.first)


def _turned_away(position: Array, lonlat: Array, own: Index, places: Sequence[PrivatePlace]) -> Index:
    """Rows up to the last one from which the hidden area is not straight on, or which is far from it."""
    if not len(own):
        return own
    place = min(places, key=lambda p: p.away(lonlat[own[-1:]])[0])
    for after in range(len(own), 0, -AT_ONCE):
        number = range(max(after - AT_ONCE, 0), after)
        behind = [own[_behind(position[own[max(0, n - MOST_BEHIND) : n + 1]], n)] for n in number]
        here = lonlat[own[number]]
        good = np.flatnonzero((place.away(here) > 2 * place.radius) | ~place.ahead(here, lonlat[behind]))
        if len(good):
            return own[: number[good[-1]] + 1]
    return own[:0]


def _behind(position: Array, number: int) -> int:
    """The last of the rows ``(n, 2)`` up to that number that is a LEG away from it, else the first of them."""
    away = np.flatnonzero(np.hypot(*(position - position[-1]).T) >= LEG)
    return number + 1 - len(position) + (int(away[-1]) if len(away) else 0)


QUARTER = 900.0  # [s]
COARSE = 500.0  # [m] side of a blurred place's square, or its radius if that is more
METRES_PER_DEGREE = 111_320.0  # of latitude, near enough for the squares of a grid


def blurred(
    outing: Outing, hidden: Hidden, own: Index, blur: Sequence[PrivatePlace], free: tuple[float, float], first: bool
) -> Part | None:
    """Blurred rows as one for each quarter of an hour within the Unix times that are free; None if there are none.

    first: whether nothing is shown of the outing before.
    """
    if not len(own):
        return None
    unix = outing.trajectory.time + outing.epoch
    since, until = unix[own[[0, -1]]].tolist()
    start = max(free[0], quarter_before(since)) if first else free[0]
    end = free[1] if np.isfinite(free[1]) else max(start, quarter_after(until))
    quarter = np.floor(unix[own] / QUARTER) * QUARTER
    time = np.unique(quarter + QUARTER / 2)
    time = time[(time > start) & (time < end)]
    if not len(time):
        return None
    usual = [np.median(hidden.lonlat[own[quarter == t - QUARTER / 2]], axis=0) for t in time]
    centre, side = _squares(np.array(usual), blur)
    covariance = np.zeros((len(time), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = side**2 / 12
    covariance[:, 2, 2] = ANY_HEADING**2
    heading, floor = np.full(len(time), np.nan), ("",) * len(time)
    track = Trajectory(time, outing.frame.from_lonlat(centre), heading, floor, covariance)
    return Part(start, end, track, (Segment(PRIVATE, start, end, 0.0),), _blurred_stays(outing, blur, own, start, end))


def _blurred_stays(
    outing: Outing, blur: Sequence[PrivatePlace], own: Index, start: float, end: float
) -> tuple[Stay, ...]:
    """The stays among blurred rows, somewhere in a square and from quarter to quarter."""
    begin, last = outing.trajectory.time[own[[0, -1]]] + outing.epoch
    stays = []
    for stay in outing.stays:
        since, until = stay.start + outing.epoch, stay.end + outing.epoch
        inside = since < last and until > begin and hides(blur, outing.frame, stay.position)
        since, until = max(start, quarter_before(since)), min(end, quarter_after(until))
        if inside and not stay.passing and until > since:
            centre, side = _squares(outing.frame.to_lonlat(stay.position[None]), blur)
            position, covariance = outing.frame.from_lonlat(centre)[0], np.eye(2) * side[0] ** 2 / 12
            stays.append(Stay(since, until, False, position, covariance, np.nan, ""))
    return tuple(stays)


def _squares(lonlat: Array, blur: Sequence[PrivatePlace]) -> tuple[Array, Array]:
    """The middles ``(n, 2)`` [deg] of the squares in which positions lie, and their sides ``(n,)`` [m]."""
    side = np.max([np.full(len(lonlat), COARSE), *(p.hides(lonlat) * p.radius for p in blur)], axis=0)
    height = side / METRES_PER_DEGREE
    lat = (np.floor(lonlat[:, 1] / height) + 0.5) * height
    width = height / np.cos(np.radians(lat))
    return np.stack([(np.floor(lonlat[:, 0] / width) + 0.5) * width, lat], axis=1), side


def quarter_after(time: float) -> float:
    """The next full quarter of an hour. [s]"""
    return float(np.ceil(time / QUARTER) * QUARTER)


def quarter_before(time: float) -> float:
    """The last full quarter of an hour. [s]"""
    return float(np.floor(time / QUARTER) * QUARTER)


ORIGIN_DIGITS = 2  # of a degree: a new frame's origin lies within a kilometre of the first row that is shown


def shared(
    days: Sequence[Day], cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace]
) -> tuple[list[Day], list[str]]:
    """Days without what they tell of some places; and what a user must know of it, a line each."""
    if not (cut or blur):
        return list(days), []
    made, notes = list[Day](), list[str]()
    for day in days:
        outings, free = list[Outing](), -np.inf
        for outing in sorted(day.outings, key=lambda o: o.epoch):
            if not outing.frame.georeferenced:
                notes.append(f"{day.person}, {day.date}: outing left out: no absolute position")
            elif parts := _parts(replace(outing, trajectory=recorded(outing)), cut, blur, free):
                outings.append(_reframed(_outing(outing, parts)))
                free = parts[-1].end
        made.append(Day(day.person, day.date, _without_names(outings, _names(day, cut, blur))))
    return made, notes


def _parts(outing: Outing, cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace], free: float) -> list[Part]:
    """What is shown of an outing, in order, none of it before the Unix time ``free``."""
    hidden = hidden_rows(outing, cut, blur)
    parts: list[Part] = []
    for before, run in pairwise([None, *shown_runs(outing.trajectory, hidden, (*cut, *blur)), None]):
        passed = np.arange(before.last + 1 if before else 0, run.first if run else len(outing.trajectory))
        begin = _begin(outing, run, free) if run else np.inf
        coarse = blurred(outing, hidden, passed[hidden.blurred[passed]], blur, (free, begin), not parts)
        parts += [coarse] if coarse else []
        parts += [_shown(outing, run, begin, (*cut, *blur))] if run else []
        free = parts[-1].end if parts else free
    return parts


def _begin(outing: Outing, run: Run, free: float) -> float:
    """When a run begins as it is shown: on a quarter of an hour, if it lies beside what is hidden or too early."""
    begin = outing.epoch + float(outing.trajectory.time[run.first])
    return quarter_after(max(begin, free)) if any(run.beside) or begin < free else begin


def _shown(outing: Outing, run: Run, begin: float, places: Sequence[PrivatePlace]) -> Part:
    """A run as it is, from another time on."""
    track = outing.trajectory[run.first : run.last + 1]
    start, end = float(track.time[0]), float(track.time[-1])
    by = begin - start
    bounds = [(s, max(s.start, start), min(s.end, end)) for s in outing.segments]
    segments = [
        Segment(s.kind, a + by, b + by, s.distance * float(shares(outing.trajectory, [s.start, a, b, s.end])[1]))
        for s, a, b in bounds
        if b > a
    ]
    stays = [
        later(s, by)
        for s in outing.stays
        if s.start >= start - INSTANT and s.end <= end + INSTANT and not hides(places, outing.frame, s.position)
    ]
    return Part(begin, end + by, replace(track, time=track.time + by), tuple(segments), tuple(stays))


def _outing(of: Outing, parts: Sequence[Part]) -> Outing:
    """Parts as one outing, with nothing between them."""
    segments = list(parts[0].segments)
    for before, after in pairwise(parts):
        if after.start > before.end + INSTANT:
            segments.append(Segment(PRIVATE, before.end, after.start, 0.0))
        segments += after.segments
    epoch, tracks = parts[0].start, [part.track for part in parts]
    covariances = [track.covariance for track in tracks if track.covariance is not None]
    track = Trajectory(
        np.concatenate([track.time for track in tracks]) - epoch,
        np.concatenate([track.position for track in tracks]),
        np.concatenate([track.heading for track in tracks]),
        tuple(label for track in tracks for label in track.floor),
        np.concatenate(covariances) if len(covariances) == len(tracks) else None,
    )
    moved = tuple(later(s, -epoch) for s in segments)
    stays = tuple(later(s, -epoch) for part in parts for s in part.stays)
    return Outing((), "", epoch, of.frame, "", track, moved, stays, _steps(of, segments))


def _steps(of: Outing, left: Sequence[Segment]) -> int:
    """As many steps for what is left of the walking as for all of it."""
    every, own = (sum(s.distance for s in segments if s.kind == WALKING) for segments in (of.segments, left))
    return round(of.steps * own / every) if every else 0


def _reframed(outing: Outing) -> Outing:
    """An outing in a frame about another origin.

    North of the two differs by minutes of arc within a day's reach, which is not made good.
    """
    if outing.frame.kind != "enu":
        return outing
    position = outing.trajectory.position
    lon, lat = np.round(outing.frame.to_lonlat(position[:1])[0], ORIGIN_DIGITS).tolist()
    frame, old = enu(lat, lon), outing.frame
    track = replace(outing.trajectory, position=frame.from_frame(old, position))
    stays = tuple(replace(s, position=frame.from_frame(old, s.position[None])[0]) for s in outing.stays)
    return replace(outing, frame=frame, trajectory=track, stays=stays)


def _names(day: Day, cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace]) -> set[str]:
    """Those that the user said, and those of hidden stays."""
    places = (*cut, *blur)
    hidden = {
        stay.facing[0][0]
        for outing in day.outings
        if outing.frame.georeferenced
        for stay in outing.stays
        if stay.facing and hides(places, outing.frame, stay.position)
    }
    return {same_name(name) for name in (*hidden, *(place.name for place in places))}


def _without_names(outings: Sequence[Outing], names: set[str]) -> tuple[Outing, ...]:
    """Outings none of whose stays says these names."""
    return tuple(
        replace(
            outing,
            stays=tuple(
                replace(s, facing=tuple((name, p) for name, p in s.facing if same_name(name) not in names))
                for s in outing.stays
            ),
        )
        for outing in outings
    )
