"""A day from its observations."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from observations import HERE, NOON, median_error, observation, positions, walk
from walks import drawn_from_the_model

from pdr_graph import dead_reckon
from pdr_graph.apps.lifelog.day import ACTIVITIES, GAP, WALKING
from pdr_graph.apps.lifelog.reconstruct import reconstruct
from pdr_graph.frames import Frame
from pdr_graph.geometry import interpolate
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
    day = day_of(one, replace(one, epoch=NOON + one.duration + 590))
    [outing] = day.outings
    [gap] = [s for s in outing.segments if s.kind == GAP]
    assert gap.end - gap.start == pytest.approx(590, abs=1.0)
    assert gap.distance == 0.0
    assert (np.diff(outing.trajectory.time) > 500).sum() == 1
    assert np.sqrt(outing.trajectory.covariance[[0, -1], 0, 0]).max() < 5.0
    walked = sum(s.distance for s in outing.segments if s.kind == WALKING)
    assert walked == pytest.approx(2 * day_of(one).total(WALKING)[1], rel=0.03), "as each by itself"


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
    assert median_error(both.trajectory, truth) < 3.0
    assert set(both.recordings) == {"r0", "r1"}
    assert median_error(alone.trajectory, truth) > 10.0


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
    orders = parts, dict(reversed(parts.items()))
    forth, back = (reconstruct("me", "d", order, None).outings[0].trajectory for order in orders)
    assert np.array_equal(forth.position, back.position)
