"""The causal Kalman filter on the measurements of the graph."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, drawn_from_the_model, fixes_at, fixes_on, wandering_walk

from pdr_graph import Headings, kalman_filter, smooth
from pdr_graph.estimation.graph import WalkGraph


def test_filter_and_smoother_agree_at_the_end():
    """Both use all measurements for the last pose; they agree up to linearisation (0.3 sigma)."""
    steps, fixes, _ = drawn_from_the_model(150, seed=3)
    graph = WalkGraph(steps, fixes)
    causal, smoothed = kalman_filter(graph).trajectory, smooth(graph).trajectory
    sigma = np.sqrt(np.diag(smoothed.covariance[-1])[:2])
    assert np.abs(causal.position[-1] - smoothed.position[-1]) / sigma == pytest.approx([0, 0], abs=0.3)
    assert causal.covariance[-1, 0, 0] == pytest.approx(smoothed.covariance[-1, 0, 0], rel=0.2)


def test_the_filter_is_causal():
    """Fixes of the second half change nothing in the first."""
    steps, fixes, _ = drawn_from_the_model(100, seed=4)
    half = fixes.time < steps.end / 2
    full, first = (kalman_filter(WalkGraph(steps, f)).trajectory for f in (fixes, fixes[half]))
    rows = full.time < fixes.time[~half][0] - 0.6
    assert full.position[rows] == pytest.approx(first.position[rows], abs=1e-9)


def test_an_unknown_direction_is_found():
    """For any true direction, after a few fixes the best hypothesis follows the walk."""
    steps = wandering_walk(120)
    for heading in np.linspace(-3, 3, 5):
        truth = dead_reckon(steps, heading=heading)
        track = kalman_filter(WalkGraph(steps, fixes_on(truth, every=15, sigma=0.5))).trajectory
        assert np.hypot(*(track.position - truth.position)[-30:].T).max() < 1.0


def test_inconsistent_fixes_lose_weight_and_outliers_are_rejected():
    """Within the gate of 5 sigma a fix counts less the further off it is; beyond, it moves nothing at all."""
    steps, fixes, _ = drawn_from_the_model(150, seed=5)
    sixth = np.arange(len(fixes)) == 5

    def moved_by(metres):
        return kalman_filter(WalkGraph(steps, replace(fixes, position=fixes.position + np.outer(sixth, [metres, 0.0]))))

    near, far, farther = moved_by(9.0), moved_by(50.0), moved_by(5000.0)
    assert 0.3 < near.fixes[5].weight < 1.0
    assert "reduced weight" in near.fixes[5].reason
    assert far.fixes[5].weight == 0.0
    assert far.fixes[5].reason.endswith("sigma from where it was expected: rejected")
    assert "1 fix rejected: more than 5 sigma from the expected position" in far.warnings
    assert far.trajectory.position == pytest.approx(farther.trajectory.position, abs=1e-9)
    without = kalman_filter(WalkGraph(steps, fixes[~sixth])).trajectory
    last = far.trajectory.position[-1], far.trajectory.covariance[-1]
    assert last[0] == pytest.approx(without.position[-1], abs=0.05), "but for the keyframe that it asks for"
    assert last[1] == pytest.approx(without.covariance[-1], abs=0.05)


def test_a_lost_filter_is_reinitialised_with_a_warning():
    """A lift, a ride, a phone turned unnoticed: the walk goes on elsewhere and in another direction.

    Four fixes are refused; at the fifth in a row the filter gives up its place, and finds the new one.
    """
    steps = wandering_walk(300, seed=2)
    turn = steps.turn.copy()
    turn[150] += 2.1
    truth = dead_reckon(replace(steps, turn=turn))
    fixes = fixes_on(truth, every=6, sigma=0.7, seed=0)
    away = np.outer(fixes.time > steps.time[150], [300.0, -200.0])
    estimate = kalman_filter(WalkGraph(steps, replace(fixes, position=fixes.position + away)))
    anew = [n for n, fix in enumerate(estimate.fixes) if fix.reason.endswith("the filter is re-initialised")]
    assert len(anew) == 1
    assert [fix.weight for fix in estimate.fixes[anew[0] - 4 : anew[0] + 1]] == [0, 0, 0, 0, 1]
    assert any(f"re-initialised at {fixes.time[anew[0]]:.1f} s" in w for w in estimate.warnings)
    apart = np.hypot(*(estimate.trajectory.position - truth.position - [300.0, -200.0])[200:].T)
    assert np.median(apart) < 1.5
    assert np.hypot(*(estimate.trajectory.position - truth.position)[100:149].T).max() < 3.0


def test_single_outliers_do_not_reinitialise_the_filter():
    """Every fourth fix is anywhere within 300 m: each is rejected, and the walk is as without them."""
    steps, fixes, truth = drawn_from_the_model(400, seed=9, every=5)
    random = np.random.default_rng(0)
    wild = np.arange(len(fixes)) % 4 == 3
    anywhere = np.where(wild[:, None], random.uniform(-300, 300, fixes.position.shape), fixes.position)
    estimate = kalman_filter(WalkGraph(steps, replace(fixes, position=anywhere)))
    assert not any("re-initialised" in w for w in estimate.warnings)
    assert np.mean([fix.weight == 0.0 for fix, w in zip(estimate.fixes, wild, strict=True) if w]) > 0.8
    clean = kalman_filter(WalkGraph(steps, fixes[~wild])).trajectory
    error, usual = (np.hypot(*(t.position - truth.position).T).mean() for t in (estimate.trajectory, clean))
    assert error < 1.2 * usual


def test_the_first_magnetic_heading_acts_at_the_start():
    """As by a magnetometer that is there from the first step on: no row waits for it, turned the wrong way."""
    steps = wandering_walk(80)
    truth = dead_reckon(steps, fixes_at([0.0], [[5.0, 5.0]]), heading=2.0)
    late = Headings(steps.time[[60]], truth.heading[[61]], np.full(1, 0.05))
    track = kalman_filter(WalkGraph(steps, fixes_at([0.0], [[5.0, 5.0]], 0.5), headings=late)).trajectory
    assert np.hypot(*(track.position - truth.position).T).max() < 0.5
    back = np.hypot(0.02 * np.sqrt(61), 0.003 * steps.time[60])  # turns and drift until then
    assert np.sqrt(track.covariance[0, 2, 2]) == pytest.approx(np.hypot(0.05, back), rel=0.2)


def test_without_fixes_it_is_dead_reckoning():
    steps = wandering_walk(25)
    track = kalman_filter(WalkGraph(steps)).trajectory
    assert track.position == pytest.approx(dead_reckon(steps).position, abs=1e-9)
    assert len(kalman_filter(WalkGraph(steps, fixes_at([2.0], [[5, 5]]))).trajectory) == 27


def test_without_fixes_the_covariance_is_that_of_the_graph():
    """Two propagations of the same errors over bends, with an unknown calibration."""
    graph = WalkGraph(wandering_walk(40, seed=3))
    ours, theirs = (estimate(graph).trajectory.covariance for estimate in (kalman_filter, smooth))
    scale = np.sqrt(np.einsum("nii,njj->nij", theirs, theirs))
    assert ours / scale == pytest.approx(theirs / scale, abs=1e-6)
