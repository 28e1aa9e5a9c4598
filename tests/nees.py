"""Errors of estimates in terms of their covariance (NEES), on walks drawn from the model: for tests and tables."""

from contextlib import ExitStack, contextmanager
from dataclasses import replace
from unittest.mock import patch

import numpy as np
from scipy.stats import chi2
from walks import drawn_beside_beacons, drawn_from_the_model, drawn_with_a_receiver

from pdr_graph import smooth
from pdr_graph.estimation import kalman
from pdr_graph.estimation.factors import base
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import wrap_angle
from pdr_graph.priors import BEACONS, LOSSES, PRICES, changed

SEEDS = 120
STEPS = 90
WIDE = 1e6  # [σ] within which Huber's loss is Gaussian


@contextmanager
def gaussian():
    """Without robust losses and hypotheses about sources that err, which are not Gaussian."""
    with ExitStack() as patches:
        patches.enter_context(changed(PRICES, astray=100.0))
        patches.enter_context(changed(BEACONS, suspicious=np.inf))
        patches.enter_context(changed(LOSSES, huber=WIDE))
        for module in (base, kalman):
            patches.enter_context(
                patch.object(module, "huber_weight", lambda deviation, _=WIDE: np.ones_like(deviation))
            )
        yield


def normalised_errors(drawn, method=smooth, seeds=SEEDS):
    """NEES ``(seeds,)`` of the pose at one random row of each walk: independent draws, three degrees of freedom each.

    drawn: of a seed, the graph and the truth.
    """
    nees = []
    for seed in range(seeds):
        graph, truth = drawn(seed)
        track = method(graph).trajectory
        row = np.random.default_rng(seed).integers(0, len(track))
        nees.append(nees_of([*track.position[row], track.heading[row]], track.covariance[row], truth, row))
    return np.array(nees)


def nees_of(pose, covariance, truth, row):
    """The squared error of a pose by its covariance."""
    gap = np.append(truth.position[row] - pose[:2], wrap_angle(truth.heading[row] - pose[2]))
    return gap @ np.linalg.solve(covariance, gap)


def interval(seeds=SEEDS):
    """Where the mean of that many lies, 95 times in a hundred."""
    low, high = chi2.ppf([0.025, 0.975], 3 * seeds) / seeds
    return low, high


def independent_fixes(seed, wrong=1.0):
    steps, fixes, truth = drawn_from_the_model(STEPS, seed, wrong=wrong)
    return WalkGraph(steps, fixes), truth


def twice_as_bad(seed):
    return independent_fixes(seed, wrong=2.0)


def a_receiver(seed):
    steps, fixes, truth = drawn_with_a_receiver(STEPS, seed)
    return WalkGraph(steps, fixes), truth


def a_receiver_taken_for_independent(seed):
    steps, fixes, truth = drawn_with_a_receiver(STEPS, seed)
    return WalkGraph(steps, replace(fixes, source=())), truth


def beacons(seed, wrong=1.0):
    steps, fixes, levels, truth = drawn_beside_beacons(STEPS, seed, wrong=wrong)
    return WalkGraph(steps, fixes, levels=levels), truth


def twice_as_noisy(seed):
    return beacons(seed, wrong=2.0)
