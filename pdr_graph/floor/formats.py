"""Floor plans from files: our GeoJSON, Microsoft floor folders and IPIN21 polygons."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.areas import KINDS, OUTLINE, Area
from pdr_graph.floor.features import Feature, check_degrees, features_of, read_json
from pdr_graph.floor.storeys import heights_of
from pdr_graph.frames import Frame, enu, projected
from pdr_graph.types import Array

MICROSOFT_MAP = "geojson_map.json"
MICROSOFT_INFO = "floor_info.json"
IPIN21_EPSG = 32632
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
    "Wa": "wall",  # a wall whose name was cut short
}


@dataclass(frozen=True)
class Drawing:
    """A file's floors by label, lowest first, all in one frame.

    notes: what was left out of the file or taken for something, mended: what was drawn wrongly and put right, one
    line each; heights: of the floors [m] by label, none where a plan can have only one.
    """

    floors: dict[str, tuple[Area, ...]]
    frame: Frame
    notes: tuple[str, ...] = ()
    mended: tuple[str, ...] = ()
    heights: dict[str, float] = field(default_factory=dict)


def read(path: Path) -> Drawing:
    """A plan of any format, recognised by what is there."""
    if path.name in (MICROSOFT_MAP, MICROSOFT_INFO):
        path = path.parent
    if not path.exists():
        raise InputError(path, "", "no such file", "a floor plan")
    if path.is_dir():
        if not (path / MICROSOFT_MAP).is_file():
            raise InputError(path, "", f"a folder without {MICROSOFT_MAP}", "a floor plan's file, or its floor folder")
        return microsoft_floor(path)
    collection, notes, mended = read_json(path), list[str](), list[str]()
    features = list(features_of(path, collection, notes, mended))
    is_ipin21 = any("Type" in properties and "kind" not in properties for _, _, properties in features)
    return replace((ipin21 if is_ipin21 else own)(path, collection, features, notes), mended=tuple(mended))


def microsoft_floor(folder: Path) -> Drawing:
    """A floor folder of the Indoor Location Competition 2.0.

    Feature 0 is the outline, every other feature something that nobody walks through: walkable is the outline minus
    all others. The metric frame stretches the outline's bounding box, in degrees, to ``map_info``'s width and height:
    x = (lon − lon0)/(lon1 − lon0)·width, y likewise.
    """
    path, notes, mended = folder / MICROSOFT_MAP, list[str](), list[str]()
    features = [f for f in features_of(path, read_json(path), notes, mended) if shapely.get_dimensions(f[1]) == 2]
    if not features:
        raise InputError(path, "", "no polygon", "the floor's outline")
    check_degrees(path, features)
    info = read_json(folder / MICROSOFT_INFO).get("map_info")
    size = [info.get("width"), info.get("height")] if isinstance(info, dict) else [None]
    if not all(isinstance(s, int | float) and np.isfinite(s) and s > 0 for s in size):
        raise InputError(folder / MICROSOFT_INFO, "map_info", f"width and height {size}", "two positive numbers [m]")
    lon0, lat0, lon1, lat1 = shapely.bounds(features[0][1])
    if not (lon1 > lon0 and lat1 > lat0):
        raise InputError(path, "feature 0", "an outline without width or height", "the floor's outline")
    frame = Frame("plan", (lat0, lon0), metres_per_degree=(size[0] / (lon1 - lon0), size[1] / (lat1 - lat0)))
    kinds = [OUTLINE, *(len(features) - 1) * ["shop"]]
    areas = [_area(kind, f, frame) for kind, f in zip(kinds, features, strict=True)]
    return Drawing({folder.resolve().name: tuple(areas)}, frame, tuple(notes), tuple(mended))


def own(path: Path, collection: dict[str, Any], features: list[Feature], notes: list[str]) -> Drawing:
    """Our own format: an RFC 7946 FeatureCollection whose features have ``kind`` and ``name`` (``docs/formats.md``).

    A feature's ``floor`` says which floor it is on, or a list of them; without it, it is on all. The frame is ENU about
    the member ``pdr_graph.origin`` ([longitude, latitude]), else about the centre of the bounding box;
    ``pdr_graph.heights`` says how high the floors are.
    """
    for n, _, properties in features:
        if properties.get("kind") not in KINDS:
            found = f"kind {properties.get('kind')!r}"[:80]
            raise InputError(path, f"feature {n}", found, "one of " + ", ".join(KINDS))
    check_degrees(path, features)
    about = collection.get("pdr_graph")
    about = about if isinstance(about, dict) else {}
    if not features:
        raise InputError(path, "", "no feature with a geometry", "at least one polygon")
    west, south, east, north = shapely.total_bounds([shape for _, shape, _ in features]).tolist()
    origin = about.get("origin", [(west + east) / 2, (south + north) / 2])
    if not _is_place(origin):
        raise InputError(path, "pdr_graph.origin", repr(origin)[:40], "[longitude, latitude] in degrees")
    frame = enu(origin[1], origin[0])
    areas = [_area(f[2]["kind"], f, frame) for f in features]
    labels = {label for area in areas for label in area.floors} or {str(about.get("floor", ""))}
    heights = heights_of(path, labels, about.get("heights"))
    floors = {label: tuple(a for a in areas if not a.floors or label in a.floors) for label in heights}
    return Drawing(floors, frame, tuple(notes), heights=heights)


def ipin21(path: Path, collection: dict[str, Any], features: list[Feature], notes: list[str]) -> Drawing:
    """Polygons of IPIN21Data with the property ``Type``, in metres of UTM zone 32N, whatever their label says."""
    corners = shapely.get_coordinates([shape for _, shape, _ in features])
    in_degrees = bool((np.abs(corners) <= (180, 90)).all())
    stated = re.findall(r"\d{4,5}|CRS84", json.dumps(collection.get("crs")))
    expected = ["4326", "CRS84"] if in_degrees else [str(IPIN21_EPSG)]
    if stated and stated[-1] not in expected:
        found = "degrees" if in_degrees else f"metres, taken for EPSG:{IPIN21_EPSG}"
        notes.append(f"the file says CRS {stated[-1]}, its coordinates are {found}")
    frame = projected(IPIN21_EPSG)
    areas: list[Area] = []
    for feature in features:
        kind = IPIN21_KINDS.get(str(feature[2].get("Type")))
        if kind is None:
            notes.append(f"feature {feature[0]}: Type {str(feature[2].get('Type'))[:30]!r} was left out")
        else:
            areas.append(_area(kind, feature, frame if in_degrees else None))
    return Drawing({path.stem.removeprefix("Plan"): tuple(areas)}, frame, tuple(notes))


def _labels(properties: dict[str, Any]) -> tuple[str, ...]:
    """The floors that a feature is on."""
    on = properties.get("floor", properties.get("level"))
    labels = (str(label) for label in (on if isinstance(on, list) else [on]) if label not in (None, ""))
    return tuple(dict.fromkeys(labels))


def _is_place(value: object) -> bool:
    """True for [longitude, latitude]."""
    numbers = isinstance(value, list) and len(value) == 2 and all(type(v) in (int, float) for v in value)
    return numbers and abs(value[0]) <= 180 and abs(value[1]) <= 90  # type: ignore[index]


def _area(kind: str, feature: Feature, frame: Frame | None) -> Area:
    """A feature in metres; one without a frame is already."""
    _, shape, properties = feature

    def transform(lonlat: Array) -> Array:
        return lonlat if frame is None else frame.from_lonlat(lonlat)

    name = str(properties.get("name") or "")
    return Area(kind, name, shapely.transform(shape, transform), properties, _labels(properties))
