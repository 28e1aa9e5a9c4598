"""``map check``: each mistake that a hand makes in a good plan is named with its feature and place."""

import json
import re

import commands
import numpy as np
import pytest
import shapely
from plans import MAPS
from refusals import refused

from pdr_graph import FloorPlan
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu

OFFICE = MAPS / "two_floors.geojson"
FRAME = enu(35.0, 135.0)


@pytest.fixture
def office():
    return json.loads(OFFICE.read_text())


def named(plan, name):
    return next(f for f in plan["features"] if f["properties"]["name"] == name)


def ring(plan, name):
    return named(plan, name)["geometry"]["coordinates"][0]


def door_at(plan, x, y, floor):
    def opens(f):
        here = shapely.transform(shapely.from_geojson(json.dumps(f["geometry"])), FRAME.from_lonlat)
        return f["properties"]["kind"] == "door" and shapely.distance(here, shapely.Point(x, y)) < 0.1

    return next(f for f in plan["features"] if opens(f) and floor in f["properties"]["floor"])


def move(feature, by):
    metres = FRAME.from_lonlat(np.array(feature["geometry"]["coordinates"][0])) + by
    feature["geometry"]["coordinates"] = [FRAME.to_lonlat(metres).tolist()]


def checked(plan, folder):
    """Problems that the command prints, and its exit code."""
    path = folder / "damaged.geojson"
    path.write_text(json.dumps(plan))
    run = commands.run("map", "check", path)
    return [line.removeprefix("problem: ") for line in run.output.splitlines() if "problem: " in line], run.code


@pytest.mark.parametrize("path", sorted(MAPS.glob("*.geojson")), ids=lambda path: path.stem)
def test_our_own_plans_have_no_problems(path):
    assert problems(Building.load(path)) == ()


def test_floors_and_connections_are_listed_and_drawn(tmp_path):
    run = commands.run("map", "check", OFFICE)
    assert run.code == 0
    assert "2: at 4 m, " in run.output
    assert "stairs Stairs: 1, 2\nlift Lift: 1, 2\nno problems found" in run.output
    run = commands.run("map", "show", OFFICE, "--out", tmp_path / "house.png")
    assert (run.code, run.output.count("walkable")) == (0, 2)
    assert (tmp_path / "house.png").stat().st_size > 5000


def test_an_unclosed_ring_is_closed_and_named(office, tmp_path):
    begins = ring(office, "Cafe")[0]
    del ring(office, "Cafe")[-1]
    number = office["features"].index(named(office, "Cafe"))
    found, code = checked(office, tmp_path)
    assert code == 3
    assert found == [f"feature {number} (Cafe): the ring from {begins} does not end where it begins, and was closed"]
    closed, whole = FloorPlan.load_all(tmp_path / "damaged.geojson"), FloorPlan.load_all(OFFICE)
    assert all(shapely.equals(a.walkable, b.walkable) for a, b in zip(closed, whole, strict=True))


def test_each_open_ring_of_several_polygons_is_closed(office, tmp_path):
    whole = shapely.box(135.0, 35.0, 135.0001, 35.00007) - shapely.box(135.00003, 35.00002, 135.00004, 35.00003)
    outer, inner = json.loads(shapely.to_geojson(whole))["coordinates"]
    named(office, "Cafe")["geometry"] = {"type": "MultiPolygon", "coordinates": [[outer, inner[:-1]]]}
    found, _ = checked(office, tmp_path)
    assert f"the ring from {inner[0]} does not end" in found[0]
    room = next(a for a in FloorPlan.load(tmp_path / "damaged.geojson", "1").areas if a.name == "Cafe")
    assert shapely.equals(room.shape, shapely.transform(whole, FRAME.from_lonlat))


def test_a_ring_of_two_places_is_refused(office, tmp_path):
    del ring(office, "Cafe")[2:]
    (tmp_path / "damaged.geojson").write_text(json.dumps(office))
    refused(Building.load, tmp_path / "damaged.geojson", r"feature \d+: found .*, expected a GeoJSON geometry")


def test_a_ring_that_collapses_in_part_keeps_its_area(office, tmp_path):
    """A square with a spike: the spike is a line after the repair, and lines have no room to walk in."""
    spike = [[0, 0], [9, 0], [9, 9], [20, 9], [9, 9], [0, 9], [0, 0]]
    cafe, office["pdr_graph"] = named(office, "Cafe"), {}
    cafe["geometry"]["coordinates"] = [FRAME.to_lonlat(np.array(spike, float)).tolist()]
    office["features"] = [cafe | {"properties": {"kind": "corridor", "name": "spiked"}}]
    found, _ = checked(office, tmp_path)
    assert "its outline crosses itself" in found[0]
    (floor,) = FloorPlan.load_all(tmp_path / "damaged.geojson")
    assert floor.walkable_area == pytest.approx(81, rel=1e-3)
    assert floor.areas[0].shape.geom_type == "Polygon"


def cross_itself(plan):
    corners = ring(plan, "Seminar")
    corners[1], corners[2] = corners[2], corners[1]


def lead_through_a_wall(plan):
    named(plan, "upper floor")["geometry"]["coordinates"] += FRAME.to_lonlat(np.array([[30.0, 1.0]])).tolist()


def leave_the_upper_floor_alone(plan):
    for name in ("Stairs", "Lift"):
        named(plan, name)["properties"]["floor"] = ["1"]


def draw_a_room_as_a_line(plan):
    cafe = named(plan, "Cafe")["geometry"]
    cafe.update(type="LineString", coordinates=cafe["coordinates"][0])


def add_a_beacon(plan):
    point = {"type": "Point", "coordinates": [135.0002, 35.00005]}
    plan["features"].append({"type": "Feature", "properties": {"kind": "beacon"}, "geometry": point})


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (cross_itself, r"feature \d+ \(Seminar\): its outline crosses itself at \[135.0003"),
        (
            lambda p: p["features"].remove(door_at(p, 35.4, 4, "2")),
            r"floor 2: 1 cells that cannot be reached from the rest: room 205 at \(37.7, 4.0\)",
        ),
        (
            lambda p: move(door_at(p, 35.4, 4, "2"), (0, 30)),
            r"floor 2: 1 doors that join fewer than two cells: at \(35.4, 34.0\)",
        ),
        (
            lambda p: move(door_at(p, 29, 8, "1"), (0, -8)),  # into the outer wall: nothing is on its other side
            r"floor 1: 1 doors that join fewer than two cells: at \(29.0, 0.0\)",
        ),
        (lead_through_a_wall, r"floor 2: 1 links that go through a wall: upper floor at \(33.0, 1.0\)"),
        (
            lambda p: named(p, "upper floor")["geometry"].update(type="Point", coordinates=[135.0002, 35.00005]),
            r"floor 2: 1 links that are not lines: upper floor at \(18.3, 5.5\)",
        ),
        (
            lambda p: named(p, "Stairs")["properties"].update(floor="2"),
            r"floor 2: 1 stairs or lifts that join no other floor: Stairs at \(13.5, 13.4\)",
        ),
        (leave_the_upper_floor_alone, "floor 2: no stairs or lift from the rest of the building"),
        (
            lambda p: door_at(p, 25.2, 8, "1")["properties"].update(floor=["1"]),
            r"floor 2: 1 stairs or lifts without an entrance: Lift at \(25.2, 6.8\)",
        ),
        (
            lambda p: move(named(p, "Stairs"), (0, 1)),
            r"floor 1: 1 stairs or lifts without an entrance: Stairs at \(13.5, 14.4\)",
        ),
        (draw_a_room_as_a_line, r"floor 1: 1 cells that are not polygons: room Cafe at \(5.5, 4.0\)"),
        (
            lambda p: move(named(p, "103"), (1, 0)),
            r"floor 1: 1 rooms that overlap: 103 and 104 at \(26.0, 14.2\)",
        ),
        (add_a_beacon, "floor 1: 1 beacons without an id"),
    ],
)
def test_a_problem_is_reported_with_feature_and_position(office, tmp_path, damage, problem):
    damage(office)
    found, code = checked(office, tmp_path)
    assert code == 3
    assert [line for line in found if re.match(problem, line)], found
