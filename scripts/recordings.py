"""Real recordings with a reference: walks in malls by method, and every recording by every method.

The rows are those of ``pdr-graph bench``.
"""

from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from tempfile import gettempdir, mkdtemp

import numpy as np
from live import GNSS, HELP, THINNED
from tables import commit, publish, table

from pdr_graph import WalkGraph, smooth
from pdr_graph.apps.bench.matrix import STATISTICS, WORST, Matrix, key_of, known, statistics, worst
from pdr_graph.apps.lifelog.workers import cores
from pdr_graph.types import Trajectory


def straight(evidence):
    """Straight lines between the fixes."""
    fixes = evidence.fixes
    return Trajectory(fixes.time, fixes.position, np.zeros(len(fixes)))


def aligned(evidence):
    """Dead reckoning, rigidly aligned with all fixes."""
    return smooth(WalkGraph(evidence.steps, evidence.fixes)).dead_reckoning


def rows_of(data, of, given, methods, only=(), words=(), number=None):
    """The rows that ``pdr-graph bench`` makes of a data set, on all cores.

    only: texts that their names have; words: one of these too; number: of walks, evenly spread over the data set; None
    for all. A run of a commit that was interrupted goes on; its rows are removed with the last one.
    """
    clean = "+" not in commit()
    out = Path(gettempdir(), f"pdr-graph-rows-{commit()}-{of}") if clean else Path(mkdtemp())
    matrix = Matrix(out, (of,), methods, given, data, out)
    wanted = [each.name for each in matrix.missing(only, again=True)]
    wanted = [name for name in wanted if not words or any(word in " | ".join(name) for word in words)]
    walks = list(dict.fromkeys(name[1] for name in wanted))
    walks = set(walks[:: max(1, len(walks) // number)][:number] if number else walks)
    wanted = {name for name in wanted if name[1] in walks}
    for _ in matrix.rows([each for each in matrix.missing(only) if each.name in wanted], cores()):
        pass
    rows = [row for row in matrix.results() if key_of(row) in wanted]
    if failed := [row for row in rows if "failed" in row]:
        raise SystemExit("\n".join(f"failed: {' | '.join(key_of(row))}: {row['failed']}" for row in failed))
    rmtree(out)
    return rows


METHODS = {
    "straight lines": "recordings:straight",
    "dead reckoning": "recordings:aligned",
    "filter (causal)": "filter",
    "filter, smoothed (RTS)": "rts",
    "graph": "graph",
}


CELLS = {  # of bench stats, by their names in these tables
    "CE50 [m]": "CE50 [m]",
    "CE75 [m]": "CE75 [m]",
    "CE95 [m]": "CE95 [m]",
    "in 50 %": "in 50 %",
    "in 90 % region": "in 90 %",
    "in 99 %": "in 99 %",
    "log score [nats]": "log score [nats]",
    "energy score [m]": "energy score [m]",
    "walks up to 60 % in 90 %": "walks up to 60 % in 90 %",
}
NAMED = 3  # of the worst walks


PLACES = {
    "5 places, plan": "five places and their times, plan",
    "5 places, plan, no times": "the same in any order, plan",
    "5 places": "five places and their times",
    "5 places, no times": "the same in any order",
}


def places(data, words=(), number=None):
    """CE with five waypoints, drawn at random, with their times and without."""
    rows = rows_of(data, "malls", tuple(PLACES), ("graph",), (), words, number)
    found = {line[1]: dict(zip(STATISTICS, line, strict=True)) for line in statistics(rows)}
    shown = {name: found[what] for what, name in PLACES.items() if what in found}
    lines = [[name, *(cells[column] for column in CELLS.values())] for name, cells in shown.items()]
    publish("results/microsoft.md", "places", table(["given", *CELLS], lines))


def microsoft(data, words=(), number=None, *_):
    """CE at waypoints that were not given, by method and by what was given, and the worst walks with the plan."""
    plans = tuple(f"{what}, plan" for what in HELP)
    rows = rows_of(data, "malls", tuple(HELP), tuple(METHODS.values()), (), words, number)
    rows += rows_of(data, "malls", plans, ("particles", "graph"), (), words, number)
    found = {tuple(line[1:3]): dict(zip(STATISTICS, line, strict=True)) for line in statistics(rows)}
    columns, lines = CELLS | {"rows that cross a wall": "across walls"}, []
    for what, given in HELP.items():
        shown = {name: (what, method) for name, method in METHODS.items()}
        shown |= {f"{name} with map": (f"{what}, plan", name) for name in ("particles", "graph")}
        for name, key in shown.items():
            if key in found and (what, name) != ("first", "straight lines"):
                lines.append([given, name, *(found[key][column] for column in columns.values())])
    far = [row for row in rows if row["given"] in plans and row["method"] == "graph"]
    text = table(["given", "method", *columns], lines)
    publish("results/microsoft.md", "microsoft", f"{text}\n\n{named(far, ON_PLANS)}")
    places(data, words, number)


def named(rows, given):
    """The table of the worst walks of each group. given: its names."""
    lines = [[given[what], walk, *rest] for _, what, _, walk, *rest in worst(rows, NAMED)]
    return table(["given", "the worst walks, graph", *WORST[4:]], lines)


PDR, LAID, FILTER, ONLINE, GRAPH = NAMES = "PDR", "PDR, rigidly aligned", "filter", "graph online", "graph"
BY_NAME = dict(zip(NAMES, ("pdr", "recordings:aligned", "filter", "live", "graph"), strict=True))
COMPARED = [(GRAPH, PDR), (GRAPH, LAID), (GRAPH, FILTER), (GRAPH, ONLINE), (ONLINE, LAID), (ONLINE, FILTER)]
WORSE = 1.1  # times another method's mean error, from where the graph is called worse
ON_PLANS = {what + plan: name + plan for what, name in HELP.items() for plan in ("", ", plan")}
LANDMARKS = {what: name.replace("waypoint", "landmark") for what, name in ON_PLANS.items()}
MALLS, MUSEUM, EIGHT, CAMPUS = "malls", "museum", "IPIN21, eight", "NJU campus"
CASES = [  # in the summary, or not; group, data set, text in the names of its rows, what is given and the tables' word
    (True, MALLS, "malls", "", {what: name for what, name in ON_PLANS.items() if what != "first"}),
    (False, MALLS, "malls", "", {"first": "first only"}),
    (True, MUSEUM, "museum", "", GNSS),
    (False, MUSEUM, "museum", "", LANDMARKS),
    (True, EIGHT, "ipin21", "_err", {f"recorded{plan}": f"simulated fixes{plan}" for plan in ("", ", plan")}),
    (False, EIGHT, "ipin21", "| landmarks |", LANDMARKS),
    (True, CAMPUS, "nju", "", dict.fromkeys(THINNED, "GPS, one in 10 to 120 s")),
    (False, CAMPUS, "nju", "", {"first 60 s": "the first minute", "first and last": "first and last"}),
]


@dataclass(frozen=True)
class Case:
    """A recording with what it is given, as the tables call it.

    rows: of the bench, by method; errors: by method at each place [m], NaN where it had no pose; short: in the summary.
    """

    short: bool
    group: str
    given: str
    recording: str
    rows: dict
    errors: dict


def every_recording(data, words=(), number=None, *_):
    """The table in short with the worst museum logs, and where another method is better than the graph."""
    cases = [case for each in CASES for case in cases_of(data, *each, words, number)]
    museum = [case.rows[GRAPH] for case in cases if case.short and case.group == MUSEUM]
    header = ["recordings", "given", "walks", *(f"{m} [m]" for m in NAMES[1:-1])]
    summary = table([*header, *(f"graph: {name}" for name in CELLS)], in_short(cases))
    publish("results/recordings.md", "summary", f"{summary}\n\n{named(museum, GNSS)}")
    publish("results/recordings.md", "out of order", out_of_order(cases))


def cases_of(data, short, group, of, only, given, words, number):
    """The recordings of a data set by all methods."""
    found = {}
    for row in rows_of(data, of, tuple(given), tuple(BY_NAME.values()), (only,), words, number):
        found.setdefault((row["walk"], row["given"]), {})[row["method"]] = row
    for (walk, what), by_method in found.items():
        rows = {name: by_method[method] for name, method in BY_NAME.items()}
        errors = {name: np.array(row["errors"], dtype=float) for name, row in rows.items()}
        yield Case(short, group, given[what], walk, rows, errors)


def in_short(cases):
    """Median and 95 % of whole groups, with what is given most; of the graph also its regions, with intervals."""
    together = {}
    for case in cases:
        if case.short:
            together.setdefault((case.group, case.given), []).append(case)
    for names, alike in together.items():
        errors = [np.concatenate([known(case.rows[name], "errors") for case in alike]) for name in NAMES[1:-1]]
        said = [" / ".join(f"{p:.2f}" for p in np.percentile(each, (50, 95))) for each in errors]
        # as one group, also of several given
        [line] = statistics([case.rows[GRAPH] | {"given": names[1]} for case in alike])
        found = dict(zip(STATISTICS, line, strict=True))
        walks = len({case.recording for case in alike})
        yield [*names, walks, *said, *(found[column] for column in CELLS.values())]


def out_of_order(cases):
    """How often one method is better than another, and of each group the rows where the graph is worse than one by a
    tenth, those with the largest difference.
    """
    lines, worse = [], {}
    for method, other in COMPARED:
        both = [(case, *means(case, method, other)) for case in cases]
        both = [(case, own, its) for case, own, its in both if not np.isnan(own)]
        found = [(case, own, its) for case, own, its in both if own > WORSE * its]
        lines.append([method, other, len(both), sum(own < its for _, own, its in both), len(found)])
        for case, own, its in found:
            if method == GRAPH:
                row = [case.recording, case.given, len(case.errors[GRAPH]), f"{other}: {its:.2f}", f"{own:.2f}"]
                worse.setdefault(case.group, []).append((its - own, row))
    counts = table(["", "beside", "rows", "its mean is smaller", f"larger by {WORSE - 1:.0%} and more"], lines)
    rows = [row for found in worse.values() for _, row in sorted(found, key=lambda pair: pair[0])[:NAMED]]
    return f"{counts}\n\n{table(['recording', 'given', 'places', 'better [m]', 'graph [m]'], rows)}"


def means(case, *methods):
    """Mean errors at the places where all have one. [m]"""
    errors = np.array([case.errors[method] for method in methods])
    known = ~np.isnan(errors).any(axis=0)
    return errors[:, known].mean(axis=1) if known.any() else np.full(len(methods), np.nan)
