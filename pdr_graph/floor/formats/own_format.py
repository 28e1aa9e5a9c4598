"""Reads and writes plans in the GeoJSON of this project (``docs/formats.md``)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import CELL_KINDS, Area
from pdr_graph.floor.formats.drawing import Drawing, floor_heights, frame_about
from pdr_graph.floor.formats.geojson import Feature, area_of, check_degrees
from pdr_graph.frames import Frame, enu
from pdr_graph.whole_files import write_file

LOCAL_FRAME = "local"  # value of the member ``pdr_graph.frame``


def read(path: Path, collection: dict[str, Any], features: list[Feature], notes: list[str]) -> Drawing:
    """Read our own format: an RFC 7946 FeatureCollection of features with ``kind`` and ``name`` (``docs/formats.md``).

    A feature's ``floor`` is the label of its floor or a list of labels; without it, the feature is on all floors. The
    frame is ENU about the member ``pdr_graph.origin`` ([longitude, latitude]), by default about the centre of the
    bounding box; ``pdr_graph.heights`` has the heights of the floors. With ``"frame": "local"`` in ``pdr_graph`` the
    coordinates are metres of a plan without georeference.
    """
    for n, _, properties in features:
        if properties.get("kind") not in CELL_KINDS:
            found = f"kind {properties.get('kind')!r}"[:80]
            raise InputError(path, f"feature {n}", found, "one of " + ", ".join(CELL_KINDS))
    about = collection.get("pdr_graph")
    about = about if isinstance(about, dict) else {}
    frame = Frame() if about.get("frame") == LOCAL_FRAME else _georeferenced(path, about, features)
    areas = [area_of(f[2]["kind"], f, frame if frame.georeferenced else None) for f in features]
    labels = {label for area in areas for label in area.floors} or {str(about.get("floor", ""))}
    heights = floor_heights(path, labels, about.get("heights"))
    floors = {label: tuple(a for a in areas if not a.floors or label in a.floors) for label in heights}
    return Drawing(floors, frame, tuple(notes), heights=heights)


def _georeferenced(path: Path, about: dict[str, Any], features: list[Feature]) -> Frame:
    """The frame of a plan in degrees. Raises InputError for other coordinates, or another member ``frame``."""
    if "frame" in about:
        raise InputError(path, "pdr_graph.frame", repr(about["frame"])[:40], f"{LOCAL_FRAME!r}, or no such member")
    check_degrees(path, features)
    if "origin" not in about:
        return frame_about(shape for _, shape, _ in features)
    origin = about["origin"]
    numbers = isinstance(origin, list) and len(origin) == 2 and all(type(v) in (int, float) for v in origin)
    if not numbers or not (np.abs(origin) <= (180, 90)).all():
        raise InputError(path, "pdr_graph.origin", repr(origin)[:40], "[longitude, latitude] in degrees")
    return enu(origin[1], origin[0])


WRITTEN_ANEW = ("kind", "name", "floor", "level", "Type")  # properties that are not copied


def write(path: Path, drawing: Drawing) -> None:
    """Write a plan: longitude and latitude, or metres with ``"frame": "local"`` of one without georeference."""
    labels = list(drawing.floors)
    about: dict[str, Any] = {} if drawing.frame.georeferenced else {"frame": LOCAL_FRAME}
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
    properties: dict[str, Any] = {
        name: value
        for name, value in area.properties.items()
        if name not in WRITTEN_ANEW
        and (isinstance(value, str) or (isinstance(value, int | float) and abs(value) < np.inf))
    }
    properties |= {"kind": area.kind, "name": area.name}
    if floors:
        properties["floor"] = floors[0] if len(floors) == 1 else floors
    placed = shapely.transform(area.shape, frame.to_lonlat) if frame.georeferenced else area.shape
    digits = 8 if frame.georeferenced else 3  # of a coordinate: 1 mm
    shape = shapely.transform(placed, lambda position: np.round(position, digits))
    if not shapely.is_valid(shape):  # rounded corners may make an outline cross itself
        shape = placed
    return {"type": "Feature", "properties": properties, "geometry": json.loads(shapely.to_geojson(shape))}
