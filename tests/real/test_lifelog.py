"""Days and lifelogs of recordings by others, of GPS alone and beside steps."""

import shutil
import sqlite3
from collections import defaultdict
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest
from cleaned_track import cleaned_length, raw_length

from pdr_graph import Walker, detect_steps
from pdr_graph.apps.lifelog import revision
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.day import GAP, VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.multi_day import estimate_together
from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.apps.lifelog.past.importing import import_past
from pdr_graph.apps.lifelog.reconstruct import estimate_walk
from pdr_graph.apps.lifelog.sessions import Session, sessions_of, turn_by_field
from pdr_graph.apps.lifelog.stays import follow_positions
from pdr_graph.apps.lifelog.store import RecordingOptions, Store
from pdr_graph.apps.lifelog.timeline import STAY
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.estimation.gps_track import detect_rides
from pdr_graph.geometry import wrap_angle
from pdr_graph.io.loading import load
from pdr_graph.types import Fixes, Trajectory
from pdr_graph.walk import read

DAYS = ("geolife_sample/000", "geolife_sample/001", "geolife_sample/005", "geolife_sample/010", "gpx_sample")
WALKS = ("nju_phyphox_outdoor", *(f"ipin2023_track3/*{name}*.txt" for name in ("Trial01", "Trial24", "Trial52")))
FASTEST_WALK = 2.2  # [m/s] in the mean of a segment: between walking fast and cycling slowly


def day(data, folder):
    (path,) = [p for p in (data / folder).iterdir() if p.suffix in (".plt", ".gpx")]
    fixes = read(path).fixes
    return fixes, follow_positions(fixes)[1]


@pytest.mark.parametrize("folder", DAYS)
def test_no_kilometres_are_invented(data, folder):
    """Within 3.5 % of a cleaning by published recipes; the raw track has up to 84 % more."""
    fixes, segments = day(data, folder)
    cleaned = cleaned_length(fixes.time, fixes.position)
    assert raw_length(fixes.position) > 1.1 * cleaned
    assert sum(s.distance for s in segments) == pytest.approx(cleaned, rel=0.035)


@pytest.mark.parametrize("folder", DAYS)
def test_nobody_walks_as_fast_as_a_bicycle_nor_rides_in_a_garden(data, folder):
    _, segments = day(data, folder)
    for s in segments:
        speed = s.distance / (s.end - s.start)
        assert s.kind != WALKING or 0.3 < speed < FASTEST_WALK
        assert s.kind != VEHICLE or speed > 1.5
    # who is in the same house for four hours (5.9 to 9.9 h) does not ride
    if folder.endswith("005"):
        assert sum(s.distance for s in segments if 5.9 * 3600 < s.start < 9.5 * 3600) < 500


def unix(text):
    return datetime.strptime(text, "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC).timestamp()


def test_a_volunteer_says_the_same(data):
    """GeoLife 010: on foot, by taxi, by bus; where the labels overlap the shorter one is meant."""
    (path,) = data.glob("geolife_sample/010/*.plt")
    given, both = read(path), np.zeros((2, 2))
    rows = [line.split("\t") for line in path.with_name("labels.txt").read_text().splitlines()[1:]]
    labels = [(unix(begin), unix(end), mode.strip() in ("walk", "run")) for begin, end, mode in rows]
    labels.sort(key=lambda label: label[1] - label[0])
    for segment in follow_positions(given.fixes)[1]:
        for second in np.arange(segment.start, segment.end) if segment.kind != GAP else ():
            at = given.walk.epoch + second
            on_foot = next((foot for begin, end, foot in labels if begin <= at <= end), None)
            if on_foot is not None:
                both[int(not on_foot), int(segment.kind == VEHICLE)] += 1
    assert both.sum() > 30 * 60
    assert np.trace(both) > 0.97 * both.sum()


@pytest.mark.parametrize("walk", WALKS)
def test_a_real_walk_has_no_ride(data, walk):
    """Outdoors, and indoors where the receiver is 10 to 30 m off and its first fixes may be 400 m off."""
    (path,) = data.glob(walk)
    given = read(path)
    assert len(given.fixes) > 100
    assert not len(detect_rides(detect_steps(given.walk, Walker()), given.fixes))


# Microsoft's chains: one walk that was recorded in pieces

CHAINS = {"site1/B1": 4, "site1/F1": 6, "site2/F1": 2}
NO_PIECE = "5dda0214"  # of site1/F1, an hour later


@pytest.fixture(scope="module")
def chains(data):
    """The pieces of each in order of time, observed, with their waypoints."""
    found = {}
    for name in CHAINS:
        folder = data / "ms_indoor20" / name
        paths = [path for path in folder.glob("*.txt") if NO_PIECE not in path.name]
        pieces = [(observe(path, RecordingOptions(plan=folder)), load(path).truth) for path in paths]
        found[name] = sorted(pieces, key=lambda piece: piece[0].epoch)
    return found


def by_ends(pieces):
    """The first waypoint of the first and the last of the last piece."""
    ones = [replace(one, fixes=Fixes.none()) for one, _ in pieces]
    for n, at in ((0, 0), (-1, -1)):
        truth = pieces[n][1]
        end = Fixes(truth.time[[at]], truth.position[[at]], np.array([0.5]), ("",))
        ones[n] = replace(ones[n], fixes=Fixes.concatenate([ones[n].fixes, end]))
    return Session(tuple((str(n), one) for n, one in enumerate(ones)))


def between_the_ends(pieces):
    first = pieces[0][0].epoch
    time = np.concatenate([truth.time + one.epoch - first for one, truth in pieces])[1:-1]
    return Trajectory(time, np.concatenate([truth.position for _, truth in pieces])[1:-1], 0 * time, ("",) * len(time))


def test_pieces_of_one_walk_are_one_outing(chains):
    for name, pieces in chains.items():
        [group] = sessions_of({str(n): one for n, (one, _) in enumerate(pieces)})
        assert len(group.parts) == CHAINS[name]


def test_each_chain_is_one_walk_by_its_ends_and_the_plan(chains):
    """All together CE50 and CE75 within 1.6 and 2.4 m, which the issue asks; each alone within a fifth more."""
    errors = []
    for pieces in chains.values():
        track = estimate_walk(by_ends(pieces), None, None).estimate.trajectory
        errors.append(circular_error(pair(track, between_the_ends(pieces))))
        assert np.percentile(errors[-1], 50) < 1.25 * 1.6
        assert np.percentile(errors[-1], 75) < 1.2 * 2.4
    assert np.percentile(np.concatenate(errors), 50) < 1.6
    assert np.percentile(np.concatenate(errors), 75) < 2.4


def course(truth, leg):
    """The direction of a leg between two waypoints. [rad]"""
    east, north = np.diff(truth.position, axis=0)[leg]
    return np.arctan2(north, east)


def test_the_field_tells_the_turn_between_two_pieces(chains):
    """Against the legs about it, which surveyors do not walk quite straight: 25° in the median."""
    off = []
    for pieces in chains.values():
        for (before, one), (after, two) in pairwise(pieces):
            turn = turn_by_field(before, after)
            if turn is not None:
                off.append(abs(wrap_angle(turn - course(two, 0) + course(one, -1))))
    assert len(off) >= 7
    assert np.median(off) < np.radians(25)


# A lifelog is the same whoever builds it

FLOOR = ("ms_indoor20", "site1", "B1")  # a walk in four pieces


def built(log, data, **options):
    """All that is in a lifelog of days with positions alone, and two of walks: one on a plan, one with beacons."""
    add(log, [data / "geolife_sample", data / "gpx_sample"], person="Geo")
    add(log, [data.joinpath(*FLOOR)], RecordingOptions(plan=data.joinpath(*FLOOR)), person="Ms")
    add(log, sorted((data / "ipin2023_track3").glob("*Trial24*")), person="Ipin")
    result = build(log, zone="Asia/Shanghai", **options)
    assert (result.failures, result.refusals) == ((), ())
    assert result.built > 5
    with closing(sqlite3.connect(log)) as database:
        names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: sorted(database.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in names}


@pytest.mark.thorough
def test_real_days_are_the_same_whoever_builds_them(data, tmp_path):
    assert built(tmp_path / "here.db", data) == built(tmp_path / "workers.db", data, workers=2)


# Walks of two people in one graph


@pytest.fixture
def store(tmp_path, data):
    """Two people on one floor: one walked its chain, the other an hour later, with the first and last waypoint each."""
    log, folder = tmp_path / "days.db", data / "ms_indoor20" / "site1" / "F1"
    for path in sorted(folder.glob("*.txt")):
        walk, fixes = load(path), tmp_path / f"{path.stem}.csv"
        truth = walk.truth
        rows = [
            f"{walk.clock_origin + truth.time[n]:.3f},{truth.position[n, 0]},{truth.position[n, 1]},0.5"
            for n in (0, -1)
        ]
        fixes.write_text("\n".join(["time,x,y,sigma", *rows]))
        add(
            log, [path], RecordingOptions(plan=folder, fixes=fixes), person="anna" if "5dda0214" in path.name else "ben"
        )
    build(log)
    return log


def trajectories(store):
    with closing(sqlite3.connect(store)) as database:
        return dict(database.execute("SELECT person, bytes FROM trajectory").fetchall())


def test_walks_that_heard_the_same_are_bound_once(store):
    before = trajectories(store)
    assert estimate_together(store) == 2
    after = trajectories(store)
    assert after.keys() == before.keys() == {"anna", "ben"}
    assert after != before
    assert estimate_together(store) == 0, "nothing has changed since"
    assert build(store).built == 0, "the days themselves are up to date"
    assert trajectories(store) == after
    add(store, [], person="anna", phone="AA:BB")
    with Store(store) as log:
        assert log.phones() == {"AA:BB": "anna"}
    assert estimate_together(store) == 2, "who carries what may bind others"


def imported(path, folder):
    """Kind, and whole minutes, of each row of the diary of a timeline."""
    import_past(folder / "log", [path])
    build(folder / "log")
    with Store(folder / "log") as log:
        return [(row.kind, round(row.duration / 60)) for row in diary(log, "me").days[0].entries]


@pytest.mark.parametrize(
    ("name", "legs", "steps"),
    [
        ("ride-at-the-end/walk_ride.zip", [("walking", 60, 76), ("vehicle", 135, 1200)], 108),
        (
            "walk-after-a-ride/walk_ride_walk60.zip",
            [("walking", 60, 76), ("vehicle", 180, 1500), ("walking", 60, 75)],
            216,
        ),
    ],
)
def test_a_recording_may_end_with_a_ride_or_a_minute_on_foot(data, tmp_path, name, legs, steps):
    add(tmp_path / "log", [data / "found" / name])
    assert build(tmp_path / "log").failures == ()
    with Store(tmp_path / "log") as log:
        (day,) = diary(log, "me").days
    assert [row.kind for row in day.entries] == [kind for kind, _, _ in legs]
    for row, (_, lasts, length) in zip(day.entries, legs, strict=True):
        assert row.duration == pytest.approx(lasts, abs=5)
        assert row.distance == pytest.approx(length, rel=0.1)
    assert day.totals.steps == pytest.approx(steps, abs=3)


def test_hours_at_one_point_are_stays_however_coarse(data, tmp_path):
    """Google's path (113 m): six hours at one point were a ride."""
    rows = imported(data / "found" / "coarse-positions" / "path.json", tmp_path)
    assert [minutes for kind, minutes in rows if kind == "stay"] == [360, 210, 40, 220, 90, 260]
    assert {kind for kind, _ in rows} == {"stay", "walking"}


def test_a_silence_of_half_an_hour_parts_two_places(data, tmp_path):
    rows = imported(data / "found" / "visits-lost-after-a-silence" / "gap34.json", tmp_path)
    assert rows == [("stay", 240), ("walking", 34), ("stay", 200)]


STATED = {
    "not me": lambda store, _, *span: revision.state_not_me(store, *span),
    "forget": lambda store, _, *span: revision.forget(store, *span),
    "walk": lambda store, _, *span: revision.state_mode(store, *span, "walk"),
    "place": lambda store, row, *span: row.kind == STAY and revision.state_place(store, span[0], "37.5,-122.2"),
}


@pytest.mark.parametrize("state", STATED)
def test_a_correction_of_a_coarse_day_changes_no_metre_or_minute_outside_its_row(data, tmp_path, state):
    """An iPhone's day with silences, each fifth row in turn; deleting deletes what told the end of a silence."""
    import_past(tmp_path / "log", [data / "mobilitynet" / "ucb-sdb-ios-3" / "2019-11-19.rec"])
    build(tmp_path / "log")

    def rows(store):
        with Store(store) as log:
            return [row for day in diary(log, "me", outings=False).days for row in day.entries]

    def beside(store, row):
        """Time and distance of each kind outside the row."""
        sums = defaultdict(float)
        for own in rows(store):
            for start, end in ((-np.inf, row.start - 10), (row.end + 10, np.inf)):
                share = max(min(own.end, end) - max(own.start, start), 0.0) / own.duration
                sums[own.kind, "s"] += share * own.duration
                sums[own.kind, "m"] += share * own.distance
        return {name: value for name, value in sums.items() if value}

    for n, row in enumerate(rows(tmp_path / "log")[1::5]):
        shutil.copytree(tmp_path / "log.d", tmp_path / f"{n}.d")
        shutil.copy(tmp_path / "log", tmp_path / f"{n}")
        STATED[state](tmp_path / f"{n}", row, *(f"{datetime.fromtimestamp(t, UTC)}" for t in (row.start, row.end)))
        off = 300.0 if state == "forget" else 10.0
        assert beside(tmp_path / f"{n}", row) == pytest.approx(beside(tmp_path / "log", row), abs=off)
