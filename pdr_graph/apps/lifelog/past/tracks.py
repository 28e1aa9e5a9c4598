"""Tracks of watches, apps and map programs: GPX, KML, TCX, FIT, OwnTracks and Overland, in bounded memory.

Files are untrusted: XML entities, document types and the network are refused.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, BinaryIO

import msgspec

from pdr_graph.apps.lifelog.facts import Guess
from pdr_graph.apps.lifelog.past.past_json import NO_POSITION, as_utf8, at, items, lists_format
from pdr_graph.apps.lifelog.past.past_rows import Batch, Format, Point, batch_of, guess
from pdr_graph.errors import InputError, install
from pdr_graph.io.gpx import track_points
from pdr_graph.io.past_day import PHONE, TRACKED
from pdr_graph.io.signatures import GPX_ROOT
from pdr_graph.io.validation import float_of
from pdr_graph.io.xml_elements import XmlElements

BATCH = 20_000  # points in a batch
TCX_DEGREES = "LatitudeDegrees", "LongitudeDegrees"


def _gpx(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Track points, with the accuracies that apps state."""
    elements = XmlElements(stream, where, "gpx", "trkpt")
    points = ((time, (lat, lon), accuracy, TRACKED) for time, lat, lon, accuracy, _ in track_points(elements))
    while part := list(itertools.islice(points, BATCH)):
        yield batch_of(part)
    yield _defects(elements, where)


def _tcx(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Track points of Garmin's Training Center; those without a position are pauses or indoors."""
    elements = XmlElements(stream, where, "TrainingCenterDatabase", "Trackpoint")
    texts = ([one.findtext(f".//{{*}}{name}") for name in ("Time", *TCX_DEGREES)] for one in elements)
    points = ((_iso(time), (float_of(lat), float_of(lon)), math.nan, TRACKED) for time, lat, lon in texts if lat or lon)
    while part := list(itertools.islice(points, BATCH)):
        yield batch_of(part)
    yield _defects(elements, where)


def _defects(elements: XmlElements, where: str) -> Batch:
    """What was mended or damaged, after the last element. Raises InputError if the file ends in the middle."""
    if elements.is_cut:
        more = f" ({'; '.join(elements.notes)})" if elements.notes else ""
        raise InputError(where, "", f"an end in the middle{more}", "the whole file: was the download cut off?")
    return Batch(notes=tuple(elements.notes))


def _kml(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Tracks (``gx:Track``) and points with a time; a place or line with a span of time is a guess.

    One track at a time is in memory.
    """
    points, guesses, untimed = list[Point](), list[Guess](), 0
    elements = XmlElements(stream, where, "kml", "Placemark")
    for element in elements:
        for track in element.iterfind(".//{*}Track"):  # as many times as coordinates, in the same order
            places = track.iterfind("{*}coord")
            for time, place in zip(track.iterfind("{*}when"), places, strict=False):
                points.append((_iso(time.text), _lat_lon((place.text or "").split()), math.nan, TRACKED))
        time = element.findtext("{*}TimeStamp/{*}when")
        begin, end = (element.findtext(f"{{*}}TimeSpan/{{*}}{name}") for name in ("begin", "end"))
        place, line = (element.findtext(f".//{{*}}{name}/{{*}}coordinates") for name in ("Point", "LineString"))
        first = (place or line or "").split()[:1]
        at_first = _lat_lon(first[0].split(",")) if first else NO_POSITION
        if time and place:
            points.append((_iso(time), _lat_lon(place.split(",")), math.nan, TRACKED))
        if begin and end and (place or line):
            kind, name = "visit" if place else "activity", element.findtext("{*}name")
            guesses.append(guess("KML", kind, (_iso(begin), _iso(end)), name, at_first, None))
        if element.find("{*}TimeSpan") is None and element.find("{*}TimeStamp") is None:
            for name in ("Point", "LineString"):
                texts = element.iterfind(f".//{{*}}{name}/{{*}}coordinates")
                untimed += sum(len((text.text or "").split()) for text in texts)
        if len(points) > BATCH:
            yield batch_of(points)
            points = []
    yield batch_of(points, guesses=guesses, left_out={"no time": untimed})
    yield _defects(elements, where)


def _iso(text: str | None) -> str:
    """A time as text, which is not a bare number such as a year."""
    return text.strip() if text and "T" in text else ""


def _lat_lon(parts: Sequence[str]) -> tuple[float, float]:
    """Latitude and longitude [deg] of longitude and latitude as texts; NaN if they are none."""
    return (float_of(parts[1]), float_of(parts[0])) if len(parts) > 1 else NO_POSITION


LARGEST_FIT = 20_000_000  # [bytes]; a day at 1 Hz has 5 MB
MOST_MESSAGES = 500_000  # six days at 1 Hz; the library takes 25 µs for each


def _fit(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Records with a position, by Garmin's own reader. Raises InputError if it is missing or the file is damaged."""
    try:
        from garmin_fit_sdk import Decoder, Stream
    except ImportError:
        raise InputError(where, "", "a FIT file", f"{install('fit')}, which reads it") from None
    content = stream.read(LARGEST_FIT + 1)
    if len(content) > LARGEST_FIT:
        raise InputError(where, "", f"more than {LARGEST_FIT // 10**6} MB", "an activity")
    counter = itertools.count(1)

    def count_message(kind: int, message: Any) -> None:
        if next(counter) > MOST_MESSAGES:
            raise OverflowError(f"more than {MOST_MESSAGES} messages")

    try:
        decoder = Decoder(Stream.from_byte_array(bytearray(content)))
        messages, errors = decoder.read(
            convert_datetimes_to_dates=False,
            merge_heart_rates=False,
            expand_components=False,
            mesg_listener=count_message,
        )
    except Exception as error:  # the library raises whatever its parsing of damaged bytes meets
        raise InputError(where, "", f"a damaged FIT file ({error})", "a whole activity") from None
    if any(isinstance(error, OverflowError) for error in errors):
        raise InputError(where, "", f"more than {MOST_MESSAGES} messages", "one activity")
    if errors and not messages:
        raise InputError(where, "", f"a damaged FIT file ({errors[0]})", "a whole activity")
    points = list[Point]()
    for record in (record for record in messages.get("record_mesgs", []) if "position_lat" in record):
        # semicircles, and seconds from 1989-12-31
        lat, lon = (float_of(record.get(name)) * (180 / 2**31) for name in ("position_lat", "position_long"))
        time = 631_065_600.0 + float_of(record.get("timestamp"))
        points.append((time, (lat, lon), float_of(record.get("gps_accuracy")), TRACKED))
    notes = (f"FIT: cut off or damaged after {len(points)} positions ({errors[0]})",) if errors else ()
    yield replace(batch_of(points), notes=notes)


PART = 1_000_000  # [bytes] of lines that are read at once
LONGEST_LINE = 1_000_000  # [bytes]; a message has some hundred


def _owntracks(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Messages of the type location, a line each; other types (transition, waypoint, encrypted) are not positions."""
    while lines := _lines(stream, where):
        points, left_out = list[Point](), Counter[str]()
        for line in lines:
            try:
                message = msgspec.json.decode(as_utf8(line[line.index(b"{") :]), type=dict[str, Any])
            except (ValueError, RecursionError):
                left_out["unreadable"] += 1
                continue
            kind, place = message.get("_type"), (float_of(message.get("lat")), float_of(message.get("lon")))
            if kind == "location":
                points.append((message.get("tst"), place, float_of(message.get("acc")), PHONE))
            left_out["an encrypted message"] += kind == "encrypted"
        yield batch_of(points, left_out=left_out)


def _lines(stream: BinaryIO, where: str) -> list[bytes]:
    """The next lines that are not blank, PART bytes of them; none at the end. Raises InputError for a long line."""
    lines, size = list[bytes](), 0
    while size < PART and (line := stream.readline(LONGEST_LINE + 1)):
        if len(line) > LONGEST_LINE:
            raise InputError(where, "", f"a line of more than {LONGEST_LINE} bytes", "a message per line")
        size += len(line)
        lines += [line] if line.strip() else []
    return lines


def _overland(found: Sequence[Any], bad: int) -> Batch:
    """Features with a point, longitude before latitude, whose accuracy is negative if it is invalid.

    Features without a point report the state of the app.
    """
    points = list[Point]()
    for feature in (feature for feature in found if feature.get("geometry")):
        lonlat = [float_of(value) for value in items(feature, "geometry", "coordinates")]
        place = (lonlat[1], lonlat[0]) if len(lonlat) > 1 else NO_POSITION
        accuracy = float_of(at(feature, "properties", "horizontal_accuracy"))
        points.append((at(feature, "properties", "timestamp"), place, accuracy, PHONE))
    return batch_of(points, bad)


FIT = Format("FIT", re.compile(rb"\A.{8}\.FIT", re.DOTALL), _fit)
OVERLAND = lists_format("Overland", rb'"locations"\s*:\s*\[\s*\{.*"Feature"', {"locations": _overland})
# The Recorder's .rec files: a line per message with UTC time, kind and JSON
OWNTRACKS = Format("OwnTracks Recorder", re.compile(rb"\A\s*\d{4}-\d\d-\d\dT[\d:.]+Z\s+\S+\s+\{"), _owntracks)
GPX_TRACKS = Format("GPX", re.compile(rb"\A" + GPX_ROOT), _gpx)
KML = Format("KML", re.compile(rb"(?s)\A.{0,4000}?<(?:[\w.-]+:)?kml[\s>]"), _kml)
TCX = Format("TCX", re.compile(rb"(?s)\A.{0,4000}?<(?:[\w.-]+:)?TrainingCenterDatabase[\s>]"), _tcx)
