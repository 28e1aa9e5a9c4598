"""A network of the user's own: what it is given, what is refused, and a small one that is fitted to simulated walks."""

import sys

import learned_nets
import numpy as np
import pytest
from onnx import helper
from refusals import refused
from scipy.spatial.transform import Rotation

from pdr_graph.gait.learned import CHANNELS, RATE, SAMPLES, Network, learned_velocities, windows_of
from pdr_graph.inertial.attitude import Attitude


def turning_phone(rate, seconds=5.0, spin=0.8):
    """A tilted phone that turns about the vertical, in a lift that accelerates: the same samples in the level frame."""
    time = np.arange(0, seconds, 1 / rate)
    R = Rotation.from_euler("z", spin * time[:, None]) * Rotation.from_euler("xyz", [0.7, -0.3, 0.2])
    world = np.array([0.0, 0.0, spin]), np.array([1.0, 2.0, 9.8])
    rate_of, acceleration = (R.inv().apply(np.tile(each, (len(time), 1))) for each in world)
    return Attitude(time, 1 / rate, R, acceleration, rate_of), np.concatenate(world)


@pytest.mark.parametrize("rate", [50.0, 200.0, 400.0])
def test_windows_are_level_samples_at_200_hz_gyroscope_first_whatever_the_phone_does(rate):
    attitude, world = turning_phone(rate)
    middle, windows = windows_of(attitude)
    assert windows.shape[1:] == (CHANNELS, SAMPLES)
    assert windows.dtype == np.float32
    assert np.allclose(windows, world[:, None], atol=2e-3)
    assert middle[0] == pytest.approx(SAMPLES / 2 / RATE)
    assert np.diff(middle) == pytest.approx(0.1)


def echo(path, shape=("N", CHANNELS, SAMPLES), made=("N", 2)):
    """A network that says the level acceleration of the last sample as velocity."""
    rows = {"from": np.array([3, 199]), "to": np.array([5, 200]), "axes": np.array([1, 2]), "flat": np.array([2])}
    nodes = [
        helper.make_node("Slice", ["samples", "from", "to", "axes"], ["last"]),
        helper.make_node("Squeeze", ["last", "flat"], ["velocity"]),
    ]
    learned_nets.save(path, nodes, rows, ["velocity"], shape, made)
    return path


@pytest.mark.parametrize("batch", ["N", 1, 7])
def test_velocities_are_those_of_the_network_in_their_time(tmp_path, batch):
    """Also of a network that was exported for a batch of one size."""
    attitude, world = turning_phone(100.0)
    network = Network(echo(tmp_path / "net.onnx", (batch, CHANNELS, SAMPLES), (batch, 2)))
    velocities, notes = learned_velocities([attitude, attitude], network)
    assert np.allclose(velocities.velocity, world[3:5], atol=2e-3)
    assert np.unique(velocities.frame).tolist() == [0, 1], "each uninterrupted part has its own level frame"
    assert (velocities.sigma > 0).all()
    assert notes == ()


def test_stated_log_sigmas_are_used(tmp_path):
    weights = np.zeros(8 * len(learned_nets.FREQUENCIES))
    network = Network(learned_nets.write_network(tmp_path / "net.onnx", weights, sigma=0.7, offset=(1.0, 0.0)))
    velocities, _ = learned_velocities([turning_phone(100.0)[0]], network)
    assert velocities.sigma == pytest.approx(0.7)
    assert velocities.velocity == pytest.approx(np.tile([1.0, 0.0], (len(velocities), 1)))


def test_windows_without_a_number_are_left_out_with_a_note(tmp_path):
    weights = np.zeros(8 * len(learned_nets.FREQUENCIES))
    network = Network(learned_nets.write_network(tmp_path / "net.onnx", weights, offset=(np.nan, 0.0)))
    velocities, notes = learned_velocities([turning_phone(100.0)[0]], network)
    assert len(velocities) == 0
    assert len(notes) == 2
    assert "of 40 windows have no usable velocity" in notes[0]


@pytest.mark.parametrize(
    ("shape", "made", "message"),
    [
        (("N", SAMPLES, CHANNELS), 2, r"input: found .*200, 6.*expected one input \[N, 6, 200\]"),
        (("N", CHANNELS, 400), 2, r"input: found .*6, 400"),
        (("N", CHANNELS, SAMPLES), 3, r"output: found .*3.*expected \[N, 2\]"),
        (("N", "channels", "samples"), 3, r"output: found \[40, 3\].*expected \[N, 2\]"),  # as it says when it runs
    ],
)
def test_no_shape_is_guessed(tmp_path, shape, made, message):
    rows = {"samples axis": np.array([2]), "channel axis": np.array([1]), "0": np.array([0]), "to": np.array([made])}
    nodes = [
        helper.make_node("ReduceSum", ["samples", "samples axis"], ["sum"], keepdims=0),
        helper.make_node("Slice", ["sum", "0", "to", "channel axis"], ["velocity"]),
    ]
    learned_nets.save(tmp_path / "net.onnx", nodes, rows, ["velocity"], shape, (None, None))
    refused(lambda net: learned_velocities([turning_phone(100.0)[0]], Network(net)), tmp_path / "net.onnx", message)


def test_what_is_no_network_is_refused(tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"PK\x03\x04 a zip")
    refused(Network, tmp_path / "net.onnx", "expected a network as ONNX")
    refused(Network, tmp_path / "none.onnx", "no such file")


def test_without_onnxruntime_one_line_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    refused(Network, tmp_path / "net.onnx", r"pip install \'\.\[learned\]\'")


def test_the_features_of_the_test_network_in_onnx_are_those_in_numpy(tmp_path):
    random = np.random.default_rng(1)
    windows = random.normal(0, 1, (50, CHANNELS, SAMPLES)).astype(np.float32)
    weights = random.normal(0, 1, 8 * len(learned_nets.FREQUENCIES))
    path = learned_nets.write_network(tmp_path / "net.onnx", weights)
    assert path.stat().st_size < 20_000
    velocity, log_sigma = Network(path)(windows)
    assert log_sigma is None
    assert velocity == pytest.approx(learned_nets.features(windows) @ weights, abs=1e-3)
