"""A walk survives its process: acknowledged events are stored, and the resumed walk is identical."""

import os
import random
import resource
import signal
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from standin import StandIn, event
from tiers import thorough

from pdr_graph import InputError
from pdr_graph.online.interface import Samples
from pdr_graph.online.journal import WALK_MAGIC, Journal, RecordLog, read_entries
from pdr_graph.storage import encode, fingerprint
from pdr_graph.types import Fixes

HERE = Path(__file__).parent
EVERY = 47  # events of a part of a walk


def opened(path, settings=None, **options):
    return Journal.open(path, StandIn, settings, **options)


def walked(path, n, restarts=()):
    """The journal at n events, its process having ended after some of them."""
    journal = opened(path)
    for number in range(n):
        if number in restarts:
            journal.close()
            journal = opened(path)
        journal.push(event(number))
    return journal


def told(journal):
    """All that a walk is, bit by bit."""
    track = journal.finish().trajectory
    parts = [
        np.array([journal.navigator.place, journal.steps]),
        track.time,
        track.position,
        track.heading,
        track.covariance,
    ]
    return [part.tobytes() for part in parts], track.floor


def files(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_a_resumed_walk_is_identical(tmp_path):
    restarts = random.Random(1).sample(range(300), 20)
    whole, parted = walked(tmp_path / "whole", 300), walked(tmp_path / "parted", 300, restarts)
    assert told(parted) == told(whole)
    assert whole.trajectory.time.tolist() == [0.5 * n for n in range(1, 301)], "all rows are there, each once"
    whole.navigator.place *= 1 + 1e-15
    assert told(parted) != told(whole), "a control: a bit is told"


def walk_on(path, output):
    """Push events without end, and write their numbers."""
    journal = opened(path)
    for number in range(journal.count, 10**9):
        os.write(output, struct.pack("<q", number))
        journal.push(event(number))


def life(path, luck):
    """A process that walks on until it is killed: the count at every moment at which it told it, the first as found."""
    wanted = 8 * luck.choice([0, luck.randrange(EVERY), luck.randrange(5 * EVERY)])
    pipe, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            walk_on(path, writing)
        finally:
            os._exit(1)
    os.close(writing)
    with os.fdopen(pipe, "rb", buffering=0) as told_of:
        output = b""
        while len(output) < wanted and (more := told_of.read(wanted - len(output))):
            output += more
        time.sleep(luck.uniform(0, 0.001 if wanted else 0.05))  # while it opens, or goes on
        os.kill(child, signal.SIGKILL)
        output += told_of.readall()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL, "a control: it did not end by itself"
    return np.frombuffer(output, np.int64)


@pytest.mark.parametrize("kills", [10, thorough(50)])
def test_kills_lose_no_acknowledged_event(tmp_path, kills):
    luck, acknowledged, found = random.Random(9), 0, []
    for _ in range(kills):
        counts = life(tmp_path / "walk", luck)
        if len(counts):
            found.append(counts[0])
            assert acknowledged <= counts[0] <= acknowledged + 1, "every one, and perhaps one that was under way"
            acknowledged = counts[-1]
    assert len(found) > kills / 2, "a control: most lived long enough to begin"
    assert acknowledged > kills / 2.5 * EVERY, "a control: they did walk"
    journal = opened(tmp_path / "walk")
    assert acknowledged <= journal.count <= acknowledged + 1
    assert told(journal) == told(walked(tmp_path / "whole", journal.count))


def test_the_file_grows_with_the_events(tmp_path):
    """By their bytes and some for each, in one file."""
    with opened(tmp_path / "walk") as journal:
        for number in range(60 * EVERY):
            journal.push(event(number))
        largest = max(len(encode(event(number))) for number in range(EVERY))
        assert (tmp_path / "walk").stat().st_size < 1.3 * 60 * EVERY * largest
        assert list(files(tmp_path)) == ["walk"]


def test_a_failing_event_leaves_no_trace(tmp_path):
    journal = walked(tmp_path / "walk", 60)
    before = told(journal)
    with pytest.raises(ValueError, match="no fix at all"):
        journal.push(Fixes.none())
    with pytest.raises(TypeError, match=r"Samples: .*`\$\.time`"):
        journal.push(Samples("accelerometer", [0.0], np.zeros((1, 3))))
    assert (journal.count, told(journal)) == (60, before)
    journal.push(event(60))
    assert told(journal) == told(walked(tmp_path / "other", 61))


def test_a_failing_event_left_by_a_kill_is_skipped(tmp_path):
    journal = walked(tmp_path / "walk", 60)
    before = told(journal)
    journal.close()
    log = RecordLog(tmp_path / "walk", WALK_MAGIC)
    log.append(61, 0.0, encode(Fixes.none()))
    log.close()
    again = opened(tmp_path / "walk")
    assert (again.count, told(again)) == (60, before)


def test_a_full_disk_costs_the_event_and_nothing_else(tmp_path):
    path = tmp_path / "walk"
    journal, limits = walked(path, EVERY - 10), resource.getrlimit(resource.RLIMIT_FSIZE)
    before = told(journal)
    written = max(map(len, files(tmp_path).values()))
    resource.setrlimit(resource.RLIMIT_FSIZE, (written + 100, limits[1]))
    try:
        with pytest.raises(OSError, match="too large") as failure:
            journal.push(event(EVERY - 10))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert failure.value.filename == str(path)
    assert (journal.count, told(journal)) == (EVERY - 10, before)
    for number in range(EVERY - 10, 100):
        journal.push(event(number))
    assert told(journal) == told(walked(tmp_path / "whole", 100))


def test_a_second_process_cannot_open_it(tmp_path):
    """The lock is of the open file: it holds within a process, too."""
    with walked(tmp_path / "walk", 3), pytest.raises(InputError, match="another process that writes to it"):
        opened(tmp_path / "walk")
    assert opened(tmp_path / "walk").count == 3


def test_another_plan_is_an_input_error(tmp_path):
    plan, path = tmp_path / "plan.geojson", tmp_path / "walk"
    plan.write_text("{}")
    settings = {"map": fingerprint(plan), "lag": 60.0, "walker": {"height": 1.8}}
    opened(path, settings).close()
    opened(path, settings).close()
    plan.write_text("{} ")
    for other in (settings | {"map": fingerprint(plan)}, settings | {"lag": None}, {}):
        with pytest.raises(InputError, match="or that with which the walk began"):
            opened(path, other)
    opened(path, settings).close()


FORMAT_1 = zlib.decompress((HERE / "journal_format_1.z").read_bytes())  # of pdr_graph 0.1.0, with events as JSON


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"time,x,y\n", "another kind of file"),
        (b"PDS", "another kind of file"),
        (FORMAT_1, "finish the walk with the pdr_graph that began it, or start a new --journal"),
    ],
    ids=["a table", "three bytes", "format 1"],
)
def test_other_files_are_refused_and_unchanged(tmp_path, content, message):
    (tmp_path / "walk").write_bytes(content)
    refused(opened, tmp_path / "walk", message)
    assert files(tmp_path) == {"walk": content}


@pytest.mark.timeout(20)
def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "walk")
    refused(opened, tmp_path / "walk", "neither a file nor a folder")


@pytest.mark.parametrize("content", [b"", b"PDR"])
def test_an_empty_file_or_the_beginning_of_one_is_a_new_journal(tmp_path, content):
    (tmp_path / "walk").write_bytes(content)
    assert told(walked(tmp_path / "walk", 60)) == told(walked(tmp_path / "other", 60))


def test_a_journal_that_is_cut_off_anywhere_says_so(tmp_path):
    """Between two events too, where all that is there is whole."""
    path = tmp_path / "walk"
    walked(path, 8).close()
    content, found = path.read_bytes(), []
    first = next(read_entries(path, kind=WALK_MAGIC))
    for length in range(1, len(content)):
        path.write_bytes(content[:length])
        if len(WALK_MAGIC) < length < first.end:
            refused(opened, path, "damaged journal")
            assert path.read_bytes() == content[:length]
            continue
        with opened(path) as journal:
            assert journal.loss in journal.status.issues
            assert f"after event {journal.count}" in journal.loss
            found.append(journal.count)
        for aside in tmp_path.glob("*.damaged-1"):
            assert aside.read_bytes() == content[:length]
            aside.unlink()
    assert found == sorted(found)
    assert set(found) == set(range(9))


@pytest.mark.parametrize("seed", range(10))
def test_a_damaged_journal_comes_back_to_an_earlier_event_and_says_so(tmp_path, seed):
    luck, path = random.Random(seed), tmp_path / "walk"
    walked(path, 120).close()
    whole, content = told(walked(tmp_path / "other", 120)), bytearray(path.read_bytes())
    at = luck.randrange(100, len(content) - 64)
    content[at : at + 64] = bytes(64) if seed % 2 else luck.randbytes(64)
    path.write_bytes(content)
    with opened(path) as journal:
        assert told(journal) != whole
        assert journal.loss in journal.status.issues
        assert journal.loss.isprintable()
    assert (tmp_path / "walk.damaged-1").read_bytes() == content


def test_a_missing_event_costs_those_after_it(tmp_path):
    walked(tmp_path / "walk", 20).close()
    *_, seventh = (entry for entry in read_entries(tmp_path / "walk", kind=WALK_MAGIC) if entry.identity == 7)
    content = (tmp_path / "walk").read_bytes()
    (tmp_path / "walk").write_bytes(content[: seventh.offset] + content[seventh.end :])
    with opened(tmp_path / "walk") as journal:
        assert journal.count == 6
        assert f"damaged at byte {seventh.offset}" in journal.loss
        assert "the walk goes on after event 6" in journal.loss
    with opened(tmp_path / "walk") as journal:
        assert (journal.count, journal.loss) == (6, ""), "said once"


@pytest.mark.parametrize(("durable", "waits"), [("process", 0), ("minute", 1), ("power", 2 * EVERY + 9)])
def test_durable_sets_when_to_wait_for_the_disk(tmp_path, durable, waits, monkeypatch):
    calls, clock = [], [0.0]
    monkeypatch.setattr("pdr_graph.online.journal.os.fsync", lambda file: calls.append(clock[0]))
    monkeypatch.setattr("pdr_graph.online.journal.time.monotonic", lambda: clock[0])
    with opened(tmp_path / "walk", durable=durable) as journal:
        calls.clear()
        for number in range(2 * EVERY + 9):
            clock[0] += 1.0
            journal.push(event(number))
        assert len(calls) == waits
        assert told(journal) == told(walked(tmp_path / "other", 2 * EVERY + 9))
