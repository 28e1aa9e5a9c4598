"""A radio map live: scans that arrive piecemeal give the same fixes as the whole recording."""

import numpy as np
import pytest

from pdr_graph.estimation.fingerprinting import RadioMap, ScanCollector
from pdr_graph.frames import Frame
from pdr_graph.types import Recording, Sightings, Trajectory

NAMES = tuple("abcdefgh")


def heard(seed):
    """Eight access points along 120 m, heard twice a second for two minutes, and one that no map knows."""
    random = np.random.default_rng(seed)
    time = np.sort(random.uniform(0, 120, 1000))
    who = random.integers(0, len(NAMES), len(time))
    rssi = -40 - 0.8 * np.abs(time - 17.0 * who) + random.normal(0, 2, len(time))
    names = [NAMES[n] for n in who]
    names[::50] = ["unknown"] * len(names[::50])
    return Sightings(time, tuple(names), rssi)


@pytest.fixture(scope="module")
def radio_map():
    time = np.arange(0.0, 121.0)
    track = Trajectory(time, np.stack([time, 0 * time], axis=1), 0 * time)
    return RadioMap.learn([(track, Recording("one", 0.0, None, wifi=heard(1)))], Frame().describe())


def chunks(sightings, each=2.0):
    for begin in np.arange(0.0, 122.0, each):
        rows = np.flatnonzero((sightings.time >= begin) & (sightings.time < begin + each))
        names = tuple(sightings.transmitter[n] for n in rows)
        yield begin + each, Sightings(sightings.time[rows], names, sightings.rssi[rows])


def test_the_fixes_are_those_of_the_whole_recording(radio_map):
    sightings, reported, blocks = heard(2), [], []
    expected = radio_map.fixes(Recording("two", 0.0, None, wifi=sightings))
    collector = ScanCollector(radio_map, reported.append)
    for now, part in chunks(sightings):
        collector.collect(part, "wifi")
        blocks += collector.due(now, None)
    blocks += collector.due(130.0, None)
    assert reported == blocks
    time = np.concatenate([fixes.time for fixes in blocks])
    assert len(expected) > 20
    assert time == pytest.approx(expected.time)
    assert np.concatenate([fixes.position for fixes in blocks]) == pytest.approx(expected.position)
    assert np.concatenate([fixes.sigma for fixes in blocks]) == pytest.approx(expected.sigma)
