"""Buildings of several floors: their order and heights, and what joins them."""

import numpy as np
import pytest
import shapely
from floor.geojson_plans import crosses, feature, written
from plans import MAPS
from refusals import refused

from pdr_graph import FloorPlan
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building


def storeys(folder, *labels, **about):
    """One hall per floor."""
    halls = (feature("corridor", (0, 0, 9, 9), floor=label) for label in labels)
    return written(folder / "house.geojson", *halls, **about)


def test_floors_are_in_order_of_height(tmp_path):
    """By the numbers in their labels, 3.8 m each; as text "10" would come before "2"."""
    building = Building.load(storeys(tmp_path, "10", "2", "B1", "EG", "-2", "1F", "roof"))
    assert building.labels == ("-2", "B1", "EG", "1F", "2", "10", "roof")
    assert building.heights == pytest.approx(3.8 * np.arange(7))


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
        ([0, 4], r": found \[0, 4\], expected a height for each floor"),
        ({"1": 0, "2": 4, "3": 8}, ": found a floor '3', expected the labels of floors: 1, 2"),
        ({"1": 0}, ": found no height of floor '2'"),
        ({"1": 0, "2": "4 m"}, ".2: found '4 m', expected metres"),
        ({"1": 0, "2": True}, ".2: found True"),
        ({"1": 0, "2": None}, ".2: found None"),
        ({"1": 0, "2": float("nan")}, ".2: found nan"),
        ({"1": 0, "2": 4000}, ".2: found 4000, expected metres, less than 1000"),
    ],
)
def test_invalid_heights_are_refused_in_one_line(tmp_path, heights, message):
    refused(Building.load, storeys(tmp_path, "1", "2", heights=heights), "pdr_graph.heights" + message)


def test_a_plan_of_one_floor_is_a_building():
    plan = FloorPlan.load(MAPS / "arcade.geojson")
    for building in (Building.of(plan), Building.load(MAPS / "arcade.geojson")):
        assert building.labels == ("1",)
        assert building.heights.tolist() == [0.0]
        assert building.connections == ()


def test_several_floors_in_one_file_are_read_one_by_one_or_together(tmp_path):
    below, above = feature("corridor", (0, 0, 20, 3), floor="0"), feature("corridor", (0, 0, 20, 5), floor=1)
    stairs, lift = feature("stairs", (20, 0, 24, 3), floor=["0", "1"]), feature("lift", (0, -2, 2, 0))
    path = written(tmp_path / "house.geojson", below, above, stairs, lift)
    assert [(plan.label, round(plan.walkable_area)) for plan in FloorPlan.load_all(path)] == [("0", 76), ("1", 116)]
    assert FloorPlan.load(path, "1").label == "1"
    refused(FloorPlan.load, path, "2 floors, 0, 1, expected the label of one")
    refused(FloorPlan.load, path, "expected a floor 'attic'", "attic")


def test_stairs_and_lift_join_the_floors_that_they_list():
    office = Building.load(MAPS / "two_floors.geojson")
    joined = [(c.kind, c.name, c.floors) for c in office.connections]
    assert joined == [("stairs", "Stairs", (0, 1)), ("lift", "Lift", (0, 1))]
    stairs, _ = office.connections
    assert shapely.bounds(stairs.polygon) == pytest.approx([12, 10.4, 15, 16.4], abs=0.002)
    assert stairs.distance(np.array([[13, 12], [13, 8.4], [18, 20.4]])) == pytest.approx([0, 2, 5], abs=0.002)


def test_stairs_without_labels_join_all_floors(tmp_path):
    path = written(
        tmp_path / "tower.geojson",
        *(feature("corridor", (0, 0, 9, 3), floor=str(n)) for n in range(4)),
        feature("lift", (0, 3, 2, 5), name="everywhere"),
        feature("stairs", (7, 3, 9, 6), floor=["2", "1"], name="cellar"),
        feature("stairs", (4, 3, 6, 6), floor="3", name="up to nothing"),
    )
    joined = {c.name: c.floors for c in Building.load(path).connections}
    assert joined == {"everywhere": (0, 1, 2, 3), "cellar": (1, 2)}


def test_a_floor_of_shops_is_walkable_beside_its_stairs(tmp_path):
    """An outline of 600 m² with shops of 200 and 100 m² and stairs, but without corridors."""
    outline, stairs = feature("floor", (0, 0, 30, 20)), feature("stairs", (26, 0, 30, 4))
    shops = [feature("shop", (0, 10, 20, 20), floor="1"), feature("shop", (20, 10, 30, 20), floor="2")]
    building = Building.load(written(tmp_path / "mall.geojson", outline, *shops, stairs))
    assert [floor.walkable_area for floor in building.floors] == pytest.approx([400, 500], rel=1e-3)
    assert not crosses(building.floors[0], (5, 5), (28, 2))
    assert crosses(building.floors[1], (5, 5), (25, 15))
    assert problems(building) == ()


def test_halls_joined_by_another_floor_are_connected(tmp_path):
    """Two separate halls above, each with stairs from one hall below."""
    halls = [feature("corridor", box, floor="2") for box in ((0, 0, 5, 3), (10, 0, 15, 3))]
    flights = [feature("stairs", box, floor=["1", "2"]) for box in ((0, 3, 2, 8), (13, 3, 15, 8))]
    below = feature("corridor", (0, 0, 15, 3), floor="1")
    joined = Building.load(written(tmp_path / "joined.geojson", below, *halls, *flights))
    assert {*joined.parts[0], *joined.parts[1]} == {0}
    assert problems(joined) == ()
    apart = Building.load(written(tmp_path / "apart.geojson", below, *halls, flights[0]))
    assert problems(apart) == ("floor 2: 1 cells that cannot be reached from the rest: corridor at (12.5, 1.5)",)
