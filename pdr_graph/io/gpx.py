"""GPX tracks, 1.0 and 1.1: positions of a watch or a map app are read as fixes; walks are written for map apps.

lxml parses ten times as fast as gpxpy. Files are untrusted: document types, entities and network access are refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError, count, printable
from pdr_graph.frames import Frame
from pdr_graph.io.source import Source
from pdr_graph.io.validation import (
    NO_ZONE,
    build_recording,
    float_of,
    plausible_times,
    receiver_fixes,
    unix_times,
    without_rollover,
    zoneless,
)
from pdr_graph.io.xml_elements import XmlElements
from pdr_graph.types import INSTANT, Array, Fixes, Index, OneLineRepr, Recording, Steps, Trajectory, time_span

NAMESPACE = "http://www.topografix.com/GPX/1/1"
EXTENSION = "urn:pdr_graph"  # namespace of the accuracy and the steps of a point, for which GPX has no elements
STEPS = "steps"
CREATED_BY = "pdr_graph"


def read(source: Source) -> Recording:
    """Read a track as a recording of fixes alone, or with the steps that this program writes into a track."""
    notes: list[str] = []
    table, name = _table(source, notes), PurePosixPath(source.single or "").stem
    fixes = receiver_fixes(table[:, :4], notes, "GPX")
    return build_recording(str(source.path), name, {}, 0.0, fixes, notes=notes, counted=table[:, [0, 4]])


def read_fixes(source: Source, notes: list[str]) -> Fixes:
    """Read track points as fixes at Unix times [s]. Raises InputError as `read`."""
    return receiver_fixes(_table(source, notes)[:, :4], notes, "GPX")


def _table(source: Source, notes: list[str]) -> Array:
    """Unix time [s], latitude, longitude [deg], 68 % radius [m] and number of steps of each track point ``(n, 5)``.

    Segments are joined; what is damaged is left out and noted.

    Raises InputError if no point has a time, or more than a fifth of them are damaged.
    """
    name = source.single or ""
    where = source.where(name)
    elements = XmlElements(BytesIO(source.content(name)), where, "gpx", "trkpt")
    points = list(track_points(elements))
    notes += [f"GPX: {note}" for note in elements.notes]
    if elements.is_cut:
        notes.append("GPX: the file ends in the middle, it is read up to there")
    times = [time for time, *_ in points if time]
    if not times:
        end = " before an end in the middle" if elements.is_cut else ""
        raise InputError(where, "", f"{len(points)} track points{end}, none with a time", "<trkpt> with <time>")
    if len(times) < len(points):
        notes.append(f"GPX: {len(points) - len(times)} of {len(points)} track points have no time")
    if zoneless(times).any():
        notes.append(f"GPX: {NO_ZONE}")
    unix = without_rollover(unix_times(times), "GPX", notes)
    table = np.column_stack([unix, [place for time, *place in points if time]])
    damaged = ~(np.isfinite(table[:, :3]).all(axis=1) & plausible_times(table[:, 0]))
    if damaged.sum() > 0.2 * len(table):
        row = int(np.argmax(damaged))
        found = f"{int(damaged.sum())} of {len(table)} track points without a valid time, lat and lon, the first at"
        expected = "times as 2024-05-01T12:00:00Z, lat and lon in degrees"
        raise InputError(where, "<trkpt>", f"{found} {times[row][:40]!r}, {table[row, 1]}, {table[row, 2]}", expected)
    if damaged.any():
        notes.append(f"GPX: {count(int(damaged.sum()), 'track point')} without a valid time and place left out")
    return table[~damaged]


# 68 % radius [m] per unit of an element; names in lower case without underscores. docs/formats.md says which apps
ACCURACY = dict.fromkeys(("accuracy", "accuracyhorizontal", "horizontalaccuracy", "hacc", "haccuracy", "horaccur"), 1.0)
# The same of <hdop> by the begin of the creator's name: these write Android's accuracy, the last a fourth of it
HDOP_OF_APPS = {"OsmAnd": 1.0, "Locus": 1.0, "OSMTracker": 4.0}
HDOP = 5.3  # of any other: a phone's range error of 5 m times HDOP is the rms distance
CREATOR = re.compile(r"<gpx\b[^>]*?\screator\s*=\s*[\"'](\w+)")

TrackPoint = tuple[str, float, float, float, float]


def track_points(elements: XmlElements) -> Iterator[TrackPoint]:
    """Time as text, "" without one, latitude and longitude [deg], 68 % radius [m] and number of steps of each point.

    NaN if not stated. Steps are those that this program writes: others, as trailsio:steps, do not say from where they
    count. The radius is that of an accuracy in metres, else estimated from HDOP.
    """
    tags: dict[str, float] = {}
    steps = ""
    for element in elements:
        if not tags:
            creator = CREATOR.search(elements.head)
            apps = (of for app, of in HDOP_OF_APPS.items() if creator and creator[1].startswith(app))
            tags = ACCURACY | {"hdop": next(apps, HDOP)}
            steps = STEPS if creator and creator[1] == CREATED_BY else ""
        time, values = "", dict[str, float]()
        for inner in element.iterdescendants():
            name = _local_name(inner.tag)
            if name == "time":
                time = time or (inner.text or "").strip()
            elif name in tags or name == steps:
                values.setdefault(name, tags.get(name, 1.0) * float_of(inner.text))
        radii = (values[name] for name in tags if not math.isnan(values.get(name, math.nan))) if values else iter(())
        place = float_of(element.get("lat")), float_of(element.get("lon"))
        yield time, *place, next(radii, math.nan), values.get(STEPS, math.nan)


@lru_cache(maxsize=256)
def _local_name(tag: Any) -> str:
    """The name of an element without namespace and underscores, in lower case; that of a comment is no text."""
    return str(tag).rpartition("}")[2].lower().replace("_", "")


@dataclass(frozen=True)
class Points(OneLineRepr):
    """Positions on earth.

    lonlat: ``(n, 2)`` longitude and latitude [deg]; time: ``(n,)`` Unix times [s], None without a clock;
    accuracy: ``(n,)`` 68 % radius [m], None if unknown; steps: ``(n,)`` number of steps since the first point.
    """

    lonlat: Array
    time: Array | None = None
    accuracy: Array | None = None
    steps: Index | None = None

    def _summary(self) -> list[str]:
        return [count(len(self.lonlat), "point"), *([] if self.time is None else time_span(self))]


@dataclass(frozen=True)
class Track(OneLineRepr):
    """A track and its uninterrupted segments. kind: of the activity, as "bus", "" if unknown."""

    name: str
    segments: tuple[Points, ...]
    kind: str = ""


def write(
    path: Path, trajectory: Trajectory, frame: Frame, epoch: float | None, name: str, steps: Steps | None = None
) -> None:
    """Write a walk as a GPX track, with UTC times if the recording has a clock, and the number of steps at each point.

    epoch: Unix time of time 0 [s]; None without a clock.
    """
    time = None if epoch is None else epoch + trajectory.time
    number = None if steps is None else np.searchsorted(steps.time[~steps.is_gap], trajectory.time + INSTANT)
    path.write_bytes(document([Track(name, (Points(frame.to_lonlat(trajectory.position), time, steps=number),))]))


def document(tracks: Sequence[Track], places: Sequence[tuple[str, str, Points]] = ()) -> bytes:
    """The content of a GPX 1.1 file. places: name, description and position of each waypoint at its arrival."""
    gpx = etree.Element("gpx", {"version": "1.1", "creator": CREATED_BY}, nsmap={None: NAMESPACE, "pdr": EXTENSION})
    for name, description, point in places:
        _add_points(gpx, "wpt", point, name, description)
    for track in tracks:
        element = etree.SubElement(gpx, "trk")
        etree.SubElement(element, "name").text = printable(track.name)
        if track.kind:
            etree.SubElement(element, "type").text = printable(track.kind)
        for points in track.segments:
            _add_points(etree.SubElement(element, "trkseg"), "trkpt", points)
    return etree.tostring(gpx, encoding="UTF-8", xml_declaration=True, pretty_print=True)


def _add_points(parent: etree._Element, tag: str, points: Points, name: str = "", about: str = "") -> None:
    """Add an element for each point, with its parts in the order that the format requires."""
    for n, (lon, lat) in enumerate(points.lonlat):
        element = etree.SubElement(parent, tag, {"lat": f"{lat:.8f}", "lon": f"{lon:.8f}"})
        if points.time is not None:
            when = datetime.fromtimestamp(points.time[n], UTC).isoformat(timespec="milliseconds")
            etree.SubElement(element, "time").text = when.replace("+00:00", "Z")
        if name:
            etree.SubElement(element, "name").text = printable(name)
        if about:
            etree.SubElement(element, "desc").text = printable(about)
        if points.accuracy is not None or points.steps is not None:
            extensions = etree.SubElement(element, "extensions")
            if points.accuracy is not None:
                etree.SubElement(extensions, f"{{{EXTENSION}}}accuracy").text = f"{points.accuracy[n]:.2f}"
            if points.steps is not None:
                etree.SubElement(extensions, f"{{{EXTENSION}}}{STEPS}").text = f"{points.steps[n]}"
