"""Archives of the Indoor Mapping Data Format, IMDF 1.0.0 (OGC 20-094): a folder with one GeoJSON file per feature type.

All buildings of a venue are one plan: levels with the same ordinal are one floor. Levels join where stairs, escalators,
lifts or ramps of two levels overlap (`Building.connections`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pdr_graph.errors import InputError, count
from pdr_graph.floor.cells import CLOSED, DOOR, ENTRANCE, OPEN, OUTLINE, WALL, Area, overlap
from pdr_graph.floor.formats.drawing import DOOR_SLACK, STOREY, Drawing, frame_about, open_doorless_rooms
from pdr_graph.floor.formats.geojson import Feature, area_of, check_degrees, features_of, read_json
from pdr_graph.frames import Frame
from pdr_graph.io.signatures import IMDF_PARTS

MANIFEST, *LEAST_FILES = IMDF_PARTS[:3]
# Categories of units; all others are rooms
KIND_OF_UNIT = {
    **dict.fromkeys(("walkway", "walkway.island", "footbridge", "movingwalkway", "lobby", "platform"), "corridor"),
    **dict.fromkeys(("parking", "road", "unenclosedarea"), "corridor"),
    **dict.fromkeys(("stairs", "escalator"), "stairs"),
    "elevator": "lift",
    **dict.fromkeys(("brick", "column", "concrete", "drywall", "glass", "wood", "structure"), WALL),
    **dict.fromkeys(("nonpublic", "opentobelow", "swimmingpool", "vegetation"), WALL),
}
SLOPES = ("steps", "ramp")  # within a floor or between two: stairs where one on another floor overlaps


def read(folder: Path) -> Drawing:
    """Read an archive. Raises InputError for damaged files, or levels without an ordinal."""
    notes, repairs, language = list[str](), list[str](), "en"
    if (folder / MANIFEST).is_file():
        language = str(read_json(folder / MANIFEST).get("language", language))
    of_type = dict[str, list[Feature]]()
    for kind in ("level", "unit", "opening", "fixture", "kiosk"):
        path, own_notes, own_repairs = folder / f"{kind}.geojson", list[str](), list[str]()
        of_type[kind] = list(features_of(path, _collection(path, language), own_notes, own_repairs))
        notes += [f"{path.name}: {line}" for line in own_notes]
        repairs += [f"{path.name}: {line}" for line in own_repairs]
        if of_type[kind]:
            check_degrees(path, of_type[kind])
    levels = of_type["level"]
    if not levels or not of_type["unit"]:
        empty = folder / (LEAST_FILES[1] if levels else LEAST_FILES[0])
        raise InputError(empty, "features", "none with a geometry", "the levels and units of a building")
    frame = frame_about(shape for _, shape, _ in levels)
    ordinals = _ordinals(folder / LEAST_FILES[0], levels)
    areas = {ordinal: list[Area]() for ordinal in sorted(set(ordinals.values()))}
    for kind, features in of_type.items():
        _place(kind, features, frame, ordinals, areas, notes)
    _name_units(folder, language, areas)
    _mark_connections(folder, areas)
    labels = _labels(levels, ordinals)
    _add_corridors(areas, [area_of(OUTLINE, f, frame) for f in levels if not f[2].get("outdoor")], ordinals)
    floors = {labels[n]: _on_floor(here, labels[n], notes) for n, here in areas.items()}
    buildings = {str(b) for _, _, p in levels if isinstance(p.get("building_ids"), list) for b in p["building_ids"]}
    if len(buildings) > 1:
        notes.append(f"{len(buildings)} buildings: their levels of one ordinal are one floor")
    lowest = min(areas)
    heights = {labels[n]: STOREY * (n - lowest) for n in areas}
    return Drawing(floors, frame, tuple(notes), tuple(repairs), heights)


def _on_floor(areas: Sequence[Area], label: str, notes: list[str]) -> tuple[Area, ...]:
    """The areas of one floor with its label, its entrances, and an opening for rooms without a door.

    Openings between a unit where nobody walks and at most one other unit are left out.
    """
    outside = [shapely.boundary(area.shape) for area in areas if area.kind == OUTLINE]
    walkable, solid = (
        shapely.STRtree([area.shape for area in areas if area.kind in kinds]) for kinds in ((*OPEN, *CLOSED), (WALL,))
    )
    placed = list[Area]()
    for area in areas:
        properties = area.properties
        if area.kind == DOOR:
            beside = [tree.query(area.shape, predicate="dwithin", distance=DOOR_SLACK) for tree in (solid, walkable)]
            if len(beside[0]) and len(beside[1]) < 2:
                continue
            # an opening within the thickness of an outer wall, 0.5 m, of a level's outline leads outside
            if any(shapely.dwithin(ring, area.shape, 0.5) for ring in outside):
                properties = properties | {ENTRANCE: "yes"}
        placed.append(replace(area, floors=(label,), properties=properties))
    if shut := len(areas) - len(placed):
        notes.append(f"floor {label}: {count(shut, 'opening')} of units where nobody walks left out")
    return open_doorless_rooms(placed, label, notes)


def _collection(path: Path, language: str) -> dict[str, Any]:
    """The GeoJSON collection in a file, with identifiers and the texts of names in its properties; empty if missing.

    A name is a text or ``{"en": "Gate 1"}``, of which the archive's language is read, else the first.
    """
    if not path.is_file():
        return {"type": "FeatureCollection", "features": []}
    collection = read_json(path)
    features = collection.get("features")
    for feature in features if isinstance(features, list) else []:
        if isinstance(feature, dict) and isinstance(feature.get("properties"), dict):
            properties = feature["properties"]
            properties["id"] = str(feature.get("id", ""))
            for key in ("name", "short_name"):
                name = properties.get(key)
                if isinstance(name, dict):
                    name = name.get(language) or next(iter(name.values()), "")
                properties[key] = name if isinstance(name, str) else ""
    return collection


def _ordinals(path: Path, levels: Sequence[Feature]) -> dict[str, int]:
    """The ordinal of each level by its identifier."""
    ordinals = dict[str, int]()
    for n, _, properties in levels:
        ordinal = properties.get("ordinal")
        # no building has more than 200 floors above or below the ground
        if not isinstance(ordinal, int | float) or not abs(ordinal) <= 200 or ordinal != int(ordinal):
            found = f"ordinal {ordinal!r}"[:60]
            raise InputError(path, f"feature {n}", found, "a whole number, 0 for the ground floor")
        if not properties["id"] or properties["id"] in ordinals:
            raise InputError(path, f"feature {n}", f"id {properties['id'][:40]!r}", "an id of its own for each level")
        ordinals[properties["id"]] = int(ordinal)
    return ordinals


def _labels(levels: Sequence[Feature], ordinals: dict[str, int]) -> dict[int, str]:
    """The label of each ordinal: the short names of its levels; with the ordinal, where two floors had the same."""
    names: dict[int, Counter[str]] = {}
    for _, _, properties in levels:
        ordinal = ordinals[properties["id"]]
        text = properties["short_name"] or properties["name"] or str(ordinal)
        names.setdefault(ordinal, Counter())[text] += 1
    labels = {
        n: "/".join(name for name, _ in sorted(of.items(), key=lambda t: (-t[1], t[0]))) for n, of in names.items()
    }
    times = Counter(labels.values())
    return {n: label if times[label] == 1 else f"{label} ({n})" for n, label in labels.items()}


def _place(
    kind: str,
    features: Iterable[Feature],
    frame: Frame,
    ordinals: dict[str, int],
    areas: dict[int, list[Area]],
    notes: list[str],
) -> None:
    """Append the areas of all features of one type to their floors."""
    kinds = {"level": OUTLINE, "opening": DOOR, "fixture": WALL, "kiosk": "shop"}
    homeless, hidden = list[int](), Counter[str]()
    for feature in features:
        n, shape, properties = feature
        category = str(properties.get("category") or "")
        ordinal = ordinals.get(str(properties["id"] if kind == "level" else properties.get("level_id")))
        if ordinal is None:
            homeless.append(n)
            continue
        flat = shapely.get_dimensions(shape) < 2
        if flat and kind != "opening":
            notes.append(f"{kind}.geojson: feature {n} is no polygon and was left out")
            continue
        becomes = kinds.get(kind) or KIND_OF_UNIT.get(category, "corridor" if category in SLOPES else "room")
        hidden[category] += becomes == WALL and category in ("nonpublic", "opentobelow")
        areas[ordinal].append(area_of(becomes, feature, frame))
    if homeless:
        first = f"the first: feature {homeless[0]}"
        notes.append(f"{kind}.geojson: {len(homeless)} features of no known level were left out ({first})")
    for category, times in hidden.items():
        if times:
            notes.append(f"{count(times, 'unit')} of category {category}: nobody walks there")


def _name_units(folder: Path, language: str, areas: dict[int, list[Area]]) -> None:
    """Name units and kiosks without a name by the occupant whose anchor lies in them."""
    of_anchor = {str(p.get("anchor_id")): p.get("name") for p in _properties(folder / "occupant.geojson", language)}
    names = dict[str, str]()
    for p in _properties(folder / "anchor.geojson", language):
        names[str(p.get("unit_id"))] = of_anchor.get(str(p.get("id"))) or ""
    for here in areas.values():
        for n, area in enumerate(here):
            if not area.name and (name := names.get(str(area.properties["id"]))):
                here[n] = replace(area, name=name)


def _properties(path: Path, language: str) -> list[dict[str, Any]]:
    """The properties of the features in a file, also of those without a geometry."""
    features = _collection(path, language).get("features")
    found = [f.get("properties") for f in features if isinstance(f, dict)] if isinstance(features, list) else []
    return [properties for properties in found if isinstance(properties, dict)]


def _mark_connections(folder: Path, areas: dict[int, list[Area]]) -> None:
    """Change units to stairs and lifts by their amenities, and steps and ramps that overlap those of another level."""
    kind_of_amenity = {"stairs": "stairs", "escalator": "stairs", "steps": "slope", "ramp": "slope", "elevator": "lift"}
    marked = dict[str, str]()
    for p in _properties(folder / "amenity.geojson", "en"):
        kind, units = kind_of_amenity.get(str(p.get("category"))), p.get("unit_ids")
        if kind is not None and isinstance(units, list):
            marked |= {str(unit): kind for unit in units}
    slopes = list[tuple[int, int]]()
    for ordinal, here in areas.items():
        for n, area in enumerate(here):
            kind = marked.get(str(area.properties["id"]), "slope" if area.properties.get("category") in SLOPES else "")
            if area.kind not in ("corridor", "room"):
                continue
            if kind == "slope":
                slopes.append((ordinal, n))
            elif kind:
                here[n] = replace(area, kind=kind)
    shapes = [areas[ordinal][n].shape for ordinal, n in slopes]
    for (ordinal, n), shape in zip(slopes, shapes, strict=True):
        others = [s for (level, _), s in zip(slopes, shapes, strict=True) if level != ordinal]
        if any(overlap(shape, other) for other in others):
            areas[ordinal][n] = replace(areas[ordinal][n], kind="stairs")


def _add_corridors(areas: dict[int, list[Area]], levels: Iterable[Area], ordinals: dict[str, int]) -> None:
    """Add as corridors what a level has outside all units: archives often draw rooms alone."""
    for level in levels:
        here = areas[ordinals[level.properties["id"]]]
        drawn = shapely.union_all([area.shape for area in here if area.kind != OUTLINE and area.is_polygon])
        # areas of a level outside all its units are corridors from 0.8 m on; walls are narrower
        half = 0.8 / 2
        rest = shapely.buffer(shapely.difference(level.shape, drawn), -half, join_style="mitre")
        for part in shapely.get_parts(rest):
            wide = shapely.buffer(part, half + 0.05, join_style="mitre")  # + 0.05 m: it touches what is around it
            free = shapely.difference(shapely.intersection(wide, level.shape), drawn)
            whole = [p for p in np.atleast_1d(shapely.get_parts(free)) if shapely.intersects(p, part)]
            here += [Area("corridor", "", shape) for shape in whole]
