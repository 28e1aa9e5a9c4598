"""Commands of pdr-graph, each in a process of its own: a copy of one that has imported the package before.

A new interpreter takes longer to import numpy, scipy, GTSAM and matplotlib than a short walk takes to be smoothed.
"""

import atexit
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

LONGEST = 240.0  # [s] of one command, on a machine under load
POLL = 0.005  # [s]
FORKED = "import commands; commands.serve()"
NEW = "import sys; from pdr_graph.__main__ import main; sys.argv[0] = 'pdr-graph'; main()"


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
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "rb") as nothing:
        output, errors = Path(folder, "output"), Path(folder, "errors")
        with output.open("wb") as out, errors.open("wb") as err:
            files = [file.fileno() for file in (nothing, out, err)]
            code = request(forkable(), list(map(str, arguments)), str(cwd or Path.cwd()), files)
        if code is None:
            raise TimeoutError(f"{arguments}: no end within {LONGEST} s")
        return Ending(code, output.read_text(), errors.read_text().strip().splitlines())


def request(address, arguments, folder, files):
    """Have a copy run a command with these three files; return its exit code, None if it was killed at the limit."""
    what = {"arguments": arguments, "folder": folder, "environment": dict(os.environ)}
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(address)
        socket.send_fds(connection, [b"{"], files)
        connection.sendall(json.dumps(what).encode()[1:])
        connection.shutdown(socket.SHUT_WR)
        return json.loads(connection.makefile().read())


@cache
def forkable():
    """Start a process that has imported the package and forks itself for each command; its address.

    It ends with this process, when its standard input does.
    """
    folder = tempfile.mkdtemp()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", FORKED, f"{folder}/socket"]
    process = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin
    assert process.stdout
    assert process.stdout.readline(), "it listens"
    atexit.register(process.wait, LONGEST)
    atexit.register(process.stdin.close)
    return f"{folder}/socket"


def program(folder):
    """Write a program ``pdr-graph`` whose commands are run by copies, for shells that find it first."""
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import commands; "
    code += f"sys.exit(commands.request({forkable()!r}, sys.argv[1:], commands.os.getcwd(), [0, 1, 2]))"
    file = folder / "pdr-graph"
    file.write_text(f"#!{sys.executable} -S\n{code}\n")
    file.chmod(0o755)
    return file


def serve():
    """Fork for each connection: a copy runs the command that is described there, another one waits for its end."""
    import_all()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(sys.argv[1])
        listening.listen()
        os.write(1, b"ready\n")
        while sys.stdin not in select.select([listening, sys.stdin], [], [])[0]:
            connection, _ = listening.accept()
            if not os.fork():
                answer(connection)
            connection.close()
            with suppress(ChildProcessError):  # there is none
                while os.waitpid(-1, os.WNOHANG)[0]:  # those that have answered before
                    pass
    shutil.rmtree(Path(sys.argv[1]).parent, ignore_errors=True)
    os._exit(0)


def answer(connection):
    """Fork again: run the command of a connection, and send its exit code."""
    first, files, *_ = socket.recv_fds(connection, 1, 3)
    with connection.makefile("rb") as rest:
        what = json.loads(first + rest.read())
    copy = os.fork()
    if not copy:
        connection.close()
        become(what, files)
        end_as_an_interpreter()
    connection.sendall(json.dumps(ending(copy, LONGEST)).encode())
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


def become(what, files):
    """Take the arguments, folder, environment and files of a command."""
    os.setsid()
    os.chdir(what["folder"])
    os.environ.clear()
    os.environ.update(what["environment"])
    time.tzset()
    for stream, file in enumerate(files):
        os.dup2(file, stream)
        os.close(file)
    sys.argv = ["pdr-graph", *what["arguments"]]


def end_as_an_interpreter():
    """Run the command; then do what an interpreter does at its end, but for taking down its modules."""
    from pdr_graph.__main__ import main

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
