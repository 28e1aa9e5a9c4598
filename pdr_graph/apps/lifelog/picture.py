"""The picture of an overview: a calendar with the time of each kind, maps, and the usual hours of places.

The calendar of at most a month has a row per day with the hours from left to right; that of a year has a tile per day,
filled from below by the share of each kind. Time without data is empty, and pale where it belongs to a stay. The maps
of one day also have the 95 % region of its tracks, and floor plans.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from functools import partial

import numpy as np
from matplotlib import rc_context, rcParams
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import fontManager
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import Normal, Stroke
from matplotlib.transforms import Affine2D

from pdr_graph.apps.lifelog.day import GAP, KINDS_WITHOUT_DATA, PRIVATE, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import DiaryDay
from pdr_graph.apps.lifelog.local_time import ALL, DAY, YEAR
from pdr_graph.apps.lifelog.maps import Dot, MercatorFrame, Panel, panels, short_name, tiles
from pdr_graph.apps.lifelog.overview import Overview, distance_text, period_title, sums_text
from pdr_graph.apps.lifelog.places import EVERY_DAY, WEEKDAYS, Place, is_place
from pdr_graph.apps.lifelog.timeline import PASSING, STAY, TimelineEntry
from pdr_graph.apps.report.page import RADIO
from pdr_graph.apps.report.plotting import LONGEST_SIDE, draw_plan, draw_uncertainty
from pdr_graph.errors import InputError, one_line
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame
from pdr_graph.notebook_html import BLUE, GREY, RED
from pdr_graph.types import Array, Trajectory

COLOURS = {WALKING: BLUE, VEHICLE: RED, STANDING: "#3f9c8f", STAY: RADIO, PASSING: "#b9a3d0", GAP: GREY, PRIVATE: GREY}
INK, HALO = "#2b2440", [Stroke(linewidth=2.2, foreground="white", alpha=0.85), Normal()]
PAPER, MAP_BORDER = "#f7f6f2", "#c8c4ba"
LABEL_SIZE = 7.5  # [pt]
LETTER_WIDTH = 0.6 * LABEL_SIZE  # [pt] slightly more than the average
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


def font_families() -> list[str]:
    """The font families to draw with: the default, and the installed ones for letters that it lacks."""
    return [*rcParams["font.family"], *(name for name in CJK_FONTS if name in set(fontManager.get_font_names()))]


def label_width(text: str) -> float:
    """Approximate width of a label [pt]."""
    # first wide letter: code point from which letters are twice as wide: Chinese, Japanese, Korean
    return LETTER_WIDTH * sum(1 + (ord(letter) > 0x2E80) for letter in text)


# Chosen by hand
MAX_LABELS = 14  # per map
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))  # of a point, for its label
ARROW = 24.0  # [pt] length of the arrow to the north
ARROW_INSET = 26.0  # [pt] of its middle from the right and the upper edge
Label = tuple[Array, str, float]  # position (2,), text, and distance of the text from the position [pt]


def draw_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Draw labels, given in order of importance, beside their points where they overlap nothing; leave out the rest."""
    points = 72.0 / axes.figure.dpi  # [pt] of a pixel
    frame = axes.get_window_extent().get_points() * points
    places = [axes.transData.transform(position) * points for position, _, _ in labels]
    occupied = [_box(at, 2 * away, 2 * away) for at, (_, _, away) in zip(places, labels, strict=True)]
    occupied.append(_box(frame[1] - ARROW_INSET, 1.2 * ARROW, 2 * ARROW))
    for at, (_, text, away) in zip(places[:MAX_LABELS], labels, strict=False):
        boxes = [_box_beside(at, text, away, right, up) for right, up in SIDES]
        free = [b for b in boxes if is_inside(frame, b[0]) and is_inside(frame, b[1]) and not _overlaps(b, occupied)]
        if free:
            occupied.append(free[0])
            x, y = axes.transAxes.inverted().transform(free[0].mean(axis=0) / points)
            style = {"fontsize": LABEL_SIZE, "color": INK, "zorder": 8, "path_effects": HALO}
            axes.text(x, y, text, transform=axes.transAxes, ha="center", va="center", **style)


def _box_beside(at: Array, text: str, away: float, right: int, up: int) -> Array:
    """Corners ``(2, 2)`` [pt] of a text to the right (1) or left (-1) of a point, above (1) or below (-1) it."""
    wide, high = label_width(text), 1.2 * LABEL_SIZE
    return _box(at + np.array([right * (away + 2 + wide / 2), up * (away + 1 + high / 2)]), wide, high)


def _box(middle: Array, wide: float, high: float) -> Array:
    """Corners ``(2, 2)`` of a box about its middle."""
    half = np.array([wide / 2, high / 2])
    return np.stack([middle - half, middle + half])


def _overlaps(box: Array, others: Sequence[Array]) -> bool:
    return any((box[0] < other[1]).all() and (box[1] > other[0]).all() for other in others)


def draw_scale(axes: Axes, low: Array, high: Array) -> None:
    """Draw a scale bar of a round length, at most a fifth of the map's width."""
    about = (high[0] - low[0]) / 5
    power = 10.0 ** np.floor(np.log10(about))
    length = float(power * max(n for n in (1, 2, 5) if n * power <= about))
    x, y = low + 0.03 * (high - low)
    axes.plot([x, x + length], [y, y], color=INK, lw=2.5, solid_capstyle="butt", zorder=9)
    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    text = axes.annotate(label, (x + length, y), (4, 0), textcoords="offset points", va="center", fontsize=8, zorder=9)
    text.set_path_effects(HALO)


def draw_north(axes: Axes, east: float = 0.0) -> None:
    """Draw an arrow to the north in the upper right corner. east: direction of east from +x [rad]."""
    right, upper = (np.array(axes.get_window_extent().max) / axes.figure.dpi).tolist()  # [inch]
    inches = Affine2D().rotate(east).translate(-ARROW_INSET, -ARROW_INSET).scale(1 / 72).translate(right, upper)
    points = inches + axes.figure.dpi_scale_trans
    shape = ARROW * np.array([(0, 0.5), (0.22, -0.3), (0, -0.15), (-0.22, -0.3)])
    style = {"fc": INK, "ec": "white", "lw": 0.8, "zorder": 9, "clip_on": False}
    axes.add_patch(Polygon(shape, closed=True, transform=points, **style))
    axes.text(
        0, -0.55 * ARROW, "N", transform=points, fontsize=8, ha="center", va="center", zorder=9, color=INK
    ).set_path_effects(HALO)


def filled(corners: Array, aspect: float) -> Array:
    """Corners ``(2, 2)`` with the same middle, enlarged to an aspect ratio [m]."""
    half = (corners[1] - corners[0]) / 2
    half = np.array([max(half[0], half[1] * aspect), max(half[1], half[0] / aspect)])
    return corners.mean(axis=0) + np.stack([-half, half])


def is_inside(corners: Array, position: Array) -> bool:
    """True if a position ``(2,)`` lies between corners ``(2, 2)``."""
    return bool(np.all((position >= corners[0]) & (position <= corners[1])))


# Chosen by hand
# [pt²] of the place with the most time, of any place, of a slow pass
LARGEST_DOT_AREA, SMALLEST_DOT_AREA, PASSING_DOT_AREA = 1500.0, 14.0, 22.0
LARGEST_DOT_TIME = 7200.0  # [s] of the largest dot at least
DAY_LINE, PERIOD_LINE = (2.0, 1.0), (0.8, 0.5)  # width [pt] and opacity of tracks
START_DISTANCE = 3.5  # [pt] of a label from the mark of an outing's start


def draw_map(axes: Axes, panel: Panel, maps: Sequence[Panel], aspect: float, server: TileServer) -> None:
    """Draw a map. maps: all of the picture; aspect: width of the axes over their height; server: of tiles."""
    low, high = filled(panel.corners, aspect)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], facecolor=PAPER)
    for spine in axes.spines.values():
        spine.set_edgecolor(MAP_BORDER)
    if isinstance(panel.frame, MercatorFrame):
        server.draw(axes, panel.frame, np.stack([low, high]))
    if panel.plan:
        _draw_floor(axes, panel)
    for way in (near for own in panel.ways for track in own for near in _parts_near(track, low, high)):
        if way.covariance is not None:
            draw_uncertainty(axes, way, panel.floor or None)
    _draw_tracks(axes, panel, low, high)
    larger = [(other.letter, corners) for other in maps if (corners := _corners_on(panel, other)) is not None]
    dots = [dot for dot in panel.dots if not any(is_inside(corners, dot.position) for _, corners in larger)]
    draw_labels(axes, [*_draw_frames(axes, larger), *_draw_dots(axes, dots, low, high), *_draw_starts(axes, panel)])
    draw_scale(axes, low, high)
    if isinstance(panel.frame, MercatorFrame):
        draw_north(axes)
    elif panel.frame.georeferenced:
        draw_north(axes, panel.frame.bearing_of_east(panel.corners.mean(axis=0)))
    title = "   ".join(one_line(word) for word in (panel.letter, panel.floor) if word)
    style = {"fontsize": 11, "weight": "bold", "zorder": 9, "path_effects": HALO}
    axes.text(0.012, 0.985, title, transform=axes.transAxes, va="top", **style)


def floor_of(panel: Panel) -> FloorPlan:
    """The floor plan of a map that has one. Raises InputError if its file cannot be read."""
    floors = Building.load(panel.plan).floors
    return next((floor for floor in floors if floor.label == panel.floor), floors[0])


def _draw_floor(axes: Axes, panel: Panel) -> None:
    """Draw the plan with the names that fit; if it cannot be read, write why."""
    try:
        floor = floor_of(panel)
    except InputError as error:
        axes.set_xlabel(one_line(str(error)), fontsize=LABEL_SIZE)
        return
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    inches = axes.get_window_extent().width / axes.figure.dpi
    more = max(0.0, LONGEST_SIDE / inches - 1) / 2  # draw_plan assumes axes of that length
    x, y = more * (east - west), more * (north - south)
    axes.set(xlim=(west - x, east + x), ylim=(south - y, north + y))
    draw_plan(axes, floor)
    axes.set(xlim=(west, east), ylim=(south, north))
    for name in axes.texts:
        name.set_clip_on(True)


def _draw_tracks(axes: Axes, panel: Panel, low: Array, high: Array) -> None:
    """Draw the parts of tracks by kind, without rows far from the shown area."""
    width, opacity = DAY_LINE if panel.ways else PERIOD_LINE
    for kind in dict.fromkeys(part.kind for part in panel.drawn):
        unseen, parts = kind in KINDS_WITHOUT_DATA, [part.track for part in panel.drawn if part.kind == kind]
        lines = [near.position for part in parts for near in ([part] if unseen else _parts_near(part, low, high))]
        style = {"lw": 1.1, "ls": ":", "zorder": 4.2} if unseen else {"lw": width, "alpha": opacity, "zorder": 5}
        drawn = LineCollection(lines, colors=COLOURS[kind], capstyle="butt" if unseen else "round", **style)
        # many points of tracks, above which a vector graphic has them as pixels
        drawn.set_rasterized(sum(map(len, lines)) > 30_000)
        axes.add_collection(drawn, autolim=False)


def _parts_near(track: Trajectory, low: Array, high: Array) -> list[Trajectory]:
    """The parts of a track in the shown area and one size of it around."""
    margin = high - low
    inside = np.flatnonzero(np.all((track.position > low - margin) & (track.position < high + margin), axis=1))
    return [track[own] for own in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1) if len(own)]


def _corners_on(panel: Panel, other: Panel) -> Array | None:
    """Corners ``(2, 2)`` of another map on this one [m]; None if it is not a smaller part of it, outdoors."""
    if other is panel or not (isinstance(panel.frame, MercatorFrame) and _is_located(other.frame)):
        return None
    corners = panel.frame.from_frame(other.frame, other.corners)
    part = np.max(corners[1] - corners[0]) < panel.width and all(is_inside(panel.corners, corner) for corner in corners)
    return corners if part else None


def _is_located(frame: Frame | MercatorFrame) -> bool:
    return isinstance(frame, MercatorFrame) or frame.georeferenced


def _draw_frames(axes: Axes, larger: Sequence[tuple[str, Array]]) -> list[Label]:
    """Draw the frames of enlarged maps; returns their labels."""
    for _, (low, high) in larger:
        (x, y), (wide, tall) = low.tolist(), (high - low).tolist()
        axes.add_patch(Rectangle((x, y), wide, tall, fill=False, ec=INK, lw=0.8, zorder=6))
    return [(corners[1], letter, START_DISTANCE) for letter, corners in larger]


def _draw_dots(axes: Axes, dots: Sequence[Dot], low: Array, high: Array) -> list[Label]:
    """Draw places and stays as dots by time; returns their labels, those with the most time first."""
    shown = sorted((dot for dot in dots if is_inside(np.stack([low, high]), dot.position)), key=_importance)
    most = max([LARGEST_DOT_TIME, *(dot.time for dot in shown)])
    area = [
        PASSING_DOT_AREA if dot.kind == PASSING else max(LARGEST_DOT_AREA * dot.time / most, SMALLEST_DOT_AREA)
        for dot in shown
    ]
    for kind in (STAY, PASSING):
        own = [(dot.position, size) for dot, size in zip(shown, area, strict=True) if dot.kind == kind]
        if own:
            positions, sizes = zip(*own, strict=True)
            style = {"c": COLOURS[kind], "edgecolors": COLOURS[kind], "alpha": 0.45, "lw": 1.0, "zorder": 7}
            axes.scatter(*np.array(positions).T, s=sizes, **style)
    return [(dot.position, dot.label, float(np.sqrt(size)) / 2) for dot, size in zip(shown, area, strict=True)]


def _importance(dot: Dot) -> tuple[bool, float]:
    return dot.kind == PASSING, -dot.time


def _draw_starts(axes: Axes, panel: Panel) -> list[Label]:
    """Draw the starts of outings; returns their times as labels."""
    for position, _ in panel.starts:
        axes.plot(*position, marker="o", ms=5, mfc="white", mec=BLUE, mew=1.4, ls="none", zorder=6.5)
    return [(position, time, START_DISTANCE) for position, time in panel.starts]


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
GROUP_COLOURS = {STAYED: COLOURS[STAY], WALK: COLOURS[WALKING], RIDE: COLOURS[VEHICLE]}  # from below, in a tile
UNSEEN, UNSEEN_COLOUR = "no data within a stay", "#c9b8dc"
BLOCK_COLOURS = {**GROUP_COLOURS, UNSEEN: UNSEEN_COLOUR}
PICTURE_WIDTH, HEAD_HEIGHT, MAP_SPACING = 13.0, 0.75, 0.15  # [inch]
ROW_HEIGHT, DAY_ROW, DAY_TILE = 0.27, 0.6, 0.2  # [inch] of a day's row, of the only one's, and side of a day's tile
MAP_HEIGHTS, MANY_MAPS_HEIGHT, HOURS_HEIGHT = (4.0, 7.5), 5.0, 2.3  # [inch], least and most of a map; beside others
LEAST_SHARE = 0.12  # of a tile that a kind fills at least, so that a short walk is seen
NAMES_WIDTH = 1.5  # [inch] for the names of rows
SIDE = 2.6  # [inch] for distance and steps beside the rows
NAME_ROW, MAX_NAME_ROWS = 0.16, 3  # [inch] of a row of names above the only day, and how many
MOST_HOURS = 3  # places whose usual hours are drawn
SMALL_FONT = 8.0  # [pt]


@dataclass(frozen=True)
class Part:
    """A part of the picture. height: [inch]; draw: takes the figure, bottom [inch] and the total height [inch]."""

    height: float
    draw: Callable[[Figure, float, float], None]


def picture(shown: Overview, template: str = "") -> tuple[Figure, list[str]]:
    """The picture of an overview, and a line if there are no tiles. template: their address, "" for none.

    Does not use pyplot, which is slow to load and keeps every figure alive.
    """
    # a name may have dollar signs
    with rc_context({"font.family": font_families(), "svg.fonttype": "none", "text.parse_math": False}):
        server = TileServer(template)
        parts = list(_parts(shown, server))
        total = HEAD_HEIGHT + 0.25 * max(len(shown.persons) - 1, 0) + sum(part.height for part in parts)
        figure = Figure(figsize=(PICTURE_WIDTH, total), facecolor="white")
        FigureCanvasAgg(figure)
        _draw_head(figure, shown, total)
        top = sum(part.height for part in parts)
        for part in parts:
            top -= part.height
            part.draw(figure, top, total)
        return figure, [server.failure] if server.failure else []


def _parts(shown: Overview, server: TileServer) -> Iterator[Part]:
    """The parts of the picture from the top."""
    maps = panels(shown)
    columns = 2 if len(maps) == 4 else 3
    rows_of_maps = [maps[n : n + columns] for n in range(0, len(maps), columns)]
    heights = [_map_height(own, len(maps)) for own in rows_of_maps]
    drawn = [
        Part(height, partial(_draw_maps, own, maps, height, server))
        for own, height in zip(rows_of_maps, heights, strict=True)
    ]
    yield from drawn if shown.period.kind == DAY else []
    # longest rows: days of a period whose calendar has rows
    if shown.period.kind in (YEAR, ALL) and len(shown.period) > 45:
        yield from _tile_parts(shown)
    else:
        rows = _calendar_rows(shown)
        yield Part(0.75 + _names_height(rows) + _row_height(rows) * len(rows), partial(_draw_rows, shown, rows))
    if shown.period.kind != DAY:
        yield from drawn
        # least arrivals of a place whose usual hours are drawn
        usual = [(who, place) for who, place in shown.places if place.hours[0].arrivals >= 3][:MOST_HOURS]
        if usual:
            yield Part(HOURS_HEIGHT, partial(_draw_usual, usual, len(shown.persons) > 1))


def _draw_head(figure: Figure, shown: Overview, height: float) -> None:
    """Draw persons, period, totals, and the legend of the colours."""
    names = ", ".join(short_name(person) for person in shown.persons)
    title = "  ·  ".join(filter(None, [names, period_title(shown.period), one_line(shown.place)]))
    figure.text(0.012, 1 - 0.25 / height, title, fontsize=13, weight="bold", va="center")
    for n, own in enumerate(shown.diaries):
        whose = f"{short_name(own.person)}:  " if len(shown.persons) > 1 else ""
        text = f"{whose}{sums_text(shown, own)}".replace("; ", "  ·  ")
        figure.text(0.012, 1 - (0.52 + 0.25 * n) / height, text, fontsize=9.5, va="center")
    marks = [*(Patch(fc=colour) for colour in BLOCK_COLOURS.values()), Patch(fc=PAPER, ec=MAP_BORDER)]
    style = {"ncols": 5, "frameon": False, "fontsize": 9, "handlelength": 1.2, "columnspacing": 1.2}
    place = (0.995, 1 - 0.05 / height)
    figure.legend(marks, [*BLOCK_COLOURS, NO_DATA_GROUP], loc="upper right", bbox_to_anchor=place, **style)


def _axes(figure: Figure, box: tuple[float, float, float, float], total: float) -> Axes:
    """Axes in a box of left, bottom, width and height [inch]."""
    left, bottom, width, height = box
    return figure.add_axes((left / PICTURE_WIDTH, bottom / total, width / PICTURE_WIDTH, height / total))


CalendarRow = tuple[date, str, DiaryDay | None]  # date, person, their day with data


def _calendar_rows(shown: Overview) -> list[CalendarRow]:
    """A row per date and person."""
    days = {(day.date, day.person): day for day in shown.days}
    return [(on, who, days.get((on.isoformat(), who))) for on in shown.period.dates for who in shown.persons]


def _row_height(rows: Sequence[CalendarRow]) -> float:
    return DAY_ROW if len(rows) == 1 else ROW_HEIGHT


def _names_height(rows: Sequence[CalendarRow]) -> float:
    """Height [inch] of the names above the only row."""
    return NAME_ROW * MAX_NAME_ROWS if len(rows) == 1 and rows[0][2] and any(_names(rows[0][2])) else 0.0


def _draw_rows(shown: Overview, rows: Sequence[CalendarRow], figure: Figure, bottom: float, total: float) -> None:
    """Draw a row per day with the hours from left to right; beside it distance and steps."""
    height = _row_height(rows) * len(rows)
    axes = _axes(figure, (NAMES_WIDTH, bottom + 0.4, PICTURE_WIDTH - NAMES_WIDTH - SIDE, height), total)
    axes.set(xlim=(0, 24), ylim=(len(rows), 0), yticks=[])
    _style(axes)
    axes.set_xticks(range(0, 25, 3), [f"{hour:02d}:00" for hour in range(0, 25, 3)], fontsize=SMALL_FONT)
    axes.vlines(range(3, 24, 3), 0, len(rows), color=MAP_BORDER, lw=0.5, zorder=1.5)
    boxes: dict[str, list[Array]] = {group: [] for group in BLOCK_COLOURS}
    for n, (on, who, day) in enumerate(rows):
        axes.add_collection(PolyCollection([_rectangle(0, 24, n + 0.1, n + 0.9)], fc=PAPER, zorder=1), autolim=False)
        for group, start, end in _blocks(shown, on, day):
            boxes[group].append(_rectangle(start, end, n + 0.1, n + 0.9))
        name = f"{on:%a} {on}" if len(shown.persons) == 1 else f"{on:%a} {on:%m-%d}  {short_name(who)}"
        axes.text(-0.15, n + 0.5, name, fontsize=SMALL_FONT, ha="right", va="center", color=INK)
    for group, own in boxes.items():
        axes.add_collection(PolyCollection(own, fc=BLOCK_COLOURS[group], lw=0.2, ec="white", zorder=2), autolim=False)
    _draw_offsets(axes, rows)
    if _names_height(rows):
        _draw_names(axes, *rows[0])
    if not shown.place:
        _draw_distances(_axes(figure, (PICTURE_WIDTH - SIDE + 0.55, bottom + 0.4, SIDE - 1.75, height), total), rows)


def _names(day: DiaryDay) -> Iterator[tuple[TimelineEntry, str]]:
    """The stays of a day at places with names, the longest first, and the names."""
    for stay in sorted((entry for entry in day.entries if entry.kind == STAY), key=lambda entry: -entry.duration):
        if name := stay.place or (stay.facing[0][0] if stay.facing else ""):
            yield stay, short_name(name)


def _draw_names(axes: Axes, on: date, _: str, day: DiaryDay | None) -> None:
    """Draw the names of stays above the only row, as far as they fit."""
    per_point = 24.0 / (axes.get_window_extent().width * 72 / axes.figure.dpi)  # [h]
    rows: list[list[tuple[float, float]]] = [[] for _ in range(MAX_NAME_ROWS)]
    for stay, name in _names(day) if day else ():
        middle = float(np.mean(_hours_of(stay, on)))
        half = (label_width(name) / 2 + LETTER_WIDTH) * per_point
        own = (middle - half, middle + half)
        row = next((n for n, others in enumerate(rows) if all(own[1] < a or own[0] > b for a, b in others)), None)
        if row is not None:
            rows[row].append(own)
            level = -NAME_ROW / DAY_ROW * (row + 0.2)
            axes.plot([middle, middle], [0.1, level], color=RADIO, lw=0.5, zorder=1, clip_on=False)
            axes.text(middle, level, name, fontsize=LABEL_SIZE, ha="center", va="bottom", color=INK)


def _rectangle(left: float, right: float, top: float, bottom: float) -> Array:
    """Corners ``(4, 2)`` of a rectangle."""
    return np.array([(left, top), (right, top), (right, bottom), (left, bottom)])


def _blocks(shown: Overview, on: date, day: DiaryDay | None) -> Iterator[tuple[str, float, float]]:
    """Group, start and end [h] of a day's entries by the local clock; of an overview of a place, of its stays alone.

    The parts of a stay without data are UNSEEN.
    """
    for entry in day.entries if day else ():
        group = GROUPS[entry.kind]
        own = not shown.place or (entry.kind == STAY and is_place(shown.place, entry))
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
    axes.text(0, -0.1, "walked", fontsize=SMALL_FONT, va="bottom", color=INK)
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


def _tile_parts(shown: Overview) -> Iterator[Part]:
    """A part of the picture per person and year."""
    for own in shown.diaries:
        for year in range(shown.period.first.year, shown.period.last.year + 1):
            days = {day.date: day for day in own.days if day.date.startswith(f"{year}-")}
            if days or shown.period.kind == YEAR:
                title = f"{short_name(own.person)}  {year}" if len(shown.persons) > 1 else str(year)
                yield Part(7 * DAY_TILE + 0.65, partial(_draw_year, shown, year, days, title))


def _draw_year(
    shown: Overview, year: int, days: dict[str, DiaryDay], title: str, figure: Figure, bottom: float, total: float
) -> None:
    """Draw the days of a year as tiles: weeks from left to right, Monday on top."""
    weeks = 54
    axes = _axes(figure, (NAMES_WIDTH, bottom + 0.15, weeks * DAY_TILE, 7 * DAY_TILE), total)
    axes.set(xlim=(0, weeks), ylim=(7, 0), xticks=[], yticks=[])
    _style(axes)
    first = date(year, 1, 1)
    boxes: dict[str, list[Array]] = {group: [] for group in (NO_DATA_GROUP, *BLOCK_COLOURS)}
    for n in range((date(year + 1, 1, 1) - first).days):
        on = first + timedelta(days=n)
        column, row = (n + first.weekday()) // 7, on.weekday()
        boxes[NO_DATA_GROUP].append(_rectangle(column + 0.06, column + 0.94, row + 0.06, row + 0.94))
        level = row + 0.94
        for group, share in _shares(shown, on, days.get(on.isoformat())):
            boxes[group].append(_rectangle(column + 0.06, column + 0.94, level, level - 0.88 * share))
            level -= 0.88 * share
        if on.day == 1:
            axes.text(column + (row > 0), -0.25, f"{on:%b}", fontsize=SMALL_FONT, va="bottom", color=INK)
    for group, own in boxes.items():
        empty = group == NO_DATA_GROUP
        style = {"fc": PAPER, "ec": MAP_BORDER, "lw": 0.4} if empty else {"fc": BLOCK_COLOURS[group], "lw": 0}
        axes.add_collection(PolyCollection(own, zorder=1 + (not empty), **style), autolim=False)
    for row in (0, 2, 4, 6):
        axes.text(-0.3, row + 0.5, WEEKDAYS[row][:3], fontsize=SMALL_FONT, ha="right", va="center", color=INK)
    figure.text(0.012, (bottom + 0.15 + 6.6 * DAY_TILE) / total, title, fontsize=10, weight="bold")


def _shares(shown: Overview, on: date, day: DiaryDay | None) -> Iterator[tuple[str, float]]:
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


def _map_height(row: Sequence[Panel], number: int) -> float:
    """Height of a row of maps [inch], so that the first one's content fills its width. number: of all maps."""
    wide, high = (row[0].corners[1] - row[0].corners[0]).tolist()
    least, most = MAP_HEIGHTS
    return min(max(PICTURE_WIDTH / len(row) * high / wide, least), most if number == 1 else MANY_MAPS_HEIGHT)


def _draw_maps(
    row: Sequence[Panel],
    maps: Sequence[Panel],
    height: float,
    server: TileServer,
    figure: Figure,
    bottom: float,
    total: float,
) -> None:
    """Draw some of the maps beside each other."""
    width = (PICTURE_WIDTH - MAP_SPACING) / len(row) - MAP_SPACING
    for n, panel in enumerate(row):
        axes = _axes(
            figure,
            (MAP_SPACING + n * (width + MAP_SPACING), bottom + MAP_SPACING, width, height - 2 * MAP_SPACING),
            total,
        )
        draw_map(axes, panel, maps, width / (height - 2 * MAP_SPACING), server)


def _draw_usual(
    places: Sequence[tuple[str, Place]], several: bool, figure: Figure, bottom: float, total: float
) -> None:
    """Draw the usual hours of places: a row per weekday, quartiles of arrivals and departures, the median as a mark."""
    width = (PICTURE_WIDTH - 0.4 - MAP_SPACING) / MOST_HOURS
    for n, (person, place) in enumerate(places):
        axes = _axes(figure, (0.75 + n * width, bottom + 0.4, width - 0.6, HOURS_HEIGHT - 0.8), total)
        axes.set(xlim=(0, 24), ylim=(6.6, -0.6), facecolor=PAPER)
        _style(axes)
        axes.set_xticks(range(0, 25, 6), [f"{hour:02d}:00" for hour in range(0, 25, 6)], fontsize=SMALL_FONT)
        axes.set_yticks(range(7), [day[:3] for day in WEEKDAYS], fontsize=SMALL_FONT)
        axes.grid(axis="x", color=MAP_BORDER, lw=0.5)
        whose = f"{short_name(person)}: " if several else ""
        axes.set_title(f"{whose}{short_name(place.label)}: ▶ arrivals, ◁ departures", fontsize=9, loc="left")
        for usual in (own for own in place.hours if own.weekday != EVERY_DAY):
            row = WEEKDAYS.index(usual.weekday)
            _draw_quartiles(axes, usual.arrival, row - 0.12, ">", COLOURS[STAY], COLOURS[STAY])
            _draw_quartiles(axes, usual.departure, row + 0.12, "<", COLOURS[STAY], "white")


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
