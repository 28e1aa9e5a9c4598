"""What wild fixes cost: shares of the fixes of real and simulated walks replaced by ones 50 to 500 m off."""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import gps_outage
import numpy as np
from recorded import fixes_as_track
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, io, kalman_filter, kalman_smoother, magnetic_headings, smooth
from pdr_graph.evaluation import circular_error, pair
from pdr_graph.frames import enu
from pdr_graph.gait.gait import gait_of
from pdr_graph.geometry import interpolate, unit
from pdr_graph.io.tables import read_fixes
from pdr_graph.simulation.recorders import write
from pdr_graph.simulation.scenario import Scenario
from pdr_graph.simulation.simulate import simulate
from pdr_graph.types import Fixes, Headings, Steps, Trajectory

SHARES = (0.1, 0.2, 0.3, 0.4)
NEAR, FAR = 50.0, 500.0  # [m] that a wild fix is off
SEEDS, OF_MANY, MANY = 4, 2, 200  # draws of wild fixes for each walk, and for one with more fixes than so many
SEEN = 0.1  # weight below which a fix was taken for wild
WAYPOINT_SIGMA = 0.5  # [m]
EVERY = 1.0  # [s] at which a simulated walk is scored
METHODS = {"graph": smooth, "RTS": kalman_smoother, "EKF": kalman_filter}
OUTDOORS = Path(__file__).resolve().parent.parent / "scenarios" / "outdoors.toml"


@dataclass(frozen=True)
class Walk:
    """What was recorded of a walk, and what it is scored against, in one frame."""

    steps: Steps
    headings: Headings
    fixes: Fixes
    truth: Trajectory


@dataclass(frozen=True)
class Score:
    """errors [m]; of the fixes that were wild and of the others, whether each was taken for wild."""

    errors: np.ndarray
    found: np.ndarray
    blamed: np.ndarray


def scattered(fixes, share, random):
    """Fixes of which some are each somewhere else, and which these are."""
    wild = random.permutation(len(fixes)) < round(share * len(fixes))
    off = random.uniform(NEAR, FAR, (len(fixes), 1)) * unit(random.uniform(0, 2 * np.pi, len(fixes)))
    return replace(fixes, position=fixes.position + wild[:, None] * off), wild


def in_one_place(fixes, share, random):
    """Fixes of which some in a row are all in one place, within their sigmas, and which these are."""
    count = round(share * len(fixes))
    since = np.arange(len(fixes)) - random.integers(0, len(fixes) - count + 1)
    wild = (since >= 0) & (since < count)
    place = fixes.position[wild].mean(axis=0) if count else np.zeros(2)
    place = place + random.uniform(NEAR, FAR) * unit(random.uniform(0, 2 * np.pi))
    there = place + random.normal(0, 1, (len(fixes), 2)) * fixes.sigma[:, None]
    return replace(fixes, position=np.where(wild[:, None], there, fixes.position)), wild


KINDS = {"scattered": scattered, "in a row, in one place": in_one_place}


def outliers(data):
    """The table: by walk, kind and share of wild fixes."""
    rows = []
    for name, walks in walks_of(data).items():
        seeds = OF_MANY if len(walks[0].fixes) > MANY else SEEDS
        clean = {method: run(walks, scattered, 0.0, estimate, seeds=1) for method, estimate in METHODS.items()}
        rows.append([name, "none", "0 %", *(cells(clean[method], None) for method in METHODS)])
        rows[-1] += ["—", "—", "—", seen(clean["graph"], "blamed")]
        for kind, spoil in KINDS.items():
            for share in SHARES:
                spoilt = {method: run(walks, spoil, share, estimate, seeds) for method, estimate in METHODS.items()}
                without = run(walks, spoil, share, smooth, seeds, kept=lambda wild: ~wild)
                row = [name, kind, f"{100 * share:.0f} %", *(cells(spoilt[m], clean[m]) for m in METHODS)]
                row += [cells(without, clean["graph"]), doubled(spoilt["graph"], clean["graph"])]
                rows.append([*row, seen(spoilt["graph"], "found"), seen(spoilt["graph"], "blamed")])
    header = ["walk", "wild fixes", "share", *(f"{m}: 50 / 95 % [m]" for m in METHODS), "graph, wild ones left out"]
    header += ["graph: walks more than doubled", "wild ones seen", "good ones blamed"]
    publish("accuracy.md", "outliers", table(header, rows))


def run(walks, spoil, share, estimate, seeds, kept=lambda wild: wild | True):
    """Scores of every walk, each with several draws of wild fixes; kept: the fixes that are given."""
    found = []
    for n, walk in enumerate(walks):
        drawn = [spoil(walk.fixes, share, np.random.default_rng([n, seed])) for seed in range(seeds)]
        found.append([score(walk, fixes[kept(wild)], wild[kept(wild)], estimate) for fixes, wild in drawn])
    return found


def score(walk, fixes, wild, estimate):
    """One walk by one method."""
    found = estimate(WalkGraph(walk.steps, fixes, headings=walk.headings))
    doubted = np.array([fix.weight < SEEN for fix in found.fixes])
    return Score(circular_error(pair(found.trajectory, walk.truth)), doubted[wild], doubted[~wild])


def together(scores, column):
    return np.concatenate([getattr(one, column) for walk in scores for one in walk])


def cells(scores, clean):
    """Median and 95 %, and how many times those without wild fixes these are."""
    at = np.percentile(together(scores, "errors"), [50, 95])
    said = f"{at[0]:.2f} / {at[1]:.2f}"
    if clean is None:
        return said
    times = at / np.percentile(together(clean, "errors"), [50, 95])
    return f"{said} (× {times[0]:.2f} / {times[1]:.2f})"


def doubled(scores, clean):
    """Of how many walks the mean error is more than twice that without wild fixes."""
    many = [
        one.errors.mean() > 2 * usual[0].errors.mean()
        for walk, usual in zip(scores, clean, strict=True)
        for one in walk
    ]
    return f"{sum(many)} of {len(many)}"


def seen(scores, column):
    values = together(scores, column)
    return f"{100 * values.mean():.1f} %" if len(values) else "—"


def walks_of(data):
    """All walks by the name of their kind."""
    ipin = {"every 10 s, 5 m": "freq10_s_err5m", "every 5 s, 3 m": "Freq5_err3m", "every 1 s, 1 m": "Freq1_s_err1m"}
    return {
        "NJU campus, GPS at 1 Hz": [campus(data)],
        **{f"IPIN21's eight, {said}": [eight(data, file)] for said, file in ipin.items()},
        "Microsoft, every second waypoint": list(malls(data)),
        "simulated, outdoors.toml": [outdoors(seed) for seed in range(2)],
        "simulated, [gps-dr]'s walk": [Walk(*gps_outage.walked(0))],
    }


def campus(data):
    """The walk at NJU; the truth is its GPS as it was."""
    walk = io.load(data / "nju_phyphox_outdoor")
    lon, lat = walk.fixes.position[0]
    frame = enu(lat, lon)
    gaits, fixes = gait_of(walk), frame.place(walk.fixes)
    return Walk(detect_steps(gaits), magnetic_headings(gaits, frame, fixes.position[0]), fixes, fixes_as_track(fixes))


def eight(data, file):
    """IPIN21's figure of eight with one of its sets of fixes."""
    folder = data / "ipin21_hcu"
    walk, frame = io.load(folder / "eight"), FloorPlan.load(folder / "map" / "Plan4OG.geojson").frame
    fixes = read_fixes(folder / "eight" / "simulated_fixes" / f"{file}.csv", walk, frame)
    gaits = gait_of(walk)
    headings = magnetic_headings(gaits, frame, fixes.position[0])
    return Walk(detect_steps(gaits), headings, fixes, frame.place(walk.truth))


def malls(data):
    """Microsoft's walks with every second waypoint, and the last; scored at the others."""
    for path in sorted((data / "ms_indoor20").glob("site*/*/*.txt")):
        walk, frame = io.load(path), FloorPlan.load(path.parent).frame
        truth, gaits = walk.truth, gait_of(walk)
        given = np.arange(len(truth)) % 2 == 0
        given[-1] = True
        if given.all():
            continue
        floor = ("",) * int(given.sum())
        fixes = Fixes(truth.time[given], truth.position[given], np.full(len(floor), WAYPOINT_SIGMA), floor)
        rest = ~given
        scored = Trajectory(truth.time[rest], truth.position[rest], truth.heading[rest], ("",) * int(rest.sum()))
        yield Walk(detect_steps(gaits), magnetic_headings(gaits, frame, np.zeros(2)), fixes, scored)


def outdoors(seed):
    """The scenario, by another walker and phone."""
    walk = simulate(replace(Scenario.load(OUTDOORS), seed=seed))
    with TemporaryDirectory() as folder:
        write(walk, Path(folder))
        recording = io.load(folder)
    gaits, fixes = gait_of(recording), walk.frame.place(recording.fixes)
    time = np.arange(0.0, walk.truth.time[-1], EVERY)
    place = interpolate(time, walk.truth.time, walk.truth.position)
    truth = Trajectory(
        time + walk.scenario.start - recording.clock_origin, place, np.zeros(len(time)), ("",) * len(time)
    )
    return Walk(detect_steps(gaits), magnetic_headings(gaits, walk.frame, fixes.position[0]), fixes, truth)
