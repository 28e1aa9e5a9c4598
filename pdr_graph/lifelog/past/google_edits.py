"""Google's ``Timeline Edits.json`` (Takeout since 2025): raw positions of the devices that a timeline is made from."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, BinaryIO

from pdr_graph.io.past_day import PHONE
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.past.json_values import Point, at, batch_of, coordinates_e7, elements
from pdr_graph.lifelog.past.past_rows import Batch

NAME = "Google Timeline Edits"
SIGN = re.compile(rb'"timelineEdits"\s*:\s*\[')


def recognizes(head: bytes) -> bool:
    """True for a list ``timelineEdits``."""
    return SIGN.search(head) is not None


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read the raw positions, whose accuracy is in millimetres."""
    for key, found, bad in elements(stream, where):
        if key == "timelineEdits":
            yield batch_of([point for element in found for point in _position(element)], bad)


def _position(element: Any) -> Iterator[Point]:
    """The raw position of an element, if it has one."""
    position = at(element, "rawSignal", "signal", "position")
    if isinstance(position, dict):
        accuracy = float_of(position.get("accuracyMm")) / 1000
        yield position.get("timestamp"), coordinates_e7(position.get("point")), accuracy, PHONE
