"""Metric frames, their conversion to latitude and longitude, and the earth's magnetic field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pygeomag import GeoMag

from pdr_graph.errors import expect
from pdr_graph.types import LONLAT, Array, Beacons, Fixes, Trajectory

if TYPE_CHECKING:
    from pyproj import Transformer


METRES_PER_DEGREE = 111_319.49  # of latitude, and of longitude at latitude 0: earth radius 6378137 m times pi / 180
Positioned = TypeVar("Positioned", Fixes, Trajectory, Beacons)


@dataclass(frozen=True)
class Frame:
    """A metric frame, x east and y north.

    kind: ``local`` (not georeferenced), ``enu`` (about an origin), ``plan`` (a floor plan's own, linear in degrees) or
        ``projected`` (a map projection).
    origin: latitude and longitude of (0, 0) [deg], None if not georeferenced.
    epsg: code of a projected frame.
    metres_per_degree: x per degree of longitude and y per degree of latitude [m/deg] of a plan's frame.
    """

    kind: str = "local"
    origin: tuple[float, float] | None = None
    epsg: int | None = None
    metres_per_degree: tuple[float, float] | None = None

    @property
    def georeferenced(self) -> bool:
        """True if positions can be converted to latitude and longitude."""
        return self.kind != "local"

    def from_lonlat(self, lonlat: Array) -> Array:
        """Positions ``(n, 2)`` [m] from longitudes and latitudes ``(n, 2)`` [deg]."""
        if self.metres_per_degree is not None:
            return (lonlat - self._origin_lonlat) * self.metres_per_degree
        return np.stack(self._transformer.transform(*lonlat.T), axis=1)

    def to_lonlat(self, position: Array) -> Array:
        """Longitudes and latitudes ``(n, 2)`` [deg] from positions ``(n, 2)`` [m]."""
        if self.metres_per_degree is not None:
            return position / self.metres_per_degree + self._origin_lonlat
        return np.stack(self._transformer.transform(*position.T, direction="INVERSE"), axis=1)

    def from_frame(self, other: Frame, position: Array) -> Array:
        """Positions ``(n, 2)`` [m] converted from frame `other`; both must be georeferenced unless equal."""
        return position if other == self else self.from_lonlat(other.to_lonlat(position))

    def place(self, data: Positioned) -> Positioned:
        """`data` with positions converted to this frame [m] from the frame of its ``epsg``; unchanged without one."""
        if data.epsg is None:
            return data
        if data.epsg == self.epsg:
            return replace(data, epsg=None)
        own = None if data.epsg == LONLAT else projected(data.epsg)
        lonlat = data.position if own is None else own.to_lonlat(data.position)
        placed = replace(data, position=self.from_lonlat(lonlat), epsg=None)
        if not isinstance(placed, Fixes) or not np.isfinite(placed.course).any():
            return placed
        east = 0.0 if own is None else own.bearing_of_east(data.position[0])
        return replace(placed, course=placed.course + self.bearing_of_east(placed.position[0]) - east)

    def bearing_of_east(self, position: Array) -> float:
        """Direction of true east at a position ``(2,)``, counter-clockwise from +x: the grid convergence. [rad]"""
        lon, lat = self.to_lonlat(position[None])[0]
        east = lon + 1e-4  # [deg]: some metres
        x, y = np.diff(self.from_lonlat(np.array([[lon, lat], [east, lat]])), axis=0)[0]
        return float(np.arctan2(y, x))

    def __str__(self) -> str:
        """Its origin, or its kind, for people."""
        return self.kind if self.origin is None else "{:.6f}, {:.6f}".format(*self.origin)

    def describe(self) -> dict[str, Any]:
        """The frame as in ``summary.json``."""
        lat, lon = self.origin or (None, None)
        return {"kind": self.kind, "origin_lat": lat, "origin_lon": lon, "epsg": self.epsg}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> Frame:
        """The frame from the output of `describe`; not for a plan's frame, whose scale is not in it."""
        lat, lon = description["origin_lat"], description["origin_lon"]
        return cls(description["kind"], None if lat is None else (lat, lon), description["epsg"])

    @property
    def _origin_lonlat(self) -> Array:
        assert self.origin is not None
        return np.array(self.origin[::-1])

    @property
    def _transformer(self) -> Transformer:
        if self.kind == "projected":
            return _transformer(f"EPSG:{self.epsg}")
        if self.origin is None:
            raise ValueError(
                "Frame: found a local frame, expected a georeferenced one, as of frame_of(fixes) or a plan"
            )
        return _about(*self.origin)


@lru_cache(maxsize=64)
def _transformer(projection: str) -> Transformer:
    """The transformer from longitude and latitude [deg] to the projection [m]; cached: making one takes 30 ms."""
    from pyproj import CRS, Transformer  # here: few walks need it and it is slow to load

    return Transformer.from_crs("EPSG:4326", CRS(projection), always_xy=True)


@lru_cache(maxsize=64)
def _about(lat: float, lon: float) -> Transformer:
    """The transformer from longitude and latitude [deg] to East-North about an origin [deg] [m].

    The same to the bit as that between reference systems, which takes a hundred times as long to make, for each day of
    a lifelog.
    """
    from pyproj import Transformer

    degrees = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step"
    return Transformer.from_pipeline(f"{degrees} +proj=aeqd +lat_0={lat:.15g} +lon_0={lon:.15g} +ellps=WGS84")


def frame_of(fixes: Fixes) -> Frame:
    """The metric frame for fixes, at least one: their projection, or East-North about the first fix in degrees.

    ``frame_of(fixes).place(fixes)`` converts them to metres.
    """
    expect("frame_of, fixes", fixes, Fixes, instead="load(path).fixes")
    if fixes.epsg == LONLAT:
        lon, lat = fixes.position[0].tolist()
        return enu(lat, lon)
    return Frame() if fixes.epsg is None else projected(fixes.epsg)


def enu(lat: float, lon: float) -> Frame:
    """East-North frame about an origin [deg]: azimuthal equidistant, centimetres from the tangent plane at 10 km."""
    return Frame("enu", origin=(lat, lon))


def projected(epsg: int) -> Frame:
    """The frame of a map projection by its EPSG code."""
    return Frame("projected", epsg=epsg)


@dataclass(frozen=True)
class EarthField:
    """Field of the earth: magnitude [µT]; declination east of true north and dip below horizontal [rad]."""

    magnitude: float
    declination: float
    dip: float

    @property
    def vector(self) -> Array:
        """The field vector ``(3,)``: east, north, up. [µT]"""
        level = self.magnitude * np.cos(self.dip)
        up = -self.magnitude * np.sin(self.dip)
        return np.array([level * np.sin(self.declination), level * np.cos(self.declination), up])


def earth_field(lat: float, lon: float, epoch: float | None = None) -> EarthField:
    """The field by the World Magnetic Model (pygeomag) at a latitude and longitude [deg] and Unix time [s]."""
    # default year for a recording without absolute time: declination changes by a degree in ten years
    year = 2025.0 if epoch is None else 1970 + epoch / (365.25 * 86400)
    year = min(max(year, 2010.0), 2029.9)  # covered by the models that pygeomag ships
    model = GeoMag(base_year=datetime(int(year), 1, 1)).calculate(glat=lat, glon=lon, alt=0.0, time=year)
    return EarthField(model.f / 1000, float(np.radians(model.d)), float(np.radians(model.i)))
