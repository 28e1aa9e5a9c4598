"""CPU time of the graph with levels of surveyed beacons: laps of an hour, and errands of five minutes, in maps/mall."""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from profile_pipeline import MAPS, hour
from tables import table

from pdr_graph import evaluate, smooth
from pdr_graph.io.tables import read_trajectory
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario, UserFixes
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.walk import Options, observe, read

CORNERS = [[10.5, 12.5], [73.5, 12.5], [73.5, 47.5], [10.5, 47.5]]  # of the corridors of maps/mall
LAPS = 23
SEEDS = (1, 2, 3, 4)
PLAN = MAPS / "mall.geojson"
HEADER = ["walk in `maps/mall.geojson`, nine beacons", "steps", "levels", "fixes", "CPU [s]", "error: median, 95 % [m]"]


def beacon_rows():
    """Laps with a fix of 3 m every 20 s; errands of five minutes with a fix of 2 m every 40 s, and without any."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        walk, written = hour(folder, "mall", CORNERS, LAPS)[1], folder / "written"
        rows = [["laps of the corridors", *measured(walk, written, written / "fixes.csv")]]
        for fixes in (UserFixes(period=40, sigma=2.0), None):
            for seed in SEEDS:
                written = folder / f"{seed}{fixes is None}"
                write(simulate(replace(Scenario.load("mall"), seed=seed, user_fixes=fixes)), written)
                given = written / "fixes.csv" if fixes else None
                rows.append([f"errand, one beacon moved, seed {seed}", *measured(written, written, given)])
    return table(HEADER, rows)


def measured(recording, written, fixes):
    """Cells of one walk: steps, levels, fixes, CPU time of the graph, errors. written: the folder of its truth."""
    evidence = observe(read(recording, Options(plan=PLAN, fixes=fixes)))
    began = time.process_time()
    walk = smooth(evidence.graph())
    took = time.process_time() - began
    [levels] = evidence.measurements
    error = evaluate(walk.trajectory, read_trajectory(written / "truth.csv", evidence.walk))["ce"]
    counts = len(evidence.steps), len(levels), len(evidence.fixes)
    return [*counts, f"{took:.2f}", f"{error['p50']:.2f}, {error['p95']:.2f}"]


if __name__ == "__main__":
    print(beacon_rows())
