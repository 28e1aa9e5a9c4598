"""Workers: results do not depend on the process; a crash costs the item, an unusable cluster one line."""

import os
import pickle
import socket
import subprocess
import sys
import threading
from pathlib import Path

import days_standin as standin
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_build import added, built, content
from threadpoolctl import threadpool_info

from pdr_graph import InputError
from pdr_graph.lifelog import workers as fleets
from pdr_graph.lifelog.build import BuildResult, DayChain, PlannedDay, build
from pdr_graph.lifelog.store import Store, StoredDay
from pdr_graph.lifelog.workers import MAX_TASK_SIZE, ONE_THREAD, CrashedItem, fleet, pack

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "memory_limit": 0, "silence_logs": 60}
    with distributed.LocalCluster(**options, dashboard_address=":0") as local:
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
    message = "person1, 2024-05-03: its worker process was killed or crashed"
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
    monkeypatch.setattr(fleets, "CONNECT_TIMEOUT", 0.5)
    log, _ = added(tmp_path, people=1, days=1)
    with pytest.raises(InputError, match=message):
        built(log, **options)
    assert built(log).built == 1


def test_a_server_that_is_no_scheduler_is_refused(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(fleets, "CONNECT_TIMEOUT", 0.5)
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
    with pytest.raises(InputError, match=r"found no Dask, expected the extra fleet"), fleet(scheduler="tcp://a:1"):
        pass


def test_a_scheduler_that_ends_is_one_line(tmp_path):
    pytest.importorskip("distributed")
    log, _ = added(tmp_path, people=2, days=5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    quiet = {"stderr": subprocess.DEVNULL, "env": os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", address[16:], "--no-dashboard"]
    scheduler = subprocess.Popen([*command, "--host", "127.0.0.1"], **quiet)
    worker = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", address, "--no-dashboard"], **quiet)
    ends = []

    def progress(stage, done, of):
        if stage == "recordings" and done == of:
            ends.append(threading.Timer(0.3, scheduler.kill))
            ends[0].start()

    try:
        wait_for(address)
        with pytest.raises(InputError, match="found no answer any more, expected a running scheduler"):
            build(log, scheduler=address, progress=progress, reconstruct=standin.very_slow)
    finally:
        scheduler.kill()
        worker.kill()
    assert built(log).failures == ()
    with Store(log) as store:
        assert len(store.days()) == 10


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
