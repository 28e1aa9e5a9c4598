"""Batches of the Overland app: ``locations`` of GeoJSON features."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, BinaryIO

from pdr_graph.io.past_day import PHONE
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.past.json_values import NOWHERE, Point, at, batch_of, elements, items
from pdr_graph.lifelog.past.past_rows import Batch

NAME = "Overland"
SIGN = re.compile(rb'"locations"\s*:\s*\[\s*\{.*"Feature"', re.DOTALL)


def recognizes(head: bytes) -> bool:
    """True for a list ``locations`` of features."""
    return SIGN.search(head) is not None


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read the features with a point; those without report the state of the app."""
    for key, found, bad in elements(stream, where):
        if key == "locations":
            yield batch_of([_point(element) for element in found if element.get("geometry")], bad)


def _point(feature: Any) -> Point:
    """The point of a feature: longitude before latitude, and a negative accuracy if it is invalid."""
    lonlat = [float_of(value) for value in items(feature, "geometry", "coordinates")]
    accuracy = float_of(at(feature, "properties", "horizontal_accuracy"))
    place = (lonlat[1], lonlat[0]) if len(lonlat) > 1 else NOWHERE
    return at(feature, "properties", "timestamp"), place, accuracy, PHONE
