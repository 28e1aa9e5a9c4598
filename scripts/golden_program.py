"""Run the command line of a checkout for the golden harness, and keep what it writes and prints."""

from __future__ import annotations

import atexit
import contextlib
import importlib
import importlib.util
import math
import multiprocessing
import os
import secrets
import shlex
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Any

from golden_files import VARYING, Rules, compare

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parent / "shared" / "data")).resolve()
SCRATCH = "scratch"  # a folder of a case for what is not compared
EMPTIED = (".png", ".html")  # only compared by name: their content depends on matplotlib and plotly
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
TRIES = 3  # to start a process
KILLED_AT = 0.4  # of the bytes that a replay writes, most of them into its journal
WCHAR = 3  # the word of /proc/PID/io that says how many bytes were written
LOOK_PERIOD = 0.01  # [s] between two looks at a replay that is to be killed

# Libraries that are imported once: each command is a process that is forked afterwards, which saves 2 s of CPU each
LIBRARIES = ["gtsam", "lxml.etree", "matplotlib.backends.backend_agg", "plotly.offline", "pygeomag", "pyproj"]
LIBRARIES += ["rich.console", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.sparse.linalg"]
LIBRARIES += ["scipy.spatial", "scipy.stats", "shapely", "typer", "vqf"]
os.environ.update(ONE_THREAD)  # before the libraries are imported
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(LIBRARIES)


class CaseError(Exception):
    """A case could not be run, or two of its results that have to be equal are not."""


@dataclass(frozen=True)
class Program:
    """The command line of a checkout, run in `folder`, which holds the inputs of all cases."""

    checkout: Path
    folder: Path

    def start(self, printed: Path, *arguments: str) -> ForkServerProcess:
        """Start a command in a new process, which prints to a file."""
        for _ in range(TRIES):
            process = FORKS.Process(target=_command, args=(self.checkout, self.folder, printed, arguments))
            with contextlib.suppress(EOFError, ConnectionError):  # the server that forks has died: try another
                process.start()
                return process
        raise CaseError("no process could be started")

    def run(self, out: Path, *arguments: str) -> None:
        """Run a command to its end; write its exit status and what it prints to `out`."""
        out.mkdir(parents=True, exist_ok=True)
        printed = out / f"{len(list(out.glob('*.printed'))) + 1}-{arguments[0]}.printed"
        with tempfile.TemporaryDirectory() as aside:  # commands refuse a folder with files that they did not write
            ours = [Path(shutil.move(file, aside)) for file in out.glob("*.printed*")]
            process = self.start(Path(aside) / "now", *arguments)
            process.join()
            text = (Path(aside) / "now").read_text(encoding="utf-8")
            for file in ours:
                shutil.move(file, out)
        printed.write_text(f"exit {process.exitcode}\n{text}", encoding="utf-8")
        if "--json" in arguments and process.exitcode == 0:
            printed.with_suffix(".json").write_text(text, encoding="utf-8")

    def check(self) -> None:
        """Raise CaseError if the checkout has no command line."""
        process = self.start(self.folder / "version.printed", "--version")
        process.join()
        if process.exitcode:
            raise CaseError((self.folder / "version.printed").read_text(encoding="utf-8"))


def _command(checkout: Path, folder: Path, printed: Path, arguments: tuple[str, ...]) -> None:
    """Run a command of the checkout's package in this process."""
    with printed.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(checkout)  # for the workers of a lifelog
    sys.path[:] = [str(checkout), *(path for path in sys.path if path != str(ROOT / "scripts"))]
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(folder / "bytecode")
    sys.argv = ["pdr-graph", *arguments]
    sys.modules["__main__"] = ModuleType("__main__")  # else the workers of a lifelog would import this harness
    secrets.token_hex = lambda nbytes=None: "5a" * (nbytes or 32)  # by which a lifelog blurs and cuts places
    project = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    name, function = project["scripts"]["pdr-graph"].split(":")
    module = importlib.import_module(name)
    if not Path(module.__file__ or "").is_relative_to(checkout):
        raise CaseError(f"{module.__file__} was imported instead of {name} in {checkout}")
    try:
        getattr(module, function)()
    finally:
        atexit._run_exitfuncs()  # which a forked process leaves out


@dataclass(frozen=True)
class Case:
    """A name, and what to run with which results in an empty folder."""

    name: str
    run: Callable[[Program, Path], None]

    def make(self, program: Program, out: Path) -> None:
        """Run the case in an emptied folder, and leave there what can be compared."""
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        self.run(program, out)
        shutil.rmtree(out / SCRATCH, ignore_errors=True)
        names = {str(out): "OUT", str(program.folder): "FOLDER", str(DATA): "DATA", str(program.checkout): "CHECKOUT"}
        for path in filter(Path.is_file, out.rglob("*")):
            path.write_bytes(b"" if path.suffix in EMPTIED else _replaced(path.read_bytes(), names))


def _replaced(content: bytes, names: dict[str, str]) -> bytes:
    for path, name in names.items():
        content = content.replace(path.encode(), name.encode())
    return content


def commands(*lines: str) -> Callable[[Program, Path], None]:
    """Run command lines one after the other. OUT in them stands for the case's folder."""

    def run(program: Program, out: Path) -> None:
        for line in lines:
            program.run(out, *(part.replace("OUT", str(out)) for part in shlex.split(line)))

    return run


def require_equal(old: Path, new: Path, skipped: Collection[str] = (), ignored: frozenset[str] = VARYING) -> None:
    """Raise CaseError if the numbers of two folders' files differ."""
    for path in filter(Path.is_file, old.rglob("*")):
        if path.suffix not in EMPTIED and path.name not in skipped:
            numbers = compare(path, new / path.relative_to(old), Rules(ignored)).numbers
            if numbers:
                raise CaseError(f"{path.name} of {new.name} differs from that of {old.name}: {numbers}")


def killed_and_resumed(line: str) -> Callable[[Program, Path], None]:
    """Replay with a journal: once uninterrupted, once killed halfway and resumed. The results have to be equal."""

    def run(program: Program, out: Path) -> None:
        scratch, whole, resumed = out / SCRATCH, out / "whole", out / SCRATCH / "resumed"
        scratch.mkdir()
        replay = [*shlex.split(line), "--journal"]
        size = _watch(program, [*replay, f"{scratch}/whole.journal", "--out", str(whole)])
        again = [*replay, f"{scratch}/killed.journal", "--out", str(resumed)]
        _watch(program, again, kill_after=size * KILLED_AT)
        program.run(scratch, *again)
        require_equal(whole, resumed, {"causal.csv", "latency.json"}, VARYING | {"warnings", "journal", "live"})
        after = (resumed / "causal.csv").read_text().split("\n", 2)[-1]  # without the header and the pose at the kill
        if not (whole / "causal.csv").read_text().endswith(after):
            raise CaseError("the causal poses after the kill differ from those of the uninterrupted replay")

    return run


def _watch(program: Program, arguments: list[str], kill_after: float = math.inf) -> int:
    """Run a replay, or kill it when it has written so much; return how much it wrote [bytes]."""
    process, size = program.start(Path(os.devnull), *arguments), 0
    while process.is_alive():
        with contextlib.suppress(OSError):  # it has just ended
            size = int(Path(f"/proc/{process.pid}/io").read_text().split()[WCHAR])
        if size > kill_after:
            process.kill()
        time.sleep(LOOK_PERIOD)
    process.join()
    expected = 0 if math.isinf(kill_after) else -signal.SIGKILL
    if process.exitcode != expected:
        raise CaseError(f"a replay ended with status {process.exitcode} instead of {expected}")
    return size


def served_trial(log: Path, initial: str, offline: bool) -> Callable[[Program, Path], None]:
    """Serve a GetSensorData log as a competition does, on this machine, and take part in the trial."""

    def run(program: Program, out: Path) -> None:
        server = _evaal_server()
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        rows = [row for row in lines if row and not row.startswith(("%", "POSI"))]
        with server.serving(trial=server.Trial(rows, initial, offline=offline)) as url:
            program.run(out, "evaal", url, "trial", "--out", str(out / "trial"))
        (out / "trial" / "requests.log").unlink()  # has the time of each request
        summary = out / "trial" / "summary.json"
        summary.write_text(summary.read_text().replace(url, "URL"))

    return run


def _evaal_server() -> Any:
    """The module of the tests' own server, which imports nothing of the package."""
    path = next((ROOT / "tests").rglob("evaal_server.py"))
    sys.path.append(str(ROOT / "tests"))  # for what that imports beside it
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise CaseError(f"{path} cannot be imported")
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)  # its dataclasses look it up there
    spec.loader.exec_module(module)
    return module
