"""Real recordings with a reference: Microsoft's fifteen walks by method, and every recording by every method.

The rows are those of ``pdr-graph bench``.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from shutil import copytree
from tempfile import TemporaryDirectory

import numpy as np
from live import GNSS, HELP, THINNED
from tables import publish, table

from pdr_graph import WalkGraph, smooth
from pdr_graph.apps.bench.matrix import Matrix, statistics
from pdr_graph.types import Trajectory


def straight(evidence):
    """Straight lines between the fixes."""
    fixes = evidence.fixes
    return Trajectory(fixes.time, fixes.position, np.zeros(len(fixes)))


def aligned(evidence):
    """Dead reckoning, rigidly aligned with all fixes."""
    return smooth(WalkGraph(evidence.steps, evidence.fixes)).dead_reckoning


def rows_of(data, of, given, methods, only=()):
    """The rows that ``pdr-graph bench`` makes of a data set."""
    with TemporaryDirectory() as out:
        matrix = Matrix(Path(out), (of,), methods, given, data, Path(out))
        rows = list(matrix.rows(matrix.missing(only)))
    if failed := [row for row in rows if "failed" in row]:
        raise SystemExit(f"a row failed: {failed[0]}")
    return rows


METHODS = {
    "straight lines": "recordings:straight",
    "dead reckoning": "recordings:aligned",
    "filter (causal)": "filter",
    "filter, smoothed (RTS)": "rts",
    "graph": "graph",
}


def microsoft(data):
    """CE at waypoints that were not given, by method and by what was given."""
    rows = rows_of(data, "microsoft", tuple(HELP), tuple(METHODS.values()))
    rows += rows_of(data, "microsoft", tuple(f"{what}, plan" for what in HELP), ("particles", "graph"))
    lines, cells = [], {tuple(line[1:3]): line for line in statistics(rows)}
    for what, given in HELP.items():
        for name, method in METHODS.items():
            if (what, name) != ("first", "straight lines"):
                lines.append([given, name, *cells[what, method][6:11]])
        for name, method in {"particles with map": "particles", "graph with map": "graph"}.items():
            lines.append([given, name, *cells[f"{what}, plan", method][6:11]])
    header = ["given", "method", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 % region", "rows that cross a wall"]
    publish("results/microsoft.md", "microsoft", table(header, lines))


PDR, LAID, FILTER, ONLINE, GRAPH = NAMES = "PDR", "PDR, rigidly aligned", "filter", "graph online", "graph"
BY_NAME = dict(zip(NAMES, ("pdr", "recordings:aligned", "filter", "live", "graph"), strict=True))
COMPARED = [(GRAPH, PDR), (GRAPH, LAID), (GRAPH, FILTER), (GRAPH, ONLINE), (ONLINE, LAID), (ONLINE, FILTER)]
WORSE = 1.1  # times another method's mean error, from where the graph is called worse
ON_PLANS = {what + plan: name + plan for what, name in HELP.items() for plan in ("", ", plan")}
LANDMARKS = {what: name.replace("waypoint", "landmark") for what, name in ON_PLANS.items()}
MALLS, MUSEUM, EIGHT, CAMPUS = "Microsoft, 15 walks", "IPIN 2023, 3 trials", "IPIN21, eight", "NJU campus"
CASES = [  # in the summary, or not; group, data set, text in the names of its rows, what is given and the tables' word
    (True, MALLS, "microsoft", "", {what: name for what, name in ON_PLANS.items() if what != "first"}),
    (False, MALLS, "microsoft", "", {"first": "first only"}),
    (True, MUSEUM, "ipin2023", "", GNSS),
    (False, MUSEUM, "ipin2023", "", LANDMARKS),
    (True, EIGHT, "ipin21", "_err", {f"recorded{plan}": f"simulated fixes{plan}" for plan in ("", ", plan")}),
    (False, EIGHT, "ipin21", "| landmarks |", LANDMARKS),
    (True, CAMPUS, "nju", "", dict.fromkeys(THINNED, "GPS, one in 10 to 120 s")),
    (False, CAMPUS, "nju", "", {"first 60 s": "the first minute", "first and last": "first and last"}),
]


@dataclass(frozen=True)
class Case:
    """A recording with what it is given, as the tables call it; errors: by method at each place [m], NaN where it had
    no pose; inside: 1 where the graph's 90 % region has the place; short: in the summary.
    """

    short: bool
    group: str
    given: str
    recording: str
    errors: dict
    inside: np.ndarray


def every_recording(data):
    """The table in short, and where another method is better than the graph."""
    cases = [case for each in CASES for case in cases_of(data, *each)]
    header = ["recordings", "given", *(f"{m} [m]" for m in NAMES[1:]), "in 90 %"]
    publish("results/recordings.md", "summary", table(header, in_short(cases)))
    publish("results/recordings.md", "out of order", out_of_order(cases))


def cases_of(data, short, group, of, only, given):
    """The recordings of a data set by all methods."""
    found = {}
    for row in rows_of(data, of, tuple(given), tuple(BY_NAME.values()), (only,)):
        found.setdefault((row["walk"], row["given"]), {})[row["method"]] = row
    for (walk, what), rows in found.items():
        errors = {name: np.array(rows[method]["errors"], dtype=float) for name, method in BY_NAME.items()}
        yield Case(short, group, given[what], walk, errors, np.array(rows["graph"]["inside"], dtype=float))


def in_short(cases):
    """Median and 95 % of whole groups, with what is given most."""
    together = {}
    for case in cases:
        if case.short:
            together.setdefault((case.group, case.given), []).append(case)
    for names, alike in together.items():
        errors = [np.concatenate([case.errors[name] for case in alike]) for name in NAMES[1:]]
        said = [" / ".join(f"{p:.2f}" for p in np.nanpercentile(each, (50, 95))) for each in errors]
        yield [*names, *said, f"{100 * np.nanmean(np.concatenate([case.inside for case in alike])):.0f} %"]


def out_of_order(cases):
    """How often one method is better than another, and the rows where the graph is worse than one by a tenth."""
    lines, worse = [], []
    for method, other in COMPARED:
        both = [(case, *means(case, method, other)) for case in cases]
        both = [(case, own, its) for case, own, its in both if not np.isnan(own)]
        found = [(case, own, its) for case, own, its in both if own > WORSE * its]
        lines.append([method, other, len(both), sum(own < its for _, own, its in both), len(found)])
        worse += [
            [case.recording, case.given, len(case.inside), f"{other}: {its:.2f}", f"{own:.2f}"]
            for case, own, its in found
            if method == GRAPH
        ]
    counts = table(["", "beside", "rows", "its mean is smaller", f"larger by {WORSE - 1:.0%} and more"], lines)
    return f"{counts}\n\n{table(['recording', 'given', 'places', 'better [m]', 'graph [m]'], worse)}"


def means(case, *methods):
    """Mean errors at the places where all have one. [m]"""
    errors = np.array([case.errors[method] for method in methods])
    known = ~np.isnan(errors).any(axis=0)
    return errors[:, known].mean(axis=1) if known.any() else np.full(len(methods), np.nan)


def strangers(data):
    """What the commands say of each input after a public report, beside the right value that its README states."""
    rows = []
    for page in sorted(data.glob("found/*/README.md")):
        stated = dict(line.split(": ", 1) for line in page.read_text().splitlines() if ": " in line)
        with TemporaryDirectory() as folder:
            copytree(page.parent, folder, dirs_exist_ok=True)
            command = stated["command"].split("     (")[0]
            command = f'pdr-graph() {{ "{sys.executable}" -m pdr_graph "$@"; }}; {command}'
            done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True)
        lines = (done.stdout + done.stderr).splitlines()
        said = [line for line in lines if line.startswith(("ok", "doubtful", "failed"))] or [
            n for n in lines if ":" in n
        ]
        found = "; ".join(line.replace("|", "/") for line in said[:3])
        found = f"{found[:160]} (exit {done.returncode})"
        if "syntax error" in done.stderr:  # what a server gets: the tests send it
            found = "not a command of a shell"
        rows.append([page.parent.name, found, stated["expected"].replace("|", "/")])
    publish("results/strangers.md", "strangers", table(["input", "found", "right"], rows))
