"""Recordings are added once and days built, by function and by command; a file that is none costs one line."""

import os
import re
import shutil
import sqlite3
import subprocess
import sys
import zipfile
from contextlib import closing
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

import commands
import days_standin as standin
import pytest
import recorders
from plans import MAPS

from pdr_graph import InputError
from pdr_graph.apps.lifelog.ingest import AddResult, add, find_recordings, time_of
from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.apps.lifelog.store import Entry, RecordingOptions, Store


def entries(path):
    with Store(path) as log:
        return {entry.path.rpartition("/")[2]: entry for entry in log.entries()}


def phyphox(folder, **options):
    """Write a recording that is a folder of tables without a date."""
    for name, text in recorders.phyphox(recorders.sample(), **options).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_a_recording_is_added_once(tmp_path):
    log, walk = tmp_path / "log", standin.recording(tmp_path / "walk.plt")
    assert add(log, [walk]) == AddResult(added=1)
    assert add(log, [walk]) == AddResult(existing=1)
    other = shutil.copy(walk, tmp_path / "the same.plt")
    assert add(log, [other, walk, other]) == AddResult(existing=2), "a path that is given twice is one"
    [entry] = entries(log).values()
    assert entry == Entry(entry.hash, "me", str(walk))
    moved = walk.rename(tmp_path / "moved.plt")
    assert add(log, [moved]) == AddResult(existing=1)
    assert list(entries(log)) == ["moved.plt"]
    standin.recording(walk, seed=1)
    assert add(log, [walk]) == AddResult(added=1), "another content is another recording"


def test_options_replace_earlier_ones(tmp_path):
    log, walk = tmp_path / "log", standin.recording(tmp_path / "walk.plt")
    toml = tmp_path / "walker.toml"
    toml.write_text("height = 1.6\n")
    assert add(log, [walk], person="Ada") == AddResult(added=1)
    assert add(log, [walk], RecordingOptions(walker=toml, floor="2")) == AddResult(existing=1, changed=1)
    assert add(log, [walk], RecordingOptions(walker=toml)) == AddResult(existing=1), "what is not given stays"
    assert add(log, [walk], RecordingOptions(begins=1.7e9), person="Grace") == AddResult(existing=1, changed=1)
    [entry] = entries(log).values()
    assert entry == Entry(entry.hash, "Grace", str(walk), RecordingOptions(walker=toml, floor="2", begins=1.7e9))


def test_all_recordings_in_a_folder_are_added(tmp_path):
    folder = tmp_path / "days"
    expected = [standin.recording(folder / "may" / f"{n}.plt", n) for n in range(3)]
    expected += [standin.recording(folder / "june" / "1.plt", 30), phyphox(folder / "experiment")]
    zipped = folder / "july.zip"
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.write(standin.recording(tmp_path / "july.plt", 60), "july.plt")
    (folder / "notes.txt").write_text("It rained.")
    (folder / "loop").symlink_to(folder)
    found, passed, refused = find_recordings([folder])
    assert sorted(found) == sorted([*expected, zipped])
    assert (passed, refused) == (1, [])
    begin = standin.FIRST
    assert add(tmp_path / "log", [folder / "may", folder / "june"]) == AddResult(added=4)
    result = add(tmp_path / "log", [folder])
    assert (result.added, result.existing, result.skipped) == (1, 4, 1)
    assert [line.partition(": ")[2] for line in result.refused] == [
        "found no date, expected a start time: give --begins with a time such as 2024-05-01T09:30:00+02:00"
    ]
    assert add(tmp_path / "log", [folder / "experiment"], RecordingOptions(begins=begin)) == AddResult(added=1)


def test_a_folder_with_one_recording_is_one_recording(tmp_path):
    folder = phyphox(tmp_path / "experiment")
    log = tmp_path / "log"
    assert add(log, [folder], RecordingOptions(begins=1.7e9)) == AddResult(added=1)
    (folder / ".DS_Store").write_text("a window's place")
    copied = shutil.copytree(folder, tmp_path / "elsewhere" / "experiment")
    assert add(log, [copied.parent]) == AddResult(existing=1), "its content is what a reader sees in it"


def test_unreadable_files_do_not_stop_the_others(tmp_path):
    good, torn = standin.recording(tmp_path / "good.plt"), tmp_path / "torn.zip"
    torn.write_bytes(b"PK\x03\x04 and no more")
    other, empty, odd = tmp_path / "letter.txt", tmp_path / "empty", tmp_path / "walk\udcff.plt"
    other.write_text("Dear Ada")
    empty.mkdir()
    shutil.copy(good, odd)
    result = add(tmp_path / "log", [torn, good, other, empty, odd, tmp_path / "none"])
    assert result.added == 1
    assert {line.partition(": ")[2].partition(",")[0] for line in result.refused} > {
        "found 0 files",
        "found a damaged zip (File is not a zip file)",
        "found a text that begins with 'Dear Ada'",
        "found no such file",
    }
    assert all(line.isprintable() for line in result.refused)


def test_a_recording_without_steps_and_positions_is_refused(tmp_path):
    """A gyroscope alone and a single position are refused; fixes beside the gyroscope are accepted."""
    folder, log = phyphox(tmp_path / "experiment"), tmp_path / "log"
    for file in folder.glob("*.csv"):
        if file.name != "Gyroscope.csv":
            file.unlink()
    single = standin.recording(tmp_path / "single.plt")
    single.write_text("".join(single.read_text().splitlines(keepends=True)[:7]))
    message = [add(log, [one], RecordingOptions(begins=1.7e9)).refused for one in (folder, single)]
    assert [line.partition(": ")[2] for (line,) in message] == [
        f"found no acceleration and {n} positions, expected an accelerometer, or at least 2 positions" for n in (0, 1)
    ]
    with pytest.raises(InputError, match="found no acceleration and 0 positions"):
        observe(folder, RecordingOptions(begins=1.7e9))  # as of a lifelog that an older version made
    fixes = tmp_path / "fixes.csv"
    fixes.write_text("time,x,y,sigma\n1,0,0,3\n9,10,0,3\n")
    assert add(log, [folder], RecordingOptions(begins=1.7e9, fixes=fixes)).added == 1


ARCADE = MAPS / "arcade.geojson"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"person": " "}, "--person: found ' ', expected a name"),
        ({"plan": Path("none.geojson")}, "found no such file"),
        ({"walker": Path("none.toml")}, "expected a TOML file"),
        ({"begins": 1.7e9}, "--begins: found 2 recordings, expected a single recording"),
        ({"plan": ARCADE, "floor": "attic"}, "found the floors 1, expected a floor 'attic'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_an_unusable_option_is_refused(tmp_path, options, message):
    standin.recordings(tmp_path / "days", 1, 2)
    given = RecordingOptions(**{name: value for name, value in options.items() if name != "person"})
    with pytest.raises(InputError, match=message):
        add(tmp_path / "log", [tmp_path / "days"], given, person=options.get("person"))
    assert not (tmp_path / "log").exists(), "nothing is made of it"


def test_a_copy_replaces_the_original(tmp_path):
    log, folder = tmp_path / "log", phyphox(tmp_path / "experiment")
    walk = standin.recording(tmp_path / "walk.plt")
    (tmp_path / "BLE_Locations.csv").write_text("beacon,lat,lon\na,52.5,13.4\n")
    add(log, [walk], copy=True)
    add(log, [folder], RecordingOptions(begins=1.7e9), copy=True)
    content, copied = walk.read_bytes(), Path(entries(log)["walk.plt"].path)
    walk.unlink()
    shutil.rmtree(folder)
    assert copied.read_bytes() == content
    assert copied.with_name("BLE_Locations.csv").exists(), "the list of beacons beside it is a part of it"
    back = tmp_path / "back.plt"
    back.write_bytes(content)
    assert add(log, [back]) == AddResult(existing=1)
    assert entries(log)["walk.plt"].path == str(copied), "what is copied stays the copy"
    assert add(log, [copied.parent.parent]) == AddResult(existing=2, skipped=1), (
        "the copies are the recordings that they are of"
    )


def test_times_without_an_offset_are_utc():
    assert time_of("2024-05-01T09:30:00") == datetime(2024, 5, 1, 9, 30, tzinfo=UTC).timestamp()
    assert time_of("2024-05-01T09:30:00+02:00") == datetime(2024, 5, 1, 7, 30, tzinfo=UTC).timestamp()
    with pytest.raises(InputError, match=r"--begins: found yesterday, expected a time such as"):
        time_of("yesterday")


# The commands: exit codes, messages and progress


def run(*arguments):
    """Run a command of the lifelog; returns its exit code, output and error lines."""
    return commands.run("lifelog", *arguments)


def test_days_are_added_and_built(tmp_path):
    log = tmp_path / "days.db"
    for n in range(3):
        standin.recording(tmp_path / "walks" / f"{n}.plt", n, points=40)
    assert run("add", log, tmp_path / "walks", "--person", "Ada") == (0, f"3 added -> {log}\n", [])
    again = f"0 added, 3 there already, 0 of them with other options now -> {log}\n"
    assert run("add", log, tmp_path / "walks", tmp_path / "walks") == (0, again, [])
    assert run("build", log, "--zone", "Asia/Tokyo") == (0, f"3 days built, 0 up to date, 0 failed -> {log}\n", [])
    assert run("build", log) == (0, f"0 days built, 3 up to date, 0 failed -> {log}\n", [])
    with closing(sqlite3.connect(log)) as database:
        dates = database.execute("SELECT person, date FROM outing ORDER BY date").fetchall()
    assert dates == [("Ada", f"2024-05-0{n}") for n in (2, 3, 4)]
    assert log.stat().st_mode & 0o077 == 0


def test_an_unreadable_or_missing_recording_is_one_line_and_exit_3(tmp_path):
    log, bad = tmp_path / "days.db", tmp_path / "bad.txt"
    good = [standin.recording(tmp_path / f"{n}.plt", n) for n in range(2)]
    bad.write_text("Dear Ada")
    code, message, [line] = run("add", log, bad, *good)
    assert (code, message) == (3, f"2 added -> {log}\n")
    assert line.startswith(f"pdr-graph: {bad}: found a text that begins with 'Dear Ada', expected a recording")
    good[0].unlink()
    code, message, [line] = run("build", log)
    assert (code, message) == (3, f"1 day built, 0 up to date, 0 failed -> {log}\n")
    expected = "found no such file, expected the recording: add it again from its present place"
    assert line == f"pdr-graph: {good[0]}: {expected}"
    code, _, errors = run("add", log, bad, good[0])
    assert (code, len(errors)) == (2, 2), "none is readable"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("build", "none.db"), "none.db: found no such file, expected a lifelog: create it with pdr-graph lifelog add"),
        (("build", "other"), "other: found another kind of file, expected a lifelog, or a name that is not taken"),
        (("add", "other", "walk.plt"), "other: found another kind of file, expected a lifelog"),
        (("add", "/proc/days.db", "walk.plt"), "/proc/days.db: No such file or directory"),
        (
            ("add", "days.db", "walk.plt", "--begins", "soon"),
            "--begins: found soon, expected a time such as 2024-05-01T",
        ),
        (("build", "days.db", "--zone", "Mars"), "--zone: found 'Mars', expected a time zone, as Europe/Berlin"),
        (("build", "days.db", "--workers", "2", "--scheduler", "tcp://a:1"), "--scheduler: found --workers 2 too"),
    ],
)
def test_a_refusal_is_one_line_and_exit_2(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").write_text("time,x,y\n")
    add(tmp_path / "days.db", [standin.recording(tmp_path / "walk.plt")])
    code, out, errors = run(*arguments)
    assert (code, out, len(errors)) == (2, "", 1)
    assert message in errors[0]


def test_a_full_disk_is_one_line(tmp_path):
    log = tmp_path / "days.db"
    add(log, [standin.recording(tmp_path / "walk.plt", points=2000)])
    limited = f"""
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (9000, resource.RLIM_INFINITY))
from pdr_graph.apps.cli import main
import sys
sys.argv = ["pdr-graph", "lifelog", "build", {str(log)!r}]
main()
"""
    done = subprocess.run([sys.executable, "-c", limited], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    [line] = done.stderr.strip().splitlines()
    assert line.startswith(f"pdr-graph: {log}")
    assert "File too large" in line
    assert run("build", log) == (0, f"1 day built, 0 up to date, 0 failed -> {log}\n", [])


def test_begins_is_the_start_of_a_recording_without_a_clock(tmp_path):
    log, walk = tmp_path / "days.db", phyphox(tmp_path / "walk")
    code, _, [line] = run("add", log, walk)
    assert code == 2
    assert "found no date, expected a start time" in line
    assert run("add", log, walk, "--begins", "2024-05-01T23:30:00-01:00")[0] == 0
    with closing(sqlite3.connect(log)) as database:
        [(begins,)] = database.execute("SELECT begins FROM recording")
    assert begins == datetime(2024, 5, 2, 0, 30, tzinfo=UTC).timestamp()


def test_a_progress_bar_is_shown_on_a_terminal_only(tmp_path):
    log, walk = tmp_path / "days.db", standin.recording(tmp_path / "walk.plt")
    main, terminal = os.openpty()
    adding = [sys.executable, "-c", "from pdr_graph.apps.cli import main; main()", "lifelog", "add", log, walk]
    done = subprocess.run(adding, stderr=terminal, stdout=subprocess.PIPE, timeout=60)
    os.close(terminal)
    assert done.stdout.decode() == f"1 added -> {log}\n"
    assert "1/1" in os.read(main, 100_000).decode()
    os.close(main)


def test_a_folder_of_persons_is_added_by_one_call(tmp_path):
    paths = standin.recordings(tmp_path, people=3, days=2)
    for person, own in paths.items():
        (tmp_path / "all" / person).mkdir(parents=True)
        for path in own:
            path.rename(tmp_path / "all" / person / path.name)
    log = tmp_path / "days.db"
    assert run("add", log, tmp_path / "all", "--people") == (0, f"6 added -> {log}\n", [])
    with Store(log) as store:
        assert sorted(entry.person for entry in store.entries()) == sorted([*paths] * 2)
    code, _, [line] = run("add", log, tmp_path / "all" / "person0", "--people")
    assert (code, "found no folder in it" in line) == (2, True)
    assert run("add", log, tmp_path / "all", "--people", "--person", "ben")[0] == 2


def test_a_command_that_logs_to_a_file_prints_a_line_a_minute_with_its_end(monkeypatch, capsys):
    clock, module = iter(range(0, 1000, 25)), import_module("pdr_graph.apps.cli.lifelog")
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(clock)))
    advance = module._progress_lines()
    for done in range(10):
        advance("days", done, 10)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3, "after 75, 150 and 225 s"
    assert all(re.fullmatch(r"pdr-graph: days: [258] of 10, ends about 20[-0-9]+ [0-9:]+", line) for line in lines)
