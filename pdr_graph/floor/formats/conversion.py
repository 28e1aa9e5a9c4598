"""Conversion of a plan in any format to the GeoJSON of this project."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pdr_graph.errors import InputError, count
from pdr_graph.floor import plan_files
from pdr_graph.floor.formats import own_writer
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.georeference import TiePoints, georeferenced, scale_of_two_points
from pdr_graph.floor.plan_files import FloorPlan


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
    _check_target(source, target)
    if two_points is not None:
        if scale is not None:
            raise InputError("--two-points", "", "--scale too", "one of both")
        scale = scale_of_two_points(two_points)
    points = None if georeference is None else TiePoints.parse(georeference)
    drawing = _read(source, scale, points)
    if points is not None:
        drawing = georeferenced(drawing, points)
    if floor is not None:
        drawing = _labelled(drawing, floor)
    FloorPlan.of(source, drawing)  # checks it
    own_writer.write(target, drawing)
    return drawing


def _check_target(source: Path, target: Path) -> None:
    """Raise InputError for a target that is a folder or a file of the input."""
    if target.is_dir():
        raise InputError("--out", "", f"{target}, which is a folder", "a file to write")
    if source.exists() and target.resolve() in {file.resolve() for file in plan_files.files_of(source)}:
        raise InputError("--out", "", f"{target}, which is the input", "another file")


def _read(source: Path, scale: float | None, points: TiePoints | None) -> Drawing:
    """Read a plan; if it needs a scale and none is stated, with that of the points."""
    try:
        return plan_files.read(source, scale)
    except InputError:
        if scale is not None or points is None:
            raise
        return plan_files.read(source, points.scale)


def _labelled(drawing: Drawing, floor: str) -> Drawing:
    """A drawing whose only floor has a label."""
    if len(drawing.floors) != 1:
        found = f"{count(len(drawing.floors), 'floor')}, {', '.join(drawing.floors)}"
        raise InputError("--floor", "", found, "a plan of one floor")
    (areas,) = drawing.floors.values()
    areas = tuple(replace(area, floors=()) for area in areas)
    return replace(drawing, floors={floor: areas}, heights={})
