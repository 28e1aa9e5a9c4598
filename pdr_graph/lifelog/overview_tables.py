"""An overview as tables: days, places, visits and usual hours as CSV, and everything as one JSON object."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import numpy as np

from pdr_graph.errors import one_line
from pdr_graph.io.writers import cell
from pdr_graph.lifelog.overview import NO_DATA, RIDE, STAYED, WALK, DayView, Overview, totals_of
from pdr_graph.lifelog.place_visits import PlaceSummary, PlaceVisit, UsualHours
from pdr_graph.lifelog.timeline import TimelineEntry

FORMAT, FORMAT_VERSION = "pdr_graph lifelog overview", 1  # raise the number when a key changes its meaning
METRE_DIGITS, DEGREE_DIGITS = 1, 7
DIGITS = {"latitude": DEGREE_DIGITS, "longitude": DEGREE_DIGITS}  # of columns; METRE_DIGITS for the others
Record = dict[str, Any]


def local_iso(time: float, offset: float) -> str:
    """A Unix time [s] in ISO 8601 at an offset from UTC [s]: ``2024-05-01T07:42:00+02:00``."""
    moment = datetime.fromtimestamp(round(time), UTC).astimezone(timezone(timedelta(seconds=round(offset))))
    return moment.isoformat(timespec="seconds")


def day_record(day: DayView) -> Record:
    """A day: midnights, times per kind [s], distances [m], steps."""
    last = day.entries[-1].end_offset if day.entries else 0.0
    return {
        "person": day.person,
        "date": day.date,
        "start": local_iso(day.start, day.offset),
        "end": local_iso(day.end, last),
        "walking": day.time(WALK),
        "riding": day.time(RIDE),
        "staying": day.time(STAYED),
        "no_data": day.time(NO_DATA),
        "observed": day.observed,
        "walked": day.totals.walked,
        "ridden": day.totals.ridden,
        "steps": day.totals.steps,
    }


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


def visit_record(visit: PlaceVisit) -> Record:
    """A visit: place, local times, duration and time with data [s], position [deg] and sigma [m]."""
    return {
        "person": visit.person,
        "place": visit.place,
        "number": visit.number,
        "start": local_iso(visit.start, visit.start_offset),
        "end": local_iso(visit.end, visit.end_offset),
        "duration": visit.end - visit.start,
        "observed": visit.observed,
        "arrived": visit.arrived,
        "left": visit.left,
        "latitude": visit.latitude,
        "longitude": visit.longitude,
        "sigma": visit.sigma,
    }


def place_record(place: PlaceSummary) -> Record:
    """A place: position [deg] with sigma [m], visits, total time [s], first and last date."""
    return {
        "person": place.person,
        "number": place.number,
        "place": place.name,
        "latitude": place.latitude,
        "longitude": place.longitude,
        "sigma": place.sigma,
        "visits": place.visits,
        "duration": place.total,
        "first": place.first,
        "last": place.last,
    }


def hours_record(place: PlaceSummary, usual: UsualHours) -> Record:
    """Usual hours of a place on a weekday: quartiles of arrivals and departures, local time, "" where unknown."""
    about: Record = {"person": place.person, "number": place.number, "place": place.name, "weekday": usual.weekday}
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
    hours = [hours_record(place, usual) for place in shown.places for usual in place.hours]
    return {
        "days.csv": _csv([day_record(day) for day in shown.days], DAY_COLUMNS),
        "places.csv": _csv([place_record(place) for place in shown.places], PLACE_COLUMNS),
        "visits.csv": _csv([visit_record(visit) for visit in shown.visits], VISIT_COLUMNS),
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
        "persons": [_totals_record(person, shown.of(person)) for person in shown.persons],
        "days": [day_record(day) | {"entries": [entry_record(e) for e in day.entries]} for day in shown.days],
        "places": [
            place_record(place) | {"hours": [_hours_only(hours_record(place, usual)) for usual in place.hours]}
            for place in shown.places
        ],
        "visits": [visit_record(visit) for visit in shown.visits],
    }
    return json.dumps(_plain(document), allow_nan=False)


def _totals_record(person: str, own: Overview) -> Record:
    """The totals of one person."""
    totals = totals_of(own.days, len(own.period))
    return {
        "person": person,
        "days": totals.days,
        "days_with_data": totals.recorded,
        "walking": totals.walking,
        "riding": totals.riding,
        "staying": totals.staying,
        "no_data": totals.unknown,
        "observed": totals.observed,
        "walked": totals.walked,
        "ridden": totals.ridden,
        "steps": totals.steps,
    }


def _hours_only(record: Record) -> Record:
    about = ("person", "number", "place")
    return {name: None if value == "" else value for name, value in record.items() if name not in about}


def _plain(value: Any, name: str = "") -> Any:
    """The value with rounded numbers, and None instead of NaN."""
    if isinstance(value, dict):
        return {key: _plain(own, key) for key, own in value.items()}
    if isinstance(value, list):
        return [_plain(own, name) for own in value]
    if isinstance(value, float):
        return round(value, DIGITS.get(name, 3)) if np.isfinite(value) else None
    return value
