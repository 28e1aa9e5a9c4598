"""Likely mistakes, each with what a user should read: one line that names the place, what was found and what to do."""

import gzip
import json
import shutil
import zipfile
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import recorders
import simulated
from commands import run
from test_cli import ARCADE

import pdr_graph as pdr
from pdr_graph.online.interface import Samples

START = 1777629600.0  # Unix time of the walk's first fix [s]
RECORDERS = "expected a recording of a supported recorder: "


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a walk, its plan, and files with a mistake each."""
    folder = tmp_path_factory.mktemp("mistakes")
    simulated.arcade(folder / "walk")
    shutil.copy(folder / "walk" / "plan.geojson", folder / "plan.geojson")
    _tables(folder, [line.split(",") for line in (folder / "walk" / "fixes.csv").read_text().splitlines()[1:]])
    _recordings(folder)
    return folder


def _tables(folder, fixes):
    def table(name, header, rows):
        text = "\n".join([header, *(",".join(map(str, row)) for row in rows)])
        (folder / f"{name}.csv").write_text(text.strip() + "\n")

    def timed(name, time):
        table(name, "time,x,y,sigma", [[time(float(t)), x, y, s] for t, x, y, s, _ in fixes])

    def iso(seconds):
        return datetime.fromtimestamp(seconds, UTC).isoformat()

    table("no-header", "", fixes)
    table("other-names", "when,east,north,error", [row[:4] for row in fixes])
    table("no-sigma", "time,x,y", [row[:3] for row in fixes])
    table("accuracy", "time,x,y,accuracy", [row[:4] for row in fixes])
    table("longitude", "time,latitude,longitude,sigma", [[row[0], 35.0001, 135.0001, 2] for row in fixes])
    table("spaces", "time x y sigma", [[" ".join(row[:4])] for row in fixes])
    timed("late", lambda t: t + 7200)
    timed("iso-late", lambda t: iso(t + 7200).removesuffix("+00:00"))
    timed("iso-broken", lambda t: iso(t) if t < START + 10 else "soon")
    timed("milliseconds", lambda t: 1000 * t)
    timed("nanoseconds", lambda t: int(1e9 * t))
    timed("relative", lambda t: t - START)
    timed("next-day", lambda t: t + 3 * 86400)
    timed("date", lambda t: "01.05.2026 12:00:00")
    table("swapped", "time,lat,lon,sigma", [[row[0], 135.0001, 35.0001, 2] for row in fixes])
    table("degrees", "time,x,y,sigma", [[row[0], 135.0002, 35.0001, 2] for row in fixes])
    table("dms", "time,lat,lon,sigma", [[row[0], "35°00'01\"N", "135°00'01\"E", 2] for row in fixes])
    table("sigma-0", "time,x,y,sigma", [[*row[:3], 0] for row in fixes])
    table("sigma-unit", "time,x,y,sigma", [[*row[:3], "1.5m"] for row in fixes])
    table("millimetres", "time,x,y,sigma", [[t, 1000 * float(x), 1000 * float(y), s] for t, x, y, s, _ in fixes])
    table("truth-late", "time,x,y", [[float(row[0]) + 3600, *row[1:3]] for row in fixes])
    table("truth-back", "time,x,y", [row[:3] for row in fixes[::-1]])
    (folder / "walker.toml").write_text("height = 172\n")


def _recordings(folder):
    (folder / "text.zip").write_text("walk of Monday\n")
    (folder / "page.zip").write_text("<!DOCTYPE html><html><body>Please sign in</body></html>")
    (folder / "cut.zip").write_bytes(b"PK\x03\x04" + b"\0" * 200)
    (folder / "walk.rar").write_bytes(b"Rar!\x1a\x07\x01\x00" + b"\0" * 50)
    (folder / "walk.csv.gz").write_bytes(gzip.compress(b"time,x\n"))
    with zipfile.ZipFile(folder / "walk.xlsx", "w") as archive:
        for name in ("[Content_Types].xml", "xl/workbook.xml"):
            archive.writestr(name, "<x/>")
    (folder / "plan.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 50)
    (folder / "empty.csv").write_bytes(b"")
    (folder / "bare").mkdir()
    (folder / "accelerations.csv").write_text("time,ax,ay,az\n0.00,0.1,0.2,9.8\n0.01,0.1,0.2,9.8\n")
    (folder / "route.gpx").write_text('<gpx version="1.1"><trk><trkseg><trkpt lat="1" lon="2"/></trkseg></trk></gpx>')
    (folder / "result").mkdir()
    for name in ("summary.json", "trajectory.csv"):
        (folder / "result" / name).write_text("{}")
    (folder / "phyphox").mkdir()
    recorders.in_folder(folder / "phyphox", recorders.phyphox(recorders.sample()))
    for file in (folder / "phyphox").rglob("time.csv"):
        file.unlink()


SMOOTH = ("smooth", "walk", "--map", "plan.geojson", "--out", "out")
# Command, and the text that its one line should have
COMMANDS = {
    "fixes without a header": ((*SMOOTH, "--fixes", "no-header.csv"), "line 1: found 1777629600.000,1.580,18.014"),
    "the cause of it": ((*SMOOTH, "--fixes", "no-header.csv"), "(is the header missing?), expected a header with time"),
    "columns of other names": ((*SMOOTH, "--fixes", "other-names.csv"), "found when,east,north,error, expected a head"),
    "a column is missing": ((*SMOOTH, "--fixes", "no-sigma.csv"), "found time,x,y (sigma is missing), expected"),
    "accuracy for sigma": ((*SMOOTH, "--fixes", "accuracy.csv"), "(sigma is a phone's accuracy divided by 1.51)"),
    "latitude spelt out": ((*SMOOTH, "--fixes", "longitude.csv"), "(lat and lon are the names of latitude and long"),
    "columns between spaces": ((*SMOOTH, "--fixes", "spaces.csv"), "(columns between spaces? write commas)"),
    "another time zone": ((*SMOOTH, "--fixes", "late.csv"), "(exactly 2 h late: time zone?), expected times within"),
    "ISO 8601 in local time": ((*SMOOTH, "--fixes", "iso-late.csv"), "(exactly 2 h late: time zone?)"),
    "ISO 8601 broken": ((*SMOOTH, "--fixes", "iso-broken.csv"), "line 5, time: found 'soon', expected ISO 8601 as in"),
    "ISO 8601, no clock": (("smooth", "phyphox", "--fixes", "iso-late.csv"), "phyphox does not state its date"),
    "milliseconds": ((*SMOOTH, "--fixes", "milliseconds.csv"), "(milliseconds?), expected times within the recording"),
    "nanoseconds": ((*SMOOTH, "--fixes", "nanoseconds.csv"), "(nanoseconds? seconds are expected)"),
    "relative times": ((*SMOOTH, "--fixes", "relative.csv"), "(seconds from the start instead of the recorder's clo"),
    "Unix times, no clock": (("smooth", "phyphox", "--fixes", "late.csv"), "(Unix times, while the recorder's clock c"),
    "another date": ((*SMOOTH, "--fixes", "next-day.csv"), "(exactly 3 days late: another date?)"),
    "a date": ((*SMOOTH, "--fixes", "date.csv"), "(a date or a clock time? write seconds or ISO 8601, 2024-05-01T1"),
    "latitude and longitude": ((*SMOOTH, "--fixes", "swapped.csv"), "(latitude and longitude swapped?)"),
    "degrees as x and y": ((*SMOOTH, "--fixes", "degrees.csv"), "(time,lat,lon,sigma in the header?)"),
    "degrees and minutes": ((*SMOOTH, "--fixes", "dms.csv"), "(degrees and minutes? write decimal degrees, south and"),
    "a sigma of 0": ((*SMOOTH, "--fixes", "sigma-0.csv"), "data row 1, sigma: found 0, expected a standard dev"),
    "a unit in a cell": (
        (*SMOOTH, "--fixes", "sigma-unit.csv"),
        "line 2, sigma: found '1.5m' (a unit in the cell? wri",
    ),
    "millimetres": ((*SMOOTH, "--fixes", "millimetres.csv"), "(millimetres?)"),
    "a truth an hour late": ((*SMOOTH, "--truth", "truth-late.csv"), "(exactly 1 h late: time zone?)"),
    "a truth backwards": ((*SMOOTH, "--truth", "truth-back.csv"), "expected times that increase from row to row"),
    "a height in centimetres": ((*SMOOTH, "--height", "172"), "--height: found 172.0 (centimetres?), expected metres"),
    "the same in a file": (
        (*SMOOTH, "--walker", "walker.toml"),
        "walker.toml, height: found 172 (centimetres?), expected",
    ),
    "a latency in ms": ((*SMOOTH, "--gnss-latency", "2000"), "--gnss-latency: found 2000.0 (milliseconds?), expected"),
    "another floor": ((*SMOOTH, "--floor", "F1"), "plan.geojson: found the floors 1, expected a floor 'F1' (1?)"),
    "a text named zip": (
        ("smooth", "text.zip"),
        "found a text named .zip that begins with 'walk of Monday', " + RECORDERS,
    ),
    "a web page named zip": (("smooth", "page.zip"), "found a web page (was the download a login page or a message?)"),
    "half a zip": (("smooth", "cut.zip"), "expected a complete zip: was the download cut off?"),
    "a RAR archive": (("smooth", "walk.rar"), "found a RAR archive, expected a zip, a folder or a file (unpack it"),
    "a gzip archive": (("smooth", "walk.csv.gz"), "found a gzip archive, expected a zip"),
    "an Excel file": (("smooth", "walk.xlsx"), "found an Excel file, expected CSV: save each table as CSV, or export"),
    "an empty file": (("smooth", "empty.csv"), "found an empty file, " + RECORDERS),
    "an empty folder": (("smooth", "bare"), "found an empty folder, " + RECORDERS),
    "a plan as recording": (
        ("smooth", "plan.geojson"),
        "found GeoJSON, expected a recording (is this a floor plan? --",
    ),
    "a picture of a plan": (("smooth", "plan.png"), "found a PNG picture, expected a recording (is this a floor plan"),
    "fixes as recording": (("smooth", "late.csv"), "with the header time,x,y,sigma, expected a recording (are these"),
    "truth as recording": (("smooth", "truth-late.csv"), "(is this a trajectory? evaluate and --truth take it)"),
    "a result as recording": (("smooth", "result"), "found a result of pdr-graph, expected the recording that it was"),
    "an unknown table": (("smooth", "accelerations.csv"), "with the header time,ax,ay,az, expected a recording; a tab"),
    "a route without times": (("smooth", "route.gpx"), "found 1 track points, none with a time, expected <trkpt> with"),
    "no such file": (("smooth", "nowhere.zip"), "nowhere.zip: found no such file, expected a recording"),
    "a path, no command": (
        ("walk",),
        "found a path and no command, expected a command before it: pdr-graph smooth walk",
    ),
    "the recording as --out": (("smooth", "walk", "--out", "walk"), "--out: found a folder with"),
    "a clock of its own": (("evaluate", "relative.csv", "truth-late.csv"), "expected the same clock"),
}


@pytest.mark.parametrize("mistake", COMMANDS)
def test_a_mistake_on_the_command_line_is_one_line_that_explains_it(place, mistake):
    arguments, text = COMMANDS[mistake]
    code, printed, errors = run(*arguments, cwd=place)
    assert (code, printed, len(errors)) == (2, "", 1), errors
    assert errors[0].startswith("pdr-graph: ")
    assert text in errors[0]


def walk():
    return pdr.Fixes(np.arange(3.0), np.zeros((3, 2)), np.ones(3))


# Call, and the text of the exception
CALLS = {
    "an unknown sensor": (
        lambda: pdr.Navigator().push(Samples("acc", np.zeros(1), np.zeros((1, 3)))),
        r"found 'acc' \(accelerometer\?\), expected one of accelerometer, gyroscope, magnetometer, linear",
    ),
    "samples of one axis": (
        lambda: pdr.Navigator().push(Samples("gyroscope", np.zeros(2), np.zeros((2, 1)))),
        r"found shape \(2, 1\) at 2 times, expected \(2, 3\)",
    ),
    "a height in centimetres": (lambda: pdr.Walker(height=172), "found 172, expected metres between 0 and 3"),
    "a sigma of 0": (lambda: replace(walk(), sigma=np.zeros(3)), r"Fixes\.sigma"),
    "a NaN": (lambda: replace(walk(), position=np.full((3, 2), np.nan)), r"Fixes\.position: found row 0"),
    "a path for a recording": (lambda: pdr.detect_steps("walk.zip"), "expected"),
    "a path for a plan": (lambda: pdr.Navigator("plan.geojson"), "expected FloorPlan or Building or None"),
    "an event of another type": (lambda: pdr.Navigator().push(1.0), r"Navigator\.push, event: found float 1\.0"),
}


@pytest.mark.parametrize("mistake", CALLS)
def test_a_mistake_in_python_is_an_exception_that_explains_it(mistake):
    call, text = CALLS[mistake]
    with pytest.raises((ValueError, TypeError), match=text) as raised:
        call()
    assert "\n" not in str(raised.value)


def test_a_live_clock_in_milliseconds_is_named_by_the_status():
    nav = pdr.Navigator()
    for time in range(0, 5000, 10):
        nav.push(Samples("accelerometer", np.array([float(time)]), np.array([[0.0, 0.0, 9.8]])))
    assert any("times in milliseconds: seconds are expected" in issue for issue in nav.status.issues)


def test_times_in_iso_8601_are_no_mistake(place, tmp_path):
    """With an offset, with Z or in UTC without; in fixes, truth, ranges and evaluate."""
    lines = (place / "walk" / "fixes.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    times = [datetime.fromtimestamp(float(row[0]), UTC) for row in rows]
    forms = [time.isoformat() if n % 2 else time.strftime("%Y-%m-%d %H:%M:%SZ") for n, time in enumerate(times)]
    fixes = tmp_path / "fixes.csv"
    fixes.write_text("\n".join([lines[0], *(",".join([t, *row[1:]]) for t, row in zip(forms, rows, strict=True))]))
    recording = pdr.load(place / "walk")
    plain = pdr.read_fixes(place / "walk" / "fixes.csv", recording)
    assert pdr.read_fixes(fixes, recording).time == pytest.approx(plain.time, abs=1e-6)
    assert pdr.read_trajectory(fixes).time == pytest.approx(plain.time + recording.clock_origin, abs=1e-6)
    clock = replace(recording, clock_origin=5.0)  # another clock of the recorder, at the same date
    assert pdr.read_fixes(fixes, clock).time == pytest.approx(plain.time, abs=1e-6)


@pytest.mark.parametrize("command", ["smooth", "replay"])
def test_a_gpx_track_is_a_recording_without_steps(tmp_path, command):
    """Nothing is missing that it had: exit code 0, with a note."""
    points = "".join(
        f'<trkpt lat="{35 + n * 1e-5:.6f}" lon="135"><time>2026-05-01T10:00:{n:02d}Z</time></trkpt>' for n in range(40)
    )
    track = tmp_path / "walk.gpx"
    track.write_text(f'<gpx version="1.1"><trk><trkseg>{points}</trkseg></trk></gpx>')
    code, printed, errors = run(command, track, "--out", tmp_path / "out")
    assert (code, errors) == (0, [])
    assert "note: positions alone: the recording has no accelerometer" in printed
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["missing"] == []


def test_there_are_more_than_forty():
    assert len(COMMANDS) + len(CALLS) >= 40
    assert ARCADE.exists()
