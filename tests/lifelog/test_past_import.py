"""Exports are imported in any order, as often as one likes, and merged: the store is the same."""

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_past import (
    LAT,
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
from typer.testing import CliRunner

from pdr_graph import InputError
from pdr_graph.apps.cli import app
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.facts import FORGOTTEN, Correction
from pdr_graph.apps.lifelog.past import past_rows
from pdr_graph.apps.lifelog.past.past_days import cut_past
from pdr_graph.apps.lifelog.past.past_rows import DaySpill, day_of
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.io.loading import load
from pdr_graph.io.past_day import GOOGLE_PATH, POSITION, from_text, to_text
from pdr_graph.io.validation import RADIUS_68


def a_walk(number=20, start=NOON, **options):
    """Positions every minute, 100 m apart."""
    return [location(start + 60 * n, LAT + 0.001 * n, **options) for n in range(number)]


def test_the_same_file_twice_changes_nothing_and_the_counts_say_so(tmp_path):
    log, file = tmp_path / "log", records(tmp_path / "a.json", a_walk())
    first = imported(log, file).positions
    assert (first.new, first.existing, first.days) == (20, 0, 1)
    before, times = content(log), [f.stat().st_mtime_ns for f in tmp_path.rglob("*.csv")]
    again = imported(log, file, file).positions
    assert (again.new, again.existing, again.days) == (0, 20, 0)
    assert content(log) == before
    assert [f.stat().st_mtime_ns for f in tmp_path.rglob("*.csv")] == times


def test_an_export_that_overlaps_rewrites_only_the_days_it_changes(tmp_path):
    log, day = tmp_path / "log", 86_400
    old = [*a_walk(), *a_walk(start=NOON + day)]
    imported(log, records(tmp_path / "a.json", old))
    before = content(log)
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


def test_a_day_of_the_past_is_built_like_any_other(tmp_path):
    log = tmp_path / "log"
    imported(log, records(tmp_path / "a.json", a_walk(60)))
    result = build(log)
    assert (result.built, result.failures, result.refusals) == (1, (), ())
    with Store(log) as store:
        [outing] = store.day("me", "2024-05-01").outings
    assert outing.trajectory.time[-1] == pytest.approx(59 * 60)
    imported(log, records(tmp_path / "b.json", a_walk(5, NOON + 7200)))
    assert build(log).built == 1, "a day that an import changes is built again"
    assert build(log).built == 0


def test_a_day_with_one_position_waits_for_more(tmp_path):
    log = tmp_path / "log"
    imported(log, records(tmp_path / "a.json", [location(NOON)]))
    assert build(log).refusals == ()
    assert content(log)[0] == set()
    imported(log, records(tmp_path / "b.json", [location(NOON + 60)]))
    assert len(rows(log)) == 2


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
        assert cut_past(store, "me", NOON + 300, NOON + 600) == 6
        store.put_correction(Correction(0, "me", NOON, FORGOTTEN, NOON + 300, NOON + 600))
    assert len(rows(log)) == 14
    imported(log, file)
    assert len(rows(log)) == 14


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


@settings(max_examples=25, deadline=None)
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


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**12), st.integers(-900_000_000, 900_000_000), st.integers(1, 10**9))))
def test_a_day_is_read_as_it_was_written(numbers):
    table = np.zeros(len(numbers), POSITION)
    for row, (time, lat, accuracy) in zip(table, numbers, strict=True):
        row["time"], row["lat"], row["accuracy"], row["source"] = time, lat, accuracy, GOOGLE_PATH
    text = to_text("a, b", table, np.empty(0, [("time", "i8"), ("mac", "i8"), ("rssi", "i1")]))
    assert np.array_equal(from_text("x", text)[0], table)


def test_a_damaged_day_is_refused_in_one_line():
    text = to_text("me", np.zeros(3, POSITION), np.zeros(0, [("time", "i8"), ("mac", "i8"), ("rssi", "i1")]))
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
    command = ["lifelog", "import", str(log), str(file)]
    first, again = (CliRunner().invoke(app, command) for _ in range(2))
    assert first.exit_code == again.exit_code == 0
    assert first.stdout == f"3 new positions, 0 there already, 1 day changed -> {log}\n"
    assert again.stdout == f"0 new positions, 3 there already, 0 days changed -> {log}\n"
    assert "1 of 4 positions were left out: 1 latitude 0, longitude 0" in first.stderr
    file.write_text("no timeline")
    assert CliRunner().invoke(app, command).exit_code == 2
