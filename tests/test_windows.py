"""`smooth`, `replay` and `Navigator` need nothing that Windows lacks.

There is no Windows here: processes of their own run without the modules, functions and signals that it lacks, with its
rules for folders and open files, a byte lock as its `msvcrt` has, and pipes in its Western code page.
"""

import json
import os
import subprocess
import sys

import pytest

PRELUDE = r"""
import asyncio, fcntl, os, psutil, signal, struct, subprocess, sys, types
LACKING = "fcntl resource pwd grp termios tty pty syslog posix_ipc".split()
GONE = "chown confstr ctermid fchown fork forkpty fdatasync getegid geteuid getgid getloadavg getpgid getuid killpg"
GONE += " lchown mkfifo mknod nice pread preadv pwrite pwritev posix_fadvise posix_fallocate sched_getaffinity"
GONE += " sched_setaffinity sched_yield setsid sync statvfs wait3 wait4"
GONE += " O_DIRECTORY O_NOFOLLOW O_NONBLOCK O_SYNC O_CLOEXEC"
for name in GONE.split():
    delattr(os, name)
for name in "SIGHUP SIGKILL SIGALRM SIGUSR1 SIGUSR2 SIGPIPE alarm setitimer pthread_sigmask".split():
    delattr(signal, name)


def locking(handle, mode, count, fcntl=fcntl):
    "A lock of bytes of an open file, not of a process: F_OFD_SETLK."
    here = os.lseek(handle, 0, os.SEEK_CUR)
    try:
        fcntl.fcntl(handle, 37, struct.pack("hhqqi", fcntl.F_WRLCK, 0, here, count, 0))
    except BlockingIOError as error:
        raise PermissionError(13, "Permission denied") from error


sys.modules["msvcrt"] = types.SimpleNamespace(LK_NBLCK=2, locking=locking)
for name in LACKING:
    sys.modules[name] = None


def ours():
    return "pdr_graph" in sys._getframe(2).f_code.co_filename


def opened(path, *how, by=os.open, **options):
    "No folder is opened."
    if ours() and os.path.isdir(path):
        raise PermissionError(13, "Permission denied", str(path))
    return by(path, *how, **options)


def closed_alone(by):
    "A function of files for closed files alone."
    def checked(*paths, **options):
        places = {os.path.realpath(path) for path in paths} if not options else ()
        for handle in os.listdir("/proc/self/fd"):
            place = f"/proc/self/fd/{handle}"
            if os.path.realpath(place) in places and os.path.lexists(place):
                raise PermissionError(13, "The process cannot access the file: it is open", str(paths[0]))
        return by(*paths, **options)
    return checked


os.open = opened
for name in "unlink remove replace rename".split():
    setattr(os, name, closed_alone(getattr(os, name)))
"""
COMMAND = "from pdr_graph.__main__ import main\nsys.argv[0] = 'pdr-graph'\nmain()\n"


def run(code, *arguments):
    """End of a process as on Windows; a text file that is opened without its encoding is an error of ours."""
    environment = os.environ | {"PYTHONIOENCODING": "cp1252", "COLUMNS": "100"}
    strict = ["-X", "warn_default_encoding", "-W", "error::EncodingWarning:pdr_graph"]
    line = [sys.executable, *strict, "-c", PRELUDE + code, *map(str, arguments)]
    return subprocess.run(line, capture_output=True, timeout=300, check=False, env=environment)


@pytest.fixture(scope="module")
def inputs(arcade_walk):
    return arcade_walk, "--map", arcade_walk / "plan.geojson", "--fixes", arcade_walk / "fixes.csv"


@pytest.mark.parametrize("verb", ["smooth", "replay"])
def test_a_walk_is_estimated(verb, inputs, tmp_path):
    journal = ("--journal", tmp_path / "walk.journal") if verb == "replay" else ()
    for _ in range(1 + bool(journal)):  # the second time over the files of the first, from the journal
        ended = run(COMMAND, verb, *inputs, "--out", tmp_path / "out", *journal)
        assert ended.returncode in (0, 3), ended.stderr.decode("cp1252")
        ended.stdout.decode("cp1252")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["steps"] > 30
    assert b"\r" not in (tmp_path / "out" / "trajectory.csv").read_bytes()
    assert not [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]
    if journal:  # Windows alone gives the peak
        latency = json.loads((tmp_path / "out" / "latency.json").read_text())
        assert latency["peak_memory"] is None


TWICE = """
from pathlib import Path
from pdr_graph.errors import InputError
from pdr_graph.whole_files import output_folder
from pdr_graph import Journal, Navigator
out, journal = map(Path, sys.argv[1:])
with output_folder(out), Journal.open(journal, Navigator):
    for again in (lambda: output_folder(out).__enter__(), lambda: Journal.open(journal, Navigator)):
        try:
            again()
        except InputError as error:
            print(error)
"""


def test_a_second_process_waits_for_no_folder_and_no_journal(tmp_path):
    ended = run(TWICE, tmp_path / "out", tmp_path / "walk.journal")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count(b"another process that writes to it") == 2


LIVE = """
import numpy as np
from pathlib import Path
from pdr_graph import Fixes, Journal, Navigator, Samples
def walk(journal, begin, end):
    for second in range(begin, end):
        t = second + np.arange(50) / 50
        phase = 2 * np.pi * 1.8 * t
        a = np.column_stack([0 * t, 0 * t, 9.81 + 3 * np.sin(phase) + 0.5 * np.sin(6 * phase)])  # landings jar
        journal.push(Samples("accelerometer", t, a))
        journal.push(Samples("gyroscope", t, 0.01 * np.ones((50, 3))))
        journal.push(Fixes(t[:1], np.array([[1.3 * second, 0.0]]), np.array([3.0]), ("gps",)))
with Journal.open(Path(sys.argv[1]), Navigator) as journal:
    walk(journal, 0, 20)
    first = journal.pose
with Journal.open(Path(sys.argv[1]), Navigator) as journal:
    assert (journal.pose.x, journal.pose.time) == (first.x, first.time)
    walk(journal, 20, 40)
    print(journal.steps, journal.pose.x)
"""


def test_a_journal_continues_a_live_walk(tmp_path):
    ended = run(LIVE, tmp_path / "walk.journal")
    assert ended.returncode == 0, ended.stderr.decode()
    steps, x = map(float, ended.stdout.split())
    assert steps > 50
    assert abs(x - 1.3 * 39) < 6.0


def test_a_text_is_printed_in_any_code_page(inputs, tmp_path):
    out = tmp_path / "Straße ≤ π"
    ended = run(COMMAND, "smooth", *inputs, "--out", out)
    assert ended.returncode in (0, 3), ended.stderr.decode("cp1252")
    assert (out / "summary.json").exists()
