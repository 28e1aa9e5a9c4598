"""Walks with no waypoint given, only what other walks of the floor heard: for docs/results/fingerprints.md."""

import numpy as np
from recorded import WAYPOINT_NOISE, gaps
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, magnetic_headings, smooth
from pdr_graph.apps.report.evaluation import REGION_90
from pdr_graph.estimation.fingerprinting import RadioMap
from pdr_graph.gait.steps import gait_signals
from pdr_graph.geometry import interpolate, nearest
from pdr_graph.io.loading import load
from pdr_graph.priors import SCANS
from pdr_graph.types import Fixes

SIGMA = 0.5  # [m] stated of a waypoint that is given to a walk of the map
METHODS = ("fingerprints: nearest in time", "fingerprints: straight lines between", "graph", "graph with the plan")


def percentiles(errors):
    return [f"{p:.2f}" for p in np.percentile(errors, [50, 75, 95])]


def observed(folder):
    """The walks of a floor: recording, steps, headings, and the walk smoothed with all its waypoints and the plan."""
    floor, walks = FloorPlan.load(folder), []
    for path in sorted(folder.glob("*.txt")):
        walk = load(path)
        gaits, truth = gait_signals(walk), walk.truth
        steps, headings = detect_steps(gaits), magnetic_headings(gaits, floor.frame, np.zeros(2))
        given = Fixes(truth.time, truth.position, np.full(len(truth), SIGMA), ("",) * len(truth))
        track = smooth(WalkGraph(steps, given, headings=headings, floor=floor)).trajectory
        walks.append((path.stem, walk, steps, headings, track))
    return floor, walks


def four_ways(walk, steps, headings, floor, fixes):
    """Errors [m] at the waypoints and whether they are in the 90 % region, by method."""
    truth = walk.truth
    lines = interpolate(truth.time, fixes.time, fixes.position)
    stays = fixes.position[nearest(fixes.time, truth.time)]
    yield from ((np.hypot(*(at - truth.position).T), None) for at in (stays, lines))
    for plan in (None, floor):
        track = smooth(WalkGraph(steps, fixes, headings=headings, floor=plan)).trajectory
        yield gaps(track, truth, WAYPOINT_NOISE)[:2]


def of_floor(folder):
    """Rows of one floor: each walk with a map of the others; each fix's error as a share of its own sigma, before it
    is widened for what it shares with its neighbours.
    """
    floor, walks = observed(folder)
    rows, results, shares = [], [], []
    for name, walk, steps, headings, track in walks:
        others = [(t, w) for other, w, _, _, t in walks if other != name]
        row = [f"{folder.name} {name[:12]}…", len(walk.truth)]
        fixes = RadioMap.learn(others).fixes(walk) if others else Fixes.none()
        if not len(fixes):
            rows.append([*row, 0 if others else "no other walk", *["—"] * 6])
            continue
        errors = fixes.position - interpolate(fixes.time, track.time, track.position)
        shares.append(SCANS.shared * errors / fixes.sigma[:, None])
        found = list(four_ways(walk, steps, headings, floor, fixes))
        results.append(found)
        medians = [f"{np.median(errors):.2f}" for errors, _ in found]
        rows.append(
            [*row, len(fixes), f"{np.median(fixes.sigma) / SCANS.shared:.1f}", f"{rms(shares[-1]):.2f}", *medians]
        )
    return rows, results, shares


def rms(values):
    return np.sqrt(np.mean(values**2))


def fingerprints(data):
    """Each walk of site 1 with no waypoint, and a radio map of the floor's other walks."""
    floors = [of_floor(data / "ms_indoor20" / "site1" / name) for name in ("B1", "F1", "F2")]
    results, shares = [r for _, found, _ in floors for r in found], np.concatenate([s for *_, f in floors for s in f])
    rows = []
    for n, method in enumerate(METHODS):
        errors = np.concatenate([found[n][0] for found in results])
        within = [found[n][1] for found in results]
        coverage = "—" if within[0] is None else f"{100 * np.concatenate(within).mean():.0f} %"
        rows.append([method, len(errors), *percentiles(errors), coverage])
    header = ["walks with fixes, no waypoint given", "waypoints", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 % region"]
    one, ninety = (np.abs(shares) < 1).mean(), ((shares**2).sum(axis=1) < REGION_90).mean()
    said = f"Of {len(shares)} fixes {100 * one:.0f} % are, per axis, within their own sigma of the walk smoothed with"
    said += f" its waypoints (68 % if normal), {100 * ninety:.0f} % in their 90 % region; rms {rms(shares):.2f} sigma."
    by_walk = ["walk", "waypoints", "fixes", "their sigma [m]", "error / sigma (rms)"]
    by_walk += ["nearest [m]", "lines [m]", "graph [m]", "with the plan [m]"]
    parts = [table(header, rows), said, table(by_walk, [row for found, _, _ in floors for row in found])]
    publish("results/fingerprints.md", "fingerprints", "\n\n".join(parts))
