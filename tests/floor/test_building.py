"""Buildings of several floors: their order and heights, and what joins them."""

import json

import numpy as np
import pytest
import shapely
from plans import MAPS

from pdr_graph import FloorPlan, InputError
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu

FRAME = enu(35.0, 135.0)


def feature(kind, box, floor=None, name=""):
    lonlat = shapely.transform(shapely.box(*box), FRAME.to_lonlat)
    properties = {"kind": kind, "name": name} | ({"floor": floor} if floor else {})
    return {"type": "Feature", "properties": properties, "geometry": json.loads(shapely.to_geojson(lonlat))}


def written(path, *features, **about):
    about = {"origin": [135.0, 35.0]} | about
    path.write_text(json.dumps({"type": "FeatureCollection", "pdr_graph": about, "features": features}))
    return path


def storeys(folder, *labels, **about):
    """One hall per floor."""
    return written(folder / "house.geojson", *(feature("corridor", (0, 0, 9, 9), on) for on in labels), **about)


@pytest.fixture(scope="module")
def office():
    return Building.load(MAPS / "two_floors.geojson")


def test_floors_are_in_order_of_height(tmp_path):
    """By the numbers in their labels, 3.8 m each; as text "10" would come before "2"."""
    building = Building.load(storeys(tmp_path, "10", "2", "B1", "EG", "-2", "1F", "roof"))
    assert building.labels == ("-2", "B1", "EG", "1F", "2", "10", "roof")
    assert building.heights == pytest.approx(3.8 * np.arange(7))
    assert [floor.label for floor in FloorPlan.load_all(tmp_path / "house.geojson")] == list(building.labels)


def test_heights_of_the_plan_are_used(tmp_path):
    building = Building.load(storeys(tmp_path, "1", "2", "deck", heights={"1": 0, "2": 4.5, "deck": 2.0}))
    assert building.labels == ("1", "deck", "2")
    assert building.heights.tolist() == [0.0, 2.0, 4.5]
    assert building["2"].height == 4.5
    with pytest.raises(KeyError, match="found only 1, deck, 2"):
        building["3"]


@pytest.mark.parametrize(
    ("heights", "message"),
    [
        ([0, 4], "pdr_graph.heights: found [0, 4], expected a height for each floor"),
        ({"1": 0, "2": 4, "3": 8}, "pdr_graph.heights: found a floor '3', expected the labels of floors: 1, 2"),
        ({"1": 0}, "pdr_graph.heights: found no height of floor '2'"),
        ({"1": 0, "2": "4 m"}, "pdr_graph.heights.2: found '4 m', expected metres"),
        ({"1": 0, "2": True}, "pdr_graph.heights.2: found True"),
        ({"1": 0, "2": None}, "pdr_graph.heights.2: found None"),
        ({"1": 0, "2": float("nan")}, "pdr_graph.heights.2: found nan"),
        ({"1": 0, "2": 4000}, "pdr_graph.heights.2: found 4000, expected metres, less than 1000"),
    ],
)
def test_invalid_heights_are_refused_in_one_line(tmp_path, heights, message):
    with pytest.raises(InputError) as refusal:
        Building.load(storeys(tmp_path, "1", "2", heights=heights))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_plan_of_one_floor_is_a_building():
    plan = FloorPlan.load(MAPS / "arcade.geojson")
    for building in (Building.of(plan), Building.load(MAPS / "arcade.geojson")):
        assert building.labels == ("1",)
        assert building.heights.tolist() == [0.0]
        assert building.connections == ()


def test_stairs_and_lift_join_the_floors_that_they_list(office):
    assert [(c.kind, c.name, c.floors) for c in office.connections] == [
        ("stairs", "Stairs", (0, 1)),
        ("lift", "Lift", (0, 1)),
    ]
    stairs, _ = office.connections
    assert shapely.bounds(stairs.polygon) == pytest.approx([12, 10.4, 15, 16.4], abs=0.002)
    assert stairs.distance(np.array([[13, 12], [13, 8.4], [18, 20.4]])) == pytest.approx([0, 2, 5], abs=0.002)


def test_stairs_without_labels_join_all_floors(tmp_path):
    path = written(
        tmp_path / "tower.geojson",
        *(feature("corridor", (0, 0, 9, 3), str(n)) for n in range(4)),
        feature("lift", (0, 3, 2, 5), name="everywhere"),
        feature("stairs", (7, 3, 9, 6), ["2", "1"], name="cellar"),
        feature("stairs", (4, 3, 6, 6), "3", name="up to nothing"),
    )
    building = Building.load(path)
    assert {c.name: c.floors for c in building.connections} == {"everywhere": (0, 1, 2, 3), "cellar": (1, 2)}


def test_a_floor_of_shops_is_walkable_beside_its_stairs(tmp_path):
    """An outline of 600 m² with shops of 200 and 100 m² and stairs, but without corridors."""
    path = written(
        tmp_path / "mall.geojson",
        feature("floor", (0, 0, 30, 20)),
        feature("shop", (0, 10, 20, 20), "1"),
        feature("shop", (20, 10, 30, 20), "2"),
        feature("stairs", (26, 0, 30, 4)),
    )
    building = Building.load(path)
    assert [floor.walkable_area for floor in building.floors] == pytest.approx([400, 500], rel=1e-3)
    assert not building.floors[0].crosses_wall(np.array([[5.0, 5.0]]), np.array([[28.0, 2.0]]))[0]
    assert building.floors[1].crosses_wall(np.array([[5.0, 5.0]]), np.array([[25.0, 15.0]]))[0]
    assert problems(building) == ()


def test_halls_joined_by_another_floor_are_connected(tmp_path):
    """Two separate halls above, each with stairs from one hall below."""
    halls = [feature("corridor", box, "2") for box in ((0, 0, 5, 3), (10, 0, 15, 3))]
    flights = [feature("stairs", box, ["1", "2"]) for box in ((0, 3, 2, 8), (13, 3, 15, 8))]
    below = feature("corridor", (0, 0, 15, 3), "1")
    joined = Building.load(written(tmp_path / "joined.geojson", below, *halls, *flights))
    assert {*joined.parts[0], *joined.parts[1]} == {0}
    assert problems(joined) == ()
    apart = Building.load(written(tmp_path / "apart.geojson", below, *halls, flights[0]))
    assert problems(apart) == ("floor 2: 1 cells that cannot be reached from the rest: corridor at (12.5, 1.5)",)
