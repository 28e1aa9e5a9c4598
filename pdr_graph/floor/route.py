"""A known way to walk: the line of a calibration walk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor import formats
from pdr_graph.floor.areas import LINK
from pdr_graph.types import Array


def read_route(path: str | Path) -> Array:
    """Corners ``(m, 2)`` [m] of the one ``link`` in a plan of our own format.

    Raises InputError if there is none, or several.
    """
    drawing = formats.read(Path(path))
    lines = {area.shape for areas in drawing.floors.values() for area in areas if area.kind == LINK}
    if len(lines) != 1:
        raise InputError(path, "", f"{len(lines)} features of kind 'link'", "one, the line that was walked")
    corners = shapely.get_coordinates(lines.pop())
    apart = np.hypot(*np.diff(corners, axis=0).T) > 0
    return corners[np.append(True, apart)]
