"""The causal Kalman filter and its smoother on the measurements of the graph, against the graph."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, drawn_from_the_model, fixes_at, fixes_on, straight, wandering_walk

from pdr_graph import Headings, Prior, kalman_filter, kalman_smoother, smooth
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import wrap_angle


def test_the_filter_is_causal():
    """Fixes of the second half change nothing in the first."""
    steps, fixes, _ = drawn_from_the_model(100, seed=4)
    half = fixes.time < steps.end / 2
    full, first = (kalman_filter(WalkGraph(steps, f)).trajectory for f in (fixes, fixes[half]))
    rows = full.time < fixes.time[~half][0] - 0.6
    assert full.position[rows] == pytest.approx(first.position[rows], abs=1e-9)


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


def test_without_fixes_the_covariance_is_that_of_the_graph():
    """Two propagations of the same errors over bends, with an unknown calibration."""
    graph = WalkGraph(wandering_walk(40, seed=3))
    ours, theirs = (estimate(graph).trajectory.covariance for estimate in (kalman_filter, smooth))
    scale = np.sqrt(np.einsum("nii,njj->nij", theirs, theirs))
    assert ours / scale == pytest.approx(theirs / scale, abs=1e-6)


@pytest.mark.parametrize(("method", "known"), [(kalman_filter, -30), (kalman_smoother, 0)])
def test_an_unknown_direction_is_found(method, known):
    """For any true direction, after a few fixes the best hypothesis follows the walk; smoothed, from the start on."""
    steps = wandering_walk(120)
    for heading in np.linspace(-3, 3, 5):
        truth = dead_reckon(steps, heading=heading)
        track = method(WalkGraph(steps, fixes_on(truth, every=15, sigma=0.5))).trajectory
        assert np.hypot(*(track.position - truth.position)[known:].T).max() < 1.0


@pytest.mark.parametrize("away", [(0.0, 0.0), (300.0, -200.0)], ids=["a turned phone", "a lift or a ride"])
def test_a_lost_filter_is_reinitialised_with_a_warning(away):
    """The walk goes on in another direction, and perhaps elsewhere: at the fifth refused fix the filter begins anew.

    The smoothed walk is right on both sides.
    """
    steps = wandering_walk(300, seed=2)
    truth = dead_reckon(replace(steps, turn=steps.turn + 2.1 * (np.arange(300) == 150)))
    after = (truth.time > steps.time[150])[:, None]
    truth = replace(truth, position=truth.position + after * away)
    fixes = fixes_on(truth, every=6, sigma=0.7, seed=0)
    causal, smoothed = (method(WalkGraph(steps, fixes)) for method in (kalman_filter, kalman_smoother))
    [anew] = [n for n, fix in enumerate(causal.fixes) if fix.reason.endswith("the filter is re-initialised")]
    assert [fix.weight for fix in causal.fixes[anew - 4 : anew + 1]] == [0, 0, 0, 0, 1]
    assert any(f"re-initialised at {fixes.time[anew]:.1f} s" in w for w in causal.warnings)
    apart, apart_smoothed = (np.hypot(*(e.trajectory.position - truth.position).T) for e in (causal, smoothed))
    assert np.median(apart[200:]) < 1.5
    assert apart[100:149].max() < 3.0
    assert np.percentile(apart_smoothed, 90) < 3.0


def straight_on(steps: int = 240, seed: int = 1) -> WalkGraph:
    """A straight walk in a direction that is known well, with noisy fixes now and then: a linear Gaussian chain."""
    walked = straight(steps, sigma_length=0.1, sigma_turn=1e-4)
    random = np.random.default_rng(seed)
    at = np.arange(20, steps, 45)
    place = np.stack([0.75 * (at + 1), np.zeros(len(at))], axis=1) + random.normal(0, 0.8, (len(at), 2))
    direction = Headings(np.zeros(1), np.zeros(1), np.full(1, 1e-4))
    stiff = Prior(sigma=(0.1, 1e-4, 1e-6), change=(0.03, 1e-5, 1e-7))
    return WalkGraph(walked, fixes_at(walked.time[at], place, 0.8), headings=direction, prior=stiff)


def test_in_the_linear_case_it_equals_the_graph():
    """Straight on in a known direction, the stride unknown and changing: means and covariances of every step agree.

    Two ways to one answer that share no code but the cutting of the walk.
    """
    graph = straight_on()
    filtered, batch = kalman_smoother(graph), smooth(graph)
    assert len(batch.calibration.value) == 2
    assert filtered.trajectory.position == pytest.approx(batch.trajectory.position, abs=1e-3)
    assert filtered.trajectory.heading == pytest.approx(batch.trajectory.heading, abs=1e-5)
    ours, theirs = filtered.trajectory.covariance, batch.trajectory.covariance
    scale = np.sqrt(np.einsum("nii,njj->nij", theirs, theirs))
    assert ours / scale == pytest.approx(theirs / scale, abs=2e-3)
    assert filtered.calibration.value == pytest.approx(batch.calibration.value, abs=1e-4)
    assert filtered.calibration.covariance[:, 0, 0] == pytest.approx(batch.calibration.covariance[:, 0, 0], rel=2e-3)
    causal = kalman_filter(graph).trajectory
    middle = np.abs(causal.position - batch.trajectory.position)[100:150]
    assert middle.max() > 0.1, "control: the filter alone differs"
    assert (causal.covariance[100:150, 0, 0] > 1.2 * theirs[100:150, 0, 0]).all()


@pytest.mark.parametrize("seed", range(3))
def test_smoothing_never_increases_the_covariance_and_leaves_the_last_row(seed):
    """In any direction of (x, y, θ): the filter's covariance less the smoother's has no negative eigenvalue."""
    steps, fixes, _ = drawn_from_the_model(200, seed)
    causal, smoothed = (method(WalkGraph(steps, fixes)).trajectory for method in (kalman_filter, kalman_smoother))
    assert np.linalg.eigvalsh(causal.covariance - smoothed.covariance).min() > -1e-9
    assert smoothed.position[-1] == pytest.approx(causal.position[-1])


def test_bent_walks_equal_the_graph_up_to_linearisation():
    """Over twelve walks drawn from the model it is about as near the truth as the graph, and far nearer than causal."""
    error = np.zeros((12, 3))
    for seed in range(12):
        steps, fixes, truth = drawn_from_the_model(200, seed)
        graph = WalkGraph(steps, fixes)
        for n, method in enumerate((kalman_filter, kalman_smoother, smooth)):
            error[seed, n] = np.hypot(*(method(graph).trajectory.position - truth.position).T).mean()
    causal, smoothed, batch = error.mean(axis=0)
    assert smoothed < 1.1 * batch
    assert smoothed < 0.6 * causal


def test_both_have_the_rows_of_the_graph():
    steps, fixes, _ = drawn_from_the_model(230, seed=6)
    graph = WalkGraph(steps, fixes)
    batch = smooth(graph)
    for estimate in (kalman_filter(graph), kalman_smoother(graph)):
        assert np.array_equal(estimate.trajectory.time, batch.trajectory.time)
        assert estimate.trajectory.covariance.shape == batch.trajectory.covariance.shape
        assert np.array_equal(estimate.calibration.start, batch.calibration.start)
        assert np.array_equal(estimate.calibration.prior_sigma, batch.calibration.prior_sigma)
        assert [fix.time for fix in estimate.fixes] == [fix.time for fix in batch.fixes]
        assert np.abs(wrap_angle(estimate.trajectory.heading) - estimate.trajectory.heading).max() < 1e-12
