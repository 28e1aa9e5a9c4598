"""The plain simulator: its sensors fit its truth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph import io
from pdr_graph.simulation.walk import GYRO_BIAS, PITCH, walk_along, write

ROUTE = np.array([(0.0, 0.0), (15.0, 0.0), (15.0, 10.0)])


@pytest.fixture(scope="module")
def walk():
    return walk_along(ROUTE, seed=2)


def test_it_stands_still_before_and_after(walk):
    """A second at either end: only gravity, the gyro only its bias."""
    for still in (walk.time < 1.0, walk.time > walk.time[-1] - 1.0):
        assert np.linalg.norm(walk.acceleration[still].mean(axis=0)) == pytest.approx(9.81, abs=0.05)
        assert walk.angular_rate[still].mean(axis=0) == pytest.approx(GYRO_BIAS, abs=0.03)


def test_it_follows_its_route(walk):
    assert walk.position[0] == pytest.approx(ROUTE[0], abs=0.01)
    assert walk.position[-1] == pytest.approx(ROUTE[-1], abs=0.01)
    assert walk.heading[-1] - walk.heading[0] == pytest.approx(np.pi / 2, abs=0.02)


def test_the_gyro_turns_as_the_walker_does(walk):
    """Integrated about the pitched phone's vertical, less the bias: a quarter turn, give or take the phone's wander."""
    up = Rotation.from_euler("X", -PITCH).apply([0.0, 0.0, 1.0])
    turned = np.sum((walk.angular_rate - GYRO_BIAS) @ up) / 50.0
    assert turned == pytest.approx(np.pi / 2, abs=0.25)


def test_the_same_seed_is_the_same_walk(walk):
    assert np.array_equal(walk_along(ROUTE, seed=2).acceleration, walk.acceleration)
    assert not np.array_equal(walk_along(ROUTE, seed=3).acceleration, walk.acceleration)


def test_written_files_read_back(walk, tmp_path):
    write(walk, tmp_path)
    recording = io.load(tmp_path / "walk.txt")
    assert recording.accelerometer.values == pytest.approx(walk.acceleration, abs=1e-6)
    assert recording.gyroscope.time == pytest.approx(walk.time, abs=1e-3)
    assert recording.truth.position[0] == pytest.approx([0, 0], abs=0.01)
