"""The numbers of a day, week, month or year: time per kind, distances, steps, visits, places and their usual hours.

Every second of a day counts once: as walking, riding, staying, or no data. A stay over midnight is one visit, and its
time is divided between both days, as are the steps and the distance of a walk over midnight.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from pdr_graph.errors import count
from pdr_graph.lifelog.day import (
    GAP,
    KINDS_WITHOUT_DATA,
    PRIVATE,
    STANDING,
    VEHICLE,
    WALKING,
    Outing,
    clipped,
    split_at_gaps,
)
from pdr_graph.lifelog.diary import DiaryDay
from pdr_graph.lifelog.period import Period
from pdr_graph.lifelog.place_visits import (
    DAY_LENGTH,
    PlaceSummary,
    PlaceVisit,
    is_place,
    joined_visits,
    place_label,
    places_of_visits,
)
from pdr_graph.lifelog.places import Place
from pdr_graph.lifelog.timeline import PASSING, STAY, DayTotals, TimelineEntry
from pdr_graph.types import Array, OneLineRepr

WALK, RIDE, STAYED, NO_DATA = "walking", "riding", "staying", "no data"
GROUPS = {
    WALKING: WALK,
    PASSING: WALK,
    VEHICLE: RIDE,
    STAY: STAYED,
    STANDING: STAYED,
    GAP: NO_DATA,
    PRIVATE: NO_DATA,
}


@dataclass(frozen=True)
class Line:
    """A part of a track. kind: as of a segment; lonlat: ``(n, 2)`` [deg]."""

    kind: str
    lonlat: Array


@dataclass(frozen=True)
class DayView(OneLineRepr):
    """What an overview needs of a diary's day.

    start, end: Unix times of its midnights [s]; entries: its rows; totals: of these; lines: what is drawn on a map.
    """

    person: str
    date: str
    start: float
    end: float
    entries: tuple[TimelineEntry, ...]
    totals: DayTotals
    lines: tuple[Line, ...] = ()

    def _summary(self) -> list[str]:
        return [repr(self.person), self.date, count(len(self.entries), "row")]

    @property
    def offset(self) -> float:
        """Offset of local time from UTC at the start of the day [s]."""
        return self.entries[0].offset if self.entries else 0.0

    def time(self, group: str) -> float:
        """Time of one of the GROUPS [s]; no data is what remains of the day."""
        spent = {WALK: self.totals.walking, RIDE: self.totals.riding, STAYED: self.totals.staying}
        return max(self.end - self.start - sum(spent.values()), 0.0) if group == NO_DATA else spent[group]

    @property
    def observed(self) -> float:
        """Time with data [s]; stays and ways go on over short times without data."""
        own = [entry for entry in self.entries if is_known(entry)]
        return float(sum((entry.end - entry.start) * entry.observed for entry in own))


@dataclass(frozen=True)
class Totals:
    """Sums over days: times [s], distances [m], number of steps, of days, and of days with data."""

    days: int
    recorded: int
    walking: float
    riding: float
    staying: float
    unknown: float
    observed: float
    walked: float
    ridden: float
    steps: int


@dataclass(frozen=True)
class Overview(OneLineRepr):
    """The numbers of a period. place: its label if the overview is of one place, else "".

    days: with data, by person and date; places: most time first; visits: by person and time.
    """

    period: Period
    persons: tuple[str, ...]
    place: str
    days: tuple[DayView, ...]
    places: tuple[PlaceSummary, ...]
    visits: tuple[PlaceVisit, ...]

    def _summary(self) -> list[str]:
        return [self.period.name, count(len(self.days), "day"), count(len(self.places), "place")]

    def of(self, person: str) -> Overview:
        """The part of one person."""
        return replace(
            self,
            persons=(person,),
            days=tuple(day for day in self.days if day.person == person),
            places=tuple(place for place in self.places if place.person == person),
            visits=tuple(visit for visit in self.visits if visit.person == person),
        )


def is_known(entry: TimelineEntry) -> bool:
    """True if it is known what the person did; a stay may go on without data."""
    return GROUPS[entry.kind] != NO_DATA


def view_of(day: DiaryDay, tolerance: float) -> DayView:
    """What an overview needs of a day, with tracks simplified to a tolerance [m]."""
    lines = tuple(line for outing in day.outings for line in _lines(outing, day.start, day.end, tolerance))
    return DayView(day.person, day.date, day.start, day.end, day.entries, day.totals, lines)


def overview(
    days: Iterable[DayView], period: Period, place: str = "", known: Mapping[tuple[str, int], Place] | None = None
) -> Overview:
    """The overview of days of any persons.

    place: name or number; then only visits, times and hours of that place. known: places by person and number.
    """
    own = tuple(sorted(days, key=lambda day: (day.person, day.date)))
    visits = [
        visit
        for person, same in groupby(own, key=lambda day: day.person)
        for visit in joined_visits(person, [entry for day in same for entry in day.entries])
    ]
    if place:
        visits = [visit for visit in visits if is_place(place, visit.place, visit.number)]
    persons = tuple(dict.fromkeys(day.person for day in own))
    label = place_label(visits[0].place, visits[0].number) if place and visits else ""
    return Overview(period, persons, label, own, places_of_visits(visits, known or {}), tuple(visits))


def totals_of(days: Sequence[DayView], length: int) -> Totals:
    """Sums over days of one person. length: number of days of the period."""
    return Totals(
        days=length,
        recorded=sum(day.observed > 0 for day in days),
        walking=sum(day.time(WALK) for day in days),
        riding=sum(day.time(RIDE) for day in days),
        staying=sum(day.time(STAYED) for day in days),
        unknown=sum(day.time(NO_DATA) for day in days) + (length - len(days)) * DAY_LENGTH,
        observed=sum(day.observed for day in days),
        walked=sum(day.totals.walked for day in days),
        ridden=sum(day.totals.ridden for day in days),
        steps=sum(day.totals.steps for day in days),
    )


def _lines(outing: Outing, start: float, end: float, tolerance: float) -> Iterable[Line]:
    """The tracks of an outing between two Unix times [s] by kind, simplified to a tolerance [m]."""
    import shapely

    if not outing.frame.georeferenced:
        return
    for track, segments in split_at_gaps(outing):
        for segment in segments:
            since, until = max(segment.start, start - outing.epoch), min(segment.end, end - outing.epoch)
            if segment.kind in (*KINDS_WITHOUT_DATA, STANDING) or until <= since:
                continue
            own = clipped(track, since, until)
            if len(own) > 1 and np.ptp(own.position, axis=0).max() > 0:
                line = shapely.simplify(shapely.linestrings(own.position), tolerance, preserve_topology=False)
                yield Line(segment.kind, outing.frame.to_lonlat(shapely.get_coordinates(line)))
