"""Over seeded walks drawn from the model, the normalised error follows its χ² distribution; a wrong model does not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from walks import drawn_beside_beacons, drawn_from_the_model, drawn_with_a_receiver

from pdr_graph import kalman_smoother, smooth
from pdr_graph.estimation import bank, observations, robust
from pdr_graph.estimation import graph as walk_graph
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import wrap_angle

SEEDS = 120
FEWER = 40  # for controls, which fail by far
STEPS = 90


def normalised_errors(drawn, method=smooth, seeds=SEEDS):
    """NEES ``(seeds,)`` of the pose at one random row of each walk: independent draws, three degrees of freedom each.

    drawn: of a seed, the graph and the truth.
    """
    nees = []
    for seed in range(seeds):
        graph, truth = drawn(seed)
        track = method(graph).trajectory
        row = np.random.default_rng(seed).integers(0, len(track))
        gap = np.append(truth.position[row] - track.position[row], wrap_angle(truth.heading[row] - track.heading[row]))
        nees.append(gap @ np.linalg.solve(track.covariance[row], gap))
    return np.array(nees)


@pytest.fixture(autouse=True)
def gaussian(monkeypatch):
    """Without robust loss, which is not Gaussian."""
    for module in (walk_graph, observations, robust, bank):
        monkeypatch.setattr(module, "HUBER_WIDTH", 1e6)


def interval(seeds=SEEDS):
    low, high = chi2.ppf([0.025, 0.975], 3 * seeds) / seeds
    return low, high


def independent_fixes(seed, wrong=1.0):
    steps, fixes, truth = drawn_from_the_model(STEPS, seed, wrong=wrong)
    return WalkGraph(steps, fixes), truth


def a_receiver(seed):
    steps, fixes, truth = drawn_with_a_receiver(STEPS, seed)
    return WalkGraph(steps, fixes), truth


def a_receiver_taken_for_independent(seed):
    steps, fixes, truth = drawn_with_a_receiver(STEPS, seed)
    return WalkGraph(steps, replace(fixes, source=())), truth


def beacons(seed, wrong=1.0):
    steps, fixes, levels, truth = drawn_beside_beacons(STEPS, seed, wrong=wrong)
    return WalkGraph(steps, fixes, levels=levels), truth


@pytest.mark.parametrize("method", [smooth, kalman_smoother])
def test_covariance_is_honest(method):
    low, high = interval()
    assert low < normalised_errors(independent_fixes, method).mean() < high


@pytest.mark.parametrize("method", [smooth, kalman_smoother])
def test_fixes_twice_as_bad_as_stated_are_found_out(method):
    """The control."""
    assert normalised_errors(lambda seed: independent_fixes(seed, wrong=2.0), method, FEWER).mean() > interval(FEWER)[1]


def test_the_covariance_is_honest_where_fixes_share_a_receivers_offset_and_lag():
    low, high = interval()
    assert low < normalised_errors(a_receiver).mean() < high


def test_a_receivers_fixes_taken_for_independent_are_found_out():
    """The control: the same draws, whose source nobody names."""
    assert normalised_errors(a_receiver_taken_for_independent, seeds=FEWER).mean() > interval(FEWER)[1]


def test_the_covariance_is_honest_where_beacons_tell_ranges():
    low, high = interval()
    assert low < normalised_errors(beacons).mean() < high


def test_levels_twice_as_noisy_as_assumed_are_found_out():
    """The control."""
    assert normalised_errors(lambda seed: beacons(seed, wrong=2.0), seeds=FEWER).mean() > interval(FEWER)[1]
