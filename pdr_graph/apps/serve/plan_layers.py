"""The floor plan as GeoJSON for the page's map: what `plotting.draw_plan` draws, as one feature per layer and floor.

A plan without georeference is drawn about longitude 0, latitude 0, where a map's metres are equal along both axes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely

from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import BEACON, CLOSED, DOOR, LINK, OPEN, SOLID
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import METRES_PER_DEGREE, Frame
from pdr_graph.types import Array

CELL_LAYERS = {"room": CLOSED, "door": (DOOR,), "stairs": ("stairs",)}  # layers and the kinds of cells in them


def plan_layers(building: Building | None) -> dict[str, Any]:
    """The plan as a GeoJSON FeatureCollection; without a plan, an empty one.

    Each feature has ``layer`` (``ground``, ``border``, ``walkable``, ``room``, ``door``, ``stairs``, ``wall``,
    ``link``, ``beacon`` or ``name``) and ``floor``. The member ``pdr_graph`` has ``georeferenced``, ``floors`` (labels,
    lowest first) and ``bounds`` (west, south, east, north; None without a plan).
    """
    if building is None:
        about = {"georeferenced": None, "floors": [], "bounds": None}
        return {"type": "FeatureCollection", "pdr_graph": about, "features": []}
    frame = building.floors[0].frame
    features = [
        {"type": "Feature", "properties": properties | {"floor": floor.label}, "geometry": _geometry(shape, frame)}
        for floor in building.floors
        for properties, shape in _drawn(floor)
        if not shapely.is_empty(shape)
    ]
    (west, south), (east, north) = lonlat(building.corners, frame).tolist()
    about = {
        "georeferenced": frame.georeferenced,
        "floors": list(building.labels),
        "bounds": [west, south, east, north],
    }
    return {"type": "FeatureCollection", "pdr_graph": about, "features": features}


def lonlat(position: Array, frame: Frame) -> Array:
    """Longitudes and latitudes ``(n, 2)`` [deg] of positions ``(n, 2)`` [m]; about (0, 0) without a georeference."""
    return frame.to_lonlat(position) if frame.georeferenced else position / METRES_PER_DEGREE


def _drawn(floor: FloorPlan) -> Iterator[tuple[dict[str, str], shapely.Geometry]]:
    """The shapes of a floor [m] with their properties."""
    areas = [area for area in floor.areas if area.is_polygon and area.kind not in (LINK, BEACON)]
    yield {"layer": "ground"}, shapely.union_all([area.shape for area in areas])
    solid = shapely.geometrycollections([area.shape for area in areas if area.kind in SOLID])
    yield {"layer": "border"}, shapely.union_all(shapely.boundary(shapely.get_parts(solid)))
    yield {"layer": "walkable"}, floor.walkable
    for layer, kinds in CELL_LAYERS.items():
        shapes = [cell.polygon for cell in floor.cells.cells if cell.kind in kinds]
        yield {"layer": layer}, shapely.union_all(shapes)
    yield {"layer": "wall"}, floor.cells.barriers
    yield {"layer": "link"}, shapely.union_all([area.shape for area in floor.of_kind(LINK)])
    for area in floor.of_kind(BEACON):
        yield {"layer": "beacon", "text": area.name}, shapely.point_on_surface(area.shape)
    for area in floor.of_kind(*SOLID, *CLOSED, *OPEN):
        if area.name and area.is_polygon:
            yield {"layer": "name", "text": area.name}, shapely.point_on_surface(area.shape)


def _geometry(shape: shapely.Geometry, frame: Frame) -> dict[str, Any]:
    """A shape [m] as a GeoJSON geometry in longitude and latitude."""
    placed = shapely.transform(shape, lambda points: np.round(lonlat(points, frame), 9))  # decimals of a degree: 0.1 mm
    geometry: dict[str, Any] = json.loads(shapely.to_geojson(placed))
    return geometry
