"""Recordings of positions alone: GPX and GeoLife, as recordings and as fixes for another recording."""

import numpy as np
import pytest
from refusals import refused

from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_fixes
from pdr_graph.io.validation import RADIUS_68, receiver_fixes, without_rollover
from pdr_graph.types import LONLAT, Recording, Signal

UNIX = 1_700_000_000.0  # 2023-11-14T22:13:20Z
WALK = Recording("walk", 0.0, UNIX, accelerometer=Signal(np.arange(0.0, 60.0, 0.02), np.zeros((3000, 3))))


def gpx(points, version="1/1", head='<?xml version="1.0" encoding="UTF-8"?>'):
    return (
        f'{head}<gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/{version}"><trk><trkseg>'
        + "".join(points)
        + "</trkseg></trk></gpx>"
    )


def point(time="2023-11-14T22:13:20Z", lat=49.45, lon=11.1, more=""):
    return f'<trkpt lat="{lat}" lon="{lon}"><ele>3</ele><time>{time}</time>{more}</trkpt>'


def written(tmp_path, text, name="track.gpx"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "time", ["2023-11-14T22:13:25Z", "2023-11-14T22:13:25.000Z", "2023-11-14T23:13:25+01:00", "2023-11-14T22:13:25"]
)
@pytest.mark.parametrize("version", ["1/0", "1/1"])
def test_reader_gpx(tmp_path, time, version):
    walk = load(written(tmp_path, gpx([point(), point(time, lon=11.2)], version)))
    assert walk.epoch == walk.clock_origin == UNIX
    assert walk.fixes.time == pytest.approx([0.0, 5.0])
    assert walk.fixes.position == pytest.approx(np.array([[11.1, 49.45], [11.2, 49.45]]))
    assert walk.fixes.epsg == LONLAT
    assert walk.accelerometer is None


# 68 % radius [m] of a point as each app writes it, and its own file's begin where that decides the meaning
APPS = {
    "Apple Health": ("Apple Health Export", "<extensions><speed>1</speed><hAcc>35</hAcc><vAcc>2</vAcc></extensions>"),
    "Open GPX Tracker": ("Open GPX Tracker for iOS", "<extensions><hAcc>35</hAcc></extensions>"),
    "OpenTracks": ("OpenTracks", "<extensions><o:accuracy_horizontal>35</o:accuracy_horizontal></extensions>"),
    "PhoneTrack": ("PhoneTrack", "<sat>7</sat><hdop>2</hdop><extensions><accuracy>35.00</accuracy></extensions>"),
    "ulogger": ("ulogger-server 1.2", "<extensions><ulogger:accuracy>35</ulogger:accuracy></extensions>"),
    "pdr_graph": ("pdr_graph", '<extensions><p:accuracy xmlns:p="urn:p">35.00</p:accuracy></extensions>'),
    "Overland": ("Compass", "<extensions><horizontal_accuracy>35</horizontal_accuracy></extensions>"),
    "camelCase": ("HealthFit", "<extensions><x:horizontalAccuracy>35</x:horizontalAccuracy></extensions>"),
    "HERE": ("", "<e:horaccur>35</e:horaccur>"),
    "OsmAnd": ("OsmAnd~ 4.7.1", "<hdop>35.0</hdop>"),
    "OsmAnd+": (
        "OsmAnd Maps 4.2.3 (4.2.3)",
        "<hdop>35.0</hdop><extensions><osmand:speed>1</osmand:speed></extensions>",
    ),
    "Locus": ("Locus Map, Android", "<hdop>35.0</hdop>"),
    "OSMTracker": ("OSMTracker for Android™ - https://github.com/labexp/osmtracker-android", "<hdop>8.75</hdop>"),
    "GPSLogger": ("GPSLogger 130 - http://gpslogger.mendhak.com/", f"<sat>9</sat><hdop>{35 / 5.3}</hdop>"),
    "gpsbabel": ("GPSBabel - https://www.gpsbabel.org", f"<fix>3d</fix><hdop>{35 / 5.3}</hdop><vdop>1</vdop>"),
}


@pytest.mark.parametrize("app", APPS)
def test_the_accuracy_that_an_app_states_is_read(tmp_path, app):
    """In metres, also as OsmAnd's and Locus' hdop and as a fourth of it by OSMTracker; only a receiver's is an HDOP."""
    creator, more = APPS[app]
    track = gpx([point(more=more), point("2023-11-14T22:13:25Z", more=more)]).replace('"test"', f'"{creator}"')
    walk = load(written(tmp_path, track))
    assert walk.fixes.sigma == pytest.approx([35 / RADIUS_68] * 2)
    assert not any("accuracy" in note for note in walk.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (gpx([point()])[:-30], "1 track points before an end in the middle, none with a time"),
        (gpx([]), "0 track points"),
        (gpx(['<trkpt lat="1" lon="2"/>']), "none with a time"),
        (gpx([point(lat="north")]), "1 of 1 track points without a valid time, lat and lon, .* nan, 11.1"),
        (gpx([point("yesterday")]), "yesterday"),
        (gpx([point()], head='<!DOCTYPE gpx [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'), "document type"),
        (gpx([point("&b;")], head='<!DOCTYPE gpx [<!ENTITY b SYSTEM "file:///etc/passwd">]>'), "document type"),
    ],
)
def test_broken_and_hostile_gpx_raises_one_line(tmp_path, text, message):
    refused(load, written(tmp_path, text), message)


PLT = "Geolife trajectory\nWGS 84\nAltitude is in Feet\nReserved 3\n0,2,255,My Track,0,0,2,8421376\n0\n"


def test_reader_geolife(tmp_path):
    """Days since 1899-12-30: the row in the description of the format, and one five seconds later."""
    rows = "39.9,116.3,0,492,39747.1124074074,2008-10-26,02:41:52\n"
    rows += "39.9,116.4,0,-777,39747.1124652778,2008-10-26,02:41:57\n"
    walk = load(written(tmp_path, PLT + rows, "20081026024152.plt"))
    assert walk.epoch == 1_224_988_912.0
    assert walk.fixes.time.tolist() == [0.0, 5.0]
    assert walk.fixes.position.tolist() == [[116.3, 39.9], [116.4, 39.9]]


@pytest.mark.parametrize("year", ["5138", "9999", "2300", "1969"])
def test_a_point_of_no_time_is_left_out(tmp_path, year):
    """Of the year 5138, say: a lifelog would have a million days."""
    whole = [point(f"2023-11-14T22:13:{n:02d}Z", lon=11 + n / 1e4) for n in range(20)]
    bad = point(f"{year}-11-14T22:13:20Z")
    walk = load(written(tmp_path, gpx([*whole, bad])))
    assert len(walk.fixes) == 20
    assert any("1 track point without a valid time and place" in note for note in walk.notes)
    rows = "".join(f"39.9,116.3,0,492,{39747.1 + n / 86400:.10f},2008-10-26,02:41:52\n" for n in range(9))
    days = {"5138": 1e13, "9999": 2958465.9, "2300": 146097.0 + 45000, "1969": 20000.0}[year]
    walk = load(written(tmp_path, f"{PLT}{rows}39.9,116.3,0,492,{days},2008-10-26,02:41:52\n", "20081026024152.plt"))
    assert len(walk.fixes) == 9


def test_a_track_of_a_watch_can_be_the_fixes_of_a_phone(tmp_path):
    fixes = read_fixes(written(tmp_path, gpx([point("2023-11-14T22:13:30Z")])), WALK)
    assert fixes.time == pytest.approx([10.0])
    clockless = Recording("walk", 0.0, None, accelerometer=WALK.accelerometer)
    refused(read_fixes, written(tmp_path, gpx([point()])), "a recording with a clock", clockless)


def test_simulated_fixes_of_ipin21_are_metres_with_the_error_in_the_file_name(tmp_path):
    row = "1.700000010000000000e+12,5.665786341145318002e+05,5.932830475879570469e+06,2.027584508371089100e+01\n"
    fixes = read_fixes(written(tmp_path, row, "freq10_s_err3m.csv"), WALK)
    assert fixes.time == pytest.approx([10.0])
    assert fixes.position == pytest.approx(np.array([[566578.634, 5932830.476]]), abs=1e-3)
    assert fixes.sigma == pytest.approx([np.sqrt(3)])
    assert fixes.epsg == 32632
    refused(read_fixes, written(tmp_path, row, "fixes.csv"), "its name", WALK)


def test_invalid_positions_are_left_out():
    invalid = [[0, 0, 0, 5], [1, 95, 11, 5], [2, np.nan, 11, 5], [3, 49, 11, -1]]
    notes = []
    fixes = receiver_fixes(np.array([*invalid, [5, 49, 11, 0], [4, 49, 11, 1.51], [4, 49, 11, 1.51]], float), notes)
    assert fixes.time.tolist() == [4.0, 5.0]
    assert fixes.sigma[0] == pytest.approx(1.0)
    assert [note.split()[1] for note in notes] == ["4", "1", "1"]


@pytest.mark.parametrize("first", [0, 1], ids=["the first is right", "the first is among them"])
def test_times_of_a_receiver_that_lost_1024_weeks_are_put_right(first):
    time, lost = 1.7e9 + 30 * np.arange(12.0) + 30_000 * (np.arange(12) > 4), np.arange(12) % 3 != first
    notes = []
    mended = without_rollover(time - 1024 * 7 * 86400 * lost, "GPX", notes)
    assert mended == pytest.approx(time)
    assert len(notes) == 1
    years = np.array([1.1e9, 1.1e9 + 60, 1.7e9, 1.7e9 + 60])  # two days of one person
    assert without_rollover(years, "GPX", notes) == pytest.approx(years)
    assert len(notes) == 1
