"""What wild fixes cost: shares of the fixes of real and simulated walks replaced by ones 50 to 500 m off."""

from dataclasses import dataclass, replace

import gps_outage
import numpy as np
from recorded import ipin21_walks, nju_walk
from simulations import simulated
from tables import publish, table

from pdr_graph import WalkGraph, kalman_filter, kalman_smoother, smooth
from pdr_graph.apps.report.evaluation import circular_error, pair
from pdr_graph.geometry import unit
from pdr_graph.lab.simulation.scenario import Scenario

SHARES = (0.1, 0.2, 0.3, 0.4)
NEAR, FAR = 50.0, 500.0  # [m] that a wild fix is off
SEEDS, OF_MANY, MANY = 4, 2, 200  # draws of wild fixes for each walk, and for one with more fixes than so many
SEEN = 0.1  # weight below which a fix was taken for wild
METHODS = {"graph": smooth, "RTS": kalman_smoother, "EKF": kalman_filter}


@dataclass(frozen=True)
class Score:
    """errors [m]; of the fixes that were wild and of the others, whether each was taken for wild."""

    errors: np.ndarray
    found: np.ndarray
    blamed: np.ndarray


def scattered(fixes, share, random):
    """Fixes of which some are each somewhere else, and which these are."""
    wild = random.permutation(len(fixes)) < round(share * len(fixes))
    off = random.uniform(NEAR, FAR, (len(fixes), 1)) * unit(random.uniform(0, 2 * np.pi, len(fixes)))
    return replace(fixes, position=fixes.position + wild[:, None] * off), wild


def in_one_place(fixes, share, random):
    """Fixes of which some in a row are all in one place, within their sigmas, and which these are."""
    count = round(share * len(fixes))
    since = np.arange(len(fixes)) - random.integers(0, len(fixes) - count + 1)
    wild = (since >= 0) & (since < count)
    place = fixes.position[wild].mean(axis=0) if count else np.zeros(2)
    place = place + random.uniform(NEAR, FAR) * unit(random.uniform(0, 2 * np.pi))
    there = place + random.normal(0, 1, (len(fixes), 2)) * fixes.sigma[:, None]
    return replace(fixes, position=np.where(wild[:, None], there, fixes.position)), wild


KINDS = {"scattered": scattered, "in a row, in one place": in_one_place}


def outliers(data, malls):
    """The table: by walk, kind and share of wild fixes. malls: Microsoft's walks with every second waypoint."""
    rows = []
    for name, walks in walks_of(data, malls).items():
        seeds = OF_MANY if len(walks[0].fixes) > MANY else SEEDS
        clean = {method: run(walks, scattered, 0.0, estimate, seeds=1) for method, estimate in METHODS.items()}
        rows.append([name, "none", "0 %", *(cells(clean[method], None) for method in METHODS)])
        rows[-1] += ["—", "—", "—", seen(clean["graph"], "blamed")]
        for kind, spoil in KINDS.items():
            for share in SHARES:
                spoilt = {method: run(walks, spoil, share, estimate, seeds) for method, estimate in METHODS.items()}
                without = run(walks, spoil, share, smooth, seeds, kept=lambda wild: ~wild)
                row = [name, kind, f"{100 * share:.0f} %", *(cells(spoilt[m], clean[m]) for m in METHODS)]
                row += [cells(without, clean["graph"]), doubled(spoilt["graph"], clean["graph"])]
                rows.append([*row, seen(spoilt["graph"], "found"), seen(spoilt["graph"], "blamed")])
    header = ["walk", "wild fixes", "share", *(f"{m}: 50 / 95 % [m]" for m in METHODS), "graph, outliers left out"]
    header += ["graph: walks more than doubled", "wild ones seen", "good ones blamed"]
    publish("results/outliers.md", "outliers", table(header, rows))


def run(walks, spoil, share, estimate, seeds, kept=lambda wild: wild | True):
    """Scores of every walk, each with several draws of wild fixes; kept: the fixes that are given."""
    found = []
    for n, walk in enumerate(walks):
        drawn = [spoil(walk.fixes, share, np.random.default_rng([n, seed])) for seed in range(seeds)]
        found.append([score(walk, fixes[kept(wild)], wild[kept(wild)], estimate) for fixes, wild in drawn])
    return found


def score(walk, fixes, wild, estimate):
    """One walk by one method."""
    found = estimate(WalkGraph(walk.steps, fixes, headings=walk.headings))
    doubted = np.array([fix.weight < SEEN for fix in found.fixes])
    return Score(circular_error(pair(found.trajectory, walk.truth)), doubted[wild], doubted[~wild])


def together(scores, column):
    return np.concatenate([getattr(one, column) for walk in scores for one in walk])


def cells(scores, clean):
    """Median and 95 %, and how many times those without wild fixes these are."""
    at = np.percentile(together(scores, "errors"), [50, 95])
    said = f"{at[0]:.2f} / {at[1]:.2f}"
    if clean is None:
        return said
    times = at / np.percentile(together(clean, "errors"), [50, 95])
    return f"{said} (× {times[0]:.2f} / {times[1]:.2f})"


def doubled(scores, clean):
    """Of how many walks the mean error is more than twice that without wild fixes."""
    many = [
        one.errors.mean() > 2 * usual[0].errors.mean()
        for walk, usual in zip(scores, clean, strict=True)
        for one in walk
    ]
    return f"{sum(many)} of {len(many)}"


def seen(scores, column):
    values = together(scores, column)
    return f"{100 * values.mean():.1f} %" if len(values) else "—"


def walks_of(data, malls):
    """All walks by the name of their kind."""
    ipin = {"every 10 s, 5 m": "freq10_s_err5m", "every 5 s, 3 m": "Freq5_err3m", "every 1 s, 1 m": "Freq1_s_err1m"}
    eights = {walk.name: walk for walk in ipin21_walks(data)}
    return {
        "NJU campus, GPS at 1 Hz": [nju_walk(data)],
        **{f"IPIN21's eight, {said}": [eights[file]] for said, file in ipin.items()},
        "Microsoft, every second waypoint": malls,
        "simulated, outdoors.toml": [simulated(replace(Scenario.load("outdoors"), seed=seed)) for seed in range(2)],
        "simulated, [gps-dr]'s walk": [gps_outage.walked(0)],
    }
