"""A real building as bare CAD lines, without unit, outline and doors, and a walk in it."""

import json

import numpy as np
import pytest
import shapely

from pdr_graph import InputError
from pdr_graph.apps.bench.data_sets import given, walks_of
from pdr_graph.apps.bench.matrix import places
from pdr_graph.apps.bench.methods import OURS
from pdr_graph.apps.report.output_files import smooth_recording
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building
from pdr_graph.io.tables import read_trajectory
from pdr_graph.walk import Options, observe

SCALE = 4.3197  # [m] per unit
START = (8.0, 26.75)  # [m] surveyed; the walk heads along -y and is closed


@pytest.fixture(scope="module")
def plan(folder):
    return Building.load(folder / "cad_lines.csv", SCALE)


@pytest.fixture(scope="module")
def folder(data):
    return data / "apf_pdr"


def test_the_unit_is_asked_for(folder):
    with pytest.raises(InputError, match=r"517 segments, 11.36 by 15.55 units, unit not stated"):
        Building.load(folder / "cad_lines.csv")


def test_the_corridors_are_one_walkable_area_around_the_start(plan):
    floor = plan.floors[0]
    (corridor,) = floor.of_kind("corridor")
    assert shapely.contains(corridor.shape, shapely.Point(START))
    assert 700 < shapely.area(corridor.shape) < 850
    ways = [(8.0, 12.0), (0.0, 9.0), (-2.5, 0.0), (-6.0, -8.5), (-9.8, -20.0)]
    assert all(shapely.contains(corridor.shape, shapely.Point(place)) for place in ways)
    assert not floor.crosses_wall(np.array([START]), np.array([[8.0, 12.0]])).any()
    assert floor.crosses_wall(np.array([START]), np.array([[0.0, 20.0]])).all()


def test_spaces_without_a_door_are_reported(plan):
    (line,) = problems(plan)
    assert "cells that cannot be reached from the rest" in line


@pytest.mark.thorough
def test_the_walk_is_found_on_the_lines_without_any_position(folder, tmp_path):
    """The published walk, by plan and steps alone: start and end to 1.5 m, and no wall between."""
    options = Options(plan=folder / "cad_lines.csv", scale=SCALE)
    assert smooth_recording(folder / "walk", tmp_path / "out", options) == ()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    track = read_trajectory(tmp_path / "out" / "trajectory.csv")
    assert np.hypot(*(track.position[[0, -1]] - START).T).max() < 1.5
    assert summary["verdict"]["state"] == "ok"
    assert summary["wall_crossings"] <= 2
    assert [route["probability"] > 0.9 for route in summary["routes"]] == [True]


@pytest.mark.thorough
def test_the_bench_scores_whether_the_walk_closes(data):
    """Given its start alone: where dead reckoning ends 27 m off, the walk on the lines is back within 1.5 m."""
    [(_, recorded)] = walks_of("apf", data)
    errors = {}
    for what in ("first", "first, plan"):
        walk = given(recorded(), what)
        errors[what] = places(OURS["graph"](observe(walk.evidence)), walk.truth, walk.noise)[0]
    assert errors["first"] == pytest.approx([27], abs=3)
    assert errors["first, plan"] < 1.5
