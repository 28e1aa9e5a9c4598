"""GeoJSON: the features of any collection, with repairs, and plans in our own format (``docs/formats.md``)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError
from pdr_graph.floor.cells import CELL_KINDS, Area
from pdr_graph.floor.formats.drawing import Drawing, check_crossings, check_file_size, floor_heights, frame_about
from pdr_graph.frames import Frame, enu
from pdr_graph.io.signatures import function, geojson_reader
from pdr_graph.whole_files import write_file

# Limits of an untrusted file
LARGEST_GEOJSON = 200_000_000  # [bytes]
MOST_FEATURES = 50_000  # of a collection: an airport has 20 000, and 30 000 rooms take 20 s
MOST_HOLES = 20_000  # of a feature; 10 000 take 4 s, and the time grows with their square
WIDEST_PLAN = 1.0  # [deg] a wider plan is in metres
Feature = tuple[int, shapely.Geometry, dict[str, Any]]  # its number in the file, its shape as written, its properties


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file. Raises InputError for other files."""
    try:
        check_file_size(path, LARGEST_GEOJSON)
        value = json.loads(path.read_text(encoding="utf-8-sig"))
    except InputError:
        raise
    except (OSError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InputError(path, "", f"no JSON ({error})", "a floor plan") from None
    if not isinstance(value, dict):
        raise InputError(path, "", f"a JSON {type(value).__name__}", "a JSON object")
    return value


def features_of(path: Path, collection: dict[str, Any], notes: list[str], repairs: list[str]) -> Iterator[Feature]:
    """All features of a GeoJSON collection that have a geometry; drawing errors are repaired.

    notes, repairs: a line is appended for features that were skipped (RFC 7946 allows a geometry of null) and for each
    repair. Raises InputError for other collections and geometries.
    """
    features = collection.get("features")
    if collection.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise InputError(path, "", f"type {str(collection.get('type'))[:40]!r}", "a GeoJSON FeatureCollection")
    if len(features) > MOST_FEATURES:
        raise InputError(path, "", f"{len(features)} features", f"at most {MOST_FEATURES}")
    without_geometry = []
    for n, feature in enumerate(features):
        try:
            geometry, properties = feature["geometry"], dict(feature.get("properties") or {})
            opened = _close(geometry)
            shape = shapely.Polygon() if geometry is None else shapely.from_geojson(json.dumps(geometry))
        except (KeyError, TypeError, AttributeError, ValueError, RecursionError, shapely.errors.GEOSException) as error:
            found = f"{type(error).__name__} {str(error)[:80]}"
            raise InputError(path, f"feature {n}", found, "a GeoJSON geometry") from None
        if shapely.is_empty(shape):
            without_geometry.append(n)
            continue
        if not (np.abs(shapely.get_coordinates(shape)) < 1e8).all():  # largest coordinate [m or deg]
            raise InputError(path, f"feature {n}", "coordinates that are not on Earth", "degrees or metres")
        holes = int(shapely.get_num_interior_rings(shapely.get_parts(shape)).sum())
        if holes > MOST_HOLES:
            raise InputError(path, f"feature {n}", f"{holes} holes", f"at most {MOST_HOLES}")
        name = f"feature {n} ({properties['name']})" if properties.get("name") else f"feature {n}"
        if not shapely.is_valid(shape):
            check_crossings(path, f"feature {n}", shape)
            place = re.search(r"\[(\S+) (\S+)\]", shapely.is_valid_reason(shape))  # Self-intersection[135.00001 35]
            at = f" at [{place[1]}, {place[2]}]" if place else ""
            repairs.append(f"{name}: its outline crosses itself{at}, and was repaired")
            shape = repaired(shape)
        if opened:
            found = f"the ring from {opened[0][:2]} does not end where it begins"
            repairs.append(f"{name}: {found}, and was closed")
        yield n, shapely.force_2d(shape), properties
    if without_geometry:
        first = f"the first: feature {without_geometry[0]}"
        notes.append(f"{len(without_geometry)} features without a geometry were left out ({first})")


def repaired(shape: shapely.Geometry) -> shapely.Geometry:
    """A valid shape of the same dimension: what collapses to a line or a point is left out, unless all does."""
    parts = shapely.get_parts(shapely.make_valid(shape))
    dimensions = shapely.get_dimensions(parts)
    return shapely.union_all(parts[dimensions == dimensions.max(initial=0)])


def check_degrees(path: Path, features: list[Feature]) -> None:
    """Raise InputError for coordinates that are not degrees, or a plan wider than 1°."""
    for n, shape, _ in features:
        corners = shapely.get_coordinates(shape)
        if not (np.abs(corners) <= (180, 90)).all():
            swapped = bool((np.abs(corners) <= (90, 180)).all())
            found = f"coordinates up to {np.abs(corners).max():.6g}{' (latitude before longitude?)' if swapped else ''}"
            raise InputError(path, f"feature {n}", found, "longitudes and latitudes in degrees (RFC 7946)")
    west, south, east, north = shapely.total_bounds([shape for _, shape, _ in features])
    if max(east - west, north - south) > WIDEST_PLAN:
        found = f"a plan of {east - west:.3g}° by {north - south:.3g}°"
        raise InputError(path, "", found, f"at most {WIDEST_PLAN:g}°: longitudes and latitudes in degrees, not metres")


def _close(geometry: Any) -> list[Any]:
    """Close the rings of a GeoJSON geometry in place: by RFC 7946 the last position is the first again.

    Returns the first position of each ring that was open.
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


def area_of(kind: str, feature: Feature, frame: Frame | None) -> Area:
    """The area of a feature [m]; without a frame its coordinates are in metres already."""
    _, shape, properties = feature
    on = properties.get("floor", properties.get("level"))
    labels = dict.fromkeys(str(each) for each in (on if isinstance(on, list) else [on]) if each not in (None, ""))
    metres = shape if frame is None else shapely.transform(shape, frame.from_lonlat)
    return Area(kind, str(properties.get("name") or ""), metres, properties, tuple(labels))


LOCAL_FRAME = "local"  # value of the member ``pdr_graph.frame``


def read_plan(path: Path) -> Drawing:
    """Read a GeoJSON plan of our own format, of OpenStreetMap's indoor tags, or of IPIN21Data."""
    notes, repairs = list[str](), list[str]()
    collection = read_json(path)
    features = list(features_of(path, collection, notes, repairs))
    if not features:
        raise InputError(path, "features", "none with a geometry", "rooms, corridors or walls")
    reader = geojson_reader([properties for _, _, properties in features])
    return replace(function(reader)(path, collection, features, notes), repairs=tuple(repairs))


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
