"""How much each number of `pdr_graph.priors` matters: halved and doubled, on real and simulated walks.

``scripts/reproduce settings --only TABLE,...`` measures some tables, by default all of `CASES`, and keeps the page's
figures of the others. ``--write`` writes docs/results/settings.md, and the ranges of the tables measured to priors.py.
"""

import ast
import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from conditions import (
    INDOORS,
    OUTDOORS,
    measured,
    recordings,
    scattered,
    simulated_recording,
    simulated_walk,
    walks_given,
    with_steps,
)
from live import THINNED
from tables import publish, published, table

from pdr_graph import priors
from pdr_graph.apps.bench.data_sets import BenchWalk, given
from pdr_graph.apps.bench.matrix import places
from pdr_graph.apps.bench.methods import OURS
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.priors import changed, entries, tables

ROOT = Path(__file__).resolve().parent.parent
SAME = (0.03, 0.05, 3.0)  # change of CE50 and CE95, as share, and of the coverage, in points, that counts as none
HEADER = ["number", "value", "source", "halved: CE95 [m]", "doubled: CE95 [m]", "same accuracy"]
KINDS = STEADY, UNUSED, NOT_MEASURED = "same accuracy at half and double", "no effect on these walks", "not measured"


@cache
def outdoors(data):
    """A campus walk with the phone's fixes, and two simulated walks with a receiver's."""
    scenario = Scenario.load("outdoors")
    campus = [walks_given(data, "nju", what)["campus"] for what in THINNED]
    return [*campus, *(simulated_recording(replace(scenario, seed=seed)) for seed in (1, 2))]


def scored(walk, method="graph"):
    """Errors [m] at the places that were not given, and whether each is inside its 90 % region."""
    errors, inside = places(OURS[method](walk.evidence), walk.truth, walk.noise)
    return errors[np.isfinite(errors)], inside[np.isfinite(inside)]


def malls(data, what):
    """Walks of Microsoft that are given something."""
    return list(walks_given(data, "microsoft", what).values())


def by_steps(data):
    """From the sensors' samples: steps are detected again."""
    for walk in list(recordings(data, "microsoft").values())[::4]:
        yield scored(with_steps(given(walk, "first and last")))


def on_fixes(data, method="graph"):
    """Without a plan."""
    for walk in malls(data, "every second") + malls(data, "first and last"):
        yield scored(walk, method)


def on_plans(data):
    """With the plan, between the first and the last waypoint of every eighth walk, and with every second of all."""
    for walk in malls(data, "first and last, plan")[::8] + malls(data, "every second, plan")[::3]:
        yield scored(walk)


def on_receivers(data):
    """With the fixes of a receiver."""
    yield from map(scored, outdoors(data))


def on_outliers(data):
    """The same, every fifth fix far off."""
    random = np.random.default_rng(0)
    for walk in outdoors(data):
        yield scored(
            replace(walk, evidence=replace(walk.evidence, fixes=scattered(walk.evidence.fixes, 0.2, random)[0]))
        )


def simulated(*cases):
    """Simulated walks, each of a setting, a seed and its sources, which may err as `conditions.measured` has it."""
    for setting, seed, *sources in cases:
        walk = walk_of(setting, seed)
        yield scored(BenchWalk(measured(walk, sources), walk.truth))


walk_of = cache(simulated_walk)


def on_beacons(data):
    """Museum logs with their beacons and receivers, and simulated walks with a wrong list."""
    yield from (scored(walk) for walk in walks_given(data, "ipin2023", "recorded").values())
    yield from simulated((INDOORS, 4, "start", "beacons: a pair swapped"), (INDOORS, 5, "GNSS", "beacons: one moved"))


def on_ranges(data):
    """Simulated walks with ranges to anchors, a fifth of them without line of sight."""
    yield from simulated(*((OUTDOORS, seed, "start", "ranges") for seed in range(4)))


def on_velocities(data):
    """Simulated walks with the velocities of a network, which is wrong on some of them."""
    wrong = "", ": turned for 20 s", ": of another walk", ": half"
    yield from simulated(*((OUTDOORS, n, "start", "end", f"network{lie}") for n, lie in enumerate(wrong)))


def on_lies(data):
    """Simulated walks with a source that errs, each beside another."""
    yield from simulated(
        (OUTDOORS, 0, "GNSS: 20 m off from half-way on", "user fixes"),
        (OUTDOORS, 1, "GNSS and speed: not following", "user fixes"),
        (OUTDOORS, 2, "GNSS: 3 times as sure", "compass"),
        (OUTDOORS, 3, "user fixes: of two people"),
        (INDOORS, 4, "start", "beacons: a pair swapped"),
        (INDOORS, 5, "GNSS", "beacons: of another building"),
        (INDOORS, 6, "user fixes", "plan: 5 m shifted"),
    )


ON_PLANS = "WALLS", "REGIONS", "SEARCH", "PARTICLES"
SLOW = *ON_PLANS, "FIXES", "BEACONS", "RANGES", "LEARNED", "PRICES", "DOUBTS"  # tables whose measurement takes minutes
CASES = {
    by_steps: (
        "STEP",
        "CANDIDATE",
        "BOUT",
        "STRIDES",
        "IRREGULARITY",
        "FORWARD",
        "GRIP",
        "COMPASS",
        "REST",
        "MAGNETOMETER",
        "NORTH",
        "CONFIDENCE",
    ),
    on_fixes: ("MOTION", "WALKER"),
    on_outliers: ("LOSSES", "INITIAL", "FIXES"),
    on_beacons: ("BEACONS",),
    on_ranges: ("RANGES",),
    on_velocities: ("LEARNED",),
    on_lies: ("PRICES", "DOUBTS"),
    lambda data: on_fixes(data, "filter"): ("KALMAN",),
    on_plans: ON_PLANS,
    on_receivers: ("RECEIVERS",),
}


QUICK = [name for of in CASES.values() for name in of if name not in SLOW]


def score(case, data):
    """CE50, CE95 [m], the share inside the 90 % region [%], and the sum of all errors [m], the same to the last digit
    where a number is not used; NaN where a walk cannot be estimated.
    """
    try:
        found = list(case(data))
    except Exception as error:  # an impossible number may fail anywhere
        print(f"    {type(error).__name__}: {error}", file=sys.stderr)
        return np.full(4, np.nan)
    errors, inside = (np.concatenate([one[k] for one in found]) for k in (0, 1))
    return np.array([*np.percentile(errors, [50, 95]), 100 * inside.mean(), errors.sum()])


def scaled(value, factor):
    """A value times a factor, of its own type."""
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def is_same(before, after):
    change = np.abs(after - before)[:3] / np.array([before[0], before[1], 1.0])
    return bool(np.all(change <= SAME))


def rows_of(name, data):
    """Rows of the table ``name`` by number: its cells from `halved` on, and the range."""
    case = next(case for case, of in CASES.items() if name in of)
    instance, before = tables()[name], score(case, data)
    print(f"{name}: {before[0]:.2f} / {before[1]:.2f} m, {before[2]:.0f} % inside", file=sys.stderr, flush=True)
    for entry in entries():
        if entry.table == name:
            after = []
            for factor in (0.5, 2.0):
                with changed(instance, **{entry.name: scaled(entry.value, factor)}):
                    after.append(score(case, data))
            if all(one[3] == before[3] for one in after):
                yield entry, [UNUSED, UNUSED], None
                continue
            same = [is_same(before, one) for one in after]
            ends = tuple(f if s else 1 for f, s in zip((0.5, 2), same, strict=True))
            cells = [change(before, one) for one in after]
            print(f"  {entry}", *cells, ends, file=sys.stderr, flush=True)
            yield entry, cells, ends


def change(before, after):
    """Change of CE95 [m]."""
    return "fails" if np.isnan(after).any() else f"{after[1] - before[1]:+.2f}"


def settings(data, names=()):
    """The page's tables, with the figures of the tables ``names``, by default of all that have a case."""
    figures, ranges = kept(), {}
    for name in names or [name for of in CASES.values() for name in of]:
        for entry, cells, ends in rows_of(name, data):
            figures[str(entry)], ranges[str(entry)] = cells, ends
    if "--write" in sys.argv:
        write_ranges(ranges)
    sensitive, others = [], {}
    for entry in entries():
        cells, still = figures.get(str(entry), ["", ""]), ranges.get(str(entry)) or entry.still
        if UNUSED in cells or still in (None, (0.5, 2)):
            kind = 1 if UNUSED in cells else 2 if still is None else 0
            others.setdefault(entry.table, ([], [], []))[kind].append(f"`{entry.name}`")
        else:
            within = " to ".join(shown(scaled(entry.value, factor)) for factor in still)
            sensitive.append([f"`{entry}`", f"{shown(entry.value)} {entry.unit}", entry.source, *cells, within])
    rows = [[f"`{name}`", *map(" ".join, of)] for name, of in others.items()]
    text = f"{table(HEADER, sensitive)}\n\n{table(['table', *KINDS], rows)}"
    publish("results/settings.md", "settings", text.replace("|a|", "abs a"), ", ".join(names))


def kept():
    """Cells of the page as it is, by number; `UNUSED` twice where it is in that column."""
    sensitive, others = published("results/settings.md", "settings")
    figures = {row["number"].strip("`"): list(row.values())[3:5] for row in sensitive}
    for row in others:
        for name in re.findall(r"`(\w+)`", row[UNUSED]):
            figures[f"{row['table'].strip('`')}.{name}"] = [UNUSED, UNUSED]
    return figures


def shown(value):
    """A number or several, in three digits."""
    if isinstance(value, tuple):
        return ", ".join(map(shown, value))
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def write_ranges(ranges):
    """Put the factors ``{"TABLE.name": (least, most)}`` into priors.py, as the argument ``still`` of `number`."""
    path = Path(priors.__file__)
    text = path.read_text(encoding="utf-8")
    lines, classes = text.encode().splitlines(keepends=True), {type(t).__name__: name for name, t in tables().items()}
    places = [
        (node.value, ranges[name])
        for table_class in ast.parse(text).body
        if isinstance(table_class, ast.ClassDef) and table_class.name in classes
        for node in table_class.body
        if isinstance(node, ast.AnnAssign) and ranges.get(name := f"{classes[table_class.name]}.{node.target.id}")
    ]
    for call, ends in reversed(places):
        before, last = call.args[-1], [*call.args, *(old.value for old in call.keywords)][-1]
        row, column = before.end_lineno - 1, before.end_col_offset
        tail = lines[last.end_lineno - 1][last.end_col_offset :]
        lines[row : last.end_lineno] = [lines[row][:column] + f", still={ends}".encode() + tail]
    path.write_bytes(b"".join(lines))
