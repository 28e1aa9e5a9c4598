"""Where the time of ``pdr-graph smooth`` goes, stage by stage, on an hour's walk.

``python scripts/profile_pipeline.py RECORDING [options of smooth]`` does the same to a recording of your own.
"""

import json
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np
from clocked import GRAPH
from tables import table

from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

CLOCKED = Path(__file__).with_name("clocked.py")
MAPS = Path(__file__).resolve().parent.parent / "maps"
OF_A_LAP = [[1.25, 1.25], [43.75, 1.25], [43.75, 26.75], [1.25, 26.75]]  # corners of the middle line of maps/loop
LAPS = 37  # about an hour
RUNS = 5
NOT_EXPORTED = ("truth.csv", "steps.csv", "events.csv", "fixes.csv", "gnss.csv")


def profile_rows():
    """CPU time of each stage on an hour at 100 Hz with a plan: the run of the median time of a few."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = hour(Path(folder))
        runs = sorted(
            (profiled(arguments) for _ in range(RUNS)), key=lambda run: sum(v[0] for v in run["spent"].values())
        )
        size = arguments[1].stat().st_size / 1e6
        quickest = min(on_the_wall(arguments) for _ in range(RUNS))
        without = min(on_the_wall([*arguments, "--no-report"]) for _ in range(RUNS))
    middle = runs[RUNS // 2]
    spent, (cpu, wall) = middle["spent"], np.sum(list(middle["spent"].values()), axis=0)
    rows = [[stage, f"{own[0]:.2f}", f"{100 * own[0] / cpu:.0f} %"] for stage, own in spent.items()]
    of_graph = sum(spent[stage][0] for stage in GRAPH if stage in spent)
    rows += [["**of which the graph**", f"**{of_graph:.2f}**", f"{100 * of_graph / cpu:.0f} %"]]
    rows += [["**the whole command**", f"**{cpu:.2f}**", "100 %"]]
    said = f"{size:.0f} MB zipped. On the wall {wall:.2f} s in that run, which has one stage after another. The command"
    said += f" itself takes {quickest:.2f} s, and {without:.2f} s with `--no-report`, each the quickest of {RUNS};"
    said += f" at most {middle['memory']:.0f} MB of memory."
    return f"{table(['stage', 'CPU [s]', 'share'], rows)}\n\n{said}"


def hour(folder, plan="loop", corners=OF_A_LAP, laps=LAPS, period=20.0):
    """Arguments of ``smooth`` for an hour's walk in laps, as Sensor Logger zips it, a fix of 3 m every so often [s]."""
    way = [*corners[1:], corners[0]]
    route = [corners[0], {"stand": 5}, *({"to": way} for _ in range(laps))]
    drawn = MAPS / f"{plan}.geojson"
    given = {"plan": str(drawn), "route": route, "fixes": {"period": period, "sigma": 3.0}}
    written, recording = folder / "written", folder / "walk.zip"
    write(simulate(Scenario.of(given)), written)
    with zipfile.ZipFile(recording, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(written.glob("*.csv")):
            if path.name not in NOT_EXPORTED:
                archive.write(path, path.name)
    return ["smooth", recording, "--map", drawn, "--fixes", written / "fixes.csv", "--out", folder / "out"]


def profiled(arguments):
    """One run in a new process: {"spent": {stage: [CPU, wall]}, "memory": [MB]}."""
    command = [sys.executable, CLOCKED, *map(str, arguments)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL).stdout)


def on_the_wall(arguments):
    """Time of the command itself in a new process [s]."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "pdr_graph", *map(str, arguments)], check=True, capture_output=True)
    return time.perf_counter() - began


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for stage, (cpu, wall) in profiled(["smooth", *sys.argv[1:], "--out", folder])["spent"].items():
            print(f"{stage:28} CPU {cpu:6.2f} s   wall {wall:6.2f} s")
