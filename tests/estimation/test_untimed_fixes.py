"""Places without a time: their times are found together with the walk, and a place of somebody else is named."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from plans import ARCADE, plan
from refusals import refused
from walks import drawn_from_the_model, steps_of

from pdr_graph import FloorPlan, Navigator, Recording, Signal, WalkGraph, smooth
from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.estimation.verdict import verdict
from pdr_graph.geometry import dead_reckon, interpolate
from pdr_graph.io.tables import read_visited
from pdr_graph.types import DOUBTFUL, Headings, UntimedFixes

SIGMA = 0.5  # [m]


def visited(truth, random, number=6, false=0):
    """Places of a walk in any order, and some of another one; with the true times of the former [s]."""
    time = np.sort(random.uniform(truth.time[0], truth.time[-1], number))
    place = interpolate(time, truth.time, truth.position) + random.normal(0, SIGMA, (number, 2))
    order = random.permutation(number)
    away = truth.position.max(axis=0) + random.uniform(10, 20, (false, 2))
    place = np.concatenate([place[order], away])
    span = np.tile([truth.time[0], truth.time[-1]], (len(place), 1))
    label = tuple(f"receipt {n}" for n in range(len(place)))
    return UntimedFixes(span, place, np.full(len(place), SIGMA), label), time[order]


def compass(steps, truth):
    """The direction of the first step, by a compass of 0.2 rad."""
    return Headings(steps.time[:1], truth.heading[:1], np.array([0.2]))


def walks(number=6, false=0, seeds=6):
    """Estimates of walks by a compass and places alone, with the truths and the true times of the places."""
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        steps, _, truth = drawn_from_the_model(120, seed)
        places, time = visited(truth, random, number, false)
        yield smooth(WalkGraph(steps, headings=compass(steps, truth), measurements=[places])), truth, time


def test_times_of_places_in_any_order_are_found():
    """Ten places, no fix and no plan. A walk that its places leave open is a doubt, and its region holds."""
    errors, late, inside = [], [], []
    for estimate, truth, time in walks(number=10):
        track = estimate.trajectory
        errors.append(np.hypot(*(interpolate(truth.time, track.time, track.position) - truth.position).T))
        late += [report.time - true for report, true in zip(estimate.reports["untimed"], time, strict=True)]
        inside.append(coverage(track, truth))
        assert np.median(errors[-1]) < 4 or verdict(estimate).state == DOUBTFUL
    assert np.median(np.concatenate(errors)) < 1.6
    assert np.median(np.abs(late)) < 1.5
    assert np.mean(inside) > 0.87


def test_a_place_of_somebody_else_is_named():
    """One of eleven, 10 to 20 m away: in four walks of six, none of whose own places is rejected then."""
    named = 0
    for estimate, _, _ in walks(number=10, false=1):
        *right, wrong = estimate.reports["untimed"]
        if wrong.weight < 0.1:
            named += 1
            assert all(report.weight > 0.5 for report in right)
            assert any("receipt 10" in warning for warning in estimate.warnings)
    assert named >= 4


def test_a_place_in_another_town_changes_nothing():
    """It is 50 km away: no walk of this length joins it with the others."""
    steps, _, truth = drawn_from_the_model(120, 1)
    places, _ = visited(truth, np.random.default_rng(1), 10)
    far = replace(places, position=np.vstack([places.position[:9], [5e4, 0.0]]))
    tracks = []
    for table in (far, UntimedFixes(places.time[:9], places.position[:9], places.sigma[:9], places.label[:9])):
        estimate = smooth(WalkGraph(steps, headings=compass(steps, truth), measurements=[table]))
        tracks.append(estimate.trajectory.position)
        assert len(estimate.reports["untimed"]) == len(table)
    assert np.hypot(*(tracks[0] - tracks[1]).T).max() < 0.5


def test_half_of_the_places_of_somebody_else_are_a_doubt():
    [(estimate, _, _)] = walks(number=4, false=4, seeds=1)
    assert verdict(estimate).state == DOUBTFUL


def test_a_straight_walk_is_open_along_itself():
    """Its places say nothing about how far along they are but the ends: the region says so."""
    steps = steps_of(np.full(60, 0.7), np.zeros(60))
    truth = dead_reckon(steps)
    span = np.tile([steps.start, steps.end], (2, 1))
    middle = UntimedFixes(span, truth.position[[28, 32]], np.full(2, 0.5), ("a", "b"))
    track = smooth(WalkGraph(steps, headings=compass(steps, truth), measurements=[middle])).trajectory
    along = np.sqrt(np.linalg.eigvalsh(track.covariance[:, :2, :2])[:, 1])
    assert np.median(along) > 5


def test_an_interval_of_time_decides_between_two_visits():
    """A walker who comes back: the place is passed twice, and the receipt is of the morning."""
    there = np.full(40, 0.7)
    turn = np.zeros(80)
    turn[40] = np.pi
    steps = steps_of(np.concatenate([there, there]), turn)
    truth = dead_reckon(steps)
    ends = truth.position[[0, 40, -1]]
    late = np.array([[steps.start, steps.end]] * 3 + [[steps.time[45], steps.end]])
    places = UntimedFixes(late, np.concatenate([ends, truth.position[[20]]]), np.full(4, 0.5), tuple("abcd"))
    estimate = smooth(WalkGraph(steps, headings=compass(steps, truth), measurements=[places]))
    assert estimate.reports["untimed"][3].time > steps.time[45]


def test_a_place_that_is_passed_twice_has_both_times():
    """There and back the same way: each time may be the one."""
    turn = np.zeros(80)
    turn[40] = np.pi
    steps = steps_of(np.full(80, 0.7), turn)
    truth = dead_reckon(steps)
    span = np.tile([steps.start, steps.end], (3, 1))
    places = UntimedFixes(span, truth.position[[0, 40, 15]], np.full(3, 0.5), tuple("abc"))
    report = smooth(WalkGraph(steps, headings=compass(steps, truth), measurements=[places])).reports["untimed"][2]
    assert len(report.others) == 1
    assert sorted([report.time, *report.others]) == pytest.approx([truth.time[15], truth.time[65]], abs=2)


def test_only_whole_walks_take_places_without_a_time():
    table = UntimedFixes(np.array([[0.0, 9.0]]), np.zeros((1, 2)), np.ones(1), ("a",))
    with pytest.raises(TypeError, match="expected measurements with a time"):
        Navigator().push(table)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"sigma": np.zeros(1)}, "standard deviations above 0 m"),
        ({"time": np.array([[5.0, 4.0]])}, "not after the latest"),
        ({"time": np.array([4.0])}, "expected"),
        ({"position": np.array([[np.nan, 0.0]])}, "finite"),
    ],
)
def test_values_that_cannot_be_are_refused(changes, found):
    table = UntimedFixes(np.array([[0.0, 9.0]]), np.zeros((1, 2)), np.ones(1), ("a",))
    with pytest.raises(ValueError, match=found):
        replace(table, **changes)


# The file

LYING = Signal(np.arange(0, 60, 0.02), np.tile([0.0, 0.0, 9.8], (3000, 1)))
RECORDING = Recording("walk", 100.0, None, accelerometer=LYING)


def written(tmp_path, text):
    path = tmp_path / "visited.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_of_places(tmp_path):
    """Empty times are those of the recording; times count on the recorder's clock."""
    path = written(tmp_path, "place,x,y,earliest,latest,sigma\ntill,1,2,,,\ncar park,3,4,120,130,2\n")
    table, epsg = read_visited(path, RECORDING)
    assert epsg is None
    assert table.label == ("till", "car park")
    assert table.time.tolist() == [[0.0, pytest.approx(59.98)], [20.0, 30.0]]
    assert table.sigma.tolist() == [1.0, 2.0]


def test_a_place_may_be_a_name_on_the_plan(tmp_path):
    arcade = FloorPlan.load(ARCADE)
    name = next(area.name for area in arcade.areas if area.name and sum(a.name == area.name for a in arcade.areas) == 1)
    table, _ = read_visited(written(tmp_path, f"place\n{name.upper()}\n"), RECORDING, [arcade])
    assert arcade.walkable.distance(shapely.Point(table.position[0])) < 0.1


def test_a_shop_of_two_parts_is_one_place_and_stairs_all_over_are_none(tmp_path):
    """The place lies beside the shop, where one can walk."""
    parts = [("shop", "till", shapely.box(x, 0, x + 4, 5)) for x in (10, 14)]
    stairs = [("shop", "stairs", shapely.box(x, 20, x + 2, 22)) for x in (0, 50)]
    floor = plan(("floor", "F1", shapely.box(-10, -10, 60, 30)), *parts, *stairs)
    table, _ = read_visited(written(tmp_path, "place\nTill\n"), RECORDING, [floor])
    assert table.sigma.tolist() == [pytest.approx(np.sqrt(40 / 12))]
    assert 0 <= shapely.distance(shapely.box(10, 0, 18, 5), shapely.Point(table.position[0])) < 0.1
    refused(read_visited, written(tmp_path, "place\nstairs\n"), "of 2 areas", RECORDING, [floor])


@pytest.mark.parametrize(
    ("text", "found", "expected"),
    [
        ("x,y\n1,far\n", "far", "number"),
        ("place\ntill 7\n", "till 7", "name of one area"),
        ("place,x,y,earliest,latest\na,1,2,130,120\n", "130", "before latest"),
        ("place,x,y,earliest,latest\na,1,2,9000,9900\n", "9000", "within the recording"),
        ("place,x,y,sigma\na,1,2,-1\n", "-1", "standard deviation"),
        ("earliest,latest\n100,110\n", "no place", "lat,lon"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_line(tmp_path, text, found, expected):
    refused(read_visited, written(tmp_path, text), f"{found}.*{expected}", RECORDING, [FloorPlan.load(ARCADE)])
