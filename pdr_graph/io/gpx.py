"""GPX tracks, 1.0 and 1.1: positions of a watch or a map app are read as fixes; walks are written for map apps.

lxml parses ten times as fast as gpxpy; track points of numbers and a time are found by a pattern, twice as fast again.
Files are untrusted: document types, entities and network access are refused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path, PurePosixPath

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError, count, printable
from pdr_graph.frames import Frame
from pdr_graph.io.source import Source
from pdr_graph.io.validation import build_recording, receiver_fixes
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
    root, points = _parsed(where, source.text(name))
    timed = np.array([bool(time) for time in points.time], bool)
    if not timed.any():
        raise InputError(where, "", f"{len(timed)} track points, none with a time", "<trkpt> with <time>")
    if not timed.all():
        notes.append(f"GPX: {np.sum(~timed)} of {len(timed)} track points have no time")
    lat, lon = (_degrees(where, root, texts, name) for texts, name in ((points.lat, "lat"), (points.lon, "lon")))
    accuracy = np.full(len(timed), np.nan)
    for row, values in points.accuracy.items():
        accuracy[row] = accuracy_of(values)
    time = _unix_times(where, [time for time in points.time if time])
    return receiver_fixes(np.column_stack([time, lat[timed], lon[timed], accuracy[timed]]), notes, "GPX")


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

    def _summary(self) -> list[str]:
        points = sum(len(segment.lonlat) for segment in self.segments)
        return [repr(self.name), count(len(self.segments), "segment"), count(points, "point")]


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


@dataclass
class _TrackPoints:
    """The track points of a file as text.

    lat, lon: None where the attribute is missing; time: "" without one; accuracy: row -> tag -> text.
    """

    lat: list[str | None] = field(default_factory=list)
    lon: list[str | None] = field(default_factory=list)
    time: list[str] = field(default_factory=list)
    accuracy: dict[int, dict[str, str]] = field(default_factory=dict)


def _parsed(where: str, text: str) -> tuple[etree._Element, _TrackPoints]:
    """The root element, without plain points if all are plain, and the track points.

    A plain point is well-formed by itself, so that the XML is well-formed if the rest is. A tree of all elements would
    take three times as long.
    """
    rest, points = _plain_points(text)
    if points is not None:
        with suppress(InputError):  # the message must have the line in the whole text
            return _parse(where, rest), points
    root = _parse(where, text)
    return root, _track_points(root)


# A track point of numbers and a time, as most apps write it; other elements of plain text in it are not used
_OTHERS = r"(?:<(?!time>|hdop>|[ah]\w*ccuracy>|trkpt>|wpt>|rtept>)([A-Za-z_]\w*)>[\t\n -%'-;=?-~]*</\{}>\s*)*"
_DEGREES, _TIME = r"-?\d{1,3}(?:\.\d+)?", r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?Z"
PLAIN_POINT = re.compile(
    rf'<trkpt lat="({_DEGREES})" lon="({_DEGREES})">\s*{_OTHERS.format(3)}<time>({_TIME})</time>\s*'
    rf"{_OTHERS.format(5)}</trkpt>",
    re.ASCII,
)


def _plain_points(text: str) -> tuple[str, _TrackPoints | None]:
    """The text without its track points, and these, if all are plain; else the whole text, and None."""
    head = text[: text.find(">", text.find("<gpx"))]
    renamed = text.count("xmlns") > head.count("xmlns")
    if renamed or "<!" in text or text.count("<?") > 1:  # comments, entities and the like could hide points
        return text, None
    parts = PLAIN_POINT.split(text)
    rest = "".join(parts[::6])
    if len(parts) == 1 or any(name in rest for name in ("trkpt", *ACCURACY_TAGS)):
        return text, None
    return rest, _TrackPoints(list(parts[1::6]), list(parts[2::6]), list(parts[4::6]))


# DOP of the receiver, an element of GPX; and extensions with a radius [m]
ACCURACY_TAGS = frozenset(("hdop", "accuracy", "horizontalAccuracy", "horizontalaccuracy"))


def _track_points(root: etree._Element) -> _TrackPoints:
    """Collect the track points in one pass over all elements, which is faster than selecting them in lxml."""
    prefix = root.tag[: root.tag.find("}") + 1]
    track_point, time = prefix + "trkpt", prefix + "time"
    others = (prefix + "wpt", prefix + "rtept")
    points, inside = _TrackPoints(), False
    for element in root.iter():
        tag = element.tag
        if tag == track_point:
            points.lat.append(element.get("lat"))
            points.lon.append(element.get("lon"))
            points.time.append("")
            inside = True
        elif tag in others:
            inside = False  # the time of a waypoint is not the time of a track point
        elif inside and tag == time:
            points.time[-1] = points.time[-1] or (element.text or "").strip()
        elif inside and tag.rpartition("}")[2] in ACCURACY_TAGS:
            values = points.accuracy.setdefault(len(points.time) - 1, {})
            values.setdefault(tag.rpartition("}")[2].lower(), element.text or "")
    return points


def _parse(where: str, text: str) -> etree._Element:
    """The root element; raises InputError if the XML is broken or has a document type definition."""
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, remove_comments=True, remove_pis=True
    )
    try:
        root = etree.fromstring(text.encode(), parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InputError(where, "", f"broken XML ({str(error)[:120]})", "a whole GPX file") from None
    if root.getroottree().docinfo.doctype:
        raise InputError(where, "", "a document type definition", "plain GPX, which has none")
    return root


def _degrees(where: str, root: etree._Element, texts: list[str | None], name: str) -> Array:
    """One attribute of all points as numbers ``(n,)`` [deg]."""
    try:
        return np.array([float(text) for text in texts])  # pyright: ignore[reportArgumentType] None is a TypeError
    except (TypeError, ValueError):
        wrong = next(n for n, text in enumerate(texts) if not _is_number(text))
        line = next(islice(root.iter("{*}trkpt"), wrong, None)).sourceline
        found = f"no {name}" if texts[wrong] is None else repr(str(texts[wrong])[:40])
        raise InputError(where, f"line {line}", found, "lat and lon in degrees") from None


def _is_number(text: str | None) -> bool:
    try:
        float(text or "")
    except ValueError:
        return False
    return True


# [m] 68 % radius per HDOP: a phone's range error of 5 m times HDOP is the root mean square distance
ACCURACY_PER_HDOP = 5.3


def accuracy_of(values: dict[str, str]) -> float:
    """68 % radius of one point [m]; NaN if the file has none. values: lower-case tag -> text."""
    for name, factor in (("accuracy", 1.0), ("horizontalaccuracy", 1.0), ("hdop", ACCURACY_PER_HDOP)):
        if _is_number(values.get(name)):
            return factor * float(values[name])
    return np.nan


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
