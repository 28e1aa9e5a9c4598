"""Which recordings of a day are one session."""

from dataclasses import replace

import numpy as np
import pytest
from observations import HERE, NOON, observation, positions, walk

from pdr_graph.apps.lifelog.sessions import LONGEST_SESSION_GAP, sessions_of
from pdr_graph.frames import Frame


def named(*ones):
    return {f"r{n}": one for n, one in enumerate(ones)}


def later(one, by, **other):
    return replace(one, epoch=one.epoch + by, **other)


def sizes(*ones):
    return [len(group.parts) for group in sessions_of(named(*ones))]


def test_a_short_gap_continues_a_session_and_a_long_one_ends_it():
    one = walk()[0]
    assert sizes(one, later(one, one.duration + LONGEST_SESSION_GAP - 1)) == [2]
    assert sizes(one, later(one, one.duration + LONGEST_SESSION_GAP + 1)) == [1, 1]


def test_the_order_of_adding_does_not_matter():
    one = walk()[0]
    parts = [later(one, k * (one.duration + 5)) for k in range(4)]
    forth = sessions_of(dict(zip("abcd", parts, strict=True)))
    back = sessions_of(dict(reversed(list(zip("abcd", parts, strict=True)))))
    assert [group.hashes for group in forth] == [group.hashes for group in back] == [("a", "b", "c", "d")]


def test_another_plan_is_another_session():
    one = walk()[0]
    assert sizes(one, later(one, one.duration + 5, plan="mall")) == [1, 1]


def test_frames_that_cannot_be_converted_are_two_sessions():
    one = walk()[0]
    assert sizes(one, later(one, one.duration + 5, frame=Frame())) == [1, 1]


def test_a_recording_without_position_continues_in_the_frame_of_the_one_before():
    one = walk()[0]
    lost = observation(one.steps, one.fixes[:0], one.epoch + one.duration + 5, Frame())
    assert sizes(one, lost) == [2]


def test_the_later_of_two_simultaneous_recordings_is_left_out_with_a_note():
    one = walk()[0]
    [group] = sessions_of(named(one, later(one, 10.0, source="second phone")))
    assert len(group.parts) == 1
    assert any("second phone" in note for note in group.notes)


def test_positions_of_a_watch_are_split_between_the_walk_and_the_time_around_it():
    one = walk(120)[0]
    watch = positions(1000.0, NOON - 400.0)
    before, beside, after = sessions_of(named(one, watch))
    assert beside.parts[0][1] is one
    [(_, given)] = beside.beside
    time = given.epoch + given.fixes.time
    assert ((time >= one.epoch) & (time <= one.epoch + one.duration)).all()
    counted = len(before.parts[0][1].fixes) + len(given.fixes) + len(after.parts[0][1].fixes)
    assert counted == len(watch.fixes), "none is lost and none counts twice"
    assert before.end < one.epoch < one.epoch + one.duration < after.epoch


def test_positions_alone_are_sessions_of_their_own():
    one, two = positions(300.0), positions(300.0, NOON + 300.0 + LONGEST_SESSION_GAP + 100)
    assert sizes(one, two) == [1, 1]
    assert np.allclose(sessions_of(named(one))[0].epoch, NOON)


@pytest.mark.parametrize("count", [0, 1])
def test_a_day_without_recordings_or_with_one_position_has_no_session(count):
    one = positions(4.0)
    assert len(one.fixes) == 1
    assert sessions_of(named(*[one][:count])) == []


def test_sessions_are_in_order_of_time():
    one = walk()[0]
    groups = sessions_of(named(later(one, 9000.0), positions(300.0, NOON + 4000), one))
    assert [group.epoch for group in groups] == sorted(group.epoch for group in groups)
    assert groups[0].parts[0][1].frame == HERE
