"""Bags of ROS 2: sensors in as another library writes them, walks out as another library reads them."""

import json
import sys

import numpy as np
import pytest
import recorders
from bags import by_foxglove, by_rosbags
from commands import run
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as McapWriter
from refusals import refused
from scipy.spatial.transform import Rotation

from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory
from pdr_graph.io.validation import RADIUS_68


@pytest.fixture(scope="module")
def sampled():
    return recorders.sample()


def assert_is_the_walk(walk, s):
    assert walk.epoch == pytest.approx(recorders.UNIX + s.time[0], abs=1e-3)
    for signal, values in (
        (walk.accelerometer, s.acceleration),
        (walk.gyroscope, s.angular_rate),
        (walk.magnetometer, s.field),
        (walk.barometer, s.pressure[:, None]),
    ):
        assert signal.time == pytest.approx(s.time - s.time[0], abs=2e-5)
        assert signal.values == pytest.approx(values, abs=1e-6)
    assert walk.fixes.position == pytest.approx(s.lonlat, abs=1e-9)
    assert walk.fixes.sigma == pytest.approx(s.accuracy / RADIUS_68)


@pytest.mark.parametrize("stamped", [True, False], ids=["header's stamps", "times of the log"])
def test_mcap_of_another_writer_is_read(tmp_path, sampled, stamped):
    assert_is_the_walk(load(by_foxglove(tmp_path / "walk.mcap", sampled, stamped)), sampled)


def test_rosbag2_is_read_as_a_folder_and_as_its_file(tmp_path, sampled):
    folder = by_rosbags(tmp_path / "walk", sampled)
    assert_is_the_walk(load(folder), sampled)
    assert_is_the_walk(load(next(folder.glob("*.db3"))), sampled)


def test_a_damaged_bag_and_one_without_sensors_are_refused(tmp_path, sampled):
    whole = by_foxglove(tmp_path / "walk.mcap", sampled).read_bytes()
    (tmp_path / "half.mcap").write_bytes(whole[: len(whole) // 2])
    refused(load, tmp_path / "half.mcap", "a bag that cannot be read")
    with (tmp_path / "words.mcap").open("wb") as file, McapWriter(file) as bag:
        schema = bag.register_msgdef("std_msgs/msg/String", "string data")
        bag.write_message("/words", schema, {"data": "hello"}, log_time=1, publish_time=1)
    refused(load, tmp_path / "words.mcap", "messages std_msgs/msg/String", "sensor_msgs/msg/Imu")


def test_without_the_extra_a_bag_is_refused_with_its_name(tmp_path, sampled, monkeypatch):
    by_foxglove(tmp_path / "walk.mcap", sampled)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    refused(load, tmp_path / "walk.mcap", "no rosbags to read it", "the extra ros")


def test_a_walk_is_read_by_foxglove_as_it_was_written(tmp_path, sampled):
    """smooth reads a bag, export writes one; Foxglove's decoder is the judge."""
    by_foxglove(tmp_path / "walk.mcap", sampled)
    run("smooth", "walk.mcap", "--no-report", "--out", "result", cwd=tmp_path)
    assert run("export", "result", "--out", "track.mcap", cwd=tmp_path).code == 0
    track = read_trajectory(tmp_path / "result" / "trajectory.csv")
    line = json.loads((tmp_path / "result" / "trajectory.geojson").read_text())
    seen = {name: [] for name in ("pose", "location", "geojson")}
    with (tmp_path / "track.mcap").open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            seen[channel.topic.rsplit("/", 1)[1]].append(message)
    assert json.loads(seen["geojson"][0].geojson) == line
    stamps = [pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec for pose in seen["pose"]]
    assert stamps == pytest.approx(track.time, abs=1e-6)
    poses = [pose.pose.pose for pose in seen["pose"]]
    assert np.array([(p.position.x, p.position.y) for p in poses]) == pytest.approx(track.position)
    turns = Rotation.from_quat([[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in poses])
    assert np.exp(1j * turns.as_euler("xyz")[:, 2]) == pytest.approx(np.exp(1j * track.heading))
    stated = np.array([pose.pose.covariance for pose in seen["pose"]]).reshape(-1, 6, 6)
    assert stated[:, [[0], [1], [5]], [0, 1, 5]] == pytest.approx(track.covariance)
    places = np.array([(fix.longitude, fix.latitude) for fix in seen["location"]])
    assert places == pytest.approx(np.array(line["features"][0]["geometry"]["coordinates"]), abs=1e-8)
    enu = np.array([fix.position_covariance for fix in seen["location"]]).reshape(-1, 3, 3)
    assert enu[:, :2, :2] == pytest.approx(track.covariance[:, :2, :2], abs=1e-3), "its frame is east and north"


def test_a_walk_as_a_folder_of_rosbag2_and_covariances_of_a_turned_frame(tmp_path):
    """A plan that lies across: what is uncertain along its x is uncertain to the north on the map."""
    from rosbags.highlevel import AnyReader

    from pdr_graph.io import ros_bags
    from pdr_graph.types import Trajectory

    x = np.linspace(0.0, 9.0, 10)
    covariance = np.tile(np.diag([4.0, 1.0, 0.01]), (10, 1, 1))
    track = Trajectory(1.7e9 + x, np.column_stack([x, 0 * x]), 0 * x, ("",) * 10, covariance)
    north = recorders.FRAME.to_lonlat(np.column_stack([0 * x, x])).tolist()
    drawn = {"type": "FeatureCollection", "features": [{"geometry": {"type": "LineString", "coordinates": north}}]}
    ros_bags.write(tmp_path / "bag", track, json.dumps(drawn))
    with AnyReader([tmp_path / "bag"]) as bag:
        fixes = [bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages() if c.msgtype.endswith("LocationFix")]
    assert len(fixes) == 10
    assert fixes[0].position_covariance.reshape(3, 3)[:2, :2] == pytest.approx(np.diag([1.0, 4.0]), abs=1e-6)
