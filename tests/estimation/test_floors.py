"""The floor of each step, on walks with known heights."""

from dataclasses import dataclass

import numpy as np
import pytest

from pdr_graph.estimation.floors import floors_along, floors_of
from pdr_graph.geometry import row_times
from pdr_graph.inertial.barometer import SCALE_HEIGHT
from pdr_graph.types import Fixes, Signal, Steps


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


def test_labels_change_half_way_up_the_stairs():
    steps, barometer = along((0, 0), (60, 0), (74, 3.6), (140, 3.6))
    labels = np.array(floors_of(steps, barometer, "0", Fixes.none(), None))
    rows = row_times(steps)
    assert len(labels) == len(rows)
    changed = rows[np.argmax(labels == "1")]
    assert changed == pytest.approx(67, abs=1.5)
    assert np.all(labels == np.where(rows < changed, "0", "1"))


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
def test_storeys_are_labelled_in_the_style_of_the_start(start, levels, expected):
    steps, barometer = along(*flights(*levels))
    assert in_order(floors_of(steps, barometer, start, Fixes.none(), None)) == expected


@pytest.mark.parametrize("waited", [6.0, 30.0, 120.0])
def test_a_stop_half_way_is_not_a_floor(waited):
    on = 67 + waited
    up = ((0, 0), (60, 0), (67, 1.8), (on, 1.8), (on + 7, 3.6), (on + 60, 3.6), (on + 74, 0), (on + 140, 0))
    steps, barometer = along(*up)
    assert in_order(floors_of(steps, barometer, "0", Fixes.none(), None)) == ["0", "1", "0"]


def test_many_floors_up_in_a_lift_and_down_the_stairs():
    steps, barometer = along(
        (0, 0), (60, 0), (75, 18.0), (120, 18.0), (134, 14.4), (200, 14.4), (262, 0), (300, 0), still=((58, 78),)
    )
    floors = floors_along(steps, barometer, "0", Fixes.none(), None)
    labels = np.array(floors.labels)
    assert floors.kinds == ("lift", "stairs", "stairs")
    assert [labels[np.searchsorted(row_times(steps), t)] for t in (30, 100, 170, 280)] == ["0", "5", "4", "0"]
    assert floors.height[-1] == pytest.approx(0, abs=3 * floors.sigma[-1])


@pytest.mark.parametrize("scale", [0.87, 1.0, 1.13])
def test_storeys_of_a_plan_may_have_any_height(scale):
    plan = Plan(("garage", "hall", "gallery", "roof"), np.array([-2.5, 0.0, 6.0, 9.0]))
    levels = np.array([0.0, 6.0, 9.0, 0.0, -2.5])
    steps, barometer = along(*flights(*(scale * levels)))
    labels = in_order(floors_of(steps, barometer, "hall", Fixes.none(), plan))
    assert labels == ["hall", "gallery", "roof", "gallery", "hall", "garage"]


def test_fixes_with_floors_determine_the_storey_height():
    steps, barometer = along(*flights(0, 5.8))
    stated = fixes([(10, "0"), (70, "1"), (80, "1"), (90, "1")])
    assert in_order(floors_of(steps, barometer, "0", Fixes.none(), None)) == ["0", "1", "2"]
    assert in_order(floors_of(steps, barometer, "0", stated, None)) == ["0", "1"]


@pytest.mark.parametrize("plan", [None, Plan(("0", "1", "2"), np.array([0.0, 3.6, 7.2]))])
@pytest.mark.parametrize("seed", range(3))
def test_beacons_received_through_the_ceiling_do_not_matter(plan, seed):
    steps, barometer = along(*flights(0, 3.6))
    random = np.random.default_rng(seed)
    stated = fixes(
        [(t, ("0" if t < 47 else "1") if random.random() < 0.7 else random.choice(list("012"))) for t in range(90)]
    )
    assert in_order(floors_of(steps, barometer, "0", stated, plan)) == ["0", "1"]
    assert in_order(floors_of(steps, barometer, "", stated, plan)) == ["0", "1"], "the fixes know the start too"


def test_fixes_that_agree_overrule_a_wrong_start():
    steps, barometer = along(*flights(0, 3.6))
    stated = fixes([(t, "2") for t in range(0, 40, 4)] + [(t, "3") for t in range(60, 90, 4)])
    assert in_order(floors_of(steps, barometer, "0", stated, None)) == ["2", "3"]


def test_without_a_barometer_several_fixes_determine_the_floor():
    steps, _ = along(*flights(0, 3.6))
    stated = [(t, "F1") for t in range(0, 40, 4)] + [(t, "F2") for t in range(56, 90, 4)]
    assert in_order(floors_of(steps, None, "F1", fixes(stated), None)) == ["F1", "F2"]
    assert in_order(floors_of(steps, None, "F1", fixes([(5, "F1"), (20, "F2"), (30, "F1"), (50, "F1")]), None)) == [
        "F1"
    ]
    assert in_order(floors_of(steps, None, "F1", Fixes.none(), None)) == ["F1"]


def test_a_hill_is_no_floor_unless_a_plan_has_it():
    steps, barometer = along((0, 0), (60, 0), (110, 3.6), (180, 3.6))
    floors = floors_along(steps, barometer, "0", Fixes.none(), None)
    assert floors.kinds == ("ramp",)
    assert set(floors.labels) == {"0"}
    assert floors.height[-1] == pytest.approx(3.6, abs=0.4)
    plan = Plan(("0", "1"), np.array([0.0, 3.6]))
    assert in_order(floors_of(steps, barometer, "0", Fixes.none(), plan)) == ["0", "1"]


def test_a_pressure_step_of_a_door_is_no_floor():
    steps, barometer = along((0, 0), (60, 0), (61, 3.0), (140, 3.0))
    floors = floors_along(steps, barometer, "0", Fixes.none(), None)
    assert floors.kinds == ("draught",)
    assert set(floors.labels) == {"0"}
    assert not floors.height.any()


def test_a_level_walk_stays_on_its_floor():
    steps, barometer = along((0, 0), (300, 0))
    floors = floors_along(steps, barometer, "3", Fixes.none(), Plan(("3", "4"), np.array([0.0, 3.0])))
    assert set(floors.labels) == {"3"}
    assert not len(floors.climbs)
    assert not floors.height.any()


def test_with_a_plan_and_an_unknown_start_the_floor_is_unknown():
    steps, barometer = along((0, 0), (300, 0))
    plan = Plan(("3", "4"), np.array([0.0, 3.0]))
    assert set(floors_of(steps, barometer, "", Fixes.none(), plan)) == {""}
    assert set(floors_of(steps, barometer, "", fixes([(100, "4")]), plan)) == {"4"}
    assert set(floors_of(steps, barometer, "", Fixes.none(), Plan(("3",), np.zeros(1)))) == {"3"}
