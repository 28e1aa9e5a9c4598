"""Rooms, corridors and doors: a wall need not be drawn to be one."""

import json

import numpy as np
import pytest
import shapely
from floor.geojson_plans import crosses
from plans import plan

from pdr_graph import FloorPlan
from pdr_graph.floor.building import Building
from pdr_graph.floor.check import problems

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
    assert floor.cells.passages.tolist() == [[0, 3], [1, 3]]
    assert len(set(Building.of(floor).parts[0])) == 2, "room B has no door"


def test_the_distance_field_contains_walls_without_thickness():
    """A metre from a shared edge the distance is a metre; in an open door it is that to the jamb."""
    floor = plan(CORRIDOR, *ROOMS, DOOR)
    distance, _ = floor.distance.at(np.array([[9.0, 6.0], [11.0, 6.0], [10.0, 6.0], [4.5, 3.0]]))
    assert distance == pytest.approx([1.0, 1.0, 0.0, 0.5], abs=0.06)


def test_a_line_is_a_wall_and_a_door_opens_it():
    wall = ("wall", "", shapely.LineString([(10, 0), (10, 3)]))
    door = ("door", "", shapely.Point(10, 1.5))
    assert crosses(plan(CORRIDOR, wall), (8, 1.5), (12, 1.5))
    assert not crosses(plan(CORRIDOR, wall, door), (8, 1.5), (12, 1.5))
    assert crosses(plan(CORRIDOR, wall, door), (8, 0.3), (12, 0.3))


def test_open_neighbours_are_joined_across_a_narrow_gap():
    """The cells are a millimetre apart."""
    floor = plan(("corridor", "", shapely.box(0, 0, 5, 3)), ("intersection", "", shapely.box(5.001, 0, 9, 3)))
    assert floor.cells.passages.tolist() == [[0, 1]]
    assert not crosses(floor, (4, 1), (6, 1))
    assert floor.distance.at(np.array([[5.0, 1.5]]))[0] == pytest.approx([1.5], abs=0.06)


def test_rooms_of_a_plan_without_doors_are_open():
    floor = plan(CORRIDOR, *ROOMS)
    assert not crosses(floor, (8, 1), (8, 6))
    assert any("no door" in problem for problem in problems(Building.of(floor)))


def test_ipin21_polygons(tmp_path):
    """Coordinates are UTM metres whatever CRS the file states; types are mapped, null geometries are skipped."""
    x, y = 566e3, 5932e3
    boxes = {
        "Corridor": (0, 0, 9, 2),
        "Room": (0, 2.2, 9, 6),
        "Wall": (0, 2, 9, 2.2),
        "Door": (4, 2, 5, 2.2),
        "Sofa": (1, 3, 2, 4),
    }
    shapes = [json.loads(shapely.to_geojson(shapely.box(x + a, y + b, x + c, y + d))) for a, b, c, d in boxes.values()]
    kinds_and_shapes = zip([*boxes, None], [*shapes, None], strict=True)
    features = [{"type": "Feature", "properties": {"Type": k}, "geometry": s} for k, s in kinds_and_shapes]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    path = tmp_path / "Plan4OG.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    floor = FloorPlan.load(path)
    assert floor.label == "4OG"
    assert floor.frame.describe()["epsg"] == 32632
    assert not crosses(floor, (x + 4.5, y + 1), (x + 4.5, y + 5))
    assert crosses(floor, (x + 7, y + 1), (x + 7, y + 5))
    assert [note.split(":")[0] for note in floor.notes] == [
        "1 features without a geometry were left out (the first",
        "the file states CRS CRS84, but its coordinates are metres, read as EPSG",
        "feature 4",
    ]
