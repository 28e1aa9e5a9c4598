"""Errors along and across the walking direction, in multiples of their stated sigmas, on all real recordings."""

from dataclasses import replace

import numpy as np
from covariance import graph_of
from microsoft import microsoft_walks
from recorded import WAYPOINT_NOISE, ipin21_walks, ipin2023_walks, nju_walks
from tables import publish, table

from pdr_graph import smooth
from pdr_graph.apps.report.evaluation import pair
from pdr_graph.geometry import along_and_across, protection_level

LEVELS = (0.95, 0.999)
QUANTILES = (0.95, 0.999)


def protection(data):
    """What the protection levels hold: share of places along and across, by kind of walk."""
    groups = dict(_groups(data))
    groups["all, each walk counted alike"] = [walk for walks in groups.values() for walk in walks]
    rows = [[name, f"{len(walks)}", f"{sum(len(z) for z in walks)}", *_held(walks)] for name, walks in groups.items()]
    levels = [f"within the {100 * level:g} % level" for level in LEVELS]
    quantiles = [f"{100 * quantile:g} % of errors / sigma" for quantile in QUANTILES]
    publish("results/protection.md", "protection", table(["walks", "", "places", *levels, *quantiles, "worst"], rows))


def _groups(data):
    """Normalised errors of each walk, by kind of walk."""
    for given, walks in microsoft_walks(data):
        yield f"Microsoft, {given}", [normalised_errors(walk, WAYPOINT_NOISE) for walk in walks]
        with_plan = [normalised_errors(walk, WAYPOINT_NOISE, walk.floor) for walk in walks]
        yield f"Microsoft, {given}, plan", with_plan
    some = list(ipin21_walks(data))
    yield "IPIN21", [normalised_errors(walk) for walk in some]
    yield "IPIN21, plan", [normalised_errors(walk, floor=walk.floor) for walk in some]
    some = list(ipin2023_walks(data))
    yield "IPIN 2023, GNSS", [normalised_errors(replace(walk, levels=None)) for walk in some]
    yield "IPIN 2023, GNSS, beacons", [normalised_errors(walk) for walk in some]
    yield "NJU campus", [normalised_errors(walk) for walk in nju_walks(data)]


def normalised_errors(walk, noise=0.0, floor=None):
    """|error| / sigma ``(n, 2)`` along and across the walking direction at the places of the truth."""
    track = smooth(graph_of(walk, floor)).trajectory
    pairs = pair(track, walk.truth)
    flat = track.covariance[:, :2, :2].reshape(-1, 4).T
    covariance = np.stack([np.interp(pairs.time, track.time, v) for v in flat], 1).reshape(-1, 2, 2)
    heading = np.interp(pairs.time, track.time, np.unwrap(track.heading))
    sigma = along_and_across(covariance + noise**2 * np.eye(2), heading)
    cos, sin = np.cos(heading), np.sin(heading)
    (x, y) = (pairs.estimate - pairs.truth).T
    return np.abs(np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)) / sigma


def _held(walks):
    """Share of errors within each level, their quantiles and the worst [sigma]; each walk counts alike."""
    walks = [walk for walk in walks if len(walk)]
    z = np.concatenate([walk.ravel() for walk in walks])
    weight = np.concatenate([np.full(walk.size, 1 / walk.size) for walk in walks]) / len(walks)
    order = np.argsort(z)
    below = np.cumsum(weight[order])
    quantiles = [z[order][min(np.searchsorted(below, q), len(z) - 1)] for q in QUANTILES]
    shares = [100 * float(weight[z <= _factor(level)].sum()) for level in LEVELS]
    return [*(f"{share:.1f} %" for share in shares), *(f"{value:.1f}" for value in (*quantiles, z.max()))]


def _factor(level):
    """The multiple of sigma that a level is."""
    return protection_level(np.eye(2)[None], np.zeros(1), level)[0, 0]
