"""A command of ``pdr-graph`` in this process, with clocks around its stages: ``python scripts/clocked.py smooth …``.

One stage after another, without the copy of the process that has some of them on a machine of two cores.
Prints {"spent": {stage: [CPU, wall]}, "memory": [MB]}; imports nothing that the command itself would not.
"""

import importlib
import json
import resource
import sys
import time
from pathlib import Path

import numpy as np

START = "interpreter and imports"
REST = "all else"
STAGES = {  # what the time of a function is counted as, less what is counted as something else
    "reading the recording": ("pdr_graph.walk:load",),
    "plan, fixes, frame": ("pdr_graph.apps.report.output_files:read",),
    "attitude": ("pdr_graph.gait.steps:attitude_of",),
    "steps": (
        "pdr_graph.walk:gait_signals",
        "pdr_graph.walk:detect_steps",
        "pdr_graph.walk:with_stair_lengths",
    ),
    "headings": ("pdr_graph.walk:magnetic_headings",),
    "floors": ("pdr_graph.walk:_with_floors",),
    "graph, built": ("pdr_graph.walk:WalkGraph",),
    "graph, particles": (
        "pdr_graph.estimation.ambiguity.path_modes:particle_filter",
        "pdr_graph.estimation.ambiguity.path_modes:particles_from",
    ),
    "graph, solved": ("pdr_graph.walk:smooth",),
    "graph, covariance": ("pdr_graph.estimation.smoother:_mixture_covariance",),
    "tracks and tables, written": (
        "pdr_graph.io.writers:write_trajectory",
        "pdr_graph.io.writers:write_tum",
        "pdr_graph.io.writers:write_geojson",
        "pdr_graph.io.writers:write_summary",
        "pdr_graph.io.gpx:write",
    ),
    "picture": ("pdr_graph.apps.report.output_files:_write_picture",),
    "report: filter": ("pdr_graph.walk:kalman_filter",),
    "report: page": ("pdr_graph.apps.report.output_files:write_report",),
    "summary": ("pdr_graph.apps.report.output_files:summarize",),
}


class Clocks:
    """CPU and wall time of stages, each without those that it called ``{stage: [CPU, wall]}`` [s]."""

    def __init__(self):
        self.spent, self._inner = {}, [np.zeros(2)]

    def around(self, module, name, stage):
        """Count the time of one function as that of a stage."""
        function = getattr(module, name)

        def counted(*arguments, **options):
            began = _now()
            self._inner.append(np.zeros(2))
            try:
                return function(*arguments, **options)
            finally:
                took = _now() - began
                own = took - self._inner.pop()
                self._inner[-1] += took
                self.spent[stage] = self.spent.get(stage, np.zeros(2)) + own

        setattr(module, name, counted)


def clocked(arguments):
    """The command with these arguments, and what it spent."""
    clocks = Clocks()
    for stage, functions in STAGES.items():
        for function in functions:
            module, name = function.split(":")
            clocks.around(importlib.import_module(module), name, stage)
    from pdr_graph.apps import cli

    sys.argv[1:] = arguments
    at_start = np.array([time.process_time(), time.time() - _born()])
    before = _now()
    try:
        cli.main()
    except SystemExit as ended:
        if ended.code:
            raise
    whole = _now() - before
    known = sum(clocks.spent.values(), np.zeros(2))
    spent = {START: at_start} | {stage: clocks.spent[stage] for stage in STAGES if stage in clocks.spent}
    spent[REST] = whole - known
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"spent": {stage: own.tolist() for stage, own in spent.items()}, "memory": memory}


def _now():
    return np.array([time.process_time(), time.perf_counter()])


def _born():
    """When this process began, Unix time [s]."""
    ticks = float(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + ticks / 100


if __name__ == "__main__":
    sys.stdout = sys.stderr  # what the command itself says
    print(json.dumps(clocked(sys.argv[1:])), file=sys.__stdout__)
