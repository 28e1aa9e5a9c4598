"""Walks of the simulator as its recorder has them, for docs/results/."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from recorded import Walk

from pdr_graph import detect_steps, magnetic_headings
from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import interpolate
from pdr_graph.io.loading import load
from pdr_graph.lab.simulation.recorders import write
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Trajectory

EVERY = 1.0  # [s] at which their truth is told


def simulated(scenario):
    """The walk of a scenario, with the fixes of its own receiver."""
    walk = simulate(scenario)
    with TemporaryDirectory() as folder:
        write(walk, Path(folder))
        recording = load(folder)
    gaits, fixes = gait_signals(recording), walk.frame.place(recording.fixes)
    time = np.arange(0.0, walk.truth.time[-1], EVERY)
    place = interpolate(time, walk.truth.time, walk.truth.position)
    time = time + scenario.start - recording.clock_origin
    truth = Trajectory(time, place, np.zeros(len(time)), ("",) * len(time))
    headings, floor = magnetic_headings(gaits, walk.frame, place[0]), next(iter(scenario.plans.values()), None)
    return Walk(f"simulated, seed {scenario.seed}", detect_steps(gaits), headings, fixes, truth, floor)
