"""The floor of each step, on walks with known heights, of the whole walk and of one under way."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from walks import part

from pdr_graph.estimation.floors import LONGEST_WINDOW, LiveFloors, floors_along, floors_of
from pdr_graph.geometry import row_times
from pdr_graph.inertial.barometer import SCALE_HEIGHT
from pdr_graph.types import Fixes, Signal, Steps, take

SOON = 10.0  # [s] after a climb: half the window of a median, a rate's Gaussian, a look every 3 s


@dataclass(frozen=True)
class Plan:
    labels: tuple[str, ...]
    heights: np.ndarray


def along(*corners, seed=0, still=()):
    """Steps and barometer of a walk with corners (time [s], height [m]); no step is made in ``still`` [s]."""
    end = float(corners[-1][0])
    time = np.arange(5.0, end - 5, 0.55)
    for begin, after in still:
        time = time[(time < begin) | (time > after)]
    column = np.full(len(time), 0.6)
    duration = np.minimum(0.55, np.diff(time, prepend=0.0))
    steps = Steps(0.0, end, time, duration, column, 0 * column, 0 * column, column, column)
    at = np.arange(0, end, 0.2)
    height = np.interp(at, *np.array(corners, dtype=float).T)
    noise = np.random.default_rng(seed).normal(0, 0.01, len(at))
    return steps, Signal(at, (1000 * np.exp(-height / SCALE_HEIGHT) + noise)[:, None])


def flights(*levels, storey_time=14.0, floor_time=40.0):
    """Corners of a walk from level to level [m]."""
    corners, now = [(0.0, levels[0])], 0.0
    for here, there in zip(levels, [*levels[1:], levels[-1]], strict=True):
        corners.append((now + floor_time, here))
        now += floor_time + (storey_time * max(1.0, abs(there - here) / 3.6) if there != here else 0.0)
        corners.append((now + 0.1 * (there == here), there))
    return corners


def fixes(labels):
    """Fixes (time [s], floor label)."""
    time = np.array([t for t, _ in labels], dtype=float)
    return Fixes(time, np.zeros((len(time), 2)), np.full(len(time), 5.0), tuple(label for _, label in labels))


def in_order(labels):
    """Labels with each run of one once."""
    return [label for n, label in enumerate(labels) if not n or label != labels[n - 1]]


THREE = Plan(("0", "1", "2"), np.array([0.0, 3.6, 7.2]))


def batch(steps, barometer, start="", stated=None, plan=None):
    """The labels in order, of the whole walk."""
    return in_order(floors_of(steps, barometer, start, Fixes.none() if stated is None else stated, plan))


def live(steps, barometer, start="", stated=None, plan=None):
    """The labels in order, as they are known after each second."""
    return labels_of(second_by_second(steps, barometer, LiveFloors(plan, start), stated))


def labels_of(rows):
    return in_order([label for _, label, _ in rows])


def second_by_second(steps, barometer, floors, stated=None, certain=6.0, arrived=None):
    """The label and whether one climbs after each second; steps are certain some seconds later."""
    rows, sure, arrived = [], 0, barometer.time if arrived is None else arrived
    for now in np.arange(steps.start + 1, steps.end, 1.0):
        new = (arrived > now - 1) & (arrived <= now)
        floors.push(barometer.time[new], barometer.values[new])
        if stated is not None and np.any(said := (stated.time > now - 1) & (stated.time <= now)):
            floors.add_fixes(stated[said])
        landed, walked = np.searchsorted(steps.time, [now - certain, now], side="right").tolist()
        if landed > sure:
            floors.add_steps(part(steps, sure, landed))
            sure = landed
        if sure:
            floors.advance(replace(part(steps, sure, walked), end=now))
        rows.append((now, floors.label, floors.climbing))
    return rows


BOTH = pytest.mark.parametrize("labels", [batch, live])


def test_labels_change_half_way_up_the_stairs():
    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (140, 3.6))
    labels = np.array(floors_of(steps, barometer, "0", Fixes.none(), None))
    rows = row_times(steps)
    assert len(labels) == len(rows)
    changed = rows[np.argmax(labels == "1")]
    assert changed == pytest.approx(67, abs=1.5)
    assert np.all(labels == np.where(rows < changed, "0", "1"))


@BOTH
@pytest.mark.parametrize(
    ("start", "levels", "expected"),
    [
        ("0", (0, 3.6), ["0", "1"]),
        ("0", (0, -5.8), ["0", "-1", "-2"]),
        ("F1", (0, 3.6, 0, -3.6), ["F1", "F2", "F1", "B1"]),
        ("B1", (0, 3.6), ["B1", "F1"]),
        ("1F", (0, -3.6, -7.2), ["1F", "B1F", "B2F"]),
        ("L3", (0, -3.6), ["L3", "L2"]),
        ("Foyer", (0, 3.6, 0), ["Foyer", "", "Foyer"]),
        ("", (0, 3.6), [""]),
    ],
)
def test_storeys_are_labelled_in_the_style_of_the_start(start, levels, expected, labels):
    assert labels(*along(*flights(*levels)), start) == expected


@pytest.mark.parametrize(("labels", "waited"), [(batch, 6.0), (batch, 30.0), (batch, 120.0), (live, 6.0), (live, 30.0)])
def test_a_stop_half_way_is_not_a_floor(waited, labels):
    on = 67 + waited
    up = ((0, 0), (60, 0), (67, 1.8), (on, 1.8), (on + 7, 3.6), (on + 60, 3.6), (on + 74, 0), (on + 140, 0))
    assert labels(*along(*up), "0") == ["0", "1", "0"]


@BOTH
@pytest.mark.parametrize("scale", [0.87, 1.0, 1.13])
def test_storeys_of_a_plan_may_have_any_height(scale, labels):
    plan = Plan(("garage", "hall", "gallery", "roof"), np.array([-2.5, 0.0, 6.0, 9.0]))
    walk = along(*flights(*(scale * np.array([0.0, 6.0, 9.0, 0.0, -2.5]))))
    assert labels(*walk, "hall", plan=plan) == ["hall", "gallery", "roof", "gallery", "hall", "garage"]


@BOTH
@pytest.mark.parametrize("plan", [None, THREE])
@pytest.mark.parametrize("seed", range(3))
def test_beacons_received_through_the_ceiling_do_not_matter(plan, seed, labels):
    random = np.random.default_rng(seed)
    stated = [(t, ("0" if t < 47 else "1") if random.random() < 0.7 else random.choice(list("012"))) for t in range(90)]
    walk = along(*flights(0, 3.6))
    assert labels(*walk, "0", fixes(stated), plan) == ["0", "1"]
    assert batch(*walk, "", fixes(stated), plan) == ["0", "1"], "the fixes know the start too"


def test_many_floors_up_in_a_lift_and_down_the_stairs():
    steps, barometer = along(
        (0, 0), (60, 0), (75, 18.0), (120, 18.0), (134, 14.4), (200, 14.4), (262, 0), (300, 0), still=((58, 78),)
    )
    floors = floors_along(steps, barometer, "0", Fixes.none(), None)
    labels = np.array(floors.labels)
    assert floors.kinds == ("lift", "stairs", "stairs")
    assert [labels[np.searchsorted(row_times(steps), t)] for t in (30, 100, 170, 280)] == ["0", "5", "4", "0"]
    assert floors.height[-1] == pytest.approx(0, abs=3 * floors.sigma[-1])


def test_fixes_with_floors_determine_the_storey_height():
    walk = along(*flights(0, 5.8))
    assert batch(*walk, "0") == ["0", "1", "2"]
    assert batch(*walk, "0", fixes([(10, "0"), (70, "1"), (80, "1"), (90, "1")])) == ["0", "1"]


def test_fixes_that_agree_overrule_a_wrong_start():
    stated = fixes([(t, "2") for t in range(0, 40, 4)] + [(t, "3") for t in range(60, 90, 4)])
    assert batch(*along(*flights(0, 3.6)), "0", stated) == ["2", "3"]


def test_without_a_barometer_several_fixes_determine_the_floor():
    steps, _ = along(*flights(0, 3.6))
    stated = [(t, "F1") for t in range(0, 40, 4)] + [(t, "F2") for t in range(56, 90, 4)]
    assert batch(steps, None, "F1", fixes(stated)) == ["F1", "F2"]
    assert batch(steps, None, "F1", fixes([(5, "F1"), (20, "F2"), (30, "F1"), (50, "F1")])) == ["F1"]
    assert batch(steps, None, "F1") == ["F1"]


@pytest.mark.parametrize(
    ("corners", "kind", "rise"),
    [(((60, 0), (110, 3.6), (180, 3.6)), "ramp", 3.6), (((60, 0), (61, 3.0), (140, 3.0)), "draught", 0.0)],
    ids=["a hill", "a pressure step of a door"],
)
def test_what_climbs_otherwise_is_no_floor_unless_a_plan_has_it(corners, kind, rise):
    walk = along((0, 0), *corners)
    floors = floors_along(*walk, "0", Fixes.none(), None)
    assert floors.kinds == (kind,)
    assert set(floors.labels) == {"0"}
    assert floors.height[-1] == pytest.approx(rise, abs=0.4 * (rise > 0))
    assert batch(*walk, "0", plan=THREE) == (["0", "1"] if rise else ["0"])


def test_a_level_walk_stays_on_its_floor():
    steps, barometer = along((0, 0), (300, 0))
    plan = Plan(("3", "4"), np.array([0.0, 3.0]))
    floors = floors_along(steps, barometer, "3", Fixes.none(), plan)
    assert set(floors.labels) == {"3"}
    assert not len(floors.climbs)
    assert not floors.height.any()
    assert batch(steps, barometer, "", plan=plan) == [""], "of two floors, none is known without a start or a fix"
    assert batch(steps, barometer, "", fixes([(100, "4")]), plan) == ["4"]
    assert batch(steps, barometer, "", plan=Plan(("3",), np.zeros(1))) == ["3"]


# While a walk goes on


@pytest.mark.parametrize("plan", [None, THREE])
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


@pytest.mark.thorough
def test_a_long_walk_equals_the_batch_in_bounded_memory():
    """Twenty-four climbs in half an hour; the window holds six."""
    levels = [3.6 * n for n in (0, 1, 2, 1, 0, -1, -2, -1) * 3]
    steps, barometer = along(*flights(*levels, floor_time=70.0))
    floors, sizes = LiveFloors(None, "F1"), []
    look = floors._estimate
    floors._estimate = lambda *arguments: (sizes.append(max(len(floors.time), len(floors.pressure))), look(*arguments))
    rows = second_by_second(steps, barometer, floors)
    assert labels_of(rows) == ["F1", "F2", "F3", "F2", "F1", "B1", "B2", "B1"] * 3
    assert max(sizes) < 1.6 * LONGEST_WINDOW / 0.5


def test_while_the_barometer_is_silent_fixes_determine_the_floor():
    """Long after the first of them too."""
    steps, barometer = along((0, 0), (900, 0))
    stated = fixes([(10, "0"), (20, "0"), (30, ""), (800, "1"), (810, "1"), (820, "1")])
    rows = second_by_second(steps, take(barometer, slice(0)), LiveFloors(None, ""), stated)
    assert labels_of(rows) == ["", "0", "1"]
    assert next(now for now, label, _ in rows if label == "1") < 815

    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (300, 3.6), (314, 7.2), (500, 7.2), (514, 3.6), (600, 3.6))
    gone = take(barometer, (barometer.time < 150) | (barometer.time > 400))
    stated = fixes([(100, "1"), (340, "2"), (350, "2"), (360, "2"), (370, "2")])
    assert live(steps, gone, "0", stated) == ["0", "1", "2", "1"]


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
    time, hpa = change(barometer.time, barometer.values[:, 0])
    damaged, floors = SimpleNamespace(time=time, values=hpa[:, None]), LiveFloors(None, "0")
    assert labels_of(second_by_second(steps, damaged, floors, arrived=barometer.time)) == ["0", "1", "0"]


@pytest.mark.parametrize("hpa", [np.nan, 0.0, 1013.0])
def test_a_stuck_barometer_never_changes_the_floor(hpa):
    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (140, 3.6))
    assert live(steps, replace(barometer, values=np.full_like(barometer.values, hpa)), "0") == ["0"]


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
