"""Places that a user wants to keep private, and the area that is hidden about each so that it cannot be located.

Tracks that end at a circle reveal its centre: three ends are enough. The hidden area is therefore the place moved to
the middle of the square of a grid in which its centroid lies, and enlarged by half the diagonal of the square. Anyone
who locates the hidden area exactly knows only the square: its middle is 0.38 of a side away on average. The grid is
shifted by the secret of the lifelog, and its squares are nested (`nested_squares`): a place that is hidden with several
radii, or as a circle and as an area, is in squares that lie within one another, so all exports together reveal no more
than the smallest square.

Habits show in many days, whatever is hidden: the mean of the points where somebody appears who leaves home in all
directions alike is home, ± 2 r / √n after n walks. A place should be described in the same words every time: of two
descriptions whose centroids lie in different squares both squares are known, and the place is near the line between.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import CLOSED, SOLID
from pdr_graph.floor.formats.geojson import check_degrees, features_of, read_json
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame, enu
from pdr_graph.lifelog.nested_squares import nested_squares
from pdr_graph.types import Array, Mask, OneLineRepr

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


def private_places(texts: Sequence[str], plans: Sequence[str], secret: bytes) -> tuple[PrivatePlace, ...]:
    """The places that texts describe: ``latitude,longitude,radius``, names, or paths of GeoJSON files.

    plans: paths of the plans on which names are looked up; secret: of the lifelog. Raises InputError for any text that
    describes no place, so that nobody believes it hidden.
    """
    return tuple(place for text in texts for place in _places(text, plans, secret))


def _places(text: str, plans: Sequence[str], secret: bytes) -> Iterator[PrivatePlace]:
    if match := CIRCLE.fullmatch(text):
        lat, lon, radius = (_number(text, number) for number in match.groups())
        yield _place_of_circle(text, lat, lon, radius, secret)
    elif Path(text).suffix.lower() in (".json", ".geojson"):
        yield from _places_of_file(Path(text), secret)
    else:
        yield from _places_by_name(text, plans, secret)


def _number(text: str, number: str) -> float:
    try:
        return float(number)
    except ValueError:
        raise InputError("a private place", text, f"{number!r}", EXPECTED) from None


def _place_of_circle(text: str, lat: float, lon: float, radius: float, secret: bytes) -> PrivatePlace:
    if abs(lat) > 90 or abs(lon) > 180:
        raise InputError("a private place", text, f"latitude {lat}, longitude {lon}", "degrees, the latitude first")
    if not MIN_RADIUS <= radius <= MAX_RADIUS:
        raise InputError("a private place", text, f"a radius of {radius} m", f"{MIN_RADIUS:.0f} to {MAX_RADIUS:.0f} m")
    return _private_place(text, enu(lat, lon), shapely.Point(0, 0).buffer(radius, quad_segs=32), secret)


def _places_of_file(path: Path, secret: bytes) -> Iterator[PrivatePlace]:
    """The polygons of a GeoJSON file, and its points with a radius."""
    notes, mended = list[str](), list[str]()
    features = list(features_of(path, read_json(path), notes, mended))
    check_degrees(path, features)
    if notes or not features:  # the user believes all of it hidden
        raise InputError(path, "", notes[0] if notes else "no feature", "polygons, or points with a radius")
    for number, shape, properties in features:
        yield _place_of_feature(path, number, shape, properties, secret)


def _place_of_feature(
    path: Path, number: int, shape: shapely.Geometry, properties: dict[str, Any], secret: bytes
) -> PrivatePlace:
    name = str(properties.get("name") or f"{path.name}, feature {number}")
    lon, lat = shapely.get_coordinates(shapely.centroid(shape))[0].tolist()
    if shapely.get_dimensions(shape) == 2:
        frame = enu(lat, lon)
        return _private_place(name, frame, shapely.transform(shape, frame.from_lonlat), secret)
    radius = properties.get("radius")
    if not isinstance(shape, shapely.Point) or not isinstance(radius, int | float):
        raise InputError(
            path, f"feature {number}", f"a {type(shape).__name__}", "a polygon, or a point with a radius [m]"
        )
    return _place_of_circle(name, lat, lon, float(radius), secret)


def _places_by_name(text: str, plans: Sequence[str], secret: bytes) -> Iterator[PrivatePlace]:
    """All shops and rooms of a name on some plans."""
    found = dict.fromkeys(
        (floor.frame, area.shape)
        for plan in plans
        for floor in Building.load(plan).floors
        for area in floor.of_kind(*NAMED_KINDS)
        if area.name and normalized_name(area.name) == normalized_name(text)
    )
    if not found:
        raise InputError("a private place", text, f"no such name on {len(plans)} plans", EXPECTED)
    for frame, shape in found:
        lon, lat = frame.to_lonlat(shapely.get_coordinates(shapely.centroid(shape)))[0].tolist()
        own = enu(lat, lon)
        moved = shapely.transform(shape, partial(own.from_frame, frame))
        if shapely.get_dimensions(moved) < 2:  # a stand drawn as a point, a wall as a line
            moved = shapely.buffer(moved, MIN_RADIUS)
        yield _private_place(text, own, moved, secret)


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
