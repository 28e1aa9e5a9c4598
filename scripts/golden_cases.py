"""The cases of the golden harness: what the command line is asked to do, with simulated and with real recordings."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from golden_program import DATA, ROOT, SCRATCH, Case, Program, commands, killed_and_resumed, require_equal, served_trial

SCENARIOS = tuple(sorted(path.stem for path in (ROOT / "pdr_graph").rglob("scenarios/*.toml")))
FIX_PERIOD = 30.0  # [s] between the fixes of a scenario that has none of its own
FIX_SIGMA = 1.0  # [m] of these fixes, which are exact
WAYPOINT_SIGMA = 0.5  # [m] of every second waypoint of a Microsoft walk
BUILDS = {"workers-1": "--workers 1", "workers-2": "--workers 2", "together": "--workers 1 --together"}
PRIVATE = "35.0002,135.0003,15"  # a circle in the plans of arcade and mall
STEPS = ("arcade", "cart", "mall", "stairs", "ipin21", "nju-phyphox", "oxford-user1_bag", "sensor-logger")
IPIN_INITIAL = "11.111000,49.461300,-2"  # where a trial begins: near the log's first position


@dataclass(frozen=True)
class Recording:
    """A recording and the options that belong to it. Paths are relative to the folder of the harness or absolute."""

    name: str
    path: str
    plan: str = ""
    fixes: str = ""

    @property
    def inputs(self) -> str:
        """The arguments that smooth and replay share."""
        plan, fixes = self.plan and f"--map {self.plan}", self.fixes and f"--fixes {self.fixes}"
        return " ".join(filter(None, (self.path, plan, fixes)))


def simulations() -> list[Case]:
    """Every shipped scenario. The results are inputs of other cases."""
    return [Case(f"simulate/{name}", commands(f"simulate {name} --out OUT")) for name in SCENARIOS]


def all_cases(folder: Path) -> list[Case]:
    """All other cases, the longest first. folder: with the simulations and `make_inputs`."""
    simulated = [_simulated(folder, name) for name in SCENARIOS]
    real = [*_microsoft(), *_other_phones(), *_positions_only()] if DATA.is_dir() else []
    parts = (
        _lifelogs,
        _replays,
        _journals,
        _trials,
        _smoothed,
        _variants,
        _steps,
        _plans,
        _scores,
        _learning,
    )
    return [case for part in parts for case in part(simulated, real)]


def _simulated(folder: Path, name: str) -> Recording:
    """A simulated recording with its plan and its fixes, or those of `make_inputs`."""
    files = (f"simulate/{name}/plan.geojson", f"simulate/{name}/fixes.csv", f"inputs/{name}.csv")
    plan, own, made = (file if (folder / file).exists() else "" for file in files)
    return Recording(name, f"simulate/{name}", plan, own or made)


def make_inputs(folder: Path) -> None:
    """Write the fixes of recordings that have none."""
    (folder / "inputs").mkdir(exist_ok=True)
    for name in SCENARIOS:
        simulated, path = folder / "simulate" / name, folder / "inputs" / f"{name}.csv"
        if not any((simulated / file).exists() for file in ("fixes.csv", "Location.csv")):
            _write_fixes(path, _every(FIX_PERIOD, simulated / "truth.csv"))
    for path in _microsoft_logs():
        _write_fixes(folder / "inputs" / f"{path.stem}.csv", _waypoints(path)[::2])


def _write_fixes(path: Path, rows: list[str]) -> None:
    path.write_text("\n".join(["time,x,y,sigma", *rows, ""]))


def _every(period: float, truth: Path) -> list[str]:
    """The first position of each period of a walk, as fixes."""
    with truth.open(newline="") as file:
        groups = groupby(csv.DictReader(file), lambda row: float(row["time"]) // period)
        first = [next(rows) for _, rows in groups]
    return [f"{row['time']},{row['x']},{row['y']},{FIX_SIGMA}" for row in first]


def _waypoints(log: Path) -> list[str]:
    """The waypoints of a Microsoft walk as fixes."""
    rows = [line.split("\t") for line in log.read_text(encoding="utf-8").splitlines() if "\tTYPE_WAYPOINT\t" in line]
    return [f"{int(time) / 1000:.3f},{x},{y},{WAYPOINT_SIGMA}" for time, _, x, y in rows]


def _microsoft_logs() -> list[Path]:
    """The first and the last walk of each floor."""
    floors = sorted(path for path in DATA.glob("ms_indoor20/site*/*") if path.is_dir())
    walks = [sorted(floor.glob("*.txt")) for floor in floors]
    return [walk for floor in walks for walk in dict.fromkeys((floor[0], floor[-1]))]


def _microsoft() -> Iterator[Recording]:
    for log in _microsoft_logs():
        yield Recording(f"microsoft-{log.stem[:9]}", str(log), str(log.parent), f"inputs/{log.stem}.csv")


def _other_phones() -> Iterator[Recording]:
    for log in sorted(DATA.glob("ipin2023_track3/*Trial*.txt")):
        yield Recording(f"ipin2023-{log.stem.split('Training')[1]}", str(log))
    eight = DATA / "ipin21_hcu"
    fixes = next(eight.rglob("freq10_s_err5m.csv"))
    yield Recording("ipin21", f"{eight}/eight", f"{eight}/map/Plan4OG.geojson", str(fixes))
    yield Recording("nju-phyphox", f"{DATA}/nju_phyphox_outdoor")
    yield Recording("sensor-logger", f"{DATA}/apf_pdr/walk")
    for path in sorted((*DATA.glob("oxford_steps/validation/*.csv"), *DATA.glob("oxford_steps/Pixel*"))):
        yield Recording(f"oxford-{path.stem.rpartition('_')[0]}", str(path))


def _positions_only() -> Iterator[Recording]:
    yield Recording("gpx", f"{DATA}/gpx_sample/cerknicko-jezero.gpx")
    yield Recording("geolife", f"{DATA}/geolife_sample/010/20080402060926.plt")


def _smoothed(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    """Every method on the scenarios, graph and filter on real recordings."""
    for walk in simulated:
        for method in ("graph", "filter", "rts", "pdr"):
            line = f"smooth {walk.inputs} --method {method} --truth {walk.path}/truth.csv --out OUT"
            yield Case(f"smooth/{walk.name}/{method}", commands(line))
    for walk in real:
        for method in ("graph", "filter"):
            yield Case(f"real/{walk.name}/{method}", commands(f"smooth {walk.inputs} --method {method} --out OUT"))


def _variants(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    """Options of smooth, each on the scenarios for which it makes a difference."""
    for walk in simulated:
        if walk.plan:
            fixes = walk.fixes and f"--fixes {walk.fixes}"
            yield Case(f"smooth/{walk.name}/no-map", commands(f"smooth {walk.path} {fixes} --out OUT"))
        if walk.name in ("arcade", "campus", "cart", "two_floors"):
            yield Case(f"smooth/{walk.name}/rate-5", commands(f"smooth {walk.inputs} --rate 5 --out OUT"))
        if walk.name in ("campus", "outdoors"):
            for name, option in (("no-recorded-fixes", "--no-recorded-fixes"), ("latency", "--gnss-latency 1.5")):
                yield Case(f"smooth/{walk.name}/{name}", commands(f"smooth {walk.inputs} {option} --out OUT"))


def _replays(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    for walk in sorted(simulated, key=lambda walk: walk.name != "outdoors"):  # the longest first
        yield Case(f"replay/{walk.name}/lag-60", commands(f"replay {walk.inputs} --lag 60 --out OUT"))
        if walk.name in ("arcade", "campus", "two_floors"):
            yield Case(f"replay/{walk.name}/lag-none", commands(f"replay {walk.inputs} --lag none --out OUT"))
    for walk in real:
        yield Case(f"real/{walk.name}/replay", commands(f"replay {walk.inputs} --out OUT"))


def _journals(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    for walk in (*simulated, *real):
        if walk.name in ("arcade", "two_floors", "ipin2023-Trial24_repetition03"):
            yield Case(f"journal/{walk.name}", killed_and_resumed(f"replay {walk.inputs}"))


def _trials(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    for log in DATA.glob("ipin2023_track3/*Trial24*.txt"):
        yield Case("evaal/online", served_trial(log, IPIN_INITIAL, offline=False))
        yield Case("evaal/offline", served_trial(log, IPIN_INITIAL, offline=True))


def _steps(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    for walk in (*simulated, *real):
        if walk.name in STEPS:
            yield Case(f"steps/{walk.name}", commands(f"steps {walk.path} --out OUT/steps.csv"))


def _plans(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    plans = {walk.plan: walk.name for walk in (*real, *simulated) if walk.plan}
    for plan, name in plans.items():
        yield Case(f"map/{name}", commands(f"map check {plan}"))


def _scores(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    for walk in simulated:
        if walk.name in ("arcade", "two_floors"):
            evaluate = f"evaluate OUT/trajectory.csv {walk.path}/truth.csv --map {walk.plan}"
            scores = (evaluate, f"{evaluate} --json", f"{evaluate} --pairing nearest --json")
            yield Case(f"evaluate/{walk.name}", commands(f"smooth {walk.inputs} --out OUT", *scores))


def _learning(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    """A walker's profile and a radio map, and walks that are smoothed with them."""
    eight, mall = (next(walk for walk in simulated if walk.name == name) for name in ("figure_eight", "mall"))
    calibrate = f"calibrate {eight.path} --route {eight.plan} --out OUT/walker.toml"
    yield Case("calibrate", commands(calibrate, f"smooth {mall.inputs} --walker OUT/walker.toml --out OUT/smoothed"))
    first, radio_map = f"smooth {mall.inputs} --out OUT/first", f"radio-map {mall.path} OUT/first --out OUT/map.npz"
    second = f"smooth {mall.path} --map {mall.plan} --radio-map OUT/map.npz --out OUT/second"
    yield Case("radio-map", commands(first, radio_map, second))


def _lifelogs(simulated: list[Recording], real: list[Recording]) -> Iterator[Case]:
    """Walks of several persons, a chain of recordings, positions without an inertial log."""
    walks = {walk.name: walk for walk in simulated}
    adds = [f"{walks[name].inputs} --person {name}" for name in ("arcade", "mall", "outdoors", "two_floors")]
    if DATA.is_dir():
        chain = DATA / "ms_indoor20" / "site1" / "B1"
        first = min(chain.glob("*.txt"))
        adds += [
            f"{first} --map {chain} --fixes inputs/{first.stem}.csv --person chain",
            f"{chain} --map {chain} --person chain",
            f"{DATA}/gpx_sample/cerknicko-jezero.gpx {DATA}/geolife_sample/010/20080402060926.plt --person positions",
            f"{next(DATA.glob('ipin2023_track3/*Trial24*.txt'))} --begins 2023-06-14T08:00:00 --person museum",
        ]
    yield Case("lifelog", _lifelog(adds))


def _lifelog(adds: list[str]) -> Callable[[Program, Path], None]:
    """Build a lifelog with 1 and with 2 workers, which has to be equal, and with all walks together."""

    def run(program: Program, out: Path) -> None:
        stores = out / SCRATCH
        (stores / "new").mkdir(parents=True)
        commands(*(f"lifelog add {stores}/new/days.db {add}" for add in adds))(program, out)
        for name, options in BUILDS.items():
            shutil.copytree(stores / "new", stores / name)
            commands(*_lifelog_results(f"{stores}/{name}/days.db", options))(program, out / name)
        require_equal(out / "workers-1", out / "workers-2")

    return run


def _lifelog_results(store: str, options: str) -> Iterator[str]:
    yield f"lifelog build {store} --zone Europe/Berlin {options}"
    yield f"lifelog show {store} --all"
    yield f"lifelog show {store} --person mall --out OUT/shown"
    yield f"lifelog export {store} --out OUT/csv --format csv"
    yield f"lifelog export {store} --out OUT/geojson --format geojson --blur {PRIVATE}"
    yield f"lifelog export {store} --out OUT/days.gpx --cut {PRIVATE}"
