"""Plans of several files: a folder or a zip with a file per floor becomes one building."""

import json
import zipfile

import numpy as np
import pytest
import shapely

from pdr_graph import InputError
from pdr_graph.floor.check import problems
from pdr_graph.floor.formats.several_files import MOST_FLOOR_FILES
from pdr_graph.floor.plan_files import Building, plan_fingerprint
from pdr_graph.frames import enu

FRAME = enu(48.0, 11.0)


def floor(path, stairs=(0, 6, 3, 10), frame=FRAME, **about):
    """A file with the hall of one floor, and stairs beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    features = []
    for kind, box in (("corridor", (0, 0, 20, 6)), ("stairs", stairs)):
        lonlat = shapely.transform(shapely.box(*box), frame.to_lonlat)
        geometry = json.loads(shapely.to_geojson(lonlat))
        features.append({"type": "Feature", "properties": {"kind": kind, "name": kind}, "geometry": geometry})
    path.write_text(json.dumps({"type": "FeatureCollection", "pdr_graph": about, "features": features}))
    return path


def microsoft(folder, lon=11.0, lat=48.0):
    """A floor of 40 m by 20 m with a shop, as the competition has it."""
    folder.mkdir(parents=True)
    boxes = [shapely.box(lon, lat, lon + 4e-4, lat + 2e-4), shapely.box(lon + 1e-4, lat, lon + 2e-4, lat + 1e-4)]
    features = [{"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(box))} for box in boxes]
    (folder / "geojson_map.json").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    (folder / "floor_info.json").write_text(json.dumps({"map_info": {"width": 29.8, "height": 22.3}}))


def packed(path, folder):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            archive.write(file, file.relative_to(folder.parent))
    return path


def refused(path, message):
    with pytest.raises(InputError, match=message) as refusal:
        Building.load(path)
    assert "\n" not in str(refusal.value)
    assert str(path) in str(refusal.value)


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


def test_the_label_in_a_file_comes_before_its_name(tmp_path):
    floor(tmp_path / "a.geojson", floor="1")
    floor(tmp_path / "b.geojson", floor="0")
    assert Building.load(tmp_path).labels == ("0", "1")


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


def test_heights_of_the_files_are_used_if_they_differ(tmp_path):
    floor(tmp_path / "a.geojson", floor="1", heights={"1": 5.5})
    floor(tmp_path / "b.geojson", floor="2", heights={"2": 1.0})
    building = Building.load(tmp_path)
    assert building.labels == ("2", "1")
    assert building.heights.tolist() == [1.0, 5.5]


def test_a_folder_of_microsoft_floors_is_a_building(tmp_path):
    for name in ("F2", "B1", "F1"):
        microsoft(tmp_path / "site" / name)
    (tmp_path / "site" / "F1" / "walk.txt").write_text("a recording")
    building = Building.load(tmp_path / "site")
    assert building.labels == ("B1", "F1", "F2")
    assert Building.load(tmp_path / "site" / "F1" / "floor_info.json").labels == ("F1",)
    assert Building.load(packed(tmp_path / "site.zip", tmp_path / "site")).labels == ("B1", "F1", "F2")
    assert Building.load(packed(tmp_path / "F1.zip", tmp_path / "site" / "F1")).labels == ("F1",)


def test_a_folder_of_one_plan_is_that_plan(tmp_path):
    """As ``simulate`` writes it: tables and a picture beside it are no floors."""
    floor(tmp_path / "walk" / "plan.geojson")
    (tmp_path / "walk" / "truth.csv").write_text("time,x,y\n")
    (tmp_path / "walk" / "plan.png").write_bytes(b"picture")
    assert Building.load(tmp_path / "walk").labels == ("",)


def test_a_zip_has_the_floors_of_its_folder(tmp_path):
    floor(tmp_path / "house" / "0.geojson")
    floor(tmp_path / "house" / "1.geojson")
    whole, same = Building.load(tmp_path / "house"), Building.load(packed(tmp_path / "h.zip", tmp_path / "house"))
    assert same.labels == whole.labels
    assert [c.floors for c in same.connections] == [(0, 1)]


def test_a_changed_floor_changes_the_fingerprint(tmp_path):
    floor(tmp_path / "house" / "0.geojson")
    upper = floor(tmp_path / "house" / "1.geojson")
    before = plan_fingerprint(tmp_path / "house")
    (tmp_path / "house" / "notes.txt").write_text("not a plan")
    assert plan_fingerprint(tmp_path / "house") == before
    floor(upper, stairs=(1, 6, 3, 10))
    assert plan_fingerprint(tmp_path / "house") != before


def test_two_files_of_one_label_are_refused(tmp_path):
    floor(tmp_path / "a.geojson", floor="1")
    floor(tmp_path / "b.geojson", floor="1")
    refused(tmp_path, r"floor '1' in a\.geojson and in b\.geojson")


def test_floors_of_two_places_are_refused(tmp_path):
    floor(tmp_path / "0.geojson")
    floor(tmp_path / "1.geojson", frame=enu(48.01, 11.0))
    refused(tmp_path, r"1\.geojson 11\d\d m beside 0\.geojson")


def test_a_folder_without_plans_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    refused(tmp_path, "a folder without geojson_map.json or any plan")


def test_a_broken_file_is_named(tmp_path):
    floor(tmp_path / "0.geojson")
    (tmp_path / "1.geojson").write_text("{")
    refused(tmp_path, r"1\.geojson: found no JSON")


def test_too_many_files_are_refused(tmp_path):
    for n in range(MOST_FLOOR_FILES + 1):
        (tmp_path / f"{n}.geojson").write_text("")
    refused(tmp_path, f"more than {MOST_FLOOR_FILES} plans")


def archive(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


@pytest.mark.parametrize("name", ["../1.geojson", "/tmp/1.geojson", "a/../../1.geojson", "C:\\1.geojson"])
def test_members_that_lead_elsewhere_are_refused(tmp_path, name):
    refused(archive(tmp_path / "house.zip", {"0.geojson": "{}", name: "{}"}), "leads elsewhere")


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path):
    bomb = archive(tmp_path / "house.zip", {"0.geojson": bytes(250_000_000)})
    assert bomb.stat().st_size < 300_000
    refused(bomb, "more than 200 MB of files")


def test_an_archive_in_an_archive_is_not_opened(tmp_path):
    inner = archive(tmp_path / "inner.zip", {"0.geojson": "{}"})
    refused(archive(tmp_path / "house.zip", {"inner.zip": inner.read_bytes()}), "a folder without")


def test_a_folder_and_a_file_of_one_name_are_refused(tmp_path):
    refused(archive(tmp_path / "house.zip", {"a": "1", "a/b": "2", "c": "3"}), "member names that no folder can hold")


def test_very_long_names_are_refused(tmp_path):
    refused(archive(tmp_path / "house.zip", {f"{'a' * 300}.geojson": "1", "b": ""}), "member names that no folder")


def test_deeply_nested_json_is_refused(tmp_path):
    (tmp_path / "deep.geojson").write_text("[" * 200_000)
    refused(tmp_path / "deep.geojson", "no JSON")
    nested = '{"type": "FeatureCollection", "features": [{"geometry": ' + "[" * 900 + "]" * 900 + "}]}"
    (tmp_path / "deep.geojson").write_text(nested)
    refused(tmp_path / "deep.geojson", "a GeoJSON geometry")


def test_a_million_features_are_refused(tmp_path):
    point = '{"type":"Feature","properties":{"kind":"beacon"},"geometry":{"type":"Point","coordinates":[11,48]}}'
    path = tmp_path / "many.geojson"
    path.write_text('{"type":"FeatureCollection","features":[' + ",".join([point] * 1_000_000) + "]}")
    refused(path, "1000000 features, expected at most")
