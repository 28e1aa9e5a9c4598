"""The picture of an overview as SVG: a calendar with the time of each kind, maps, and the usual hours of places.

The calendar of at most a month and a half has a row per day with the hours from left to right; that of a year has a
tile per day, filled from below by the share of each kind. Time without data is empty, and pale where it belongs to a
stay. The maps of one day also have the 95 % region of its tracks, and floor plans. Lengths are in pixels.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from html import escape
from itertools import groupby

import numpy as np
import shapely
from rich.cells import cell_len

from pdr_graph.apps.lifelog.day import GAP, KINDS_WITHOUT_DATA, PRIVATE, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import DiaryDay
from pdr_graph.apps.lifelog.local_time import ALL, DAY, YEAR
from pdr_graph.apps.lifelog.maps import Dot, DrawnPart, MercatorFrame, Panel, TileServer, floor_of, panels, short_name
from pdr_graph.apps.lifelog.overview import Overview, entry_text, fitted
from pdr_graph.apps.lifelog.places import EVERY_DAY, WEEKDAYS, Place, is_place
from pdr_graph.apps.lifelog.timeline import PASSING, STAY, TimelineEntry, distance_text, duration_text
from pdr_graph.apps.report.page import BAND, OUTDOORS, RADIO, plan_drawing, region, thinned
from pdr_graph.errors import count, one_line
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.notebook_html import BLUE, GREY, RED
from pdr_graph.types import Array

COLOURS = {WALKING: BLUE, VEHICLE: RED, STANDING: "#3f9c8f", STAY: RADIO, PASSING: "#b9a3d0", GAP: GREY, PRIVATE: GREY}
PAPER = "#f7f6f2"
WALK, RIDE, STAYED, NO_DATA_GROUP, UNSEEN = "walking", "riding", "staying", "no data", "no data within a stay"
GROUPS = {
    WALKING: WALK,
    PASSING: WALK,
    VEHICLE: RIDE,
    STAY: STAYED,
    STANDING: STAYED,
    GAP: NO_DATA_GROUP,
    PRIVATE: NO_DATA_GROUP,
}
BLOCK_COLOURS = {STAYED: COLOURS[STAY], WALK: BLUE, RIDE: RED, UNSEEN: "#c9b8dc"}  # from below, in a tile
GUESS_OPACITY = 0.45  # of what another program guessed
VOID = ("input", "link", "meta")  # elements of HTML without an end tag


def tag(name: str, /, *content: str, **attributes: object) -> str:
    """An element of HTML or SVG. content: its parts, escaped where they are text; attributes: escaped here; those that
    are None are left out, ``_`` becomes ``-`` (``class_``: ``class``), and numbers have two decimals.
    """
    texts = []
    for key, value in attributes.items():
        text = f"{value:.2f}".removesuffix(".00") if isinstance(value, float) else str(value)
        texts += [f' {key.rstrip("_").replace("_", "-")}="{escape(text)}"'] if value is not None else []
    return f"<{name}{''.join(texts)}>" + ("" if name in VOID else f"{''.join(content)}</{name}>")


def text_tag(x: float, y: float, text: str, **attributes: object) -> str:
    """A text of SVG at a point [px], its baseline there."""
    return tag("text", escape(text), x=x, y=y, **attributes)


def linked(address: str, *content: str, **attributes: object) -> str:
    """Elements as a link; as they are without an address."""
    return tag("a", *content, href=address, **attributes) if address else "".join(content)


class Links:
    """The addresses to which a picture and a page lead: none, in a file. ``apps.serve`` has those of a server."""

    def day(self, person: str, on: str) -> str:
        """Address of a day."""
        return ""

    def place(self, person: str, number: int) -> str:
        """Address of a place."""
        return ""

    def entry(self, day: DiaryDay, number: int) -> str:
        """Address of the page that corrects an entry of a day."""
        return ""


@dataclass(frozen=True)
class Picture:
    """A part of the picture of an overview. content: SVG; kind: its class; about: other attributes."""

    kind: str
    width: float
    height: float
    content: str

    @property
    def svg(self) -> str:
        """The SVG element."""
        size = f"0 0 {self.width:.0f} {self.height:.0f}"
        return tag("svg", self.content, viewBox=size, role="group", aria_label=self.kind)


# [px]
WIDTH, SPACE, LEFT, RIGHT = 1180.0, 10.0, 140.0, 250.0  # of the picture; between maps; beside the rows of days
DAY_ROW, ONLY_ROW, DAY_TILE, HOURS = 24.0, 46.0, 18.0, 22.0  # a day, the only day, a day's tile, the line of hours
LETTER = 7.2  # width of a letter, on average
MAP_HEIGHTS = (360.0, 470.0, 680.0)  # of a map: least; most beside others; most of the only one
LONGEST_CALENDAR = 62  # of a calendar of many persons
LONGEST_ROWS = 45  # days of a calendar with a row per day
MOST_HOURS = 3  # places whose usual hours are drawn
HOUR = (WIDTH - LEFT - RIGHT) / 24


def pictures(shown: Overview, tiles: TileServer, links: Links | None = None) -> list[Picture]:
    """The picture of an overview, in parts from the top. tiles: behind its maps; links: to where it leads."""
    to, maps = links or Links(), panels(shown)
    columns = 2 if len(maps) == 4 else 3
    drawn = list[Picture]()
    for row in (maps[n : n + columns] for n in range(0, len(maps), columns)):
        # the content of the first one fills its width
        wide, high = (row[0].corners[1] - row[0].corners[0]).tolist()
        least, several, only = MAP_HEIGHTS
        width = (WIDTH - SPACE * (len(row) - 1)) / len(row)
        height = min(max(width * high / wide, least), only if len(maps) == 1 else several)
        drawn += [draw_map(shown, panel, maps, (width, height), tiles, to) for panel in row]
    if shown.period.kind == DAY:
        return [*_calendars(shown, to), *drawn]
    # least arrivals of a place whose usual hours are drawn
    usual = [placed for placed in shown.places if placed[1].hours[0].arrivals >= 3 and not shown.is_fleet][:MOST_HOURS]
    return [*_calendars(shown, to), *drawn, *(_usual(who, place, len(shown.persons) > 1) for who, place in usual)]


def legend(guesses: bool = False) -> str:
    """The colours of the calendar, as HTML. guesses: True if there are some of other programs."""
    colours = {**BLOCK_COLOURS, NO_DATA_GROUP: PAPER}
    marks = [tag("span", tag("i", style=f"background:{colour}"), name) for name, colour in colours.items()]
    if guesses:
        pale = f"background:{BLOCK_COLOURS[RIDE]};opacity:{GUESS_OPACITY}"
        marks.append(tag("span", tag("i", style=pale), "guessed by another program: pale, dotted"))
    return tag("p", *marks, class_="legend")


# Calendars


def _calendars(shown: Overview, links: Links) -> Iterator[Picture]:
    dates = [date.fromisoformat(on) for on in sorted({day.date for day in shown.days})]
    if shown.is_fleet and (len(shown.period) > 1 or len(shown.persons) > LONGEST_CALENDAR):
        yield _busy(shown, dates)
    elif shown.period.kind in (YEAR, ALL) and len(shown.period) > LONGEST_ROWS:
        for own in shown.diaries:
            for year in range(shown.period.first.year, shown.period.last.year + 1):
                days = {day.date: day for day in own.days if day.date.startswith(f"{year}-")}
                if days or shown.period.kind == YEAR:
                    title = f"{short_name(own.person)}  {year}" if len(shown.persons) > 1 else str(year)
                    yield _year(shown, year, days, title, links)
    else:
        yield _rows(shown, links)


def _hours_grid(height: float) -> str:
    """The lines of the hours with their names above."""
    lines = []
    for hour in range(0, 25, 3):
        x = LEFT + hour * HOUR
        lines.append(tag("line", x1=x, x2=x, y1=HOURS - 4, y2=HOURS + height, class_="grid"))
        lines.append(text_tag(x, HOURS - 8, f"{hour:02d}:00", class_="middle soft"))
    return "".join(lines)


def _rows(shown: Overview, links: Links) -> Picture:
    """A row per day with the hours from left to right; beside it the offset from UTC, distance and steps.

    The only row has the names of its stays.
    """
    known = {(day.date, day.person): day for day in shown.days}
    rows = [(on, who, known.get((on.isoformat(), who))) for on in shown.period.dates for who in shown.persons]
    high = ONLY_ROW if len(rows) == 1 else DAY_ROW
    longest = max([day.totals.walked for day in shown.days], default=0.0) or 1.0
    drawn, offsets = [], dict[str, float]()
    for n, (on, who, day) in enumerate(rows):
        top, middle = HOURS + n * high, HOURS + n * high + high / 2 + 4
        name = f"{on:%a} {on}" if len(shown.persons) == 1 else f"{on:%a} {on:%m-%d}  {fitted(one_line(who), 9)}"
        label = text_tag(LEFT - 10, middle, name, class_="end")
        drawn.append(linked(links.day(who, day.date) if day else "", label))
        box = {"y": top + 3, "height": high - 6}
        drawn.append(tag("rect", x=LEFT, width=24 * HOUR, class_="empty", **box))
        if day is None:
            continue
        for group, start, end, number in blocks(shown, on, day):
            title = tag("title", escape(entry_text(day.entries[number])))
            left, wide = LEFT + start * HOUR, max((end - start) * HOUR, 0.5)
            look = {
                "fill": BLOCK_COLOURS[group],
                "fill_opacity": GUESS_OPACITY if day.entries[number].is_guess else None,
            }
            block = tag("rect", title, x=left, width=wide, **look, **box)
            address = links.entry(day, number) if len(rows) == 1 else links.day(who, day.date)
            drawn.append(linked(address, block, class_="entry", data_n=number))
        drawn += [_names(day, on, middle)] if len(rows) == 1 else []
        x = LEFT + 24 * HOUR + 8
        if day.entries and offsets.get(who) != day.entries[-1].end_offset:
            offsets[who] = day.entries[-1].end_offset
            drawn.append(text_tag(x, middle, offset_text(offsets[who]), class_="soft"))
        if day.totals.walked >= 0.5 and not shown.place:
            steps = f", {day.totals.steps:,} steps" if day.totals.steps else ""
            wide = (RIGHT - 75) * day.totals.walked / longest
            drawn.append(tag("rect", x=x + 65, y=top + 4, width=wide, height=high - 8, fill=BLUE, opacity=0.3))
            drawn.append(text_tag(x + 69, middle, f"{distance_text(day.totals.walked)}{steps}"))
    title = "" if shown.place else text_tag(LEFT + 24 * HOUR + 77, HOURS - 8, "walked", class_="soft")
    height = high * len(rows)
    return Picture("calendar", WIDTH, HOURS + height + 6, _hours_grid(height) + title + "".join(drawn))


def _names(day: DiaryDay, on: date, y: float) -> str:
    """The names of a day's stays, in their blocks where they fit."""
    named = []
    for entry in day.entries:
        name = (entry.place or (entry.facing[0][0] if entry.facing else "")) if entry.kind == STAY else ""
        start, end = np.clip(_hours_of(entry, on), 0, 24).tolist()
        if name and _width(short_name(name)) < (end - start) * HOUR:
            named.append(text_tag(LEFT + (start + end) / 2 * HOUR, y, short_name(name), class_="middle name"))
    return "".join(named)


def _busy(shown: Overview, dates: Sequence[date]) -> Picture:
    """How many persons had data in each quarter of an hour: a row per date, of weekdays if there are many."""
    weekly = len(dates) > LONGEST_CALENDAR
    row_of = {on.isoformat(): on.weekday() if weekly else n for n, on in enumerate(dates)}
    present = np.zeros((len(WEEKDAYS) if weekly else len(dates), 96))
    for day in (day for day in shown.days if day.date in row_of):
        quarters = np.zeros(96, dtype=bool)
        for entry in (entry for entry in day.entries if entry.is_seen):
            first, last = ((t - day.start) / 900 for t in (entry.start, entry.end))
            quarters[int(first) : max(int(np.ceil(last)), int(first) + 1)] = True
        present[row_of[day.date]] += quarters
    drawn, most = [], max(float(present.max(initial=0.0)), 1.0)
    for n, row in enumerate(present):
        top, middle = HOURS + n * DAY_ROW, HOURS + n * DAY_ROW + DAY_ROW / 2 + 4
        name = WEEKDAYS[n] if weekly else f"{dates[n]:%a} {dates[n]:%m-%d}"
        drawn.append(text_tag(LEFT - 10, middle, name, class_="end"))
        quarter = 0
        for number, same in groupby(row.tolist()):
            x, lasts = LEFT + quarter * HOUR / 4, len(list(same))
            style = {"fill": RADIO, "fill_opacity": number / most}
            drawn.append(
                tag("rect", x=x, y=top + 1, width=lasts * HOUR / 4, height=DAY_ROW - 2, **style) if number else ""
            )
            quarter += lasts
        at = f", {int(row.argmax()) // 4:02d}:00" if row.any() else ""
        busiest = f"at most {count(int(row.max()), 'person')}{at}"
        drawn.append(text_tag(LEFT + 24 * HOUR + 8, middle, busiest, class_="soft"))
    height = DAY_ROW * len(present)
    return Picture("calendar", WIDTH, HOURS + height + 6, _hours_grid(height) + "".join(drawn))


def blocks(shown: Overview, on: date, day: DiaryDay) -> Iterator[tuple[str, float, float, int]]:
    """Group, start and end [h] of a day's entries by the local clock, and their numbers; of an overview of a place, of
    its stays alone. The parts of a stay without data are UNSEEN.
    """
    for number, entry in enumerate(day.entries):
        group = GROUPS[entry.kind]
        own = not shown.place or (entry.kind == STAY and is_place(shown.place, entry.place, entry.place_number))
        if group == NO_DATA_GROUP or not own:
            continue
        bounds = _hours_of(entry, on)
        yield group, *np.clip(bounds, 0, 24).tolist(), number
        for part in entry.parts or (entry,) if group == STAYED else ():
            if not part.is_seen:
                share = np.interp([part.start, part.end], [entry.start, entry.end], bounds)
                yield UNSEEN, *np.clip(share, 0, 24).tolist(), number


def _hours_of(entry: TimelineEntry, on: date) -> Array:
    """Start and end ``(2,)`` of an entry by the local clock, from the midnight of a date [h]."""
    midnight = datetime(on.year, on.month, on.day, tzinfo=UTC).timestamp()
    return (np.array([entry.start + entry.offset, entry.end + entry.end_offset]) - midnight) / 3600


def offset_text(offset: float) -> str:
    """An offset from UTC [s] as ``UTC+2`` or ``UTC+5:30``."""
    hours, minutes = divmod(abs(round(offset / 60)), 60)
    return f"UTC{'-' if offset < 0 else '+'}{hours}" + (f":{minutes:02d}" if minutes else "")


def _year(shown: Overview, year: int, days: Mapping[str, DiaryDay], title: str, links: Links) -> Picture:
    """The days of a year as tiles: weeks from left to right, Monday on top.

    A tile is filled from below by the share of each kind; one that occurred has at least an eighth, so that a short
    walk is seen.
    """
    first = date(year, 1, 1)
    drawn = [text_tag(0, HOURS + DAY_TILE, title, class_="bold")]
    drawn += [
        text_tag(LEFT - 10, HOURS + (n + 0.75) * DAY_TILE, WEEKDAYS[n][:3], class_="end soft") for n in (0, 2, 4, 6)
    ]
    for n in range((date(year + 1, 1, 1) - first).days):
        on = first + timedelta(days=n)
        column, row = (n + first.weekday()) // 7, on.weekday()
        x, y, side = LEFT + column * DAY_TILE + 1, HOURS + row * DAY_TILE + 1, DAY_TILE - 2
        if on.day == 1:
            drawn.append(text_tag(x + (DAY_TILE if row else 0), HOURS - 8, f"{on:%b}", class_="soft"))
        tile = [tag("rect", x=x, y=y, width=side, height=side, class_="empty")]
        day, level = days.get(on.isoformat()), y + side
        hours = dict.fromkeys(BLOCK_COLOURS, 0.0)
        for group, start, end, _ in blocks(shown, on, day) if day else ():
            hours[group] += max(end - start, 0.0)
        hours[STAYED] = max(hours[STAYED] - hours[UNSEEN], 0.0)
        least = {group: max(time, 24 / 8) if time > 0 else 0.0 for group, time in hours.items()}
        for group in (UNSEEN, STAYED, WALK, RIDE):
            high = side * least[group] / max(sum(least.values()), 24.0)
            level -= high
            tile += [tag("rect", x=x, y=level, width=side, height=high, fill=BLOCK_COLOURS[group])] if high else []
        text = tag("title", escape(f"{on:%a} {on}"))
        drawn.append(linked(links.day(day.person, day.date) if day else "", tag("g", text, *tile)))
    return Picture("calendar", WIDTH, HOURS + 7 * DAY_TILE + 6, "".join(drawn))


def _usual(person: str, place: Place, several: bool) -> Picture:
    """The usual hours of a place: quartiles of arrivals and departures, the median as a mark.

    A row per weekday, and one of all days.
    """
    width, left, row = WIDTH / MOST_HOURS - SPACE, 36.0, 18.0
    hour = (width - left - 20) / 24
    whose = f"{short_name(person)}: " if several else ""
    drawn = [text_tag(left, 13, f"{whose}{short_name(place.label)}: ▶ arrivals, ◁ departures")]
    for n in range(0, 25, 6):
        drawn.append(tag("line", x1=left + n * hour, x2=left + n * hour, y1=20, y2=24 + 8 * row, class_="grid"))
        drawn.append(text_tag(left + n * hour, 38 + 8 * row, f"{n:02d}:00", class_="middle soft"))
    for usual in place.hours:
        every = usual.weekday == EVERY_DAY
        top = 20 + (len(WEEKDAYS) if every else WEEKDAYS.index(usual.weekday)) * row
        drawn.append(text_tag(left - 6, top + 13, "all" if every else usual.weekday[:3], class_="end soft"))
        for (low, middle, high), level, mark in ((usual.arrival, top + 6, "▶"), (usual.departure, top + 14, "◁")):
            if np.isfinite(middle):  # a line from quartile to quartile, over midnight too
                ends = [(low, high)] if low <= high else [(low, 24.0), (0.0, high)]
                lines = (f"M{left + a * hour:.1f},{level:.1f}H{left + b * hour:.1f}" for a, b in ends)
                drawn.append(tag("path", d="".join(lines), stroke=RADIO, fill="none"))
                drawn.append(text_tag(left + middle * hour, level + 4, mark, class_="middle mark"))
    return Picture("usual-hours", width, 42 + 8 * row, "".join(drawn))


# Maps

LINE_TOLERANCE = 0.3  # [px] to which lines are simplified
MOST_TRACK_ROWS = 3000  # of the walker that moves on a map
HEAT_LEVELS = (1.0, 4.0, 15.0, 60.0, 240.0, 900.0)  # [s/m²] of all persons, from which a heat map is a shade darker
HEAT, HEAT_OPACITY = "#c03a1e", 0.18


@dataclass(frozen=True)
class MapArea:
    """The shown area of a map: from ``low (2,)`` to ``high (2,)`` [m], drawn with `size` [px]."""

    low: Array
    high: Array
    size: tuple[float, float]

    @classmethod
    def of(cls, panel: Panel, size: tuple[float, float]) -> MapArea:
        """The area of a map, longer where the picture is."""
        half = np.ptp(panel.corners, axis=0) / 2
        low, high = panel.corners.mean(axis=0) + np.outer((-1, 1), np.array(size) * np.max(half / size))
        return cls(low, high, size)

    @property
    def scale(self) -> float:
        """Pixels per metre."""
        return self.size[0] / float(self.high[0] - self.low[0])

    def pixels(self, position: Array) -> Array:
        """Positions ``(…, 2)`` [m] in pixels, from the upper left corner."""
        return (position - (self.low[0], self.high[1])) * (self.scale, -self.scale)

    def holds(self, position: Array) -> bool:
        """True if a position ``(2,)`` [m] is in the area."""
        return bool(np.all((position >= self.low) & (position <= self.high)))

    def line(self, position: Array) -> str:
        """Positions ``(n, 2)`` [m] as a path of SVG: the parts in the area and one size of it around, simplified.

        A part goes on to the rows before and after it; a line of two rows, as that of a gap, is whole.
        """
        margin, commands = self.high - self.low, ""
        inside = np.all((position > self.low - margin) & (position < self.high + margin), axis=1)
        near = inside | np.append(inside[1:], False) | np.append(False, inside[:-1]) | (len(position) == 2)
        rows = np.flatnonzero(near)
        for own in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            if len(own) > 1:
                simple = shapely.simplify(shapely.linestrings(self.pixels(position[own])), LINE_TOLERANCE)
                commands += _commands(shapely.get_coordinates(simple))
        return commands

    def polygons(self, shapes: Array | shapely.Geometry) -> str:
        """Polygons [m] as a path of SVG, simplified."""
        drawn = shapely.simplify(shapely.transform(shapely.union_all(shapes), self.pixels), LINE_TOLERANCE)
        return "".join(_commands(shapely.get_coordinates(r)) + "Z" for r in shapely.get_rings(shapely.get_parts(drawn)))


def _commands(line: Array) -> str:
    """The points ``(n, 2)`` of a line in SVG syntax."""
    return "M" + " ".join(f"{x:.1f},{y:.1f}" for x, y in line.tolist())


def draw_map(
    shown: Overview, panel: Panel, maps: Sequence[Panel], size: tuple[float, float], tiles: TileServer, links: Links
) -> Picture:
    """A map. maps: all of the overview; size: width and height [px]."""
    ground = MapArea.of(panel, size)
    days = shown.days if shown.period.kind == DAY and len(shown.diaries) == 1 else []
    floor, failure = floor_of(panel)
    drawn = [*_tiles(panel, ground, tiles), *([_plan(floor, ground)] if floor else [])]
    tracks = [track for own in panel.ways for track in own]
    if regions := [region(track, np.array([panel.floor in ("", f) for f in track.floor]), floor) for track in tracks]:
        drawn.append(tag("path", d=ground.polygons(np.concatenate(regions)), fill=BAND, fill_opacity=0.3))
    scale = ""
    if panel.plan and not panel.ways:
        time = time_by_place(panel.drawn, np.array([ground.low, ground.high]))
        scale = _heat_scale(float(time.max(initial=0.0)), ground)
        drawn += [*_heat(time, ground), *_arrows(panel, ground)]
    else:
        drawn += _lines(panel, ground, days, links)
    larger = [(other.letter, corners) for other in maps if (corners := _corners_on(panel, other)) is not None]
    for _, corners in larger:
        (x0, y1), (x1, y0) = ground.pixels(corners).tolist()
        drawn.append(tag("rect", x=x0, y=y0, width=x1 - x0, height=y1 - y0, class_="outline"))
    hidden = [MapArea(low, high, size) for _, (low, high) in larger]
    dots = [dot for dot in panel.dots if ground.holds(dot.position) and not any(h.holds(dot.position) for h in hidden)]
    start = tag("circle", r=4, fill="white", stroke=BLUE)
    pins = [
        *((corners[1], letter, "") for letter, corners in larger),
        *((dot.position, dot.label, mark) for dot, mark in _marks(dots, days, links)),
        *((position, time, start) for position, time in panel.starts),
    ]
    # the most important last, so that it is on top; the script places its label first
    shapes = [_pin(ground.pixels(position), text, mark) for position, text, mark in pins[::-1]]
    about = {"data_shares": _shares(panel, ground), "data_track": _walker(panel, ground) if days else None}
    box = {"width": size[0], "height": size[1], "viewBox": f"0 0 {size[0]:.0f} {size[1]:.0f}"}
    about |= box | {"data_metres": f"{1 / ground.scale:.6g}"}
    inside = tag("svg", *drawn, tag("g", *shapes, class_="pins"), class_="ground", **about)
    back = tag("rect", width=size[0], height=size[1], fill=OUTDOORS if panel.plan else PAPER)
    frame = tag("rect", x=0.5, y=0.5, width=size[0] - 1, height=size[1] - 1, class_="outline frame")
    return Picture("map", *size, back + inside + frame + scale + _decoration(panel, ground, failure))


def _pin(at: Array, text: str, mark: str) -> str:
    """A mark at a point ``(2,)`` [px] with its label, which the script places."""
    (x, y), label = at.tolist(), text_tag(0, 0, text, class_="label halo")
    return tag("g", tag("g", mark, label, class_="pin"), transform=f"translate({x:.1f} {y:.1f})")


def _marks(dots: Sequence[Dot], days: Sequence[DiaryDay], links: Links) -> Iterator[tuple[Dot, str]]:
    """The dots of places and stays, longest first, each with its circle, which leads to its entries in a day."""
    most = max([7200.0, *(dot.time for dot in dots)])  # two hours at least have the largest area
    for dot in sorted(dots, key=lambda dot: (dot.kind == PASSING, -dot.time)):
        radius = 3.0 if dot.kind == PASSING else max(22.0 * float(np.sqrt(dot.time / most)), 3.0)
        numbers = [number for time in dot.starts for day in days if (number := entry_at(day, time)) is not None]
        look = {"fill": COLOURS[dot.kind], "fill_opacity": 0.15 if dot.is_guess else 0.5}
        ring = tag("circle", r=radius, class_="guess", stroke=COLOURS[dot.kind]) if dot.is_guess else ""
        circle = ring + tag("circle", tag("title", escape(dot.text)), r=radius, **look)
        about = {"class_": "entry dot", "data_n": " ".join(map(str, dict.fromkeys(numbers))), "aria_label": dot.text}
        yield dot, linked(links.entry(days[0], numbers[0]) if numbers else "", circle, **about)


def _decoration(panel: Panel, ground: MapArea, failure: str) -> str:
    """Letter, floor, arrow to the north, place of the scale bar, and what is missing on a map."""
    (width, height), frame = ground.size, panel.frame
    title = "   ".join(one_line(word) for word in (panel.letter, panel.floor) if word)
    drawn = [text_tag(8, 22, title, class_="halo bold")]
    if isinstance(frame, MercatorFrame) or frame.georeferenced:
        east = 0.0 if isinstance(frame, MercatorFrame) else frame.bearing_of_east(panel.corners.mean(axis=0))
        turned = f"translate({width - 20:.0f} 24) rotate({-np.degrees(east):.1f})"
        arrow = text_tag(0, -1, "▲", class_="middle halo") + text_tag(0, 14, "N", class_="middle halo")
        drawn.append(tag("g", arrow, class_="north", transform=turned))
    bar = tag("path", class_="bar") + text_tag(0, 4, "", class_="halo")
    drawn.append(tag("g", bar, class_="scale-bar", transform=f"translate(12 {height - 14:.0f})"))
    drawn += [text_tag(width / 2, height - 10, failure, class_="middle halo")] if failure else []
    return "".join(drawn)


def _tiles(panel: Panel, ground: MapArea, tiles: TileServer) -> Iterator[str]:
    """The tiles of a map in Web Mercator."""
    if isinstance(panel.frame, MercatorFrame):
        for tile in tiles.of(panel.frame, np.array([ground.low, ground.high]), ground.size[0]):
            x, y = ground.pixels(np.array([tile.corners[0, 0], tile.corners[1, 1]])).tolist()
            wide, high = (np.ptp(tile.corners, axis=0) * ground.scale).tolist()
            yield tag("image", href=tile.address, x=x, y=y, width=wide + 0.3, height=high + 0.3)  # without a seam


def _plan(floor: FloorPlan, ground: MapArea) -> str:
    """A floor plan with the names that fit."""
    drawing = plan_drawing(floor)
    x, y = ground.pixels(np.array([floor.corners[0, 0], floor.corners[1, 1]])).tolist()
    names = []
    for name in drawing["names"]:
        at_x, at_y = ground.pixels(np.array([name["x"], name["y"]])).tolist()
        if 0.75 * _width(name["text"]) < name["width"] * ground.scale:
            names.append(text_tag(at_x, at_y, name["text"], class_="middle room"))
    placed = f"translate({x:.2f} {y:.2f}) scale({ground.scale:.5f})"
    return tag("g", drawing["svg"], transform=placed) + "".join(names)


def _lines(panel: Panel, ground: MapArea, days: Sequence[DiaryDay], links: Links) -> Iterator[str]:
    """The tracks of a map by kind, of a day by entry too; those without data dotted and below the others."""
    paths = dict[tuple[str, int | None, bool], str]()
    for part in sorted(panel.drawn, key=lambda part: part.kind not in KINDS_WITHOUT_DATA):
        middle = float(part.track.time[0] + part.track.time[-1]) / 2
        key = part.kind, entry_at(days[0], middle) if days else None, part.is_guess
        paths[key] = paths.get(key, "") + ground.line(part.track.position)
    faint = 1.0 if panel.ways else 0.5 if len(panel.drawn) < 1000 else 0.2
    for (kind, number, is_guess), path in paths.items():
        unseen = is_guess or kind in KINDS_WITHOUT_DATA
        look = {"stroke": COLOURS[kind], "class_": "track unseen" if unseen else "track", "stroke_opacity": faint}
        entry = days[0].entries[number] if number is not None else None
        title = tag("title", escape(entry_text(entry))) if entry else ""
        address = links.entry(days[0], number) if number is not None and kind not in KINDS_WITHOUT_DATA else ""
        wide = 2.2 if panel.ways and (is_guess or not unseen) else 1.0
        line = tag("path", title, d=path, stroke_width=wide, **look)
        yield linked(address, line, class_="entry", data_n=number) if path else ""


def entry_at(day: DiaryDay, time: float) -> int | None:
    """Number of the entry of a day at a Unix time [s]; None outside the day."""
    number = bisect_right(day.entries, time, key=lambda entry: entry.start) - 1
    return number if number >= 0 and time <= day.entries[number].end else None


def _heat(time: Array, ground: MapArea) -> Iterator[str]:
    """The areas where tracks spent more than each of HEAT_LEVELS. time: ``(n, m)`` in each square of one metre [s]."""
    for level in HEAT_LEVELS:
        x, y = ground.low[:, None] + np.argwhere(time >= level).T
        cells = shapely.box(x, y, x + 1, y + 1)
        if len(x):
            yield tag("path", d=ground.polygons(cells), fill=HEAT, fill_opacity=HEAT_OPACITY, fill_rule="evenodd")


def _heat_scale(most: float, ground: MapArea) -> str:
    """The colours of a heat map up to `most` [s/m²], with the time at which each begins."""
    levels, (width, height) = [level for level in HEAT_LEVELS if level <= most], ground.size
    if not levels:
        return ""
    wide, left, top = 52.0, width / 2 - 26.0 * len(levels), height - 18.0
    drawn = [text_tag(left - 8, top + 11, "time per m²", class_="end halo")]
    for n, level in enumerate(levels):
        box = {"x": left + n * wide, "y": top, "width": wide, "height": 14.0}
        opacity = 1 - (1 - HEAT_OPACITY) ** (n + 1)  # of the areas that lie over one another
        drawn += [tag("rect", fill="white", **box), tag("rect", fill=HEAT, fill_opacity=opacity, **box)]
        drawn.append(text_tag(left + (n + 0.5) * wide, top + 11, duration_text(level), class_="middle"))
    return tag("g", *drawn, class_="heat-scale")


def _arrows(panel: Panel, ground: MapArea) -> Iterator[str]:
    """The flows between places, as wide as they are large; those there and back bend to different sides."""
    most = max((arrow.number for arrow in panel.arrows), default=1.0)
    for arrow in panel.arrows[::-1]:  # the largest on top
        start, end = ground.pixels(np.array([arrow.start, arrow.end]))
        way = end - start
        if (length := float(np.hypot(*way))) < 1:
            continue
        ahead, wide = way / length, 1.0 + 5.0 * arrow.number / most
        side = np.array([-ahead[1], ahead[0]])
        head = min(6.0 + 2 * wide, length / 2)
        bend = (start + end) / 2 + 0.15 * length * side
        into = (end - bend) / np.hypot(*(end - bend))  # direction at the end
        neck, beside = end - head * into, head / 2 * np.array([-into[1], into[0]])
        (x, y), (bx, by), (nx, ny) = start.tolist(), bend.tolist(), neck.tolist()
        line = tag("path", d=f"M{x:.1f},{y:.1f}Q{bx:.1f},{by:.1f} {nx:.1f},{ny:.1f}", fill="none", stroke_width=wide)
        tip = tag("path", d=_commands(np.array([neck + beside, end, neck - beside])) + "Z", fill=BLUE, stroke="none")
        yield tag("g", tag("title", escape(arrow.text)), line, tip, class_="flow", stroke=BLUE, opacity=0.75)


def time_by_place(drawn: Sequence[DrawnPart], corners: Array) -> Array:
    """Time of tracks in each square of one metre, blurred by a metre as positions are [s]. corners: ``(2, 2)`` [m]."""
    from scipy.ndimage import gaussian_filter

    tracks = [part.track for part in drawn if part.kind not in KINDS_WITHOUT_DATA and len(part.track) > 1]
    middle = [(track.position[1:] + track.position[:-1]) / 2 for track in tracks]
    place, lasts = np.concatenate([np.empty((0, 2)), *middle]), [np.diff(track.time) for track in tracks]
    cells = np.ceil(np.ptp(corners, axis=0)).astype(int)
    sides = [(float(low), float(low + n)) for low, n in zip(corners[0], cells, strict=True)]
    time, _ = np.histogramdd(place, list(cells), sides, weights=np.concatenate([np.empty(0), *lasts]))
    return gaussian_filter(time, 1.0)


def _corners_on(panel: Panel, other: Panel) -> Array | None:
    """Corners ``(2, 2)`` of another map on this one [m]; None if it is not a smaller part of it, outdoors."""
    located = isinstance(other.frame, MercatorFrame) or other.frame.georeferenced
    if other is panel or not (isinstance(panel.frame, MercatorFrame) and located):
        return None
    corners, whole = (
        panel.frame.from_frame(other.frame, other.corners),
        MapArea(panel.corners[0], panel.corners[1], (1, 1)),
    )
    part = np.max(corners[1] - corners[0]) < panel.width and all(map(whole.holds, corners))
    return corners if part else None


def _shares(panel: Panel, ground: MapArea) -> str | None:
    """Three corners of the area (NW, NE, SW) as shares of Web Mercator's map; None if not on Earth."""
    if not (isinstance(panel.frame, MercatorFrame) or panel.frame.georeferenced):
        return None
    (west, south), (east, north) = ground.low, ground.high
    corners = np.array([(west, north), (east, north), (west, south)])
    lonlat = panel.frame.to_lonlat(corners)
    frame = panel.frame if isinstance(panel.frame, MercatorFrame) else MercatorFrame(*lonlat[0, ::-1].tolist())
    return " ".join(f"{share:.12f}" for share in frame.shares(frame.from_frame(panel.frame, corners)).ravel())


def _walker(panel: Panel, ground: MapArea) -> str | None:
    """Where the walker was on a map, for the script: time [s], place [px] and sigma [m], parts separated by ``;``."""
    tracks = [track for own in panel.ways for track in own]
    share, parts = MOST_TRACK_ROWS / max(sum(map(len, tracks)), 1), []
    for track in tracks:
        rows = thinned(len(track), max(int(share * len(track)), 2))
        here = np.array([panel.floor in ("", track.floor[row]) for row in rows])
        sigma = np.zeros(len(track)) if track.covariance is None else horizontal_sigma(track.covariance[:, :2, :2])
        table = np.column_stack([track.time, ground.pixels(track.position), sigma])[rows]
        for run in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(here.astype(int))) + 1):
            if len(run) and here[run[0]]:
                parts.append(",".join(f"{t:.1f} {x:.1f} {y:.1f} {s:.1f}" for t, x, y, s in table[run].tolist()))
    return ";".join(parts) or None


def _width(text: str) -> float:
    """About the width of a text [px]."""
    return LETTER * cell_len(text)
