"""Floors of real walks: a museum's stairs, and walks that stayed on one floor. Landmarks only score."""

import numpy as np
import pytest

from pdr_graph import detect_steps
from pdr_graph.estimation.floors import floors_along
from pdr_graph.inertial.barometer import climbs
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes, Signal


def of(path, start):
    walk = load(path)
    steps = detect_steps(walk)
    return walk, steps, floors_along(steps, walk.barometer, start, Fixes.none(), None)


def test_the_stairs_of_a_museum(data):
    """From floor 0 to -2 and back, twice; steps between landmarks of different floors are on the stairs."""
    (path,) = data.glob("ipin2023_track3/*Trial52*.txt")
    walk, steps, found = of(path, "0")
    assert found.kinds == ("stairs",) * 4
    assert list(np.sign(found.climbs.height)) == [-1, 1, -1, 1]
    truth, labels = walk.truth, np.array(found.labels[1:-1])
    before = np.searchsorted(truth.time, steps.time) - 1
    inside = (before >= 0) & (before < len(truth) - 1)
    floor = np.array(truth.floor)
    scored = inside & (floor[before] == floor[np.minimum(before + 1, len(truth) - 1)])
    assert scored.sum() > 60
    assert np.mean(labels[scored] == floor[before[scored]]) >= 0.95


def test_up_and_down_the_same_stairs_is_as_high(data):
    """Two flights down and two up between the same floors: four measures of one height."""
    (path,) = data.glob("ipin2023_track3/*Trial52*.txt")
    found = climbs(load(path).barometer)
    height = np.abs(found.height)
    assert np.all(np.abs(height - height.mean()) < 2 * found.sigma)


@pytest.mark.parametrize(
    ("pattern", "start"),
    [
        ("ipin2023_track3/*Trial01*.txt", "0"),
        ("ipin2023_track3/*Trial24*.txt", "-2"),
        ("nju_phyphox_outdoor", "1"),
        ("ipin21_hcu/eight", "4"),
    ],
)
def test_who_stays_on_a_floor_is_on_it(data, pattern, start):
    """NJU's walk climbs hills of 1 and 3 m, at 0.07 m/s; they are ramps, not floors."""
    (path,) = data.glob(pattern)
    _, _, found = of(path, start)
    assert set(found.labels) == {start}
    assert set(found.kinds) <= {"ramp"}


@pytest.mark.parametrize(
    "pattern", ["ipin2023_track3/*Trial01*.txt", "ipin2023_track3/*Trial24*.txt", "ipin21_hcu/eight"]
)
def test_a_storey_added_to_a_real_barometer_is_found(data, pattern):
    """Its noise is real, and its height is known: 3.6 m in 5 to 15 s at any time, each alone."""
    (path,) = data.glob(pattern)
    barometer = load(path).barometer
    random, time = np.random.default_rng(0), barometer.time
    errors = []
    for _ in range(40):
        lasts = random.uniform(5, 15)
        begin = random.uniform(time[0] + 15, time[-1] - 15 - lasts)
        share = np.clip((time - begin) / lasts, 0, 1)
        found = climbs(Signal(time, barometer.values * np.exp(-3.6 * share / 8581)[:, None]))
        assert len(found) == 1
        errors.append((found.height[0] - 3.6) / found.sigma[0])
    assert np.sqrt(np.mean(np.square(errors))) < 1.5, "sigma is honest"
