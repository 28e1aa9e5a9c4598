"""Which recordings of a day are one session, and how they are joined to one walk."""

from dataclasses import replace

import numpy as np
import pytest
from observations import HERE, NOON, cut_in_two, positions, walk

from pdr_graph import WalkGraph, smooth
from pdr_graph.apps.lifelog.sessions import (
    LONGEST_RESTART,
    LONGEST_SESSION_GAP,
    TURN_SIGMA,
    join,
    restart_closures,
    sessions_of,
    turn_by_field,
)
from pdr_graph.frames import Frame, enu
from pdr_graph.priors import MOTION
from pdr_graph.types import Beacons

WALK = walk()[0]
THERE = enu(48.101, 11.601)


def named(*ones):
    return {f"r{n}": one for n, one in enumerate(ones)}


def after(one, gap, **other):
    """The same recording again, some seconds after its end."""
    return replace(one, epoch=one.epoch + one.duration + gap, **other)


@pytest.mark.parametrize(
    ("ones", "sizes"),
    [
        pytest.param((WALK, after(WALK, LONGEST_SESSION_GAP - 1)), [2], id="a short gap continues a session"),
        pytest.param((WALK, after(WALK, LONGEST_SESSION_GAP + 1)), [1, 1], id="a long gap ends it"),
        pytest.param((WALK, after(WALK, 5, plan="mall")), [1, 1], id="another plan is another session"),
        pytest.param((WALK, after(WALK, 5, frame=Frame())), [1, 1], id="a frame that cannot be converted too"),
        pytest.param((WALK, after(WALK, 5, fixes=WALK.fixes[:0], frame=Frame())), [2], id="no position continues"),
        pytest.param((positions(300.0), positions(300.0, NOON + 400 + LONGEST_SESSION_GAP)), [1, 1], id="a watch"),
        pytest.param((positions(4.0),), [], id="one position is no session"),
        pytest.param((), [], id="nothing"),
    ],
)
def test_which_recordings_are_one_session(ones, sizes):
    assert [len(group.parts) for group in sessions_of(named(*ones))] == sizes


def test_the_order_of_adding_does_not_matter():
    parts = [after(WALK, k * (WALK.duration + 5)) for k in range(4)]
    forth = sessions_of(dict(zip("abcd", parts, strict=True)))
    back = sessions_of(dict(reversed(list(zip("abcd", parts, strict=True)))))
    assert [group.hashes for group in forth] == [group.hashes for group in back] == [("a", "b", "c", "d")]
    groups = sessions_of(named(after(WALK, 9000.0), positions(300.0, NOON + 4000), WALK))
    assert [group.epoch for group in groups] == sorted(group.epoch for group in groups)


def test_the_later_of_two_simultaneous_recordings_is_left_out_with_a_note():
    [group] = sessions_of(named(WALK, replace(WALK, epoch=NOON + 10.0, source="second phone")))
    assert len(group.parts) == 1
    assert any("second phone" in note for note in group.notes)


def test_positions_of_a_watch_are_split_between_the_walk_and_the_time_around_it():
    one = walk(120)[0]
    watch = positions(1000.0, NOON - 400.0)
    before, beside, later = sessions_of(named(one, watch))
    assert beside.parts[0][1] is one
    [(_, given)] = beside.beside
    time = given.epoch + given.fixes.time
    assert ((time >= one.epoch) & (time <= one.epoch + one.duration)).all()
    counted = len(before.parts[0][1].fixes) + len(given.fixes) + len(later.parts[0][1].fixes)
    assert counted == len(watch.fixes), "none is lost and none counts twice"
    assert before.end < one.epoch < one.epoch + one.duration < later.epoch
    assert join([one], [given]).fixes.time == pytest.approx(np.sort(np.r_[one.fixes.time, time - one.epoch]))


# Joining


def smoothed(parts):
    one = join(parts)
    return smooth(WalkGraph(one.steps, one.fixes, closures=restart_closures(parts))).trajectory


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
def test_the_magnetic_field_determines_the_turn_between_two_recordings_at_one_place(turned):
    (one, _), (two, _) = cut_in_two(60, 1, 8.0, turned=turned)
    stronger = replace(two, ends=replace(two.ends, field=2 * two.ends.field))
    assert turn_by_field(one, two) == pytest.approx(turned, abs=1e-6)
    assert turn_by_field(one, stronger) is None
    for later, sigma in ((two, TURN_SIGMA), (stronger, MOTION.gap_turn)):
        steps = join([one, later]).steps
        assert steps.sigma_turn[steps.is_gap] == pytest.approx([sigma])


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
    steps = join([one, two]).steps
    assert len(restart_closures([one, two])) == 0
    expected = pytest.approx([LONGEST_RESTART + 1], rel=1e-3)
    assert steps.sigma_length[steps.is_gap] == expected, "1 m/s: they stand or walk"


def test_recordings_and_beacons_are_converted_to_the_frame_of_the_first():
    """A list of beacons without latitudes, of a recording in a frame of its own, is left out."""
    place = np.array([[3.0, 4.0]])
    fixes = replace(WALK.fixes, position=THERE.from_lonlat(HERE.to_lonlat(WALK.fixes.position)))
    beacons = Beacons(("a",), THERE.from_lonlat(HERE.to_lonlat(place)), np.ones(1), ("",), ("a",))
    later = after(WALK, 5, frame=THERE, fixes=fixes, beacons=beacons)
    both = join([WALK, later])
    assert both.frame == HERE
    assert both.fixes.position[len(fixes) :] == pytest.approx(WALK.fixes.position, abs=1e-3)
    assert both.beacons.position == pytest.approx(place, abs=1e-3)
    assert join([WALK, replace(later, fixes=fixes[:0], frame=Frame())]).beacons is None
