"""Rides within a walk, batch and live: by how far positions go beyond the steps."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from streets import NOISE, PACE, gauss_markov, logged, seen, streets
from tiers import thorough
from walks import steps_of

from pdr_graph import Navigator, WalkGraph, smooth
from pdr_graph.estimation.gps_track import detect_rides, largest_sums
from pdr_graph.estimation.live.window import rewound
from pdr_graph.estimation.rides import without_rides
from pdr_graph.estimation.verdict import verdict
from pdr_graph.geometry import interpolate, unit
from pdr_graph.types import STEP_COLUMNS


def on_foot(place, done):
    """A step per second of walking along ``place``."""
    foot, heading = np.flatnonzero(done == "walk"), np.unwrap(np.arctan2(*np.diff(place, axis=0).T[::-1]))
    steps = steps_of(np.full(len(foot), PACE), np.diff(heading[foot], prepend=0.0), sigma_length=0.1)
    return replace(steps, time=foot + 1.0, duration=np.full(len(foot), 0.9), end=float(len(place) - 1))


def by_bus(seconds, seed=0, walk=180, **of_fixes):
    """A walk, a ride and a walk: place per second, steps, fixes."""
    place, done = streets([("walk", walk), ("bus", seconds), ("walk", walk)], seed)
    return place, on_foot(place, done), seen(place, seed=seed, **of_fixes)


def live(steps, fixes, between=True):
    """A navigator at the end of the walk, its pose per second with whether it says that it rides, and its estimate.

    between: the front end also reports seconds without a step.
    """
    nav, poses, issues, reported = Navigator(), [], [], 0.0
    for second in range(1, int(steps.end) + 1):
        here = rewound([steps], float(second))[0]
        later = here.time > reported if second > 1 else np.ones(len(here), bool)
        chunk = {name: getattr(here, name)[later] for name in STEP_COLUMNS}
        if between or later.any():
            nav.push(replace(here, start=reported, **chunk))
            reported = float(second)
        nav.push(fixes[(fixes.time > second - 1) & (fixes.time <= second)])
        poses.append(nav.pose)
        issues.append(any("ride since" in issue for issue in nav.status.issues))
    return nav, poses, np.array(issues), nav.finish()


@pytest.mark.parametrize("seconds", [20, 40, 120])
def test_a_ride_is_named_and_bends_neither_walk(seconds):
    """In batch; `without_rides` has a row to each fix, so that the track follows a bus around a corner."""
    for seed in range(3):
        place, steps, fixes = by_bus(seconds, seed)
        ((begin, end),) = rides = detect_rides(steps, fixes)
        assert begin == pytest.approx(180, abs=10)
        assert end == pytest.approx(180 + seconds, abs=10)
        track = smooth(WalkGraph(without_rides(steps, rides, fixes), fixes)).trajectory
        off = np.hypot(*(interpolate(np.arange(len(place)), track.time, track.position) - place).T)
        assert off.max() < 25, "also between the fixes of the ride"


def test_a_jump_of_the_receiver_is_no_ride():
    """60 m from one fix to the next, for good; a bus takes some seconds."""
    place, done = streets([("walk", 300)])
    steps = on_foot(place, done)
    for noise in NOISE.values():
        fixes = seen(place, noise)
        assert not len(detect_rides(steps, fixes))
        assert not len(
            detect_rides(steps, replace(fixes, position=fixes.position + 60.0 * (fixes.time > 150)[:, None]))
        )


@pytest.mark.parametrize(("every", "seconds"), [(1, 150), thorough(10, 600), thorough(1, 600)])
def test_outliers_are_no_ride(every, seconds):
    """One fix in ten is 50 to 500 m off."""
    place, done = streets([("walk", seconds)])
    steps, fixes, random = on_foot(place, done), seen(place, every=every), np.random.default_rng(1)
    off = random.uniform(50, 500, (len(fixes), 1)) * unit(random.uniform(0, 2 * np.pi, len(fixes)))
    wild = replace(fixes, position=fixes.position + off * (random.random(len(fixes)) < 0.1)[:, None])
    assert not len(detect_rides(steps, wild))
    assert not live(steps, wild)[2].any()


@pytest.mark.parametrize("walk", [90, thorough(180)])
def test_a_live_ride_is_named_in_time_and_both_walks_are_right(walk):
    place, steps, fixes = by_bus(60, walk=walk)
    nav, poses, rides, estimate = live(steps, fixes)
    named = np.flatnonzero(rides)
    assert walk < named[0] < walk + 20
    assert named[-1] < walk + 60 + 40, "a walk of 30 m ends it"
    off = np.array([np.hypot(pose.x - x, pose.y - y) for pose, (x, y) in zip(poses, place[1:], strict=True)])
    assert np.median(off[named]) < 15
    assert np.percentile(off[walk + 120 :], 95) < 15, "a minute after the ride"
    assert {reason.source for reason in verdict(estimate).reasons} <= {"place"}, "its fixes have 20 m"
    assert any("a ride from" in warning for warning in estimate.warnings)
    assert nav.status.restarts == 0


def test_a_live_ride_is_named_in_time_where_a_counter_reports_steps_alone():
    """Between its steps it is not silent, as sensors that stop are: no steps are what a ride has."""
    place, steps, fixes = by_bus(60, walk=90)
    _, poses, rides, estimate = live(steps, fixes, between=False)
    assert 90 < np.flatnonzero(rides)[0] < 110
    off = np.array([np.hypot(pose.x - x, pose.y - y) for pose, (x, y) in zip(poses, place[1:], strict=True)])
    assert np.median(off[90:150]) < 15
    assert any("a ride from" in warning for warning in estimate.warnings)


@pytest.mark.parametrize("noise", [next(iter(NOISE)), *map(thorough, [*NOISE][1:])])
def test_a_live_walk_has_no_ride(noise):
    place, done = streets([("walk", 150)])
    assert not live(on_foot(place, done), seen(place, NOISE[noise]))[2].any()


def test_fixes_that_go_faster_than_regular_steps_are_doubtful():
    """A scale that is three times too large looks like a ride, all on steps."""
    place, done = streets([("walk", 150)])
    steps, fixes = on_foot(place, done), seen(3.0 * place)
    estimate = live(steps, fixes)[3]
    assert not verdict(estimate).ok
    assert any("farther than the steps" in reason.text for reason in verdict(estimate).reasons)


def test_the_lag_of_a_receiver_does_not_explain_its_noise():
    """Half an hour around a pond with a fix per second: lag and heading of each pose would fit any noise."""
    time = np.arange(1500)
    place = 130 * np.stack([np.sin(time * PACE / 130), 1 - np.cos(time * PACE / 130)], axis=1)
    steps = steps_of(np.full(1499, 0.9 * PACE), np.full(1499, PACE / 130), sigma_length=0.1, sigma_turn=0.03)
    steps = replace(steps, time=time[1:].astype(float), duration=np.full(1499, 0.9), end=1499.0)
    random = np.random.default_rng(0)
    fixes = logged(time, place + gauss_markov(1500, 2.0, 20, random) + random.normal(0, 1.0, place.shape))
    track = smooth(WalkGraph(steps, fixes)).trajectory
    assert np.percentile(np.hypot(*(interpolate(time, track.time, track.position) - place).T), 95) < 6


def test_the_parts_of_largest_sums_are_disjoint_and_complete():
    """Against all parts of short rows."""
    for seed in range(50):
        values = np.random.default_rng(seed).normal(-0.2, 1, 12)
        found = largest_sums(values, 1.5)
        assert all(b <= a for (_, b), (a, _) in pairwise(found))
        sums = {(a, b): values[a:b].sum() for a in range(12) for b in range(a + 1, 13)}
        if max(sums.values()) > 1.5:
            assert max(sums, key=sums.get) in found
        else:
            assert not found
