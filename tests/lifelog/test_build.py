"""A build computes each result once and repeats only what changed; a failure costs one line and nothing else."""

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import days_standin as standin
import pytest

from pdr_graph import InputError
from pdr_graph.apps.lifelog import cache
from pdr_graph.apps.lifelog.build import BuildResult, DayChain, PlannedDay, build, reconstruct_days
from pdr_graph.apps.lifelog.diary import digest_file
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.store import ZONE, RecordingOptions, Store

HERE = Path(__file__).parent


def arcade_there(path):
    """Write the arcade's plan, drawn where the recordings are."""
    from plans import MAPS, moved  # here: the child process of a test has no path to it

    moved(MAPS / "arcade.geojson", path, *standin.PLACE)


def added(folder, people=3, days=5):
    """A lifelog, in UTC, of some people with a recording on each day; and the recordings by person."""
    paths = standin.recordings(folder / "raw", people, days)
    for person, its in paths.items():
        add(folder / "log", its, person=person)
    with Store(folder / "log") as log:
        log.put_setting(ZONE, "UTC")
    return folder / "log", paths


def days_of(log):
    """The days of a lifelog by person and date."""
    with Store(log, reads=True) as store:
        return store.days()


def built(log, reconstruct=standin.reconstruct, **options):
    return build(log, reconstruct=reconstruct, **options)


def content(log):
    """All rows of a lifelog, without the paths of its recordings."""
    with closing(sqlite3.connect(log)) as database:
        names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        rows = {name: sorted(database.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in names}
    rows["recording"] = [(*row[:2], *row[3:]) for row in rows["recording"]]
    return rows


def build_counts(folder):
    """How often each day was reconstructed, by the files of `counting`."""
    return {file.name: len(file.read_text().splitlines()) for file in sorted(folder.iterdir())}


@pytest.fixture
def counted(tmp_path):
    folder = tmp_path / "made"
    folder.mkdir()
    return folder


def test_a_day_has_the_recordings_that_began_on_it(tmp_path):
    log, _ = added(tmp_path)
    standin.recording(tmp_path / "later.plt", 1.01, seed=7)
    add(log, [tmp_path / "later.plt"], person="person1")
    assert built(log) == BuildResult(15, 0, (), ())
    with Store(log) as store:
        days = store.days()
        entries = {Path(entry.path).name: entry for entry in store.entries()}
        track = store.day("person0", "2024-05-03").outings[0].trajectory
    assert list(days) == [(f"person{p}", f"2024-05-0{d}") for p in range(3) for d in range(1, 6)]
    in_order = (entries["1-1.plt"].hash, entries["later.plt"].hash)
    assert days["person1", "2024-05-02"].recordings == in_order
    assert {(entry.duration, entry.steps) for entry in entries.values()} == {(30.0, 0)}
    assert track.time.tolist() == [0, 10, 20, 30]


def test_the_profile_is_carried_from_day_to_day(tmp_path):
    log, _ = added(tmp_path, people=1, days=3)
    before = []

    def learning(person, date, observations, profile, ways=None):
        before.append(None if profile is None else profile.E_length)
        return standin.reconstruct(person, date, observations, profile)

    built(log, learning)
    after = [day.profile.E_length for day in days_of(log).values()]
    assert before == [None, *after[:-1]]
    assert len(set(after)) == 3, "a control: each day teaches something"


def test_a_new_day_is_the_only_one_built_and_needs_nothing_of_the_others(tmp_path, counted):
    log, _ = added(tmp_path, people=2, days=3)
    make = partial(standin.counting, counted)
    assert built(log, make) == BuildResult(6, 0, (), ())
    add(log, [standin.recording(tmp_path / "new.plt", 9)], person="person1")
    shutil.rmtree(tmp_path / "raw")
    assert built(log, make) == BuildResult(1, 6, (), ())
    shutil.rmtree(tmp_path / "log.d")
    assert built(log, make) == BuildResult(0, 7, (), ()), "what lies beside the store is to make days of"
    assert list(build_counts(counted).values()) == 7 * [1]


def test_a_late_recording_changes_its_own_day_and_all_later_ones(tmp_path, counted):
    log, _ = added(tmp_path, people=2)
    built(log, partial(standin.counting, counted))
    add(log, [standin.recording(tmp_path / "late.plt", 2.01, seed=8)], person="person1")
    assert built(log, partial(standin.counting, counted)) == BuildResult(3, 7, (), ())
    again = [day for day, times in build_counts(counted).items() if times == 2]
    assert again == ["person1 2024-05-03", "person1 2024-05-04", "person1 2024-05-05"]
    whole = tmp_path / "whole"
    shutil.copytree(tmp_path / "raw", whole / "raw")
    for person in range(2):
        add(whole / "log", sorted((whole / "raw").glob(f"{person}-*.plt")), person=f"person{person}")
    add(whole / "log", [tmp_path / "late.plt"], person="person1")
    built(whole / "log", zone="UTC")
    assert content(whole / "log") == content(log), "as if it had been there from the beginning"


@pytest.mark.parametrize(
    ("option", "days"), [("plan", 3), ("fixes", 3), ("walker", 1), ("floor", 1), ("content of the plan", 1)]
)
def test_changed_options_change_the_day(tmp_path, option, days):
    """Also the days after it, if its profile changes: by another frame, or by other positions."""
    log, paths = added(tmp_path, people=1)
    plan, walker, fixes = tmp_path / "plan.geojson", tmp_path / "walker.toml", tmp_path / "fixes.csv"
    arcade_there(plan)
    walker.write_text("height = 1.6\n")
    fixes.write_text(f"time,lat,lon,sigma\n{standin.FIRST + 2 * 86400:.1f},52.5,13.4,3\n")
    if option == "content of the plan":
        add(log, [paths["person0"][2]], RecordingOptions(plan=plan))
        built(log)
        plan.write_text(plan.read_text() + "\n")
    else:
        built(log)
        given = {"plan": plan, "walker": walker, "fixes": fixes, "floor": "1"}[option]
        add(log, [paths["person0"][2]], RecordingOptions(**{option: given}))
    assert built(log) == BuildResult(days, 5 - days, (), ())
    assert built(log) == BuildResult(0, 5, (), ())
    with Store(log) as store:
        day = store.day("person0", "2024-05-03")
    assert bool(day.outings[0].plan) == (option in ("plan", "content of the plan"))


def test_days_are_separated_at_midnight_of_the_zone(tmp_path):
    log, _ = added(tmp_path, people=1)
    built(log)
    assert [date for _, date in days_of(log)] == [f"2024-05-0{d}" for d in range(1, 6)]
    assert built(log, zone="Europe/Berlin") == BuildResult(5, 0, (), ()), "the recordings began after midnight there"
    assert built(log) == BuildResult(0, 5, (), ()), "it is kept in mind"
    assert [date for _, date in days_of(log)] == [f"2024-05-0{d}" for d in range(2, 7)]
    assert built(log, zone="UTC").built == 5
    assert built(log, zone="local").built == 5, "they were recorded in Berlin"
    for zone in ("Europe/Entenhausen", "/etc/passwd", "../UTC", "", "Europe"):
        with pytest.raises(InputError, match=r"--zone: found .*, expected a time zone, as Europe/Berlin"):
            built(log, zone=zone)


def test_a_recording_that_changes_its_person_is_in_one_day_only(tmp_path):
    log, paths = added(tmp_path, people=1, days=2)
    built(log)
    add(log, [paths["person0"][0]], person="Ada")
    assert built(log) == BuildResult(2, 0, (), ())
    assert list(days_of(log)) == [("Ada", "2024-05-01"), ("person0", "2024-05-02")]


def test_a_day_that_fails_does_not_stop_the_others(tmp_path, counted):
    log, _ = added(tmp_path, people=2)
    reason = "2024-05-03: ZeroDivisionError: no day like 2024-05-03"
    failing = standin.failing_on("2024-05-03")
    assert built(log, failing) == BuildResult(8, 0, (f"person0, {reason}", f"person1, {reason}"), ())
    with Store(log) as store:
        assert [day[2] for day in store.failures()] == [reason[12:]] * 2
    assert [date[-2:] for _, date in days_of(log)] == 2 * ["01", "02", "04", "05"]
    assert built(log, failing).failures == (f"person0, {reason}", f"person1, {reason}"), "it is tried again"
    assert built(log, failing) == BuildResult(0, 8, (f"person0, {reason}", f"person1, {reason}"), ())
    assert built(log, partial(standin.counting, counted)) == BuildResult(6, 4, (), ())
    assert {name[-2:] for name in build_counts(counted)} == {"03", "04", "05"}
    other, _ = added(tmp_path / "other", people=2)
    built(other)
    assert content(other) == content(log), "as if it had never failed"


def test_a_day_that_fails_keeps_its_earlier_rows(tmp_path):
    log, _ = added(tmp_path, people=1, days=2)
    built(log)
    before = content(log)
    add(log, [standin.recording(tmp_path / "late.plt", 1.01)], person="person0")
    assert built(log, standin.failing_on("2024-05-02")).failures
    assert content(log)["trajectory"] == before["trajectory"]


CLOCK = "time: found 1e+18 s since 1970, expected a time from 1970 to tomorrow: give --begins"


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda log, file: file.unlink(), "{}: found no such file, expected the recording"),
        (lambda log, file: standin.recording(file, 1, seed=99), "found changed content, expected the content that was"),
        (lambda log, file: add(log, [file], RecordingOptions(begins=1e18)), CLOCK),
    ],
    ids=["missing", "changed", "a clock that was never set"],
)
def test_an_unusable_recording_costs_one_line_until_it_is_there_again(tmp_path, spoil, reason):
    log, paths = added(tmp_path, people=1, days=2)
    file = paths["person0"][1]
    original = shutil.copy(file, tmp_path / "original.plt")
    spoil(log, file)
    result = built(log)
    assert (result.built, result.failures) == (1, ())
    [line] = result.refusals
    assert reason.format(file) in line
    assert built(log).refusals == (line,)
    add(log, [original], RecordingOptions(begins=standin.FIRST + 86_400))
    assert built(log) == BuildResult(1, 1, (), ())


def test_a_missing_plan_costs_one_line_and_keeps_the_days(tmp_path):
    log, paths = added(tmp_path, people=1, days=3)
    plan = tmp_path / "plan.geojson"
    arcade_there(plan)
    add(log, paths["person0"], RecordingOptions(plan=plan))
    built(log)
    before = content(log)
    plan.unlink()
    result = built(log)
    assert (result.built, result.up_to_date, result.failures) == (0, 3, ())
    assert len(result.refusals) == 3
    assert result.refusals[0].startswith(f"{plan}: found No such file or directory, expected the plan of {tmp_path}")
    assert content(log) | {"recording": ()} == before | {"recording": ()}


def test_a_damaged_observation_is_created_again(tmp_path):
    log, paths = added(tmp_path, people=1, days=2)
    built(log)
    with Store(log) as store:
        entries = {Path(entry.path): entry for entry in store.entries()}
        file = store.folder / "observations" / entries[paths["person0"][1]].observation
    whole = file.read_bytes()
    file.unlink()
    late = standin.recording(tmp_path / "late.plt", 1.01)
    add(log, [late], person="person0")
    assert built(log) == BuildResult(1, 1, (), ())
    assert file.read_bytes() == whole
    file.write_bytes(whole[:-9])
    add(log, [late], RecordingOptions(floor="1"))
    assert "found no observation, or a damaged one" in built(log).failures[0]
    assert built(log) == BuildResult(1, 1, (), ())
    assert file.read_bytes() == whole


def test_temporary_files_and_old_observations_are_removed(tmp_path):
    log, paths = added(tmp_path, people=1, days=2)
    (tmp_path / "log.d" / "days").mkdir(parents=True)
    (tmp_path / "log.d" / "days" / "tmp1.part").write_bytes(b"of a process that was killed")
    (tmp_path / "log.d" / "recordings" / "tmp2.part").mkdir(parents=True)
    built(log)
    add(log, paths["person0"], RecordingOptions(floor="1"))
    built(log)
    with Store(log) as store:
        names = {entry.observation for entry in store.entries()}
        digests = {digest_file(store.folder, *own).name for own in store.days()}
    left = {path.name for path in (tmp_path / "log.d").rglob("*")}
    assert left == {"days", "observations", "recordings", "digests", *names, *digests}


def test_another_version_rebuilds_everything(tmp_path, monkeypatch):
    log, _ = added(tmp_path, people=1, days=2)
    built(log)
    monkeypatch.setattr(cache, "RESULT_VERSION", "0.0.0, 1")
    assert built(log) == BuildResult(2, 0, (), ())
    with closing(sqlite3.connect(log)) as database:
        assert {"pdr_graph", "gtsam", "numpy", "python"} <= dict(database.execute("SELECT * FROM version")).keys()


def test_a_worker_of_another_version_is_refused(tmp_path):
    chain = DayChain("me", (PlannedDay("2024-05-01", (("a", "b"),), None),), None, str(tmp_path), "9.9.9, 1")
    [done] = reconstruct_days([chain], standin.reconstruct)
    assert done.failure == f"--scheduler, a worker: found pdr_graph {cache.RESULT_VERSION}, expected 9.9.9, 1, as here"
    assert not list(tmp_path.iterdir())


CHILD = """
import os, sys, pathlib
sys.path.insert(0, sys.argv[2])
import days_standin, test_build
import pdr_graph.apps.lifelog.observation
log = pathlib.Path(sys.argv[1])
def report(*done):
    os.write(1, b".")
while sys.stdin.readline().strip():  # a process for each life: what takes time to load is loaded
    child = os.fork()
    if not child:
        test_build.built(log, days_standin.slow, progress=report)
        os._exit(0)
    os.write(2, f"{child}\\n".encode())
    os.write(2, f"{os.waitpid(child, 0)[1]}\\n".encode())
"""


@pytest.mark.thorough
def test_twenty_kills_lose_nothing_and_repeat_nothing(tmp_path):
    log, _ = added(tmp_path, people=6, days=10)
    luck, killed, seen = random.Random(3), [], []
    nursery = subprocess.Popen([sys.executable, "-c", CHILD, log, HERE], stdin=-1, stdout=-1, stderr=-1, bufsize=0)
    for _ in range(20):
        nursery.stdin.write(b"live\n")
        child = int(nursery.stderr.readline())
        for _ in range(luck.choice([1, 3, 6])):  # done by this one, of 120
            nursery.stdout.read(1)
        time.sleep(luck.uniform(0, 0.03))
        with suppress(ProcessLookupError):  # it may be done
            os.kill(child, signal.SIGKILL)
        killed.append(int(nursery.stderr.readline()))
        seen.append(len(days_of(log)))
    nursery.communicate(b"\n", timeout=60)
    assert killed == 20 * [signal.SIGKILL], "a control: none was done before"
    assert seen == sorted(seen), "what is built stays"
    assert seen[-1] in range(5, 60), "a control: some was built, and some was left to build"
    result = built(log)
    assert (result.built + result.up_to_date, result.failures, result.refusals) == (60, (), ())
    other, _ = added(tmp_path / "other", people=6, days=10)
    built(other)
    assert content(other) == content(log)
    assert not list((tmp_path / "log.d" / "days").iterdir())


def test_ways_are_kept_for_later_builds_and_a_change_of_them_builds_the_days_again(tmp_path):
    """Days are built with ways once; those of a file that is gone, or is none, are refused before anything is done."""
    ways = tmp_path / "krems.osm"
    shutil.copy(HERE.parent / "floor" / "krems.osm", ways)
    log, _ = added(tmp_path, people=1, days=2)
    given = []

    def reconstruct(person, date, observations, profile, ways):
        given.append(ways)
        return standin.reconstruct(person, date, observations, profile)

    def built(paths=None):
        return build(log, observe=standin.observe, reconstruct=reconstruct, paths=paths).built

    assert [built(str(ways)), built()] == [2, 0]
    assert {file for file, _ in given} == {str(ways)}
    ways.write_bytes(ways.read_bytes().replace(b"footway", b"path"))
    assert built() == 2
    with pytest.raises(InputError, match="no such file"):
        built(str(tmp_path / "none.osm"))
    ways.unlink()
    with pytest.raises(InputError, match="or --paths none"):
        built()
    given.clear()
    assert built("none") == 2
    assert given == [("", "")] * 2
