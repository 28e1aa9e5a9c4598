"""The floor of a walk under way, compared with that of the whole walk."""

from dataclasses import replace

import numpy as np
import pytest
from test_floors import Plan, along, fixes, flights, in_order

from pdr_graph.estimation.floors import LiveFloors, floors_along
from pdr_graph.priors import LIVE_FLOORS
from pdr_graph.types import Fixes, Steps

SOON = 10.0  # [s] after a climb: half the window of a median, a rate's Gaussian, a look every 3 s
NAMES = ("time", "duration", "length", "turn", "pause_turn", "sigma_length", "sigma_turn")


def part(steps, begin, end):
    """The steps that ended between two times [s]."""
    some = (steps.time > begin) & (steps.time <= end)
    rows = {name: getattr(steps, name)[some] for name in NAMES}
    return replace(steps, start=begin, end=end, final_turn=0.0, **rows)


def second_by_second(steps, barometer, floors, said=None, certain=6.0):
    """The label and whether one climbs after each second; steps are certain some seconds later."""
    rows, sure = [], steps.start
    for now in np.arange(steps.start + 1, steps.end, 1.0):
        some = (barometer.time > now - 1) & (barometer.time <= now)
        floors.push(barometer.time[some], barometer.values[some])
        if said is not None and np.any((said.time > now - 1) & (said.time <= now)):
            floors.add_fixes(said[(said.time > now - 1) & (said.time <= now)])
        landed = steps.time[steps.time <= now - certain]
        if len(landed) and landed[-1] > sure:
            floors.add_steps(part(steps, sure, landed[-1]))
            sure = landed[-1]
        if sure > steps.start:
            floors.advance(part(steps, sure, now))
        rows.append((now, floors.label, floors.climbing))
    return rows


def labels_of(rows):
    return in_order([label for _, label, _ in rows])


@pytest.mark.parametrize("plan", [None, Plan(("0", "1", "2"), np.array([0.0, 3.6, 7.2]))])
def test_the_floor_is_estimated_soon_after_the_stairs(plan):
    """While on them it says that it climbs, and a little later all is as offline."""
    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (140, 3.6), (154, 7.2), (220, 7.2))
    floors = LiveFloors(plan, "0")
    rows = second_by_second(steps, barometer, floors)
    assert labels_of(rows) == ["0", "1", "2"]
    for end, label in ((74, "1"), (154, "2")):
        assert next(now for now, current, _ in rows if current == label) <= end + SOON
    climbing = [now for now, _, climbs in rows if climbs]
    assert all(60 < now < 74 + SOON or 140 < now < 154 + SOON for now in climbing)
    assert len(climbing) > 14
    last = steps.time[steps.time > 150]
    offline = np.array(floors_along(steps, barometer, "0", Fixes.none(), plan).labels[1:-1])[steps.time > 150]
    assert np.mean(np.array(floors.labels(last)) == offline) > 0.95


def test_a_long_walk_equals_the_batch_in_bounded_memory():
    """Twenty-four climbs in half an hour; the window holds six."""
    levels = [3.6 * n for n in (0, 1, 2, 1, 0, -1, -2, -1) * 3]
    steps, barometer = along(*flights(*levels, floor_time=70.0))
    floors, sizes = LiveFloors(None, "F1"), []
    look = floors._estimate
    floors._estimate = lambda *arguments: (sizes.append(max(len(floors.time), len(floors.pressure))), look(*arguments))
    rows = second_by_second(steps, barometer, floors)
    assert labels_of(rows) == ["F1", "F2", "F3", "F2", "F1", "B1", "B2", "B1"] * 3
    assert max(sizes) < 1.6 * LIVE_FLOORS.longest / 0.5


def test_without_a_barometer_fixes_determine_the_floor():
    """Long after the first of them too."""
    steps, barometer = along((0, 0), (900, 0))
    nothing = replace(barometer, time=barometer.time[:0], values=barometer.values[:0])
    said = fixes([(10, "0"), (20, "0"), (30, ""), (800, "1"), (810, "1"), (820, "1")])
    rows = second_by_second(steps, nothing, LiveFloors(None, ""), said)
    assert labels_of(rows) == ["", "0", "1"]
    assert next(now for now, label, _ in rows if label == "1") < 815


def test_fixes_replace_a_barometer_while_it_is_silent():
    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (300, 3.6), (314, 7.2), (500, 7.2), (514, 3.6), (600, 3.6))
    stopped = (barometer.time < 150) | (barometer.time > 400)
    gone = replace(barometer, time=barometer.time[stopped], values=barometer.values[stopped])
    stated = fixes([(100, "1"), (340, "2"), (350, "2"), (360, "2"), (370, "2")])
    assert labels_of(second_by_second(steps, gone, LiveFloors(None, "0"), stated)) == ["0", "1", "2", "1"]


@pytest.mark.parametrize(
    "change",
    [
        lambda time, hpa: (time, np.where(np.arange(len(time)) % 7 == 0, np.nan, hpa)),
        lambda time, hpa: (time, np.where(np.arange(len(time)) % 97 == 0, 1e6, hpa)),
        lambda time, hpa: (np.where(np.arange(len(time)) % 50 == 30, time + 1e6, time), hpa),
        lambda time, hpa: (np.where(np.arange(len(time)) % 50 == 30, time - 40, time), hpa),
        lambda time, hpa: (np.floor(time), hpa),
    ],
    ids=["NaN", "spikes", "ahead", "back", "repeated"],
)
def test_bad_samples_are_skipped(change):
    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (140, 3.6), (154, 0), (220, 0))
    order = np.arange(len(barometer))
    time, hpa = change(barometer.time, barometer.values[:, 0])
    floors, rows, sure = LiveFloors(None, "0"), [], 0.0
    for now in np.arange(1, 220, 1.0):
        some = order[(barometer.time > now - 1) & (barometer.time <= now)]
        floors.push(time[some], hpa[some, None])
        landed = steps.time[steps.time <= now]
        if len(landed) and landed[-1] > sure:
            floors.add_steps(part(steps, sure, landed[-1]))
            sure = landed[-1]
        floors.advance()
        rows.append((now, floors.label, floors.climbing))
    assert labels_of(rows) == ["0", "1", "0"]


@pytest.mark.parametrize("hpa", [np.nan, 0.0, 1013.0])
def test_a_stuck_barometer_never_changes_the_floor(hpa):
    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (140, 3.6))
    stuck = replace(barometer, values=np.full_like(barometer.values, hpa))
    assert labels_of(second_by_second(steps, stuck, LiveFloors(None, "0"))) == ["0"]


def test_before_the_first_steps_the_floor_is_that_of_the_start():
    floors = LiveFloors(None, "2")
    floors.push(np.array([0.0]), np.array([[1013.0]]))
    floors.advance()
    assert (floors.label, floors.labels(np.array([0.0, 5.0])), floors.climbing) == ("2", ("2", "2"), False)
    assert LiveFloors(None).labels(np.empty(0)) == ()


def test_a_chunk_may_have_no_steps():
    floors = LiveFloors(None, "0")
    nothing = Steps(0.0, 5.0, *(np.empty(0) for _ in range(7)))
    floors.add_steps(nothing)
    floors.advance(replace(nothing, start=5.0, end=9.0))
    assert floors.label == "0"
