"""The accuracy tables of docs/accuracy.md, from real recordings in ../shared/data or $PDR_GRAPH_DATA."""

import os
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import calibration_walk
import cart
import compass
import covariance
import fingerprints
import floors as floors_by_step
import gps_outage
import heading
import lifelog_chains
import lifelog_days
import lifelog_visits
import live
import map_matching
import numpy as np
import outliers
import realism
import recorded
import steps
import topology
import wide_places
from tables import publish, table

from pdr_graph import FloorPlan, WalkGraph, detect_steps, io, kalman_filter, kalman_smoother, magnetic_headings, smooth
from pdr_graph.estimation import preintegration
from pdr_graph.estimation.graph import Prior
from pdr_graph.evaluation import circular_error, pair
from pdr_graph.gait.gait import gait_of
from pdr_graph.types import Fixes, Trajectory

DATA = Path(os.environ.get("PDR_GRAPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
SIGMA = 0.5  # [m] stated of a waypoint that is given
HELP = {
    "every second waypoint": lambda n: np.unique(np.append(np.arange(0, n, 2), n - 1)),
    "first and last": lambda n: np.array([0, n - 1]),
    "first only": lambda n: np.array([0]),
}


@cache
def recordings():
    """The fifteen Microsoft walks: each with its steps, what its magnetometer says of its direction, and its floor."""
    paths = sorted((DATA / "ms_indoor20").glob("site*/*/*.txt"))
    if not paths:
        raise SystemExit(f"no recordings under {DATA} (set PDR_GRAPH_DATA)")
    floors = {folder: FloorPlan.load(folder) for folder in {p.parent for p in paths}}
    walks = []
    for path in paths:
        walk, floor = io.load(path), floors[path.parent]
        gaits = gait_of(walk)
        walks.append((walk, detect_steps(gaits), magnetic_headings(gaits, floor.frame, np.zeros(2)), floor))
    return walks


def some(truth, which):
    """The rows ``which`` of a truth, as a truth."""
    return Trajectory(truth.time[which], truth.position[which], truth.heading[which], ("",) * len(which))


def withheld_errors(walk, steps, headings, floor, which, method):
    """Errors [m] at the waypoints that were not given, whether each is inside its 90 % region, and wall crossings."""
    truth = walk.truth
    rest = np.setdiff1d(np.arange(len(truth)), which)
    if not len(rest):
        return np.empty(0), np.empty(0, dtype=bool), np.nan
    fixes = Fixes(truth.time[which], truth.position[which], np.full(len(which), SIGMA), ("",) * len(which))
    track = method(steps, fixes, headings, floor)
    withheld = some(truth, rest)
    inside = np.empty(0, dtype=bool)
    if track.covariance is not None:
        _, inside, _ = recorded.gaps(track, withheld, recorded.WAYPOINT_NOISE)
    crossings = floor.crosses_wall(track.position[:-1], track.position[1:]).mean()
    return circular_error(pair(track, withheld)), inside, crossings


def microsoft_walks():
    """The fifteen walks by what is given of them."""
    for given, choose in HELP.items():
        walks = []
        for walk, said, headings, floor in recordings():
            truth, which = walk.truth, choose(len(walk.truth))
            rest = np.setdiff1d(np.arange(len(truth)), which)
            fixes = Fixes(truth.time[which], truth.position[which], np.full(len(which), SIGMA), ("",) * len(which))
            walks += [recorded.Walk(given, said, headings, fixes, some(truth, rest), floor)] if len(rest) else []
        yield given, walks


METHODS = {
    "straight lines": lambda steps, fixes, headings, floor: some(
        Trajectory(fixes.time, fixes.position, np.zeros(len(fixes)), fixes.floor), np.arange(len(fixes))
    ),
    "dead reckoning": lambda steps, fixes, headings, floor: smooth(WalkGraph(steps, fixes)).dead_reckoning,
    "filter (causal)": lambda steps, fixes, headings, floor: (
        kalman_filter(WalkGraph(steps, fixes, headings=headings)).trajectory
    ),
    "filter, smoothed (RTS)": lambda steps, fixes, headings, floor: (
        kalman_smoother(WalkGraph(steps, fixes, headings=headings)).trajectory
    ),
    "graph": lambda steps, fixes, headings, floor: smooth(WalkGraph(steps, fixes, headings=headings)).trajectory,
    "graph with map": lambda steps, fixes, headings, floor: (
        smooth(WalkGraph(steps, fixes, headings=headings, floor=floor)).trajectory
    ),
}


def percentiles_with_interval(groups, draws=2000):
    """CE50/75/95 and their 95 % bootstrap intervals: whole walks are drawn, since errors in one walk are alike."""
    random = np.random.default_rng(0)
    groups = [g for g in groups if len(g)]
    at = [50, 75, 95]
    samples = [
        np.percentile(np.concatenate([groups[i] for i in random.integers(0, len(groups), len(groups))]), at)
        for _ in range(draws)
    ]
    low, high = np.percentile(samples, [2.5, 97.5], axis=0)
    values = np.percentile(np.concatenate(groups), at)
    return [f"{v:.2f} ({a:.2f}–{b:.2f})" for v, a, b in zip(values, low, high, strict=True)]


def microsoft():
    """CE at waypoints that were not given, by method and by what was given."""
    walks, rows = recordings(), []
    for given, choose in HELP.items():
        for name, method in METHODS.items():
            if given == "first only" and name == "straight lines":
                continue
            results = [withheld_errors(w, s, h, f, choose(len(w.truth)), method) for w, s, h, f in walks]
            errors, inside = [r[0] for r in results], np.concatenate([r[1] for r in results])
            crossing = np.nanmean([r[2] for r in results])
            coverage = f"{100 * inside.mean():.0f} %" if len(inside) else "—"
            rows.append([given, name, *percentiles_with_interval(errors), coverage, f"{100 * crossing:.1f} %"])
    header = ["given", "method", "CE50 [m]", "CE75 [m]", "CE95 [m]", "in 90 % region", "rows that cross a wall"]
    publish("accuracy.md", "microsoft", table(header, rows))


def settings():
    """How much the hand-set numbers matter: process noise without a map, the wall's spring with one."""
    walks, rows = recordings(), []

    def row(name, method, change=lambda steps: steps):
        cells = []
        for given in ("every second waypoint", "first and last"):
            results = [withheld_errors(w, change(s), h, f, HELP[given](len(w.truth)), method) for w, s, h, f in walks]
            errors, inside = (np.concatenate([r[k] for r in results]) for k in (0, 1))
            cells += [
                " / ".join(f"{p:.2f}" for p in np.percentile(errors, [50, 75, 95])),
                f"{100 * inside.mean():.0f} %",
            ]
        rows.append([name, *cells])

    default = preintegration.SIGMA_LATERAL
    for sway in (0.1, 0.25, 0.4):
        for share in (0.2, 0.3, 0.4):
            preintegration.SIGMA_LATERAL = sway
            row(
                f"sway {sway} m, stride {share:.0%}",
                METHODS["graph"],
                lambda s, k=share: replace(s, sigma_length=k * s.length),
            )
    preintegration.SIGMA_LATERAL = default
    for turn in (0.01, 0.04):
        changed = lambda s, k=turn: replace(s, sigma_turn=np.full(len(s), k))  # noqa: E731
        row(f"turn {turn} rad", METHODS["graph"], changed)
    for margin, sigma in ((0.8, 1.0), (0.8, 0.5), (0.8, 2.0), (0.2, 1.0), (1.2, 1.0)):
        prior = Prior(wall_margin=margin, wall_sigma=sigma)
        method = lambda s, x, h, f, p=prior: smooth(WalkGraph(s, x, headings=h, floor=f, prior=p)).trajectory  # noqa: E731
        row(f"with map: margin {margin} m, sigma {sigma} m", method)
    header = ["setting", "every second: CE50/75/95 [m]", "in 90 %", "first and last: CE50/75/95 [m]", "in 90 %"]
    publish("accuracy.md", "settings", table(header, rows))


def lifelog(data):
    """The four tables of the lifelog."""
    lifelog_chains.lifelog_chains(data)
    lifelog_days.lifelog_days(data)
    lifelog_visits.lifelog_visits()


if __name__ == "__main__":
    tables = {"microsoft": microsoft, "settings": settings}
    tables |= {"ipin21": lambda: recorded.ipin21(DATA), "gnss": lambda: recorded.gnss(DATA)}
    tables |= {"heading": lambda: heading.heading(DATA), "cart": cart.cart}
    tables |= {"steps": lambda: steps.steps(DATA), "calibration-walk": calibration_walk.calibration_walk}
    tables |= {"compass": lambda: compass.compass(DATA)}
    tables |= {"fingerprints": lambda: fingerprints.fingerprints(DATA)}
    tables |= {"floors": lambda: floors_by_step.floors(DATA)}
    tables |= {"topology": lambda: topology.topology(DATA)}
    tables |= {"map-matching": map_matching.map_matching, "wide-places": wide_places.wide_places}
    tables |= {"gps-outage": gps_outage.gps_outage}
    tables |= {"outliers": lambda: outliers.outliers(DATA, dict(microsoft_walks())["every second waypoint"])}
    tables |= {"covariance": lambda: covariance.covariance(DATA, microsoft_walks())}
    tables |= {"live": lambda: live.live(DATA, microsoft_walks(), recordings())}
    tables |= {"lifelog": lambda: lifelog(DATA)}
    tables |= {"simulation": lambda: realism.simulation(DATA)}
    chosen = [a for a in sys.argv[1:] if not a.startswith("--")]
    if not chosen or not set(chosen) <= set(tables):
        raise SystemExit(f"usage: scripts/reproduce {' | '.join(tables)} [--write]")
    for name in chosen:
        tables[name]()
