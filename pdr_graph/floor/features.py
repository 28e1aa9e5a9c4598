"""Features of a GeoJSON file: read, and mended where their drawing is wrong."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError

LARGEST_FILE = 200_000_000  # bytes
FARTHEST = 1e8  # [m] of any coordinate
WIDEST = 1.0  # [deg] of a plan; a larger one is in metres
Feature = tuple[int, shapely.Geometry, dict[str, Any]]  # its number in the file, its shape as written, its properties


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object."""
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(path, "", f"{path.stat().st_size} bytes", f"at most {LARGEST_FILE}")
        value = json.loads(path.read_text(encoding="utf-8-sig"))
    except InputError:
        raise
    except (OSError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InputError(path, "", f"no JSON ({error})", "a floor plan") from None
    if not isinstance(value, dict):
        raise InputError(path, "", f"a JSON {type(value).__name__}", "a JSON object")
    return value


def features_of(path: Path, collection: dict[str, Any], notes: list[str], mended: list[str]) -> Iterator[Feature]:
    """All features with a geometry; null ones are noted, as RFC 7946 allows them, and broken polygons mended.

    notes, mended: lines are added of what was left out, and of what was drawn wrongly and put right.
    """
    features = collection.get("features")
    if collection.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise InputError(path, "", f"type {str(collection.get('type'))[:40]!r}", "a GeoJSON FeatureCollection")
    nowhere = []
    for n, feature in enumerate(features):
        try:
            geometry, properties = feature["geometry"], dict(feature.get("properties") or {})
            opened = _close(geometry)
            shape = shapely.Polygon() if geometry is None else shapely.from_geojson(json.dumps(geometry))
        except (KeyError, TypeError, AttributeError, ValueError, RecursionError, shapely.errors.GEOSException) as error:
            found = f"{type(error).__name__} {str(error)[:80]}"
            raise InputError(path, f"feature {n}", found, "a GeoJSON geometry") from None
        if shapely.is_empty(shape):
            nowhere.append(n)
            continue
        if not (np.abs(shapely.get_coordinates(shape)) < FARTHEST).all():
            raise InputError(path, f"feature {n}", "a coordinate that is nowhere on Earth", "degrees, or metres")
        if not shapely.is_valid(shape):
            mended.append(f"{_named(n, properties)}: its outline crosses itself{_at(shape)}, and was mended")
            shape = shapely.make_valid(shape)
        if opened:
            found = f"the ring from {opened[0][:2]} does not end where it begins"
            mended.append(f"{_named(n, properties)}: {found}, and was closed")
        yield n, shapely.force_2d(shape), properties
    if nowhere:
        notes.append(f"{len(nowhere)} features without a geometry were left out (the first: feature {nowhere[0]})")


def check_degrees(path: Path, features: list[Feature]) -> None:
    """Refuse coordinates that are no degrees."""
    for n, shape, _ in features:
        corners = shapely.get_coordinates(shape)
        if not (np.abs(corners) <= (180, 90)).all():
            found = f"coordinates up to {np.abs(corners).max():.6g}"
            raise InputError(path, f"feature {n}", found, "longitudes and latitudes in degrees, as RFC 7946 has them")
    west, south, east, north = shapely.total_bounds([shape for _, shape, _ in features])
    if max(east - west, north - south) > WIDEST:
        found = f"a plan of {east - west:.3g}° by {north - south:.3g}°"
        raise InputError(path, "", found, f"at most {WIDEST:g}°: longitudes and latitudes in degrees, not metres")


def _close(geometry: Any) -> list[Any]:
    """Close the rings of a GeoJSON geometry in place: RFC 7946 wants the first position again as the last.

    Returns where the rings begin that were open.
    """
    match geometry:
        case {"type": "Polygon", "coordinates": [*rings]}:
            pass
        case {"type": "MultiPolygon", "coordinates": [*polygons]}:
            rings = [ring for polygon in polygons if isinstance(polygon, list) for ring in polygon]
        case _:
            return []
    open_ = [ring for ring in rings if isinstance(ring, list) and len(ring) > 2 and ring[0][:2] != ring[-1][:2]]
    for ring in open_:
        ring.append(ring[0])
    return [ring[0] for ring in open_]


def _named(n: int, properties: dict[str, Any]) -> str:
    """A feature by its number in the file and its name."""
    name = str(properties.get("name") or "")
    return f"feature {n} ({name})" if name else f"feature {n}"


def _at(shape: shapely.Geometry) -> str:
    """Where a polygon crosses itself, as shapely says it: ``Self-intersection[135.00001 35]``."""
    found = re.search(r"\[(\S+) (\S+)\]", shapely.is_valid_reason(shape))
    return f" at [{found[1]}, {found[2]}]" if found else ""
