"""What a day is made of: from positions alone, and beside steps."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import chi2
from walks import steps_of

from pdr_graph import smooth
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.gait.gaps import follow as then
from pdr_graph.gait.gaps import gap
from pdr_graph.geometry import dead_reckon, length_along
from pdr_graph.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.lifelog.positions import KEEPS, LOST, SPEED, WALKS, follow_positions
from pdr_graph.lifelog.rides import rides, without_rides
from pdr_graph.lifelog.segments import PAUSE, segments_of
from pdr_graph.lifelog.smooth_way import Motion, Seen, smooth_way
from pdr_graph.types import Fixes, Steps, Trajectory

SIGMA = 5.0  # [m] stated, per axis: a phone's
PACE = 1.3  # [m/s]
DAY = (("stand", 1800), ("walk", 900), ("stand", 120), ("bus", 1200), ("walk", 400), ("stand", 3600), ("walk", 600))


# --- made days, a position per second


def streets(legs, seed=0):
    """Positions ``(n + 1, 2)`` and what was done ``(n,)`` of someone who goes along streets, and of their bus."""
    random = np.random.default_rng(seed)
    place, done, heading = [np.zeros(2)], [], 0.0
    for what, seconds in legs:
        top, block = {"stand": (0.0, (1, 1)), "walk": (PACE, (40, 120)), "bus": (9.0, (150, 500))}[what]
        speed, left, wait = 0.0, random.uniform(*block), 0
        for _ in range(seconds):
            speed, wait = (0.0, wait - 1) if wait else (min(top, speed + 1.2), 0)
            place.append(place[-1] + speed * np.array([np.cos(heading), np.sin(heading)]))
            left -= speed
            if left <= 0 and top:
                heading, left = heading + random.choice([-1, 0, 1]) * np.pi / 2, random.uniform(*block)
                wait = int(random.uniform(10, 60)) if what == "bus" and random.random() < 0.5 else 0
        done += [what] * seconds
    return np.array(place), np.array(done)


def gauss_markov(n, sigma, lasts, random):
    """Errors ``(n, 2)`` a second apart that are alike for some time [s]."""
    keep = np.exp(-1 / lasts)
    noise = random.normal(0, sigma * np.sqrt(1 - keep**2), (n, 2))
    noise[0] = random.normal(0, sigma, 2)
    return lfilter([1], [1, -keep], noise, axis=0)


NOISE = {
    "alike for two minutes": lambda n, random: gauss_markov(n, 4.8, 120, random) + random.normal(0, 1.5, (n, 2)),
    "alike for 20 s": lambda n, random: gauss_markov(n, SIGMA, 20, random),
    "white": lambda n, random: random.normal(0, SIGMA, (n, 2)),
}
USUAL = NOISE["alike for two minutes"]


def seen(place, noise=USUAL, every=1, seed=0):
    """Fixes of one receiver every so many seconds."""
    position = place + noise(len(place), np.random.default_rng(seed))
    return logged(np.arange(0, len(place), every), position)


def logged(time, position):
    """Fixes at some of the seconds."""
    n = len(time)
    return Fixes(time.astype(float), position[time], np.full(n, SIGMA), ("",) * n, source=("GPS",) * n)


def time_of(segments, kind, begin=-np.inf, end=np.inf):
    return sum(max(min(s.end, end) - max(s.start, begin), 0.0) for s in segments if s.kind == kind)


def distance(segments, *kinds):
    return sum(s.distance for s in segments if s.kind in kinds)


def covers(segments, start, end):
    """Segments follow one another without holes, no two neighbours are of one kind, and what is still goes nowhere."""
    assert segments[0].start == pytest.approx(start)
    assert segments[-1].end == pytest.approx(end)
    for one, other in pairwise(segments):
        assert one.end == other.start
        assert one.kind != other.kind
    assert all(s.start < s.end for s in segments)
    assert all(s.distance == 0 for s in segments if s.kind in (STANDING, GAP))


# --- the smoother


def kernel(time, speed, keeps):
    """Covariance of positions in a correlated random walk from time[0] on: the double integral of s² exp(−|u − w| / τ),
    by hand.
    """
    a, b = time[:, None] - time[0], time[None] - time[0]
    fades = np.exp(-a / keeps) + np.exp(-b / keeps) - np.exp(-abs(a - b) / keeps)
    return speed**2 * keeps**2 * (2 * np.minimum(a, b) / keeps - 1 + fades)


def test_the_smoother_is_the_gaussian_process_that_it_says():
    """Kriging with the walk's kernel in closed form, dense: mean and variance of every row."""
    random = np.random.default_rng(1)
    time = np.cumsum(random.choice([0.2, 1.0, 5.0, 40.0], 60))
    z = np.cumsum(random.normal(0, 3, (60, 2)), axis=0)
    slow, white = random.uniform(2, 20, 60), random.uniform(1, 5, 60)
    n = len(time) - 1
    way = smooth_way(Seen(time, z, slow, white), Motion(np.full(n, 0.9), np.full(n, 40.0), np.zeros(n, dtype=bool)), ())
    everywhere = 1e6  # [m²] where it begins
    of_way = kernel(time, 0.9, 40.0) + everywhere
    offset = np.outer(slow, slow) * np.exp(-abs(time[:, None] - time) / 120.0)
    gain = np.linalg.solve(of_way + offset + np.diag(white**2), of_way).T
    # the oracle's start is vague by 1 km, ours by 1000 km
    assert way.position == pytest.approx(gain @ z, abs=2e-2)
    assert way.variances()[:, 0] == pytest.approx(np.diag(of_way - gain @ of_way), rel=2e-3)


def drawn(seed, kind, worse=1.0):
    """A walk drawn from the model, and its fixes; worse: times the noise that is said."""
    random = np.random.default_rng(seed)
    time = np.arange(0, 600, 5.0)
    root = np.linalg.cholesky(kernel(time, SPEED[kind], KEEPS[kind]) + 1e-6 * np.eye(len(time)))
    truth = root @ random.normal(size=(len(time), 2))
    noise = gauss_markov(600, 4.8, 120, random)[::5] + random.normal(0, 1.5, (len(time), 2))
    return time, truth, truth + worse * noise


@pytest.mark.parametrize(("worse", "honest"), [(1.0, True), (1.5, False)])
def test_the_covariance_of_a_way_is_honest(worse, honest):
    seeds, row, nees = 150, 60, 0.0
    for seed in range(seeds):
        time, truth, z = drawn(seed, WALKS, worse)
        n = len(time)
        motion = Motion(np.full(n - 1, SPEED[WALKS]), np.full(n - 1, KEEPS[WALKS]), np.zeros(n - 1, dtype=bool))
        way = smooth_way(Seen(time, z, np.full(n, 4.8), np.full(n, 1.5)), motion, ())
        nees += np.sum((way.position[row] - truth[row]) ** 2) / way.variances()[row, 0]
    low, high = chi2.ppf([0.005, 0.995], 2 * seeds)
    assert (low < nees < high) == honest


# --- days of positions alone


@pytest.mark.parametrize("every", [1, 5, 15])
@pytest.mark.parametrize("noise", NOISE)
def test_a_walk_is_as_long_as_it_is(noise, every):
    """Within 5 %: who measures every 15 s misses 2 % at the corners; raw, the noise makes up to six times of it."""
    place, _ = streets([("walk", 3600)])
    _, segments = follow_positions(seen(place, NOISE[noise], every))
    assert time_of(segments, WALKING) > 0.98 * 3600
    assert distance(segments, WALKING) == pytest.approx(length_along(place)[-1], rel=0.05)


@pytest.mark.parametrize("noise", NOISE)
def test_who_stands_goes_nowhere(noise):
    track = seen(np.zeros((7200, 2)), NOISE[noise])
    assert length_along(track.position)[-1] > 3000  # invented by the raw track
    way, (only,) = follow_positions(track)
    assert (only.kind, only.start, only.end, only.distance) == (STANDING, 0.0, 7199.0, 0.0)
    assert np.hypot(*way.position.T).max() < 3 * SIGMA


@pytest.mark.parametrize(("sigma", "lasts"), [(20.0, 90.0), (60.0, 60.0), (60.0, 120.0)])
def test_indoors_a_receiver_wanders_and_nobody_goes(sigma, lasts):
    """Its errors last a minute or two, whatever accuracy it states; the raw track has 20 to 60 km."""
    for seed in range(3):
        track = seen(np.zeros((3 * 3600, 2)), lambda n, random: gauss_markov(n, sigma, lasts, random), 5, seed)
        _, segments = follow_positions(track)
        assert time_of(segments, STANDING) > 0.9 * 3 * 3600
        assert distance(segments, WALKING, VEHICLE) < 0.05 * length_along(track.position)[-1]


def test_a_receiver_that_finds_its_place_is_no_ride():
    """After a gap it begins 200 m off and comes in within 15 s."""
    time = np.r_[np.arange(0, 900, 5), np.arange(1200, 2100, 5)]
    off = 200.0 * np.clip(1 - (np.arange(2100) - 1200) / 15, 0, 1) * (np.arange(2100) >= 1200)
    place = USUAL(2100, np.random.default_rng(0)) + off[:, None] * [0.8, 0.6]
    _, segments = follow_positions(logged(time, place))
    assert kinds(segments) == [STANDING, GAP, STANDING]


def test_a_day_is_told_apart():
    """Walks, a bus with its stops, an office: nine tenths of each, and no kilometre more or less than 5 %."""
    place, done = streets(DAY)
    for every in (1, 5, 15):
        _, segments = follow_positions(seen(place, every=every))
        covers(segments, 0.0, (len(place) - 1) // every * every)
        edge = [0, *(np.flatnonzero(done[1:] != done[:-1]) + 1), len(done)]
        for a, b in pairwise(edge):
            own = {"stand": (STANDING,), "walk": (WALKING,), "bus": (VEHICLE, STANDING)}[done[a]]
            assert sum(time_of(segments, kind, a, b) for kind in own) > 0.85 * (b - a), (every, done[a], a)
        assert distance(segments, WALKING, VEHICLE) == pytest.approx(length_along(place)[-1], rel=0.05)


def test_laps_of_a_track_are_walked():
    """They lead nowhere in the end, and still are no noise: 400 m round, for an hour."""
    angle = PACE * np.arange(3600) / (400 / 2 / np.pi)
    place = 400 / 2 / np.pi * np.column_stack([np.cos(angle), np.sin(angle)])
    _, segments = follow_positions(seen(place))
    assert distance(segments, WALKING) == pytest.approx(3600 * PACE, rel=0.05)


def test_wild_fixes_lengthen_nothing():
    place, _ = streets([("walk", 1800)])
    track = seen(place, every=5)
    _, clean = follow_positions(track)
    random = np.random.default_rng(0)
    wild = random.random(len(track)) < 0.05
    spoilt = replace(track, position=track.position + wild[:, None] * random.normal(0, 200, (len(track), 2)))
    _, segments = follow_positions(spoilt)
    assert time_of(segments, WALKING) > 0.95 * 1800
    assert distance(segments, WALKING) == pytest.approx(distance(clean, WALKING), rel=0.02)


def test_where_nothing_was_recorded_is_a_gap():
    """Half an hour: shown as one, without a distance, and nobody knows where they were in its midst."""
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


def test_the_covariance_of_a_gap_holds_those_who_walked_on():
    """Walkers drawn from the model, unseen for half an hour: at its rows, and linear between them."""
    inside, seeds = [], 60
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        time = np.r_[np.arange(0, 600, 5.0), np.arange(700, 2400, 100.0), np.arange(2400, 3000, 5.0)]
        covariance = kernel(time, SPEED[LOST], KEEPS[LOST])
        truth = np.linalg.cholesky(covariance + 1e-6 * np.eye(len(time))) @ random.normal(size=(len(time), 2))
        known = (time < 600) | (time >= 2400)
        fixes = Fixes(time[known], truth[known], np.full(known.sum(), SIGMA), ("",) * known.sum())
        way, _ = follow_positions(fixes)
        for at in (900.0, 1500.0, 2200.0):
            mean = [np.interp(at, way.time, axis) for axis in way.position.T]
            variance = np.interp(at, way.time, way.covariance[:, 0, 0])
            inside.append(np.sum((truth[time == at][0] - mean) ** 2) / variance < chi2.ppf(0.9, 2))
    assert 0.8 < np.mean(inside) < 0.98


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.5, 1.0, 5.0, 30.0, 70.0, 3600.0]), max_size=60), st.integers(0, 99))
def test_segments_cover_whatever_was_recorded(spans, seed):
    """Any intervals, repeated times as well: no holes, and every long interval is within a gap."""
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


def test_turning_the_world_turns_the_way():
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
    """Two bouts of so many steps, straight on, and a pause between them [s]."""
    one = steps_of(np.full(count, 0.7), np.zeros(count))
    late = replace(one, start=one.end, end=one.end + pause + one.end, time=one.time + one.end + pause)
    return then(one, late)


def kinds(segments):
    return [s.kind for s in segments]


def test_steps_that_follow_one_another_are_a_walk_and_pauses_are_not():
    steps = paused(40, 20.0)
    track = dead_reckon(steps)
    segments = segments_of(steps, track, np.empty((0, 2)))
    covers(segments, steps.start, steps.end)
    assert kinds(segments) == [WALKING, STANDING, WALKING]
    assert segments[1].end - segments[1].start == pytest.approx(20.4)
    assert distance(segments, WALKING) == pytest.approx(80 * 0.7)
    assert kinds(segments_of(paused(40, PAUSE - 1), track, np.empty((0, 2)))) == [WALKING]


def test_a_walk_is_as_long_as_its_trajectory():
    """Which the graph has scaled; not as long as the steps."""
    steps = paused(40, 20.0)
    track = dead_reckon(steps)
    track = replace(track, position=1.1 * track.position)
    assert distance(segments_of(steps, track, np.empty((0, 2))), WALKING) == pytest.approx(1.1 * 80 * 0.7)


def test_shuffling_is_standing():
    steps = paused(3, 20.0)
    steps = replace(steps, start=-10.0, end=steps.end + 10.0)
    assert kinds(segments_of(steps, dead_reckon(steps), np.empty((0, 2)))) == [STANDING]


def test_a_gap_in_the_recording_is_a_gap_and_a_ride_a_ride():
    walk = steps_of(np.full(40, 0.7), np.zeros(40))
    lost = then(walk, gap(walk.end, walk.end + 100.0))
    late = replace(walk, start=lost.end, end=lost.end + walk.end, time=walk.time + lost.end)
    steps = then(lost, late)
    track = dead_reckon(steps)
    segments = segments_of(steps, track, np.empty((0, 2)))
    covers(segments, steps.start, steps.end)
    assert kinds(segments) == [WALKING, GAP, WALKING]
    assert (segments[1].start, segments[1].end) == pytest.approx((walk.end, lost.end))
    ridden = np.array([[walk.end, walk.end + 100.0]])
    assert kinds(segments_of(steps, track, ridden)) == [WALKING, VEHICLE, WALKING]


def test_a_recording_without_steps_stands():
    none = Steps(0.0, 60.0, *np.empty((7, 0)))
    assert kinds(segments_of(none, dead_reckon(none), np.empty((0, 2)))) == [STANDING]


# --- rides within a walk


def walk_and_ride(ride, bumps=0.0, seed=0, every=1, noise=USUAL):
    """A walk, a ride or what else is given, a walk again: steps, fixes, when it was [s], and the truth per second.

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
def test_a_ride_is_found_however_bumpy(bumps, every):
    for seed in range(3):
        steps, fixes, (begin, end), _ = walk_and_ride([("bus", 400)], bumps, seed, every)
        ((found, left),) = rides(steps, fixes)
        # boarding and leaving are slow, and a fix may be 20 s from either; a bus may wait for a minute at its last stop
        assert found == pytest.approx(begin, abs=45)
        assert left == pytest.approx(end, abs=75)


def test_a_ride_goes_on_after_a_stop_and_ends_with_a_walk():
    """Three minutes at a stop with nobody walking are a part of it; 130 m on foot to the next bus are not."""
    stop, change = [("bus", 300), ("stand", 180), ("bus", 300)], [("bus", 300), ("walk", 100), ("bus", 300)]
    for seed in range(3):
        steps, fixes, _, _ = walk_and_ride(stop, seed=seed)
        assert len(rides(steps, fixes)) == 1
        steps, fixes, _, _ = walk_and_ride(change, seed=seed)
        assert len(rides(steps, fixes)) == 2


def test_a_ride_underground_is_found():
    """No fix for its ten minutes."""
    steps, fixes, (begin, end), _ = walk_and_ride([("bus", 600)])
    heard = fixes[(fixes.time < begin - 5) | (fixes.time > end + 5)]
    ((found, left),) = rides(steps, heard)
    assert found == pytest.approx(begin, abs=45)
    assert left == pytest.approx(end, abs=45)


def test_a_ride_without_any_step_is_all_there_is():
    still = Steps(0.0, 600.0, *np.empty((7, 0)))
    place, _ = streets([("bus", 600)])
    found = rides(still, seen(place))
    assert found == pytest.approx(np.array([[0.0, 600.0]]), abs=75)
    assert len(without_rides(still, found)) == 1
    assert not len(rides(still, Fixes.none()))


@pytest.mark.parametrize("noise", NOISE)
def test_a_walk_has_no_ride(noise):
    for seed in range(3):
        steps, fixes, _, _ = walk_and_ride([("walk", 0)], 0.0, seed, noise=NOISE[noise])
        assert not len(rides(steps, fixes))


def test_jumps_of_a_receiver_are_no_ride():
    """Indoors: it settles 40 m off for minutes, and back."""
    steps, fixes, _, _ = walk_and_ride([("walk", 0)])
    jumps = 40.0 * ((fixes.time // 150) % 2)
    assert not len(rides(steps, replace(fixes, position=fixes.position + jumps[:, None] * [0.6, 0.8])))


def test_a_gap_in_the_recording_is_no_ride():
    """The walker walked on, 500 m, while the phone slept: nobody says how."""
    steps = steps_of(np.full(1200, 0.7), np.zeros(1200))
    track = dead_reckon(steps)
    slept = without_rides(steps, np.array([[200.0, 500.0]]))
    rows = np.r_[:360, 920:1200:2]
    fixes = Fixes(track.time[rows], track.position[rows], np.full(len(rows), 3.0), ("",) * len(rows))
    assert not len(rides(slept, fixes))


def test_a_ride_is_one_row_that_leads_anywhere():
    steps, _, (begin, end), _ = walk_and_ride([("bus", 400)], bumps=1.0)
    ridden = without_rides(steps, np.array([[begin, end]]))
    ((row,),) = np.nonzero(ridden.length == 0)
    assert (ridden.time[row], ridden.duration[row]) == (end, end - begin)
    assert ridden.sigma_length[row] > 9.0 * 400 / 2  # a bus is within two sigmas
    assert ((ridden.time[:row] <= begin) & (ridden.length[:row] > 0)).all()
    assert (ridden.time[row + 1 :] - ridden.duration[row + 1 :] >= end).all()
    assert without_rides(steps, np.empty((0, 2))) is steps


def test_a_ride_does_not_bend_the_walk():
    """Smoothed with a ride in it, both walks lie where they were: within what the receiver errs. Unseen, it does."""
    steps, fixes, (begin, end), place = walk_and_ride([("bus", 400)], bumps=0.3, every=5)

    def off(steps):
        track = smooth(WalkGraph(steps, fixes)).trajectory
        walks = (track.time < begin - 30) | (track.time > end + 60)
        return np.hypot(*(track.position - place[np.minimum(track.time, len(place) - 1).astype(int)])[walks].T)

    found = rides(steps, fixes)
    assert np.percentile(off(without_rides(steps, found)), 90) < 2.5 * SIGMA
    assert np.percentile(off(steps), 90) > 5 * SIGMA


def test_a_ride_begins_at_the_last_step_before_it():
    """Waiting at the stop is a part of it, if that is short: the bus sets off slowly."""
    steps, fixes, _, _ = walk_and_ride([("bus", 400)])
    steps = replace(steps, time=steps.time - 0.05)  # fixes are at whole seconds
    ((found, _),) = rides(steps, fixes)
    assert found in steps.time


def test_segments_of_a_ride_are_one_vehicle():
    steps, fixes, (begin, end), _ = walk_and_ride([("bus", 400)], bumps=1.0)
    found = rides(steps, fixes)
    steps = without_rides(steps, found)
    segments = segments_of(steps, dead_reckon(steps), found)
    covers(segments, steps.start, steps.end)
    assert time_of(segments, VEHICLE) == pytest.approx(end - begin, abs=75)
    assert kinds(segments).count(VEHICLE) == 1
    assert isinstance(dead_reckon(steps), Trajectory)
