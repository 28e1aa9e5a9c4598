"""Workers: results do not depend on the process; a crash costs the item, an unusable cluster one line."""

import os
import pickle
import re
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from time import monotonic, sleep

import days_standin as standin
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_build import HERE, added, built, content, days_of
from threadpoolctl import threadpool_info
from tiers import thorough

from pdr_graph import InputError
from pdr_graph.apps.lifelog import workers
from pdr_graph.apps.lifelog.build import BuildResult, DayChain, PlannedDay, build
from pdr_graph.apps.lifelog.export import export_days
from pdr_graph.apps.lifelog.store import StoredDay
from pdr_graph.apps.lifelog.workers import MAX_TASK_SIZE, ONE_THREAD, CrashedItem, FleetLostError, fleet, pack

FORKED = {"distributed.worker.multiprocessing-method": "forkserver"}  # of a process that has imported Dask: at once


@pytest.fixture(scope="module")
def cluster():
    """A cluster that waits for a worker to restart, however long that takes under load."""
    distributed = pytest.importorskip("distributed")
    import dask

    options = {"n_workers": 2, "threads_per_worker": 1, "memory_limit": 0, "silence_logs": 60}
    settings = {
        "distributed.deploy.lost-worker-timeout": "10 minutes",
        "distributed.comm.timeouts.connect": "2 minutes",
        "distributed.scheduler.allowed-failures": 1,  # of a task, 3 by default: each takes a restart
    } | FORKED
    with dask.config.set(settings), distributed.LocalCluster(**options, dashboard_address=":0") as local:
        yield local.scheduler_address


@pytest.fixture(params=["processes", thorough("cluster")])
def elsewhere(request):
    """The options of a build in other processes."""
    return {"workers": 2} if request.param == "processes" else {"scheduler": request.getfixturevalue("cluster")}


def test_the_number_and_kind_of_workers_make_no_difference(tmp_path, elsewhere):
    """Also if a day fails in a worker, or a recording is missing."""
    found = []
    for folder, options in ((tmp_path / "here", {}), (tmp_path / "there", elsewhere)):
        log, paths = added(folder, people=2)
        paths["person1"][4].unlink()
        result = built(log, standin.failing_on("2024-05-03"), **options)
        assert (result.built, len(result.failures), len(result.refusals)) == (7, 2, 1)
        found.append(repr([result, content(log), built(log, **options), content(log)]).replace(str(folder), ""))
    assert found[0] == found[1]


def test_a_day_that_crashes_or_hangs_and_a_recording_that_crashes_cost_only_themselves(
    tmp_path, monkeypatch, elsewhere
):
    """A day that hangs does so when nearly all of its minute is over: the others have theirs, also under load."""
    log, paths = added(tmp_path, days=3)
    monkeypatch.setattr(workers, "STALL_FACTOR", 40)
    reason = CrashedItem("").reason
    days = standin.dying_or_hanging
    result = build(
        log, reconstruct=days, observe=partial(standin.dying_of, "0-1.plt"), time_limit=standin.LIMIT, **elsewhere
    )
    assert (result.built, result.unfinished) == (6, ())
    assert result.failures == (f"person1, 2024-05-02: {reason}", f"person2, 2024-05-02: {reason}")
    assert result.refusals == (f"{paths['person0'][1]}: {reason}",)
    assert built(log).built == 6, "those days and all after them"
    whole, _ = added(tmp_path / "whole", days=3)
    built(whole)
    assert content(log) == content(whole)


def test_a_full_disk_of_a_worker_ends_the_build(tmp_path):
    log, _ = added(tmp_path, people=2, days=2)
    with pytest.raises(OSError, match="large"):
        built(log, standin.filling, workers=2)
    assert built(log).failures == ()


def threads_and_numbers(task):
    """Work that yields its numbers of threads, of loaded libraries and of those to be loaded, and an inverse."""
    for item in task:
        a = np.random.default_rng(item).normal(size=(300, 300))
        yield (
            item,
            np.linalg.inv(a @ a.T).tobytes(),
            [library["num_threads"] for library in threadpool_info()],
            {n: os.environ.get(n) for n in ONE_THREAD},
        )


def test_each_worker_has_one_thread_and_the_same_numbers(elsewhere):
    """Floats come back from a worker bit by bit; the control is a product of random matrices."""
    before, numbers = dict(os.environ), []
    with fleet(**elsewhere) as there, fleet() as here:
        for crew in (here, there):
            results = list(crew.run(threads_and_numbers, [(1,), (2, 3), (4, 5)]))
            numbers.append(sorted(result[:2] for result in results))
            for _, _, threads, variables in results:
                assert set(threads) == {1}
                assert variables == ONE_THREAD
    assert numbers[0] == numbers[1]
    assert [item for item, _ in numbers[1]] == [1, 2, 3, 4, 5]
    assert dict(os.environ) == before, "of this process for a while only"


def killing_the_first(task):
    """Work that kills its process at item 0, else yields each item with the number of items of its task."""
    for item in task:
        if item == 0:
            sleep(0.5)  # the other worker has begun the next task
            os.kill(os.getpid(), signal.SIGKILL)
        yield item, len(task)


def test_after_a_crash_only_what_had_begun_is_run_alone():
    """The crashed item and its neighbours are; the tasks behind them remain whole, to run side by side."""
    tasks = [(3 * n, 3 * n + 1, 3 * n + 2) for n in range(20)]
    with fleet(2) as crew:
        results = list(crew.run(killing_the_first, tasks))
    crashed = [result.item for result in results if isinstance(result, CrashedItem)]
    size = dict(result for result in results if not isinstance(result, CrashedItem))
    assert (crashed, sorted(size)) == ([0], list(range(1, 60)))
    assert (size[1], size[2]) == (1, 1)
    assert all(size[item] == 3 for item in range(30, 60))


def test_a_task_has_paths_and_keys_only():
    built_before = StoredDay("k" * 64, ("h" * 64,), standin.reconstruct("me", "2024-05-01", {}, None).profile)
    days = tuple(PlannedDay(f"2024-05-{d:02}", (("h" * 64, "k" * 64),), built_before) for d in range(MAX_TASK_SIZE))
    chain = DayChain("me", days, None, "/a/folder", "1")
    assert len(pickle.dumps(chain)) < 500 * MAX_TASK_SIZE


@given(st.lists(st.integers(1, 100), max_size=200), st.integers(1, 16))
def test_tasks_have_about_twenty_days(sizes, workers):
    items = list(enumerate(sizes))
    tasks = pack(items, sizes, workers)
    assert sorted(item for task in tasks for item in task) == items, "each once"
    days = [sum(size for _, size in task) for task in tasks]
    for task, count in zip(tasks, days, strict=True):
        assert len(task) == 1 or count < 2 * MAX_TASK_SIZE, "long ones are alone, short ones together"
    assert len(pack(items, [1] * len(items), workers)) >= min(len(items), workers), "each has something to do"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scheduler": "nonsense"}, "--scheduler, nonsense: found missing port number in address 'nonsense'"),
        ({"scheduler": "http://127.0.0.1:1"}, "found unknown address scheme 'http'"),
        ({"scheduler": "tcp://127.0.0.1:1"}, "found Timed out trying to connect"),
    ],
)
def test_an_unusable_cluster_is_refused(tmp_path, monkeypatch, options, message):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_TIMEOUT", 0.5)
    log, _ = added(tmp_path, people=1, days=1)
    with pytest.raises(InputError, match=message):
        built(log, **options)
    assert built(log).built == 1


def test_a_server_that_is_no_scheduler_is_refused(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_TIMEOUT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(InputError, match="found no answer, expected a Dask scheduler"), fleet(scheduler=address):
            pass


def test_a_cluster_without_workers_is_refused(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_TIMEOUT", 3.0)
    refusal = pytest.raises(InputError, match="found no workers, expected at least one")
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty, refusal:
        fleet(scheduler=empty.scheduler_address).__enter__()


def test_the_message_without_dask_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"found no Dask, expected pip install '\.\[fleet\]'"):
        fleet(scheduler="tcp://a:1").__enter__()


@pytest.fixture
def hurry(monkeypatch):
    """A function: from its call on, time of the build that waits here passes 100 times as fast."""
    began = []

    def clock():
        now = monotonic()
        return now + 99 * (now - began[0]) if began else now

    monkeypatch.setattr(workers, "monotonic", clock)
    monkeypatch.setattr(workers, "LOOK_PERIOD", 0.05)
    return lambda: began.append(monotonic())


@pytest.fixture
def small_cluster():
    """A scheduler and its only worker: the processes by name, and the address."""
    distributed = pytest.importorskip("distributed")
    import dask
    from distributed.utils import get_mp_context

    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    with dask.config.set(FORKED):
        start = get_mp_context().Process
    processes = {
        "scheduler": start(target=standin.scheduler, args=(address[16:],)),
        "worker": start(target=standin.worker, args=(address,)),
    }
    for process in processes.values():
        process.start()
    try:
        with distributed.Client(address, timeout=30, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=30)
        yield processes, address
    finally:
        for process in processes.values():
            process.kill()
            process.join()


@pytest.mark.thorough
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("which", ["scheduler", "worker"])
def test_a_cluster_that_goes_or_freezes_leaves_the_rest_to_the_next_build(
    tmp_path, monkeypatch, small_cluster, hurry, which, ending
):
    """A worker that freezes keeps its connection: only the missing results tell."""
    monkeypatch.setattr(workers, "STALL_FACTOR", 1)
    log, _ = added(tmp_path, people=2, days=6)
    processes, address = small_cluster
    made, end = tmp_path / "made", tmp_path / "end"
    made.mkdir()

    def progress(stage, done, of):
        if stage == "days" and done >= 2 and not end.exists():
            os.kill(processes[which].pid, ending)
            monkeypatch.setattr(workers, "CONNECT_TIMEOUT", 0.5)
            hurry()
            end.touch()

    result = build(
        log, scheduler=address, time_limit=60.0, progress=progress, reconstruct=partial(standin.waiting, made, 4, end)
    )
    left = 12 - result.built
    expected = f": {left} person-day{'s' * (left > 1)} not built, left to the next build: person"
    assert len(result.unfinished) == (left > 0), "a worker may finish without its scheduler"
    for line in result.unfinished:
        assert expected in line
    assert 2 <= result.built < 12 + (which == "scheduler"), "what was finished is stored"
    assert (result.up_to_date, result.failures, result.refusals) == (0, (), ())
    assert built(log) == BuildResult(left, 12 - left, (), ())
    whole, _ = added(tmp_path / "whole", people=2, days=6)
    built(whole)
    assert content(log) == content(whole)


def test_recordings_that_a_lost_fleet_has_not_observed_are_named(tmp_path, monkeypatch):
    log, paths = added(tmp_path, people=2, days=4)

    def losing(self, work, tasks, written, running):
        for number, task in list(tasks.items()):
            if number:
                raise FleetLostError("all workers gone")
            yield number, work(task)

    monkeypatch.setattr(workers.Fleet, "_execute", losing)
    result = built(log)
    assert (result.built, result.failures, result.refusals) == (0, (), ())
    recordings, days = result.unfinished
    assert recordings.startswith("all workers gone: 6 recordings not observed, left to the next build: ")
    assert recordings.endswith("and 1 more")
    assert days.startswith("all workers gone: 2 person-days not built, left to the next build: ")
    assert sum(str(path) in recordings for its in paths.values() for path in its) == 5
    monkeypatch.undo()
    assert built(log) == BuildResult(8, 0, (), ())


def test_processes_that_freeze_are_ended(tmp_path, monkeypatch, hurry):
    """A frozen process cannot end itself."""
    monkeypatch.setattr(workers, "STALL_FACTOR", 1)
    log, _ = added(tmp_path, people=2, days=3)
    frozen, hurried = tmp_path / "frozen", []

    def progress(stage, done, of):
        if frozen.exists() and not hurried:
            hurried.append(hurry())

    result = built(log, partial(standin.freezing, frozen), workers=2, time_limit=60.0, progress=progress)
    assert (result.failures, result.refusals) == ((), ())
    [line] = result.unfinished
    assert line.startswith("no recording and no day was finished for 1 min: ")
    assert "person1 2024-05-02 to 2024-05-03 (2)" in line
    assert built(log).failures == ()


LIMITED = "import threading, time; from pdr_graph.apps.lifelog.workers import limited; "
IN_TIME = "list(limited(map(time.sleep, 5 * [0.7]), 3.0))"
HANGING = "list(limited(map(time.sleep, [0.1, 600]), 3.0))"
IN_TWO_THREADS = f"threading.Thread(target=lambda: {HANGING}, daemon=True).start(); "
IN_TWO_THREADS += "list(limited(map(time.sleep, 3000 * [0.1]), 600.0))"


def test_a_time_limit_ends_the_process_of_a_hanging_item_only():
    """Of several threads the earliest deadline counts."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    alone = [
        subprocess.Popen([sys.executable, "-c", LIMITED + code], env=environment, stderr=subprocess.PIPE)
        for code in (IN_TIME, HANGING, IN_TWO_THREADS)
    ]
    assert [(process.communicate(timeout=300)[1], process.returncode) for process in alone] == [
        (b"", 0),
        (b"", 1),
        (b"", 1),
    ]


KILLED = """
import pathlib, sys, time
sys.path.insert(0, sys.argv[2])
import days_standin
from pdr_graph.apps.lifelog.build import build
def slow(*day):
    time.sleep(1)
    return days_standin.reconstruct(*day)
build(pathlib.Path(sys.argv[1]), "UTC", workers=2, reconstruct=slow)
"""


def children_of(process):
    """Ids of the processes that a process has started."""
    found = list[int]()
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            if int(file.read_text().rpartition(")")[2].split()[1]) == process:
                found.append(int(file.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_build_can_be_read_and_its_workers_end_with_it_when_it_is_killed(tmp_path):
    """`export` has the days that are finished; kill -9 leaves no process."""
    log, _ = added(tmp_path, people=12, days=2)
    with subprocess.Popen([sys.executable, "-c", KILLED, log, HERE]) as process:
        end = monotonic() + 60
        while not days_of(log):
            assert monotonic() < end
            sleep(0.1)
        begun = monotonic()
        written, _ = export_days(log, tmp_path / "out", "csv")
        assert process.poll() is None, "a control: it goes on"
        assert monotonic() - begun < 20
        assert written
        workers = children_of(process.pid)
        assert len(workers) >= 2
        process.kill()
    end = monotonic() + 10
    while left := [pid for pid in workers if Path(f"/proc/{pid}").exists()]:
        assert monotonic() < end, left
        sleep(0.1)


@pytest.mark.thorough
@pytest.mark.timeout(300)
def test_the_commands_of_the_docs_start_a_cluster_that_builds(tmp_path):
    pytest.importorskip("distributed")
    lines = (Path(__file__).parents[2] / "docs/lifelog.md").read_text()
    [commands] = [block for block in re.findall(r"```sh\n(.*?)```", lines, re.DOTALL) if "dask scheduler" in block]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        commands = commands.replace("8786", str(free.getsockname()[1]))
    (tmp_path / "pdr-graph").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m pdr_graph "$@"\n')
    (tmp_path / "pdr-graph").chmod(0o700)
    (tmp_path / "dask").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m dask "$@"\n')
    (tmp_path / "dask").chmod(0o700)
    log, _ = added(tmp_path, people=2, days=2)
    path = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": os.pathsep.join(sys.path)}
    script = commands.replace("days.db", str(log)) + "kill $(jobs -p)\nwait\n"
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=os.environ | path, capture_output=True, text=True)
    assert done.stdout.startswith("4 days built, 0 up to date, 0 failed"), done.stderr[-2000:]
