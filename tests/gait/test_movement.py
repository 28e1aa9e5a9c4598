"""What moves without steps is said: in the verdict of a recording, and live."""

import re

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from test_step_detection import RATE, in_hand, standing, typing, walking

from pdr_graph import Navigator, WalkGraph, detect_steps, smooth
from pdr_graph.estimation.verdict import verdict
from pdr_graph.online.interface import events_of
from pdr_graph.types import Recording, Signal


def unsteady(seconds=60.0):
    """A phone that is moved about without a rhythm, as by who shuffles: 0.7 m/s² rms below 2 Hz."""
    sway = gaussian_filter1d(np.random.default_rng(5).normal(size=round(seconds * RATE)), 0.1 * RATE)
    return in_hand(0.7 * sway / sway.std())


def recorded(time, acceleration):
    rate = np.random.default_rng(0).normal(0, 0.01, (len(time), 3))
    return Recording("made", 0.0, None, accelerometer=Signal(time, acceleration), gyroscope=Signal(time, rate))


def live(recording):
    """A navigator that has received a recording, and whether it named movement without steps meanwhile."""
    nav, named = Navigator(), False
    for event in events_of(recording):
        nav.push(event)
        named |= any("no steps were recognised" in line for line in nav.status.issues)
    return nav, named


def test_movement_without_a_step_is_a_doubt():
    """In a recording and live; the verdict is not "ok" with 0 m."""
    recording = recorded(*unsteady())
    steps = detect_steps(recording)
    assert len(steps) == 0
    assert steps.stepless == pytest.approx(60, abs=4)
    found = verdict(smooth(WalkGraph(steps)))
    assert found.state == "doubtful"
    assert "s, and no steps were recognised" in str(found)
    nav, named = live(recording)
    assert named
    assert "no steps were recognised" in str(nav.status.verdict)
    assert "no steps were recognised" in str(verdict(nav.finish()))


@pytest.mark.parametrize("motion", [standing, typing])
def test_who_stands_or_types_is_not_told_so(motion):
    recording = recorded(*(values[: round(60 * RATE)] for values in motion()))
    assert detect_steps(recording).stepless == 0
    assert verdict(smooth(WalkGraph(detect_steps(recording)))).ok
    assert not live(recording)[1]


def test_a_walk_is_no_movement_without_steps_and_a_short_one_beside_it_no_doubt():
    """Half a minute of shuffling before a minute of walking: live it is named while it lasts."""
    walked, moved = walking(1.9, 3.0, seconds=60.0, rate=RATE)[1], unsteady(30.0)[1]
    assert detect_steps(recorded(np.arange(len(walked)) / RATE, walked)).stepless == 0
    both = np.concatenate([moved, walked @ np.array([[1, 0, 0], [0, 0.95, -0.3], [0, 0.3, 0.95]])])
    recording = recorded(np.arange(len(both)) / RATE, both)
    steps = detect_steps(recording)
    assert steps.stepless == pytest.approx(30, abs=4)
    assert verdict(smooth(WalkGraph(steps))).ok
    nav, named = live(recording)
    assert named
    assert not any("no steps were recognised" in line for line in nav.status.issues)


def test_steps_that_are_lost_within_a_walk_are_said_and_widen_the_way():
    """Twelve seconds as strong as the steps around them, but too smooth for landings: in a recording and live."""
    walked, smoothly = walking(1.9, 3.0, seconds=60.0)[1], 3 * np.cos(2 * np.pi * 1.9 * np.arange(600) / RATE)
    lost = [0.0, 0.0, 9.81] + smoothly[:, None] * [0, 0, 1] + np.random.default_rng(0).normal(0, 0.05, (600, 3))
    recording, whole = (
        recorded(np.arange(len(a)) / RATE, a) for a in (np.concatenate([walked[:2000], lost, walked[2000:]]), walked)
    )
    steps, without = detect_steps(recording), detect_steps(whole)
    assert without.missing == 0
    assert verdict(smooth(WalkGraph(without))).ok
    assert steps.missing == pytest.approx(12, abs=3)
    said = str(verdict(smooth(WalkGraph(steps))))
    assert said.startswith("doubtful")
    assert 16 <= int(re.search(r"about (\d+) steps may be missing", said)[1]) <= 29
    assert np.hypot.reduce(steps.sigma_length) > 0.5 * steps.missing
    nav, _ = live(recording)
    assert "steps may be missing" in str(verdict(nav.finish()))
