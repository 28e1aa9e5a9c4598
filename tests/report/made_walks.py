"""Synthetic walks for tests of reports."""

import numpy as np
from walks import fixes_on, steps_of

from pdr_graph import dead_reckon, kalman_filter, smooth
from pdr_graph.apps.report.content import WalkReport
from pdr_graph.apps.report.output_files import summarize
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Walker
from pdr_graph.types import Fixes, Recording, Signal
from pdr_graph.walk import Evidence, Result

RATE = 100.0  # [Hz]
SENSORS = ("accelerometer", "gyroscope", "magnetometer")


def laps(count, side=25):
    """Steps along ``count`` laps of a square of ``side`` steps per side, and a fix every 40 steps."""
    random = np.random.default_rng(3)
    turn = np.zeros(4 * side * count)
    turn[side::side] = np.pi / 2
    steps = steps_of(random.normal(0.7, 0.05, len(turn)), turn + random.normal(0, 0.01, len(turn)))
    return steps, fixes_on(dead_reckon(steps_of(np.full(len(turn), 0.7), turn)), 40, sigma=2.0, seed=4)


def recording_of(steps, name="walk.txt", **more):
    """A recording as long as ``steps`` with white noise in all sensors."""
    time = np.arange(0.0, steps.end, 1 / RATE)
    random = np.random.default_rng(5)
    signals = {sensor: Signal(time, random.normal(0, 1, (len(time), 3))) for sensor in SENSORS}
    return Recording(name, 1e9, 1.7e9, **(signals | more))


def estimated(steps, fixes, **more):
    """The report data of a walk as ``pdr-graph smooth`` estimates it."""
    graph = WalkGraph(steps, fixes)
    causal = {"filter": kalman_filter(graph).trajectory}
    return shown(recording_of(steps), smooth(graph), steps=steps, causal=causal, **more)


def shown(walk, estimate, building=None, warnings=(), missing=(), **more):
    """What a report has of an estimate."""
    evidence = Evidence(walk, Walker(), building, Frame(), Fixes.none())
    steps = more.get("steps")
    summary = summarize(Result(evidence, estimate, graph=None if steps is None else WalkGraph(steps, Fixes.none())))
    summary |= {"seconds": {"reading": 1.0}, "settings": {"method": "graph"}}
    summary |= {"missing": list(missing), "warnings": list(warnings)}
    return WalkReport(walk, building, estimate, "graph", summary, **more)
