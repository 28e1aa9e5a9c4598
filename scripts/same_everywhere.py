"""The same everywhere: every command in several environments, whose output files must be equal to the byte.

    scripts/same_everywhere.py [ENVIRONMENT ...]

Prints a row per environment: the commands that ran, the files compared, and those that differ from the first
environment. Exit code 1 if any does. Left out, by name: run times and memory (in `summary.json` and the JSON of
`evaluate` the keys of `VARYING`, in `report.html` the rows in seconds), and the SQLite file of a lifelog (its pages
depend on the order of its transactions; what it says is compared by `show` and `export`). A locale that the machine
lacks is said and left out.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VARYING = {"seconds", "push", "pose", "peak_memory", "memory"}  # keys of run times
STAGE = re.compile(rb'"[\w ]+ \[s\]", ?"[\d.]+"')  # of a report
FIX_PERIOD = 30  # [s] between the fixes of the mall, which has none of its own
SECRET = "5a" * 32  # of the lifelog, or each would hide other areas
TIME_LIMIT = 600  # [s] of a command
PRIVATE = "35.0002,135.0003,15"  # a circle in the plan of the arcade
DAYS = "{out}/days.db"
ARCADE = "{out}/arcade --map {out}/arcade/plan.geojson --fixes {out}/arcade/fixes.csv"
MALL = "{out}/mall --map {out}/mall/plan.geojson"
EXPORT = f"lifelog export {DAYS} --out {{out}}/exported"
COMMANDS = (
    "simulate arcade --out {out}/arcade",
    "simulate mall --out {out}/mall",
    "simulate figure_eight --out {out}/figure_eight",
    "steps {out}/arcade --out {out}/steps.csv",
    f"smooth {ARCADE} --out {{out}}/smoothed",
    f"replay {ARCADE} --out {{out}}/replayed",
    "evaluate {out}/smoothed/trajectory.csv {out}/arcade/truth.csv --map {out}/arcade/plan.geojson --json",
    f"smooth {MALL} --fixes {{out}}/mall_fixes.csv --out {{out}}/mall_smoothed",
    "radio-map {out}/mall {out}/mall_smoothed --out {out}/radio.npz",
    "calibrate {out}/figure_eight --route {out}/figure_eight/plan.geojson --out {out}/walker.toml",
    "map convert {maps}/arcade.geojson --out {out}/converted.geojson",
    "map convert {maps}/loop.png --scale 0.05 --out {out}/drawn.geojson",
    f"lifelog add {DAYS} {ARCADE}",
    f"lifelog add {DAYS} {MALL} --fixes {{out}}/mall_fixes.csv --person ben",
    f"lifelog build {DAYS} {{workers}}",
    f"lifelog show {DAYS} --person me --out {{out}}/shown",
    f"lifelog show {DAYS} --json",
    f"{EXPORT} --format gpx",
    f"{EXPORT} --format geojson",
    f"{EXPORT} --format csv --cut {PRIVATE}",
    f"{EXPORT} --format parquet",
)


@dataclass(frozen=True)
class Environment:
    """What differs from an ordinary one. folder: that commands run in, the outputs' by default."""

    name: str
    variables: dict[str, str] = field(default_factory=dict)
    umask: int = 0o022
    workers: int = 1
    folder: str = ""


BASE = {"PYTHONHASHSEED": "0", "LC_ALL": "C.UTF-8", "TZ": "UTC", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
ENVIRONMENTS = (
    Environment("plain"),
    Environment("PYTHONHASHSEED=4711", {"PYTHONHASHSEED": "4711"}),
    Environment("LC_ALL=de_DE.UTF-8", {"LC_ALL": "de_DE.UTF-8"}),
    Environment("LC_ALL=C", {"LC_ALL": "C"}),
    Environment("LC_ALL=xx_YY.UTF-8 (none such)", {"LC_ALL": "xx_YY.UTF-8"}),
    Environment("TZ=America/St_Johns, umask 077", {"TZ": "America/St_Johns"}, 0o077),
    Environment("TZ=Asia/Tokyo, from the folder /", {"TZ": "Asia/Tokyo"}, folder="/"),
    Environment("2 threads, 2 workers", {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}, workers=2),
)


def outputs(environment: Environment, out: Path) -> dict[str, str]:
    """The hash of what each command printed as JSON and of each file written, by name."""
    found = {}
    for number, command in enumerate(COMMANDS):
        printed = _run(environment, out, command)
        if "--json" in command:
            found[f"printed by {command.split()[0]}, {number}"] = _hash(_without_times(printed.encode(), out))
        if command.startswith("simulate mall"):
            _write_fixes(out)
        if command.startswith("lifelog build"):
            with contextlib.closing(sqlite3.connect(out / "days.db")) as database, database:
                database.execute("INSERT INTO setting VALUES ('secret', ?)", (SECRET,))
    return found | dict(_files(out))


def _run(environment: Environment, out: Path, command: str) -> str:
    """The standard output of a command. In a folder of its own all paths are absolute, else relative to `out`."""
    names = {"out": out if environment.folder else ".", "maps": ROOT / "maps"}
    workers = f"--workers {environment.workers}" if environment.workers > 1 else ""
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from pdr_graph.apps.cli import main; main()",
            *command.format(**names, workers=workers).split(),
        ],
        cwd=environment.folder or out,
        env={**os.environ, **BASE, **environment.variables, "PYTHONPATH": str(ROOT)},
        umask=environment.umask,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="surrogateescape",
        timeout=TIME_LIMIT,
    )
    if done.returncode not in (0, 3):  # 3: a result with warnings
        raise SystemExit(f"{environment.name}: {command}\nexit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def _write_fixes(out: Path) -> None:
    """Fixes for the walk through the mall: its true position every FIX_PERIOD."""
    with (out / "mall" / "truth.csv").open(newline="") as file:
        rows = [(float(row["time"]), row["x"], row["y"]) for row in csv.DictReader(file)]
    chosen = {round(time / FIX_PERIOD): f"{time},{x},{y},1.0" for time, x, y in reversed(rows)}
    (out / "mall_fixes.csv").write_text("\n".join(["time,x,y,sigma", *(chosen[n] for n in sorted(chosen)), ""]))


def _files(out: Path) -> Iterator[tuple[str, str]]:
    """Name and hash of all files but the lifelog's own."""
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_file() and not name.startswith("days.db"):
            content = path.read_bytes()
            without = WITHOUT_TIMES.get(path.suffix, _relative)
            yield name, _hash(without(content, out))


def _without_times(content: bytes, out: Path) -> bytes:
    """A JSON document without the keys of VARYING."""
    return json.dumps(_pruned(json.loads(_relative(content, out)))).encode()


def _without_stages(content: bytes, out: Path) -> bytes:
    """A report without the run times of its stages."""
    return STAGE.sub(b"", _relative(content, out))


WITHOUT_TIMES = {".json": _without_times, ".html": _without_stages}


def _pruned(value: object) -> object:
    if isinstance(value, dict):
        return {key: _pruned(own) for key, own in value.items() if key not in VARYING}
    return [_pruned(own) for own in value] if isinstance(value, list) else value


def _relative(content: bytes, out: Path) -> bytes:
    """The content with the paths of a run from another folder as those of a run inside `out`."""
    return content.replace(f"{out}/".encode(), b"")


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _lacks_locale(environment: Environment) -> bool:
    """True if the environment has a locale of a language that this machine has not."""
    wanted = environment.variables.get("LC_ALL", "")
    have = subprocess.run(["locale", "-a"], capture_output=True, text=True, check=False).stdout.lower().split()
    return wanted.startswith("de_") and wanted.lower().replace("utf-8", "utf8") not in have


def main(chosen: list[str]) -> int:
    """Run the environments whose names contain one of some words, and the first; 1 if a file differs."""
    first, differing = None, 0
    print("environment | commands | files | differing\n---|---|---|---")
    for n, environment in enumerate(ENVIRONMENTS):
        if n and chosen and not any(word in environment.name for word in chosen):
            continue
        if _lacks_locale(environment):
            print(f"{environment.name} | not run: no such locale here (localedef -i de_DE -f UTF-8 de_DE.UTF-8)")
            continue
        folder = Path(tempfile.mkdtemp())
        found = outputs(environment, folder)
        first = first or found
        other = sorted(name for name in first | found if first.get(name) != found.get(name))
        differing += len(other)
        print(f"{environment.name} | {len(COMMANDS)} | {len(found)} | {', '.join(other) or '0'}", flush=True)
        if "KEEP" in os.environ:
            print(f"kept: {folder}")
        else:
            shutil.rmtree(folder)
    return min(differing, 1)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
