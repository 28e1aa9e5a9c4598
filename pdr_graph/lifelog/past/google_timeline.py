"""Android's ``Timeline.json`` (since 2024): guessed segments of all years, and raw signals of the last month."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, BinaryIO

import numpy as np

from pdr_graph.io.past_day import GOOGLE_PATH, MS, PHONE, SIGHTING, Rows
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.facts import Guess
from pdr_graph.lifelog.observation import LATEST_EPOCH
from pdr_graph.lifelog.past.google_records import RADIOS
from pdr_graph.lifelog.past.json_values import Point, at, batch_of, coordinates, elements, items
from pdr_graph.lifelog.past.past_rows import FIRST_TIME, PATH_ACCURACY, Batch, guess, unix_time, with_guesses

NAME = "Google Timeline"
SIGN = re.compile(rb'"(?:semanticSegments|rawSignals)"\s*:\s*\[')


def recognizes(head: bytes) -> bool:
    """True for a list ``semanticSegments`` or ``rawSignals``."""
    return SIGN.search(head) is not None


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read visits and activities as guesses, points of the path, raw positions and Wi-Fi scans."""
    for key, found, bad in elements(stream, where):
        if key == "semanticSegments":
            yield segments(found, bad)
        elif key == "rawSignals":
            points = [point for element in found for point in _position(at(element, "position"))]
            batch = batch_of(points, bad)
            yield Batch(batch.positions, _sightings(found), (), batch.left_out)


def segments(found: Sequence[Any], bad: int) -> Batch:
    """Guesses and points of the path of segments, as of Android or iOS; bad: segments that cannot be read."""
    guesses = [item for element in found for item in _guesses(element)]
    return with_guesses(batch_of([point for element in found for point in _path(element)], bad), guesses)


def _guesses(element: Any) -> Iterator[Guess]:
    """The visit or activity of a segment, with the probability of its most probable place or kind."""
    times = at(element, "startTime"), at(element, "endTime")
    visit, ride = at(element, "visit"), at(element, "activity")
    if isinstance(visit, dict):
        best = at(visit, "topCandidate")
        meaning = str(at(best, "semanticType") or "").upper()
        name = at(best, "placeId") or at(best, "placeID") if meaning in ("", "UNKNOWN") else meaning
        yield guess(NAME, "visit", times, name, coordinates(at(best, "placeLocation")), at(best, "probability"))
    if isinstance(ride, dict):
        best = at(ride, "topCandidate")
        place = coordinates(at(ride, "start"))
        yield guess(NAME, "activity", times, at(best, "type"), place, at(best, "probability"))


def _path(element: Any) -> Iterator[Point]:
    """The points of a segment's path: Android has their times, iOS minutes from the segment's start."""
    start = unix_time(at(element, "startTime"))
    for point in items(element, "timelinePath"):
        time = at(point, "time") or start + 60 * float_of(at(point, "durationMinutesOffsetFromStartTime"))
        yield time, coordinates(at(point, "point")), PATH_ACCURACY, GOOGLE_PATH


def _position(position: Any) -> Iterator[Point]:
    """The point of a raw position."""
    if isinstance(position, dict):
        place = coordinates(position)
        accuracy, radio = float_of(position.get("accuracyMeters")), position.get("source")
        yield position.get("timestamp"), place, accuracy, RADIOS.get(radio, PHONE) if isinstance(radio, str) else PHONE


def _sightings(found: Sequence[Any]) -> Rows:
    """The receptions in Wi-Fi scans; those without a valid time, address or power are left out."""
    rows: list[tuple[int, int, int]] = []
    for element in found:
        scan = at(element, "wifiScan")
        time = unix_time(at(scan, "deliveryTime")) if scan else 0.0
        if FIRST_TIME <= time < LATEST_EPOCH:
            for device in items(scan, "devicesRecords"):
                mac, rssi = float_of(at(device, "mac")), float_of(at(device, "rawRssi"))
                if 0 < mac < 2**48 and -120 <= rssi < 0:
                    rows.append((round(time * MS), int(mac), round(rssi)))
    return np.array(rows, SIGHTING)
