"""What a radio map tells of walks that are told nothing else: one real floor, by maps of its other recordings."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from magnetic import Floor, score
from scipy.spatial import KDTree
from tables import publish, table

from pdr_graph import smooth
from pdr_graph.apps.bench.data_sets import walks_of
from pdr_graph.estimation.fingerprinting import RadioMap, matched, scans_of, unlikeness
from pdr_graph.estimation.verdict import verdict
from pdr_graph.geometry import interpolate
from pdr_graph.types import OK

FOLDS = 8  # maps; each has seven eighths of the recordings, or of the walks
FAR = 10.0  # [m] median of a recording that is in another part of the floor
ALIKE = (0.0, 0.3, 0.4, 0.5, 1.0)  # distances of scans
GAPS = (0.0, 1.5, 3.0, 6.0, 12.0, np.inf)  # [m] from a place to the nearest of the map


def left_out(floor, fold):
    """Each recording with its track by all waypoints, the map of the other folds, and the fixes by this."""
    for own in range(FOLDS):
        pairs = list(zip(floor.walks, floor.tracks, fold.tolist(), strict=True))
        radio_map = RadioMap.learn([(track, walk.evidence.walk) for walk, track, of in pairs if of != own])
        for walk, track, of in pairs:
            if of == own:
                yield walk, track, radio_map, radio_map.fixes(walk.evidence.walk)


def fix_errors(track, radio_map, fixes):
    """Of each fix its distance from the map and its error [m]."""
    place = interpolate(fixes.time, track.time, track.position)
    return np.column_stack([KDTree(radio_map.position).query(place)[0], np.hypot(*(fixes.position - place).T)])


def judged(walk, fixes):
    """Errors and regions of a recording, and whether its estimate is ok."""
    estimate = smooth(replace(walk.evidence, fixes=fixes).graph())
    return score(estimate.trajectory, walk.truth), verdict(estimate).state == OK


def floors(data):
    """The floor of each scan by those of other walks of its mall, by the distance of the most similar one."""
    found = [(name.split()[0].split("/"), scans_of(read().evidence.walk)) for name, read in walks_of("malls", data)]
    rows, right, alike = [], [], []
    for mall in sorted({site for (site, _), _ in found}):
        own = [(label, scans) for (site, label), scans in found if site == mall and len(scans)]
        names = sorted({name for _, scans in own for name in scans.transmitter})
        level = [scans.of(names) for _, scans in own]
        for n, (label, _) in enumerate(own):
            others = [m for m in range(len(own)) if m != n]
            labels = [own[m][0] for m in others for _ in level[m]]
            distance = unlikeness(level[n], np.concatenate([level[m] for m in others]))
            _, of_scan, closest = matched(distance, np.zeros((len(labels), 2)), labels)
            right += [floor == label for floor in of_scan if floor]
            alike += [d for d, floor in zip(closest.tolist(), of_scan, strict=True) if floor]
    right, alike = np.array(right), np.array(alike)
    for low, high in pairwise(ALIKE):
        own = right[(alike >= low) & (alike < high)]
        rows.append([f"{low:g} to {high:g}", len(own), f"{100 * own.mean():.1f} %"])
    publish("results/radio.md", "radio floors", table(["most similar scan", "scans", "right floor"], rows))


def radio(data):
    """The tables."""
    floors(data)
    floor, rows, of_fixes = Floor(data), [], []
    folds = {
        "recordings": np.random.default_rng(0).permutation(len(floor.walks)) % FOLDS,
        "whole walks": floor.number % FOLDS,
    }
    for name, fold in folds.items():
        parts = list(left_out(floor, fold))
        gap, error = np.concatenate([fix_errors(*part[1:]) for part in parts]).T
        for low, high in pairwise(GAPS):
            own = error[(gap >= low) & (gap < high)]
            middle = " / ".join(f"{value:.1f}" for value in np.percentile(own, [50, 90]))
            of_fixes.append([name, f"{low:g} to {high:g}", len(own), middle])
        scores, sure = zip(*(judged(walk, fixes) for walk, _, _, fixes in parts), strict=True)
        off, inside = np.concatenate(scores).T
        far = [bool(np.median(own[:, 0]) > FAR) for own in scores]
        middle = " / ".join(f"{value:.2f}" for value in np.percentile(off, [50, 75, 95]))
        cells = [f"{off.mean():.2f}", f"{100 * inside.mean():.0f} %"]
        both = sum(a and b for a, b in zip(sure, far, strict=True))
        rows.append([name, len(scores), middle, *cells, sum(far), sum(sure), both])
    header = ["left out", "recordings", "CE50 / 75 / 95 [m]", "mean [m]", "in 90 % region", "10 m off", "ok", "both"]
    publish("results/radio.md", "radio", table(header, rows))
    header = ["left out", "from the map [m]", "fixes", "error, median / 90 % [m]"]
    publish("results/radio.md", "radio fixes", table(header, of_fixes))
