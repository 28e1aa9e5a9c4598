"""An overview of a day, week, month or year of any persons: numbers, text for a terminal, CSV tables, and JSON.

Every second of a day counts once: as walking, riding, staying, or no data. A stay over midnight is one visit, and its
time is divided between both days, as are the steps and the distance of a walk over midnight.

Text has lines of at most 100 columns. A day is a list that fits a screen: the shortest entries are merged with their
neighbours, and counted.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import groupby
from types import MappingProxyType
from typing import Any

import numpy as np
from rich.cells import cell_len, set_cell_size

from pdr_graph.apps.lifelog.day import GAP, PRIVATE, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import Diary, DiaryDay, Totals, repeated, totals_of
from pdr_graph.apps.lifelog.local_time import DAY, Period
from pdr_graph.apps.lifelog.places import (
    EVERY_DAY,
    FEWEST_HOURS,
    Dwell,
    Flow,
    Place,
    UsualHours,
    dwells,
    flows,
    is_place,
    joined_visits,
    local_date,
    places_of_visits,
)
from pdr_graph.apps.lifelog.timeline import (
    KIND_NAMES,
    PASSING,
    STAY,
    TimelineEntry,
    csv_table,
    distance_text,
    duration_text,
    local_iso,
)
from pdr_graph.errors import count, one_line
from pdr_graph.types import DAY_LENGTH, OneLineRepr

MOST_PERSONS = 6  # each of whom has tables on the page


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
    def is_fleet(self) -> bool:
        """True for so many persons that they are shown together."""
        return len(self.diaries) > MOST_PERSONS

    @cached_property
    def dwells(self) -> list[Dwell]:
        """The time of all persons at each place on a plan, longest first."""
        return dwells((day.person, row) for day in self.days for row in day.entries)

    @cached_property
    def flows(self) -> list[Flow]:
        """How often persons went from one place on a plan to the next, largest first."""
        return flows(day.entries for day in self.days)

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
        visits = [visit for visit in visits if not place or is_place(place, visit.place, visit.place_number)]
        found.append(replace(own, visits=tuple(visits), places=places_of_visits(visits, own.places)))
    label = next((visit.label for own in found for visit in own.visits), "") if place else ""
    return Overview(period, label, tuple(found))


JSON_FORMAT, JSON_VERSION = "pdr_graph lifelog overview", 1  # raise the number when a key changes its meaning
DEGREE_DIGITS = {"latitude": 7, "longitude": 7}  # of columns
SUM_COLUMNS = "walking riding staying no_data observed walked ridden steps"
Record = dict[str, Any]


DAY_COLUMNS = f"person date start end {SUM_COLUMNS}"
ENTRY_COLUMNS = (
    "kind start end duration observed distance floor place number latitude longitude sigma mode corrected guess likely "
    "evidence"
)
PLACE_COLUMNS = "person number place latitude longitude sigma visits duration first last"
VISIT_COLUMNS = "person place number start end duration observed arrived left latitude longitude sigma"
DWELL_COLUMNS = "place floor persons stops time sigma median busiest"
FLOW_COLUMNS = "origin origin_floor target target_floor number sigma"
BUSY_COLUMNS = "place floor hour time"
HOURS_COLUMNS = (
    "person number place weekday arrivals arrival_25 arrival_50 arrival_75 "
    "departures departure_25 departure_50 departure_75"
)


def _record(columns: str, source: object, **values: Any) -> Record:
    """A row of a table: a value by column, of `values`, else the attribute of the source."""
    return {name: values[name] if name in values else getattr(source, name) for name in columns.split()}


def day_record(day: DiaryDay) -> Record:
    """A day: midnights, times per kind [s], distances [m], steps."""
    last = day.entries[-1].end_offset if day.entries else 0.0
    span = {"start": local_iso(day.start, day.offset), "end": local_iso(day.end, last)}
    return _record(DAY_COLUMNS, day.totals, person=day.person, date=day.date, no_data=day.totals.unknown, **span)


def entry_record(columns: str, entry: TimelineEntry, **values: Any) -> Record:
    """An entry of a day or a visit: local times, durations [s], distance [m], position [deg] and sigma [m]."""
    span = {"start": local_iso(entry.start, entry.offset), "end": local_iso(entry.end, entry.end_offset)}
    about = {"floor": " > ".join(entry.floor), "number": entry.place_number, "likely": dict(entry.likely)}
    about |= {"evidence": evidence_text(entry)}
    return _record(columns, entry, **span, **about, **values)


def visit_record(person: str, visit: TimelineEntry) -> Record:
    """A visit; observed: its time with data [s]."""
    return entry_record(VISIT_COLUMNS, visit, person=person, observed=visit.observed * visit.duration)


def place_record(person: str, place: Place) -> Record:
    """A place: position [deg] with sigma [m], visits, total time [s], first and last date."""
    return _record(PLACE_COLUMNS, place, person=person, place=place.name, visits=len(place.visits))


def hours_record(usual: UsualHours) -> Record:
    """Usual hours of a place on a weekday: quartiles of arrivals and departures, local time, NaN where unknown."""
    about: Record = {"weekday": usual.weekday}
    for name, quartiles in (("arrival", usual.arrival), ("departure", usual.departure)):
        about[f"{name}s"] = getattr(usual, f"{name}s")
        for part, hour in zip(("25", "50", "75"), quartiles, strict=True):
            about[f"{name}_{part}"] = hour_text(hour) or np.nan
    return about


def dwell_record(dwell: Dwell) -> Record:
    """Time at a place on a plan [s] with its standard deviation, expected persons and stops, and the busiest hour."""
    return _record(DWELL_COLUMNS, dwell, place=dwell.name, busiest=f"{dwell.hour:02d}:00")


def place_records(dwelt: Sequence[Dwell], went: Sequence[Flow]) -> dict[str, tuple[list[Record], str]]:
    """Rows and columns of the tables of places on plans by file name, without empty ones: time, flows, hours."""
    busy = [
        _record(BUSY_COLUMNS, dwell, place=dwell.name, hour=f"{hour:02d}:00", time=time)
        for dwell in dwelt
        for hour, time in enumerate(dwell.hours.tolist())
        if time > 0
    ]
    found = {
        "dwell.csv": ([dwell_record(dwell) for dwell in dwelt], DWELL_COLUMNS),
        "flows.csv": ([_record(FLOW_COLUMNS, flow) for flow in went], FLOW_COLUMNS),
        "busy.csv": (busy, BUSY_COLUMNS),
    }
    return {name: made for name, made in found.items() if made[0]}


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
    records |= place_records(shown.dwells, shown.flows)
    return {name: csv_table(rows, columns.split(), DEGREE_DIGITS).encode() for name, (rows, columns) in records.items()}


def as_json(shown: Overview) -> str:
    """Everything in an overview as one JSON object on one line of ASCII; unknown numbers are null.

    Its keys are in docs/formats.md.
    """
    period, persons = shown.period, list[Record]()
    for own in shown.diaries:
        totals = totals_of(own.days, len(period))
        about = {"person": own.person, "days": totals.days, "days_with_data": totals.recorded}
        persons.append(about | _record(SUM_COLUMNS, totals, no_data=totals.unknown))
    document: Record = {
        "format": JSON_FORMAT,
        "version": JSON_VERSION,
        "period": _record("kind name first last", period, first=str(period.first), last=str(period.last)),
        "place": shown.place,
        "persons": persons,
        "days": [
            day_record(day) | {"entries": [entry_record(ENTRY_COLUMNS, entry) for entry in day.entries]}
            for day in shown.days
        ],
        "places": [
            place_record(person, place) | {"hours": [hours_record(usual) for usual in place.hours]}
            for person, place in shown.places
        ],
        "visits": [visit_record(*visited) for visited in shown.visits],
    }
    return json.dumps(_plain(document), allow_nan=False)


def _plain(value: Any, name: str = "") -> Any:
    """The value with rounded numbers, and None instead of NaN."""
    if isinstance(value, dict):
        return {key: _plain(own, key) for key, own in value.items()}
    if isinstance(value, list):
        return [_plain(own, name) for own in value]
    if isinstance(value, float):
        return round(value, DEGREE_DIGITS.get(name, 3)) if np.isfinite(value) else None
    return value


ROW_TITLES = ("from", "to", "for", "what", "distance", "where", "probability")
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
TRAVEL_KINDS = (WALKING, PASSING, VEHICLE)


ListRow = tuple[TimelineEntry, Counter[str]]  # an entry, and how many of each of MERGED_NAMES were merged with it


def day_list(entries: Sequence[TimelineEntry], most: int = LIST_ROWS) -> list[ListRow]:
    """At most `most` rows (at least one) of the entries of a day.

    The shortest row is merged with its longer neighbour, a walk or ride before a stay; with both if they are one.
    """
    rows = [(entry, Counter[str]()) for entry in entries]
    while len(rows) > max(most, 1):
        n = min(range(len(rows)), key=lambda k: rows[k][0].duration)
        beside = [k for k in (n - 1, n + 1) if 0 <= k < len(rows)]
        kept = max(beside, key=lambda k: (rows[k][0].kind in TRAVEL_KINDS, rows[k][0].duration))
        taken = slice(min(n, kept), max(n, kept) + 1)
        if len(beside) == 2 and _identity(rows[n - 1][0]) == _identity(rows[n + 1][0]):
            kept, taken = n - 1, slice(n - 1, n + 2)
        merged = sum((counter for _, counter in rows[taken]), Counter([MERGED_NAMES[rows[n][0].kind]]))
        far = sum(entry.distance for entry, _ in rows[taken])
        start, end = rows[taken][0][0].start, rows[taken][-1][0].end
        rows[taken] = [(replace(rows[kept][0], start=start, end=end, distance=far), merged)]
    return rows


def _identity(entry: TimelineEntry) -> tuple[object, ...]:
    """Equal for entries that are one if nothing is between them."""
    if entry.kind != STAY:
        return (entry.kind,)
    return (STAY, entry.place_number, entry.place) if entry.place_number >= 0 else (STAY, entry.x, entry.y)


def list_texts(entries: Sequence[TimelineEntry], most: int = LIST_ROWS) -> list[tuple[str, ...]]:
    """The list of a day as texts; times have seconds if a row is shorter than a minute."""
    rows = day_list(entries, most)
    seconds = any(entry.duration < 60 for entry, _ in rows)
    return [row_texts(entry, merged, seconds) for entry, merged in rows]


def row_texts(
    entry: TimelineEntry, merged: Mapping[str, int] = MappingProxyType({}), seconds: bool = False
) -> tuple[str, str, str, str, str, str, str]:
    """Texts of a row: local start and end, duration, activity, distance, place with what was merged, probability.

    The end has "+1" if it is on the next date, after a flight over time zones.
    """
    far = distance_text(entry.distance) if entry.kind in (*TRAVEL_KINDS, STAY) and entry.distance >= 0.5 else ""
    common = Counter(merged).most_common()
    texts = [f"{n} slow passes" if name == "slow pass" and n > 1 else count(n, name) for name, n in common[:2]]
    texts += [count(others, "other")] if (others := sum(number for _, number in common[2:])) else []
    words = [
        _place(entry),
        one_line(entry.guess),
        evidence_text(entry),
        "corrected" if entry.corrected else "",
        f"and {', '.join(texts)}" if texts else "",
    ]
    start, end = entry.start + entry.offset, entry.end + entry.end_offset
    later = int(end // DAY_LENGTH - start // DAY_LENGTH) if end % DAY_LENGTH > 0 else 0
    return (
        clock_text(entry.start, entry.offset, seconds),
        clock_text(entry.end, entry.end_offset, seconds) + (f" +{later}" if later else ""),
        duration_text(entry.duration),
        entry.mode or KIND_NAMES.get(entry.kind, entry.kind),
        far,
        "; ".join(filter(None, words)),
        likely_text(entry),
    )


def likely_text(entry: TimelineEntry) -> str:
    """The probability of the activity of an entry, and the others from one twentieth on: ``84 %, riding 10 %``."""
    own = STAY if entry.kind == STANDING else entry.kind
    texts = [f"{p:.0%}" if p < 0.995 else ">99%" for kind, p in entry.likely if kind == own]
    texts += [f"{KIND_NAMES.get(kind, kind)} {p:.0%}" for kind, p in entry.likely if kind != own and p >= 0.05]
    return ", ".join(texts)


def evidence_text(entry: TimelineEntry) -> str:
    """Receipts and photos of the time of an entry, with local times."""
    inside = [(time, text) for time, text in entry.evidence if entry.start <= time <= entry.end]
    return "; ".join(f"{clock_text(time, entry.offset)} {one_line(text)}" for time, text in sorted(inside))


def entry_text(entry: TimelineEntry) -> str:
    """An entry in one line: local times, what, and where."""
    start, end, lasts, what, far, where, _ = row_texts(entry)
    return f"{start}–{end}  {', '.join(filter(None, (what, lasts, far, where)))}"


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


def clock_text(time: float, offset: float, seconds: bool = False) -> str:
    """Local time of day of a Unix time [s] at an offset from UTC [s]: ``07:42``, or ``07:42:15``."""
    moment = datetime.fromtimestamp(round(time + offset), UTC)
    return f"{moment:%H:%M:%S}" if seconds else f"{moment:%H:%M}"


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


def guess_notes(shown: Overview) -> list[str]:
    """A line for each program of whose guesses a part of the days is made."""
    guessed = Counter[str]()
    for entry in (entry for day in shown.days for entry in day.entries if entry.is_guess):
        guessed[entry.guess.partition(":")[0]] += round(entry.duration)
    return [f"{duration_text(lasts)} are what {source} guessed, without data" for source, lasts in guessed.items()]


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


def visit_times(visit: TimelineEntry) -> tuple[str, str]:
    """Local start with its date and local end, with "?" where it was not observed, and "+1" for the next day."""
    first, last = local_date(visit.start + visit.offset), local_date(visit.end + visit.end_offset)
    start, end = clock_text(visit.start, visit.offset), clock_text(visit.end, visit.end_offset)
    later = f" +{(last - first).days}" if last > first else ""
    return f"{first:%a} {first}  {start}{'' if visit.arrived else '?'}", f"{end}{'' if visit.left else '?'}{later}"


TEXT_WIDTH = 100  # columns of a line
NOTHING = "–"
PERIOD_TITLES = ("", "walking", "riding", "staying", "no data", "walked", "ridden", "steps")
VISIT_TITLES = ("place", "from", "to", "for", "with data")
PLACE_TITLES = (
    *("place", "visits", "time", "comes (quartiles)", "leaves (quartiles)"),
    *("first", "last", "latitude, longitude"),
)
HOURS_TITLES = ("place", "weekday", "arrivals", "comes (quartiles)", "departures", "leaves (quartiles)")


@dataclass(frozen=True)
class ShownTable:
    """A table of an overview for people.

    rows: texts, a cell per name of the head; note: below it, "" for none; subjects: what each row is about: a person, a
    day, a place, a visit, a day with the number of its entry, or None; () for no table of these.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    subjects: Sequence[Diary | DiaryDay | Place | TimelineEntry | tuple[DiaryDay, int] | None] = ()


def shown_tables(shown: Overview, own: Diary, short: bool) -> Iterator[ShownTable]:
    """The tables of one person. short: for a terminal: fewer rows, and usual hours of a single place alone."""
    places, visits = own.places[: 12 if short else 200], own.visits[-(20 if short else 500) :]
    is_list = shown.period.kind == DAY and not shown.place
    if is_list:
        # least rows of a day's list when several persons share the screen; all rows on a page
        most = max(LIST_ROWS // len(shown.diaries), 10)
        rows = [texts for day in own.days for texts in list_texts(day.entries, most if short else len(day.entries))]
        subjects = [(day, n) for day in own.days for n in range(len(day.entries))]
        yield ShownTable("the day", ROW_TITLES, rows, "", () if short else subjects)
    elif not (short and shown.place):
        again = repeated(own.days)
        note = f"clocks repeated {time_text(again)} on the way: the total counts these hours once" if again else ""
        rows, subjects = zip(*_period_rows(own.days, shown.period, 31 if short else 400), strict=True)
        yield ShownTable("days", PERIOD_TITLES, rows, note, subjects)
    if not is_list and (shown.place or not short):
        rows = [
            [v.label, *visit_times(v), duration_text(v.duration), f"{v.observed:.0%}" if v.duration > 0 else ""]
            for v in visits
        ]
        hidden = len(own.visits) - len(visits)
        note = f"{count(hidden, 'earlier visit')} in visits.csv. " if hidden else ""
        if not all(visit.arrived and visit.left for visit in visits):
            note += "?: no data before or after, so it may have begun earlier or ended later"
        yield ShownTable("visits", VISIT_TITLES, rows, note, visits)
    if not (is_list and short):
        rest = own.places[len(places) :]
        note = f"and {count(len(rest), 'other place')}, {time_text(sum(p.duration for p in rest))}" if rest else ""
        yield replace(places_table(places, short), note=note)
    if shown.place or not short:
        rows = [
            [place.label, usual.weekday, *usual_texts(usual)]
            for place in places
            for usual in sorted(place.hours, key=lambda usual: usual.weekday == EVERY_DAY)
            if max(usual.arrivals, usual.departures) >= FEWEST_HOURS
        ]
        yield ShownTable("usual hours", HOURS_TITLES, rows)


def places_table(places: Sequence[Place], short: bool) -> ShownTable:
    """The table of places. short: its first columns, for a terminal."""
    rows = [place_texts(place, short) for place in places]
    return ShownTable("places", PLACE_TITLES[: 5 if short else None], rows, "", places)


FLOW_TITLES = ("from", "to", "persons went")
DWELL_TITLES = ("place", "floor", "persons", "stops", "time", "a stop (median)", "busiest")


def fleet_tables(shown: Overview, short: bool) -> Iterator[ShownTable]:
    """The tables of all persons together. short: for a screen."""
    most = 15 if short else 300
    persons = sorted(shown.diaries, key=lambda own: -sum(day.totals.observed for day in own.days))
    rows = [_totals_texts(short_text(own.person), totals_of(own.days, len(shown.period))) for own in persons[:most]]
    note = f"and {count(len(persons) - most, 'other person')} in days.csv" if len(persons) > most else ""
    yield ShownTable("persons", ("person", *PERIOD_TITLES[1:]), rows, note, persons[:most])
    dwelt = [
        [
            short_text(d.name),
            d.floor,
            f"{d.persons:.0f}",
            f"{d.stops:.0f}",
            f"{time_text(d.time)} ± {time_text(d.sigma)}",
            duration_text(d.median),
            f"{d.hour:02d}:00–{d.hour + 1:02d}:00",
        ]
        for d in shown.dwells[:most]
    ]
    hidden = len(shown.dwells) - most
    note = f"and {count(hidden, 'other place')} in dwell.csv. " if hidden > 0 else ""
    hours = np.sum([dwell.hours for dwell in shown.dwells], axis=0) if shown.dwells else np.zeros(24)
    busiest = [
        f"{n:02d}:00 ({time_text(float(hours[n]))})" for n in np.argsort(-hours, kind="stable")[:3] if hours[n] >= 1
    ]
    note += f"Busiest hours: {', '.join(busiest)}. " if busiest else ""
    note += "Expected values by the probabilities of the stays."
    yield ShownTable("time at places", DWELL_TITLES, dwelt, note)
    went = [
        [short_text(flow.origin), short_text(flow.target), f"{flow.number:.1f} ± {flow.sigma:.1f}"]
        for flow in shown.flows[: most // 2]
    ]
    hidden = len(shown.flows) - len(went)
    yield ShownTable(
        "from place to place", FLOW_TITLES, went, f"and {count(hidden, 'other')} in flows.csv" if hidden else ""
    )


def short_text(name: str) -> str:
    """A name on one line that fits a column."""
    return fitted(one_line(name), 28)


def fleet_text(shown: Overview) -> str:
    """The totals of all persons together in one line."""
    return totals_text(replace(totals_of(shown.days, len(shown.days)), unknown=0.0))


def _period_rows(
    days: Sequence[DiaryDay], period: Period, most: int
) -> Iterator[tuple[Sequence[str], DiaryDay | None]]:
    """Totals of each day, of each month or year if there are more than `most` days; days without data are counted."""
    by_date = {day.date: day for day in days}
    letters = next(n for n in (10, 7, 4) if n == 4 or len({on[:n] for on in by_date}) <= most)
    names = {on[:letters] for on in by_date}
    for present, dates in groupby(period.dates, key=lambda on: str(on)[:letters] in names):
        on_dates = list(dates)
        if not present:
            yield [f"{count(len(on_dates), 'day')} without data", *[""] * (len(PERIOD_TITLES) - 1)], None
            continue
        for name, same in groupby(on_dates, key=lambda on: str(on)[:letters]):
            every = list(same)
            own = [by_date[str(on)] for on in every if str(on) in by_date]
            title = f"{every[0]:%a} {name}" if letters == 10 else f"{name}  {len(own)} of {count(len(every), 'day')}"
            yield _totals_texts(title, totals_of(own, len(every))), own[0] if letters == 10 else None
    yield _totals_texts("total", totals_of(days, len(period))), None


def _totals_texts(title: str, totals: Totals) -> list[str]:
    """A title and the totals, as of PERIOD_TITLES."""
    times = [totals.walking, totals.riding, totals.staying, totals.unknown]
    texts = [time_text(time) if time >= 0.5 else NOTHING for time in times]
    texts += [distance_text(far) if far >= 0.5 else NOTHING for far in (totals.walked, totals.ridden)]
    return [title, *texts, f"{totals.steps:,}" if totals.steps else NOTHING]


def place_texts(place: Place, short: bool = False) -> list[str]:
    """A place with the usual hours of every day, as of PLACE_TITLES; short: the first five."""
    usual = [usual_texts(own) for own in place.hours if own.weekday == EVERY_DAY]
    texts = [list(dict.fromkeys(text[n] for text in usual if text[n] != NOTHING)) for n in (1, 3)]
    if short:  # of two modes the medians
        texts = [[text.split()[0] for text in own] if len(own) > 1 else own for own in texts]
    comes, leaves = (", ".join(own) or NOTHING for own in texts)
    row = [fitted(one_line(place.label), 28), str(len(place.visits)), time_text(place.duration), comes, leaves]
    where = f"{place.latitude:.5f}, {place.longitude:.5f} ± {place.sigma:.0f} m" if place.sigma >= 0 else ""
    return row if short else [place.label, *row[1:], place.first, place.last, where]


def usual_texts(usual: UsualHours) -> list[str]:
    """Number and quartiles of arrivals and of departures, as ``18:42 (18:10–19:05)``."""
    texts = []
    for number, (low, middle, high) in ((usual.arrivals, usual.arrival), (usual.departures, usual.departure)):
        span = f"{hour_text(middle)} ({hour_text(low)}–{hour_text(high)})" if np.isfinite(middle) else NOTHING
        texts += [str(number), span]
    return texts


def as_text(shown: Overview) -> str:
    """The overview as text, a part per person; lines have at most TEXT_WIDTH columns."""
    parts = []
    if shown.is_fleet:
        lines = [f"{count(len(shown.diaries), 'person')}  {period_title(shown.period)}  {shown.place}".rstrip()]
        for table in fleet_tables(shown, short=True):
            if table.rows:
                lines += [*aligned([table.head, *table.rows]), *filter(None, [table.note]), ""]
        parts.append("\n".join(fitted(line, TEXT_WIDTH) for line in [*lines, fleet_text(shown)]))
    for own in () if shown.is_fleet else shown.diaries:
        place = f"  {one_line(shown.place)}" if shown.place else ""
        blocks = [[f"{one_line(own.person)}  {period_title(shown.period)}{place}"]]
        for table in shown_tables(shown, own, short=True):
            if table.rows:
                blocks.append([*aligned([table.head, *table.rows]), *filter(None, [table.note])])
        if shown.period.kind == DAY and not shown.place:
            blocks.append([totals_text(totals_of(own.days, 1))])
        blocks[:2] = [[line for block in blocks[:2] for line in block]]
        parts.append("\n\n".join("\n".join(fitted(line, TEXT_WIDTH) for line in block) for block in blocks))
    return "\n\n".join(parts) + "\n"


def aligned(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Rows of a table with its head as lines; columns of numbers are to the right, others to the left."""
    columns = list(zip(*[[one_line(cell) for cell in row] for row in rows], strict=True))
    padded = []
    for column in columns:
        wide = max(map(cell_len, column))
        right = all(cell[0].isdigit() or cell == NOTHING for cell in column[1:] if cell)
        pads = [" " * (wide - cell_len(cell)) for cell in column]
        padded.append([pad + cell if right else cell + pad for cell, pad in zip(column, pads, strict=True)])
    return ("  ".join(cells).rstrip() for cells in zip(*padded, strict=True))


def fitted(text: str, width: int) -> str:
    """A text of at most `width` columns of a terminal, the end replaced by an ellipsis if necessary."""
    return text if cell_len(text) <= width else f"{set_cell_size(text, width - 1)}…"
