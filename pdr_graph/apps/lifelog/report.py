"""The files of an overview, which only their owner can read.

``overview.html`` has the picture and the tables in one file, without scripts and without requests. Of one day of one
person ``report.html`` has the same maps and rows to play with. Neither has names or paths of recordings and plans.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, tzinfo
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.day import Day
from pdr_graph.apps.lifelog.diary import Totals, detailed
from pdr_graph.apps.lifelog.export import DiaryRows, as_geojson
from pdr_graph.apps.lifelog.maps import Panel, panels
from pdr_graph.apps.lifelog.overview import (
    ROW_TITLES,
    Overview,
    ShownTable,
    distance_text,
    fleet_tables,
    period_title,
    row_texts,
    shown_tables,
    tables,
)
from pdr_graph.apps.lifelog.picture import COLOURS, dot_areas, floor_of, lines_of, picture
from pdr_graph.apps.lifelog.timeline import (
    KIND_NAMES,
    PASSING,
    STAY,
    TimelineEntry,
    duration_text,
    timeline_csv,
)
from pdr_graph.apps.report.charts_and_tables import chart, sigma, table
from pdr_graph.apps.report.page import (
    CENTIMETRE,
    CENTISECOND,
    ON_NO_MAP,
    column,
    plan_drawing,
    region,
    rings,
    runs,
    track,
)
from pdr_graph.apps.report.page import page as interactive_page
from pdr_graph.apps.report.plotting import picture_bytes
from pdr_graph.errors import InputError, count, one_line
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.notebook_html import BLUE
from pdr_graph.types import Trajectory

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

    day: with the outings that began on that date, for ``day.geojson``; drawn: the picture of the
    overview, which is ``day.png``, too; missing, notes: a line each.
    """
    rows = DiaryRows({own.date: own.entries for own in shown.days})
    cache.write(out / "timeline.csv", timeline_csv(detailed(rows.by_date.get(day.date, ()))).encode())
    cache.write(out / "day.geojson", as_geojson([day], {day.person: rows}))
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


def page(shown: Overview, svg: bytes, remarks: Sequence[str]) -> bytes:
    """The page. svg: the picture of the overview; remarks: a line each."""
    names = ", ".join(one_line(person) for person in shown.persons)
    names = count(len(shown.persons), "person") if shown.is_fleet else names
    title = "  ".join(filter(None, [names, period_title(shown.period), one_line(shown.place)]))
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    head += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(title)}</title><style>{PAGE_STYLE}</style>"
    body = [f"<h1>{escape(title)}</h1>", *(f"<p>{escape(line)}</p>" for line in remarks)]
    body.append(f"<div>{svg[svg.index(b'<svg') :].decode()}</div>")
    if len(shown.diaries) > 1 and (shown.is_fleet or shown.dwells):
        body += [_html_table("", shown_table) for shown_table in fleet_tables(shown, short=False)]
    for own in () if shown.is_fleet else shown.diaries:
        whose = f"{own.person}: " if len(shown.persons) > 1 else ""
        body += [_html_table(whose, shown_table) for shown_table in shown_tables(shown, own, short=False)]
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(body)}</body></html>\n'.encode()


def _html_table(whose: str, shown: ShownTable) -> str:
    """A table with a heading and its note; nothing without rows."""
    if not shown.rows:
        return ""
    row = "<tr>{}</tr>".format
    head = row("".join(f"<th>{escape(name)}</th>" for name in shown.head))
    rows = "".join(row("".join(f"<td>{escape(one_line(cell))}</td>" for cell in cells)) for cells in shown.rows)
    start = f'<h2>{escape(one_line(whose + shown.title))}</h2><div class="wide"><table>'
    note = f"<p>{escape(shown.note)}</p>" if shown.note else ""
    return f"{start}<thead>{head}</thead><tbody>{rows}</tbody></table></div>{note}"


OFFSET_PERIOD = 900.0  # [s]; daylight saving time starts and ends at multiples of it
LANE_HEIGHT = 26  # [px] in the chart of the day


def content(shown: Overview, zone: tzinfo, missing: Sequence[str], warnings: Sequence[str]) -> dict[str, Any]:
    """The content of ``report.html``, in the form documented in ``web/content.js``, of one day of one person.

    missing, warnings: a line each.
    """
    [day], maps = shown.days, panels(shown)
    entries, floors = day.known, [_plan(panel) for panel in maps]
    start, end = (entries[0].start, max(e.end for e in entries)) if entries else (0.0, 0.0)
    ways = {n: _joined(path for own in panel.ways for path in own) for n, panel in enumerate(maps) if panel.ways}
    sigmas = [sigma({"where": (BLUE, way)}) for way in list(ways.values())[:1]]
    rows = [row_texts(entry, seconds=True) for entry in entries]
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
        "maps": [_map(panel, floors[n], n) for n, panel in enumerate(maps)],
        "tracks": [line for n, way in ways.items() for line in _tracks(maps[n], floors[n], way, n, len(maps))],
        "marks": [marks for n, panel in enumerate(maps) for marks in _marks(panel, n)],
        "charts": [_hours_chart(entries), *sigmas] if entries else [],
        "phases": [{"start": e.start, "end": e.end, "text": _entry_label(e)} for e in entries],
        "tables": [table("The day", ROW_TITLES, rows, [round(e.start, 2) for e in entries])],
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


def _map(panel: Panel, floor: FloorPlan | None, number: int) -> dict[str, Any]:
    """A map with its floor plan."""
    name = " ".join(word for word in (panel.letter, panel.floor) if word) or f"map {number + 1}"
    return {"name": name, "corners": panel.corners.tolist(), "plan": plan_drawing(floor) if floor else None}


def _plan(panel: Panel) -> FloorPlan | None:
    """The floor plan of a map; None if it has none, or its file is no longer there."""
    with suppress(InputError):
        return floor_of(panel) if panel.plan else None
    return None


def _joined(paths: Iterable[Trajectory]) -> Trajectory:
    """Concatenate paths in time order, with a row of NaN after each."""
    time, position, heading, covariance, floor = [], [], [], [], list[str]()
    for path in sorted(paths, key=lambda path: float(path.time[0])):
        own = np.full((len(path), 3, 3), np.nan) if path.covariance is None else path.covariance
        time.append(np.append(path.time, path.time[-1]))
        position.append(np.append(path.position, [[np.nan, np.nan]], axis=0))
        heading.append(np.append(path.heading, np.nan))
        covariance.append(np.append(own, np.full((1, 3, 3), np.nan), axis=0))
        floor += [*path.floor, path.floor[-1]]
    times, positions, headings = (np.concatenate(parts) for parts in (time, position, heading))
    return Trajectory(times, positions, headings, tuple(floor), np.concatenate(covariance))


def _tracks(panel: Panel, floor: FloorPlan | None, way: Trajectory, number: int, maps: int) -> Iterator[dict[str, Any]]:
    """A track per kind of activity, and the track of the walker with its 95 % region."""
    for line in lines_of(panel):
        paths = [path for path in line.tracks if len(path) > 1]
        if paths:
            path = replace(_joined(paths), covariance=None)
            style = {"dash": "dot", "width": 1.2} if line.unseen else {"dash": "solid", "width": 2.4}
            yield track(KIND_NAMES.get(line.kind, line.kind), line.colour, path, [number] * len(path), **style)
    on = [number if panel.floor in ("", label) else ON_NO_MAP for label in way.floor]
    regions: list[Any] = [None] * maps
    parts = [path for own in panel.ways for path in own]
    bands = [region(path, np.array([panel.floor in ("", label) for label in path.floor]), floor) for path in parts]
    regions[number] = rings(np.concatenate(bands))
    yield track("where", BLUE, way, on, width=0, walker=True, lead=True, bands=regions)


def _marks(panel: Panel, number: int) -> Iterator[dict[str, Any]]:
    """The marks of the places and stays, and of the slow passes, on a map."""
    areas = dot_areas(panel.dots)
    for kind in (STAY, PASSING):
        own = [(dot, area) for dot, area in zip(panel.dots, areas, strict=True) if dot.kind == kind]
        if own:
            x, y = (column(axis, CENTIMETRE) for axis in np.array([dot.position for dot, _ in own]).T)
            marks = {"name": KIND_NAMES.get(kind, kind), "colour": COLOURS[kind], "symbol": "circle", "x": x, "y": y}
            size = [round(float(np.sqrt(area)), 1) for _, area in own]
            yield marks | {"size": size, "text": [dot.text for dot, _ in own], "on": runs([number] * len(own))}


def _entry_label(entry: TimelineEntry) -> str:
    _, _, _, what, _, where = row_texts(entry)
    return ", ".join(filter(None, (what, where)))


def _hours_chart(entries: Sequence[TimelineEntry]) -> dict[str, Any]:
    """Chart of the day: a lane per kind of activity, the first on top; each block has its hover text in its middle."""
    kinds = [kind for kind in COLOURS if any(entry.kind == kind for entry in entries)][::-1]
    lanes = []
    for lane, kind in enumerate(kinds):
        own = [entry for entry in entries if entry.kind == kind]
        time = np.array([(e.start, (e.start + e.end) / 2, e.end, e.end) for e in own]).ravel()
        y = np.tile([lane, lane, lane, np.nan], len(own))
        text = [f"{duration_text(e.duration)}\n{_entry_label(e)}" for e in own for _ in range(4)]
        block = {"name": kind, "colour": COLOURS[kind], "width": LANE_HEIGHT // 2, "text": text}
        lanes.append(block | {"time": column(time, CENTISECOND), "y": column(y, 1.0)})
    labels = [KIND_NAMES.get(kind, kind) for kind in kinds]
    return chart("the day", "", *lanes, labels=labels, height=40 + LANE_HEIGHT * len(kinds))
