"""Plans in any format become our GeoJSON, in longitude and latitude or in metres along the drawing's own axes."""

import json
import shutil

import commands
import drawn_plans as drawn
import numpy as np
import pytest
import shapely
from plans import MAPS

from pdr_graph import InputError
from pdr_graph.floor.formats.conversion import TiePoints, convert, scale_of_two_points
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import Frame, enu


@pytest.fixture
def lines(tmp_path):
    """The building in units of 0.5 m."""
    path = tmp_path / "lines.csv"
    path.write_text(drawn.csv(drawn.segments(drawn.walls()), 0.5))
    return path


def run(*arguments):
    return commands.run("map", *arguments)


def place_of(x, y, turn=0.3, lat=49.45, lon=11.08):
    """Latitude and longitude of a point of the building [m], which is turned [rad]."""
    position = np.array([[np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y]])
    lon, lat = enu(lat, lon).to_lonlat(position)[0]
    return f"{lat:.9f},{lon:.9f}"


def tie_points(*corners, unit=0.5, mirrored=False):
    order = -1 if mirrored else 1
    return " ".join("{},{}=".format(*(x / unit, y / unit)[::order]) + place_of(x, y) for x, y in corners)


TWO, THREE = ((0, 0), (36, 0)), ((0, 0), (36, 0), (36, 14.4))


def test_a_plan_without_georeference_is_written_and_read_in_metres(lines, tmp_path):
    convert(lines, tmp_path / "plan.geojson", scale=0.5, floor="EG")
    (plan,) = Building.load(tmp_path / "plan.geojson").floors
    assert plan.frame == Frame()
    assert plan.label == "EG"
    assert drawn.agreement(plan.walkable) > 0.98
    assert json.loads((tmp_path / "plan.geojson").read_text())["pdr_graph"] == {"frame": "local", "floor": "EG"}


@pytest.mark.parametrize("name", ["two_floors", "mall", "office"])
def test_a_converted_plan_is_the_same_plan(tmp_path, name):
    convert(MAPS / f"{name}.geojson", tmp_path / "again.geojson")
    before, after = Building.load(MAPS / f"{name}.geojson"), Building.load(tmp_path / "again.geojson")
    assert after.labels == before.labels
    assert [c.floors for c in after.connections] == [c.floors for c in before.connections]
    for one, other in zip(before.floors, after.floors, strict=True):
        apart = shapely.area(shapely.symmetric_difference(one.walkable, other.walkable))
        assert apart < 0.005 * one.walkable_area
        assert [(a.kind, a.name) for a in one.areas] == [(a.kind, a.name) for a in other.areas]


def test_two_points_georeference_and_scale_a_drawing(lines, tmp_path):
    convert(lines, tmp_path / "plan.geojson", georeference=tie_points((0, 0), (36, 14.4)))
    plan = Building.load(tmp_path / "plan.geojson").floors[0]
    door = drawn.openings()[3].centroid
    lat, lon = (float(v) for v in place_of(door.x, door.y).split(","))
    assert shapely.contains(plan.walkable, shapely.Point(plan.frame.from_lonlat(np.array([[lon, lat]]))[0]))
    assert plan.walkable_area == pytest.approx(shapely.area(drawn.free()), rel=0.02)


def test_more_points_are_fitted_and_their_residual_is_noted(lines, tmp_path):
    drawing = convert(lines, tmp_path / "a.geojson", 0.5, georeference=tie_points(*THREE))
    assert "georeferenced by 3 points: turned by 17.2°, residual 0.00 m" in drawing.notes


@pytest.mark.parametrize(
    ("source", "arguments", "message"),
    [
        (None, {"scale": 0.6, "georeference": tie_points(*TWO)}, "43.2 m apart in the plan and 36.0 m on Earth"),
        (None, {"scale": 0.5, "georeference": tie_points(*THREE, (0, 14.4), mirrored=True)}, "mirrored"),
        (None, {"scale": 0.5, "two_points": "0,0 1,1 = 2"}, "one of both"),
        ("arcade", {"georeference": tie_points(*TWO)}, "georeferenced by its format"),
        ("two_floors", {"floor": "1"}, "a plan of one floor"),
    ],
    ids=["points against the scale", "mirrored points", "two scales", "two georeferences", "a label for two floors"],
)
def test_contradictory_options_are_refused_and_leave_no_file(lines, tmp_path, source, arguments, message):
    with pytest.raises(InputError, match=message):
        convert(MAPS / f"{source}.geojson" if source else lines, tmp_path / "a.geojson", **arguments)
    assert not (tmp_path / "a.geojson").exists()


@pytest.mark.parametrize("text", ["", "0,0=1,2", "0,0=1,2 0,0=1,2", "0,0=91,0 1,1=2,2", "0,0 1,1", "a,b=1,2 3,4=5,6"])
def test_points_that_georeference_nothing_are_refused(text):
    with pytest.raises(InputError, match="--georeference"):
        TiePoints.parse(text)


def test_a_distance_of_two_points_is_a_scale():
    assert scale_of_two_points("100,100 600,100 = 10") == pytest.approx(0.02)
    assert scale_of_two_points("-1.5,0 -1.5,4=2 m") == pytest.approx(0.5)
    for text in ("", "0,0 0,0 = 3", "0,0 1,1", "0,0 1,1 = -2"):
        with pytest.raises(InputError, match="--two-points"):
            scale_of_two_points(text)


def test_the_command_writes_plan_and_picture_and_checks(lines, tmp_path):
    done = run("convert", lines, "--out", tmp_path / "plan.geojson", "--two-points", "0,0 72,0 = 36")
    assert done.code == 0, done.output
    assert "metres along the drawing's own axes" in done.output
    assert "no problems found" in done.output
    assert (tmp_path / "plan.png").stat().st_size > 5000
    assert run("show", lines, "--scale", "0.5", "--out", tmp_path / "b.png").code == 0
    assert "\\b" not in run("convert", "--help").output, "no escapes"


def test_the_command_ends_with_3_if_a_room_is_sealed(tmp_path):
    outside, inside = shapely.box(0, 0, 20, 10), shapely.box(5, 2, 10, 8)
    (tmp_path / "a.csv").write_text(drawn.csv(drawn.segments(shapely.multipolygons([outside, inside]))))
    done = run("convert", tmp_path / "a.csv", "--out", tmp_path / "plan.geojson", "--scale", "1")
    assert done.code == 3
    assert "1 cells that cannot be reached from the rest: room at (7.5, 5.0)" in done.output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "--out: found arcade.geojson, which is the input, expected another file"),
        (("--out", "arcade.geojson"), "--out: found arcade.geojson, which is the input, expected another file"),
        (("--out", "."), "--out: found ., which is a folder, expected a file to write"),
    ],
)
def test_neither_the_input_nor_a_folder_is_written_over(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    shutil.copy(MAPS / "arcade.geojson", tmp_path)
    assert run("convert", "arcade.geojson", *options).errors == [f"pdr-graph: {message}"]
    assert (tmp_path / "arcade.geojson").read_bytes() == (MAPS / "arcade.geojson").read_bytes()


def test_a_picture_is_not_drawn_over(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drawn.picture(0.1, texts=False).convert("RGBA").save(tmp_path / "scan.png")
    before = (tmp_path / "scan.png").read_bytes()
    assert run("convert", "scan.png", "--scale", 0.1).code == 0
    assert (tmp_path / "scan.png").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"scan.png", "scan.geojson", "scan-plan.png"}


def test_a_refused_plan_leaves_no_file(tmp_path):
    """A room all of wall: its GeoJSON is valid, but nobody can walk in it."""
    box = shapely.geometry.mapping(shapely.box(0, 0, 20, 10))
    features = [{"type": "Feature", "properties": {"kind": k}, "geometry": box} for k in ("floor", "wall")]
    solid = {"type": "FeatureCollection", "pdr_graph": {"frame": "local"}, "features": features}
    (tmp_path / "solid.geojson").write_text(json.dumps(solid))
    done = run("convert", tmp_path / "solid.geojson", "--out", tmp_path / "plan.geojson")
    assert (done.code, len(done.errors)) == (2, 1)
    assert "no walkable area" in done.errors[0]
    assert [path.name for path in tmp_path.iterdir()] == ["solid.geojson"]


def test_a_name_that_is_no_text_is_written_and_read_again(tmp_path):
    """JSON can have half of a surrogate pair, which UTF-8 cannot."""
    plan = json.loads((MAPS / "arcade.geojson").read_text())
    plan["features"][1]["properties"]["name"] = "caf\ud83d"
    (tmp_path / "a.geojson").write_text(json.dumps(plan))
    convert(tmp_path / "a.geojson", tmp_path / "b.geojson")
    assert "caf\ud83d" in {area.name for area in Building.load(tmp_path / "b.geojson").floors[0].areas}
