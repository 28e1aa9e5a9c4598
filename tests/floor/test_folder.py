"""Plans of several files: a folder or a zip with a file per floor becomes one building."""

import json
import zipfile

import numpy as np
import pytest
import shapely
from floor.geojson_plans import HERE, feature, written
from refusals import refused

from pdr_graph.floor.check import problems
from pdr_graph.floor.formats.several_files import MOST_FLOOR_FILES
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu


def floor(path, stairs=(0, 6, 3, 10), frame=HERE, **about):
    """A file with the hall of one floor, and stairs beside it."""
    boxes = (("corridor", (0, 0, 20, 6)), ("stairs", stairs))
    return written(path, *(feature(kind, box, frame, name=kind) for kind, box in boxes), **about)


def microsoft(folder, lon=11.0, lat=48.0):
    """A floor of 40 m by 20 m with a shop, as the competition has it."""
    folder.mkdir(parents=True)
    boxes = [shapely.box(lon, lat, lon + 4e-4, lat + 2e-4), shapely.box(lon + 1e-4, lat, lon + 2e-4, lat + 1e-4)]
    features = [{"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(box))} for box in boxes]
    (folder / "geojson_map.json").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    (folder / "floor_info.json").write_text(json.dumps({"map_info": {"width": 29.8, "height": 22.3}}))


def packed(path, folder):
    return archive(path, {str(p.relative_to(folder.parent)): p.read_bytes() for p in folder.rglob("*") if p.is_file()})


def archive(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ("names", "labels"),
    [
        (("EG", "1", "2"), ("EG", "1", "2")),
        (("plan_EG", "plan_1"), ("EG", "1")),
        (("town hall - floor -1", "town hall - floor 0"), ("-1", "0")),
        (("floor1", "floor10", "floor2"), ("1", "2", "10")),
        (("B1", "F1"), ("B1", "F1")),
        (("4OG", "5OG"), ("4OG", "5OG")),
    ],
)
def test_a_file_is_a_floor_with_its_name_as_label(tmp_path, names, labels):
    for name in names:
        floor(tmp_path / "house" / f"{name}.geojson")
    building = Building.load(tmp_path / "house")
    assert building.labels == labels
    assert building.heights == pytest.approx(3.8 * np.arange(len(labels)))


def test_the_label_and_the_height_in_a_file_come_before_its_name(tmp_path):
    floor(tmp_path / "a.geojson", floor="1", heights={"1": 5.5})
    floor(tmp_path / "b.geojson", floor="2", heights={"2": 1.0})
    building = Building.load(tmp_path)
    assert building.labels == ("2", "1")
    assert building.heights.tolist() == [1.0, 5.5]


def test_stairs_over_each_other_join_the_files(tmp_path):
    """The upper flight is drawn 1 m shorter and shifted; that of the top floor is elsewhere."""
    floor(tmp_path / "0.geojson")
    floor(tmp_path / "1.geojson", stairs=(0.3, 6, 3.2, 9))
    floor(tmp_path / "2.geojson", stairs=(15, 6, 18, 10))
    building = Building.load(tmp_path)
    [stairs] = building.connections
    assert stairs.floors == (0, 1)
    assert shapely.bounds(stairs.polygon)[2] - shapely.bounds(stairs.polygon)[0] == pytest.approx(3.2, abs=0.01)
    assert building.parts[0][0] == building.parts[1][0] != building.parts[2][0]
    assert [p.split(":")[0] for p in problems(building)] == ["floor 2", "floor 2"]
    assert "stairs or lifts that join no other floor" in problems(building)[1]


def test_files_with_other_origins_lie_over_each_other(tmp_path):
    """The frame is that of the first; each file states the same place in degrees, about an origin of its own."""
    floor(tmp_path / "0.geojson", origin=[11.0, 48.0])
    floor(tmp_path / "1.geojson", origin=[11.001, 48.001])
    building = Building.load(tmp_path)
    assert len({area.frame for area in building.floors}) == 1
    assert [c.floors for c in building.connections] == [(0, 1)]
    assert building["1"].corners == pytest.approx(building["0"].corners, abs=1e-3)


def test_a_folder_or_a_zip_of_microsoft_floors_is_a_building(tmp_path):
    for name in ("F2", "B1", "F1"):
        microsoft(tmp_path / "site" / name)
    (tmp_path / "site" / "F1" / "walk.txt").write_text("a recording")
    assert Building.load(tmp_path / "site").labels == ("B1", "F1", "F2")
    assert Building.load(tmp_path / "site" / "F1" / "floor_info.json").labels == ("F1",)
    assert Building.load(packed(tmp_path / "site.zip", tmp_path / "site")).labels == ("B1", "F1", "F2")
    assert Building.load(packed(tmp_path / "F1.zip", tmp_path / "site" / "F1")).labels == ("F1",)


def test_a_folder_of_one_plan_is_that_plan(tmp_path):
    """As ``simulate`` writes it: tables and a picture beside it are no floors."""
    floor(tmp_path / "walk" / "plan.geojson")
    (tmp_path / "walk" / "truth.csv").write_text("time,x,y\n")
    (tmp_path / "walk" / "plan.png").write_bytes(b"picture")
    assert Building.load(tmp_path / "walk").labels == ("",)


def test_floors_that_are_no_building_together_are_refused(tmp_path):
    floor(tmp_path / "twice" / "a.geojson", floor="1")
    floor(tmp_path / "twice" / "b.geojson", floor="1")
    refused(Building.load, tmp_path / "twice", r"floor '1' in a\.geojson and in b\.geojson")
    floor(tmp_path / "places" / "0.geojson")
    floor(tmp_path / "places" / "1.geojson", frame=enu(48.01, 11.0))
    refused(Building.load, tmp_path / "places", r"1\.geojson 11\d\d m beside 0\.geojson")
    floor(tmp_path / "broken" / "0.geojson")
    (tmp_path / "broken" / "1.geojson").write_text("{")
    refused(Building.load, tmp_path / "broken", r"1\.geojson: found no JSON")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"notes.txt": "nothing"}, "a folder without geojson_map.json or any plan"),
        ({f"{n}.geojson": "" for n in range(MOST_FLOOR_FILES + 1)}, f"more than {MOST_FLOOR_FILES} plans"),
    ],
    ids=["no plan", "too many"],
)
def test_folders_that_are_no_building_are_refused(tmp_path, files, message):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    refused(Building.load, tmp_path, message)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"../1.geojson": "{}"}, "leads elsewhere"),
        ({"/tmp/1.geojson": "{}"}, "leads elsewhere"),
        ({"a/../../1.geojson": "{}"}, "leads elsewhere"),
        ({"C:\\1.geojson": "{}"}, "leads elsewhere"),
        ({"1.geojson": bytes(250_000_000)}, "more than 200 MB of files"),
        ({"a": "1", "a/b": "2"}, "member names that no folder can hold"),
        ({f"{'a' * 300}.geojson": "1"}, "member names that no folder"),
        ({"level.geojson": "{}", "unit.geojson": "{"}, r"house\.zip/level\.geojson: found type"),
    ],
    ids=["up", "absolute", "up again", "a drive", "a bomb", "a file as folder", "a long name", "named with the zip"],
)
def test_hostile_archives_are_refused(tmp_path, members, message):
    path = archive(tmp_path / "house.zip", {"0.geojson": "{}"} | members)
    assert path.stat().st_size < 300_000
    assert refused(Building.load, path, message).startswith(str(path)), "and not a temporary folder"


def test_an_archive_in_an_archive_is_not_opened(tmp_path):
    inner = archive(tmp_path / "inner.zip", {"0.geojson": "{}"})
    refused(Building.load, archive(tmp_path / "house.zip", {"inner.zip": inner.read_bytes()}), "a folder without")


def test_deeply_nested_json_is_refused(tmp_path):
    path = tmp_path / "deep.geojson"
    path.write_text("[" * 200_000)
    refused(Building.load, path, "no JSON")
    geometry = "[" * 900 + "]" * 900
    path.write_text('{"type": "FeatureCollection", "features": [{"geometry": ' + geometry + "}]}")
    refused(Building.load, path, "a GeoJSON geometry")
