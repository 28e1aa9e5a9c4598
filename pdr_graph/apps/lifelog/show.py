"""Show a day, week, month, year, place or person: as text, as JSON, and as files that only their owner can read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.corrections import corrected
from pdr_graph.apps.lifelog.day import Day
from pdr_graph.apps.lifelog.diary import Diary, DiaryDay, dates_of, detailed, diary
from pdr_graph.apps.lifelog.local_time import ALL, DAY, LAST_DATE, Period
from pdr_graph.apps.lifelog.overview import (
    Overview,
    as_json,
    as_text,
    evidence_text,
    guess_notes,
    overview,
    tables,
)
from pdr_graph.apps.lifelog.places import Place, likely_home
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import timeline_csv
from pdr_graph.errors import InputError, count, one_line
from pdr_graph.whole_files import output_folder

TRACK_TOLERANCE = 10.0  # [m] to which the tracks of more than a day are simplified
LIKELY_HOME = "home?"  # name of the place where somebody spends the nights, for those who ask for the guess
MOST_NAMES = 12  # places that a message names
FORMER_FILES = ("overview.png", "report.html", "day.png")  # of earlier versions: stale beside a new page


@dataclass(frozen=True)
class Choice:
    """What to show.

    persons: () for all; period: None for the last day, or all days of a person or place; place: its name or number, ""
    for all; guess_home: True names the likely home of each person LIKELY_HOME.
    """

    persons: tuple[str, ...] = ()
    period: Period | None = None
    place: str = ""
    guess_home: bool = False


@dataclass(frozen=True)
class Shown:
    """An overview with remarks on its days, a line each. folder: where its files are by default."""

    overview: Overview
    remarks: tuple[str, ...]
    folder: Path

    @property
    def text(self) -> str:
        """The overview as text."""
        return as_text(self.overview) + "".join(f"{line}\n" for line in self.remarks)

    @property
    def json(self) -> str:
        """The overview as one JSON object."""
        return as_json(self.overview)


def show(path: Path, choice: Choice, out: Path | None = None, template: str = "", write: bool = True) -> Shown:
    """The overview of a choice; its files are written to the folder `out`, by default one named after the lifelog.

    template: address of map tiles, "" for none, which are fetched then. write: False writes no files. Files:
    ``overview.html``, ``days.csv``, ``places.csv``, ``visits.csv``, ``hours.csv``; of one day of one person also
    ``timeline.csv`` and ``day.geojson``. Raises InputError if there is no such person, place or day.
    """
    with Store(path, reads=True) as log:
        chosen = overview_of(log, choice)
        folder = out or path.with_name(_folder_name(path, chosen.period))
        with output_folder(folder, private=True, without=FORMER_FILES) if write else nullcontext() as staged:
            remarks = _written(log, chosen, staged, template)
    return Shown(chosen, tuple(remarks), folder)


def overview_of(log: Store, choice: Choice) -> Overview:
    """The overview of a choice. Raises InputError if there is no such person, place or day."""
    persons = _persons(log, choice.persons)
    period = choice.period or _default_period(log, persons, choice)
    diaries = list(_diaries(log, persons, period, choice.guess_home))
    if not diaries:
        raise _no_day(log, persons, period)
    if period.kind == ALL:
        dates = [date.fromisoformat(day.date) for own in diaries for day in own.days]
        period = replace(period, first=min(dates), last=max(dates))
    chosen = overview(diaries, period, choice.place)
    if choice.place and not chosen.visits:
        raise _no_place(choice.place, diaries, period)
    return chosen


def _persons(log: Store, wanted: Sequence[str]) -> list[str]:
    """The persons to show. Raises InputError for one without days."""
    people = sorted({person for person, _ in dates_of(log)})
    if not people:
        raise InputError(log.path, "", "no day", "lifelog build, and more than one position a day")
    for person in wanted:
        if person not in people:
            raise InputError("--person", "", repr(person), f"one of {', '.join(people)}")
    return list(dict.fromkeys(wanted)) or people


def _default_period(log: Store, persons: Sequence[str], choice: Choice) -> Period:
    """All days of a person or a place; else the last day."""
    last = max(date.fromisoformat(on) for person, on in dates_of(log) if person in persons)
    if choice.persons or choice.place:
        return Period(ALL, "all days", date.min, LAST_DATE)
    return Period(DAY, last.isoformat(), last, last)


def _diaries(log: Store, persons: Sequence[str], period: Period, guess_home: bool) -> Iterator[Diary]:
    """The diaries of persons with known days in a period, and these days."""
    for person in persons:
        tolerance = 0.0 if period.kind == DAY else TRACK_TOLERANCE
        found = diary(log, person, period.first.isoformat(), period.last.isoformat(), tolerance)
        home = likely_home(found.places) if guess_home else None
        days = [day if home is None else _with_home(day, home) for day in found.days if day.known]
        if days:
            yield replace(found, days=tuple(days))


def _with_home(day: DiaryDay, home: Place) -> DiaryDay:
    """The day with LIKELY_HOME as the name of a place that has none."""
    entries = (
        replace(entry, place=LIKELY_HOME) if entry.place_number == home.number and not entry.place else entry
        for entry in day.entries
    )
    return replace(day, entries=tuple(entries))


def _no_place(place: str, diaries: Sequence[Diary], period: Period) -> InputError:
    labels = dict.fromkeys(e.label for own in diaries for day in own.days for e in day.entries if e.label)
    named = ", ".join(list(labels)[:MOST_NAMES]) or "none"
    more = f" and {count(len(labels) - MOST_NAMES, 'other')}" if len(labels) > MOST_NAMES else ""
    return InputError("--place", period.name, repr(place), f"a place that was visited: {named}{more}")


def _no_day(log: Store, persons: Sequence[str], period: Period) -> InputError:
    dates = sorted(on for person, on in dates_of(log) if person in persons)
    option = "" if period.kind == ALL else "--date" if period.kind == DAY else f"--{period.kind}"
    return InputError(option, "", repr(period.name), f"a recorded day from {dates[0]} to {dates[-1]}")


def _folder_name(path: Path, period: Period) -> str:
    return f"{path.stem}-{'shown' if period.kind == DAY else period.name.replace(' ', '-')}"


def _written(log: Store, chosen: Overview, folder: Path | None, template: str) -> list[str]:
    """Write the files of an overview to a folder, None for nowhere; returns the remarks on it."""
    is_day = chosen.period.kind == DAY and len(chosen.persons) == 1 and not chosen.place
    # none of an outing that began on the day before
    who, on = chosen.persons[0], chosen.period.name
    found = log.day(who, on) if is_day else None
    stored = corrected(found, log.corrections(who)) if found else None
    notes, missing = _remarks(stored) if stored else ([], [])
    remarks = [*(f"note: {line}" for line in [*notes, *guess_notes(chosen)]), *(f"missing: {line}" for line in missing)]
    if folder is not None:
        remarks += _files(chosen, stored, folder, template, remarks)
    beside = [evidence_text(entry) for day in chosen.days if is_day for entry in day.entries if entry.evidence]
    return [*remarks, *filter(None, beside), *(f"note: {line}" for own in chosen.diaries for line in own.doubts)]


def _files(shown: Overview, stored: Day | None, folder: Path, template: str, remarks: Sequence[str]) -> list[str]:
    """Write the files of an overview; returns a line if there are no tiles. stored: the day with its outings."""
    from pdr_graph.apps.lifelog.overview_page import page  # scipy and plans, which are slow to import

    html, failures = page(shown, template, remarks)
    cache.write(folder / "overview.html", html)
    for name, content in tables(shown).items():
        cache.write(folder / name, content)
    if stored is not None:
        from pdr_graph.apps.lifelog.export import DiaryRows, as_geojson  # as slow

        rows = DiaryRows({own.date: own.entries for own in shown.days})
        entries = detailed(rows.by_date.get(stored.date, ()))
        cache.write(folder / "timeline.csv", timeline_csv(entries).encode())
        cache.write(folder / "day.geojson", as_geojson([stored], {stored.person: rows}))
    return failures


def _remarks(day: Day) -> tuple[list[str], list[str]]:
    """The notes of the outings of a day, and what is missing, a line each."""
    from pdr_graph.apps.lifelog.export import not_exported  # scipy and plans, which are slow to import

    notes = [*not_exported([day]), *(line for outing in day.outings for line in outing.notes)]
    missing = [line for outing in day.outings for line in outing.missing]
    return [one_line(line) for line in dict.fromkeys(notes)], [one_line(line) for line in dict.fromkeys(missing)]
