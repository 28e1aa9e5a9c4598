"""Accuracy on walks that came with their own fixes, for docs/accuracy.md."""

import numpy as np
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, io, magnetic_headings, read_fixes, smooth
from pdr_graph.estimation.beacons import levels
from pdr_graph.evaluation import circular_error, pair
from pdr_graph.frames import enu
from pdr_graph.gait.gait import gait_of
from pdr_graph.io.beacons import read_beacons
from pdr_graph.types import Fixes, Trajectory

START_SIGMA = 0.3  # [m] stated of IPIN21's known start


def percentiles(errors):
    return " / ".join(f"{p:.2f}" for p in np.percentile(errors, [50, 75, 95]))


def coverage(track, truth):
    """How often the truth lies in the stated 90 % region."""
    pairs = pair(track, truth)
    parts = track.covariance[:, :2, :2].reshape(-1, 4).T
    covariance = np.stack([np.interp(pairs.time, track.time, v) for v in parts], 1).reshape(-1, 2, 2)
    gap = pairs.estimate - pairs.truth
    inside = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(covariance), gap) < 4.605
    return f"{100 * inside.mean():.0f} %"


def fixes_as_track(fixes):
    return Trajectory(fixes.time, fixes.position, np.zeros(len(fixes)), fixes.floor)


def ipin21(data):
    """The figure of eight with each set of simulated fixes, without and with the plan's walls."""
    folder = data / "ipin21_hcu"
    walk, floor = io.load(folder / "eight"), FloorPlan.load(folder / "map" / "Plan4OG.geojson")
    gaits, truth, rows = gait_of(walk), floor.frame.place(walk.truth), []
    steps = detect_steps(gaits)
    paths = sorted(folder.rglob("*_err*.csv"), key=lambda p: p.stem.lower())
    start = Fixes(truth.time[:1], truth.position[:1], np.array([START_SIGMA]), ("",))
    sets = [("the start, alone", start), *((path.stem, read_fixes(path, walk, floor.frame)) for path in paths)]
    for name, fixes in sets:
        own = percentiles(circular_error(pair(truth, fixes_as_track(fixes)))) if len(fixes) > 1 else "—"
        cells = [name, own]
        headings = magnetic_headings(gaits, floor.frame, fixes.position[0])
        for plan in (None, floor):
            track = smooth(WalkGraph(steps, fixes, headings=headings, floor=plan)).trajectory
            crossing = 100 * floor.crosses_wall(track.position[:-1], track.position[1:]).mean()
            cells += [percentiles(circular_error(pair(track, truth))), coverage(track, truth), f"{crossing:.0f} %"]
        rows.append(cells)
    header = ["fixes", "their own error [m]", "graph [m]", "in 90 %", "cross", "with map [m]", "in 90 %", "cross"]
    publish("accuracy.md", "ipin21", table(header, rows))


def gnss(data):
    """Phones with their own GNSS: a museum's landmarks, and a campus walk of which most positions were withheld."""
    rows = []
    for path in sorted((data / "ipin2023_track3").glob("*Trial*.txt")):
        walk = io.load(path)
        lon, lat = walk.fixes.position[0]
        frame = enu(lat, lon)
        truth, fixes = frame.place(walk.truth), frame.place(walk.fixes)
        gaits = gait_of(walk)
        headings = magnetic_headings(gaits, frame, fixes.position[0])
        steps, own = detect_steps(gaits), percentiles(circular_error(pair(fixes_as_track(fixes), truth)))
        beacons = frame.place(read_beacons(path.parent / "BLE_Locations.csv", walk))
        heard = levels(walk.bluetooth, beacons, steps)
        for given, beside in (("GNSS", None), ("GNSS, beacons", heard)):
            track = smooth(WalkGraph(steps, fixes, headings=headings, levels=beside)).trajectory
            cells = [percentiles(circular_error(pair(track, truth))), coverage(track, truth)]
            rows.append([path.stem, given, own, *cells])
    walk = io.load(data / "nju_phyphox_outdoor")
    lon, lat = walk.fixes.position[0]
    frame = enu(lat, lon)
    fixes = frame.place(walk.fixes)
    gaits = gait_of(walk)
    steps, headings = detect_steps(gaits), magnetic_headings(gaits, frame, fixes.position[0])
    for every in (10, 30, 60, 120):
        given = np.arange(0, len(fixes), every)
        rest = fixes_as_track(fixes[np.setdiff1d(np.arange(len(fixes)), given)])
        between = percentiles(circular_error(pair(fixes_as_track(fixes[given]), rest)))
        track = smooth(WalkGraph(steps, fixes[given], headings=headings)).trajectory
        errors = percentiles(circular_error(pair(track, rest)))
        rows.append(["NJU campus", f"one in {every} s", between, errors, coverage(track, rest)])
    header = ["walk", "given", "straight lines between fixes [m]", "graph [m]", "in 90 %"]
    publish("accuracy.md", "gnss", table(header, rows))
