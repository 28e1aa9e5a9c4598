"""Floor plans: where one can walk, distances to walls, crossings, and what is too large."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import shapely
from floor.geojson_plans import crosses, feature, written
from refusals import refused
from shapely import affinity

from pdr_graph import FloorPlan, InputError
from pdr_graph.floor.distance_field import OPEN_DISTANCE, DistanceField
from pdr_graph.floor.plan_files import Building


@pytest.fixture
def floor_folder(tmp_path):
    """Microsoft's: an outline of 40 × 20 m that a shop of 10 × 20 m divides; a degree is 100 km wide and high."""

    def square(name, *corners):
        box = shapely.box(*(origin + v / 1e5 for v, origin in zip(corners, (120, 30, 120, 30), strict=True)))
        return {"type": "Feature", "properties": {"name": name}, "geometry": json.loads(shapely.to_geojson(box))}

    nowhere = {"type": "Feature", "properties": {"name": "nowhere"}, "geometry": None}
    features = [square("outline", 0, 0, 40, 20), square("shop", 15, 0, 25, 20), nowhere]
    folder = tmp_path / "F9"
    folder.mkdir()
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
    assert not crosses(plan, (2, 5), (12, 5))


@pytest.mark.parametrize("info", ['{"map_info": {"width": -1, "height": 2}}', '{"map_info": 3}'])
def test_a_floor_of_no_size_is_refused(floor_folder, info):
    (floor_folder / "floor_info.json").write_text(info)
    refused(FloorPlan.load, floor_folder, "positive")


def test_own_geojson(tmp_path):
    """A corridor and a room joined by a door, with a gap between them that is the wall."""
    hall, room, door = (0, 0, 20, 3), (5, 3.2, 12, 9), (8, 2.9, 9, 3.3)
    features = [feature(kind, box) for kind, box in (("corridor", hall), ("room", room), ("door", door))]
    plan = FloorPlan.load(written(tmp_path / "plan.geojson", *features, feature("wall", (0, 0, 1, 3)), floor="2"))
    assert plan.label == "2"
    assert plan.frame.describe() == {"kind": "enu", "origin_lat": 48.0, "origin_lon": 11.0, "epsg": None}
    assert not crosses(plan, (8.5, 1), (8.5, 5))
    assert crosses(plan, (11, 1), (11, 5))
    refused(FloorPlan.load, written(tmp_path / "plan.geojson", feature("lake", hall)), "feature 0.*lake")


def irregular_area():
    """A star-shaped hall with a pillar: slanted walls, convex and concave corners."""
    angle = np.linspace(0, 2 * np.pi, 15)[:-1]
    radius = np.where(np.arange(14) % 2, 9.0, 16.0)
    hall = shapely.Polygon(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
    return hall.difference(shapely.box(1, 1, 3, 4))


def signed(area, points):
    """Distances of points ``(n, 2)`` from the walls, by shapely: negative where nobody can walk. [m]"""
    distance = shapely.distance(area.boundary, shapely.points(points))
    return np.where(shapely.contains_xy(area, *points.T), distance, -distance)


def test_distances_agree_with_exact_ones():
    """Bilinear on 0.25 m, approximate ones by half the diagonal of a pixel more, and exact ones without tiles."""
    area, points = irregular_area(), np.random.default_rng(1).uniform(-18, 18, (3000, 2))
    exact = signed(area, points)
    error = np.abs(DistanceField(area).at(points)[0] - exact)
    assert np.percentile(error, 99) < 0.06
    assert error.max() < 0.18  # half a cell's diagonal: at corners, where distance has a ridge
    assert np.percentile(np.abs(DistanceField(area).approximate(points.T) - exact), 99) < 0.1
    assert DistanceField(area).exact(points[:300]) == pytest.approx(exact[:300], abs=0.01)


@pytest.mark.parametrize("turned", [0.0, 0.3])
def test_distances_at_nodes_are_those_of_the_outline(turned):
    """Walls along the nodes, where a node is neither inside nor outside, and across them; hundreds beside each node."""
    pillars = shapely.box(*np.array([(x, y, x + 0.25, y + 0.25) for x in range(1, 29) for y in range(1, 9)]).T)
    area = affinity.rotate(shapely.box(0, 0, 30, 10) - shapely.unary_union(pillars), turned, use_radians=True)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-2, 32, 0.25), np.arange(-2, 12, 0.25)))
    nodes = np.stack([x, y], axis=1)
    assert DistanceField(area).at(nodes)[0] == pytest.approx(signed(area, nodes), abs=2e-3), (
        "arcs at corners are chords"
    )


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


# Plans whose cost grows with the square of their parts are refused, and dense outlines cost no more


def corridors(path, rings, floors=None):
    """A plan of corridors with these outlines [m], on one floor or on one each."""
    hall, features = feature("corridor", (0, 0, 1, 1)), []
    for n, ring in enumerate(rings):
        properties = hall["properties"] | ({"floor": floors[n]} if floors else {})
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append(hall | {"properties": properties, "geometry": geometry})
    path.write_text(json.dumps({"type": "FeatureCollection", "pdr_graph": {"frame": "local"}, "features": features}))
    return path


def box(x, y, width=2.0, height=2.0):
    return [[x, y], [x + width, y], [x + width, y + height], [x, y + height], [x, y]]


def test_hundreds_of_areas_on_one_place_are_refused(tmp_path):
    """Every pair of them could have a passage: 10 000 took ten gigabytes."""
    with pytest.raises(InputError, match="1000 areas, each of which touches more than 40 others"):
        FloorPlan.load(corridors(tmp_path / "p.geojson", [box(0, 0)] * 1000))
    side = [box(2 * (n % 40), 2 * (n // 40)) for n in range(1600)]
    assert FloorPlan.load(corridors(tmp_path / "p.geojson", side)).walkable_area == pytest.approx(6400, rel=1e-3)


def test_thousands_of_floors_are_refused(tmp_path):
    floors = [str(n) for n in range(501)]
    assert len(Building.load(corridors(tmp_path / "p.geojson", [box(0, 0)] * 500, floors=floors)).floors) == 500
    with pytest.raises(InputError, match="found 501 floors, expected 1 to 500"):
        Building.load(corridors(tmp_path / "p.geojson", [box(0, 0)] * 501, floors=floors))


@pytest.mark.thorough
def test_tens_of_thousands_of_features_or_holes_are_refused(tmp_path):
    """10⁵ of either took more than a minute."""
    with pytest.raises(InputError, match="found 50001 features, expected at most 50000"):
        FloorPlan.load(corridors(tmp_path / "p.geojson", [box(0, 0)] * 50_001))
    holes = [box(2 * (n % 200) + 0.5, 2 * (n // 200) + 0.5, 1, 1) for n in range(20_001)]
    path = corridors(tmp_path / "p.geojson", [box(0, 0, 400, 400)])
    value = json.loads(path.read_text())
    value["features"][0]["geometry"]["coordinates"] += holes
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match="feature 0: found 20001 holes, expected at most 20000"):
        FloorPlan.load(path)


def test_a_scribble_is_refused_and_an_outline_that_crosses_itself_once_is_repaired(tmp_path):
    corners = np.random.default_rng(0).uniform(0, 50, (500, 2)).round(3).tolist()
    with pytest.raises(InputError, match="feature 0: found an outline of 500 sides that cross one another"):
        FloorPlan.load(corridors(tmp_path / "p.geojson", [[*corners, corners[0]]]))
    bow = [[0, 0], [10, 10], [10, 0], [0, 10], [0, 0]]
    assert "crosses itself" in FloorPlan.load(corridors(tmp_path / "p.geojson", [bow])).repairs[0]


def test_an_outline_of_a_hundred_thousand_corners_costs_what_its_shape_costs():
    """Each tile of distances looks at the walls near it: 10⁵ of them, some millimetres long, took minutes."""
    circle = shapely.Point(0, 0).buffer(50, quad_segs=25_000)
    begin = time.perf_counter()
    fine, coarse = DistanceField(circle), DistanceField(shapely.Point(0, 0).buffer(50, quad_segs=100))
    points = np.random.default_rng(0).uniform(-40, 40, (300, 2))
    assert fine.at(points)[0] == pytest.approx(coarse.at(points)[0], abs=0.02)
    assert time.perf_counter() - begin < 10
