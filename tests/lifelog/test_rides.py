"""Rides within a walk with steps, detected by the positions beside them."""

from dataclasses import replace

import numpy as np
import pytest
from streets import NOISE, SIGMA, USUAL, seen, streets
from walks import steps_of

from pdr_graph import smooth
from pdr_graph.apps.lifelog.day import VEHICLE
from pdr_graph.apps.lifelog.stays import detect_rides, segments_of, without_rides
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
    n = len(time)
    steps = Steps(
        start=0.0,
        end=float(len(place) - 1),
        time=time,
        duration=np.full(n, 0.9),
        length=np.maximum(length, 0.1),
        turn=np.diff(course, prepend=0.0),
        pause_turn=np.zeros(n),
        sigma_length=np.full(n, 0.1),
        sigma_turn=np.full(n, 0.02),
    )
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
    heard = fixes[(fixes.time < begin - 5) | (fixes.time > end + 5)]
    ((found, left),) = detect_rides(steps, heard)
    assert found == pytest.approx(begin, abs=45)
    assert left == pytest.approx(end, abs=45)


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


def test_a_ride_is_one_row_with_a_wide_sigma():
    steps, _, (begin, end), _ = walk_and_ride([("bus", 400)], bumps=1.0)
    ridden = without_rides(steps, np.array([[begin, end]]))
    ((row,),) = np.nonzero(ridden.is_gap)
    assert (ridden.time[row], ridden.duration[row]) == (end, end - begin)
    assert ridden.sigma_length[row] > 9.0 * 400 / 2  # a bus is within two sigmas
    assert ((ridden.time[:row] <= begin) & (ridden.length[:row] > 0)).all()
    assert (ridden.time[row + 1 :] - ridden.duration[row + 1 :] >= end).all()
    assert without_rides(steps, np.empty((0, 2))) is steps


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


def test_a_ride_begins_at_the_last_step_before_it():
    """A short wait at the stop is part of the ride, since a bus starts slowly."""
    steps, fixes, _, _ = walk_and_ride([("bus", 400)])
    steps = replace(steps, time=steps.time - 0.05)  # fixes are at whole seconds
    ((found, _),) = detect_rides(steps, fixes)
    assert found in steps.time


def test_segments_of_a_ride_are_one_vehicle():
    steps, fixes, (begin, end), _ = walk_and_ride([("bus", 400)], bumps=1.0)
    found = detect_rides(steps, fixes)
    steps = without_rides(steps, found)
    segments = segments_of(steps, dead_reckon(steps), found)
    (ride,) = [segment for segment in segments if segment.kind == VEHICLE]
    assert (ride.start, ride.end) == pytest.approx((begin, end), abs=75)
