"""Rides within a walk with steps, detected by the positions beside them."""

from dataclasses import replace

import numpy as np
import pytest
from streets import NOISE, SIGMA, USUAL, seen, streets
from walks import steps_of

from pdr_graph import smooth
from pdr_graph.apps.lifelog.stays import detect_rides, without_rides
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import dead_reckon
from pdr_graph.types import Fixes, Steps


def walk_and_ride(ride, bumps=0.0, seed=0, every=1, noise=USUAL):
    """A walk, a ride (or another motion) and a walk: steps, fixes, time of the ride [s], truth per second.

    bumps: spurious steps per second of the ride.
    """
    place, done = streets([("walk", 600), ("stand", 20), *ride, ("stand", 20), ("walk", 600)], seed)
    foot = np.flatnonzero(done == "walk")
    last = foot[-600:]
    heading = np.unwrap(np.arctan2(*np.diff(place, axis=0).T[::-1]))
    random = np.random.default_rng(seed)
    middle = np.arange(620, last[0] - 20)
    bumped = middle[random.random(len(middle)) < bumps]
    time = np.union1d(foot, bumped) + 1.0
    length = np.where(np.isin(time - 1, bumped), 0.6, np.hypot(*np.diff(place, axis=0).T)[(time - 1).astype(int)])
    course = heading[(time - 1).astype(int)]
    length = np.maximum(length, 0.1)
    steps = steps_of(length, np.diff(course, prepend=0.0), sigma_length=0.1)
    steps = replace(steps, time=time, duration=np.full(len(time), 0.9), end=float(len(place) - 1))
    return steps, seen(place, noise, every, seed), (620.0, float(last[0] - 20)), place


@pytest.mark.parametrize("bumps", [0.0, 1.0])
@pytest.mark.parametrize("every", [1, 5, 20])
def test_a_ride_is_detected_on_any_road(bumps, every):
    for seed in range(3):
        steps, fixes, (begin, end), _ = walk_and_ride([("bus", 400)], bumps, seed, every)
        ((found, left),) = detect_rides(steps, fixes)
        # boarding and leaving are slow, and a fix may be 20 s from either; a bus may wait for a minute at its last stop
        assert found == pytest.approx(begin, abs=45)
        assert left == pytest.approx(end, abs=75)


def test_a_ride_continues_after_a_stop_and_ends_with_a_walk():
    """Three minutes of standing at a stop are part of it; 130 m on foot to the next bus are not."""
    stop, change = [("bus", 300), ("stand", 180), ("bus", 300)], [("bus", 300), ("walk", 100), ("bus", 300)]
    for seed in range(3):
        steps, fixes, _, _ = walk_and_ride(stop, seed=seed)
        assert len(detect_rides(steps, fixes)) == 1
        steps, fixes, _, _ = walk_and_ride(change, seed=seed)
        assert len(detect_rides(steps, fixes)) == 2


def test_a_ride_underground_is_detected():
    """There is no fix in its ten minutes."""
    steps, fixes, (begin, end), _ = walk_and_ride([("bus", 600)])
    steps = replace(steps, time=steps.time - 0.05)  # fixes are at whole seconds
    heard = fixes[(fixes.time < begin - 5) | (fixes.time > end + 5)]
    ((found, left),) = detect_rides(steps, heard)
    assert found == pytest.approx(begin, abs=45)
    assert left == pytest.approx(end, abs=45)
    assert found in steps.time, "it begins at the last step before it: a bus starts slowly"


def test_a_ride_without_any_step_is_detected():
    still = Steps(0.0, 600.0, *np.empty((7, 0)))
    place, _ = streets([("bus", 600)])
    found = detect_rides(still, seen(place))
    assert found == pytest.approx(np.array([[0.0, 600.0]]), abs=75)
    assert len(without_rides(still, found)) == 1
    assert not len(detect_rides(still, Fixes.none()))


@pytest.mark.parametrize("noise", NOISE)
def test_a_walk_has_no_ride(noise):
    for seed in range(3):
        steps, fixes, _, _ = walk_and_ride([("walk", 0)], 0.0, seed, noise=NOISE[noise])
        assert not len(detect_rides(steps, fixes))


def test_jumps_of_a_receiver_are_no_ride():
    """Indoors its positions are 40 m off for minutes."""
    steps, fixes, _, _ = walk_and_ride([("walk", 0)])
    jumps = 40.0 * ((fixes.time // 150) % 2)
    assert not len(detect_rides(steps, replace(fixes, position=fixes.position + jumps[:, None] * [0.6, 0.8])))


def test_a_gap_in_the_recording_is_no_ride():
    """The walker goes 500 m while the phone records nothing."""
    steps = steps_of(np.full(1200, 0.7), np.zeros(1200))
    track = dead_reckon(steps)
    slept = without_rides(steps, np.array([[200.0, 500.0]]))
    rows = np.r_[:360, 920:1200:2]
    fixes = Fixes(track.time[rows], track.position[rows], np.full(len(rows), 3.0), ("",) * len(rows))
    assert not len(detect_rides(slept, fixes))


def test_a_ride_does_not_bend_the_walk():
    """Both walks are within the receiver's error if the ride is detected; the control is not."""
    steps, fixes, (begin, end), place = walk_and_ride([("bus", 400)], bumps=0.3, every=5)

    def off(steps):
        track = smooth(WalkGraph(steps, fixes)).trajectory
        walks = (track.time < begin - 30) | (track.time > end + 60)
        return np.hypot(*(track.position - place[np.minimum(track.time, len(place) - 1).astype(int)])[walks].T)

    found = detect_rides(steps, fixes)
    assert np.percentile(off(without_rides(steps, found)), 90) < 2.5 * SIGMA
    assert np.percentile(off(steps), 90) > 5 * SIGMA
