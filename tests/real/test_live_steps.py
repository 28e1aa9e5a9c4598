"""Live steps of real walks: those of the whole recording."""

from functools import reduce

import numpy as np
import pytest

from pdr_graph import detect_steps
from pdr_graph.gait.step_chunks import append_steps
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.io.loading import load

WALKS = ["ms_indoor20/site1/B1/*.txt", "ms_indoor20/site2/*/*.txt", "ipin2023_track3/*Trial01*.txt", "ipin21_hcu/eight"]


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


@pytest.mark.parametrize("pattern", WALKS)
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
