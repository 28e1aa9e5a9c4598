"""Deleting deletes: no byte of a deleted time remains in any file of a lifelog, and it does not come back."""

import shutil
import sqlite3
import struct
import zlib
from contextlib import closing, suppress
from dataclasses import replace

import made_past as past
import made_tracks as made
import numpy as np
import pytest
from made_tracks import at, clock, place
from observations import walk

from pdr_graph import InputError
from pdr_graph.apps.lifelog import cache, revision
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.facts import Guess
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.observation import observe, read_observation
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.types import Ranges, Sightings, Signal

DATE = "2024-05-01"
NAMES = (b"SSID-of-the-clinic", b"aa:bb:cc:clinic", b"anchor-of-the-clinic", b"clinic in a note", b"the clinic itself")


def hour(part):
    """Mask of the positions of an observation from 10 to 11."""
    time = part.epoch + part.fixes.time
    return (time >= at(10)) & (time <= at(11))


def rich(recording, options):
    """`observe`, with radio scans, pressure, ranges and a note of the hour that will be deleted."""
    seen = observe(recording, options)
    time = np.array([1.0, 2.1, 2.5, 2.9, 4.0]) * 3600  # from 8:00: at 9, 10:06, 10:30, 10:54 and 12
    place = np.array([[1.0, 2.0], [7.125, 9.375]])
    names = ("home", *(name.decode() for name in NAMES[:2]), NAMES[0].decode(), "home")
    anchors = "anchor", NAMES[2].decode()
    return replace(
        seen,
        wifi=Sightings(time, names, np.array([-50.0, -51.0, -52.123456789, -53.0, -54.0])),
        barometer=Signal(time, np.array([[1000.0], [1001.25], [999.123456789], [1002.5], [1003.0]])),
        measurements=(Ranges(time, np.array([0, 1, 1, 1, 0]), time / 7, np.ones(5), anchors, place, np.ones(2)),),
        notes=(NAMES[3].decode(),),
    )


def floats(values):
    """The bytes of each number."""
    return [struct.pack("<d", value) for value in np.ravel(values).tolist()]


def patterns(store):
    """Bytes that only the hour has: names, positions in the frame of the observation and of the track, levels."""
    with Store(store) as log:
        [entry] = [e for e in log.entries() if e.person == "me"]
        seen = read_observation(log.folder / cache.OBSERVATIONS / entry.observation)
        track = log.day("me", DATE).outings[0]
    inside = (track.epoch + track.trajectory.time > at(10.05)) & (track.epoch + track.trajectory.time < at(10.95))
    found = [*NAMES, *floats(seen.fixes.position[hour(seen)])]
    found += floats([-52.123456789, 999.123456789, 2.5 * 3600 / 7])
    return found + floats(track.trajectory.position[inside])


def unpacked(content):
    """The bytes, and those of every compressed piece in them, pieces within pieces too."""
    found, begin = [content], 0
    while (begin := content.find(b"\x78\x01", begin)) >= 0:
        with suppress(zlib.error):
            found += unpacked(zlib.decompressobj().decompress(content[begin:]))
        begin += 1
    return found


def blobs(store):
    """Everything in the tables of a store, as bytes: SQLite may part a long blob into pages."""
    with closing(sqlite3.connect(store)) as database:
        tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        for table in tables:
            for row in database.execute(f"SELECT * FROM {table}").fetchall():
                yield from (v if isinstance(v, bytes) else repr(v).encode() for v in row)


def left(folder, sought):
    """Which of the patterns any file below a folder has, raw or decompressed, or the store in its tables."""
    contents = [file.read_bytes() for file in folder.rglob("*") if file.is_file()]
    contents += list(blobs(folder / "days.db"))
    pieces = [piece for content in contents for piece in unpacked(content)]
    return {pattern for pattern in sought if any(pattern in piece for piece in pieces)}


def unbuilt(folder):
    """A lifelog, in a folder of its own, with a copy of the day."""
    made.write(folder / "raw" / "day.plt", *made.positions())
    store = folder / "store" / "days.db"
    store.parent.mkdir()
    add(store, [folder / "raw"], copy=True)
    return store


def a_rich_lifelog(tmp_path):
    """A lifelog with a copy, corrections, a guess and a diary of the hour."""
    store = unbuilt(tmp_path)
    assert build(store, "UTC", observe=rich).built == 1
    with Store(store) as log:
        log.put_guesses("me", [Guess("google", at(10.2), at(10.4), "visit", NAMES[4].decode(), 48.1, 11.5, 0.5)])
        assert diary(log, "me").days
    revision.split(store, clock(10.25))
    revision.split(store, clock(10.75))
    revision.state_place(store, clock(10.5), place(3000, 510))
    revision.undo(store, 3)
    revision.name_place(store, clock(10.5), NAMES[4].decode())
    return store


def test_no_byte_of_a_deleted_hour_is_left_and_the_rest_of_the_day_remains(tmp_path):
    store = a_rich_lifelog(tmp_path)
    sought = patterns(store)
    assert len(sought) > 1000
    assert left(store.parent, sought) == set(sought), "each is there before, else the search would prove nothing"
    lines = revision.forget(store, clock(10), clock(11))
    assert left(store.parent, sought) == set()
    assert not store.with_name("days.db-wal").exists()
    assert build(store).built == 0
    assert left(store.parent, sought) == set()
    assert any("rebuilt" in line for line in lines)
    with Store(store) as log:
        day = log.day("me", DATE)
        [entry] = log.entries()
        rows = diary(log, "me").days[0].entries
    times = np.concatenate([o.epoch + o.trajectory.time for o in day.outings])
    assert ((times < at(10)).sum(), (times > at(11)).sum()) == pytest.approx((720, 720), abs=40)
    assert entry.epoch == pytest.approx(at(8))
    [row] = [row for row in rows if row.start <= at(10.5) < row.end]
    assert (row.kind, row.start, row.end) == ("gap", at(10), at(11))


def kinds_of(store):
    """The kinds of a diary's rows."""
    with Store(store) as log:
        return [row.kind for day in diary(log, "me").days for row in day.entries]


def test_an_original_is_named_and_what_is_read_again_stays_without_the_hour(tmp_path):
    store = made.lifelog(tmp_path)
    sought = [p for p in patterns(store) if p not in NAMES]
    before = left(store.parent, sought)
    assert len(before) > 1000
    lines = revision.forget(store, clock(10), clock(11))
    original = tmp_path / "raw" / "me" / "0.plt"
    assert f"still on your disk: {original}" in lines
    assert left(store.parent, sought) == set()
    before = kinds_of(store)
    with Store(store) as log:
        shutil.rmtree(log.folder)
        log.delete_days([("me", DATE)])
        log.delete(*(entry.hash for entry in log.entries()))
    add(store, [original])
    assert build(store).built == 1
    assert left(store.parent, sought) == set()
    assert kinds_of(store) == before


def test_a_copy_is_deleted_and_a_recording_without_other_data_with_it(tmp_path):
    store = a_rich_lifelog(tmp_path)
    revision.forget(store, clock(10), clock(11))
    with Store(store) as log:
        assert not list((log.folder / cache.COPIES).iterdir())
        assert len(log.entries()) == 1
    lines = revision.forget(store, clock(7), clock(14))
    assert "1 recording had data then, 1 of them nothing else" in lines
    with Store(store) as log:
        assert (log.entries(), log.days()) == ((), {})
        assert not list((log.folder / cache.OBSERVATIONS).iterdir())
    result = add(store, [tmp_path / "raw"])
    assert result.added == 1
    [refusal] = build(store).refusals
    assert "nothing but times that were deleted" in refusal


def test_an_interrupted_deletion_goes_on_when_it_is_called_again(tmp_path, monkeypatch):
    store = a_rich_lifelog(tmp_path)
    sought = patterns(store)
    with monkeypatch.context() as patch:
        patch.setattr(revision, "_clean", lambda log: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            revision.forget(store, clock(10), clock(11))
    revision.forget(store, clock(10), clock(11))
    assert left(store.parent, sought) == set()
    assert sum("deleted" in line for line in revision.listing(store)) == 1


def test_the_past_that_was_imported_is_cut_and_a_further_import_does_not_bring_it_back(tmp_path):
    store = tmp_path / "store" / "days.db"
    store.parent.mkdir()
    secret = [past.location(past.NOON + 60 * n, 52.51 + 1.234567e-3 * n, 13.41) for n in range(60)]
    others = [past.location(past.NOON - 3600 + 60 * n) for n in range(60)]
    others += [past.location(past.NOON + 3600 + 60 * n) for n in range(60)]
    export = past.records(tmp_path / "Records.json", others + secret)
    past.imported(store, export)
    build(store, "UTC")
    sought = [str(place["latitudeE7"]).encode() for place in secret]
    assert left(store.parent, sought) == set(sought)
    lines = revision.forget(store, "2024-05-01 12:00", "2024-05-01 13:00")
    assert any("rebuilt" in line for line in lines)
    assert left(store.parent, sought) == set()
    past.imported(store, export)
    assert build(store).failures == ()
    assert left(store.parent, sought) == set()


def test_a_person_is_deleted_with_everything(tmp_path):
    store = made.lifelog(tmp_path)
    made.write(tmp_path / "ben.plt", *made.positions(seed=5))
    add(store, [tmp_path / "ben.plt"], person="benedict", phone="benedicts-phone", copy=True)
    build(store)
    revision.name_place(store, place(0, 0), "benedicts home", person="benedict")
    assert left(store.parent, [b"benedict", b"benedicts-phone"])
    lines = revision.forget_person(store, "benedict")
    assert lines[0] == "deleted: benedict, 1 recording"
    assert left(store.parent, [b"benedict", b"benedicts-phone"]) == set()
    with Store(store) as log:
        assert [name for name, _ in log.days()] == ["me"]
    with pytest.raises(InputError, match="'benedict', expected one of me"):
        revision.forget_person(store, "benedict")


def test_a_recording_is_deleted_with_its_part_of_the_day(tmp_path):
    store = made.lifelog(tmp_path)
    time, where = made.positions(seed=4)
    other = made.write(tmp_path / "other.plt", time + 6 * 3600, where)
    add(store, [other])
    build(store)
    sought = floats(observe(other).fixes.position)
    assert left(store.parent, sought)
    lines = revision.forget_recording(store, str(other))
    assert f"still on your disk: {other}" in lines
    assert left(store.parent, sought) <= set(floats([0.0])), "the origin of each frame"
    with Store(store) as log:
        assert len(log.day("me", DATE).outings) == 1
    with pytest.raises(InputError, match="0 recordings by"):
        revision.forget_recording(store, str(other))


def test_undoing_a_deletion_lets_the_original_be_read_again(tmp_path):
    store = made.lifelog(tmp_path)

    def stored():
        with Store(store) as log:
            return log.day_hash("me", DATE)

    before = stored()
    revision.forget(store, clock(10), clock(11))
    assert "1 recording can be read again" in revision.undo(store, 1)[-1]
    assert build(store).built == 1
    assert stored() == before


def test_steps_are_cut_too(tmp_path):
    """Of a walk with steps nothing but the ends of the gap remains."""
    one = replace(walk(200)[0], epoch=at(10))
    store = unbuilt(tmp_path)
    build(store, "UTC", observe=lambda recording, options: one)
    inside = (one.steps.time > 30.0) & (one.steps.time < 60.0)
    sought = floats(one.steps.length[inside]) + floats(one.steps.turn[inside])
    assert left(store.parent, sought) == set(sought)
    revision.forget(store, f"{DATE} 10:00:29", f"{DATE} 10:01:01")
    assert left(store.parent, sought) == set()
    with Store(store) as log:
        assert log.entries()[0].steps == pytest.approx(200 - 32 / 0.55, abs=3)


def test_of_what_was_imported_the_files_with_that_time_are_named_and_none_of_the_lifelog(tmp_path):
    """Three files of one day, one of which has the time."""
    log = tmp_path / "log"
    files = [
        past.records(tmp_path / f"{n}.json", [past.location(past.NOON + 7200 * n + 60 * k) for k in range(60)])
        for n in range(3)
    ]
    past.imported(log, *files)
    build(log)
    told = [line for line in revision.forget(log, "2024-05-01 16:10", "2024-05-01 16:20") if "disk" in line]
    assert told == [f"still on your disk: {files[1]}"]
    lines = revision.forget_person(log, "me")
    assert [line for line in lines if "disk" in line] == [f"still on your disk: {file}" for file in files]
    assert "imported again is there again" in lines[1]
    assert left(tmp_path, [b"imported: me"]) == set()


@pytest.mark.parametrize("imported", [False, True])
def test_a_place_is_forgotten_with_its_name_and_the_rest_of_the_day_remains(tmp_path, imported):
    """No position within its radius is left, also none that only passes; the file it came from is named."""
    where = np.concatenate([made.positions()[1], np.linspace((0, 0), made.OFFICE, 60)])
    time = np.concatenate([made.positions()[0], at(13.1) + 10.0 * np.arange(60)])
    store, raw = tmp_path / "store" / "days.db", tmp_path / "raw" / "0.plt"
    store.parent.mkdir()
    if imported:
        lonlat = made.FRAME.to_lonlat(where)
        raw = past.records(
            tmp_path / "Records.json", [past.location(t, y, x) for t, (x, y) in zip(time, lonlat, strict=True)]
        )
        past.imported(store, raw)
    else:
        made.write(raw, time, where)
        add(store, [raw])
    build(store, "UTC")
    revision.name_place(store, clock(10.5), "the office")
    lines = revision.forget_place(store, "The Office")
    assert f"still on your disk: {raw}" in lines
    assert left(store.parent, [b"the office"]) == set()
    with Store(store) as log:
        day, own = log.day("me", DATE), diary(log, "me")
        [entry] = log.entries()
        fixes = read_observation(log.folder / cache.OBSERVATIONS / entry.observation)
    near = fixes.frame.from_lonlat(made.FRAME.to_lonlat(np.array([made.OFFICE])))
    assert np.hypot(*(fixes.fixes.position - near).T).min() > 100
    assert len(own.places) == 1
    times = np.concatenate([o.epoch + o.trajectory.time for o in day.outings])
    assert (times < at(9)).sum() > 300
    assert (times > at(12.25)).sum() > 200
    with pytest.raises(InputError, match=r"found 'The Office', expected .* a place of the diary: place 1"):
        revision.forget_place(store, "The Office")
