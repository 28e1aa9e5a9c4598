"""Does a stated region hold what it says, whatever one of the sources does? Simulated walks x lies, and recordings.

python scripts/integrity.py [WORDS] [--walks N] [--held-back] [--write] makes the rows whose "family: name" has one of
some words, separated by commas: ``beacons:`` of a family, ``swapped,moved`` of rows, ``recordings`` of the real ones;
without words, all. Tune on the walks of development; the published table has those held back.
"""

import os
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from integrity_recorded import recorded
from integrity_rows import HELD_BACK, is_wanted, make_rows
from integrity_scores import HEADER, cells, reliability, score
from integrity_walks import INDOORS, LOOPS, OUTDOORS, measured, simulated_walk
from tables import publish, table

from pdr_graph import smooth

WALKS, FEWER = 80, 15  # of each family; of those in which a walk takes 10 to 60 s:
LONG = ("GNSS, beacons", "beacons, GNSS", "beacons", "plan")
DATA = Path(os.environ.get("PDR_GRAPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


@dataclass(frozen=True)
class Row:
    """A row of the table: what the estimate is given, and without what it is compared to see harm (None: nothing)."""

    given: tuple[str, ...]
    without: tuple[str, ...] | None = None

    @property
    def name(self):
        return ", ".join(self.given)


def rows_of(given, lies, without=None):
    """A row without a lie, and one for each lie of the last source."""
    return [Row((*given[:-1], f"{given[-1]}: {lie}" if lie else given[-1]), without) for lie in ("", *lies)]


LISTS = ("a pair swapped", "one moved", "one missing", "three on another floor", "of another building")
RECEIVER = ("10 m off", "jumping", "5 s late", "frozen for a minute", "3 times as sure")
PLAN = ("5 m shifted", "a door missing", "of another floor")
NO_COMPASS = "compass: none"
FAMILIES = {  # the setting and the rows of walks that are compared with each other; each family has its own walks
    "GNSS, beacons": (
        INDOORS,
        [
            Row(("GNSS",)),
            Row(("GNSS: 10 m off",)),
            *rows_of(("GNSS", "beacons"), LISTS, ("GNSS",)),
        ],
    ),
    "beacons, GNSS": (INDOORS, rows_of(("beacons", "GNSS"), RECEIVER, ("beacons",))),
    "beacons": (INDOORS, rows_of(("beacons",), LISTS)),
    "outdoors": (OUTDOORS, rows_of(("GNSS",), RECEIVER)),
    "fixes": (
        INDOORS,
        [
            Row((NO_COMPASS, "user fixes")),
            Row(("user fixes",), (NO_COMPASS, "user fixes")),
            Row(("compass: 40° off", "user fixes"), (NO_COMPASS, "user fixes")),
            Row(("stride: 40 % off", "user fixes")),
            *rows_of(("user fixes", "start"), ("8 m off",), ("user fixes",)),
        ],
    ),
    "ends": (
        INDOORS,
        [
            Row(("start",)),
            Row(("compass: 40° off", "start")),
            Row(("start", "end"), ("start",)),
            Row((NO_COMPASS, "start", "end")),
            Row(("compass: 40° off", "start", "end"), (NO_COMPASS, "start", "end")),
        ],
    ),
    "ranges": (INDOORS, rows_of(("ranges", "start"), ("8 m off",), ("ranges",))),
    "radio map": (
        INDOORS,
        [*rows_of(("start", "radio map"), ("a part rebuilt",), ("start",)), Row(("radio map", "plan"), ("radio map",))],
    ),
    "plan": (
        INDOORS,
        [
            *rows_of(("user fixes", "plan"), PLAN, ("user fixes",)),
            Row(("start", "end", "plan"), ("start", "end")),
            *rows_of(("start", "plan"), PLAN, ("start",)),
            Row(("start: 8 m off", "user fixes", "plan"), ("user fixes", "plan")),
            Row(("start: 8 m off", "plan"), ("start: 8 m off",)),
            Row(("stride: 40 % off", "user fixes", "plan")),
        ],
    ),
    "loops": (
        LOOPS,
        [Row(("start", "end")), Row((NO_COMPASS, "start", "end")), Row(("compass: 40° off", "start", "end"))],
    ),
}
LIE = ": "  # in the name of a source that lies


def integrity(data, wanted=(), walks=None, first=HELD_BACK):
    """The tables. wanted: words of which a row's name has one; walks: of each family; first: seed of the first walk."""
    rows = [
        (name, row) for name, (_, some) in FAMILIES.items() for row in some if is_wanted(f"{name}: {row.name}", wanted)
    ]
    found = scores_by_row(rows, walks, first)
    lines = [
        [FAMILIES[name][0], row.name, *cells(found[name, row.given], row.without and found[name, row.without])]
        for name, row in rows
    ]
    publish("results/integrity.md", "integrity", table(["", "given", *HEADER], lines))
    groups = {"nothing lies": [], "a source lies": []}
    for name, row in rows:
        if any(source.startswith("plan") for source in row.given):
            lies = any(LIE in source for source in row.given)
            groups["a source lies" if lies else "nothing lies"] += found[name, row.given]
    if any(groups.values()):
        groups = {name: scores for name, scores in groups.items() if scores}
        publish("results/integrity.md", "integrity probability", reliability(groups))
    if not wanted:
        recorded(data)


def scores_by_row(rows, walks, first):
    """The scores of all walks by family and what is given, also without the sources that rows are compared with."""
    jobs = []
    for name in dict.fromkeys(name for name, _ in rows):
        needed = dict.fromkeys(given for of, row in rows if of == name for given in (row.given, row.without) if given)
        count = walks or (FEWER if name in LONG else WALKS)
        jobs += [(name, first + 1000 * list(FAMILIES).index(name) + seed, tuple(needed)) for seed in range(count)]
    found = {}
    with ProcessPoolExecutor() as pool:
        for (name, _, _), scores in zip(jobs, pool.map(scores_of, jobs), strict=True):
            for given, one in scores.items():
                found.setdefault((name, given), []).append(one)
    return found


def scores_of(job):
    """The scores of one walk by what is given."""
    family, seed, needed = job
    warnings.simplefilter("ignore")
    walk = simulated_walk(FAMILIES[family][0], seed)
    return {given: score(smooth(measured(walk, given).graph()), walk.truth) for given in needed}


def some_rows(wanted, walks, first):
    """Some tables: of simulated walks, or of the recordings."""
    if wanted == ["recordings"]:
        recorded(DATA)
    else:
        integrity(DATA, wanted, walks, first)


if __name__ == "__main__":
    make_rows(some_rows, sys.argv[1:], __doc__, f"of each family; {WALKS}, of long ones {FEWER}")
