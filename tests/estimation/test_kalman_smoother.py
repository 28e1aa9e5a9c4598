"""The Kalman smoother: equal to the graph in the linear case, and up to linearisation elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, drawn_from_the_model, fixes_at, fixes_on, steps_of, wandering_walk

from pdr_graph import Headings, Prior, kalman_filter, kalman_smoother, smooth
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import wrap_angle


def straight_on(steps: int = 240, seed: int = 1) -> WalkGraph:
    """A straight walk in a direction that is known well, with noisy fixes now and then: a linear Gaussian chain."""
    walked = steps_of(np.full(steps, 0.7), np.zeros(steps), sigma_length=0.1, sigma_turn=1e-4)
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


def test_the_filter_alone_differs():
    """Control: without later measurements the middle of that walk differs, with a larger covariance."""
    graph = straight_on()
    causal, batch = kalman_filter(graph).trajectory, smooth(graph).trajectory
    assert np.abs(causal.position - batch.position)[100:150].max() > 0.1
    assert (causal.covariance[100:150, 0, 0] > 1.2 * batch.covariance[100:150, 0, 0]).all()


@pytest.mark.parametrize("seed", range(3))
def test_smoothing_never_increases_the_covariance(seed):
    """In any direction of (x, y, θ): the filter's covariance less the smoother's has no negative eigenvalue."""
    steps, fixes, _ = drawn_from_the_model(200, seed)
    graph = WalkGraph(steps, fixes)
    gained = kalman_filter(graph).trajectory.covariance - kalman_smoother(graph).trajectory.covariance
    assert np.linalg.eigvalsh(gained).min() > -1e-9


def test_the_last_row_is_the_filters():
    steps, fixes, _ = drawn_from_the_model(150, seed=3)
    graph = WalkGraph(steps, fixes)
    assert kalman_smoother(graph).trajectory.position[-1] == pytest.approx(kalman_filter(graph).trajectory.position[-1])


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


def test_a_late_direction_is_smoothed_back_to_the_start():
    """The direction is unknown before the second fix; the smoothed steps before it have it."""
    steps = wandering_walk(120)
    for heading in np.linspace(-3, 3, 5):
        truth = dead_reckon(steps, heading=heading)
        track = kalman_smoother(WalkGraph(steps, fixes_on(truth, every=15, sigma=0.5))).trajectory
        assert np.hypot(*(track.position - truth.position).T).max() < 1.0


def test_it_smooths_through_a_reinitialisation():
    """A phone that was turned unnoticed: the filter begins anew, and the smoothed walk is right on both sides."""
    steps, fixes, truth = turned_unnoticed()
    graph = WalkGraph(steps, fixes)
    estimate = kalman_smoother(graph)
    assert any("re-initialised" in w for w in estimate.warnings)
    apart = np.hypot(*(estimate.trajectory.position - truth.position).T)
    assert np.percentile(apart, 90) < 3.0


def turned_unnoticed(at: int = 150):
    """A walk of 300 steps whose turn by 120° at step ``at`` no gyro noticed; the fixes and the truth."""
    walked = wandering_walk(300, seed=2)
    turn = walked.turn.copy()
    turn[at] += 2.1
    truth = dead_reckon(replace(walked, turn=turn))
    return walked, fixes_on(truth, every=6, sigma=0.7, seed=0), truth


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
