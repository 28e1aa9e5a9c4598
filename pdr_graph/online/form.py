"""Positions as a trial gives and takes them: ``lon,lat,floor``, or ``x,y,floor`` in the output frame."""

from __future__ import annotations

import math

import numpy as np

from pdr_graph.frames import Frame
from pdr_graph.types import LONLAT, Array, Fixes

INITIAL_SIGMA = 0.5  # [m] per axis: someone stands on a mark
GROUND = "0"  # the floor that is sent where none is known


class Form:
    """The form of one trial's positions.

    initial: where the trial begins, longitude and latitude [deg] or x and y [m], None if that is not known (a server
    that does not know says 0,0,0) or to be ignored. default: the floor's label where the estimate has none, that of
    the initial position, else 0.
    """

    def __init__(self, lonlat: bool, initial: str, ignored: bool = False):
        self.lonlat = lonlat
        cells = [] if ignored else [cell.strip() for cell in initial.replace(";", ",").split(",")]
        self.default = cells[2] if len(cells) > 2 and cells[2] else GROUND
        self.initial = _place(cells, lonlat)

    def text(self, position: Array, floor: str, frame: Frame | None) -> str:
        """A position ``(2,)`` [m]; empty while it has no longitude."""
        if not self.lonlat:
            return self.written(position, floor)
        if frame is None or not frame.georeferenced:
            return ""
        return self.written(frame.to_lonlat(position[None])[0], floor)

    def written(self, place: Array, floor: str) -> str:
        """A place ``(2,)`` in [deg] or [m] and its floor, as a server can read them; empty if it is none."""
        if not np.isfinite(place).all():
            return ""
        legible = floor and floor.isascii() and floor.isprintable() and not set(floor) & set(",;")
        digits = 8 if self.lonlat else 3
        return f"{place[0]:.{digits}f},{place[1]:.{digits}f},{floor if legible else self.default}"

    def initial_fix(self, time: float, floors: tuple[str, ...]) -> Fixes:
        """The initial position, none if it is unknown. floors: of the plan, empty without one."""
        if self.initial is None:
            return Fixes.none()
        label = self.default if not floors or self.default in floors else ""
        sigma, epsg = np.array([INITIAL_SIGMA]), LONLAT if self.lonlat else None
        return Fixes(np.array([time]), np.array([self.initial]), sigma, (label,), epsg)


def _place(cells: list[str], lonlat: bool) -> tuple[float, float] | None:
    try:
        x, y = float(cells[0]), float(cells[1])
    except (ValueError, IndexError):
        return None
    known = math.isfinite(x) and math.isfinite(y) and (x, y) != (0.0, 0.0)
    return (x, y) if known and (not lonlat or (abs(x) <= 180 and abs(y) <= 90)) else None
