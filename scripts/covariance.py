"""Is the covariance honest? The normalised error where all is Gaussian, and what the 90 % regions hold elsewhere."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from recorded import WAYPOINT_NOISE, gaps, ipin21_walks, ipin2023_walks, nju_walks
from simulations import EVERY, simulated
from tables import publish, table

from pdr_graph import WalkGraph, kalman_filter, kalman_smoother, smooth
from pdr_graph.errors import read_toml
from pdr_graph.geometry import unit
from pdr_graph.lab.simulation.scenario import Scenario, scenario_file
from pdr_graph.types import Fixes

ROOT = Path(__file__).resolve().parents[1]
SEEDS = range(3)  # of each scenario
INDOORS, OUTDOORS = ("mall", "arcade", "office"), "outdoors"
SIGMA, OFF = 1.5, 8.0  # [m] of simulated fixes, and [σ] by which a wild one is off
PERIODS = {"sparse": 12.0, "dense": 2.0}  # [s]
WILD = (0.0, 0.1, 0.3)  # shares
METHODS = {
    "EKF": lambda walk: kalman_filter(graph_of(walk)),
    "RTS": lambda walk: kalman_smoother(graph_of(walk)),
    "graph": lambda walk: smooth(graph_of(walk)),
    "graph with map": lambda walk: smooth(graph_of(walk, walk.floor)),
}


def covariance(data, microsoft):
    """Both tables. microsoft: what is given, and the walks."""
    gaussian_case()
    rows = []
    for name, walks in indoors():
        rows += regions(name, walks)
    rows += regions("simulated outdoors, GNSS that errs alike for 50 s", list(outdoors()))
    for walk in ipin21_walks(data):
        rows += regions(f"IPIN21, {walk.name}", [walk])
    for walk in ipin2023_walks(data):
        short = walk.name.split("Training")[1].split("_")[0]
        rows += regions(f"IPIN 2023, {short}, GNSS", [replace(walk, levels=None)])
        rows += regions(f"IPIN 2023, {short}, GNSS, beacons", [walk], ["graph"])
    for walk in nju_walks(data):
        rows += regions(f"NJU campus, {walk.name}", [walk])
    for given, walks in microsoft:
        rows += regions(f"Microsoft, {given}", walks, noise=WAYPOINT_NOISE)
    header = ["walks", "", "method", "in 90 % region", "size of the region [m]", "error [m]"]
    publish("results/covariance.md", "covariance", table(header, rows))


def gaussian_case():
    """Mean NEES per degree of freedom on the tests' draws from the model."""
    sys.path.append(str(ROOT / "tests"))
    import nees

    draws = {"independent fixes": nees.independent_fixes, "control: twice as bad as stated": nees.twice_as_bad}
    draws |= {"fixes of one receiver": nees.a_receiver}
    draws |= {"control: taken for independent": nees.a_receiver_taken_for_independent}
    draws |= {"ranges to beacons": nees.beacons, "control: twice as noisy as assumed": nees.twice_as_noisy}
    low, high = (bound / 3 for bound in nees.interval())
    rows = []
    with nees.gaussian():
        for name, drawn in draws.items():
            methods = {"graph": smooth} | ({"RTS": kalman_smoother} if len(rows) < 3 else {})
            for method, estimate in methods.items():
                mean = nees.normalised_errors(drawn, estimate).mean() / 3
                rows.append([name, method, f"{mean:.2f}", "inside" if low < mean < high else "outside"])
    header = ["drawn from the model", "method", "NEES / 3", f"95 % interval {low:.2f}–{high:.2f}"]
    publish("results/covariance.md", "nees", table(header, rows))


def regions(name, walks, methods=METHODS, noise=0.0):
    """A row for each method: what its 90 % regions hold, and how large they are."""
    for method in methods:
        if method == "graph with map" and walks[0].floor is None:
            continue
        parts = [gaps(METHODS[method](walk).trajectory, walk.truth, noise) for walk in walks]
        error, inside, size = (np.concatenate(part) for part in zip(*parts, strict=True))
        share = f"{100 * inside.mean():.0f} %"
        yield [name, len(walks), method, share, f"{np.median(size):.1f}", f"{np.median(error):.2f}"]


def graph_of(walk, floor=None):
    """The walk's measurements."""
    return WalkGraph(walk.steps, walk.fixes, headings=walk.headings, floor=floor, levels=walk.levels)


def indoors():
    """Walks between walls by what fixes are given."""
    walks = [simulated(drawn(scenario, seed)) for scenario in INDOORS for seed in SEEDS]
    for pace, period in PERIODS.items():
        for wild in WILD:
            name = f"simulated indoors, {pace} fixes" + (f", {wild:.0%} wild" if wild else "")
            yield name, [with_fixes(walk, period, wild, seed) for seed, walk in enumerate(walks)]


def outdoors():
    """Walks by the simulator's own receiver."""
    for seed in SEEDS:
        yield simulated(drawn(OUTDOORS, seed))


def drawn(name, seed):
    """A scenario by another walker and phone, as one recorder writes them all."""
    path = scenario_file(name)
    return Scenario.of(read_toml(path) | {"seed": seed, "recorder": "sensor_logger"}, path)


def with_fixes(walk, period, wild, seed):
    """The walk with fixes of its truth, a share of them ``OFF`` sigmas off in any direction."""
    random, rows = np.random.default_rng(seed), np.arange(0, len(walk.truth), round(period / EVERY))
    place = walk.truth.position[rows] + random.normal(0, SIGMA, (len(rows), 2))
    off = random.random(len(rows)) < wild
    place[off] += OFF * SIGMA * unit(random.uniform(-np.pi, np.pi, int(off.sum())))
    return replace(walk, fixes=Fixes(walk.truth.time[rows], place, np.full(len(rows), SIGMA), ("",) * len(rows)))
