"""Floors of real walks, offline and live: a museum's stairs, and walks on one floor. Landmarks only score."""

import numpy as np
import pytest
from tiers import thorough

from pdr_graph import detect_steps
from pdr_graph.estimation.floors import LiveFloors, floors_along
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.inertial.barometer import climbs
from pdr_graph.io.loading import load
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.types import Fixes, Signal

PATIENCE = 15.0  # [s]


def told_of(walk, start):
    """Times and labels of the certain steps, as they were told PATIENCE later; and each new label, and when it came."""
    gait, floors = StepStream(), LiveFloors(None, start)
    waiting, told, changes = [], [], []
    for event in events_of(walk):
        if not isinstance(event, Samples):
            continue
        if event.sensor == "barometer":
            floors.push(event.time, event.values)
        gait.push(event.sensor, event.time, event.values)
        certain, tail = gait.advance()
        if certain is not None:
            floors.add_steps(certain)
            waiting += certain.time.tolist()
        before, now = floors.label, float(event.time[-1])
        floors.advance(tail)
        if floors.label != before:
            changes.append((now, floors.label))
        while waiting and waiting[0] < now - PATIENCE:
            told.append((waiting[0], *floors.labels(np.array([waiting.pop(0)]))))
    return told, changes


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


def test_live_floors_in_a_museum_are_soon_those_of_the_whole_recording(data):
    """15 s later all but a few steps have the label that they keep; a new one comes within 8 s."""
    (path,) = data.glob("ipin2023_track3/*Trial52*.txt")
    walk, steps, found = of(path, "0")
    offline = np.array(found.labels[1:-1])
    told, changes = told_of(walk, "0")
    time, labels = np.array([t for t, _ in told]), np.array([label for _, label in told])
    nearest = np.abs(steps.time[:, None] - time).argmin(axis=0)
    assert np.mean(labels == offline[nearest]) > 0.95
    since = steps.time[1:][offline[1:] != offline[:-1]]
    assert [label for _, label in changes] == offline[1:][offline[1:] != offline[:-1]].tolist()
    assert np.all(np.array([now for now, _ in changes]) - since < 8)


def test_up_and_down_the_same_stairs_is_as_high(data):
    """Two flights down and two up between the same floors: four measures of one height."""
    (path,) = data.glob("ipin2023_track3/*Trial52*.txt")
    found = climbs(load(path).barometer)
    height = np.abs(found.height)
    assert np.all(np.abs(height - height.mean()) < 2 * found.sigma)


@pytest.mark.parametrize(
    ("pattern", "start"),
    [
        thorough("ipin2023_track3/*Trial01*.txt", "0"),
        thorough("ipin2023_track3/*Trial24*.txt", "-2"),
        thorough("nju_phyphox_outdoor", "1"),
        ("ipin21_hcu/eight", "4"),
    ],
)
def test_who_stays_on_a_floor_is_on_it_live_too(data, pattern, start):
    """NJU's walk climbs hills of 1 and 3 m, at 0.07 m/s; they are ramps, not floors."""
    (path,) = data.glob(pattern)
    walk, _, found = of(path, start)
    assert set(found.labels) == {start}
    assert set(found.kinds) <= {"ramp"}
    told, changes = told_of(walk, start)
    assert changes == []
    assert {label for _, label in told} == {start}


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
