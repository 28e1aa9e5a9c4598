"""The store of a lifelog: values come back bit by bit, access is the owner's, and damage is reported in one line."""

import os
import resource
import sqlite3
import subprocess
import sys
import zlib
from contextlib import closing, contextmanager
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
HERE = Path(__file__).parent


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


@pytest.fixture
def stored(tmp_path):
    """A store with a day, and the day."""
    day = a_day(tmp_path)
    with Store(tmp_path / "log", new=True) as log:
        put(log, day)
    return tmp_path / "log", day


def execute(path, *statements):
    """Change a store without its program."""
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        for statement in statements:
            database.execute(statement)


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


def test_bytes_of_something_else_are_refused(tmp_path):
    with pytest.raises(ValueError, match="bytes of no Observation"):
        from_bytes(to_bytes(observation(tmp_path))[:-1])
    with pytest.raises(ValueError, match="bytes of no Trajectory"):
        decompress(to_bytes(observation(tmp_path)), Trajectory)


def test_a_day_comes_back_bit_by_bit(stored):
    path, day = stored
    with Store(path) as log:
        put(log, Day("me", "2024-05-02", ()))
    with Store(path) as log:
        found = log.day("me", DATE)
        assert bits_of(found) == bits_of(day)
        assert bits_of(log.day("me", "2024-05-02")) == bits_of(Day("me", "2024-05-02", ()))
        assert log.day("you", DATE) is None
        assert list(log.days()) == [("me", DATE), ("me", "2024-05-02")]
    found.outings[0].trajectory.covariance[-1, 2, 2] *= 1 + 1e-15
    assert bits_of(found) != bits_of(day), "a control: a changed bit is detected"


def test_a_day_is_in_the_store_once(stored):
    path, day = stored
    with Store(path) as log:
        put(log, replace(day, outings=day.outings * 2))
        put(log, day)
        assert bits_of(log.day("me", DATE)) == bits_of(day)
    expected = {"day": 1, "outing": 1, "segment": 2, "trajectory": 1, "stay": 2, "facing": 2, "profile": 1}
    with closing(sqlite3.connect(path)) as database:
        assert expected == {n: database.execute(f"SELECT count(*) FROM {n}").fetchone()[0] for n in expected}


def test_plain_sql_reads_stays(stored):
    with closing(sqlite3.connect(stored[0])) as database:
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
    from pdr_graph import Journal, Navigator

    path = tmp_path / "log"
    refused(path, "no such file, expected a lifelog")
    path.write_text("time,x,y\n")
    refused(path, "another kind of file, expected a lifelog", new=True)
    path.unlink()
    execute(path, "PRAGMA journal_mode = WAL", "CREATE TABLE bookmark (name TEXT)")
    refused(path, "another kind of file", new=True)
    Journal.open(tmp_path / "journal", Navigator, {}).close()
    refused(tmp_path / "journal", "another kind of file, expected a lifelog", new=True)


def test_a_store_of_another_format_is_refused_and_unchanged(tmp_path):
    """Format 1 is that of pdr_graph 0.1.0."""
    Store(tmp_path / "log", new=True).close()
    execute(tmp_path / "log", "PRAGMA user_version = 99", "PRAGMA journal_mode = DELETE")
    refused(tmp_path / "log", "format: found 99, expected 6, which this version reads: use the newer pdr_graph")
    path = earlier(tmp_path, 1)
    refused(path, "format: found 1, expected 6, which this version reads: add the recordings to a new store")


def earlier(folder, number):
    """A store of an earlier format."""
    path = folder / f"format_{number}"
    path.write_bytes(zlib.decompress(HERE.joinpath(f"store_format_{number}.z").read_bytes()))
    return path


@pytest.mark.parametrize("number", [2, 5])
def test_a_store_of_an_earlier_format_is_upgraded_and_loses_nothing(tmp_path, number):
    """Format 2 had no ranges and no lists of beacons, format 5 checksums of its rows."""
    path = earlier(tmp_path, number)
    for _ in range(2):
        with Store(path, thorough=True) as log:
            [entry] = log.entries()
            assert entry.person == "Ada"
            assert list(log.days()) == [("Ada", DATE)]
            assert len(log.day("Ada", DATE).outings[0].trajectory) == 4
            if number == 5:
                assert [each.value for each in log.corrections()] == [{"name": "at"}]
                assert [each.name for each in log.guesses("Ada")] == ["guess"]
                assert (log.phones(), log.setting("zone")) == ({"badge": "Ada"}, "UTC")
            else:
                assert (entry.path, entry.options) == ("walk.plt", RecordingOptions())
                assert (entry.epoch, entry.duration) == (standin.FIRST, 30.0)
    with Store(path) as log:
        put(log, a_day(tmp_path))
        changed = replace(entry, options=RecordingOptions(ranges=Path("r.csv"), begins=2.5))
        log.put(changed)
        log.put_guesses("Ada", log.guesses("Ada"))
        assert log.entries() == (changed,)
        assert list(log.days()) == [("Ada", DATE), ("me", DATE)]


def test_an_observation_of_an_earlier_format_is_read():
    found = read_observation(HERE / "observation_format_2.z")
    assert (found.source, len(found.fixes), found.measurements) == ("walk", 4, ())
    assert bits_of(from_bytes(to_bytes(found))) == bits_of(found), "it can be written again, in the new format"


WRITING = """import pathlib, sys, time
from pdr_graph import recovery
from pdr_graph.apps.lifelog.store import Store
recovery.LOCK_TIMEOUT, seconds = float(sys.argv[2]), float(sys.argv[3])
with Store(pathlib.Path(sys.argv[1]), thorough=True) as log:
    print("open", flush=True)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        log.put_versions({"pdr_graph": str(time.time())})
"""


def test_one_process_at_a_time_writes_a_store_and_another_waits_or_reads(stored):
    """A correction waits for 30 s, until a build ends, instead of saying that the store is locked; `show` reads."""
    command = [sys.executable, "-c", WRITING, stored[0]]
    with Store(stored[0]):
        other = subprocess.run([*command, "1", "0"], capture_output=True, text=True)
    assert "found a lifelog that another process writes" in other.stderr.splitlines()[-1]
    with subprocess.Popen([*command, "30", "4"], stdout=subprocess.PIPE, text=True) as build:
        assert build.stdout.readline() == "open\n"
        assert recovery.LOCK_TIMEOUT >= 30.0
        for _ in range(5):  # between its transactions
            with Store(stored[0], reads=True) as log:
                assert list(log.days()) == [("me", DATE)]
                log.delete_days([("me", DATE)])  # of the copy
        assert build.poll() is None
        with Store(stored[0]) as log:
            assert list(log.days()) == [("me", DATE)]
            assert build.wait(30) == 0


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
def test_a_build_recovers_all_but_the_days(stored, damage):
    path, _ = stored
    with Store(path) as log:
        log.put_phone("me", "badge")
    execute(path, "PRAGMA writable_schema = ON", damage)
    with pytest.warns(DataLossWarning, match="3 rows of setting, 1 row of phone; a build makes the days"):
        log = Store(path, thorough=True)
    with log:
        assert not log.days()
        assert log.phones() == {"badge": "me"}
    assert path.with_name("log.damaged-1").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    "damage",
    [
        "DELETE FROM trajectory",
        "UPDATE trajectory SET bytes = substr(bytes, 2)",
        "UPDATE profile SET covariance = '[1'",
        "UPDATE day SET recordings = NULL",
    ],
)
def test_a_day_of_damaged_rows_is_told_and_made_again(stored, damage):
    path, _ = stored
    with Store(path) as log:
        put(log, Day("me", "2024-05-02", ()))
    execute(path, damage + f" WHERE date = '{DATE}'")
    with Store(path, thorough=True) as log:
        with pytest.raises(InputError, match=f"me, {DATE}: found damaged rows .* build makes the day again"):
            print(log.days(), log.day("me", DATE))
        assert list(log.days()) == [("me", "2024-05-02")], "so that a build makes it"
        [(person, date, reason)] = log.failures()
        assert (person, date, reason[:12]) == ("me", DATE, "damaged rows")


@contextmanager
def full_disk(size, match):
    """Files can have this size; expect an error, whose file is yielded in a list."""
    limits, failed = resource.getrlimit(resource.RLIMIT_FSIZE), []
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        with pytest.raises(OSError, match=match) as failure:
            yield failed
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    failed.append(failure.value.filename)


def test_a_full_disk_costs_only_the_day_that_is_being_stored(stored):
    path, day = stored
    large = replace(day, outings=day.outings * 99)
    with Store(path) as log:
        log.put(Entry("b" * 64, "me", "walk.plt"))
        with full_disk(path.stat().st_size + 100, "disk") as failed:
            put(log, large)
        assert failed == [str(path)]
        assert bits_of(log.day("me", DATE)) == bits_of(day)
        put(log, large)
    with Store(path) as log:
        assert len(log.day("me", DATE).outings) == 99
        assert [entry.hash for entry in log.entries()] == ["b" * 64]


def test_a_file_without_room_on_the_disk_leaves_the_earlier_one(tmp_path):
    cache.write(tmp_path / "day", b"before")
    with full_disk(100, "large") as failed:
        cache.write(tmp_path / "day", bytes(10_000))
    assert failed == [str(tmp_path / "day")]
    assert [file.name for file in tmp_path.iterdir()] == ["day"]
    assert (tmp_path / "day").read_bytes() == b"before"
