"""What ways outdoors are worth: simulated walks in a real town with and without its ways, beside an HMM map matcher."""

from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from itertools import pairwise

import numpy as np
from integrity import covered, marked
from tables import HELD_BACK, publish, table

from pdr_graph.apps.bench.matrix import places
from pdr_graph.errors import percent
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.smoother import smooth
from pdr_graph.floor.paths import PathNetwork
from pdr_graph.frames import enu
from pdr_graph.lab.papers.hmm_map_matching import hmm_match
from pdr_graph.lab.simulation import town_walks
from pdr_graph.types import Fixes, Trajectory

WALKS = 12
TOWN = "krems.osm.gz", (48.41, 15.60), ((-100.0, -100.0), (500.0, 500.0))  # middle of its frame, and a box in it [m]
OUTAGES = {"outages of 20 s": (20.0, 6), "outages of 2 min": (120.0, 3), "an outage of 10 min": (600.0, 1)}
LIES = {"10 m off": town_walks.displaced, "jumping": town_walks.jumping, "5 s late": town_walks.late}
ON, LAWN, ACROSS = "along ways", "across a lawn", "across ways"
ROWS = [(ON, what) for what in ("honest", *LIES, *OUTAGES)] + [(where, "honest") for where in (LAWN, ACROSS)]
BAD = {"10 m off", "jumping", "5 s late", *OUTAGES}  # the receiver errs
HEADER = ["the walk", "GNSS", "walks", "fixes matched by HMM [m]", "without ways [m]", "with [m]", "ratio"]
HEADER += ["in 90 % region, without", "with", "said to be off"]


def paths(data, wanted=(), walks=None, first=HELD_BACK):
    """The table. wanted: words of which a row's name has one; walks: of each row; first: seed of the first walk."""
    rows = [row for row in ROWS if not wanted or any(word in " ".join(row) for word in wanted)]
    jobs = [(*row, first + seed) for row in rows for seed in range(walks or WALKS)]
    with ProcessPoolExecutor() as pool:
        scores = list(pool.map(partial(scored, data), jobs))
    lines = []
    for row in rows:
        of_row = [score for (*which, _), score in zip(jobs, scores, strict=True) if tuple(which) == row]
        errors = [np.concatenate([score[name] for score in of_row]) for name in ("hmm", "without", "with")]
        hmm, without, with_ = (float(np.mean(error)) for error in errors)
        most = 1.05 if row[0] != ON else 0.6 if row[1] in BAD else 1.0
        ratio = marked(f"{with_ / without:.2f}", with_ > most * without)
        inside = [covered([score[name] for score in of_row]) for name in ("inside without", "inside")]
        off = np.mean([score["off"] for score in of_row])
        said = marked(percent(off), off < 0.8 if row[1] == "10 m off" else off > 0.2)
        lines.append([*row, len(of_row), *(f"{error:.1f}" for error in (hmm, without, with_)), ratio, *inside, said])
    publish("results/paths.md", "paths", table(HEADER, lines))


@cache
def town(data):
    """The ways of the town around the box."""
    name, place, box = TOWN
    corners = Fixes(np.array([0.0, 600.0]), np.array(box), np.full(2, 5.0))
    return PathNetwork.load(data / "paths" / name, enu(*place), corners)


def scored(data, job):
    """Errors [m], and whether places are in their region, of one walk."""
    where, what, seed = job
    network, random = town(data), np.random.default_rng(seed)
    walk = town_walks.town_walk(network, seed, across=where != ON)
    fixes, time = town_walks.fixes_of(walk, seed), walk.steps.time
    judged = np.ones(len(time), dtype=bool) if where == ON else ~walk.on[1:]
    if what in LIES:
        fixes = LIES[what](fixes, random)
    if what in OUTAGES:
        lost = town_walks.outages(fixes, *OUTAGES[what])
        bounds = np.append(-1, np.flatnonzero(~lost))
        spans = [(fixes.time[a], fixes.time[b]) for a, b in pairwise(bounds[1:].tolist()) if b > a + 1]
        judged = np.any([(time > begin) & (time < end) for begin, end in spans], axis=0)
        fixes = fixes[~lost]
    network = town_walks.lawn(network, walk) if where == LAWN else network
    truth, score = walk.place[1:][judged], {}
    score["hmm"] = np.hypot(*(hmm_match(network, fixes, time[judged]) - truth).T)
    for name, inside, ways in (("without", "inside without", None), ("with", "inside", network)):
        estimate = smooth(WalkGraph(walk.steps, fixes, paths=ways))
        track = estimate.trajectory
        score[name], score[inside] = places(track, Trajectory(time[judged], truth, np.full(len(truth), np.nan)), 0.0)
        score["off"] = any(found.source == "GPS" and found.against == "paths" for found in estimate.contradictions)
    return score
