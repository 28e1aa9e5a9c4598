"""How much the hand-set numbers matter on Microsoft's walks: process noise, and the spring of the walls."""

from dataclasses import replace
from functools import partial

import numpy as np
from microsoft import METHODS, graph_of, helped_walks, withheld_errors
from recorded import percentiles
from tables import publish, table

from pdr_graph import smooth
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.priors import MOTION

GIVEN = ("every second waypoint", "first and last")
SWAYS, STRIDES, TURNS = (0.1, 0.25, 0.4), (0.2, 0.3, 0.4), (0.01, 0.04)  # [m], share of a step, [rad] per step
WALLS = ((0.8, 1.0), (0.8, 0.5), (0.8, 2.0), (0.2, 1.0), (1.2, 1.0))  # margin and sigma [m]


def settings(data):
    """The table."""
    walks, rows = [[walk for _, walk in helped_walks(data, given)] for given in GIVEN], []
    default = MOTION.lateral
    for sway in SWAYS:
        MOTION.lateral = sway
        rows += [row(f"sway {sway} m, stride {share:.0%}", walks, partial(strides, share)) for share in STRIDES]
    MOTION.lateral = default
    rows += [row(f"turn {turn} rad", walks, partial(turns, turn)) for turn in TURNS]
    for margin, sigma in WALLS:
        held = partial(on_plan, Prior(wall_margin=margin, wall_sigma=sigma))
        rows.append(row(f"with map: margin {margin} m, sigma {sigma} m", walks, method=held))
    header = ["setting", "every second: CE50/75/95 [m]", "in 90 %", "first and last: CE50/75/95 [m]", "in 90 %"]
    publish("results/settings.md", "settings", table(header, rows))


def row(name, walks, change=lambda steps: steps, method=METHODS["graph"]):
    """Errors by what was given, the steps' own sigmas changed or the walls'."""
    cells = []
    for of in walks:
        found = [withheld_errors(replace(walk, steps=change(walk.steps)), method) for walk in of]
        errors, inside = (np.concatenate([one[k] for one in found]) for k in (0, 1))
        cells += [percentiles(errors), f"{100 * inside.mean():.0f} %"]
    return [name, *cells]


def strides(share, steps):
    return replace(steps, sigma_length=share * steps.length)


def turns(sigma, steps):
    return replace(steps, sigma_turn=np.full(len(steps), sigma))


def on_plan(prior, walk):
    return smooth(graph_of(walk, floor=walk.floor, prior=prior)).trajectory
