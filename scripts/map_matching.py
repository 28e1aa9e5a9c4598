"""The experiment of [map-matching] in simulation: laps of a corridor loop, corrected by the building."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tables import DOCS, publish, table

from pdr_graph import FloorPlan, Headings, WalkGraph, detect_steps, smooth
from pdr_graph.apps.report.plotting import draw_plan
from pdr_graph.geometry import dead_reckon, interpolate, length_along
from pdr_graph.lab.papers.map_matching import correct, match, straightened
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes

LOOP = Path(__file__).resolve().parents[1] / "maps" / "loop.geojson"
START, HEADING = np.array([14.85, 1.25]), 0.0  # the opposite corner is at 40 % of the lap, as in the paper
CORNERS = [[43.75, 1.25], [43.75, 26.75], [1.25, 26.75], [1.25, 1.25]]
WALKS = 60
ZIGZAG = (0.4, 0.8)  # [m] amplitude, drawn for each walk: as much as corridors of 2.5 m leave
STRIDE, TURNS, DRIFT = (0.89, 0.03), (1.04, 0.02), (0.0, 0.001)  # mean, sigma [-], [-], [rad/s] of a walker's errors
SHARES = np.sort([*np.arange(1, 11) / 10, 0.35, 0.53, 0.56])  # of the path, where the paper measures
SIGMA_START, SIGMA_HEADING = 0.2, 0.1  # [m], [rad] told to the graph of the known start
PAPER = {
    "dead reckoning": (6.76, 10.78, 2.01),
    "projection on links": (1.01, 1.94, 0.19),
    "method 1": (0.57, 1.08, 0.24),
    "method 2": (1.54, 2.68, 0.44),
}
SHOWN = 3  # the walk of the figure
OURS = "**the graph**"


def map_matching():
    """The table, and the figure."""
    plan, walks = FloorPlan.load(LOOP), [walked(seed) for seed in range(WALKS)]
    methods = {
        "dead reckoning": lambda steps: reckoned(straightened(steps)),
        "projection on links": lambda steps: match(straightened(steps), plan.network, START, HEADING).trajectory,
        "method 1": lambda steps: correct(straightened(steps), plan, START, HEADING, 1).trajectory,
        "method 2": lambda steps: correct(straightened(steps), plan, START, HEADING, 2).trajectory,
        "dead reckoning, gyroscope as it is": reckoned,
        "method 1, gyroscope as it is": lambda steps: correct(steps, plan, START, HEADING, 1).trajectory,
        OURS: lambda steps: graph_track(steps, plan, known_start(steps), HEADING),
    }
    tracks = {name: [method(steps) for steps, _ in walks] for name, method in methods.items()}
    found = {
        name: np.array([errors(track, truth) for track, (_, truth) in zip(own, walks, strict=True)])
        for name, own in tracks.items()
    }
    rivals = found["method 1"].mean(axis=1)
    rows = []
    for name, own in tracks.items():
        error = found[name]
        ours = (f(error, axis=1).mean() for f in (np.mean, np.max, np.min))
        paper = PAPER.get(name, ("",) * 3)
        crossing = np.mean([plan.crosses_wall(t.position[:-1], t.position[1:]).mean() for t in own])
        kept = [zigzag_kept(track, truth) for track, (_, truth) in zip(own, walks, strict=True)]
        rows.append(
            [
                name,
                *(f"{v:.2f} ({p})" if p else f"{v:.2f}" for v, p in zip(ours, paper, strict=True)),
                f"{100 * np.mean(error.mean(axis=1) < rivals):.0f} %" if name != "method 1" else "—",
                f"{100 * crossing:.1f} %",
                f"{np.mean(kept, axis=0)[0]:.2f}",
                f"{np.mean(kept, axis=0)[1]:.2f}",
            ]
        )
    header = ["error [m] (paper)", "mean", "max", "min", "walks nearer than method 1", "steps through walls"]
    header += ["correlation with the true zigzag", "off to the side [m]"]
    publish("results/map-matching.md", "map-matching", table(header, rows))
    if "--write" in sys.argv:
        draw(plan, *walks[SHOWN], {name: own[SHOWN] for name, own in tracks.items()})


@cache
def walked(seed):
    """One lap: the steps that the phone tells of, and the truth."""
    zigzag = np.random.default_rng(seed).uniform(*ZIGZAG, 2).tolist()
    legs = [{"to": to} for to in (*CORNERS, START.tolist())]
    legs[1]["zigzag"], legs[2]["zigzag"] = zigzag
    route = [START.tolist(), {"stand": 3}, *legs, {"stand": 3}]
    return told(LOOP, route, seed)


def told(plan, route, seed):
    """The steps that a walker's phone tells of a route through a plan, and the truth."""
    walk = simulate(Scenario.of({"seed": seed, "plan": str(plan), "route": route, "phone": {"rate": 50}}))
    return misjudged(detect_steps(walk.recording("accelerometer", "gyroscope")), seed), walk.truth


def misjudged(steps, seed):
    """The steps with errors of a walker's own, on top of those that the simulated phone and body make.

    As the paper's, strides are said shorter than they are; its dead reckoning is 6.8 m off.
    """
    z = np.random.default_rng([seed, 1]).standard_normal(3)
    stride, turns, drift = (mean + sigma * z for (mean, sigma), z in zip((STRIDE, TURNS, DRIFT), z, strict=True))
    since = np.diff(steps.time, prepend=steps.start)
    return replace(
        steps,
        length=stride * steps.length,
        turn=turns * steps.turn + drift * since,
        pause_turn=turns * steps.pause_turn + drift * (since - steps.duration),
        final_turn=turns * steps.final_turn + drift * (steps.end - steps.time[-1]),
    )


def reckoned(steps):
    """Dead reckoning from the known start."""
    return dead_reckon(steps, known_start(steps), HEADING)


def graph_track(steps, plan, fixes, heading):
    """The graph's walk between walls, by the few places that are known and the heading at the start."""
    there = Headings(np.array([steps.start]), np.array([heading]), np.array([SIGMA_HEADING]))
    return smooth(WalkGraph(steps, fixes, headings=there, floor=plan)).trajectory


def known_start(steps, start=START):
    """The start as a fix."""
    return Fixes(np.array([steps.start]), start[None], np.array([SIGMA_START]), ("",))


def errors(track, truth):
    """Distances [m] from the truth when the walker was at SHARES of the path."""
    way = length_along(truth.position)
    rows = np.searchsorted(way, SHARES * way[-1] - 1e-9)
    return np.hypot(*(interpolate(truth.time[rows], track.time, track.position) - truth.position[rows]).T)


def zigzag_kept(track, truth):
    """On the two legs that zigzag: correlation of the way to the side with the true one, and its rms error [m]."""
    x, y = truth.position.T
    (left, bottom), (right, top) = np.min(CORNERS, axis=0) + 3, np.max(CORNERS, axis=0) - 3
    legs = [((y > bottom) & (y < top) & (x > right), 0), ((x > left) & (x < right) & (y > top), 1)]
    kept = []
    for on, axis in legs:
        true = truth.position[on, axis]
        mine = interpolate(truth.time[on], track.time, track.position)[:, axis]
        alike = np.corrcoef(mine, true)[0, 1] if np.std(mine) > 1e-9 else 0.0
        kept.append((alike, np.sqrt(np.mean((mine - true) ** 2))))
    return np.mean(kept, axis=0)


def draw(plan, steps, truth, tracks):
    """As the paper's figures 11 and 12: the tracks of one walk, and the region of every turn."""
    figure = Figure(figsize=(12.5, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1])
    draw_plan(left, plan)
    left.plot(*truth.position.T, color="0.1", lw=2.5, alpha=0.5, label="truth")
    colours = {"dead reckoning": "0.6", "projection on links": "tab:green", "method 1": "tab:red", OURS: "tab:blue"}
    for name, colour in colours.items():
        left.plot(*tracks[name].position.T, color=colour, lw=1.3, label=name.strip("*"), zorder=5)
    left.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(-4, 49), ylim=(-4, 32))
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=5, frameon=False)
    for n, stretch in enumerate(correct(straightened(steps), plan, START, HEADING).stretches, start=1):
        R_d, R_s = np.nonzero(stretch.region.feasible)
        colour = f"C{n - 1}"
        right.scatter(stretch.region.R_d[R_d], stretch.region.R_s[R_s], s=9, color=colour, alpha=0.45, lw=0)
        right.plot(*stretch.pair, marker="o", ms=8, mfc=colour, mec="k", ls="none", label=f"turn {n}")
    right.set(xlabel="$R_d$", ylabel="$R_s$", title="pairs that cross no wall, and the one chosen")
    right.legend(frameon=False)
    figure.savefig(DOCS / "map-matching.png", dpi=80)
