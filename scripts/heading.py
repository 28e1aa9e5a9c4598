"""[heading]'s experiment with the simulator: five holding states, ten walkers, every method of direction."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tables import DOCS, publish, table

from pdr_graph import detect_steps
from pdr_graph.frames import enu
from pdr_graph.gait.heading import walking_direction
from pdr_graph.gait.steps import uninterrupted
from pdr_graph.inertial.attitude import attitude_of
from pdr_graph.io.loading import load
from pdr_graph.lab.papers.attitude_filters import imu_filter
from pdr_graph.lab.papers.gait_methods import (
    PrincipalDirection,
    acceleration_axis,
    accumulate_turn,
    angular_rate_axis,
)
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import LONLAT

HOLDS = ("hand", "swinging arm", "trouser pocket", "breast pocket", "bag")
PAPER = {
    "acceleration PCA": (20.3, 21.3, 29.0, 44.6, 26.4),
    "angular-rate PCA": (55.7, 21.7, 27.3, 73.3, 50.0),
    "angular-rate accumulation": (11.8, 18.2, 24.9, 15.0, 15.4),
}
METHODS = {  # the paper's own use its choice of attitude
    "acceleration PCA": (imu_filter, acceleration_axis),
    "angular-rate PCA": (imu_filter, angular_rate_axis),
    "angular-rate accumulation": (imu_filter, accumulate_turn),
    "**ours**": (attitude_of, walking_direction),
}
TRIALS, WALKERS = 62, 10
CORNERS = [[1.2, 1.2], [1.2, 27.0]]  # of the L: west, then north
SHORTEST_LEG = 3.0  # [m] between waypoints
SHOWN = (11, 10)  # trials of the figure: lag and drift; a flip


def trial(number):
    """One of 62 walks: holds in turn, ten walkers, twelve of the walks again with others' luck."""
    return walked(HOLDS[number % len(HOLDS)], number // len(HOLDS) % WALKERS + 10 * (number // 50))


def walked(hold, seed, rehold=None):
    """A walk along the L at 25 Hz."""
    way = [{"to": CORNERS}]
    if rehold:
        way = [{"to": [[20.0, 1.2]], "hold": rehold}, {"to": CORNERS}]
    route = [[37.0, 1.2], {"stand": 3}, *way, {"stand": 3}]
    return simulate(Scenario.of({"seed": seed, "route": route, "phone": {"hold": hold, "rate": 25}}))


def errors(walk, method):
    """Times [s] and errors [deg], not wrapped, while walking; the initial walking direction is given."""
    attitude_by, direction_by = METHODS[method]
    attitude = attitude_by(walk.recording("accelerometer", "gyroscope"))
    direction = direction_by(attitude, 1 / walk.walker.cadence)
    truth = np.interp(attitude.time, walk.body.time, walk.body.heading)
    walking = np.interp(attitude.time, walk.body.time, walk.body.step_length) > 0.3
    first = int(np.flatnonzero(walking)[0])
    heading = direction.heading - direction.heading[first] + truth[first]
    if isinstance(direction, PrincipalDirection):
        x, y, _ = walk.world_of(attitude)[first].inv().apply([1.0, 0.0, 0.0])  # the paper starts with both worlds alike
        there = direction.axis + direction.heading[first] + np.arctan2(y, x) - truth[first]
        heading += np.angle(np.exp(2j * there)) / 2  # of the two ways the one nearer to the given direction
    return attitude.time[walking], np.degrees(heading - truth)[walking]


def heading(data):
    """The tables and the figure."""
    course(data)
    trials = [trial(n) for n in range(TRIALS)]
    found = {m: [[] for _ in HOLDS] for m in METHODS}
    for method in METHODS:
        for n, walk in enumerate(trials):
            found[method][n % len(HOLDS)].append(np.sqrt(np.mean(errors(walk, method)[1] ** 2)))
    rows = []
    for method, per_hold in found.items():
        paper = PAPER.get(method, [None] * len(HOLDS))
        cells = [f"{np.mean(e):.1f}" + (f" ({p})" if p else "") for e, p in zip(per_hold, paper, strict=True)]
        rows.append([method, *cells])
    changes = [("hand", hold) for hold in HOLDS[1:]] + [(hold, "hand") for hold in HOLDS[1:]]
    again = [walked(before, seed, after) for seed, (before, after) in enumerate(changes)]
    for row, method in zip(rows, METHODS, strict=True):
        row.append(f"{np.mean([np.sqrt(np.mean(errors(walk, method)[1] ** 2)) for walk in again]):.1f}")
    publish("results/heading.md", "heading", table(["RMS [deg] (paper)", *HOLDS, "re-held in mid-walk"], rows))
    draw([trials[n] for n in SHOWN])


def course(data):
    """Errors of the course between consecutive waypoints of real walks, about each walk's own median."""
    paths = sorted((data / "ms_indoor20").glob("site*/*/*.txt"))
    paths += sorted((data / "ipin2023_track3").glob("*Trial*.txt"))
    walks = [uninterrupted(load(path))[0] for path in paths]
    rows = []
    for method, (attitude_by, direction_by) in METHODS.items():
        found = np.degrees(np.concatenate([_course_errors(walk, attitude_by, direction_by) for walk in walks]))
        rows.append([method, len(found), *(f"{v:.1f}" for v in np.percentile(found, [50, 75, 95]))])
    publish("results/heading.md", "course", table(["method", "legs", "median [deg]", "75 %", "95 %"], rows))


def _course_errors(walk, attitude_by, direction_by):
    steps, attitude = detect_steps(walk), attitude_by(walk)
    direction = direction_by(attitude, float(np.median(steps.duration)))
    heading = np.interp(steps.time - steps.duration / 2, attitude.time, direction.heading)
    way = np.cumsum(steps.length * np.exp(1j * heading))
    truth = walk.truth
    if truth.epsg == LONLAT:
        truth = enu(*truth.position[0][::-1]).place(truth)
    at, place = truth.time, truth.position @ [1, 1j]
    ours, theirs = np.diff(np.interp(at, steps.time, way)), np.diff(place)
    far = (np.abs(theirs) > SHORTEST_LEG) & (np.abs(ours) > SHORTEST_LEG / 3)
    if not far.any():
        return np.empty(0)
    apart = np.angle(theirs[far] / ours[far])
    apart = np.angle(np.exp(1j * (apart - np.angle(np.exp(1j * apart).mean()))))
    return np.abs(apart - np.median(apart))


def draw(walks):
    """Directions of some walks over time."""
    figure = Figure(figsize=(9, 3.3 * len(walks)), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, walk in zip(figure.subplots(len(walks), sharex=True), walks, strict=True):
        axes.plot(walk.body.time, np.degrees(walk.body.heading), color="0.7", lw=4, label="truth")
        for method, colour in zip(METHODS, ("tab:green", "tab:orange", "tab:purple", "tab:blue"), strict=True):
            time, error = errors(walk, method)
            truth = np.degrees(np.interp(time, walk.body.time, walk.body.heading))
            axes.plot(time, truth + error, color=colour, lw=2 if "ours" in method else 1, label=method.strip("*"))
        axes.set(ylabel="walking direction [deg]", title=walk.scenario.phone.hold)
    axes.set(xlabel="time [s]")
    figure.axes[0].legend(loc="best")
    figure.savefig(DOCS / "heading.png", dpi=80)
