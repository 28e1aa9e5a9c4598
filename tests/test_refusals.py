"""Likely mistakes on the command line, and the line that each ends with: the place, what was found, what to do.

Every refusal has exit code 2, one line on standard error, no other output, and has written nothing.
"""

import gzip
import io
import json
import zipfile
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import recorders
from commands import run
from evaal_trial import PositionFormat
from plans import ARCADE, MAPS, moved

from pdr_graph import InputError
from pdr_graph.apps.replay import navigator_of
from pdr_graph.apps.serve.serving import Settings, build, read_inputs
from pdr_graph.floor import plan_files
from pdr_graph.floor.formats import geojson
from pdr_graph.frames import Frame, enu, projected
from pdr_graph.io.signatures import RECORDING_FORMATS
from pdr_graph.walk import Options, read

PLACE = (48.0, 11.0)  # latitude and longitude, which are both possible in either order
FRAME = enu(*PLACE)
RECORDERS = "expected a recording of a supported recorder: "


@pytest.fixture(scope="module")
def place(arcade_walk, long_walk, tmp_path_factory):
    """A folder with a walk, its plan, the same plan elsewhere and without a place, and other files to be confused."""
    folder = tmp_path_factory.mktemp("mistakes")
    (folder / "maps").symlink_to(MAPS)
    (folder / "walk").symlink_to(arcade_walk)
    (folder / "long").symlink_to(long_walk)
    geojson.write(folder / "local.geojson", replace(plan_files.read(ARCADE), frame=Frame()))
    for name, at in {"here": PLACE, "far": (48.5, 11.0), "swapped": PLACE[::-1], "beyond": (135.0, 35.0)}.items():
        moved(ARCADE, folder / f"{name}.geojson", *at)
    (folder / "plan.geojson").write_bytes(ARCADE.read_bytes())
    unlabelled = json.loads(ARCADE.read_text())
    del unlabelled["pdr_graph"]["floor"]
    (folder / "unlabelled.geojson").write_text(json.dumps(unlabelled))
    (folder / "phyphox").mkdir()
    recorders.in_folder(folder / "phyphox", recorders.phyphox(recorders.sample()))
    (folder / "empty").mkdir()
    (folder / "result").mkdir()
    for name in ("summary.json", "trajectory.csv"):
        (folder / "result" / name).write_text("{}")
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    return folder


TEXTS = {
    "fixes.csv": "time,x,y,sigma\n1777629600,2,18,1\n1777629620,15,28,1\n",
    "munich.csv": "time,lat,lon,sigma\n1777629600,48.1,11.5,2\n1777629620,48.1,11.5,2\n",
    "unix.csv": "time,x,y,sigma\n1777629600,2,18,1\n",
    "iso.csv": "time,x,y,sigma\n2026-05-01T10:00:00,2,18,1\n",
    "truth.csv": "time,x,y\n1777629600,2,18\n1777629620,15,28\n",
    "late.csv": "time,x,y\n1777633200,2,18\n1777633220,15,28\n",
    "back.csv": "time,x,y\n1777629620,15,28\n1777629600,2,18\n",
    "abroad.csv": "time,x,y\n1777629600,500000,5500000\n1777629620,500000,5500000\n",
    "relative.csv": "time,x,y\n0,2,18\n20,15,28\n",
    "degrees.csv": "time,lat,lon\n1777629600,49.1,11.1\n1777629620,49.1,11.2\n",
    "metres.csv": "time,x,y\n1777629600,0,0\n1777629620,1,0\n",
    "walker.toml": "height = 172\n",
    "ranges.csv": "time,anchor,range\n1777629601,A,5\n1777629602,B,6\n",
    "anchors.csv": "beacon,x,y\nA,9000,18\nB,9005,18\nC,20,18\n",
    "beacons.csv": "beacon,x,y\nA,90000,18\nB,90005,18\n",
    "a.tum": "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n",
    "later.tum": "7201 0 0 0 0 0 0 1\n7202 1 0 0 0 0 0 1\n",
    "back.tum": "2 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n",
    "short.tum": "1 0 0 0 0 0 0 1\n2 1 0\n",
}


def refusal(folder, *arguments):
    """The line with which a command is refused; it leaves the folder as it was."""
    before = {path.name for path in folder.iterdir()}
    code, printed, errors = run(*arguments, cwd=folder)
    assert (code, printed, len(errors)) == (2, "", 1), errors
    assert errors[0].startswith("pdr-graph: ")
    assert {path.name for path in folder.iterdir()} == before
    return errors[0]


def smooth(place, tmp_path, text, plan="plan.geojson", *options):
    """The refusal of the walk with fixes."""
    (tmp_path / "f.csv").write_text(text)
    return refusal(place, "smooth", "walk", "--map", plan, "--fixes", tmp_path / "f.csv", *options, "--out", "out")


TABLES = {
    "line 1: found 1777629601.0,2.0,18.0,1.0,1 (is the header missing?), expected": "1777629601.0,2.0,18.0,1.0,1",
    "found when,east,north,error, expected a header": "when,east,north,error\n1777629601,2,18,1",
    "found time,x,y (sigma is missing), expected": "time,x,y\n1777629601,2,18",
    "(sigma is a phone's accuracy divided by 1.51)": "time,x,y,accuracy\n1777629601,2,18,1",
    "(lat and lon are the names of latitude and long": "time,latitude,longitude,sigma\n1777629601,35.0001,135.0001,2",
    "(columns between spaces? write commas)": "time x y sigma\n1777629601 2 18 1",
    "(a date or a clock time? write seconds or ISO 8601, 2024-05-01T1": "time,x,y,sigma\n01.05.2026 12:00:00,2,18,1",
    "line 3, time: found 'soon', expected ISO 8601 as in": "time,x,y,sigma\n2026-05-01T10:00:00,2,18,1\nsoon,2,18,1",
    "(nanoseconds? seconds are expected)": "time,x,y,sigma\n1777629601000000000,2,18,1",
    "line 3, x: found 'nan'": "time,x,y,sigma\n1777629601,2,18,1\n1777629602,nan,18,1",
    "data row 1, sigma: found 0, expected a standard dev": "time,x,y,sigma\n1777629601,2,18,0",
    "line 2, sigma: found '1.5m' (a unit in the cell? wri": "time,x,y,sigma\n1777629601,2,18,1.5m",
    "(degrees and minutes? write decimal degrees, south": "time,lat,lon,sigma\n1777629601,35°00'01\"N,135°00'01\"E,2",
    "found 135.0001, expected a latitude within ±90° (latitude and long": "time,lat,lon,sigma\n1,135.0001,35,2",
    "f.csv, floor: found '3', expected the floors of plan.geojson: 1": "time,x,y,sigma,floor\n1777629601,2,18,1,3",
}


@pytest.mark.parametrize("expected", TABLES)
def test_a_table_of_fixes(place, tmp_path, expected):
    assert expected in smooth(place, tmp_path, TABLES[expected])


def table_of(walk, columns="x,y", convert=lambda position: position, late=0.0, clock=str):
    """The walk's fixes at converted positions, later by some seconds, with times as a clock writes them."""
    rows = np.genfromtxt(walk / "fixes.csv", delimiter=",", skip_header=1, usecols=(0, 1, 2))
    lines = [
        f"{clock(time + late)},{x:.8f},{y:.8f},1"
        for time, (x, y) in zip(rows[:, 0].tolist(), convert(rows[:, 1:]).tolist(), strict=True)
    ]
    return "\n".join([f"time,{columns},sigma", *lines]) + "\n"


def iso(seconds):
    return datetime.fromtimestamp(seconds, UTC).isoformat().removesuffix("+00:00")


def half_in_millimetres(position):
    odd = np.arange(len(position))[:, None] % 2
    return 1000.0 * position + np.where(odd, 1e5, [9e6, 0])


# Of the fixes: columns, positions and plan
PLACES = {
    "degrees as x and y": ("x,y", FRAME.to_lonlat, "here", "x, y: found degrees on the plan (time,lat,lon,sigma in"),
    "the same, latitude first": ("x,y", lambda p: FRAME.to_lonlat(p)[:, ::-1], "here", "x, y: found degrees on the pl"),
    "UTM": ("x,y", lambda p: projected(32632).from_lonlat(FRAME.to_lonlat(p)), "here", "(metres of EPSG:32632?)"),
    "millimetres": ("x,y", lambda p: 1000 * p, "here", "(millimetres?)"),
    "millimetres of a plan in metres": ("x,y", lambda p: 1000 * p, "local", "(millimetres?)"),
    "another origin": ("x,y", lambda p: p + np.array([0, 9000]), "here", "found a plan 9.0 km or more from each of"),
    "no hint for half of them": ("x,y", half_in_millimetres, "here", "expected a plan within"),
    "latitude and longitude swapped": ("lat,lon", FRAME.to_lonlat, "here", "(latitude and longitude swapped?)"),
    "latitude for a plan in metres": (
        "lon,lat",
        FRAME.to_lonlat,
        "local",
        "expected time,x,y,sigma in metres of the pl",
    ),
    "a plan kilometres away": (
        "lon,lat",
        FRAME.to_lonlat,
        "far",
        "far.geojson: found a plan 56 km or more from each of",
    ),
    "a plan swapped": ("lon,lat", FRAME.to_lonlat, "swapped", "(latitude and longitude swapped?)"),
    "a plan beyond 90 degrees": ("x,y", lambda p: p, "beyond", "coordinates up to 135"),
}


@pytest.mark.parametrize("mistake", PLACES)
def test_fixes_of_another_place_than_the_plan(place, tmp_path, mistake):
    columns, convert, plan, expected = PLACES[mistake]
    line = smooth(place, tmp_path, table_of(place / "walk", columns, convert), f"{plan}.geojson")
    assert expected in line
    assert mistake != "no hint for half of them" or "?" not in line


@pytest.mark.parametrize("clock", [str, iso])
def test_fixes_of_another_time_zone(place, tmp_path, clock):
    """tests/test_plausibility.py has the hints on other clocks."""
    line = smooth(place, tmp_path, table_of(place / "walk", late=7200.0, clock=clock))
    assert "(exactly 2 h late: time zone?), expected times within the recording" in line


def excel():
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name in ("[Content_Types].xml", "xl/workbook.xml"):
            archive.writestr(name, "<x/>")
    return content.getvalue()


TRACK = b'<gpx version="1.1"><trk><trkseg><trkpt lat="1" lon="2"/></trkseg></trk></gpx>'
FILES = {
    "a text named .zip that begins with 'walk of Monday', " + RECORDERS: ("a.zip", b"walk of Monday\n"),
    "a web page (was the download a login page or a message?)": ("a.zip", b"<!DOCTYPE html><html><body>Sign in</body>"),
    "expected a complete zip: was the download cut off?": ("a.zip", b"PK\x03\x04" + bytes(200)),
    "a RAR archive, expected a zip, a folder or a file (un": ("a.rar", b"Rar!\x1a\x07\x01\x00" + bytes(50)),
    "a gzip archive, expected a zip": ("a.csv", gzip.compress(b"time,x\n")),
    "an Excel file, expected CSV: save each table as CSV, or export": ("a.xlsx", excel()),
    "an empty file, " + RECORDERS: ("a.csv", b""),
    "a PNG picture, expected a recording (is this a floor plan": ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(50)),
    "with the header time,ax,ay,az, expected a recording; a tab": ("a.csv", b"time,ax,ay,az\n0.00,0.1,0.2,9.8\n"),
    "a text that begins with '0.00,0.1,0.2,9.8', " + RECORDERS: ("a.csv", b"0.00,0.1,0.2,9.8\n"),
    "found 1 track points, none with a time, expected <trkpt> with": ("a.gpx", TRACK),
}


@pytest.mark.parametrize("command", ["smooth", "replay"])
@pytest.mark.parametrize("expected", FILES)
def test_a_file_that_is_no_recording(tmp_path, expected, command):
    name, content = FILES[expected]
    (tmp_path / name).write_bytes(content)
    line = refusal(tmp_path, command, name)
    assert expected in line
    assert RECORDERS not in expected or all(row.name in line for row in RECORDING_FORMATS)


COMMANDS = {
    "smooth nowhere.zip": "nowhere.zip: found no such file, expected a recording",
    "smooth empty": "found an empty folder, expected a recording of a supported recorder: ",
    "smooth plan.geojson": "found GeoJSON, expected a recording (is this a floor plan? --",
    "smooth fixes.csv": "with the header time,x,y,sigma, expected a recording (are these",
    "steps truth.csv --out o": "(is this a trajectory? evaluate and --truth take it)",
    "smooth result": "found a result of pdr-graph, expected the recording that it was",
    "walk": "found a path and no command, expected a command before it: pdr-graph smooth walk",
    "smooth walk --map plan.geojson --fixes nowhere.csv": "nowhere.csv",
    "smooth walk --map nowhere --out o": "nowhere: found no such file, expected a floor p",
    "smooth walk --map fixes.csv --out o": "header time,x,y,sigma, expected a floor plan: Microsoft, IMDF",
    "smooth walk --map phyphox --out o": "Accelerometer.csv: found a recording of phyphox, expected a floor plan: ",
    "smooth walk --walker fixes.csv": "fixes.csv",
    "smooth walk --rate -1": "--rate",
    "replay walk --lag soon --out o": "--lag: found soon, expected a number",
    "smooth walk --height 172": "--height: found 172.0 (centimetres?), expected metres",
    "smooth walk --walker walker.toml": "walker.toml, height: found 172 (centimetres?), expected",
    "smooth walk --gnss-latency 2000": "--gnss-latency: found 2000.0 (milliseconds?), expected",
    "smooth walk --start-heading 361": "--start-heading",
    "smooth walk --start-heading nan": "--start-heading",
    "smooth walk --map plan.geojson --floor F1": "plan.geojson: found the floors 1, expected a floor 'F1' (1?)",
    "smooth walk --map maps/two_floors.geojson --floor 3 --out o": "found the floors 1, 2, expected a floor '3'",
    "smooth walk --map maps/two_floors.geojson --fixes fixes.csv --out o": "found 2 floors, 1, 2, expected --floor",
    "smooth phyphox --fixes iso.csv": "phyphox does not state its date",
    "smooth phyphox --fixes unix.csv": "(Unix times, while the recorder's clock c",
    "smooth walk --map plan.geojson --truth late.csv": "(exactly 1 h late: time zone?)",
    "smooth walk --map plan.geojson --truth back.csv": "expected times that increase from row to row",
    "smooth walk --map plan.geojson --fixes fixes.csv --truth abroad.csv": "abroad.csv: found each of 2 rows",
    "smooth walk --fixes fixes.csv --beacons anchors.csv --ranges ranges.csv": "found each of 2 anchors 9.0 km",
    "smooth walk --out fixes.csv": "fixes.csv",
    "smooth walk --out walk": "--out: found a folder with",
    "steps walk --out no/such/folder/o.csv": "no/such/folder",
    "evaluate walker.toml truth.csv": "header",
    "evaluate truth.csv nowhere.csv": "nowhere.csv",
    "evaluate relative.csv truth.csv": "expected the same clock",
    "evaluate degrees.csv degrees.csv": "degrees.csv, line 1",
    "evaluate metres.csv degrees.csv": "degrees.csv, line 1",
    "compare metres.csv truth.csv --truth degrees.csv": "degrees.csv, line 1",
    "compare a.tum": "a.tum: found one trajectory, expected two or more, or --truth",
    "compare a.tum graph": "graph: found a method, and no file of that name, expected --recording",
    "compare a.tum a.tum": "the same trajectory twice",
    "compare a.tum later.tum": "later.tum, time: found 7201.000 to 7202.000 (exactly 2 h late: time zone?)",
    "compare a.tum empty": "a folder without trajectory.csv",
    "compare a.tum back.tum": "back.tum, line 2, time: found 1.000000 after 2.000000",
    "compare a.tum short.tum": "short.tum, line 2: found 3 fields",
    "map show truth.csv": "truth.csv",
    "calibrate walk --route nowhere.geojson --out o.toml": "nowhere.geojson",
    "calibrate walk --route maps/arcade.geojson --out o.toml": "'link'",
    "calibrate long/walk.txt --route maps/figure_eight.geojson --out o.toml": "leave the route",
    "smooth": "RECORDING: found no value, expected one (pdr-graph smooth --help)",
    "calibrate walk --out o.toml": "--route: found no value",
    "smooth walk --rate": "--rate: found no value",
    "smooth walk --rate fast": "--rate: found fast, expected a number",
    "smooth walk --method best": "--method: found best, expected one of graph, filter, rts, pdr",
    "smooth walk --mapp plan.geojson": "Unknown option: --mapp. Did you mean --map?",
    "smooth walk --plan plan.geojson": "--plan: found no such option, expected --map",
    "smooth walk --gps a.csv": "--gps: found no such option, expected --fixes",
    "lifelog import walk days.db": "walk: found a folder, expected the lifelog first: pdr-graph lifelog import",
    "smooth walk other": "other: found an argument too many",
    "simulate arcade --seed -1": "--seed: found -1, expected >= 0",
    "serve --port -5": "--port: found -5, expected >= 0",
    "lifelog correct undo days.db 1.5": "N: found 1.5, expected a whole number",
    "simulate atlantis": "arcade, campus",
    "serve --map maps/two_floors.geojson --floor 3 --out o": "expected a floor '3'",
    "serve --map beyond.geojson --out o": "(latitude before longitude?)",
    "replay walk --map maps/mall.geojson --fixes munich.csv --out o": "mall.geojson: found a plan",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command(place, command):
    assert COMMANDS[command] in refusal(place, *command.split())


def test_a_lifelog_refuses_the_plan_that_a_walk_cannot_reach(place, tmp_path):
    given = ("--map", MAPS / "mall.geojson", "--fixes", place / "munich.csv")
    code, printed, errors = run("lifelog", "add", "days.db", place / "walk", *given, cwd=tmp_path)
    assert (code, printed, len(errors)) == (2, "0 added -> days.db\n", 1)
    assert "mall.geojson: found a plan" in errors[0]
    assert list(tmp_path.iterdir()) == []


def test_a_misspelt_command_suggests_the_right_one():
    code, _, errors = run("smoth", "walk.txt")
    assert code == 2
    assert '"smooth"' in errors[-1]


def refused(call, *arguments):
    """The text of an InputError; empty without one."""
    try:
        call(*arguments)
    except InputError as error:
        return str(error)
    return ""


def test_live_beacons_of_another_town(place):
    options = Options(plan=ARCADE, beacons=place / "beacons.csv")
    assert "beacons.csv: found each of 2 beacons 90 km or more from the plan" in refused(navigator_of, options)


@pytest.mark.parametrize(
    ("plan", "initial", "lonlat", "expected"),
    [
        ("here", "31.0,48.0,0", True, "found a plan 1,488 km or more from the only fix, expected a plan within 7.2 km"),
        ("here", "48.0,11.0,0", True, "(latitude and longitude swapped?)"),
        ("here", "649200.0,5318400.0,0", False, "(metres of EPSG:32632?)"),
        ("here", "11.0002,48.0001,0", True, ""),
        ("here", "0,0,0", True, ""),
        ("local", "11.0,48.0,0", True, "found a plan without latitude, expected one that has it"),
        ("local", "20.0,18.0,0", False, ""),
    ],
)
def test_a_trial_that_begins_elsewhere_is_refused_before_its_first_request(place, plan, initial, lonlat, expected):
    path = place / f"{plan}.geojson"
    building = navigator_of(Options(plan=path)).keywords["floor"]
    line = refused(PositionFormat(lonlat, initial).check_begins_near, path, building)
    assert expected in line
    assert bool(line) == bool(expected)


def test_results_in_different_frames_are_not_compared(tmp_path):
    for name, latitude in (("one", 1.0), ("two", 2.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "trajectory.csv").write_text("time,x,y\n1,2,3\n2,3,4\n")
        summary = {"frame": {"kind": "enu", "origin_lat": latitude}}
        (tmp_path / name / "summary.json").write_text(json.dumps(summary))
    line = refusal(tmp_path, "compare", "one", "two")
    assert line.startswith("pdr-graph: two, frame: found kind enu, origin_lat 2.0, expected that of one")


# What is no mistake


ON_FLOOR_F1 = "time,x,y,sigma,floor\n1777629600,2,18,1,F1\n"
ACCEPTED = {
    "by latitude": ("here", lambda walk: table_of(walk, "lon,lat", FRAME.to_lonlat), None),
    "without latitude": ("local", table_of, None),
    "without labels": ("unlabelled", table_of, None),
    "any floor of one without labels": ("unlabelled", table_of, "3"),
    "the only floor under another name": ("plan", lambda walk: ON_FLOOR_F1, None),
}


@pytest.mark.parametrize("case", ACCEPTED)
def test_a_plan_with_its_fixes_is_accepted(place, tmp_path, case):
    plan, fixes, floor = ACCEPTED[case]
    (tmp_path / "f.csv").write_text(fixes(place / "walk"))
    options = Options(plan=place / f"{plan}.geojson", fixes=tmp_path / "f.csv", floor=floor)
    assert len(read(place / "walk", options).fixes) > 0
    server = Options(plan=options.plan, floor=floor)
    assert refused(build, Settings(tmp_path / "server", server), read_inputs(server)[0]) == ""
