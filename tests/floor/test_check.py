"""``map check``: each mistake that a hand makes in a good plan is named with its feature and place."""

import json

import numpy as np
import pytest
import shapely
from plans import MAPS
from typer.testing import CliRunner

from pdr_graph import FloorPlan, InputError
from pdr_graph.apps.cli import app
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


def moved(plan, feature, by):
    corners = feature["geometry"]["coordinates"][0]
    metres = FRAME.from_lonlat(np.array(corners)) + by
    feature["geometry"]["coordinates"] = [FRAME.to_lonlat(metres).tolist()]


def checked(plan, folder):
    """Problems that the command prints, and its exit code."""
    path = folder / "damaged.geojson"
    path.write_text(json.dumps(plan))
    run = CliRunner().invoke(app, ["map", "check", str(path)])
    return [line.removeprefix("problem: ") for line in run.output.splitlines() if "problem: " in line], run.exit_code


@pytest.mark.parametrize("path", sorted(MAPS.glob("*.geojson")), ids=lambda path: path.stem)
def test_our_own_plans_have_no_problems(path):
    assert problems(Building.load(path)) == ()


def test_an_unclosed_ring_is_closed_and_named(office, tmp_path):
    begins = ring(office, "Cafe")[0]
    del ring(office, "Cafe")[-1]
    number = office["features"].index(named(office, "Cafe"))
    found, code = checked(office, tmp_path)
    assert code == 3
    assert found == [f"feature {number} (Cafe): the ring from {begins} does not end where it begins, and was closed"]
    for repaired, whole in zip(
        FloorPlan.load_all(tmp_path / "damaged.geojson"), FloorPlan.load_all(OFFICE), strict=True
    ):
        assert shapely.equals(repaired.walkable, whole.walkable)


def test_each_open_ring_of_several_polygons_is_closed(office, tmp_path):
    cafe = named(office, "Cafe")
    whole = shapely.box(135.0, 35.0, 135.0001, 35.00007) - shapely.box(135.00003, 35.00002, 135.00004, 35.00003)
    outer, inner = json.loads(shapely.to_geojson(whole))["coordinates"]
    cafe["geometry"] = {"type": "MultiPolygon", "coordinates": [[outer, inner[:-1]]]}
    found, _ = checked(office, tmp_path)
    assert f"the ring from {inner[0]} does not end" in found[0]
    room = next(a for a in FloorPlan.load(tmp_path / "damaged.geojson", "1").areas if a.name == "Cafe")
    assert shapely.equals(room.shape, shapely.transform(whole, FRAME.from_lonlat))


def test_a_ring_of_two_places_is_refused(office, tmp_path):
    del ring(office, "Cafe")[2:]
    (tmp_path / "damaged.geojson").write_text(json.dumps(office))
    with pytest.raises(InputError, match=r"feature \d+: found .*, expected a GeoJSON geometry"):
        Building.load(tmp_path / "damaged.geojson")


def crossing_itself(plan):
    corners = ring(plan, "Seminar")
    corners[1], corners[2] = corners[2], corners[1]
    return (
        f"feature {plan['features'].index(named(plan, 'Seminar'))} (Seminar): its outline crosses itself at [135.0003"
    )


def sealed_room(plan):
    plan["features"].remove(door_at(plan, 35.4, 4, "2"))
    return "floor 2: 1 cells that cannot be reached from the rest: room 205 at (37.7, 4.0)"


def door_in_the_open(plan):
    moved(plan, door_at(plan, 35.4, 4, "2"), (0, 30))
    return "floor 2: 1 doors that join fewer than two cells: at (35.4, 34.0)"


def door_into_a_solid_wall(plan):
    """It is in the outer wall: a room on one side, nothing on the other."""
    moved(plan, door_at(plan, 29, 8, "1"), (0, -8))
    return "floor 1: 1 doors that join fewer than two cells: at (29.0, 0.0)"


def link_through_a_wall(plan):
    link = named(plan, "upper floor")
    link["geometry"]["coordinates"].append(FRAME.to_lonlat(np.array([[30.0, 1.0]])).tolist()[0])
    return "floor 2: 1 links that go through a wall: upper floor at (33.0, 1.0)"


def link_of_one_place(plan):
    named(plan, "upper floor")["geometry"] = {"type": "Point", "coordinates": [135.0002, 35.00005]}
    return "floor 2: 1 links that are not lines: upper floor at (18.3, 5.5)"


def stairs_on_one_floor(plan):
    named(plan, "Stairs")["properties"]["floor"] = "2"
    return "floor 2: 1 stairs or lifts that join no other floor: Stairs at (13.5, 13.4)"


def floor_that_nothing_reaches(plan):
    for name in ("Stairs", "Lift"):
        named(plan, name)["properties"]["floor"] = ["1"]
    return "floor 2: no stairs or lift from the rest of the building"


def lift_without_a_door_above(plan):
    door_at(plan, 25.2, 8, "1")["properties"]["floor"] = ["1"]
    return "floor 2: 1 stairs or lifts without an entrance: Lift at (25.2, 6.8)"


def stairs_away_from_the_corridor(plan):
    moved(plan, named(plan, "Stairs"), (0, 1))
    return "floor 1: 1 stairs or lifts without an entrance: Stairs at (13.5, 14.4)"


def room_drawn_as_a_line(plan):
    cafe = named(plan, "Cafe")["geometry"]
    cafe.update(type="LineString", coordinates=cafe["coordinates"][0])
    return "floor 1: 1 cells that are not polygons: room Cafe at (5.5, 4.0)"


def rooms_over_each_other(plan):
    moved(plan, named(plan, "103"), (1, 0))
    return "floor 1: 1 rooms that overlap: 103 and 104 at (26.0, 14.2)"


@pytest.mark.parametrize(
    "damage",
    [
        crossing_itself,
        sealed_room,
        door_in_the_open,
        door_into_a_solid_wall,
        link_through_a_wall,
        link_of_one_place,
        stairs_on_one_floor,
        floor_that_nothing_reaches,
        lift_without_a_door_above,
        stairs_away_from_the_corridor,
        room_drawn_as_a_line,
        rooms_over_each_other,
    ],
)
def test_a_problem_is_reported_with_feature_and_position(office, tmp_path, damage):
    claim = damage(office)
    found, code = checked(office, tmp_path)
    assert code == 3
    assert any(line.startswith(claim) for line in found), found


def test_map_info_lists_floors_and_connections():
    run = CliRunner().invoke(app, ["map", "check", str(OFFICE)])
    assert run.exit_code == 0
    assert "2: at 4 m, " in run.output
    assert "stairs Stairs: 1, 2\nlift Lift: 1, 2\nno problems found" in run.output


def test_a_ring_that_collapses_in_part_keeps_its_area(tmp_path):
    """A square with a spike: the spike is a line after the repair, and lines have no room to walk in."""
    spike = [[0, 0], [9, 0], [9, 9], [20, 9], [9, 9], [0, 9], [0, 0]]
    lonlat = FRAME.to_lonlat(np.array(spike, float)).tolist()
    corridor = {"type": "Feature", "properties": {"kind": "corridor", "name": "spiked"}}
    corridor["geometry"] = {"type": "Polygon", "coordinates": [lonlat]}
    path = tmp_path / "spiked.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [corridor]}))
    building = Building.load(path)
    assert building.floors[0].walkable_area == pytest.approx(81, rel=1e-3)
    assert building.floors[0].areas[0].shape.geom_type == "Polygon"
    assert "its outline crosses itself" in problems(building)[0]
