"""Show a day, week, month, year, place or person: as text, as JSON, and as files that only their owner can read."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from pdr_graph.errors import InputError, count
from pdr_graph.lifelog import cache
from pdr_graph.lifelog.diary import diary
from pdr_graph.lifelog.local_time import zone_of_outings
from pdr_graph.lifelog.overview import DayView, Overview, is_known, overview, view_of
from pdr_graph.lifelog.overview_tables import as_json, tables
from pdr_graph.lifelog.overview_text import as_text
from pdr_graph.lifelog.period import ALL, DAY, LAST_DATE, Period
from pdr_graph.lifelog.place_visits import place_label
from pdr_graph.lifelog.places import Place, likely_home
from pdr_graph.lifelog.store import ZONE, Store
from pdr_graph.lifelog.timeline import TimelineEntry
from pdr_graph.whole_files import output_folder

TOLERANCES = {DAY: 1.0}  # [m] by which drawn tracks may be simplified
LIKELY_HOME = "home?"  # name of the place where somebody spends the nights, for those who ask for the guess
MOST_NAMES = 12  # places that a message names


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
    ``overview.html``, ``overview.png``, ``days.csv``, ``places.csv``, ``visits.csv``, ``hours.csv``; of one day of one
    person also those of `report.write_day`. Raises InputError if there is no such person, place or day.
    """
    with Store(path) as log:
        persons = _persons(log, choice.persons)
        period = choice.period or _default_period(log, persons, choice)
        days, known = _views(log, persons, period, choice.guess_home)
        if not days:
            raise _no_day(log, persons, period)
        if period.kind == ALL:
            dates = [date.fromisoformat(day.date) for day in days]
            period = replace(period, first=min(dates), last=max(dates))
        chosen = overview(days, period, choice.place, known)
        if choice.place and not chosen.visits:
            raise _no_place(choice.place, days, period)
        folder = out or path.with_name(_folder_name(path, period))
        with output_folder(folder, private=True) if write else nullcontext() as staged:
            remarks = _written_day(log, chosen, staged)
            if staged is not None:
                remarks += _write(chosen, staged, template, remarks)
    return Shown(chosen, tuple(remarks), folder)


def _persons(log: Store, wanted: Sequence[str]) -> list[str]:
    """The persons to show. Raises InputError for one without days."""
    people = sorted({person for person, _ in log.days()})
    if not people:
        raise InputError(log.path, "", "no day", "lifelog build, and more than one position a day")
    for person in wanted:
        if person not in people:
            raise InputError("--person", "", repr(person), f"one of {', '.join(people)}")
    return list(dict.fromkeys(wanted)) or people


def _default_period(log: Store, persons: Sequence[str], choice: Choice) -> Period:
    """All days of a person or a place; else the last day."""
    last = max(date.fromisoformat(on) for person, on in log.days() if person in persons)
    if choice.persons or choice.place:
        return Period(ALL, "all days", date.min, LAST_DATE)
    return Period(DAY, last.isoformat(), last, last)


def _views(
    log: Store, persons: Sequence[str], period: Period, guess_home: bool
) -> tuple[list[DayView], dict[tuple[str, int], Place]]:
    """The days of a period that are not all without data, and all places by person and number."""
    tolerance = TOLERANCES.get(period.kind, 10.0)  # coarse tolerance [m], of longer periods
    days, places = list[DayView](), dict[tuple[str, int], Place]()
    for person in persons:
        found = diary(log, person, period.first.isoformat(), period.last.isoformat())
        home = likely_home(found.places) if guess_home else None
        own = [view_of(day, tolerance) for day in found.days if any(is_known(entry) for entry in day.entries)]
        days += [_with_home(day, home) for day in own] if home is not None else own
        places |= {(person, place.number): place for place in found.places}
    return days, places


def _with_home(day: DayView, home: Place) -> DayView:
    """The day with LIKELY_HOME as the name of a place that has none."""
    entries = (
        replace(entry, place=LIKELY_HOME) if entry.place_number == home.number and not entry.place else entry
        for entry in day.entries
    )
    return replace(day, entries=tuple(entries))


def _no_place(place: str, days: Sequence[DayView], period: Period) -> InputError:
    entries = [entry for day in days for entry in day.entries]
    labels = dict.fromkeys(filter(None, (place_label(entry.place, entry.place_number) for entry in entries)))
    named = ", ".join(list(labels)[:MOST_NAMES]) or "none"
    more = f" and {count(len(labels) - MOST_NAMES, 'other')}" if len(labels) > MOST_NAMES else ""
    return InputError("--place", period.name, repr(place), f"a place that was visited: {named}{more}")


def _no_day(log: Store, persons: Sequence[str], period: Period) -> InputError:
    dates = sorted(on for person, on in log.days() if person in persons)
    option = "" if period.kind == ALL else "--date" if period.kind == DAY else f"--{period.kind}"
    return InputError(option, "", repr(period.name), f"a recorded day from {dates[0]} to {dates[-1]}")


def _folder_name(path: Path, period: Period) -> str:
    return f"{path.stem}-{'shown' if period.kind == DAY else period.name.replace(' ', '-')}"


def _written_day(log: Store, chosen: Overview, folder: Path | None) -> list[str]:
    """Write the report of one day of one person; returns its remarks."""
    if chosen.period.kind != DAY or len(chosen.persons) != 1 or chosen.place:
        return []
    stored = log.day(chosen.persons[0], chosen.period.name)
    if stored is None:  # of an outing that began on the day before
        return []
    from pdr_graph.lifelog.report import DayRows, write_day  # imports matplotlib, which is slow

    [day] = chosen.days
    known = [n for n, entry in enumerate(day.entries) if is_known(entry)]
    entries = (_labelled(entry) for entry in day.entries[known[0] : known[-1] + 1])
    rows = DayRows(tuple(entries), day.totals)
    return write_day(stored, zone_of_outings(log.setting(ZONE), stored.outings), folder, rows)


def _labelled(entry: TimelineEntry) -> TimelineEntry:
    """The entry with the number of its place as its name, if it has none and none on a plan."""
    return entry if entry.facing else replace(entry, place=place_label(entry.place, entry.place_number))


def _write(chosen: Overview, folder: Path, template: str, remarks: Sequence[str]) -> list[str]:
    """Write the files of an overview; returns a line for each map without tiles."""
    from pdr_graph.lifelog import overview_page, overview_picture
    from pdr_graph.lifelog.report import PICTURE_DPI
    from pdr_graph.report.plotting import picture_bytes

    figure, failures = overview_picture.picture(chosen, template)
    for name, table in tables(chosen).items():
        cache.write(folder / name, table)
    cache.write(folder / "overview.png", picture_bytes(figure, PICTURE_DPI))
    svg = picture_bytes(figure, PICTURE_DPI, "svg")
    cache.write(folder / "overview.html", overview_page.page(chosen, svg, [*remarks, *failures]))
    return failures
