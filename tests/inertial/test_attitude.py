"""Rest detection, and the gyroscope's bias at rest."""

import numpy as np
import pytest

from pdr_graph.inertial.attitude import at_rest, bias_from_rests
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

PERIOD = 0.02


@pytest.fixture
def random():
    return np.random.default_rng(0)


def table_then_walk(random, still=500, moving=500):
    rate = random.normal(0, 0.002, (still + moving, 3))
    force = random.normal(0, 0.02, (still + moving, 3)) + np.array([0, 0, 9.81])
    rate[still:] += random.normal(0, 0.5, (moving, 3))
    force[still:] += random.normal(0, 2.0, (moving, 3))
    return rate, force


def test_rest_is_detected_with_any_bias(random):
    rate, force = table_then_walk(random)
    for bias in (0.0, 0.05):
        rest = at_rest(rate + bias, 1.02 * force, PERIOD)
        assert rest[30:470].all()
        assert not rest[520:].any()


def test_a_phone_in_a_hand_is_not_at_rest():
    """A standing person moves the phone by more than the noise of its sensors."""
    walk = simulate(Scenario.of({"route": [[0, 0], {"stand": 30}, [5, 0]], "phone": {"rate": 50, "lost": 0}}))
    standing = slice(0, 1400)
    acceleration, rate = (walk.signals[name].values[standing] for name in ("accelerometer", "gyroscope"))
    assert at_rest(rate, acceleration, PERIOD).mean() < 0.05


def test_the_bias_is_linear_between_rests(random):
    """It drifts by 0.01 rad/s between two rests half an hour apart; half-way it is half of that."""
    n = 90_000
    drift = np.linspace(0.01, 0.02, n)[:, None] * [1.0, -1.0, 0.5]
    rate, rest = drift + random.normal(0, 0.002, (n, 3)), np.zeros(n, bool)
    rest[:1000] = rest[-1000:] = True
    rate[~rest] += random.normal(0, 1.0, (np.sum(~rest), 3))
    bias = bias_from_rests(rate, rest, PERIOD)
    assert bias == pytest.approx(drift, abs=0.0005)


def test_a_calm_moment_is_not_rest_and_without_a_rest_the_bias_is_zero(random):
    rate, force = table_then_walk(random, still=50)
    rest = at_rest(rate, force, PERIOD)
    assert not rest.any()
    assert not bias_from_rests(rate, rest, PERIOD).any()
