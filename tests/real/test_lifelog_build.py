"""A lifelog of real recordings: who builds it makes no difference, nor how often it is interrupted."""

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress

import pytest

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.store import RecordingOptions

FLOOR = ("ms_indoor20", "site1", "B1")  # a walk in four pieces


def added(log, data):
    """Days with positions alone, and two of walks: one on a plan, one with beacons."""
    add(log, [data / "geolife_sample", data / "gpx_sample"], person="Geo")
    add(log, [data.joinpath(*FLOOR)], RecordingOptions(plan=data.joinpath(*FLOOR)), person="Ms")
    add(log, sorted((data / "ipin2023_track3").glob("*Trial24*")), person="Ipin")
    return log


def content(log):
    """All that is in a lifelog."""
    with closing(sqlite3.connect(log)) as database:
        names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: sorted(database.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in names}


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """What an undisturbed build makes of the recordings."""
    log = added(tmp_path_factory.mktemp("whole") / "days.db", data)
    result = build(log, zone="Asia/Shanghai")
    assert (result.failures, result.refusals) == ((), ())
    assert result.built > 5
    return content(log)


def test_real_days_are_the_same_whoever_builds_them(data, whole, tmp_path):
    log = added(tmp_path / "days.db", data)
    build(log, zone="Asia/Shanghai", workers=2)
    assert content(log) == whole


CHILD = """
import os, sys, pathlib
import pdr_graph.apps.lifelog.reconstruct
from pdr_graph.apps.lifelog.build import build
while sys.stdin.readline().strip():  # a process for each life: what takes time to load is loaded
    child = os.fork()
    if not child:
        build(pathlib.Path(sys.argv[1]), zone="Asia/Shanghai")
        os._exit(0)
    print(child, flush=True)
    print(os.waitpid(child, 0)[1], flush=True)
"""


def test_real_days_are_the_same_however_often_their_build_is_killed(data, whole, tmp_path):
    log, luck, ends = added(tmp_path / "days.db", data), random.Random(1), []
    nursery = subprocess.Popen([sys.executable, "-c", CHILD, log], stdin=-1, stdout=-1, text=True, bufsize=1)
    assert nursery.stdin is not None
    assert nursery.stdout is not None
    for _ in range(12):
        nursery.stdin.write("live\n")
        child = int(nursery.stdout.readline())
        time.sleep(luck.uniform(0, 0.25))
        with suppress(ProcessLookupError):  # it may be done
            os.kill(child, signal.SIGKILL)
        ends.append(int(nursery.stdout.readline()))
    nursery.communicate("\n", timeout=60)
    assert ends.count(signal.SIGKILL) > 5, "a control: a fast machine may be done before"
    build(log, zone="Asia/Shanghai")
    assert content(log) == whole
