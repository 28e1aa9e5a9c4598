"""Real recordings as the back end sees them, what is given of their truth, and how an estimate is scored."""

from dataclasses import dataclass, replace

import numpy as np

from pdr_graph import FloorPlan, detect_steps, magnetic_headings, read_fixes
from pdr_graph.apps.report.evaluation import REGION_90, circular_error, in_region, pair, stated_covariance
from pdr_graph.estimation.factors.beacon_rssi import levels_along
from pdr_graph.estimation.floors import floors_along
from pdr_graph.frames import enu
from pdr_graph.gait.steps import gait_signals
from pdr_graph.inertial.barometer import with_stair_lengths
from pdr_graph.io.loading import load
from pdr_graph.io.tables import read_beacons
from pdr_graph.types import Fixes, Headings, Levels, Steps, Trajectory

SIGMA = 0.5  # [m] stated of a waypoint that is given
START_SIGMA = 0.3  # [m] stated of IPIN21's known start
WAYPOINT_NOISE = 0.66 / np.sqrt(2)  # [m] per axis, of the taps of Microsoft's surveyors


@dataclass(frozen=True)
class Walk:
    """A walk as the front end saw it, what was measured beside it, and its truth."""

    name: str
    steps: Steps
    headings: Headings
    fixes: Fixes
    truth: Trajectory
    floor: FloorPlan | None = None
    levels: Levels | None = None


def percentiles(errors):
    return " / ".join(f"{p:.2f}" for p in np.percentile(errors, [50, 75, 95]))


def errors_at(track, truth):
    """Errors of a track at each place of the truth ``(n,)`` [m]; NaN where it has none."""
    pairs = pair(track, truth)
    errors = np.full(len(truth), np.nan)
    errors[np.isin(truth.time, pairs.time)] = circular_error(pairs)
    return errors


def gaps(track, truth, noise=0.0):
    """Of each place of the truth: distance from the estimate [m], whether it lies in the stated 90 % region, and how
    large that is [m], the radius of a circle of its area. noise: of the truth itself, per axis [m].
    """
    pairs = pair(track, truth)
    covariance = stated_covariance(track, pairs.time) + noise**2 * np.eye(2)
    size = np.sqrt(REGION_90) * np.linalg.det(covariance) ** 0.25
    return circular_error(pairs), in_region(pairs, covariance), size


def coverage(track, truth):
    """How often the truth lies in the stated 90 % region."""
    return f"{100 * gaps(track, truth)[1].mean():.0f} %"


def fixes_as_track(fixes):
    return Trajectory(fixes.time, fixes.position, np.zeros(len(fixes)), fixes.floor)


def given(truth, which):
    """The places ``which`` of a truth as fixes."""
    which = np.unique(np.arange(len(truth))[which])
    return Fixes(truth.time[which], truth.position[which], np.full(len(which), SIGMA), ("",) * len(which))


def rest(truth, which):
    """The others."""
    left = np.setdiff1d(np.arange(len(truth)), np.arange(len(truth))[which])
    return Trajectory(truth.time[left], truth.position[left], truth.heading[left], ("",) * len(left))


def helped(walk, which):
    """A walk that is given some places of its truth and nothing else; the others are left to score it."""
    return replace(walk, fixes=given(walk.truth, which), truth=rest(walk.truth, which), levels=None)


def ipin21_walks(data):
    """The figure of eight with the start alone and with each set of simulated fixes."""
    folder = data / "ipin21_hcu"
    walk, floor = load(folder / "eight"), FloorPlan.load(folder / "map" / "Plan4OG.geojson")
    gaits, truth = gait_signals(walk), floor.frame.place(walk.truth)
    steps = detect_steps(gaits)
    paths = sorted(folder.rglob("*_err*.csv"), key=lambda p: p.stem.lower())
    start = Fixes(truth.time[:1], truth.position[:1], np.array([START_SIGMA]), ("",))
    sets = [("the start, alone", start), *((path.stem, read_fixes(path, walk, floor.frame)) for path in paths)]
    for name, fixes in sets:
        yield Walk(name, steps, magnetic_headings(gaits, floor.frame, fixes.position[0]), fixes, truth, floor)


def ipin21_landmarks(data, truth):
    """The rows of the figure of eight's truth when the walker was at the surveyed places."""
    folder = data / "ipin21_hcu" / "eight"
    at = np.loadtxt(folder / "ref.csv")[:, 0] / 1000 - load(folder).clock_origin
    return np.unique([np.argmin(np.abs(truth.time - t)) for t in at])


def ipin2023_walks(data, relisted=lambda listed: listed):
    """Three walks in a museum with the phone's GNSS, and the beacons that it heard; relisted: changes their list."""
    for path in sorted((data / "ipin2023_track3").glob("*Trial*.txt")):
        walk = load(path)
        lon, lat = walk.fixes.position[0]
        frame = enu(lat, lon)
        gaits, fixes = gait_signals(walk), frame.place(walk.fixes)
        headings, steps = magnetic_headings(gaits, frame, fixes.position[0]), detect_steps(gaits)
        floors = floors_along(steps, walk.barometer, "", fixes, None)
        steps = with_stair_lengths(steps, floors.climbs, floors.kinds)
        listed = relisted(read_beacons(path.parent / "BLE_Locations.csv", walk))
        heard = levels_along(walk.bluetooth, frame.place(listed), steps)
        yield Walk(path.stem, steps, headings, fixes, frame.place(walk.truth), levels=heard)


def nju_walk(data):
    """A campus walk by its GPS, which is its truth as well."""
    walk = load(data / "nju_phyphox_outdoor")
    lon, lat = walk.fixes.position[0]
    frame = enu(lat, lon)
    fixes = frame.place(walk.fixes)
    gaits = gait_signals(walk)
    steps, headings = detect_steps(gaits), magnetic_headings(gaits, frame, fixes.position[0])
    return Walk("one in 1 s", steps, headings, fixes, fixes_as_track(fixes))


def nju_walks(data):
    """The campus walk with most positions withheld: these are its truth."""
    whole = nju_walk(data)
    for every in (10, 30, 60, 120):
        yield withheld(whole, f"one in {every} s", np.arange(0, len(whole.fixes), every))


def withheld(walk, name, which):
    """A walk with the positions ``which`` of its receiver; the others are its truth."""
    others = walk.fixes[np.setdiff1d(np.arange(len(walk.fixes)), np.arange(len(walk.fixes))[which])]
    return replace(walk, name=name, fixes=walk.fixes[which], truth=fixes_as_track(others))
