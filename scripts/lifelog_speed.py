"""How long a lifelog takes: a month of a million steps, 200 person-days by several workers, and an hour of raw samples.

Observations are drawn as those of a phone that is carried all day: steps, and fixes half of the time.
"""

import os
import resource
import sqlite3
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tables import table

from pdr_graph import dead_reckon
from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.cache import content_hash
from pdr_graph.apps.lifelog.observation import Observation, observe
from pdr_graph.apps.lifelog.store import Entry, Store
from pdr_graph.frames import enu
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Headings, Steps

FIRST = datetime(2024, 5, 1, 7, tzinfo=UTC).timestamp()  # [s] Unix time of the first walk
DAY, APART = 86_400.0, 14_400.0  # [s] between days, and between the walks of one
WALKS = 3  # on each day
PERIOD = 0.55  # [s] per step
OUTSIDE, FIX, SIGMA = 600.0, 30.0, 4.0  # [s] outside, and as long inside again; between fixes outside; [m] of them
MONTH, STEPS = 30, 1_000_000  # days of one person, and steps in all of them
PEOPLE, DAYS, DAILY = 40, 5, 6_000  # of the fleet, and their steps on a day
LAP = [[40, 0], [40, 30], [0, 30], [0, 0]]


def drawn(recording, *_):
    """What a recording told, of which the file has seed, day, number on that day, and steps."""
    seed, day, number, steps = map(int, recording.read_text().split())
    said, fixes = drawn_walk(steps, seed)
    return Observation(
        source=recording.stem,
        epoch=FIRST + DAY * day + APART * number,
        duration=said.end,
        frame=enu(52.5, 13.4),
        plan="",
        floor="",
        steps=said,
        looks=np.zeros(len(said) + 1),
        headings=Headings.none(),
        fixes=fixes,
    )


def drawn_walk(n, seed):
    """Steps as a front end would say them, and fixes outside."""
    random, zeros = np.random.default_rng(seed), np.zeros(n)
    time_ = PERIOD * np.arange(1, n + 1)
    true = Steps(
        start=0.0,
        end=time_[-1] + 0.5,
        time=time_,
        duration=zeros + PERIOD,
        length=random.normal(0.7, 0.05, n),
        turn=random.normal(0, 0.1, n),
        pause_turn=zeros,
        sigma_length=zeros + 0.07,
        sigma_turn=zeros + 0.02,
    )
    at = np.flatnonzero(np.diff(time_ // FIX, prepend=0) * (time_ % (2 * OUTSIDE) < OUTSIDE))
    place = dead_reckon(true).position[at + 1] + random.normal(0, SIGMA, (len(at), 2))
    fixes = Fixes(time_[at], place, np.full(len(at), SIGMA), ("",) * len(at), source=("GNSS",) * len(at))
    length = 0.95 * true.length + random.normal(0, 0.07, n)
    return replace(true, length=length, turn=true.turn + random.normal(0, 0.02, n)), fixes


def lifelog(folder, people, days, steps):
    """A lifelog of some people, each with as many steps on each day."""
    raw = folder / "raw"
    raw.mkdir(parents=True)
    entries = []
    for person in range(people):
        for day in range(days):
            for number in range(WALKS):
                file = raw / f"{person}-{day}-{number}.txt"
                file.write_text(f"{len(entries)} {day} {number} {round(steps / WALKS)}")
                entries.append(Entry(content_hash(file), f"person {person:02}", str(file)))
    with Store(folder / "lifelog.db", new=True) as log:
        log.put(*entries)
    return folder / "lifelog.db"


def timed(log, **options):
    """Time [s] that days take once all is observed, and most memory [MB] of this process; ``build`` must be whole."""
    began = time.perf_counter()

    def progress(stage, done, total):
        nonlocal began
        if stage == "recordings":
            began = time.perf_counter()

    drawing = import_module(Path(__file__).stem).drawn  # by a name that is the same in every process
    result = build(log, progress=progress, observe=drawing, **options)
    took = time.perf_counter() - began
    if result.failures or result.refusals:
        raise SystemExit("\n".join([*result.failures, *result.refusals]))
    return result.built, took, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def month(folder):
    """A month observed first, in another process than that which makes days of it."""
    log = lifelog(Path(folder), 1, MONTH, STEPS / MONTH)
    _, took, memory = timed(log)
    size = [log.stat().st_size, sum(file.stat().st_size for file in log.with_name("lifelog.db.d").rglob("*"))]
    again = time.perf_counter()
    build(log, observe=drawn)
    return took, memory, size, time.perf_counter() - again


def month_rows():
    """A million steps of one person."""
    with TemporaryDirectory() as folder, alone() as process:
        took, memory, size, again = process.submit(month, folder).result()
    rows = [[f"{MONTH} days, {STEPS} steps, one process", f"{took:.1f} s, {memory:.0f} MB of memory"]]
    rows += [["the same again, nothing being new", f"{again:.2f} s"]]
    rows += [["the store", f"{size[0] / 1e6:.0f} MB"], ["observations beside it", f"{size[1] / 1e6:.0f} MB"]]
    return table(["a month", ""], rows)


def alone():
    """A process of its own, whose memory is that of what it does."""
    return ProcessPoolExecutor(1, mp_context=get_context("spawn"))


def fleet_rows():
    """The same days by this process, by joblib and by Dask."""
    with TemporaryDirectory() as folder:
        ways = {"one process": ({}, 0), "joblib, 2 workers": ({"workers": 2}, 0)}
        ways |= {f"Dask, {n} worker{'s' * (n > 1)}": ({}, n) for n in (1, 2, 4)}
        rows, first, slowest = [], None, None
        for number, (name, (options, dask)) in enumerate(ways.items()):
            log = lifelog(Path(folder) / str(number), PEOPLE, DAYS, DAILY)
            with cluster(dask) as address, alone() as process:
                days, took, _ = process.submit(timed, log, **options, **address).result()
            said = content(log)
            first, slowest = first or said, slowest or took
            same = "—" if not rows else "yes" if said == first else "NO"
            rows.append([name, days, f"{took:.1f}", f"{slowest / took:.2f}", same])
    steps = PEOPLE * DAYS * DAILY
    head = [f"{PEOPLE} people × {DAYS} days, {steps} steps", "person-days", "time [s]", "speed-up", "identical"]
    return f"{table(head, rows)}\n\n{os.cpu_count()} cores; workers had been started, and load what they need."


@contextmanager
def cluster(workers):
    """Options of a local Dask cluster; none without workers."""
    if not workers:
        yield {}
        return
    from distributed import LocalCluster

    options = {"n_workers": workers, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": ":0"}
    with LocalCluster(**options) as local:
        yield {"scheduler": local.scheduler_address}


def content(log):
    """All that is in the tables of days."""
    names = ("day", "outing", "segment", "trajectory", "stay", "facing", "profile", "failure")
    with closing(sqlite3.connect(log)) as database:
        ordered = "SELECT * FROM {} ORDER BY person, date, rowid"
        return {name: database.execute(ordered.format(name)).fetchall() for name in names}


def hour_rows():
    """An hour about a loop, as Sensor Logger has it, with GNSS and a barometer."""
    given = Scenario.of({"route": [[0, 0], *({"to": LAP} for _ in range(37))], "gnss": {}})
    with TemporaryDirectory() as folder:
        write(simulate(given), Path(folder))
        size = sum(path.stat().st_size for path in Path(folder).rglob("*.csv")) / 1e6
        began = time.perf_counter()
        load(folder)
        read = time.perf_counter()
        found = observe(Path(folder))
        done = time.perf_counter()
    rows = [[f"{found.duration / 60:.0f} min of samples at 100 Hz, {size:.0f} MB of text", f"{done - read:.1f} s"]]
    rows += [["of which reading the text", f"{read - began:.1f} s"]]
    return table(["to observe", ""], rows)


def lifelog_rows():
    """A month, a fleet, and an hour of samples."""
    return "\n\n".join(rows() for rows in (month_rows, fleet_rows, hour_rows))
