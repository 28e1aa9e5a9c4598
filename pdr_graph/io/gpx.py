"""GPX tracks, 1.0 and 1.1: positions of a watch or a map app are read as fixes; walks are written for map apps.

lxml parses ten times as fast as gpxpy. Files are untrusted: document types, entities and network access are refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError, count, printable
from pdr_graph.frames import Frame
from pdr_graph.io.source import Source, parsed_xml
from pdr_graph.io.validation import build_recording, float_of, receiver_fixes
from pdr_graph.types import Array, Fixes, OneLineRepr, Recording, Trajectory, time_span

NAME = "GPX"
NAMESPACE = "http://www.topografix.com/GPX/1/1"
EXTENSION = "urn:pdr_graph"  # namespace of the accuracy of a point, for which GPX has no element


def recognizes(source: Source) -> bool:
    """True if the root element is ``gpx``."""
    return source.single is not None and b"<gpx" in source.head(source.single, 2048).replace(b"\0", b"")


def read(source: Source) -> Recording:
    """Read a track as a recording of fixes alone."""
    notes: list[str] = []
    fixes = read_fixes(source, notes)
    return build_recording(str(source.path), PurePosixPath(source.single or "").stem, {}, 0.0, fixes, notes=notes)


def read_fixes(source: Source, notes: list[str]) -> Fixes:
    """Read track points as fixes at Unix times [s].

    The accuracy is that of an ``accuracy`` extension, else estimated from HDOP. Segments are joined. Raises InputError
    if the XML is broken or no point has a time.
    """
    name = source.single or ""
    where = source.where(name)
    root = parsed_xml(where, source.text(name).encode(), "a whole GPX file")
    points = list(root.iter(root.tag[: root.tag.find("}") + 1] + "trkpt"))
    times, lat, lon, accuracy = zip(*map(track_point, points), strict=True) if points else ([], [], [], [])
    timed = np.array([bool(time) for time in times], dtype=bool)
    if not timed.any():
        raise InputError(where, "", f"{len(points)} track points, none with a time", "<trkpt> with <time>")
    if not timed.all():
        notes.append(f"GPX: {np.sum(~timed)} of {len(timed)} track points have no time")
    for name, degrees in (("lat", lat), ("lon", lon)):
        for row in np.flatnonzero(np.isnan(degrees))[:1]:
            text = points[row].get(name)
            found = f"no {name}" if text is None else repr(text[:40])
            raise InputError(where, f"line {points[row].sourceline}", found, "lat and lon in degrees")
    table = np.column_stack([lat, lon, accuracy])[timed]
    time = _unix_times(where, [time for time in times if time])
    return receiver_fixes(np.column_stack([time, table]), notes, "GPX")


# 68 % radius [m] per unit of an extension, and of HDOP: a phone's range error of 5 m times HDOP is the rms distance
ACCURACY_TAGS = {"accuracy": 1.0, "horizontalaccuracy": 1.0, "hdop": 5.3}


def track_point(element: etree._Element) -> tuple[str, float, float, float]:
    """Time as text, "" without one, latitude and longitude [deg] and 68 % radius [m] of a point, NaN if not stated."""
    time, accuracy = "", math.nan
    values: dict[str, str] = {}
    for inner in element.iterdescendants():
        name = _local_name(inner.tag)
        if name == "time":
            time = time or (inner.text or "").strip()
        elif name in ACCURACY_TAGS:
            values.setdefault(name, inner.text or "")
    if values:
        radii = (factor * float_of(values[name]) for name, factor in ACCURACY_TAGS.items() if name in values)
        accuracy = next((radius for radius in radii if not math.isnan(radius)), math.nan)
    return time, float_of(element.get("lat")), float_of(element.get("lon")), accuracy


@lru_cache(maxsize=256)
def _local_name(tag: Any) -> str:
    """The name of an element without its namespace, in lower case; that of a processing instruction is no text."""
    return str(tag).rpartition("}")[2].lower()


@dataclass(frozen=True)
class Points(OneLineRepr):
    """Positions on earth.

    lonlat: ``(n, 2)`` longitude and latitude [deg]; time: ``(n,)`` Unix times [s], None without a clock;
    accuracy: ``(n,)`` 68 % radius [m], None if unknown.
    """

    lonlat: Array
    time: Array | None = None
    accuracy: Array | None = None

    def _summary(self) -> list[str]:
        return [count(len(self.lonlat), "point"), *([] if self.time is None else time_span(self))]


@dataclass(frozen=True)
class Track(OneLineRepr):
    """A track and its uninterrupted segments."""

    name: str
    segments: tuple[Points, ...]


def write(path: Path, trajectory: Trajectory, frame: Frame, epoch: float | None, name: str) -> None:
    """Write a walk as a GPX track, with UTC times if the recording has a clock.

    epoch: Unix time of time 0 [s]; None without a clock.
    """
    time = None if epoch is None else epoch + trajectory.time
    path.write_bytes(document([Track(name, (Points(frame.to_lonlat(trajectory.position), time),))]))


def document(tracks: Sequence[Track], places: Sequence[tuple[str, Points]] = ()) -> bytes:
    """The content of a GPX 1.1 file. places: name and position of each waypoint, at the time of arrival."""
    gpx = etree.Element("gpx", {"version": "1.1", "creator": "pdr_graph"}, nsmap={None: NAMESPACE, "pdr": EXTENSION})
    for name, point in places:
        _add_points(gpx, "wpt", point, name)
    for track in tracks:
        element = etree.SubElement(gpx, "trk")
        etree.SubElement(element, "name").text = printable(track.name)
        for points in track.segments:
            _add_points(etree.SubElement(element, "trkseg"), "trkpt", points)
    return etree.tostring(gpx, encoding="UTF-8", xml_declaration=True, pretty_print=True)


def _add_points(parent: etree._Element, tag: str, points: Points, name: str = "") -> None:
    """Add an element for each point, with its parts in the order that the format requires."""
    for n, (lon, lat) in enumerate(points.lonlat):
        element = etree.SubElement(parent, tag, {"lat": f"{lat:.8f}", "lon": f"{lon:.8f}"})
        if points.time is not None:
            when = datetime.fromtimestamp(points.time[n], UTC).isoformat(timespec="milliseconds")
            etree.SubElement(element, "time").text = when.replace("+00:00", "Z")
        if name:
            etree.SubElement(element, "name").text = printable(name)
        if points.accuracy is not None:
            extensions = etree.SubElement(element, "extensions")
            etree.SubElement(extensions, f"{{{EXTENSION}}}accuracy").text = f"{points.accuracy[n]:.2f}"


# UTC times as most apps write them, which numpy parses all at once
PLAIN_TIMES = re.compile(r"(?:\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z )*", re.ASCII)


def _unix_times(where: str, times: list[str]) -> Array:
    """Unix times [s] of ISO 8601 texts; UTC if they have no zone, as the format requires."""
    try:
        if PLAIN_TIMES.fullmatch(" ".join([*times, ""])):
            return np.array([t[:-1] for t in times], dtype="datetime64[ms]").astype(float) / 1000
        parsed = [datetime.fromisoformat(t) for t in times]
        return np.array([(t if t.tzinfo else t.replace(tzinfo=UTC)).timestamp() for t in parsed])
    except (ValueError, OverflowError) as error:
        raise InputError(where, "<time>", str(error)[:80], "times as 2024-05-01T12:00:00Z") from None
