"""IMDF archives: units, openings and levels become rooms, doors and floors; buildings of a venue share floors."""

import json
import shutil

import numpy as np
import pytest
import shapely
from refusals import refused

from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu

FRAME = enu(52.0, 0.2)


def record(kind, shape=None, **properties):
    """A feature of one type; shape: in metres."""
    geometry = None if shape is None else json.loads(shapely.to_geojson(shapely.transform(shape, FRAME.to_lonlat)))
    about = {"id": properties.pop("id", f"{kind}-{id(properties)}"), "feature_type": kind}
    return {"type": "Feature", **about, "properties": properties, "geometry": geometry}


def level(identifier, ordinal, name, box=(0, 0, 20, 10), building="b1", **more):
    named = {"short_name": {"en": name}, "name": {"en": f"Level {name}"}}
    return record("level", shapely.box(*box), id=identifier, ordinal=ordinal, building_ids=[building], **named, **more)


def unit(on, box, category="office", name=None, **more):
    return record("unit", shapely.box(*box), level_id=on, category=category, name=name and {"en": name}, **more)


def opening(on, *ends):
    return record("opening", shapely.LineString(ends), level_id=on, category="pedestrian")


def house():
    """Two levels: a hall with two offices, stairs and a lift on both."""
    features = {"level": [level("g", 0, "G"), level("one", 1, "1")], "unit": [], "opening": []}
    for on in ("g", "one"):
        features["unit"] += [
            unit(on, (0, 4, 20, 6), "walkway"),
            unit(on, (0, 0, 10, 4), name="East"),
            unit(on, (10, 0, 20, 4), "conferenceroom", name="West"),
            unit(on, (0, 6, 4, 10), "stairs"),
            unit(on, (4, 6, 6, 8), "elevator"),
            unit(on, (6, 6, 20, 10), "structure"),
            unit(on, (4, 8, 6, 10), "opentobelow"),
        ]
        features["opening"] += [
            opening(on, (4, 4), (5, 4)),
            opening(on, (14, 4), (15, 4)),
            opening(on, (4.5, 6), (5.5, 6)),
        ]
    features["opening"].append(opening("g", (0, 4.5), (0, 5.5)))
    return features


def written(folder, features):
    folder.mkdir(exist_ok=True)
    (folder / "manifest.json").write_text(json.dumps({"version": "1.0.0", "language": "en"}))
    for kind, of_kind in features.items():
        collection = {"type": "FeatureCollection", "name": kind, "features": of_kind}
        (folder / f"{kind}.geojson").write_text(json.dumps(collection))
    return folder


def loaded(tmp_path, features):
    return Building.load(written(tmp_path / "archive", features))


def crosses(floor, *ends):
    """True if there is a wall between two positions; the frame begins in the middle of the archive [m]."""
    start, end = (np.array([place], float) - (10, 5) for place in ends)
    return bool(floor.crosses_wall(start, end)[0])


def kinds(floor):
    return sorted((area.kind, area.name) for area in floor.areas if area.name)


def test_units_openings_and_levels_become_rooms_doors_and_floors(tmp_path):
    building = loaded(tmp_path, house())
    assert building.labels == ("G", "1")
    assert building.heights.tolist() == [0.0, 3.8]
    ground = building["G"]
    assert kinds(ground) == [("floor", "Level G"), ("room", "East"), ("room", "West")]
    assert ground.walkable_area == pytest.approx(2 * 20 + 2 * 40 + 16 + 4, rel=0.01)
    assert [(c.kind, c.floors) for c in building.connections] == [("stairs", (0, 1)), ("lift", (0, 1))]
    assert problems(building) == ()
    assert not crosses(ground, (4.5, 5), (4.5, 3)), "through an opening"
    assert crosses(ground, (8, 5), (8, 3))


def test_a_unit_without_an_opening_is_open_along_the_corridor(tmp_path):
    features = house()
    del features["opening"][0]
    ground = loaded(tmp_path, features)["G"]
    assert not crosses(ground, (5, 5), (5, 3))
    assert crosses(ground, (9, 2), (11, 2)), "the wall to its neighbour"
    assert any("1 room without a door" in note for note in ground.notes)


def test_a_zip_and_the_name_of_one_file_stand_for_the_archive(tmp_path):
    folder = written(tmp_path / "archive", house())
    shutil.make_archive(str(tmp_path / "packed"), "zip", tmp_path, "archive")
    shutil.make_archive(str(tmp_path / "flat"), "zip", folder)
    whole = Building.load(folder)
    for path in (tmp_path / "packed.zip", tmp_path / "flat.zip", folder / "unit.geojson", folder / "manifest.json"):
        same = Building.load(path)
        assert same.labels == whole.labels
        assert all(shapely.equals(a.walkable, b.walkable) for a, b in zip(same.floors, whole.floors, strict=True))


def test_the_ordinal_is_the_order_and_the_short_name_the_label(tmp_path):
    features = house()
    features["level"] = [level("one", 2, "A"), level("g", -1, "Z")]
    building = loaded(tmp_path, features)
    assert building.labels == ("Z", "A")
    assert building.heights == pytest.approx([0, 3 * 3.8])
    features["level"] = [level("g", 0, "L"), level("one", 1, "L")]
    assert loaded(tmp_path, features).labels == ("L (0)", "L (1)"), "labels are unique"


def test_buildings_of_a_venue_share_the_floors_of_equal_ordinals(tmp_path):
    """The other building calls its ground floor 1, and stands 10 m away."""
    features = house()
    features["level"] += [
        level("h1", 0, "1", (30, 0, 40, 10), "b2"),
        level("h2", 1, "2", (30, 0, 40, 10), "b2"),
    ]
    features["unit"] += [unit("h1", (30, 0, 40, 10), name="Hut"), unit("h2", (30, 0, 40, 10), name="Loft")]
    building = loaded(tmp_path, features)
    assert building.labels == ("1/G", "1/2")
    assert ("room", "Hut") in kinds(building["1/G"])
    assert "2 buildings: their levels of one ordinal are one floor" in building.floors[0].notes


def test_what_a_level_has_outside_all_units_is_a_corridor(tmp_path):
    """Rooms alone are drawn; walls of 0.2 m between them are no corridor."""
    features = house()
    features["unit"] = [u for u in features["unit"] if u["properties"]["category"] != "walkway"]
    features["unit"][0] = unit("g", (0, 0, 9.8, 4), name="East")
    building = loaded(tmp_path, features)
    [corridor] = building["G"].of_kind("corridor")
    assert shapely.area(corridor.shape) == pytest.approx(40, rel=0.05)
    assert problems(building) == ()


def test_amenities_make_stairs_of_units_without_the_category(tmp_path):
    features = house()
    for n, feature in enumerate(features["unit"]):
        if feature["properties"]["category"] == "stairs":
            feature["properties"]["category"] = "unspecified"
            feature["id"] = f"flight-{n}"
            point = shapely.Point(2, 8)
            amenity = record("amenity", point, category="stairs", unit_ids=[feature["id"]])
            features.setdefault("amenity", []).append(amenity)
    assert [c.kind for c in loaded(tmp_path, features).connections] == ["stairs", "lift"]


@pytest.mark.parametrize("category", ["ramp", "steps"])
def test_a_slope_joins_levels_only_if_both_have_it(tmp_path, category):
    features = house()
    slopes = [f for f in features["unit"] if f["properties"]["category"] == "stairs"]
    for feature in slopes:
        feature["properties"]["category"] = category
    assert [c.kind for c in loaded(tmp_path, features).connections] == ["stairs", "lift"]
    slopes[1]["properties"]["category"] = "storage"
    building = loaded(tmp_path, features)
    assert [c.kind for c in building.connections] == ["lift"]
    assert len(building["G"].of_kind("corridor")) == 2


def test_kiosks_and_fixtures_are_solid_and_occupants_name_units(tmp_path):
    features = house()
    features["kiosk"] = [record("kiosk", shapely.box(8, 4, 9, 5), level_id="g", name={"en": "Flowers"})]
    features["fixture"] = [record("fixture", shapely.box(12, 4, 12.5, 6), level_id="g", category="desk")]
    features["unit"][1] |= {"id": "u1"}
    features["unit"][1]["properties"]["name"] = None
    features["anchor"] = [record("anchor", shapely.Point(5, 2), id="a1", unit_id="u1")]
    features["occupant"] = [record("occupant", anchor_id="a1", name={"en": "Bakery"})]
    ground = loaded(tmp_path, features)["G"]
    assert {("shop", "Flowers"), ("room", "Bakery")} <= set(kinds(ground))
    assert ground.walkable_area == pytest.approx(140 - 1 - 1, rel=0.01)


def test_features_that_lead_nowhere_are_left_out_and_noted(tmp_path):
    features = house()
    for feature in features["unit"]:
        if feature["properties"]["category"] == "structure":
            feature["properties"]["category"] = "nonpublic"
    features["opening"].append(opening("g", (12, 6), (13, 6)))
    features["unit"].append(unit("attic", (0, 0, 1, 1)))
    building = loaded(tmp_path, features)
    assert "floor G: 1 opening of units where nobody walks left out" in building.floors[0].notes
    note = "unit.geojson: 1 features of no known level were left out (the first: feature 14)"
    assert note in building.floors[0].notes
    assert problems(building) == ()


FAR = [[[1e7, 0], [1e7, 1], [1e7 + 1, 0], [1e7, 0]]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f["level"][0]["properties"].update(ordinal="ground"), "ordinal 'ground', expected a whole number"),
        (lambda f: f["level"][0]["properties"].update(ordinal=1e9), "ordinal 1000000000.0"),
        (lambda f: f["level"][0]["properties"].update(ordinal=float("nan")), "ordinal nan"),
        (lambda f: f["level"][1].update(id="g"), "an id of its own"),
        (lambda f: f["level"].clear(), "level.geojson, features: found none"),
        (lambda f: f["unit"].clear(), "unit.geojson, features: found none"),
        (lambda f: f["unit"][0]["geometry"].update(coordinates=FAR), "degrees"),
        (lambda f: f["unit"].append(3), "expected a GeoJSON geometry"),
        (lambda f: f["unit"][0].update(properties=[1]), "expected a GeoJSON geometry"),
    ],
)
def test_archives_that_cannot_be_are_refused_in_one_line(tmp_path, change, message):
    features = house()
    change(features)
    refused(Building.load, written(tmp_path / "archive", features), message)
