"""The Recorder's ``.rec`` files of OwnTracks: a line per message, time, kind and JSON."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, BinaryIO

import msgspec

from pdr_graph.errors import InputError
from pdr_graph.io.past_day import PHONE
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.past.json_values import Point, at, batch_of
from pdr_graph.lifelog.past.past_rows import Batch

NAME = "OwnTracks Recorder"
SIGN = re.compile(rb"\s*\d{4}-\d\d-\d\dT[\d:.]+Z\s+\S+\s+\{")
PART = 1_000_000  # [bytes] of lines that are read at once
LONGEST_LINE = 1_000_000  # [bytes]; a message has some hundred


def recognizes(head: bytes) -> bool:
    """True if the first line is a UTC time, a kind and the beginning of an object."""
    return SIGN.match(head) is not None


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read the messages of the type location; other types (transition, waypoint, encrypted) are not positions."""
    while lines := _lines(stream, where):
        found = [_decoded(line) for line in lines]
        kinds = Counter(at(message, "_type") for message in found)
        batch = batch_of([_point(m) for m in found if at(m, "_type") == "location"], found.count(None))
        encrypted = Counter({"an encrypted message": kinds["encrypted"]})
        yield Batch(batch.positions, left_out=+(batch.left_out + encrypted))


def _lines(stream: BinaryIO, where: str) -> list[bytes]:
    """The next lines that are not blank, PART bytes of them; none at the end. Raises InputError for a long line."""
    lines, size = list[bytes](), 0
    while size < PART and (line := stream.readline(LONGEST_LINE + 1)):
        if len(line) > LONGEST_LINE:
            raise InputError(where, "", f"a line of more than {LONGEST_LINE} bytes", "a message per line")
        size += len(line)
        lines += [line] if line.strip() else []
    return lines


def _decoded(line: bytes) -> Any:
    """The message of a line; None if it is not an object."""
    try:
        return msgspec.json.decode(line[line.index(b"{") :], type=dict[str, Any])
    except (ValueError, RecursionError):
        return None


def _point(message: Any) -> Point:
    """The point of a location: time of the fix [s], degrees, 68 % radius [m]."""
    place = float_of(message.get("lat")), float_of(message.get("lon"))
    return message.get("tst"), place, float_of(message.get("acc")), PHONE
