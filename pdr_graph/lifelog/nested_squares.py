"""Squares over the earth whose sides halve from level to level, so that each lies within one of every coarser level.

Whoever learns the squares of one position on several levels knows no more than the smallest of them. With grids that
are not nested, the squares of a few levels would have little in common but the position.
"""

from __future__ import annotations

import numpy as np

from pdr_graph.types import Array

EQUATOR = 40_075_017.0  # [m] around the earth
FARTHEST = 89.9  # [deg] latitude of the outermost squares: Mercator's projection has no poles


def nested_squares(
    lonlat: Array, least_side: Array, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array, Array]:
    """The squares in which positions lie: middles ``(n, 2)`` [deg], sides ``(n,)`` [m], corners ``(n, 4, 2)`` [deg].

    lonlat: ``(n, 2)`` [deg]; least_side: ``(n,)`` [m], the sides are up to twice as long; shift: of all squares, as a
    share of the earth's circumference. The squares are those of Mercator's projection.
    """
    lat = np.clip(lonlat[:, 1], -FARTHEST, FARTHEST)
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
