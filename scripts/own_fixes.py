"""Walks that came with their own fixes, a table each of docs/results/: IPIN21's eight, and phones with GNSS."""

from recorded import coverage, fixes_as_track, ipin21_walks, ipin2023_walks, nju_walks, percentiles
from tables import publish, table

from pdr_graph import WalkGraph, smooth
from pdr_graph.apps.report.evaluation import circular_error, pair


def ipin21(data):
    """The figure of eight, without and with the plan's walls."""
    rows = []
    for walk in ipin21_walks(data):
        fixes, truth, floor = walk.fixes, walk.truth, walk.floor
        own = percentiles(circular_error(pair(truth, fixes_as_track(fixes)))) if len(fixes) > 1 else "—"
        cells = [walk.name, own]
        for plan in (None, floor):
            track = smooth(WalkGraph(walk.steps, fixes, headings=walk.headings, floor=plan)).trajectory
            crossing = 100 * floor.crosses_wall(track.position[:-1], track.position[1:]).mean()
            cells += [percentiles(circular_error(pair(track, truth))), coverage(track, truth), f"{crossing:.0f} %"]
        rows.append(cells)
    header = ["fixes", "their own error [m]", "graph [m]", "in 90 %", "cross", "with map [m]", "in 90 %", "cross"]
    publish("results/ipin21.md", "ipin21", table(header, rows))


def gnss(data):
    """Phones with their own GNSS: a museum's landmarks, and a campus walk of which most positions were withheld."""
    rows = []
    for walk in ipin2023_walks(data):
        own = percentiles(circular_error(pair(fixes_as_track(walk.fixes), walk.truth)))
        for given, beside in (("GNSS", None), ("GNSS, beacons", walk.levels)):
            track = smooth(WalkGraph(walk.steps, walk.fixes, headings=walk.headings, levels=beside)).trajectory
            errors = percentiles(circular_error(pair(track, walk.truth)))
            rows.append([walk.name, given, own, errors, coverage(track, walk.truth)])
    for walk in nju_walks(data):
        between = percentiles(circular_error(pair(fixes_as_track(walk.fixes), walk.truth)))
        track = smooth(WalkGraph(walk.steps, walk.fixes, headings=walk.headings)).trajectory
        errors = percentiles(circular_error(pair(track, walk.truth)))
        rows.append(["NJU campus", walk.name, between, errors, coverage(track, walk.truth)])
    header = ["walk", "given", "straight lines between fixes [m]", "graph [m]", "in 90 %"]
    publish("results/gnss.md", "gnss", table(header, rows))
