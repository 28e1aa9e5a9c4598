"""GPX tracks, 1.0 and 1.1: positions of a watch or a map app, as fixes; and a walk for any map app to show.

lxml parses ten times as fast as gpxpy, and can be told to trust nothing: no document type, no entities, no network.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError
from pdr_graph.frames import Frame
from pdr_graph.io.door import admit
from pdr_graph.io.positions import receiver_fixes
from pdr_graph.io.source import Source
from pdr_graph.types import Array, Fixes, Recording, Trajectory

NAME = "GPX (.gpx)"
NAMESPACE = "http://www.topografix.com/GPX/1/1"
ACCURACY_PER_HDOP = 5.3  # [m] 68 % radius: a phone's range error of 5 m, times HDOP, is the root mean square distance
PLAIN_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z")
Point = tuple[float, float, str, float]  # latitude and longitude [deg], time, accuracy [m]


def recognizes(source: Source) -> bool:
    """True if the root element is ``gpx``."""
    return source.single is not None and b"<gpx" in source.head(source.single, 2048).replace(b"\0", b"")


def read(source: Source) -> Recording:
    """Read a track as a recording of fixes alone."""
    notes: list[str] = []
    fixes = read_fixes(source, notes)
    return admit(str(source.path), PurePosixPath(source.single or "").stem, {}, 0.0, fixes, notes=notes)


def read_fixes(source: Source, notes: list[str]) -> Fixes:
    """Track points at Unix times. Accuracy is an ``accuracy`` extension's, else from HDOP. Segments are joined."""
    name = source.single or ""
    where = source.where(name)
    points = _points(where, source.text(name))
    timed = [p for p in points if p[2]]
    if not timed:
        raise InputError(where, "", f"{len(points)} track points, none with a time", "<trkpt> with <time>")
    if len(timed) < len(points):
        notes.append(f"GPX: {len(points) - len(timed)} of {len(points)} track points have no time")
    lat, lon, time, accuracy = zip(*timed, strict=True)
    return receiver_fixes(np.column_stack([_unix(where, time), lat, lon, accuracy]), notes, "GPX")


def write(path: Path, trajectory: Trajectory, frame: Frame, epoch: float | None, name: str) -> None:
    """A track for any map app, with UTC times where the log has a clock."""
    gpx = etree.Element("gpx", {"version": "1.1", "creator": "pdr_graph"}, nsmap={None: NAMESPACE})
    track = etree.SubElement(gpx, "trk")
    etree.SubElement(track, "name").text = "".join(c if c.isprintable() else "?" for c in name)
    segment = etree.SubElement(track, "trkseg")
    for t, (lon, lat) in zip(trajectory.time, frame.to_lonlat(trajectory.position), strict=True):
        point = etree.SubElement(segment, "trkpt", {"lat": f"{lat:.8f}", "lon": f"{lon:.8f}"})
        if epoch is not None:
            when = datetime.fromtimestamp(epoch + t, UTC)
            etree.SubElement(point, "time").text = when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    etree.ElementTree(gpx).write(path, encoding="UTF-8", xml_declaration=True, pretty_print=True)


def _points(where: str, text: str) -> list[Point]:
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, remove_comments=True, remove_pis=True
    )
    try:
        root = etree.fromstring(text.encode(), parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InputError(where, "", f"broken XML ({str(error)[:120]})", "a whole GPX file") from None
    if root.getroottree().docinfo.doctype:
        raise InputError(where, "", "a document type definition", "plain GPX, which has none")
    prefix = root.tag[: root.tag.find("}") + 1]
    rated = "hdop" in text or "ccuracy" in text
    points: list[Point] = []
    for point in root.iter(prefix + "trkpt"):
        children = {child.tag: child.text for child in point}
        accuracy = _accuracy(point) if rated else np.nan
        at = point.attrib
        lat, lon = _number(where, point, at.get("lat")), _number(where, point, at.get("lon"))
        points.append((lat, lon, (children.get(prefix + "time") or "").strip(), accuracy))
    return points


def _number(where: str, point: etree._Element, text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        found = "no coordinate" if text is None else repr(text[:40])
        raise InputError(where, f"line {point.sourceline}", found, "lat and lon in degrees") from None


def _accuracy(point: etree._Element) -> float:
    """68 % radius of one point [m], NaN where the file does not say."""
    said = {str(e.tag).rpartition("}")[2].lower(): e.text for e in point.iter()}
    for name, factor in (("accuracy", 1.0), ("horizontalaccuracy", 1.0), ("hdop", ACCURACY_PER_HDOP)):
        try:
            return factor * float(said[name] or "")
        except (KeyError, ValueError):
            continue
    return np.nan


def _unix(where: str, times: tuple[str, ...]) -> Array:
    """Unix seconds of ISO 8601 times; without a zone they are UTC, as the format demands."""
    try:
        if all(PLAIN_TIME.fullmatch(t) for t in times):
            return np.array([t[:-1] for t in times], dtype="datetime64[ms]").astype(float) / 1000
        parsed = [datetime.fromisoformat(t) for t in times]
        return np.array([(t if t.tzinfo else t.replace(tzinfo=UTC)).timestamp() for t in parsed])
    except (ValueError, OverflowError) as error:
        raise InputError(where, "<time>", str(error)[:80], "times as 2024-05-01T12:00:00Z") from None
