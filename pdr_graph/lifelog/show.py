"""What a lifelog has to show of a person's day: on a terminal, and as files that are their owner's alone."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from zoneinfo import ZoneInfo

from pdr_graph.errors import InputError, one_line
from pdr_graph.lifelog import files
from pdr_graph.lifelog.day import Day
from pdr_graph.lifelog.export import as_geojson, notes
from pdr_graph.lifelog.store import ZONE, Store
from pdr_graph.lifelog.timeline import printed, table, timeline

DOTS = 130  # per inch of the picture


def listed(path: Path) -> str:
    """The persons and days of a lifelog, a line each."""
    with Store(path) as log:
        days = log.days()
    lines = [(one_line(person), date, len(day.recordings)) for (person, date), day in days.items()]
    return "".join(f"{person}  {date}  {count} recording{'s' * (count != 1)}\n" for person, date, count in lines)


def show_day(path: Path, person: str | None = None, date: str | None = None, out: Path | None = None) -> str:
    """The timeline of a day for a terminal; out: a folder for it as ``timeline.csv``, ``day.geojson`` and ``day.png``.

    person: need not be said where there is only one; date: the last one if it is not said. Raises InputError if there
    is no such day.
    """
    with Store(path) as log:
        zone = ZoneInfo(log.setting(ZONE))
        day = log.day(*_chosen(log, person, date))
    assert day is not None, "one that is there was chosen"
    entries = timeline(day)
    if out is not None:
        from pdr_graph.lifelog.picture import picture  # it takes matplotlib, long to import

        files.write(out / "timeline.csv", table(entries, zone).encode())
        files.write(out / "day.geojson", as_geojson([day]))
        drawn = io.BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph")  # names that no font here has are boxes
            picture(day, zone).savefig(drawn, format="png", dpi=DOTS)
        files.write(out / "day.png", drawn.getvalue())
    return printed(day, entries, zone) + "".join(f"{line}\n" for line in _remarks(day))


def _remarks(day: Day) -> list[str]:
    """What a user must know of a day, a line each."""
    said = [f"note: {one_line(line)}" for line in (*notes([day]), *(n for o in day.outings for n in o.notes))]
    said += [f"missing: {one_line(line)}" for outing in day.outings for line in outing.missing]
    return list(dict.fromkeys(said))


def _chosen(log: Store, person: str | None, date: str | None) -> tuple[str, str]:
    """Whose day is meant, and which."""
    days = list(log.days())
    if not days:
        raise InputError(log.path, "", "no day", "a lifelog that pdr-graph lifelog build has built")
    people = sorted({one for one, _ in days})
    if person is None and len(people) > 1:
        raise InputError("--person", "", f"none, of {len(people)}", f"one of {', '.join(people)}")
    person = people[0] if person is None else person
    dates = [day for one, day in days if one == person]
    if not dates:
        raise InputError("--person", "", repr(person), f"one of {', '.join(people)}")
    if date is not None and date not in dates:
        raise InputError("--date", "", repr(date), f"a day from {dates[0]} to {dates[-1]} that was recorded")
    return person, date or dates[-1]
