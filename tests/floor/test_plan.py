"""Floor plans: where one can walk, distances to walls, crossings."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import shapely
from shapely import affinity

from pdr_graph import FloorPlan, InputError
from pdr_graph.floor.distance_field import OPEN_DISTANCE, DistanceField


def lonlat_square(x0, y0, x1, y1):
    """A rectangle in degrees, for a floor on which a degree is 100 km wide and high."""
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    return [[120 + x / 1e5, 30 + y / 1e5] for x, y in corners]


def feature(coordinates, **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": coordinates}}


@pytest.fixture
def floor_folder(tmp_path):
    """An outline of 40 × 20 m that a shop of 10 × 20 m divides."""
    folder = tmp_path / "F9"
    folder.mkdir()
    features = [
        {
            "type": "Feature",
            "properties": {"name": "outline"},
            "geometry": {"type": "MultiPolygon", "coordinates": [[lonlat_square(0, 0, 40, 20)]]},
        },
        feature([lonlat_square(15, 0, 25, 20)], name="shop"),
        {"type": "Feature", "properties": {"name": "nowhere"}, "geometry": None},
    ]
    (folder / "geojson_map.json").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    (folder / "floor_info.json").write_text(json.dumps({"map_info": {"width": 40.0, "height": 20.0}}))
    return folder


def test_microsoft_floor(floor_folder):
    plan = FloorPlan.load(floor_folder)
    assert plan.label == "F9"
    assert plan.walkable_area == pytest.approx(40 * 20 - 10 * 20, rel=1e-6)
    assert shapely.bounds(plan.areas[0].shape) == pytest.approx([0, 0, 40, 20], abs=1e-6)
    assert plan.frame.to_lonlat(np.array([[40.0, 20.0]])) == pytest.approx(np.array([[120.0004, 30.0002]]))


def test_crosses_wall_agrees_with_shapely_for_every_segment(floor_folder):
    plan = FloorPlan.load(floor_folder)
    random = np.random.default_rng(0)
    a, b = random.uniform([-5, -5], [45, 25], (2, 300, 2))
    expected = [not plan.walkable.covers(shapely.LineString([p, q])) for p, q in zip(a, b, strict=True)]
    assert plan.crosses_wall(a, b).tolist() == expected
    assert plan.crosses_wall(np.array([[2.0, 5.0]]), np.array([[12.0, 5.0]])).tolist() == [False]


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda f: (f / "geojson_map.json").write_text("{"), "JSON"),
        (lambda f: (f / "geojson_map.json").write_text("[]"), "JSON object"),
        (lambda f: (f / "geojson_map.json").write_text('{"type": "FeatureCollection", "features": []}'), "polygon"),
        (lambda f: (f / "geojson_map.json").unlink(), "found a folder without geojson_map.json"),
        (lambda f: (f / "floor_info.json").write_text('{"map_info": {"width": -1, "height": 2}}'), "positive"),
        (lambda f: (f / "floor_info.json").write_text('{"map_info": 3}'), "positive"),
    ],
)
def test_damaged_floors_are_refused_in_one_line(floor_folder, damage, complaint):
    damage(floor_folder)
    with pytest.raises(InputError, match=complaint) as refusal:
        FloorPlan.load(floor_folder)
    assert "\n" not in str(refusal.value)


def test_own_geojson(tmp_path):
    """A corridor and a room joined by a door, with a gap between them that is the wall."""
    rectangles = [("corridor", 0, 0, 20, 3), ("room", 5, 3.2, 12, 9), ("door", 8, 2.9, 9, 3.3), ("wall", 0, 0, 1, 3)]
    features = [feature([lonlat_square(*r)], kind=kind) for kind, *r in rectangles]
    path = tmp_path / "plan.geojson"
    content = {"type": "FeatureCollection", "pdr_graph": {"origin": [120, 30], "floor": "2"}, "features": features}
    path.write_text(json.dumps(content))
    plan = FloorPlan.load(path)
    assert plan.label == "2"
    assert plan.frame.describe() == {"kind": "enu", "origin_lat": 30.0, "origin_lon": 120.0, "epsg": None}
    # longitudes of a made-up 100 km degree are 96.5 km here: the areas are those of the drawing times both scales
    door = np.array([[8.5, 1.0], [8.5, 5.0]]) * [0.965, 1.108]
    beside = np.array([[11.0, 1.0], [11.0, 5.0]]) * [0.965, 1.108]
    assert not plan.crosses_wall(door[:1], door[1:])[0]
    assert plan.crosses_wall(beside[:1], beside[1:])[0]
    content["features"][0]["properties"]["kind"] = "lake"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"feature 0.*lake"):
        FloorPlan.load(path)


def test_a_plan_without_features_is_refused(tmp_path):
    """An empty collection has no bounds."""
    path = tmp_path / "plan.geojson"
    path.write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(InputError, match="found none with a geometry"):
        FloorPlan.load(path)


def irregular_area():
    """A star-shaped hall with a pillar: slanted walls, convex and concave corners."""
    angle = np.linspace(0, 2 * np.pi, 15)[:-1]
    radius = np.where(np.arange(14) % 2, 9.0, 16.0)
    hall = shapely.Polygon(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
    return hall.difference(shapely.box(1, 1, 3, 4))


def test_distance_field_agrees_with_exact_distances():
    """Bilinear on 0.25 m: 99 % of points within 0.06 m of shapely's distance, inside and outside."""
    area = irregular_area()
    points = np.random.default_rng(1).uniform(-18, 18, (3000, 2))
    exact = shapely.distance(area.boundary, shapely.points(points))
    exact = np.where(shapely.contains_xy(area, *points.T), exact, -exact)
    distance, _ = DistanceField(area).at(points)
    error = np.abs(distance - exact)
    assert np.percentile(error, 99) < 0.06
    assert error.max() < 0.18  # half a cell's diagonal: at corners, where distance has a ridge


@pytest.mark.parametrize("turned", [0.0, 0.3])
def test_distances_at_nodes_are_those_of_the_outline(turned):
    """Walls along the nodes, where a node is neither inside nor outside, and across them; hundreds beside each node."""
    pillars = shapely.box(*np.array([(x, y, x + 0.25, y + 0.25) for x in range(1, 29) for y in range(1, 9)]).T)
    area = affinity.rotate(shapely.box(0, 0, 30, 10) - shapely.unary_union(pillars), turned, use_radians=True)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-2, 32, 0.25), np.arange(-2, 12, 0.25)))
    exact = shapely.distance(area.boundary, shapely.points(x, y))
    exact = np.where(shapely.contains_xy(area, x, y), exact, -exact)
    found = DistanceField(area).at(np.stack([x, y], axis=1))[0]
    assert found == pytest.approx(exact, abs=2e-3), "corners of pillars are arcs of chords"


def test_approximate_distances_agree_with_exact_ones():
    """99 % within 0.1 m: half the diagonal of a pixel, and the grid's own error."""
    area = irregular_area()
    points = np.random.default_rng(1).uniform(-18, 18, (3000, 2))
    exact = shapely.distance(area.boundary, shapely.points(points))
    exact = np.where(shapely.contains_xy(area, *points.T), exact, -exact)
    about = DistanceField(area).approximate(points.T)
    assert np.percentile(np.abs(about - exact), 99) < 0.1


def test_exact_distances_need_no_tiles():
    area, points = irregular_area(), np.random.default_rng(2).uniform(-18, 18, (300, 2))
    exact = shapely.distance(area.boundary, shapely.points(points))
    exact = np.where(shapely.contains_xy(area, *points.T), exact, -exact)
    assert DistanceField(area).exact(points) == pytest.approx(exact, abs=0.01)


def test_tiles_of_others_make_no_difference():
    """A user who computes few tiles at a time gets the same in a field that somebody else filled meanwhile."""
    fresh, full = DistanceField(irregular_area()), DistanceField(irregular_area())
    points = np.random.default_rng(3).uniform(-18, 18, (500, 2)).T
    everything = full.approximate(points)
    mine, shared = fresh.no_tiles(), full.no_tiles()
    for _ in range(5):
        assert np.array_equal(fresh.approximate(points, 1, mine), full.approximate(points, 1, shared))
    assert not np.array_equal(full.approximate(points, 1, shared), everything)
    assert np.array_equal(full.approximate(points, 1), everything), "a control: without tiles of its own"


def test_threads_share_a_field():
    """Eight threads ask for distances at once: each gets those that a thread alone gets."""
    points = np.random.default_rng(3).uniform(-18, 18, (64, 200, 2))
    alone, shared = DistanceField(irregular_area()), DistanceField(irregular_area())
    expected = [alone.at(some)[0] for some in points]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda some: shared.at(some)[0], points))
    assert np.array_equal(found, expected)


def test_tiles_can_be_computed_one_per_call():
    """Most of the places first; places in other tiles are open; in the end all distances are the same."""
    patient, hasty = DistanceField(irregular_area()), DistanceField(irregular_area())
    points = np.random.default_rng(3).uniform(-18, 18, (500, 2)).T
    crowd = np.tile([[0.5], [0.5]], 400)
    known = patient.approximate(np.hstack([crowd, points]))
    looks = [hasty.approximate(np.hstack([crowd, points]), at_once=1) for _ in range(40)]
    assert np.array_equal(looks[0][:400], known[:400]), "where most are comes first"
    agreeing = [np.mean(look == known) for look in looks]
    assert agreeing == sorted(agreeing)
    assert agreeing[0] < 0.6
    assert np.all((looks[0] == known) | (looks[0] == OPEN_DISTANCE))
    assert np.array_equal(looks[-1], known)


def test_distance_gradient_is_the_derivative():
    field = DistanceField(irregular_area())
    points = np.random.default_rng(2).uniform(-12, 12, (400, 2))
    step = 1e-6
    cell = np.floor(points / 0.25) == np.floor((points + 2 * step) / 0.25)
    points = points[cell.all(axis=1)]
    _, gradient = field.at(points)
    for axis in range(2):
        ahead = points.copy()
        ahead[:, axis] += step
        slope = (field.at(ahead)[0] - field.at(points)[0]) / step
        assert slope == pytest.approx(gradient[:, axis], abs=1e-6)


def test_slits_between_shops_are_not_walkable():
    """Two shops are 10 cm apart: the middle of the slit is 2 m inside a wall."""
    area = shapely.box(0, 0, 20, 10).difference(shapely.box(5, 2, 9.95, 10).union(shapely.box(10.05, 2, 15, 10)))
    distance, _ = DistanceField(area).at(np.array([[10.0, 6.0], [10.0, 1.0]]))
    assert distance[0] < -3.5
    assert distance[1] == pytest.approx(1.0, abs=0.06)
