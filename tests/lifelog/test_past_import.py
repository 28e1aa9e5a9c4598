"""Exports are imported in any order, as often as one likes, and merged: the store is the same."""

import json
import random
import re
import shutil
from dataclasses import replace

import commands
import numpy as np
import pytest
from gps_days import METRES, gps_day
from hypothesis import given, settings
from hypothesis import strategies as st
from made_past import (
    LAT,
    LON,
    NOON,
    content,
    imported,
    iso,
    location,
    path_of,
    position,
    records,
    rows,
    scan,
    timeline,
    zipped,
)
from tiers import thorough

from pdr_graph import InputError
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.day import VEHICLE, WALKING
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.facts import FORGOTTEN, Correction
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.past import past_rows, tracks
from pdr_graph.apps.lifelog.past.importing import import_past
from pdr_graph.apps.lifelog.past.past_days import (
    access_points,
    cut_past,
    day_sums,
    known_places,
    scan_positions,
    scans_of,
)
from pdr_graph.apps.lifelog.past.past_rows import DaySpill, day_of, valid_positions
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY
from pdr_graph.frames import METRES_PER_DEGREE
from pdr_graph.io.loading import load
from pdr_graph.io.past_day import GOOGLE_PATH, GPS, POSITION, SIGHTING, from_text, to_text
from pdr_graph.io.validation import RADIUS_68


def a_walk(number=20, start=NOON, **options):
    """Positions every minute, 100 m apart."""
    return [location(start + 60 * n, LAT + 0.001 * n, **options) for n in range(number)]


def test_the_same_file_twice_changes_nothing_and_an_overlap_only_the_days_it_changes(tmp_path):
    """The counts say so."""
    log, day = tmp_path / "log", 86_400
    old = [*a_walk(), *a_walk(start=NOON + day)]
    first = imported(log, records(tmp_path / "a.json", old)).positions
    assert (first.new, first.existing, first.days) == (40, 0, 2)
    before, times = content(log), [f.stat().st_mtime_ns for f in tmp_path.rglob("*.csv")]
    again = imported(log, *2 * [tmp_path / "a.json"]).positions
    assert (again.new, again.existing, again.days) == (0, 40, 0)
    assert content(log) == before
    assert [f.stat().st_mtime_ns for f in tmp_path.rglob("*.csv")] == times
    result = imported(log, records(tmp_path / "b.json", [*old[20:], *a_walk(5, NOON + day + 7200)])).positions
    assert (result.new, result.existing, result.days) == (5, 20, 1)
    after = content(log)
    assert len(after[0]) == 2, "the entry of the new content replaces that of the old"
    assert len(before[0] & after[0]) == 1
    assert after[2]["2024-05-01.csv"] == before[2]["2024-05-01.csv"]


def test_the_better_accuracy_wins_and_a_position_has_one_row(tmp_path):
    log = tmp_path / "log"
    imported(log, records(tmp_path / "a.json", [location(NOON + n, accuracy=50) for n in range(3)]))
    signals = [position(NOON + 1 + 0.4, accuracy=8), position(NOON + 2, accuracy=500)]
    result = imported(log, timeline(tmp_path / "b.json", signals=signals)).positions
    assert (result.new, result.better, result.existing) == (0, 1, 1)
    assert [int(row[3]) for row in rows(log)] == [5000, 800, 5000]


def test_googles_path_is_coarse_and_absent_beside_measured_positions(tmp_path):
    log = tmp_path / "log"
    times = [NOON, NOON + 60, NOON + 7200, NOON + 7260]
    imported(log, timeline(tmp_path / "a.json", [path_of(times)], [position(NOON + 20)]))
    assert [(row[0], row[4]) for row in rows(log)] == [
        (str((NOON + 20) * 1000), "gps"),
        (str(times[2] * 1000), "google-path"),
        (str(times[3] * 1000), "google-path"),
    ]
    [file] = tmp_path.rglob("*.csv")
    fixes = load(file).fixes
    assert fixes.source == ("gps", "google-path", "google-path")
    assert fixes.sigma == pytest.approx([10 / RADIUS_68, 75, 75], rel=0.01)


def test_a_day_of_the_past_is_built_like_any_other_once_it_has_two_positions(tmp_path):
    log = tmp_path / "log"
    imported(log, records(tmp_path / "one.json", [location(NOON)]))
    assert build(log).refusals == ()
    assert content(log)[0] == set()
    imported(log, records(tmp_path / "a.json", a_walk(60)))
    result = build(log)
    assert (result.built, result.failures, result.refusals) == (1, (), ())
    with Store(log) as store:
        [outing] = store.day("me", "2024-05-01").outings
    assert outing.trajectory.time[-1] == pytest.approx(59 * 60)
    imported(log, records(tmp_path / "b.json", a_walk(5, NOON + 7200)))
    assert build(log).built == 1, "a day that an import changes is built again"
    assert build(log).built == 0


@pytest.mark.parametrize(("longitude", "hours"), [(-122, 8), (0, 0), (140, -9)])
def test_days_part_at_night_wherever_the_person_is(tmp_path, longitude, hours):
    noon = NOON + 3600 * hours  # on the clock there
    times = [noon + 3600 * n for n in range(-11, 12)]
    imported(tmp_path / "log", records(tmp_path / "a.json", [location(t, LAT, longitude) for t in times]))
    assert len(rows(tmp_path / "log")) == len(times)


def test_guesses_are_kept_apart_with_their_probability(tmp_path):
    log = tmp_path / "log"
    best = {"placeId": "ChIJ1", "probability": 0.4, "placeLocation": {"latLng": "52.5°, 13.4°"}}
    visit = {"startTime": iso(NOON), "endTime": iso(NOON + 3600), "visit": {"topCandidate": best}}
    ride = {"topCandidate": {"type": "IN_BUS", "probability": 0.8}}
    ride = {"startTime": iso(NOON + 3600), "endTime": iso(NOON + 4000), "activity": ride}
    result = imported(log, timeline(tmp_path / "a.json", [visit, ride, {"visit": {}}]))
    assert (result.guesses, result.positions.new) == (2, 0)
    assert "1 a visit or activity without a valid time" in result.notes[0]
    assert imported(log, tmp_path / "a.json").guesses == 0
    with Store(log) as store:
        first, second = store.guesses("me")
        assert (first.kind, first.name, first.probability) == ("visit", "ChIJ1", 0.4)
        assert (second.kind, second.name, second.probability) == ("activity", "IN_BUS", 0.8)
        assert store.guesses("me", NOON + 3601) == (second,)
        assert store.guesses("ben") == ()


def test_two_persons_have_their_own_past(tmp_path):
    log, file = tmp_path / "log", records(tmp_path / "a.json", a_walk())
    imported(log, file)
    assert imported(log, file, person="Ben").positions.new == 20
    assert len(rows(log)) == len(rows(log, person="Ben")) == 20
    with pytest.raises(InputError, match="--person"):
        imported(log, file, person=" ")


def test_folders_and_zips_are_searched_and_other_files_counted(tmp_path):
    log, folder = tmp_path / "log", tmp_path / "Takeout"
    (folder / "Location History" / "deep" / "deeper" / "2024").mkdir(parents=True)
    records(folder / "Location History" / "anything.txt", a_walk())
    timeline(folder / "Location History" / "deep" / "deeper" / "2024" / "x", [path_of([NOON + 86_400])])
    (folder / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0 no timeline")
    (folder / "Settings.json").write_text('{"gaiaId": "1", "deviceSettings": []}')
    result = imported(log, folder)
    assert (result.positions.new, result.skipped, result.refused) == (21, 2, ())
    assert "settings of Google's timeline" in result.notes[0]
    files = {f"Takeout/{file.name}": file for file in folder.rglob("*") if file.is_file()}
    again = imported(log, zipped(tmp_path / "t.zip", files))
    assert (again.positions.new, again.positions.existing, again.skipped) == (0, 21, 2)


def test_a_file_that_is_no_timeline_costs_one_line_and_no_store(tmp_path):
    log, file = tmp_path / "log", tmp_path / "a.json"
    contents = {
        '{"gaiaId": "1", "deviceSettings": []}': "settings of Google's timeline",
        "Encrypted Backups cannot be exported": "an encrypted backup",
        '{"locations": []}'.encode("utf-16"): "UTF-16",
        "": "an empty file",
        '{"a": 1}': "expected a timeline",
        "17": "expected a timeline",
    }
    for text, reason in contents.items():
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        result = imported(log, file)
        assert len(result.refused) == 1, text
        assert reason in result.refused[0]
        assert not log.exists()
    assert "no such file" in imported(log, tmp_path / "none").refused[0]


def test_what_a_person_has_deleted_stays_deleted(tmp_path):
    log, file = tmp_path / "log", records(tmp_path / "a.json", a_walk())
    imported(log, file)
    with Store(log) as store:
        assert cut_past(store, "me", [(NOON + 300, NOON + 600)]) == 6
        store.put_correction(Correction(0, "me", NOON, FORGOTTEN, NOON + 300, NOON + 600))
    for _ in range(2):
        assert len(rows(log)) == 14
        imported(log, file)


def test_a_killed_import_is_completed_by_the_next(tmp_path):
    log, file = tmp_path / "log", records(tmp_path / "a.json", a_walk())
    imported(log, file)
    whole = content(log)
    with Store(log) as store:
        store.delete(*[entry.hash for entry in store.entries()])  # killed before the entries were written
        (store.folder / "past" / "x.part").mkdir()
    assert imported(log, file).positions.new == 0
    assert content(log) == whole
    assert not list(tmp_path.rglob("*.part"))


EVENT = st.tuples(
    st.sampled_from(["record", "signal", "path", "scan"]),
    st.integers(0, 3000),  # [s]
    st.sampled_from([0, 0.4]),
    st.sampled_from([0, 5, 100, 113, 900]),
    st.integers(0, 2),
)


def export(path, events):
    """Write some events as one export of each kind; returns the files."""
    locations, signals, segments = [], [], []
    for kind, second, part, accuracy, place in events:
        time, lat = NOON - 1500 + second + part, LAT + 0.002 * place
        if kind == "record":
            locations.append(location(time, lat, accuracy=accuracy))
        elif kind == "signal":
            signals.append(position(time, lat, accuracy=accuracy, source="WIFI"))
        elif kind == "scan":
            signals.append(scan(time, {100 + 10 * place + n: -50 - n for n in range(4)}))
        else:
            segments.append(path_of([time], lat))
    return [records(path / "r.json", locations), timeline(path / "t.json", segments, signals)]


@settings(max_examples=25)
@given(st.lists(EVENT, min_size=1, max_size=40), st.randoms(use_true_random=False))
def test_any_order_and_overlap_of_exports_gives_the_same_store(tmp_path_factory, events, rng):
    tmp_path = tmp_path_factory.mktemp("past")
    one, many = tmp_path / "one" / "log", tmp_path / "many" / "log"
    for folder in (one.parent, many.parent, tmp_path / "part"):
        folder.mkdir()
    imported(one, *export(tmp_path, events))
    parts = [[event for event in events if rng.random() < 0.6] for _ in range(3)]
    parts.append([event for event in events if not any(event in part for part in parts)])
    rng.shuffle(parts)
    for part in parts:
        rng.shuffle(part)
        imported(many, *export(tmp_path / "part", part))
    assert content(many) == content(one) if one.exists() else not many.exists()


NO_SCANS = np.empty(0, [("time", "i8"), ("mac", "i8"), ("rssi", "i1")])


@given(st.lists(st.tuples(st.integers(0, 10**12), st.integers(-900_000_000, 900_000_000), st.integers(1, 10**9))))
def test_a_day_is_read_as_it_was_written(numbers):
    table = np.zeros(len(numbers), POSITION)
    for row, (time, lat, accuracy) in zip(table, numbers, strict=True):
        row["time"], row["lat"], row["accuracy"], row["source"] = time, lat, accuracy, GOOGLE_PATH
    assert np.array_equal(from_text("x", to_text("a, b", table, NO_SCANS))[0], table)


def test_a_damaged_day_is_refused_in_one_line():
    text = to_text("me", np.zeros(3, POSITION), NO_SCANS)
    for damaged in ("", text[:-5], text.replace("gps", "moon"), text.replace("0,0", "x,0"), text[: len(text) // 2]):
        with pytest.raises(InputError):
            from_text("day.csv", damaged)


def test_rows_beyond_the_memory_wait_on_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(past_rows, "MOST_ROWS", 100)
    table = np.zeros(1000, POSITION)
    table["time"] = [n * 40_000_000 for n in random.Random(0).sample(range(1000), 1000)]
    with DaySpill(tmp_path, POSITION) as spill:
        for part in np.split(table, 20):
            spill.add(part)
        got = np.concatenate([spill.rows(day) for day in spill.days()])
        assert all((day_of(spill.rows(day)) == day).all() for day in spill.days())
    assert np.array_equal(np.sort(got["time"]), np.sort(table["time"]))
    assert list(tmp_path.iterdir()) == []


def test_the_command_says_what_is_new_and_what_was_there(tmp_path):
    log, file = tmp_path / "log", records(tmp_path / "a.json", [*a_walk(3), location(NOON, 0, 0)])
    command = "lifelog", "import", log, file
    first, again = (commands.run(*command) for _ in range(2))
    assert first.code == again.code == 0
    assert first.output == f"3 new positions, 0 there already, 1 day changed -> {log}\n"
    assert again.output == f"0 new positions, 3 there already, 0 days changed -> {log}\n"
    assert "1 of 4 positions were left out: 1 latitude 0, longitude 0" in first.errors[0]
    file.write_text("no timeline")
    assert commands.run(*command).code == 2


# Wi-Fi scans of days without GPS get positions from the scans of other days, with a sigma that holds


EAST = METRES_PER_DEGREE * np.cos(np.radians(LAT))  # [m] per degree of longitude
DAY = 86_400


class Town:
    """Access points in a square of 2 km; levels by distance, with shadowing and a sensitivity limit."""

    def __init__(self, seed=0, number=3000, moved=0.02, hotspots=0.01):
        self.rng = np.random.default_rng(seed)
        self.place = self.rng.uniform(-1000, 1000, (number, 2))
        self.later = self.place.copy()  # where routers are from day 10 on
        self.moves = self.rng.random(number) < moved
        self.later[self.moves] = self.rng.uniform(-1000, 1000, (int(self.moves.sum()), 2))
        self.follows = self.rng.random(number) < hotspots  # carried by somebody: anywhere at any time
        self.power = self.rng.normal(-38, 4, number)  # [dBm] at 1 m

    def levels(self, where, day):
        """What a phone receives at a place: address -> power [dBm], with walls and people in between."""
        place = (self.later if day >= 10 else self.place).copy()
        place[self.follows] = self.rng.uniform(-1000, 1000, (int(self.follows.sum()), 2))
        distance = np.maximum(np.hypot(*(place - where).T), 1.0)
        level = self.power - 10 * 3.2 * np.log10(distance) + self.rng.normal(0, 6, len(place))
        return {int(n) + 1: float(level[n]) for n in np.flatnonzero(level > -92)}

    def where(self, second):
        """Place at a time of the day: home, a way of 20 min, work, the way back by another street."""
        times = [28_800, 29_400, 30_000, 57_600, 58_200, 58_800]
        x, y = [-700, -700, 600, 600, 600, -700], [-400, 500, 500, 500, -400, -400]
        return np.array([np.interp(second, times, axis) for axis in (x, y)])

    def signals(self, days, gps=lambda day: True):
        """Raw signals of some days, every 2 min, and the true place of each scan by its time.

        A position errs by 5 m, and by 12 m per axis that change every hour, as indoors; it states both.
        """
        signals, truth = [], {}
        for day in days:
            offsets = self.rng.normal(0, 12.0, (25, 2))
            for second in np.arange(21_600, 72_000, 120.0).tolist():
                time, place = NOON - NOON % DAY + day * DAY + second, self.where(second)
                truth[round(time * 1000)] = place
                signals.append(scan(time, self.levels(place, day)))
                if gps(day):
                    x, y = place + self.rng.normal(0, 5.0, 2) + offsets[int(second // 3600)]
                    signals.append(position(time + 3, LAT + y / METRES_PER_DEGREE, LON + x / EAST, 1.51 * 13.0))
        return signals, truth


def wifi_errors(rows, truth):
    """Error [m] and sigma per axis [m] of the rows with the source wifi."""
    found = [row for row in rows if row[4] == "wifi"]
    place = np.array(
        [[(int(lon) / 1e7 - LON) * EAST, (int(lat) / 1e7 - LAT) * METRES_PER_DEGREE] for _, lat, lon, *_ in found]
    )
    true = np.array([truth[int(row[0])] for row in found])
    return np.hypot(*(place - true).T), np.array([int(row[3]) / 151 for row in found])


def all_rows(store):
    """The rows of positions of all days."""
    texts = content(store)[2].values()
    return [line.split(",") for text in texts for line in text.split("milliseconds,")[1].splitlines()[1:]]


@pytest.mark.parametrize(("number", "moved"), [(3000, 0.02), thorough(3000, 0.2), (800, 0.02)])
def test_the_stated_sigma_covers_the_error_at_home_and_on_the_way(tmp_path, number, moved):
    town = Town(1, number, moved)
    signals, truth = town.signals(range(14), gps=lambda day: day % 2 == 0)
    result = imported(tmp_path / "log", timeline(tmp_path / "t.json", (), signals))
    rows = [row for row in all_rows(tmp_path / "log") if len(row) == 5]
    error, sigma = wifi_errors(rows, truth)
    assert result.placed == len(error) > (2500 if number == 3000 else 200)
    second = np.array([int(row[0]) // 1000 % 86_400 for row in rows if row[4] == "wifi"])
    walks = ((second > 28_800) & (second < 30_000)) | ((second > 57_600) & (second < 58_800))
    for chosen in (walks, ~walks):
        assert np.mean(error[chosen] < 2.45 * sigma[chosen]) > 0.9  # 95 % of a circle; few independent places
        assert np.median(error[chosen]) < 20
    assert np.median(sigma) < 25, "not covered by saying nothing"


def test_a_day_is_placed_by_an_export_that_comes_later(tmp_path):
    town = Town(2)
    first, _ = town.signals([1], gps=lambda day: False)
    second, _ = town.signals([2])
    log = tmp_path / "log"
    assert imported(log, timeline(tmp_path / "a.json", (), first)).placed == 0
    assert imported(log, timeline(tmp_path / "b.json", (), second)).placed > 300
    assert imported(log, tmp_path / "a.json").positions.days == 0
    with Store(log) as store:
        assert len(store.entries()) == 2


def places(numbers, spots, levels=(-50, -60, -70, -80)):
    """A map of access points from scans at spots [m east]; numbers: their addresses at each spot."""
    positions, rows = [], []
    for n, (macs, spot) in enumerate(zip(numbers, spots, strict=True)):
        positions.append((NOON + 600 * n, LAT, LON + spot / EAST, 10.0))
        rows += [((NOON + 600 * n) * 1000, mac, level) for mac, level in zip(macs, levels, strict=False)]
    time, lat, lon, accuracy = np.array(positions).T
    scans = scans_of(np.array(rows, SIGHTING))
    known = known_places(scans, valid_positions(time, lat, lon, accuracy, GPS).positions)
    return access_points([day_sums(scans, known, 0)])


def test_an_access_point_seen_at_two_far_places_is_not_used():
    points = places([(1, 2, 3, 9), (4, 5, 6, 9)], [0, 5000])
    assert points["mac"].tolist() == [1, 2, 3, 4, 5, 6]
    assert (points["lon"][:3] - LON) * EAST == pytest.approx(np.zeros(3), abs=0.1)
    assert (points["lon"][3:] - LON) * EAST == pytest.approx(np.full(3, 5000), abs=0.1)


def test_a_scan_needs_three_access_points_that_agree():
    points = places([(1, 2, 3), (4, 5, 6)], [0, 1000])

    def found(*macs):
        return scan_positions(scans_of(np.array([(0, mac, -50 - mac % 10) for mac in macs], SIGHTING)), points)

    assert len(found(1, 2).scan) == 0
    assert len(found(1, 2, 4, 5).scan) == 0
    assert len(found(1, 2, 3, 99).scan) == 1
    assert (found(1, 2, 3, 4).lon - LON) * METRES_PER_DEGREE == pytest.approx([0], abs=0.5), (
        "the one elsewhere has no weight"
    )


def test_a_scan_is_at_a_known_place_only_near_in_time_to_a_good_position():
    def at(*positions, time=NOON):
        when, east, accuracy = np.array(positions, float).T
        rows = valid_positions(when, np.full(len(when), LAT), LON + east / EAST, accuracy, GPS).positions
        return known_places(scans_of(np.array([(time * 1000, 1, -50)], SIGHTING)), rows)

    between = at((NOON - 30, 0, 10), (NOON + 30, 40, 10))
    assert (between.lon - LON) * EAST == pytest.approx([20], abs=0.1)
    assert len(at((NOON - 15, 0, 10)).scan) == 1
    assert len(at((NOON - 25, 0, 10)).scan) == 0
    assert len(at((NOON, 0, 100)).scan) == 0


def test_scans_with_a_position_get_no_second_one(tmp_path):
    signals = [
        signal for n in range(40) for signal in (scan(NOON + 60 * n, {1: -40, 2: -50, 3: -60}), position(NOON + 60 * n))
    ]
    assert imported(tmp_path / "log", timeline(tmp_path / "t.json", (), signals)).placed == 0


def test_an_import_for_which_the_disk_has_no_space_stores_nothing(tmp_path, monkeypatch):
    """Neither a day nor a guess; the lifelog is as before, and the same import later is whole."""
    log = tmp_path / "log"
    imported(log, records(tmp_path / "a", [location(NOON)]))
    before = content(log)
    visit = {
        "startTime": iso(NOON),
        "endTime": iso(NOON + 600),
        "visit": {"topCandidate": {"placeLocation": f"geo:{LAT},{LON}"}},
    }
    file = timeline(tmp_path / "b", [visit], [position(NOON + n) for n in range(1, 50)])
    usage = shutil.disk_usage(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10_000))
        with pytest.raises(OSError, match="MB of rows"):
            imported(log, file)
    assert content(log) == before
    result = imported(log, file)
    assert result.positions.new == 49


def iphone(path, legs):
    """Write a timeline of iOS without any path: a list of visits (name, probability, hours, place) and ways."""
    found = []
    for n, (name, share, begin, end, lat) in enumerate(legs):
        span = {"startTime": iso(NOON + 3600 * begin), "endTime": iso(NOON + 3600 * end)}
        if name in ("HOME", "WORK"):
            best = {"probability": str(share), "semanticType": name, "placeID": f"id{n}"}
            found.append(span | {"visit": {"topCandidate": best | {"placeLocation": f"geo:{lat},{LON}"}}})
        else:
            ends = {"start": f"geo:{lat[0]},{LON}", "end": f"geo:{lat[1]},{LON}"}
            found.append(span | {"activity": ends | {"topCandidate": {"type": name, "probability": str(share)}}})
    path.write_text(json.dumps(found))
    return path


IPHONE = [
    ("HOME", 0.8, 0, 1, LAT),
    ("in passenger vehicle", 0.9, 1, 1.25, (LAT, LAT + 0.1)),
    ("WORK", 0.7, 1.25, 4, LAT + 0.1),
    ("walking", 0.6, 4, 4.5, (LAT + 0.1, LAT + 0.08)),
]


def test_guesses_alone_are_a_diary_that_says_so(tmp_path):
    log = tmp_path / "log"
    assert imported(log, iphone(tmp_path / "a.json", IPHONE)).guesses == len(IPHONE)
    build(log)
    with Store(log) as store:
        (day,) = diary(store, "me").days
    assert [entry.kind for entry in day.entries] == [STAY, VEHICLE, STAY, WALKING]
    assert [entry.start - NOON for entry in day.entries] == [0, 3600, 4500, 14_400]
    assert [entry.guess for entry in day.entries] == [
        "Google Timeline: HOME, 80%",
        "Google Timeline: in passenger vehicle, 90%",
        "Google Timeline: WORK, 70%",
        "Google Timeline: walking, 60%",
    ]
    assert [entry.distance for entry in day.entries] == pytest.approx([0, 11_119, 0, 2224], rel=1e-3)
    assert day.totals.observed == 0
    shown = commands.run("lifelog", "show", log, "--out", tmp_path / "shown")
    assert shown.code == 0, shown.errors
    assert "Google Timeline: HOME, 80%" in shown.output
    assert "4 h 30 min are what Google Timeline guessed, without data" in shown.output
    assert commands.run("lifelog", "correct", "name", log, "2024-05-01 14:30", "home").code == 0
    with Store(log) as store:
        assert diary(store, "me").days[0].entries[0].place == "home"


def test_what_was_recorded_is_not_replaced_by_a_guess(tmp_path):
    """At work from 13:15 to 16:00 UTC, says Google; the phone was at home until 15:00."""
    log = tmp_path / "log"
    imported(log, iphone(tmp_path / "a.json", IPHONE))
    imported(log, records(tmp_path / "b.json", [location(NOON + 60 * n) for n in range(180)]))
    build(log)
    with Store(log) as store:
        (day,) = diary(store, "me").days
    kinds = [(entry.kind, entry.observed > 0, round((entry.end - NOON) / 60)) for entry in day.entries]
    assert kinds == [(STAY, True, 179), (STAY, False, 240), (WALKING, False, 270)]
    assert day.totals.staying == pytest.approx(4 * 3600)


def test_the_points_of_one_minute_are_all_kept_in_order(tmp_path):
    log, minutes = tmp_path / "log", [NOON + 60 * (n // 4) for n in range(12)]
    points = [{"point": f"{LAT + 0.001 * n}°, {LON}°", "time": iso(time)} for n, time in enumerate(minutes)]
    segment = {"startTime": iso(NOON), "endTime": iso(NOON + 7200), "timelinePath": points}
    assert imported(log, timeline(tmp_path / "a.json", [segment])).positions.new == 12
    found = np.array([[int(row[0]), int(row[1])] for row in rows(log)])
    assert (np.diff(found, axis=0) > 0).all(), "later is farther north"
    assert imported(log, tmp_path / "a.json").positions.new == 0


@pytest.mark.parametrize("every", [2, 4])
def test_a_way_to_a_shop_in_googles_path_alone_is_a_walk(tmp_path, every):
    """450 m in 14 min each way, at 113 m accuracy: 14 hours at home on three of three days."""
    random = np.random.default_rng(every)
    minutes = np.concatenate([np.arange(0, 180, 15), np.arange(180, 228, every), np.arange(228, 401, 15)])
    east = np.interp(minutes, [180, 194, 214, 228], [0, 450, 450, 0]) + random.normal(0, 10, len(minutes))
    points = [
        {"point": f"{LAT}°, {LON + metres / METRES[0]:.6f}°", "time": iso(NOON + 60 * minute)}
        for metres, minute in zip(east.tolist(), minutes.tolist(), strict=True)
    ]
    segment = {"startTime": iso(NOON), "endTime": iso(NOON + 24000), "timelinePath": points}
    imported(tmp_path / "log", timeline(tmp_path / "a.json", [segment]))
    build(tmp_path / "log")
    with Store(tmp_path / "log") as store:
        (day,) = diary(store, "me").days
    assert [entry.kind for entry in day.entries if entry.is_known] == [STAY, WALKING, STAY, WALKING, STAY]
    assert day.totals.walked == pytest.approx(900, rel=0.1)
    assert day.totals.walking == pytest.approx(28 * 60, rel=0.3)


def gpx(path, track):
    """Write a GPX track. track: of gps_days."""
    points = (
        f'<trkpt lat="{lat:.6f}" lon="{lon:.6f}"><time>{iso(time)}</time></trkpt>'
        for time, (lon, lat) in zip(track.time, track.lonlat, strict=True)
    )
    path.write_text(
        f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{"".join(points)}</trkseg></trk></gpx>'
    )
    return path


def test_logs_of_two_persons_for_one_are_doubted_and_named(tmp_path):
    """Also if their times are equal; a second device of one person is not, nor the same file again."""
    ada, ben = gps_day(1), gps_day(2)
    random = np.random.default_rng(0)
    beside = replace(ada, time=ada.time + 2, lonlat=ada.lonlat + random.normal(0, 5, ada.lonlat.shape) / METRES)
    first, other, watch = (gpx(tmp_path / f"{n}.gpx", day) for n, day in (("a", ada), ("b", ben), ("watch", beside)))
    assert not any("doubtful" in note for note in imported(tmp_path / "one", first, watch).notes)
    assert not any("doubtful" in note for note in imported(tmp_path / "one", first).notes)
    (note,) = (note for note in imported(tmp_path / "two", first, other).notes if "doubtful" in note)
    assert {"a.gpx", "b.gpx"} == set(re.findall(r"\w+\.gpx", note))
    for log, doubted in (("one", False), ("two", True), ("added", True)):
        if log == "added":
            add(tmp_path / log, [first, other])
        build(tmp_path / log)
        with Store(tmp_path / log) as store:
            days = [store.day(*key) for key in store.days()]
        notes = [note for day in days for outing in day.outings for note in outing.notes]
        assert any("doubtful" in note for note in notes) == doubted, log


@pytest.mark.parametrize(("zone", "hours"), [(None, 0), ("local", 2), ("Europe/Berlin", 2), ("Asia/Tokyo", 9)])
def test_times_without_a_zone_are_in_the_zone_that_is_stated(tmp_path, zone, hours):
    """Of a track in Berlin in summer; by default they are UTC, which a note says. Times with a zone are as stated."""
    times = [*(iso(NOON + n).removesuffix(".000Z") for n in range(3)), iso(NOON + 7)]
    points = "".join(f'<trkpt lat="{LAT}" lon="{LON}"><time>{time}</time></trkpt>' for time in times)
    (tmp_path / "a.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    result = import_past(tmp_path / "log", [tmp_path / "a.gpx"], zone=zone)
    assert [int(row[0]) for row in rows(tmp_path / "log")] == sorted(
        1000 * time for time in [*(NOON + n - 3600 * hours for n in range(3)), NOON + 7]
    )
    [note] = result.notes
    taken = {None: "UTC (--zone)", "local": "those of where they were"}.get(zone, f"those of {zone}")
    assert note.endswith(f"times without a zone were taken as {taken}")


def test_a_whole_track_that_may_be_1024_weeks_early_says_so(tmp_path):
    """Nothing in it tells: the file of a receiver of 2026, or one of the days before telephones."""
    points = "".join(f'<trkpt lat="{LAT}" lon="{LON}"><time>2006-07-{n:02}T09:00:00Z</time></trkpt>' for n in (1, 2))
    (tmp_path / "a.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    [note] = imported(tmp_path / "log", tmp_path / "a.gpx").notes
    assert note.endswith("until 2006-07-02, or until 2026-02-15 if the receiver lost 1024 weeks")


def test_half_a_long_track_is_not_1024_weeks_away(tmp_path, monkeypatch):
    """The receiver loses its weeks between two parts that are read one after the other."""
    monkeypatch.setattr(tracks, "BATCH", 10)
    times = [iso(NOON + 60 * n - (n >= 10) * 1024 * 7 * 86_400) for n in range(30)]
    points = "".join(f'<trkpt lat="{LAT}" lon="{LON}"><time>{time}</time></trkpt>' for time in times)
    (tmp_path / "a.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    result = imported(tmp_path / "log", tmp_path / "a.gpx")
    assert [int(row[0]) for row in rows(tmp_path / "log")] == [1000 * (NOON + 60 * n) for n in range(30)]
    assert "1024 weeks early" in result.notes[0]


def test_an_import_of_nothing_ends_with_an_error(tmp_path):
    (tmp_path / "a.gpx").write_text("<gpx></gpx>")
    done = commands.run("lifelog", "import", tmp_path / "log", tmp_path / "a.gpx")
    assert (done.code, done.output) == (1, "nothing to import\n")
    assert "without a position" in done.errors[0]
    assert not (tmp_path / "log").exists()
    done = commands.run("lifelog", "import", tmp_path / "log", tmp_path / "a.gpx", "--zone", "Berlin")
    assert (done.code, len(done.errors)) == (2, 1)
