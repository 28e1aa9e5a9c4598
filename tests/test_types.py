"""The data types refuse values that would come out as a silent NaN, print one line and show themselves in notebooks."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from plans import MAPS
from walks import fixes_at, wandering_walk

import pdr_graph as pdr
from pdr_graph.apps.report.evaluation import pair
from pdr_graph.gait.step_chunks import gap, join
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import dead_reckon
from pdr_graph.io.delimited import table
from pdr_graph.io.gpx import Points, Track
from pdr_graph.io.source import Source
from pdr_graph.lab.papers import attitude_filters
from pdr_graph.lab.papers.map_matching import correct, match
from pdr_graph.lab.simulation.body import walk_path
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.notebook_html import MOST_POINTS
from pdr_graph.online.interface import Mode, Pose
from pdr_graph.types import (
    Beacons,
    Calibration,
    Closures,
    Contradiction,
    Drifts,
    Fixes,
    Headings,
    Levels,
    OneLineRepr,
    Ranges,
    Recording,
    Rows,
    Sightings,
    Signal,
    UntimedFixes,
    Verdict,
    take,
)

STEPS = wandering_walk(3)
FIX = fixes_at([0.0], [[1.0, 2.0]])


@pytest.mark.parametrize(
    ("record", "change", "complaint"),
    [
        (STEPS, {"length": np.array([0.7, np.nan, 0.7])}, "Steps.length: found row 1: nan"),
        (STEPS, {"turn": np.zeros(2)}, "Steps.turn: found 2 rows, expected 3"),
        (STEPS, {"time": np.array([1.0, 0.5, 2.0])}, "time, row 1: found 0.5"),
        (STEPS, {"time": np.array([0.55, 0.55, 1.1])}, "time, row 1"),
        (STEPS, {"end": 0.1}, "time, row 0"),
        (STEPS, {"end": -1.0}, "start < end"),
        (STEPS, {"duration": np.array([0.5, 3.0, 0.5])}, "duration, row 1: found 3.0"),
        (STEPS, {"sigma_turn": np.zeros(3)}, "sigma_turn, row 0: found 0.0"),
        (FIX, {"position": np.array([[np.inf, 0.0]])}, "Fixes.position: found row 0"),
        (FIX, {"sigma": np.array([-1.0])}, "sigma, row 0: found -1.0"),
        (FIX, {"floor": ("1", "2")}, "Fixes.floor: found 2 labels, expected 1"),
    ],
)
def test_values_that_cannot_be_are_refused(record, change, complaint):
    with pytest.raises(ValueError, match=complaint):
        replace(record, **change)


def test_fixes_are_selected_like_arrays():
    fixes = fixes_at([0.0, 1.0, 2.0], np.arange(6.0).reshape(3, 2))
    assert fixes[1].position.tolist() == [[2.0, 3.0]]
    assert len(fixes[-1]) == 1
    assert fixes[fixes.time > 0.5].time.tolist() == [1.0, 2.0]
    assert len(fixes[:0]) == 0


def test_a_step_is_taken_with_all_that_the_sensors_do_not_determine():
    """Also where a walk has as many unknown quantities as steps."""
    steps = replace(take(STEPS, slice(2)), unknown=("turns", "lengths"))
    one = take(steps, 0)
    assert one.time.tolist() == STEPS.time[:1].tolist()
    assert one.unknown == steps.unknown


TIME = np.arange(0, 10, 0.01)
SIGNAL = Signal(TIME, np.zeros((1000, 3)))
TRACK = dead_reckon(STEPS)
CALIBRATION = Calibration(np.zeros(1), np.array([[1.0, 1.0, 0.0]]), 0.01 * np.eye(3)[None], np.ones((1, 3)))
CONTRADICTION = Contradiction("plan", "fixes", 12.0, "m", "the plan lies 12 m from the fixes", "the plan")
PLACE, ONE = np.zeros((1, 2)), np.ones(1)
RANGES = Ranges(TIME[:2], np.zeros(2, int), np.ones(2), np.ones(2), ("a",), PLACE, ONE)
RECORDING = Recording("<script>", 0.0, None, accelerometer=SIGNAL, gyroscope=SIGNAL, fixes=FIX)
POSE = Pose(3.0, 1.0, 2.0, 0.5, "F1", np.eye(3), (Mode(0.9, 1.0, 2.0, 0.5, np.eye(3)),))
GRAPH = pdr.WalkGraph(wandering_walk(30), fixes_at([1.0, 9.0], [[0.0, 0.0], [5.0, 5.0]]))
ESTIMATE = pdr.smooth(GRAPH)
LOOP = pdr.FloorPlan.load(MAPS / "loop.geojson")
WALK = simulate(Scenario.of({"route": [[14.85, 1.25], [30, 1.25]], "gnss": {}, "phone": {"rate": 50}}))
WALKED, START = pdr.detect_steps(WALK.recording("accelerometer", "gyroscope")), np.array([14.85, 1.25])
TABLE = table("x.csv", "a,b\n1,2\n3,4\n")
POINTS = Points(np.zeros((3, 2)), np.array([5.0, 6.0, 7.0]))
AXES = np.zeros((4, 3))
REPRS = [
    (SIGNAL, "Signal(1000 samples, 100 Hz, 0.0 to 10.0 s)"),
    (FIX, "Fixes(1 fix, 0.0 to 0.0 s)"),
    (Fixes.none(), "Fixes(0 fixes)"),
    (Headings([1.0, 2.5], [0.0, 0.0], [1.0, 1.0]), "Headings(2 headings, 1.0 to 2.5 s)"),
    (Drifts([1.0, 2.5], [0.0, 0.0], [1.0, 1.0]), "Drifts(2 drifts, 1.0 to 2.5 s)"),
    (RECORDING, "Recording(10 s, accelerometer 100 Hz, gyroscope 100 Hz, 1 fix)"),
    (Recording("walk", 0.0, None), "Recording(empty)"),
    (join([STEPS, replace(gap(5.0, 6.0), start=5.0)]), "Steps("),
    (TRACK, "Trajectory("),
    (Sightings(TIME[:2], ("a", "b"), TIME[:2]), "Sightings(2 receptions, 0.0 to 0.0 s)"),
    (Beacons(("a",), PLACE, ONE, ("",), ("a",)), "Beacons(1 beacon)"),
    (CALIBRATION, "Calibration(1 segment, last: R_s 1 ± 0.1, R_d 1 ± 0.1, b 0 ± 0.1)"),
    (ESTIMATE, "Estimate("),
    (CONTRADICTION, "Contradiction(plan against fixes, 12 m, doubtful)"),
    (Verdict.of([CONTRADICTION]), "Verdict(doubtful, 1 reason)"),
    (Walker(), "Walker(height 1.7 m, stride 'inverted pendulum')"),
    (Levels(TIME[:1], np.zeros(1, int), ONE, ("a",), PLACE, ONE), "Levels(1 level, 0.0 to 0.0 s)"),
    (RANGES, "Ranges(2 ranges, 0.0 to 0.0 s)"),
    (UntimedFixes(np.array([[0.0, 9.0]]), PLACE, ONE, ("till",)), "UntimedFixes(1 place, 0.0 to 9.0 s)"),
    (Closures.of([(1.0, 2.0, 0.5)]), "Closures(1 closure, 1.0 to 2.0 s)"),
    (POSE, "Pose("),
    (POSE.modes[0], "Mode("),
    (GRAPH, "WalkGraph("),
    (LOOP, "FloorPlan("),
    (pdr.Frame(), "Frame("),
    (pdr.Navigator(), "Navigator("),
    (pdr.Navigator().status, "Status("),
    (pdr.Samples("gyroscope", 0.0, (0, 0, 0)), "Samples("),
    (TABLE, "Table(2 header)"),
    (TABLE.rows, "TextRows('x.csv', ',')"),
    (POINTS, "Points(3 points, 5.0 to 7.0 s)"),
    (Track("a walk", (POINTS,)), "Track('a walk', 1 segments)"),
    (Source(MAPS / "loop.geojson"), "1 file)"),
    (WALK, "Simulation('scenario', 0.0 to "),
    (WALK.scenario, "Scenario('scenario', seed 0, 1 activities, about 30 s, hold 'hand')"),
    (WALK.scenario.route, "Route(1 activities, about 30 s)"),
    (WALK.body, "Body(0.0 to "),
    (WALK.motion, "Motion(0.0 to "),
    (WALK.gnss, "SatelliteFixes("),
    (walk_path(np.array([[0, 0], [9, 0]]), np.zeros(2), np.zeros(1), np.random.default_rng(0)), "WalkPath(9."),
    (pair(WALK.truth, WALK.truth), " pairs, 0.0 to "),
    (match(WALKED, LOOP.network, START, 0.0), " 0 turns)"),
    (correct(WALKED, LOOP, START, 0.0), " 0 stretches)"),
    (attitude_filters.Samples(AXES, AXES, AXES), "Samples(4 samples)"),
    (attitude_filters.Navigation(AXES, AXES), "Navigation(4 samples)"),
]


@pytest.mark.parametrize(("record", "expected"), REPRS, ids=lambda value: type(value).__name__)
def test_the_repr_of_a_data_type_is_one_short_line(record, expected):
    text = repr(record)
    assert expected in text
    assert "\n" not in text
    assert "array" not in text
    assert len(text) < (120 if type(record).__module__ == "pdr_graph.types" else 160)


def test_a_journal_has_one_line_too(tmp_path):
    with pdr.Journal.open(tmp_path / "a.journal", pdr.Navigator) as journal:
        assert repr(journal) == f"Journal('{tmp_path / 'a.journal'}', 0 events)"


def test_every_data_type_is_among_these():
    kinds = {*OneLineRepr.__subclasses__(), *Rows.__subclasses__()} - {Rows}
    ours = {kind for kind in kinds if kind.__module__ == "pdr_graph.types"}
    assert ours <= {type(record) for record, _ in REPRS}


# In a notebook


def page_of(record):
    return ET.fromstring(record._repr_html_().replace("<br>", "<br/>"))


@pytest.mark.parametrize(
    ("record", "pictured"),
    [
        *((record, True) for record in (ESTIMATE, TRACK, FIX, LOOP, RECORDING)),
        *((record, False) for record in (STEPS, SIGNAL, POSE, POSE.modes[0], pdr.Navigator().status)),
        *((record, False) for record in (Fixes.none(), Recording("empty", 0.0, None))),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_notebook_shows_a_table_of_escaped_text_and_a_picture_of_what_has_places(record, pictured):
    """Well-formed, so that nothing of a record can be markup; as small as a picture of a thousand points."""
    page = page_of(record)
    assert page.find("b").text == repr(record)
    assert len(page.findall("table/tr")) >= 2
    drawn = [e for e in page.iter() if e.tag.endswith("polyline") or e.tag.endswith("circle")]
    assert bool(drawn) is pictured
    assert len(record._repr_html_()) < 200_000


def test_a_long_track_is_thinned_and_unknown_places_are_left_out():
    long = np.column_stack([np.arange(1e5), np.zeros(100_000)])
    long[7] = np.nan
    track = pdr.Trajectory(np.arange(1e5), long, np.zeros(100_000))
    (line,) = [e for e in page_of(track).iter() if "points" in e.attrib]
    assert len(line.attrib["points"].split()) == MOST_POINTS
    assert "nan" not in line.attrib["points"]
