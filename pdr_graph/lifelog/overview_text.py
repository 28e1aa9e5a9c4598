"""An overview as text for a terminal: lines of at most 100 columns."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Sequence
from datetime import date
from itertools import groupby

import numpy as np

from pdr_graph.errors import count, one_line
from pdr_graph.lifelog.day_list import MOST_ROWS, clock_text, distance_text, list_texts
from pdr_graph.lifelog.overview import DayView, Overview, Totals, totals_of
from pdr_graph.lifelog.overview_tables import hour_text
from pdr_graph.lifelog.period import DAY, MONTH, WEEK, Period
from pdr_graph.lifelog.place_visits import DAY_LENGTH, EVERY_DAY, PlaceSummary, PlaceVisit, UsualHours
from pdr_graph.lifelog.timeline import duration_text

WIDTH = 100  # columns of a line
MOST_PLACES, MOST_VISITS, MOST_MONTHS = 12, 20, 25  # rows of tables
NOTHING = "–"


def as_text(shown: Overview) -> str:
    """The overview as text, a part per person."""
    return (
        "\n\n".join("\n".join(_person_lines(shown.of(person), len(shown.persons))) for person in shown.persons) + "\n"
    )


def _person_lines(own: Overview, persons: int) -> Iterator[str]:
    """The lines of one person."""
    [person], period = own.persons, own.period
    yield fitted(f"{one_line(person)}  {period_title(period)}{f'  {one_line(own.place)}' if own.place else ''}", WIDTH)
    if own.place:
        yield from _visit_lines(own.visits)
    elif period.kind == DAY:
        # least rows of a day's list when several persons share the screen
        yield from _day_lines(own.days, max(MOST_ROWS // persons, 10))
        yield ""
        yield fitted(totals_text(totals_of(own.days, 1)), WIDTH)
        return
    else:
        yield from _period_lines(own)
    if own.places:
        yield ""
        yield from _place_lines(own.places)
    if own.place and own.places:
        yield ""
        yield from _hours_lines(own.places[0].hours)


def period_title(period: Period) -> str:
    """The name of a period with its dates: ``Wednesday 2024-05-01``, ``2024-W18 (2024-04-29 to 2024-05-05)``."""
    if period.kind == DAY:
        return f"{period.first:%A} {period.name}"
    return f"{period.name} ({period.first} to {period.last})"


def sums_text(own: Overview) -> str:
    """The totals of one person in one line; of an overview of a place, its visits and the time there."""
    if own.place:
        return f"{count(len(own.visits), 'visit')}; {time_text(sum(v.end - v.start for v in own.visits))}"
    return totals_text(totals_of(own.days, len(own.period)))


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


def _day_lines(days: Sequence[DayView], most: int) -> Iterator[str]:
    """The list of a day."""
    for start, end, lasted, what, far, where in (texts for day in days for texts in list_texts(day.entries, most)):
        yield fitted(f"{start}  {end:<5}  {lasted:>10}  {what:<8}  {far:>8}  {where}".rstrip(), WIDTH)


COLUMNS = ("", "walking", "riding", "staying", "no data", "walked", "ridden", "steps")
WIDTHS = (16, 13, 13, 13, 14, 10, 10, 11)


def _period_lines(own: Overview) -> Iterator[str]:
    """A line per day of a week or a month, else per month or year, and the totals."""
    yield _line(COLUMNS, WIDTHS)
    yield from _lines_per_day(own) if own.period.kind in (WEEK, MONTH) else _lines_per_month(own)
    yield _totals_line("total", totals_of(own.days, len(own.period)))


def _lines_per_day(own: Overview) -> Iterator[str]:
    """A line per day; consecutive days without data are counted."""
    by_date = {day.date: day for day in own.days}
    for present, dates in groupby(own.period.dates, key=lambda on: on.isoformat() in by_date):
        if present:
            yield from (_totals_line(f"{on:%a} {on}", totals_of([by_date[on.isoformat()]], 1)) for on in dates)
        else:
            yield f"{count(len(list(dates)), 'day')} without data"


def _lines_per_month(own: Overview) -> Iterator[str]:
    """A line per month with data, or per year if there are many."""
    letters = 7 if len({day.date[:7] for day in own.days}) <= MOST_MONTHS else 4
    for name, same in groupby(own.days, key=lambda day: day.date[:letters]):
        days = list(same)
        yield _totals_line(f"{name}  {count(len(days), 'day')}", totals_of(days, len(days)))


def _totals_line(title: str, totals: Totals) -> str:
    times = [totals.walking, totals.riding, totals.staying, totals.unknown]
    texts = [time_text(time) if time >= 0.5 else NOTHING for time in times]
    texts += [distance_text(far) if far >= 0.5 else NOTHING for far in (totals.walked, totals.ridden)]
    return _line([title, *texts, f"{totals.steps:,}" if totals.steps else NOTHING], WIDTHS)


PLACE_COLUMNS, PLACE_WIDTHS = (
    ("place", "visits", "time", "comes (quartiles)", "leaves (quartiles)"),
    (28, 6, 12, 20, 20),
)
HOURS_COLUMNS, HOURS_WIDTHS = (
    ("", "arrivals", "comes (quartiles)", "departures", "leaves (quartiles)"),
    (10, 8, 20, 10, 20),
)


def _place_lines(places: Sequence[PlaceSummary]) -> Iterator[str]:
    """The places with most time: visits, total time, usual hours."""
    yield _line(PLACE_COLUMNS, PLACE_WIDTHS)
    for place in places[:MOST_PLACES]:
        usual = place.hours[0]
        hours = hours_text(usual.arrival), hours_text(usual.departure)
        yield _line([one_line(place.label), str(place.visits), time_text(place.total), *hours], PLACE_WIDTHS)
    if len(places) > MOST_PLACES:
        rest = sum(place.total for place in places[MOST_PLACES:])
        yield f"and {count(len(places) - MOST_PLACES, 'other place')}, {time_text(rest)}"


def _hours_lines(hours: Sequence[UsualHours]) -> Iterator[str]:
    """The usual hours of each weekday at one place."""
    yield _line(HOURS_COLUMNS, HOURS_WIDTHS)
    for usual in sorted(hours, key=lambda own: own.weekday == EVERY_DAY):
        come, go = hours_text(usual.arrival), hours_text(usual.departure)
        yield _line([usual.weekday, str(usual.arrivals), come, str(usual.departures), go], HOURS_WIDTHS)


def hours_text(quartiles: tuple[float, float, float]) -> str:
    """Quartiles of a time of day as ``18:42 (18:10–19:05)``."""
    low, middle, high = quartiles
    return f"{hour_text(middle)} ({hour_text(low)}–{hour_text(high)})" if np.isfinite(middle) else NOTHING


def _visit_lines(visits: Sequence[PlaceVisit]) -> Iterator[str]:
    """The last visits to a place; a time that was not observed has a question mark."""
    if len(visits) > MOST_VISITS:
        yield f"{count(len(visits) - MOST_VISITS, 'earlier visit')}"
    for visit in visits[-MOST_VISITS:]:
        since, until = visit_times(visit)
        yield f"{since:<23}  {until:<11}  {duration_text(visit.end - visit.start):>10}"
    if not all(visit.arrived and visit.left for visit in visits[-MOST_VISITS:]):
        yield "?: no data before or after, so it may have begun earlier or ended later"


def visit_times(visit: PlaceVisit) -> tuple[str, str]:
    """Local start with its date and local end, with "?" where it was not observed, and "+1" for the next day."""
    first, last = (
        date.fromisoformat(str(np.datetime64(int(time), "s"))[:10])
        for time in (visit.start + visit.start_offset, visit.end + visit.end_offset)
    )
    start, end = clock_text(visit.start, visit.start_offset), clock_text(visit.end, visit.end_offset)
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
