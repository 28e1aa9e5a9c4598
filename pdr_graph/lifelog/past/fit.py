"""FIT activities of watches and cycling computers, by Garmin's own reader (extra ``fit``)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, BinaryIO

from pdr_graph.errors import InputError, install
from pdr_graph.io.past_day import TRACK
from pdr_graph.io.validation import float_of
from pdr_graph.lifelog.past.json_values import Point, batch_of
from pdr_graph.lifelog.past.past_rows import Batch

NAME = "FIT"
LARGEST_FIT = 20_000_000  # [bytes]; a day at 1 Hz has 5 MB
MOST_MESSAGES = 500_000  # six days at 1 Hz; the library takes 25 µs for each


def recognizes(head: bytes) -> bool:
    """True if the header has the mark of the format."""
    return head[8:12] == b".FIT"


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read the records with a position. Raises InputError if the library is missing or the file is damaged."""
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
    records = [record for record in messages.get("record_mesgs", []) if "position_lat" in record]
    batch = batch_of([_point(record) for record in records])
    notes = (f"FIT: cut off or damaged after {len(records)} positions ({errors[0]})",) if errors else ()
    yield Batch(batch.positions, left_out=batch.left_out, notes=notes)


def _point(record: Any) -> Point:
    """The point of a record."""
    # semicircles [deg]
    lat, lon = (float_of(record.get(name)) * (180 / 2**31) for name in ("position_lat", "position_long"))
    # fit epoch [s]: Unix time of 1989-12-31, where the format counts from
    return 631_065_600.0 + float_of(record.get("timestamp")), (lat, lon), float_of(record.get("gps_accuracy")), TRACK
