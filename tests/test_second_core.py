"""A call in a copy of the process has the result of a plain call, whatever happens to the copy; nothing is left."""

import os
import resource
import signal
import subprocess
import sys
import textwrap
import time
import warnings
from pathlib import Path

import pytest

from pdr_graph import second_core
from pdr_graph.second_core import ForkedCall, in_background

HERE = os.getpid()
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="copies are made on Linux alone")


@pytest.fixture(autouse=True)
def _two_cores(monkeypatch):
    """Copies are made, even where the tests have threads or a single core; none is left at the end."""
    monkeypatch.setattr(second_core, "_may_fork", lambda: True)
    files, children = len(os.listdir("/proc/self/fd")), child_processes()
    yield
    assert child_processes() <= children
    assert len(os.listdir("/proc/self/fd")) == files


def child_processes():
    """Numbers of the processes that this one has begun: other tests of the run may have left some, as Dask's."""
    return {
        int(child) for tasks in Path("/proc/self/task").iterdir() for child in (tasks / "children").read_text().split()
    }


def called(function, *arguments):
    """The result of a function of its arguments alone."""
    with ForkedCall(lambda _, *given: function(*given), int) as call:
        call.start(*arguments)
        return call.result()


def process_and_size(data):
    return os.getpid(), len(data)


def test_the_call_is_made_in_another_process():
    process, size = called(process_and_size, bytes(10_000_000))
    assert process != HERE
    assert size == 10_000_000


def test_a_result_larger_than_a_pipe_arrives_whole():
    data = os.urandom(5_000_000)
    assert called(bytes, data) == data


def test_what_was_prepared_is_the_first_argument():
    """It is prepared in the copy alone, before the call is made."""
    began = time.monotonic()

    def prepare():
        time.sleep(0.2)
        return os.getpid(), time.monotonic()

    with ForkedCall(lambda prepared, other: (*prepared, other), prepare) as call:
        time.sleep(0.5)
        called_at = time.monotonic()
        call.start("other")
        process, prepared_at, other = call.result()
    assert process != HERE
    assert began < prepared_at < called_at
    assert other == "other"


def killed(number):
    def function():
        if os.getpid() != HERE:
            os.kill(os.getpid(), number)
        return os.getpid()

    return function


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_if_the_copy_is_killed_the_call_is_made_here(number):
    assert called(killed(number)) == HERE


def test_if_the_preparation_fails_in_the_copy_it_is_made_here():
    def prepare():
        if os.getpid() != HERE:
            raise MemoryError
        return os.getpid()

    with ForkedCall(lambda process: process, prepare) as call:
        call.start()
        assert call.result() == HERE


def test_a_result_that_cannot_be_sent_is_made_here():
    """A function within a function cannot be pickled."""
    assert called(lambda: lambda: os.getpid())() == HERE


def test_an_exception_is_raised_here():
    with pytest.raises(ZeroDivisionError):
        called(divmod, 1, 0)


def test_a_warning_of_the_copy_is_given_here():
    def warn():
        warnings.warn("a glyph is missing", UserWarning, stacklevel=1)
        return os.getpid()

    with pytest.warns(UserWarning, match="a glyph is missing"):
        assert called(warn) != HERE


def test_a_copy_that_does_not_answer_is_given_up(monkeypatch):
    monkeypatch.setattr(second_core, "LONGEST_CALL", 0.3)

    def hang():
        if os.getpid() != HERE:
            time.sleep(60)
        return os.getpid()

    began = time.monotonic()
    assert called(hang) == HERE
    assert time.monotonic() - began < 30


def test_arguments_above_a_limit_of_the_system_are_used_here():
    """A limit of the size of files, as scripts/output_faults sets it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        assert called(process_and_size, bytes(1_000_000)) == (HERE, 1_000_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_call_that_is_never_made_ends_with_its_block():
    with pytest.raises(KeyError), ForkedCall(os.kill, int):
        raise KeyError


KILLED = """
import os, time
from pdr_graph import second_core
second_core._may_fork = lambda: True
with second_core.ForkedCall(time.sleep, lambda: None) as call:
    print(call._process, flush=True)
    time.sleep(60)
"""


def test_if_the_process_is_killed_its_copy_ends_too():
    process = subprocess.Popen([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, text=True)
    copy = int(process.stdout.readline())
    process.kill()
    process.communicate(timeout=30)
    status, deadline = Path(f"/proc/{copy}/status"), time.monotonic() + 30
    while status.exists() and "(zombie)" not in status.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_a_task_beside_a_block_is_done_at_its_end():
    done = []
    with in_background(lambda: done.append(time.sleep(0.2))):
        assert done == []
    assert done == [None]


def test_an_exception_of_a_task_beside_is_dropped(capsys):
    """What failed is tried again where it is needed."""
    with in_background(lambda: 1 / 0):
        pass
    assert capsys.readouterr() == ("", "")


def test_the_garbage_of_a_walk_is_not_frozen_with_the_modules():
    """A program that smooths many walks would grow with each."""
    code = """
        import gc
        from pdr_graph.batch import keep_modules

        keep_modules()
        before = gc.get_freeze_count()
        garbage = [[] for _ in range(1000)]
        keep_modules()
        assert gc.get_freeze_count() <= before
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True, timeout=60)
