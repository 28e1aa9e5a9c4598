"""Real recordings with a reference: Microsoft's fifteen walks by method, and every recording by every method."""

import subprocess
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from shutil import copytree
from tempfile import TemporaryDirectory

import numpy as np
from conditions import (
    HELP,
    WAYPOINT_NOISE,
    errors_at,
    fixes_as_track,
    gaps,
    graph_of,
    helped,
    ipin21_landmarks,
    microsoft_walks,
    nju_walk,
    withheld,
)
from live import campus, eight, followed, mall, museum, on_campus
from tables import publish, table

from pdr_graph import WalkGraph, kalman_filter, kalman_smoother, smooth
from pdr_graph.apps.bench.matrix import percentiles_with_interval
from pdr_graph.apps.report.evaluation import circular_error, pair

MICROSOFT_METHODS = {
    "straight lines": lambda walk: fixes_as_track(walk.fixes),
    "dead reckoning": lambda walk: smooth(WalkGraph(walk.steps, walk.fixes)).dead_reckoning,
    "filter (causal)": lambda walk: kalman_filter(graph_of(walk)).trajectory,
    "filter, smoothed (RTS)": lambda walk: kalman_smoother(graph_of(walk)).trajectory,
    "graph": lambda walk: smooth(graph_of(walk)).trajectory,
    "graph with map": lambda walk: smooth(graph_of(walk, floor=walk.floor)).trajectory,
}
PDR, LAID, FILTER, ONLINE, GRAPH = METHODS = "PDR", "PDR, rigidly aligned", "filter", "graph online", "graph"
COMPARED = [(GRAPH, PDR), (GRAPH, LAID), (GRAPH, FILTER), (GRAPH, ONLINE), (ONLINE, LAID), (ONLINE, FILTER)]
MALLS = "Microsoft, 15 walks"
MUSEUM, EIGHT, CAMPUS = "IPIN 2023, 3 trials", "IPIN21, eight", "NJU campus"
MINUTE = 60  # positions at 1 Hz that NJU's students were given
WORSE = 1.1  # times another method's mean error, from where the graph is called worse
IN_SHORT = (
    (MALLS, "first only, plan"),
    (MALLS, "first and last"),
    (MALLS, "first and last, plan"),
    (MALLS, "every second waypoint"),
    (MALLS, "every second waypoint, plan"),
    (MUSEUM, "GNSS"),
    (MUSEUM, "GNSS, beacons"),
    (EIGHT, "simulated fixes"),
    (EIGHT, "simulated fixes, plan"),
    (CAMPUS, "GPS, one in 10 to 120 s"),
)


def withheld_errors(walk, method):
    """Errors [m] at the waypoints that were not given, whether each is inside its 90 % region, and wall crossings."""
    track = method(walk)
    inside = np.empty(0, dtype=bool)
    if track.covariance is not None:
        _, inside, _ = gaps(track, walk.truth, WAYPOINT_NOISE)
    crossings = walk.floor.crosses_wall(track.position[:-1], track.position[1:]).mean()
    return circular_error(pair(track, walk.truth)), inside, crossings


def microsoft(data):
    """CE at waypoints that were not given, by method and by what was given."""
    rows = []
    for given, walks in microsoft_walks(data):
        for name, method in MICROSOFT_METHODS.items():
            if given == "first only" and name == "straight lines":
                continue
            results = [withheld_errors(walk, method) for walk in walks]
            errors, inside = [r[0] for r in results], np.concatenate([r[1] for r in results])
            crossing = np.mean([r[2] for r in results])
            coverage = f"{100 * inside.mean():.0f} %" if len(inside) else "—"
            rows.append([given, name, *percentiles_with_interval(errors), coverage, f"{100 * crossing:.1f} %"])
    header = ["given", "method", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 % region", "rows that cross a wall"]
    publish("results/microsoft.md", "microsoft", table(header, rows))


@dataclass(frozen=True)
class Row:
    """A recording with one kind of help.

    group, help: what it is pooled by; errors: by method at each place [m], NaN where it had no pose yet; inside: of
    each place, whether it lies in the graph's 90 % region.
    """

    group: str
    help: str
    recording: str
    given: str
    errors: dict
    inside: np.ndarray

    @property
    def inside_share(self):
        return f"{100 * self.inside.mean():.0f} %"

    def said(self, method, at):
        """Percentiles of a method's errors."""
        known = self.errors[method][~np.isnan(self.errors[method])]
        return " / ".join(f"{p:.2f}" for p in np.percentile(known, at)) if len(known) else "no pose yet"


def every_recording(data):
    """The table in short, and where another method is better than the graph."""
    rows = [scored(*one) for one in cases(data)]
    header = ["recordings", "given", *(f"{m} [m]" for m in METHODS[1:]), "in 90 %"]
    publish("results/recordings.md", "summary", table(header, in_short(rows)))
    publish("results/recordings.md", "out of order", out_of_order(rows))


def in_short(rows):
    """Median and 95 % of whole groups, with what is given most."""
    for row in pooled(rows):
        if (row.group, row.help) in IN_SHORT:
            told = [row.said(method, (50, 95)) for method in METHODS[1:]]
            yield [row.group, row.help, *told, row.inside_share]


def cases(data):
    """Group, help and case of all that has places to score an estimate at."""
    for given in HELP:
        for plan in (False, True):
            yield from ((MALLS, case.given, case.walk.name, case) for case in mall(data, given, plan))
    for case in museum(data):
        yield MUSEUM, case.given, case.name, case
        if case.given == "GNSS":
            yield from ((MUSEUM, one.given, one.name, one) for one in by_places(case, np.arange(len(case.walk.truth))))
    for case in eight(data):
        alone = case.given.startswith("the start, alone")
        yield EIGHT, case.given if alone else f"simulated fixes{', plan' * (case.plan is not None)}", case.name, case
        if alone:
            places = ipin21_landmarks(data, case.walk.truth)
            yield from ((EIGHT, one.given, one.name, one) for one in by_places(case, places) if "only" not in one.given)
    for case in campus(data):
        yield CAMPUS, "GPS, one in 10 to 120 s", case.name, case
    for given, which in (("the first minute", slice(MINUTE)), ("first and last", [0, -1])):
        yield CAMPUS, given, CAMPUS, on_campus(data, withheld(nju_walk(data), given, which))


def by_places(case, places):
    """A case by some of the places of its truth instead of its own positions and beacons."""
    for given, choose in HELP.items():
        said = given.replace("waypoint", "landmark") + ", plan" * (case.plan is not None)
        walk = helped(case.walk, places[choose(case.walk.truth[places])])
        yield replace(case, given=said, walk=walk, beacons=None)


def scored(group, help_, recording, case):
    """A case by all methods."""
    walk = case.walk
    graph = graph_of(walk, levels=walk.levels, floor=case.plan)
    tracks = offline(graph, smooth(graph)) | {ONLINE: followed(case).causal}
    return row(group, help_, recording, case.given, tracks, walk.truth, case.noise)


def offline(graph, estimate):
    """Tracks by all methods but the live one."""
    alone = WalkGraph(graph.steps, graph.fixes[:1])
    return {
        PDR: smooth(alone).trajectory,
        LAID: estimate.dead_reckoning,
        FILTER: kalman_filter(graph).trajectory,
        GRAPH: estimate.trajectory,
    }


def row(group, help_, recording, given, tracks, truth, noise):
    """Tracks scored at a truth."""
    errors = {method: errors_at(track, truth) for method, track in tracks.items()}
    return Row(group, help_, recording, given, errors, gaps(tracks[GRAPH], truth, noise)[1])


def pooled(rows):
    """All recordings of a group with one kind of help as one row."""
    together = defaultdict(list)
    for one in rows:
        together[one.group, one.help].append(one)
    for (group, help_), alike in together.items():
        errors = {m: np.concatenate([one.errors[m] for one in alike]) for m in METHODS if m in alike[0].errors}
        yield Row(group, help_, group, help_, errors, np.concatenate([one.inside for one in alike]))


def out_of_order(rows):
    """How often one method is better than another, and the rows where the graph is worse than one by a tenth."""
    lines, worse = [], []
    for method, other in COMPARED:
        both = [(one, *means(one, method, other)) for one in rows if {method, other} <= set(one.errors)]
        both = [(one, own, its) for one, own, its in both if not np.isnan(own)]
        found = [(one, own, its) for one, own, its in both if own > WORSE * its]
        lines.append([method, other, len(both), sum(own < its for _, own, its in both), len(found)])
        worse += [
            [one.recording, one.given, len(one.inside), f"{other}: {its:.2f}", f"{own:.2f}"]
            for one, own, its in found
            if method == GRAPH
        ]
    counts = table(["", "beside", "rows", "its mean is smaller", f"larger by {WORSE - 1:.0%} and more"], lines)
    return f"{counts}\n\n{table(['recording', 'given', 'places', 'better [m]', 'graph [m]'], worse)}"


def means(row, *methods):
    """Mean errors at the places where all have one. [m]"""
    errors = np.array([row.errors[method] for method in methods])
    known = ~np.isnan(errors).any(axis=0)
    return errors[:, known].mean(axis=1) if known.any() else np.full(len(methods), np.nan)


def strangers(data):
    """What the commands say of each input after a public report, beside the right value that its README states."""
    rows = []
    for page in sorted(data.glob("found/*/README.md")):
        stated = dict(line.split(": ", 1) for line in page.read_text().splitlines() if ": " in line)
        with TemporaryDirectory() as folder:
            copytree(page.parent, folder, dirs_exist_ok=True)
            command = f'pdr-graph() {{ "{sys.executable}" -m pdr_graph "$@"; }}; {stated["command"].split("     (")[0]}'
            done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True)
        lines = (done.stdout + done.stderr).splitlines()
        said = [line for line in lines if line.startswith(("ok", "doubtful", "failed"))] or [
            n for n in lines if ":" in n
        ]
        found = "; ".join(line.replace("|", "/") for line in said[:3])
        rows.append([page.parent.name, f"{found[:160]} (exit {done.returncode})", stated["expected"].replace("|", "/")])
    publish("results/strangers.md", "strangers", table(["input", "found", "right"], rows))
