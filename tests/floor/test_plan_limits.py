"""Plans whose cost grows with the square of their parts are refused in one line, and dense outlines cost no more."""

import json
import time

import numpy as np
import pytest
import shapely

from pdr_graph import FloorPlan, InputError
from pdr_graph.floor.distance_field import DistanceField
from pdr_graph.floor.plan_files import Building


def plan(path, rings, **properties):
    features = [
        {
            "type": "Feature",
            "properties": {"kind": "corridor"} | {key: values[n] for key, values in properties.items()},
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        }
        for n, ring in enumerate(rings)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "pdr_graph": {"frame": "local"}, "features": features}))
    return path


def box(x, y, width=2.0, height=2.0):
    return [[x, y], [x + width, y], [x + width, y + height], [x, y + height], [x, y]]


def test_hundreds_of_areas_on_one_place_are_refused(tmp_path):
    """Every pair of them could have a passage: 10 000 took ten gigabytes."""
    with pytest.raises(InputError, match="1000 areas, each of which touches more than 40 others"):
        FloorPlan.load(plan(tmp_path / "p.geojson", [box(0, 0)] * 1000))
    side = [box(2 * (n % 40), 2 * (n // 40)) for n in range(1600)]
    assert FloorPlan.load(plan(tmp_path / "p.geojson", side)).walkable_area == pytest.approx(6400, rel=1e-3)


def test_thousands_of_floors_are_refused(tmp_path):
    floors = [str(n) for n in range(501)]
    assert len(Building.load(plan(tmp_path / "p.geojson", [box(0, 0)] * 500, floor=floors)).floors) == 500
    with pytest.raises(InputError, match="found 501 floors, expected 1 to 500"):
        Building.load(plan(tmp_path / "p.geojson", [box(0, 0)] * 501, floor=floors))


def test_tens_of_thousands_of_features_or_holes_are_refused(tmp_path):
    """10⁵ of either took more than a minute."""
    with pytest.raises(InputError, match="found 50001 features, expected at most 50000"):
        FloorPlan.load(plan(tmp_path / "p.geojson", [box(0, 0)] * 50_001))
    holes = [box(2 * (n % 200) + 0.5, 2 * (n // 200) + 0.5, 1, 1) for n in range(20_001)]
    path = plan(tmp_path / "p.geojson", [box(0, 0, 400, 400)])
    value = json.loads(path.read_text())
    value["features"][0]["geometry"]["coordinates"] += holes
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match="feature 0: found 20001 holes, expected at most 20000"):
        FloorPlan.load(path)


def test_a_scribble_is_refused_and_an_outline_that_crosses_itself_once_is_repaired(tmp_path):
    corners = np.random.default_rng(0).uniform(0, 50, (500, 2)).round(3).tolist()
    with pytest.raises(InputError, match="feature 0: found an outline of 500 sides that cross one another"):
        FloorPlan.load(plan(tmp_path / "p.geojson", [[*corners, corners[0]]]))
    bow = [[0, 0], [10, 10], [10, 0], [0, 10], [0, 0]]
    assert "crosses itself" in FloorPlan.load(plan(tmp_path / "p.geojson", [bow])).repairs[0]


def test_an_outline_of_a_hundred_thousand_corners_costs_what_its_shape_costs():
    """Each tile of distances looks at the walls near it: 10⁵ of them, some millimetres long, took minutes."""
    circle = shapely.Point(0, 0).buffer(50, quad_segs=25_000)
    begin = time.perf_counter()
    fine, coarse = DistanceField(circle), DistanceField(shapely.Point(0, 0).buffer(50, quad_segs=100))
    points = np.random.default_rng(0).uniform(-40, 40, (300, 2))
    assert fine.at(points)[0] == pytest.approx(coarse.at(points)[0], abs=0.02)
    assert time.perf_counter() - begin < 10
