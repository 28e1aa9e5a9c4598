"""GeoParquet exports: trackintel and movingpandas read them as they are, and compute what we computed."""

import io
import stat
import sys

import numpy as np
import pytest
import shapely
from made_days import HERE, NOWHERE, day, outing, stay
from made_month import HOME, OFFICE, made_month
from typer.testing import CliRunner

from pdr_graph.apps.cli import app
from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.export import export_days, parquet_tables
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.errors import InputError
from pdr_graph.frames import enu

geopandas = pytest.importorskip("geopandas", reason="the extra geo")
pytest.importorskip("pyarrow", reason="the extra geo")
BERLIN = enu(52.52, 13.40)
NAMES = ("positionfixes", "triplegs", "staypoints", "locations")


@pytest.fixture(scope="module")
def exported(month_log, tmp_path_factory):
    """The tables as written, read by geopandas."""
    out = tmp_path_factory.mktemp("tables") / "out"
    export_days(month_log, out, "parquet")
    return tables_in(out)


def tables_in(folder):
    return {name: geopandas.read_parquet(folder / f"{name}.parquet") for name in NAMES}


@pytest.fixture(scope="module")
def trackintel():
    return pytest.importorskip("trackintel", reason="the extra test")


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


@pytest.mark.filterwarnings("ignore::Warning")  # of pandas 4, in trackintel
def test_trackintel_finds_the_tracked_share_that_we_find(exported, trackintel, month_log):
    import pandas

    columns = ["user_id", "started_at", "finished_at"]
    both = pandas.concat([exported["staypoints"][columns], exported["triplegs"][columns]])
    quality = trackintel.analysis.tracking_quality.temporal_tracking_quality(both, granularity="all")
    with Store(month_log) as store:
        for person, share in quality.set_index("user_id")["quality"].items():
            rows = [entry for own in diary(store, person).days for entry in own.entries]
            spent = sum(row.end - row.start for row in rows if row.kind != GAP)
            assert share == pytest.approx(spent / (rows[-1].end - rows[0].start), abs=1e-3)


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


def test_locations_are_where_ada_lives_and_works(exported):
    own = exported["locations"][exported["locations"]["user_id"] == "Ada"]
    two = own.nlargest(2, "duration")
    at = BERLIN.from_lonlat(np.array([(point.x, point.y) for point in two["center"]]))
    assert at == pytest.approx(np.array([HOME, OFFICE]), abs=30.0)
    assert all(extent.contains(center) for center, extent in zip(own["center"], own["extent"], strict=True))
    assert exported["locations"]["extent"].crs == "EPSG:4326"


def test_tables_are_the_same_for_the_same_days():
    days = made_month(days=4)
    assert parquet_tables(days) == parquet_tables(days)


def metres(geometry):
    """Coordinates [m] in the frame of Berlin, of what is not in Tokyo."""
    at = BERLIN.from_lonlat(shapely.get_coordinates(geometry.values))
    return at[np.hypot(*at.T) < 1e6]


def hidden_home(log, folder, how):
    """The tables of Ada with 250 m around her home cut or blurred."""
    lon, lat = BERLIN.to_lonlat(HOME[None])[0]
    export_days(log, folder, "parquet", "Ada", **{how: [f"{lat},{lon},250"]})
    return tables_in(folder)


def test_a_cut_place_is_in_no_table(month_log, tmp_path):
    """Neither fixes, lines, stays nor places within the radius, nor a stay that joins what is left around it."""
    found = hidden_home(month_log, tmp_path, "cut")
    for name in NAMES:
        geometry = found[name]["center" if name == "locations" else "geom"]
        assert np.hypot(*metres(geometry).T).min() > 250, name
    lasted = found["staypoints"]["finished_at"] - found["staypoints"]["started_at"]
    assert lasted.max().total_seconds() < 12 * 3600, "no night"
    assert found["locations"]["sigma"].max() < 100


def test_a_blurred_place_is_coarse_in_every_table(month_log, tmp_path):
    found = hidden_home(month_log, tmp_path, "blur")
    for name in ("staypoints", "locations"):
        rows = found[name]
        coarse = rows["sigma"] > 100  # [m], of a square of half a kilometre
        assert coarse.any()
        assert np.hypot(*metres(rows.geometry[~coarse]).T).min() > 250, name
        assert np.hypot(*metres(rows.geometry[coarse]).T).min() > 10, "the middle of the square is not the place"


def test_gaps_divide_tracks_and_days_without_a_position_are_left_out():
    legs = [(WALKING, 300.0, 0.0), (GAP, 600.0, 0.0), (VEHICLE, 300.0, 1.0), (STANDING, 900.0, 0.0)]
    made = day(outing(legs, stays=[stay(1200, 2100, (1000.0, 2500.0), [("Kiosk", 0.9)])]), outing(legs, frame=NOWHERE))
    tables = {name: geopandas.read_parquet(io.BytesIO(content)) for name, content in parquet_tables([made]).items()}
    fixes = tables["positionfixes.parquet"]
    assert fixes["track_id"].nunique() == 2
    assert len(fixes) == sum(len(track) for track in (range(301), range(1201)))
    assert HERE.from_lonlat(shapely.get_coordinates(fixes.geometry.values))[0] == pytest.approx((0, 0), abs=0.01)
    assert parquet_tables([day(outing(legs, frame=NOWHERE))]) == {}


def test_the_command_writes_private_files_and_refuses_a_single_one(month_log, tmp_path):
    command = ["lifelog", "export", str(month_log), "--format", "parquet", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*command, "--from", "2024-05-02", "--to", "2024-05-03"])
    assert result.exit_code == 0, result.output
    assert result.output == f"4 files -> {tmp_path / 'out'}\n"
    assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in (tmp_path / "out").iterdir())
    with pytest.raises(InputError, match="a folder: parquet has several files"):
        export_days(month_log, tmp_path / "days.parquet", "parquet")


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"found no pyarrow, expected pip install '\.\[geo\]'"):
        parquet_tables([])
