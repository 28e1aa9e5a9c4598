"""Steps and lengths of walks at 0.4 to 1.5 m/s against other sensors: at the foot (strides), a camera (RIDI)."""

import gait_data
import numpy as np
import pytest

from pdr_graph import detect_steps
from pdr_graph.gait.step_detection import StepDetector, walking_steps
from pdr_graph.lab.papers.attitude_filters import on_one_grid

PACES = {"strides": gait_data.strides, "ridi": gait_data.ridi}


@pytest.fixture(scope="module", params=PACES)
def walks(data, request):
    return [(walk, detect_steps(walk.recording)) for walk in PACES[request.param](data)]


def test_every_step_counts_once_at_any_pace(walks):
    """Within 4 %, the first and last of a walk apart; within 10 % below 0.5 m/s, where the smallest are lost."""
    for walk, steps in walks:
        slow = walk.length / np.ptp(walk.recording.accelerometer.time) < 0.5
        assert len(steps) == pytest.approx(walk.steps, rel=0.1 if slow else 0.04), walk.name


def test_uncalibrated_lengths_are_true_at_any_pace(walks):
    """The total of every walk within 12 %, half of them within 6.5 % (asked: 5)."""
    errors = np.array([steps.length.sum() / walk.length - 1 for walk, steps in walks])
    assert np.abs(errors).max() < 0.12
    assert np.median(np.abs(errors)) < 0.065


def test_slow_steps_are_found_live_too(data):
    """By samples in packets of half a second, exactly those of the whole recording."""
    for walk in list(gait_data.strides(data))[-3:]:
        time, _, (acceleration,) = on_one_grid(walk.recording, "accelerometer")
        period = float(time[-1] - time[0]) / (len(time) - 1)
        detector = StepDetector(period, float(time[0]))
        packets = np.array_split(acceleration, round(len(time) * period / 0.5))
        live = np.concatenate([*(detector.update(packet) for packet in packets), detector.finish()])[:, 0]
        assert live == pytest.approx(walking_steps(time, acceleration).time)


@pytest.mark.parametrize("carry", ["leg", "bag", "handheld", "body"])
def test_the_region_holds_however_the_phone_is_carried_and_whichever_way_somebody_walks(data, carry):
    """RIDI, by two positions: no walk has less than 80 % in its region, those with steps sideways or backwards too."""
    errors = []
    for walk in (walk for walk in gait_data.ridi(data) if carry in walk.name):
        error, inside = gait_data.scored(walk)
        errors.append(np.sqrt(np.mean(error**2)))
        assert inside.mean() > 0.8, walk.name
    assert np.median(errors) < 1.2
