"""Plans by others: an IMDF archive and OpenStreetMap's indoor tags are read as drawn, and walks on them are found."""

import json

import commands
import numpy as np
import pytest
import shapely

from pdr_graph import evaluate, read_trajectory
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building

IN_CPC4 = """seed = 3
plan = "PLAN"
floor = "G"
route = [[0, -11], {stand = 2}, {to = [[0, 0], [-0.3, 12], [-15, 20]]}, {stand = 5},
    {to = [[-0.3, 12], [0, -4], [7, -7], [15, -5]]}, {stand = 2}]
[fixes]
period = 15
sigma = 0.5
"""
IN_CASERNE = """seed = 5
plan = "PLAN"
floor = "0"
route = [[-86, -45], {stand = 2}, {to = [[-70, -35], [-45, -24], [-31, -15], [-29.8, -8]]},
    {stairs = "1", to = [[-30.4, -6.8], [-31.5, -3.2], [-35.2, -4.1], [-34.4, -8.4]]},
    {to = [[-34.2, -10.2], [-33, -12.5], [-24, -7.5], [-22, -6]]}, {stand = 3}]
[fixes]
period = 20
sigma = 1.5
"""


def smoothed(folder, plan, scenario):
    """The summary of a simulated walk, and its score."""
    (folder / "walk.toml").write_text(scenario.replace("PLAN", str(plan)))
    for command in (
        ["simulate", folder / "walk.toml", "--out", folder / "walk"],
        ["smooth", folder / "walk", "--map", plan, "--fixes", folder / "walk" / "fixes.csv", "--out", folder / "out"],
    ):
        run = commands.run(*command)
        assert run.code == 0, run.output
    scores = evaluate(
        read_trajectory(folder / "out" / "trajectory.csv"), read_trajectory(folder / "walk" / "truth.csv")
    )
    return json.loads((folder / "out" / "summary.json").read_text()), scores["ce"]


def test_an_imdf_archive_of_offices(data):
    """Two levels, each unit an office; the archive has openings on the ground floor alone, and no stairs."""
    building = Building.load(data / "plans" / "imdf_cpc4")
    assert building.labels == ("G", "1")
    ground, upper = building.floors
    assert (len(ground.of_kind("room")), len(upper.of_kind("room"))) == (20, 13)
    assert ground.walkable_area == pytest.approx(2038, rel=0.02), "of the units, and the cracks between them"
    assert sum(bool(door.properties.get("entrance")) for door in ground.of_kind("door")) == 2
    doors = [door for door in ground.of_kind("door") if "category" in door.properties]
    assert len(doors) == 16
    assert len(set(building.parts[0])) == 1, "each room can be reached"
    assert problems(building) == (
        "floor 1: 13 rooms and no door: the rooms are open to all that they touch",
        "floor 1: no stairs or lift from the rest of the building",
    )


@pytest.mark.thorough
def test_a_walk_in_the_offices(data, tmp_path):
    summary, error = smoothed(tmp_path, data / "plans" / "imdf_cpc4", IN_CPC4)
    assert summary["verdict"]["state"] == "ok"
    assert summary["wall_crossings"] <= 1
    assert error["p50"] < 1.0, "twice the sigma of a fix"
    assert error["max"] < 2.5, "five times it"


def test_the_xml_and_the_geojson_of_a_mall_are_the_same_building(data):
    """But for a shop, which is on levels 0 and 2 in the one and 0 and 1 in the other."""
    xml, other = (Building.load(data / "plans" / "osm_caserne" / f"caserne.{ending}") for ending in ("osm", "geojson"))
    assert xml.labels == ("-1", "0", "1", "2")
    assert other.labels == ("-1", "0", "1")
    assert {(c.kind, c.floors) for c in xml.connections} == {(c.kind, c.floors) for c in other.connections}
    assert len(xml.connections) == 6
    for label in other.labels:
        areas = [{(a.kind, a.name, a.floors) for a in b[label].areas if a.name != "H&M"} for b in (xml, other)]
        assert areas[0] == areas[1]
    first, second = (b["0"] for b in (xml, other))
    same = shapely.transform(second.walkable, lambda p: first.frame.from_frame(second.frame, p))
    assert shapely.area(shapely.symmetric_difference(same, first.walkable)) < 1.0


def test_shops_of_the_mall_open_to_its_corridor_and_not_to_each_other(data):
    ground = Building.load(data / "plans" / "osm_caserne" / "caserne.osm")["0"]
    shop, beside, in_front = np.array([[[-63.0, -20.0]], [[-55.0, -16.0]], [[-60.0, -29.0]]])
    assert (ground.cells.at(np.concatenate([shop, beside])) >= 0).all()
    assert ground.crosses_wall(shop, beside)[0]
    assert not ground.crosses_wall(shop, in_front)[0]


@pytest.mark.thorough
def test_a_walk_up_the_stairs_of_the_mall(data, tmp_path):
    summary, error = smoothed(tmp_path, data / "plans" / "osm_caserne" / "caserne.osm", IN_CASERNE)
    assert summary["verdict"]["state"] == "ok"
    assert summary["floors"] == ["0", "1"]
    assert summary["climbs"][0]["kind"] == "stairs"
    assert error["p50"] < 1.5


def test_floors_of_a_site_are_a_building(data):
    building = Building.load(data / "ms_indoor20" / "site1")
    assert building.labels == ("B1", "F1", "F2")
    alone = Building.load(data / "ms_indoor20" / "site1" / "F2").floors[0]
    corners = building["F2"].frame.to_lonlat(building["F2"].corners)
    assert corners == pytest.approx(alone.frame.to_lonlat(alone.corners), abs=1e-9)
    middle = building.corners.mean(axis=0)
    assert [bool(floor.near(middle[None])[0]) for floor in building.floors] == [True] * 3
