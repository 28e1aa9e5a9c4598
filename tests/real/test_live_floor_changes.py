"""Floors of real walks under way: soon those that the whole recording tells."""

import numpy as np
import pytest

from pdr_graph import detect_steps
from pdr_graph.estimation.floors import LiveFloors, floors_along
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.io.loading import load
from pdr_graph.online.interface import Samples, events_of
from pdr_graph.types import Fixes

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


def test_the_stairs_of_a_museum(data):
    """15 s later all but a few steps have the label that they keep; a new one comes within 8 s."""
    (path,) = data.glob("ipin2023_track3/*Trial52*.txt")
    walk = load(path)
    steps = detect_steps(walk)
    offline = np.array(floors_along(steps, walk.barometer, "0", Fixes.none(), None).labels[1:-1])
    told, changes = told_of(walk, "0")
    time, labels = np.array([t for t, _ in told]), np.array([label for _, label in told])
    nearest = np.abs(steps.time[:, None] - time).argmin(axis=0)
    assert np.mean(labels == offline[nearest]) > 0.95
    since = steps.time[1:][offline[1:] != offline[:-1]]
    assert [label for _, label in changes] == offline[1:][offline[1:] != offline[:-1]].tolist()
    assert np.all(np.array([now for now, _ in changes]) - since < 8)


@pytest.mark.parametrize(
    ("pattern", "start"),
    [
        ("ipin2023_track3/*Trial24*.txt", "-2"),
        ("nju_phyphox_outdoor", "1"),
        ("ipin21_hcu/eight", "4"),
    ],
)
def test_who_stays_on_a_floor_is_told_no_other(data, pattern, start):
    (path,) = data.glob(pattern)
    told, changes = told_of(load(path), start)
    assert changes == []
    assert {label for _, label in told} == {start}
