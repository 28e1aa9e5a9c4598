"""Correct a lifelog, and delete from it: times, recordings or persons, so that no byte of them is left in its files.

A correction finds the entries that a person means, is stored, and its day is rebuilt at once. Each function returns the
lines to print: the correction with its number, what the timeline shows now, and the days that were rebuilt.

What is deleted: rows of the store, observations, copies of recordings, days that are not stored yet. A recording with
data inside and outside of a deleted time is cut: its observation keeps the rest, its copy is deleted. The deleted time
itself is kept as a fact, so that recordings that are added or read again are cut, too.
"""

from __future__ import annotations

import re
import shutil
import time as clock
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from pdr_graph.apps.lifelog import build, cache
from pdr_graph.apps.lifelog.corrections import SLIVER, corrected, distance, place_names
from pdr_graph.apps.lifelog.day import Day, rows_of
from pdr_graph.apps.lifelog.diary import UnpartedDiary
from pdr_graph.apps.lifelog.facts import (
    ALWAYS,
    AT,
    ESTIMATE_KINDS,
    FORGOTTEN,
    MERGE,
    MODE,
    MODE_ACTIVITIES,
    NOT_ME,
    PLACE_NAME,
    SPLIT,
    VISITED,
    Correction,
    forgotten_times,
)
from pdr_graph.apps.lifelog.local_time import LocalClock
from pdr_graph.apps.lifelog.observation import (
    DELETED,
    entry_columns,
    is_usable,
    read_observation,
    to_bytes,
    without_times,
)
from pdr_graph.apps.lifelog.overview import row_texts
from pdr_graph.apps.lifelog.past.past_days import FOLDER as PAST
from pdr_graph.apps.lifelog.past.past_days import PastDays, cut_past, sources_of
from pdr_graph.apps.lifelog.places import Place, is_place
from pdr_graph.apps.lifelog.stays_and_legs import MOVING, VISIT_RADIUS, Track, on_sphere
from pdr_graph.apps.lifelog.store import TOGETHER, Entry, Store
from pdr_graph.apps.lifelog.timeline import TimelineEntry
from pdr_graph.errors import InputError, count, one_line
from pdr_graph.io.past_day import E7, MS
from pdr_graph.types import DAY_LENGTH, Array

AT_RADIUS = 15.0  # [m] default standard deviation per axis of a stated place: a point on a map, in a building
NAME_RADIUS = 75.0  # [m] default radius of a named place: positions of stays in one house scatter as far
LARGEST_RADIUS = 10_000.0  # [m]
LONGEST_CORRECTION = 366 * DAY_LENGTH  # [s] of one correction
DIARY_MARGIN = timedelta(days=3)  # that determine the rows of a day: a visit may last over nights
LATLON = re.compile(r"\s*([-+]?\d+(?:\.\d*)?)\s*,\s*([-+]?\d+(?:\.\d*)?)\s*", re.ASCII)
LOCAL_TIME_FORM = 'a local time such as "2024-05-01 09:30"'


@dataclass(frozen=True)
class OpenDiary:
    """The diary of a person in an open lifelog. rows: before midnights part them; clock: on the walls."""

    log: Store
    person: str
    rows: tuple[TimelineEntry, ...]
    clock: LocalClock
    places: tuple[Place, ...]
    track: Track

    @classmethod
    @contextmanager
    def opened(cls, store: Path, person: str | None, *near: str) -> Iterator[OpenDiary]:
        """Open a lifelog with the diary of a person, as of `of`."""
        with Store(store) as log:
            yield cls.of(log, person, *near)

    @classmethod
    def of(cls, log: Store, person: str | None, *near: str) -> OpenDiary:
        """The diary of a person; the only one by default. Raises InputError if the choice is ambiguous or unknown.

        near: dates or times as texts, to read the days around them alone; all days by default, and for other texts.
        """
        who = person_of(log, person)
        dates = [date for name, date in log.days() if name == who]
        with suppress(ValueError, OverflowError):  # of other texts
            days = [datetime.fromisoformat(text.strip()[:10]).date() for text in near]
            first, last = (min(days) - DIARY_MARGIN).isoformat(), (max(days) + DIARY_MARGIN).isoformat()
            dates = [date for date in dates if first <= date <= last]
        whole = UnpartedDiary.of(log, who, dates)
        return cls(log, who, whole.rows, whole.clock, whole.places, whole.track)

    def time(self, option: str, text: str) -> float:
        """The Unix time [s] of a text, local time by default. Raises InputError."""
        try:
            time = datetime.fromisoformat(text.strip())
            if time.tzinfo is None:
                near = self.clock.zone(time.replace(tzinfo=UTC).timestamp())
                time = time.replace(tzinfo=self.clock.zone(time.replace(tzinfo=near).timestamp()))
            return time.timestamp()
        except (ValueError, OverflowError):
            raise InputError(option, "", repr(text), LOCAL_TIME_FORM) from None

    def span(self, start: str, end: str) -> tuple[float, float]:
        """Unix times [s] of FROM and TO. Raises InputError if TO is not later, or far later."""
        begin, after = self.time("FROM", start), self.time("TO", end)
        if not 0 < after - begin <= LONGEST_CORRECTION:
            raise InputError("TO", "", f"{end}, {after - begin:.0f} s after FROM", "a later time, at most a year later")
        return begin, after

    def span_of_rows(self, start: str, end: str) -> tuple[float, float]:
        """As `span`, moved to starts and ends of rows within SLIVER. Raises InputError without any row."""
        begin, after = self.span(start, end)
        if not self.between(begin, after):
            raise InputError("FROM", "", f"nothing of {self.person} from {start} to {end}", "a time of the timeline")
        bounds = [time for row in self.rows for time in (row.start, row.end)]
        first, last = (
            min((bound for bound in bounds if abs(bound - time) <= SLIVER), key=lambda b: abs(b - time), default=time)
            for time in (begin, after)
        )
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
        words = (f"{self.hour(row.start)} to {self.hour(row.end)[11:]}", *row_texts(row)[2:])
        return "  ".join(word for word in words if word)

    def hour(self, time: float) -> str:
        """Local date and time of a Unix time [s]."""
        return f"{self.clock.at(time):%Y-%m-%d %H:%M:%S}"

    def make(self, kind: str, span: tuple[float, float], value: dict[str, float | str] | None = None) -> list[str]:
        """Store a correction and rebuild its day; returns the lines to print."""
        correction = Correction(0, self.person, clock.time(), kind, *span, value or {})
        correction = replace(correction, number=self.log.put_correction(correction))
        return [self.line(correction), *_effect(self.log, correction)]

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
        if correction.kind == PLACE_NAME:
            return f"{where} is called {named}"
        start, end = (self.hour(time) for time in correction.span)
        words = {
            AT: f"was at {' '.join(filter(None, [named, where]))}",
            MERGE: "one stay",
            MODE: f"was {correction.text('mode')}",
            NOT_ME: "not me",
            FORGOTTEN: "deleted",
            VISITED: f"{correction.text('source')} {named}, {where}",
        }
        return f"{start} to {end if end[:10] != start[:10] else end[11:]}: {words[correction.kind]}"


def state_place(store: Path, at: str, place: str, radius: float | None = None, person: str | None = None) -> list[str]:
    """State where the person was during the row at a time. place: "LAT,LON" or the name of a known place.

    radius: standard deviation per axis [m], AT_RADIUS by default. Raises InputError, as all functions here do, if an
    argument or the lifelog cannot be used.
    """
    with OpenDiary.opened(store, person, at) as diary:
        row = diary.row_at("TIME", at)
        latitude, longitude, name = _place(place, diary.log.corrections(diary.person))
        named = {"name": name} if name else {}
        return diary.make(AT, (row.start, row.end), _value(latitude, longitude, radius, AT_RADIUS) | named)


def merge(store: Path, start: str, end: str, person: str | None = None) -> list[str]:
    """Make one stay of all rows from one time to another; also returns a line for each walk or ride that vanishes."""
    with OpenDiary.opened(store, person, start, end) as diary:
        inside = diary.between(*diary.span_of_rows(start, end))
        gone = [f"no longer in the diary: {diary.text(row)}" for row in inside if row.kind in MOVING]
        return diary.make(MERGE, (inside[0].start, inside[-1].end)) + gone


def split(store: Path, at: str, person: str | None = None) -> list[str]:
    """Split the row at a time in two."""
    with OpenDiary.opened(store, person, at) as diary:
        diary.row_at("TIME", at)
        time = diary.time("TIME", at)
        return diary.make(SPLIT, (time, time))


def state_mode(store: Path, start: str, end: str, mode: str, person: str | None = None) -> list[str]:
    """State what the person did from one time to another. mode: one of `facts.MODE_ACTIVITIES`."""
    if mode not in MODE_ACTIVITIES:
        raise InputError("MODE", "", repr(mode), f"one of {', '.join(MODE_ACTIVITIES)}")
    with OpenDiary.opened(store, person, start, end) as diary:
        return diary.make(MODE, diary.span_of_rows(start, end), {"mode": mode})


def state_not_me(store: Path, start: str, end: str, person: str | None = None) -> list[str]:
    """State that what was recorded from one time to another is not this person's: it is shown as no data."""
    with OpenDiary.opened(store, person, start, end) as diary:
        return diary.make(NOT_ME, diary.span_of_rows(start, end))


def name_place(store: Path, place: str, name: str, radius: float | None = None, person: str | None = None) -> list[str]:
    """Name a place. place: "LAT,LON", or the time of a stay there; radius: [m], NAME_RADIUS by default."""
    if not (name.strip() and name.isprintable()):
        raise InputError("NAME", "", repr(name), "a name")
    with OpenDiary.opened(store, person, place) as diary:
        span = ALWAYS
        if found := LATLON.fullmatch(place):
            latitude, longitude = _degrees(found)
        else:
            row = diary.row_at("PLACE", place)
            latitude, longitude, span = row.latitude, row.longitude, (row.start, row.end)
            if not abs(latitude) <= 90:
                raise InputError("PLACE", "", f"{place}: {diary.text(row)}", "the time of a stay, or LAT,LON")
        return diary.make(PLACE_NAME, span, _value(latitude, longitude, radius, NAME_RADIUS) | {"name": name})


def listing(store: Path, person: str | None = None) -> list[str]:
    """A line per correction, of all persons by default: number, what it states, and when it was made."""
    with Store(store, reads=True) as log:
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
        if found[0].kind != FORGOTTEN:
            return [line, *_effect(log, found[0])]

        # Recordings that still exist have a time again that the next build may read
        own = [e for e in log.entries() if e.person == found[0].person and e.overlaps(*found[0].span)]
        there = [entry for entry in own if Path(entry.path).exists()]
        for entry in there:
            (log.folder / cache.OBSERVATIONS / entry.observation).unlink(missing_ok=True)
        again = f"{count(len(there), 'recording')} can be read again: pdr-graph lifelog build {log.path}"
        return [line, "what was deleted is not restored; recordings of that time may be added again", again]


def person_of(log: Store, person: str | None) -> str:
    """The person that is meant; the only one by default. Raises InputError if that is ambiguous or unknown."""
    people = log.people()
    if not people:
        raise InputError(log.path, "", "no recordings", "a lifelog with recordings: pdr-graph lifelog add")
    if person is None and len(people) > 1:
        raise InputError("--person", "", f"no choice, {len(people)} persons", f"one of {', '.join(people)}")
    if person is not None and person not in people:
        raise InputError("--person", "", repr(person), f"one of {', '.join(people)}")
    return people[0] if person is None else person


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


def _value(latitude: float, longitude: float, radius: float | None, default: float) -> dict[str, float | str]:
    """The value of a correction about a place [deg], within a radius [m]. Raises InputError for other radii."""
    radius = default if radius is None else radius
    if not 0 < radius <= LARGEST_RADIUS:
        raise InputError("--radius", "", f"{radius:g} m", f"metres above 0, up to {LARGEST_RADIUS:.0f}")
    return {"latitude": latitude, "longitude": longitude, "radius": radius}


def _rebuilt(log: Store, person: str, dates: Collection[str]) -> list[str]:
    """Rebuild days; returns a line per day, and one for the days that are left to the next build."""
    begun = clock.perf_counter()
    results, later = build.rebuild_dates(log, person, dates)
    done = f"rebuilt in {clock.perf_counter() - begun:.1f} s"
    lines = [f"{one_line(r.person)}, {r.date}: {r.failure or done}" for r in results]
    return lines + ([f"{count(later, 'day')} to build: pdr-graph lifelog build {log.path}"] if later else [])


def _effect(log: Store, correction: Correction) -> list[str]:
    """Rebuild the days of a correction if it changes their estimate; lines of what the timeline shows then."""
    dates = build.touched_dates(log, correction.person, *correction.span)
    lines = _rebuilt(log, correction.person, dates) if correction.kind in ESTIMATE_KINDS else []
    if correction.span == ALWAYS:
        return lines
    start, end = correction.span
    diary = OpenDiary.of(log, correction.person, *(datetime.fromtimestamp(t, UTC).isoformat() for t in (start, end)))
    shown = [row for row in diary.rows if row.start <= end and row.end >= start] if start == end else []
    return [*(f"  {diary.text(row)}" for row in shown or diary.between(start, end)), *lines]


LONGEST_FREE = 60.0  # [s] beside a forgotten position, and between two, that are forgotten with them
MOST_FORGOTTEN = 10  # forgotten times that are named
SHOWN_PAGES = ("overview.html", "report.html")  # of a folder that ``lifelog show`` writes beside the store by default


def forget(store: Path, start: str, end: str, person: str | None = None) -> list[str]:
    """Delete all that a lifelog holds of a person's time; returns the lines to print.

    start, end: local times. Raises InputError if they or the lifelog cannot be used; OSError of the disk: what is
    missing is then deleted by calling it again.
    """
    with OpenDiary.opened(store, person) as diary:
        return _forget(diary, [diary.span(start, end)])


def forget_place(store: Path, place: str, radius: float | None = None, person: str | None = None) -> list[str]:
    """Delete all that a lifelog holds of a person's times at a place, and its names; returns the lines to print.

    place: "LAT,LON", or the name or number of a place of the diary; radius: [m] within which positions are deleted,
    VISIT_RADIUS by default. Raises as `forget`.
    """
    radius = VISIT_RADIUS if radius is None else radius
    with OpenDiary.opened(store, person) as diary:
        places = [own for own in diary.places if is_place(place, own.name, own.number)]
        middles = [(own.latitude, own.longitude) for own in places if np.isfinite(own.latitude)]
        if found := LATLON.fullmatch(place):
            middles.append(_degrees(found))
            places = [own for own in diary.places if distance(*middles[0], own.latitude, own.longitude) <= radius]
        elif not places:
            named = ", ".join(own.label for own in diary.places) or "none"
            raise InputError("--place", "", repr(place), f"LAT,LON in degrees or a place of the diary: {named}")
        _value(0.0, 0.0, radius, radius)  # checks the radius
        times = [(visit.start, visit.end) for own in places for visit in own.visits]
        for middle in middles:
            times += _times_near(diary, middle, radius)
        spans = joined_spans(times, LONGEST_FREE)
        if not spans:
            raise InputError("--place", "", f"nothing of {diary.person} within {radius:.0f} m", "a larger --radius")
        for correction in diary.log.corrections(diary.person):
            near = "latitude" in correction.value and any(
                distance(*middle, *correction.place) <= radius for middle in middles
            )
            if near or (correction.text("name") and correction.text("name") in {own.name for own in places}):
                diary.log.delete_correction(correction.number)
        return _forget(diary, spans)


def _times_near(diary: OpenDiary, middle: tuple[float, float], radius: float) -> Iterator[tuple[float, float]]:
    """Times [s] with a position, recorded or estimated, or a guess within a radius [m] of a place [deg]."""
    log, track = diary.log, diary.track

    def runs(time: Array, lonlat: Array) -> Iterator[tuple[float, float]]:
        order = np.argsort(time, kind="stable")
        time, sphere = time[order], on_sphere(lonlat[order].reshape(-1, 2))
        near = np.linalg.norm(sphere - on_sphere(np.array([middle[::-1]])), axis=1) <= radius
        edges = np.flatnonzero(np.diff(np.r_[False, near, False]))
        for first, after in edges.reshape(-1, 2).tolist():  # half-way to the neighbours, where they are near in time
            beside = time[max(first - 1, 0)], time[min(after, len(time) - 1)]
            before, later = (time[first] + beside[0]) / 2, (time[after - 1] + beside[1]) / 2
            yield max(before, time[first] - LONGEST_FREE), min(later, time[after - 1] + LONGEST_FREE)

    yield from runs(track.time, track.lonlat)
    for entry in log.entries():
        file = log.folder / cache.OBSERVATIONS / entry.observation
        seen = read_observation(file) if entry.person == diary.person and entry.observation else None
        if seen is not None and seen.frame.georeferenced and len(seen.fixes):
            yield from runs(seen.epoch + seen.fixes.time, seen.frame.to_lonlat(seen.fixes.position))
    past = PastDays(log, diary.person)
    for day in past.days():
        rows, _ = past.read(day)
        yield from runs(rows["time"] / MS, np.column_stack([rows["lon"], rows["lat"]]) / E7)
    for guess in log.guesses(diary.person):
        if distance(*middle, guess.latitude, guess.longitude) <= radius:
            yield guess.start, guess.stop


def joined_spans(spans: Iterable[tuple[float, float]], apart: float) -> list[tuple[float, float]]:
    """Times as few spans, in order: those at most `apart` [s] from one another are one."""
    found: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if found and start - found[-1][1] <= apart:
            found[-1] = found[-1][0], max(found[-1][1], end)
        else:
            found.append((start, end))
    return found


def _forget(diary: OpenDiary, spans: Sequence[tuple[float, float]]) -> list[str]:
    """Delete all that a lifelog holds of some times [s] of a person; returns the lines to print."""
    log, who = diary.log, diary.person
    known = forgotten_times(log.corrections(who))
    facts = [Correction(0, who, clock.time(), FORGOTTEN, *span) for span in spans]
    for fact in facts:
        if fact.span not in known:  # else it was interrupted, and goes on
            log.put_correction(fact)
    touched = [e for e in log.entries() if e.person == who and any(e.overlaps(*span) for span in spans)]
    own = {entry.hash for entry in touched}
    dates = [date for (name, date), day in log.days().items() if name == who and own & set(day.recordings)]
    before = [day for date in dates if (day := log.day(who, date))]
    cut_past(log, who, spans)
    present = {entry.hash for entry in log.entries()}  # imported days were cut above
    forgotten = forgotten_times(log.corrections(who))
    removed = [entry for entry in touched if entry.hash in present and not _cut(log, entry, forgotten)]
    _remove(log, removed)
    for correction in log.corrections(who):
        if correction.kind != FORGOTTEN and correction.span != ALWAYS:
            _cut_correction(log, correction, spans)
    log.delete_days((who, date) for date in dates)
    _clean(log)
    build.observe_new(log, who)
    deleted = [diary.statement(fact).removesuffix(": deleted") for fact in facts]
    lines = [f"deleted of {one_line(who)}: {text}" for text in deleted[:MOST_FORGOTTEN]]
    lines += [f"and {count(len(deleted) - MOST_FORGOTTEN, 'other time')}"] if len(deleted) > MOST_FORGOTTEN else []
    lines.append(f"{count(len(touched), 'recording')} had data then, {len(removed)} of them nothing else")
    kept = {entry.hash for entry in touched} - {entry.hash for entry in removed}
    now = [date for (name, date), made in build.recordings_by_day(log).items() if name == who and kept & made.keys()]
    lines += _rebuilt(log, who, {*dates, *now})
    for day in before:
        _put_rest(log, day, facts)
    log.compact()
    named = sum(c.kind == PLACE_NAME for c in log.corrections(who))
    remain = f"{count(named, 'place')} with a name remain: pdr-graph lifelog correct list"
    return lines + _still_there(log, touched, {who: spans}) + ([remain] if named else [])


def _put_rest(log: Store, day: Day, facts: Sequence[Correction]) -> None:
    """Put what remains of a day of positions in place of its new estimate: beside what was deleted nothing changes."""
    own, rebuilt = log.days().get((day.person, day.date)), log.day(day.person, day.date)
    if own is None or rebuilt is None or any(outing.steps for outing in (*day.outings, *rebuilt.outings)):
        return
    from pdr_graph.apps.lifelog.privacy import with_new_origin  # with plans, which are slow to import

    left = (with_new_origin(replace(o, recordings=own.recordings)) for o in corrected(day, facts).outings)
    log.put_day(rows_of(replace(rebuilt, outings=tuple(left)), own.key, own.recordings))


def _cut_correction(log: Store, correction: Correction, spans: Sequence[tuple[float, float]]) -> None:
    """Delete a correction of forgotten times, or keep of it what is outside of them."""
    start, end = correction.span
    for first, last in spans:
        if first <= start and end <= last and correction.touches(first, last):
            log.delete_correction(correction.number)
            return
        start, end = (last if first <= start < last else start), (first if first < end <= last else end)
    if (start, end) != correction.span:
        log.put_correction(replace(correction, start=start, end=end))


def forget_recording(store: Path, recording: str) -> list[str]:
    """Delete a recording, by its path or the beginning of its content hash, and the days made of it."""
    with Store(store) as log:
        path = str(Path(recording).resolve())
        found = [e for e in log.entries() if e.path == path or (len(recording) >= 8 and e.hash.startswith(recording))]
        if len(found) != 1:
            expected = "the path or content hash of one recording of the lifelog"
            raise InputError("RECORDING", "", f"{count(len(found), 'recording')} by {recording!r}", expected)
        [entry] = found
        dates = [
            date for (who, date), day in log.days().items() if who == entry.person and entry.hash in day.recordings
        ]
        _remove(log, found)
        log.delete_days((entry.person, date) for date in dates)
        _clean(log)
        lines = ["deleted: one recording", *_rebuilt(log, entry.person, dates)]
        log.compact()
        imported = entry.epoch is not None and Path(entry.path).is_relative_to(log.folder)
        span = (entry.epoch or 0.0, (entry.epoch or 0.0) + (entry.duration or 0.0))
        return lines + _still_there(log, found, {entry.person: [span]} if imported else {})


def forget_person(store: Path, person: str) -> list[str]:
    """Delete all of a person: recordings, days, corrections, phones, and that times of theirs were deleted."""
    with Store(store) as log:
        who = person_of(log, person)
        found = [entry for entry in log.entries() if entry.person == who]
        there = _still_there(log, found, {who: [ALWAYS]})
        _remove(log, found)
        log.delete_person(who)
        shutil.rmtree(PastDays(log, who).folder, ignore_errors=True)
        _clean(log)
        again = "nothing is kept, not even what was deleted: what is added or imported again is there again"
        return [f"deleted: {one_line(who)}, {count(len(found), 'recording')}", again, *there]


def _cut(log: Store, entry: Entry, spans: Sequence[tuple[float, float]]) -> bool:
    """Cut the observation of a recording and delete its copy; False if nothing remains of it."""
    file = log.folder / cache.OBSERVATIONS / entry.observation
    observation = read_observation(file)
    if observation is None:  # a build reads the recording again, if it still exists, and cuts it then
        file.unlink(missing_ok=True)
        return Path(entry.path).exists()
    cut = without_times(observation, spans, DELETED)
    if cut is None or not is_usable(cut):
        return False
    if cut is not observation:
        cache.write(file, to_bytes(cut))
        log.put(replace(entry, **entry_columns(cut)))
        _delete_copy(log, entry)
    return True


def _remove(log: Store, entries: Iterable[Entry]) -> None:
    """Delete recordings with their observations and copies."""
    for entry in entries:
        if entry.observation:
            (log.folder / cache.OBSERVATIONS / entry.observation).unlink(missing_ok=True)
        _delete_copy(log, entry)
        log.delete(entry.hash)


def _delete_copy(log: Store, entry: Entry) -> None:
    """Delete what ``STORE.d`` holds of a recording beside its observation."""
    shutil.rmtree(log.folder / cache.COPIES / entry.hash, ignore_errors=True)
    if Path(entry.path).is_relative_to(log.folder):
        Path(entry.path).unlink(missing_ok=True)


def _clean(log: Store) -> None:
    """Delete files that nothing refers to, and rewrite the store without what was deleted."""
    log.put_setting(TOGETHER, "")
    cache.remove_all_but(log.folder / cache.OBSERVATIONS, {entry.observation for entry in log.entries()})
    for folder in (cache.DAYS, cache.DIGESTS):
        cache.remove_all_but(log.folder / folder, set())
    for folder in (cache.COPIES, PAST):
        cache.remove_partial_copies(log.folder / folder)
    log.compact()


def _still_there(
    log: Store, entries: Iterable[Entry], deleted: Mapping[str, Sequence[tuple[float, float]]]
) -> list[str]:
    """A line for each file outside of the lifelog that still has the deleted data.

    deleted: times of persons [s], of which imported files may have some.
    """
    files = [path for e in entries for path in (Path(e.path), *(e.options.files.get(n) for n in ("fixes", "ranges")))]
    for who, times in deleted.items():
        for path, spans in sources_of(log, who).items():
            if not spans or any(a <= end and start <= b for a, b in spans for start, end in times):
                files.append(path)
    beside = sorted(log.path.resolve().parent.glob(f"{log.path.stem}-*"))
    shown = [folder for folder in beside if any((folder / page).exists() for page in SHOWN_PAGES)]
    there = dict.fromkeys(path for path in (*files, *shown) if path is not None and path.exists())
    return [f"still on your disk: {one_line(str(path))}" for path in there if not path.is_relative_to(log.folder)]
