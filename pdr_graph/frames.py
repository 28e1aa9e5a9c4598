"""Metric frames and their way to latitude and longitude."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pdr_graph.errors import expect
from pdr_graph.types import LONLAT, Array, Beacons, Fixes, Trajectory

if TYPE_CHECKING:
    from pyproj import Transformer

EAST = 1e-4  # [deg] of longitude: some metres
Placed = TypeVar("Placed", Fixes, Trajectory, Beacons)


@dataclass(frozen=True)
class Frame:
    """A metric frame, x east and y north.

    kind: ``local`` (not georeferenced), ``enu`` (about an origin), ``plan`` (a floor plan's own, linear in degrees) or
        ``projected`` (a map projection).
    origin: latitude and longitude of (0, 0) [deg], None if not georeferenced.
    epsg: of a projected frame.
    metres_per_degree: x per degree of longitude and y per degree of latitude, of a plan's frame.
    """

    kind: str = "local"
    origin: tuple[float, float] | None = None
    epsg: int | None = None
    metres_per_degree: tuple[float, float] | None = None

    @property
    def georeferenced(self) -> bool:
        """True if positions have a latitude and a longitude."""
        return self.kind != "local"

    def from_lonlat(self, lonlat: Array) -> Array:
        """Positions ``(n, 2)`` [m] of longitudes and latitudes ``(n, 2)`` [deg]."""
        if self.metres_per_degree is not None:
            return (lonlat - self._origin_lonlat) * self.metres_per_degree
        return np.stack(self._transformer.transform(*lonlat.T), axis=1)

    def to_lonlat(self, position: Array) -> Array:
        """Longitudes and latitudes ``(n, 2)`` [deg] of positions ``(n, 2)`` [m]."""
        if self.metres_per_degree is not None:
            return position / self.metres_per_degree + self._origin_lonlat
        return np.stack(self._transformer.transform(*position.T, direction="INVERSE"), axis=1)

    def from_frame(self, other: Frame, position: Array) -> Array:
        """Positions ``(n, 2)`` [m] of another frame in this one; both are on earth if they are not the same."""
        return position if other == self else self.from_lonlat(other.to_lonlat(position))

    def place(self, what: Placed) -> Placed:
        """What has places brought into this frame from that of its ``epsg``; without one as it is."""
        if what.epsg is None:
            return what
        position = what.position
        if what.epsg != self.epsg:
            lonlat = position if what.epsg == LONLAT else projected(what.epsg).to_lonlat(position)
            position = self.from_lonlat(lonlat)
        return replace(what, position=position, epsg=None)

    def bearing_of_east(self, position: Array) -> float:
        """Where true east lies at a position ``(2,)``, counter-clockwise from +x: a projection's convergence. [rad]"""
        lon, lat = self.to_lonlat(position[None])[0]
        x, y = np.diff(self.from_lonlat(np.array([[lon, lat], [lon + EAST, lat]])), axis=0)[0]
        return float(np.arctan2(y, x))

    def describe(self) -> dict[str, Any]:
        """As ``summary.json`` has it."""
        lat, lon = self.origin or (None, None)
        return {"kind": self.kind, "origin_lat": lat, "origin_lon": lon, "epsg": self.epsg}

    @classmethod
    def described(cls, said: dict[str, Any]) -> Frame:
        """The frame of which `describe` says so; not of a plan, which has its own scale."""
        lat, lon = said["origin_lat"], said["origin_lon"]
        return cls(said["kind"], None if lat is None else (lat, lon), said["epsg"])

    @property
    def _origin_lonlat(self) -> Array:
        assert self.origin is not None
        return np.array(self.origin[::-1])

    @property
    def _transformer(self) -> Transformer:
        if self.kind == "projected":
            return _transformer(f"EPSG:{self.epsg}")
        if self.origin is None:
            raise ValueError("Frame: found a local frame, needed one with a latitude, as of frame_of(fixes) or a plan")
        lat, lon = self.origin
        return _transformer(f"+proj=aeqd +lat_0={lat} +lon_0={lon} +ellps=WGS84")


@lru_cache(maxsize=64)
def _transformer(projection: str) -> Transformer:
    """From longitude and latitude; made once, since that takes 30 ms."""
    from pyproj import CRS, Transformer  # here, since few walks need it and it takes time to load

    return Transformer.from_crs("EPSG:4326", CRS(projection), always_xy=True)


def frame_of(fixes: Fixes) -> Frame:
    """That in which fixes are, of at least one; about the first where they are longitude and latitude.

    ``frame_of(fixes).place(fixes)`` has them in metres.
    """
    expect("frame_of, fixes", fixes, Fixes, instead="load(path).fixes")
    if fixes.epsg == LONLAT:
        lon, lat = fixes.position[0].tolist()
        return enu(lat, lon)
    return Frame() if fixes.epsg is None else projected(fixes.epsg)


def enu(lat: float, lon: float) -> Frame:
    """East-North about an origin [deg]: azimuthal equidistant, centimetres from the tangent plane within 10 km."""
    return Frame("enu", origin=(lat, lon))


def projected(epsg: int) -> Frame:
    """The frame of a map projection, as it is."""
    return Frame("projected", epsg=epsg)
