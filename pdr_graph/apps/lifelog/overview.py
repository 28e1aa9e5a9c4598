"""An overview of a day, week, month or year of any persons: numbers, text for a terminal, CSV tables, and JSON.

Every second of a day counts once: as walking, riding, staying, or no data. A stay over midnight is one visit, and its
time is divided between both days, as are the steps and the distance of a walk over midnight.

Text has lines of at most 100 columns. A day is a list that fits a screen: the shortest entries are merged with their
neighbours, and counted.
"""

from __future__ import annotations

import json
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, timezone
from itertools import groupby
from types import MappingProxyType
from typing import Any

import numpy as np

from pdr_graph.apps.lifelog.day import GAP, PRIVATE, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import Diary, DiaryDay, Totals, totals_of
from pdr_graph.apps.lifelog.local_time import DAY, MONTH, WEEK, Period
from pdr_graph.apps.lifelog.places import (
    EVERY_DAY,
    Place,
    UsualHours,
    is_place,
    joined_visits,
    local_date,
    places_of_visits,
)
from pdr_graph.apps.lifelog.timeline import KIND_NAMES, PASSING, STAY, TimelineEntry, csv_table, duration_text
from pdr_graph.errors import count, one_line
from pdr_graph.types import DAY_LENGTH, OneLineRepr


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


JSON_FORMAT, JSON_VERSION = "pdr_graph lifelog overview", 1  # raise the number when a key changes its meaning
DEGREE_DIGITS = {"latitude": 7, "longitude": 7}  # of columns
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
    records = {
        "days.csv": ([day_record(day) for day in shown.days], DAY_COLUMNS),
        "places.csv": ([place_record(*placed) for placed in shown.places], PLACE_COLUMNS),
        "visits.csv": ([visit_record(*visited) for visited in shown.visits], VISIT_COLUMNS),
        "hours.csv": (hours, HOURS_COLUMNS),
    }
    return {name: csv_table(rows, columns.split(), DEGREE_DIGITS).encode() for name, (rows, columns) in records.items()}


DAY_COLUMNS = "person date start end walking riding staying no_data observed walked ridden steps"
PLACE_COLUMNS = "person number place latitude longitude sigma visits duration first last"
VISIT_COLUMNS = "person place number start end duration observed arrived left latitude longitude sigma"
HOURS_COLUMNS = (
    "person number place weekday arrivals arrival_25 arrival_50 arrival_75 "
    "departures departure_25 departure_50 departure_75"
)


def as_json(shown: Overview) -> str:
    """Everything in an overview as one JSON object on one line of ASCII; unknown numbers are null.

    Its keys are in docs/formats.md.
    """
    period = shown.period
    document: Record = {
        "format": JSON_FORMAT,
        "version": JSON_VERSION,
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
        return round(value, DEGREE_DIGITS.get(name, 3)) if np.isfinite(value) else None
    return value


ROW_TITLES = ("from", "to", "for", "what", "distance", "where")
LIST_ROWS = 25  # of a list that fits a screen
MERGED_NAMES = {
    STAY: "short stop",
    STANDING: "short stop",
    PASSING: "slow pass",
    WALKING: "short walk",
    VEHICLE: "short ride",
    GAP: "short gap",
    PRIVATE: "short gap",
}
SHORTEST_MINUTES = 60.0  # [s] of the shortest row of a list whose times are in minutes
MERGED_KINDS = 2  # kinds of merged entries that a row names
TRAVEL_KINDS = (WALKING, PASSING, VEHICLE)


ListRow = tuple[TimelineEntry, Counter[str]]  # an entry, and how many of each of MERGED_NAMES were merged with it


def _identity(entry: TimelineEntry) -> tuple[object, ...]:
    """Equal for entries that are one if nothing is between them."""
    if entry.kind != STAY:
        return (entry.kind,)
    return (STAY, entry.place_number, entry.place) if entry.place_number >= 0 else (STAY, entry.x, entry.y)


def day_list(entries: Sequence[TimelineEntry], most: int = LIST_ROWS) -> list[ListRow]:
    """At most `most` rows (at least one) of the entries of a day; the shortest are merged with their neighbours."""
    rows = [(entry, Counter[str]()) for entry in entries]
    while len(rows) > max(most, 1):
        shortest = min(range(len(rows)), key=lambda n: rows[n][0].duration)
        rows[max(shortest - 1, 0) : shortest + 2] = _merged(rows, shortest)
    return rows


def _merged(rows: Sequence[ListRow], n: int) -> list[ListRow]:
    """The rows from n - 1 to n + 1, where row n is merged with one of the others, or with both if they are one."""
    row, before, after = rows[n], rows[n - 1 : n] if n else [], rows[n + 1 : n + 2]
    if before and after and _identity(before[0][0]) == _identity(after[0][0]):
        (both, merged), (last, others) = _absorbed(before[0], row), after[0]
        joined = replace(both, end=last.end, distance=both.distance + last.distance)
        return [(joined, merged + others)]
    larger = max([*before, *after], key=lambda r: (r[0].kind in TRAVEL_KINDS, r[0].duration))
    one = _absorbed(larger, row)
    return [one, *after] if before and larger is before[0] else [*before, one]


def _absorbed(row: ListRow, short: ListRow) -> ListRow:
    """The row with a neighbour as a part of it."""
    (entry, merged), (other, others) = row, short
    start, end = min(entry.start, other.start), max(entry.end, other.end)
    longer = replace(entry, start=start, end=end, distance=entry.distance + other.distance)
    return longer, merged + others + Counter([MERGED_NAMES[other.kind]])


def list_texts(entries: Sequence[TimelineEntry], most: int = LIST_ROWS) -> list[tuple[str, str, str, str, str, str]]:
    """The list of a day as texts; times have seconds if a row is shorter than SHORTEST_MINUTES."""
    rows = day_list(entries, most)
    seconds = any(entry.duration < SHORTEST_MINUTES for entry, _ in rows)
    return [row_texts(entry, merged, seconds) for entry, merged in rows]


def row_texts(
    entry: TimelineEntry, merged: Mapping[str, int] = MappingProxyType({}), seconds: bool = False
) -> tuple[str, str, str, str, str, str]:
    """Texts of a row: local start and end, duration, activity, distance, place with what was merged."""
    far = distance_text(entry.distance) if entry.kind in TRAVEL_KINDS and entry.distance >= 0.5 else ""
    words = [_place(entry), "corrected" if entry.corrected else "", _merged_text(Counter(merged))]
    return (
        clock_text(entry.start, entry.offset, seconds),
        _end_text(entry, seconds),
        duration_text(entry.duration),
        entry.mode or KIND_NAMES.get(entry.kind, entry.kind),
        far,
        "; ".join(filter(None, words)),
    )


def _end_text(entry: TimelineEntry, seconds: bool) -> str:
    """Local end; with "+1" if it is on the next date, after a flight over time zones."""
    start, end = entry.start + entry.offset, entry.end + entry.end_offset
    later = int(end // DAY_LENGTH - start // DAY_LENGTH) if end % DAY_LENGTH > 0 else 0
    return clock_text(entry.end, entry.end_offset, seconds) + (f" +{later}" if later else "")


def _place(entry: TimelineEntry) -> str:
    """Floors and place: the name that the person gave, else places on a plan with probabilities, else its number.

    Coordinates for a place without a name or number.
    """
    facing, place = max((part.facing for part in (entry, *entry.parts)), key=lambda own: own[0][1] if own else 0.0), ""
    if facing and entry.place in ("", facing[0][0]):
        (name, probability), *others = facing
        # most other names: alternative names of a place; the CSV has all
        beside = ", ".join(f"{one_line(n)} {p:.0%}" for n, p in others[:2])
        place = f"{one_line(name)} {probability:.0%}" + (f"  ({beside})" if beside else "")
    elif entry.label:
        place = one_line(entry.label)
    elif np.isfinite(entry.latitude):
        place = f"{entry.latitude:.5f}, {entry.longitude:.5f} ± {entry.sigma:.0f} m"
    elif np.isfinite(entry.x):
        place = f"x {entry.x:.0f}, y {entry.y:.0f} ± {entry.sigma:.0f} m"
    return " ".join(filter(None, [one_line(f"floor {' > '.join(entry.floor)}") if any(entry.floor) else "", place]))


def _merged_text(merged: Counter[str]) -> str:
    """What was merged: ``and 3 short stops, 1 short walk``; the rarer kinds are ``5 others``."""
    common = merged.most_common()
    texts = [_count(number, name) for name, number in common[:MERGED_KINDS]]
    others = sum(number for _, number in common[MERGED_KINDS:])
    texts += [count(others, "other")] if others else []
    return f"and {', '.join(texts)}" if texts else ""


def _count(number: int, name: str) -> str:
    return f"{number} slow passes" if name == "slow pass" and number > 1 else count(number, name)


def clock_text(time: float, offset: float, seconds: bool = False) -> str:
    """Local time of day of a Unix time [s] at an offset from UTC [s]: ``07:42``, or ``07:42:15``."""
    moment = datetime.fromtimestamp(round(time + offset), UTC)
    return f"{moment:%H:%M:%S}" if seconds else f"{moment:%H:%M}"


def distance_text(metres: float) -> str:
    """A distance as a text: ``640 m``, ``6.2 km``, ``1,250 km``."""
    if metres < 999.5:
        return f"{metres:.0f} m"
    return f"{metres / 1000:.1f} km" if metres < 99_950 else f"{metres / 1000:,.0f} km"


TEXT_WIDTH = 100  # columns of a line
TEXT_PLACES, TEXT_VISITS, MOST_MONTHS = 12, 20, 25  # rows of tables
NOTHING = "–"


def as_text(shown: Overview) -> str:
    """The overview as text, a part per person."""
    return "\n\n".join("\n".join(_person_lines(shown, own)) for own in shown.diaries) + "\n"


def _person_lines(shown: Overview, own: Diary) -> Iterator[str]:
    """The lines of one person."""
    place = f"  {one_line(shown.place)}" if shown.place else ""
    yield fitted(f"{one_line(own.person)}  {period_title(shown.period)}{place}", TEXT_WIDTH)
    if shown.place:
        yield from _visit_lines(own.visits)
    elif shown.period.kind == DAY:
        # least rows of a day's list when several persons share the screen
        yield from _day_lines(own.days, max(LIST_ROWS // len(shown.diaries), 10))
        yield ""
        yield fitted(totals_text(totals_of(own.days, 1)), TEXT_WIDTH)
        return
    else:
        yield from _period_lines(own.days, shown.period)
    if own.places:
        yield ""
        yield from _place_lines(own.places)
    if shown.place and own.places:
        yield ""
        yield from _hours_lines(own.places[0].hours)


def period_title(period: Period) -> str:
    """The name of a period with its dates: ``Wednesday 2024-05-01``, ``2024-W18 (2024-04-29 to 2024-05-05)``."""
    if period.kind == DAY:
        return f"{period.first:%A} {period.name}"
    return f"{period.name} ({period.first} to {period.last})"


def sums_text(shown: Overview, own: Diary) -> str:
    """The totals of one person in one line; of an overview of a place, its visits and the time there."""
    if shown.place:
        return f"{count(len(own.visits), 'visit')}; {time_text(sum(visit.duration for visit in own.visits))}"
    return totals_text(totals_of(own.days, len(shown.period)))


def totals_text(totals: Totals) -> str:
    """The totals in one line, of each kind that occurred."""
    steps = f", {totals.steps:,} steps" if totals.steps else ""
    texts = [
        f"walked {distance_text(totals.walked)} in {time_text(totals.walking)}{steps}" if totals.walking else "",
        f"rode {distance_text(totals.ridden)} in {time_text(totals.riding)}" if totals.riding else "",
        f"stayed {time_text(totals.staying)}" if totals.staying else "",
        f"no data {time_text(totals.unknown)}" if totals.unknown >= 60 else "",
    ]
    return "; ".join(filter(None, texts))


def time_text(seconds: float) -> str:
    """A duration as a text: ``45 s``, ``12 min``, ``2 h 05 min``, ``6.7 days``."""
    # longest hours [s] of a duration in hours; longer ones are in days
    return duration_text(seconds) if seconds < (96 * 3600.0) else f"{seconds / DAY_LENGTH:,.1f} days"


def _day_lines(days: Sequence[DiaryDay], most: int) -> Iterator[str]:
    """The list of a day."""
    for start, end, lasted, what, far, where in (texts for day in days for texts in list_texts(day.entries, most)):
        yield fitted(f"{start}  {end:<5}  {lasted:>10}  {what:<8}  {far:>8}  {where}".rstrip(), TEXT_WIDTH)


PERIOD_TITLES = ("", "walking", "riding", "staying", "no data", "walked", "ridden", "steps")
PERIOD_WIDTHS = (16, 13, 13, 13, 14, 10, 10, 11)


def _period_lines(days: Sequence[DiaryDay], period: Period) -> Iterator[str]:
    """A line per day of a week or a month, where days without data are counted, else per month or year; the totals."""
    yield _line(PERIOD_TITLES, PERIOD_WIDTHS)
    if period.kind in (WEEK, MONTH):
        yield from _lines_per_day(days, period)
    else:
        letters = 7 if len({day.date[:7] for day in days}) <= MOST_MONTHS else 4
        for name, own in days_by(days, letters):
            yield _line(totals_texts(f"{name}  {count(len(own), 'day')}", totals_of(own, len(own))), PERIOD_WIDTHS)
    yield _line(totals_texts("total", totals_of(days, len(period))), PERIOD_WIDTHS)


def _lines_per_day(days: Sequence[DiaryDay], period: Period) -> Iterator[str]:
    """A line per day; consecutive days without data are counted."""
    by_date = {day.date: day for day in days}
    for present, dates in groupby(period.dates, key=lambda on: on.isoformat() in by_date):
        if present:
            yield from (
                _line(totals_texts(f"{on:%a} {on}", by_date[on.isoformat()].totals), PERIOD_WIDTHS) for on in dates
            )
        else:
            yield f"{count(len(list(dates)), 'day')} without data"


def days_by(days: Sequence[DiaryDay], letters: int) -> Iterator[tuple[str, list[DiaryDay]]]:
    """The days in order with the same first letters of the date, and these letters."""
    return ((name, list(same)) for name, same in groupby(days, key=lambda day: day.date[:letters]))


def totals_texts(title: str, totals: Totals) -> list[str]:
    """A title and the totals, as of PERIOD_TITLES."""
    times = [totals.walking, totals.riding, totals.staying, totals.unknown]
    texts = [time_text(time) if time >= 0.5 else NOTHING for time in times]
    texts += [distance_text(far) if far >= 0.5 else NOTHING for far in (totals.walked, totals.ridden)]
    return [title, *texts, f"{totals.steps:,}" if totals.steps else NOTHING]


PLACE_TITLES, PLACE_WIDTHS = (
    ("place", "visits", "time", "comes (quartiles)", "leaves (quartiles)"),
    (28, 6, 12, 20, 20),
)
HOURS_TITLES, HOURS_WIDTHS = (
    ("", "arrivals", "comes (quartiles)", "departures", "leaves (quartiles)"),
    (10, 8, 20, 10, 20),
)


def _place_lines(places: Sequence[Place]) -> Iterator[str]:
    """The places with most time: visits, total time, usual hours."""
    yield _line(PLACE_TITLES, PLACE_WIDTHS)
    for place in places[:TEXT_PLACES]:
        usual = place.hours[0]
        hours = hours_text(usual.arrival), hours_text(usual.departure)
        yield _line([one_line(place.label), str(len(place.visits)), time_text(place.duration), *hours], PLACE_WIDTHS)
    if len(places) > TEXT_PLACES:
        rest = sum(place.duration for place in places[TEXT_PLACES:])
        yield f"and {count(len(places) - TEXT_PLACES, 'other place')}, {time_text(rest)}"


def _hours_lines(hours: Sequence[UsualHours]) -> Iterator[str]:
    """The usual hours of each weekday at one place."""
    yield _line(HOURS_TITLES, HOURS_WIDTHS)
    for usual in sorted(hours, key=lambda own: own.weekday == EVERY_DAY):
        yield _line(usual_texts(usual), HOURS_WIDTHS)


def usual_texts(usual: UsualHours) -> list[str]:
    """Usual hours as texts: weekday, and number and quartiles of arrivals and of departures."""
    come, go = hours_text(usual.arrival), hours_text(usual.departure)
    return [usual.weekday, str(usual.arrivals), come, str(usual.departures), go]


def hours_text(quartiles: tuple[float, float, float]) -> str:
    """Quartiles of a time of day as ``18:42 (18:10–19:05)``."""
    low, middle, high = quartiles
    return f"{hour_text(middle)} ({hour_text(low)}–{hour_text(high)})" if np.isfinite(middle) else NOTHING


def _visit_lines(visits: Sequence[TimelineEntry]) -> Iterator[str]:
    """The last visits to a place; a time that was not observed has a question mark."""
    if len(visits) > TEXT_VISITS:
        yield f"{count(len(visits) - TEXT_VISITS, 'earlier visit')}"
    for visit in visits[-TEXT_VISITS:]:
        since, until = visit_times(visit)
        yield f"{since:<23}  {until:<11}  {duration_text(visit.duration):>10}"
    if not all(visit.arrived and visit.left for visit in visits[-TEXT_VISITS:]):
        yield "?: no data before or after, so it may have begun earlier or ended later"


def visit_times(visit: TimelineEntry) -> tuple[str, str]:
    """Local start with its date and local end, with "?" where it was not observed, and "+1" for the next day."""
    first, last = local_date(visit.start + visit.offset), local_date(visit.end + visit.end_offset)
    start, end = clock_text(visit.start, visit.offset), clock_text(visit.end, visit.end_offset)
    later = f" +{(last - first).days}" if last > first else ""
    return f"{first:%a} {first}  {start}{'' if visit.arrived else '?'}", f"{end}{'' if visit.left else '?'}{later}"


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Cells beside each other, the first one to the left, the others to the right."""
    first = fitted(cells[0], widths[0])
    pad = widths[0] - text_width(first)
    others = "".join(
        f"{text:>{width}}" if width < 20 else f"  {text:<{width - 2}}"
        for text, width in zip(cells[1:], widths[1:], strict=True)
    )
    return f"{first}{' ' * pad}{others}".rstrip()


def text_width(text: str) -> int:
    """Columns of a text on a terminal: Chinese, Japanese and Korean letters have two."""
    return sum(1 + (unicodedata.east_asian_width(letter) in "WF") for letter in text)


def fitted(text: str, width: int) -> str:
    """A text of at most `width` columns, the end replaced by an ellipsis if necessary."""
    if text_width(text) <= width:
        return text
    kept = ""
    for letter in text:
        if text_width(kept + letter) > width - 1:
            break
        kept += letter
    return f"{kept}…"
