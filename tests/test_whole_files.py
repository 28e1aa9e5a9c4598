"""Output files are whole or absent: errors, full disks, interruptions and second processes leave the earlier ones."""

import os
import resource
import signal
import subprocess
import sys
import time

import pytest

from pdr_graph.errors import InputError
from pdr_graph.whole_files import UNFINISHED, output_folder, uninterrupted, write_file


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.fixture
def earlier(tmp_path):
    """A folder with the result of an earlier run and a file of somebody."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "summary.json").write_text("earlier")
    (out / "notes.txt").write_text("mine")
    return out


def test_files_take_their_places_at_the_end_and_others_stay(earlier):
    with output_folder(earlier) as staged:
        (staged / "summary.json").write_text("new")
        (staged / "meta").mkdir()
        (staged / "meta" / "device.csv").write_text("new")
        assert (earlier / "summary.json").read_text() == "earlier"
    assert names(earlier) == ["meta", "meta/device.csv", "notes.txt", "summary.json"]
    assert (earlier / "summary.json").read_text() == "new"


@pytest.mark.parametrize("error", [ValueError("an estimate that fails"), KeyboardInterrupt(), OSError(28, "full")])
def test_a_failure_leaves_a_folder_as_it_was(earlier, error):
    def fail():
        with output_folder(earlier) as staged:
            (staged / "summary.json").write_text("half")
            raise error

    with pytest.raises(type(error)):
        fail()
    assert names(earlier) == ["notes.txt", "summary.json"]
    assert (earlier / "summary.json").read_text() == "earlier"


def test_an_error_of_the_disk_names_the_file_in_its_place_and_leaves_no_folder(tmp_path):
    with pytest.raises(OSError, match="No space") as raised, output_folder(tmp_path / "a" / "out") as staged:
        raise OSError(28, "No space left on device", str(staged / "figure.png"))
    assert raised.value.filename == str(tmp_path / "a" / "out" / "figure.png")
    assert names(tmp_path) == []


HOLD = """
import sys, time
from pathlib import Path
from pdr_graph.whole_files import output_folder
with output_folder(Path(sys.argv[1])) as staged:
    (staged / "trajectory.csv").write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_told_until_the_first_is_killed_whose_files_are_removed(earlier):
    first = subprocess.Popen([sys.executable, "-c", HOLD, str(earlier)], stdout=subprocess.PIPE, text=True)
    assert first.stdout.readline() == "ready\n"
    with pytest.raises(InputError, match="another process that writes to it"), output_folder(earlier):
        pass
    first.kill()
    first.wait(timeout=30)
    assert (earlier / UNFINISHED / "trajectory.csv").exists()
    with output_folder(earlier) as staged:
        (staged / "summary.json").write_text("new")
    assert names(earlier) == ["notes.txt", "summary.json"]


def test_a_file_is_replaced_as_a_whole_through_a_link(tmp_path):
    (tmp_path / "real.csv").write_text("earlier")
    (tmp_path / "link.csv").symlink_to("real.csv")
    write_file(tmp_path / "link.csv", "new \udcff")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "real.csv").read_text() == "new \\udcff"
    assert names(tmp_path) == ["link.csv", "real.csv"]


def test_a_device_is_written_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_file(pipe, "content")
    assert os.read(reader, 100) == b"content"
    os.close(reader)
    assert pipe.is_fifo()


@pytest.mark.parametrize("size", [0, 4095])
def test_a_full_disk_leaves_the_earlier_file(tmp_path, size):
    (tmp_path / "steps.csv").write_text("earlier")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        with pytest.raises(OSError, match="too large") as raised:
            write_file(tmp_path / "steps.csv", b"x" * 5000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert raised.value.filename == str(tmp_path / "steps.csv")
    assert (tmp_path / "steps.csv").read_text() == "earlier"
    assert names(tmp_path) == ["steps.csv"]


def test_an_interruption_waits_for_the_end_of_a_block():
    """SIGINT raises KeyboardInterrupt here also in a test run that a shell has put into the background."""
    before, done = signal.signal(signal.SIGINT, signal.default_int_handler), []

    def interrupted_in_a_block():
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            done.append(True)

    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted_in_a_block()
        assert done
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def handles(pid, number):
    """True if a process has a handler of a signal."""
    with open(f"/proc/{pid}/status") as status:
        [caught] = [int(line.split()[1], 16) for line in status if line.startswith("SigCgt")]
    return caught >> (number - 1) & 1


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs /proc")
@pytest.mark.parametrize(("number", "line"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "told to end")])
def test_a_command_that_is_interrupted_says_one_line_and_leaves_nothing(tmp_path, number, line):
    command = [sys.executable, "-m", "pdr_graph", "simulate", "campus", "--out", "out"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not handles(process.pid, signal.SIGTERM):  # Python itself is starting
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    assert (process.returncode, out, err) == (128 + number, "", f"pdr-graph: {line}\n")
    assert names(tmp_path) == []
