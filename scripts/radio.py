"""What a radio map tells of walks that are told nothing else: one real floor, by maps of its other recordings."""

from dataclasses import replace

import numpy as np
from magnetic import Floor, score
from tables import publish, table

from pdr_graph import smooth
from pdr_graph.estimation.fingerprinting import RadioMap
from pdr_graph.estimation.verdict import verdict
from pdr_graph.types import OK

FOLDS = 8  # maps; each has seven eighths of the recordings, or of the walks
FAR = 10.0  # [m] median of a recording that is in another part of the floor


def judged(floor, fold):
    """Errors and regions of each recording by a map of the other folds, and whether its estimate is ok."""
    for left_out in range(FOLDS):
        pairs = list(zip(floor.walks, floor.tracks, fold.tolist(), strict=True))
        radio_map = RadioMap.learn([(track, walk.evidence.walk) for walk, track, own in pairs if own != left_out])
        for walk in (walk for walk, _, own in pairs if own == left_out):
            evidence = replace(walk.evidence, fixes=radio_map.fixes(walk.evidence.walk))
            estimate = smooth(evidence.graph())
            yield score(estimate.trajectory, walk.truth), verdict(estimate).state == OK


def radio(data):
    """The table."""
    floor, rows = Floor(data), []
    folds = {
        "recordings": np.random.default_rng(0).permutation(len(floor.walks)) % FOLDS,
        "whole walks": floor.number % FOLDS,
    }
    for name, fold in folds.items():
        scores, sure = zip(*judged(floor, fold), strict=True)
        off, inside = np.concatenate(scores).T
        far = [bool(np.median(own[:, 0]) > FAR) for own in scores]
        middle = " / ".join(f"{value:.2f}" for value in np.percentile(off, [50, 75, 95]))
        cells = [f"{off.mean():.2f}", f"{100 * inside.mean():.0f} %"]
        both = sum(a and b for a, b in zip(sure, far, strict=True))
        rows.append([name, len(scores), middle, *cells, sum(far), sum(sure), both])
    header = ["left out", "recordings", "CE50 / 75 / 95 [m]", "mean [m]", "in 90 % region", "10 m off", "ok", "both"]
    publish("results/radio.md", "radio", table(header, rows))
