"""Floor folders of Microsoft's Indoor Location Competition 2.0."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import OUTLINE
from pdr_graph.floor.formats.drawing import Drawing
from pdr_graph.floor.formats.geojson import area_of, check_degrees, features_of, read_json
from pdr_graph.frames import Frame

FILES = ("geojson_map.json", "floor_info.json")  # areas; size of the floor


def root_of(path: Path) -> Path:
    """The folder of a floor from one of its files; any other path unchanged."""
    return path.parent if path.name in FILES else path


def recognizes(path: Path) -> bool:
    """True for a floor folder."""
    return (path / FILES[0]).is_file()


def read(folder: Path) -> Drawing:
    """Read a floor folder of the Indoor Location Competition 2.0.

    Feature 0 is the outline, all others are solid: the walkable area is the outline minus them. The metric frame scales
    the outline's bounding box from degrees to ``map_info``'s width and height: x = (lon − lon0)/(lon1 − lon0)·width, y
    likewise.
    """
    (path, about), notes, repairs = (folder / name for name in FILES), list[str](), list[str]()
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
