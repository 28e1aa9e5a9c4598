"""Activities of a day, from positions alone and from steps, and rides within a walk."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streets import DAY, NOISE, PACE, SIGMA, USUAL, gauss_markov, logged, seen, streets
from walks import steps_of

from pdr_graph import smooth
from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.stays import follow_positions, segments_of
from pdr_graph.estimation.gps_track import detect_rides, plausible
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.rides import without_rides
from pdr_graph.gait.step_chunks import append_steps as then
from pdr_graph.gait.step_chunks import gap, shifted
from pdr_graph.geometry import dead_reckon, length_along
from pdr_graph.priors import RIDING
from pdr_graph.types import Fixes, Steps


def time_of(segments, kind, begin=-np.inf, end=np.inf):
    return sum(max(min(s.end, end) - max(s.start, begin), 0.0) for s in segments if s.kind == kind)


def distance(segments, *kinds):
    return sum(s.distance for s in segments if s.kind in kinds)


def kinds(segments):
    return [s.kind for s in segments]


def covers(segments, start, end):
    """Assert that segments are contiguous, neighbours differ in kind, and standing has no distance."""
    assert segments[0].start == pytest.approx(start)
    assert segments[-1].end == pytest.approx(end)
    for one, other in pairwise(segments):
        assert one.end == other.start
        assert one.kind != other.kind or one.kind == GAP, "a fix is between two gaps"
    assert all(s.start < s.end for s in segments)
    assert all(s.distance == 0 for s in segments if s.kind in (STANDING, GAP))


# --- days of positions alone


@pytest.mark.parametrize("every", [1, 5, 15])
@pytest.mark.parametrize("noise", NOISE)
def test_the_length_of_a_walk_is_right(noise, every):
    """Within 5 %: a fix every 15 s misses 2 % at the corners; the raw track is up to six times too long."""
    place, _ = streets([("walk", 3600)])
    _, segments = follow_positions(seen(place, NOISE[noise], every))
    assert time_of(segments, WALKING) > 0.98 * 3600
    assert distance(segments, WALKING) == pytest.approx(length_along(place)[-1], rel=0.05)


@pytest.mark.parametrize("every", [5, 30])
@pytest.mark.parametrize("stated", [3.0, 13.0, 43.0, 75.0])
@pytest.mark.parametrize("noise", NOISE)
def test_a_walk_between_two_stands_is_a_walk_at_any_stated_accuracy(noise, stated, every):
    """Receivers err by 5 m per axis whatever they state; a phone that states 75 m for all is an example."""
    place, _ = streets([("stand", 1800), ("walk", 1200), ("stand", 1800)])
    track = seen(place, NOISE[noise], every)
    _, segments = follow_positions(replace(track, sigma=np.full(len(track), stated)))
    assert time_of(segments, WALKING, 1800, 3000) > 0.9 * 1200
    assert time_of(segments, STANDING) > 0.95 * 3600
    assert 0.8 < distance(segments, WALKING, VEHICLE) / length_along(place)[-1] < 1.05


@pytest.mark.parametrize(("sigma", "lasts"), [(20.0, 90.0), (60.0, 60.0), (60.0, 120.0)])
def test_a_receiver_that_wanders_indoors_is_standing(sigma, lasts):
    """Its errors last a minute or two, whatever accuracy it states; the raw track has 20 to 60 km."""
    for seed in range(3):
        track = seen(np.zeros((3 * 3600, 2)), lambda n, random: gauss_markov(n, sigma, lasts, random), 5, seed)
        _, segments = follow_positions(track)
        assert time_of(segments, STANDING) > 0.9 * 3 * 3600
        assert distance(segments, WALKING, VEHICLE) < 0.05 * length_along(track.position)[-1]


@pytest.mark.parametrize("every", [20.0, 120.0, 600.0, 1920.0])
@pytest.mark.parametrize("sigma", [5.0, 40.0, 75.0, 300.0, 2000.0])
def test_a_point_that_does_not_move_is_standing_at_any_accuracy(sigma, every):
    time = np.arange(0.0, 6 * 3600.0 + 1, every)
    for number in (len(time), 2):
        fixes = Fixes(time, np.zeros((len(time), 2)), np.full(len(time), sigma), source=("phone",) * len(time))
        _, segments = follow_positions(fixes[:number])
        assert kinds(segments) == [STANDING]


@pytest.mark.parametrize("minutes", [20, 31, 34, 45, 59])
@pytest.mark.parametrize("sigma", [5.0, 13.0, 75.0])
def test_a_silence_between_two_places_is_no_stand(sigma, minutes):
    """A position in 10 min at one place, then 1.3 km away: nobody stands in between."""
    time = np.concatenate([np.arange(0.0, 14401.0, 600.0), 14400.0 + 60 * minutes + np.arange(0.0, 14401.0, 600.0)])
    place = np.where(time[:, None] > 14400.0, [[1300.0, 0.0]], [[0.0, 0.0]])
    place += np.random.default_rng(minutes).normal(0, sigma / 3, place.shape)
    _, segments = follow_positions(Fixes(time, place, np.full(len(time), sigma), source=("phone",) * len(time)))
    between = 14400.0, 14400.0 + 60 * minutes
    assert time_of(segments, STANDING, *between) == 0
    assert time_of(segments, STANDING) > 0.9 * (time[-1] - time[0] - 60 * minutes)


@pytest.mark.parametrize("far", [200.0, 600.0, 1100.0, 2400.0])
@pytest.mark.parametrize("stated", [7.0, 43.0])
@pytest.mark.parametrize("times", [1, 2])
def test_one_stray_place_within_a_stay_is_no_ride(far, stated, times):
    """Under 144 km/h, there and back at once; a cached position may be repeated."""
    time = np.arange(0.0, 5401.0, 30.0)
    place = np.random.default_rng(0).normal(0, 4, (len(time), 2))
    place[90 : 90 + times] = far * np.array([0.8, 0.6])
    _, segments = follow_positions(Fixes(time, place, np.full(len(time), stated), source=("phone",) * len(time)))
    assert kinds(segments) == [STANDING]


def test_a_ride_of_a_minute_with_several_positions_is_a_ride():
    time = np.arange(0.0, 3601.0, 10.0)
    place = np.random.default_rng(0).normal(0, 4, (len(time), 2))
    place[:, 0] += np.interp(time, [1800.0, 1860.0], [0.0, 600.0])
    _, segments = follow_positions(Fixes(time, place, np.full(len(time), 7.0), source=("phone",) * len(time)))
    assert kinds(segments) == [STANDING, VEHICLE, STANDING]
    assert distance(segments, VEHICLE) == pytest.approx(600, rel=0.1)


def test_a_walk_there_and_back_with_one_position_at_its_end_is_no_stray():
    """To a shop 450 m off and back, 14 min each way, with a position only at home and there."""
    time = 840.0 * np.arange(20)
    place = np.zeros((20, 2))
    place[10] = 450.0, 0.0
    fixes = Fixes(time, place, np.full(20, 10.0), source=("phone",) * 20)
    assert len(plausible(fixes)) == 20


def test_the_convergence_of_a_receiver_is_no_ride():
    """After a gap it is 200 m off, and converges within 15 s."""
    time = np.r_[np.arange(0, 900, 5), np.arange(1200, 2100, 5)]
    off = 200.0 * np.clip(1 - (np.arange(2100) - 1200) / 15, 0, 1) * (np.arange(2100) >= 1200)
    place = USUAL(2100, np.random.default_rng(0)) + off[:, None] * [0.8, 0.6]
    _, segments = follow_positions(logged(time, place))
    assert kinds(segments) == [STANDING, GAP, STANDING]


def test_activities_of_a_day_are_separated():
    """Walks, a bus with its stops, an office: 90 % of each, and distances within 5 %."""
    place, done = streets(DAY)
    for every in (1, 5, 15):
        _, segments = follow_positions(seen(place, every=every))
        covers(segments, 0.0, (len(place) - 1) // every * every)
        edge = [0, *(np.flatnonzero(done[1:] != done[:-1]) + 1), len(done)]
        for a, b in pairwise(edge):
            own = {"stand": (STANDING,), "walk": (WALKING,), "bus": (VEHICLE, STANDING)}[done[a]]
            assert sum(time_of(segments, kind, a, b) for kind in own) > 0.85 * (b - a), (every, done[a], a)
        assert distance(segments, WALKING, VEHICLE) == pytest.approx(length_along(place)[-1], rel=0.05)


def test_laps_of_a_track_are_walking():
    """An hour of laps of 400 m ends where it began, and is no noise."""
    angle = PACE * np.arange(3600) / (400 / 2 / np.pi)
    place = 400 / 2 / np.pi * np.column_stack([np.cos(angle), np.sin(angle)])
    _, segments = follow_positions(seen(place))
    assert distance(segments, WALKING) == pytest.approx(3600 * PACE, rel=0.05)


def test_outliers_do_not_lengthen_a_walk():
    place, _ = streets([("walk", 1800)])
    track = seen(place, every=5)
    _, clean = follow_positions(track)
    random = np.random.default_rng(0)
    wild = random.random(len(track)) < 0.05
    spoilt = replace(track, position=track.position + wild[:, None] * random.normal(0, 200, (len(track), 2)))
    _, segments = follow_positions(spoilt)
    assert time_of(segments, WALKING) > 0.95 * 1800
    assert distance(segments, WALKING) == pytest.approx(distance(clean, WALKING), rel=0.02)


def test_time_without_data_is_a_gap():
    """Half an hour is one gap without a distance, with a large covariance in its middle."""
    place, _ = streets([("walk", 1200), ("walk", 1800), ("walk", 1200)])
    time = np.r_[np.arange(0, 1200, 5), np.arange(3000, 4200, 5)]
    way, segments = follow_positions(logged(time, place + USUAL(len(place), np.random.default_rng(0))))
    covers(segments, 0.0, 4195.0)
    (lost,) = [s for s in segments if s.kind == GAP]
    assert (lost.start, lost.end) == (1195.0, 3000.0)
    walked = length_along(place)[[1195, -1]] - length_along(place)[[0, 3000]]
    assert distance(segments, WALKING) == pytest.approx(walked.sum(), rel=0.05)
    sigma = np.sqrt(way.covariance[:, 0, 0])
    within = (way.time > 1195) & (way.time < 3000)
    assert within.sum() >= 3
    assert sigma[within].max() > 300  # a walker gets 1 km away and back
    assert sigma[~within].max() < 2 * SIGMA


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.5, 1.0, 5.0, 30.0, 70.0, 3600.0]), max_size=60), st.integers(0, 99))
def test_segments_cover_the_whole_recording(spans, seed):
    """Any intervals, also repeated times: no holes, and every long interval is within a gap."""
    time = np.concatenate([[100.0], 100.0 + np.cumsum(spans)])
    place = np.cumsum(np.random.default_rng(seed).normal(0, 4, (len(time), 2)), axis=0)
    way, segments = follow_positions(Fixes(time, place, np.full(len(time), SIGMA), ("F1",) * len(time)))
    assert np.isfinite(way.position).all()
    assert (way.covariance[:, [0, 1, 2], [0, 1, 2]] > 0).all()
    assert set(way.floor) == {"F1"}
    if time[-1] == time[0]:
        assert segments == ()
        return
    covers(segments, time[0], time[-1])
    once = np.unique(time)
    for a, b in pairwise(once):
        if b - a > max(60.0, 5 * np.median(np.diff(once))):
            assert time_of(segments, GAP, a, b) == pytest.approx(b - a)


# --- walks with steps


def paused(count, pause):
    """Two straight bouts of steps with a pause between them [s]."""
    one = steps_of(np.full(count, 0.7), np.zeros(count))
    late = replace(one, start=one.end, end=one.end + pause + one.end, time=one.time + one.end + pause)
    return then(one, late)


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        (paused(40, 20.0), [WALKING, STANDING, WALKING]),
        (paused(40, RIDING.pause - 1), [WALKING]),
        (replace(paused(3, 20.0), start=-10.0, end=paused(3, 20.0).end + 10.0), [STANDING]),
        (Steps(0.0, 60.0, *np.empty((7, 0))), [STANDING]),
    ],
    ids=["a pause is standing", "a short one is not", "shuffling is standing", "no step is standing"],
)
def test_steps_are_walking(steps, expected):
    segments = segments_of(steps, dead_reckon(steps), np.empty((0, 2)))
    covers(segments, steps.start, steps.end)
    assert kinds(segments) == expected
    assert distance(segments, WALKING) == pytest.approx(0.7 * len(steps) * (WALKING in expected))


def test_a_segment_is_as_long_as_its_trajectory():
    """The graph may have scaled the trajectory; it is not as long as the steps."""
    steps = paused(40, 20.0)
    track = dead_reckon(steps)
    track = replace(track, position=1.1 * track.position)
    assert distance(segments_of(steps, track, np.empty((0, 2))), WALKING) == pytest.approx(1.1 * 80 * 0.7)


def test_gaps_and_rides_are_segments_of_their_own():
    walk = steps_of(np.full(40, 0.7), np.zeros(40))
    steps = then(then(walk, gap(walk.end, walk.end + 100.0)), shifted(walk, walk.end + 100.0))
    segments = segments_of(steps, dead_reckon(steps), np.empty((0, 2)))
    covers(segments, steps.start, steps.end)
    assert kinds(segments) == [WALKING, GAP, WALKING]
    assert (segments[1].start, segments[1].end) == pytest.approx((walk.end, walk.end + 100.0))
    ridden = np.array([[walk.end, walk.end + 100.0]])
    assert kinds(segments_of(steps, dead_reckon(steps), ridden)) == [WALKING, VEHICLE, WALKING]


# Rides within a walk with steps, detected by the positions beside them


def walk_and_ride(ride, bumps=0.0, seed=0, every=1, noise=USUAL, walks=600):
    """A walk, a ride (or another motion) and a walk: steps, fixes, time of the ride [s], truth per second.

    bumps: spurious steps per second of the ride; walks: their duration [s].
    """
    place, done = streets([("walk", walks), ("stand", 20), *ride, ("stand", 20), ("walk", walks)], seed)
    foot = np.flatnonzero(done == "walk")
    last = foot[-walks:]
    heading = np.unwrap(np.arctan2(*np.diff(place, axis=0).T[::-1]))
    random = np.random.default_rng(seed)
    middle = np.arange(walks + 20, last[0] - 20)
    bumped = middle[random.random(len(middle)) < bumps]
    time = np.union1d(foot, bumped) + 1.0
    length = np.where(np.isin(time - 1, bumped), 0.6, np.hypot(*np.diff(place, axis=0).T)[(time - 1).astype(int)])
    course = heading[(time - 1).astype(int)]
    length = np.maximum(length, 0.1)
    steps = steps_of(length, np.diff(course, prepend=0.0), sigma_length=0.1)
    steps = replace(steps, time=time, duration=np.full(len(time), 0.9), end=float(len(place) - 1))
    return steps, seen(place, noise, every, seed), (walks + 20.0, float(last[0] - 20)), place


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


@pytest.mark.parametrize(
    "legs",
    [
        [("walk", 60), ("bus", 140)],
        [("bus", 300), ("walk", 90)],
        [("walk", 60), ("bus", 180), ("walk", 60)],
        [("walk", 180), ("stand", 20), ("bus", 240), ("stand", 10), ("walk", 90)],
        [("stand", 60), ("walk", 120), ("bus", 400), ("stand", 20), ("walk", 120)],
    ],
)
def test_a_walk_of_a_minute_before_or_after_a_ride_is_a_walk(legs):
    """The recording may begin and end with either."""
    for seed in range(3):
        place, done = streets(legs, seed)
        foot = np.flatnonzero(done == "walk")
        time, heading = foot + 1.0, np.unwrap(np.arctan2(*np.diff(place, axis=0).T[::-1]))[foot]
        steps = steps_of(np.full(len(foot), PACE), np.diff(heading, prepend=0.0), sigma_length=0.1)
        steps = replace(steps, time=time, duration=np.full(len(foot), 0.9), end=float(len(place) - 1))
        ((found, left),) = detect_rides(steps, seen(place, seed=seed))
        ridden = np.flatnonzero(done == "bus")
        assert found == pytest.approx(ridden[0], abs=31)  # it begins and ends with a wait of half a minute at most
        assert left == pytest.approx(ridden[-1] + 1, abs=31)
        assert not np.any((time > found + 1) & (time < left - 1)), "no step is in the ride"


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
    assert len(without_rides(still, found, Fixes.none())) == 1
    assert not len(detect_rides(still, Fixes.none()))


@pytest.mark.parametrize("noise", NOISE)
def test_a_walk_has_no_ride(noise):
    """Nor if indoors the positions are 40 m off for minutes."""
    for seed in range(3):
        steps, fixes, _, _ = walk_and_ride([("walk", 0)], 0.0, seed, noise=NOISE[noise])
        jumps = 40.0 * ((fixes.time // 150) % 2)[:, None] * [0.6, 0.8]
        assert not len(detect_rides(steps, fixes))
        assert not len(detect_rides(steps, replace(fixes, position=fixes.position + jumps)))


def test_a_gap_in_the_recording_is_no_ride():
    """The walker goes 500 m while the phone records nothing."""
    steps = steps_of(np.full(1200, 0.7), np.zeros(1200))
    track = dead_reckon(steps)
    slept = without_rides(steps, np.array([[200.0, 500.0]]), Fixes.none())
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
    assert np.percentile(off(without_rides(steps, found, fixes)), 90) < 2.5 * SIGMA
    assert np.percentile(off(steps), 90) > 5 * SIGMA
