"""Polygons of IPIN21Data."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.floor.cells import Area
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.geojson import Feature, area_of
from pdr_graph.frames import projected
from pdr_graph.types import UTM_32N

KIND_OF_TYPE = {
    "Corridor": "corridor",
    "Gallery": "corridor",
    "Balcony": "corridor",
    "Room": "room",
    "Door": "door",
    "B_Door": "door",
    "Stairs": "stairs",
    "Stairscase": "stairs",
    "Elevator": "lift",
    "Wall": "wall",
    "Wa": "wall",  # truncated in the files
}


def recognizes(features: list[Feature]) -> bool:
    """True for features with IPIN21's property."""
    return any("Type" in properties and "kind" not in properties for _, _, properties in features)


def read(path: Path, collection: dict[str, Any], features: list[Feature], notes: list[str]) -> Drawing:
    """Read polygons of IPIN21Data: property ``Type``, in metres of UTM zone 32N whatever CRS the file states."""
    corners = shapely.get_coordinates([shape for _, shape, _ in features])
    in_degrees = bool((np.abs(corners) <= (180, 90)).all())
    stated = re.findall(r"\d{4,5}|CRS84", json.dumps(collection.get("crs")))
    expected = ["4326", "CRS84"] if in_degrees else [str(UTM_32N)]
    if stated and stated[-1] not in expected:
        found = "degrees" if in_degrees else f"metres, read as EPSG:{UTM_32N}"
        notes.append(f"the file states CRS {stated[-1]}, but its coordinates are {found}")
    frame = projected(UTM_32N)
    areas: list[Area] = []
    for feature in features:
        kind = KIND_OF_TYPE.get(str(feature[2].get("Type")))
        if kind is None:
            notes.append(f"feature {feature[0]}: Type {str(feature[2].get('Type'))[:30]!r} was left out")
        else:
            areas.append(area_of(kind, feature, frame if in_degrees else None))
    return Drawing({path.stem.removeprefix("Plan"): tuple(areas)}, frame, tuple(notes))
