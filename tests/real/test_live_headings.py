"""The compass of real walks under way, against the surveyors' ways. Landmarks only score."""

import numpy as np
import pytest

from pdr_graph import detect_steps
from pdr_graph.frames import enu
from pdr_graph.gait.compass import LiveCompass
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.geometry import wrap_angle
from pdr_graph.io.loading import load
from pdr_graph.online.interface import Samples, events_of

HANGZHOU = (30.3, 120.2)  # [deg] about where the Microsoft walks are, for their field
NEAR = 60.0  # [s] of the walk before and after a heading that it is compared with


def said_of(walk, frame):
    compass = LiveCompass()
    compass.locate(frame, np.zeros(2), walk.epoch)
    gait, said = StepStream(listener=compass.update, preview=compass.preview), []
    for event in events_of(walk):
        if isinstance(event, Samples) and event.sensor == "magnetometer":
            compass.push(event.time, event.values)
        elif isinstance(event, Samples):
            gait.push(event.sensor, event.time, event.values)
            gait.advance()
            said += compass.advance()
    return said


def errors(walk, truth, said):
    """By how much the walked way, turned as each heading says, differs from the truth. [rad]"""
    steps = detect_steps(walk)
    heading = np.cumsum(steps.turn)
    way = np.cumsum(steps.length * np.exp(1j * (heading - steps.turn / 2)))
    found = []
    for one in said:
        near = np.abs(truth.time - one.time) < NEAR
        walked, true = np.diff(np.interp(truth.time[near], steps.time, way)), np.diff(truth.position[near] @ [1, 1j])
        turned = np.angle(np.sum(true * walked.conj()))
        since_start = np.interp(one.time, [steps.start, *steps.time], [0.0, *heading])
        found.append(wrap_angle(one.heading - since_start - turned))
    return np.array(found)


@pytest.mark.parametrize("pattern", ["ms_indoor20/site1/*/*.txt", "ms_indoor20/site2/*/*.txt"])
def test_who_holds_the_phone_before_them_is_told_their_way(data, pattern):
    """Compasses of these phones err by 17 to 21° (5–95 %) over many more walks: 30° and three sigmas are none's."""
    told = 0
    for path in sorted(data.glob(pattern)):
        walk = load(path)
        frame = enu(*HANGZHOU)
        said = said_of(walk, frame)
        error, sigma = errors(walk, frame.place(walk.truth), said), np.array([one.sigma for one in said])
        assert np.all(np.abs(error) < np.minimum(np.radians(30), 3 * sigma))
        told += len(said) > 0
    assert told >= 2


@pytest.mark.parametrize("trial", ["Trial01", "Trial24", "Trial52"])
def test_in_a_museum_it_is_right_or_says_that_it_is_unsure(data, trial):
    """Trial52's stairs mislead what gait says is ahead; offline too."""
    (path,) = data.glob(f"ipin2023_track3/*{trial}*.txt")
    walk = load(path)
    frame = enu(*walk.truth.position[0][::-1])
    said = said_of(walk, frame)
    error, sigma = errors(walk, frame.place(walk.truth), said), np.array([one.sigma for one in said])
    assert len(said) >= 3
    assert np.all(np.abs(error / sigma) < 3)
    assert abs(error[-1]) < np.radians(20)
