"""Google's ``location-history.json`` of iOS: a bare list of segments whose numbers are texts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import BinaryIO

from pdr_graph.lifelog.past.google_timeline import segments
from pdr_graph.lifelog.past.json_values import elements
from pdr_graph.lifelog.past.past_rows import Batch

NAME = "Google Timeline of iOS"
SIGN = re.compile(rb'\s*\[\s*\{.*"startTime".*', re.DOTALL)
KINDS = re.compile(rb'"(?:visit|activity|timelinePath|timelineMemory)"')


def recognizes(head: bytes) -> bool:
    """True for a bare list whose elements have ``startTime`` and one of the kinds of segments."""
    return SIGN.match(head) is not None and KINDS.search(head) is not None


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read visits and activities as guesses, and the points of the path."""
    for _, found, bad in elements(stream, where):
        yield segments(found, bad)
