"""Google's Semantic Location History (Takeout until 2024): visits and activities, a file per month."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, BinaryIO

from pdr_graph.io.past_day import GOOGLE_PATH
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.facts import Guess
from pdr_graph.lifelog.past.json_values import Point, at, batch_of, coordinates_e7, elements, items
from pdr_graph.lifelog.past.past_rows import PATH_ACCURACY, Batch, guess, with_guesses

NAME = "Google Semantic Location History"
SIGN = re.compile(rb'"timelineObjects"\s*:\s*\[')


def recognizes(head: bytes) -> bool:
    """True for a list ``timelineObjects``."""
    return SIGN.search(head) is not None


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read visits and activities as guesses, and the points of raw paths that have a time."""
    for key, found, bad in elements(stream, where):
        if key != "timelineObjects":
            continue
        guesses = [item for element in found for item in _guesses(element)]
        points = [point for element in found for point in _path(at(element, "activitySegment"))]
        yield with_guesses(batch_of(points, bad), guesses)


def _times(value: Any) -> tuple[Any, Any]:
    """Start and stop of a duration, whose names end in Ms in exports before 2022."""
    span = at(value, "duration")
    return tuple(at(span, name) or at(span, f"{name}Ms") for name in ("startTimestamp", "endTimestamp"))


def _guesses(element: Any) -> Iterator[Guess]:
    """The visit, with visits inside it, or the activity of an element."""
    visit, ride = at(element, "placeVisit"), at(element, "activitySegment")
    if isinstance(visit, dict):
        for one in (visit, *items(visit, "childVisits")):
            place = at(one, "location")
            name = at(place, "name") or at(place, "placeId")
            share = float_of(at(place, "locationConfidence")) / 100
            yield guess(NAME, "visit", _times(one), name, coordinates_e7(place), share)
    if isinstance(ride, dict):
        name = at(ride, "activityType") or at(ride, "waypointPath", "travelMode")
        shares = [at(a, "probability") for a in items(ride, "activities") if at(a, "activityType") == name]
        share = float_of(shares[0]) / 100 if shares else None
        yield guess(NAME, "activity", _times(ride), name, coordinates_e7(at(ride, "startLocation")), share)


def _path(ride: Any) -> Iterator[Point]:
    """The points of an activity's raw path; way points have no time and are not read."""
    for point in items(ride, "simplifiedRawPath", "points"):
        accuracy = float_of(at(point, "accuracyMeters"))
        time = at(point, "timestamp") or at(point, "timestampMs")
        yield time, coordinates_e7(point), max(PATH_ACCURACY, accuracy), GOOGLE_PATH
