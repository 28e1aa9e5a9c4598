"""The filter front end: the same measurements, one after the other."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, drawn_from_the_model, fixes_at, fixes_on, wandering_walk

from pdr_graph import kalman_filter, smooth
from pdr_graph.estimation.graph import WalkGraph


def test_at_the_end_filter_and_smoother_know_the_same():
    """The last pose has no future: both give it from the same measurements, up to linearisation (0.3 sigma)."""
    steps, fixes, _ = drawn_from_the_model(150, seed=3)
    graph = WalkGraph(steps, fixes)
    causal, smoothed = kalman_filter(graph).trajectory, smooth(graph).trajectory
    sigma = np.sqrt(np.diag(smoothed.covariance[-1])[:2])
    assert np.abs(causal.position[-1] - smoothed.position[-1]) / sigma == pytest.approx([0, 0], abs=0.3)
    assert causal.covariance[-1, 0, 0] == pytest.approx(smoothed.covariance[-1, 0, 0], rel=0.2)


def test_it_does_not_look_ahead():
    """Fixes of the second half change nothing in the first."""
    steps, fixes, _ = drawn_from_the_model(100, seed=4)
    half = fixes.time < steps.end / 2
    full, first = (kalman_filter(WalkGraph(steps, f)).trajectory for f in (fixes, fixes[half]))
    rows = full.time < fixes.time[~half][0] - 0.6
    assert full.position[rows] == pytest.approx(first.position[rows], abs=1e-9)


def test_an_unknown_direction_is_found():
    """Any true direction: once a few fixes are in, the bank's best hypothesis follows the walk."""
    steps = wandering_walk(120)
    for heading in np.linspace(-3, 3, 5):
        truth = dead_reckon(steps, heading=heading)
        track = kalman_filter(WalkGraph(steps, fixes_on(truth, every=15, sigma=0.5))).trajectory
        assert np.hypot(*(track.position - truth.position)[-30:].T).max() < 1.0


def test_fixes_far_off_are_weighted_down():
    steps, fixes, truth = drawn_from_the_model(150, seed=5)
    wild = replace(fixes, position=fixes.position + np.outer(np.arange(len(fixes)) == 5, [50.0, 0.0]))
    estimate = kalman_filter(WalkGraph(steps, wild))
    assert estimate.fixes[5].weight < 0.2
    assert np.hypot(*(estimate.trajectory.position - truth.position)[-1]) < 6.0


def test_without_fixes_it_is_dead_reckoning():
    steps = wandering_walk(25)
    track = kalman_filter(WalkGraph(steps)).trajectory
    assert track.position == pytest.approx(dead_reckon(steps).position, abs=1e-9)
    assert len(kalman_filter(WalkGraph(steps, fixes_at([2.0], [[5, 5]]))).trajectory) == 27
