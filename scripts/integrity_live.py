"""Does the live pose's stated region hold what it says, whatever a source does? Simulated walks, step by step.

python scripts/integrity_live.py [WORDS] [--walks N] [--held-back] [--write] makes the rows whose "setting: name" has
one of some words. Tune on the walks of development; the published table has those held back.
"""

import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from integrity_rows import HELD_BACK, is_wanted, make_rows
from integrity_scores import LEAST_COVERAGE, Score, score, share
from integrity_walks import INDOORS, OUTDOORS, measured, simulated_walk
from tables import publish, table

from pdr_graph import smooth
from pdr_graph.online.interface import trajectory_of
from pdr_graph.online.navigator import Navigator
from pdr_graph.types import Estimate, Steps, last_time, take

WALKS = 30  # of each row
LAG = 60.0  # [s]
OWN = 50_000  # first seed of the walks of this table, beside those of others
ROWS = {  # what the navigator is given
    OUTDOORS: [("GNSS",), ("GNSS: 10 m off",), ("GNSS: 3 times as sure",)],
    INDOORS: [
        ("GNSS", "beacons"),
        ("GNSS", "beacons: a pair swapped"),
        ("GNSS", "beacons: one moved"),
        ("GNSS", "beacons: of another building"),
        ("GNSS: 10 m off", "beacons"),
        ("user fixes", "start"),
        ("user fixes", "start: 8 m off"),
    ],
}
HEADER = ["", "given", "walks", "batch [m]", "in 90 %", "current pose [m]", "in 90 %", "its radius [m]"]
HEADER += ["smoothed, lag 60 s [m]", "in 90 %", "its radius [m]", "not ok"]


@dataclass(frozen=True)
class Live:
    """Scores of a walk: of the batch, of the current poses, and of the walk smoothed with a lag."""

    batch: Score
    pose: Score
    smoothed: Score


def integrity_live(wanted=(), walks=None, first=HELD_BACK):
    """The table. wanted: words of which a row's name has one; walks: of each row; first: seed of the first walk."""
    jobs, lines = [], []
    for setting, rows in ROWS.items():
        rows = [row for row in rows if is_wanted(f"{setting}: {', '.join(row)}", wanted)]
        jobs += [(setting, row, OWN + first + seed) for row in rows for seed in range(walks or WALKS)]
    found = {}
    with ProcessPoolExecutor() as pool:
        for (setting, row, _), one in zip(jobs, pool.map(scores_of, jobs), strict=True):
            found.setdefault((setting, row), []).append(one)
    for (setting, row), some in found.items():
        lines.append([setting, ", ".join(row), len(some), *cells(some)])
    publish("results/integrity-live.md", "integrity live", table(HEADER, lines))


def scores_of(job):
    """The scores of one walk."""
    setting, sources, seed = job
    warnings.simplefilter("ignore")
    walk = simulated_walk(setting, seed)
    given = measured(walk, sources)
    batch = score(smooth(given.graph()), walk.truth)
    poses, estimate = followed(given)
    causal = Estimate(poses, poses, None, {}, 0, float("nan"), True)
    return Live(batch, score(causal, walk.truth), score(estimate, walk.truth))


def followed(given):
    """A walk through a navigator: its pose after each step, and the estimate at its end."""
    nav, poses = Navigator(given.floor, lag=LAG), []
    for event in events(given):
        nav.push(event)
        if isinstance(event, Steps) and (pose := nav.pose) is not None:
            poses.append(pose)
    return trajectory_of(poses), nav.finish()


def events(given):
    """Measurements in their time, and each step as it ends."""
    tables = [given.fixes, given.headings, *(table for table in (given.levels, given.ranges) if table is not None)]
    steps, begin = given.steps, -np.inf
    for n in range(len(steps)):
        columns = {name: v[n : n + 1] for name, v in vars(steps).items() if isinstance(v, np.ndarray)}
        start = steps.start if n == 0 else float(steps.time[n - 1])
        yield Steps(start, float(steps.time[n]), **columns)
        for data in tables:
            rows = np.flatnonzero((last_time(data) > begin) & (last_time(data) <= steps.time[n]))
            if len(rows):
                yield take(data, rows)
        begin = steps.time[n]


def cells(scores):
    """Cells of a row from the scores of its walks; those that miss the target are bold."""
    row = []
    for name in ("batch", "pose", "smoothed"):
        some = [getattr(one, name) for one in scores]
        error, inside, size = (np.concatenate([getattr(s, n) for s in some]) for n in ("error", "inside", "size"))
        row += [" / ".join(f"{p:.1f}" for p in np.percentile(error, [50, 75, 95])), share(inside, LEAST_COVERAGE)]
        row += [f"{np.median(size):.1f}"] * (name != "batch")
    return [*row, share([one.smoothed.verdict != "ok" for one in scores])]


if __name__ == "__main__":
    make_rows(integrity_live, sys.argv[1:], __doc__, f"of each row; {WALKS}")
