"""[stationary-switch]'s experiment with the simulator: a phone on a cart, forth 95 cm and back 105 cm."""

from dataclasses import replace

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tables import DOCS, publish, table

from pdr_graph.lab.papers.attitude_filters import below_threshold, rest_threshold, strapdown, switching
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Signal

LEARNT_FOR = 30.0  # [s] at rest
SEEDS = range(20)
SWITCHES = {  # rest in samples in a row, and whether the next rest is known
    "λ = 0": (0, False),
    "λ learnt, sample by sample": (1, False),
    "λ learnt, at rest for 0.8 s": (40, False),
    "**the same, looking ahead to the next rest**": (40, True),
}


def pushed(seed):
    """The cart's walk, and the same phone before: λ and the bias are learnt from half a minute at rest."""
    given = {"seed": seed, "heading": 0, "phone": {"hold": "cart", "rate": 50}}
    route = [[0, 0], {"stand": LEARNT_FOR + 5.3}, {"roll": [0.95, 0], "speed": 0.452}, {"stand": 4}]
    route += [{"roll": [-0.10, 0], "speed": 0.438}, {"stand": 5}]
    return simulate(Scenario.of(given | {"route": route}))


def tracked(walk, shortest, look_ahead):
    """Times [s] and positions along the track [m]. shortest: rest, in samples; 0 for λ = 0."""
    recording = walk.recording("accelerometer", "gyroscope", "magnetometer")
    time, rate = recording.gyroscope.time, recording.gyroscope.values
    still = time < LEARNT_FOR
    rate = rate - rate[still].mean(axis=0)
    recording = replace(recording, gyroscope=Signal(time, rate))
    threshold = rest_threshold(rate[still]) if shortest else 0.0
    shortest = max(shortest, 1)
    attitude = switching(recording, threshold, shortest)
    rest = below_threshold(attitude.angular_rate, threshold, shortest)
    position = strapdown(attitude, rest, look_ahead).position
    begun = np.searchsorted(attitude.time, LEARNT_FOR)
    x, y = (position - position[begun])[:, :2].T
    forth = np.searchsorted(attitude.time, LEARNT_FOR + 5.3 + 4.0)  # on the way the cart's own axis is found
    axis = np.array([x[forth], y[forth]]) / max(np.hypot(x[forth], y[forth]), 1e-9)
    return attitude.time, axis[0] * x + axis[1] * y


def cart():
    """The table and the figure."""
    walks, rows = [pushed(seed) for seed in SEEDS], []
    for name, switch in SWITCHES.items():
        ends = [100 * abs(tracked(walk, *switch)[1][-1] + 0.10) for walk in walks]
        rows.append([name, f"{np.median(ends):.1f}", f"{np.percentile(ends, 90):.1f}", f"{max(ends):.1f}"])
    publish("results/cart.md", "cart", table(["end error [cm]", "median of 20", "90 %", "largest"], rows))
    draw(walks[0])


def draw(walk):
    """Position along the track over time."""
    figure = Figure(figsize=(7, 3), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.plot(walk.body.time, walk.body.position[:, 0], color="0.7", lw=4, label="truth")
    colours = ("tab:orange", "tab:green", "tab:purple", "tab:blue")
    for (name, switch), colour in zip(SWITCHES.items(), colours, strict=True):
        axes.plot(*tracked(walk, *switch), color=colour, label=name.strip("*"))
    axes.set(xlabel="time [s]", ylabel="x [m]", xlim=(LEARNT_FOR, None), ylim=(-1.5, 1.5))
    axes.legend()
    figure.savefig(DOCS / "cart.png", dpi=80)
