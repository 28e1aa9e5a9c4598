"""Published attitude filters and strapdown navigation, compared with truth, with kinematics and with each other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph import InputError
from pdr_graph.inertial.attitude import Attitude, attitude_of
from pdr_graph.lab.papers import attitude_filters
from pdr_graph.lab.papers.attitude_filters import on_one_grid, strapdown
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Recording, Signal

NAMES = ("accelerometer", "gyroscope", "magnetometer")
ALL = {**attitude_filters.ATTITUDE_FILTERS, "VQF offline": attitude_of}
MAGNETIC = ("accelerometer + magnetometer", "MARG filter", "VQF, 9-D")
# [deg] median tilt error of a phone in the hand, 95 % quantile of each method
TILT = {"accelerometer + magnetometer": 12.0, "gyro integration": 9.0, "IMU filter": 4.0, "MARG filter": 4.0}


@pytest.fixture(scope="module")
def walk():
    """A walk with the phone in the hand, in a disturbed field."""
    route = [[0, 0], {"stand": 4}, {"to": [[40, 0], [40, 30]]}, {"stand": 3}]
    return simulate(Scenario.of({"seed": 2, "route": route, "phone": {"disturbance": 2.0}}))


@pytest.fixture(scope="module")
def recording(walk):
    return walk.recording(*NAMES)


def against_truth(walk, attitude):
    """Tilt error ``(n,)`` and rotation of the attitude's world against the true one ``(n,)``, both [deg]."""
    world = walk.world_of(attitude)
    up, east = world.apply([0.0, 0.0, 1.0]), world.apply([1.0, 0.0, 0.0])
    tilt = np.degrees(np.arccos(np.clip(up[:, 2], -1, 1)))
    return tilt, np.degrees(np.unwrap(np.arctan2(east[:, 1], east[:, 0])))


@pytest.mark.parametrize("name", ALL)
def test_every_method_estimates_the_vertical_and_keeps_its_horizontal_axes(walk, recording, name):
    """With a magnetometer x is magnetic east: at 35° N, 135° E a compass points 8° to the west of true north."""
    tilt, turned = against_truth(walk, ALL[name](recording))
    assert np.median(tilt[300:]) < TILT.get(name, 3.0)
    if name in MAGNETIC:
        assert np.median(turned[300:]) == pytest.approx(-8.0, abs=12.0)
    else:
        assert np.ptp(turned[300:]) < 25.0
        assert np.abs(np.diff(turned)).max() < 2.0


def test_integration_is_the_product_of_all_rotations(recording):
    """From any start attitude."""
    start = Rotation.from_euler("xyz", [2.0, 1.0, 0.5])
    attitude = attitude_filters.gyro_integration(recording, start)
    rate, turned = attitude.angular_rate, start
    for step in Rotation.from_rotvec((rate[:-1] + rate[1:]) / 2 * attitude.period):
        turned = turned * step
    assert (attitude.R_world_device[0].inv() * start).magnitude() < 1e-9
    assert (turned.inv() * attitude.R_world_device[-1]).magnitude() < 1e-7


FILTERS = {
    "accelerometer + magnetometer": lambda period: attitude_filters.AccelerometerMagnetometer(),
    "gyro integration": attitude_filters.GyroIntegration,
    "gravity filter": attitude_filters.GravityFilter,
    "IMU filter": lambda period: attitude_filters.Madgwick(period, magnetometer=False),
    "MARG filter": lambda period: attitude_filters.Madgwick(period, magnetometer=True),
    "VQF, 6-D": lambda period: attitude_filters.Vqf(period, magnetometer=False),
    "VQF, 9-D": lambda period: attitude_filters.Vqf(period, magnetometer=True),
    "switching": lambda period: attitude_filters.Switching(period, 0.1),
    "switching after a rest": lambda period: attitude_filters.Switching(period, 0.3, 20),
}


@pytest.mark.parametrize("name", FILTERS)
def test_samples_one_by_one_give_the_same_as_all_at_once(recording, name):
    """Ten seconds, four of them at rest: no attitude depends on later samples."""
    _, period, values = on_one_grid(recording, *NAMES)
    values = [v[:1000] for v in values]
    whole = FILTERS[name](period).update(attitude_filters.Samples(*values))
    for cuts in (np.arange(1, 1000), np.array([1, 3, 7, 500, 519, 990])):
        live = FILTERS[name](period)
        parts = zip(*(np.split(v, cuts) for v in values), strict=True)
        pieces = Rotation.concatenate([live.update(attitude_filters.Samples(*part)) for part in parts])
        assert (pieces.inv() * whole).magnitude().max() < 1e-6


def test_the_gravity_filter_equals_a_kalman_filter(recording):
    """Compared with the textbook filter of a constant vector with an unknown initial value."""
    _, period, values = on_one_grid(recording, *NAMES)
    samples = attitude_filters.Samples(*(v[:1500] for v in values))
    drifting = attitude_filters.GyroIntegration(period).update(samples)
    Q, R = attitude_filters.GRAVITY_PROCESS**2 * period, attitude_filters.GRAVITY_NOISE**2 * max(period * 50, 1.0)
    g, P = np.zeros(3), 1e12
    for z in drifting.apply(samples.acceleration):
        P = P + Q
        g, P = g + P / (P + R) * (z - g), P * R / (P + R)
    up = attitude_filters.GravityFilter(period).update(samples)[-1].inv().apply([0.0, 0.0, 1.0])
    assert drifting[-1].inv().apply(g / np.linalg.norm(g)) == pytest.approx(up, abs=1e-5)


def test_a_switch_at_rest_removes_the_drift():
    """A phone at rest, turned by hand, at rest again: the gyroscope drifts, the switch does not."""
    n, rate = 3000, 50.0
    time_ = np.arange(n) / rate
    angle = np.clip((time_ - 20) / 4, 0, 1) * 1.5
    turned = Rotation.from_euler("x", angle[:, None])
    force, field = turned.inv().apply([0, 0, 9.81]), turned.inv().apply([0.0, 30.0, -35.0])
    omega = np.gradient(angle)[:, None] * rate * [1.0, 0, 0] + 0.004
    signals = {name: Signal(time_, values) for name, values in zip(NAMES, (force, omega, field), strict=True)}
    lying = Recording("turned", 0.0, None, **signals)
    drifted, switched = attitude_filters.switching(lying, 0.0), attitude_filters.switching(lying, 0.01)
    errors = [(turned[n - 1].inv() * a.R_world_device[-1]).magnitude() for a in (drifted, switched)]
    assert errors[0] > 0.2 > 0.01 > errors[1]


def test_a_missing_sensor_is_named(recording):
    without = Recording("walk", 0.0, None, accelerometer=recording.accelerometer, gyroscope=recording.gyroscope)
    for name in MAGNETIC:
        with pytest.raises(InputError, match="magnetometer: found no samples"):
            ALL[name](without)


# Strapdown navigation

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


def test_look_ahead_removes_a_constant_error_between_two_rests():
    """A tilt adds a constant part of gravity; before the first and after the last rest nothing is removed."""
    attitude, between = pushed(bias=0.05)
    assert strapdown(attitude, between, look_ahead=True).position[-1, 0] == pytest.approx(0.5, abs=0.01)
    for rest in (TIME < 2, TIME >= 4, TIME < 0):
        expected = strapdown(attitude, rest).position
        assert strapdown(attitude, rest, look_ahead=True).position == pytest.approx(expected)
