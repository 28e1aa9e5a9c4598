"""Google's timelines, all five kinds: Takeout until 2024, Android, iOS, and what a timeline was made from."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, BinaryIO

import msgspec
import numpy as np

from pdr_graph.apps.lifelog.facts import ACTIVITY, END, VISIT, Guess
from pdr_graph.apps.lifelog.past.past_json import at, coordinates, coordinates_e7, decoded, items, lists_format, pieces
from pdr_graph.apps.lifelog.past.past_rows import (
    FIRST_TIME,
    PATH_ACCURACY,
    Batch,
    Format,
    Point,
    batch_of,
    guess,
    valid_positions,
)
from pdr_graph.io.past_day import E7, GOOGLE_CELL, GOOGLE_PATH, GOOGLE_WIFI, GPS, MS, PHONE, SIGHTING, Rows
from pdr_graph.io.validation import float_of, plausible_times, unix_time, unix_times
from pdr_graph.types import Array

SEMANTIC, TIMELINE = "Google Semantic Location History", "Google Timeline"
GOOGLE_RADIOS = {"GPS": GPS, "WIFI": GOOGLE_WIFI, "CELL": GOOGLE_CELL}
NAN = float("nan")
OFFSET = "durationMinutesOffsetFromStartTime"


class Location(
    msgspec.Struct,
    gc=False,
    rename={"latitude": "latitudeE7", "longitude": "longitudeE7", "milliseconds": "timestampMs"},
):
    """One position of ``Records.json``. latitude, longitude: [1e-7 deg]; accuracy: 68 % radius [m]; timestamp: ISO
    8601; milliseconds: Unix time [ms] instead, in exports before 2022.
    """

    latitude: float = NAN
    longitude: float = NAN
    accuracy: float = NAN
    source: str = ""
    timestamp: str = ""
    milliseconds: str | int = ""


DECODE_LOCATIONS = msgspec.json.Decoder(list[Location]).decode


def records(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Every position that a phone reported, up to gigabytes; Google's guesses of the activity are not read."""
    for piece in pieces(stream, where):
        if piece.key == "locations":
            found, bad = decoded(piece, DECODE_LOCATIONS, Location)
            time = unix_times([location.timestamp or location.milliseconds for location in found])
            lat = _unwrapped(np.array([location.latitude for location in found])) / E7
            lon = _unwrapped(np.array([location.longitude for location in found])) / E7
            source = np.array([GOOGLE_RADIOS.get(location.source, PHONE) for location in found], np.uint8)
            accuracy = np.array([location.accuracy for location in found])
            batch = valid_positions(time, lat, lon, accuracy, source)
            yield replace(batch, left_out=+(batch.left_out + Counter({"unreadable": bad})))


def _unwrapped(values: Array) -> Array:
    """Angles [1e-7 deg] with the sign that exports before 2018 lost: they wrote -1 as 2³² - 1."""
    return np.where((values > 1.8e9) & (values < 2.0**32), values - 2.0**32, values)


def _semantic(found: Sequence[Any], bad: int) -> Batch:
    """Visits, with visits inside them, and activities as guesses, and the points of raw paths, which have a time."""
    points, guesses = list[Point](), list[Guess]()
    for element in found:
        visit, ride = at(element, "placeVisit"), at(element, "activitySegment")
        for stay in (visit, *items(visit, "childVisits")) if isinstance(visit, dict) else ():
            place = at(stay, "location")
            name, share = at(place, "name") or at(place, "placeId"), float_of(at(place, "locationConfidence")) / 100
            guesses.append(guess(SEMANTIC, VISIT, _times(stay), name, coordinates_e7(place), share))
        if isinstance(ride, dict):
            name = at(ride, "activityType") or at(ride, "waypointPath", "travelMode")
            shares = [at(a, "probability") for a in items(ride, "activities") if at(a, "activityType") == name]
            share = float_of(shares[0]) / 100 if shares else None
            place = coordinates_e7(at(ride, "startLocation"))
            guesses.append(guess(SEMANTIC, ACTIVITY, _times(ride), name, place, share))
            guesses += _end(SEMANTIC, _times(ride)[1], coordinates_e7(at(ride, "endLocation")))
        for point in items(ride, "simplifiedRawPath", "points"):
            accuracy = max(PATH_ACCURACY, float_of(at(point, "accuracyMeters")))
            time = at(point, "timestamp") or at(point, "timestampMs")
            points.append((time, coordinates_e7(point), accuracy, GOOGLE_PATH))
    return batch_of(points, bad, guesses)


def _end(source: str, time: Any, place: tuple[float, float]) -> list[Guess]:
    """The end of an activity as a guess; none if its place is unknown."""
    return [guess(source, END, (time, time), "", place, None)] if np.isfinite(place).all() else []


def _spread(times: Sequence[float]) -> list[float]:
    """Times [s] of a path, which are whole minutes: several of one minute are spread over it, in order."""
    return [
        time + 60 * k / len(own) for _, same in groupby(times) for own in [list(same)] for k, time in enumerate(own)
    ]


def _times(value: Any) -> tuple[Any, Any]:
    """Start and stop of a duration, whose names end in Ms in exports before 2022."""
    span = at(value, "duration")
    return tuple(at(span, name) or at(span, f"{name}Ms") for name in ("startTimestamp", "endTimestamp"))


def _segments(found: Sequence[Any], bad: int) -> Batch:
    """Visits and activities of segments as guesses, and the points of the path, as of Android or iOS.

    A guess has the probability of its most probable place or kind. Android has the times of points, iOS minutes from
    the segment's start.
    """
    points, guesses = list[Point](), list[Guess]()
    for element in found:
        times = at(element, "startTime"), at(element, "endTime")
        visit, ride = at(element, "visit"), at(element, "activity")
        if isinstance(visit, dict):
            best = at(visit, "topCandidate")
            meaning = str(at(best, "semanticType") or "").upper()
            name = at(best, "placeId") or at(best, "placeID") if meaning in ("", "UNKNOWN") else meaning
            place = coordinates(at(best, "placeLocation"))
            guesses.append(guess(TIMELINE, VISIT, times, name, place, at(best, "probability")))
        if isinstance(ride, dict):
            best, place = at(ride, "topCandidate"), coordinates(at(ride, "start"))
            guesses.append(guess(TIMELINE, ACTIVITY, times, at(best, "type"), place, at(best, "probability")))
            guesses += _end(TIMELINE, times[1], coordinates(at(ride, "end")))
        start, path = unix_time(times[0]), dict[tuple[float, tuple[float, float]], None]()  # without repetitions
        for point in items(element, "timelinePath"):
            moment, since = at(point, "time"), at(point, OFFSET)
            minute = unix_time(moment) if moment else start + 60 * float_of(since)
            path[minute, coordinates(at(point, "point"))] = None
        for time, (_, place) in zip(_spread([minute for minute, _ in path]), path, strict=True):
            points.append((time, place, PATH_ACCURACY, GOOGLE_PATH))
    return batch_of(points, bad, guesses)


def _raw_signals(found: Sequence[Any], bad: int) -> Batch:
    """Raw positions and Wi-Fi scans of the last month."""
    points = list[Point]()
    for position in (at(element, "position") for element in found):
        if isinstance(position, dict):
            radio = position.get("source")
            source = GOOGLE_RADIOS.get(radio, PHONE) if isinstance(radio, str) else PHONE
            accuracy = float_of(position.get("accuracyMeters"))
            points.append((position.get("timestamp"), coordinates(position), accuracy, source))
    return replace(batch_of(points, bad), sightings=_sightings(found))


def _sightings(found: Sequence[Any]) -> Rows:
    """The receptions in Wi-Fi scans; those without a valid time, address or power are left out."""
    rows: list[tuple[int, int, int]] = []
    for element in found:
        scan = at(element, "wifiScan")
        time = unix_time(at(scan, "deliveryTime")) if scan else 0.0
        if time >= FIRST_TIME and plausible_times(np.array(time)):
            for device in items(scan, "devicesRecords"):
                mac, rssi = float_of(at(device, "mac")), float_of(at(device, "rawRssi"))
                if 0 < mac < 2**48 and -120 <= rssi < 0:
                    rows.append((round(time * MS), int(mac), round(rssi)))
    return np.array(rows, SIGHTING)


def _edits(found: Sequence[Any], bad: int) -> Batch:
    """Raw positions of the devices that a timeline is made from; their accuracy is in millimetres."""
    positions = (at(element, "rawSignal", "signal", "position") for element in found)
    return batch_of(
        [
            (p.get("timestamp"), coordinates_e7(p.get("point")), float_of(p.get("accuracyMm")) / 1000, PHONE)
            for p in positions
            if isinstance(p, dict)
        ],
        bad,
    )


RECORDS = Format(
    "Google Records.json",
    re.compile(rb'"locations"\s*:\s*\[\s*\{.*"(?:latitudeE7|timestampMs)"', re.DOTALL),
    records,
)
# Timeline.json of Android, and location-history.json of iOS: a bare list of segments whose numbers are texts
ANDROID = {"semanticSegments": _segments, "rawSignals": _raw_signals}
IOS_SIGN = rb'\A(?=\s*\[\s*\{.*"startTime").*"(?:visit|activity|timelinePath|timelineMemory)"'
GOOGLE_FORMATS = (
    RECORDS,
    lists_format(SEMANTIC, rb'"timelineObjects"\s*:\s*\[', {"timelineObjects": _semantic}),
    lists_format(TIMELINE, rb'"(?:semanticSegments|rawSignals)"\s*:\s*\[', ANDROID),
    lists_format("Google Timeline Edits", rb'"timelineEdits"\s*:\s*\[', {"timelineEdits": _edits}),
)
IOS_TIMELINE = lists_format("Google Timeline of iOS", IOS_SIGN, {"": _segments})
