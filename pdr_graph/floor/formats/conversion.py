"""Conversion of a plan in any format to the GeoJSON of this project, with its scale and georeference.

These may come from points whose distance, or whose latitude and longitude, are known.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError, count
from pdr_graph.floor import plan_files
from pdr_graph.floor.formats import geojson
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.plan_files import FloorPlan
from pdr_graph.frames import enu
from pdr_graph.geometry import as_points
from pdr_graph.types import Array, OneLineRepr


def convert(
    source: Path,
    target: Path,
    scale: float | None = None,
    two_points: str | None = None,
    georeference: str | None = None,
    floor: str | None = None,
) -> Drawing:
    """Write a plan in our GeoJSON to `target`; returns what was written.

    scale: metres per unit; two_points: the same by a distance, ``x1,y1 x2,y2 = METRES``; georeference: points with
    their place, ``x,y=lat,lon x,y=lat,lon``, which also state the scale if nothing else does; floor: label of the only
    floor. Raises InputError for a plan that cannot be read or has no walkable area, for statements that contradict each
    other, and for a target that is a folder or a file of the input; `target` is unchanged then.
    """
    if target.is_dir():
        raise InputError("--out", "", f"{target}, which is a folder", "a file to write")
    if source.exists() and plan_files.is_file_of(target, source):
        raise InputError("--out", "", f"{target}, which is the input", "another file")
    if two_points is not None:
        if scale is not None:
            raise InputError("--two-points", "", "--scale too", "one of both")
        scale = scale_of_two_points(two_points)
    points = None if georeference is None else TiePoints.parse(georeference)
    try:
        drawing = plan_files.read(source, scale)
    except InputError:
        if scale is not None or points is None:
            raise
        drawing = plan_files.read(source, points.scale)  # a drawing that needs a scale
    if points is not None:
        drawing = georeferenced(drawing, points)
    if floor is not None:
        if len(drawing.floors) != 1:
            found = f"{count(len(drawing.floors), 'floor')}, {', '.join(drawing.floors)}"
            raise InputError("--floor", "", found, "a plan of one floor")
        (areas,) = drawing.floors.values()
        drawing = replace(drawing, floors={floor: tuple(replace(area, floors=()) for area in areas)}, heights={})
    FloorPlan.of(source, drawing)  # checks it
    geojson.write(target, drawing)
    return drawing


NUMBER = r"\s*(-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)\s*"
TWO_POINTS = re.compile(rf"{NUMBER},{NUMBER}[\s;]{NUMBER},{NUMBER}={NUMBER}m?\s*")
TIE_POINT = re.compile(rf"{NUMBER},{NUMBER}={NUMBER},{NUMBER}")
LARGEST_CONTRADICTION = 0.05  # of two scales, as a share: points clicked in a picture are a pixel or two off


@dataclass(frozen=True)
class TiePoints(OneLineRepr):
    """Points of a drawing with their place. drawn: ``(n, 2)`` in its own coordinates; lonlat: ``(n, 2)`` [deg]."""

    drawn: Array
    lonlat: Array

    @classmethod
    def parse(cls, text: str) -> TiePoints:
        """Points from a text ``x,y=lat,lon x,y=lat,lon ...``. Raises InputError unless there are two that differ."""
        expected = "two points or more, x,y=lat,lon x,y=lat,lon, in the plan's own units and degrees"
        parts = re.split(r"[\s;]+", re.sub(r"\s*([,=])\s*", r"\1", text.strip()))
        matches = [TIE_POINT.fullmatch(part) for part in parts]
        if len(parts) < 2 or not all(matches):
            raise InputError("--georeference", "", text, expected)
        numbers = np.array([[float(v) for v in match.groups()] for match in matches if match])
        if not (np.abs(numbers[:, 2:]) <= (90, 180)).all():
            raise InputError("--georeference", "", text, "latitude within ±90°, longitude within ±180°")
        points = cls(numbers[:, :2], numbers[:, [3, 2]])
        if not points.spread > 0 or not np.ptp(points.lonlat, axis=0).any():
            raise InputError("--georeference", "", "points at one place", expected)
        return points

    @property
    def east_north(self) -> Array:
        """Places ``(n, 2)`` [m], east and north of the first."""
        lon, lat = self.lonlat[0].tolist()
        return enu(lat, lon).from_lonlat(self.lonlat)

    @property
    def spread(self) -> float:
        """Root mean square distance of the drawn points from their mean [unit]."""
        return float(np.sqrt(np.mean(np.sum((self.drawn - self.drawn.mean(axis=0)) ** 2, axis=1))))

    @property
    def scale(self) -> float:
        """Metres per unit of the drawing."""
        place = self.east_north
        return float(np.sqrt(np.mean(np.sum((place - place.mean(axis=0)) ** 2, axis=1)))) / self.spread


def scale_of_two_points(text: str) -> float:
    """Metres per unit from a text ``x1,y1 x2,y2 = METRES``. Raises InputError for another text."""
    match = TWO_POINTS.fullmatch(text)
    x1, y1, x2, y2, metres = (float(v) for v in match.groups()) if match else (0.0,) * 5
    apart = float(np.hypot(x2 - x1, y2 - y1))
    if not (apart > 0 and metres > 0):
        raise InputError("--two-points", "", text, '"x1,y1 x2,y2 = METRES", two points of the plan and their distance')
    return metres / apart


def georeferenced(drawing: Drawing, points: TiePoints) -> Drawing:
    """A drawing turned, scaled and moved to its place on Earth: the similarity that fits the points best.

    Raises InputError for a plan that is georeferenced already or mirrored, or whose scale the points contradict.
    """
    if drawing.frame.georeferenced:
        raise InputError("--georeference", "", "a plan that is georeferenced by its format", "no such option")
    a, b, c, d, e, f = drawing.affine
    metres = points.drawn @ np.array([[a, d], [b, e]]) + (c, f)
    place, lon, lat = points.east_north, *points.lonlat[0].tolist()
    scale, shift, residual = _similarity(metres, place)
    _check_fit(metres, place, abs(scale), residual)
    note = f"georeferenced by {len(metres)} points: turned by {np.degrees(np.angle(scale)):.1f}°"
    note += f", residual {residual:.2f} m" if len(metres) > 2 else ""

    def moved(position: Array) -> Array:
        z = scale * (position[:, 0] + 1j * position[:, 1]) + shift
        return as_points(z)

    areas = {id(area): area for drawn in drawing.floors.values() for area in drawn}
    new = {key: replace(area, shape=shapely.transform(area.shape, moved)) for key, area in areas.items()}
    floors = {label: tuple(new[id(area)] for area in drawn) for label, drawn in drawing.floors.items()}
    notes = (*drawing.notes, note)
    ignored = shapely.transform(drawing.ignored, moved)
    return replace(drawing, floors=floors, frame=enu(lat, lon), notes=notes, ignored=ignored)


def _similarity(points: Array, place: Array) -> tuple[complex, complex, float]:
    """The factor and shift (complex) from points to places ``(n, 2)`` [m], least squares, and the rms residual [m]."""
    z, w = points[:, 0] + 1j * points[:, 1], place[:, 0] + 1j * place[:, 1]
    centred = z - z.mean()
    factor = complex(np.vdot(centred, w - w.mean()) / np.vdot(centred, centred).real)
    shift = complex(w.mean() - factor * z.mean())
    return factor, shift, float(np.sqrt(np.mean(np.abs(factor * z + shift - w) ** 2)))


def _check_fit(points: Array, place: Array, scale: float, residual: float) -> None:
    """Raise InputError if the points contradict the scale of a plan or fit better to its mirror image."""
    # the axes of a drawing are mirrored if the residual of its mirror image is five times smaller
    if len(points) > 2 and residual > 1.0 and _similarity(points * (-1, 1), place)[2] * 5.0 < residual:
        raise InputError(
            "--georeference", "", f"a residual of {residual:.1f} m", "points that are not mirrored (x,y swapped?)"
        )
    if not 1 - LARGEST_CONTRADICTION <= scale <= 1 + LARGEST_CONTRADICTION:
        apart = float(np.hypot(*np.ptp(points, axis=0)))
        found = f"points {apart:.1f} m apart in the plan and {apart * scale:.1f} m on Earth"
        raise InputError("--georeference", "", found, "distances that agree within 5 %: wrong scale or wrong point?")
