"""Workers: results do not depend on the process; a crash costs the item, an unusable cluster one line."""

import os
import pickle
import signal
import socket
import subprocess
import sys
from pathlib import Path

import days_standin as standin
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_build import added, built, content
from threadpoolctl import threadpool_info

from pdr_graph import InputError
from pdr_graph.lifelog import cluster as clusters
from pdr_graph.lifelog import workers as fleets
from pdr_graph.lifelog.build import BuildResult, DayChain, PlannedDay, build
from pdr_graph.lifelog.store import StoredDay
from pdr_graph.lifelog.time_limits import FleetLostError
from pdr_graph.lifelog.workers import MAX_TASK_SIZE, ONE_THREAD, CrashedItem, fleet, pack

HERE = Path(__file__).parent


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
    }
    with dask.config.set(settings), distributed.LocalCluster(**options, dashboard_address=":0") as local:
        yield local.scheduler_address


@pytest.fixture(params=["processes", "cluster"])
def elsewhere(request):
    """The options of a build in other processes."""
    return {"workers": 2} if request.param == "processes" else {"scheduler": request.getfixturevalue("cluster")}


def test_the_number_and_kind_of_workers_make_no_difference(tmp_path, elsewhere):
    here, _ = added(tmp_path / "here", people=4, days=6)
    there, _ = added(tmp_path / "there", people=4, days=6)
    assert built(here) == built(there, **elsewhere) == BuildResult(24, 0, (), ())
    assert content(here) == content(there)
    assert built(there, **elsewhere) == built(there) == BuildResult(0, 24, (), ())


def test_a_day_that_fails_in_a_worker_does_not_stop_the_others(tmp_path, elsewhere):
    here, _ = added(tmp_path / "here", people=2)
    there, paths = added(tmp_path / "there", people=2)
    paths["person1"][4].unlink()
    (tmp_path / "here" / "raw" / paths["person1"][4].name).unlink()
    failing = standin.failing_on("2024-05-03")
    result = built(there, failing, **elsewhere)
    assert (result.built, len(result.failures), len(result.refusals)) == (7, 2, 1)
    expected = built(here, failing)
    assert result.failures == expected.failures
    assert [message.replace("/there/", "/here/") for message in result.refusals] == list(expected.refusals)


def test_a_crashed_process_costs_only_its_day(tmp_path, elsewhere):
    log, _ = added(tmp_path)
    message = f"person1, 2024-05-03: {CrashedItem('').reason}"
    assert built(log, standin.dying, **elsewhere) == BuildResult(14, 0, (message,), ())
    assert built(log) == BuildResult(3, 12, (), ()), "that day and those after it"
    whole, _ = added(tmp_path / "whole")
    built(whole)
    assert content(log) == content(whole)


def test_a_full_disk_of_a_worker_ends_the_build(tmp_path):
    log, _ = added(tmp_path, people=2, days=2)
    with pytest.raises(OSError, match="large"):
        built(log, standin.filling, workers=2)
    assert built(log).failures == ()


def test_a_recording_that_crashes_its_process_is_refused(tmp_path):
    log, paths = added(tmp_path, people=2, days=2)
    result = build(log, workers=2, observe=standin.dying_of("0-1.plt"), reconstruct=standin.reconstruct)
    assert (result.built, result.failures) == (3, ())
    assert result.refusals == (f"{paths['person0'][1]}: {CrashedItem('').reason}",)


def thread_counts(task):
    """Work that yields its numbers of threads, of loaded libraries and of those to be loaded."""
    for item in task:
        yield (
            item,
            [library["num_threads"] for library in threadpool_info()],
            {n: os.environ.get(n) for n in ONE_THREAD},
        )


def test_each_worker_has_one_thread(elsewhere):
    before = dict(os.environ)
    with fleet(**elsewhere) as there, fleet() as here:
        for crew in (here, there):
            results = list(crew.run(thread_counts, [(1,), (2, 3)]))
            assert sorted(item for item, _, _ in results) == [1, 2, 3]
            for _, threads, variables in results:
                assert set(threads) == {1}
                assert variables == ONE_THREAD
    assert dict(os.environ) == before, "of this process for a while only"


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


def test_two_hundred_person_days_are_ten_tasks():
    assert [len(task) for task in pack(range(40), [5] * 40, 2)] == [4] * 10


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"workers": 2, "scheduler": "tcp://127.0.0.1:1"},
            "--scheduler: found --workers 2 too, expected only one of the two options",
        ),
        ({"scheduler": "nonsense"}, "--scheduler, nonsense: found missing port number in address 'nonsense'"),
        ({"scheduler": "http://127.0.0.1:1"}, "found unknown address scheme 'http'"),
        ({"scheduler": "tcp://127.0.0.1:1"}, "found Timed out trying to connect"),
    ],
)
def test_an_unusable_cluster_is_refused(tmp_path, monkeypatch, options, message):
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "CONNECT_TIMEOUT", 0.5)
    log, _ = added(tmp_path, people=1, days=1)
    with pytest.raises(InputError, match=message):
        built(log, **options)
    assert built(log).built == 1


def test_a_server_that_is_no_scheduler_is_refused(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "CONNECT_TIMEOUT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(InputError, match="found no answer, expected a Dask scheduler"), fleet(scheduler=address):
            pass


def test_a_cluster_without_workers_is_refused():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(InputError, match="found no workers, expected at least one"),
        fleet(scheduler=empty.scheduler_address),
    ):
        pass


def test_the_message_without_dask_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    message = r"found no Dask, expected pip install '\.\[fleet\]'"
    with pytest.raises(InputError, match=message), fleet(scheduler="tcp://a:1"):
        pass


@pytest.fixture
def small_cluster():
    """A scheduler and its only worker: the processes by name, and the address."""
    pytest.importorskip("distributed")
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    quiet = {"stderr": subprocess.DEVNULL, "env": os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", address[16:], "--no-dashboard"]
    processes = {"scheduler": subprocess.Popen([*command, "--host", "127.0.0.1"], **quiet)}
    command = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--no-dashboard", "--no-nanny"]
    processes["worker"] = subprocess.Popen([*command, "--nthreads", "1"], **quiet)
    try:
        wait_for(address)
        yield processes, address
    finally:
        for process in processes.values():
            process.kill()
            process.wait()


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("which", ["scheduler", "worker"])
def test_a_cluster_that_goes_or_freezes_leaves_the_rest_to_the_next_build(
    tmp_path, monkeypatch, small_cluster, which, ending
):
    """A worker that freezes keeps its connection: only the missing results tell."""
    monkeypatch.setattr(clusters, "ASK_PERIOD", 0.5)
    monkeypatch.setattr(clusters, "CONNECT_TIMEOUT", 10.0)
    monkeypatch.setattr(clusters, "RESTART_TIME", 20.0)
    monkeypatch.setattr(fleets, "STALL_FACTOR", 1)
    log, _ = added(tmp_path, people=2, days=6)
    processes, address = small_cluster

    def progress(stage, done, of):
        if stage == "days" and done >= 2:
            processes[which].send_signal(ending)

    options = {"scheduler": address, "time_limit": 40.0, "progress": progress}
    result = build(log, **options, reconstruct=standin.very_slow)
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

    def losing(self, work, tasks, written):
        for number, task in enumerate(tasks):
            if number:
                raise FleetLostError("all workers gone")
            yield number, work(task)

    monkeypatch.setattr(fleets.Fleet, "_execute", losing)
    result = built(log)
    assert (result.built, result.failures, result.refusals) == (0, (), ())
    recordings, days = result.unfinished
    assert recordings.startswith("all workers gone: 6 recordings not observed, left to the next build: ")
    assert recordings.endswith("and 1 more")
    assert days.startswith("all workers gone: 2 person-days not built, left to the next build: ")
    assert sum(str(path) in recordings for its in paths.values() for path in its) == 5
    monkeypatch.undo()
    assert built(log) == BuildResult(8, 0, (), ())


def test_a_day_that_hangs_costs_itself(tmp_path, monkeypatch, elsewhere):
    """The limit is generous enough for a machine under load, the fleet's for workers that restart there."""
    log, _ = added(tmp_path, people=2, days=3)
    monkeypatch.setattr(fleets, "STALL_FACTOR", 40)
    message = f"person1, 2024-05-02: {CrashedItem('').reason}"
    assert built(log, standin.hanging, **elsewhere, time_limit=12.0) == BuildResult(5, 0, (message,), ())
    assert built(log) == BuildResult(2, 4, (), ()), "that day and the one after it"


def test_processes_that_freeze_are_ended(tmp_path, monkeypatch):
    """A frozen process cannot end itself."""
    monkeypatch.setattr(fleets, "STALL_FACTOR", 1)
    log, _ = added(tmp_path, people=2, days=3)
    result = built(log, standin.freezing, workers=2, time_limit=40.0)
    assert (result.failures, result.refusals) == ((), ())
    [line] = result.unfinished
    assert line.startswith("no recording and no day was finished for 1 min: ")
    assert "person1 2024-05-02 to 2024-05-03 (2)" in line
    assert built(log).failures == ()


def test_a_time_limit_ends_the_process_of_a_hanging_item_only():
    code = "import time; from pdr_graph.lifelog.time_limits import limited; list(limited(map(time.sleep, {}), 3.0))"
    for sleeps, ended in (([1.0] * 5, 0), ([0.1, 600], 1)):
        done = run_alone(code.format(sleeps))
        assert (done.returncode, done.stderr) == (ended, b"")


def test_the_earliest_deadline_of_several_threads_counts():
    code = """
import threading, time
from pdr_graph.lifelog.time_limits import limited
threading.Thread(target=lambda: list(limited(map(time.sleep, [600]), 2.0)), daemon=True).start()
list(limited(map(time.sleep, [0.1] * 3000), 600.0))
"""
    assert run_alone(code).returncode == 1


def run_alone(code):
    """Run Python code in a process of its own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, timeout=300)


def wait_for(address):
    """Wait until the cluster has a worker."""
    import distributed

    with distributed.Client(address, timeout=30, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=30)


def test_numbers_do_not_depend_on_the_process(elsewhere):
    """Floats come back from a worker bit by bit; the control is a product of random matrices."""
    with fleet(**elsewhere) as there, fleet() as here:
        one, other = (sorted(crew.run(drawn, [(n,) for n in range(5)])) for crew in (here, there))
    assert one == other


def drawn(task):
    for seed in task:
        a = np.random.default_rng(seed).normal(size=(300, 300))
        yield seed, np.linalg.inv(a @ a.T).tobytes()
