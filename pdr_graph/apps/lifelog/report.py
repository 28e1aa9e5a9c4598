"""The files of an overview, which only their owner can read.

``overview.html`` has the picture and the tables in one file, without scripts and without requests. Of one day of one
person ``report.html`` has the same maps and rows to play with. Neither has names or paths of recordings and plans.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, tzinfo
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.day import KINDS_WITHOUT_DATA, Day
from pdr_graph.apps.lifelog.diary import DiaryDay, Totals, totals_of
from pdr_graph.apps.lifelog.export import as_geojson
from pdr_graph.apps.lifelog.local_time import DAY
from pdr_graph.apps.lifelog.maps import Dot, DrawnPart, Panel, panels
from pdr_graph.apps.lifelog.overview import (
    PERIOD_TITLES,
    ROW_TITLES,
    Overview,
    days_by,
    distance_text,
    list_texts,
    period_title,
    row_texts,
    tables,
    time_text,
    totals_texts,
    usual_texts,
    visit_times,
)
from pdr_graph.apps.lifelog.picture import COLOURS, floor_of, picture
from pdr_graph.apps.lifelog.places import Place
from pdr_graph.apps.lifelog.timeline import (
    KIND_NAMES,
    PASSING,
    STAY,
    TimelineEntry,
    duration_text,
    timeline,
    timeline_csv,
)
from pdr_graph.apps.report import charts_and_tables
from pdr_graph.apps.report.charts_and_tables import Table, table
from pdr_graph.apps.report.page import CENTIMETRE, CENTISECOND, ON_NO_MAP, column, plan_drawing, rings, runs, track
from pdr_graph.apps.report.page import page as interactive_page
from pdr_graph.apps.report.plotting import picture_bytes
from pdr_graph.errors import InputError, count, one_line
from pdr_graph.geometry import confidence_band
from pdr_graph.notebook_html import BLUE
from pdr_graph.types import Array, Trajectory

PICTURE_DPI = 130


def write_overview(shown: Overview, out: Path, template: str, remarks: Sequence[str]) -> tuple[list[str], bytes]:
    """Write the files of an overview; returns a line if there are no tiles, and the picture.

    template: address of map tiles, "" for none.
    """
    figure, failures = picture(shown, template)
    for name, content in tables(shown).items():
        cache.write(out / name, content)
    drawn = picture_bytes(figure, PICTURE_DPI)
    cache.write(out / "overview.png", drawn)
    svg = picture_bytes(figure, PICTURE_DPI, "svg")
    cache.write(out / "overview.html", page(shown, svg, [*remarks, *failures]))
    return failures, drawn


def write_day(
    shown: Overview, day: Day, zone: tzinfo, out: Path, drawn: bytes, missing: Sequence[str], notes: Sequence[str]
) -> list[str]:
    """Write the files of the overview of one day of a person; returns a line for a failure, else nothing.

    day: with the outings that began on that date, for ``timeline.csv`` and ``day.geojson``; drawn: the picture of the
    overview, which is ``day.png``, too; missing, notes: a line each.
    """
    cache.write(out / "timeline.csv", timeline_csv(timeline(day), zone).encode())
    cache.write(out / "day.geojson", as_geojson([day]))
    cache.write(out / "day.png", drawn)
    try:
        html = interactive_page(content(shown, zone, missing, notes))
    except Exception as error:  # a failing report must not lose the result
        return [one_line(f"missing: report.html ({type(error).__name__}: {error})")]
    cache.write(out / "report.html", html)
    return []


POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
PAGE_STYLE = """
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
    tables = "".join(_html_table(title, head, rows) for title, head, rows in _tables(shown) if rows)
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    head += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(title)}</title><style>{PAGE_STYLE}</style>"
    body = f"<h1>{escape(title)}</h1>{notes}<div>{picture}</div>{tables}"
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{body}</body></html>\n'.encode()


def _html_table(title: str, head: Sequence[str], rows: Rows) -> str:
    """A table with a heading."""
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join(f"<tr>{''.join(f'<td>{escape(one_line(cell))}</td>' for cell in row)}</tr>" for row in rows)
    start = f'<h2>{escape(one_line(title))}</h2><div class="wide"><table>'
    return f"{start}<thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"


def _tables(shown: Overview) -> Iterator[tuple[str, Sequence[str], Rows]]:
    """Title, column names and rows of each table."""
    is_list = shown.period.kind == DAY and not shown.place
    for own in shown.diaries:
        whose = f"{own.person}: " if len(shown.persons) > 1 else ""
        if is_list:
            rows = [texts for day in own.days for texts in list_texts(day.entries)]
            yield f"{whose}the day", ROW_TITLES, rows
        else:
            yield f"{whose}days", PERIOD_TITLES, list(_day_rows(own.days, len(shown.period)))
        if own.places:
            yield f"{whose}places", PLACE_HEAD, [_place_row(place) for place in own.places[:MOST_PLACES]]
            yield f"{whose}usual hours", HOURS_HEAD, list(_hours_rows(own.places[:MOST_PLACES]))
        if own.visits and not is_list:
            hidden = len(own.visits) - MOST_VISITS
            earlier = f" ({count(hidden, 'earlier visit')} in visits.csv)" if hidden > 0 else ""
            yield f"{whose}visits{earlier}", VISIT_HEAD, [_visit_row(visit) for visit in own.visits[-MOST_VISITS:]]


PLACE_HEAD = ("place", "visits", "time", "first", "last", "latitude, longitude")
HOURS_HEAD = ("place", "weekday", "arrivals", "comes (quartiles)", "departures", "leaves (quartiles)")
VISIT_HEAD = ("place", "from", "to", "for", "with data")


def _day_rows(days: Sequence[DiaryDay], length: int) -> Iterator[Sequence[str]]:
    """A row per day with data, or per month if there are many; then the totals. length: of the period, in days."""
    for name, own in days_by(days, 10 if len(days) <= 400 else 7):  # most days
        yield totals_texts(name, totals_of(own, len(own)))
    yield totals_texts("total", totals_of(days, length))


def _place_row(place: Place) -> Sequence[str]:
    where = f"{place.latitude:.5f}, {place.longitude:.5f} ± {place.sigma:.0f} m" if place.sigma >= 0 else ""
    return [place.label, str(len(place.visits)), time_text(place.duration), place.first, place.last, where]


def _hours_rows(places: Sequence[Place]) -> Iterator[Sequence[str]]:
    """A row per place and weekday, with at least two arrivals or departures."""
    for place in places:
        for usual in place.hours:
            if max(usual.arrivals, usual.departures) >= 2:
                yield [place.label, *usual_texts(usual)]


def _visit_row(visit: TimelineEntry) -> Sequence[str]:
    seen = f"{visit.observed:.0%}" if visit.duration > 0 else ""
    return [visit.label, *visit_times(visit), duration_text(visit.duration), seen]


OFFSET_PERIOD = 900.0  # [s]; daylight saving time starts and ends at multiples of it
# Chosen by hand
SMALLEST_DOT, LARGEST_DOT = 7.0, 22.0  # [px] diameter of the mark of a slow pass or short stay, of the longest stay
BLOCK_HEIGHT, LANE_HEIGHT = 14, 26  # [px] in the chart of the day


def content(shown: Overview, zone: tzinfo, missing: Sequence[str], warnings: Sequence[str]) -> dict[str, Any]:
    """The content of ``report.html``, in the form documented in ``web/content.js``, of one day of one person.

    missing, warnings: a line each.
    """
    [day], maps = shown.days, panels(shown)
    entries = day.known
    start, end = (entries[0].start, max(e.end for e in entries)) if entries else (0.0, 0.0)
    ways = {n: _joined_track(panel) for n, panel in enumerate(maps) if panel.ways}
    return {
        "title": f"{day.person}   {day.date}",
        "subtitle": f"times of {zone}",
        "headline": _headline(day.totals),
        "verdict": None,
        "missing": list(missing),
        "warnings": list(warnings),
        "north": True,
        "offsets": _offsets(start, end, zone),
        "start": start,
        "end": end,
        "maps": [_map(panel, n) for n, panel in enumerate(maps)],
        "tracks": [line for n, way in ways.items() for line in _tracks(maps[n], way, n, len(maps))],
        "marks": [marks for n, panel in enumerate(maps) for marks in _marks(panel, n)],
        "charts": [_hours_chart(entries), *(_sigma_chart(way) for way in list(ways.values())[:1])] if entries else [],
        "phases": [{"start": e.start, "end": e.end, "text": _entry_label(e)} for e in entries],
        "tables": [_timeline_table(entries)],
    }


def _headline(sums: Totals) -> list[list[str]]:
    figures = [["walked", f"{distance_text(sums.walked)} in {duration_text(sums.walking)}"]]
    figures += [["ridden", f"{distance_text(sums.ridden)} in {duration_text(sums.riding)}"]] if sums.riding else []
    figures += [["stayed", duration_text(sums.staying)]] if sums.staying else []
    figures += [["steps", f"{sums.steps:,}"]] if sums.steps else []
    figures += [["no data", duration_text(sums.unknown)]] if sums.unknown else []
    return figures + [[name, duration_text(time)] for name, time in sums.places[:3]]


def _offsets(start: float, end: float, zone: tzinfo) -> list[list[float]]:
    """Offsets of local time from UTC [s], each with the Unix time from which it holds."""
    times = np.arange(OFFSET_PERIOD * np.floor(start / OFFSET_PERIOD), end + OFFSET_PERIOD, OFFSET_PERIOD).tolist()
    ahead = [(time, datetime.fromtimestamp(time, zone).utcoffset()) for time in times]
    changes = [next(same) for _, same in groupby(ahead, key=lambda one: one[1])]
    return [[time, by.total_seconds() if by is not None else 0.0] for time, by in changes]


def _map(panel: Panel, number: int) -> dict[str, Any]:
    name = " ".join(word for word in (panel.letter, panel.floor) if word)
    return {"name": name or f"map {number + 1}", "corners": panel.corners.tolist(), "plan": _plan(panel)}


def _plan(panel: Panel) -> dict[str, Any] | None:
    """The floor plan of a map; None if it has none, or its file is no longer there."""
    if not panel.plan:
        return None
    try:
        floor = floor_of(panel)
    except InputError:
        return None
    return plan_drawing(floor)


def _joined_track(panel: Panel) -> Trajectory:
    """All tracks on a map as one, with a row of NaN after each."""
    return _concatenated(path for own in panel.ways for path in own)


def _concatenated(paths: Iterable[Trajectory]) -> Trajectory:
    """Concatenate paths in time order, with a row of NaN after each."""
    ordered = sorted(paths, key=lambda path: float(path.time[0]))
    parts = [_with_nan_row(path) for path in ordered]
    time, position, heading, covariance = (
        np.concatenate(column) for column in zip(*(p[:4] for p in parts), strict=True)
    )
    return Trajectory(time, position, heading, tuple(label for p in parts for label in p[4]), covariance)


def _with_nan_row(path: Trajectory) -> tuple[Any, ...]:
    """The columns of a path with a row of NaN appended."""
    covariance = np.full((len(path), 3, 3), np.nan) if path.covariance is None else path.covariance
    return (
        np.append(path.time, path.time[-1]),
        np.append(path.position, [[np.nan, np.nan]], axis=0),
        np.append(path.heading, np.nan),
        np.append(covariance, np.full((1, 3, 3), np.nan), axis=0),
        (*path.floor, path.floor[-1]),
    )


def _tracks(panel: Panel, way: Trajectory, number: int, maps: int) -> Iterator[dict[str, Any]]:
    """A track per kind of activity, and the track of the walker with its 95 % region."""
    for kind in COLOURS:
        own = [drawn for drawn in panel.drawn if drawn.kind == kind and len(drawn.track) > 1]
        if own:
            unseen = kind in KINDS_WITHOUT_DATA
            style = {"dash": "dot" if unseen else "solid", "width": 1.2 if unseen else 2.4}
            yield _activity_track(KIND_NAMES.get(kind, kind), COLOURS[kind], own, number) | style
    on = [number if panel.floor in ("", label) else ON_NO_MAP for label in way.floor]
    regions: list[Any] = [None] * maps
    regions[number] = rings(np.concatenate([_region(panel, path) for own in panel.ways for path in own]))
    yield track("where", BLUE, way, on, width=0, walker=True, lead=True, bands=regions)


def _region(panel: Panel, path: Trajectory) -> Array:
    """The 95 % region of a path, of the rows on the map's floor."""
    return confidence_band(path, np.array([panel.floor in ("", label) for label in path.floor]))


def _activity_track(name: str, colour: str, drawn: Sequence[DrawnPart], number: int) -> dict[str, Any]:
    """The parts of one kind of activity as one track, on the map of a number."""
    path = _concatenated(one.track for one in drawn)
    bare = Trajectory(path.time, path.position, path.heading, path.floor)
    return track(name, colour, bare, [number] * len(bare))


def _marks(panel: Panel, number: int) -> Iterator[dict[str, Any]]:
    """The marks of the places and stays, and of the slow passes, on a map."""
    for kind in (STAY, PASSING):
        own = [dot for dot in panel.dots if dot.kind == kind]
        if own:
            x, y = (column(axis, CENTIMETRE) for axis in np.array([dot.position for dot in own]).T)
            marks = {"name": KIND_NAMES.get(kind, kind), "colour": COLOURS[kind], "symbol": "circle", "x": x, "y": y}
            dots = {"size": [_diameter(dot) for dot in own], "text": [dot.text for dot in own]}
            yield marks | dots | {"on": runs([number] * len(own))}


def _diameter(dot: Dot) -> float:
    """Diameter [px] of the mark of a place or stay, by the time there."""
    # longest stay [s]: duration of a stay with the largest mark
    share = 0.0 if dot.kind == PASSING else min(dot.time / 7200.0, 1.0)
    return round(float(np.sqrt(SMALLEST_DOT**2 + share * (LARGEST_DOT**2 - SMALLEST_DOT**2))), 1)


def _entry_label(entry: TimelineEntry) -> str:
    _, _, _, what, _, where = row_texts(entry)
    return ", ".join(filter(None, (what, where)))


def _hours_chart(entries: Sequence[TimelineEntry]) -> dict[str, Any]:
    """Chart of the day: a lane per kind of activity, the first on top."""
    kinds = [kind for kind in COLOURS if any(entry.kind == kind for entry in entries)][::-1]
    lanes = [_lane(kind, [e for e in entries if e.kind == kind], n) for n, kind in enumerate(kinds)]
    labels = [KIND_NAMES.get(kind, kind) for kind in kinds]
    return {"title": "the day", "unit": "", "lines": lanes, "labels": labels, "height": 40 + LANE_HEIGHT * len(kinds)}


def _lane(kind: str, entries: Sequence[TimelineEntry], lane: int) -> dict[str, Any]:
    """The blocks of one lane; each has a point in its middle for the hover text."""
    time = np.array([(e.start, (e.start + e.end) / 2, e.end, e.end) for e in entries]).ravel()
    y = np.tile([lane, lane, lane, np.nan], len(entries))
    text = [f"{duration_text(e.duration)}\n{_entry_label(e)}" for e in entries for _ in range(4)]
    block = {"name": kind, "colour": COLOURS[kind], "width": BLOCK_HEIGHT, "text": text}
    return block | {"time": column(time, CENTISECOND), "y": column(y, 1.0)}


def _sigma_chart(way: Trajectory) -> dict[str, Any]:
    return charts_and_tables.sigma({"where": (BLUE, way)})


def _timeline_table(entries: Sequence[TimelineEntry]) -> Table:
    return table(
        "The day", ROW_TITLES, [row_texts(e, seconds=True) for e in entries], [round(e.start, 2) for e in entries]
    )
