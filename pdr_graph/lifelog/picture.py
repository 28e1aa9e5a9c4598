"""The picture of a day: its maps, and below them its hours.

Maps have tracks by kind with their 95 % region, stays by duration, and names where they fit; the hours are blocks from
left to right, with the names of places above.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta, tzinfo

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from pdr_graph.errors import InputError, one_line
from pdr_graph.floor.plan_files import Building
from pdr_graph.lifelog.day import KINDS_WITHOUT_DATA, Day, Stay
from pdr_graph.lifelog.map_furniture import Label, draw_labels, draw_north, draw_scale, filled, is_inside
from pdr_graph.lifelog.maps import (
    COLOURS,
    HALO,
    INK,
    LABEL_SIZE,
    LETTER_WIDTH,
    DrawnPart,
    Panel,
    font_families,
    label_width,
    panels,
    short_name,
)
from pdr_graph.lifelog.timeline import (
    KIND_NAMES,
    PASSING,
    STAY,
    TimelineEntry,
    duration_text,
    timeline,
    total_texts,
    totals,
)
from pdr_graph.report.page import RADIO, TRACK
from pdr_graph.report.plotting import LONGEST_SIDE, draw_plan, draw_uncertainty
from pdr_graph.types import Array, Trajectory

PAPER, BORDER = "#f7f6f2", "#c8c4ba"
# Chosen by hand
DOT_AREA, PASSING_AREA = (40.0, 600.0), 22.0  # [pt²] of the shortest and the longest stay, and of a slow pass
START_DISTANCE = 3.5  # [pt] of a label from the mark of an outing's start


def draw_map(axes: Axes, panel: Panel, maps: Sequence[Panel], zone: tzinfo, aspect: float) -> None:
    """Draw one of a day's maps. maps: all of them; zone: of times; aspect: width of the axes over their height."""
    low, high = filled(panel.corners, aspect)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor=PAPER)
    for spine in axes.spines.values():
        spine.set_edgecolor(BORDER)
    if panel.plan:
        _draw_floor(axes, panel)
    for way in (near for own in panel.ways for track in own for near in _parts_near(track, low, high)):
        draw_uncertainty(axes, way, panel.floor or None)
    for drawn in panel.drawn:
        _draw_track(axes, drawn, low, high)
    larger = [(other.letter, corners) for other in maps if (corners := _corners_on(panel, other)) is not None]
    stays = [s for s in panel.stays if not any(is_inside(corners, s.position) for _, corners in larger)]
    draw_labels(axes, [*_draw_frames(axes, larger), *_draw_stays(axes, stays), *_draw_starts(axes, panel, zone)])
    draw_scale(axes, low, high)
    if panel.frame.georeferenced:
        draw_north(axes, panel.frame.bearing_of_east(panel.corners.mean(axis=0)))
    title = "   ".join(one_line(word) for word in (panel.letter, panel.floor) if word)
    style = {"fontsize": 11, "weight": "bold", "zorder": 9, "path_effects": HALO}
    axes.text(0.012, 0.985, title, transform=axes.transAxes, va="top", **style)


def _draw_floor(axes: Axes, panel: Panel) -> None:
    """Draw the plan with the names that fit; if it cannot be read, write why."""
    try:
        floors = Building.load(panel.plan).floors
    except InputError as error:
        axes.set_xlabel(one_line(str(error)), fontsize=LABEL_SIZE)
        return
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    inches = axes.get_window_extent().width / axes.figure.dpi
    more = max(0.0, LONGEST_SIDE / inches - 1) / 2  # draw_plan assumes axes of that length
    x, y = more * (east - west), more * (north - south)
    axes.set(xlim=(west - x, east + x), ylim=(south - y, north + y))
    draw_plan(axes, next((floor for floor in floors if floor.label == panel.floor), floors[0]))
    axes.set(xlim=(west, east), ylim=(south, north))
    for name in axes.texts:
        name.set_clip_on(True)


def _draw_track(axes: Axes, drawn: DrawnPart, low: Array, high: Array) -> None:
    """Draw a part of a track, without rows far from the shown area."""
    unseen, colour = drawn.kind in KINDS_WITHOUT_DATA, COLOURS[drawn.kind]
    for track in [drawn.track] if unseen else _parts_near(drawn.track, low, high):
        if unseen:
            axes.plot(*track.position.T, color=colour, lw=1.1, ls=":", zorder=4.2)
        else:
            axes.plot(*track.position.T, color=colour, lw=2.0, solid_capstyle="round", zorder=5)


def _parts_near(track: Trajectory, low: Array, high: Array) -> list[Trajectory]:
    """The parts of a track in the shown area and one size of it around."""
    margin = high - low
    inside = np.flatnonzero(np.all((track.position > low - margin) & (track.position < high + margin), axis=1))
    return [track[own] for own in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1) if len(own)]


def _corners_on(panel: Panel, other: Panel) -> Array | None:
    """Corners ``(2, 2)`` of another map on this one [m]; None if it is not a smaller part of it."""
    if other is panel or panel.plan or not (panel.frame.georeferenced and other.frame.georeferenced):
        return None
    corners = panel.frame.from_frame(other.frame, other.corners)
    part = np.max(corners[1] - corners[0]) < panel.width and all(is_inside(panel.corners, corner) for corner in corners)
    return corners if part else None


def _draw_frames(axes: Axes, larger: Sequence[tuple[str, Array]]) -> list[Label]:
    """Draw the frames of enlarged maps; returns their labels."""
    for _, (low, high) in larger:
        (x, y), (wide, tall) = low.tolist(), (high - low).tolist()
        axes.add_patch(Rectangle((x, y), wide, tall, fill=False, ec=INK, lw=0.8, zorder=6))
    return [(corners[1], letter, START_DISTANCE) for letter, corners in larger]


def _draw_stays(axes: Axes, stays: Sequence[Stay]) -> list[Label]:
    """Draw stays as dots by duration; returns their labels, the longest stays first."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    shown = [s for s in stays if west < s.position[0] < east and south < s.position[1] < north]
    for stay in shown:
        kind = PASSING if stay.passing else STAY
        axes.scatter(*stay.position, s=_dot(stay), c=COLOURS[kind], alpha=0.8, edgecolors="white", lw=0.8, zorder=7)
    order = sorted(shown, key=lambda s: (s.passing, s.start - s.end))
    return [(s.position, _stay_label(s), np.sqrt(_dot(s)) / 2) for s in order]


def _dot(stay: Stay) -> float:
    """Area of a stay's dot [pt²]."""
    if stay.passing:
        return PASSING_AREA
    least, most = DOT_AREA
    # longest stay [s] of a stay with the largest dot
    return float(least + (most - least) * min((stay.end - stay.start) / (2 * 3600.0), 1.0))


def _stay_label(stay: Stay) -> str:
    lasted = duration_text(stay.end - stay.start)
    return f"{short_name(stay.facing[0][0])} {lasted}" if stay.facing else lasted


def _draw_starts(axes: Axes, panel: Panel, zone: tzinfo) -> list[Label]:
    """Draw the starts of outings; returns their times as labels."""
    starts = [s for s in panel.starts if panel.floor in ("", s.floor[0])]
    for start in starts:
        axes.plot(*start.position[0], marker="o", ms=5, mfc="white", mec=TRACK, mew=1.4, ls="none", zorder=6.5)
    return [(s.position[0], f"{datetime.fromtimestamp(s.time[0], zone):%H:%M}", START_DISTANCE) for s in starts]


# Chosen by hand
MAX_NAME_ROWS = 3  # above the hours
HOURS_MARGIN = 0.02  # of a shorter day's duration, on both sides


def draw_hours(axes: Axes, day: Day, entries: Sequence[TimelineEntry], zone: tzinfo) -> None:
    """Draw the entries of a day, at least one, by the clock of a time zone."""
    begin, end = _time_span(day, entries, zone)
    axes.set(xlim=(_plot_date(begin, zone), _plot_date(end, zone)), yticks=[])
    axes.xaxis_date(zone)
    locator = AutoDateLocator(tz=zone, minticks=5, maxticks=13)
    axes.xaxis.set(major_locator=locator, major_formatter=ConciseDateFormatter(locator, tz=zone, show_offset=False))
    axes.tick_params(labelsize=8.5)
    for side in ("left", "right", "top"):
        axes.spines[side].set_visible(False)
    for entry in entries:
        _draw_block(axes, entry, zone)
    axes.set_ylim(0, 1.1 + 0.5 * _draw_names(axes, entries, end - begin, zone))


def _time_span(day: Day, entries: Sequence[TimelineEntry], zone: tzinfo) -> tuple[float, float]:
    """First and last Unix time [s] of the hours: of the whole day if it is long, else of its entries with a margin."""
    first, last = entries[0].start, max(entry.end for entry in entries)
    # shortest full day [s] between the first and last entry of a day that is shown with all its 24 hours
    if last - first <= (12 * 3600.0):
        return first - HOURS_MARGIN * (last - first), last + HOURS_MARGIN * (last - first)
    midnight = datetime.fromisoformat(day.date).replace(tzinfo=zone)
    return min(midnight.timestamp(), first), max((midnight + timedelta(days=1)).timestamp(), last)


def _plot_date(time: float, zone: tzinfo) -> float:
    return float(date2num(datetime.fromtimestamp(time, zone)))


def _draw_block(axes: Axes, entry: TimelineEntry, zone: tzinfo) -> None:
    """Draw an entry as a block of at least a line's width, or as a dotted line without data."""
    left, right, colour = _plot_date(entry.start, zone), _plot_date(entry.end, zone), COLOURS[entry.kind]
    if entry.kind in KINDS_WITHOUT_DATA:
        axes.plot([left, right], [0.5, 0.5], color=colour, lw=1.5, ls=":", zorder=1)
    else:
        axes.add_patch(Rectangle((left, 0.12), right - left, 0.76, fc=colour, ec=colour, lw=0.6, zorder=2))
    if entry.kind == STAY:  # the next entry may be a stay too
        axes.plot([right, right], [0.12, 0.88], color="white", lw=0.7, zorder=3)


def _draw_names(axes: Axes, entries: Sequence[TimelineEntry], span: float, zone: tzinfo) -> int:
    """Draw the names of stays in rows, the longest stays first, as far as they fit; returns the number of rows."""
    per_point = span / (axes.get_window_extent().width * 72 / axes.figure.dpi)  # [s]
    rows: list[list[tuple[float, float]]] = []
    for stay in sorted((e for e in entries if e.kind == STAY and e.facing), key=lambda e: e.start - e.end):
        name, middle = short_name(stay.facing[0][0]), (stay.start + stay.end) / 2
        half = (label_width(name) / 2 + LETTER_WIDTH) * per_point
        own = (middle - half, middle + half)
        row = next((n for n, others in enumerate(rows) if all(own[1] < a or own[0] > b for a, b in others)), len(rows))
        if row < MAX_NAME_ROWS:
            rows += [[]] * (row == len(rows))
            rows[row] = [*rows[row], own]
            at, level = _plot_date(middle, zone), 1.1 + 0.5 * row
            axes.plot([at, at], [0.9, level], color=RADIO, lw=0.5, zorder=1)
            axes.text(at, level, name, fontsize=LABEL_SIZE, ha="center", va="bottom", color=INK)
    return len(rows)


WIDTH, HOURS_HEIGHT, HEAD_HEIGHT, MARGIN = (
    13.0,
    1.9,
    0.7,
    0.15,
)  # [inch] of the picture, its hours, its head, between maps
MAP_HEIGHT = (7.0, 5.0, 4.4)  # [inch] for one map in a row, two, three


def picture(day: Day, zone: tzinfo) -> Figure:
    """Draw the maps of a day, with tracks by kind, 95 % regions and stays; below, its hours in a time zone.

    Does not use pyplot, which is slow to load and keeps every figure alive.
    """
    with rc_context({"font.family": font_families(), "text.parse_math": False}):  # a name may have dollar signs
        return _draw(day, zone)


def _draw(day: Day, zone: tzinfo) -> Figure:
    maps, entries = panels(day), timeline(day)
    columns = 2 if len(maps) == 4 else min(max(len(maps), 1), 3)
    height, lines = MAP_HEIGHT[columns - 1], -(-len(maps) // columns)
    total = HEAD_HEIGHT + lines * height + HOURS_HEIGHT
    figure = Figure(figsize=(WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)
    for n, panel in enumerate(maps):
        row, column = divmod(n, columns)
        beside = min(columns, len(maps) - row * columns)  # the last row's maps share its width
        wide, high = (WIDTH - MARGIN) / beside - MARGIN, height - 2.5 * MARGIN
        left, bottom = MARGIN + column * (wide + MARGIN), HOURS_HEIGHT + (lines - 1 - row) * height + MARGIN
        axes = figure.add_axes((left / WIDTH, bottom / total, wide / WIDTH, high / total))
        draw_map(axes, panel, maps, zone, wide / high)
    if entries:
        draw_hours(figure.add_axes((0.03, 0.55 / total, 0.94, (HOURS_HEIGHT - 0.75) / total)), day, entries, zone)
    _draw_head(figure, day, entries, total)
    return figure


def _draw_head(figure: Figure, day: Day, entries: Sequence[TimelineEntry], height: float) -> None:
    """Draw the name of the person, the date, the totals, and the legend of the colours."""
    whose = f"{one_line(day.person)}   {day.date}"
    figure.text(0.012, 1 - 0.25 / height, whose, fontsize=13, weight="bold", va="center")
    figure.text(0.012, 1 - 0.52 / height, "     ".join(total_texts(totals(day, entries))), fontsize=9.5, va="center")
    kinds = [kind for kind in COLOURS if any(entry.kind == kind for entry in entries)]
    names, place = [KIND_NAMES.get(kind, kind) for kind in kinds], (0.995, 1 - 0.05 / height)
    style = {"ncols": max(len(kinds), 1), "frameon": False, "fontsize": 9, "handlelength": 1.6, "columnspacing": 1.2}
    figure.legend([_legend_mark(kind) for kind in kinds], names, loc="upper right", bbox_to_anchor=place, **style)


def _legend_mark(kind: str) -> Line2D:
    if kind in (STAY, PASSING):
        return Line2D([], [], marker="o", ms=8 if kind == STAY else 5, color=COLOURS[kind], ls="none")
    return Line2D([], [], color=COLOURS[kind], lw=2.5, ls=":" if kind in KINDS_WITHOUT_DATA else "-")
