"""Tiles behind a map, from the address that the user gives; without one nothing is ever fetched.

The address is a template such as ``https://tile.openstreetmap.org/{z}/{x}/{y}.png`` (Web Mercator). Its server learns
which area is drawn.
"""

from __future__ import annotations

import io
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from urllib.parse import urlsplit

import numpy as np
from matplotlib.image import imread

from pdr_graph import __version__
from pdr_graph.errors import InputError
from pdr_graph.types import Array
from pdr_graph.web_request import ask, same_host

MERCATOR_RADIUS = 6_378_137.0  # [m] of Web Mercator's sphere
# Chosen by hand
MAX_TILES = 64  # of a map
TIMEOUT, LONGEST = 10.0, 60.0  # [s] of a request; of all tiles of a map
MAX_FAILURES = 3  # requests that may fail before no other is made
PNG_HEAD = struct.Struct(">8s8xII")  # signature, width and height


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
    """A picture ``(height, width, 3 or 4)`` with its corners ``(2, 2)`` on the map [m]."""

    picture: Array
    corners: Array


def check_template(template: str) -> None:
    """Raise InputError unless the text is a web address with {z}, {x} and {y}."""
    if urlsplit(template).scheme not in ("http", "https") or any(
        part not in template for part in ("{z}", "{x}", "{y}")
    ):
        expected = "a web address such as https://tile.openstreetmap.org/{z}/{x}/{y}.png"
        raise InputError("--tiles", "", repr(template), expected)


def tiles(template: str, frame: MercatorFrame, corners: Array, pixels: float) -> Iterator[Tile]:
    """Yield the tiles of an area ``(2, 2)`` [m] that is drawn `pixels` wide.

    Stops after MAX_FAILURES failures, or LONGEST seconds; raises OSError if not a single tile was fetched.
    """
    low, high = corners
    (west, north), (east, south) = frame.shares(np.array([[low[0], high[1]], [high[0], low[1]]]))
    zoom = _zoom(west, north, east, south, pixels)
    number, failures, made, end = 2**zoom, 0, 0, time.monotonic() + LONGEST
    for y in range(max(int(north * number), 0), min(int(south * number), number - 1) + 1):
        for x in range(int(np.floor(west * number)), int(np.floor(east * number)) + 1):
            address = _filled_in(template, zoom, x % number, y)
            try:
                picture = _fetched(address)
            except (OSError, ValueError, SyntaxError) as error:  # of the network, or not a picture
                failures += 1
                if failures >= MAX_FAILURES or time.monotonic() > end:
                    if not made:
                        raise OSError(f"{address}: {error}") from None
                    return
                continue
            made += 1
            yield Tile(picture, np.sort(frame.position(np.array([[x, y + 1], [x + 1, y]]) / number), axis=0))
            if time.monotonic() > end:
                return


def _filled_in(template: str, zoom: int, x: int, y: int) -> str:
    """The address of a tile."""
    return template.replace("{z}", str(zoom)).replace("{x}", str(x)).replace("{y}", str(y))


def _zoom(west: float, north: float, east: float, south: float, pixels: float) -> int:
    """The zoom at which a tile is drawn about as large as it is, with at most MAX_TILES tiles."""
    wanted = np.log2(max(pixels, 1) / 256 / max(east - west, 1e-9))  # tile pixels
    zoom = int(np.clip(np.round(wanted), 0, 19))  # highest zoom
    while zoom > 0 and ((east - west) * 2**zoom + 1) * ((south - north) * 2**zoom + 1) > MAX_TILES:
        zoom -= 1
    return zoom


def _fetched(address: str) -> Array:
    """The picture at an address, a PNG. Raises OSError, ValueError or SyntaxError if there is none."""
    most = 2_000_000  # bytes of a tile
    answer = ask(
        address, TIMEOUT, TIMEOUT, most, same_host(address), headers={"User-Agent": f"pdr_graph/{__version__}"}
    )
    if answer.status != 200:
        raise OSError(f"status {answer.status}")
    content = answer.body
    if len(content) < PNG_HEAD.size:
        raise ValueError("no picture")
    _, width, height = PNG_HEAD.unpack_from(content)  # before it is unpacked: a thousandth may be a gigabyte
    if max(width, height) > 1024:  # most side [pixels] of a tile
        raise ValueError(f"no PNG, or one of {width} × {height} pixels")
    picture = imread(io.BytesIO(content))
    return picture if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, axis=2)
