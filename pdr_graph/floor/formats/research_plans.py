"""Plans of research data sets: floor folders of Microsoft's Indoor Location Competition 2.0, polygons of IPIN21Data."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import OUTLINE, Area
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.geojson import Feature, area_of, check_degrees, features_of, read_json
from pdr_graph.frames import Frame, projected
from pdr_graph.io.signatures import MICROSOFT
from pdr_graph.types import UTM_32N


def read_microsoft(folder: Path) -> Drawing:
    """Read a floor folder of the Indoor Location Competition 2.0.

    Feature 0 is the outline, all others are solid: the walkable area is the outline minus them. The metric frame scales
    the outline's bounding box from degrees to ``map_info``'s width and height: x = (lon − lon0)/(lon1 − lon0)·width, y
    likewise.
    """
    (path, about), notes, repairs = (folder / name for name in MICROSOFT.parts), list[str](), list[str]()
    features = [f for f in features_of(path, read_json(path), notes, repairs) if shapely.get_dimensions(f[1]) == 2]
    if not features:
        raise InputError(path, "", "no polygon", "the floor's outline")
    check_degrees(path, features)
    info = read_json(about).get("map_info")
    size = [info.get("width"), info.get("height")] if isinstance(info, dict) else [None]
    if not all(isinstance(s, int | float) and np.isfinite(s) and s > 0 for s in size):
        raise InputError(about, "map_info", f"width and height {size}", "two positive numbers [m]")
    lon0, lat0, lon1, lat1 = shapely.bounds(features[0][1])
    if not (lon1 > lon0 and lat1 > lat0):
        raise InputError(path, "feature 0", "an outline without width or height", "the floor's outline")
    frame = Frame("plan", (lat0, lon0), metres_per_degree=(size[0] / (lon1 - lon0), size[1] / (lat1 - lat0)))
    kinds = [OUTLINE, *(len(features) - 1) * ["shop"]]
    areas = [area_of(kind, f, frame) for kind, f in zip(kinds, features, strict=True)]
    return Drawing({folder.resolve().name: tuple(areas)}, frame, tuple(notes), tuple(repairs))


IPIN21_KINDS = {
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


def read_ipin21(path: Path, collection: dict[str, Any], features: list[Feature], notes: list[str]) -> Drawing:
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
        kind = IPIN21_KINDS.get(str(feature[2].get("Type")))
        if kind is None:
            notes.append(f"feature {feature[0]}: Type {str(feature[2].get('Type'))[:30]!r} was left out")
        else:
            areas.append(area_of(kind, feature, frame if in_degrees else None))
    return Drawing({path.stem.removeprefix("Plan"): tuple(areas)}, frame, tuple(notes))
