"""Floor plans from files: our GeoJSON, Microsoft floor folders and IPIN21 polygons; routes and floor heights."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.columns import OneLineRepr
from pdr_graph.errors import InputError, count
from pdr_graph.floor.cells import KINDS, LINK, OUTLINE, Area
from pdr_graph.frames import Frame, enu, projected
from pdr_graph.storage import fingerprint
from pdr_graph.types import Array

# Limits of an untrusted file
LARGEST_FILE = 200_000_000  # [bytes]
LARGEST_COORDINATE = 1e8  # [m or deg]
WIDEST_PLAN = 1.0  # [deg] a wider plan is in metres
Feature = tuple[int, shapely.Geometry, dict[str, Any]]  # its number in the file, its shape as written, its properties


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file. Raises InputError for other files."""
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(path, "", f"{path.stat().st_size} bytes", f"at most {LARGEST_FILE} bytes")
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
        if not (np.abs(shapely.get_coordinates(shape)) < LARGEST_COORDINATE).all():
            raise InputError(path, f"feature {n}", "coordinates that are not on Earth", "degrees or metres")
        if not shapely.is_valid(shape):
            repairs.append(f"{_name_of(n, properties)}: its outline crosses itself{_crossing(shape)}, and was repaired")
            shape = shapely.make_valid(shape)
        if opened:
            found = f"the ring from {opened[0][:2]} does not end where it begins"
            repairs.append(f"{_name_of(n, properties)}: {found}, and was closed")
        yield n, shapely.force_2d(shape), properties
    if without_geometry:
        first = f"the first: feature {without_geometry[0]}"
        notes.append(f"{len(without_geometry)} features without a geometry were left out ({first})")


def check_degrees(path: Path, features: list[Feature]) -> None:
    """Raise InputError for coordinates that are not degrees, or a plan wider than 1°."""
    for n, shape, _ in features:
        corners = shapely.get_coordinates(shape)
        if not (np.abs(corners) <= (180, 90)).all():
            found = f"coordinates up to {np.abs(corners).max():.6g}"
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


def _name_of(n: int, properties: dict[str, Any]) -> str:
    """The number of a feature in the file, and its name."""
    name = str(properties.get("name") or "")
    return f"feature {n} ({name})" if name else f"feature {n}"


def _crossing(shape: shapely.Geometry) -> str:
    """Where a polygon crosses itself, from shapely's reason: ``Self-intersection[135.00001 35]``."""
    found = re.search(r"\[(\S+) (\S+)\]", shapely.is_valid_reason(shape))
    return f" at [{found[1]}, {found[2]}]" if found else ""


STOREY = 3.8  # [m] height of a storey if the plan has no heights: offices and shops have 3.5 to 4.5
HIGHEST_FLOOR = 1000.0  # [m] above or below zero: no building is higher
GROUND = ("G", "GF", "EG")  # labels of the ground floor
BELOW = ("B", "BF", "UG")  # letters before or after the number of a floor below the ground: B1, B1F, 2UG


def floor_heights(path: Path, labels: Iterable[str], stated: Any = None) -> dict[str, float]:
    """Height of each floor [m] by its label, lowest first.

    stated: the plan's heights by label; None: a storey each, in the order of the labels. Raises InputError for the
    height of an unknown floor, a floor without a height, or a height that is not a number.
    """
    ordered = sorted(labels, key=_storey)
    if stated is None:
        return {label: STOREY * n for n, label in enumerate(ordered)}
    place, floors = "pdr_graph.heights", ", ".join(ordered)
    if not isinstance(stated, dict):
        raise InputError(path, place, repr(stated), 'a height for each floor, {"1": 0.0, "2": 4.0}')
    if unknown := sorted(set(stated) - set(ordered)):
        raise InputError(path, place, f"a floor {unknown[0]!r}", f"the labels of floors: {floors}")
    for label in ordered:
        if label not in stated:
            raise InputError(path, place, f"no height of floor {label!r}", f"a height for each of {floors}")
        if type(stated[label]) not in (int, float) or not abs(stated[label]) < HIGHEST_FLOOR:
            raise InputError(path, f"{place}.{label}", repr(stated[label]), f"metres, less than {HIGHEST_FLOOR:g}")
    return {label: float(stated[label]) for label in sorted(ordered, key=lambda label: stated[label])}


def _storey(label: str) -> tuple[float, str]:
    """Sort key of a floor: its number (-2, B1, 0, EG, 1, F2, 3F, 4OG); floors without a number are last, by name."""
    found = re.fullmatch(r"([A-Z]*) ?(-?\d{1,9}(?:\.\d{1,9})?) ?([A-Z]*)", label.strip().upper())
    if found is None:
        return (0.0 if label.strip().upper() in GROUND else np.inf), label
    before, number, after = found.groups()
    return (-float(number) if before in BELOW or after in BELOW else float(number)), label


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
    "Wa": "wall",  # truncated in the files
}


@dataclass(frozen=True)
class Drawing(OneLineRepr):
    """The floors of a file by label, lowest first, in one frame.

    notes: features that were skipped or reinterpreted; repairs: drawing errors that were repaired, one line each;
    heights: of the floors by label [m], empty if the format has one floor per file.
    """

    floors: dict[str, tuple[Area, ...]]
    frame: Frame
    notes: tuple[str, ...] = ()
    repairs: tuple[str, ...] = ()
    heights: dict[str, float] = field(default_factory=dict)

    def _summary(self) -> list[str]:
        return [f"{label!r}: {count(len(areas), 'area')}" for label, areas in self.floors.items()]


def root_of(path: Path) -> Path:
    """The folder of a Microsoft floor from one of its files; any other path unchanged."""
    return path.parent if path.name in (MICROSOFT_MAP, MICROSOFT_INFO) else path


def files_of(path: Path) -> tuple[Path, ...]:
    """The files that `read` reads: the plan, or both files of a Microsoft floor folder."""
    root = root_of(path)
    return (root / MICROSOFT_MAP, root / MICROSOFT_INFO) if root.is_dir() else (root,)


def plan_fingerprint(path: Path) -> str:
    """The name of a plan and a hash of its files."""
    return fingerprint(root_of(path), files_of(path))


def read(path: Path) -> Drawing:
    """Read a plan; its format is recognised by content. Raises InputError for other files."""
    path = root_of(path)
    if not path.exists():
        raise InputError(path, "", "no such file", "a floor plan")
    if path.is_dir():
        if not (path / MICROSOFT_MAP).is_file():
            raise InputError(path, "", f"a folder without {MICROSOFT_MAP}", "a floor plan's file or floor folder")
        return read_microsoft(path)
    collection, notes, repairs = read_json(path), list[str](), list[str]()
    features = list(features_of(path, collection, notes, repairs))
    if not features:
        raise InputError(path, "features", "none with a geometry", "rooms, corridors or walls")
    is_ipin21 = any("Type" in properties and "kind" not in properties for _, _, properties in features)
    read_format = read_ipin21 if is_ipin21 else read_own_format
    return replace(read_format(path, collection, features, notes), repairs=tuple(repairs))


def read_microsoft(folder: Path) -> Drawing:
    """Read a floor folder of the Indoor Location Competition 2.0.

    Feature 0 is the outline, all others are solid: the walkable area is the outline minus them. The metric frame scales
    the outline's bounding box from degrees to ``map_info``'s width and height: x = (lon − lon0)/(lon1 − lon0)·width, y
    likewise.
    """
    (path, about), notes, repairs = files_of(folder), list[str](), list[str]()
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
    areas = [_area(kind, f, frame) for kind, f in zip(kinds, features, strict=True)]
    return Drawing({folder.resolve().name: tuple(areas)}, frame, tuple(notes), tuple(repairs))


def read_own_format(path: Path, collection: dict[str, Any], features: list[Feature], notes: list[str]) -> Drawing:
    """Read our own format: an RFC 7946 FeatureCollection of features with ``kind`` and ``name`` (``docs/formats.md``).

    A feature's ``floor`` is the label of its floor or a list of labels; without it, the feature is on all floors. The
    frame is ENU about the member ``pdr_graph.origin`` ([longitude, latitude]), by default about the centre of the
    bounding box; ``pdr_graph.heights`` has the heights of the floors.
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
    heights = floor_heights(path, labels, about.get("heights"))
    floors = {label: tuple(a for a in areas if not a.floors or label in a.floors) for label in heights}
    return Drawing(floors, frame, tuple(notes), heights=heights)


def read_ipin21(path: Path, collection: dict[str, Any], features: list[Feature], notes: list[str]) -> Drawing:
    """Read polygons of IPIN21Data: property ``Type``, in metres of UTM zone 32N whatever CRS the file states."""
    corners = shapely.get_coordinates([shape for _, shape, _ in features])
    in_degrees = bool((np.abs(corners) <= (180, 90)).all())
    stated = re.findall(r"\d{4,5}|CRS84", json.dumps(collection.get("crs")))
    expected = ["4326", "CRS84"] if in_degrees else [str(IPIN21_EPSG)]
    if stated and stated[-1] not in expected:
        found = "degrees" if in_degrees else f"metres, read as EPSG:{IPIN21_EPSG}"
        notes.append(f"the file states CRS {stated[-1]}, but its coordinates are {found}")
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
    """The labels of the floors that a feature is on."""
    on = properties.get("floor", properties.get("level"))
    labels = (str(label) for label in (on if isinstance(on, list) else [on]) if label not in (None, ""))
    return tuple(dict.fromkeys(labels))


def _is_place(value: object) -> bool:
    """True for [longitude, latitude]."""
    numbers = isinstance(value, list) and len(value) == 2 and all(type(v) in (int, float) for v in value)
    return numbers and abs(value[0]) <= 180 and abs(value[1]) <= 90  # type: ignore[index]


def _area(kind: str, feature: Feature, frame: Frame | None) -> Area:
    """The area of a feature [m]; without a frame its coordinates are in metres already."""
    _, shape, properties = feature

    def transform(lonlat: Array) -> Array:
        return lonlat if frame is None else frame.from_lonlat(lonlat)

    name = str(properties.get("name") or "")
    return Area(kind, name, shapely.transform(shape, transform), properties, _labels(properties))


def read_route(path: str | Path) -> Array:
    """Corners ``(m, 2)`` [m] of the only ``link`` in a plan of our own format.

    Raises InputError unless there is exactly one.
    """
    drawing = read(Path(path))
    lines = {area.shape for areas in drawing.floors.values() for area in areas if area.kind == LINK}
    if len(lines) != 1:
        raise InputError(path, "", f"{len(lines)} features of kind 'link'", "one: the line that was walked")
    corners = shapely.get_coordinates(lines.pop())
    apart = np.hypot(*np.diff(corners, axis=0).T) > 0
    return corners[np.append(True, apart)]
