"""A sample of `recorders` as bags of ROS 2: MCAP by Foxglove's writer, rosbag2 by rosbags."""

import numpy as np
import recorders
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from pdr_graph.io.validation import RADIUS_68

STORE = get_typestore(Stores.ROS2_HUMBLE)
IMU, FIELD = "sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField"
FIX, PRESSURE = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/FluidPressure"
TOPICS = {IMU: "/phone/imu", FIELD: "/phone/mag", FIX: "/phone/fix", PRESSURE: "/phone/pressure"}


def vector(values):
    return dict(zip("xyz", map(float, values), strict=True))


def messages(s, stamped=True):
    """Time [ns], type and content of each message of a sample; stamped: False without times in the headers."""
    pressures = zip(s.time, s.pressure.tolist(), strict=True)
    for time, kind, content in [
        *((t, IMU, {"a": a, "w": w}) for t, a, w in zip(s.time, s.acceleration, s.angular_rate, strict=True)),
        *((t, FIELD, {"magnetic_field": vector(1e-6 * b)}) for t, b in zip(s.time, s.field, strict=True)),
        *((t, PRESSURE, {"fluid_pressure": 100 * p, "variance": 0.0}) for t, p in pressures),
        *((t, FIX, {"p": p, "r": r}) for t, p, r in zip(s.fix_time, s.lonlat, s.accuracy, strict=True)),
    ]:
        ns = round((recorders.UNIX + time) * 1e6) * 1000
        stamp = dict(zip(("sec", "nanosec"), divmod(ns, 10**9) if stamped else (0, 0), strict=True))
        header = {"stamp": stamp, "frame_id": "phone"}
        zero = [0.0] * 9
        if kind == IMU:
            content = {
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                "orientation_covariance": [-1.0, *zero[1:]],
                "angular_velocity": vector(content["w"]),
                "angular_velocity_covariance": zero,
                "linear_acceleration": vector(content["a"]),
                "linear_acceleration_covariance": zero,
            }
        elif kind == FIELD:
            content |= {"magnetic_field_covariance": zero}
        elif kind == FIX:
            variance = float(content["r"] / RADIUS_68) ** 2
            content = {
                "status": {"status": 0, "service": 1},
                "latitude": float(content["p"][1]),
                "longitude": float(content["p"][0]),
                "altitude": 0.0,
                "position_covariance": [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, 9.0],
                "position_covariance_type": 2,
            }
        yield ns, kind, {"header": header, **content}


def by_foxglove(path, s, stamped=True):
    """A file of MCAP by Foxglove's writer."""
    with path.open("wb") as file, McapWriter(file) as bag:
        schemas = {k: bag.register_msgdef(k, STORE.generate_msgdef(k, ros_version=2)[0]) for k in TOPICS}
        for ns, kind, content in sorted(messages(s, stamped), key=lambda row: row[0]):
            bag.write_message(TOPICS[kind], schemas[kind], content, log_time=ns, publish_time=ns)
    return path


def built(kind, content):
    """A message of rosbags of a dictionary."""
    fields = {}
    for name, (node, detail) in STORE.fielddefs[kind][1]:
        value = content[name]
        fields[name] = built(detail, value) if int(node) == 2 else np.array(value) if int(node) == 3 else value
    return STORE.types[kind](**fields)


def by_rosbags(path, s):
    """A folder of rosbag2 with a SQLite file."""
    with Writer(path, version=8) as bag:
        connections = {k: bag.add_connection(topic, k, typestore=STORE) for k, topic in TOPICS.items()}
        for ns, kind, content in messages(s):
            bag.write(connections[kind], ns, STORE.serialize_cdr(built(kind, content), kind))
    return path
