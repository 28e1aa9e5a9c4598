"""Show a day of a lifelog: as text, and as files that only their owner can read."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from zoneinfo import ZoneInfo

from pdr_graph.errors import InputError, one_line
from pdr_graph.lifelog import cache
from pdr_graph.lifelog.day import Day
from pdr_graph.lifelog.export import as_geojson, notes
from pdr_graph.lifelog.store import ZONE, Store
from pdr_graph.lifelog.timeline import printed, table, timeline

DPI = 130  # of the picture


def listed(path: Path) -> str:
    """Text with a line per person and day of a lifelog."""
    with Store(path) as log:
        days = log.days()
    lines = [(one_line(person), date, len(day.recordings)) for (person, date), day in days.items()]
    return "".join(f"{person}  {date}  {count} recording{'s' * (count != 1)}\n" for person, date, count in lines)


def show_day(path: Path, person: str | None = None, date: str | None = None, out: Path | None = None) -> str:
    """Text with the timeline of a day; files are written to ``out`` if given.

    out: folder for ``timeline.csv``, ``day.geojson``, ``day.png`` and ``report.html``; person: optional if there is
    only one; date: the last day by default. Raises InputError if there is no such day.
    """
    with Store(path) as log:
        zone = ZoneInfo(log.setting(ZONE))
        day = log.day(*_chosen(log, person, date))
    assert day is not None, "_chosen returns existing days only"
    entries = timeline(day)
    if out is not None:
        from pdr_graph.lifelog.picture import picture  # imports matplotlib, which is slow

        cache.write(out / "timeline.csv", table(entries, zone).encode())
        cache.write(out / "day.geojson", as_geojson([day]))
        drawn = io.BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph")  # letters that no font has are drawn as boxes
            picture(day, zone).savefig(drawn, format="png", dpi=DPI)
        cache.write(out / "day.png", drawn.getvalue())
    missing = [line for outing in day.outings for line in outing.missing]
    noted = [*notes([day]), *(line for outing in day.outings for line in outing.notes)]
    missing, noted = ([one_line(line) for line in dict.fromkeys(lines)] for lines in (missing, noted))
    if out is not None:
        missing += _write_report(out / "report.html", day, zone, missing, noted)
    remarks = [*(f"note: {line}" for line in noted), *(f"missing: {line}" for line in missing)]
    return printed(day, entries, zone) + "".join(f"{line}\n" for line in remarks)


def _write_report(
    path: Path, day: Day, zone: ZoneInfo, missing: Sequence[str], noted: Sequence[str]
) -> tuple[str, ...]:
    """Write the HTML report of a day; returns a line for a failure, else nothing."""
    try:
        from pdr_graph.lifelog.report import content
        from pdr_graph.report.page import page

        cache.write(path, page(content(day, zone, missing, noted)))
    except Exception as error:  # a failing report must not lose the result
        return (one_line(f"{path.name} ({type(error).__name__}: {error})"),)
    return ()


def _chosen(log: Store, person: str | None, date: str | None) -> tuple[str, str]:
    """The person and date of an existing day. Raises InputError if the choice is missing or unknown."""
    days = list(log.days())
    if not days:
        raise InputError(log.path, "", "no day", "a built lifelog: run pdr-graph lifelog build")
    people = sorted({one for one, _ in days})
    if person is None and len(people) > 1:
        raise InputError("--person", "", f"no choice, {len(people)} persons", f"one of {', '.join(people)}")
    person = people[0] if person is None else person
    dates = [day for one, day in days if one == person]
    if not dates:
        raise InputError("--person", "", repr(person), f"one of {', '.join(people)}")
    if date is not None and date not in dates:
        raise InputError("--date", "", repr(date), f"a recorded day from {dates[0]} to {dates[-1]}")
    return person, date or dates[-1]
