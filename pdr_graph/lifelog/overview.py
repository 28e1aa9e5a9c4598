"""An overview of a day, week, month or year of any persons; as CSV tables, and as one JSON object.

Every second of a day counts once: as walking, riding, staying, or no data. A stay over midnight is one visit, and its
time is divided between both days, as are the steps and the distance of a walk over midnight.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import numpy as np

from pdr_graph.errors import count, one_line
from pdr_graph.io.writers import cell
from pdr_graph.lifelog.diary import Diary, DiaryDay, Totals, totals_of
from pdr_graph.lifelog.local_time import Period
from pdr_graph.lifelog.places import Place, UsualHours, is_place, joined_visits, places_of_visits
from pdr_graph.lifelog.timeline import TimelineEntry
from pdr_graph.types import OneLineRepr


@dataclass(frozen=True)
class Overview(OneLineRepr):
    """The diaries of a period, in order of persons, with visits and places of that period.

    place: its label if the overview is of one place, else ""; visits and places are then of that place.
    """

    period: Period
    place: str
    diaries: tuple[Diary, ...]

    def _summary(self) -> list[str]:
        return [self.period.name, count(len(self.days), "day"), count(len(self.places), "place")]

    @property
    def persons(self) -> tuple[str, ...]:
        """The persons."""
        return tuple(own.person for own in self.diaries)

    @property
    def days(self) -> list[DiaryDay]:
        """The days with data, by person and date."""
        return [day for own in self.diaries for day in own.days]

    @property
    def visits(self) -> list[tuple[str, TimelineEntry]]:
        """The visits with their persons, by person and time."""
        return [(own.person, visit) for own in self.diaries for visit in own.visits]

    @property
    def places(self) -> list[tuple[str, Place]]:
        """The places with their persons, most time first."""
        every = [(own.person, place) for own in self.diaries for place in own.places]
        return sorted(every, key=lambda placed: (-placed[1].duration, placed[1].number))


def overview(diaries: Iterable[Diary], period: Period, place: str = "") -> Overview:
    """The overview of diaries of a period. place: name or number; then only visits, times and hours of that place."""
    found = []
    for own in sorted(diaries, key=lambda own: own.person):
        visits = joined_visits([entry for day in own.days for entry in day.entries])
        visits = [visit for visit in visits if not place or is_place(place, visit)]
        found.append(replace(own, visits=tuple(visits), places=places_of_visits(visits, own.places)))
    label = next((visit.label for own in found for visit in own.visits), "") if place else ""
    return Overview(period, label, tuple(found))


FORMAT, FORMAT_VERSION = "pdr_graph lifelog overview", 1  # raise the number when a key changes its meaning
METRE_DIGITS, DEGREE_DIGITS = 1, 7
DIGITS = {"latitude": DEGREE_DIGITS, "longitude": DEGREE_DIGITS}  # of columns; METRE_DIGITS for the others
Record = dict[str, Any]


def local_iso(time: float, offset: float) -> str:
    """A Unix time [s] in ISO 8601 at an offset from UTC [s]: ``2024-05-01T07:42:00+02:00``."""
    moment = datetime.fromtimestamp(round(time), UTC).astimezone(timezone(timedelta(seconds=round(offset))))
    return moment.isoformat(timespec="seconds")


def day_record(day: DiaryDay) -> Record:
    """A day: midnights, times per kind [s], distances [m], steps."""
    last = day.entries[-1].end_offset if day.entries else 0.0
    about = {"person": day.person, "date": day.date}
    return about | {"start": local_iso(day.start, day.offset), "end": local_iso(day.end, last)} | _sums(day.totals)


def _sums(totals: Totals) -> Record:
    """Times per kind [s], distances [m], steps."""
    names = ("walking", "riding", "staying", "unknown", "observed", "walked", "ridden", "steps")
    return {"no_data" if name == "unknown" else name: getattr(totals, name) for name in names}


def entry_record(entry: TimelineEntry) -> Record:
    """An entry of a day: kind, times, distance [m], place with its position [deg] and sigma [m], what was stated."""
    return {
        "kind": entry.kind,
        "start": local_iso(entry.start, entry.offset),
        "end": local_iso(entry.end, entry.end_offset),
        "duration": entry.end - entry.start,
        "observed": entry.observed,
        "distance": entry.distance,
        "floor": " > ".join(entry.floor),
        "place": entry.place,
        "number": entry.place_number,
        "latitude": entry.latitude,
        "longitude": entry.longitude,
        "sigma": entry.sigma,
        "mode": entry.mode,
        "corrected": entry.corrected,
    }


def visit_record(person: str, visit: TimelineEntry) -> Record:
    """A visit: place, local times, duration and time with data [s], position [deg] and sigma [m]."""
    return {
        "person": person,
        "place": visit.place,
        "number": visit.place_number,
        "start": local_iso(visit.start, visit.offset),
        "end": local_iso(visit.end, visit.end_offset),
        "duration": visit.duration,
        "observed": visit.observed * visit.duration,
        "arrived": visit.arrived,
        "left": visit.left,
        "latitude": visit.latitude,
        "longitude": visit.longitude,
        "sigma": visit.sigma,
    }


def place_record(person: str, place: Place) -> Record:
    """A place: position [deg] with sigma [m], visits, total time [s], first and last date."""
    return {
        "person": person,
        "number": place.number,
        "place": place.name,
        "latitude": place.latitude,
        "longitude": place.longitude,
        "sigma": place.sigma,
        "visits": len(place.visits),
        "duration": place.duration,
        "first": place.first,
        "last": place.last,
    }


def hours_record(usual: UsualHours) -> Record:
    """Usual hours of a place on a weekday: quartiles of arrivals and departures, local time, "" where unknown."""
    about: Record = {"weekday": usual.weekday}
    for name, number, quartiles in (
        ("arrival", usual.arrivals, usual.arrival),
        ("departure", usual.departures, usual.departure),
    ):
        about[f"{name}s"] = number
        about |= {f"{name}_{part}": hour_text(hour) for part, hour in zip(("25", "50", "75"), quartiles, strict=True)}
    return about


def hour_text(hour: float) -> str:
    """A time of day [h] as ``07:42``; "" if unknown."""
    minutes = round(hour * 60) % 1440 if np.isfinite(hour) else 0
    return f"{minutes // 60:02d}:{minutes % 60:02d}" if np.isfinite(hour) else ""


def tables(shown: Overview) -> dict[str, bytes]:
    """The tables of an overview by file name."""
    hours = [
        {"person": person, "number": place.number, "place": place.name} | hours_record(usual)
        for person, place in shown.places
        for usual in place.hours
    ]
    return {
        "days.csv": _csv([day_record(day) for day in shown.days], DAY_COLUMNS),
        "places.csv": _csv([place_record(*placed) for placed in shown.places], PLACE_COLUMNS),
        "visits.csv": _csv([visit_record(*visited) for visited in shown.visits], VISIT_COLUMNS),
        "hours.csv": _csv(hours, HOURS_COLUMNS),
    }


DAY_COLUMNS = "person date start end walking riding staying no_data observed walked ridden steps"
PLACE_COLUMNS = "person number place latitude longitude sigma visits duration first last"
VISIT_COLUMNS = "person place number start end duration observed arrived left latitude longitude sigma"
HOURS_COLUMNS = (
    "person number place weekday arrivals arrival_25 arrival_50 arrival_75 "
    "departures departure_25 departure_50 departure_75"
)


def _csv(records: Iterable[Record], columns: str) -> bytes:
    """A CSV table with these columns, separated by spaces here; unknown numbers are empty."""
    names = columns.split()
    rows = [",".join(_cell(name, record[name]) for name in names) for record in records]
    return ("\n".join([",".join(names), *rows]) + "\n").encode()


def _cell(name: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{DIGITS.get(name, METRE_DIGITS)}f}" if np.isfinite(value) else ""
    return str(value).lower() if isinstance(value, bool) else cell(one_line(str(value)))


def as_json(shown: Overview) -> str:
    """Everything in an overview as one JSON object on one line of ASCII; unknown numbers are null.

    Its keys are in docs/formats.md.
    """
    period = shown.period
    document: Record = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "period": {
            "kind": period.kind,
            "name": period.name,
            "first": period.first.isoformat(),
            "last": period.last.isoformat(),
        },
        "place": shown.place,
        "persons": [_totals_record(own, len(period)) for own in shown.diaries],
        "days": [day_record(day) | {"entries": [entry_record(e) for e in day.entries]} for day in shown.days],
        "places": [
            place_record(person, place) | {"hours": [_with_nulls(hours_record(usual)) for usual in place.hours]}
            for person, place in shown.places
        ],
        "visits": [visit_record(*visited) for visited in shown.visits],
    }
    return json.dumps(_plain(document), allow_nan=False)


def _totals_record(own: Diary, length: int) -> Record:
    """The totals of one person. length: number of days of the period."""
    totals = totals_of(own.days, length)
    return {"person": own.person, "days": totals.days, "days_with_data": totals.recorded} | _sums(totals)


def _with_nulls(record: Record) -> Record:
    return {name: None if value == "" else value for name, value in record.items()}


def _plain(value: Any, name: str = "") -> Any:
    """The value with rounded numbers, and None instead of NaN."""
    if isinstance(value, dict):
        return {key: _plain(own, key) for key, own in value.items()}
    if isinstance(value, list):
        return [_plain(own, name) for own in value]
    if isinstance(value, float):
        return round(value, DIGITS.get(name, 3)) if np.isfinite(value) else None
    return value
