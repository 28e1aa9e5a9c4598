"""The month of the README, from raw files to the last table: ``python scripts/lifelog_month.py [FOLDER]``.

Thirty days of two hours at 100 Hz, as phyphox exports them (a folder of tables), then ``pdr-graph lifelog add``,
``build --workers 2`` and ``show``, each in a process of its own; then one more day. There are three distinct walks: a
day is one of them with another start (``meta/time.csv``), so its content and its times differ, its samples do not.
"""

import os
import shutil
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from tables import table

from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

FIRST = datetime(2024, 5, 1, 9, tzinfo=UTC).timestamp()  # [s] Unix time of the first recording
DAY, DAYS, WALKS = 86_400.0, 30, 3
LAP = [[40, 0], [40, 30], [0, 30], [0, 0]]
LAPS = 72  # about two hours
NOT_EXPORTED = ("truth.csv", "steps.csv", "events.csv", "fixes.csv", "gnss.csv")
PERIOD = 0.2  # [s] between looks at the memory of processes


def walks(folder):
    """The distinct walks; none is made again if it exists."""
    for seed in range(WALKS):
        made = folder / f"walk{seed}"
        if not made.exists():
            route = [[0, 0], *({"to": LAP} for _ in range(LAPS))]
            given = {"route": route, "gnss": {}, "recorder": "phyphox", "seed": seed, "start": FIRST}
            write(simulate(Scenario.of(given)), part := folder / "part")
            for name in NOT_EXPORTED:
                (part / name).unlink(missing_ok=True)
            part.rename(made)
        yield made


def days(folder, sources, first, number):
    """Recordings of consecutive days: hard links to the samples of a walk, and a start of their own."""
    for day in range(first, first + number):
        source, made = sources[day % len(sources)], folder / f"day{day:02}"
        shutil.copytree(source, made, copy_function=os.link)
        clock = made / "meta" / "time.csv"
        text = clock.read_text()
        clock.unlink()
        clock.write_text("\n".join(shifted(line, DAY * day) for line in text.splitlines()) + "\n")
    return folder


def shifted(line, seconds):
    """A row of ``meta/time.csv`` later by ``seconds``."""
    cells = line.split(",")
    return line if cells[0] == '"event"' else ",".join([*cells[:2], f"{float(cells[2]) + seconds:.3f}", *cells[3:]])


def measured(*arguments):
    """Time on the wall [s], CPU time [s], and the largest memory of one process and of all [MB] of a command."""
    command = [sys.executable, "-c", "from pdr_graph.apps.cli import main; main()", "lifelog", *map(str, arguments)]
    before, began = os.times(), time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    largest = [0.0, 0.0]
    watch = threading.Thread(target=memory, args=(process, largest))
    watch.start()
    if process.wait():
        raise SystemExit(f"exit code {process.returncode}: {' '.join(command)}")
    watch.join()
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - began, cpu, *largest


def memory(process, largest):
    """Keep the largest resident memory of one process, and of the process with all its children [MB]."""
    while process.poll() is None:
        sizes = [resident(pid) for pid in family(process.pid)]
        largest[:] = max(largest[0], *sizes), max(largest[1], sum(sizes))
        time.sleep(PERIOD)


def family(pid):
    """A process and all below it."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        children = []
    return [pid, *(below for child in children for below in family(int(child)))]


def resident(pid):
    """Resident memory of a process [MB]; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return 0.0


def month_rows(folder):
    """The table of docs/performance.md."""
    sources = list(walks(folder))
    size = sum(file.stat().st_size for walk in sources for file in walk.rglob("*.csv")) / len(sources) / 1e6
    with TemporaryDirectory(dir=folder) as place:
        log, raw, more = Path(place) / "days.db", Path(place) / "raw", Path(place) / "more"
        days(raw, sources, 0, DAYS)
        days(more, sources, DAYS, 1)
        shown = Path(place) / "shown"
        rows = [
            ["`lifelog add`, 30 recordings", *measured("add", log, raw)],
            ["`lifelog build --workers 2`", *measured("build", log, "--workers", 2)],
            ["`lifelog show`, one day", *measured("show", log, "--out", shown)],
        ]
        rows.insert(
            0,
            [
                "**the month**",
                *(sum(row[k] for row in rows) for k in (1, 2)),
                *(max(row[k] for row in rows) for k in (3, 4)),
            ],
        )
        new = [measured("add", log, more), measured("build", log), measured("show", log, "--out", shown)]
        rows += [
            [
                "a new day: the same three, one process",
                *(sum(row[k] for row in new) for k in (0, 1)),
                *(max(row[k] for row in new) for k in (2, 3)),
            ]
        ]
        rows += [["`lifelog build`, nothing being new", *measured("build", log)]]
    cells = [[name, f"{wall:.1f}", f"{cpu:.1f}", f"{one:.0f}", f"{whole:.0f}"] for name, wall, cpu, one, whole in rows]
    head = [
        f"{DAYS} days × 2 h at 100 Hz, {DAYS * size / 1e3:.1f} GB",
        "wall [s]",
        "CPU [s]",
        "largest process [MB]",
        "all processes [MB]",
    ]
    return table(head, cells)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        Path(sys.argv[1]).mkdir(parents=True, exist_ok=True)
        print(month_rows(Path(sys.argv[1])))
    else:
        with TemporaryDirectory() as temporary:
            print(month_rows(Path(temporary)))
