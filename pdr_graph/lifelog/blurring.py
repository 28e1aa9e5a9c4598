"""What lies at blurred places: one row for each quarter of an hour, in the middle of a square.

The squares are those of a grid that is the same everywhere and always: one about the place would give its middle away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pdr_graph.geometry import ANY_HEADING
from pdr_graph.lifelog.day import Outing, Segment, Stay
from pdr_graph.lifelog.hiding import Hidden
from pdr_graph.lifelog.parts import PRIVATE, Part
from pdr_graph.lifelog.private_places import PrivatePlace, hides
from pdr_graph.types import Array, Index, Trajectory

QUARTER = 900.0  # [s]
COARSE = 500.0  # [m] side of a blurred place's square, or its radius if that is more
METRES_PER_DEGREE = 111_320.0  # of latitude, near enough for the squares of a grid


def blurred(
    outing: Outing, hidden: Hidden, own: Index, blur: Sequence[PrivatePlace], free: tuple[float, float], first: bool
) -> Part | None:
    """Blurred rows as one for each quarter of an hour within the Unix times that are free; None if there are none.

    first: whether nothing is shown of the outing before.
    """
    if not len(own):
        return None
    unix = outing.trajectory.time + outing.epoch
    since, until = unix[own[[0, -1]]].tolist()
    start = max(free[0], quarter_before(since)) if first else free[0]
    end = free[1] if np.isfinite(free[1]) else max(start, quarter_after(until))
    quarter = np.floor(unix[own] / QUARTER) * QUARTER
    time = np.unique(quarter + QUARTER / 2)
    time = time[(time > start) & (time < end)]
    if not len(time):
        return None
    usual = [np.median(hidden.lonlat[own[quarter == t - QUARTER / 2]], axis=0) for t in time]
    centre, side = _squares(np.array(usual), blur)
    covariance = np.zeros((len(time), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = side**2 / 12
    covariance[:, 2, 2] = ANY_HEADING**2
    heading, floor = np.full(len(time), np.nan), ("",) * len(time)
    track = Trajectory(time, outing.frame.from_lonlat(centre), heading, floor, covariance)
    return Part(start, end, track, (Segment(PRIVATE, start, end, 0.0),), _blurred_stays(outing, blur, own, start, end))


def _blurred_stays(
    outing: Outing, blur: Sequence[PrivatePlace], own: Index, start: float, end: float
) -> tuple[Stay, ...]:
    """The stays among blurred rows, somewhere in a square and from quarter to quarter."""
    begin, last = outing.trajectory.time[own[[0, -1]]] + outing.epoch
    stays = []
    for stay in outing.stays:
        since, until = stay.start + outing.epoch, stay.end + outing.epoch
        inside = since < last and until > begin and hides(blur, outing.frame, stay.position)
        since, until = max(start, quarter_before(since)), min(end, quarter_after(until))
        if inside and not stay.passing and until > since:
            centre, side = _squares(outing.frame.to_lonlat(stay.position[None]), blur)
            position, covariance = outing.frame.from_lonlat(centre)[0], np.eye(2) * side[0] ** 2 / 12
            stays.append(Stay(since, until, False, position, covariance, np.nan, ""))
    return tuple(stays)


def _squares(lonlat: Array, blur: Sequence[PrivatePlace]) -> tuple[Array, Array]:
    """The middles ``(n, 2)`` [deg] of the squares in which positions lie, and their sides ``(n,)`` [m]."""
    side = np.max([np.full(len(lonlat), COARSE), *(p.hides(lonlat) * p.radius for p in blur)], axis=0)
    height = side / METRES_PER_DEGREE
    lat = (np.floor(lonlat[:, 1] / height) + 0.5) * height
    width = height / np.cos(np.radians(lat))
    return np.stack([(np.floor(lonlat[:, 0] / width) + 0.5) * width, lat], axis=1), side


def quarter_after(time: float) -> float:
    """The next full quarter of an hour. [s]"""
    return float(np.ceil(time / QUARTER) * QUARTER)


def quarter_before(time: float) -> float:
    """The last full quarter of an hour. [s]"""
    return float(np.floor(time / QUARTER) * QUARTER)
