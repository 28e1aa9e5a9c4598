"""Floor plans from files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.areas import OUTLINE, SOLID, WALKABLE, Area
from pdr_graph.frames import Frame, enu
from pdr_graph.types import Array

MICROSOFT_MAP = "geojson_map.json"
MICROSOFT_INFO = "floor_info.json"
KINDS = (OUTLINE, *WALKABLE, *SOLID)
Drawing = tuple[str, tuple[Area, ...], Frame]  # label, areas and frame: the arguments of FloorPlan


def read(path: Path) -> Drawing:
    """A plan of either format, recognised by what is there."""
    if path.name in (MICROSOFT_MAP, MICROSOFT_INFO):
        path = path.parent
    if not path.exists():
        raise InputError(path, "", "no such file", "a floor plan")
    return microsoft_floor(path) if path.is_dir() else geojson(path)


def microsoft_floor(folder: Path) -> Drawing:
    """A floor folder of the Indoor Location Competition 2.0.

    Feature 0 is the outline, every other feature something that nobody walks through: walkable is the outline minus
    all others. The metric frame stretches the outline's bounding box, in degrees, to ``map_info``'s width and height:
    x = (lon − lon0)/(lon1 − lon0)·width, y likewise.
    """
    collection = _json(folder / MICROSOFT_MAP)
    info = _json(folder / MICROSOFT_INFO).get("map_info")
    size = [info.get("width"), info.get("height")] if isinstance(info, dict) else [None]
    if not all(isinstance(s, int | float) and np.isfinite(s) and s > 0 for s in size):
        raise InputError(folder / MICROSOFT_INFO, "map_info", f"width and height {size}", "two positive numbers [m]")
    polygons = [(p, props) for p, props in _polygons(folder / MICROSOFT_MAP, collection)]
    lon0, lat0, lon1, lat1 = shapely.bounds(polygons[0][0])
    if not (lon1 > lon0 and lat1 > lat0):
        raise InputError(
            folder / MICROSOFT_MAP, "feature 0", "an outline without width or height", "the floor's outline"
        )
    frame = Frame("plan", (lat0, lon0), metres_per_degree=(size[0] / (lon1 - lon0), size[1] / (lat1 - lat0)))
    areas = tuple(
        Area("shop" if n else OUTLINE, str(properties.get("name") or ""), _project(polygon, frame))
        for n, (polygon, properties) in enumerate(polygons)
    )
    return folder.resolve().name, areas, frame


def geojson(path: Path) -> Drawing:
    """Our own format: an RFC 7946 FeatureCollection of polygons with ``kind`` and ``name`` (``docs/formats.md``).

    The frame is ENU about the member ``pdr_graph.origin`` ([longitude, latitude]), else about the centre of the
    bounding box.
    """
    collection = _json(path)
    polygons = list(_polygons(path, collection))
    for n, (_, properties) in enumerate(polygons):
        if properties.get("kind") not in KINDS:
            found = f"kind {properties.get('kind')!r}"
            raise InputError(path, f"feature {n}", found, "one of " + ", ".join(KINDS))
    own = collection.get("pdr_graph")
    own = own if isinstance(own, dict) else {}
    west, south, east, north = shapely.total_bounds([p for p, _ in polygons])
    origin = own.get("origin", [(west + east) / 2, (south + north) / 2])
    if not _is_place(origin):
        raise InputError(path, "pdr_graph.origin", repr(origin)[:40], "[longitude, latitude] in degrees")
    frame = enu(origin[1], origin[0])
    areas = tuple(Area(q["kind"], str(q.get("name") or ""), _project(p, frame)) for p, q in polygons)
    return str(own.get("floor", "")), areas, frame


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, RecursionError, json.JSONDecodeError) as error:
        raise InputError(path, "", str(error), "a JSON file") from None
    if not isinstance(value, dict):
        raise InputError(path, "", f"a JSON {type(value).__name__}", "a JSON object")
    return value


def _polygons(path: Path, collection: dict[str, Any]) -> list[tuple[shapely.Geometry, dict[str, Any]]]:
    """Polygons [deg] and their properties; features with null geometry are left out, as RFC 7946 allows them."""
    features = collection.get("features")
    if collection.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise InputError(path, "", f"type {str(collection.get('type'))[:40]!r}", "a GeoJSON FeatureCollection")
    polygons = []
    for n, feature in enumerate(features):
        try:
            geometry, properties = feature["geometry"], dict(feature.get("properties") or {})
            shape = shapely.Polygon() if geometry is None else shapely.from_geojson(json.dumps(geometry))
        except (KeyError, TypeError, AttributeError, ValueError, shapely.errors.GEOSException) as error:
            found = f"{type(error).__name__} {str(error)[:80]}"
            raise InputError(path, f"feature {n}", found, "a GeoJSON geometry") from None
        if shapely.is_empty(shape) or shapely.get_dimensions(shape) != 2:
            continue
        corners = shapely.get_coordinates(shape)
        if not (np.abs(corners) <= (180, 90)).all():
            found = f"coordinates up to {np.abs(corners).max():.6g}"
            raise InputError(path, f"feature {n}", found, "longitudes and latitudes in degrees, as RFC 7946 has them")
        polygons.append((shapely.make_valid(shape), properties))
    if not polygons:
        raise InputError(path, "", f"{len(features)} features, none a polygon", "at least one polygon")
    return polygons


def _is_place(value: object) -> bool:
    """True for [longitude, latitude]."""
    numbers = isinstance(value, list) and len(value) == 2 and all(type(v) in (int, float) for v in value)
    return numbers and abs(value[0]) <= 180 and abs(value[1]) <= 90  # type: ignore[index]


def _project(polygon: shapely.Geometry, frame: Frame) -> shapely.Geometry:
    def transform(lonlat: Array) -> Array:
        return frame.from_lonlat(lonlat)

    return shapely.transform(polygon, transform)
