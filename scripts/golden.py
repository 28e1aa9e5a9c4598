"""Record what the command line writes for many walks, and compare another version of the program with it.

python scripts/golden.py record DIR, then python scripts/golden.py compare DIR: see CONTRIBUTING.md. It imports nothing
of the package.
"""

import argparse
import csv
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from fnmatch import fnmatchcase
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parent / "shared" / "data")).resolve()
SCENARIOS = tuple(sorted(path.stem for path in (ROOT / "pdr_graph").rglob("scenarios/*.toml")))
FIX_PERIOD, FIX_SIGMA, WAYPOINT_SIGMA = 30.0, 1.0, 0.5  # [s], [m] of fixes made from the truth; [m] of waypoints
VARYING = {"seconds", "versions", "push", "pose", "peak_memory", "memory"}  # JSON keys that differ in every run
SKIPPED = (".png", ".html", ".db", ".npz", "latency.json")  # compared by name alone
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
METRES_PER_DEGREE = 111_320.0
# Without a random key, by which a lifelog blurs and cuts places
START = "import secrets, sys; secrets.token_hex = lambda n=None: '5a' * (n or 32); sys.argv[0] = 'pdr-graph'; "
START += "import importlib; home, run = sys.argv.pop(1).split(':'); getattr(importlib.import_module(home), run)()"


def main():
    """Run, and return 1 if outputs differ or a case cannot be run."""
    parser = argparse.ArgumentParser(prog="scripts/golden.py", description=__doc__)
    parser.add_argument("verb", choices=("record", "compare"))
    parser.add_argument("folder", metavar="DIR", type=Path, help="where the recorded outputs are")
    parser.add_argument("--only", metavar="PATTERN", default="*", help="only these cases, as in 'replay/*'")
    parser.add_argument("--checkout", metavar="PATH", type=Path, default=ROOT, help="whose command line; default: this")
    parser.add_argument("--tolerance", metavar="METRES", type=float, default=0.0, help="accept smaller differences")
    options = parser.parse_args()
    folder, checkout, wrong = options.folder.resolve(), options.checkout.resolve(), 0
    if options.verb == "record":
        (folder / "inputs").mkdir(parents=True, exist_ok=True)
        for name in SCENARIOS:
            run([f"simulate {name} --out OUT"], checkout, folder, folder / "simulate" / name)
        make_inputs(folder)
    with TemporaryDirectory(prefix="golden-") as anew:
        for name, lines in cases(folder).items():
            if fnmatchcase(name, options.only):
                out = (folder if options.verb == "record" else Path(anew)) / name
                found = run(lines, checkout, folder, out)
                if options.verb == "compare":
                    found = found or list(differences(folder / name, out, options.tolerance))
                wrong += bool(found)
                print("\n    ".join([f"{name}: {'differs' if found else 'same or recorded'}", *found]), flush=True)
    return wrong > 0


def run(lines, checkout, folder, out):
    """Run command lines into a folder, with what they print; return the last line of a traceback, if there is one."""
    scripts = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    printed = ""
    for line in lines:
        arguments = [part.replace("OUT", str(out)) for part in shlex.split(line)]
        command = [sys.executable, "-c", START, scripts["pdr-graph"], *arguments]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        if "Traceback" in done.stderr:
            return [f"failed: {line}: {done.stderr.splitlines()[-1]}"]
        printed += f"{arguments[0]}: exit {done.returncode}\n{done.stdout}{done.stderr}"
    (out / "printed").write_text(printed, encoding="utf-8")
    return []


def make_inputs(folder):
    """Write the fixes of recordings that have none: places of the truth, every second waypoint of Microsoft's walks."""
    for name in SCENARIOS:
        simulated = folder / "simulate" / name
        if not any((simulated / file).exists() for file in ("fixes.csv", "Location.csv")):
            with (simulated / "truth.csv").open(newline="") as file:
                spans = groupby(csv.DictReader(file), lambda row: float(row["time"]) // FIX_PERIOD)
                first = [next(rows) for _, rows in spans]
            write_fixes(folder, name, [f"{row['time']},{row['x']},{row['y']},{FIX_SIGMA}" for row in first])
    for log in microsoft_logs():
        rows = [line.split("\t") for line in log.read_text("utf-8").splitlines() if "\tTYPE_WAYPOINT\t" in line]
        fixes = [f"{int(time) / 1000:.3f},{x},{y},{WAYPOINT_SIGMA}" for time, _, x, y in rows]
        write_fixes(folder, log.stem, fixes[::2])


def write_fixes(folder, name, rows):
    (folder / "inputs" / f"{name}.csv").write_text("\n".join(["time,x,y,sigma", *rows, ""]))


def microsoft_logs():
    """The first walk of each floor."""
    return [min(floor.glob("*.txt")) for floor in sorted(DATA.glob("ms_indoor20/site*/*")) if floor.is_dir()]


def given(folder, name):
    """The arguments of a simulated walk with its plan and its fixes, or those of `make_inputs`."""
    here = f"simulate/{name}"
    fixes = next((f for f in (f"{here}/fixes.csv", f"inputs/{name}.csv") if (folder / f).exists()), None)
    plan = f"{here}/plan.geojson"
    return here + (f" --map {plan}" if (folder / plan).exists() else "") + (f" --fixes {fixes}" if fixes else "")


def recorded():
    """Real recordings of all kinds: name and arguments."""
    for log in microsoft_logs():
        yield f"microsoft-{log.stem[:9]}", f"{log} --map {log.parent} --fixes inputs/{log.stem}.csv"
    for log in sorted(DATA.glob("ipin2023_track3/*Trial*.txt")):
        yield f"ipin2023-{log.stem.split('Training')[1]}", str(log)
    eight = DATA / "ipin21_hcu"
    fixes = next(eight.rglob("freq10_s_err5m.csv"))
    yield "ipin21", f"{eight}/eight --map {eight}/map/Plan4OG.geojson --fixes {fixes}"
    for name in ("nju_phyphox_outdoor", "apf_pdr/walk", "gpx_sample/cerknicko-jezero.gpx"):
        yield name.partition("/")[0], f"{DATA}/{name}"


def cases(folder):
    """Command lines by the name of their case. OUT: the folder of the case."""
    real, made = list(recorded()) if DATA.is_dir() else [], {}
    for name in SCENARIOS:
        walk, truth = given(folder, name), f"simulate/{name}/truth.csv"
        for method in ("graph", "filter", "rts", "pdr"):
            made[f"smooth/{name}/{method}"] = [f"smooth {walk} --method {method} --truth {truth} --out OUT"]
        made[f"replay/{name}"] = [f"replay {walk} --lag 60 --out OUT"]
        made[f"steps/{name}"] = [f"steps simulate/{name} --out OUT/steps.csv"]
    for name, walk in real:
        for method in ("graph", "filter"):
            made[f"real/{name}/{method}"] = [f"smooth {walk} --method {method} --out OUT"]
        made[f"real/{name}/replay"] = [f"replay {walk} --out OUT"]
    names = ("arcade", "mall", "outdoors", "two_floors")
    made["lifelog"] = [
        *(f"lifelog add OUT/days.db {given(folder, name)} --person {name}" for name in names),
        "lifelog build OUT/days.db --zone Europe/Berlin",
        "lifelog show OUT/days.db --all",
        "lifelog export OUT/days.db --out OUT/csv --format csv",
        "lifelog export OUT/days.db --out OUT/days.gpx --cut 35.0002,135.0003,15",
    ]
    return made


def differences(old, new, tolerance):
    """Lines that say how the files of two folders differ by more than a tolerance [m]."""
    was, now = ({str(p.relative_to(of)): p for p in of.rglob("*") if p.is_file()} for of in (old, new))
    for name in sorted(was.keys() ^ now.keys()):
        yield f"{name}: only {'recorded' if name in was else 'in the new version'}"
    for name in sorted(was.keys() & now.keys()):
        if name.endswith(SKIPPED) or ".db.d/" in name:
            continue
        one, other = (values(folder[name], root) for folder, root in ((was, old), (now, new)))
        apart = {at: difference(one.get(at, ""), other.get(at, ""), at) for at in {**one, **other}}
        if apart and max(apart.values()) > tolerance:
            worst = max(apart, key=apart.__getitem__)
            count = sum(size > tolerance for size in apart.values())
            found = f"{one.get(worst)} -> {other.get(worst)}"
            yield f"{name}: {count} values, most at {worst}, {apart[worst]:.3g}: {found}"[:300]


def values(path, folder):
    """The values of a file by their place in it: leaves of JSON, or lines."""
    text = path.read_text(encoding="utf-8", errors="replace").replace(str(folder), "OUT")
    if path.suffix in (".json", ".geojson"):
        return dict(leaves(json.loads(text), ""))
    return {f"line {n}": line for n, line in enumerate(text.splitlines(), 1)}


def leaves(value, place):
    """The place and the text of every leaf of a JSON value."""
    if isinstance(value, (dict, list)) and value:
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            if key not in VARYING:
                yield from leaves(inner, f"{place}.{key}")
    else:
        yield place, str(value)


def difference(was, now, place):
    """The largest difference of the numbers of two texts [m for degrees]; infinite if anything else differs."""
    if NUMBER.sub("0", was) != NUMBER.sub("0", now):
        return math.inf
    pairs = zip(NUMBER.findall(was), NUMBER.findall(now), strict=True)
    largest = max((abs(float(a) - float(b)) for a, b in pairs), default=0.0)
    return largest * (METRES_PER_DEGREE if "coordinates" in place or 'lat="' in was else 1.0)


if __name__ == "__main__":
    sys.exit(main())
