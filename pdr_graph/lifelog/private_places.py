"""Places that a user wants to keep private, and what is hidden about each so that the place itself cannot be told.

Tracks that end where a circle begins give its centre away: three ends are enough. So what is hidden is the place
enlarged by its own radius and moved by a fixed distance in a fixed direction, both of which only the lifelog's own
secret tells, and which always leaves the place inside. Whoever finds the hidden area exactly knows only that the place
is within its radius r of the middle: the best guess is within ρ of it with a probability of (ρ/r)², and 2/3 r away on
average.

No more can be had from two days. From many the habits show, whatever is hidden: the mean of where somebody comes out
who leaves home in all directions alike is home, give or take 2 r / √n after n walks. And the same place should be
named in the same words every time: each way of naming it is moved in its own way.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import CLOSED, SOLID
from pdr_graph.floor.formats import check_degrees, features_of, read_json
from pdr_graph.frames import Frame, enu
from pdr_graph.types import Array, Mask

CIRCLE = re.compile(r"\s*(-?[\d.]+)\s*,\s*(-?[\d.]+)\s*,\s*([\d.]+)\s*m?\s*", re.ASCII)
NAMED = (*CLOSED, *SOLID)  # kinds of a plan's areas that people call by name
SMALLEST, LARGEST = 1.0, 100_000.0  # [m] radius of a place
NEEDED = "latitude,longitude,radius, the name of a shop or room on a plan of the lifelog, or a GeoJSON file of areas"


@dataclass(frozen=True, eq=False)
class PrivatePlace:
    """A place, and what is hidden about it.

    name: as the user said it; frame: east-north about the place; shape: the place itself [m]; hidden: what is left out
    of exports [m]; radius: by which it was enlarged, that of a circle of the place's area [m].
    """

    name: str
    frame: Frame
    shape: shapely.Geometry
    hidden: shapely.Geometry
    radius: float

    def hides(self, lonlat: Array) -> Mask:
        """Which longitudes and latitudes ``(n, 2)`` [deg] are hidden."""
        x, y = self._near(lonlat).T
        shapely.prepare(self.hidden)
        return np.asarray(shapely.contains_xy(self.hidden, x, y))

    def crossed(self, lonlat: Array) -> Mask:
        """Which straight lines from each of ``(n, 2)`` [deg] to the next lead through what is hidden. ``(n - 1,)``"""
        return self._hit(np.stack([(p := self._near(lonlat))[:-1], p[1:]], axis=1))

    def ahead(self, lonlat: Array, towards: Array) -> Mask:
        """Whether straight on from each of ``(n, 2)``, where ``towards (n, 2)`` lies behind it, is what is hidden."""
        here, behind = self._near(lonlat), self._near(towards)
        way = here - behind
        length = np.maximum(np.hypot(*way.T), 1e-9)
        reach = self.away(lonlat) + self._across
        return self._hit(np.stack([here, here + way * (reach / length)[:, None]], axis=1))

    def away(self, lonlat: Array) -> Array:
        """Distance ``(n,)`` [m] of positions ``(n, 2)`` [deg] from what is hidden."""
        return np.asarray(shapely.distance(self.hidden, shapely.points(self._near(lonlat))))

    @cached_property
    def _across(self) -> float:
        return float(np.hypot(*np.diff(np.reshape(shapely.bounds(self.hidden), (2, 2)), axis=0)[0]))

    def _near(self, lonlat: Array) -> Array:
        """Positions [m]; what is beyond the horizon of the frame is as far away."""
        return np.nan_to_num(self.frame.from_lonlat(lonlat), nan=1e8, posinf=1e8, neginf=-1e8)

    def _hit(self, lines: Array) -> Mask:
        shapely.prepare(self.hidden)
        return np.asarray(shapely.intersects(self.hidden, shapely.linestrings(lines)), dtype=bool)


def hides(places: Sequence[PrivatePlace], frame: Frame, position: Array) -> bool:
    """Whether one of some places hides a position ``(2,)`` [m] of a frame."""
    lonlat = frame.to_lonlat(position[None])
    return any(place.hides(lonlat)[0] for place in places)


def same_name(name: str) -> str:
    """What two spellings of a name have in common."""
    return " ".join(name.casefold().split())


def private_places(said: Sequence[str], plans: Sequence[str], secret: bytes) -> tuple[PrivatePlace, ...]:
    """The places of some texts: ``latitude,longitude,radius``, names, or paths of GeoJSON files.

    plans: paths of those on which a name may be; secret: the lifelog's own. Raises InputError of what is none of
    these: nothing may be thought hidden that is not.
    """
    return tuple(place for text in said for place in _places(text, plans, secret))


def _places(text: str, plans: Sequence[str], secret: bytes) -> Iterator[PrivatePlace]:
    if match := CIRCLE.fullmatch(text):
        lat, lon, radius = (_finite(text, number) for number in match.groups())
        yield _circle(text, lat, lon, radius, secret)
    elif Path(text).suffix.lower() in (".json", ".geojson"):
        yield from _areas(Path(text), secret)
    else:
        yield from _named(text, plans, secret)


def _finite(text: str, number: str) -> float:
    try:
        return float(number)
    except ValueError:
        raise InputError("a private place", text, f"{number!r}", NEEDED) from None


def _circle(text: str, lat: float, lon: float, radius: float, secret: bytes) -> PrivatePlace:
    if abs(lat) > 90 or abs(lon) > 180:
        raise InputError("a private place", text, f"latitude {lat}, longitude {lon}", "degrees, the latitude first")
    if not SMALLEST <= radius <= LARGEST:
        raise InputError("a private place", text, f"a radius of {radius} m", f"{SMALLEST:.0f} to {LARGEST:.0f} m")
    return _hidden(text, enu(lat, lon), shapely.Point(0, 0).buffer(radius, quad_segs=32), secret)


def _areas(path: Path, secret: bytes) -> Iterator[PrivatePlace]:
    """The polygons of a file, and its points with a radius."""
    notes, mended = list[str](), list[str]()
    features = list(features_of(path, read_json(path), notes, mended))
    check_degrees(path, features)
    if notes or not features:  # something in it could not be used, which the user thinks is hidden
        raise InputError(path, "", notes[0] if notes else "no feature", "polygons, or points with a radius")
    for number, shape, properties in features:
        yield _area(path, number, shape, properties, secret)


def _area(path: Path, number: int, shape: shapely.Geometry, properties: dict[str, Any], secret: bytes) -> PrivatePlace:
    name = str(properties.get("name") or f"{path.name}, feature {number}")
    lon, lat = shapely.get_coordinates(shapely.centroid(shape))[0].tolist()
    if shapely.get_dimensions(shape) == 2:
        frame = enu(lat, lon)
        return _hidden(name, frame, shapely.transform(shape, frame.from_lonlat), secret)
    radius = properties.get("radius")
    if not isinstance(shape, shapely.Point) or not isinstance(radius, int | float):
        raise InputError(
            path, f"feature {number}", f"a {type(shape).__name__}", "a polygon, or a point with a radius [m]"
        )
    return _circle(name, lat, lon, float(radius), secret)


def _named(text: str, plans: Sequence[str], secret: bytes) -> Iterator[PrivatePlace]:
    """All shops and rooms of that name on some plans, whatever its capitals."""
    found = dict.fromkeys(
        (floor.frame, area.shape)
        for plan in plans
        for floor in Building.load(plan).floors
        for area in floor.of_kind(*NAMED)
        if area.name and same_name(area.name) == same_name(text)
    )
    if not found:
        raise InputError("a private place", text, f"no such name on {len(plans)} plans", NEEDED)
    for frame, shape in found:
        lon, lat = frame.to_lonlat(shapely.get_coordinates(shapely.centroid(shape)))[0].tolist()
        own = enu(lat, lon)
        moved = shapely.transform(shape, partial(own.from_frame, frame))
        if shapely.get_dimensions(moved) < 2:  # a stand that the plan has as a point, a wall as a line
            moved = shapely.buffer(moved, SMALLEST)
        yield _hidden(text, own, moved, secret)


def _hidden(name: str, frame: Frame, shape: shapely.Geometry, secret: bytes) -> PrivatePlace:
    """A place with what is hidden about it."""
    radius = max(SMALLEST, float(np.sqrt(shapely.area(shape) / np.pi)))
    assert frame.origin is not None, "made about the place"
    told = json.dumps([*np.round(frame.origin, 6), *np.round(shapely.bounds(shape), 1)])
    drawn = np.frombuffer(hmac.digest(secret, told.encode(), hashlib.sha256)[:16], dtype="<u8") / 2.0**64
    away, angle = radius * np.sqrt(drawn[0]), 2 * np.pi * drawn[1]  # evenly over the circle of that radius
    dx, dy = away * np.cos(angle), away * np.sin(angle)
    # quad_segs: the polygon lies within the circle, by 0.03 % of its radius, which is added
    wider = shapely.buffer(shape, 1.001 * radius, quad_segs=32)
    hidden = shapely.transform(wider, lambda p: p + np.array([dx, dy]))
    return PrivatePlace(name, frame, shape, hidden, radius)
