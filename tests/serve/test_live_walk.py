"""One walker: order, repeats, gaps, damage, and the walk that goes on after the process ended at any moment."""

import contextlib
import json
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
import pytest
import simulated
from hypothesis import given
from hypothesis import strategies as st
from streamed_walks import bodies

from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.serve import live_walk
from pdr_graph.apps.serve.live_walk import LOG, SESSION, LiveWalk, MessageLog, Queue, Session, finish
from pdr_graph.errors import InputError
from pdr_graph.online.interface import events_of
from pdr_graph.online.journal import END, MESSAGES, Entry, read_body, read_entries
from pdr_graph.online.navigator import Navigator

SECONDS = 20
EPOCH = simulated.START  # Unix time [s]


@pytest.fixture(scope="module")
def recording():
    """A walk of half a minute with a fix every five seconds; messages are those of SECONDS."""
    walk = simulated.walk_along(np.array([[0.0, 0.0], [25.0, 0.0], [25.0, 15.0]]), seed=3)
    time = np.where(walk.time == walk.time[0], 0.0, walk.time + 0.003)  # [s]: but the first none where packets meet
    time = (round(EPOCH * 1e9) + np.round(time * 1e9).astype(int)) * 1e-9 - EPOCH  # as messages have it
    return simulated.with_receiver(replace(walk, time=time), every=500)


@pytest.fixture(scope="module")
def messages(recording):
    return bodies(recording, "s")[:SECONDS]


def opened(folder):
    session = Session("s", "s", "phone", "owner", "sensorlogger", "android", 0.0)
    return LiveWalk(folder, session, partial(Navigator, lag=20.0))


def received(n):
    """When message n arrives [s]: with its last sample. It is in the pose, so that no clock of today may say it."""
    return EPOCH + n + 1.0


def logged(folder, messages, numbers=None, late=0.0):
    """A log of messages; numbers: their order of arrival; late [s]: by the server's clock."""
    log = MessageLog(folder / LOG)
    for n in range(len(messages)) if numbers is None else numbers:
        log.add(n, received(n) + late, messages[n])
    log.close()


def used(walk, now=np.inf):
    while walk.work(now):
        pass
    return walk.pose()


@pytest.fixture(scope="module")
def expected(messages, tmp_path_factory):
    """The pose after all messages, in order and without an interruption."""
    folder = tmp_path_factory.mktemp("expected")
    logged(folder, messages)
    return used(opened(folder))


@pytest.fixture
def walk(messages, tmp_path):
    """A walk whose messages wait."""
    logged(tmp_path, messages)
    return opened(tmp_path)


def test_the_pose_is_that_of_a_navigator_that_gets_the_recording(recording, expected):
    """To the millimetre: its events are the same."""
    nav = Navigator(lag=20.0, epoch=recording.epoch)
    for event in events_of(recording):
        if event.time[-1] < SECONDS - 0.1:  # the packet that the last message ends within waits
            nav.push(event)
            nav.review()
    assert expected["x"] == pytest.approx(nav.pose.x, abs=0.001)
    assert expected["y"] == pytest.approx(nav.pose.y, abs=0.001)
    assert expected["steps"] == nav.steps


SWAPPED = [n + 1 - 2 * (n % 2) if 2 <= n < SECONDS - 2 else n for n in range(SECONDS)]


@pytest.mark.parametrize(
    "numbers", [SWAPPED, [n for n in range(SECONDS) for _ in range(2)]], ids=["out of order", "repeated"]
)
def test_messages_are_put_in_order_and_used_once(messages, expected, tmp_path, numbers):
    """Files of earlier versions beside the log are ignored."""
    logged(tmp_path, messages, numbers)
    (tmp_path / "walk.journal").write_bytes(b"of an earlier version")
    assert used(opened(tmp_path), now=0.0) == expected


def test_a_lost_message_is_a_gap_of_the_walk(messages, expected, tmp_path):
    """The walker may have turned meanwhile, so that the direction can be open; the place goes on."""
    logged(tmp_path, messages, [n for n in range(SECONDS) if n != 15])
    pose = used(opened(tmp_path))
    assert pose["state"] in ("running", "initialising heading")
    assert np.hypot(pose["x"] - expected["x"], pose["y"] - expected["y"]) < 2 * pose["sigma"]


def test_the_walk_goes_on_after_its_process_ended_within_a_message(messages, expected, tmp_path, monkeypatch):
    """Before, after or between its events; it had published poses and paths."""
    random, push = np.random.default_rng(0), Navigator.push
    for end in range(4):
        logged(tmp_path, messages[: SECONDS * (end + 1) // 4])
        walk, remaining = opened(tmp_path), iter(range(random.integers(1, 250)))

        def interrupted(navigator, event, remaining=remaining):
            if next(remaining, None) is None:
                raise KeyboardInterrupt  # it passes all handlers, as a signal does
            push(navigator, event)

        with monkeypatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
            patch.setattr(Navigator, "push", interrupted)
            while walk.work(np.inf):
                walk.pose()
                walk.path()
    assert used(opened(tmp_path)) == expected


def test_poses_and_paths_between_messages_change_nothing(walk, expected):
    assert walk.catching_up
    while walk.work(np.inf):
        assert walk.pose()["message"] == SECONDS - walk.waiting
        walk.path()
    assert not walk.catching_up
    assert without_display(walk.pose()) == without_display(expected)


def without_display(pose):
    """A pose without the point of a map, which follows a jump of the poses that it showed."""
    return {name: value for name, value in pose.items() if name != "display"}


def test_an_event_that_fails_is_counted_and_the_walk_goes_on(walk, monkeypatch):
    push = Navigator.push

    def failing(navigator, event):
        if event.time[0] == pytest.approx(10.0, abs=0.01):
            raise ZeroDivisionError
        push(navigator, event)

    monkeypatch.setattr(Navigator, "push", failing)
    pose = used(walk)
    assert any("could not be used" in issue for issue in pose["issues"])
    assert pose["steps"] > 25


def test_the_path_comes_in_parts_that_are_the_whole(messages, tmp_path):
    log, points = MessageLog(tmp_path / LOG), {"time": [], "x": []}
    walk = opened(tmp_path)
    for n, body in enumerate(messages):
        log.add(n, received(n), body)
        walk.look()
        used(walk)
        path = walk.path()
        if path is None:
            continue
        assert path["from"] == len(points["time"])
        for name, column in points.items():
            column += path["finalised"][name]
    whole = walk.path(whole=True)
    assert whole["finalised"]["time"] == points["time"]
    assert whole["finalised"]["x"] == points["x"]
    assert (np.diff(points["time"] + path["current"]["time"]) > 0).all()
    log.close()


def test_a_finished_walk_has_its_whole_path(walk):
    pose, path = walk.finish()
    assert pose["state"] == "finished"
    assert path["current"]["time"] == []
    assert len(path["finalised"]["time"]) > 18


def test_a_clock_hours_off_is_an_issue(messages, tmp_path):
    logged(tmp_path, messages[:5], late=2 * 3600.0)
    assert "the phone's clock is 2.0 h behind this machine's" in used(opened(tmp_path))["issues"]


def test_positions_that_a_clock_set_back_leaves_out_are_an_issue(tmp_path):
    """The machine's, by three hours, between two messages of positions alone."""
    log = MessageLog(tmp_path / LOG)
    for n in range(4):
        body = json.dumps(sensor_logger(n, EPOCH + n, 11.0)).encode()
        log.add(n, EPOCH + n - (3 * 3600.0 if n > 1 else 0.0), body)
    log.close()
    assert "the phone's clock is 3.0 h ahead of this machine's" in used(opened(tmp_path))["issues"]


def entry(identity, received=0.0):
    return Entry(identity, received, identity, identity + 1)


TOO_MANY = list(range(5, 5 + live_walk.MOST_WAITING + 1))


# Positions alone: (seconds before the last, metres to the east, seconds by which the phone's clock is ahead)
QUEUED = [(180, 480, 0), (120, 540, 0), (60, 600, 0)]
ARRIVALS = {
    "queued": (QUEUED, 600),
    "newest first": ([(60, 540, 0), (120, 480, 0), (180, 420, 0), (240, 360, 0)], 540),
    "hours late": ([*QUEUED, (6000, 0, 0), (5940, 60, 0), (5880, 120, 0)], 600),
    "a hundred, newest first": ([(10 * n, 1000 - 10 * n, 0) for n in range(100)], 1000),
    "doubled": ([*QUEUED, QUEUED[0], QUEUED[2]], 600),
    "a clock set right": ([*((ago, east, 86400) for ago, east, _ in QUEUED), (30, 630, 0)], 630),
}


def owntracks(n, time, lon):
    return {"_type": "location", "tst": time, "lat": 48.0, "lon": lon, "acc": 8}


def sensor_logger(n, time, lon):
    place = {"latitude": 48.0, "longitude": lon, "horizontalAccuracy": 8}
    sample = {"name": "location", "time": int(time * 1e9), "values": place}
    return {"messageId": n, "sessionId": "s", "payload": [sample]}


@pytest.mark.parametrize("app", [owntracks, sensor_logger])
@pytest.mark.parametrize(("posted", "newest"), ARRIVALS.values(), ids=ARRIVALS)
def test_the_dot_is_at_the_newest_position_in_any_order_of_arrival(posted, newest, app, tmp_path):
    """A late one changes the recording, not the dot; one of the future is of the moment at which it came."""
    log, degree = MessageLog(tmp_path / LOG), 111_320 * np.cos(np.radians(48.0))
    for n, (ago, east, ahead) in enumerate(posted):
        message = app(n, EPOCH - ago + ahead, 11.0 + east / degree)
        log.add(n, EPOCH - ago if ahead else EPOCH, json.dumps(message).encode())
    log.close()
    walk = LiveWalk(tmp_path, Session("s", "s", "phone", "owner", app.__name__.replace("_", ""), "", 0.0), Navigator)
    pose = used(walk)
    assert (pose["lon"] - 11.0) * degree == pytest.approx(newest, abs=5.0)
    assert pose["time"] == pytest.approx(EPOCH - min(ago for ago, _, _ in posted), abs=0.01)


@pytest.mark.parametrize(
    ("identities", "now", "order"),
    [
        ([0, 2, 3], 101.9, [0]),
        ([0, 2, 3], 102.1, [0, 2, 3]),
        (TOO_MANY, 100.0, TOO_MANY),
    ],
    ids=["one is missing", "for two seconds", "too many wait"],
)
def test_a_message_waits_two_seconds_for_those_before_it_unless_too_many_wait(identities, now, order):
    queue = Queue(ordered=True)
    for identity in identities:
        queue.add(entry(identity, received=100.0))
    assert emptied(queue, now) == order


def test_the_order_does_not_depend_on_when_it_is_asked_for():
    """A message that came too late stays late when the log is read again."""
    arrivals = [(0, 100.0), (2, 100.1), (1, 103.0), (3, 103.1), (5, 103.2), (4, 104.0)]
    live, again, order = Queue(ordered=True), Queue(ordered=True), []
    for identity, received in arrivals:
        order += emptied(live, received)
        for queue in (live, again):
            queue.add(entry(identity, received))
    assert [*order, *emptied(live)] == emptied(again) == [0, 2, 1, 3, 4, 5]


@pytest.mark.parametrize("jump", [-3600.0, 3600.0])
def test_a_clock_that_is_set_keeps_no_message_waiting(jump):
    """Message 1 is missing when the clock is set; those after it come a second apart."""
    queue = Queue(ordered=True)
    for identity, received in ((0, 5000.0), (2, 5001.0), (3, 5002.0 + jump), (4, 5003.0 + jump), (5, 5004.0 + jump)):
        queue.add(entry(identity, received))
    assert emptied(queue, 5004.5 + jump) == [0, 2, 3, 4, 5]


def emptied(queue, now=np.inf):
    """Identities of the messages that are due."""
    order = []
    while (due := queue.next(now)) is not None:
        order.append(due.identity)
    return order


def test_a_message_that_is_damaged_or_cut_short_by_a_kill_is_no_message(tmp_path):
    log = MessageLog(tmp_path / "log")
    log.add(1, 0.0, b"one")
    log.add(2, 0.0, b"two" * 100)
    log.close()
    whole = (tmp_path / "log").read_bytes().removesuffix(END)
    for damaged in (whole[:-1] + b"?", *(whole[:end] for end in range(len(MESSAGES), len(whole)))):
        (tmp_path / "log").write_bytes(damaged)
        log = MessageLog(tmp_path / "log")
        assert 2 not in log.identities
        assert log.add(2, 0.0, b"again")
        log.close()
        read = [read_body(tmp_path / "log", each) for each in read_entries(tmp_path / "log")]
        assert read[-1] == b"again"


@given(st.lists(st.integers(-9, 9) | st.integers(-(1 << 62), 1 << 62), unique=True, max_size=30))
def test_the_numbers_of_messages_are_those_that_were_added(added):
    numbers = live_walk.Numbers()
    for n, number in enumerate(added):
        assert number not in numbers
        numbers.add(number)
        assert all(each in numbers for each in added[: n + 1])
    assert [each for each in range(-11, 12) if each in numbers] == sorted(each for each in added if abs(each) < 12)
    assert sum(end - begin for begin, end in zip(numbers._begins, numbers._ends, strict=True)) == len(added)


def test_messages_that_follow_one_another_cost_no_memory():
    numbers = live_walk.Numbers()
    for number in [*range(1, 1000, 2), *range(0, 1001, 2)]:
        numbers.add(number)
    assert len(numbers._begins) == 1


def test_another_file_is_no_log(tmp_path):
    (tmp_path / "log").write_bytes(b"x" * 100)
    with pytest.raises(InputError):
        MessageLog(tmp_path / "log")


def test_a_finished_walk_is_a_day_of_the_lifelog(messages, tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    logged(folder, messages)
    session = Session("s", "s", "phone", "ann", "sensorlogger", "android", EPOCH, True)
    (folder / SESSION).write_bytes(msgspec.json.encode(session))
    for _ in range(2):  # a walk that was resumed is finished again
        assert finish(folder, tmp_path / "days.db", None) == ""
    with Store(tmp_path / "days.db") as log:
        ((person, date),) = log.days()
    assert (person, date) == ("ann", "2023-11-14")
