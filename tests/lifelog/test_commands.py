"""``pdr-graph lifelog add`` and ``build``: exit codes, messages and progress."""

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from datetime import UTC, datetime

import commands
import days_standin as standin
import pytest
from test_ingest import phyphox

from pdr_graph.apps.lifelog.ingest import add


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
