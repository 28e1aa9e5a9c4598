"""The experiments of the five papers, their published figures beside ours."""

import sys
from functools import partial

from conditions import DATA
from tables import DOCS, HELD_BACK, publish, table

from pdr_graph.apps.report.plotting import plot_regions
from pdr_graph.lab.papers import (
    calibration_walk,
    gps_dr,
    heading_experiment,
    map_matching_loop,
    reference_positions,
    stationary_switch,
)
from pdr_graph.lab.papers.map_matching import correct

EXPERIMENTS = {
    "heading": partial(heading_experiment.experiment, data=DATA),
    "gps-dr": partial(gps_dr.experiment, data=DATA),
    "map-matching": map_matching_loop.experiment,
    "calibration-walk": calibration_walk.experiment,
    "reference-positions": reference_positions.experiment,
    "stationary-switch": stationary_switch.experiment,
}


def seeds(quick=False):
    """The tables of each experiment; quick: with fewer trials, in five minutes of CPU in all."""
    for name, experiment in EXPERIMENTS.items():
        parts = []
        for made in experiment(quick=quick):
            parts += [f"**{made.title}**", table(made.header, made.rows), made.note]
        publish("results/seeds.md", name, "\n\n".join(filter(None, parts)))
    if "--write" in sys.argv:
        draw_regions()


def draw_regions():
    """The regions of (R_d, R_s) of one lap, into docs/regions.png."""
    lap = map_matching_loop.simulate_lap(HELD_BACK)
    stretches = correct(lap.steps, lap.plan, lap.start, 0.0, 1).stretches
    regions = [(stretch.region.R_d, stretch.region.R_s, stretch.region.feasible) for stretch in stretches]
    plot_regions(regions, [stretch.pair for stretch in stretches]).savefig(DOCS / "regions.png")
