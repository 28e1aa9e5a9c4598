"""Visits to places: when somebody came and left, how long they stayed, and at which hours they usually do.

A stay that continues after midnight is one visit. The start of a stay counts as an arrival only if it was observed: not
after a time without data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pdr_graph.errors import count
from pdr_graph.lifelog.day import KINDS_WITHOUT_DATA
from pdr_graph.lifelog.places import Place
from pdr_graph.lifelog.timeline import STAY, TimelineEntry, duration_text
from pdr_graph.types import Array, OneLineRepr

WEEKDAYS = ("Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday")
EVERY_DAY = "every day"  # instead of a weekday
DAY_LENGTH = 86_400.0  # [s]
# Chosen by hand
UNOBSERVED_TIME = 900.0  # [s] of no data before a stay, below which its start counts as an arrival; departures likewise


@dataclass(frozen=True)
class PlaceVisit(OneLineRepr):
    """A stay at a place, over midnights too.

    place: its name, "" without one; number: of the place, -1 if it is none; start, end: Unix times [s] with the offsets
    of local time [s]; arrived, left: whether the start and the end were observed, not inside a time without data.
    observed: time with data [s]. latitude, longitude [deg], sigma [m]: NaN where unknown.
    """

    person: str
    place: str
    number: int
    start: float
    end: float
    start_offset: float
    end_offset: float
    arrived: bool
    left: bool
    observed: float
    latitude: float
    longitude: float
    sigma: float

    def _summary(self) -> list[str]:
        return [repr(self.person), repr(self.label), duration_text(self.end - self.start)]

    @property
    def label(self) -> str:
        """The name of the place, else its number, else ""."""
        return place_label(self.place, self.number)


@dataclass(frozen=True)
class UsualHours:
    """When somebody comes to a place and leaves it: quartiles of local time [h], NaN where fewer than two are known.

    weekday: of the arrival or the departure, or EVERY_DAY; arrivals, departures: how many were observed.
    """

    weekday: str
    arrivals: int
    arrival: tuple[float, float, float]
    departures: int
    departure: tuple[float, float, float]


@dataclass(frozen=True)
class PlaceSummary(OneLineRepr):
    """A visited place: position [deg] with sigma [m], visits, total time [s], dates, and the usual hours.

    hours: of EVERY_DAY first, then of the weekdays that occurred.
    """

    person: str
    number: int
    name: str
    latitude: float
    longitude: float
    sigma: float
    visits: int
    total: float
    first: str
    last: str
    hours: tuple[UsualHours, ...]

    def _summary(self) -> list[str]:
        return [repr(self.label), count(self.visits, "visit"), duration_text(self.total)]

    @property
    def label(self) -> str:
        """The name, else the number."""
        return place_label(self.name, self.number)


def place_label(name: str, number: int) -> str:
    """The name of a place, else its number, else "" (a stay that belongs to no place)."""
    return name or (f"place {number}" if number >= 0 else "")


def is_place(text: str, name: str, number: int) -> bool:
    """True if a text is the name of a place, in any case, or its number."""
    plain = text.strip().casefold()
    return bool(plain) and (plain == name.strip().casefold() or plain in (str(number), f"place {number}"))


def joined_visits(person: str, entries: Sequence[TimelineEntry]) -> list[PlaceVisit]:
    """The visits of a person. entries: of all days, in time order."""
    joined: list[list[TimelineEntry]] = []
    for before, entry in pairwise([None, *entries]):
        assert entry is not None
        if before is not None and joined and _continues(before, entry):
            joined[-1].append(entry)
        else:
            joined.append([entry])
    found = list[PlaceVisit]()
    for n, parts in enumerate(joined):
        if parts[0].kind != STAY:
            continue
        begin, end = parts[0].start, parts[-1].end
        before, after = joined[n - 1][-1] if n else None, joined[n + 1][0] if n + 1 < len(joined) else None
        arrived = before is not None and begin - _last_seen(before) < UNOBSERVED_TIME
        left = after is not None and _first_seen(after) - end < UNOBSERVED_TIME
        found.append(_visit(person, parts, arrived, left))
    return found


def _continues(before: TimelineEntry, after: TimelineEntry) -> bool:
    """True if two entries are one, divided at midnight."""
    same = before.place_number == after.place_number and before.place == after.place
    unplaced = before.place_number < 0 and (before.x, before.y) != (after.x, after.y)
    kinds = before.kind == after.kind and after.kind in (STAY, *KINDS_WITHOUT_DATA)
    # same instant [s] between two parts of a stay, before and after midnight
    return kinds and abs(after.start - before.end) < 1.0 and same and not (after.kind == STAY and unplaced)


def _last_seen(entry: TimelineEntry) -> float:
    """Unix time of the end of the last part of an entry with data [s]; -inf if it has none."""
    return max((part.end for part in entry.parts or (entry,) if is_seen(part)), default=-np.inf)


def _first_seen(entry: TimelineEntry) -> float:
    """Unix time of the start of the first part of an entry with data [s]; inf if it has none."""
    return min((part.start for part in entry.parts or (entry,) if is_seen(part)), default=np.inf)


def is_seen(entry: TimelineEntry) -> bool:
    """True if an entry has data."""
    return entry.kind not in KINDS_WITHOUT_DATA and entry.observed > 0


def _visit(person: str, parts: Sequence[TimelineEntry], arrived: bool, left: bool) -> PlaceVisit:
    first, last = parts[0], parts[-1]
    longest = max(parts, key=lambda entry: entry.end - entry.start)
    observed = sum((entry.end - entry.start) * entry.observed for entry in parts)
    return PlaceVisit(
        person=person,
        place=first.place,
        number=first.place_number,
        start=first.start,
        end=last.end,
        start_offset=first.offset,
        end_offset=last.end_offset,
        arrived=arrived,
        left=left,
        observed=float(observed),
        latitude=longest.latitude,
        longitude=longest.longitude,
        sigma=longest.sigma,
    )


def places_of_visits(visits: Sequence[PlaceVisit], known: Mapping[tuple[str, int], Place]) -> tuple[PlaceSummary, ...]:
    """The places of visits, most time first. known: places with their positions, by person and number."""
    by_place: dict[tuple[str, int, str], list[PlaceVisit]] = {}
    for visit in visits:
        if visit.number >= 0 or visit.place:
            by_place.setdefault((visit.person, visit.number, visit.place), []).append(visit)
    found = [_place(own, known.get((who, number))) for (who, number, _), own in by_place.items()]
    return tuple(sorted(found, key=lambda place: (-place.total, place.number)))


def _place(visits: Sequence[PlaceVisit], known: Place | None) -> PlaceSummary:
    first, last = visits[0], visits[-1]
    longest = max(visits, key=lambda visit: visit.end - visit.start)
    at = longest if known is None else known
    return PlaceSummary(
        person=first.person,
        number=first.number,
        name=first.place,
        latitude=at.latitude,
        longitude=at.longitude,
        sigma=at.sigma,
        visits=len(visits),
        total=sum(visit.end - visit.start for visit in visits),
        first=_local_date(first.start + first.start_offset),
        last=_local_date(last.end + last.end_offset),
        hours=_usual_hours(visits),
    )


def _local_date(local: float) -> str:
    return str(np.datetime64(int(local), "s"))[:10]


def _usual_hours(visits: Sequence[PlaceVisit]) -> tuple[UsualHours, ...]:
    """Usual hours of every day, then of each weekday on which somebody arrived or left."""
    come = np.array([v.start + v.start_offset for v in visits if v.arrived])
    gone = np.array([v.end + v.end_offset for v in visits if v.left])
    found = []
    for weekday in (-1, *range(7)):
        own = [time[(weekday < 0) | (_weekday(time) == weekday)] for time in (come, gone)]
        if weekday < 0 or any(len(time) for time in own):
            quartiles = [clock_quartiles(time / 3600 % 24) for time in own]
            name = EVERY_DAY if weekday < 0 else WEEKDAYS[weekday]
            found.append(UsualHours(name, len(own[0]), quartiles[0], len(own[1]), quartiles[1]))
    return tuple(found)


def _weekday(local: Array) -> Array:
    """Weekdays of local times [s], Monday is 0; 1 January 1970 was a Thursday."""
    return (np.floor(local / DAY_LENGTH) + 3) % 7


def clock_quartiles(hours: Array) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile of times of day [h]; 23:30 is near 0:30. NaN for fewer than two.

    The quartiles are those of the distances, up to 12 h, from the circular mean.
    """
    if len(hours) < 2:
        return np.nan, np.nan, np.nan
    angle = np.asarray(hours) * np.pi / 12
    mean = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()) * 12 / np.pi
    away = (np.asarray(hours) - mean + 12) % 24 - 12
    low, middle, high = ((mean + np.quantile(away, [0.25, 0.5, 0.75])) % 24).tolist()
    return low, middle, high
