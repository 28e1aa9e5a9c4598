"""The picture of an overview: a calendar with the time of each kind, a map of the places, and their usual hours.

The calendar of at most a month has a row per day with the hours from left to right; that of a year has a tile per day,
filled from below by the share of each kind. Time without data is empty, and pale where it belongs to a stay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from pdr_graph.errors import one_line
from pdr_graph.lifelog.day import VEHICLE, WALKING
from pdr_graph.lifelog.day_list import distance_text
from pdr_graph.lifelog.maps import COLOURS, INK, font_families, short_name
from pdr_graph.lifelog.overview import GROUPS, NO_DATA, RIDE, STAYED, WALK, DayView, Overview
from pdr_graph.lifelog.overview_map import Region, draw_region, regions
from pdr_graph.lifelog.overview_text import period_title, sums_text
from pdr_graph.lifelog.period import ALL, DAY, YEAR
from pdr_graph.lifelog.picture import BORDER, PAPER
from pdr_graph.lifelog.place_visits import EVERY_DAY, WEEKDAYS, PlaceSummary, is_place, is_seen
from pdr_graph.lifelog.timeline import STAY
from pdr_graph.types import Array

GROUP_COLOURS = {STAYED: COLOURS[STAY], WALK: COLOURS[WALKING], RIDE: COLOURS[VEHICLE]}  # from below, in a tile
UNSEEN, UNSEEN_COLOUR = "no data within a stay", "#c9b8dc"
BLOCK_COLOURS = {**GROUP_COLOURS, UNSEEN: UNSEEN_COLOUR}
WIDTH, HEAD, MARGIN = 13.0, 0.75, 0.15  # [inch]
ROW_HEIGHT, DAY_ROW, TILE = 0.27, 0.6, 0.2  # [inch] of a day's row, of the only one's, and side of a day's tile
MAP_HEIGHTS, MANY_MAPS_HEIGHT, HOURS_HEIGHT = (4.0, 7.5), 5.0, 2.3  # [inch], least and most of a map; beside others
LEAST_SHARE = 0.12  # of a tile that a kind fills at least, so that a short walk is seen
LEFT = 1.5  # [inch] for the names of rows
SIDE = 2.6  # [inch] for distance and steps beside the rows
MOST_HOURS = 3  # places whose usual hours are drawn
SMALL = 8.0  # [pt]


@dataclass(frozen=True)
class Panel:
    """A part of the picture. height: [inch]; draw: takes the figure, bottom [inch] and the total height [inch]."""

    height: float
    draw: Callable[[Figure, float, float], list[str]]


def picture(shown: Overview, template: str = "") -> tuple[Figure, list[str]]:
    """The picture of an overview, and a line for each map without tiles. template: their address, "" for none."""
    with rc_context({"font.family": font_families(), "svg.fonttype": "none", "text.parse_math": False}):
        panels = list(_panels(shown, template))
        total = HEAD + 0.25 * max(len(shown.persons) - 1, 0) + sum(panel.height for panel in panels)
        figure = Figure(figsize=(WIDTH, total), facecolor="white")
        FigureCanvasAgg(figure)
        _draw_head(figure, shown, total)
        failures, top = list[str](), sum(panel.height for panel in panels)
        for panel in panels:
            top -= panel.height
            failures += panel.draw(figure, top, total)
        return figure, failures


def _panels(shown: Overview, template: str) -> Iterator[Panel]:
    """The parts of the picture from the top."""
    found = regions(shown)
    day, height = shown.period.kind == DAY, _map_height(found)
    maps = Panel(height, lambda figure, bottom, total: _draw_maps(figure, found, height, template, day, bottom, total))
    if shown.period.kind == DAY:
        yield from [maps] if found else []
    # longest rows: days of a period whose calendar has rows
    if shown.period.kind in (YEAR, ALL) and len(shown.period) > 45:
        yield from _tile_panels(shown)
    else:
        rows = _calendar_rows(shown)
        each = DAY_ROW if len(rows) == 1 else ROW_HEIGHT
        yield Panel(
            0.75 + each * len(rows), lambda figure, bottom, total: _draw_rows(figure, shown, rows, bottom, total)
        )
    if shown.period.kind != DAY:
        yield from [maps] if found else []
        # least arrivals of a place whose usual hours are drawn
        usual = [p for p in shown.places if p.hours[0].arrivals >= 3][:MOST_HOURS]
        if usual:
            several = len(shown.persons) > 1
            yield Panel(HOURS_HEIGHT, lambda figure, bottom, total: _draw_usual(figure, usual, several, bottom, total))


def _draw_head(figure: Figure, shown: Overview, height: float) -> None:
    """Draw persons, period, totals, and the legend of the colours."""
    names = ", ".join(short_name(person) for person in shown.persons)
    title = "  ·  ".join(filter(None, [names, period_title(shown.period), one_line(shown.place)]))
    figure.text(0.012, 1 - 0.25 / height, title, fontsize=13, weight="bold", va="center")
    for n, person in enumerate(shown.persons):
        own = shown.of(person)
        whose = f"{short_name(person)}:  " if len(shown.persons) > 1 else ""
        text = f"{whose}{sums_text(own)}".replace("; ", "  ·  ")
        figure.text(0.012, 1 - (0.52 + 0.25 * n) / height, text, fontsize=9.5, va="center")
    marks = [*(Patch(fc=colour) for colour in BLOCK_COLOURS.values()), Patch(fc=PAPER, ec=BORDER)]
    style = {"ncols": 5, "frameon": False, "fontsize": 9, "handlelength": 1.2, "columnspacing": 1.2}
    place = (0.995, 1 - 0.05 / height)
    figure.legend(marks, [*BLOCK_COLOURS, NO_DATA], loc="upper right", bbox_to_anchor=place, **style)


def _axes(figure: Figure, box: tuple[float, float, float, float], total: float) -> Axes:
    """Axes in a box of left, bottom, width and height [inch]."""
    left, bottom, width, height = box
    return figure.add_axes((left / WIDTH, bottom / total, width / WIDTH, height / total))


CalendarRow = tuple[date, str, DayView | None]  # date, person, their day with data


def _calendar_rows(shown: Overview) -> list[CalendarRow]:
    """A row per date and person."""
    days = {(day.date, day.person): day for day in shown.days}
    return [(on, who, days.get((on.isoformat(), who))) for on in shown.period.dates for who in shown.persons]


def _draw_rows(figure: Figure, shown: Overview, rows: Sequence[CalendarRow], bottom: float, total: float) -> list[str]:
    """Draw a row per day with the hours from left to right; beside it distance and steps."""
    height = (DAY_ROW if len(rows) == 1 else ROW_HEIGHT) * len(rows)
    axes = _axes(figure, (LEFT, bottom + 0.4, WIDTH - LEFT - SIDE, height), total)
    axes.set(xlim=(0, 24), ylim=(len(rows), 0), yticks=[])
    _style(axes)
    axes.set_xticks(range(0, 25, 3), [f"{hour:02d}:00" for hour in range(0, 25, 3)], fontsize=SMALL)
    axes.vlines(range(3, 24, 3), 0, len(rows), color=BORDER, lw=0.5, zorder=1.5)
    boxes: dict[str, list[Array]] = {group: [] for group in BLOCK_COLOURS}
    for n, (on, who, day) in enumerate(rows):
        axes.add_collection(PolyCollection([_box(0, 24, n + 0.1, n + 0.9)], fc=PAPER, zorder=1), autolim=False)
        for group, start, end in _blocks(shown, on, day):
            boxes[group].append(_box(start, end, n + 0.1, n + 0.9))
        name = f"{on:%a} {on}" if len(shown.persons) == 1 else f"{on:%a} {on:%m-%d}  {short_name(who)}"
        axes.text(-0.15, n + 0.5, name, fontsize=SMALL, ha="right", va="center", color=INK)
    for group, own in boxes.items():
        axes.add_collection(PolyCollection(own, fc=BLOCK_COLOURS[group], lw=0.2, ec="white", zorder=2), autolim=False)
    _draw_offsets(axes, rows)
    if shown.place:
        return []
    beside = _axes(figure, (WIDTH - SIDE + 0.55, bottom + 0.4, SIDE - 1.75, height), total)
    _draw_distances(beside, rows)
    return []


def _box(left: float, right: float, top: float, bottom: float) -> Array:
    """Corners ``(4, 2)`` of a rectangle."""
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


def _blocks(shown: Overview, on: date, day: DayView | None) -> Iterator[tuple[str, float, float]]:
    """Group, start and end [h] of a day's entries by the local clock; of an overview of a place, of its stays alone.

    The parts of a stay without data are UNSEEN.
    """
    midnight = datetime(on.year, on.month, on.day, tzinfo=UTC).timestamp()
    for entry in day.entries if day else ():
        group = GROUPS[entry.kind]
        own = not shown.place or (entry.kind == STAY and is_place(shown.place, entry.place, entry.place_number))
        if group == NO_DATA or not own:
            continue
        bounds = np.array([entry.start + entry.offset, entry.end + entry.end_offset]) - midnight
        yield group, *np.clip(bounds / 3600, 0, 24).tolist()
        if group == STAYED:
            for part in (part for part in entry.parts or (entry,) if not is_seen(part)):
                share = np.interp([part.start, part.end], [entry.start, entry.end], bounds / 3600)
                yield UNSEEN, *np.clip(share, 0, 24).tolist()


def _draw_offsets(axes: Axes, rows: Sequence[CalendarRow]) -> None:
    """Write the offset from UTC beside a person's first day and where it changed."""
    before: dict[str, float] = {}
    for n, (_, who, day) in enumerate(rows):
        if day is not None and day.entries:
            offset = day.entries[-1].end_offset
            if before.get(who) != offset:
                axes.text(24.15, n + 0.5, offset_text(offset), fontsize=6.5, va="center", color=INK)
            before[who] = offset


def offset_text(offset: float) -> str:
    """An offset from UTC [s] as ``UTC+2`` or ``UTC+5:30``."""
    hours, minutes = divmod(abs(round(offset / 60)), 60)
    return f"UTC{'-' if offset < 0 else '+'}{hours}" + (f":{minutes:02d}" if minutes else "")


def _draw_distances(axes: Axes, rows: Sequence[CalendarRow]) -> None:
    """Draw the distances walked and ridden as bars, with the walked distance and the steps as text."""
    days = [day for _, _, day in rows if day is not None]
    most = max([*(day.totals.walked for day in days), 1.0])
    axes.set(xlim=(0, most), ylim=(len(rows), 0), yticks=[], xticks=[])
    _style(axes)
    axes.text(0, -0.1, "walked", fontsize=SMALL, va="bottom", color=INK)
    for n, (_, _, day) in enumerate(rows):
        far = day.totals.walked if day else 0.0
        if day is None or far < 0.5:
            continue
        axes.barh(n + 0.5, far, height=0.6, color=COLOURS[WALKING], alpha=0.35)
        steps = f", {day.totals.steps:,} steps" if day.totals.steps else ""
        axes.text(0, n + 0.5, f" {distance_text(far)}{steps}", fontsize=7.5, va="center", color=INK)


def _style(axes: Axes) -> None:
    """Remove the frame and the tick marks."""
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(length=0)


def _tile_panels(shown: Overview) -> Iterator[Panel]:
    """A part of the picture per person and year."""
    for person in shown.persons:
        own = shown.of(person)
        for year in range(shown.period.first.year, shown.period.last.year + 1):
            days = {day.date: day for day in own.days if day.date.startswith(f"{year}-")}
            if days or shown.period.kind == YEAR:
                title = f"{short_name(person)}  {year}" if len(shown.persons) > 1 else str(year)
                yield Panel(7 * TILE + 0.65, _tile_drawer(own, year, days, title))


def _tile_drawer(
    own: Overview, year: int, days: dict[str, DayView], title: str
) -> Callable[[Figure, float, float], list[str]]:
    return lambda figure, bottom, total: _draw_tiles(figure, own, year, days, title, bottom, total)


def _draw_tiles(
    figure: Figure, shown: Overview, year: int, days: dict[str, DayView], title: str, bottom: float, total: float
) -> list[str]:
    """Draw the days of a year as tiles: weeks from left to right, Monday on top."""
    weeks = 54
    axes = _axes(figure, (LEFT, bottom + 0.15, weeks * TILE, 7 * TILE), total)
    axes.set(xlim=(0, weeks), ylim=(7, 0), xticks=[], yticks=[])
    _style(axes)
    first = date(year, 1, 1)
    boxes: dict[str, list[Array]] = {group: [] for group in (NO_DATA, *BLOCK_COLOURS)}
    for n in range((date(year + 1, 1, 1) - first).days):
        on = first + timedelta(days=n)
        column, row = (n + first.weekday()) // 7, on.weekday()
        boxes[NO_DATA].append(_box(column + 0.06, column + 0.94, row + 0.06, row + 0.94))
        level = row + 0.94
        for group, share in _shares(shown, on, days.get(on.isoformat())):
            boxes[group].append(_box(column + 0.06, column + 0.94, level, level - 0.88 * share))
            level -= 0.88 * share
        if on.day == 1:
            axes.text(column + (row > 0), -0.25, f"{on:%b}", fontsize=SMALL, va="bottom", color=INK)
    for group, own in boxes.items():
        empty = group == NO_DATA
        style = {"fc": PAPER, "ec": BORDER, "lw": 0.4} if empty else {"fc": BLOCK_COLOURS[group], "lw": 0}
        axes.add_collection(PolyCollection(own, zorder=1 + (not empty), **style), autolim=False)
    for row in (0, 2, 4, 6):
        axes.text(-0.3, row + 0.5, WEEKDAYS[row][:3], fontsize=SMALL, ha="right", va="center", color=INK)
    figure.text(0.012, (bottom + 0.15 + 6.6 * TILE) / total, title, fontsize=10, weight="bold")
    return []


def _shares(shown: Overview, on: date, day: DayView | None) -> Iterator[tuple[str, float]]:
    """The share of a tile of each group, from below; the part of the stays without data is UNSEEN.

    A kind that occurred has at least LEAST_SHARE, together at most the whole tile.
    """
    hours = dict.fromkeys((UNSEEN, *GROUP_COLOURS), 0.0)
    for group, start, end in _blocks(shown, on, day):
        hours[group] += max(end - start, 0.0)
    hours[STAYED] = max(hours[STAYED] - hours[UNSEEN], 0.0)
    least = {group: max(time, 24 * LEAST_SHARE) if time > 0 else 0.0 for group, time in hours.items()}
    whole = max(sum(least.values()), 24.0)
    yield from ((group, time / whole) for group, time in least.items())


def _map_height(found: Sequence[Region]) -> float:
    """Height of the maps [inch], so that the first one's content fills its width."""
    if not found:
        return 0.0
    wide, high = (found[0].corners[1] - found[0].corners[0]).tolist()
    least, most = MAP_HEIGHTS
    return min(max(WIDTH / len(found) * high / wide, least), most if len(found) == 1 else MANY_MAPS_HEIGHT)


def _draw_maps(
    figure: Figure, found: Sequence[Region], height: float, template: str, day: bool, bottom: float, total: float
) -> list[str]:
    """Draw the maps beside each other; returns a line for each one without tiles."""
    width, failures = (WIDTH - MARGIN) / len(found) - MARGIN, list[str]()
    for n, region in enumerate(found):
        axes = _axes(figure, (MARGIN + n * (width + MARGIN), bottom + MARGIN, width, height - 2 * MARGIN), total)
        title = "ABC"[n] if len(found) > 1 else ""
        failures += draw_region(axes, region, width / (height - 2 * MARGIN), title, template, day)
    return failures


def _draw_usual(
    figure: Figure, places: Sequence[PlaceSummary], several: bool, bottom: float, total: float
) -> list[str]:
    """Draw the usual hours of places: a row per weekday, quartiles of arrivals and departures, the median as a mark."""
    width = (WIDTH - 0.4 - MARGIN) / MOST_HOURS
    for n, place in enumerate(places):
        axes = _axes(figure, (0.75 + n * width, bottom + 0.4, width - 0.6, HOURS_HEIGHT - 0.8), total)
        axes.set(xlim=(0, 24), ylim=(6.6, -0.6), facecolor=PAPER)
        _style(axes)
        axes.set_xticks(range(0, 25, 6), [f"{hour:02d}:00" for hour in range(0, 25, 6)], fontsize=SMALL)
        axes.set_yticks(range(7), [day[:3] for day in WEEKDAYS], fontsize=SMALL)
        axes.grid(axis="x", color=BORDER, lw=0.5)
        whose = f"{short_name(place.person)}: " if several else ""
        axes.set_title(f"{whose}{short_name(place.label)}: ▶ arrivals, ◁ departures", fontsize=9, loc="left")
        for usual in (own for own in place.hours if own.weekday != EVERY_DAY):
            row = WEEKDAYS.index(usual.weekday)
            _draw_quartiles(axes, usual.arrival, row - 0.12, ">", COLOURS[STAY], COLOURS[STAY])
            _draw_quartiles(axes, usual.departure, row + 0.12, "<", COLOURS[STAY], "white")
    return []


def _draw_quartiles(
    axes: Axes, quartiles: tuple[float, float, float], row: float, marker: str, colour: str, fill: str
) -> None:
    """Draw a line from quartile to quartile, over midnight too, and the median as a mark."""
    low, middle, high = quartiles
    if not np.isfinite(middle):
        return
    spans = [(low, high)] if low <= high else [(low, 24.0), (0.0, high)]
    for start, end in spans:
        axes.plot([start, end], [row, row], color=colour, lw=1.4, zorder=3)
    axes.plot([middle], [row], marker=marker, ms=5.5, color=colour, mfc=fill, zorder=4, ls="none")
