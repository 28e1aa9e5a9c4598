"""Disturb every command in the middle of its work. Its outputs must be the earlier ones or the new ones, never half.

python scripts/output_faults.py [COUNT] [KIND ...] [COMMAND ...]

KIND: disk-full, small-disk, read-only, interrupted, killed, second.

COUNT: moments at which each command is interrupted (20). After each fault: one line of text and no traceback; the files
that were there are unchanged, or all new ones are in place; nothing unfinished lies about. A lifelog or journal is then
continued and must give what an undisturbed run gives. small-disk and read-only mount disks, as root.
"""

import hashlib
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from pdr_graph.lab.simulation.scenario import scenario_file

ROOT = Path(__file__).resolve().parents[1]
SIZES = [0, 1, 100, *(1000 * 2**n for n in range(14))]  # [bytes] of the largest file that may be written
FREE = [0, 4096, 20_000, 100_000, 1_000_000, 30_000_000]  # [bytes] on a small disk
# What commands import
MODULES = ["cli", "lifelog.build", "replay", "report.output_files", "report.plotting", "report.content"]
LONGEST = 600  # [s] of one command, on a busy machine
WALK = ["walk", "--map", "walk/plan.geojson", "--fixes", "walk/fixes.csv"]
ROUTE = str(ROOT / "maps/figure_eight.geojson")
ADD, BUILD = ["lifelog", "add", "days.db", "walk"], ["lifelog", "build", "days.db"]
EXPORT, CORRECT = ["lifelog", "export", "days.db"], ["lifelog", "correct"]
HOUR = ["2026-05-01 10:00:30", "2026-05-01 10:01:00"]  # within the simulated walk
# Name -> commands that come before; the command; what it writes, () for a lifelog
COMMANDS = {
    "simulate": ([], ["simulate", "arcade", "--out", "out"], ["out"]),
    "smooth": ([], ["smooth", *WALK, "--out", "out"], ["out"]),
    "replay": ([], ["replay", *WALK, "--out", "out"], ["out"]),
    "replay --journal": ([], ["replay", *WALK, "--out", "out", "--journal", "walk.journal"], ["out"]),
    "steps": ([], ["steps", "walk", "--out", "steps.csv"], ["steps.csv"]),
    "radio-map": ([], ["radio-map", "walk", "smoothed", "--out", "map.npz"], ["map.npz"]),
    "calibrate": ([], ["calibrate", "eight", "--route", ROUTE, "--out", "me.toml"], ["me.toml", "me.png"]),
    "map show": ([], ["map", "show", "walk/plan.geojson", "--out", "plan.png"], ["plan.png"]),
    "map convert": ([], ["map", "convert", "walk/plan.geojson", "--out", "new.geojson"], ["new.geojson", "new.png"]),
    "lifelog add": ([], ADD, []),
    "lifelog build": ([ADD], BUILD, []),
    "lifelog build --workers": ([ADD], [*BUILD, "--workers", "2"], []),
    "lifelog correct": ([ADD, BUILD], [*CORRECT, "not-me", "days.db", *HOUR], []),
    "lifelog forget": ([ADD, BUILD], [*CORRECT, "forget", "days.db", *HOUR], []),
    "lifelog show": ([ADD, BUILD], ["lifelog", "show", "days.db", "--out", "out"], ["out"]),
    "lifelog export": ([ADD, BUILD], [*EXPORT, "--format", "csv", "--out", "out"], ["out"]),
}


class End(NamedTuple):
    """How a command ended."""

    code: int
    errors: str

    @property
    def refused(self):
        return self.code not in (0, 3)


def run(arguments, folder, size=None):
    """Run a command in a fork of this process, which has all modules; size: of the largest file that it may write."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.chdir(folder)
        os.dup2(writer, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if size is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        _end(arguments)
    os.close(writer)
    with os.fdopen(reader, errors="replace") as errors:
        text = errors.read()
    return End(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), text)


def _end(arguments):
    """Run the program, and end the process as it does."""
    from pdr_graph.__main__ import main

    sys.argv, code = ["pdr-graph", *arguments], 0
    try:
        main()
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    sys.stderr.flush()
    os._exit(code)


def run_well(arguments, folder):
    """Run a command that must not be refused."""
    end = run(arguments, folder)
    if end.refused:
        sys.exit(f"{arguments}: {end.errors}")


def start(arguments, folder, **options):
    """Start a command as a program of its own."""
    command = [sys.executable, "-m", "pdr_graph", *arguments]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, **pipes, **options)


def ended(process):
    """Wait for a program."""
    _, errors = process.communicate(timeout=LONGEST)
    return End(process.returncode, errors)


def prepare(root):
    """Recordings and a smoothed walk, which the commands read."""
    scenario = scenario_file("arcade").read_text()
    (root / "walk.toml").write_text(scenario + "\n[wifi]\naccess_points = 15\n")
    for arguments in (
        ["simulate", "walk.toml", "--out", "walk"],
        ["simulate", "figure_eight", "--out", "eight"],
        ["smooth", *WALK, "--out", "smoothed"],
    ):
        run_well(arguments, root)


def contents(folder, names):
    """Hash of every file of some outputs."""
    files = [file for name in names for file in (folder / name, *(folder / name).rglob("*")) if file.is_file()]
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def faults_of(end, folder, names, before):
    """Yield what is wrong after a command whose outputs had some contents before."""
    lines = end.errors.strip().splitlines()
    if "Traceback" in end.errors or "Exception ignored" in end.errors:
        yield f"traceback: {end.errors[-1500:]}"
    elif end.refused and len(lines) != 1:
        yield f"exit code {end.code}, {len(lines)} lines: {end.errors[:800]}"
    now = contents(folder, names)
    changed = {name for name in before.keys() | now.keys() if before.get(name) != now.get(name)}
    complete = now.keys() >= before.keys() and all(name in changed for name in before if name.endswith("summary.json"))
    if end.refused and changed and not complete:
        yield f"changed: {sorted(changed)}"
    left = [path.name for path in folder.rglob("*") if "unfinished" in path.name or path.suffix == ".part"]
    if left:
        yield f"unfinished: {left}"


class Case:
    """A command in a folder of its own, in which it ran once undisturbed."""

    def __init__(self, name, root):
        self.earlier, self.command, self.outputs = COMMANDS[name]
        self.resumes = not self.outputs or "--journal" in self.command  # its work goes on in a file
        self.folder, self.fresh = root / name.replace(" ", "_"), root / f"fresh {name}"
        self.fresh.mkdir()
        for path in ("walk", "eight", "smoothed"):
            (self.fresh / path).symlink_to(root / path)
        for arguments in self.earlier:
            run_well(arguments, self.fresh)
        shutil.copytree(self.fresh, self.folder, symlinks=True)
        started = time.perf_counter()
        ended(start(self.command, self.folder))
        self.seconds = time.perf_counter() - started
        self.expected = self._state() if self.resumes else {}

    def again(self):
        """A folder as before the command, with the outputs of an earlier run unless it resumes."""
        if self.resumes:
            shutil.rmtree(self.folder)
            shutil.copytree(self.fresh, self.folder, symlinks=True)
        self.before = contents(self.folder, self.outputs)
        return self.folder

    def _state(self):
        """The days of a lifelog, or the trajectory of a journal's walk."""
        if self.outputs:
            return contents(self.folder, ["out/trajectory.csv"])
        if self.command is ADD:
            run_well(BUILD, self.folder)
        run_well([*EXPORT, "--format", "csv", "--out", "state"], self.folder)
        return contents(self.folder, ["state"])

    def faults(self, end):
        """Yield what is wrong after a disturbed run; what it resumes is resumed."""
        yield from faults_of(end, self.folder, self.outputs, self.before)
        if self.resumes:
            more = run(self.command, self.folder)
            if more.refused and "already" not in more.errors:
                yield f"cannot be continued: {more.errors[-500:]}"
            elif self._state() != self.expected:
                yield "continued, it gives another result"


def disk_full(case, _):
    """Limit the size of every file."""
    for size in SIZES:
        end = run(case.command, case.again(), size)
        yield f"{size} bytes", end, case.faults(end)


def interrupted(case, count):
    """Ctrl-C and requests to end, at random moments after Python itself has started."""
    random.seed(str(case.command))
    for n in range(count):
        process = start(case.command, case.again())
        at = random.uniform(0.0, 1.0) * case.seconds
        while not _handles_signals(process.pid):
            time.sleep(0.002)
        time.sleep(at)
        number = (signal.SIGINT, signal.SIGTERM)[n % 2]
        process.send_signal(number)
        end = ended(process)
        yield f"{number.name} after {at:.2f} s", end, case.faults(end)


def killed(case, count):
    """SIGKILL of the command and all its processes, at random moments; then the same command again."""
    random.seed(str(case.command))
    for _ in range(count):
        process = start(case.command, case.again(), start_new_session=True)
        at = random.uniform(0.0, 1.0) * case.seconds
        time.sleep(at)
        os.killpg(process.pid, signal.SIGKILL)
        end = ended(process)
        faults = [] if case.resumes else [*_half(case)]
        if not case.resumes:
            again = run(case.command, case.folder)
            faults += faults_of(again, case.folder, case.outputs, {})
        else:
            faults += case.faults(again := run(case.command, case.folder))
        yield f"SIGKILL after {at:.2f} s", End(end.code, again.errors), faults


def _half(case):
    """Yield what is neither of before nor of after a command that was killed."""
    now = contents(case.folder, case.outputs)
    lost = case.before.keys() - now.keys()
    if case.before and lost:
        yield f"lost: {sorted(lost)}"


def _handles_signals(process):
    with open(f"/proc/{process}/status") as status:
        [caught] = [int(line.split()[1], 16) for line in status if line.startswith("SigCgt")] or [-1]
    return caught >> (signal.SIGTERM - 1) & 1


def second(case, _):
    """Two at once: the second is told, or comes after the first."""
    folder = case.again()
    processes = [start(case.command, folder) for _ in range(2)]
    ends = [ended(process) for process in processes]
    faults = [[] if end.code in (0, 2, 3) else list(faults_of(end, folder, [], {})) for end in ends]
    if all(end.refused for end in ends):
        faults[0].append(f"both are refused: {ends[0].errors} {ends[1].errors}")
    for end, found in zip(ends, faults, strict=True):
        yield "", end, found


def small_disk(case, _):
    """Write to disks with little left, which have the earlier outputs."""
    if len(case.outputs) == 1:
        for free in FREE:
            yield _on_disk(case, f"{free} bytes free", free, ())


def read_only(case, _):
    """Write to a disk that cannot be written."""
    if len(case.outputs) == 1:
        yield _on_disk(case, "read-only", 0, ("-o", "remount,ro"))


def _on_disk(case, what, free, remount):
    """Run a command whose output is on a disk in memory."""
    folder, [name] = case.again(), case.outputs
    disk, output = folder / "disk", folder / name
    if not output.exists():
        run_well(case.command, folder)
    disk.mkdir(exist_ok=True)
    size = free + sum(path.stat().st_blocks * 512 for path in (output, *output.rglob("*"))) + 8192
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", disk], check=True)
    try:
        (shutil.copytree if output.is_dir() else shutil.copyfile)(output, disk / name)
        if remount:
            subprocess.run(["mount", *remount, disk], check=True)
        before = contents(disk, [name])
        end = run([str(disk / name) if part == name else part for part in case.command], folder)
        return what, end, list(faults_of(end, disk, [name], before))
    finally:
        subprocess.run(["umount", disk], check=True)


KINDS = {
    "disk-full": disk_full,
    "small-disk": small_disk,
    "read-only": read_only,
    "interrupted": interrupted,
    "killed": killed,
    "second": second,
}


def main():
    count = next((int(text) for text in sys.argv[1:] if text.isdigit()), 20)
    kinds = [name for name in sys.argv[1:] if name in KINDS] or list(KINDS)
    names = [name for name in sys.argv[1:] if name in COMMANDS] or list(COMMANDS)
    failures = 0
    with tempfile.TemporaryDirectory() as scratch:
        prepare(Path(scratch))
        for name in names:
            case = Case(name, Path(scratch))
            for kind in kinds:
                codes = Counter()
                for what, end, faults in KINDS[kind](case, count):
                    codes[end.code] += 1
                    for fault in faults:
                        failures += 1
                        print(f"FAILED {name}, {kind}, {what}: {fault}", flush=True)
                if codes:
                    ends = ", ".join(f"{n} x exit {code}" for code, n in sorted(codes.items()))
                    print(f"{name}, {kind}: {ends}", flush=True)
    print(f"{failures} failures")
    sys.exit(bool(failures))


if __name__ == "__main__":
    for module in MODULES:
        import_module(f"pdr_graph.apps.{module}")
    main()
