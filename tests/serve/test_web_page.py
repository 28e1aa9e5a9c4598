"""What the page is made of: the plan's layers, the security policy, and MapLibre GL JS as npm has it."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import shapely

from pdr_graph.apps.serve.application import WEB, checked_tiles, security_headers, settings
from pdr_graph.apps.serve.publishing import plan_layers
from pdr_graph.errors import InputError
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import METRES_PER_DEGREE, Frame

MAPS = Path(__file__).parents[2] / "maps"
VENDORED = {  # of `npm pack maplibre-gl@5.24.1`
    "LICENSE.txt": "ee5fc05a0677eaf69601d2c7db0d9ecd6cc27c3abc1d0733bc9ed34707cf8ef2",
    "maplibre-gl-csp-worker.js": "58534d0ebbe8535cd22d19eb3739788898667390ab9b22b87edfe55b9c85d0a5",
    "maplibre-gl-csp.js": "2835432eb59578c24e9bc7fbcef6f6f03f2af3f60951b940db875125ff617ddb",
    "maplibre-gl.css": "ab1e70d59ec40465bae7e7030da2f3ccf28133fd502e62bd598eefbadfd7a732",
}
ADDRESS = re.compile(r"https?://[\w.-]+")
NO_REQUEST = ("http://www.w3.org",)  # a name space


@pytest.fixture(scope="module")
def building():
    return Building.load(MAPS / "two_floors.geojson")


@pytest.mark.parametrize("name", VENDORED)
def test_what_is_vendored_is_as_published(name):
    assert hashlib.sha256((WEB / "maplibre-gl" / name).read_bytes()).hexdigest() == VENDORED[name]


def test_no_file_of_the_page_names_another_host():
    for file in WEB.iterdir():
        if file.is_file():
            assert set(ADDRESS.findall(file.read_text(encoding="utf-8"))) <= set(NO_REQUEST), file.name


def test_all_that_the_page_loads_is_there():
    for file in WEB.glob("*.html"):
        for path in re.findall(r'(?:src|href)="web/([^"]+)"', file.read_text(encoding="utf-8")):
            assert (WEB / path).is_file(), path
    for file in WEB.glob("*.js"):
        for path in re.findall(r'from "\./([^"]+)"', file.read_text(encoding="utf-8")):
            assert (WEB / path).is_file(), f"{file.name}: {path}"


def test_the_layers_of_a_plan_cover_its_floors(building):
    layers = plan_layers(building)
    about = layers["pdr_graph"]
    assert (about["georeferenced"], about["floors"]) == (True, ["1", "2"])
    west, south, east, north = about["bounds"]
    for floor in about["floors"]:
        of_floor = [each for each in layers["features"] if each["properties"]["floor"] == floor]
        assert {"ground", "walkable", "room", "stairs", "wall", "name"} <= {e["properties"]["layer"] for e in of_floor}
        for each in of_floor:
            low_x, low_y, high_x, high_y = shapely.from_geojson(json.dumps(each["geometry"])).bounds
            assert west - 1e-7 <= low_x <= high_x <= east + 1e-7
            assert south - 1e-7 <= low_y <= high_y <= north + 1e-7


def test_a_plan_without_georeference_lies_about_the_origin(building):
    local = Building.of(*[replace(floor, frame=Frame()) for floor in building.floors])
    about = plan_layers(local)["pdr_graph"]
    assert about["georeferenced"] is False
    (west, south), (east, north) = (local.corners / METRES_PER_DEGREE).tolist()
    assert about["bounds"] == pytest.approx([west, south, east, north])


def test_without_a_plan_there_are_no_layers():
    assert plan_layers(None)["features"] == []
    assert plan_layers(None)["pdr_graph"]["bounds"] is None


@pytest.mark.parametrize(
    "url",
    ["host/{z}/{x}/{y}", "ftp://host/{z}/{x}/{y}", "https://host/{z}/{x}", "https://a b/{z}/{x}/{y}",
     "https://host; script-src */{z}/{x}/{y}", "https:///{z}/{x}/{y}"],
)  # fmt: skip
def test_other_tile_servers_are_refused(url):
    with pytest.raises(InputError, match="--tiles"):
        checked_tiles(url)


def test_the_policy_names_the_tile_server_and_no_other():
    tiles = checked_tiles("https://tiles.example:8443/a/{z}/{x}/{y}.png")
    policy = security_headers(tiles)["Content-Security-Policy"]
    assert ADDRESS.findall(policy) == ["https://tiles.example"] * 2
    assert "unsafe" not in policy
    assert ADDRESS.findall(security_headers(None)["Content-Security-Policy"]) == []
    assert settings(tiles, True) == {"tiles": {"url": tiles, "attribution": "tiles: tiles.example"}, "guarded": True}
    assert settings(None, False) == {"tiles": None, "guarded": False}
