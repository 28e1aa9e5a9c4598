"""Correct a lifelog: find the entries that a person means, store the correction, and rebuild its day at once.

Each function returns the lines to print: the correction with its number, what the timeline shows now, and the days that
were rebuilt.
"""

from __future__ import annotations

import re
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pdr_graph.errors import InputError, count, one_line
from pdr_graph.lifelog import build
from pdr_graph.lifelog.cache import OBSERVATIONS
from pdr_graph.lifelog.corrections import place_names
from pdr_graph.lifelog.diary import UnpartedDiary
from pdr_graph.lifelog.facts import (
    ALWAYS,
    AT,
    ESTIMATED,
    FORGOTTEN,
    MERGE,
    MODE,
    MODES,
    NAME,
    NOT_ME,
    SPLIT,
    Correction,
)
from pdr_graph.lifelog.local_time import LocalClock
from pdr_graph.lifelog.store import Store
from pdr_graph.lifelog.timeline import TimelineEntry, entry_texts

AT_RADIUS = 15.0  # [m] default standard deviation per axis of a stated place: a point on a map, in a building
NAME_RADIUS = 75.0  # [m] default radius of a named place: positions of stays in one house scatter as far
LARGEST_RADIUS = 10_000.0  # [m]
SNAP = 60.0  # [s] from the start or end of an entry, within which a time means that: people read minutes
LONGEST = 366 * 86400.0  # [s] of one correction
DAYS_AROUND = timedelta(days=3)  # that determine the rows of a day: a visit may last over nights
LATLON = re.compile(r"\s*([-+]?\d+(?:\.\d*)?)\s*,\s*([-+]?\d+(?:\.\d*)?)\s*", re.ASCII)
TIME_FORM = 'a local time such as "2024-05-01 09:30"'


@dataclass(frozen=True)
class OpenDiary:
    """The diary of a person in an open lifelog. rows: before midnights part them; clock: on the walls."""

    log: Store
    person: str
    rows: tuple[TimelineEntry, ...]
    clock: LocalClock

    @classmethod
    def of(cls, log: Store, person: str | None, *near: str) -> OpenDiary:
        """The diary of a person; the only one by default. Raises InputError if the choice is ambiguous or unknown.

        near: dates or times as texts, to read the days around them alone; all days by default, and for other texts.
        """
        who = person_of(log, person)
        dates = [date for name, date in log.days() if name == who]
        whole = UnpartedDiary.of(log, who, _dates_near(dates, near))
        return cls(log, who, whole.rows, whole.clock)

    def time(self, option: str, text: str) -> float:
        """The Unix time [s] of a text, local time by default. Raises InputError."""
        try:
            time = datetime.fromisoformat(text.strip())
            if time.tzinfo is None:
                near = self.clock.zone(time.replace(tzinfo=UTC).timestamp())
                time = time.replace(tzinfo=self.clock.zone(time.replace(tzinfo=near).timestamp()))
            return time.timestamp()
        except (ValueError, OverflowError):
            raise InputError(option, "", repr(text), TIME_FORM) from None

    def span(self, start: str, end: str) -> tuple[float, float]:
        """Unix times [s] of FROM and TO. Raises InputError if TO is not later, or far later."""
        begin, after = self.time("FROM", start), self.time("TO", end)
        if not 0 < after - begin <= LONGEST:
            raise InputError("TO", "", f"{end}, {after - begin:.0f} s after FROM", "a later time, at most a year later")
        return begin, after

    def span_of_rows(self, start: str, end: str) -> tuple[float, float]:
        """As `span`, moved to starts and ends of rows within SNAP. Raises InputError without any row."""
        begin, after = self.span(start, end)
        if not self.between(begin, after):
            raise InputError("FROM", "", f"nothing of {self.person} from {start} to {end}", "a time of the timeline")
        bounds = [time for row in self.rows for time in (row.start, row.end)]
        first, last = (min(bounds, key=lambda bound: abs(bound - time)) for time in (begin, after))
        first, last = first if abs(first - begin) <= SNAP else begin, last if abs(last - after) <= SNAP else after
        return (first, last) if first < last else (begin, after)

    def between(self, start: float, end: float) -> list[TimelineEntry]:
        """The rows of a time [s]."""
        return [row for row in self.rows if row.start < end and row.end > start]

    def row_at(self, option: str, text: str) -> TimelineEntry:
        """The row at a local time. Raises InputError if there is none."""
        time = self.time(option, text)
        found = [row for row in self.rows if row.start <= time < row.end]
        if not found:
            expected = "a time of the timeline: pdr-graph lifelog show"
            raise InputError(option, "", f"nothing of {self.person} at {text}", expected)
        return found[0]

    def text(self, row: TimelineEntry) -> str:
        """A row as a line."""
        lasted, what, far, floor, place = entry_texts(row)
        words = (f"{self.hour(row.start)} to {self.hour(row.end)[11:]}", lasted, what, far, floor, place)
        return "  ".join(word for word in words if word)

    def hour(self, time: float) -> str:
        """Local date and time of a Unix time [s]."""
        return f"{self.clock.at(time):%Y-%m-%d %H:%M:%S}"

    def make(self, kind: str, span: tuple[float, float], value: dict[str, float | str] | None = None) -> list[str]:
        """Store a correction and rebuild its day; returns the lines to print."""
        correction = Correction(0, self.person, clock.time(), kind, *span, value or {})
        correction = replace(correction, number=self.log.put_correction(correction))
        return [self.line(correction), *_rebuilt(self.log, correction)]

    def line(self, correction: Correction) -> str:
        """A correction as a line: number, person, what it states, and when it was made."""
        made = f"{datetime.fromtimestamp(correction.made, UTC):%Y-%m-%d %H:%M} UTC"
        return f"{correction.number}  {one_line(self.person)}  {self.statement(correction)}  (made {made})"

    def statement(self, correction: Correction) -> str:
        """What a correction states, in words."""
        if correction.kind == SPLIT:
            return f"split at {self.hour(correction.start)}"
        named, where = one_line(correction.text("name")), ""
        if "latitude" in correction.value:
            where = "{:.5f}, {:.5f}".format(*correction.place) + f" ± {correction.radius:.0f} m"
        if correction.kind == NAME:
            return f"{where} is called {named}"
        start, end = (self.hour(time) for time in correction.span)
        words = {
            AT: f"was at {' '.join(filter(None, [named, where]))}",
            MERGE: "one stay",
            MODE: f"was {correction.text('mode')}",
            NOT_ME: "not me",
            FORGOTTEN: "deleted",
        }
        return f"{start} to {end if end[:10] != start[:10] else end[11:]}: {words[correction.kind]}"


def state_place(store: Path, at: str, place: str, radius: float | None = None, person: str | None = None) -> list[str]:
    """State where the person was during the row at a time. place: "LAT,LON" or the name of a known place.

    radius: standard deviation per axis [m], AT_RADIUS by default. Raises InputError, as all functions here do, if an
    argument or the lifelog cannot be used.
    """
    with Store(store) as log:
        diary = OpenDiary.of(log, person, at)
        row = diary.row_at("TIME", at)
        latitude, longitude, name = _place(place, log.corrections(diary.person))
        value: dict[str, float | str] = {"latitude": latitude, "longitude": longitude}
        value["radius"] = _radius(radius, AT_RADIUS)
        return diary.make(AT, (row.start, row.end), value | ({"name": name} if name else {}))


def merge(store: Path, start: str, end: str, person: str | None = None) -> list[str]:
    """Make one stay of all rows from one time to another."""
    with Store(store) as log:
        diary = OpenDiary.of(log, person, start, end)
        inside = diary.between(*diary.span_of_rows(start, end))
        return diary.make(MERGE, (inside[0].start, inside[-1].end))


def split(store: Path, at: str, person: str | None = None) -> list[str]:
    """Split the row at a time in two."""
    with Store(store) as log:
        diary = OpenDiary.of(log, person, at)
        diary.row_at("TIME", at)
        time = diary.time("TIME", at)
        return diary.make(SPLIT, (time, time))


def state_mode(store: Path, start: str, end: str, mode: str, person: str | None = None) -> list[str]:
    """State what the person did from one time to another. mode: one of `facts.MODES`."""
    if mode not in MODES:
        raise InputError("MODE", "", repr(mode), f"one of {', '.join(MODES)}")
    with Store(store) as log:
        diary = OpenDiary.of(log, person, start, end)
        return diary.make(MODE, diary.span_of_rows(start, end), {"mode": mode})


def state_not_me(store: Path, start: str, end: str, person: str | None = None) -> list[str]:
    """State that what was recorded from one time to another is not this person's: it is shown as no data."""
    with Store(store) as log:
        diary = OpenDiary.of(log, person, start, end)
        return diary.make(NOT_ME, diary.span_of_rows(start, end))


def name_place(store: Path, place: str, name: str, radius: float | None = None, person: str | None = None) -> list[str]:
    """Name a place. place: "LAT,LON", or the time of a stay there; radius: [m], NAME_RADIUS by default."""
    if not (name.strip() and name.isprintable()):
        raise InputError("NAME", "", repr(name), "a name")
    with Store(store) as log:
        diary, span = OpenDiary.of(log, person, place), ALWAYS
        if found := LATLON.fullmatch(place):
            latitude, longitude = _degrees(found)
        else:
            row = diary.row_at("PLACE", place)
            latitude, longitude, span = row.latitude, row.longitude, (row.start, row.end)
            if not abs(latitude) <= 90:
                raise InputError("PLACE", "", f"{place}: {diary.text(row)}", "the time of a stay, or LAT,LON")
        value: dict[str, float | str] = {"latitude": latitude, "longitude": longitude, "name": name}
        return diary.make(NAME, span, value | {"radius": _radius(radius, NAME_RADIUS)})


def listing(store: Path, person: str | None = None) -> list[str]:
    """A line per correction, of all persons by default: number, what it states, and when it was made."""
    with Store(store) as log:
        found = log.corrections(person)
        diaries = {who: OpenDiary.of(log, who) for who in dict.fromkeys(c.person for c in found)}
        return [diaries[c.person].line(c) for c in found] or ["no corrections"]


def undo(store: Path, number: int) -> list[str]:
    """Undo a correction, and rebuild its day.

    Deleted data do not come back by this; but recordings that still exist may be read again by the next build.
    """
    with Store(store) as log:
        found = [c for c in log.corrections() if c.number == number]
        if not found:
            raise InputError("N", "", f"{number}", "the number of a correction: pdr-graph lifelog correct list")
        line = f"undone: {OpenDiary.of(log, found[0].person).line(found[0])}"
        log.delete_correction(number)
        return [line, *(_read_again if found[0].kind == FORGOTTEN else _rebuilt)(log, found[0])]


def person_of(log: Store, person: str | None) -> str:
    """The person that is meant; the only one by default. Raises InputError if that is ambiguous or unknown."""
    people = sorted({entry.person for entry in log.entries()} | {c.person for c in log.corrections()})
    if not people:
        raise InputError(log.path, "", "no recordings", "a lifelog with recordings: pdr-graph lifelog add")
    if person is None and len(people) > 1:
        raise InputError("--person", "", f"no choice, {len(people)} persons", f"one of {', '.join(people)}")
    if person is not None and person not in people:
        raise InputError("--person", "", repr(person), f"one of {', '.join(people)}")
    return people[0] if person is None else person


def _dates_near(dates: Sequence[str], texts: Sequence[str]) -> list[str]:
    """The dates from DAYS_AROUND before the first to DAYS_AROUND after the last of some; all if one is no date."""
    try:
        days = [datetime.fromisoformat(text.strip()[:10]).date() for text in texts]
        first, last = min(days) - DAYS_AROUND, max(days) + DAYS_AROUND
    except (ValueError, OverflowError):
        return list(dates)
    return [date for date in dates if first.isoformat() <= date <= last.isoformat()]


def _place(text: str, corrections: Sequence[Correction]) -> tuple[float, float, str]:
    """Latitude, longitude [deg] and name ("" without one) of a place. Raises InputError for other texts."""
    if found := LATLON.fullmatch(text):
        return *_degrees(found), ""
    named = {name: (latitude, longitude) for latitude, longitude, _, name in place_names(corrections)}
    if text not in named:
        known = ", ".join(named) or "none yet: pdr-graph lifelog correct name"
        raise InputError("PLACE", "", repr(text), f"LAT,LON in degrees or the name of a place ({known})")
    return *named[text], text


def _degrees(found: re.Match[str]) -> tuple[float, float]:
    latitude, longitude = float(found[1]), float(found[2])
    if abs(latitude) > 90 or abs(longitude) > 180:
        swapped = ": swapped?" if abs(longitude) <= 90 else ""
        raise InputError("PLACE", "", f"{found[0]}{swapped}", "latitude,longitude in degrees")
    return latitude, longitude


def _radius(radius: float | None, default: float) -> float:
    if radius is None:
        return default
    if not 0 < radius <= LARGEST_RADIUS:
        raise InputError("--radius", "", f"{radius:g} m", f"metres above 0, up to {LARGEST_RADIUS:.0f}")
    return radius


def _rebuilt(log: Store, correction: Correction) -> list[str]:
    """Rebuild the days of a correction if it changes their estimate; lines of what the timeline shows then."""
    lines = list[str]()
    if correction.kind in ESTIMATED:
        begun = clock.perf_counter()
        results, later = build.rebuild(log, correction.person, *correction.span)
        took = clock.perf_counter() - begun
        lines += [f"{one_line(r.person)}, {r.date}: {r.failure or f'rebuilt in {took:.1f} s'}" for r in results]
        lines += [f"{count(later, 'day')} to build: pdr-graph lifelog build {log.path}"] if later else []
    if correction.span == ALWAYS:
        return lines
    start, end = correction.span
    diary = OpenDiary.of(log, correction.person, *(datetime.fromtimestamp(t, UTC).isoformat() for t in (start, end)))
    shown = [row for row in diary.rows if row.start <= end and row.end >= start] if start == end else []
    return [*(f"  {diary.text(row)}" for row in shown or diary.between(start, end)), *lines]


def _read_again(log: Store, correction: Correction) -> list[str]:
    """Let the next build read recordings again that still exist, with a time that is no longer deleted."""
    own = [e for e in log.entries() if e.person == correction.person and e.overlaps(*correction.span)]
    there = [entry for entry in own if Path(entry.path).exists()]
    for entry in there:
        (log.folder / OBSERVATIONS / entry.observation).unlink(missing_ok=True)
    again = f"{count(len(there), 'recording')} can be read again: pdr-graph lifelog build {log.path}"
    return ["what was deleted is not restored; recordings of that time may be added again", again]
