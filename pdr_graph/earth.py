"""The earth's magnetic field."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np
from pygeomag import GeoMag

from pdr_graph.types import Array

USUAL_YEAR = 2025.0  # of a recording without a clock: declination changes by a degree in ten years
FIRST_YEAR, LAST_YEAR = 2010.0, 2029.9  # of the models that pygeomag brings


@dataclass(frozen=True)
class EarthField:
    """Of a place and date: magnitude [µT]; declination, east of true north, and dip below the horizon [rad]."""

    magnitude: float
    declination: float
    dip: float

    @property
    def vector(self) -> Array:
        """East, north, up ``(3,)``. [µT]"""
        level = self.magnitude * np.cos(self.dip)
        up = -self.magnitude * np.sin(self.dip)
        return np.array([level * np.sin(self.declination), level * np.cos(self.declination), up])


def earth_field(lat: float, lon: float, epoch: float | None = None) -> EarthField:
    """The World Magnetic Model's field at a latitude and longitude [deg] and Unix time [s], by pygeomag."""
    year = USUAL_YEAR if epoch is None else 1970 + epoch / (365.25 * 86400)
    year = min(max(year, FIRST_YEAR), LAST_YEAR)
    at = GeoMag(base_year=datetime(int(year), 1, 1)).calculate(glat=lat, glon=lon, alt=0.0, time=year)
    return EarthField(at.f / 1000, float(np.radians(at.d)), float(np.radians(at.i)))
