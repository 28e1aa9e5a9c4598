"""Give hostile files to every command that reads files: each must end soon, in bounded memory, with one line.

python scripts/hostile_files.py [WORD …]

An attack runs if its name or group (archives, recordings, tables, plans, timelines) has one of the words; without words
all of them run, for half an hour on one core. Each is
a file made in a temporary folder and a command of its own process, whose time and memory are limited and measured. The
table has the size of the input, exit code, seconds, largest memory and the last line that the command prints. An
attack fails if the process is killed, prints a traceback, more than one line of refusal, needs more than MEMORY or
TIME, exits otherwise than expected, or does not say what it should.
"""

import json
import os
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from hostile_archives import ARCHIVES
from hostile_plans import PLANS
from hostile_recordings import RECORDINGS
from hostile_tables import TABLES
from hostile_timelines import TIMELINES

from pdr_graph.apps import cli

GUARD = 12_000_000_000  # [bytes] of address space of a child process: beyond, it fails
MEMORY = 600, 27  # [MB] for any input, and more per MB of it (unpacked up to the stated limit of a recording)
TIME = 60, 2.5  # [s] for any input, and more per MB of it, on one busy core
REFUSED, DEGRADED = 2, 3  # exit codes
# What commands import
MODULES = [
    "apps.lifelog.build",
    "apps.lifelog.past.importing",
    "apps.report.plotting",
    "apps.report.content",
    "lab.simulation",
]


@dataclass(frozen=True)
class Outcome:
    """Result of one attack. size: of the input [bytes]; memory: [bytes]; text: what it printed and its warnings."""

    size: int
    code: int | None
    seconds: float
    memory: int
    text: str

    @property
    def line(self):
        lines = [line for line in self.text.splitlines() if line.strip()]
        refusals = [line for line in lines if ": found " in line]
        return (refusals or lines or [""])[0]


def attacked(attack, folder):
    """The outcome of an attack, made and run in a new folder, and the memory that it may need [MB]."""
    inputs, outputs = folder / "in", folder / "out"
    inputs.mkdir(), outputs.mkdir()
    made = folder / "made.json"
    _, status, _ = os.wait4(forked(lambda: made.write_text(json.dumps(attack.make(inputs), default=str))), 0)
    if status:
        raise RuntimeError(f"{attack.name}: the files could not be made")
    arguments, most = json.loads(made.read_text())
    size = sum(file.stat().st_blocks * 512 for file in inputs.rglob("*") if file.is_file() and not file.is_symlink())
    arguments = [str(outputs / a[4:]) if a.startswith("OUT/") else a for a in arguments]
    weight = max(size, most) / 1e6
    code, seconds, memory, text = measured(arguments, outputs, TIME[0] + TIME[1] * weight)
    for summary in outputs.rglob("summary.json"):
        text += "\n".join(["", *json.loads(summary.read_text()).get("warnings", [])])
    if list(folder.rglob("pwned")):
        text += "\nThe file was obeyed"
    return Outcome(size, code, seconds, memory, text), MEMORY[0] + MEMORY[1] * weight


def forked(work):
    """The id of a child process that does some work and exits with 0, or 1 after an error."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            work()
            code = 0
        except SystemExit as end:
            code = end.code or 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush(), sys.stderr.flush()
            os._exit(code)
    return pid


def measured(arguments, folder, limit):
    """Exit code (None if it took longer than ``limit`` seconds), seconds, largest memory [bytes], printed text."""

    def command():
        for stream in (1, 2):
            os.dup2(printed.fileno(), stream)
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_AS, (GUARD, GUARD))
        sys.argv = ["pdr-graph", *arguments]
        cli.main()

    begun = time.monotonic()
    with tempfile.TemporaryFile() as printed:
        child, is_late, pid = forked(command), False, 0
        while not pid:
            time.sleep(0.02)
            pid, status, usage = os.wait4(child, os.WNOHANG)
            if not pid and not is_late and time.monotonic() - begun > limit:
                os.kill(child, signal.SIGKILL)
                is_late = True
        printed.seek(0)
        text = printed.read(1_000_000).decode("utf-8", "replace")
    code = None if is_late else os.waitstatus_to_exitcode(status)
    return code, time.monotonic() - begun, usage.ru_maxrss * 1024, text


def failure(attack, outcome, allowed):
    """Why an attack succeeded against the program; empty if it did not. allowed: memory [MB]."""
    if outcome.code is None:
        return "too slow"
    if outcome.code < 0:
        return f"killed by signal {-outcome.code}"
    if "Traceback (most recent" in outcome.text or "Warning: " in outcome.text:
        return "traceback, or a warning of Python"
    if "The file was obeyed" in outcome.text:
        return "code was run"
    if outcome.code not in attack.codes:
        return f"exit code {outcome.code}, expected {' or '.join(map(str, attack.codes))}"
    lines = outcome.text.strip().splitlines()
    if outcome.code == REFUSED and (len(lines) > 3 or sum(line.startswith("pdr-graph: ") for line in lines) != 1):
        return "no refusal of one line"
    if outcome.memory / 1e6 > allowed:
        return f"more than {allowed:.0f} MB"
    if attack.says and not re.search(attack.says, outcome.text):
        return f"does not say {attack.says!r}"
    return ""


def main():
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    groups = {"archives": ARCHIVES, "recordings": RECORDINGS, "tables": TABLES, "plans": PLANS, "timelines": TIMELINES}
    wanted = [(name, a) for name, group in groups.items() for a in group]
    attacks = [a for name, a in wanted if not words or any(word == name or word in a.name for word in words)]
    os.environ["COLUMNS"] = "400"
    for module in MODULES:
        import_module(f"pdr_graph.{module}")
    failures = []
    begun = time.monotonic()
    print("| attack | input [MB] | exit | time [s] | memory [MB] | what it says |\n|---|--:|--:|--:|--:|---|")
    for attack in attacks:
        with tempfile.TemporaryDirectory(prefix="hostile-") as top:
            outcome, allowed = attacked(attack, Path(top))
            why = failure(attack, outcome, allowed)
            line = outcome.line.replace(top, "").replace("/in/", "").replace("/out/", "").replace("|", "\\|")
        cells = (attack.name, f"{outcome.size / 1e6:.1f}", outcome.code, f"{outcome.seconds:.1f}")
        mark = f"**{why}** " if why else ""
        print(f"| {' | '.join(map(str, cells))} | {outcome.memory / 1e6:.0f} | {mark}{line[:220]} |", flush=True)
        if why:
            failures.append(attack.name)
            print(f"  {outcome.text[-1500:]}", file=sys.stderr)
    minutes = (time.monotonic() - begun) / 60
    print(f"\n{len(attacks)} attacks in {minutes:.1f} min, {len(failures)} failures: {', '.join(failures)}")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
