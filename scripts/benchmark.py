"""The smoother's speed beside what a user would write with GTSAM's tutorials, and beside the limit, in one run.

Times are medians of several runs in this process; quote the ratios, machines differ.
"""

import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import shapely
from beacon_speed import beacon_rows
from lifelog_speed import lifelog_rows
from live_speed import live_rows
from profile_pipeline import profile_rows
from read_speed import reading_rows
from rivals import banded_limit, rival_rows
from scaling import scaling_rows
from synthetic_walks import PERIOD, held_by_walls, walk
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, smooth
from pdr_graph.estimation import particle_filter
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.gait.step_detection import StepDetector, walking_steps
from pdr_graph.gait.step_stream import StepStream
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.io.loading import load
from pdr_graph.lab.papers.attitude_filters import METHODS, switching
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import PARTICLES, changed
from pdr_graph.types import Fixes, Recording, Signal, Steps

ROOT = Path(__file__).resolve().parent.parent
PARTICLE_COUNT = 1000
HOUR = 360_000  # samples at 100 Hz


def median_time(function, runs):
    """Median wall time [s], after one run that is not counted."""
    times = []
    for _ in range(runs + 1):
        started = time.perf_counter()
        function()
        times.append(time.perf_counter() - started)
    return float(np.median(times[1:] or times))


def smoother_rows():
    """Time of the graph alone and with the covariance of every step, by length and how often a fix comes."""
    rows = []
    for n, every in ((1000, 30), (2000, 30), (7000, 30), (7000, 2), (30_000, 30), (100_000, 30)):
        steps, fixes = walk(n, every)
        runs = 9 if n <= 7000 else 3

        def mean_only(steps=steps, fixes=fixes):
            graph = WalkGraph(steps, fixes)
            return optimize(graph, graph.start)

        alone = median_time(mean_only, runs)
        whole = median_time(lambda steps=steps, fixes=fixes: smooth(WalkGraph(steps, fixes)), runs)
        limit = median_time(lambda n=n: banded_limit(n), runs)
        often = "1 Hz" if every == 2 else f"every {every} steps"
        rows.append(
            [n, often, f"{alone:.3f}", f"{whole:.3f}", f"{1e6 * whole / n:.1f}", f"{limit:.4f}", f"{whole / limit:.1f}"]
        )
    header = ["steps", "fixes", "walk [s]", "with covariance [s]", "µs per step", "banded limit [s]", "times the limit"]
    return table(header, rows)


def wall_rows():
    """The graph with walls; a step of particles, beside drawing its normal numbers; start-up by the floor's size."""
    plan = FloorPlan.load(ROOT / "maps" / "loop.geojson")
    steps, fixes = held_by_walls(7000)
    graph = WalkGraph(steps, fixes, floor=plan)
    good = optimize(graph, graph.start).state
    seven = median_time(lambda: optimize(graph, good), 5)
    found = optimize(graph, good)
    rows = [["graph of 7000 steps with walls, from a good start", f"{seven:.3f} s", f"{found.iterations} iterations"]]
    told = median_time(lambda: smooth(WalkGraph(steps, fixes, floor=plan)), 5)
    sought = median_time(lambda: particle_filter.particle_filter(WalkGraph(steps, fixes, floor=plan)), 1)
    rows += [["built and smoothed, with covariance; fixes tell the way", f"{told:.3f} s", ""]]
    rows += [["particles alone, which need not be asked there", f"{sought:.3f} s", f"{sought / told:.0f} ×"]]

    short = WalkGraph(*held_by_walls(400), floor=plan)
    with changed(PARTICLES, fewest=PARTICLE_COUNT, most=PARTICLE_COUNT):
        step = median_time(lambda: particle_filter.particle_filter(short), 9) / 400
    random = np.random.default_rng(0)
    drawn = median_time(lambda: [random.standard_normal((3, PARTICLE_COUNT)) for _ in range(100)], 9) / 100
    rows += [
        [f"particle filter, {PARTICLE_COUNT} particles", f"{1e6 * step:.0f} µs per step", f"{step / drawn:.1f} × noise"]
    ]

    mall = FloorPlan.load(ROOT / "maps" / "mall.geojson")
    there = Fixes(np.zeros(1), np.array([[10.5, 11.5]]), np.ones(1), ("",))
    few = Steps(0.0, 33.0, PERIOD * np.arange(1, 61), *np.tile([[PERIOD], [0.7], [0], [0], [0.07], [0.02]], 60))
    alone, of_many = (
        median_time(lambda tiles=tiles: WalkGraph(few, there, floor=tiled(mall, tiles)), 5)
        - median_time(lambda tiles=tiles: tiled(mall, tiles), 5)
        for tiles in (1, 10)
    )
    rows += [["60 steps in a mall: plan and graph, the file read", f"{alone:.3f} s", ""]]
    rows += [["the same among a hundred malls side by side", f"{of_many:.3f} s", f"{of_many / alone:.1f} × one mall"]]
    return table(["with walls", "time", ""], rows)


def tiled(plan, count):
    """A plan ``count`` times ``count`` times, side by side."""
    size = plan.corners[1] - plan.corners[0]
    places = [size * (i, j) for i in range(count) for j in range(count)]
    areas = (
        replace(a, shape=shapely.transform(a.shape, lambda c, to=place: c + to)) for place in places for a in plan.areas
    )
    return replace(plan, areas=tuple(areas))


def command_rows():
    """Whole commands in a new process, on a simulated walk of 100 s at 50 Hz in maps/arcade."""
    corners = [[27.8, 7.9], [27.8, 27.6], [6.8, 27.8], [6.8, 8.2], [53, 7.7], [53.2, 27.0]]
    given = {"recorder": "indoor_location", "phone": {"rate": 50}, "fixes": {"period": 10.0}}
    given |= {"plan": str(ROOT / "maps" / "arcade.geojson"), "route": [[6.8, 8.0], {"to": corners}]}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        write(simulate(Scenario.of(given)), out)
        recording = out / "walk.txt"
        start = [sys.executable, "-c", "from pdr_graph.apps.cli import main; main()"]
        arguments = [
            "smooth",
            recording,
            "--map",
            ROOT / "maps/arcade.geojson",
            "--fixes",
            out / "fixes.csv",
            "--out",
            out / "result",
        ]
        whole = median_time(lambda: subprocess.run([*start, *arguments], check=True), 5)
        help_ = median_time(lambda: subprocess.run([*start, "--help"], check=True, stdout=subprocess.DEVNULL), 5)
        seconds = load(recording).accelerometer.time[-1]
    rows = [[f"`pdr-graph smooth`, {seconds:.0f} s at 50 Hz with a map, start-up included", f"{whole:.2f} s"]]
    rows += [["`pdr-graph --help`", f"{help_:.2f} s"]]
    return table(["command", "median"], rows)


def simulation_rows():
    """An hour's walk about a loop, five sensors at 100 Hz; and writing its tables."""
    lap = [[40, 0], [40, 30], [0, 30], [0, 0]]
    route = [[0, 0], *({"to": lap} for _ in range(37))]
    given = Scenario.of({"route": route, "gnss": {}, "phone": {"barometer_rate": 100}})
    simulated = simulate(given)
    alone = median_time(lambda: simulate(given), 3)
    with tempfile.TemporaryDirectory() as folder:
        writing = median_time(lambda: write(simulated, Path(folder)), 1)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*.csv")) / 1e6
    minutes, steps = simulated.body.time[-1] / 60, len(simulated.body.landings)
    rows = [[f"simulated: {minutes:.0f} min, {steps} steps, five sensors at 100 Hz", f"{alone:.1f} s"]]
    rows += [[f"written as Sensor Logger has it, {size:.0f} MB", f"{writing:.1f} s"]]
    return table(["an hour's walk", "time"], rows)


def attitude_rows():
    """An hour at 100 Hz, walked once about a loop and repeated, by every method of attitude."""
    walk = simulate(Scenario.of({"route": [[0, 0], {"to": [[40, 0], [40, 30], [0, 30], [0, 0]]}]}))
    signals = {}
    for name in ("accelerometer", "gyroscope", "magnetometer"):
        values = walk.signals[name].values
        signals[name] = Signal(np.arange(HOUR) / 100, np.resize(values, (HOUR, 3)))
    recording = Recording("an hour", 0.0, None, **signals)
    methods = {**METHODS, "switching at rest": lambda r: switching(r, 0.05), "**VQF, offline (default)**": attitude_of}
    times = {name: median_time(lambda m=method: m(recording), 3) for name, method in methods.items()}
    attitude = table(["attitude of an hour at 100 Hz", "time"], [[name, f"{t:.2f} s"] for name, t in times.items()])
    time_, samples = recording.accelerometer.time, recording.accelerometer.values
    stages = {
        "steps alone, `walking_steps`": lambda: walking_steps(time_, samples),
        "steps, live, packets of 0.2 s, `StepDetector`": lambda: live_steps(samples),
        "**recording to `Steps`, all stages**": lambda: detect_steps(recording),
        "**the same live, packets of 0.1 s, `StepStream`**": lambda: live_gait(recording),
    }
    times = {name: median_time(stage, 3) for name, stage in stages.items()}
    rows = [[name, f"{t:.2f} s"] for name, t in times.items()]
    return f"{attitude}\n\n{table(['gait of an hour at 100 Hz', 'time'], rows)}"


def live_steps(samples):
    """All samples through the detector, twenty at a time."""
    detector = StepDetector(0.01)
    for first in range(0, len(samples), 20):
        detector.update(samples[first : first + 20])
    detector.finish()


def live_gait(recording):
    """All samples of accelerometer and gyroscope, ten at a time."""
    gait = StepStream()
    for first in range(0, HOUR, 10):
        for sensor in ("accelerometer", "gyroscope"):
            signal = recording.signals[sensor]
            gait.push(sensor, signal.time[first : first + 10], signal.values[first : first + 10])
        gait.advance()
    gait.finish()


def smoothers():
    """The smoother's rows, and the machine that they were made on."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("gtsam", "numpy"))
    return f"{smoother_rows()}\n\n{os.cpu_count()} cores, Python {platform.python_version()}, {packages}"


if __name__ == "__main__":
    sections = {
        "hour": profile_rows,
        "rivals": rival_rows,
        "smoother": smoothers,
        "scaling": scaling_rows,
        "walls": wall_rows,
        "beacons": beacon_rows,
        "commands": command_rows,
        "attitude": attitude_rows,
        "simulation": simulation_rows,
        "reading": lambda: table(["format", "MB", "MB/s"], reading_rows(median_time)),
        "live": live_rows,
        "lifelog": lifelog_rows,
    }
    chosen = [a for a in sys.argv[1:] if not a.startswith("--")]
    if not set(chosen) <= set(sections):
        raise SystemExit(f"usage: scripts/benchmark [{' | '.join(sections)}] [--write]")
    for name in chosen or sections:
        publish("performance.md", name, sections[name]())
