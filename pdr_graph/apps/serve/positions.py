"""Apps that send positions alone: OwnTracks, Overland, and OsmAnd's protocol (Traccar Client, GPSLogger).

Sources: owntracks/booklet docs/tech/json.md; README of aaronpk/Overland-iOS; traccar.org/osmand and
OsmAndProtocolDecoder.java; transistorsoft's background-geolocation for the JSON of Traccar Client 9. Each message gives
the device's name and fixes at Unix times [s]; what is no position is tolerated and gives none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import parse_qsl

import msgspec
import numpy as np

from pdr_graph.errors import InputError, one_line
from pdr_graph.io.validation import float_of, iso_time, receiver_fixes
from pdr_graph.types import Fixes

MOST_POSITIONS = 100_000  # of a message
Row = tuple[float, float, float, float]  # Unix time [s], latitude, longitude [deg], 68 % radius [m]


def parse(protocol: str, body: bytes) -> tuple[str, Fixes]:
    """The device's name, empty if the message has none, and its fixes. Raises InputError if it is malformed."""
    name, rows = PARSERS[protocol](body)
    if len(rows) > MOST_POSITIONS:
        raise InputError("message", "", f"{len(rows)} positions", f"up to {MOST_POSITIONS}")
    # latest [s]: a Unix time beyond is damage
    table = np.array([row for row in rows if abs(row[0]) < 1e11], dtype=float).reshape(-1, 4)
    return one_line(name)[:64], receiver_fixes(table, [])


def owntracks(body: bytes) -> tuple[str, list[Row]]:
    """A message of OwnTracks: JSON by ``_type``; only ``location`` has a position."""
    message = _object(body, "OwnTracks")
    device = message.get("topic") or message.get("tid") or ""
    name = device.split("/")[-1] if isinstance(device, str) else ""
    if message.get("_type") != "location":
        if not isinstance(message.get("_type"), str):
            raise InputError("message", "_type", "none", "the type of an OwnTracks message")
        return name, []
    row = _row(message.get("tst"), message.get("lat"), message.get("lon"), message.get("acc"))
    if row is None:
        raise InputError("message", "location", "no lat, lon and tst", "numbers, as OwnTracks sends")
    return name, [row]


def overland(body: bytes) -> tuple[str, list[Row]]:
    """A batch of Overland: GeoJSON points; those without geometry or time are events of the phone."""
    message = _object(body, "Overland")
    locations = message.get("locations")
    if not isinstance(locations, list):
        raise InputError("message", "locations", "none", "a list of GeoJSON points, as Overland sends")
    rows, name = [], ""
    for place in (each for each in locations if isinstance(each, dict)):
        properties, geometry = place.get("properties"), place.get("geometry")
        if not isinstance(properties, dict):
            continue
        name = _text(properties.get("device_id")) or _text(properties.get("unique_id")) or name
        coordinates = geometry.get("coordinates") if isinstance(geometry, dict) else None
        if isinstance(coordinates, list) and len(coordinates) >= 2:
            time, accuracy = iso_time(properties.get("timestamp")), properties.get("horizontal_accuracy")
            row = _row(time, coordinates[1], coordinates[0], accuracy, invalid=True)
            rows += [] if row is None else [row]
    return name, rows


def osmand(body: bytes) -> tuple[str, list[Row]]:
    """A position by OsmAnd's protocol: the query or form ``id=…&lat=…``, or the JSON of Traccar Client 9."""
    if body.lstrip()[:1] == b"{":
        return _traccar(_object(body, "Traccar Client"))
    try:
        fields = dict(parse_qsl(body.decode(), max_num_fields=200))
    except ValueError as error:
        raise InputError("message", "", one_line(str(error)), "id=…&lat=…&lon=…&timestamp=…") from None
    name = fields.get("id") or fields.get("deviceid") or ""
    if not name:
        raise InputError("message", "id", "none", "the name of the device: id=…")
    lat, _, lon = (
        fields["location"].partition(",") if "location" in fields else (fields.get("lat"), "", fields.get("lon"))
    )
    time = _time(fields.get("timestamp"))
    row = _row(time, float_of(lat), float_of(lon), float_of(fields.get("accuracy")))
    if row is None:
        raise InputError("message", "lat, lon, timestamp", "not all of them", "numbers: degrees, Unix seconds")
    return name, [] if fields.get("valid") == "false" else [row]


def _traccar(message: Mapping[str, Any]) -> tuple[str, list[Row]]:
    name, location = _text(message.get("device_id")), message.get("location")
    if not name:
        raise InputError("message", "device_id", "none", "the name of the device")
    coordinates = location.get("coords") if isinstance(location, dict) else None
    if not isinstance(location, dict) or not isinstance(coordinates, dict):
        raise InputError("message", "location", "no coords", "a position of Traccar Client")
    place = (coordinates.get("latitude"), coordinates.get("longitude"), coordinates.get("accuracy"))
    row = _row(_time(location.get("timestamp")), *place, invalid=True)
    if row is None:
        raise InputError("message", "location", "no latitude, longitude and timestamp", "numbers and an ISO time")
    return name, [row]


PARSERS: dict[str, Callable[[bytes], tuple[str, list[Row]]]] = {
    "owntracks": owntracks,
    "overland": overland,
    "osmand": osmand,
}


def _object(body: bytes, app: str) -> dict[str, Any]:
    try:
        return msgspec.json.decode(body, type=dict[str, Any])
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise InputError("message", "", one_line(str(error)), f"a JSON object of {app}") from None


def _row(time: Any, lat: Any, lon: Any, accuracy: Any, invalid: bool = False) -> Row | None:
    """A row of numbers; None if one is missing. invalid: a negative accuracy marks an invalid position."""
    time, lat, lon, accuracy = (float_of(value) for value in (time, lat, lon, accuracy))
    if not np.isfinite([time, lat, lon]).all():
        return None
    return time, lat, lon, accuracy if accuracy > 0 or (invalid and accuracy < 0) else np.nan


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""


def _time(value: Any) -> float:
    """Unix time [s] of OsmAnd's timestamp: seconds, milliseconds or ISO 8601."""
    number = float_of(value)
    if np.isnan(number):
        return iso_time(value)
    # milliseconds from: OsmAnd's timestamps from here on are milliseconds
    return number / 1000 if number >= (2**31) else number
