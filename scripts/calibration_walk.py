"""The experiments of [calibration-walk] in simulation: 320 steps, sixteen walkers' 100 m, their calibration walks."""

from pathlib import Path

import numpy as np
from tables import publish, table

from pdr_graph import detect_steps
from pdr_graph.estimation.calibration import calibrate
from pdr_graph.floor.plan_files import read_route
from pdr_graph.gait import walker
from pdr_graph.gait.steps import gait_signals
from pdr_graph.gait.walker import StepFeatures, Walker
from pdr_graph.geometry import dead_reckon, interpolate, wrap_angle
from pdr_graph.lab.papers import gait_methods
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate

EIGHT = Path(__file__).resolve().parents[1] / "maps" / "figure_eight.geojson"
MANNERS = ("normal", "fast", "narrow", "wide")
PEOPLE = (("m", 1), ("m", 2), ("m", 3), ("f", 4))  # three men and a woman; seeds
HEIGHTS = (1.67, 1.75, 1.90, 1.48, 1.64, 1.72, 1.65, 1.73, 1.80, 1.77, 1.69, 1.77, 1.65, 1.67, 1.72, 1.76)
WOMEN = (3, 4)
TURNS = [[25, 0], [25, 25], [50, 25], [50, 50]]  # 25 m, left, 25 m, right, 25 m, left, 25 m
HELD = "hand"
PAPER_DISTANCE = {"height": 3.97, "lasso": 3.31}


def calibration_walk():
    """The tables."""
    twenty_steps()
    further_walks()
    hundred_metres()


def twenty_steps():
    """Four people, four manners, twenty steps and the feet together: how many steps does each method count?"""
    found = {name: [] for name in ("[calibration-walk] before", "[calibration-walk] with templates")}
    found |= {name: [] for name in ("[map-matching] peak pairs", "[gps-dr] vertical and forward", "**ours**")}
    for sex, seed in PEOPLE:
        for manner in MANNERS:
            attitude, forward, ours = twenty(sex, seed, manner)
            columns = (
                gait_methods.trough_to_peak(attitude),
                gait_methods.without_closing(attitude, forward),
                gait_methods.peak_pairs(attitude),
                gait_methods.vertical_forward(attitude, forward),
                ours,
            )
            for counted, column in zip(found.values(), columns, strict=True):
                counted.append(len(column))
    paper = {"[calibration-walk] before": "322", "[calibration-walk] with templates": "320"}
    rows = [
        [name, sum(n), sum(n) - 320, f"{np.mean(np.equal(n, 20)):.0%}", paper.get(name, "")]
        for name, n in found.items()
    ]
    publish(
        "results/calibration-walk.md",
        "twenty steps",
        table(["method", "counted of 320", "error", "walks exact", "paper"], rows),
    )


def further_walks():
    """A hundred walks of other people, of any number of steps: how many steps do the templates get wrong?"""
    before, after, true = [], [], []
    for seed in range(100, 125):
        for manner in MANNERS:
            attitude, forward, _, landed = walked(seed, manner, 13 + seed % 7 / 2, {})
            before.append(len(gait_methods.trough_to_peak(attitude)))
            after.append(len(gait_methods.without_closing(attitude, forward)))
            true.append(landed - 1)
    rows = [
        [name, sum(n), sum(n) - sum(true), f"{np.mean(np.equal(n, true)):.0%}"]
        for name, n in (("before", before), ("with templates", after))
    ]
    publish(
        "results/calibration-walk.md",
        "further walks",
        table(["100 further walks", f"counted of {sum(true)}", "error", "exact"], rows),
    )


def twenty(sex, seed, manner):
    """Attitude, forward acceleration and our landings of a walk of twenty steps, then the feet together."""
    for metres in np.arange(8.0, 26.0, 0.1):
        attitude, forward, landings, landed = walked(seed, manner, float(metres), {"sex": sex})
        if landed == 21:
            return attitude, forward, landings
    raise SystemExit(f"no walk of twenty steps by {sex} {seed}, {manner}")


def walked(seed, manner, metres, walker):
    """Attitude, forward acceleration, our landings, and how often feet landed, the last time to close."""
    route = [[0, 0], {"stand": 2}, {"to": [[metres, 0]], "manner": manner}, {"stand": 2}]
    walk = simulate(Scenario.of({"seed": seed, "route": route, "walker": walker, "phone": {"hold": HELD, "rate": 50}}))
    gait = gait_signals(walk.recording("accelerometer", "gyroscope"))[0]
    return gait.attitude, gait.forward, gait.landings, len(walk.body.landings)


def hundred_metres():
    """Sixteen walkers of the paper's heights: distance error by stride model, position error by calibration."""
    walkers = [(seed, height, "f" if seed in WOMEN else "m") for seed, height in enumerate(HEIGHTS)]
    walks = [simulated(TURNS, *walker) for walker in walkers]
    gaits = [gait_signals(walk.recording("accelerometer", "gyroscope")) for walk in walks]
    profiles = [calibrated(*walker) for walker in walkers]
    way = [walk.body.lengths.sum() for walk in walks]

    rows = []
    for name, model in walker.MODELS.items():
        walked = [model(StepFeatures(g[0]), height=h)[0].sum() for g, h in zip(gaits, HEIGHTS, strict=True)]
        shown = f"**{name}, ours**" if name == "inverted pendulum" else name
        rows.append([shown, f"{np.mean(np.abs(np.subtract(walked, way))):.2f}", PAPER_DISTANCE.get(name, "")])
    own = [detect_steps(g, p).length.sum() for g, p in zip(gaits, profiles, strict=True)]
    rows.append(["**ours, with the walker's calibration**", f"{np.mean(np.abs(np.subtract(own, way))):.2f}", ""])
    publish(
        "results/calibration-walk.md",
        "hundred metres",
        table(["stride model", "distance error of 100 m [m]", "paper"], rows),
    )

    def errors(walker_of):
        return [
            place_errors(walk, detect_steps(g, walker_of(n)))
            for n, (walk, g) in enumerate(zip(walks, gaits, strict=True))
        ]

    methods = {
        "height alone": (errors(lambda n: Walker(HEIGHTS[n], stride="height")), "8.26"),
        "height, calibration": (errors(lambda n: calibrated(*walkers[n], "height")), "5.91"),
        "**ours**": (errors(lambda n: Walker(HEIGHTS[n])), ""),
        "**ours, calibration**": (errors(lambda n: profiles[n]), "5.67 (all methods)"),
    }
    rows = [[name, *(f"{v:.2f}" for v in np.mean(found, axis=0)), paper] for name, (found, paper) in methods.items()]
    header = ["method", "mean position error [m]", "at the end [m]", "paper, mean position error [m]"]
    publish("results/calibration-walk.md", "calibration walk", table(header, rows))

    turns = np.degrees([[abs(t) for t in turns_of(walk, g[0])] for walk, g in zip(walks, gaits, strict=True)])
    rows = [[name, *(f"{v:.1f}" for v in of(turns, axis=0))] for name, of in (("mean", np.mean), ("spread", np.std))]
    rows.append(["paper's eight: mean", "88.2", "87.2", "87.8"])
    publish("results/calibration-walk.md", "corners", table(["estimated turn [deg]", "left", "right", "left"], rows))


def simulated(to, seed, height, sex, follow=0):
    """A walk of one of the sixteen, along corners or so often along the eight."""
    route = [[0, 0], {"stand": 3}, {"to": to}, {"stand": 3}]
    given = {"seed": seed, "walker": {"height": height, "sex": sex}, "phone": {"hold": HELD, "rate": 50}}
    if follow:
        given["plan"] = str(EIGHT)
        route = [[13.0, 7.0], {"stand": 3}, *[{"follow": "eight"}] * follow, {"stand": 3}]
    return simulate(Scenario.of({**given, "route": route}))


def calibrated(seed, height, sex, stride="inverted pendulum"):
    """The walker as a calibration walk, twice round the eight, tells them."""
    walk = simulated(None, seed, height, sex, follow=2)
    steps = detect_steps(walk.recording("accelerometer", "gyroscope"), Walker(height, stride=stride))
    return Walker(height, stride=stride, profile=calibrate(steps, read_route(EIGHT))[0])


def place_errors(walk, steps):
    """Mean and last distance [m] of dead reckoning from the truth; it starts where and whither the walker did."""
    body = walk.body
    first = np.searchsorted(body.time, body.landings[0])
    track = dead_reckon(steps, heading=float(body.heading[first]))
    apart = np.hypot(*(track.position - interpolate(track.time, body.time, body.position)).T)
    return apart[1:-1].mean(), apart[-1]


def turns_of(walk, gait):
    """What the walking direction turned at each corner [rad]: from 4 s before to 4 s after it."""
    body, corners = walk.body, np.array(TURNS[:-1], dtype=float)
    at = body.time[[np.argmin(np.hypot(*(body.position - corner).T)) for corner in corners]]
    heading = np.interp([at - 4, at + 4], gait.attitude.time, gait.direction.heading)
    return wrap_angle(heading[1] - heading[0])
