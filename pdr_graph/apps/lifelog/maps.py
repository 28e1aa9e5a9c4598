"""The maps of an overview: tracks by kind, and places as dots whose area is the time there; tiles behind them.

One map has everything within 50 km of each other; places on other continents have a map of their own beside it. Of one
day there are also enlarged maps of small places, and a map per floor of each plan with the stays on it.

Tiles come from the address that the user gives; without one nothing is ever fetched. The address is a template such as
``https://tile.openstreetmap.org/{z}/{x}/{y}.png`` (Web Mercator). Its server learns which area is drawn.
"""

from __future__ import annotations

import base64
import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from urllib.parse import urlsplit

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pdr_graph import __version__
from pdr_graph.apps.lifelog.day import GAP, KINDS_WITHOUT_DATA, STANDING, VEHICLE, Outing, Stay, clipped, split_at_gaps
from pdr_graph.apps.lifelog.diary import DiaryDay
from pdr_graph.apps.lifelog.local_time import DAY
from pdr_graph.apps.lifelog.overview import Overview, clock_text, time_text
from pdr_graph.apps.lifelog.places import Flow
from pdr_graph.apps.lifelog.stays_and_legs import MOVING, VISIT_RADIUS, on_sphere
from pdr_graph.apps.lifelog.timeline import PASSING, STAY, duration_text
from pdr_graph.errors import InputError, count, one_line
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame
from pdr_graph.geometry import horizontal_sigma
from pdr_graph.types import Array, OneLineRepr, Trajectory
from pdr_graph.web_request import ask

MERCATOR_RADIUS = 6_378_137.0  # [m] of Web Mercator's sphere
# Chosen by hand
MAX_TILES = 64  # of a map
TIMEOUT, TILES_TIME = 10.0, 60.0  # [s] of a request; of all tiles of a map
MAX_FAILURES = 3  # requests that may fail before no other is made
PNG_HEAD, PNG_SIGNATURE = struct.Struct(">8s8xII"), b"\x89PNG\r\n\x1a\n"  # signature, width and height


@dataclass(frozen=True)
class MercatorFrame:
    """Web Mercator about a point [deg], scaled so that lengths there are metres; x is east, y is north."""

    latitude: float
    longitude: float

    @property
    def scale(self) -> float:
        """Metres per radian of longitude."""
        return MERCATOR_RADIUS * float(np.cos(np.radians(self.latitude)))

    def from_lonlat(self, lonlat: Array) -> Array:
        """Positions ``(n, 2)`` [m] from longitudes and latitudes ``(n, 2)`` [deg]."""
        east = (lonlat[:, 0] - self.longitude + 180) % 360 - 180
        north = _mercator(lonlat[:, 1]) - _mercator(np.array(self.latitude))
        return self.scale * np.column_stack([np.radians(east), north])

    def to_lonlat(self, position: Array) -> Array:
        """Longitudes and latitudes ``(n, 2)`` [deg] of positions [m]."""
        share = self.shares(position)
        latitude = np.degrees(np.arctan(np.sinh((0.5 - share[:, 1]) * 2 * np.pi)))
        return np.column_stack([(share[:, 0] - 0.5) * 360.0, latitude])

    def from_frame(self, other: Frame | MercatorFrame, position: Array) -> Array:
        """Positions ``(n, 2)`` [m] from positions in another frame, which is georeferenced."""
        return self.from_lonlat(other.to_lonlat(position))

    def shares(self, position: Array) -> Array:
        """Shares ``(n, 2)`` of the whole map's width and height, from its upper left corner, of positions [m]."""
        east = np.radians(self.longitude) + position[:, 0] / self.scale
        north = _mercator(np.array(self.latitude)) + position[:, 1] / self.scale
        return np.column_stack([0.5 + east / (2 * np.pi), 0.5 - north / (2 * np.pi)])

    def position(self, shares: Array) -> Array:
        """Positions ``(n, 2)`` [m] from shares of the whole map."""
        east = (shares[:, 0] - 0.5) * 2 * np.pi - np.radians(self.longitude)
        north = (0.5 - shares[:, 1]) * 2 * np.pi - _mercator(np.array(self.latitude))
        return self.scale * np.column_stack([east, north])


def _mercator(latitude: Array) -> Array:
    """Mercator's northing [rad] of latitudes [deg], which are limited to the map's edge."""
    return np.arcsinh(np.tan(np.radians(np.clip(latitude, -85.05, 85.05))))


@dataclass(frozen=True)
class Tile:
    """A tile with its corners ``(2, 2)`` on the map [m]. address: of a server, or of the picture itself."""

    address: str
    corners: Array


def check_template(template: str) -> None:
    """Raise InputError unless the text is a web address with {z}, {x} and {y}."""
    if urlsplit(template).scheme not in ("http", "https") or any(
        part not in template for part in ("{z}", "{x}", "{y}")
    ):
        expected = "a web address such as https://tile.openstreetmap.org/{z}/{x}/{y}.png"
        raise InputError("--tiles", "", repr(template), expected)


def tiles(template: str, frame: MercatorFrame, corners: Array, pixels: float) -> Iterator[Tile]:
    """Yield the tiles of an area ``(2, 2)`` [m] that is drawn `pixels` wide, with their addresses on the server."""
    low, high = corners
    (west, north), (east, south) = frame.shares(np.array([[low[0], high[1]], [high[0], low[1]]]))
    # The zoom at which a tile of 256 pixels is drawn about as large as it is, with at most MAX_TILES tiles
    zoom = int(np.clip(np.round(np.log2(max(pixels, 1) / 256 / max(east - west, 1e-9))), 0, 19))  # highest zoom
    while zoom > 0 and ((east - west) * 2**zoom + 1) * ((south - north) * 2**zoom + 1) > MAX_TILES:
        zoom -= 1
    number = 2**zoom
    for y in range(max(int(north * number), 0), min(int(south * number), number - 1) + 1):
        for x in range(int(np.floor(west * number)), int(np.floor(east * number)) + 1):
            address = template.replace("{z}", str(zoom)).replace("{x}", str(x % number)).replace("{y}", str(y))
            yield Tile(address, np.sort(frame.position(np.array([[x, y + 1], [x + 1, y]]) / number), axis=0))


@dataclass
class TileServer:
    """Where the maps of a page get their tiles.

    template: of addresses, "" for none; embeds: True if the tiles become part of the page, False if the browser that
    shows it asks for them; failure: a line once there was no tile for a map, after which no other is asked for.
    """

    template: str = ""
    embeds: bool = True
    failure: str = ""

    def of(self, frame: MercatorFrame, corners: Array, pixels: float) -> Iterator[Tile]:
        """Yield the tiles of an area ``(2, 2)`` [m] that is drawn `pixels` wide.

        Stops after MAX_FAILURES failures, or TILES_TIME.
        """
        found = tiles(self.template, frame, corners, pixels) if self.template and not self.failure else ()
        failures, made, end = 0, 0, time.monotonic() + TILES_TIME
        for tile in found:
            try:
                yield replace(tile, address=_fetched(tile.address)) if self.embeds else tile
                made += 1
            except (OSError, ValueError) as error:  # of the network, or not a picture
                failures += 1
                if not made:
                    self.failure = one_line(f"no tiles: {tile.address}: {error}")
            if failures >= MAX_FAILURES or time.monotonic() > end:
                break
        self.failure = "" if made else self.failure


def _fetched(address: str) -> str:
    """The picture at an address, a PNG, as an address with its content. Raises OSError or ValueError without one."""
    most = 2_000_000  # bytes of a tile
    answer = ask(address, TIMEOUT, TIMEOUT, most, "same host", headers={"User-Agent": f"pdr_graph/{__version__}"})
    if answer.status != 200:
        raise OSError(f"status {answer.status}")
    if len(answer.body) < PNG_HEAD.size:
        raise ValueError("no picture")
    signature, width, height = PNG_HEAD.unpack_from(answer.body)
    if signature != PNG_SIGNATURE or max(width, height) > 1024:  # most side [pixels] of a tile
        raise ValueError(f"no PNG, or one of {width} × {height} pixels")
    return f"data:image/png;base64,{base64.b64encode(answer.body).decode()}"


# Chosen by hand
NEIGHBOURS = 50_000.0  # [m] between points that share a map
GROUP_CELL = 5_000.0  # [m] to which points are rounded before they are grouped
MOST_MAPS = 3  # outdoors
MARGIN_SHARE = 0.12  # of the size of the content, on each side of a map
PLAN_MARGIN = 0.02  # that of a whole floor plan
MOST_ARROWS, LEAST_ARROW = 15, 0.2  # flows that are drawn; the least, of the largest
MIN_SIZE_INDOORS, MIN_SIZE_OUTDOORS = 40.0, 150.0  # [m] of a map
PLACE_SIZE = 2_000.0  # [m] of the map of an overview of one place
TAILS = 0.02  # share of track points on each side that may lie outside the map of more than a day
ENLARGED_SHARE = 0.3  # of the whole map's width, below which a place is drawn again on a larger map
PANEL_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
MAX_NAME_LENGTH = 26  # letters of a label


@dataclass(frozen=True)
class DrawnPart(OneLineRepr):
    """A part of an outing on a map, of one kind and on one floor; a gap has the rows before and after it.

    Times of the track are Unix times [s]. is_guess: True for a straight line between two places, since all that is
    known is what another program guessed.
    """

    kind: str
    floor: str
    track: Trajectory
    is_guess: bool = False

    def _summary(self) -> list[str]:
        return [self.kind, *filter(None, [self.floor]), repr(self.track)]


@dataclass(frozen=True)
class Dot:
    """A place, a stay or a slow pass on a map. position: ``(2,)`` [m]; kind: STAY or PASSING; time: there [s]; label:
    beside it; text: the whole, lines; starts: Unix times of its visits [s]; is_guess: as of `TimelineEntry`.
    """

    position: Array
    kind: str
    time: float
    label: str
    text: str
    starts: tuple[float, ...] = ()
    is_guess: bool = False


@dataclass(frozen=True)
class Arrow:
    """How often persons went from one place to another. start, end: ``(2,)`` [m]; number: expected; text: the whole."""

    start: Array
    end: Array
    number: float
    text: str


@dataclass(frozen=True)
class Panel(OneLineRepr):
    """One map.

    frame: of all positions; plan: path, "" without one; floor: label, "" for any; corners: ``(2, 2)`` of the shown area
    [m]; ways: of one day, the tracks without gaps of each outing; starts: positions and local times of their starts;
    drawn: all tracks by kind and floor, and of one day the gaps; dots; letter: name of the map, "" if it is the only
    one; arrows: between dots. Tracks and dots may lie outside the shown area.
    """

    frame: Frame | MercatorFrame
    plan: str
    floor: str
    corners: Array
    ways: tuple[tuple[Trajectory, ...], ...]
    starts: tuple[tuple[Array, str], ...]
    drawn: tuple[DrawnPart, ...]
    dots: tuple[Dot, ...]
    letter: str = ""
    arrows: tuple[Arrow, ...] = ()

    def _summary(self) -> list[str]:
        names = [name for name in (self.letter, self.floor) if name]
        return [*names, f"{self.width:.0f} m", count(len(self.ways), "outing"), count(len(self.dots), "dot")]

    @property
    def width(self) -> float:
        """The longer side of the shown area [m]."""
        return float(np.max(self.corners[1] - self.corners[0]))


@dataclass(frozen=True)
class _Way:
    """A part of an outing without a gap, in the outing's frame with Unix times [s].

    drawn: by kind and floor; start: the local time at which the outing starts with it, else "".
    """

    outing: Outing
    track: Trajectory
    drawn: tuple[DrawnPart, ...]
    start: str


def _converted(convert: Callable[[Frame, Array], Array], tracks: Sequence[tuple[Frame, Trajectory]]) -> list[Array]:
    """The positions of tracks, each in its frame, converted; one call for each frame, since calls are slow."""
    numbers, found = defaultdict[Frame, list[int]](list), dict[int, Array]()
    for n, (frame, _) in enumerate(tracks):
        numbers[frame].append(n)
    for frame, own in numbers.items():
        rows = [tracks[n][1].position for n in own]
        ends = np.cumsum([len(part) for part in rows])[:-1]
        found |= dict(zip(own, np.split(convert(frame, np.concatenate(rows)), ends), strict=True))
    return [found[n] for n in range(len(tracks))]


def panels(shown: Overview) -> tuple[Panel, ...]:
    """The maps of an overview, that with the most time first."""
    dots, days = _places(shown), shown.days
    ways = [way for day in days for outing in day.outings for way in _ways_of(outing, day)]
    outdoors = [way for way in ways if way.outing.frame.georeferenced]
    if shown.place:
        found = [_outdoors(dots[:1], outdoors, False, PLACE_SIZE)] if dots else []
    elif shown.period.kind == DAY:
        groups = [
            (own, tracks)
            for own, tracks in _groups(dots, outdoors)
            if not tracks or any(not way.outing.plan for way in tracks)  # some leave the floor plans
        ]
        guessed = [leg for day in days for leg in _guessed_legs(day)]
        whole = [_outdoors(*own, True, guessed=guessed) for own in groups[:MOST_MAPS]]
        found = [*whole, *(place for panel in whole for place in _enlarged_places(panel))]
        found += _indoors(ways, shown.flows if shown.is_fleet else None)
    else:
        apart = [way for way in outdoors if not (shown.is_fleet and way.outing.plan)]
        near = [dot for dot in dots if apart] if shown.is_fleet else dots
        found = [_outdoors(*own, False) for own in _groups(near, apart)[:MOST_MAPS]]
        found += _indoors([way for way in ways if way.outing.plan], shown.flows) if shown.is_fleet else []
    letters = PANEL_LETTERS[: len(found)] if len(found) > 1 else ("",)
    return tuple(replace(panel, letter=letter) for panel, letter in zip(found, letters, strict=False))


def _ways_of(outing: Outing, day: DiaryDay) -> Iterator[_Way]:
    """The parts of an outing without gaps that lie in a day, drawn by kind and floor."""
    for n, (track, segments) in enumerate(split_at_gaps(outing)):
        line = clipped(replace(track, time=track.time + outing.epoch), day.start, day.end)
        drawn = list[DrawnPart]()
        for segment in segments if len(line) else ():
            part = clipped(line, segment.start + outing.epoch, segment.end + outing.epoch)
            changes = [n for n, (one, other) in enumerate(pairwise(part.floor), 1) if one != other]
            for first, last in pairwise([0, *changes, len(part)]):
                if last > first:  # the parts on two floors share the row of the change
                    own = part[max(first - 1, 0) : last]
                    drawn.append(DrawnPart(segment.kind, own.floor[-1], own))
        if len(line):
            starts_here = n == 0 and outing.epoch >= day.start
            start = clock_text(float(line.time[0]), day.offset) if starts_here else ""
            yield _Way(outing, line, tuple(drawn), start)


def _places(shown: Overview) -> list[Dot]:
    """The places, and stays that belong to no place, most time first; their positions are longitude and latitude."""
    several = len(shown.persons) > 1
    named = [
        (who, place, f"{short_name(place.label)}, {time_text(place.duration)}", place.visits)
        for who, place in shown.places
    ]
    named += [
        (who, visit, _faced(visit.facing, visit.duration), (visit,)) for who, visit in shown.visits if not visit.label
    ]
    dots = [
        Dot(
            np.array([own.longitude, own.latitude]),
            STAY,
            own.duration,
            label := f"{short_name(who)}: {text}" if several else text,
            f"{label}, ± {own.sigma:.0f} m",
            tuple(visit.start for visit in visits),
            all(visit.is_guess for visit in visits),
        )
        for who, own, text, visits in named
        if np.isfinite(own.latitude)
    ]
    return sorted(dots, key=lambda dot: -dot.time)


def _groups(dots: Sequence[Dot], ways: Sequence[_Way]) -> list[tuple[list[Dot], list[_Way]]]:
    """Dots and ways by the map that shows them, that with the most time first."""
    rows = _converted(Frame.to_lonlat, [(way.outing.frame, way.track) for way in ways])
    points = np.array([*(dot.position for dot in dots), *(own[0] for own in rows)]).reshape(-1, 2)
    if not len(points):
        return []
    every = np.concatenate([points, *rows])
    cells, cell_of = np.unique(np.round(on_sphere(every) / GROUP_CELL), axis=0, return_inverse=True)
    pairs = KDTree(cells).query_pairs(NEIGHBOURS / GROUP_CELL, output_type="ndarray")
    ones = np.ones(len(pairs))
    _, group_of = connected_components(coo_array((ones, pairs.T), shape=(len(cells), len(cells))), directed=False)
    group = group_of[cell_of.ravel()[: len(points)]]
    time = np.bincount(group, [*(dot.time for dot in dots), *(1.0 for _ in ways)])
    return [
        (
            [dot for dot, own in zip(dots, group, strict=False) if own == n],
            [way for way, own in zip(ways, group[len(dots) :], strict=True) if own == n],
        )
        for n in np.argsort(-time, kind="stable")
        if (group == n).any()
    ]


def _guessed_legs(day: DiaryDay) -> Iterator[DrawnPart]:
    """The walks and rides of a day that another program guessed, between two places; in longitude and latitude."""
    for before, leg, after in zip(day.entries, day.entries[1:], day.entries[2:], strict=False):
        ends = np.array([[own.longitude, own.latitude] for own in (before, after)])
        if leg.is_guess and leg.kind in MOVING and np.isfinite(ends).all():
            track = Trajectory(np.array([leg.start, leg.end]), ends, np.zeros(2), ("", ""))
            yield DrawnPart(leg.kind, "", track, is_guess=True)


def _outdoors(
    dots: Sequence[Dot],
    ways: Sequence[_Way],
    is_day: bool,
    side: float = 0.0,
    guessed: Sequence[DrawnPart] = (),
) -> Panel:
    """A map in Web Mercator about the start of a day, or the place with most time.

    side: of the map about that place [m], 0 for one of everything; guessed: legs, in longitude and latitude.
    """
    first = ways[0].outing.frame.to_lonlat(ways[0].track.position[:1])[0] if ways and (is_day or not dots) else None
    lon, lat = (dots[0].position if first is None else first).tolist()
    frame = MercatorFrame(lat, lon)
    placed = [replace(dot, position=frame.from_lonlat(dot.position[None])[0]) for dot in dots]
    if not is_day:
        moving = [replace(way, drawn=tuple(part for part in way.drawn if part.kind != STANDING)) for way in ways]
        panel = _panel(frame, moving, placed, tails=TAILS)
        drawn = tuple(part for part in panel.drawn if part.kind not in KINDS_WITHOUT_DATA)
        panel = replace(panel, ways=(), starts=(), drawn=drawn)
    else:
        panel = _panel(frame, ways, placed)
        tracks = (replace(leg.track, position=frame.from_lonlat(leg.track.position)) for leg in guessed)
        legs = [replace(leg, track=track) for leg, track in zip(guessed, tracks, strict=True)]
        # those that begin at a place of this map
        middles = np.array([dot.position for dot in placed]).reshape(-1, 2)
        far = [np.hypot(*(middles - leg.track.position[0]).T).min(initial=np.inf) for leg in legs]
        here = tuple(leg for leg, off in zip(legs, far, strict=True) if off < 2 * VISIT_RADIUS)
        panel = replace(panel, drawn=(*panel.drawn, *here))
    return replace(panel, corners=_corners_around(placed[0].position[None], side)) if side else panel


def _indoors(ways: Sequence[_Way], together: Sequence[Flow] | None) -> Iterator[Panel]:
    """A map for each outing without an absolute position or plan, and for each floor of each plan, with its stays.

    together: of many persons, the flows between places: one dot for each place that anybody faced, the largest flows as
    arrows, the whole plan, and no outings without one.
    """
    nowhere = [way for way in ways if not (way.outing.frame.georeferenced or way.outing.plan)]
    for outing in () if together is not None else _outings(nowhere):
        own = [way for way in ways if way.outing is outing]
        yield _panel(outing.frame, own, [_dot_of(outing, stay, stay.position) for stay in outing.stays])
    for plan in dict.fromkeys(way.outing.plan for way in ways if way.outing.plan):
        own = [way for way in ways if way.outing.plan == plan]
        frame, outings = own[0].outing.frame, _outings(own)
        for floor in dict.fromkeys(part.floor for way in own for part in way.drawn):
            stays = [(o, stay) for o in outings for stay in o.stays if floor in ("", stay.floor)]
            dots = [_dot_of(o, stay, frame.from_frame(o.frame, stay.position[None])[0]) for o, stay in stays]
            if together is None:
                yield _panel(frame, own, dots, plan, floor)
                continue
            place_of = _dots_together([stay for _, stay in stays], dots)
            panel = _panel(frame, own, list(place_of.values()), plan, floor)
            drawing, _ = floor_of(panel)
            corners = panel.corners if drawing is None else _corners_around(drawing.corners, 0.0, PLAN_MARGIN)
            here = [flow for flow in together if {flow.origin_floor, flow.target_floor} <= {floor, ""}]
            arrows = _arrows([flow for flow in here if {flow.origin, flow.target} <= place_of.keys()], place_of)
            yield replace(panel, ways=(), starts=(), corners=corners, arrows=tuple(arrows))


def floor_of(panel: Panel) -> tuple[FloorPlan | None, str]:
    """The floor plan of a map, None without one, and a line if its file cannot be read."""
    if not panel.plan:
        return None, ""
    from pdr_graph.apps.lifelog.reconstruct import building_of  # all of estimation, which is slow to import

    try:
        floors = building_of(panel.plan).floors
    except (InputError, OSError):
        return None, "no plan: its file cannot be read"
    return next((floor for floor in floors if floor.label == panel.floor), floors[0]), ""


def _arrows(flows: Sequence[Flow], place_of: Mapping[str, Dot]) -> Iterator[Arrow]:
    """The largest flows as arrows, largest first."""
    for flow in flows[:MOST_ARROWS]:
        if flow.number >= LEAST_ARROW * flows[0].number:
            text = f"{one_line(flow.origin)} → {one_line(flow.target)}: {flow.number:.1f} ± {flow.sigma:.1f}"
            yield Arrow(place_of[flow.origin].position, place_of[flow.target].position, flow.number, text)


def _dots_together(stays: Sequence[Stay], dots: Sequence[Dot]) -> dict[str, Dot]:
    """A dot by name for each place that was faced: its expected time, at the mean of the stays that name it first."""
    lasts, moments = defaultdict[str, float](float), defaultdict[str, Array](lambda: np.zeros(3))
    for stay, dot in zip(stays, dots, strict=True):
        for rank, (name, probability) in enumerate(() if stay.passing else stay.facing):
            weight = probability * (stay.end - stay.start)
            lasts[name] += weight
            moments[name] += weight * np.append(dot.position, 1.0) if rank == 0 else 0.0
    found = dict[str, Dot]()
    for name, lasted in sorted(lasts.items(), key=lambda item: -item[1]):
        *moment, weight = moments[name].tolist()
        if weight > 0:
            text = f"{short_name(name)}, {time_text(lasted)}"
            found[name] = Dot(np.array(moment) / weight, STAY, lasted, text, text)
    return found


def _outings(ways: Iterable[_Way]) -> list[Outing]:
    """The outings of ways, each once."""
    return list({id(way.outing): way.outing for way in ways}.values())


def _dot_of(outing: Outing, stay: Stay, position: Array) -> Dot:
    """The dot of a stay on a floor plan: with the most probable place that it faces, and as text with all of them."""
    lasted = stay.end - stay.start
    named = [f"{name} {probability:.0%}" for name, probability in stay.facing]
    text = "\n".join([f"{duration_text(lasted)}, ± {float(horizontal_sigma(stay.covariance)):.1f} m", *named])
    kind, start = PASSING if stay.passing else STAY, outing.epoch + stay.start
    return Dot(position, kind, lasted, _faced(stay.facing, lasted), text, (start,))


def _faced(facing: Sequence[tuple[str, float]], lasted: float) -> str:
    """The duration of a stay [s] as text, after the most probable place that it faces."""
    return " ".join([*(short_name(name) for name, _ in facing[:1]), duration_text(lasted)])


def _panel(
    frame: Frame | MercatorFrame,
    ways: Sequence[_Way],
    dots: Sequence[Dot],
    plan: str = "",
    floor: str = "",
    tails: float = 0.0,
) -> Panel:
    """A map of some ways and dots. floor: label of the only floor shown, "" for all; tails: share of track points at
    each side that may lie outside.
    """

    def placed(own: Sequence[tuple[Frame, Trajectory]]) -> list[Trajectory]:
        moved = _converted(frame.from_frame, own)
        return [replace(track, position=position) for (_, track), position in zip(own, moved, strict=True)]

    ordered = sorted(ways, key=lambda way: float(way.track.time[0]))
    tracks = placed([(way.outing.frame, way.track) for way in ordered])
    parts = [(way.outing.frame, d) for way in ordered for d in way.drawn if floor in ("", d.floor)]
    moved = placed([(own, d.track) for own, d in parts])
    drawn = [replace(d, track=track) for (_, d), track in zip(parts, moved, strict=True)]
    for before, after in pairwise(tracks):  # a gap has the last row of one track and the first row of the other
        ends, labels = (before[-1], after[0]), (before.floor[-1], after.floor[0])
        shared = labels[0] if labels[0] == labels[1] else ""
        time, position, heading = (
            np.concatenate([getattr(e, n) for e in ends]) for n in ("time", "position", "heading")
        )
        drawn += [DrawnPart(GAP, shared, Trajectory(time, position, heading, labels))] if floor in ("", shared) else []
    points = [d.track.position for d in drawn if tails == 0.0 or d.kind != GAP]
    ends = [np.quantile(np.concatenate(points), [tails, 1 - tails], axis=0)] if points else []
    content = np.concatenate([np.array([dot.position for dot in dots]).reshape(-1, 2), *ends])
    content = content[np.isfinite(content).all(axis=1)]
    corners = _corners_around(content, MIN_SIZE_INDOORS if plan else MIN_SIZE_OUTDOORS)
    by_outing: dict[int, tuple[Trajectory, ...]] = {}
    starts = list[tuple[Array, str]]()
    for way, track in zip(ordered, tracks, strict=True):
        by_outing[id(way.outing)] = (*by_outing.get(id(way.outing), ()), track)
        starts += [(track.position[0], way.start)] if way.start and floor in ("", track.floor[0]) else []
    return Panel(frame, plan, floor, corners, tuple(by_outing.values()), tuple(starts), tuple(drawn), tuple(dots))


def _enlarged_places(whole: Panel) -> list[Panel]:
    """Enlarged maps of the small places on a map of a day, without rides."""
    own = [d for d in whole.drawn if d.kind not in (VEHICLE, GAP)]
    if not own:
        return []
    low, high = (np.array([end(d.track.position, axis=0) for d in own]) for end in (np.min, np.max))
    gaps = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2)  # < 0 for boxes that overlap
    _, group = connected_components(coo_array(gaps < 300.0))  # place distance [m] between places with maps of their own
    found = [[d for d, g in zip(own, group, strict=True) if g == n] for n in range(int(group.max()) + 1)]
    found = [g for g in found if not any(d.floor for d in g)]  # places on a plan are drawn on the plan
    close = [_enlarged(whole, np.concatenate([d.track.position for d in g])) for g in found]
    times = [sum(float(np.ptp(d.track.time)) for d in g) for g in found]
    order = sorted(range(len(found)), key=lambda n: -times[n])
    # least place time [s] in a place that is drawn again
    small = [n for n in order if close[n].width < ENLARGED_SHARE * whole.width and times[n] > 300.0]
    # most places that are drawn again: those with the longest time in them
    return [close[n] for n in sorted(small[:4])]


def _enlarged(whole: Panel, position: Array) -> Panel:
    """The part of a map about positions ``(n, 2)`` [m], in Web Mercator about their middle."""
    lon, lat = whole.frame.to_lonlat(position.mean(axis=0)[None])[0].tolist()
    frame, old = MercatorFrame(lat, lon), whole.frame

    def moved(track: Trajectory) -> Trajectory:
        return replace(track, position=frame.from_frame(old, track.position))

    return Panel(
        frame,
        "",
        "",
        _corners_around(frame.from_frame(old, position), MIN_SIZE_OUTDOORS),
        tuple(tuple(map(moved, own)) for own in whole.ways),
        tuple((frame.from_frame(old, at[None])[0], text) for at, text in whole.starts),
        tuple(replace(d, track=moved(d.track)) for d in whole.drawn),
        tuple(replace(dot, position=frame.from_frame(old, dot.position[None])[0]) for dot in whole.dots),
    )


def _corners_around(position: Array, least: float, margin: float = MARGIN_SHARE) -> Array:
    """Corners ``(2, 2)`` of the shown area about positions ``(n, 2)``, with sides of at least `least` [m].

    margin: on each side, a share of the size.
    """
    low, high = position.min(axis=0), position.max(axis=0)
    half = np.maximum((high - low) * (0.5 + margin), least / 2)
    return np.stack([(low + high) / 2 - half, (low + high) / 2 + half])


def short_name(name: str) -> str:
    """A name on one line, shortened to MAX_NAME_LENGTH letters."""
    plain = one_line(name)
    return plain if len(plain) <= MAX_NAME_LENGTH else f"{plain[: MAX_NAME_LENGTH - 1]}…"
