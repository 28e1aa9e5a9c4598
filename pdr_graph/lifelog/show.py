"""What a lifelog has to show of a person's day: on a terminal, and as files that are their owner's alone."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
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
    """The timeline of a day for a terminal; out: a folder for it as ``timeline.csv``, ``day.geojson``, ``day.png``
    and ``report.html``.

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
    missing = [line for outing in day.outings for line in outing.missing]
    said = [*notes([day]), *(line for outing in day.outings for line in outing.notes)]
    missing, said = ([one_line(line) for line in dict.fromkeys(lines)] for lines in (missing, said))
    if out is not None:
        missing += _write_report(out / "report.html", day, zone, missing, said)
    remarks = [*(f"note: {line}" for line in said), *(f"missing: {line}" for line in missing)]
    return printed(day, entries, zone) + "".join(f"{line}\n" for line in remarks)


def _write_report(path: Path, day: Day, zone: ZoneInfo, missing: Sequence[str], said: Sequence[str]) -> tuple[str, ...]:
    """The day as a page; returns what could not be written."""
    try:
        from pdr_graph.lifelog.report import content
        from pdr_graph.report.page import page

        files.write(path, page(content(day, zone, missing, said)))
    except Exception as error:  # a report must not cost the result
        return (one_line(f"{path.name} ({type(error).__name__}: {error})"),)
    return ()


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
