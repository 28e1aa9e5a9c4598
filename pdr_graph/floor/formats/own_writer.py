"""Writes plans in the GeoJSON of this project (``docs/formats.md``)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.floor.cells import Area
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.own_format import LOCAL
from pdr_graph.frames import Frame
from pdr_graph.whole_files import write_file

DEGREES, METRES = 8, 3  # digits of coordinates: 1 mm
WRITTEN_ANEW = ("kind", "name", "floor", "level", "Type")  # properties that are not copied


def write(path: Path, drawing: Drawing) -> None:
    """Write a plan: longitude and latitude, or metres with ``"frame": "local"`` of one without georeference."""
    labels = list(drawing.floors)
    about: dict[str, Any] = {} if drawing.frame.georeferenced else {"frame": LOCAL}
    if drawing.frame.kind == "enu" and drawing.frame.origin is not None:
        about["origin"] = list(drawing.frame.origin[::-1])
    if len(labels) == 1:
        about |= {"floor": labels[0]} if labels[0] else {}
    elif drawing.heights:
        about["heights"] = drawing.heights
    areas, floors = dict[int, Area](), dict[int, list[str]]()
    for label, drawn in drawing.floors.items():
        for area in drawn:
            areas[id(area)] = area
            floors.setdefault(id(area), []).append(label)
    features = [_feature(area, floors[key] if len(labels) > 1 else [], drawing.frame) for key, area in areas.items()]
    collection = {"type": "FeatureCollection", "pdr_graph": about, "features": features}
    write_file(path, json.dumps(collection, ensure_ascii=False, allow_nan=False))


def _feature(area: Area, floors: list[str], frame: Frame) -> dict[str, Any]:
    """An area as a GeoJSON feature. floors: its labels, none for a plan of one floor."""
    properties: dict[str, Any] = {name: value for name, value in area.properties.items() if _is_copied(name, value)}
    properties |= {"kind": area.kind, "name": area.name}
    if floors:
        properties["floor"] = floors[0] if len(floors) == 1 else floors
    placed = shapely.transform(area.shape, frame.to_lonlat) if frame.georeferenced else area.shape
    digits = DEGREES if frame.georeferenced else METRES
    shape = shapely.transform(placed, lambda position: np.round(position, digits))
    if not shapely.is_valid(shape):  # rounded corners may make an outline cross itself
        shape = placed
    return {"type": "Feature", "properties": properties, "geometry": json.loads(shapely.to_geojson(shape))}


def _is_copied(name: str, value: object) -> bool:
    """True for properties that are texts or finite numbers and are not written anew."""
    return name not in WRITTEN_ANEW and (
        isinstance(value, str) or (isinstance(value, int | float) and abs(value) < np.inf)
    )
