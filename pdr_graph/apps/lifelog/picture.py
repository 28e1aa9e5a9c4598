"""The picture of an overview: a calendar with the time of each kind, maps, and the usual hours of places.

The calendar of at most a month has a row per day with the hours from left to right; that of a year has a tile per day,
filled from below by the share of each kind. Time without data is empty, and pale where it belongs to a stay. The maps
of one day also have the 95 % region of its tracks, and floor plans.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from functools import partial
from typing import Any

import numpy as np
from matplotlib import rc_context, rcParams
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager
from matplotlib.patches import Patch, Rectangle
from matplotlib.transforms import Bbox

from pdr_graph.apps.lifelog.day import GAP, KINDS_WITHOUT_DATA, PRIVATE, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import DiaryDay
from pdr_graph.apps.lifelog.local_time import ALL, DAY, YEAR
from pdr_graph.apps.lifelog.maps import Dot, DrawnPart, MercatorFrame, Panel, panels, short_name, tiles
from pdr_graph.apps.lifelog.overview import Overview, distance_text, fleet_text, period_title, sums_text
from pdr_graph.apps.lifelog.places import EVERY_DAY, WEEKDAYS, Place, is_place
from pdr_graph.apps.lifelog.timeline import PASSING, STAY, TimelineEntry
from pdr_graph.apps.report.page import RADIO
from pdr_graph.apps.report.plotting import HALO, draw_plan, draw_scale, draw_uncertainty
from pdr_graph.apps.report.plotting import STYLE as FIGURE_STYLE
from pdr_graph.errors import InputError, count, one_line
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.floor.plan_files import Building
from pdr_graph.notebook_html import BLUE, GREY, RED
from pdr_graph.types import Array, Trajectory

COLOURS = {WALKING: BLUE, VEHICLE: RED, STANDING: "#3f9c8f", STAY: RADIO, PASSING: "#b9a3d0", GAP: GREY, PRIVATE: GREY}
INK, PAPER, MAP_BORDER = "#2b2440", "#f7f6f2", "#c8c4ba"
STYLE: Any = FIGURE_STYLE | {
    "text.color": INK,
    "axes.facecolor": PAPER,
    "axes.titlesize": "large",
    "axes.axisbelow": True,
    "lines.linewidth": 1.0,
    "lines.markersize": 5,
    "lines.markeredgewidth": 1.4,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    "svg.fonttype": "none",
}
CJK_FONTS = (  # with Chinese, Japanese and Korean letters; those that are installed are used
    "Noto Sans CJK JP",
    "Noto Sans JP",
    "Hiragino Sans",
    "Yu Gothic",
    "Microsoft YaHei",
    "PingFang SC",
    "WenQuanYi Zen Hei",
    "Malgun Gothic",
)
MAX_LABELS = 14  # per map
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))  # of a point, for its label
Label = tuple[Array, str, float]  # position (2,), text, and distance of the text from the position [pt]


def draw_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Draw labels, given in order of importance, beside their points where they overlap nothing; leave out the rest."""
    pixels = axes.figure.dpi / 72  # of a point
    places = axes.transData.transform(np.array([position for position, _, _ in labels]).reshape(-1, 2))
    away = np.array([[distance * pixels] for _, _, distance in labels])
    occupied = [Bbox(ends) for ends in np.stack([places - away, places + away], axis=1)] if labels else []
    occupied += [text.get_window_extent() for text in axes.texts if text.get_text().endswith("N")]
    for (position, text, distance), place in zip(labels[:MAX_LABELS], places, strict=False):
        style: dict[str, Any] = {"ha": "center", "va": "center", "path_effects": HALO, "zorder": 8}
        drawn = axes.annotate(text, (position[0], position[1]), (0, 0), textcoords="offset points", **style)
        size = np.array(drawn.get_window_extent().size) / pixels  # [pt]
        for side in SIDES:
            shift = side * (distance + 3 + size / 2)
            box = Bbox.from_bounds(*(place + (shift - size / 2) * pixels), *(size * pixels))
            inside = Bbox.intersection(axes.bbox, box)
            if inside and np.array_equal(inside.extents, box.extents) and not box.count_overlaps(occupied):
                drawn.set_position(shift.tolist())
                occupied.append(box)
                break
        else:
            drawn.remove()


def is_inside(corners: Array, position: Array) -> bool:
    """True if a position ``(2,)`` lies between corners ``(2, 2)``."""
    return bool(np.all((position >= corners[0]) & (position <= corners[1])))


def draw_map(axes: Axes, panel: Panel, maps: Sequence[Panel], server: TileServer) -> None:
    """Draw a map. maps: all of the picture; server: of tiles."""
    size, half = axes.bbox.size, np.ptp(panel.corners, axis=0) / 2
    shown = panel.corners.mean(axis=0) + np.outer((-1, 1), size * np.max(half / size))
    axes.set(xlim=shown[:, 0], ylim=shown[:, 1], aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set(visible=True, edgecolor=MAP_BORDER)
    if isinstance(panel.frame, MercatorFrame):
        server.draw(axes, panel.frame, shown)
    floor = None
    if panel.plan:
        try:
            floor = floor_of(panel)
            draw_plan(axes, floor)
        except InputError as error:
            axes.set_xlabel(one_line(str(error)))
    for way in (near for own in panel.ways for track in own for near in _parts_near(track, shown)):
        if way.covariance is not None:
            draw_uncertainty(axes, way, panel.floor or None, floor)
    if panel.plan and not panel.ways:
        heat = np.ma.masked_less(time_by_place(panel.drawn, shown), LEAST_HEAT)
        axes.imshow(heat.T, cmap="YlOrRd", norm="log", alpha=0.7, origin="lower", extent=shown.T.ravel(), zorder=2)
    for line in lines_of(panel) if not panel.plan or panel.ways else ():
        near = line.tracks if line.unseen else [part for track in line.tracks for part in _parts_near(track, shown)]
        parts = [part.position for part in near]
        look: dict[str, Any] = (
            {"lw": 2.0} if panel.ways else {"lw": 0.8, "alpha": 0.5 if len(panel.drawn) < 1000 else 0.2}
        )
        look = {"ls": ":"} if line.unseen else look
        drawn = LineCollection(parts, colors=line.colour, **look)
        # many points of tracks, above which a vector graphic has them as pixels
        drawn.set_rasterized(sum(map(len, parts)) > 30_000)
        axes.add_collection(drawn, autolim=False)
    larger = [(other.letter, corners) for other in maps if (corners := _corners_on(panel, other)) is not None]
    for _, (low, high) in larger:
        axes.add_patch(Rectangle(low.tolist(), *(high - low).tolist(), fill=False, ec=INK, zorder=3))
    labels: list[Label] = [(corners[1], letter, 2.0) for letter, corners in larger]
    dots = [dot for dot in panel.dots if is_inside(shown, dot.position)]
    dots = [dot for dot in dots if not any(is_inside(corners, dot.position) for _, corners in larger)]
    dots.sort(key=lambda dot: (dot.kind == PASSING, -dot.time))
    for dot, area in zip(dots, dot_areas(dots), strict=True):
        axes.scatter(*dot.position, s=area, c=COLOURS[dot.kind], alpha=0.5, zorder=4)
        labels.append((dot.position, dot.label, float(np.sqrt(area)) / 2))
    for position, _ in panel.starts:
        axes.plot(*position, marker="o", mfc="white", mec=BLUE, ls="none", zorder=3)
    frame = panel.frame
    if isinstance(frame, MercatorFrame) or frame.georeferenced:
        east = 0.0 if isinstance(frame, MercatorFrame) else frame.bearing_of_east(panel.corners.mean(axis=0))
        style: dict[str, Any] = {"ha": "center", "va": "center", "size": "x-large", "path_effects": HALO, "zorder": 9}
        axes.annotate("▲\nN", (1, 1), (-20, -20), "axes fraction", "offset points", rotation=np.degrees(east), **style)
    draw_labels(axes, [*labels, *((position, time, 3.5) for position, time in panel.starts)])
    draw_scale(axes)
    title = "   ".join(one_line(word) for word in (panel.letter, panel.floor) if word)
    bold: Any = {"size": "x-large", "weight": "bold", "va": "top", "zorder": 9, "path_effects": HALO}
    axes.annotate(title, (0, 1), (6, -6), "axes fraction", "offset points", **bold)


LEAST_HEAT = 1.0  # [s/m²] of all persons that a heat map shows


def time_by_place(drawn: Sequence[DrawnPart], corners: Array) -> Array:
    """Time of tracks in each square of one metre, blurred by a metre as positions are [s]. corners: ``(2, 2)`` [m]."""
    from scipy.ndimage import gaussian_filter

    tracks = [part.track for part in drawn if part.kind not in KINDS_WITHOUT_DATA and len(part.track) > 1]
    middle = [(track.position[1:] + track.position[:-1]) / 2 for track in tracks]
    place, lasts = np.concatenate([np.empty((0, 2)), *middle]), [np.diff(track.time) for track in tracks]
    cells = np.ceil(np.ptp(corners, axis=0)).astype(int)
    sides = [(float(low), float(high)) for low, high in corners.T]
    time, _ = np.histogramdd(place, list(cells), sides, weights=np.concatenate([np.empty(0), *lasts]))
    return gaussian_filter(time, 1.0)


@dataclass(frozen=True)
class KindLines:
    """The tracks of one kind of activity on a map. unseen: True without data."""

    kind: str
    tracks: tuple[Trajectory, ...]

    @property
    def unseen(self) -> bool:
        """True without data: drawn dotted."""
        return self.kind in KINDS_WITHOUT_DATA

    @property
    def colour(self) -> str:
        """Its colour in pictures and pages."""
        return COLOURS[self.kind]


def lines_of(panel: Panel) -> list[KindLines]:
    """The tracks of a map by kind, as pictures and pages draw them; without data below the others."""
    kinds = sorted(dict.fromkeys(part.kind for part in panel.drawn), key=lambda kind: kind not in KINDS_WITHOUT_DATA)
    return [KindLines(kind, tuple(part.track for part in panel.drawn if part.kind == kind)) for kind in kinds]


def dot_areas(dots: Sequence[Dot]) -> list[float]:
    """Areas of dots [pt²] in pictures and pages, proportional to the time; two hours at least have the largest."""
    most = max([7200.0, *(dot.time for dot in dots)])
    return [20.0 if dot.kind == PASSING else max(1500.0 * dot.time / most, 20.0) for dot in dots]


def floor_of(panel: Panel) -> FloorPlan:
    """The floor plan of a map that has one. Raises InputError if its file cannot be read."""
    floors = Building.load(panel.plan).floors
    return next((floor for floor in floors if floor.label == panel.floor), floors[0])


def _parts_near(track: Trajectory, shown: Array) -> list[Trajectory]:
    """The parts of a track in the shown area ``(2, 2)`` and one size of it around."""
    (low, high), margin = shown, shown[1] - shown[0]
    inside = np.flatnonzero(np.all((track.position > low - margin) & (track.position < high + margin), axis=1))
    return [track[own] for own in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1) if len(own)]


def _corners_on(panel: Panel, other: Panel) -> Array | None:
    """Corners ``(2, 2)`` of another map on this one [m]; None if it is not a smaller part of it, outdoors."""
    located = isinstance(other.frame, MercatorFrame) or other.frame.georeferenced
    if other is panel or not (isinstance(panel.frame, MercatorFrame) and located):
        return None
    corners = panel.frame.from_frame(other.frame, other.corners)
    part = np.max(corners[1] - corners[0]) < panel.width and all(is_inside(panel.corners, corner) for corner in corners)
    return corners if part else None


@dataclass
class TileServer:
    """Where the maps of a picture get their tiles. template: of addresses, "" for none; failure: a line once it gave
    none for a map, after which it is not asked again.
    """

    template: str
    failure: str = ""

    def draw(self, axes: Axes, frame: MercatorFrame, corners: Array) -> None:
        """Draw the tiles of a map with corners ``(2, 2)`` [m]."""
        if not self.template or self.failure:
            return
        try:
            for tile in tiles(self.template, frame, corners, axes.get_window_extent().width):
                (west, south), (east, north) = tile.corners.tolist()
                style = {"zorder": 1, "aspect": "equal", "interpolation": "bilinear"}
                axes.imshow(tile.picture, extent=(west, east, south, north), **style)
        except OSError as error:
            self.failure = one_line(f"no tiles: {error}")
        finally:
            axes.set(xlim=corners[:, 0], ylim=corners[:, 1])


WALK, RIDE, STAYED, NO_DATA_GROUP = "walking", "riding", "staying", "no data"
GROUPS = {
    WALKING: WALK,
    PASSING: WALK,
    VEHICLE: RIDE,
    STAY: STAYED,
    STANDING: STAYED,
    GAP: NO_DATA_GROUP,
    PRIVATE: NO_DATA_GROUP,
}
UNSEEN = "no data within a stay"
BLOCK_COLOURS = {STAYED: COLOURS[STAY], WALK: BLUE, RIDE: RED, UNSEEN: "#c9b8dc"}  # from below, in a tile
# [inch]
WIDTH, SPACE, LEFT, RIGHT = 13.0, 0.15, 1.5, 2.6  # of the picture; between maps; beside the rows of days
ROW_HEIGHT, DAY_ROW, NAME_ROW, DAY_TILE = 0.27, 0.6, 0.16, 0.2  # of a day, of the only day, of names, of a day's tile
MAP_HEIGHTS = (4.0, 5.0, 7.5)  # of a map: least; most beside others; most of the only one
LONGEST_CALENDAR = 62  # of a calendar of many persons
HOURS_HEIGHT, MOST_HOURS = 2.3, 3  # of the usual hours of places, and how many places
Box = Callable[[float, float, float, float], Axes]  # axes at left, bottom, width, height in a part of the picture
Part = tuple[float, Callable[[Box], None]]  # height of a part of the picture, and what draws it


def picture(shown: Overview, template: str = "") -> tuple[Figure, list[str]]:
    """The picture of an overview, and a line if there are no tiles. template: their address, "" for none.

    Does not use pyplot, which is slow to load and keeps every figure alive.
    """
    fonts = [*rcParams["font.family"], *(name for name in CJK_FONTS if name in set(fontManager.get_font_names()))]
    with warnings.catch_warnings(), rc_context(STYLE | {"font.family": fonts}):
        warnings.filterwarnings("ignore", "Glyph")
        server = TileServer(template)
        parts = list(_parts(shown, server))
        top = sum(height for height, _ in parts)
        total = top + 0.5 + 0.25 * (1 if shown.is_fleet else len(shown.persons))
        figure = Figure(figsize=(WIDTH, total), facecolor="white")
        FigureCanvasAgg(figure)
        _draw_head(figure, shown)
        for height, draw in parts:
            top -= height

            def box(left: float, bottom: float, width: float, height: float, top: float = top) -> Axes:
                return figure.add_axes((left / WIDTH, (top + bottom) / total, width / WIDTH, height / total))

            draw(box)
        return figure, [server.failure] if server.failure else []


def _parts(shown: Overview, server: TileServer) -> Iterator[Part]:
    """The parts of the picture from the top."""
    maps = panels(shown)
    columns = 2 if len(maps) == 4 else 3
    drawn = list[Part]()
    for row in (maps[n : n + columns] for n in range(0, len(maps), columns)):
        # the content of the first one fills its width
        wide, high = (row[0].corners[1] - row[0].corners[0]).tolist()
        least, several, only = MAP_HEIGHTS
        height = min(max(WIDTH / len(row) * high / wide, least), only if len(maps) == 1 else several)
        drawn.append((height, partial(_draw_maps, row, maps, height, server)))
    yield from drawn if shown.period.kind == DAY else []
    dates = [date.fromisoformat(on) for on in sorted({day.date for day in shown.days})]
    if shown.is_fleet and (len(shown.period) > 1 or len(shown.persons) > LONGEST_CALENDAR):
        number = len(dates) if len(dates) <= LONGEST_CALENDAR else len(WEEKDAYS)
        yield 0.75 + ROW_HEIGHT * number, partial(_draw_busy, shown, dates)
    # longest rows: days of a period whose calendar has rows
    elif shown.period.kind in (YEAR, ALL) and len(shown.period) > 45:
        for own in shown.diaries:
            for year in range(shown.period.first.year, shown.period.last.year + 1):
                days = {day.date: day for day in own.days if day.date.startswith(f"{year}-")}
                if days or shown.period.kind == YEAR:
                    title = f"{short_name(own.person)}  {year}" if len(shown.persons) > 1 else str(year)
                    yield 7 * DAY_TILE + 0.65, partial(_draw_year, shown, year, days, title)
    else:
        known = {(day.date, day.person): day for day in shown.days}
        rows = [(on, who, known.get((on.isoformat(), who))) for on in shown.period.dates for who in shown.persons]
        names = list(_names(rows[0][2])) if len(rows) == 1 and rows[0][2] else []
        high = (DAY_ROW if len(rows) == 1 else ROW_HEIGHT) * len(rows)
        yield 0.75 + high + (3 * NAME_ROW if names else 0), partial(_draw_rows, shown, rows, high, names)
    if shown.period.kind != DAY:
        yield from drawn
        # least arrivals of a place whose usual hours are drawn
        usual = [(who, place) for who, place in shown.places if place.hours[0].arrivals >= 3][:MOST_HOURS]
        if usual and not shown.is_fleet:
            yield HOURS_HEIGHT, partial(_draw_usual, usual, len(shown.persons) > 1)


def _draw_head(figure: Figure, shown: Overview) -> None:
    """Write persons, period and totals, and the legend of the colours."""
    names = ", ".join(short_name(person) for person in shown.persons)
    names = count(len(shown.persons), "person") if shown.is_fleet else names
    title = "  ·  ".join(filter(None, [names, period_title(shown.period), one_line(shown.place)]))
    whose = [f"{short_name(own.person)}:  " if len(shown.persons) > 1 else "" for own in shown.diaries]
    sums = [f"{who}{sums_text(shown, own)}" for who, own in zip(whose, shown.diaries, strict=True)]
    sums = [fleet_text(shown)] if shown.is_fleet else sums
    inch = 1 / figure.get_figheight()
    figure.text(0.012, 1 - 0.15 * inch, title, size="xx-large", weight="bold", va="top")
    figure.text(0.012, 1 - 0.45 * inch, "\n".join(sums).replace("; ", "  ·  "), size="large", va="top", linespacing=1.6)
    marks = [*(Patch(fc=colour) for colour in BLOCK_COLOURS.values()), Patch(fc=PAPER, ec=MAP_BORDER)]
    figure.legend(marks, [*BLOCK_COLOURS, NO_DATA_GROUP], loc="upper right", ncols=5, handlelength=1)


CalendarRow = tuple[date, str, DiaryDay | None]  # date, person, their day with data


def _draw_rows(
    shown: Overview, rows: Sequence[CalendarRow], height: float, names: Sequence[tuple[TimelineEntry, str]], box: Box
) -> None:
    """Draw a row per day with the hours from left to right; beside it the offset from UTC, distance and steps.

    names: of the stays of the only row, above it.
    """
    axes = box(LEFT, 0.4, WIDTH - LEFT - RIGHT, height)
    axes.set(xlim=(0, 24), ylim=(len(rows), 0), yticks=[], facecolor="none")
    axes.set_xticks(range(0, 25, 3), [f"{hour:02d}:00" for hour in range(0, 25, 3)])
    axes.grid(axis="x", color=MAP_BORDER, lw=0.5)
    boxes: dict[str, list[Array]] = {NO_DATA_GROUP: [], **{group: [] for group in BLOCK_COLOURS}}
    offsets: dict[str, float] = {}
    for n, (on, who, day) in enumerate(rows):
        name = f"{on:%a} {on}" if len(shown.persons) == 1 else f"{on:%a} {on:%m-%d}  {short_name(who)}"
        axes.text(-0.15, n + 0.5, name, ha="right", va="center")
        boxes[NO_DATA_GROUP].append(_rectangle(0, 24, n + 0.1, n + 0.9))
        for group, start, end in _blocks(shown, on, day):
            boxes[group].append(_rectangle(start, end, n + 0.1, n + 0.9))
        if day is not None and day.entries and offsets.get(who) != day.entries[-1].end_offset:
            offsets[who] = day.entries[-1].end_offset
            axes.text(24.15, n + 0.5, offset_text(offsets[who]), va="center", size="small")
    _draw_boxes(axes, boxes)
    _draw_names(axes, rows[0][0], names)
    if not shown.place:
        side = box(WIDTH - RIGHT + 0.55, 0.4, RIGHT - 1.75, height)
        walked = [day.totals.walked if day else 0.0 for _, _, day in rows]
        side.set(xlim=(0, max([*walked, 1.0])), ylim=(len(rows), 0), yticks=[], xticks=[], facecolor="none")
        side.set_title("walked")
        side.barh(np.arange(len(rows)) + 0.5, walked, height=0.6, color=BLUE, alpha=0.35)
        for n, (_, _, day) in enumerate(rows):
            if day and day.totals.walked >= 0.5:
                steps = f", {day.totals.steps:,} steps" if day.totals.steps else ""
                side.text(0, n + 0.5, f" {distance_text(day.totals.walked)}{steps}", va="center")


def _draw_busy(shown: Overview, dates: Sequence[date], box: Box) -> None:
    """Draw how many persons had data in each quarter of an hour: a row per date, of weekdays if there are many."""
    weekly = len(dates) > LONGEST_CALENDAR
    row_of = {on.isoformat(): on.weekday() if weekly else n for n, on in enumerate(dates)}
    present = np.zeros((len(WEEKDAYS) if weekly else len(dates), 96))
    for day in (day for day in shown.days if day.date in row_of):
        quarters = np.zeros(96, dtype=bool)
        for entry in (entry for entry in day.entries if entry.is_seen):
            first, last = ((t - day.start) / 900 for t in (entry.start, entry.end))
            quarters[int(first) : max(int(np.ceil(last)), int(first) + 1)] = True
        present[row_of[day.date]] += quarters
    axes = box(LEFT, 0.4, WIDTH - LEFT - RIGHT, ROW_HEIGHT * len(present))
    axes.imshow(present, cmap="Purples", vmin=0, aspect="auto", extent=(0, 24, len(present), 0))
    axes.set(yticks=[], facecolor="none")
    axes.set_xticks(range(0, 25, 3), [f"{hour:02d}:00" for hour in range(0, 25, 3)])
    for n in range(len(present)):
        axes.text(-0.15, n + 0.5, WEEKDAYS[n] if weekly else f"{dates[n]:%a} {dates[n]:%m-%d}", ha="right", va="center")
        most = int(present[n].max())
        text = f"at most {count(most, 'person')}" + (f", {int(present[n].argmax()) // 4:02d}:00" if most else "")
        axes.text(24.15, n + 0.5, text, va="center", size="small")


def _names(day: DiaryDay) -> Iterator[tuple[TimelineEntry, str]]:
    """The stays of a day at places with names, the longest first, and the names."""
    for stay in sorted((entry for entry in day.entries if entry.kind == STAY), key=lambda entry: -entry.duration):
        if name := stay.place or (stay.facing[0][0] if stay.facing else ""):
            yield stay, short_name(name)


def _draw_names(axes: Axes, on: date, names: Sequence[tuple[TimelineEntry, str]]) -> None:
    """Draw the names of stays above the only row, in three rows, as far as they fit."""
    occupied = list[Bbox]()
    for stay, name in names:
        middle = float(np.mean(_hours_of(stay, on)))
        for row in range(3):
            level = -NAME_ROW / DAY_ROW * (row + 0.2)
            text = axes.text(middle, level, name, ha="center", va="bottom")
            if not text.get_window_extent().padded(2).count_overlaps(occupied):
                occupied.append(text.get_window_extent())
                axes.plot([middle, middle], [0.1, level], color=RADIO, lw=0.5, zorder=1, clip_on=False)
                break
            text.remove()


def _rectangle(left: float, right: float, top: float, bottom: float) -> Array:
    """Corners ``(4, 2)`` of a rectangle."""
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


def _draw_boxes(axes: Axes, boxes: Mapping[str, Sequence[Array]]) -> None:
    """Draw rectangles by group."""
    for group, own in boxes.items():
        empty = group == NO_DATA_GROUP
        style: dict[str, Any] = {"ec": MAP_BORDER, "lw": 0.4, "zorder": 0} if empty else {"lw": 0}
        axes.add_collection(PolyCollection(own, fc=PAPER if empty else BLOCK_COLOURS[group], **style), autolim=False)


def _blocks(shown: Overview, on: date, day: DiaryDay | None) -> Iterator[tuple[str, float, float]]:
    """Group, start and end [h] of a day's entries by the local clock; of an overview of a place, of its stays alone.

    The parts of a stay without data are UNSEEN.
    """
    for entry in day.entries if day else ():
        group = GROUPS[entry.kind]
        own = not shown.place or (entry.kind == STAY and is_place(shown.place, entry.place, entry.place_number))
        if group == NO_DATA_GROUP or not own:
            continue
        bounds = _hours_of(entry, on)
        yield group, *np.clip(bounds, 0, 24).tolist()
        if group == STAYED:
            for part in (part for part in entry.parts or (entry,) if not part.is_seen):
                share = np.interp([part.start, part.end], [entry.start, entry.end], bounds)
                yield UNSEEN, *np.clip(share, 0, 24).tolist()


def _hours_of(entry: TimelineEntry, on: date) -> Array:
    """Start and end ``(2,)`` of an entry by the local clock, from the midnight of a date [h]."""
    midnight = datetime(on.year, on.month, on.day, tzinfo=UTC).timestamp()
    return (np.array([entry.start + entry.offset, entry.end + entry.end_offset]) - midnight) / 3600


def offset_text(offset: float) -> str:
    """An offset from UTC [s] as ``UTC+2`` or ``UTC+5:30``."""
    hours, minutes = divmod(abs(round(offset / 60)), 60)
    return f"UTC{'-' if offset < 0 else '+'}{hours}" + (f":{minutes:02d}" if minutes else "")


def _draw_year(shown: Overview, year: int, days: dict[str, DiaryDay], title: str, box: Box) -> None:
    """Draw the days of a year as tiles: weeks from left to right, Monday on top.

    A tile is filled from below by the share of each kind; one that occurred has at least an eighth, so that a short
    walk is seen.
    """
    weeks, first = 54, date(year, 1, 1)
    axes = box(LEFT, 0.15, weeks * DAY_TILE, 7 * DAY_TILE)
    axes.set(xlim=(0, weeks), ylim=(7, 0), facecolor="none")
    boxes: dict[str, list[Array]] = {group: [] for group in (NO_DATA_GROUP, *BLOCK_COLOURS)}
    months = list[float]()
    for n in range((date(year + 1, 1, 1) - first).days):
        on = first + timedelta(days=n)
        column, row = (n + first.weekday()) // 7, on.weekday()
        months += [column + (row > 0)] if on.day == 1 else []
        left, right, level = column + 0.06, column + 0.94, row + 0.94
        boxes[NO_DATA_GROUP].append(_rectangle(left, right, row + 0.06, level))
        hours = dict.fromkeys(BLOCK_COLOURS, 0.0)
        for group, start, end in _blocks(shown, on, days.get(on.isoformat())):
            hours[group] += max(end - start, 0.0)
        hours[STAYED] = max(hours[STAYED] - hours[UNSEEN], 0.0)
        least = {group: max(time, 24 / 8) if time > 0 else 0.0 for group, time in hours.items()}
        for group in (UNSEEN, STAYED, WALK, RIDE):
            high = 0.88 * least[group] / max(sum(least.values()), 24.0)
            boxes[group].append(_rectangle(left, right, level, level - high))
            level -= high
    _draw_boxes(axes, boxes)
    axes.set_yticks([0.5, 2.5, 4.5, 6.5], [WEEKDAYS[row][:3] for row in (0, 2, 4, 6)])
    axes.xaxis.tick_top()
    axes.set_xticks(months, [f"{date(year, month, 1):%b}" for month in range(1, 13)], ha="left")
    axes.annotate(title, (0, 1), (-LEFT * 72 + 12, 0), "axes fraction", "offset points", weight="bold", va="top")


def _draw_maps(row: Sequence[Panel], maps: Sequence[Panel], height: float, server: TileServer, box: Box) -> None:
    """Draw some of the maps beside each other."""
    width = (WIDTH - SPACE) / len(row) - SPACE
    for n, panel in enumerate(row):
        draw_map(box(SPACE + n * (width + SPACE), SPACE, width, height - 2 * SPACE), panel, maps, server)


def _draw_usual(places: Sequence[tuple[str, Place]], several: bool, box: Box) -> None:
    """Draw the usual hours of places: a row per weekday, quartiles of arrivals and departures, the median as a mark."""
    width = (WIDTH - 0.5) / MOST_HOURS
    for n, (person, place) in enumerate(places):
        axes = box(0.75 + n * width, 0.4, width - 0.6, HOURS_HEIGHT - 0.8)
        axes.set(xlim=(0, 24), ylim=(6.6, -0.6))
        axes.set_xticks(range(0, 25, 6), [f"{hour:02d}:00" for hour in range(0, 25, 6)])
        axes.set_yticks(range(7), [day[:3] for day in WEEKDAYS])
        axes.grid(axis="x", color=MAP_BORDER, lw=0.5)
        whose = f"{short_name(person)}: " if several else ""
        axes.set_title(f"{whose}{short_name(place.label)}: ▶ arrivals, ◁ departures")
        for usual in (own for own in place.hours if own.weekday != EVERY_DAY):
            row = WEEKDAYS.index(usual.weekday)
            for (low, middle, high), level, mark, fill in (
                (usual.arrival, row - 0.12, ">", RADIO),
                (usual.departure, row + 0.12, "<", "white"),
            ):
                if np.isfinite(middle):  # a line from quartile to quartile, over midnight too
                    ends = [(low, high)] if low <= high else [(low, 24.0), (0.0, high)]
                    axes.hlines([level] * len(ends), *zip(*ends, strict=True), colors=RADIO)
                    axes.plot([middle], [level], marker=mark, color=RADIO, mfc=fill, ls="none")
