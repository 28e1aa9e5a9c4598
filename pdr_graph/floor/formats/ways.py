"""Ways on foot from files: OpenStreetMap (.osm, .osm.gz, .osm.pbf), lines of GeoJSON, routes and tracks of GPX.

Only ways within a box are kept, so that an extract of a country takes little memory. XML and PBF are read by libosmium
(extra ``paths``), which refuses entities; a small .osm is read without it.
"""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely

from pdr_graph.errors import InputError, count
from pdr_graph.floor.formats.geojson import features_of, read_json
from pdr_graph.io.signatures import tags_of
from pdr_graph.io.validation import float_of
from pdr_graph.io.xml_elements import XmlElements, parsed_xml
from pdr_graph.priors import WAYS
from pdr_graph.types import Array

SMALL_XML = 60_000_000  # [bytes] of XML that is read without libosmium; a tree takes ten times as much memory
CLOSED_TO_WALKERS = ("no", "private")  # values of access and foot
FORMATS = "OpenStreetMap (.osm, .osm.pbf), lines of GeoJSON or GPX routes"
LONG = 30  # corners from which a way that begins elsewhere may still come near
GPX_PARTS = ("rte", "trkseg")


class Found(NamedTuple):
    """The ways of a file within a box. lines: ``(m, 2)`` of each, longitude and latitude [deg]; classes: of each.

    total: number of ways in the file; nearest: longitude and latitude of the way nearest to the box, if none is in it.
    """

    lines: list[Array]
    classes: tuple[str, ...]
    total: int
    nearest: Array
    notes: tuple[str, ...]


Street = tuple[str, Array]  # class; longitudes and latitudes ``(m, 2)`` [deg]


def read_ways(path: Path, low: Array, high: Array) -> Found:
    """The ways that enter the box from ``low`` to ``high``, longitude and latitude [deg].

    Raises InputError for other files and broken ones.
    """
    if not path.is_file():
        raise InputError(path, "", "no such file", FORMATS)
    with path.open("rb") as file:
        head = file.read(2000)
    notes = list[str]()
    if head[:2] == b"\x1f\x8b":
        head = _unpacked(path, 2000)
    if b"OSMHeader" in head[:40] or b"<osm" in head:
        ways = partial(_osm, path, low, high, b"<osm" in head)
    elif b"<gpx" in head:
        ways = partial(_gpx, path)
    elif not head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        raise InputError(path, "", "another format", FORMATS)
    else:
        ways = partial(_geojson, path, notes)
    lines, classes, far = list[Array](), list[str](), _Far(*((low + high) / 2).tolist())
    for name, line in ways(far):
        if (line.max(axis=0) >= low).all() and (line.min(axis=0) <= high).all():
            lines.append(line)
            classes.append(name)
        else:
            far.add(*line[0].tolist())
    total = len(lines) + far.total
    if not total:
        raise InputError(path, "", "no way on foot", "ways with highway=footway, path, residential…, or lines")
    return Found(lines, tuple(classes), total, np.array(far.nearest), tuple(notes))


class _Far:
    """Ways outside the box: how many there are, and the place of the nearest to its middle [deg]."""

    def __init__(self, lon: float, lat: float):
        self.total, self.nearest = 0, (np.nan, np.nan)
        self._lon, self._lat, self._off = lon, lat, np.inf

    def add(self, lon: float, lat: float) -> None:
        """Count a way that begins there."""
        self.total += 1
        if (off := abs(lon - self._lon) + abs(lat - self._lat)) < self._off:
            self._off, self.nearest = off, (lon, lat)


def _unpacked(path: Path, most: int) -> bytes:
    """The first bytes of a gzip file."""
    try:
        with gzip.open(path) as unpacked:
            return unpacked.read(most)
    except (OSError, EOFError) as error:
        raise InputError(path, "", f"a damaged gzip file ({error})", "a whole file") from None


def walkable(tags: dict[str, str]) -> bool:
    """True for the tags of a way on which one may walk."""
    if tags.get("highway", "") not in dict(WAYS.half_width) or tags.get("area") == "yes":
        return False
    return tags.get("foot", tags.get("access", "")) not in CLOSED_TO_WALKERS


def _osm(path: Path, low: Array, high: Array, is_xml: bool, far: _Far) -> Iterator[Street]:
    """The ways of OpenStreetMap that begin near the box."""
    try:
        from osmium import FileProcessor, InvalidLocationError
        from osmium.filter import EntityFilter, KeyFilter
        from osmium.geom import ALL, WKBFactory
        from osmium.osm import NODE, WAY, Way
    except ImportError:
        if not is_xml or path.stat().st_size > SMALL_XML:
            raise InputError(path, "", "an OpenStreetMap extract", "pip install 'pdr-graph[paths]'") from None
        yield from _osm_tree(path)
        return
    west, south, east, north = *(low - 0.02).tolist(), *(high + 0.02).tolist()  # 2 km: ways have corners
    geometry = WKBFactory()  # a way at once: thirty times as fast as its nodes one by one
    every = FileProcessor(str(path), NODE | WAY).with_locations("flex_mem")
    every = every.with_filter(EntityFilter(WAY)).with_filter(KeyFilter("highway"))
    try:
        for way in every:
            assert isinstance(way, Way), "the filter passes no others"
            nodes = way.nodes
            if not len(nodes) or not (first := nodes[0].location).valid():
                continue
            lon, lat = first.lon_without_check(), first.lat_without_check()
            if len(nodes) < LONG and not (west < lon < east and south < lat < north):
                far.add(lon, lat)
                continue
            tags = dict(way.tags)
            if walkable(tags):
                try:
                    corners = shapely.get_coordinates(shapely.from_wkb(geometry.create_linestring(way, ALL)))
                except (RuntimeError, InvalidLocationError):  # corners are not in the extract, or all at one place
                    corners = np.array([(node.lon, node.lat) for node in nodes if node.location.valid()])
                if len(corners) > 1:
                    yield tags["highway"], corners
    except RuntimeError as error:
        raise InputError(path, "", f"a damaged extract ({str(error)[:80]})", "a whole .osm or .osm.pbf file") from None


def _osm_tree(path: Path) -> Iterator[Street]:
    """The ways of a small .osm."""
    content = path.read_bytes()
    if content[:2] == b"\x1f\x8b":
        content = _unpacked(path, SMALL_XML + 1)
        if len(content) > SMALL_XML:
            raise InputError(path, "", "a large OpenStreetMap extract", "pip install 'pdr-graph[paths]'")
    root = parsed_xml(str(path), content, "a whole .osm file")
    nodes = {
        each.get("id"): (float_of(each.get("lon")), float_of(each.get("lat"))) for each in root.iterchildren("node")
    }
    for way in root.iterchildren("way"):
        tags = {tag.get("k", ""): tag.get("v", "") for tag in way.iterchildren("tag")}
        corners = [nodes[ref] for each in way.iterchildren("nd") if (ref := each.get("ref")) in nodes]
        if walkable(tags) and len(corners) > 1:
            yield tags["highway"], np.array(corners)


def _gpx(path: Path, far: _Far) -> Iterator[Street]:
    """Routes and tracks."""
    for part in GPX_PARTS:
        with path.open("rb") as file:
            for element in XmlElements(file, str(path), "gpx", part):
                points = [(float_of(each.get("lon")), float_of(each.get("lat"))) for each in element]
                line = np.array([point for point in points if np.isfinite(point).all()]).reshape(-1, 2)
                if len(line) > 1:
                    yield "path", _checked(path, line)


def _geojson(path: Path, notes: list[str], far: _Far) -> Iterator[Street]:
    """Lines of GeoJSON, with the class of their property ``highway``; lines without it are paths."""
    left_out = 0
    for _, shape, properties in features_of(path, read_json(path), notes, []):
        tags = tags_of(properties)
        parts = shapely.get_parts(shape)
        is_line = (shapely.get_dimensions(parts) == 1).all()
        if not is_line or ("highway" in tags and not walkable(tags)):
            left_out += 1
            continue
        for line in parts:
            yield str(tags.get("highway", "path")), _checked(path, shapely.get_coordinates(line))
    if left_out:
        notes.append(f"{count(left_out, 'feature')} that are no ways on foot were left out")


def _checked(path: Path, line: Array) -> Array:
    """The line. Raises InputError unless it has degrees."""
    if not (np.abs(line) <= (180, 90)).all():
        raise InputError(path, "", f"the place {line[0].tolist()}", "longitude and latitude in degrees")
    return line
