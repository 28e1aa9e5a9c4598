"""Remove private places from days, and everything else in them that would reveal these places.

**The hidden area.** Tracks that end at a circle reveal its centre: three ends are enough. The hidden area is therefore
the place moved to the middle of the square of a grid in which its centroid lies, and enlarged by half the diagonal of
the square. Anyone who locates the hidden area exactly knows only the square: its middle is 0.38 of a side away on
average. The grid is shifted by the secret of the lifelog, and its squares are nested: a place that is hidden with
several radii, or as a circle and as an area, is in squares that lie within one another, so all exports together reveal
no more than the smallest square.

Habits show in many days, whatever is hidden: the mean of the points where somebody appears who leaves home in all
directions alike is home, ± 2 r / √n after n walks. A place should be described in the same words every time: of two
descriptions whose centroids lie in different squares both squares are known, and the place is near the line between.

**What else would reveal a place**, and the remedy:

* where tracks end: the hidden area is larger than the place and not centred on it;
* their direction at the end: a track is shortened until it does not point at the hidden area, up to two radii of the
  place away from it. Somebody who walks straight towards the place from farther away reveals that;
* times: the time between two shown rows bounds how far somebody was in between, and the time from the start of a
  recording to its first shown row how far from home it began. Hidden starts and ends leave no trace, and a track beside
  a hidden one is shifted in time to begin on a quarter of an hour; durations and speeds stay. It begins and ends with
  recorded rows, since a gap beside it would reveal how long the hidden part was;
* distance and number of steps: both count the shown parts only;
* names: those of hidden stays and those that the user gives are removed from all stays;
* the frame: its origin is often the very first position. A local frame gets another origin;
* sources, plans, hashes and notes: left out.

Rows to cut are left out. Rows to blur become one row per quarter of an hour, in the middle of a square of a grid that
is the same everywhere and always (a grid about the place would reveal its middle) and nested, with the covariance of a
square; their stays have no name, and begin and end on a quarter of an hour.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely

from pdr_graph.apps.lifelog.day import (
    PRIVATE,
    WALKING,
    Day,
    ExportedPart,
    Outing,
    Segment,
    Stay,
    path_shares,
    shift,
    without_gap_rows,
)
from pdr_graph.apps.lifelog.places import NamedArea
from pdr_graph.errors import InputError
from pdr_graph.floor.cells import CLOSED, SOLID
from pdr_graph.floor.formats.geojson import check_degrees, features_of, read_json
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame, enu
from pdr_graph.geometry import ANY_HEADING, wrap_angle
from pdr_graph.types import INSTANT, Array, Index, Mask, OneLineRepr, Trajectory

EQUATOR = 40_075_017.0  # [m] around the earth
FARTHEST_LATITUDE = 89.9  # [deg] latitude of the outermost squares: Mercator's projection has no poles


def nested_squares(
    lonlat: Array, least_side: Array, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array, Array]:
    """The squares in which positions lie: middles ``(n, 2)`` [deg], sides ``(n,)`` [m], corners ``(n, 4, 2)`` [deg].

    lonlat: ``(n, 2)`` [deg]; least_side: ``(n,)`` [m], the sides are up to twice as long; shift: of all squares, as a
    share of the earth's circumference. The squares are those of Mercator's projection.
    """
    lat = np.clip(lonlat[:, 1], -FARTHEST_LATITUDE, FARTHEST_LATITUDE)
    level = np.floor(np.log2(EQUATOR * np.cos(np.radians(lat)) / least_side))
    size = 2.0 ** -np.maximum(level, 0.0)[:, None]  # share of the circumference
    low = np.floor((_mercator(lonlat[:, 0], lat) + shift) / size) * size - shift
    middle = _degrees(low + size / 2)
    corners = np.stack([_degrees(low + size * np.array(corner)) for corner in ((0, 0), (0, 1), (1, 0), (1, 1))], axis=1)
    return middle, size[:, 0] * EQUATOR * np.cos(np.radians(middle[:, 1])), corners


def _mercator(lon: Array, lat: Array) -> Array:
    """Mercator's x and y ``(n, 2)`` of longitudes and latitudes [deg], as shares of the circumference."""
    return np.stack([lon / 360, np.arcsinh(np.tan(np.radians(lat))) / (2 * np.pi)], axis=1)


def _degrees(place: Array) -> Array:
    """Longitudes, from -180, and latitudes ``(n, 2)`` [deg] of Mercator's x and y."""
    lat = np.degrees(np.arctan(np.sinh(2 * np.pi * place[:, 1])))
    return np.stack([360 * ((place[:, 0] + 0.5) % 1.0 - 0.5), lat], axis=1)


CIRCLE = re.compile(r"\s*(-?[\d.]+)\s*,\s*(-?[\d.]+)\s*,\s*([\d.]+)\s*m?\s*", re.ASCII)
NAMED_KINDS = (*CLOSED, *SOLID)  # kinds of areas of a plan that have names
MIN_RADIUS, MAX_RADIUS = 1.0, 100_000.0  # [m] radius of a place
MAX_LATITUDE = 89.0  # [deg] of a place: the squares are Mercator's
# Least side of the square that hides a place within it, in radii of the place: its middle is then at least 2/3 of a
# radius from the place on average
SQUARE_RADII = 1.75
EXPECTED = "latitude,longitude,radius, the name of a shop or room on a plan of the lifelog, or a GeoJSON file of areas"


@dataclass(frozen=True, eq=False)
class PrivatePlace(OneLineRepr):
    """A place, and the area that is hidden about it.

    name: in the user's words; frame: east-north about the hidden area; shape: the place itself [m]; hidden: the area
    that is left out of exports [m]; radius: of a circle with the area of the place [m].
    """

    name: str
    frame: Frame
    shape: shapely.Geometry
    hidden: shapely.Geometry
    radius: float

    def _summary(self) -> list[str]:
        return [repr(self.name), f"radius {self.radius:.0f} m"]

    def hides(self, lonlat: Array) -> Mask:
        """Mask ``(n,)`` of the positions ``(n, 2)``, longitude and latitude [deg], in the hidden area."""
        x, y = self._local(lonlat).T
        shapely.prepare(self.hidden)
        return np.asarray(shapely.contains_xy(self.hidden, x, y))

    def crossed(self, lonlat: Array) -> Mask:
        """Mask ``(n - 1,)`` of the lines between consecutive positions ``(n, 2)`` [deg] that cross the hidden area."""
        return self._meets(np.stack([(p := self._local(lonlat))[:-1], p[1:]], axis=1))

    def ahead(self, lonlat: Array, behind: Array) -> Mask:
        """Mask ``(n,)``: the line from `behind` ``(n, 2)`` through `lonlat` ``(n, 2)`` [deg] meets the hidden area."""
        here, behind = self._local(lonlat), self._local(behind)
        way = here - behind
        length = np.maximum(np.hypot(*way.T), 1e-9)
        reach = self.distance(lonlat) + self._extent
        return self._meets(np.stack([here, here + way * (reach / length)[:, None]], axis=1))

    def distance(self, lonlat: Array) -> Array:
        """Distance ``(n,)`` [m] of positions ``(n, 2)`` [deg] from the hidden area."""
        return np.asarray(shapely.distance(self.hidden, shapely.points(self._local(lonlat))))

    @cached_property
    def _extent(self) -> float:
        return float(np.hypot(*np.diff(np.reshape(shapely.bounds(self.hidden), (2, 2)), axis=0)[0]))

    def _local(self, lonlat: Array) -> Array:
        """Positions in the frame [m]; those beyond its horizon become 100 000 km."""
        return np.nan_to_num(self.frame.from_lonlat(lonlat), nan=1e8, posinf=1e8, neginf=-1e8)

    def _meets(self, lines: Array) -> Mask:
        shapely.prepare(self.hidden)
        return np.asarray(shapely.intersects(self.hidden, shapely.linestrings(lines)), dtype=bool)


def is_hidden(places: Sequence[PrivatePlace], frame: Frame, position: Array) -> bool:
    """True if one of the places hides a position ``(2,)`` [m] of a frame."""
    lonlat = frame.to_lonlat(position[None])
    return any(place.hides(lonlat)[0] for place in places)


def normalized_name(name: str) -> str:
    """The name without differences of capitals and spaces."""
    return " ".join(name.casefold().split())


def private_places(
    texts: Sequence[str], plans: Sequence[str], secret: bytes, named: Sequence[NamedArea] = ()
) -> tuple[PrivatePlace, ...]:
    """The places that texts describe: ``latitude,longitude,radius``, names, or paths of GeoJSON files.

    plans: paths of the plans on which names are looked up; secret: of the lifelog; named: areas with names, or numbers
    of places. Raises InputError for any text that describes no place, so that nobody believes it hidden.
    """
    return tuple(place for text in texts for place in _places(text, plans, secret, named))


def _places(text: str, plans: Sequence[str], secret: bytes, named: Sequence[NamedArea]) -> Iterator[PrivatePlace]:
    """The places of one text: a circle, the areas of a GeoJSON file, or all of a name that are visited or on plans."""
    if match := CIRCLE.fullmatch(text):
        try:
            lat, lon, radius = map(float, match.groups())
        except ValueError as error:
            raise InputError("a private place", text, f"{error}", EXPECTED) from None
        yield _place_of_circle(text, lat, lon, radius, secret)
    elif Path(text).suffix.lower() in (".json", ".geojson"):
        path, notes = Path(text), list[str]()
        features = list(features_of(path, read_json(path), notes, []))
        check_degrees(path, features)
        if notes or not features:  # the user believes all of it hidden
            raise InputError(path, "", notes[0] if notes else "no feature", "polygons, or points with a radius")
        for number, shape, properties in features:
            name = str(properties.get("name") or f"{path.name}, feature {number}")
            lon, lat = shapely.get_coordinates(shapely.centroid(shape))[0].tolist()
            radius = properties.get("radius")
            if shapely.get_dimensions(shape) == 2:
                frame = enu(lat, lon)
                yield _private_place(name, frame, shapely.transform(shape, frame.from_lonlat), secret)
            elif isinstance(shape, shapely.Point) and isinstance(radius, int | float):
                yield _place_of_circle(name, lat, lon, float(radius), secret)
            else:
                found, expected = f"a {type(shape).__name__}", "a polygon, or a point with a radius [m]"
                raise InputError(path, f"feature {number}", found, expected)
    else:
        own = [area for area in named if normalized_name(area[3]) == normalized_name(text)]
        for lat, lon, radius, _ in own:
            yield _place_of_circle(text, lat, lon, min(max(radius, MIN_RADIUS), MAX_RADIUS), secret)
        found = dict.fromkeys(
            (floor.frame, area.shape)
            for plan in plans
            for floor in Building.load(plan).floors
            for area in floor.of_kind(*NAMED_KINDS)
            if area.name and normalized_name(area.name) == normalized_name(text)
        )
        if not found and not own:
            known = ", ".join(dict.fromkeys(area[3] for area in named if area[3]))
            no_name = f"no such name on {len(plans)} plans, nor a place named {known or 'by a correction'}"
            raise InputError("a private place", text, no_name, EXPECTED)
        for frame, shape in found:
            lon, lat = frame.to_lonlat(shapely.get_coordinates(shapely.centroid(shape)))[0].tolist()
            about = enu(lat, lon)
            moved = shapely.transform(shape, partial(about.from_frame, frame))
            if shapely.get_dimensions(moved) < 2:  # a stand drawn as a point, a wall as a line
                moved = shapely.buffer(moved, MIN_RADIUS)
            yield _private_place(text, about, moved, secret)


def _place_of_circle(text: str, lat: float, lon: float, radius: float, secret: bytes) -> PrivatePlace:
    """The place of a circle; latitude and longitude [deg], radius [m]."""
    if abs(lat) > 90 or abs(lon) > 180:
        raise InputError("a private place", text, f"latitude {lat}, longitude {lon}", "degrees, the latitude first")
    if not MIN_RADIUS <= radius <= MAX_RADIUS:
        raise InputError("a private place", text, f"a radius of {radius} m", f"{MIN_RADIUS:.0f} to {MAX_RADIUS:.0f} m")
    return _private_place(text, enu(lat, lon), shapely.Point(0, 0).buffer(radius, quad_segs=32), secret)


def _private_place(name: str, frame: Frame, shape: shapely.Geometry, secret: bytes) -> PrivatePlace:
    """The place of a shape [m] in a frame about it, with the area that is hidden."""
    assert frame.origin is not None, "a frame about the place"
    if abs(frame.origin[0]) > MAX_LATITUDE:
        raise InputError(
            "a private place", name, f"latitude {frame.origin[0]:.2f}", f"up to {MAX_LATITUDE:.0f} degrees"
        )
    radius = max(MIN_RADIUS, float(np.sqrt(shapely.area(shape) / np.pi)))
    drawn = np.frombuffer(hmac.digest(secret, b"squares", hashlib.sha256)[:16], dtype="<u8") / 2.0**64
    lonlat, least = np.array([frame.origin[::-1]]), np.array([SQUARE_RADII * radius])
    middle, _, corners = nested_squares(lonlat, least, (float(drawn[0]), float(drawn[1])))
    own = enu(*middle[0, ::-1].tolist())  # about the square: its coordinates do not depend on where the place is in it
    reach = float(np.hypot(*own.from_lonlat(corners[0]).T).max())
    # quad_segs: the polygon lies within the circle, by 0.03 % of its radius, which is added
    hidden = shapely.buffer(shape, 1.001 * reach, quad_segs=32)  # as if the place were in the middle of the square
    return PrivatePlace(name, own, shapely.transform(shape, partial(own.from_frame, frame)), hidden, radius)


# Chosen by hand
SHORTEST_SHOWN = 60.0  # [s] of a track between two hidden ones
LEG_LENGTH = 30.0  # [m] over which the direction of a track is measured
ROWS_PER_BLOCK = 50  # rows whose direction is tested at a time, from the end of a track backwards


@dataclass(frozen=True)
class HiddenRows(OneLineRepr):
    """The hidden rows of an outing. lonlat: ``(n, 2)`` [deg]; cut, blurred: ``(n,)``; broken: ``(n - 1,)`` True where
    the line between two rows crosses a hidden area.
    """

    lonlat: Array
    cut: Mask
    blurred: Mask
    broken: Mask

    def _summary(self) -> list[str]:
        return [f"{np.count_nonzero(self.cut)} cut, {np.count_nonzero(self.blurred)} blurred of {len(self.lonlat)}"]


@dataclass(frozen=True)
class ShownRun:
    """The shown rows from `first` to `last`; at_hidden: whether hidden rows are before, and after them."""

    first: int
    last: int
    at_hidden: tuple[bool, bool]


def hidden_rows(outing: Outing, cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace]) -> HiddenRows:
    """The rows of an outing that places hide; a row that is cut is not blurred."""
    lonlat = outing.frame.to_lonlat(outing.trajectory.position)
    nothing = np.zeros(len(lonlat), dtype=bool)
    of_cut = np.any([nothing, *(place.hides(lonlat) for place in cut)], axis=0)
    of_blur = np.any([nothing, *(place.hides(lonlat) for place in blur)], axis=0) & ~of_cut
    broken = np.any([nothing[1:], *(place.crossed(lonlat) for place in (*cut, *blur))], axis=0)
    return HiddenRows(lonlat, of_cut, of_blur, broken)


def shown_runs(track: Trajectory, hidden: HiddenRows, places: Sequence[PrivatePlace]) -> list[ShownRun]:
    """Row ranges outside private places, in time order, without ends that point at a hidden area.

    A range beside hidden rows that is shorter than SHORTEST_SHOWN is left out.
    """
    shown = np.flatnonzero(~(hidden.cut | hidden.blurred))
    apart = np.flatnonzero((np.diff(shown) > 1) | hidden.broken[shown[:-1]])
    runs = list[ShownRun]()
    for rows in np.split(shown, apart + 1) if len(shown) else []:
        at_hidden = bool(rows[0] > 0), bool(rows[-1] < len(track) - 1)
        shortest = SHORTEST_SHOWN if any(at_hidden) else 0.0
        if np.ptp(track.time[rows[[0, -1]]]) >= shortest and at_hidden[1]:
            rows = _trimmed_end(track.position, hidden.lonlat, rows, places)
        if len(rows) and np.ptp(track.time[rows[[0, -1]]]) >= shortest and at_hidden[0]:
            rows = _trimmed_end(track.position, hidden.lonlat, rows[::-1], places)[::-1]
        if len(rows) and np.ptp(track.time[rows[[0, -1]]]) >= shortest:
            runs.append(ShownRun(int(rows[0]), int(rows[-1]), at_hidden))
    return runs


def _trimmed_end(position: Array, lonlat: Array, rows: Index, places: Sequence[PrivatePlace]) -> Index:
    """The rows up to the last one that is far from each hidden area, or from which the track does not point at it."""
    for after in range(len(rows), 0, -ROWS_PER_BLOCK):
        number, behind = range(max(after - ROWS_PER_BLOCK, 0), after), list[int]()
        for n in number:  # the leg to a row begins at the last row LEG_LENGTH away from it, else at the first
            # most leg rows: rows among which a leg begins: half a kilometre of steps
            leg = rows[max(0, n - 1000) : n + 1]
            before = np.flatnonzero(np.hypot(*(position[leg] - position[leg[-1]]).T) >= LEG_LENGTH)
            behind.append(int(leg[before[-1] if len(before) else 0]))
        here = lonlat[rows[number]]
        away = [(p.distance(here) > 2 * p.radius) | ~p.ahead(here, lonlat[behind]) for p in places]
        good = np.flatnonzero(np.all(away, axis=0))
        if len(good):
            return rows[: number[good[-1]] + 1]
    return rows[:0]


QUARTER_HOUR = 900.0  # [s] to which times are rounded; chosen by hand
SQUARE_SIDE = 500.0  # [m] least side of the squares of blurred positions, and the radius of the place; chosen by hand


def blurred_part(
    outing: Outing,
    hidden: HiddenRows,
    rows: Index,
    cut: Sequence[PrivatePlace],
    blur: Sequence[PrivatePlace],
    free: tuple[float, float],
    first: bool,
) -> ExportedPart | None:
    """Blurred rows as one row per quarter of an hour; None if there are none, or if their line is in an area to cut.

    rows: numbers of the blurred rows; free: Unix times [s] from and to which nothing else is shown; first: True if no
    earlier part of the outing is shown.
    """
    if not len(rows):
        return None
    unix = outing.trajectory.time + outing.epoch
    since, until = unix[rows[[0, -1]]].tolist()
    start = max(free[0], quarter_before(since)) if first else free[0]
    end = free[1] if np.isfinite(free[1]) else max(start, quarter_after(until))
    quarter = np.floor(unix[rows] / QUARTER_HOUR) * QUARTER_HOUR
    time = np.unique(quarter + QUARTER_HOUR / 2)
    time = time[(time > start) & (time < end)]
    if not len(time):
        return None
    usual = [np.median(hidden.lonlat[rows[quarter == t - QUARTER_HOUR / 2]], axis=0) for t in time]
    centre, side = _grid_squares(np.array(usual), blur)
    if any(place.hides(centre).any() or place.crossed(centre).any() for place in cut):
        return None
    covariance = np.zeros((len(time), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = side**2 / 12
    covariance[:, 2, 2] = ANY_HEADING**2
    heading, floor = np.full(len(time), np.nan), ("",) * len(time)
    track = Trajectory(time, outing.frame.from_lonlat(centre), heading, floor, covariance)
    stays = list[Stay]()
    for stay in outing.stays:  # in the middle of a square, from quarter to quarter of an hour, without names
        begin, last = stay.start + outing.epoch, stay.end + outing.epoch
        inside = begin < until and last > since and is_hidden(blur, outing.frame, stay.position)
        begin, last = max(start, quarter_before(begin)), min(end, quarter_after(last))
        if inside and not stay.passing and last > begin:
            centre, side = _grid_squares(outing.frame.to_lonlat(stay.position[None]), blur)
            place, spread = outing.frame.from_lonlat(centre)[0], np.eye(2) * side[0] ** 2 / 12
            if not is_hidden(cut, outing.frame, place):
                stays.append(Stay(begin, last, False, place, spread, np.nan, ""))
    return ExportedPart(start, end, track, (Segment(PRIVATE, start, end, 0.0),), tuple(stays))


def _grid_squares(lonlat: Array, blur: Sequence[PrivatePlace]) -> tuple[Array, Array]:
    """The middles ``(n, 2)`` [deg] of the grid squares in which positions lie, and their sides ``(n,)`` [m]."""
    least = np.max([np.full(len(lonlat), SQUARE_SIDE), *(p.hides(lonlat) * p.radius for p in blur)], axis=0)
    middle, side, _ = nested_squares(lonlat, least)
    return middle, side


def quarter_after(time: float) -> float:
    """The next full quarter of an hour [s]."""
    return float(np.ceil(time / QUARTER_HOUR) * QUARTER_HOUR)


def quarter_before(time: float) -> float:
    """The last full quarter of an hour [s]."""
    return float(np.floor(time / QUARTER_HOUR) * QUARTER_HOUR)


def without_private_places(
    days: Sequence[Day], cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace]
) -> tuple[list[Day], list[str]]:
    """Remove places from days: leave out those to cut, coarsen those to blur; also returns notes, a line each.

    Days are unchanged without any place.
    """
    if not (cut or blur):
        return list(days), []
    made, notes, places = list[Day](), list[str](), (*cut, *blur)
    for day in days:
        outings, free, names = list[Outing](), -np.inf, {place.name for place in places}
        for outing in sorted(day.outings, key=lambda o: o.epoch):
            if not outing.frame.georeferenced:
                notes.append(f"{day.person}, {day.date}: outing left out: no absolute position")
                continue
            hidden = (s for s in outing.stays if s.facing and is_hidden(places, outing.frame, s.position))
            names |= {stay.facing[0][0] for stay in hidden}
            if parts := _exported_parts(replace(outing, trajectory=without_gap_rows(outing)), cut, blur, free):
                outings.append(with_new_origin(_outing_of_parts(outing, parts)))
                free = parts[-1].end
        private = set(map(normalized_name, names))
        for n, outing in enumerate(outings):
            stays = (
                replace(s, facing=tuple((name, p) for name, p in s.facing if normalized_name(name) not in private))
                for s in outing.stays
            )
            outings[n] = replace(outing, stays=tuple(stays))
        made.append(Day(day.person, day.date, tuple(outings)))
    return made, notes


def _exported_parts(
    outing: Outing, cut: Sequence[PrivatePlace], blur: Sequence[PrivatePlace], free: float
) -> list[ExportedPart]:
    """The shown parts of an outing in time order, none of them before the Unix time `free` [s].

    A part is shown from a quarter of an hour on if it is beside hidden rows or before `free`.
    """
    track, places, hidden = outing.trajectory, (*cut, *blur), hidden_rows(outing, cut, blur)
    parts: list[ExportedPart] = []
    for before, run in pairwise([None, *shown_runs(track, hidden, places), None]):
        begin = outing.epoch + float(track.time[run.first]) if run else np.inf
        # shortest break [s] between two shown parts
        after = free + 1.0  # a part that begins where another ends would make one line across what is hidden
        if run and (any(run.at_hidden) or begin < after):
            begin = quarter_after(max(begin, after))
        passed = np.arange(before.last + 1 if before else 0, run.first if run else len(track))
        coarse = blurred_part(outing, hidden, passed[hidden.blurred[passed]], cut, blur, (free, begin), not parts)
        parts += [coarse] if coarse else []
        if run:
            rows = track[run.first : run.last + 1]
            start, end = float(rows.time[0]), float(rows.time[-1])
            by = begin - start
            segments = tuple(
                replace(s, start=a + by, end=b + by, distance=s.distance * share)
                for s in outing.segments
                if (b := min(s.end, end)) > (a := max(s.start, start))
                for share in [float(path_shares(track, [s.start, a, b, s.end])[1])]
            )
            stays = tuple(
                shift(s, by)
                for s in outing.stays
                if s.start >= start - INSTANT
                and s.end <= end + INSTANT
                and not is_hidden(places, outing.frame, s.position)
            )
            parts.append(ExportedPart(begin, end + by, replace(rows, time=rows.time + by), segments, stays))
        free = parts[-1].end if parts else free
    return parts


def _outing_of_parts(of: Outing, parts: Sequence[ExportedPart]) -> Outing:
    """Join parts to one outing, with private segments between them and steps in proportion to the walked distance."""
    segments = list(parts[0].segments)
    for before, after in pairwise(parts):
        if after.start > before.end + INSTANT:
            segments.append(Segment(PRIVATE, before.end, after.start, 0.0))
        segments += after.segments
    epoch, tracks = parts[0].start, [part.track for part in parts]
    covariances = [track.covariance for track in tracks if track.covariance is not None]
    track = Trajectory(
        np.concatenate([track.time for track in tracks]) - epoch,
        np.concatenate([track.position for track in tracks]),
        np.concatenate([track.heading for track in tracks]),
        tuple(label for track in tracks for label in track.floor),
        np.concatenate(covariances) if len(covariances) == len(tracks) else None,
    )
    moved = tuple(shift(s, -epoch) for s in segments)
    stays = tuple(shift(s, -epoch) for part in parts for s in part.stays)
    every, left = (sum(s.distance for s in of_them if s.kind == WALKING) for of_them in (of.segments, segments))
    return Outing((), "", epoch, of.frame, "", track, moved, stays, round(of.steps * left / every) if every else 0)


def with_new_origin(outing: Outing) -> Outing:
    """The outing in a local frame with another origin.

    Headings are turned by the angle between both norths: beside the direction of the track, the headings of a day would
    reveal the old origin to tens of metres.
    """
    if outing.frame.kind != "enu":
        return outing
    position = outing.trajectory.position
    # origin digits of a degree: the new origin of a frame lies within a kilometre of the first shown row
    lon, lat = np.round(outing.frame.to_lonlat(position[:1])[0], 2).tolist()
    frame, old = enu(lat, lon), outing.frame
    turned = wrap_angle(outing.trajectory.heading + _convergence(frame, old, position))
    track = replace(outing.trajectory, position=frame.from_frame(old, position), heading=turned)
    stays = tuple(
        replace(
            s,
            position=frame.from_frame(old, s.position[None])[0],
            heading=float(wrap_angle(s.heading + _convergence(frame, old, s.position[None]))[0]),
        )
        for s in outing.stays
    )
    return replace(outing, frame=frame, trajectory=track, stays=stays)


def _convergence(frame: Frame, old: Frame, position: Array) -> Array:
    """The angles ``(n,)`` by which headings at positions ``(n, 2)`` [m] of the old frame are turned to a new one."""
    ahead = frame.from_frame(old, position + np.array([100.0, 0.0])) - frame.from_frame(old, position)
    return np.arctan2(ahead[:, 1], ahead[:, 0])
