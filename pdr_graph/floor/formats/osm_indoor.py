"""OpenStreetMap: its XML (``.osm``, of JOSM or the API) as features, and indoor tags as floors.

Indoor tags are those of Simple Indoor Tagging, in an ``.osm`` file or as GeoJSON of osmtogeojson or overpass turbo. A
door that is a node opens the walls of the rooms and corridors on whose outline it lies. XML is untrusted: document
types, entities and network access are refused.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError, count
from pdr_graph.floor.cells import CLOSED, CONNECTING, DOOR, OPEN, OUTLINE, SOLID, WALL, Area
from pdr_graph.floor.formats.drawing import STOREY, Drawing, check_file_size, frame_about, open_doorless_rooms
from pdr_graph.floor.formats.geojson import Feature, check_degrees, repaired
from pdr_graph.io.signatures import tags_of
from pdr_graph.io.validation import float_of
from pdr_graph.io.xml_elements import parsed_xml
from pdr_graph.priors import PLANS
from pdr_graph.types import Array

KIND_OF_INDOOR = {"room": "room", "corridor": "corridor", "area": "corridor", "level": OUTLINE, "wall": WALL}
KIND_OF_INDOOR |= {"column": WALL, "void": WALL, "door": DOOR}
MOST_LEVEL_AREAS = 100_000  # features times the levels on which each is
LEVEL_NUMBER = r"[+-]?\d{1,4}(?:\.\d{1,3})?"


def read_xml(path: Path) -> Drawing:
    """Read an ``.osm`` file. Raises InputError for broken or hostile XML, or if nothing in it is a room."""
    notes, repairs = list[str](), list[str]()
    features = osm_features(path, notes, repairs)
    return replace(read(path, {}, features, notes), repairs=tuple(repairs))


def read(path: Path, collection: dict[str, Any], features: Sequence[Feature], notes: list[str]) -> Drawing:
    """Read features with longitudes and latitudes [deg]. Raises InputError if none is a room, corridor or area."""
    tagged = [(shape, tags_of(properties)) for _, shape, properties in features]
    indoor = [(shape, tags, kind) for shape, tags in tagged if (kind := _kind(shape, tags))]
    if len(indoor) < len(tagged):
        notes.append(f"{count(len(tagged) - len(indoor), 'feature')} without indoor tags were left out")
    if not any(kind in (*OPEN, *CLOSED) for _, _, kind in indoor):
        raise InputError(path, "", "no room, corridor or area", "indoor=room, corridor or area on closed ways")
    check_degrees(path, [(n, shape, tags) for n, (shape, tags, _) in enumerate(indoor)])
    frame = frame_about(shape for shape, _, _ in indoor)
    shapes = [shapely.transform(shape, frame.from_lonlat) for shape, _, _ in indoor]
    missing = set[float]()  # levels that buildings leave out in their count, as hotels leave out 13
    for _, tags in tagged:
        with suppress(ValueError):
            missing.update(levels_of(tags.get("non_existent_levels")))
    areas = _areas(path, indoor, shapes, missing, notes)
    levels = sorted({float(label) for area in areas if area.kind in (*OPEN, *CLOSED, OUTLINE) for label in area.floors})
    floors = {_label(level): _floor(areas, _label(level), notes) for level in levels}
    below = {level: sum(levels[0] < other < level for other in missing) for level in levels}
    heights = {_label(level): STOREY * (level - levels[0] - below[level]) for level in levels}
    return Drawing(floors, frame, tuple(notes), heights=heights)


def _kind(shape: shapely.Geometry, tags: dict[str, Any]) -> str:
    """The kind of an element by its tags; empty if it is not part of the plan."""
    dimensions, indoor, highway = int(shapely.get_dimensions(shape)), str(tags.get("indoor", "")), tags.get("highway")
    is_door = tags.get("door") is not None or tags.get("entrance") is not None
    if dimensions == 0:
        return DOOR if is_door else "lift" if highway == "elevator" else ""
    if highway == "steps" and ("level" in tags or indoor):
        return "stairs"
    if dimensions == 2 and indoor:
        if tags.get("stairs") == "yes" or "conveying" in tags or "stairs" in (tags.get("room"), tags.get("area")):
            return "stairs"
        if tags.get("elevator") == "yes" or tags.get("room") == "elevator":
            return "lift"
    if dimensions == 2 and highway == "elevator" and ("level" in tags or indoor):
        return "lift"
    if dimensions == 1 and is_door and indoor in ("", "door"):
        return DOOR if "level" in tags else ""
    return KIND_OF_INDOOR.get(indoor, "")


def levels_of(text: Any, missing: Collection[float] = ()) -> tuple[float, ...]:
    """The levels in a value of ``level`` or ``repeat_on``: ``0``, ``-1;0``, ``0-3``, ``-2--1``, ``0.5``.

    missing: levels that do not exist, left out of ranges. Raises ValueError for other texts.
    """
    levels = list[float]()
    for part in re.split(r"[;,]", str(text)):
        found = re.fullmatch(rf"\s*({LEVEL_NUMBER})\s*(?:-\s*({LEVEL_NUMBER})\s*)?", part)
        if found is None:
            raise ValueError(f"level {str(text)[:40]!r}")
        first = float(found[1])
        last = first if found[2] is None else float(found[2])
        # no building has more than 200 levels above or below the ground
        if max(abs(first), abs(last)) > 200.0 or last < first:
            raise ValueError(f"level {str(text)[:40]!r}")
        between = np.arange(first, last + 0.5).tolist() if last > first else [first]
        levels += [level for level in between if level not in missing or len(between) == 1]
    return tuple(dict.fromkeys(level + 0.0 for level in levels))


def _label(level: float) -> str:
    return f"{level:g}"


def _areas(
    path: Path,
    indoor: Sequence[tuple[shapely.Geometry, dict[str, Any], str]],
    shapes: Sequence[shapely.Geometry],
    missing: Collection[float],
    notes: list[str],
) -> list[Area]:
    """The areas of all floors with the labels of their levels; doors and walls are lines or polygons."""
    areas, without, flat, unreadable = list[Area](), 0, 0, Counter[str]()
    for (_, tags, kind), shape in zip(indoor, shapes, strict=True):
        try:
            levels = _levels(tags, kind, missing)
        except ValueError as error:
            unreadable[str(error)] += 1
            continue
        if not levels and shapely.get_dimensions(shape) > 0:
            levels, without = (0.0,), without + 1
        if kind in (*OPEN, *CLOSED, OUTLINE) and kind not in CONNECTING:
            if shapely.get_dimensions(shape) == 1 and shapely.get_num_coordinates(shape) > 2:  # a way left open
                shape = repaired(shapely.Polygon(shapely.get_coordinates(shape)))
            if kind != OUTLINE and shapely.get_dimensions(shape) < 2:
                flat += 1
                continue
        name = str(tags.get("name") or tags.get("ref") or "")
        areas.append(Area(kind, name, shape, dict(tags), tuple(map(_label, levels))))
    if flat:
        notes.append(f"{count(flat, 'room')} without an area left out")
    if without:
        notes.append(f"{count(without, 'feature')} without a level: taken as level 0")
    notes += [f"{count(times, 'feature')} with an unreadable {text} left out" for text, times in unreadable.items()]
    if sum(len(area.floors) for area in areas) > MOST_LEVEL_AREAS:
        raise InputError(path, "level", "features on too many levels", f"at most {MOST_LEVEL_AREAS} areas")
    return [*_connections([area for area in areas if area.kind in CONNECTING], areas), *_rest(areas)]


def _levels(tags: dict[str, Any], kind: str, missing: Collection[float]) -> tuple[float, ...]:
    """The levels of a feature, none if they are not stated."""
    texts = [tags[key] for key in ("level", "repeat_on") if tags.get(key) not in (None, "")]
    if not texts and kind == OUTLINE and "min_level" in tags and "max_level" in tags:
        texts = [f"{tags['min_level']}-{tags['max_level']}"]
    return tuple(dict.fromkeys(level for text in texts for level in levels_of(text, missing)))


def _rest(areas: Iterable[Area]) -> list[Area]:
    """All areas but stairs and lifts; a wall drawn as a ring around rooms is its line."""
    rest = [area for area in areas if area.kind not in CONNECTING]
    cells = [area for area in rest if area.kind in (*OPEN, *CLOSED)]
    tree = shapely.STRtree([cell.shape for cell in cells])

    def surrounds(wall: Area) -> bool:
        if not wall.is_polygon:
            return False
        on = [cells[int(k)] for k in tree.query(wall.shape) if set(cells[int(k)].floors) & set(wall.floors)]
        inside = shapely.area(shapely.intersection([cell.shape for cell in on], wall.shape))
        return bool(np.sum(inside) > shapely.area(wall.shape) / 2)

    return [replace(a, shape=shapely.boundary(a.shape)) if a.kind == WALL and surrounds(a) else a for a in rest]


def _connections(drawn: Sequence[Area], areas: Sequence[Area]) -> list[Area]:
    """Stairs and lifts as polygons; a line or point within stairs, a lift or a small room adds its levels to that."""
    polygons = [area for area in drawn if area.is_polygon]
    for area in drawn:
        if area.is_polygon or not area.floors:
            continue
        middle = shapely.centroid(area.shape)
        if isinstance(area.shape, shapely.LineString):
            middle = area.shape.interpolate(0.5, normalized=True)
        floors = set(area.floors)
        for n, other in enumerate(polygons):
            same = other.kind == area.kind and floors & set(other.floors)
            if same and shapely.dwithin(other.shape, middle, PLANS.crack):
                polygons[n] = replace(other, floors=tuple(dict.fromkeys((*other.floors, *area.floors))))
                break
        else:
            polygons.append(replace(area, shape=_footprint(area, areas)))
    return polygons


def _footprint(area: Area, areas: Sequence[Area]) -> shapely.Geometry:
    """The polygon of stairs drawn as a line, or of a lift drawn as a point: the room as small as a lift around it."""
    if area.kind != "lift":
        return shapely.buffer(area.shape, _width(area.properties, 1.5) / 2, cap_style="flat")
    for room in areas:
        # a room of 15 m² or more around a lift's point is not its cabin
        small = room.kind == "room" and room.is_polygon and shapely.area(room.shape) < 15.0
        if small and set(room.floors) & set(area.floors) and shapely.intersects(room.shape, area.shape):
            return room.shape
    return shapely.buffer(area.shape, 1.6 / 2, cap_style="square")


def _width(tags: dict[str, Any], default: float) -> float:
    """The stated width [m] of a door or of stairs."""
    found = re.fullmatch(r"\s*(\d{1,2}(?:\.\d{1,3})?)\s*m?\s*", str(tags.get("width", "")))
    return float(found[1]) if found and 0.3 < float(found[1]) < 20 else default


def _floor(areas: Iterable[Area], label: str, notes: list[str]) -> tuple[Area, ...]:
    """The areas of one level: stairs, lifts and rooms are cut out of corridors, doors open the outlines they are on."""
    here = [area for area in areas if label in area.floors or (area.kind == DOOR and not area.floors)]
    cabins = {id(area.shape) for area in here if area.kind == "lift"}  # rooms that are the cabin of a lift's point
    here = [area for area in here if area.kind != "room" or id(area.shape) not in cabins]
    joining = shapely.union_all([area.shape for area in here if area.kind in CONNECTING])
    rooms = shapely.union_all([area.shape for area in here if area.kind == "room" and area.is_polygon])
    cut = {"room": joining, "corridor": shapely.union(joining, rooms)}
    cells = [replace(a, shape=shapely.difference(a.shape, cut[a.kind])) if a.kind in cut else a for a in here]
    cells = [a for a in cells if not shapely.is_empty(a.shape)]
    walls = [a for a in cells if a.kind in (*OPEN, *CLOSED) and a.is_polygon]
    rings = [shapely.boundary(a.shape) for a in walls] + [a.shape for a in cells if a.kind in SOLID]
    tree = shapely.STRtree(rings)
    opened = [_on_walls(a, rings, tree, label) if a.kind == DOOR else a for a in cells]
    left_out = sum(a is None for a in opened)
    if left_out:
        notes.append(f"floor {label}: {count(left_out, 'door')} on no room or corridor left out")
    return open_doorless_rooms([a for a in opened if a is not None], label, notes, from_outside=True)


def _on_walls(door: Area, rings: Sequence[shapely.Geometry], tree: shapely.STRtree, label: str) -> Area | None:
    """A door with the piece of the outlines that it opens; None if it lies on none and its level is not stated."""
    if shapely.get_dimensions(door.shape) > 0:
        return door
    near = tree.query(door.shape, predicate="dwithin", distance=PLANS.crack)
    if not len(near):
        return None
    opening = shapely.buffer(door.shape, _width(door.properties, PLANS.door_width) / 2)
    pieces = shapely.intersection(shapely.union_all([rings[int(n)] for n in near]), opening)
    return replace(door, shape=shapely.line_merge(pieces), floors=(label,))


AREAS = ("area", "building", "building:part", "indoor", "room")  # tags of closed ways that are polygons


def osm_features(path: Path, notes: list[str], repairs: list[str]) -> list[Feature]:
    """All tagged elements with longitude and latitude. Raises InputError for broken or hostile XML."""
    # text takes ten times as much memory as a tree; a station has 2 MB
    check_file_size(path, 60_000_000, "cut out the building")
    root = parsed_xml(str(path), path.read_bytes(), "a whole .osm file")
    if root.tag != "osm":
        raise InputError(path, "", f"an element {str(root.tag)[:40]!r}", "OSM XML, whose first element is osm")
    for element in list(root):  # those that an editor has deleted
        if element.get("action") == "delete" or element.get("visible") == "false":
            root.remove(element)
    nodes = dict[str, Array]()
    for node in root.iterchildren("node"):
        if node.get("lat") is not None:
            place = np.array([float_of(node.get("lon")), float_of(node.get("lat"))])
            if not (np.abs(place) <= (180, 90)).all():
                found = f"lat {node.get('lat', '')[:20]!r}, lon {str(node.get('lon'))[:20]!r}"
                raise InputError(path, f"line {node.sourceline}", found, "lat and lon in degrees")
            nodes[node.get("id", "")] = place
    corners = {
        way.get("id", ""): [nodes[ref] for nd in way.iterchildren("nd") if (ref := nd.get("ref", "")) in nodes]
        for way in root.iterchildren("way")
    }
    ways = {identifier: shapely.LineString(line) for identifier, line in corners.items() if len(line) > 1}
    features, broken = list[Feature](), 0
    for element in root.iterchildren("node", "way", "relation"):
        tags = {tag.get("k", ""): tag.get("v", "") for tag in element.iterchildren("tag")}
        if not tags:
            continue
        shape = _shape(element, tags, nodes, ways)
        if shape is None or shapely.is_empty(shape):
            broken += element.tag == "way" or tags.get("type") == "multipolygon"
            continue
        if not shapely.is_valid(shape):
            repairs.append(f"{element.tag} {element.get('id')}: its outline crosses itself, and was repaired")
            shape = repaired(shape)
        features.append((len(features), shape, dict(tags)))
    if broken:
        notes.append(f"{broken} ways or relations whose nodes or ways are not in the file were left out")
    return features


def _shape(
    element: etree._Element,
    tags: dict[str, str],
    nodes: dict[str, Array],
    ways: dict[str, shapely.LineString],
) -> shapely.Geometry | None:
    """The point, line or polygon of an element."""
    identifier = element.get("id", "")
    if element.tag == "node":
        return shapely.Point(nodes[identifier]) if identifier in nodes else None
    if element.tag == "relation":
        members = [each.get("ref", "") for each in element.iterchildren("member") if each.get("type") == "way"]
        rings = shapely.build_area(shapely.union_all([ways.get(member) for member in members]))
        return rings if tags.get("type") == "multipolygon" else None
    line = ways.get(identifier)
    if line is None:
        return None
    is_ring = shapely.is_closed(line) and shapely.get_num_coordinates(line) > 3
    area = tags.get("highway") == "elevator" or any(key in tags for key in AREAS)
    return shapely.Polygon(shapely.get_coordinates(line)) if is_ring and area and tags.get("area") != "no" else line
