"""The second core of a machine: modules that load while a file is read, and a call in a copy of this process."""

from __future__ import annotations

import gc
import os
import pickle
import select
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Generic, Self, TypeVar

from pdr_graph.whole_files import INTERRUPTIONS

Value = TypeVar("Value")
LONGEST_CALL = 60.0  # [s] after which a copy that does not answer is given up
LENGTH = 8  # [bytes] of an answer's length, before it


@contextmanager
def in_background(task: Callable[[], object]) -> Iterator[None]:
    """Run a task in a thread beside the block: an import while a file is unzipped, or what is computed outside Python.

    An exception of the task is dropped, since what failed is tried again where it is needed.
    """

    def run() -> None:
        with suppress(Exception):
            task()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        thread.join()


class ForkedCall(Generic[Value]):
    """One call of a function in a copy of this process (a fork), which prepares while the arguments are computed.

    The copy makes the call faster and nothing else: without one, or if anything goes wrong in it, the call is made in
    this process, with the same result or exception. The copy ends with the block.
    """

    def __init__(self, function: Callable[..., Value], prepare: Callable[[], Any]):
        """function: its result must be picklable; prepare: computes its first argument, before the others are known."""
        self._function, self._prepare = function, prepare
        self._arguments: tuple[Any, ...] = ()
        self._process = 0  # id of the copy; 0 without one
        self._files = list[int]()  # that this process closes at the end

    def __enter__(self) -> Self:
        """Start the copy, where there is a core for it."""
        if _may_fork():
            with suppress(OSError):  # no memory or no file is left: there is no copy
                self._fork()
        return self

    def __exit__(self, *_: object) -> None:
        """End the copy."""
        self._end()

    def start(self, *arguments: Any) -> None:
        """Make the call with these arguments, which must be picklable."""
        self._arguments = arguments
        if self._process:
            shared, go, _ = self._files
            try:
                with os.fdopen(shared, "wb", closefd=False) as file:
                    pickle.dump(arguments, file, pickle.HIGHEST_PROTOCOL)
                os.write(go, b"!")
            except OSError:  # a limit of the system, or the copy was ended
                self._end()

    def result(self) -> Value:
        """The function's result; warnings of the copy are given here."""
        answer = self._answer() if self._process else b""
        self._end()
        if not answer:
            return self._function(self._prepare(), *self._arguments)
        value, warned = pickle.loads(answer)
        for warning in warned:
            warnings.warn_explicit(*warning)
        return value

    def _fork(self) -> None:
        """Start the copy; signals wait until each process knows which of the two it is."""
        shared = os.memfd_create("arguments")
        self._files.append(shared)
        asked, go = os.pipe()
        self._files.append(go)
        answer, answered = os.pipe()
        self._files.append(answer)
        signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTIONS)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads: libraries have some, which are idle
                self._process = os.fork()
            if not self._process:
                os.close(go)  # so that the end of the other process closes it
                self._run(asked, shared, answered)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTIONS)
            os.close(asked)
            os.close(answered)

    def _run(self, asked: int, shared: int, answered: int) -> None:
        """All that the copy does: prepare, wait for the arguments, answer. An error ends it without an answer."""
        try:
            for number in INTERRUPTIONS:
                signal.signal(number, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTIONS)
            gc.disable()  # it would visit, and so copy, all memory
            prepared = self._prepare()
            if os.read(asked, 1):  # nothing, if the other process has ended
                os.lseek(shared, 0, os.SEEK_SET)
                with os.fdopen(shared, "rb") as file, warnings.catch_warnings(record=True) as caught:
                    value = self._function(prepared, *pickle.load(file))
                    warned = [(f"{each.message}", each.category, each.filename, each.lineno) for each in caught]
                data = pickle.dumps((value, warned), pickle.HIGHEST_PROTOCOL)
                with os.fdopen(answered, "wb") as file:
                    file.write(len(data).to_bytes(LENGTH, "big") + data)
        finally:
            os._exit(0)

    def _answer(self) -> bytes:
        """The answer of the copy; empty if it does not come, or not whole."""
        data, pipe, deadline = bytearray(), self._files[-1], time.monotonic() + LONGEST_CALL
        while select.select([pipe], [], [], max(0.0, deadline - time.monotonic()))[0]:
            piece = os.read(pipe, 1 << 20)  # piece [bytes]: read at once
            if not piece:
                whole = len(data) == LENGTH + int.from_bytes(data[:LENGTH], "big")
                return bytes(data[LENGTH:]) if whole else b""
            data += piece
        return b""

    def _end(self) -> None:
        """End the copy, if there is one, and close its files."""
        process, files = self._process, self._files
        self._process, self._files = 0, []
        if process:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
        for file in files:
            os.close(file)


def _may_fork() -> bool:
    """True if another core is free for this process, which is alone with the idle threads of libraries."""
    return sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1 and threading.active_count() == 1
