"""Pictures of a floor: PNG and JPEG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.line_drawing import Lines, areas_of
from pdr_graph.floor.formats.prerequisites import required_library
from pdr_graph.floor.formats.tracing import Picture, opened, traced
from pdr_graph.floor.formats.units import metres_per_unit
from pdr_graph.frames import Frame


def recognizes(path: Path, head: bytes) -> bool:
    """True for a PNG or a JPEG."""
    return head.startswith((b"\x89PNG\r\n", b"\xff\xd8\xff"))


def read(path: Path, scale: float | None) -> Drawing:
    """Trace the walls of a picture. scale: metres per pixel; the format states none."""
    picture, factor = opened(path, ("PNG", "JPEG"))
    return drawing_of_picture(path, picture, scale, 1.0 / factor, ["the walls were traced from a picture"])


def drawing_of_picture(path: Path, picture: Picture, scale: float | None, finer: float, notes: list[str]) -> Drawing:
    """The plan in a picture's brightness, x right and y up from its lower left corner.

    scale: metres per pixel of the file; finer: pixels of `picture` per pixel of the file. Raises InputError without a
    scale, or if the dark lines enclose no building.
    """
    rows, columns = np.array(picture.shape) / finer
    if scale is None:
        found = f"a picture of {columns:.0f} by {rows:.0f} pixels and no scale"
        expected = '--scale METRES_PER_PIXEL, or pdr-graph map convert --two-points "x1,y1 x2,y2 = METRES"'
        raise InputError(path, "", found, expected)
    metres = metres_per_unit(path, np.array([[0.0, 0.0], [columns, rows]]), scale, "a picture in pixels") / finer
    with required_library(path, "a picture", "scikit-image"):
        walls, affine = traced(picture, metres, notes)
    if shapely.is_empty(walls):
        raise InputError(path, "", "a picture without dark lines", "the walls of a floor")
    areas, outside = areas_of(Lines(np.empty((0, 2, 2)), solid=walls), notes)
    if not areas:
        raise InputError(path, "", "dark lines that enclose no building", "walls with gaps of at most 5 m around it")
    (a, b, c), (d, e, f) = affine.tolist()
    return Drawing(
        {"": areas}, Frame(), tuple(notes), affine=(a * finer, b * finer, c, d * finer, e * finer, f), ignored=outside
    )
