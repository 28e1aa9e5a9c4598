"""Exports have the content of the day: checked with independent readers, our own reader and the standards."""

import csv
import io
import json
import stat
import sys
from dataclasses import replace
from datetime import datetime
from itertools import pairwise

import commands
import gpxpy
import made_tracks as made
import numpy as np
import pytest
import shapely
from lxml import etree
from made_days import HERE, NOWHERE, day, outing, stay
from made_month import HOME, OFFICE, made_month

from pdr_graph.apps.lifelog import revision
from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING, rows_of
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.export import (
    as_csv,
    as_geojson,
    as_gpx,
    as_trips,
    export_days,
    not_exported,
    parquet_tables,
)
from pdr_graph.apps.lifelog.facts import Guess
from pdr_graph.apps.lifelog.show import Choice, show
from pdr_graph.apps.lifelog.store import Entry, RecordingOptions, Store
from pdr_graph.errors import InputError
from pdr_graph.frames import enu
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_trajectory

WAY = [(WALKING, 100.0, 0.0), (GAP, 300.0, 0.5), (VEHICLE, 60.0, 1.0), (STANDING, 200.0, 1.0), (WALKING, 50.0, 2.0)]
KIOSK = stay(460, 660, (600.0, 700.0), [("Kiosk <1>", 0.8), ("Bank", 0.1)], floor="F1", sigma=3.0)
BY = stay(10, 20, (12.0, 0.0), passing=True)
DAY = day(outing(WAY, stays=[BY, KIOSK], sigma=4.0))
TRACK = DAY.outings[0].trajectory  # the rows outside gaps
NAMESPACE = "{http://www.topografix.com/GPX/1/1}"


def test_our_reader_reads_a_gpx_back(tmp_path):
    (tmp_path / "day.gpx").write_bytes(as_gpx([DAY]))
    walk = load(tmp_path / "day.gpx")
    assert walk.epoch + walk.fixes.time == pytest.approx(DAY.outings[0].epoch + TRACK.time, abs=1e-3)
    assert HERE.from_lonlat(walk.fixes.position) == pytest.approx(TRACK.position, abs=0.002)  # eight decimals
    assert walk.fixes.sigma == pytest.approx(np.full(len(TRACK), 4.0), abs=0.01)  # two decimals of a radius
    assert not walk.notes


def test_an_outing_is_a_track_that_a_gap_divides_and_a_stay_a_waypoint():
    later = replace(DAY.outings[0], epoch=DAY.outings[0].epoch + 5000, stays=())
    gpx = gpxpy.parse(as_gpx([day(DAY.outings[0], later)]).decode())
    assert [track.name for track in gpx.tracks] == ["Anna 2024-05-01, 1", "Anna 2024-05-01, 2"]
    assert [len(segment.points) for segment in gpx.tracks[0].segments] == [101, 311]
    [place] = gpx.waypoints  # the slow pass is none
    assert place.name == "Kiosk <1> (80%)"
    assert place.time.timestamp() == DAY.outings[0].epoch + 460
    assert HERE.from_lonlat(np.array([[place.longitude, place.latitude]]))[0] == pytest.approx((600, 700), abs=0.01)


POINT = ["time", "name", "extensions"]
ORDER = {"gpx": ["wpt", "trk"], "trk": ["name", "trkseg"], "wpt": POINT, "trkpt": POINT}


def test_a_gpx_is_valid_by_its_schema():
    """Children are in the order of GPX 1.1; other namespaces are in extensions only."""
    root = etree.fromstring(as_gpx([DAY]))
    assert (root.tag, root.get("version")) == (NAMESPACE + "gpx", "1.1")
    for element in root.iter(NAMESPACE + "*"):
        own = [child.tag.removeprefix(NAMESPACE) for child in element]
        known = ORDER.get(element.tag.removeprefix(NAMESPACE))
        if known:
            assert own == sorted(own, key=known.index)
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
    again = read_trajectory(tmp_path / "day.csv")
    assert again.time == pytest.approx(DAY.outings[0].epoch + TRACK.time)
    assert again.position == pytest.approx(TRACK.position, abs=1e-4)
    assert again.covariance == pytest.approx(TRACK.covariance, abs=1e-3)
    rows = list(csv.DictReader(io.StringIO(as_csv(DAY).decode())))
    lonlat = np.array([(float(row["longitude"]), float(row["latitude"])) for row in rows])
    assert HERE.from_lonlat(lonlat) == pytest.approx(TRACK.position, abs=0.002)
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
    result = commands.run("lifelog", *words)
    assert result.code == 0, result.errors
    return result.output


def names_in(folder):
    """The names of the files in a folder, which only its owner may read."""
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in folder.iterdir())
    return {file.name for file in folder.iterdir()}


def test_show_prints_a_day_and_writes_it_for_its_owner_alone(store, tmp_path):
    output = run("show", store, "--person", "Anna", "--date", "2024-05-02", "--out", tmp_path / "out")
    assert output.startswith("Anna  Thursday 2024-05-02")
    assert "note: home: a note" in output  # what its outings say, to its owner
    assert {"day.geojson", "overview.html", "timeline.csv"} <= names_in(tmp_path / "out")


def test_show_lists_persons_and_dates_and_refuses_a_person_without_days(store):
    dates = [("Anna", "2024-05-01"), ("Anna", "2024-05-02"), ("Ben/../C", "2024-05-01")]
    assert run("show", store, "--all").split("\n")[:3] == [f"{who}  {date}  1 recording" for who, date in dates]
    with pytest.raises(InputError, match="one of Anna"):
        show(store, Choice(("Carl",)))


def test_trips_of_kepler_have_the_lines_with_their_times():
    """docs.kepler.gl: a LineString of longitude, latitude, altitude, Unix time."""
    lines = [each for each in json.loads(as_geojson([DAY]))["features"] if "times" in each["properties"]]
    trips = json.loads(as_trips([DAY]))["features"]
    assert len(trips) == len(lines) > 0
    for trip, line in zip(trips, lines, strict=True):
        points = np.array(trip["geometry"]["coordinates"])
        assert points[:, :2].tolist() == line["geometry"]["coordinates"]
        assert points[:, 3].tolist() == line["properties"]["times"]
        assert (np.diff(points[:, 3]) >= 0).all()


@pytest.mark.parametrize(("form", "number"), [("gpx", 2), ("geojson", 2), ("kepler", 2), ("csv", 6)])
def test_export_writes_files_for_their_owner_alone(store, tmp_path, form, number):
    run("export", store, "--out", tmp_path / "out", "--format", form)
    found = names_in(tmp_path / "out")
    assert len(found) == number
    assert all(name.startswith(("Anna_2024", "Ben%2F..%2FC_2024")) for name in found)


def exported_features(store, file, *options, **more):
    """The features of a GeoJSON export."""
    written, _ = export_days(store, file, "geojson", *options, **more)
    assert written == [file]
    return json.loads(file.read_bytes())["features"]


def test_export_selects_days_by_date_and_person(store, tmp_path):
    both = exported_features(store, tmp_path / "all.geojson")
    assert {f["properties"]["date"] for f in both} == {"2024-05-01", "2024-05-02"}
    one = exported_features(store, tmp_path / "one.geojson", "Anna", since="2024-05-02", until="2024-05-02")
    assert {f["properties"]["date"] for f in one} == {"2024-05-02"}
    for asked, complaint in (
        ({"since": "2024-06-01"}, "2024-05-02"),
        ({"until": "May"}, "a date such as"),
        ({"person": "Carl"}, "Carl"),
        ({"file_format": "csv", "out": tmp_path / "a.csv"}, "a folder"),
        ({"file_format": "parquet", "out": tmp_path / "a.parquet"}, "a folder: parquet has several files"),
        ({"cut": ["office"]}, "no such name on 0 plans"),
    ):
        with pytest.raises(InputError, match=complaint):
            export_days(store, **({"out": tmp_path / "x", "file_format": "gpx"} | asked))


@pytest.mark.parametrize("text", ["The Office", "place 2"])
def test_a_place_of_the_diary_is_cut_by_its_name_or_number(tmp_path, text):
    """Named by a correction: nothing within its radius of 75 m is in the export."""
    store = made.lifelog(tmp_path)
    with Store(store) as log:
        (office,) = (p for p in diary(log, "me").places if p.number == 2)
    if text != "place 2":
        revision.name_place(store, f"{office.latitude:.6f},{office.longitude:.6f}", "the office")
    whole, part = (exported_features(store, tmp_path / f"{n}.geojson", cut=cut) for n, cut in enumerate(([], [text])))
    frame = enu(office.latitude, office.longitude)

    def nearest(features):
        points = np.concatenate([shapely.get_coordinates(shapely.geometry.shape(f["geometry"])) for f in features])
        return np.hypot(*frame.from_lonlat(points).T).min()

    assert nearest(whole) < 30 < 75 < nearest(part)


@pytest.fixture
def stated(tmp_path):
    """A lifelog in which a place has a name, a ride a mode, and another program guessed the night."""
    store = made.lifelog(tmp_path)
    revision.name_place(store, made.clock(10), "the office")
    revision.name_place(store, made.place(0, 0), "home")
    revision.state_mode(store, made.clock(9), made.clock(9 + 1 / 6), "tram")
    with Store(store) as log:
        latitude, longitude = map(float, made.place(0, 0).split(","))
        log.put_guesses("me", [Guess("google", made.at(1), made.at(7), "visit", "HOME", latitude, longitude, 0.78)])
    return store


def test_names_modes_and_guesses_are_in_every_format(stated, tmp_path, read_tables):
    gpx, table, folder = tmp_path / "a.gpx", tmp_path / "csv", tmp_path / "tables"
    features = [f["properties"] for f in exported_features(stated, tmp_path / "a.geojson")]
    visits = [f for f in features if f["kind"] == "visit"]
    assert [visit["place"] for visit in visits] == ["home", "home", "the office", "home"]
    assert (visits[0]["guess"], visits[0]["observed"]) == ("google: HOME, 78%", 0)
    [ride] = [f for f in features if f.get("mode")]
    assert (ride["mode"], ride["kind"], ride["corrected"]) == ("tram", VEHICLE, True)
    assert {f["place"] for f in features if f["kind"] == STANDING} == {"home", "the office"}

    export_days(stated, gpx, "gpx")
    read = gpxpy.parse(gpx.read_text())
    assert [point.name for point in read.waypoints] == ["home", "home", "the office", "home"]
    assert read.waypoints[0].description == "google: HOME, 78%"
    assert [track.type for track in read.tracks] == [None, "tram", None]

    export_days(stated, table, "csv")
    rows = list(csv.DictReader((table / "me_2024-05-01_timeline.csv").open()))
    assert {row["place"] for row in rows if row["kind"] == "stay"} == {"home", "the office"}
    assert [row["mode"] for row in rows if row["corrected"] == "true"] == ["tram"]

    export_days(stated, folder, "parquet")
    tables = read_tables(folder)
    assert tables["triplegs"]["mode"].tolist() == ["tram", "vehicle"]
    assert set(tables["locations"]["name"]) == {"home", "the office"}
    assert tables["staypoints"]["guess"][0] == "google: HOME, 78%"


def test_an_export_without_home_names_other_places_and_modes_alone(stated, tmp_path):
    for kind in ("geojson", "gpx", "csv", "parquet"):
        out = tmp_path / kind / "all.geojson" if kind == "geojson" else tmp_path / kind
        export_days(stated, out, kind, cut=["home"])
    text = b"".join(file.read_bytes() for file in tmp_path.glob("g*/*"))
    assert b"the office" in text
    assert b"tram" in text
    assert not any(b"home" in file.read_bytes().lower() for file in tmp_path.glob("[gcp]*/*"))


LON, LAT = HERE.to_lonlat(np.array([[0.0, 0.0]]))[0]


def test_export_cuts_the_same_area_every_time(store, tmp_path):
    """The secret of the lifelog determines the area, so that many exports reveal no more than one."""
    place = f"{LAT:.6f},{LON:.6f},60"  # a latitude below zero begins like an option
    contents = []
    for name in ("a.geojson", "b.geojson"):
        out = ("--out", tmp_path / name, "--format", "geojson")
        run("export", store, "--person", "Anna", *out, "--cut", place)
        contents.append((tmp_path / name).read_text())
    assert contents[0] == contents[1]
    assert len(json.dumps(exported_features(store, tmp_path / "c.geojson", "Anna"))) > len(contents[0])
    blurred = exported_features(store, tmp_path / "d.geojson", "Anna", blur=[place])
    assert any(f["properties"]["kind"] == "private" for f in blurred)


def test_a_place_on_a_plan_of_the_lifelog_is_cut_by_its_name(store, tmp_path):
    features = [
        {
            "type": "Feature",
            "properties": {"kind": kind, "name": "Home"},
            "geometry": {"type": "Polygon", "coordinates": [square(half)]},
        }
        for kind, half in (("floor", 50.0), ("shop", 20.0))
    ]
    plan = tmp_path / "plan.geojson"
    plan.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    with Store(store) as log:
        log.put(Entry("5f3b" * 16, "Anna", "walk.txt", RecordingOptions(plan=plan)))
    found = exported_features(store, tmp_path / "b.geojson", "Anna", cut=["home"])
    corners = [at for f in found if f["geometry"]["type"] == "LineString" for at in f["geometry"]["coordinates"]]
    assert np.abs(HERE.from_lonlat(np.array(corners))).max(axis=1).min() > 50
    with pytest.raises(InputError, match="no such name on 1 plans"):
        export_days(store, tmp_path / "c.geojson", "geojson", cut=["office"])


def square(half):
    """Corners [deg] of a square about the start of the day, with sides of twice `half` [m]."""
    x = np.array([-1.0, 1.0, 1.0, -1.0, -1.0])
    return HERE.to_lonlat(half * np.column_stack([x, np.roll(x, 1)])).tolist()


def test_a_completely_private_day_is_noted_and_not_written(store, tmp_path):
    written, lines = export_days(store, tmp_path / "out", "gpx", "Anna", cut=[f"{LAT},{LON},50000"])
    assert not written
    assert lines == ["Anna, 2024-05-01: nothing left to export", "Anna, 2024-05-02: nothing left to export"]


# GeoParquet

BERLIN = enu(52.52, 13.40)
NAMES = ("positionfixes", "triplegs", "staypoints", "locations")


@pytest.fixture(scope="module")
def geopandas():
    pytest.importorskip("pyarrow", reason="the extra geo")
    return pytest.importorskip("geopandas", reason="the extra geo")


@pytest.fixture(scope="module")
def read_tables(geopandas):
    """A function: the tables in a folder, read by geopandas."""
    return lambda folder: {name: geopandas.read_parquet(folder / f"{name}.parquet") for name in NAMES}


@pytest.fixture(scope="module")
def exported(month_log, read_tables, tmp_path_factory):
    out = tmp_path_factory.mktemp("tables") / "out"
    export_days(month_log, out, "parquet")
    return read_tables(out)


@pytest.fixture(scope="module")
def trackintel():
    return pytest.importorskip("trackintel", reason="the extra test")


@pytest.mark.thorough
def test_trackintel_takes_the_tables_as_they_are(exported, trackintel):
    """Its classes check columns, types, time zones and geometries; its readers, the names."""
    trackintel.Positionfixes(exported["positionfixes"])
    trackintel.Triplegs(exported["triplegs"])
    trackintel.Staypoints(exported["staypoints"])
    trackintel.Locations(exported["locations"])
    trackintel.io.read_positionfixes_gpd(exported["positionfixes"], geom_col="geom")
    trackintel.io.read_triplegs_gpd(exported["triplegs"], geom_col="geom")
    trackintel.io.read_staypoints_gpd(exported["staypoints"], geom_col="geom")
    trackintel.io.read_locations_gpd(exported["locations"], center="center")


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::Warning")  # of pandas 4, in trackintel
def test_trackintel_finds_the_tracked_share_that_we_find(exported, trackintel, month_log):
    """Of the time with positions: a walk that only its ends show has no line."""
    import pandas

    columns = ["user_id", "started_at", "finished_at"]
    both = pandas.concat([exported["staypoints"][columns], exported["triplegs"][columns]])
    quality = trackintel.analysis.tracking_quality.temporal_tracking_quality(both, granularity="all")
    with Store(month_log) as store:
        for person, share in quality.set_index("user_id")["quality"].items():
            rows = [entry for own in diary(store, person).days for entry in own.entries]
            spent = sum(row.end - row.start for row in rows if row.kind != GAP and row.is_seen)
            assert share == pytest.approx(spent / (rows[-1].end - rows[0].start), abs=1e-3)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::Warning")  # of pandas 4, in movingpandas, and on its local times
def test_movingpandas_finds_the_lengths_that_we_find(exported):
    """Geodesic lengths of the tracks in degrees, against our lengths in metres."""
    movingpandas = pytest.importorskip("movingpandas", reason="the extra test")
    fixes = exported["positionfixes"]
    tracks = movingpandas.TrajectoryCollection(fixes, traj_id_col="track_id", t="tracked_at")
    found = {(who, t) for t, who in fixes.groupby("track_id")["user_id"].first().items()}
    ours = [
        float(np.hypot(*np.diff(o.trajectory.position, axis=0).T).sum())
        for seed in (0, 1)
        for own in made_month(seed=seed)
        for o in own.outings
    ]
    assert len(tracks.trajectories) == len(found) == len(ours)
    lengths = [track.get_length() for track in sorted(tracks.trajectories, key=lambda track: track.id)]
    assert lengths == pytest.approx(ours, rel=2e-3)


def test_ids_join_the_tables(exported):
    fixes, stays, legs, places = (exported[name] for name in ("positionfixes", "staypoints", "triplegs", "locations"))
    assert set(stays["location_id"].dropna()) == set(places.index)
    assert set(fixes["staypoint_id"].dropna()) <= set(stays.index)
    assert set(fixes["tripleg_id"].dropna()) <= set(legs.index)
    for table, column in ((stays, "staypoint_id"), (legs, "tripleg_id")):
        spans = table[["user_id", "started_at", "finished_at"]].rename(columns={"user_id": "owner"})
        own = fixes.dropna(subset=[column]).join(spans, column)
        assert (own["user_id"] == own["owner"]).all()
        assert (own["tracked_at"] >= own["started_at"]).all()
        assert (own["tracked_at"] <= own["finished_at"]).all()


def metres(geometry):
    """Coordinates [m] in the frame of Berlin, of what is not in Tokyo."""
    at = BERLIN.from_lonlat(shapely.get_coordinates(geometry.values))
    return at[np.hypot(*at.T) < 1e6]


def test_locations_are_where_ada_lives_and_works(exported):
    own = exported["locations"][exported["locations"]["user_id"] == "Ada"]
    assert metres(own.nlargest(3, "duration")["center"])[:2] == pytest.approx(np.array([HOME, OFFICE]), abs=30.0)
    assert all(extent.contains(center) for center, extent in zip(own["center"], own["extent"], strict=True))
    assert exported["locations"]["extent"].crs == "EPSG:4326"


@pytest.mark.usefixtures("geopandas")
def test_tables_are_the_same_for_the_same_days():
    days = made_month(days=4)
    assert parquet_tables(days) == parquet_tables(days)


@pytest.fixture
def hidden_home(month_log, read_tables, tmp_path):
    """A function: the tables of Ada with 250 m around her home cut or blurred."""

    def tables(how):
        lon, lat = BERLIN.to_lonlat(HOME[None])[0]
        export_days(month_log, tmp_path, "parquet", "Ada", **{how: [f"{lat},{lon},250"]})
        return read_tables(tmp_path)

    return tables


def test_a_cut_place_is_in_no_table(hidden_home):
    """Neither fixes, lines, stays nor places within the radius, nor a stay that joins what is left around it."""
    found = hidden_home("cut")
    for name in NAMES:
        geometry = found[name]["center" if name == "locations" else "geom"]
        assert np.hypot(*metres(geometry).T).min() > 250, name
    lasted = found["staypoints"]["finished_at"] - found["staypoints"]["started_at"]
    assert lasted.max().total_seconds() < 12 * 3600, "no night"
    assert found["locations"]["sigma"].max() < 100


def test_a_blurred_place_is_coarse_in_every_table(hidden_home):
    found = hidden_home("blur")
    for name in ("staypoints", "locations"):
        rows = found[name]
        coarse = rows["sigma"] > 100  # [m], of a square of half a kilometre
        assert coarse.any()
        assert np.hypot(*metres(rows.geometry[~coarse]).T).min() > 250, name
        assert np.hypot(*metres(rows.geometry[coarse]).T).min() > 10, "the middle of the square is not the place"


def test_gaps_divide_tracks_and_days_without_a_position_are_left_out(geopandas):
    legs = [(WALKING, 300.0, 0.0), (GAP, 600.0, 0.0), (VEHICLE, 300.0, 1.0), (STANDING, 900.0, 0.0)]
    made = day(outing(legs, stays=[stay(1200, 2100, (1000.0, 2500.0), [("Kiosk", 0.9)])]), outing(legs, frame=NOWHERE))
    tables = {name: geopandas.read_parquet(io.BytesIO(content)) for name, content in parquet_tables([made]).items()}
    fixes = tables["positionfixes.parquet"]
    assert fixes["track_id"].nunique() == 2
    assert len(fixes) == sum(len(track) for track in (range(301), range(1201)))
    assert HERE.from_lonlat(shapely.get_coordinates(fixes.geometry.values))[0] == pytest.approx((0, 0), abs=0.01)
    assert parquet_tables([day(outing(legs, frame=NOWHERE))]) == {}


@pytest.mark.usefixtures("geopandas")
def test_the_command_writes_private_files(month_log, tmp_path):
    dates = ("--from", "2024-05-02", "--to", "2024-05-03")
    out = tmp_path / "out"
    assert run("export", month_log, "--format", "parquet", "--out", out, *dates) == f"7 files -> {out}\n"
    frames = {"positionfixes", "triplegs", "staypoints", "locations"}
    assert set(names_in(out)) == {f"{name}.parquet" for name in frames | {"dwell", "flows", "busy"}}


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"found no pyarrow, expected pip install '\.\[geo\]'"):
        parquet_tables([])
