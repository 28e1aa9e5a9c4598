"""Keep what the command line writes for many walks, and compare another version of the program with it.

scripts/golden record DIR, then scripts/golden compare DIR: see CONTRIBUTING.md. It imports nothing of the package.
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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parent / "shared" / "data")).resolve()
SCENARIOS = tuple(sorted(path.stem for path in (ROOT / "pdr_graph").rglob("scenarios/*.toml")))
FIX_PERIOD, FIX_SIGMA = 30.0, 1.0  # [s] between the fixes of a scenario that has none of its own; [m], exact ones
WAYPOINT_SIGMA = 0.5  # [m] of every second waypoint of a Microsoft walk
PRIVATE = "35.0002,135.0003,15"  # a circle in the plans of arcade and mall
VARYING = {"seconds", "versions", "push", "pose", "peak_memory", "memory"}  # JSON keys that differ in every run
PROSE = {"reason", "warnings", "missing", "units", "ended"}  # JSON keys of texts that are no identifiers
EMPTIED = (".png", ".html", ".db", ".npz")  # only compared by name
SKIPPED = ("*.db.d/*", "*/latency.json")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
METRES_PER_DEGREE = 111_320.0
# Without a random key, by which a lifelog blurs and cuts places
START = "import secrets, sys; secrets.token_hex = lambda n=None: '5a' * (n or 32); sys.argv[0] = 'pdr-graph'; "
START += (
    "import importlib; home, function = sys.argv.pop(1).split(':'); getattr(importlib.import_module(home), function)()"
)


def main():
    """Run, and return 1 if numbers differ or a case cannot be run."""
    parser = argparse.ArgumentParser(prog="scripts/golden", description=__doc__)
    parser.add_argument("verb", choices=("record", "compare"))
    parser.add_argument("folder", metavar="DIR", type=Path, help="where the recorded outputs are")
    parser.add_argument("--only", metavar="PATTERN", default="*", help="only these cases, as in 'replay/*'")
    parser.add_argument("--checkout", metavar="PATH", type=Path, default=ROOT, help="whose command line; default: this")
    parser.add_argument("--jobs", metavar="N", type=int, default=2, help="cases that run at the same time; default: 2")
    parser.add_argument("--tolerance", metavar="METRES", type=float, default=0.0, help="accept smaller differences")
    parser.add_argument("--renamed", metavar="OLD=NEW", action="append", default=[], help="a key or name that changed")
    parser.add_argument("--ignored", metavar="KEY", action="append", default=[], help="a JSON key to leave out")
    options = parser.parse_args()
    folder, checkout = options.folder.resolve(), options.checkout.resolve()
    if not DATA.is_dir():
        print(f"no real recordings at {DATA} (set PDR_GRAPH_DATA): their cases are left out")
    simulations = {f"simulate/{name}": [f"simulate {name} --out OUT"] for name in SCENARIOS}
    if options.verb == "record":
        (folder / "inputs").mkdir(parents=True, exist_ok=True)
        missing = {name: lines for name, lines in simulations.items() if not (folder / name).exists()}
        run_all(missing | chosen(simulations, options.only), checkout, folder, folder, options.jobs)
        make_inputs(folder)
        problems = run_all(chosen(cases(folder), options.only), checkout, folder, folder, options.jobs)
        print(f"{len(problems)} cases recorded, {sum(map(bool, problems.values()))} failed")
        return any(problems.values())
    some = chosen(simulations | cases(folder), options.only)
    with TemporaryDirectory(prefix="golden-") as anew:
        problems = run_all(some, checkout, folder, Path(anew), options.jobs)
        verdicts = []
        for name, problem in problems.items():
            found = [problem] if problem else list(differences(folder / name, Path(anew) / name, options))
            numbers = [line for line in found if not line.startswith("texts")]
            verdicts.append("numbers differ" if numbers else "texts differ" if found else "same")
            print("\n    ".join([f"{name}: {verdicts[-1]}", *found]), flush=True)
    print(f"{len(some)} cases: " + ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts)))
    return "numbers differ" in verdicts


def chosen(some, pattern):
    return {name: lines for name, lines in some.items() if fnmatchcase(name, pattern)}


# Running


def run_all(some, checkout, folder, parent, jobs):
    """Run cases, each into its folder below a parent; return what is wrong by name, "" if nothing is."""
    scripts = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

    def run(name):
        out = parent / name
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        with TemporaryDirectory() as aside:  # commands refuse a folder with files that they did not write
            for number, line in enumerate(some[name], start=1):
                arguments = [part.replace("OUT", str(out)) for part in shlex.split(line)]
                command = [sys.executable, "-c", START, scripts["pdr-graph"], *arguments]
                done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
                if "Traceback" in done.stderr:
                    return f"failed: {line}: {done.stderr.splitlines()[-1]}"
                printed = f"exit {done.returncode}\n{done.stdout}{done.stderr}"
                file = Path(aside) / f"{number}-{arguments[0]}.printed"
                file.write_text(printed, encoding="utf-8")
                if "--json" in arguments and done.returncode == 0:
                    file.with_suffix(".json").write_text(done.stdout, encoding="utf-8")
            shutil.copytree(aside, out, dirs_exist_ok=True)
        places = {str(out): "OUT", str(folder): "FOLDER", str(DATA): "DATA", str(checkout): "CHECKOUT"}
        for path in filter(Path.is_file, out.rglob("*")):
            content = b"" if path.suffix in EMPTIED else path.read_bytes()
            for place, word in places.items():
                content = content.replace(place.encode(), word.encode())
            path.write_bytes(content)
        return ""

    with ThreadPoolExecutor(jobs) as pool:
        return dict(zip(some, pool.map(run, some), strict=True))


# Cases


@dataclass(frozen=True)
class Walk:
    """A recording and the options that belong to it. Paths are relative to the harness's folder or absolute."""

    name: str
    path: str
    plan: str = ""
    fixes: str = ""

    @property
    def inputs(self):
        """The arguments that smooth and replay share."""
        return " ".join(
            filter(None, (self.path, self.plan and f"--map {self.plan}", self.fixes and f"--fixes {self.fixes}"))
        )


def make_inputs(folder):
    """Write the fixes of recordings that have none."""
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
    """The first and the last walk of each floor."""
    floors = [sorted(floor.glob("*.txt")) for floor in sorted(DATA.glob("ms_indoor20/site*/*")) if floor.is_dir()]
    return [walk for floor in floors for walk in dict.fromkeys((floor[0], floor[-1]))]


def simulated_walk(folder, name):
    """A simulated recording with its plan and its fixes, or those of `make_inputs`."""
    files = (f"simulate/{name}/plan.geojson", f"simulate/{name}/fixes.csv", f"inputs/{name}.csv")
    plan, own, made = (file if (folder / file).exists() else "" for file in files)
    return Walk(name, f"simulate/{name}", plan, own or made)


def recorded_walks():
    """Real recordings of all kinds."""
    yield from (
        Walk(f"microsoft-{log.stem[:9]}", str(log), str(log.parent), f"inputs/{log.stem}.csv")
        for log in microsoft_logs()
    )
    for log in sorted(DATA.glob("ipin2023_track3/*Trial*.txt")):
        yield Walk(f"ipin2023-{log.stem.split('Training')[1]}", str(log))
    eight = DATA / "ipin21_hcu"
    yield Walk("ipin21", f"{eight}/eight", f"{eight}/map/Plan4OG.geojson", str(next(eight.rglob("freq10_s_err5m.csv"))))
    yield Walk("nju-phyphox", f"{DATA}/nju_phyphox_outdoor")
    yield Walk("sensor-logger", f"{DATA}/apf_pdr/walk")
    for path in sorted((*DATA.glob("oxford_steps/validation/*.csv"), *DATA.glob("oxford_steps/Pixel*"))):
        yield Walk(f"oxford-{path.stem.rpartition('_')[0]}", str(path))
    yield Walk("gpx", f"{DATA}/gpx_sample/cerknicko-jezero.gpx")
    yield Walk("geolife", f"{DATA}/geolife_sample/010/20080402060926.plt")


def cases(folder):
    """Command lines by the name of their case. folder: with the simulations and `make_inputs`. OUT: of the case."""
    simulated = {name: simulated_walk(folder, name) for name in SCENARIOS}
    real = list(recorded_walks()) if DATA.is_dir() else []
    made = {"lifelog": list(lifelog(simulated))}
    for name, walk in simulated.items():
        for method in ("graph", "filter", "rts", "pdr"):
            line = f"smooth {walk.inputs} --method {method} --truth {walk.path}/truth.csv --out OUT"
            made[f"smooth/{name}/{method}"] = [line]
        if walk.plan:
            made[f"smooth/{name}/no-map"] = [f"smooth {Walk(name, walk.path, '', walk.fixes).inputs} --out OUT"]
            made[f"map/{name}"] = [f"map check {walk.plan}"]
        made[f"replay/{name}/lag-60"] = [f"replay {walk.inputs} --lag 60 --out OUT"]
        made[f"steps/{name}"] = [f"steps {walk.path} --out OUT/steps.csv"]
    for name in ("arcade", "campus", "two_floors"):
        made[f"smooth/{name}/rate-5"] = [f"smooth {simulated[name].inputs} --rate 5 --out OUT"]
        made[f"replay/{name}/lag-none"] = [f"replay {simulated[name].inputs} --lag none --out OUT"]
    for name, option in (("no-recorded-fixes", "--no-recorded-fixes"), ("latency", "--gnss-latency 1.5")):
        made[f"smooth/outdoors/{name}"] = [f"smooth {simulated['outdoors'].inputs} {option} --out OUT"]
    for walk in (simulated["arcade"], simulated["two_floors"]):
        evaluate = f"evaluate OUT/trajectory.csv {walk.path}/truth.csv --map {walk.plan}"
        scores = [evaluate, f"{evaluate} --json", f"{evaluate} --pairing nearest --json"]
        made[f"evaluate/{walk.name}"] = [f"smooth {walk.inputs} --out OUT", *scores]
    eight, mall = simulated["figure_eight"], simulated["mall"]
    calibrate = f"calibrate {eight.path} --route {eight.plan} --out OUT/walker.toml"
    made["calibrate"] = [calibrate, f"smooth {mall.inputs} --walker OUT/walker.toml --out OUT/smoothed"]
    first, radio_map = f"smooth {mall.inputs} --out OUT/first", f"radio-map {mall.path} OUT/first --out OUT/map.npz"
    made["radio-map"] = [
        first,
        radio_map,
        f"smooth {mall.path} --map {mall.plan} --radio-map OUT/map.npz --out OUT/2nd",
    ]
    for walk in real:
        for method in ("graph", "filter"):
            made[f"real/{walk.name}/{method}"] = [f"smooth {walk.inputs} --method {method} --out OUT"]
        made[f"real/{walk.name}/replay"] = [f"replay {walk.inputs} --out OUT"]
    return made


def lifelog(simulated):
    """Walks of several persons, a chain of recordings, positions without an inertial log."""
    store = "OUT/days.db"
    for name in ("arcade", "mall", "outdoors", "two_floors"):
        yield f"lifelog add {store} {simulated[name].inputs} --person {name}"
    if DATA.is_dir():
        chain = DATA / "ms_indoor20" / "site1" / "B1"
        first = min(chain.glob("*.txt"))
        yield f"lifelog add {store} {first} --map {chain} --fixes inputs/{first.stem}.csv --person chain"
        yield f"lifelog add {store} {chain} --map {chain} --person chain"
        tracks = f"{DATA}/gpx_sample/cerknicko-jezero.gpx {DATA}/geolife_sample/010/20080402060926.plt"
        yield f"lifelog add {store} {tracks} --person positions"
    yield f"lifelog build {store} --zone Europe/Berlin --workers 2"
    yield f"lifelog show {store} --all"
    yield f"lifelog show {store} --person mall --out OUT/shown"
    yield f"lifelog export {store} --out OUT/csv --format csv"
    yield f"lifelog export {store} --out OUT/geojson --format geojson --blur {PRIVATE}"
    yield f"lifelog export {store} --out OUT/days.gpx --cut {PRIVATE}"


# Comparing


def differences(old, new, options):
    """Lines that say how the files of two folders differ; those about texts alone begin with "texts"."""
    renamed = dict(pair.split("=")[::-1] for pair in options.renamed)
    was, now = files(old, {}), files(new, renamed)
    for name in sorted(was.keys() | now.keys()):
        if name not in was or name not in now:
            yield f"{name}: only {'recorded' if name in was else 'in the new version'}"
            continue
        ignored = VARYING | set(options.ignored)
        one, other = values(was[name], {}, ignored), values(now[name], renamed, ignored)
        changed = [place for place in {**one, **other} if repr(one.get(place)) != repr(other.get(place))]
        texts = [place for place in changed if place.startswith("text ")]
        numbers = {
            place: difference(one.get(place), other.get(place), place) for place in changed if place not in texts
        }
        if texts:
            yield f"texts of {name}: {texts[0]}: {one.get(texts[0])} -> {other.get(texts[0])}"[:300]
        if numbers and max(numbers.values()) > options.tolerance:
            worst = max(numbers, key=numbers.__getitem__)
            found = f"{one.get(worst)} -> {other.get(worst)}"
            yield f"{name}: {len(numbers)} numbers, most at {worst}, {numbers[worst]:.3g}: {found}"[:300]


def files(folder, renamed):
    """The files of a folder by name, that of the recorded version."""
    paths = [path for path in folder.rglob("*") if path.is_file() and not any(map(path.match, SKIPPED))]
    return {translated(str(path.relative_to(folder)), renamed): path for path in paths}


def translated(text, renamed):
    """A text with the names of the recorded version."""
    for new, old in renamed.items():
        text = re.sub(rf"(?<![\w-]){re.escape(new)}(?![\w-])", old, text)
    return text


def values(path, renamed, ignored):
    """The values of a file by their place in it; places of prose begin with "text "."""
    text = translated(path.read_text(encoding="utf-8", errors="replace"), renamed)
    if path.suffix in (".json", ".geojson"):
        return dict(leaves(json.loads(text), "", "", ignored))
    prose = "text " if path.suffix == ".printed" else ""
    return {f"{prose * (n > 1)}line {n}": line for n, line in enumerate(text.splitlines(), 1)}


def leaves(value, place, key, ignored):
    """The place and the value of every leaf of a JSON value; an empty list or object is one."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            if name not in ignored:
                yield from leaves(inner, f"{place}.{name}", name, ignored)
    elif isinstance(value, list) and value:
        for n, inner in enumerate(value):
            yield from leaves(inner, f"{place}[{n}]", key, ignored)
    else:
        prose = isinstance(value, str) and (" " in value or key in PROSE)
        yield f"{'text ' * prose}{place}", value


def difference(old, new, place):
    """The largest difference of the numbers of two values [m for degrees]; infinite if anything else differs."""
    was, now = str(old), str(new)
    if NUMBER.sub("0", was) != NUMBER.sub("0", now):
        return math.inf
    largest = max(abs(float(a) - float(b)) for a, b in zip(NUMBER.findall(was), NUMBER.findall(now), strict=True))
    return largest * (METRES_PER_DEGREE if "coordinates" in place or 'lat="' in was else 1.0)


if __name__ == "__main__":
    sys.exit(main())
