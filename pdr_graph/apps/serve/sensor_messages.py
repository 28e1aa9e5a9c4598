"""Messages of apps, by HTTP or MQTT, as events of a navigator.

Sensor Logger, source: PUSHING.md of tszheichoi/awesome-sensor-logger. Times are Unix nanoseconds. ``accelerometer`` is
without gravity; the total is its sum with ``gravity``, or ``accelerometeruncalibrated``. iOS has the opposite signs
(and g) unless "Standardise Units & Frames" is set. The message does not state the platform: gravity shows it, by the
rule of the export's reader.

Apps that send positions alone: OwnTracks, Overland, and OsmAnd's protocol (Traccar Client, GPSLogger). Sources:
owntracks/booklet docs/tech/json.md; README of aaronpk/Overland-iOS; traccar.org/osmand and OsmAndProtocolDecoder.java;
transistorsoft's background-geolocation for the JSON of Traccar Client 9. Each message gives the device's name and fixes
at Unix times [s]; what is no position is tolerated and gives none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any
from urllib.parse import parse_qsl

import msgspec
import numpy as np

from pdr_graph.errors import InputError, one_line
from pdr_graph.geometry import interpolate
from pdr_graph.inertial.units import in_g
from pdr_graph.io.sensor_logger import NANOSECOND, XYZ, sign_by_posture
from pdr_graph.io.validation import float_of, iso_time, plausible_times, receiver_fixes, unix_time
from pdr_graph.online.interface import PACKET, Event, Scan, events_of
from pdr_graph.priors import FIXES
from pdr_graph.types import INERTIAL, LONLAT, STANDARD_GRAVITY, Array, Fixes, Recording, Sightings, Signal

USED_COLUMNS = {  # name in a message: name of its columns here
    **{name: XYZ for name in ("accelerometer", "gravity", "gyroscope", "magnetometer")},
    **{f"{name}uncalibrated": XYZ for name in ("accelerometer", "gyroscope", "magnetometer")},
    "barometer": ("pressure",),
    "location": (
        *("latitude", "longitude", "horizontalAccuracy"),
        *("speed", "bearing", "speedAccuracy", "bearingAccuracy"),
    ),
}
PLAIN_NAMES = {
    "gyroscope": ("gyroscope", "gyroscopeuncalibrated"),
    "magnetometer": ("magnetometer", "magnetometeruncalibrated"),
}


class Values(msgspec.Struct):
    """The values of a sample that are used; of any JSON type, since apps send null and texts too."""

    x: Any = None
    y: Any = None
    z: Any = None
    pressure: Any = None
    latitude: Any = None
    longitude: Any = None
    horizontalAccuracy: Any = None  # noqa: N815
    speed: Any = None
    bearing: Any = None
    speedAccuracy: Any = None  # noqa: N815
    bearingAccuracy: Any = None  # noqa: N815
    id: Any = None
    rssi: Any = None


class Sample(msgspec.Struct):
    """One sample of a sensor; time: Unix nanoseconds."""

    name: str
    time: int | float
    values: Values = msgspec.field(default_factory=Values)
    accuracy: Any = None


class Message(msgspec.Struct):
    """A message of the app: its number within a recording (sessionId), and samples of all sensors."""

    messageId: int  # noqa: N815
    sessionId: str  # noqa: N815
    payload: list[Sample]
    deviceId: str = ""  # noqa: N815


_DECODER = msgspec.json.Decoder(Message)


def parse(body: bytes) -> Message:
    """Decode a message. Raises InputError, of one line, for any other JSON."""
    try:
        message = _DECODER.decode(body)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError, OverflowError) as error:
        raise InputError("message", "", one_line(str(error)), "JSON with messageId, sessionId and payload") from None
    if not 0 <= message.messageId < (1 << 62):  # largest number of a messageId
        raise InputError("message", "messageId", f"{message.messageId}", "a number from 0 on")
    if not message.sessionId:
        raise InputError("message", "sessionId", "an empty text", "the app's name of the recording")
    return message


def samples_of(body: bytes) -> list[Sample]:
    """The samples of a message; none of one that cannot be used."""
    try:
        return parse(body).payload
    except InputError:
        return []


def positions_of(protocol: str, body: bytes) -> Fixes | None:
    """The positions in a message of any app; None without."""
    if protocol != SENSOR_LOGGER:
        return parse_positions(protocol, body)[1]
    tables, _ = tables_of(samples_of(body))
    return fixes_of(tables, [])


def is_test(body: bytes) -> bool:
    """True for what the app's button "Tap to Test Pushing" sends: samples named ``test``, of no recording."""
    try:
        content = msgspec.json.decode(body) if len(body) <= 4096 else {}  # a test is short
        return {sample["name"] for sample in content["payload"]} == {"test"}
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError, LookupError, TypeError):
        return False


def tables_of(payload: Sequence[Sample]) -> tuple[dict[str, Array], dict[str, int]]:
    """The columns ``(n, 1 + k)`` of each used sensor, Unix time [s] first, sorted; NaN where a value is no number.

    Also the number of samples of each other sensor.
    """
    by_name = dict[str, list[Sample]]()
    for sample in payload:
        by_name.setdefault(sample.name.lower(), []).append(sample)
    tables, ignored = dict[str, Array](), dict[str, int]()
    for name, samples in by_name.items():
        if name not in USED_COLUMNS:
            ignored[one_line(name)[:40]] = len(samples)
            continue
        of = attrgetter("time", *(f"values.{column}" for column in USED_COLUMNS[name]))
        table = _numbers([of(sample) for sample in samples]) * ([NANOSECOND] + [1.0] * len(USED_COLUMNS[name]))
        tables[name] = table[np.argsort(table[:, 0], kind="stable")]
    return tables, ignored


def from_android(payload: Sequence[Sample]) -> bool:
    """True if a sample has an accuracy, which the app sends on Android alone."""
    return any(sample.accuracy is not None for sample in payload)


def _numbers(rows: Sequence[Sequence[Any]]) -> Array:
    """The rows as an array, NaN for what is no number."""
    try:
        return np.array(rows, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.array([[float_of(value) for value in row] for row in rows], dtype=float)


def receptions(payload: Sequence[Sample]) -> Sightings | None:
    """The Bluetooth receptions with a level, at Unix times [s]; None if there are none."""
    rows = [
        (float(sample.time) * NANOSECOND, sample.values.id, float_of(sample.values.rssi))
        for sample in payload
        if sample.name.lower() == "bluetooth" and isinstance(sample.values.id, str)
    ]
    rows = sorted(row for row in rows if np.isfinite(row[2]))
    if not rows:
        return None
    time, names, level = zip(*rows, strict=True)
    return Sightings(np.array(time), tuple(names), np.array(level))


@dataclass
class Signs:
    """How the accelerations of a session are read; decided once, from its first samples.

    acceleration: factor to m/s² with Android's signs, 0 while unknown; kind: of acceleration, "" while unknown;
    plain: which of calibrated and uncalibrated is used, by sensor; gravity: its last row ``(1, 4)`` time and values;
    guessed: whether only gravity's sign told the system; notes: assumptions, a line each.
    """

    acceleration: float = 0.0
    kind: str = ""
    plain: dict[str, str] = field(default_factory=dict)
    gravity: Array = field(default_factory=lambda: np.empty((0, 4)))
    guessed: bool = False
    notes: list[str] = field(default_factory=list)


TOTAL, RAW, LINEAR = "accelerometer and gravity", "accelerometeruncalibrated", "accelerometer"


def signals_of(tables: dict[str, Array], signs: Signs, platform: str = "", android: bool = False) -> dict[str, Array]:
    """The rows ``(n, 1 + k)`` of each sensor as of ``Recording.signals``, with Android's signs.

    Accelerations are in m/s²; the navigator recognises the other units. platform: "ios" or "android" if the user
    stated it; android: of `from_android`. Rows with a missing value stay, NaN, and are counted where they are used.
    """
    signals = _acceleration(tables, signs, platform, android)
    for sensor, names in PLAIN_NAMES.items():
        present = [name for name in names if name in tables]
        if present:
            name = signs.plain.setdefault(sensor, present[0])
            if name in tables:
                signals[sensor] = tables[name]
    if "barometer" in tables:
        signals["barometer"] = tables["barometer"]
    return signals


def _acceleration(tables: dict[str, Array], signs: Signs, platform: str, android: bool) -> dict[str, Array]:
    linear, gravity, raw = (tables.get(name) for name in ("accelerometer", "gravity", "accelerometeruncalibrated"))
    if gravity is not None:
        gravity = gravity[np.isfinite(gravity).all(axis=1)]
        gravity = np.concatenate([signs.gravity[-1:], gravity])
        signs.gravity = gravity[-1:].copy()
    with_gravity = gravity if gravity is not None and len(gravity) else raw
    if not signs.acceleration and with_gravity is not None:
        _decide(with_gravity, signs, platform, android)
    if linear is not None and gravity is not None and len(gravity):
        signs.kind = signs.kind if signs.kind == RAW else TOTAL
    elif not signs.kind:
        signs.kind = RAW if raw is not None else LINEAR if linear is not None else ""
    factor = [1.0] + 3 * [signs.acceleration or 1.0]
    if signs.kind == TOTAL and linear is not None and gravity is not None and len(gravity):
        total = linear[:, 1:] + interpolate(linear[:, 0], gravity[:, 0], gravity[:, 1:])
        return {"accelerometer": np.column_stack([linear[:, 0], total]) * factor}
    if signs.kind == RAW and raw is not None:
        return {"accelerometer": raw * factor}
    if signs.kind == LINEAR and linear is not None:
        return {"linear_acceleration": linear * factor}
    return {}


def _decide(with_gravity: Array, signs: Signs, platform: str, android: bool) -> None:
    """Decide unit and signs of accelerations, once."""
    rows = with_gravity[np.isfinite(with_gravity).all(axis=1)]
    if not len(rows):
        return
    is_in_g = in_g(rows[:, 1:])
    if platform:
        sign = -1.0 if platform == "ios" else 1.0
    elif android:
        sign = 1.0
    elif is_in_g:
        sign = -1.0  # only iOS has g, and only with its own signs
    else:
        sign, _, system = sign_by_posture(rows)
        signs.guessed = True
        signs.notes.append(f"accelerometer: {system} assumed from gravity's sign; platform=ios or android states it")
    signs.acceleration = sign * (STANDARD_GRAVITY if is_in_g else 1.0)


def fixes_of(tables: dict[str, Array], notes: list[str]) -> Fixes | None:
    """The phone's positions at Unix times [s]; None if there are none."""
    if "location" not in tables:
        return None
    fixes = receiver_fixes(tables["location"], notes)
    return fixes if len(fixes) else None


def shifted(part: Any, origin: float) -> Any:
    """A table with times since ``origin`` [s]."""
    return replace(part, time=part.time - origin)


LATEST_TIME = 1e8  # [s] from the first sample: three years; times beyond are damage
SENSOR_LOGGER, OWNTRACKS = "sensorlogger", "owntracks"
PLATFORMS = ("ios", "android")


@dataclass
class Intake:
    """What is known of a session after some messages.

    protocol; platform: "ios" or "android" if the user stated it; origin: Unix time of time 0 of the events [s], NaN
    before the first; latest: time of the last inertial sample [s]; held: rows that wait, by sensor, times in seconds
    since origin; held_fixes ``(n, 8)``: columns of `Fixes` but labels; ahead: by which the last positions of a message
    were later than its arrival [s]; ignored: number of samples of other sensors;
    unusable: number of rows by sensor that were no numbers, or years away.
    """

    protocol: str
    platform: str = ""
    origin: float = np.nan
    latest: float = -np.inf
    signs: Signs = field(default_factory=Signs)
    held: dict[str, Array] = field(default_factory=dict)
    held_fixes: Array = field(default_factory=lambda: np.empty((0, 8)))
    ahead: float = -np.inf
    ignored: dict[str, int] = field(default_factory=dict)
    unusable: dict[str, int] = field(default_factory=dict)

    def events(self, body: bytes, received: float = np.inf) -> list[Event]:
        """The events of a message, received at a Unix time [s]. Raises InputError if it is malformed.

        A position of the future, without sensors, is by a wrong clock: it is of the moment at which it was received, so
        that those after the clock was set right are newer.
        """
        if self.protocol == SENSOR_LOGGER:
            return self._sensor_events(parse(body), received)
        return self._fix_events(self._of_the_past(parse_positions(self.protocol, body)[1], received))

    def flush(self) -> list[Event]:
        """The events that waited for another message."""
        return self._released(np.inf)

    def _of_the_past(self, fixes: Fixes, received: float) -> Fixes:
        """Fixes, those of the future at the Unix time at which they were received. [s]"""
        self.ahead = float(max(fixes.time, default=-np.inf)) - received
        return replace(fixes, time=np.minimum(fixes.time, received))

    def _fix_events(self, fixes: Fixes) -> list[Event]:
        if not len(fixes):
            return []
        if np.isnan(self.origin):
            self.origin = float(fixes.time[0])
        fixes = shifted(fixes, self.origin)
        usable = np.abs(fixes.time) < LATEST_TIME
        self._count_unusable("location", int((~usable).sum()))
        return [fixes[usable]] if usable.any() else []

    def _sensor_events(self, message: Message, received: float) -> list[Event]:
        tables, ignored = tables_of(message.payload)
        heard = receptions(message.payload)
        if heard is not None:
            ignored.pop("bluetooth", None)
        for name, count in ignored.items():
            if name in self.ignored or len(self.ignored) < 50:  # names are the app's, or an attacker's
                self.ignored[name] = self.ignored.get(name, 0) + count
        signals = signals_of(tables, self.signs, self.platform, from_android(message.payload))
        fixes = fixes_of(tables, [])
        if fixes is not None and not signals and not np.isfinite(self.latest):
            fixes = self._of_the_past(fixes, received)
        self._begin(signals, fixes)
        usable = {name: self._usable(name, table) for name, table in signals.items()}
        events = self._arrived(usable, fixes) if signals or fixes is not None else []
        if heard is not None and not np.isnan(self.origin):
            events.append(Scan("bluetooth", shifted(heard, self.origin)))
        return events

    def _begin(self, signals: dict[str, Array], fixes: Fixes | None) -> None:
        """Set time 0 at the first sample, as a recording does; else at the first fix."""
        if not np.isnan(self.origin):
            return
        finite = {name: table[np.isfinite(table).all(axis=1), 0] for name, table in signals.items()}
        starts = [time[0] for name, time in finite.items() if name in INERTIAL and len(time)]
        starts = starts or [time[0] for time in finite.values() if len(time)]
        starts = starts or ([fixes.time[0]] if fixes is not None else [])
        self.origin = float(min(starts, default=np.nan))

    def _usable(self, name: str, table: Array) -> Array:
        """The rows of finite numbers, times since the origin."""
        table = table - np.eye(1, table.shape[1])[0] * self.origin
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(table).all(axis=1) & (np.abs(table[:, 0]) < LATEST_TIME)
        self._count_unusable(name, int((~usable).sum()))
        return table[usable]

    def _count_unusable(self, name: str, count: int) -> None:
        if count:
            self.unusable[name] = self.unusable.get(name, 0) + count

    def _arrived(self, signals: dict[str, Array], fixes: Fixes | None) -> list[Event]:
        """Hold rows, and return the events of all complete packets."""
        times = [table[:, 0] for name, table in signals.items() if name in INERTIAL and len(table)]
        events: list[Event] = []
        # a message that is earlier than those before by a minute: the phone's clock was reset
        if times and min(time[0] for time in times) < self.latest - 60.0:
            events = self._released(np.inf)
        for name, table in signals.items():
            earlier = self.held.get(name)
            self.held[name] = table if earlier is None else np.concatenate([earlier, table])
        if fixes is not None:
            motion = [getattr(fixes, name) for name in Fixes.optional]
            rows = np.column_stack([fixes.time - self.origin, fixes.position, fixes.sigma, *motion])
            rows = rows[(np.abs(rows[:, 0]) < LATEST_TIME) & (rows[:, 0] >= -FIXES.longest_overhang)]
            self.held_fixes = np.concatenate([self.held_fixes, rows])
        if times:
            self.latest = float(max(time[-1] for time in times))
            return events + self._released(np.floor(self.latest / PACKET))
        return events + self._released(np.inf)

    def _released(self, until: float) -> list[Event]:
        """The events of all held rows in packets before the one of a number."""
        signals, fixes = dict[str, Any](), Fixes.none()
        for name, table in self.held.items():
            used, self.held[name] = _split(table, until)
            if len(used):
                signals[name] = Signal(used[:, 0], used[:, 1:])
        used, self.held_fixes = _split(self.held_fixes, until)
        if len(used):
            motion = dict(zip(Fixes.optional, used[:, 4:].T, strict=True))
            fixes = Fixes(used[:, 0], used[:, 1:3], used[:, 3], epsg=LONLAT, **motion)
        return list(events_of(Recording("session", self.origin, self.origin, **signals, fixes=fixes)))

    @property
    def advice(self) -> tuple[str, ...]:
        """What the user can change at the phone, a line each; empty before a second of samples."""
        if self.protocol != SENSOR_LOGGER or self.latest < 1.0:
            return ()
        lines = []
        if not self.signs.kind:
            lines.append("no accelerometer: switch on Accelerometer and Gravity, else no steps are detected")
        elif self.signs.kind == LINEAR:
            lines.append("no gravity: switch on Gravity beside Accelerometer, else the vertical is a guess")
        if "gyroscope" not in self.signs.plain:
            lines.append("no gyroscope: switch on Gyroscope, else turns are not seen")
        return tuple(lines)


def _split(table: Array, until: float) -> tuple[Array, Array]:
    """The rows in packets before the one of a number, in order of time and without repeats, and the others."""
    table = table[np.argsort(table[:, 0], kind="stable")]
    if len(table) > 1:
        repeated = (table[1:, :4] == table[:-1, :4]).all(axis=1)  # times and the first values
        table = table[np.concatenate([[True], ~repeated])]
    number = np.floor(table[:, 0] / PACKET)
    count = int(np.searchsorted(number, until))
    return table[:count], table[count:].copy()


MOST_POSITIONS = 100_000  # of a message
Row = tuple[float, float, float, float]  # Unix time [s], latitude, longitude [deg], 68 % radius [m]


def parse_positions(protocol: str, body: bytes) -> tuple[str, Fixes]:
    """The device's name, empty if the message has none, and its fixes. Raises InputError if it is malformed."""
    name, rows = PARSERS[protocol](body)
    if len(rows) > MOST_POSITIONS:
        raise InputError("message", "", f"{len(rows)} positions", f"up to {MOST_POSITIONS}")
    table = np.array(rows, dtype=float).reshape(-1, 4)
    valid = plausible_times(table[:, 0])
    if len(table) and not valid.any():
        expected = "Unix seconds from 1970 to tomorrow: is the phone's clock set?"
        raise InputError("message", "time", f"{table[0, 0]:.0f} s", expected)
    return one_line(name)[:64], receiver_fixes(table[valid], [])


class Typed(msgspec.Struct):
    """What messages of OwnTracks have, and others do not."""

    type: str = msgspec.field(name="_type")


def owntracks_type(body: bytes) -> str:
    """The type that a message of OwnTracks states; "" for other messages."""
    try:
        return msgspec.json.decode(body, type=Typed).type
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
        return ""


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
    time = unix_time(fields.get("timestamp"))
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
    row = _row(unix_time(location.get("timestamp")), *place, invalid=True)
    if row is None:
        raise InputError("message", "location", "no latitude, longitude and timestamp", "numbers and an ISO time")
    return name, [row]


PARSERS: dict[str, Callable[[bytes], tuple[str, list[Row]]]] = {
    OWNTRACKS: owntracks,
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
