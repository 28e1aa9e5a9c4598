"""Google's ``Records.json`` (Takeout until 2024): every position that a phone reported, up to gigabytes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import BinaryIO

import msgspec
import numpy as np

from pdr_graph.io.past_day import E7, GOOGLE_CELL, GOOGLE_WIFI, GPS, PHONE
from pdr_graph.lifelog.past.json_pieces import decoded, pieces
from pdr_graph.lifelog.past.past_rows import Batch, unix_times, valid_positions
from pdr_graph.types import Array

NAME = "Google Records.json"
NAN = float("nan")
RADIOS = {"GPS": GPS, "WIFI": GOOGLE_WIFI, "CELL": GOOGLE_CELL}


NAMES = {"latitude": "latitudeE7", "longitude": "longitudeE7", "milliseconds": "timestampMs"}  # in the file


class Location(msgspec.Struct, gc=False, rename=NAMES):
    """One position. latitude, longitude: [1e-7 deg]; accuracy: 68 % radius [m]; timestamp: ISO 8601; milliseconds: Unix
    time [ms] instead, in exports before 2022.
    """

    latitude: float = NAN
    longitude: float = NAN
    accuracy: float = NAN
    source: str = ""
    timestamp: str = ""
    milliseconds: str | int = ""


DECODE = msgspec.json.Decoder(list[Location]).decode
SIGN = re.compile(rb'"locations"\s*:\s*\[\s*\{.*"(?:latitudeE7|timestampMs)"', re.DOTALL)


def recognizes(head: bytes) -> bool:
    """True for a list ``locations`` whose elements have ``latitudeE7``."""
    return SIGN.search(head) is not None


def read(stream: BinaryIO, where: str) -> Iterator[Batch]:
    """Read the positions; what Google guessed of the activity beside them is not read."""
    for piece in pieces(stream, where):
        if piece.key != "locations":
            continue
        rows, bad = decoded(piece, DECODE, Location)
        batch = _batch(rows)
        yield Batch(batch.positions, left_out=+(batch.left_out + Counter({"unreadable": bad})))


def _batch(rows: list[Location]) -> Batch:
    """The positions of some rows."""
    time = unix_times([row.timestamp or row.milliseconds for row in rows])
    lat, lon = (
        _unwrapped(np.array(values)) / E7
        for values in ([row.latitude for row in rows], [row.longitude for row in rows])
    )
    source = np.array([RADIOS.get(row.source, PHONE) for row in rows], np.uint8)
    return valid_positions(time, lat, lon, np.array([row.accuracy for row in rows]), source)


def _unwrapped(values: Array) -> Array:
    """Angles [1e-7 deg] with the sign that exports before 2018 lost: they wrote -1 as 2³² - 1."""
    return np.where((values > 1.8e9) & (values < 2.0**32), values - 2.0**32, values)
