"""A day from its observations."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from observations import HERE, NOON, observation, positions, walk
from walks import drawn_from_the_model

from pdr_graph import dead_reckon
from pdr_graph.apps.lifelog.day import ACTIVITIES, GAP, VEHICLE, WALKING
from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.frames import Frame
from pdr_graph.gait.step_chunks import append_steps
from pdr_graph.geometry import interpolate, length_along
from pdr_graph.types import Fixes


def day_of(*ones, profile=None):
    return reconstruct("me", "2023-11-14", {f"r{n}": one for n, one in enumerate(ones)}, profile)


def test_segments_cover_every_second_of_an_outing_once():
    one = walk(120)[0]
    two = replace(one, epoch=NOON + one.duration + 120)
    for day in (day_of(one, two), day_of(positions(1200.0)), day_of(one, positions(400.0, NOON + 2000))):
        for outing in day.outings:
            bounds = [(s.start, s.end) for s in outing.segments]
            assert bounds[0][0] == pytest.approx(outing.trajectory.time[0], abs=1e-3)
            assert bounds[-1][1] == pytest.approx(outing.trajectory.time[-1], abs=1e-3)
            assert all(a[1] == pytest.approx(b[0]) for a, b in pairwise(bounds))
            assert {s.kind for s in outing.segments} <= set(ACTIVITIES)


def test_time_without_data_is_a_gap_without_a_distance():
    one = walk(120)[0]
    day = day_of(one, replace(one, epoch=NOON + one.duration + 300))
    [outing] = day.outings
    [gap] = [s for s in outing.segments if s.kind == GAP]
    assert gap.end - gap.start == pytest.approx(300, abs=1.0)
    assert gap.distance == 0.0
    walked = sum(s.distance for s in outing.segments if s.kind == WALKING)
    assert walked == pytest.approx(2 * day_of(one).total(WALKING)[1], rel=0.03), "as each by itself"


def test_the_position_is_uncertain_in_a_gap():
    """After half of ten minutes between two walks, at 1 m/s."""
    one = walk(120)[0]
    day = day_of(one, replace(one, epoch=NOON + one.duration + 590))
    track = day.outings[0].trajectory
    ends = np.sqrt(track.covariance[[0, -1], 0, 0])
    assert ends.max() < 5.0
    gap_row = np.flatnonzero(np.diff(track.time) > 500)
    assert len(gap_row) == 1


def test_a_walk_without_position_begins_where_the_outing_before_ended():
    """A watch is put away, and half a minute later a phone records in a building."""
    one = walk(120)[0]
    blind = observation(one.steps, one.fixes[:0], NOON + one.duration + 30, Frame())
    inside = day_of(positions(300.0), replace(blind, epoch=NOON + 330.0)).outings[1]
    assert inside.frame == HERE
    assert np.hypot(*(inside.trajectory.position[0] - [1.3 * 295, 0.0])) < 15.0
    assert np.sqrt(inside.trajectory.covariance[0, 0, 0]) == pytest.approx(35.0, rel=0.3), "35 s at 1 m/s"


def test_the_positions_of_a_watch_locate_the_walk_of_a_phone():
    steps, fixes, truth = drawn_from_the_model(240, 4)
    phone = observation(steps, fixes[:0], frame=Frame())
    at = np.arange(4.0, truth.time[-1], 10.0)
    place = interpolate(at, truth.time, truth.position) + np.random.default_rng(0).normal(0, 2, (len(at), 2))
    watch = observation(None, Fixes(at, place, np.full(len(at), 2.0), ("",) * len(at)))
    alone = day_of(phone).outings[0]
    both = day_of(phone, watch).outings[0]
    gap = np.hypot(*(both.trajectory.position - truth.position).T)
    assert np.median(gap) < 3.0
    assert set(both.recordings) == {"r0", "r1"}
    assert np.median(np.hypot(*(alone.trajectory.position - truth.position).T)) > 10.0


def test_a_ride_is_no_walk_and_does_not_bend_one():
    """Two walks 5 km apart, and a phone that recorded in the car between them."""
    steps, fixes, truth = drawn_from_the_model(200, 6)
    ride = 400.0
    later = replace(steps, start=steps.end, time=steps.time + steps.end + ride, end=2 * steps.end + ride)
    whole = append_steps(steps, later)
    away = np.array([5000.0, 0.0])
    on_the_way = np.arange(10.0, ride, 5.0)
    driven = fixes.position[-1] + away * (on_the_way / ride)[:, None]
    parts = [
        fixes,
        Fixes(steps.end + on_the_way, driven, np.full(len(driven), 5.0), ("",) * len(driven)),
        replace(fixes, position=fixes.position - fixes.position[0] + fixes.position[-1] + away).shifted(
            steps.end + ride
        ),
    ]
    day = day_of(observation(whole, Fixes.concatenate(parts)))
    [outing] = day.outings
    assert day.total(VEHICLE)[0] == pytest.approx(ride, abs=40)
    assert day.total(WALKING)[1] == pytest.approx(2 * length_along(truth.position)[-1], rel=0.2)
    before = outing.trajectory.time < steps.end
    alone = day_of(observation(steps, fixes)).outings[0]
    n = min(before.sum(), len(alone.trajectory)) - 10
    apart = np.hypot(*(outing.trajectory.position[:n] - alone.trajectory.position[:n]).T)
    assert np.median(apart) < 2.0


def test_the_profile_becomes_more_certain_from_day_to_day_and_stays_honest():
    """Ten days of a walker whose stride is 12 % longer than assumed, with few and poor fixes."""
    profile, sigmas, errors = None, [], []
    for seed in range(10):
        steps, _, _ = drawn_from_the_model(200, 50 + seed)
        truth_steps = replace(steps, length=1.12 * steps.length)
        truth = dead_reckon(truth_steps)
        random = np.random.default_rng(seed)
        at = np.array([1, 60, 120, 190])
        fixes = Fixes(truth.time[at], truth.position[at] + random.normal(0, 10, (4, 2)), np.full(4, 10.0), ("",) * 4)
        profile = day_of(observation(steps, fixes, NOON + 86400.0 * seed), profile=profile).profile
        sigmas.append(np.sqrt(profile.covariance[0, 0]))
        errors.append(profile.E_length - 0.12)
    assert np.mean(sigmas[5:]) < 0.8 * sigmas[0]
    assert sigmas[-1] > 0.01, "people change: it never becomes certain"
    assert np.abs(errors[-3:]).max() < 3 * np.mean(sigmas[-3:])


def test_a_walker_file_is_the_first_profile():
    one = walk(200, seed=8)[0]
    known = day_of(one).profile
    assert known is not None
    blind = observation(one.steps, one.fixes[:1])
    began = day_of(replace(blind, profile=known)).profile
    assert began.E_length == pytest.approx(known.E_length, abs=2 * np.sqrt(known.covariance[0, 0]))
    assert day_of(blind).profile is None


def test_a_day_whose_sources_contradict_each_other_teaches_no_profile_and_its_notes_say_why():
    one = walk(200, seed=8)[0]
    known = day_of(one).profile
    away = np.random.default_rng(0).normal(0, 6, one.fixes.position.shape)  # they state 1.5 m
    wrong = replace(one, fixes=replace(one.fixes, position=one.fixes.position + away))
    for before in (None, known):
        day = day_of(wrong, profile=before)
        assert day.profile is before
        assert day.outings[0].notes[0].startswith("doubtful: ")


def test_the_order_in_which_recordings_were_added_does_not_matter():
    one = walk(100)[0]
    parts = {name: replace(one, epoch=NOON + 200.0 * n, source=name) for n, name in enumerate("abc")}
    forth = reconstruct("me", "d", parts, None)
    back = reconstruct("me", "d", dict(reversed(parts.items())), None)
    assert np.array_equal(forth.outings[0].trajectory.position, back.outings[0].trajectory.position)
