"""The `repr` of the data types of readers, simulation, papers and scores is one short line."""

import numpy as np
import pytest
from plans import MAPS

from pdr_graph import FloorPlan, detect_steps
from pdr_graph.apps.report.evaluation import pair
from pdr_graph.io.delimited import table
from pdr_graph.io.gpx import Points, Track
from pdr_graph.io.source import Source
from pdr_graph.lab.papers.attitude_filters import Navigation, Samples
from pdr_graph.lab.papers.map_matching import correct, match
from pdr_graph.lab.simulation.body import walk_path
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

WALK = simulate(Scenario.of({"route": [[14.85, 1.25], [30, 1.25]], "gnss": {}, "phone": {"rate": 50}}))
LOOP = FloorPlan.load(MAPS / "loop.geojson")
STEPS = detect_steps(WALK.recording("accelerometer", "gyroscope"))
START = np.array([14.85, 1.25])
TABLE = table("x.csv", "a,b\n1,2\n3,4\n")
POINTS = Points(np.zeros((3, 2)), np.array([5.0, 6.0, 7.0]))


@pytest.mark.parametrize(
    ("record", "expected"),
    [
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
        (match(STEPS, LOOP.network, START, 0.0), " 0 turns)"),
        (correct(STEPS, LOOP, START, 0.0), " 0 stretches)"),
        (Samples(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((4, 3))), "Samples(4 samples)"),
        (Navigation(np.zeros((4, 3)), np.zeros((4, 3))), "Navigation(4 samples)"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_the_repr_is_one_short_line(record, expected):
    text = repr(record)
    assert expected in text
    assert "\n" not in text
    assert len(text) < 160
