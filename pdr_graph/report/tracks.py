"""Tracks and their uncertainty as the page draws them, each row on the map that it belongs to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from pdr_graph.confidence import band
from pdr_graph.report.columns import CENTIMETRE, CENTIRADIAN, CENTISECOND, column, runs, thinned
from pdr_graph.types import Array, Trajectory

EVERYWHERE, NOWHERE = -1, -2  # in place of the number of a map
SQUARE_CENTIMETRE = 1e-4  # [m²]


def maps_of(floors: Sequence[str], labels: Sequence[str]) -> list[int]:
    """The number of the map for each row's floor, EVERYWHERE where the floor is unknown or there is one map."""
    if len(labels) == 1:
        return [0] * len(floors)
    number = {label: n for n, label in enumerate(labels)} | {"": EVERYWHERE}
    return [number.get(floor, NOWHERE) for floor in floors]


def track(name: str, colour: str, path: Trajectory, on: Sequence[int], **style: Any) -> dict[str, Any]:
    """A path; on: the map of each row; style: whatever else ``web/content.js`` knows of a track."""
    rows = thinned(len(path))
    drawn = {
        "name": name,
        "colour": colour,
        "on": runs([on[row] for row in rows.tolist()]),
        "time": column(path.time[rows], CENTISECOND),
        "x": column(path.position[rows, 0], CENTIMETRE),
        "y": column(path.position[rows, 1], CENTIMETRE),
        "heading": column(path.heading[rows], CENTIRADIAN),
    }
    if path.covariance is not None:
        covariance = path.covariance[rows]
        drawn["covariance"] = [column(covariance[:, i, j], SQUARE_CENTIMETRE) for i, j in ((0, 0), (0, 1), (1, 1))]
    return drawn | style


def bands(path: Trajectory, on: Sequence[int], maps: int) -> list[dict[str, Any]]:
    """The 95 % region of a path on each of so many maps."""
    where = np.array(on)
    return [rings(band(path, (where == n) | (where == EVERYWHERE))) for n in range(maps)]


def rings(polygons: Array) -> dict[str, Any]:
    """Polygons ``(k,)`` as their rings, parted by None."""
    parts = [np.append(shapely.get_coordinates(p), [[np.nan, np.nan]], axis=0) for p in polygons]
    x, y = np.concatenate([np.empty((0, 2)), *parts]).T
    return {"x": column(x, CENTIMETRE), "y": column(y, CENTIMETRE)}
