"""OpenStreetMap XML (``.osm``, of JOSM or the API) as features: nodes, ways and multipolygon relations with their tags.

Files are untrusted: document types, entities and network access are refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import shapely
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError
from pdr_graph.floor.formats.geojson import Feature, repaired
from pdr_graph.floor.formats.prerequisites import check_file_size

LARGEST_FILE = 60_000_000  # [bytes] of text, which takes ten times as much memory as a tree; a station has 2 MB
AREAS = ("area", "building", "building:part", "indoor", "room")  # tags of closed ways that are polygons


def recognizes(path: Path) -> bool:
    """True if the root element is ``osm``."""
    with path.open("rb") as stream:
        return b"<osm" in stream.read(2048).replace(b"\0", b"")


def features_of(path: Path, notes: list[str], repairs: list[str]) -> list[Feature]:
    """All tagged elements with longitude and latitude. Raises InputError for broken or hostile XML."""
    root = _parse(path)
    nodes = _nodes(path, root)
    ways = {way.get("id", ""): _line(way, nodes) for way in root.iterchildren("way") if _exists(way)}
    found, broken = list[tuple[shapely.Geometry, dict[str, str]]](), 0
    for element in root.iterchildren("node", "way", "relation"):
        tags = {tag.get("k", ""): tag.get("v", "") for tag in element.iterchildren("tag")}
        if not tags or not _exists(element):
            continue
        shape = _shape(element, tags, nodes, ways)
        if shape is None or shapely.is_empty(shape):
            broken += element.tag == "way" or tags.get("type") == "multipolygon"
            continue
        if not shapely.is_valid(shape):
            repairs.append(f"{element.tag} {element.get('id')}: its outline crosses itself, and was repaired")
            shape = repaired(shape)
        found.append((shape, tags))
    if broken:
        notes.append(f"{broken} ways or relations whose nodes or ways are not in the file were left out")
    return [(n, shape, dict(tags)) for n, (shape, tags) in enumerate(found)]


def _parse(path: Path) -> etree._Element:
    """The root element. Raises InputError for other files."""
    check_file_size(path, LARGEST_FILE, "cut out the building")
    try:
        data = path.read_bytes()
        parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
        if b"<!DOCTYPE" in data.replace(b"\0", b"") or b"<!ENTITY" in data.replace(b"\0", b""):
            raise InputError(path, "", "a document type definition", "plain OSM XML, which has none")
        root = etree.fromstring(data, parser)
    except (etree.XMLSyntaxError, OSError) as error:
        raise InputError(path, "", f"broken XML ({str(error)[:120]})", "a whole .osm file") from None
    if root.tag != "osm":
        raise InputError(path, "", f"an element {str(root.tag)[:40]!r}", "OSM XML, whose first element is osm")
    return root


def _exists(element: etree._Element) -> bool:
    """False for elements that an editor has deleted."""
    return element.get("action") != "delete" and element.get("visible") != "false"


def _nodes(path: Path, root: etree._Element) -> dict[str, tuple[float, float]]:
    """Longitude and latitude [deg] of each node that has them."""
    nodes = dict[str, tuple[float, float]]()
    for node in root.iterchildren("node"):
        if _exists(node) and node.get("lat") is not None:
            try:
                lon, lat = float(node.get("lon", "")), float(node.get("lat", ""))
            except ValueError:
                lon = lat = np.nan
            if not (abs(lon) <= 180 and abs(lat) <= 90):
                found = f"lat {node.get('lat', '')[:20]!r}, lon {str(node.get('lon'))[:20]!r}"
                raise InputError(path, f"line {node.sourceline}", found, "lat and lon in degrees")
            nodes[node.get("id", "")] = lon, lat
    return nodes


def _line(way: etree._Element, nodes: dict[str, tuple[float, float]]) -> shapely.Geometry | None:
    """The line of a way through its nodes; None if the file has fewer than two of them."""
    corners = [nodes[ref] for nd in way.iterchildren("nd") if (ref := nd.get("ref", "")) in nodes]
    return shapely.LineString(corners) if len(corners) > 1 else None


def _shape(
    element: etree._Element,
    tags: dict[str, str],
    nodes: dict[str, tuple[float, float]],
    ways: dict[str, shapely.Geometry | None],
) -> shapely.Geometry | None:
    """The point, line or polygon of an element."""
    identifier = element.get("id", "")
    if element.tag == "node":
        return shapely.Point(nodes[identifier]) if identifier in nodes else None
    if element.tag == "relation":
        return _multipolygon(element, ways) if tags.get("type") == "multipolygon" else None
    line = ways.get(identifier)
    if line is None:
        return None
    is_ring = shapely.is_closed(line) and shapely.get_num_coordinates(line) > 3
    area = tags.get("highway") == "elevator" or any(key in tags for key in AREAS)
    return shapely.Polygon(shapely.get_coordinates(line)) if is_ring and area and tags.get("area") != "no" else line


def _multipolygon(relation: etree._Element, ways: dict[str, shapely.Geometry | None]) -> shapely.Geometry | None:
    """The outer rings of a relation without its inner rings."""
    outer, inner = list[shapely.Geometry](), list[shapely.Geometry]()
    for member in relation.iterchildren("member"):
        line = ways.get(member.get("ref", "")) if member.get("type") == "way" else None
        if line is not None:
            (inner if member.get("role") == "inner" else outer).append(line)
    return shapely.difference(_filled(outer), _filled(inner))


def _filled(lines: Iterable[shapely.Geometry]) -> shapely.Geometry:
    """The union of the polygons that lines enclose."""
    return shapely.union_all(list(_rings(shapely.line_merge(shapely.union_all(list(lines))))))


def _rings(lines: shapely.Geometry) -> Iterator[shapely.Geometry]:
    """The polygons of closed lines."""
    for line in shapely.get_parts(lines):
        if shapely.is_closed(line) and shapely.get_num_coordinates(line) > 3:
            yield repaired(shapely.Polygon(line))
