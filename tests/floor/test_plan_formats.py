"""What holds for plans of every format: they are read in any order of their features, and damage is one line."""

import json
import re
import zipfile
from pathlib import Path

import pytest
import shapely
from mutations import PLAN_SCALES, inputs
from refusals import refused

from pdr_graph.floor.plan_files import Building, plan_fingerprint

MICROSOFT = {
    "geojson_map.json": json.dumps(
        {
            "type": "FeatureCollection",
            "features": [
                {"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(shapely.box(*box)))}
                for box in ((11.0, 48.0, 11.0004, 48.0002), (11.0001, 48.0, 11.0002, 48.0001))
            ],
        }
    ),
    "floor_info.json": '{"map_info": {"width": 29.8, "height": 22.3}}',
}
FORMATS = inputs()[2] | {"microsoft": ("F1.zip", MICROSOFT)}
JSON = [name for name in FORMATS if FORMATS[name][0].endswith((".geojson", ".zip"))]


def written(folder, name, whole=None):
    """The input of a format in a folder, or another content in its place."""
    file, content = FORMATS[name]
    content = content if whole is None else whole
    if isinstance(content, bytes):
        (folder / file).write_bytes(content)
        return folder / file
    with zipfile.ZipFile(folder / file, "w") as archive:
        for member, text in content.items():
            archive.writestr(member, text)
    return folder / file


def load(path, name):
    return Building.load(path, PLAN_SCALES.get(name))


def changed(name, change):
    """The content of a JSON format, each file of features changed."""
    content = FORMATS[name][1]
    if isinstance(content, bytes):
        return change(content.decode()).encode()
    return {member: change(text) if '"features"' in text else text for member, text in content.items()}


@pytest.mark.parametrize("name", [name for name in JSON if name != "microsoft"])
def test_the_order_of_features_does_not_matter(tmp_path, name):
    """But for Microsoft's, of which the first is the outline."""

    def backwards(text):
        plan = json.loads(text)
        return json.dumps(plan | {"features": plan["features"][::-1]})

    whole = load(written(tmp_path, name), name)
    again = load(written(tmp_path, name, changed(name, backwards)), name)
    assert again.labels == whole.labels
    for one, other in zip(whole.floors, again.floors, strict=True):
        placed = shapely.transform(other.walkable, lambda p: one.frame.from_frame(other.frame, p))  # noqa: B023
        assert shapely.area(shapely.symmetric_difference(one.walkable, placed)) < 0.1


@pytest.mark.parametrize("name", [*JSON, "osm indoor xml"])
def test_a_plan_is_read_and_its_beginning_alone_is_refused(tmp_path, name):
    path = written(tmp_path, name)
    assert all(floor.walkable_area > 1 for floor in load(path, name).floors)
    whole = path.read_bytes()
    for share in (0.0, 0.02, 0.3, 0.6, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        refused(load, path, "found|expected", name)


@pytest.mark.parametrize("name", JSON)
def test_a_coordinate_that_is_not_a_number_is_refused(tmp_path, name):
    whole = changed(name, lambda text: re.sub(r"(\[\[?\[?)\d+\.\d+", r"\1NaN", text, count=1))
    assert whole != FORMATS[name][1]
    refused(load, written(tmp_path, name, whole), "expected", name)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"type": "FeatureCollection", "features": []}', "[1, 2", "\x00"])
def test_a_file_without_a_plan_is_refused(tmp_path, text):
    for name in ("plan.geojson", "geojson_map.json", "mall.osm", "lines.csv", "plan.dxf", "plan.pdf", "scan.png"):
        (tmp_path / name).write_text(text)
        refused(Building.load, tmp_path / name, "found|expected")


@pytest.mark.parametrize("name", ["imdf archive", "a file per floor", "microsoft"])
def test_a_changed_file_changes_the_fingerprint_and_others_do_not(tmp_path, name):
    for member, text in FORMATS[name][1].items():
        (tmp_path / Path(member).name).write_text(text)
    before = plan_fingerprint(tmp_path)
    (tmp_path / "notes.txt").write_text("not a plan")
    assert plan_fingerprint(tmp_path) == before
    if name == "imdf archive":
        assert plan_fingerprint(tmp_path / "level.geojson") == before, "one of its files stands for the archive"
    changed_file = next(path for path in sorted(tmp_path.iterdir()) if '"features"' in path.read_text())
    changed_file.write_text('{"type": "FeatureCollection", "features": []}')
    assert plan_fingerprint(tmp_path) != before
