"""The report of a day of a lifelog: files that only their owner can read.

The page ``report.html`` has maps, hours and the timeline: the content of ``timeline.csv`` and ``day.png``, without
names or paths of recordings and plans.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, tzinfo
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError, one_line
from pdr_graph.floor.plan_files import Building
from pdr_graph.geometry import confidence_band, horizontal_sigma
from pdr_graph.lifelog import cache
from pdr_graph.lifelog.day import KINDS_WITHOUT_DATA, Day, Stay
from pdr_graph.lifelog.export import as_geojson, not_exported
from pdr_graph.lifelog.maps import COLOURS, DrawnPart, Panel, panels
from pdr_graph.lifelog.picture import picture
from pdr_graph.lifelog.timeline import (
    KIND_NAMES,
    PASSING,
    STAY,
    DayTotals,
    TimelineEntry,
    duration_text,
    entry_texts,
    timeline,
    timeline_csv,
    totals,
)
from pdr_graph.report import charts_and_tables, page
from pdr_graph.report.charts_and_tables import Table, table
from pdr_graph.report.page import CENTIMETRE, CENTISECOND, NOWHERE, TRACK, column, rings, runs, track
from pdr_graph.report.plotting import picture_bytes
from pdr_graph.types import Array, Trajectory

PICTURE_DPI = 130


@dataclass(frozen=True)
class DayRows:
    """The rows of a day that its page lists, with their totals."""

    entries: tuple[TimelineEntry, ...]
    totals: DayTotals

    @classmethod
    def of(cls, day: Day) -> DayRows:
        """Every entry of the timeline."""
        entries = timeline(day)
        return cls(entries, totals(day, entries))


def write_day(day: Day, zone: tzinfo, out: Path | None, rows: DayRows | None = None) -> list[str]:
    """Write the files of a day to a folder, None for nowhere; returns its notes and what is missing, a line each.

    rows: those of the diary, for the page; by default every entry of the timeline, as in ``timeline.csv``.
    """
    missing = [line for outing in day.outings for line in outing.missing]
    notes = [*not_exported([day]), *(line for outing in day.outings for line in outing.notes)]
    missing, notes = ([one_line(line) for line in dict.fromkeys(lines)] for lines in (missing, notes))
    if out is not None:
        cache.write(out / "timeline.csv", timeline_csv(timeline(day), zone).encode())
        cache.write(out / "day.geojson", as_geojson([day]))
        cache.write(out / "day.png", picture_bytes(picture(day, zone), PICTURE_DPI))
        missing += _write_page(out / "report.html", day, zone, missing, notes, rows)
    return [*(f"note: {line}" for line in notes), *(f"missing: {line}" for line in missing)]


def _write_page(
    path: Path, day: Day, zone: tzinfo, missing: Sequence[str], notes: Sequence[str], rows: DayRows | None
) -> tuple[str, ...]:
    """Write the HTML page of a day; returns a line for a failure, else nothing."""
    try:
        html = page.page(content(day, zone, missing, notes, rows))
    except Exception as error:  # a failing report must not lose the result
        return (one_line(f"{path.name} ({type(error).__name__}: {error})"),)
    cache.write(path, html)
    return ()


OFFSET_PERIOD = 900.0  # [s]; daylight saving time starts and ends at multiples of it
# Chosen by hand
SMALLEST_DOT, LARGEST_DOT = 7.0, 22.0  # [px] diameter of the mark of a slow pass or short stay, of the longest stay
BLOCK_HEIGHT, LANE_HEIGHT = 14, 26  # [px] in the chart of the day


def content(
    day: Day, zone: tzinfo, missing: Sequence[str], warnings: Sequence[str], rows: DayRows | None = None
) -> dict[str, Any]:
    """The content of the page, in the form documented in ``web/content.js``.

    missing, warnings: a line each; rows: what the page lists, by default every entry of the timeline.
    """
    every, maps = timeline(day), panels(day)
    start, end = (every[0].start, max(e.end for e in every)) if every else (0.0, 0.0)
    rows = rows or DayRows.of(day)
    entries = rows.entries
    ways = [_joined_track(panel) for panel in maps]
    return {
        "title": f"{day.person}   {day.date}",
        "subtitle": f"times of {zone}",
        "headline": _headline(rows.totals),
        "verdict": None,
        "missing": list(missing),
        "warnings": list(warnings),
        "north": True,
        "offsets": _offsets(start, end, zone),
        "start": start,
        "end": end,
        "maps": [_map(panel, n) for n, panel in enumerate(maps)],
        "tracks": [line for n, panel in enumerate(maps) for line in _tracks(panel, ways[n], n, len(maps))],
        "marks": [marks for n, panel in enumerate(maps) for marks in _stay_marks(panel, n)],
        "charts": [_hours_chart(entries), *([_sigma_chart(ways[0])] if ways else [])] if entries else [],
        "phases": [{"start": e.start, "end": e.end, "text": _entry_label(e)} for e in entries],
        "tables": [_timeline_table(entries, zone)],
    }


def _headline(sums: DayTotals) -> list[list[str]]:
    figures = [["walked", f"{_distance_text(sums.walked)} in {duration_text(sums.walking)}"]]
    figures += [["ridden", f"{_distance_text(sums.ridden)} in {duration_text(sums.riding)}"]] if sums.riding else []
    figures += [["stayed", duration_text(sums.staying)]] if sums.staying else []
    figures += [["steps", f"{sums.steps:,}"]] if sums.steps else []
    figures += [["no data", duration_text(sums.unknown)]] if sums.unknown else []
    return figures + [[name, duration_text(time)] for name, time in sums.places[:3]]


def _distance_text(metres: float) -> str:
    return f"{metres / 1000:.2f} km" if metres >= 1000 else f"{metres:.0f} m"


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
        floors = Building.load(panel.plan).floors
    except InputError:
        return None
    return page.plan_drawing(next((floor for floor in floors if floor.label == panel.floor), floors[0]))


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
    on = [number if panel.floor in ("", label) else NOWHERE for label in way.floor]
    regions: list[Any] = [None] * maps
    regions[number] = rings(np.concatenate([_region(panel, path) for own in panel.ways for path in own]))
    yield track("where", TRACK, way, on, width=0, walker=True, lead=True, bands=regions)


def _region(panel: Panel, path: Trajectory) -> Array:
    """The 95 % region of a path, of the rows on the map's floor."""
    return confidence_band(path, np.array([panel.floor in ("", label) for label in path.floor]))


def _activity_track(name: str, colour: str, drawn: Sequence[DrawnPart], number: int) -> dict[str, Any]:
    """The parts of one kind of activity as one track, on the map of a number."""
    path = _concatenated(one.track for one in drawn)
    bare = Trajectory(path.time, path.position, path.heading, path.floor)
    return track(name, colour, bare, [number] * len(bare))


def _stay_marks(panel: Panel, number: int) -> Iterator[dict[str, Any]]:
    """The marks of the stays and of the slow passes on a map."""
    for kind in (STAY, PASSING):
        own = [stay for stay in panel.stays if stay.passing == (kind == PASSING)]
        if own:
            x, y = (column(axis, CENTIMETRE) for axis in np.array([stay.position for stay in own]).T)
            marks = {"name": KIND_NAMES.get(kind, kind), "colour": COLOURS[kind], "symbol": "circle", "x": x, "y": y}
            dots = {"size": [_dot_diameter(stay) for stay in own], "text": [_stay_label(stay) for stay in own]}
            yield marks | dots | {"on": runs([number] * len(own))}


def _dot_diameter(stay: Stay) -> float:
    """Diameter [px] of the mark of a stay, by its duration."""
    # longest stay [s]: duration of a stay with the largest mark
    share = 0.0 if stay.passing else min((stay.end - stay.start) / 7200.0, 1.0)
    return round(float(np.sqrt(SMALLEST_DOT**2 + share * (LARGEST_DOT**2 - SMALLEST_DOT**2))), 1)


def _stay_label(stay: Stay) -> str:
    named = [f"{name} {probability:.0%}" for name, probability in stay.facing]
    return "\n".join(
        [f"{duration_text(stay.end - stay.start)}, ± {float(horizontal_sigma(stay.covariance)):.1f} m", *named]
    )


def _entry_label(entry: TimelineEntry) -> str:
    _, what, _, floor, place = entry_texts(entry)
    return ", ".join(part for part in (what, floor, place) if part)


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
    text = [f"{duration_text(e.end - e.start)}\n{_entry_label(e)}" for e in entries for _ in range(4)]
    block = {"name": kind, "colour": COLOURS[kind], "width": BLOCK_HEIGHT, "text": text}
    return block | {"time": column(time, CENTISECOND), "y": column(y, 1.0)}


def _sigma_chart(way: Trajectory) -> dict[str, Any]:
    return charts_and_tables.sigma({"where": (TRACK, way)})


def _timeline_table(entries: Sequence[TimelineEntry], zone: tzinfo) -> Table:
    rows = [[f"{datetime.fromtimestamp(e.start, zone):%H:%M:%S}", *entry_texts(e)] for e in entries]
    head = ["from", "for", "what", "distance", "floor", "where"]
    return table("The day", head, rows, [round(e.start, 2) for e in entries])
