"""Plans and fixes of another place, order, unit or floor are refused before anything is written."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
import simulated
from plans import MAPS, moved
from test_cli import ARCADE
from typer.testing import CliRunner

from pdr_graph import InputError
from pdr_graph.apps.cli import app
from pdr_graph.apps.evaal.trial import PositionFormat
from pdr_graph.apps.replay import navigator_of
from pdr_graph.apps.serve.serving import Settings, build, read_inputs
from pdr_graph.floor.plan_files import Building
from pdr_graph.frames import enu, projected
from pdr_graph.walk import Options

TWO_FLOORS = MAPS / "two_floors.geojson"
PLACE = (48.0, 11.0)  # latitude and longitude, which are both possible in either order
FRAME = enu(*PLACE)
VERBS = ("smooth", "replay", "lifelog add")


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return simulated.arcade(tmp_path_factory.mktemp("walk"), recorder="indoor_location")


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """The plan of the walk, at PLACE."""
    return moved(ARCADE, tmp_path_factory.mktemp("plan") / "arcade.geojson", *PLACE)


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """The plan of the walk without georeference, in metres."""
    plan = json.loads(ARCADE.read_text())
    plan["pdr_graph"] |= {"frame": "local"}
    for feature in plan["features"]:
        degrees = shapely.from_geojson(json.dumps(feature["geometry"]))
        feature["geometry"] = json.loads(shapely.to_geojson(shapely.transform(degrees, enu(35.0, 135.0).from_lonlat)))
    path = tmp_path_factory.mktemp("plan") / "local.geojson"
    path.write_text(json.dumps(plan))
    return path


def fixes_of(walk, path, columns="x,y", convert=lambda position: position, floor=None):
    """The walk's fixes with converted positions."""
    rows = np.genfromtxt(walk / "fixes.csv", delimiter=",", skip_header=1, usecols=(0, 1, 2))
    positions = convert(rows[:, 1:])
    header = f"time,{columns},sigma" + (",floor" if floor else "")
    lines = [f"{t:.3f},{x:.8f},{y:.8f},1" + (f",{floor}" if floor else "") for t, (x, y) in zip(rows[:, 0], positions)]  # noqa: B905
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def attempt(verb, folder, walk, plan, fixes, *options):
    """The error's line of a command; empty if it was accepted. Asserts that a refused command has written nothing."""
    out = folder / verb.split()[0]
    target = [str(out / "days.db"), str(walk / "walk.txt")] if verb == "lifelog add" else [str(walk / "walk.txt")]
    command = [*verb.split(), *target, "--map", str(plan), *map(str, options)]
    command += ["--fixes", str(fixes)] if fixes else []
    out.mkdir(exist_ok=True)
    result = CliRunner().invoke(
        app, command + ([] if verb == "lifelog add" else ["--out", str(out / "result"), "--no-report"])
    )
    if isinstance(result.exception, InputError):
        assert not (out / "result").exists()
        line = str(result.exception)
    else:
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        refused = verb == "lifelog add" and result.exit_code == 2
        assert not refused or list(out.iterdir()) == []
        lines = result.output.strip().splitlines()
        line = next((line for line in lines if ": found " in line), "") if refused else ""
    assert "\n" not in line
    return line


@pytest.fixture(params=VERBS)
def refusal(request, tmp_path, walk):
    """A function that returns the line with which each command refuses a plan and fixes."""

    def run(plan, fixes=None, *options):
        line = attempt(request.param, tmp_path, walk, plan, fixes, *options)
        print(f"{request.param:12} {line}")
        return line

    return run


def degrees(position):
    return FRAME.to_lonlat(position)


def test_the_control_is_accepted(refusal, here, walk, tmp_path):
    assert refusal(here, fixes_of(walk, tmp_path / "f.csv", "lon,lat", degrees)) == ""


def test_a_plan_without_latitude_and_metric_fixes_are_accepted(refusal, local, walk):
    assert refusal(local, walk / "fixes.csv") == ""


def test_a_plan_kilometres_from_every_fix(refusal, walk, tmp_path):
    far = moved(ARCADE, tmp_path / "far.geojson", 48.5, 11.0)
    line = refusal(far, fixes_of(walk, tmp_path / "f.csv", "lon,lat", degrees))
    assert "far.geojson: found a plan 56 km or more from each of" in line


def test_a_plan_with_latitude_before_longitude(refusal, walk, tmp_path):
    """Where both orders are on Earth, and where they are not."""
    swapped = moved(ARCADE, tmp_path / "swapped.geojson", *PLACE[::-1])
    line = refusal(swapped, fixes_of(walk, tmp_path / "f.csv", "lon,lat", degrees))
    assert "(latitude and longitude swapped?)" in line


def test_a_plan_with_latitudes_beyond_90_degrees(refusal, walk, tmp_path):
    plan = moved(ARCADE, tmp_path / "swapped.geojson", 135.0, 35.0)
    assert "coordinates up to 135" in (line := refusal(plan, fixes_of(walk, tmp_path / "f.csv")))
    assert "(latitude before longitude?)" in line


def test_fixes_with_latitude_and_longitude_swapped(refusal, here, walk, tmp_path):
    line = refusal(here, fixes_of(walk, tmp_path / "f.csv", "lat,lon", degrees))
    assert "found a plan" in line
    assert "(latitude and longitude swapped?)" in line


def test_fixes_with_latitudes_beyond_90_degrees(refusal, walk, tmp_path):
    line = refusal(ARCADE, fixes_of(walk, tmp_path / "f.csv", "lat,lon", enu(35.0, 135.0).to_lonlat))
    assert "f.csv, data row 1, lat: found 135.0000" in line
    assert "(latitude and longitude swapped?)" in line


@pytest.mark.parametrize(
    ("convert", "hint"),
    [
        (degrees, "x, y: found degrees on the plan (time,lat,lon,sigma in the header?)"),
        (lambda p: degrees(p)[:, ::-1], "x, y: found degrees on the plan (time,lat,lon,sigma in the header?)"),
        (lambda p: projected(32632).from_lonlat(degrees(p)), "(metres of EPSG:32632?)"),
        (lambda p: 1000 * p, "(millimetres?)"),
        (lambda p: p + np.array([0, 9000]), "found a plan 9.0 km or more from each of"),
    ],
    ids=["degrees", "degrees, latitude first", "UTM", "millimetres", "another origin"],
)
def test_fixes_in_metres_of_another_frame(refusal, here, walk, tmp_path, convert, hint):
    assert hint in refusal(here, fixes_of(walk, tmp_path / "f.csv", convert=convert))


def test_fixes_by_latitude_for_a_plan_without_any(refusal, local, walk, tmp_path):
    line = refusal(local, fixes_of(walk, tmp_path / "f.csv", "lon,lat", degrees))
    assert "f.csv: found positions by latitude and longitude, expected time,x,y,sigma in metres of the plan" in line


def test_fixes_far_from_a_plan_without_latitude(refusal, local, walk, tmp_path):
    line = refusal(local, fixes_of(walk, tmp_path / "f.csv", convert=lambda p: 1000 * p))
    assert "local.geojson: found a plan" in line
    assert "(millimetres?)" in line


@pytest.mark.parametrize(
    ("plan", "label", "expected"),
    [
        (ARCADE, "3", "found the floors 1, expected a floor '3'"),
        (TWO_FLOORS, "3", "found the floors 1, 2, expected a floor '3'"),
        (TWO_FLOORS, "F2", "expected a floor 'F2' (2?)"),
    ],
)
def test_a_floor_that_the_plan_does_not_have(refusal, walk, plan, label, expected):
    assert expected in refusal(plan, walk / "fixes.csv", "--floor", label)


@pytest.mark.parametrize(
    ("plan", "label", "expected"),
    [
        (ARCADE, "3", "f.csv, floor: found '3', expected the floors of arcade.geojson: 1"),
        (TWO_FLOORS, "F1", "f.csv, floor: found 'F1' (1?), expected the floors of two_floors.geojson: 1, 2"),
    ],
)
def test_fixes_on_a_floor_that_the_plan_does_not_have(refusal, walk, tmp_path, plan, label, expected):
    assert expected in refusal(plan, fixes_of(walk, tmp_path / "f.csv", floor=label))


def test_the_only_floor_of_a_plan_may_be_called_otherwise(refusal, walk, tmp_path):
    assert refusal(ARCADE, fixes_of(walk, tmp_path / "f.csv", floor="F1")) == ""


@pytest.mark.parametrize("options", [(), ("--floor", "3")])
def test_a_plan_without_labels_has_every_floor(refusal, walk, tmp_path, options):
    drawn = json.loads(ARCADE.read_text())
    drawn["pdr_graph"].pop("floor", None)
    for feature in drawn["features"]:
        feature["properties"].pop("floor", None)
    (tmp_path / "unlabelled.geojson").write_text(json.dumps(drawn))
    assert Building.load(tmp_path / "unlabelled.geojson").labels == ("",)
    assert refusal(tmp_path / "unlabelled.geojson", walk / "fixes.csv", *options) == ""
    assert refusal_of_a_server(tmp_path, tmp_path / "unlabelled.geojson", *options[1:]) == ""


def refusal_of_a_server(folder, plan, floor=None):
    try:
        options = {"plan": Path(plan), "floor": floor}
        build(Settings(folder / "server", options), read_inputs(options))
    except InputError as error:
        assert not (folder / "server").exists()
        return str(error)
    return ""


def test_a_server_refuses_floors_and_plans_that_cannot_be(tmp_path):
    assert "expected a floor '3'" in refusal_of_a_server(tmp_path, TWO_FLOORS, "3")
    plan = moved(ARCADE, tmp_path / "swapped.geojson", 135.0, 35.0)
    assert "(latitude before longitude?)" in refusal_of_a_server(tmp_path, plan)


def test_a_refused_server_writes_nothing(tmp_path):
    command = ["serve", "--map", str(TWO_FLOORS), "--floor", "3", "--out", str(tmp_path / "server")]
    result = CliRunner().invoke(app, command)
    assert "expected a floor '3'" in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def refusal_of_a_trial(plan, initial, lonlat=True):
    building = navigator_of(Options(plan=plan)).keywords["floor"]
    try:
        PositionFormat(lonlat, initial).check_begins_near(plan, building)
    except InputError as error:
        return str(error)
    return ""


def test_a_trial_by_latitude_on_a_plan_without_any_is_refused(local):
    assert "found a plan without latitude, expected one that has it" in refusal_of_a_trial(local, "11.0,48.0,0")
    assert refusal_of_a_trial(local, "20.0,18.0,0", lonlat=False) == ""


def test_a_trial_that_begins_elsewhere_is_refused_before_its_first_request(here):
    assert refusal_of_a_trial(here, "11.0002,48.0001,0") == ""
    assert "found a plan 1,488 km or more from the only fix, expected a plan within 7.2 km" in refusal_of_a_trial(
        here, "31.0,48.0,0"
    )
    assert "(latitude and longitude swapped?)" in refusal_of_a_trial(here, "48.0,11.0,0")
    x, y = projected(32632).from_lonlat(np.array([PLACE[::-1]]))[0]
    assert "(metres of EPSG:32632?)" in refusal_of_a_trial(here, f"{x},{y},0", lonlat=False)
    assert refusal_of_a_trial(here, "0,0,0") == "", "unknown"


def test_hints_need_all_fixes_on_the_plan(refusal, here, walk, tmp_path):
    """Half of them in millimetres, half kilometres away: no guess."""

    def convert(position):
        moved_away = 1000.0 * position + [9e6, 0]
        return np.where(np.arange(len(position))[:, None] % 2, 1000.0 * position + 1e5, moved_away)

    line = refusal(here, fixes_of(walk, tmp_path / "f.csv", convert=convert))
    assert "found a plan" in line
    assert "?" not in line
