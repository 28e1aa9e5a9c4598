"""The store of a lifelog: values come back bit by bit, access is the owner's, and damage is reported in one line."""

import os
import resource
import sqlite3
import subprocess
import sys
import warnings
import zlib
from contextlib import closing
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import days_standin as standin
import numpy as np
import pytest

from pdr_graph import InputError, recovery
from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.day import Day, rows_of
from pdr_graph.apps.lifelog.observation import Ends, Observation, from_bytes, observe, read_observation, to_bytes
from pdr_graph.apps.lifelog.store import Entry, RecordingOptions, Store
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Profile
from pdr_graph.recovery import DataLossWarning
from pdr_graph.storage import decompress
from pdr_graph.types import Beacons, Headings, Ranges, Sightings, Signal, Steps, Trajectory

DATE = "2024-05-01"


def observation(tmp_path):
    """An observation with a value in every field."""
    seen = observe(standin.recording(tmp_path / "walk.plt"))
    time = np.arange(1.0, 4.0)
    columns = [np.full(3, 0.5) for _ in range(4)]
    heard = Sightings(time, ("a", "b", "a"), -time, ("1", "", "1"))
    return replace(
        seen,
        frame=Frame("plan", (52.5, 13.4), metres_per_degree=(0.1, 1 / 3)),
        floor="1",
        steps=Steps(0.0, 4.0, time, columns[0], columns[1], columns[2], columns[3], columns[0], columns[1]),
        headings=Headings(time, time, time),
        barometer=Signal(time, time[:, None]),
        bluetooth=heard,
        wifi=heard,
        beacons=Beacons(("a",), np.array([[np.nan, 1.0]]), np.ones(1), ("1",), ("a beacon",)),
        ends=Ends(np.eye(2), np.array([0.1, np.nan])),
        profile=Profile(0.1, 0.01, 0.02, np.eye(3), 0.5, np.nan),
        notes=("", "a note"),
        measurements=(ranges(), Headings(time, time, time)),
    )


def ranges():
    """Three ranges to two anchors."""
    time = np.arange(1.0, 4.0)
    places = np.array([[0.0, 1.0], [2.0, 3.0]])
    return Ranges(time, np.array([0, 1, 0]), 2 * time, np.full(3, 0.3), ("a", "b"), places, np.full(2, 0.1))


def a_day(tmp_path, **changes):
    """A day of one recording, with the profile after it."""
    seen = observe(standin.recording(tmp_path / "walk.plt"))
    return replace(standin.reconstruct("me", DATE, {"a" * 64: seen}, None), **changes)


def put(log, day, key="key"):
    log.put_day(rows_of(day, key, [name for outing in day.outings for name in outing.recordings]))


def bits_of(noun):
    """All content of a data type, bit by bit, with the types."""
    if is_dataclass(noun):
        return type(noun), [(field.name, bits_of(getattr(noun, field.name))) for field in fields(noun)]
    if isinstance(noun, np.ndarray):
        return noun.dtype, noun.shape, noun.tobytes()
    return [bits_of(one) for one in noun] if isinstance(noun, tuple) else repr(noun)


def test_an_observation_comes_back_bit_by_bit(tmp_path):
    whole = observation(tmp_path)
    assert all(getattr(whole, field.name) is not None for field in fields(Observation)), "a control: all is there"
    missing = {field.name: None for field in fields(Observation) if str(field.type).endswith("| None")}
    assert len(missing) == 7, "a control"
    for one in (whole, replace(whole, **missing)):
        assert bits_of(from_bytes(to_bytes(one))) == bits_of(one)


@pytest.mark.parametrize("seed", range(20))
def test_damaged_bytes_are_refused(tmp_path, seed):
    random, blob = np.random.default_rng(seed), bytearray(to_bytes(observation(tmp_path)))
    at = random.integers(2, len(blob))  # zlib's header has bits that say nothing
    blob[at] ^= 1 << random.integers(8)
    with pytest.raises(ValueError, match="bytes of no Observation"):
        from_bytes(bytes(blob))
    with pytest.raises(ValueError, match="bytes of no Trajectory"):
        decompress(to_bytes(observation(tmp_path)), Trajectory)


def test_a_day_comes_back_bit_by_bit(tmp_path):
    day = a_day(tmp_path)
    with Store(tmp_path / "log", new=True) as log:
        put(log, day)
        put(log, Day("me", "2024-05-02", ()))
    with Store(tmp_path / "log") as log:
        found = log.day("me", DATE)
        assert bits_of(found) == bits_of(day)
        assert bits_of(log.day("me", "2024-05-02")) == bits_of(Day("me", "2024-05-02", ()))
        assert log.day("you", DATE) is None
        assert list(log.days()) == [("me", DATE), ("me", "2024-05-02")]
    track = found.outings[0].trajectory
    track.covariance[-1, 2, 2] *= 1 + 1e-15
    assert bits_of(found) != bits_of(day), "a control: a changed bit is detected"


def test_a_day_is_in_the_store_once(tmp_path):
    day = a_day(tmp_path)
    with Store(tmp_path / "log", new=True) as log:
        put(log, day)
        put(log, replace(day, outings=day.outings * 2))
        put(log, day)
        assert bits_of(log.day("me", DATE)) == bits_of(day)
    expected = {"day": 1, "outing": 1, "segment": 2, "trajectory": 1, "stay": 2, "facing": 2, "profile": 1}
    assert {name: len(rows) for name, rows in tables(tmp_path / "log").items() if name in expected} == expected


def tables(path):
    """All rows of all tables."""
    with closing(sqlite3.connect(path)) as database:
        names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: database.execute(f"SELECT * FROM {name}").fetchall() for name in names}


def test_plain_sql_reads_stays(tmp_path):
    with Store(tmp_path / "log", new=True) as log:
        put(log, a_day(tmp_path))
    with closing(sqlite3.connect(tmp_path / "log")) as database:
        found = database.execute(
            """SELECT datetime(epoch + start, 'unixepoch'), name, probability FROM outing
            JOIN stay USING (person, date, outing) JOIN facing USING (person, date, outing, stay)
            WHERE person = 'me' AND rank = 0"""
        ).fetchall()
    assert found == [("2024-05-01 22:30:00", "a shop", 0.75)]


def test_only_the_owner_may_read_the_files(tmp_path):
    before = os.umask(0)  # everybody may read everything, were it not asked for otherwise
    try:
        with Store(tmp_path / "log", new=True) as log:
            put(log, a_day(tmp_path))
            cache.write(log.folder / "days" / "one", b"where they were")
            cache.copy({"a/b": tmp_path / "walk.plt"}, log.folder / "recordings" / "one")
            made = [log.path, log.folder, *log.folder.rglob("*")]
            modes = {path.relative_to(tmp_path).as_posix(): path.stat().st_mode & 0o777 for path in made}
    finally:
        os.umask(before)
    assert {name: oct(mode) for name, mode in modes.items() if mode & 0o077} == {}
    assert {"log", "log.d", "log.d/days/one", "log.d/recordings/one/a/b"} <= modes.keys()


def refused(path, match, new=False):
    """Assert that a file is refused in one line, and nothing is overwritten or created."""
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    with pytest.raises(InputError, match=match) as refusal:
        Store(path, new)
    assert str(path) in str(refusal.value)
    assert str(refusal.value).isprintable()
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


def test_a_file_that_is_no_lifelog_is_refused(tmp_path):
    path = tmp_path / "log"
    refused(path, "no such file, expected a lifelog")
    path.write_text("time,x,y\n")
    refused(path, "another kind of file, expected a lifelog", new=True)
    path.unlink()
    with closing(sqlite3.connect(path)) as other:
        other.executescript("PRAGMA journal_mode = WAL; CREATE TABLE bookmark (name TEXT)")
    refused(path, "another kind of file", new=True)


def test_a_journal_is_refused(tmp_path):
    from pdr_graph import Journal, Navigator

    Journal.open(tmp_path / "journal", Navigator, {}).close()
    refused(tmp_path / "journal", "another kind of file, expected a lifelog", new=True)


def test_a_newer_version_is_refused(tmp_path):
    Store(tmp_path / "log", new=True).close()
    with closing(sqlite3.connect(tmp_path / "log", isolation_level=None)) as database:
        database.execute("PRAGMA user_version = 99")
        database.execute("PRAGMA journal_mode = DELETE")
    refused(tmp_path / "log", "format: found 99, expected 6, which this version reads: use the newer pdr_graph")


def test_a_store_of_format_1_is_refused_and_unchanged(tmp_path):
    """A store of pdr_graph 0.1.0, compressed."""
    file = Path(__file__).with_name("store_format_1.z")
    (tmp_path / "log").write_bytes(zlib.decompress(file.read_bytes()))
    refused(
        tmp_path / "log", "format: found 1, expected 6, which this version reads: add the recordings to a new store"
    )


def test_a_store_of_format_2_is_upgraded_and_loses_nothing(tmp_path):
    """Format 2 had no ranges and no lists of beacons; its recordings, days and observations are read as before."""
    path = tmp_path / "log"
    path.write_bytes(zlib.decompress(Path(__file__).with_name("store_format_2.z").read_bytes()))
    for _ in range(2):
        with Store(path) as log:
            [entry] = log.entries()
            assert (entry.person, entry.path, entry.options) == ("Ada", "walk.plt", RecordingOptions())
            assert (entry.epoch, entry.duration) == (standin.FIRST, 30.0)
            assert list(log.days()) == [("Ada", DATE)]
            assert len(log.day("Ada", DATE).outings[0].trajectory) == 4
    with Store(path) as log:
        changed = replace(entry, options=RecordingOptions(ranges=Path("r.csv"), begins=2.5))
        log.put(changed)
        assert log.entries() == (changed,)
    found = read_observation(Path(__file__).with_name("observation_format_2.z"))
    assert found is not None
    assert (found.source, len(found.fixes), found.measurements) == ("walk", 4, ())
    assert bits_of(from_bytes(to_bytes(found))) == bits_of(replace(found)), "it can be written again, in the new format"


def test_a_store_of_format_5_is_upgraded_and_loses_nothing(tmp_path):
    """Format 5 had checksums of its rows."""
    path = tmp_path / "log"
    path.write_bytes(zlib.decompress(Path(__file__).with_name("store_format_5.z").read_bytes()))
    for _ in range(2):
        with Store(path, thorough=True) as log:
            assert [entry.person for entry in log.entries()] == ["Ada"]
            assert list(log.days()) == [("Ada", DATE)]
            assert len(log.day("Ada", DATE).outings[0].trajectory) == 4
            assert [each.value for each in log.corrections()] == [{"name": "at"}]
            assert [each.name for each in log.guesses("Ada")] == ["guess"]
            assert (log.phones(), log.setting("zone")) == ({"badge": "Ada"}, "UTC")
    with Store(path) as log:
        put(log, a_day(tmp_path))
        log.put_guesses("Ada", log.guesses("Ada"))
        assert list(log.days()) == [("Ada", DATE), ("me", DATE)]


def test_one_process_at_a_time_opens_a_store(tmp_path):
    script = "import sys, pathlib; from pdr_graph import recovery; from pdr_graph.apps.lifelog.store import Store; "
    script += "recovery.LOCK_TIMEOUT = 1.0; Store(pathlib.Path(sys.argv[1]))"
    with Store(tmp_path / "log", new=True):
        other = subprocess.run([sys.executable, "-c", script, tmp_path / "log"], capture_output=True, text=True)
    assert "found a lifelog that another process writes" in other.stderr.splitlines()[-1]
    Store(tmp_path / "log").close()


def test_a_store_that_a_build_writes_is_opened_when_the_build_ends(tmp_path):
    """`lifelog show` waits for 30 s instead of saying that the store is locked."""
    with Store(tmp_path / "log", new=True) as log:
        put(log, a_day(tmp_path))
    writing = """import pathlib, sys, time
from pdr_graph.apps.lifelog.store import Store
with Store(pathlib.Path(sys.argv[1]), thorough=True) as log:
    print("open", flush=True)
    end = time.monotonic() + 4
    while time.monotonic() < end:
        log.put_versions({"pdr_graph": str(time.time())})
"""
    command = [sys.executable, "-c", writing, tmp_path / "log"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as build:
        assert build.stdout.readline() == "open\n"
        assert recovery.LOCK_TIMEOUT >= 30.0
        with Store(tmp_path / "log") as log:
            assert list(log.days()) == [("me", DATE)]
            assert build.wait(30) == 0


def test_a_damaged_trajectory_is_refused(tmp_path):
    with Store(tmp_path / "log", new=True) as log:
        put(log, a_day(tmp_path))
    with closing(sqlite3.connect(tmp_path / "log", isolation_level=None)) as database:
        database.execute("UPDATE trajectory SET bytes = substr(bytes, 2)")
    with (
        Store(tmp_path / "log") as log,
        pytest.raises(InputError, match="me, 2024-05-01: found damaged rows"),
    ):
        log.day("me", DATE)


def test_a_lasting_setting_keeps_its_first_value(tmp_path):
    for value in ("first", "second"):
        with Store(tmp_path / "log", new=True, thorough=True) as log:
            assert log.lasting_setting("salt", value) == "first"


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE segment SET kind = CAST(x'b8' AS TEXT)",
        "UPDATE segment SET person = CAST(x'b8' AS TEXT)",
        "UPDATE sqlite_master SET sql = CAST(x'435245415445b8' AS TEXT) WHERE name = 'segment'",
    ],
)
def test_a_build_recovers_all_but_the_days(tmp_path, damage):
    with Store(tmp_path / "log", new=True) as log:
        put(log, a_day(tmp_path))
        log.put_phone("me", "badge")
    with closing(sqlite3.connect(tmp_path / "log", isolation_level=None)) as database:
        database.execute("PRAGMA writable_schema = ON")
        database.execute(damage)
    with pytest.warns(DataLossWarning, match="2 rows of setting, 1 row of phone; a build makes the days"):
        log = Store(tmp_path / "log", thorough=True)
    with log:
        assert not log.days()
        assert log.phones() == {"badge": "me"}
    assert (tmp_path / "log.damaged-1").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    "damage", ["DELETE FROM trajectory", "UPDATE profile SET covariance = '[1'", "UPDATE day SET recordings = NULL"]
)
def test_a_day_of_damaged_rows_is_told_and_made_again(tmp_path, damage):
    with Store(tmp_path / "log", new=True) as log:
        put(log, a_day(tmp_path))
        put(log, Day("me", "2024-05-02", ()))
    with closing(sqlite3.connect(tmp_path / "log", isolation_level=None)) as database:
        database.execute(damage + f" WHERE date = '{DATE}'")
    with Store(tmp_path / "log", thorough=True) as log:
        with pytest.raises(InputError, match=f"me, {DATE}: found damaged rows .* build makes the day again"):
            print(log.days(), log.day("me", DATE))
        assert list(log.days()) == [("me", "2024-05-02")], "so that a build makes it"
        [(person, date, reason)] = log.failures()
        assert (person, date, reason[:12]) == ("me", DATE, "damaged rows")


@pytest.mark.parametrize("seed", range(40))
def test_a_damaged_store_is_refused_in_one_line_or_read(tmp_path, seed):
    """Or what is whole of it is recovered, and the loss is said in a line; a damaged unused page is not detected."""
    random, path = np.random.default_rng(seed), tmp_path / "log"
    day = a_day(tmp_path)
    with Store(path, new=True) as log:
        put(log, day)
    content = bytearray(path.read_bytes())
    at = random.integers(100, len(content) - 64)
    content[at : at + 64] = random.bytes(64)
    path.write_bytes(content[: at if seed % 2 else None])
    message, whole = "", False
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            log = Store(path)
        message = "".join(str(each.message) for each in said)
        with log:
            if ("me", DATE) in log.days():
                found = log.day("me", DATE)
                assert bits_of(found.outings[0].trajectory) == bits_of(day.outings[0].trajectory)
                whole = bits_of(found) == bits_of(day)
    except InputError as refusal:
        message = str(refusal)
    assert message.isprintable()
    assert message or whole or not seed % 2, "one that was cut short is told, but for unused bytes of its last page"


def test_a_full_disk_costs_only_the_day_that_is_being_stored(tmp_path):
    path, limits = tmp_path / "log", resource.getrlimit(resource.RLIMIT_FSIZE)
    day = a_day(tmp_path)
    with Store(path, new=True) as log:
        put(log, day)
        log.put(Entry("b" * 64, "me", "walk.plt"))
        size = path.stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, limits[1]))
        try:
            with pytest.raises(OSError, match="disk") as failure:
                put(log, replace(day, outings=day.outings * 99))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert failure.value.filename == str(path)
        assert bits_of(log.day("me", DATE)) == bits_of(day)
        put(log, replace(day, outings=day.outings * 99))
    with Store(path) as log:
        assert len(log.day("me", DATE).outings) == 99
        assert [entry.hash for entry in log.entries()] == ["b" * 64]


def test_a_file_without_room_on_the_disk_leaves_the_earlier_one(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    cache.write(tmp_path / "day", b"before")
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(OSError, match="large") as failure:
            cache.write(tmp_path / "day", bytes(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert failure.value.filename == str(tmp_path / "day")
    assert [file.name for file in tmp_path.iterdir()] == ["day"]
    assert (tmp_path / "day").read_bytes() == b"before"


def test_an_entry_has_the_columns_of_its_table(tmp_path):
    options = RecordingOptions(*map(Path, ("plan", "fixes", "beacons", "ranges", "walker")), "1", 1.5)
    entry = Entry("c" * 64, "me", "path", options, "key", 2.5, 3.5, 4, "why")
    with Store(tmp_path / "log", new=True) as log:
        log.put(entry)
        assert log.entries() == (entry,)
    with closing(sqlite3.connect(tmp_path / "log")) as database:
        database.row_factory = sqlite3.Row
        [row] = database.execute("SELECT * FROM recording").fetchall()
    expected = vars(options) | {name: str(path) for name, path in options.files.items()}
    assert dict(row) == {name: value for name, value in vars(entry).items() if name != "options"} | expected


def test_the_folder_has_the_name_of_the_store(tmp_path):
    with Store(tmp_path / "my.days.db", new=True) as log:
        assert log.folder == Path(tmp_path / "my.days.db.d")
        assert not log.folder.exists()
