"""The experiment of [gps-dr] Sec. 4 in simulation: a walk by a GPS that errs alike for a minute, and is cut off."""

import sys
from functools import cache

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from recorded import fixes_as_track, gaps
from simulations import EVERY, simulated
from tables import DOCS, publish, table

from pdr_graph import WalkGraph, kalman_filter, kalman_smoother, smooth
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.types import Trajectory

WALKS = 20
CORNERS = [[260, 0], [260, 150], [120, 150], [120, 250], [290, 290]]  # 1650 m with the way back
CORNERS += [[290, 420], [60, 420], [-40, 330], [-40, 110], [0, 0]]
ACCURACY = 5.0  # [m] 68 %, of a receiver at 1 Hz
BEGINS = 180.0  # [s] from the start of the walk, of every outage
OUTAGES = {"20 s": 20.0, "2 min": 120.0, "5 min": 300.0, "10 min": 600.0}
ACROSS, HELD, PDR = (
    "GPS alone, straight across",
    "GPS alone, last position",
    "dead reckoning, rigidly aligned with the GPS",
)
EKF, RTS, OURS = "EKF", "EKF, smoothed (RTS)", "**the graph**"
SHOWN, SHOWN_OUTAGE = 0, "2 min"  # the walk of the figure


def gps_outage():
    """The table, and the figure."""
    rows = []
    for name, seconds in OUTAGES.items():
        scored = [scores(seed, seconds) for seed in range(WALKS)]
        causal = np.concatenate([one[EKF][0] for one in scored]).mean()
        for method in scored[0]:
            parts = zip(*(one[method] for one in scored), strict=True)
            cut, whole, inside_cut, inside = (np.concatenate(part) for part in parts)
            rows.append([name, method, *said(cut), f"{cut.mean() / causal:.2f}", share(inside_cut)])
            rows[-1] += [*said(whole), share(inside)]
    header = ["outage", "method", "in it: mean [m]", "95 % [m]", "of the EKF's", "in 90 % region"]
    header += ["whole walk: mean [m]", "95 % [m]", "in 90 % region"]
    publish("results/gps-outage.md", "gps-outage", table(header, rows))
    if "--write" in sys.argv:
        draw()


def said(errors):
    """Mean and 95 % of some errors."""
    return f"{errors.mean():.2f}", f"{np.percentile(errors, 95):.2f}"


def share(inside):
    """How often something was inside; of nothing, nothing."""
    return f"{100 * inside.mean():.0f} %" if len(inside) else "—"


@cache
def walked(seed):
    """The paper's walk by another walker and phone."""
    route = [[0, 0], {"stand": 5}, {"to": CORNERS, "manner": "fast"}, {"stand": 5}]
    given = {"seed": seed, "route": route, "phone": {"rate": 50}, "gnss": {"accuracy": ACCURACY}}
    return simulated(Scenario.of(given))


def tracks(seed, seconds):
    """The walk by every method, without the fixes of an outage."""
    walk = walked(seed)
    left = walk.fixes[(walk.fixes.time < BEGINS) | (walk.fixes.time >= BEGINS + seconds)]
    graph = WalkGraph(walk.steps, left, headings=walk.headings)
    ours = smooth(graph)
    alone = fixes_as_track(left)
    methods = {ACROSS: alone, HELD: held(alone), PDR: ours.dead_reckoning}
    return methods | {
        EKF: kalman_filter(graph).trajectory,
        RTS: kalman_smoother(graph).trajectory,
        OURS: ours.trajectory,
    }


def held(alone):
    """Each position until the next."""
    until = np.append(alone.time[1:] - 1e-3, alone.time[-1] + EVERY)
    time, rows = np.stack([alone.time, until], axis=1).ravel(), np.repeat(np.arange(len(alone)), 2)
    return Trajectory(time, alone.position[rows], alone.heading[rows], ("",) * len(rows))


def scores(seed, seconds):
    """By method: errors [m] in the outage and over the walk, and which of them lie in the stated 90 % region."""
    truth = walked(seed).truth
    cut = (truth.time >= BEGINS) & (truth.time < BEGINS + seconds)
    found = {}
    for name, track in tracks(seed, seconds).items():
        error = np.hypot(*(interpolate(truth.time, track.time, track.position) - truth.position).T)
        inside = np.empty((0, len(truth)), dtype=bool)
        if name in (EKF, RTS, OURS):
            inside = gaps(track, truth)[1][None]
        found[name] = error[cut], error, inside[:, cut].ravel(), inside.ravel()
    return found


def draw():
    """One walk and its outage, as the paper's figure 3."""
    truth = walked(SHOWN).truth
    own = tracks(SHOWN, OUTAGES[SHOWN_OUTAGE])
    cut = (truth.time >= BEGINS) & (truth.time < BEGINS + OUTAGES[SHOWN_OUTAGE])
    figure = Figure(figsize=(12.5, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    colours = {ACROSS: "tab:orange", PDR: "0.6", EKF: "tab:red", RTS: "tab:green", OURS: "tab:blue"}
    canvases = figure.subplots(1, 2)
    for axes in canvases:
        axes.plot(*truth.position.T, color="0.1", lw=2.5, alpha=0.5, label="truth")
        axes.plot(*truth.position[cut].T, color="gold", lw=9, alpha=0.4, zorder=0, label=f"no GPS, {SHOWN_OUTAGE}")
        for name, colour in colours.items():
            axes.plot(*own[name].position.T, color=colour, lw=1.3, label=name.strip("*"))
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    around = truth.position[cut]
    middle, reach = (around.min(axis=0) + around.max(axis=0)) / 2, np.ptp(around, axis=0).max() / 2 + 15
    canvases[1].set(xlim=middle[0] + [-reach, reach], ylim=middle[1] + np.array([-reach, reach]))
    figure.legend(*canvases[0].get_legend_handles_labels(), loc="outside lower center", ncols=7, frameon=False)
    figure.savefig(DOCS / "gps-outage.png", dpi=80)


if __name__ == "__main__":
    gps_outage()
