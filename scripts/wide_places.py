"""Where [map-matching] stops: over a plaza and along a wide boulevard, whose walls are far, by the building."""

import sys
from functools import cache
from pathlib import Path

import numpy as np
from map_matching import SIGMA_START, graph_track, known_start, told
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tables import DOCS, publish, table

from pdr_graph import FloorPlan
from pdr_graph.apps.report.plotting import draw_plan
from pdr_graph.geometry import dead_reckon, interpolate
from pdr_graph.lab.papers.map_matching import correct, match, straightened
from pdr_graph.types import Fixes

CAMPUS = Path(__file__).resolve().parents[1] / "maps" / "campus.geojson"
WALKS = 30
START, HEADING = np.array([2.0, 13.0]), 0.0
END = np.array([139.2, 26.0])
PLAZA, BOULEVARD = (28.0, 60.0), (60.0, 118.0)  # [m] along x
ALONE, OURS = "the graph, start alone", "**the graph, start and end**"
EVERY = 1.0  # [s] at which errors are taken
SHOWN = (0, 1, 2, 3)  # the walks of the figure


def wide_places():
    """The table, and the figure."""
    plan, walks = FloorPlan.load(CAMPUS), [walked(seed) for seed in range(WALKS)]
    methods = {
        "dead reckoning": lambda steps: dead_reckon(steps, known_start(steps, START), HEADING),
        "projection on links": lambda steps: match(straightened(steps), plan.network, START, HEADING).trajectory,
        "method 1": lambda steps: correct(straightened(steps), plan, START, HEADING, 1).trajectory,
        ALONE: lambda steps: graph_track(steps, plan, known_start(steps, START), HEADING),
        OURS: lambda steps: graph_track(steps, plan, known_ends(steps), HEADING),
    }
    tracks = {name: [method(steps) for steps, _ in walks] for name, method in methods.items()}
    rows = []
    for name, own in tracks.items():
        pairs = list(zip(own, (truth for _, truth in walks), strict=True))
        cells = []
        for place in (PLAZA, BOULEVARD):
            error = np.array([errors(track, truth, place) for track, truth in pairs])
            cells += [f"{error[:, 0].mean():.2f}", f"{np.median(error[:, 0]):.2f}", f"{error[:, 1].mean():.2f}"]
        end = np.mean([np.hypot(*(track.position[-1] - truth.position[-1])) for track, truth in pairs])
        crossing = np.mean([plan.crosses_wall(t.position[:-1], t.position[1:]).mean() for t in own])
        rows.append([name, *cells, f"{end:.2f}", f"{100 * crossing:.1f} %"])
    header = ["error [m]", "plaza: mean", "median walk", "max", "boulevard: mean", "median walk", "max", "at the end"]
    publish("results/wide-places.md", "wide places", table([*header, "steps through walls"], rows))
    if "--write" in sys.argv:
        draw(plan, walks, {name: tracks[name] for name in ("dead reckoning", ALONE, OURS)})


@cache
def walked(seed):
    """From a corridor over the plaza with a bend, along the boulevard from side to side, into another building.

    There into a room and a side corridor. From the start alone that could as well have been outside, before the door,
    with strides a tenth shorter: the forecourt is wide enough for all of it.
    """
    random = np.random.default_rng([seed, 2])
    bend = [random.uniform(40, 50), random.uniform(1, 8) if random.random() < 0.5 else random.uniform(18, 26)]
    into = [60.0, random.uniform(11, 16)]
    along = np.array([73.0, 88.0, 103.0, 117.0]) + random.uniform(-2, 0, 4)
    side = 13.5 + np.array([-1, 1, -1, 1]) * random.choice([-1, 1]) * random.uniform(1, 3.2, 4)
    drifting = {"to": np.stack([along, side], axis=1).tolist(), "zigzag": float(random.uniform(0.2, 0.5))}
    room, aside = [[123.0, 14.0], [130.0, 14.0], [130.0, 3.5]], [[130.0, 14.0], [139.2, 14.0], END.tolist()]
    around = {"stand": 1, "turn": 180}
    route = [START.tolist(), {"stand": 3}, {"to": [[31.0, 13.0], bend, into]}, drifting, {"to": room}, around]
    route += [{"to": aside}, {"stand": 3}]
    return told(CAMPUS, route, seed)


def known_ends(steps):
    """The start and the end as fixes."""
    return Fixes(np.array([steps.start, steps.end]), np.stack([START, END]), np.full(2, SIGMA_START), ("", ""))


def errors(track, truth, place):
    """Mean and greatest distance [m] from the truth while the walker was in a place."""
    time = np.arange(truth.time[0], truth.time[-1], EVERY)
    true = interpolate(time, truth.time, truth.position)
    there = (true[:, 0] > place[0]) & (true[:, 0] < place[1])
    apart = np.hypot(*(interpolate(time[there], track.time, track.position) - true[there]).T)
    return apart.mean(), apart.max()


def draw(plan, walks, tracks):
    """A few walks as the methods have them."""
    figure = Figure(figsize=(12.5, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, n in zip(figure.subplots(2, 2).ravel(), SHOWN, strict=True):
        draw_plan(axes, plan)
        axes.plot(*walks[n][1].position.T, color="0.1", lw=2.5, alpha=0.5, label="truth")
        for (name, own), colour in zip(tracks.items(), ("0.6", "tab:red", "tab:blue"), strict=True):
            axes.plot(*own[n].position.T, color=colour, lw=1.3, label=name.strip("*"), zorder=5)
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-3, 157), ylim=(-9, 51))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(DOCS / "wide-places.png", dpi=80)


if __name__ == "__main__":
    wide_places()
