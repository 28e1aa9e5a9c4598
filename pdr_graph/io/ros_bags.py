"""Bags of ROS: MCAP and rosbag2 (SQLite) with a phone's or a robot's sensors in, a walk for Foxglove and RViz out.

Read are ``sensor_msgs`` Imu, MagneticField, NavSatFix and FluidPressure of any topics, in the units of REP 103, by
rosbags, which needs no ROS (extra ``ros``). A message counts at its header's stamp, or when it was logged without one.
Written are ``geometry_msgs/PoseWithCovarianceStamped``, ``foxglove_msgs/LocationFix`` and ``foxglove_msgs/GeoJSON`` as
docs.foxglove.dev defines them for ROS 2.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pdr_graph.errors import InputError
from pdr_graph.frames import enu
from pdr_graph.io.sensor_logger import NANOSECOND
from pdr_graph.io.source import MOST_LINES, Source
from pdr_graph.io.validation import RADIUS_68, build_recording, fullest, receiver_fixes
from pdr_graph.types import Array, Recording, Trajectory

UNAVAILABLE = -1.0  # first value of the covariance of a quantity that an Imu does not have
EXTRA = "the extra ros: pip install '.[ros]' in a clone"


def read(source: Source) -> Recording:
    """Read the sensors of a bag. Raises InputError if it is damaged, packed, or has none of the messages."""
    path, notes = source.path, list[str]()
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(path, "", "a bag of ROS, and no rosbags to read it", EXTRA) from None
    tables = dict[str, dict[str, list[tuple[float, ...]]]]()
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            wanted = [connection for connection in bag.connections if connection.msgtype in ROWS_OF]
            if (number := sum(connection.msgcount for connection in wanted)) > MOST_LINES:
                raise InputError(path, "", f"{number} messages", f"at most {MOST_LINES}: a shorter recording")
            present = sorted({connection.msgtype for connection in bag.connections})
            for connection, logged, data in bag.messages(wanted) if wanted else ():
                message: Any = bag.deserialize(data, connection.msgtype)
                stamp = message.header.stamp.sec + message.header.stamp.nanosec * NANOSECOND
                for sensor, values in ROWS_OF[connection.msgtype](message):
                    rows = tables.setdefault(sensor, {}).setdefault(connection.topic, [])
                    rows.append((stamp or logged * NANOSECOND, *values))
    except InputError:
        raise
    except Exception as error:  # rosbags has no common class for what damage may raise
        found = f"a bag that cannot be read ({type(error).__name__}: {error})"
        raise InputError(path, "", found, "a complete bag, not packed (mcap recover repairs a cut one)") from None
    if not tables:
        found = f"messages {', '.join(present)[:120]}" if present else "no messages"
        raise InputError(path, "", found, f"one of {', '.join(ROWS_OF)}")
    chosen = {sensor: _of_one_topic(sensor, topics, notes) for sensor, topics in tables.items()}
    located = chosen.pop(NAV_SAT, None)
    fixes = None if located is None else receiver_fixes(located, notes)
    return build_recording(str(path), path.stem, chosen, 0.0, fixes, notes=notes)


NAV_SAT = "location"
Values = Iterator[tuple[str, tuple[float, ...]]]


def _imu(message: Any) -> Values:
    for sensor, vector, covariance in (
        ("accelerometer", message.linear_acceleration, message.linear_acceleration_covariance),
        ("gyroscope", message.angular_velocity, message.angular_velocity_covariance),
    ):
        if covariance[0] != UNAVAILABLE:
            yield sensor, (vector.x, vector.y, vector.z)


def _magnetic_field(message: Any) -> Values:
    field = message.magnetic_field
    yield "magnetometer", (1e6 * field.x, 1e6 * field.y, 1e6 * field.z)  # from T


def _pressure(message: Any) -> Values:
    yield "barometer", (message.fluid_pressure / 100,)  # from Pa


def _position(message: Any) -> Values:
    """Latitude, longitude [deg] and 68 % radius [m], NaN if unknown; nothing without a fix."""
    if message.status.status >= 0:
        covariance, known = message.position_covariance, message.position_covariance_type > 0
        radius = RADIUS_68 * math.sqrt(max((covariance[0] + covariance[4]) / 2, 0.0)) if known else math.nan
        yield NAV_SAT, (message.latitude, message.longitude, radius)


ROWS_OF = {
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/MagneticField": _magnetic_field,
    "sensor_msgs/msg/NavSatFix": _position,
    "sensor_msgs/msg/FluidPressure": _pressure,
}


def _of_one_topic(sensor: str, topics: dict[str, list[tuple[float, ...]]], notes: list[str]) -> Array:
    """The rows ``(n, 1 + k)`` of the fullest topic of a sensor in order of time; others are noted."""
    best = fullest({topic: len(topics[topic]) for topic in sorted(topics)})
    notes += [f"{sensor}: topic {topic} was left out; {best} is used" for topic in topics if topic != best]
    rows = np.array(topics[best], dtype=float)
    return rows[np.argsort(rows[:, 0], kind="stable")]


LOCATION_FIX = """builtin_interfaces/Time timestamp
string frame_id
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 UNKNOWN=0
uint8 APPROXIMATED=1
uint8 DIAGONAL_KNOWN=2
uint8 KNOWN=3
uint8 position_covariance_type
"""
FOXGLOVE = {"foxglove_msgs/msg/LocationFix": LOCATION_FIX, "foxglove_msgs/msg/GeoJSON": "string geojson\n"}
POSED, FIX, GEOJSON_MESSAGE = "geometry_msgs/msg/PoseWithCovarianceStamped", *FOXGLOVE
TOPICS = {POSED: "/pdr_graph/pose", FIX: "/pdr_graph/location", GEOJSON_MESSAGE: "/pdr_graph/geojson"}
MAP = "map"  # the frame of REP 105 that is fixed to the ground
PLANAR = [0, 1, 5]  # x, y and the rotation about z among x, y, z and the rotations about them
KNOWN = 3  # the whole covariance, as of LocationFix


def write(path: Path, track: Trajectory, geojson: str = "") -> None:
    """Write a walk as MCAP, or for another ending than .mcap as a folder of rosbag2. Times are Unix times [s].

    Poses are on /pdr_graph/pose, in the frame of the walk, which is called map. geojson: ``trajectory.geojson`` of the
    walk, "" without latitudes; with it positions are on /pdr_graph/location and the file on /pdr_graph/geojson.
    Raises InputError without rosbags.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise InputError(path, "", "no rosbags to write it", EXTRA) from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in FOXGLOVE.items():
        store.register(get_types_from_msg(definition, name))
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    single = path.suffix == ".mcap"
    plugin, topics = StoragePlugin.MCAP if single else StoragePlugin.SQLITE3, dict[str, Any]()
    with tempfile.TemporaryDirectory(dir=path.absolute().parent, prefix=".pdr-") as folder:
        made = Path(folder) / path.stem
        with Writer(made, version=9, storage_plugin=plugin) as bag:
            for time, kind, message in _messages(track, geojson, store.types):
                if kind not in topics:
                    topics[kind] = bag.add_connection(TOPICS[kind], kind, typestore=store)
                bag.write(topics[kind], time, store.serialize_cdr(message, kind))
        (made / f"{path.stem}.mcap" if single else made).replace(path)


def _messages(track: Trajectory, geojson: str, types: Any) -> Iterator[tuple[int, str, Any]]:
    """Time [ns], type and content of each message, in order of time."""
    covariance = np.zeros((len(track), 3, 3)) if track.covariance is None else np.nan_to_num(track.covariance)
    lonlat, eastward = _on_earth(track, geojson) if geojson else (np.empty((0, 2)), 1.0 + 0j)
    turn = np.array([[eastward.real, -eastward.imag], [eastward.imag, eastward.real]])  # from the frame's axes to ENU
    point, quaternion = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    pose, certain = types["geometry_msgs/msg/Pose"], types["geometry_msgs/msg/PoseWithCovariance"]
    clock, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    for n, stamp in enumerate(np.round(track.time / NANOSECOND).astype(np.int64).tolist()):
        at, (x, y) = clock(*divmod(stamp, 10**9)), track.position[n].tolist()
        half = float(np.nan_to_num(track.heading[n])) / 2
        if n == 0 and geojson:
            yield stamp, GEOJSON_MESSAGE, types[GEOJSON_MESSAGE](geojson)
        six = np.zeros((6, 6))
        six[np.ix_(PLANAR, PLANAR)] = covariance[n]
        facing = (
            quaternion(0.0, 0.0, math.sin(half), math.cos(half)) if half == half else quaternion(0.0, 0.0, 0.0, 1.0)
        )
        yield stamp, POSED, types[POSED](header(at, MAP), certain(pose(point(x, y, 0.0), facing), six.ravel()))
        if geojson:
            flat = np.zeros((3, 3))
            flat[:2, :2] = turn @ covariance[n][:2, :2] @ turn.T
            yield stamp, FIX, types[FIX](at, MAP, *lonlat[n, ::-1].tolist(), 0.0, flat.ravel(), KNOWN)


def _on_earth(track: Trajectory, geojson: str) -> tuple[Array, complex]:
    """Longitude and latitude ``(n, 2)`` [deg] of each row, and the rotation of the frame's axes to east and north."""
    lonlat = np.array(json.loads(geojson)["features"][0]["geometry"]["coordinates"])[:, :2]
    if len(lonlat) != len(track):
        found, expected = f"{len(lonlat)} points", f"{len(track)} as in trajectory.csv: files of one walk"
        raise InputError("trajectory.geojson", "", found, expected)
    here, there = (p[:, 0] + 1j * p[:, 1] for p in (track.position, enu(*lonlat[0, ::-1]).from_lonlat(lonlat)))
    rotation = np.vdot(here - here.mean(), there - there.mean())
    return lonlat, complex(rotation / abs(rotation)) if abs(rotation) else 1.0 + 0j
