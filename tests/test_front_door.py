"""The command line on other people's files: every recorder's export to a picture, and what was missing in it."""

import json

import numpy as np
import pytest
import recorders
from commands import run
from mutations import geolife, gpx
from test_cli import ARCADE

from pdr_graph import read_trajectory


@pytest.fixture(scope="module")
def felt():
    return recorders.sample()


def files(felt, recorder):
    return {
        "sensor_logger": lambda: recorders.sensor_logger(felt, "ios"),
        "phyphox": lambda: recorders.phyphox(felt),
        "get_sensor_data": lambda: {"log.txt": recorders.get_sensor_data(felt)},
        "gnss_logger": lambda: {"gnss_log.txt": recorders.gnss_logger(felt)},
    }[recorder]()


def smoothed(path, out, *options):
    code, _, errors = run("smooth", path, "--out", out, *options)
    return code, errors, json.loads((out / "summary.json").read_text())


@pytest.mark.parametrize("recorder", ["sensor_logger", "phyphox", "get_sensor_data", "gnss_logger"])
def test_an_export_becomes_a_picture(tmp_path, felt, recorder):
    """A zip as it comes from the phone, its own positions in it, and nothing else."""
    path = recorders.in_zip(tmp_path / "walk.zip", files(felt, recorder), top="walk 1/")
    code, errors, summary = smoothed(path, tmp_path / "out")
    assert (code, errors) == (0, [])
    assert summary["steps"] == pytest.approx(29, abs=3)
    assert summary["distance"] == pytest.approx(21.0, rel=0.2)
    assert len(summary["fixes"]) == len(felt.fix_time)
    assert (tmp_path / "out" / "figure.png").stat().st_size > 10_000


def test_the_summary_speaks_in_the_recorders_clock(tmp_path, felt):
    path = recorders.in_zip(tmp_path / "walk.zip", recorders.sensor_logger(felt))
    _, _, summary = smoothed(path, tmp_path / "out")
    assert [fix["time"] for fix in summary["fixes"]] == pytest.approx(recorders.UNIX + felt.fix_time, abs=1e-3)
    assert summary["calibration"][0]["start"] == pytest.approx(recorders.UNIX, abs=0.1)


def test_dead_reckoning_is_turned_and_scaled_by_nothing(tmp_path, felt):
    """``--method pdr``: the first fix says where it starts; the other fixes are not used, so its direction is open."""
    path = recorders.in_zip(tmp_path / "walk.zip", recorders.phyphox(felt))
    code, _, summary = smoothed(path, tmp_path / "out", "--method", "pdr")
    assert code == 3
    assert [reason["source"] for reason in summary["verdict"]["reasons"]] == ["route"]
    run("steps", path, "--out", tmp_path / "steps.csv")
    lengths = np.loadtxt(tmp_path / "steps.csv", delimiter=",", skiprows=1, usecols=1)
    track = read_trajectory(tmp_path / "out" / "trajectory.csv")
    assert np.hypot(*np.diff(track.position, axis=0).T).sum() == pytest.approx(lengths.sum(), abs=0.01)
    assert [fix["weight"] > 0 for fix in summary["fixes"]] == [True, *[False] * (len(felt.fix_time) - 1)]


@pytest.mark.parametrize(("name", "text"), [("track.gpx", gpx()), ("day.plt", geolife())])
def test_positions_alone_are_joined_and_a_note_says_so(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    code, errors, summary = smoothed(tmp_path / name, tmp_path / "out")
    assert (code, errors, summary["missing"]) == (3, [], []), "3: these positions are too far apart to be walked"
    assert any(note.startswith("positions alone: ") for note in summary["warnings"])
    assert (tmp_path / "out" / "trajectory.geojson").exists()


def test_a_phone_without_a_gyroscope_finishes_without_turns(tmp_path, felt):
    tables = {name: text for name, text in recorders.phyphox(felt).items() if name != "Gyroscope.csv"}
    code, errors, summary = smoothed(recorders.in_zip(tmp_path / "walk.zip", tables), tmp_path / "out")
    assert code == 3
    assert errors == [f"pdr-graph: finished without turns: there is no gyroscope (see {tmp_path}/out/summary.json)"]
    assert summary["missing"] == ["turns: there is no gyroscope"]


def test_the_receivers_latency_is_taken_back(tmp_path, felt):
    """Positions that arrive 2 s late are 2 s of walk behind, unless the setting says so."""
    late = recorders.phyphox(felt)
    header, *rows = late["Location.csv"].splitlines()
    delayed = (row.split(",", 1) for row in rows)
    late["Location.csv"] = "\n".join([header, *(f"{float(t) + 2.0:.9E},{rest}" for t, rest in delayed)]) + "\n"
    path = recorders.in_zip(tmp_path / "walk.zip", late)
    times = {}
    for latency in (0, 2):
        code, _, summary = smoothed(path, tmp_path / str(latency), "--gnss-latency", latency)
        assert code == 0
        times[latency] = [fix["time"] for fix in summary["fixes"]]
    assert np.subtract(times[0], times[2]) == pytest.approx(2.0, abs=1e-6)
    assert times[2] == pytest.approx(felt.fix_time, abs=1e-6)


def box(west, south, east, north):
    """A rectangle in metres about (135° E, 35° N)."""
    to_degrees = np.array([1 / 91288.0, 1 / 110941.0])
    corners = np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])
    return {"type": "Polygon", "coordinates": [(np.array([135.0, 35.0]) + corners * to_degrees).tolist()]}


def feature(kind, name, shape, **more):
    return {"type": "Feature", "properties": {"kind": kind, "name": name, **more}, "geometry": shape}


@pytest.fixture
def tower(tmp_path):
    """The arcade on two floors, the second without its northern half."""
    plan = json.loads(ARCADE.read_text())
    both = [f | {"properties": f["properties"] | {"floor": ["1", "2"]}} for f in plan["features"]]
    path = tmp_path / "tower.geojson"
    path.write_text(json.dumps(plan | {"features": [*both, feature("wall", "", box(0, 22, 60, 33), floor="2")]}))
    return path


def test_of_several_floors_the_fixes_name_one_or_the_user_does(tmp_path, tower, felt):
    recording = recorders.in_zip(tmp_path / "walk.zip", recorders.phyphox(felt))
    fixes = tmp_path / "fixes.csv"
    fixes.write_text("time,x,y,sigma,floor\n1,6.8,8,1,2\n10,16,8,1,2\n18,20.8,8,1,2\n")
    given = ("--map", tower, "--fixes", fixes, "--no-recorded-fixes")
    code, _, summary = smoothed(recording, tmp_path / "a", *given)
    assert (code in (0, 3), summary["floor"]) == (True, "2")
    code, _, summary = smoothed(recording, tmp_path / "b", *given, "--floor", "1")
    assert (code in (0, 3), summary["floor"]) == (True, "1")
    assert set(read_trajectory(tmp_path / "b" / "trajectory.csv").floor) == {"1"}
    code, _, errors = run("smooth", recording, *given, "--floor", "9", "--out", tmp_path / "c")
    assert code == 2
    assert "the floors 1, 2" in errors[0]


def test_map_check_finds_what_would_mislead(tmp_path):
    code, printed, _ = run("map", "check", ARCADE)
    assert code == 0
    assert "no problems found" in printed
    areas = [
        feature("corridor", "", box(0, 0, 20, 3)),
        feature("room", "office", box(0, 3, 8, 8)),
        feature("door", "", box(3, 2.9, 4, 3.1)),
        feature("room", "vault", box(8, 3, 20, 8)),
        feature("link", "shortcut", {"type": "LineString", "coordinates": box(4, 2, 12, 6)["coordinates"][0][::2]}),
    ]
    (tmp_path / "plan.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": areas}))
    code, printed, _ = run("map", "check", tmp_path / "plan.geojson")
    assert code == 3
    assert "1 cells that cannot be reached from the rest: room vault" in printed
    assert "1 links that go through a wall: shortcut" in printed
