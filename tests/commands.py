"""Commands of pdr-graph, each in a process of its own: a copy of one that has imported the package before.

A new interpreter takes longer to import numpy, scipy, GTSAM and matplotlib than a short walk takes to be smoothed.
"""

import atexit
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from functools import cache
from pathlib import Path
from typing import NamedTuple

LONGEST = 240.0  # [s] of one command, on a machine under load
POLL = 0.005  # [s]
FORKED = "import commands; commands.serve()"
NEW = "from pdr_graph.cli import main; main()"


class Ending(NamedTuple):
    """What a command leaves: exit code, output, and the lines of its errors."""

    code: int
    output: str
    errors: list[str]


def run(*arguments, cwd=None, new=False):
    """Run a command in a process; `new`: in a new interpreter, which has imported nothing."""
    if new:
        command = [sys.executable, "-c", NEW, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=LONGEST)
        return Ending(done.returncode, done.stdout, done.stderr.strip().splitlines())
    with tempfile.TemporaryDirectory() as folder:
        output, errors = Path(folder, "output"), Path(folder, "errors")
        request = {
            "arguments": [str(argument) for argument in arguments],
            "folder": str(cwd or Path.cwd()),
            "environment": dict(os.environ),
            "output": str(output),
            "errors": str(errors),
        }
        code = _forkable().run(request)
        return Ending(code, output.read_text(), errors.read_text().strip().splitlines())


@cache
def _forkable():
    return Forkable()


class Forkable:
    """A process that has imported the package and forks itself for each command; it ends with this one."""

    def __init__(self):
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        command = [sys.executable, "-c", FORKED]
        self._process = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdin
        assert self._process.stdout
        self._requests, self._answers = self._process.stdin, self._process.stdout
        atexit.register(self._end)

    def run(self, request):
        """Run a command; return its exit code. A command that takes too long is killed, with TimeoutError."""
        self._requests.write(json.dumps(request | {"limit": LONGEST}).encode() + b"\n")
        self._requests.flush()
        code = json.loads(self._answers.readline())
        if code is None:
            raise TimeoutError(f"{request['arguments']}: no end within {LONGEST} s")
        return code

    def _end(self):
        self._requests.close()
        self._process.wait(LONGEST)


def serve():
    """Fork for each line of the standard input: the copy runs the command that the line describes."""
    import_all()
    answers = os.dup(sys.stdout.fileno())
    for line in sys.stdin:
        request = json.loads(line)
        copy = os.fork()
        if not copy:
            os.close(answers)
            become(request)
            end_as_an_interpreter()
        os.write(answers, json.dumps(ending(copy, request["limit"])).encode() + b"\n")
    os._exit(0)


def import_all():
    """Import what the commands import, some of it late; no thread may have begun, since a fork copies none."""
    import gc
    import importlib
    import pkgutil

    import matplotlib.backends.backend_agg
    import matplotlib.figure  # noqa: F401

    import pdr_graph

    for module in pkgutil.walk_packages(pdr_graph.__path__, "pdr_graph."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    gc.collect()
    gc.freeze()


def become(request):
    """Take the arguments, folder, environment and files of a command."""
    os.setsid()
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    time.tzset()
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    for name, stream in (("output", 1), ("errors", 2)):
        os.dup2(os.open(request[name], os.O_WRONLY | os.O_CREAT, 0o600), stream)
    sys.argv = ["-c", *request["arguments"]]


def end_as_an_interpreter():
    """Run the command; then do what an interpreter does at its end, but for taking down its modules."""
    from pdr_graph.cli import main

    code = 0
    try:
        main()
    except SystemExit as end:
        code = end.code or 0
        if not isinstance(code, int):
            print(code, file=sys.stderr)
            code = 1
    except BaseException:
        traceback.print_exc()
        code = 1
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def ending(process, limit):
    """The exit code of a process, negative for a signal; None if it was killed at the limit."""
    end = time.monotonic() + limit
    while not (done := os.waitpid(process, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            return None
        time.sleep(POLL)
    return os.waitstatus_to_exitcode(done[1])
