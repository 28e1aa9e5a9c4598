"""The experiment of [gps-dr] Sec. 4 in simulation: a walk by a GPS that errs alike for a minute, and is cut off."""

import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tables import DOCS, publish, table

from pdr_graph import WalkGraph, detect_steps, io, kalman_filter, kalman_smoother, magnetic_headings, smooth
from pdr_graph.gait.gait import gait_of
from pdr_graph.geometry import interpolate
from pdr_graph.simulation.recorders import write
from pdr_graph.simulation.scenario import Scenario
from pdr_graph.simulation.simulate import simulate
from pdr_graph.types import Trajectory

WALKS = 20
CORNERS = [[260, 0], [260, 150], [120, 150], [120, 250], [290, 290]]  # 1650 m with the way back
CORNERS += [[290, 420], [60, 420], [-40, 330], [-40, 110], [0, 0]]
ACCURACY = 5.0  # [m] 68 %, of a receiver at 1 Hz
BEGINS = 180.0  # [s] from the start of the walk, of every outage
OUTAGES = {"20 s": 20.0, "2 min": 120.0, "5 min": 300.0, "10 min": 600.0}
ACROSS, HELD, PDR = "GPS alone, straight across", "GPS alone, last position", "dead reckoning, laid on the GPS"
EKF, RTS, OURS = "EKF", "EKF, smoothed (RTS)", "**the graph**"
EVERY = 1.0  # [s] at which errors are taken
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
    publish("accuracy.md", "gps-outage", table(header, rows))
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
    """What a phone recorded of the walk: steps, magnetic headings and its GPS fixes; and the truth, in one frame."""
    route = [[0, 0], {"stand": 5}, {"to": CORNERS, "manner": "fast"}, {"stand": 5}]
    given = {"seed": seed, "route": route, "phone": {"rate": 50}, "gnss": {"accuracy": ACCURACY}}
    walk = simulate(Scenario.of(given))
    with TemporaryDirectory() as folder:
        write(walk, Path(folder))
        recording = io.load(folder)
    gaits, fixes = gait_of(recording), walk.frame.place(recording.fixes)
    headings = magnetic_headings(gaits, walk.frame, fixes.position[0])
    time = np.arange(0.0, walk.truth.time[-1], EVERY)
    place = interpolate(time, walk.truth.time, walk.truth.position)
    time = time + walk.scenario.start - recording.clock_origin
    return detect_steps(gaits), headings, fixes, Trajectory(time, place, np.zeros(len(time)), ("",) * len(time))


def tracks(seed, seconds):
    """The walk by every method, without the fixes of an outage."""
    steps, headings, fixes, _ = walked(seed)
    left = fixes[(fixes.time < BEGINS) | (fixes.time >= BEGINS + seconds)]
    graph = WalkGraph(steps, left, headings=headings)
    ours = smooth(graph)
    alone = Trajectory(left.time, left.position, np.zeros(len(left)), left.floor)
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
    *_, truth = walked(seed)
    cut = (truth.time >= BEGINS) & (truth.time < BEGINS + seconds)
    found = {}
    for name, track in tracks(seed, seconds).items():
        gap = interpolate(truth.time, track.time, track.position) - truth.position
        error, inside = np.hypot(*gap.T), np.empty((0, len(truth)), dtype=bool)
        if name in (EKF, RTS, OURS):
            parts = interpolate(truth.time, track.time, track.covariance[:, :2, :2].reshape(-1, 4))
            covariance = parts.reshape(-1, 2, 2)
            inside = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(covariance), gap)[None] < 4.605
        found[name] = error[cut], error, inside[:, cut].ravel(), inside.ravel()
    return found


def draw():
    """One walk and its outage, as the paper's figure 3."""
    *_, truth = walked(SHOWN)
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
