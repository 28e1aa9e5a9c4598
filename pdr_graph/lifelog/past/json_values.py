"""Values in the JSON of timelines, all untrusted: nested objects, and coordinates in five notations."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, BinaryIO

import msgspec
import numpy as np

from pdr_graph.io.past_day import E7
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.past.json_pieces import decoded, pieces
from pdr_graph.lifelog.past.past_rows import Batch, unix_times, valid_positions

NOWHERE = (math.nan, math.nan)
# "50.0506312°, 14.3439906°", "48.8566, 2.3522" and "geo:27.72,-97.34"
COORDINATES = re.compile(r"(?:geo:)?\s*(-?\d{1,3}(?:\.\d*)?)\s*°?\s*,\s*(-?\d{1,3}(?:\.\d*)?)\s*°?\s*", re.ASCII)
DECODE = msgspec.json.Decoder(list[dict[str, Any]]).decode


def elements(stream: BinaryIO, where: str) -> Iterator[tuple[str, list[dict[str, Any]], int]]:
    """The elements of a document, some at a time: name of their list, objects, and how many cannot be read."""
    for piece in pieces(stream, where):
        found, bad = decoded(piece, DECODE, dict[str, Any])
        yield piece.key, found, bad


def at(value: Any, *path: str) -> Any:
    """The value along a path of names in nested objects; None where there is none."""
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def items(value: Any, *path: str) -> list[Any]:
    """The list along a path of names; empty where there is none."""
    found = at(value, *path)
    return found if isinstance(found, list) else []


def coordinates(value: Any) -> tuple[float, float]:
    """Latitude and longitude [deg] of a text, or of an object that has it as ``latLng``; NaN if it is neither."""
    if isinstance(value, dict):
        value = value.get("latLng") or value.get("LatLng")
    match = COORDINATES.fullmatch(value) if isinstance(value, str) and len(value) < 100 else None
    return (float(match[1]), float(match[2])) if match else NOWHERE


def coordinates_e7(value: Any) -> tuple[float, float]:
    """Latitude and longitude [deg] of ``latitudeE7`` and ``longitudeE7``, or ``latE7`` and ``lngE7``; else NaN."""
    for names in (("latitudeE7", "longitudeE7"), ("latE7", "lngE7")):
        lat, lon = (float_of(at(value, name)) / E7 for name in names)
        if math.isfinite(lat) and math.isfinite(lon):
            return lat, lon
    return NOWHERE


Point = tuple[Any, tuple[float, float], float, int]  # time, latitude and longitude [deg], accuracy [m], source


def batch_of(points: Sequence[Point], unreadable: int = 0) -> Batch:
    """The valid ones of some positions; unreadable: number of elements that could not be read."""
    time = unix_times([point[0] for point in points])
    lat, lon = np.array([point[1] for point in points], float).reshape(-1, 2).T
    accuracy = np.array([point[2] for point in points], float)
    batch = valid_positions(time, lat, lon, accuracy, np.array([point[3] for point in points], np.uint8))
    return Batch(batch.positions, left_out=+(batch.left_out + Counter({"unreadable": unreadable})))
