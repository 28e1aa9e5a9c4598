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
everywhere and always, with the covariance of a square; its stays have no name, and begin and end on the quarter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pdr_graph.frames import enu
from pdr_graph.lifelog.blurring import blurred, quarter_after
from pdr_graph.lifelog.day import WALKING, Day, Outing, Segment
from pdr_graph.lifelog.hiding import Run, hidden_rows, shown_runs
from pdr_graph.lifelog.parts import PRIVATE, Part, later, recorded, shares
from pdr_graph.lifelog.private_places import PrivatePlace, hides, same_name
from pdr_graph.types import INSTANT, Trajectory

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
                notes.append(f"{day.person}, {day.date}: an outing was left out, as nobody knows where on earth it was")
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
