"""A floor as a picture for the page: an SVG to lie under the tracks, and the names in it."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from pdr_graph.floor.areas import BEACON, CLOSED, LINK, OPEN, SOLID
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.plotting import BORDER, CELLS, EDGE, SOLID_FILL, WALKABLE
from pdr_graph.types import Array

THIN, WALL = 0.05, 0.12  # [m] as wide as borders and walls are drawn


def drawn(floor: FloorPlan) -> dict[str, Any]:
    """The plan as `plotting.draw_plan` has it, with its corners, names and how wide their polygons are [m]."""
    areas = [area for area in floor.areas if area.is_polygon and area.kind not in (LINK, BEACON)]
    solid = shapely.geometrycollections([area.shape for area in areas if area.kind in SOLID])
    ground = shapely.union_all([area.shape for area in areas])
    cells = [
        (shapely.geometrycollections([cell.polygon for cell in floor.cells.cells if cell.kind in kind]), colour)
        for kind, colour in CELLS
    ]
    links = shapely.geometrycollections([area.shape for area in floor.of_kind(LINK)])
    shapes = [
        _path(floor, ground, fill=SOLID_FILL),
        _path(floor, solid, stroke=BORDER, width=THIN),
        _path(floor, floor.walkable, fill=WALKABLE, stroke=EDGE, width=THIN),
        *(_path(floor, polygons, fill=colour) for polygons, colour in cells),
        _path(floor, floor.cells.barriers, stroke=EDGE, width=WALL),
        _path(floor, links, stroke=BORDER, width=THIN),
    ]
    width, height = (floor.corners[1] - floor.corners[0]).tolist()
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.2f}" height="{height:.2f}" '
    head += f'viewBox="0 0 {width:.2f} {height:.2f}" preserveAspectRatio="none">'
    return {
        "svg": f'{head}<g fill-rule="evenodd">{"".join(shapes)}</g></svg>',
        "corners": floor.corners.tolist(),
        "names": [_name(a.name, a.shape) for a in floor.of_kind(*SOLID, *CLOSED, *OPEN) if a.name and a.is_polygon],
    }


def _name(name: str, polygon: shapely.Geometry) -> dict[str, Any]:
    x, y = shapely.get_coordinates(shapely.point_on_surface(polygon))[0].tolist()
    west, _, east, _ = shapely.bounds(polygon).tolist()
    return {"text": name, "x": round(x, 2), "y": round(y, 2), "width": round(east - west, 2)}


def _path(
    floor: FloorPlan, shapes: shapely.Geometry, fill: str = "none", stroke: str = "none", width: float = 0.0
) -> str:
    """Polygons or lines as one path, from the plan's north-west corner: numbers of a browser are short."""
    corner = np.array([floor.corners[0, 0], floor.corners[1, 1]])
    closed = shapely.get_dimensions(shapes) == 2
    parts = shapely.get_parts(shapely.get_parts(shapes))
    lines = shapely.get_rings(parts[shapely.get_dimensions(parts) == 2]) if closed else parts
    said = "".join(f"M{_points(shapely.get_coordinates(line) - corner)}{'Z' if closed else ''}" for line in lines)
    return f'<path d="{said}" fill="{fill}" stroke="{stroke}" stroke-width="{width}"/>' if said else ""


def _points(line: Array) -> str:
    return " ".join(f"{x:.2f},{-y:.2f}" for x, y in line.tolist())
