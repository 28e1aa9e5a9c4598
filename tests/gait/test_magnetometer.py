"""The magnetometer in exactly known fields."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pdr_graph.frames import EarthField, earth_field
from pdr_graph.gait.compass import (
    dip_error,
    field_in_world,
    fit_iron,
    magnetic_north,
    predicted_field,
    prediction_error,
)
from pdr_graph.inertial.attitude import Attitude

PERIOD = 0.02
EARTH = EarthField(magnitude=48.0, declination=0.1, dip=1.0)
SOFT = np.eye(3) + 0.05 * np.array([[1.0, 0.5, 0.2], [0.5, -1.0, 0.3], [0.2, 0.3, 0.4]])
HARD = np.array([30.0, -120.0, 60.0])


def measured(turned, noise=0.5):
    """Samples of a phone with hard and soft iron in a constant field."""
    field = turned.inv().apply(EARTH.vector) @ np.linalg.inv(SOFT) + HARD
    return field + np.random.default_rng(0).normal(0, noise, field.shape)


def walk_with(yaw, disturbance=0.0):
    """Attitude of a level phone with this yaw, in a world rotated by 0.7 rad, and the field in device axes."""
    truth = Rotation.from_euler("z", np.asarray(yaw)[:, None])
    attitude = Attitude(
        PERIOD * np.arange(len(yaw)), PERIOD, Rotation.from_euler("z", 0.7) * truth, np.zeros((len(yaw), 3)), None
    )
    return attitude, truth.inv().apply(EARTH.vector + disturbance)


def test_the_earths_field_is_that_of_noaas_calculator():
    """Nuremberg at the end of 2026, by NOAA's calculator: 48.9 µT, 65.3° down, 4.2° east."""
    field = earth_field(49.45, 11.08, 1.797e9)
    assert field.magnitude == pytest.approx(48.9, abs=0.3)
    assert np.degrees(field.dip) == pytest.approx(65.3, abs=0.4)
    assert np.degrees(field.declination) == pytest.approx(4.2, abs=0.4)
    assert np.linalg.norm(field.vector) == pytest.approx(field.magnitude)


@pytest.mark.parametrize("epoch", [None, 0.0, 1.2e9, 1.9e9, 4e9])
def test_any_date_has_a_field(epoch):
    assert 20 < earth_field(35.0, 135.0, epoch).magnitude < 70


def test_iron_is_determined_by_all_orientations():
    iron = fit_iron(measured(Rotation.random(3000, random_state=1)), EARTH.magnitude)
    assert iron.reliable
    assert iron.hard == pytest.approx(HARD, abs=4 * iron.sigma.max())
    assert iron.hard == pytest.approx(HARD, abs=0.5)
    assert iron.soft == pytest.approx(SOFT, abs=0.01)
    assert np.linalg.norm(iron.corrected(measured(Rotation.random(50))), axis=1) == pytest.approx(48.0, abs=3.0)


def test_a_passing_magnet_does_not_bias_the_fit_of_iron():
    field = measured(Rotation.random(3000, random_state=1))
    field[:300] += [90.0, 0.0, 0.0]
    assert fit_iron(field, EARTH.magnitude).hard == pytest.approx(HARD, abs=3.0)


def test_iron_is_unreliable_after_rotation_about_one_axis():
    """The component along that axis is not determined, since the field may point up or down."""
    iron = fit_iron(measured(Rotation.from_euler("z", np.linspace(0, 20, 2000)[:, None])), EARTH.magnitude)
    assert not iron.reliable
    assert iron.hard[:2] == pytest.approx(HARD[:2], abs=3.0)


def test_iterations_of_a_fit_of_iron_converge():
    """For a phone turned all ways in 50 µT with hard iron of 20 and −30 µT, and for one that was hardly turned."""
    random = np.random.default_rng(1)
    for spread, reliable in ((3.0, True), (0.3, False)):
        way = random.normal([0, 0, 1], spread, (500, 3))
        field = 50 * way / np.linalg.norm(way, axis=1, keepdims=True) + [20, 0, -30] + random.normal(0, 0.5, (500, 3))
        fit, rounds = fit_iron(field, 50.0), None
        for _ in range(10):
            rounds = fit_iron(field, 50.0, rounds, 3)
        assert rounds.hard == pytest.approx(fit.hard, abs=1e-3)
        assert rounds.reliable == fit.reliable == reliable


def test_the_gyroscope_predicts_the_field():
    """[gps-dr] Eqs. (1)–(3) against the exact rotation: the error is of second order."""
    random = np.random.default_rng(0)
    rate, field = random.normal(0, 1.0, (50, 3)), random.normal(0, 30.0, (50, 3))
    exact = Rotation.from_rotvec(-rate * 0.01).apply(field)
    assert np.abs(predicted_field(field, rate, 0.01) - exact).max() < np.linalg.norm(field, axis=1).max() * 5e-4
    assert np.abs(predicted_field(field, rate, 0.01) - field).max() > 0.5


def test_an_undisturbed_field_passes_both_tests_however_the_phone_turns():
    attitude, device = walk_with(np.linspace(0, 9, 800))
    world = field_in_world(attitude, device)
    assert dip_error(world, EARTH.dip).max() < 1e-6
    assert prediction_error(world, PERIOD).max() < 1e-6


def test_a_field_that_turns_without_the_phone_fails_the_prediction():
    attitude, device = walk_with(np.zeros(1000))
    passing = Rotation.from_euler("z", np.clip(np.arange(1000) - 500, 0, 50)[:, None] * 0.02)  # a radian in a second
    error = prediction_error(field_in_world(attitude, passing.apply(device)), PERIOD)
    assert error[:440].max() < 0.01
    assert error[540:550].min() > 0.3


def test_north_is_true_north():
    """With declination: magnetic north is 0.1 rad to the right of true north."""
    attitude, device = walk_with(np.linspace(0, 6, 3000))
    north = magnetic_north(attitude, device, EARTH)
    assert north.direction == pytest.approx(np.pi / 2 + 0.7, abs=1e-6)
    assert np.all(north.sigma < 0.2)


def test_north_is_bridged_past_steel():
    """In a third of the walk the field dips too much; its observations are not used, and sigma grows."""
    yaw = np.linspace(0, 6, 6000)
    attitude, device = walk_with(yaw)
    _, bent = walk_with(yaw, np.array([25.0, 0.0, -60.0]))
    device[2000:4000] = bent[2000:4000]
    north = magnetic_north(attitude, device, EARTH)
    assert north.direction == pytest.approx(np.pi / 2 + 0.7, abs=0.05)
    assert north.sigma[60] > north.sigma[30]


def test_a_dead_magnetometer_gives_no_north():
    """All zeros, also on the magnetic equator, where the dip is right."""
    attitude, device = walk_with(np.linspace(0, 6, 3000))
    for dip in (0.0, 1.0):
        assert len(magnetic_north(attitude, np.zeros_like(device), EarthField(40.0, 0.0, dip))) == 0


def test_the_sigma_of_north_is_honest():
    """Over 200 walks past steel that changes every few metres, errors in sigmas have a spread of about 1."""
    errors = []
    for seed in range(200):
        random = np.random.default_rng(seed)
        steel = np.repeat(random.normal(0, 4.0, (24, 3)), 125, axis=0)  # of 2.5 s each
        attitude, device = walk_with(np.linspace(0, 6, 3000), steel)
        north = magnetic_north(attitude, device, EARTH)
        errors.append((north.direction[30] - np.pi / 2 - 0.7) / north.sigma[30])
    assert 0.5 < np.std(errors) < 1.2
