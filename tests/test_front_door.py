"""The command line on other people's files: every recorder's export to a report, and what was missing in it."""

import json
from dataclasses import replace

import bags
import numpy as np
import pytest
import recorders
from commands import run
from mutations import gpx
from plans import ARCADE
from tiers import thorough

from pdr_graph import kalman_filter, kalman_smoother, read_trajectory, smooth
from pdr_graph.walk import Options, estimate, observe, read

ALIKE = ("device_motion", "movella")  # read as named_columns are
PHONES = ("sensor_logger", "phyphox", "get_sensor_data", "gnss_logger")  # whose exports have the walk's sensors
RECORDERS = [*(name for name in recorders.EXPORTS if name not in ALIKE), "ros_bags"]
FIRST = ("sensor_logger", "gnss_logger", "ros_bags", "oxford_steps")  # tests of the readers have all


@pytest.fixture(scope="module")
def felt():
    return recorders.sample()


def exported(recorder, folder, felt):
    """The walk in the files of one recorder, with a space in the name; in a zip where it comes from a phone."""
    if recorder == "ros_bags":
        return bags.by_foxglove(folder / "walk 1.mcap", felt)
    name, write_files = recorders.EXPORTS[recorder]
    path, content = folder / name.replace("walk", "walk 1"), write_files(felt)
    if recorder == "ridi":  # a workbook is a zip
        return recorders.in_zip(path.with_suffix(".xlsx"), content)
    if isinstance(content, dict) and recorder in PHONES:
        return recorders.in_zip(path.with_suffix(".zip"), content, top="walk 1/")
    if isinstance(content, dict):
        return recorders.in_folder(path, content)
    path.write_text(content)
    return path


def smoothed(path, out, *options):
    code, _, errors = run("smooth", path, "--no-report", "--out", out, *options)
    return code, errors, json.loads((out / "summary.json").read_text())


@pytest.mark.parametrize("command", ["smooth", thorough("replay")])
@pytest.mark.parametrize("recorder", [name if name in FIRST else thorough(name) for name in RECORDERS])
def test_one_command_makes_a_report_of_every_recorders_file(tmp_path, felt, recorder, command):
    """Without options: the last line of the output is the report, in the current folder."""
    code, printed, errors = run(command, exported(recorder, tmp_path, felt), cwd=tmp_path)
    assert code == (3 if recorder == "oxford_steps" else 0), printed
    name = "walk 1-smoothed" if command == "smooth" else "walk 1-replayed"
    assert printed.splitlines()[-1] == f"-> {name}/report.html"
    assert all((tmp_path / name / page).stat().st_size > 10_000 for page in ("report.html", "figure.png"))
    assert code == 0 or "pdr-graph: finished without " in errors[0]
    if recorder in PHONES:
        summary = json.loads((tmp_path / name / "summary.json").read_text())
        assert summary["steps"] == pytest.approx(29, abs=3)
        assert summary["distance"] == pytest.approx(21.0, rel=0.2)
        assert command == "replay" or len(summary["fixes"]) == len(felt.fix_time)


def test_the_summary_has_the_recorders_clock(tmp_path, felt):
    """The receiver's latency is taken back, if it is known."""
    path = exported("sensor_logger", tmp_path, felt)
    for latency in (0, 2):
        _, _, summary = smoothed(path, tmp_path / str(latency), "--gnss-latency", latency)
        expected = recorders.UNIX + felt.fix_time - latency
        assert [fix["time"] for fix in summary["fixes"]] == pytest.approx(expected, abs=1e-3)
    assert summary["calibration"][0]["start"] == pytest.approx(recorders.UNIX, abs=0.1)


def test_dead_reckoning_is_turned_and_scaled_by_nothing(tmp_path, felt):
    """``--method pdr``: the first fix says where it starts; the other fixes are not used, so its direction is open."""
    path = exported("phyphox", tmp_path, felt)
    code, _, summary = smoothed(path, tmp_path / "out", "--method", "pdr")
    assert code == 3
    assert {reason["source"] for reason in summary["verdict"]["reasons"]} == {"route", "place"}
    run("steps", path, "--out", tmp_path / "steps.csv")
    lengths = np.loadtxt(tmp_path / "steps.csv", delimiter=",", skiprows=1, usecols=1)
    track = read_trajectory(tmp_path / "out" / "trajectory.csv")
    assert np.hypot(*np.diff(track.position, axis=0).T).sum() == pytest.approx(lengths.sum(), abs=0.01)
    assert [fix["weight"] > 0 for fix in summary["fixes"]] == [True, *[False] * (len(felt.fix_time) - 1)]


@pytest.mark.parametrize(("text", "code"), [(gpx(), 3), (recorders.gpx(recorders.sample()), 0)])
def test_positions_alone_are_joined_and_a_note_says_so(tmp_path, text, code):
    """3: the first are too far apart to be walked."""
    (tmp_path / "track.gpx").write_text(text)
    found, errors, summary = smoothed(tmp_path / "track.gpx", tmp_path / "out")
    assert (found, errors, summary["missing"]) == (code, [], [])
    assert any(note.startswith("positions alone: the recording has no acc") for note in summary["warnings"])
    assert (tmp_path / "out" / "trajectory.geojson").exists()


def test_a_phone_without_a_gyroscope_finishes_without_turns(tmp_path, felt):
    tables = {name: text for name, text in recorders.phyphox(felt).items() if name != "Gyroscope.csv"}
    code, errors, summary = smoothed(recorders.in_zip(tmp_path / "walk.zip", tables), tmp_path / "out")
    assert code == 3
    assert errors == [
        f"pdr-graph: finished without turns: there is no gyroscope, or it stopped (see {tmp_path}/out/summary.json)"
    ]
    assert summary["missing"] == ["turns: there is no gyroscope, or it stopped"]


def test_a_walk_whose_accelerometer_ends_early_says_what_is_missing(tmp_path, felt):
    """A table that was cut off: 40 % of the walk has no steps."""
    tables = recorders.phyphox(felt)
    [name] = [name for name in tables if name.startswith("Accel")]
    rows = tables[name].splitlines()
    tables[name] = "\n".join([*rows[: int(0.6 * len(rows))], rows[-1][:9]])
    recording = recorders.in_zip(tmp_path / "walk.zip", tables)
    gone = 0.4 * (felt.time[-1] - felt.time[0])
    for verb in ("smooth", "replay"):
        code, _, errors = run(verb, recording, "--no-report", "--out", tmp_path / verb)
        assert code == 3
        assert f"finished without steps: the accelerometer ends {gone:.0f} s before the gyroscope" in errors[0]


def test_a_lifelog_is_shown_without_options(tmp_path, felt):
    """The timeline on the terminal, and a folder named after the store with the page."""
    walk = exported("phyphox", tmp_path, felt)
    assert run("lifelog", "add", "days.db", walk, "--begins", "2024-05-01T09:00", cwd=tmp_path).code == 0
    assert run("lifelog", "build", "days.db", cwd=tmp_path).code == 0
    code, printed, _ = run("lifelog", "show", "days.db", cwd=tmp_path)
    assert code == 0
    assert "walking" in printed
    assert printed.endswith("-> days-shown/overview.html\n")
    files = {file.name for file in (tmp_path / "days-shown").iterdir()}
    assert {"overview.html", "days.csv", "timeline.csv"} <= files


# Plans


def box(west, south, east, north):
    """A rectangle in metres about (135° E, 35° N)."""
    to_degrees = np.array([1 / 91288.0, 1 / 110941.0])
    corners = np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])
    return {"type": "Polygon", "coordinates": [(np.array([135.0, 35.0]) + corners * to_degrees).tolist()]}


def feature(kind, name, shape, **more):
    return {"type": "Feature", "properties": {"kind": kind, "name": name, **more}, "geometry": shape}


def test_of_several_floors_the_fixes_name_one_or_the_user_does(tmp_path, felt):
    """The arcade on two floors, the second without its northern half."""
    plan = json.loads(ARCADE.read_text())
    both = [f | {"properties": f["properties"] | {"floor": ["1", "2"]}} for f in plan["features"]]
    tower = plan | {"features": [*both, feature("wall", "", box(0, 22, 60, 33), floor="2")]}
    (tmp_path / "tower.geojson").write_text(json.dumps(tower))
    recording = exported("phyphox", tmp_path, felt)
    (tmp_path / "fixes.csv").write_text("time,x,y,sigma,floor\n1,6.8,8,1,2\n10,16,8,1,2\n18,20.8,8,1,2\n")
    given = ("--map", tmp_path / "tower.geojson", "--fixes", tmp_path / "fixes.csv", "--no-recorded-fixes")
    for floor, options in (("2", ()), ("1", ("--floor", "1"))):
        code, _, summary = smoothed(recording, tmp_path / floor, *given, *options)
        assert code in (0, 3)
        assert summary["floor"] == floor
        assert set(read_trajectory(tmp_path / floor / "trajectory.csv").floor) == {floor}


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


def test_map_show_draws_a_plan(tmp_path):
    code, printed, _ = run("map", "show", ARCADE, "--out", tmp_path / "plan.png")
    assert code == 0
    assert "m² walkable" in printed
    assert (tmp_path / "plan.png").stat().st_size > 10_000


# The frame of a walk by latitude, and the options of an estimate

ANCHORS = np.array([[20.0, -5.0], [3.0, 9.0]])  # [m] east and north of the walk's start


@pytest.fixture(scope="module")
def geodetic(tmp_path_factory, felt):
    """A recording with fixes; as many of a file, seven metres south of them; anchors and ranges by latitude."""
    folder = tmp_path_factory.mktemp("geodetic")
    south = recorders.FRAME.to_lonlat(recorders.FRAME.from_lonlat(felt.lonlat) - [0.0, 7.0])
    times = recorders.UNIX + felt.fix_time - 0.5
    lines = [f"{time:.3f},{lat:.8f},{lon:.8f},3" for time, (lon, lat) in zip(times, south, strict=True)]
    (folder / "fixes.csv").write_text("\n".join(["time,lat,lon,sigma", *lines]))
    anchors = recorders.FRAME.to_lonlat(ANCHORS)
    lines = [f"{name},{lat:.8f},{lon:.8f}" for name, (lon, lat) in zip("AB", anchors, strict=True)]
    (folder / "anchors.csv").write_text("\n".join(["beacon,lat,lon", *lines]))
    (folder / "ranges.csv").write_text(f"time,anchor,range\n{times[3]},A,9\n{times[5]},B,9\n")
    return folder, exported("sensor_logger", folder, felt)


def test_without_a_plan_the_origin_is_the_earliest_fix_of_file_and_recording(geodetic, felt):
    folder, recording = geodetic
    both = read(recording, Options(fixes=folder / "fixes.csv"))
    assert len(both.fixes) == 2 * len(felt.fix_time)
    assert both.frame.kind == "enu"
    first = np.argmin(both.fixes.time)
    assert both.fixes.position[first] == pytest.approx([0.0, 0.0], abs=0.01)
    apart = both.fixes.position[both.fixes.time < both.fixes.time[first] + 0.6]
    assert np.ptp(apart[:, 1]) == pytest.approx(7.0, abs=0.1)


@pytest.mark.parametrize("recorded", [True, False])
def test_anchors_by_latitude_are_the_origin_only_of_a_walk_without_fixes(geodetic, felt, recorded):
    folder, recording = geodetic
    lists = {"beacons": folder / "anchors.csv", "ranges": folder / "ranges.csv"}
    found = read(recording, Options(recorded_fixes=recorded, **lists))
    [ranges] = found.walk.measurements
    origin = recorders.FRAME.from_lonlat(felt.lonlat[:1])[0] if recorded else ANCHORS[0]
    assert ranges.position == pytest.approx(ANCHORS - origin, abs=0.01)
    assert found.fixes.position[:1] == pytest.approx(np.zeros((int(recorded), 2)), abs=0.01)
    assert found.frame.to_lonlat(np.zeros((1, 2))) == pytest.approx(recorders.FRAME.to_lonlat(origin[None]), abs=1e-7)


@pytest.mark.parametrize("method", ["graph", "filter", "rts", "pdr", "live"])
def test_lag_and_journal_are_options_of_a_live_walk_alone(method):
    alone = {"lag", "journal"}
    assert alone & set(Options(method=method).describe()) == (alone if method == "live" else set())


def test_each_method_is_the_estimator_of_its_name(geodetic):
    found = observe(read(geodetic[1]))
    for method, estimator in {"graph": smooth, "filter": kalman_filter, "rts": kalman_smoother}.items():
        track = estimate(replace(found, options=Options(method=method))).estimate.trajectory
        expected = estimator(found.graph()).trajectory
        assert track.position == pytest.approx(expected.position, abs=1e-6), method
        assert track.covariance == pytest.approx(expected.covariance, abs=1e-6), method
