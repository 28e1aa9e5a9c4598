"""Activities of a day: from positions alone, and from steps."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streets import DAY, NOISE, PACE, SIGMA, USUAL, gauss_markov, logged, seen, streets
from walks import steps_of

from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.stays import LONGEST_PAUSE, follow_positions, segments_of
from pdr_graph.gait.step_chunks import append_steps as then
from pdr_graph.gait.step_chunks import gap, shifted
from pdr_graph.geometry import dead_reckon, length_along
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
        assert one.kind != other.kind
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


@pytest.mark.parametrize(("sigma", "lasts"), [(20.0, 90.0), (60.0, 60.0), (60.0, 120.0)])
def test_a_receiver_that_wanders_indoors_is_standing(sigma, lasts):
    """Its errors last a minute or two, whatever accuracy it states; the raw track has 20 to 60 km."""
    for seed in range(3):
        track = seen(np.zeros((3 * 3600, 2)), lambda n, random: gauss_markov(n, sigma, lasts, random), 5, seed)
        _, segments = follow_positions(track)
        assert time_of(segments, STANDING) > 0.9 * 3 * 3600
        assert distance(segments, WALKING, VEHICLE) < 0.05 * length_along(track.position)[-1]


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


def test_segments_do_not_depend_on_the_orientation_of_the_frame():
    place, _ = streets(DAY[:4])
    track = seen(place, every=5)
    turned = np.array([[0.0, -1.0], [1.0, 0.0]])
    moved = replace(track, position=track.position @ turned.T + [4e5, 5e6])
    (one, segments), (other, same) = follow_positions(track), follow_positions(moved)
    assert other.position == pytest.approx(one.position @ turned.T + [4e5, 5e6], abs=1e-4)  # a double has 1e-9 of it
    assert [s.kind for s in same] == [s.kind for s in segments]
    assert distance(same, WALKING, VEHICLE) == pytest.approx(distance(segments, WALKING, VEHICLE), abs=1e-3)


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
        (paused(40, LONGEST_PAUSE - 1), [WALKING]),
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
