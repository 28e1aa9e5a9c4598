"""The page of an overview: its picture and its tables in one file, without scripts and without requests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from itertools import groupby

from pdr_graph.errors import count, one_line
from pdr_graph.lifelog.day_list import distance_text, list_texts
from pdr_graph.lifelog.overview import Overview, Totals, totals_of
from pdr_graph.lifelog.overview_text import hours_text, period_title, time_text, visit_times
from pdr_graph.lifelog.period import DAY
from pdr_graph.lifelog.place_visits import PlaceSummary, PlaceVisit
from pdr_graph.lifelog.timeline import duration_text

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; color: #26241f; background: #fff; margin: 1.5rem auto; max-width: 1180px;
  padding: 0 1rem; }
svg { width: 100%; height: auto; }
h1 { position: absolute; left: -9999px; } /* the picture has it */
 h2 { font-size: 1.05rem; margin: 1.6rem 0 0.4rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.2rem 0.9rem 0.2rem 0; border-bottom: 1px solid #e4e0d8; vertical-align: top; }
th { font-weight: 600; color: #6b655b; }
"""
MOST_VISITS = 500  # rows of the page's table; visits.csv has all
MOST_PLACES = 200
Rows = Sequence[Sequence[str]]


def page(shown: Overview, svg: bytes, remarks: Sequence[str]) -> bytes:
    """The page. svg: the picture of the overview; remarks: a line each."""
    names = ", ".join(one_line(person) for person in shown.persons)
    title = "  ".join(filter(None, [names, period_title(shown.period), one_line(shown.place)]))
    picture = svg[svg.index(b"<svg") :].decode()
    notes = "".join(f"<p>{escape(line)}</p>" for line in remarks)
    tables = "".join(_table(title, head, rows) for title, head, rows in _tables(shown) if rows)
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    head += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(title)}</title><style>{STYLE}</style>"
    body = f"<h1>{escape(title)}</h1>{notes}<div>{picture}</div>{tables}"
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{body}</body></html>\n'.encode()


def _table(title: str, head: Sequence[str], rows: Rows) -> str:
    """A table with a heading."""
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join(f"<tr>{''.join(f'<td>{escape(one_line(cell))}</td>' for cell in row)}</tr>" for row in rows)
    start = f'<h2>{escape(one_line(title))}</h2><div class="wide"><table>'
    return f"{start}<thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"


def _tables(shown: Overview) -> Iterator[tuple[str, Sequence[str], Rows]]:
    """Title, column names and rows of each table."""
    for person in shown.persons:
        own, whose = shown.of(person), f"{person}: " if len(shown.persons) > 1 else ""
        if shown.period.kind == DAY and not shown.place:
            rows = [texts for day in own.days for texts in list_texts(day.entries)]
            yield f"{whose}the day", ("from", "to", "for", "what", "distance", "where"), rows
        else:
            yield f"{whose}days", DAY_HEAD, list(_day_rows(own))
        if own.places:
            yield f"{whose}places", PLACE_HEAD, [_place_row(place) for place in own.places[:MOST_PLACES]]
            yield f"{whose}usual hours", HOURS_HEAD, list(_hours_rows(own.places[:MOST_PLACES]))
        if own.visits and (shown.period.kind != DAY or shown.place):
            hidden = len(own.visits) - MOST_VISITS
            earlier = f" ({count(hidden, 'earlier visit')} in visits.csv)" if hidden > 0 else ""
            yield f"{whose}visits{earlier}", VISIT_HEAD, [_visit_row(visit) for visit in own.visits[-MOST_VISITS:]]


DAY_HEAD = ("", "walking", "riding", "staying", "no data", "walked", "ridden", "steps")
PLACE_HEAD = ("place", "visits", "time", "first", "last", "latitude, longitude")
HOURS_HEAD = ("place", "weekday", "arrivals", "comes (quartiles)", "departures", "leaves (quartiles)")
VISIT_HEAD = ("place", "from", "to", "for", "with data")


def _day_rows(own: Overview) -> Iterator[Sequence[str]]:
    """A row per day with data, or per month if there are many; then the totals."""
    letters = 10 if len(own.days) <= 400 else 7  # most days
    for name, same in groupby(own.days, key=lambda day: day.date[:letters]):
        days = list(same)
        yield _totals_row(name, totals_of(days, len(days)))
    yield _totals_row("total", totals_of(own.days, len(own.period)))


def _totals_row(name: str, totals: Totals) -> Sequence[str]:
    times = [time_text(time) for time in (totals.walking, totals.riding, totals.staying, totals.unknown)]
    return [name, *times, distance_text(totals.walked), distance_text(totals.ridden), f"{totals.steps:,}"]


def _place_row(place: PlaceSummary) -> Sequence[str]:
    where = f"{place.latitude:.5f}, {place.longitude:.5f} ± {place.sigma:.0f} m" if place.sigma >= 0 else ""
    return [place.label, str(place.visits), time_text(place.total), place.first, place.last, where]


def _hours_rows(places: Sequence[PlaceSummary]) -> Iterator[Sequence[str]]:
    """A row per place and weekday, with at least two arrivals or departures."""
    for place in places:
        for usual in place.hours:
            if max(usual.arrivals, usual.departures) >= 2:
                come, go = hours_text(usual.arrival), hours_text(usual.departure)
                yield [place.label, usual.weekday, str(usual.arrivals), come, str(usual.departures), go]


def _visit_row(visit: PlaceVisit) -> Sequence[str]:
    lasted = visit.end - visit.start
    seen = f"{visit.observed / lasted:.0%}" if lasted > 0 else ""
    return [visit.label, *visit_times(visit), duration_text(lasted), seen]
