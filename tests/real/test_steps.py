"""Step counts of others, and stretches in which nobody walked: one detector, one setting; and live steps."""

from functools import reduce
from itertools import pairwise

import numpy as np
import pytest
from tiers import thorough

from pdr_graph import Walker, detect_steps
from pdr_graph.frames import enu
from pdr_graph.gait.step_chunks import append_steps
from pdr_graph.gait.step_detection import walking_steps
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.io.loading import load
from pdr_graph.lab.papers.attitude_filters import on_one_grid


def landings(path):
    time, _, (acceleration,) = on_one_grid(load(path), "accelerometer")
    return walking_steps(time, acceleration)


def test_a_swinging_arm(data):
    """Of the two foot switches one rises 151 times, the other 133: 19 times the first rises again 0.3 s later with no
    landing of the other between. Feet land in turn: 264 times.
    """
    folder = data / "oxford_steps" / "Pixel_Jamie_Hard_SwingingArm_1"
    rows = np.array([line.replace(",", " ").split() for line in (folder / "stepcounter.csv").open()], dtype=float)
    rises = sorted((t, foot) for foot in (1, 2) for t in rows[1:, 0][np.diff(rows[:, foot]) > 0])
    assert len(rises) == 284
    in_turn = 1 + sum(before != after for (_, before), (_, after) in pairwise(rises))
    assert in_turn == 264
    assert len(landings(folder)) == pytest.approx(in_turn, rel=0.02)


def test_shaking_and_standing_are_no_steps(data):
    """The IPIN trials begin with half a minute of shaking and half a minute of standing, IPIN21 with four seconds."""
    for path in data.glob("ipin2023_track3/*Trial*.txt"):
        assert not np.any(landings(path).time < 60)
    assert not np.any(landings(data / "ipin21_hcu" / "eight").time < 4)


def test_a_stop_costs_nothing(data):
    """Trials 01 and 24 have a stop of 43 and 31 s between two marks at the same place."""
    for name, begin, end in (("Trial01", 126, 163), ("Trial24", 115, 141)):
        (path,) = data.glob(f"ipin2023_track3/*{name}*.txt")
        time = landings(path).time
        assert np.sum((time > begin) & (time < end)) <= 2


@pytest.mark.parametrize(("pattern", "every"), [("ipin2023_track3/*Trial01*.txt", 1), ("ipin21_hcu/eight", 8)])
def test_strides_of_people_whom_no_constant_was_chosen_on(data, pattern, every):
    """Length by steps over the way between landmarks, without any fix: within 7 %."""
    (path,) = data.glob(pattern)
    walk = load(path)
    steps, truth = detect_steps(walk, Walker()), walk.truth
    place = truth.position if truth.epsg != 4326 else enu(*truth.position[0][::-1]).place(truth).position
    way = np.hypot(*np.diff(place[::every], axis=0).T).sum()
    within = (steps.time > truth.time[0]) & (steps.time <= truth.time[-1])
    assert steps.length[within].sum() == pytest.approx(way, rel=0.07)


def live(walk, packet=0.1):
    """Certain steps of a walk whose sensors' samples come in packets of so many seconds."""
    gait, chunks = StepStream(), []
    for end in np.arange(packet, walk.accelerometer.time[-1] + packet, packet):
        for sensor in ("accelerometer", "gyroscope"):
            signal = walk.signals[sensor]
            now = slice(*np.searchsorted(signal.time, [end - packet, end]))
            gait.push(sensor, signal.time[now], signal.values[now])
        chunks.append(gait.advance()[0])
    return reduce(append_steps, [chunk for chunk in [*chunks, gait.finish()] if chunk is not None])


def headings(steps):
    """Heading since the first landing, at each."""
    return np.cumsum(steps.turn) - steps.turn[0]


@pytest.mark.parametrize(
    "pattern",
    [
        "ipin21_hcu/eight",
        *(
            thorough(pattern)
            for pattern in ("ms_indoor20/site1/B1/*.txt", "ms_indoor20/site2/*/*.txt", "ipin2023_track3/*Trial01*.txt")
        ),
    ],
)
def test_live_steps_are_those_of_the_whole_recording(data, pattern):
    """A step more or less, for the samples lie elsewhere between those of the phone; headings within 5°.

    Offline the bias and the vertical are known from both sides, live from before.
    """
    for path in sorted(data.glob(pattern))[:4]:
        walk = load(path)
        steps, found = detect_steps(walk), live(walk)
        assert len(found) == pytest.approx(len(steps), abs=max(1, 0.015 * len(steps)))
        assert found.length.sum() == pytest.approx(steps.length.sum(), rel=0.02)
        apart = np.abs(found.time[:, None] - steps.time)
        both = apart.min(axis=1) < 0.05
        assert np.mean(both) > 0.98
        off = headings(found)[both] - headings(steps)[apart.argmin(axis=1)[both]]
        assert np.percentile(np.abs(off - np.median(off)), 95) < np.radians(5)
