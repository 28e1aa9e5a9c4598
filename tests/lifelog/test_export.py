"""Exports have the content of the day: checked with independent readers, our own reader and the standards."""

import csv
import io
import json
import stat
from dataclasses import replace
from datetime import datetime
from itertools import pairwise

import gpxpy
import numpy as np
import pytest
import shapely
from lxml import etree
from made_days import HERE, NOWHERE, day, outing, stay
from typer.testing import CliRunner

from pdr_graph.apps.cli import app
from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING, rows_of
from pdr_graph.apps.lifelog.export import as_csv, as_geojson, as_gpx, export_days, not_exported
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.store import Entry, RecordingOptions, Store
from pdr_graph.errors import InputError
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory

WAY = [(WALKING, 100.0, 0.0), (GAP, 300.0, 0.5), (VEHICLE, 60.0, 1.0), (STANDING, 200.0, 1.0), (WALKING, 50.0, 2.0)]
KIOSK = stay(460, 660, (600.0, 700.0), [("Kiosk <1>", 0.8), ("Bank", 0.1)], floor="F1", sigma=3.0)
BY = stay(10, 20, (12.0, 0.0), passing=True)
DAY = day(outing(WAY, stays=[BY, KIOSK], sigma=4.0))
NAMESPACE = "{http://www.topografix.com/GPX/1/1}"


def shown(made):
    """The rows outside gaps."""
    return made.outings[0].trajectory


def test_our_reader_reads_a_gpx_back(tmp_path):
    (tmp_path / "day.gpx").write_bytes(as_gpx([DAY]))
    walk = load(tmp_path / "day.gpx")
    track = shown(DAY)
    assert walk.epoch + walk.fixes.time == pytest.approx(DAY.outings[0].epoch + track.time, abs=1e-3)
    assert HERE.from_lonlat(walk.fixes.position) == pytest.approx(track.position, abs=0.002)  # eight decimals
    assert walk.fixes.sigma == pytest.approx(np.full(len(track), 4.0), abs=0.01)  # two decimals of a radius
    assert not walk.notes


def test_a_gap_divides_a_track_and_a_stay_is_a_waypoint():
    gpx = gpxpy.parse(as_gpx([DAY]).decode())
    [track] = gpx.tracks
    assert [len(segment.points) for segment in track.segments] == [101, 311]
    [place] = gpx.waypoints  # the slow pass is none
    assert place.name == "Kiosk <1> (80%)"
    assert place.time.timestamp() == DAY.outings[0].epoch + 460
    assert HERE.from_lonlat(np.array([[place.longitude, place.latitude]]))[0] == pytest.approx((600, 700), abs=0.01)


def test_an_outing_is_a_track():
    later = replace(DAY.outings[0], epoch=DAY.outings[0].epoch + 5000, stays=())
    gpx = gpxpy.parse(as_gpx([day(DAY.outings[0], later)]).decode())
    assert [track.name for track in gpx.tracks] == ["Anna 2024-05-01, 1", "Anna 2024-05-01, 2"]


def test_a_gpx_is_valid_by_its_schema():
    """Children are in the order of GPX 1.1; other namespaces are in extensions only."""
    root = etree.fromstring(as_gpx([DAY]))
    order = ["wpt", "trk"], ["name", "trkseg"], ["time", "name", "extensions"]
    assert root.tag == NAMESPACE + "gpx"
    assert root.get("version") == "1.1"
    for element in root.iter(NAMESPACE + "*"):
        own = [child.tag.removeprefix(NAMESPACE) for child in element]
        expected = {"gpx": order[0], "trk": order[1], "wpt": order[2], "trkpt": order[2]}
        known = expected.get(element.tag.removeprefix(NAMESPACE))
        if known:
            assert [known.index(name) for name in own] == sorted(known.index(name) for name in own)
        if element.tag == NAMESPACE + "extensions":
            assert all("urn:pdr_graph" in child.tag for child in element)


def test_geojson_has_a_line_for_each_segment_and_a_point_for_each_stay():
    collection = json.loads(as_geojson([DAY]))
    features = collection["features"]
    assert set(collection) == {"type", "features"}  # RFC 7946: no crs
    assert [f["properties"]["kind"] for f in features] == [WALKING, VEHICLE, STANDING, WALKING, "passing", "stay"]
    lines, points = features[:4], features[4:]
    for line in lines:
        own = line["properties"]
        assert line["geometry"]["type"] == "LineString"
        assert len(line["geometry"]["coordinates"]) == len(own["times"]) == len(own["covariances"]) >= 2
        assert datetime.fromisoformat(own["start"]).timestamp() == pytest.approx(own["times"][0])
        assert all(xx == yy == 16 and xy == 0 for xx, xy, yy in own["covariances"])
        assert shapely.get_num_coordinates(shapely.from_geojson(json.dumps(line["geometry"]))) == len(own["times"])
    for one, other in pairwise(lines[1:]):  # no hole between segments that follow one another
        assert one["geometry"]["coordinates"][-1] == other["geometry"]["coordinates"][0]
    assert sum(line["properties"]["distance"] for line in lines) == pytest.approx(150 * 1.25 + 600)
    kiosk = points[1]["properties"]
    assert kiosk["facing"] == [{"name": "Kiosk <1>", "probability": 0.8}, {"name": "Bank", "probability": 0.1}]
    assert kiosk["covariance"] == [9, 0, 9]
    assert kiosk["heading"] is None
    assert HERE.from_lonlat(np.array([points[1]["geometry"]["coordinates"]]))[0] == pytest.approx((600, 700), abs=0.01)


def test_consecutive_segments_share_a_point_except_at_a_gap():
    """Where a segment ends between two rows, both have an interpolated point."""
    made = outing([(WALKING, 10.0, 0.0), (STANDING, 10.0, 0.0)])
    walking, standing = made.segments
    made = replace(made, segments=(replace(walking, end=7.25), replace(standing, start=7.25)))
    one, other = json.loads(as_geojson([day(made)]))["features"]
    meeting = HERE.from_lonlat(np.array([one["geometry"]["coordinates"][-1]]))[0]
    assert meeting == pytest.approx((7.25 * 1.25, 0), abs=0.01)
    assert other["geometry"]["coordinates"][0] == one["geometry"]["coordinates"][-1]


def test_a_csv_is_a_trajectory_in_unix_time(tmp_path):
    """Our own reader reads it; latitude and longitude are beside it."""
    (tmp_path / "day.csv").write_bytes(as_csv(DAY))
    track, again = shown(DAY), read_trajectory(tmp_path / "day.csv")
    assert again.time == pytest.approx(DAY.outings[0].epoch + track.time)
    assert again.position == pytest.approx(track.position, abs=1e-4)
    assert again.covariance == pytest.approx(track.covariance, abs=1e-3)
    rows = list(csv.DictReader(io.StringIO(as_csv(DAY).decode())))
    lonlat = np.array([(float(row["longitude"]), float(row["latitude"])) for row in rows])
    assert HERE.from_lonlat(lonlat) == pytest.approx(track.position, abs=0.002)
    assert {row["outing"] for row in rows} == {"1"}


def test_an_outing_without_absolute_position_is_noted():
    nowhere = day(outing(WAY, frame=NOWHERE, stays=[KIOSK]))
    assert not gpxpy.parse(as_gpx([nowhere]).decode()).tracks
    assert json.loads(as_geojson([nowhere]))["features"] == []
    [note] = not_exported([nowhere])
    assert "Anna, 2024-05-01: outing 1" in note
    rows = list(csv.DictReader(io.StringIO(as_csv(nowhere).decode())))
    assert rows[0]["latitude"] == ""
    assert float(rows[-1]["x"]) == pytest.approx(nowhere.outings[0].trajectory.position[-1, 0], abs=1e-3)


def test_no_export_has_paths_of_recordings_or_plans():
    text = as_gpx([DAY]) + as_geojson([DAY]) + as_csv(DAY)
    for private in (b"/home/anna", b"5f3b", b"a note"):
        assert private not in text


@pytest.fixture
def store(tmp_path):
    """A lifelog of two people: two days of Anna, and a day of Ben without absolute position."""
    path, nowhere = tmp_path / "days.db", day(outing(WAY, frame=NOWHERE))
    with Store(path, new=True) as log:
        log.put_setting("zone", "America/Santiago")
        [own] = DAY.outings
        later = replace(DAY, date="2024-05-02", outings=(replace(own, epoch=own.epoch + 86400),))
        for made in (DAY, later, replace(nowhere, person="Ben/../C")):
            log.put_day(rows_of(made, "key", ["5f3b" * 16]))
    return path


def run(*words):
    return CliRunner().invoke(app, ["lifelog", *map(str, words)])


def test_show_prints_a_day_and_writes_it_for_its_owner_alone(store, tmp_path):
    result = run("show", store, "--person", "Anna", "--date", "2024-05-02", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert result.output.startswith("Anna  Thursday 2024-05-02")
    assert "note: home: a note" in result.output  # what its outings say, to its owner
    folder = tmp_path / "out"
    assert {"day.geojson", "day.png", "report.html", "timeline.csv"} <= {f.name for f in folder.iterdir()}
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert all(stat.S_IMODE(f.stat().st_mode) == 0o600 for f in folder.iterdir())
    assert (folder / "day.png").read_bytes()[:4] == b"\x89PNG"


def test_show_lists_persons_and_dates(store):
    lines = run("show", store, "--all").output.split("\n")
    assert lines[:3] == [
        "Anna  2024-05-01  1 recording",
        "Anna  2024-05-02  1 recording",
        "Ben/../C  2024-05-01  1 recording",
    ]


def test_show_refuses_a_person_without_days(store):
    with pytest.raises(InputError, match="one of Anna"):
        show(store, Choice(("Carl",)))


@pytest.mark.parametrize(("form", "each"), [("gpx", 1), ("geojson", 1), ("csv", 2)])
def test_export_writes_files_for_their_owner_alone(store, tmp_path, form, each):
    result = run("export", store, "--out", tmp_path / "out", "--format", form)
    assert result.exit_code == 0, result.output
    found = sorted(f.name for f in (tmp_path / "out").iterdir())
    assert len(found) == each * (3 if form == "csv" else 2)
    assert all(name.startswith(("Anna_2024", "Ben%2F..%2FC_2024")) for name in found)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o700
    assert all(stat.S_IMODE(f.stat().st_mode) == 0o600 for f in (tmp_path / "out").iterdir())


def test_export_selects_days_by_date_and_person(store, tmp_path):
    written, _ = export_days(store, tmp_path / "all.geojson", "geojson")
    assert written == [tmp_path / "all.geojson"]
    both = json.loads(written[0].read_bytes())["features"]
    assert {f["properties"]["date"] for f in both} == {"2024-05-01", "2024-05-02"}
    export_days(store, tmp_path / "one.geojson", "geojson", "Anna", since="2024-05-02", until="2024-05-02")
    one = json.loads((tmp_path / "one.geojson").read_bytes())["features"]
    assert {f["properties"]["date"] for f in one} == {"2024-05-02"}
    for asked, complaint in (
        ({"since": "2024-06-01"}, "2024-05-02"),
        ({"until": "May"}, "a date such as"),
        ({"person": "Carl"}, "Carl"),
        ({"file_format": "csv", "out": tmp_path / "a.csv"}, "a folder"),
    ):
        with pytest.raises(InputError, match=complaint):
            export_days(store, **({"out": tmp_path / "x", "file_format": "gpx"} | asked))


def test_export_cuts_the_same_area_every_time(store, tmp_path):
    """The secret of the lifelog determines the area, so that many exports reveal no more than one."""
    lon, lat = HERE.to_lonlat(np.array([[0.0, 0.0]]))[0]
    place = f"{lat:.6f},{lon:.6f},60"  # a latitude below zero begins like an option
    contents = []
    for name in ("a.geojson", "b.geojson"):
        result = run(
            "export", store, "--person", "Anna", "--out", tmp_path / name, "--format", "geojson", "--cut", place
        )
        assert result.exit_code == 0, result.output
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]
    plain, _ = export_days(store, tmp_path / "c.geojson", "geojson", "Anna")
    assert len(plain[0].read_bytes()) > len(contents[0])
    blurred, _ = export_days(store, tmp_path / "d.geojson", "geojson", "Anna", blur=[place])
    assert any(f["properties"]["kind"] == "private" for f in json.loads(blurred[0].read_bytes())["features"])


def test_a_place_on_a_plan_of_the_lifelog_is_cut_by_its_name(store, tmp_path):
    squares = {"floor": 50.0, "shop": 20.0}
    features = [
        {
            "type": "Feature",
            "properties": {"kind": kind, "name": "Home"},
            "geometry": {"type": "Polygon", "coordinates": [square(half)]},
        }
        for kind, half in squares.items()
    ]
    plan = tmp_path / "plan.geojson"
    plan.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    with Store(store) as log:
        log.put(Entry("5f3b" * 16, "Anna", "walk.txt", RecordingOptions(plan=plan)))
    plain, _ = export_days(store, tmp_path / "a.geojson", "geojson", "Anna")
    cut, _ = export_days(store, tmp_path / "b.geojson", "geojson", "Anna", cut=["home"])
    assert len(cut[0].read_bytes()) < len(plain[0].read_bytes())
    with pytest.raises(InputError, match="no such name on 1 plans"):
        export_days(store, tmp_path / "c.geojson", "geojson", cut=["office"])


def square(half):
    """Corners [deg] of a square about the start of the day, with sides of twice `half` [m]."""
    x = np.array([-1.0, 1.0, 1.0, -1.0, -1.0])
    return HERE.to_lonlat(half * np.column_stack([x, np.roll(x, 1)])).tolist()


def test_a_completely_private_day_is_noted_and_not_written(store, tmp_path):
    lon, lat = HERE.to_lonlat(np.array([[0.0, 0.0]]))[0]
    written, lines = export_days(store, tmp_path / "out", "gpx", "Anna", cut=[f"{lat},{lon},50000"])
    assert not written
    assert lines == ["Anna, 2024-05-01: nothing left to export", "Anna, 2024-05-02: nothing left to export"]
