"""Rooms, corridors and doors: a wall need not be drawn to be one."""

import json

import numpy as np
import pytest
import shapely
from plans import plan
from typer.testing import CliRunner

from pdr_graph import FloorPlan, InputError
from pdr_graph.apps.cli import app
from pdr_graph.floor.building import Building
from pdr_graph.floor.check import problems
from pdr_graph.frames import enu

FRAME = enu(49.0, 8.0)


def crosses(floor, a, b):
    return bool(floor.crosses_wall(np.array([a], float), np.array([b], float))[0])


CORRIDOR = ("corridor", "hall", shapely.box(0, 0, 20, 3))
ROOMS = (("room", "A", shapely.box(0, 3, 10, 9)), ("room", "B", shapely.box(10, 3, 20, 9)))
DOOR = ("door", "", shapely.LineString([(4, 3), (5, 3)]))


def test_rooms_that_share_an_edge_share_a_wall():
    """No wall is drawn; the door is open, the shared edge is a wall."""
    floor = plan(CORRIDOR, *ROOMS, DOOR)
    assert not crosses(floor, (4.5, 1), (4.5, 6))
    assert crosses(floor, (8, 1), (8, 6))
    assert crosses(floor, (8, 6), (12, 6))
    assert not crosses(floor, (1, 1), (19, 2))
    assert floor.cells.at(np.array([[1, 1], [1, 6], [19, 6], [50, 50], [4.5, 3]])).tolist() == [0, 1, 2, -1, 3]


def test_the_distance_field_contains_walls_without_thickness():
    """A metre from a shared edge the distance is a metre; in an open door it is that to the jamb."""
    floor = plan(CORRIDOR, *ROOMS, DOOR)
    distance, _ = floor.distance.at(np.array([[9.0, 6.0], [11.0, 6.0], [10.0, 6.0], [4.5, 3.0]]))
    assert distance == pytest.approx([1.0, 1.0, 0.0, 0.5], abs=0.06)


def test_a_line_is_a_wall_and_a_door_opens_it():
    wall = ("wall", "", shapely.LineString([(10, 0), (10, 3)]))
    assert crosses(plan(CORRIDOR, wall), (8, 1.5), (12, 1.5))
    door = ("door", "", shapely.Point(10, 1.5))
    assert not crosses(plan(CORRIDOR, wall, door), (8, 1.5), (12, 1.5))
    assert crosses(plan(CORRIDOR, wall, door), (8, 0.3), (12, 0.3))


def test_passages_join_open_neighbours():
    floor = plan(CORRIDOR, *ROOMS, DOOR)
    assert floor.cells.passages.tolist() == [[0, 3], [1, 3]]
    assert len(set(Building.of(floor).parts[0])) == 2, "room B has no door"
    open_ = plan(("corridor", "", shapely.box(0, 0, 5, 5)), ("intersection", "", shapely.box(5, 0, 8, 5)))
    assert open_.cells.passages.tolist() == [[0, 1]]


def test_rooms_of_a_plan_without_doors_are_open():
    floor = plan(CORRIDOR, *ROOMS)
    assert not crosses(floor, (8, 1), (8, 6))
    assert any("no door" in problem for problem in problems(Building.of(floor)))


def test_narrow_gaps_between_neighbours_are_not_walls():
    """The cells are a millimetre apart."""
    floor = plan(("corridor", "", shapely.box(0, 0, 5, 3)), ("corridor", "", shapely.box(5.001, 0, 9, 3)))
    assert not crosses(floor, (4, 1), (6, 1))
    assert floor.distance.at(np.array([[5.0, 1.5]]))[0] == pytest.approx([1.5], abs=0.06)


def feature(kind, shape, **properties):
    lonlat = shapely.transform(shape, FRAME.to_lonlat)
    return {
        "type": "Feature",
        "properties": {"kind": kind, **properties},
        "geometry": json.loads(shapely.to_geojson(lonlat)),
    }


def geojson(path, *features, **own):
    own = {"origin": [8.0, 49.0]} | own
    path.write_text(json.dumps({"type": "FeatureCollection", "pdr_graph": own, "features": list(features)}))
    return path


@pytest.fixture
def two_floors(tmp_path):
    return geojson(
        tmp_path / "house.geojson",
        feature("corridor", shapely.box(0, 0, 20, 3), floor="0", name="below"),
        feature("corridor", shapely.box(0, 0, 20, 5), floor=1, name="above"),
        feature("stairs", shapely.box(20, 0, 24, 3), floor=["0", "1"]),
        feature("lift", shapely.box(0, -2, 2, 0)),
    )


def test_several_floors_in_one_file(two_floors):
    below, above = FloorPlan.load_all(two_floors)
    assert (below.label, above.label) == ("0", "1")
    assert below.walkable_area == pytest.approx(60 + 12 + 4, rel=1e-3)
    assert above.walkable_area == pytest.approx(100 + 12 + 4, rel=1e-3)
    assert FloorPlan.load(two_floors, "1").areas[0].name == "above"
    with pytest.raises(InputError, match="2 floors, 0, 1, expected the label of one"):
        FloorPlan.load(two_floors)
    with pytest.raises(InputError, match="expected a floor 'attic'"):
        FloorPlan.load(two_floors, "attic")


def test_ipin21_polygons(tmp_path):
    """Coordinates are UTM metres whatever CRS the file states; types are mapped, null geometries are skipped."""
    boxes = {
        "Corridor": (0, 0, 9, 2),
        "Room": (0, 2.2, 9, 6),
        "Wall": (0, 2, 9, 2.2),
        "Door": (4, 2, 5, 2.2),
        "Sofa": (1, 3, 2, 4),
    }
    features = [
        {
            "type": "Feature",
            "properties": {"Type": kind},
            "geometry": json.loads(
                shapely.to_geojson(shapely.box(*(v + o for v, o in zip(b, 2 * (566e3, 5932e3), strict=True))))
            ),
        }
        for kind, b in boxes.items()
    ]
    features.append({"type": "Feature", "properties": {"Type": None}, "geometry": None})
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    path = tmp_path / "Plan4OG.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    floor = FloorPlan.load(path)
    assert floor.label == "4OG"
    assert floor.frame.describe()["epsg"] == 32632
    x, y = 566e3, 5932e3
    assert not crosses(floor, (x + 4.5, y + 1), (x + 4.5, y + 5))
    assert crosses(floor, (x + 7, y + 1), (x + 7, y + 5))
    assert [note.split(":")[0] for note in floor.notes] == [
        "1 features without a geometry were left out (the first",
        "the file states CRS CRS84, but its coordinates are metres, read as EPSG",
        "feature 4",
    ]


def test_map_check_names_every_problem(tmp_path):
    path = geojson(
        tmp_path / "plan.geojson",
        feature("corridor", shapely.box(0, 0, 20, 3)),
        feature("room", shapely.box(0, 3, 10, 9), name="sealed"),
        feature("room", shapely.box(8, 3, 20, 9), name="other"),
        feature("door", shapely.box(14, 2.9, 15, 3.1)),
        feature("door", shapely.box(30, 0, 31, 0.2)),
        feature("link", shapely.LineString([(2, 1), (2, 6)]), name="shortcut"),
        feature("beacon", shapely.Point(3, 1)),
        floor="EG",
    )
    run = CliRunner().invoke(app, ["map", "check", str(path)])
    assert run.exit_code == 3
    for claim in (
        "1 doors that join fewer than two cells",
        "cells that cannot be reached from the rest: room sealed",
        "rooms that overlap: sealed and other",
        "links that go through a wall: shortcut",
        "1 beacons without an id",
    ):
        assert claim in run.output


def test_map_show_draws_all_floors(two_floors, tmp_path):
    run = CliRunner().invoke(app, ["map", "show", str(two_floors), "--out", str(tmp_path / "house.png")])
    assert run.exit_code == 0
    assert run.output.count("walkable") == 2
    assert (tmp_path / "house.png").stat().st_size > 5000
