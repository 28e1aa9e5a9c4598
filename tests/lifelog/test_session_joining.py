"""Recordings of a session joined to one walk."""

from dataclasses import replace

import numpy as np
import pytest
from observations import HERE, NOON, cut_in_two, observation, positions, walk

from pdr_graph import WalkGraph, smooth
from pdr_graph.apps.lifelog.sessions import LONGEST_RESTART, TURN_SIGMA, join, restart_closures, turn_by_field
from pdr_graph.frames import Frame, enu
from pdr_graph.priors import MOTION
from pdr_graph.types import Beacons


def smoothed(parts, fixes=None):
    one = join(parts)
    return smooth(
        WalkGraph(one.steps, one.fixes if fixes is None else fixes, closures=restart_closures(parts))
    ).trajectory


def errors_of_the_second(parts, track):
    """Errors of the second recording [m]."""
    (one, _), (two, truth) = parts
    begins = two.epoch - one.epoch
    own = (track.time > begins) & (track.time < begins + truth.time[-1])
    at = np.stack([np.interp(track.time[own] - begins, truth.time, axis) for axis in truth.position.T], axis=1)
    return np.hypot(*(track.position[own] - at).T)


def test_joined_recordings_have_all_rows_on_one_clock():
    (one, _), (two, _) = cut_in_two(100, 1, 8.0)
    both = join([one, two])
    begins = two.epoch - one.epoch
    assert len(both.steps) == len(one.steps) + 1 + len(two.steps)
    assert both.steps.time[-len(two.steps) :] == pytest.approx(two.steps.time + begins)
    assert both.steps.length.sum() == pytest.approx(one.steps.length.sum() + two.steps.length.sum())
    assert len(both.fixes) == len(one.fixes) + len(two.fixes)
    assert (np.diff(both.fixes.time) >= 0).all()
    assert both.duration == pytest.approx(begins + two.duration)
    assert len(both.looks) == len(both.steps) + 1


@pytest.mark.parametrize("turned", [-2.0, 0.3, 2.8])
def test_the_magnetic_field_determines_the_turn_between_two_recordings(turned):
    (one, _), (two, _) = cut_in_two(60, 1, 8.0, turned=turned)
    assert turn_by_field(one, two) == pytest.approx(turned, abs=1e-6)
    both = join([one, two])
    gap = np.flatnonzero(both.steps.is_gap)
    assert both.steps.sigma_turn[gap] == pytest.approx([TURN_SIGMA])


def test_the_field_of_another_place_determines_no_turn():
    (one, _), (two, _) = cut_in_two(60, 1, 8.0)
    stronger = replace(two, ends=replace(two.ends, field=2 * two.ends.field))
    assert turn_by_field(one, stronger) is None
    both = join([one, stronger])
    assert both.steps.sigma_turn[both.steps.is_gap] == pytest.approx([MOTION.gap_turn])


def test_a_recording_without_fixes_is_located_by_the_restart_and_the_field():
    """Half of the walk has no fix; it begins where the other half ended, turned as the field states."""
    worse, better = [], []
    for seed in range(8):
        parts = cut_in_two(120, seed, 8.0, turned=1.2)
        (one, _), (two, _) = parts
        two = replace(two, fixes=two.fixes[:0])
        better.append(np.median(errors_of_the_second(parts, smoothed([one, two]))))
        blind = [replace(one, ends=None), replace(two, ends=None)]
        worse.append(np.median(errors_of_the_second(parts, smoothed(blind))))
    assert np.median(better) < 0.35 * np.median(worse)


@pytest.mark.parametrize("seed", range(6))
def test_the_closure_is_rejected_if_the_walker_walked_on(seed):
    """20 m in 14 s, with fixes on both sides: the closure changes the walk by less than 10 cm."""
    parts = cut_in_two(120, seed, 14.0, stood=False)
    both = join([one for one, _ in parts])
    unbound = smooth(WalkGraph(both.steps, both.fixes)).trajectory
    harm = errors_of_the_second(parts, smoothed([one for one, _ in parts])) - errors_of_the_second(parts, unbound)
    assert np.max(harm) < 0.1


def test_a_long_gap_is_no_closure():
    (one, _), (two, _) = cut_in_two(60, 1, LONGEST_RESTART + 1)
    both = join([one, two])
    assert len(restart_closures([one, two])) == 0
    gap = both.steps.is_gap
    assert both.steps.sigma_length[gap] == pytest.approx([LONGEST_RESTART + 1], rel=1e-3), "1 m/s: they stand or walk"


def test_recordings_are_converted_to_the_frame_of_the_first():
    one = walk(60)[0]
    there = enu(48.101, 11.601)
    lonlat = HERE.to_lonlat(one.fixes.position)
    elsewhere = replace(one, frame=there, fixes=replace(one.fixes, position=there.from_lonlat(lonlat)))
    both = join([one, replace(elsewhere, epoch=NOON + one.duration + 5)])
    assert both.frame == HERE
    n = len(one.fixes)
    assert both.fixes.position[n:] == pytest.approx(one.fixes.position, abs=1e-3)


def test_beacons_are_converted_to_the_frame_of_the_first_recording():
    """A list without latitudes, of a recording in a frame of its own, is left out."""
    one, there, place = walk(60)[0], enu(48.101, 11.601), np.array([[3.0, 4.0]])
    beacons = Beacons(("a",), there.from_lonlat(HERE.to_lonlat(place)), np.ones(1), ("",), ("a",))
    two = replace(one, frame=there, fixes=one.fixes[:0], beacons=beacons, epoch=NOON + one.duration + 5)
    assert join([one, two]).beacons.position == pytest.approx(place, abs=1e-3)
    assert join([one, replace(two, frame=Frame())]).beacons is None


def test_the_positions_of_a_watch_are_fixes_of_the_walk():
    one = observation(walk(120)[0].steps, positions(1.0).fixes[:0])
    watch = positions(60.0, NOON + 10.0)
    assert join([one], [watch]).fixes.time == pytest.approx(watch.fixes.time + 10.0)
