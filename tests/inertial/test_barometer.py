"""Climbs from air pressure in weather, gusts and noise; their kinds, and the steps on stairs."""

import numpy as np
import pytest
from walks import PERIOD, steps_of

from pdr_graph.inertial.barometer import Climbs, climb_kinds, climbed_share, climbs, height_of, with_stair_lengths
from pdr_graph.types import Signal, Steps

# The 1976 standard atmosphere at 15 °C; air of 20 °C as ours is thicker by 1.7 % for the same pressures.
WARMER = 293.15 / 288.15


def standard_pressure(height):
    return 1013.25 * (1 - 2.25577e-5 * height) ** 5.25588


def barometer(*corners, rate=5.0, noise=0.01, seed=0, weather=0.0, gusts=(), gust=0.5):
    """Samples of a height with corners (time [s], height [m]); weather [hPa/h]; gusts: starts of 3 s each [s]."""
    random = np.random.default_rng(seed)
    time = np.arange(0, corners[-1][0], 1 / rate)
    pressure = standard_pressure(100 + np.interp(time, *np.array(corners).T))
    pressure += random.normal(0, noise, len(time)) + weather * time / 3600
    for at in gusts:
        pressure += gust * ((time > at) & (time < at + 3.0))
    return Signal(time, pressure[:, None])


FLAT = ((0, 0), (600, 0))
STAIRS = ((0, 0), (60, 0), (74, 3.6), (140, 3.6))
LIFT = ((0, 0), (60, 0), (66, -7.2), (140, -7.2))


def test_heights_are_those_of_the_standard_atmosphere():
    heights = np.array([0.0, 3.6, 36.0, -10.0])
    assert height_of(standard_pressure(heights)) == pytest.approx(heights * WARMER, rel=0.002)


@pytest.mark.parametrize(("rate", "noise"), [(1.0, 0.03), (5.0, 0.01), (10.0, 0.05), (20.0, 0.1), (100.0, 0.1)])
@pytest.mark.parametrize("corners", [STAIRS, LIFT])
@pytest.mark.parametrize("seed", range(4))
def test_a_climb_is_found_and_measured(corners, rate, noise, seed):
    found = climbs(barometer(*corners, rate=rate, noise=noise, seed=seed))
    (start, end), risen = (corners[1][0], corners[2][0]), corners[2][1] * WARMER
    assert len(found) == 1
    assert found.height[0] == pytest.approx(risen, abs=4 * found.sigma[0])
    assert found.sigma[0] < 0.6, "half a metre distinguishes a landing from a floor"
    assert found.start[0] == pytest.approx(start, abs=5), "as accurate as the noise permits"
    assert found.end[0] == pytest.approx(end, abs=5)


@pytest.mark.parametrize("weather", [-1.0, 1.0])
@pytest.mark.parametrize(("rate", "noise"), [(1.0, 0.01), (10.0, 0.03), (20.0, 0.1)])
def test_weather_and_gusts_are_not_climbs(rate, noise, weather):
    for seed in range(5):
        signal = barometer(*FLAT, rate=rate, noise=noise, seed=seed, weather=weather, gusts=(100, 200, 300, 550))
        assert not len(climbs(signal))


LANDING = ((0, 0), (60, 0), (67, 1.8), (90, 1.8), (97, 3.6), (160, 3.6))
HOUR = ((0, 0), (60, 0), (74, 3.6), (3600, 3.6), (3614, 0), (3700, 0))
CLIMBS = {  # corners, disturbances, heights [m] and how well they are known [m]
    "an hour of weather between two climbs is not counted": (HOUR, {"weather": 1.0}, [3.6, -3.6], 0.3),
    "a gust on the stairs does not split the climb": (STAIRS, {"gusts": (66,)}, [3.6], 0.5),
    "a gust at the beginning is not a climb": (FLAT, {"gusts": (0.0,)}, [], 0.0),
    "nor is one at the end": (FLAT, {"gusts": (598.0,)}, [], 0.0),
    "a stop on the landing makes two climbs": (LANDING, {}, [1.8, 1.8], 0.3),
    "a phone taken from a pocket is not a climb": (((0, 0), (60, 0), (61, 0.6), (140, 0.6)), {}, [], 0.0),
}


@pytest.mark.parametrize("claim", CLIMBS)
def test_climbs_and_nothing_else_are_found(claim):
    corners, disturbed, heights, within = CLIMBS[claim]
    found = climbs(barometer(*corners, **disturbed)).height
    assert found == pytest.approx(WARMER * np.array(heights), abs=within)


def test_a_gap_in_the_barometer_hides_no_climb():
    signal = barometer(*STAIRS)
    seen = (signal.time < 55) | (signal.time > 80)
    (height,) = climbs(Signal(signal.time[seen], signal.values[seen])).height
    assert height == pytest.approx(3.6 * WARMER, abs=0.4)


def test_the_share_of_a_climb_rises_from_0_to_1():
    signal = barometer(*STAIRS)
    found = climbs(signal)
    at = np.linspace(0, 140, 500)
    (share,) = climbed_share(signal, found, at)
    assert share[0] == 0
    assert share[-1] == 1
    assert np.all(np.diff(share) >= 0)
    assert share[np.searchsorted(at, 67)] == pytest.approx(0.5, abs=0.08)


@pytest.mark.parametrize("samples", [0, 1, 3, 100])
def test_few_or_constant_samples_give_no_climbs(samples):
    assert not len(climbs(Signal(np.arange(samples, dtype=float), np.full((samples, 1), 1000.0))))


# Kinds


def walk(*times, start=0.0, end=200.0):
    time = np.array(times, dtype=float)
    count = len(time)
    column = np.full(count, 0.5)
    duration = np.minimum(0.5, np.diff(time, prepend=start))
    return Steps(start, end, time, duration, column, 0 * column, 0 * column, column, column)


def climb(height, seconds, start=50.0):
    return Climbs(*(np.array([v]) for v in (start, start + seconds, height, 0.2)))


WALKING = walk(*np.arange(1, 200, 0.5))
STANDING = walk(*np.arange(1, 49, 0.5), *np.arange(150, 190, 0.5))


@pytest.mark.parametrize(
    ("steps", "height", "seconds", "kind"),
    [
        (WALKING, 3.6, 12.0, "stairs"),  # 0.15 m a step
        (WALKING, -3.6, 16.0, "stairs"),
        (WALKING, 3.6, 6.0, "escalator"),  # walked up: 0.30 m a step
        (STANDING, 3.6, 12.0, "escalator"),
        (STANDING, 3.6, 5.0, "lift"),
        (STANDING, -30.0, 18.0, "lift"),
        (WALKING, 3.0, 40.0, "ramp"),  # 6 % at 1.25 m/s
        (WALKING, 3.0, 1.5, "draught"),  # 1 m a step: a door
        (walk(*np.arange(1, 51, 0.5), 55), 7.0, 8.0, "lift"),  # a few steps in it
        (walk(), 7.0, 8.0, "lift"),
    ],
)
def test_the_kind_of_a_climb(steps, height, seconds, kind):
    assert climb_kinds(steps, climb(height, seconds)) == (kind,)
    assert climb_kinds(steps, Climbs.none()) == ()


def climbed(height, kind):
    """Forty steps of 0.6 m, twenty of them during a climb."""
    steps = steps_of(np.full(40, 0.6), np.zeros(40))
    start, end = np.array([10 * PERIOD]), np.array([30 * PERIOD])
    return steps, with_stair_lengths(steps, Climbs(start, end, np.array([height]), np.array([0.3])), (kind,))


def test_stairs_of_17_cm_have_goings_of_29_cm():
    """Blondel's rule, 63 cm = 2 rises + going; the steps before and after do not change."""
    steps, found = climbed(20 * 0.17, "stairs")
    on = found.length != steps.length
    assert found.length[on] == pytest.approx(0.63 - 2 * 0.17, abs=0.02)
    assert np.flatnonzero(on)[[0, -1]] == pytest.approx([10, 30], abs=1)


def test_steps_down_are_as_long_as_steps_up():
    assert climbed(-3.0, "stairs")[1].length == pytest.approx(climbed(3.0, "stairs")[1].length)


@pytest.mark.parametrize("kind", ["lift", "escalator", "ramp", "draught"])
def test_steps_elsewhere_do_not_change(kind):
    steps, found = climbed(3.4, kind)
    assert found.length == pytest.approx(steps.length)
