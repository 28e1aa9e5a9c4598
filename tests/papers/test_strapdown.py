"""Strapdown navigation compared with kinematics."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph.inertial.attitude import Attitude
from pdr_graph.lab.papers.attitude_filters import strapdown

PERIOD = 0.01
TIME = np.arange(0.0, 8.0, PERIOD)


def pushed(bias=0.0):
    """At rest for 2 s, 0.5 m/s² for one second, −0.5 m/s² for another, at rest again."""
    along = np.where((TIME >= 2) & (TIME < 3), 0.5, np.where((TIME >= 3) & (TIME < 4), -0.5, 0.0))
    turned = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])
    force = turned.inv().apply(np.column_stack([along + bias, np.zeros_like(along), np.full_like(along, 9.79)]))
    rest = (TIME < 2) | (TIME >= 4)
    return Attitude(TIME, PERIOD, Rotation.concatenate([turned] * len(TIME)), force, np.zeros_like(force)), rest


def test_the_second_integral_of_the_acceleration_is_the_displacement():
    attitude, rest = pushed()
    found = strapdown(attitude, rest)
    assert found.position[-1] == pytest.approx([0.5, 0.0, 0.0], abs=0.01)
    assert found.velocity[:, 0].max() == pytest.approx(0.5, abs=0.01)
    assert not found.velocity[rest][1:199].any()


def test_a_bias_grows_quadratically_without_rests():
    """[stationary-switch] Fig.: λ = 0 drifts with half the bias times the time squared."""
    attitude, rest = pushed(bias=0.05)
    free, held = strapdown(attitude, np.zeros_like(rest)), strapdown(attitude, rest)
    assert free.position[-1, 0] - 0.5 == pytest.approx(0.05 * 8**2 / 2, rel=0.02)
    assert held.position[-1, 0] == pytest.approx(0.5 + 0.05 * 2**2 / 2, abs=0.02)


def test_look_ahead_removes_a_constant_error():
    """A tilt adds a constant part of gravity; the displacement between two rests is exact."""
    attitude, rest = pushed(bias=0.05)
    assert strapdown(attitude, rest, look_ahead=True).position[-1, 0] == pytest.approx(0.5, abs=0.01)


def test_look_ahead_requires_a_rest_on_both_sides():
    """Before the first and after the last rest it has no effect."""
    attitude, _ = pushed(bias=0.05)
    for rest in (TIME < 2, TIME >= 4, TIME < 0):
        here, ahead = strapdown(attitude, rest), strapdown(attitude, rest, look_ahead=True)
        assert ahead.position == pytest.approx(here.position)
