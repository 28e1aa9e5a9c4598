"""`Estimate.at`: pose and covariance at any time."""

import copy
import pickle

import numpy as np
import pytest
from walks import drawn_from_the_model, straight

from pdr_graph import Fixes, kalman_filter, smooth
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.geometry import interpolate, wrap_angle


def walk(seed, n=120):
    steps, fixes, _ = drawn_from_the_model(n, seed)
    return steps, fixes


@pytest.mark.parametrize("seed", range(3))
def test_at_the_time_of_a_row_it_is_that_row(seed):
    estimate = smooth(WalkGraph(*walk(seed)))
    track = estimate.trajectory
    rows = estimate.at(track.time)
    assert rows.position == pytest.approx(track.position, abs=1e-9)
    assert np.abs(wrap_angle(rows.heading - track.heading)).max() < 1e-9
    assert rows.covariance == pytest.approx(track.covariance, abs=1e-9)
    for n in (0, 17, 60, len(track) - 1):
        one = estimate.at(float(track.time[n]))
        assert one.position[0] == pytest.approx(track.position[n], abs=1e-9)
        assert one.covariance[0] == pytest.approx(track.covariance[n], abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_between_rows_it_is_the_marginal_of_a_graph_with_a_keyframe_there(seed):
    """A fix of a sigma of 1000 km forces the keyframe and says nothing.

    That keyframe also moves others, by which both walks differ by up to 6 mm at their rows: 1 mm is beside these.
    """
    steps, fixes = walk(seed)
    estimate = smooth(WalkGraph(steps, fixes))
    for time in np.random.default_rng(seed).uniform(steps.start, steps.end, 6).tolist():
        here = estimate.at(time)
        weak = Fixes(np.array([time]), here.position + 1.0, np.array([1e6]), ("",))
        forced = smooth(WalkGraph(steps, Fixes.concatenate([fixes, weak])))
        [keyframe] = np.flatnonzero(np.abs(forced.graph.keyframe_time - time) < 2e-6)
        pose, track = forced.graph.optimum.poses[keyframe], forced.trajectory
        apart = track.position - estimate.trajectory.position
        assert np.hypot(*apart.T).max() < 0.01
        assert here.position + interpolate(np.array([time]), track.time, apart) == pytest.approx(
            pose[None, :2], abs=1e-3
        )
        assert abs(wrap_angle(here.heading[0] - pose[2])) < 1e-3
        [covariance] = forced.at(time).covariance
        sigma = np.sqrt(np.diag(covariance))
        assert here.covariance[0] / np.outer(sigma, sigma) == pytest.approx(
            covariance / np.outer(sigma, sigma), abs=0.02
        )


def test_it_is_continuous_and_its_uncertainty_grows_away_from_the_keyframes():
    """Every millisecond of a few steps: no jump of more than a walker can make."""
    steps, fixes = walk(1)
    estimate = smooth(WalkGraph(steps, fixes))
    time = np.arange(20.0, 26.0, 1e-3)
    dense = estimate.at(time)
    assert np.hypot(*np.diff(dense.position, axis=0).T).max() < 4e-3
    assert np.abs(np.diff(dense.covariance[:, 0, 0])).max() < 2e-3
    assert np.linalg.eigvalsh(dense.covariance).min() > 0


def test_other_times_raise_an_error_that_says_which_there_are():
    steps, fixes = walk(1, 40)
    estimate = smooth(WalkGraph(steps, fixes))
    for time in (-0.1, steps.end + 0.1, np.nan):
        with pytest.raises(ValueError, match=r"expected those of the walk, 0.000 to"):
            estimate.at(time)


def test_an_estimate_without_its_graph_is_linear_between_rows():
    steps, fixes = straight(40), Fixes(np.array([2.0, 18.0]), np.array([[0.0, 0.0], [20.0, 0.0]]), np.ones(2), ("", ""))
    for estimate in (
        kalman_filter(WalkGraph(steps, fixes)),
        pickle.loads(pickle.dumps(smooth(WalkGraph(steps, fixes)))),
    ):
        track, half = estimate.trajectory, estimate.at(float(steps.time[5] + steps.time[6]) / 2)
        assert half.position[0] == pytest.approx(track.position[6:8].mean(axis=0))
        assert half.covariance[0] == pytest.approx(track.covariance[6:8].mean(axis=0))


def test_a_copy_of_an_estimate_that_was_asked_has_no_graph_in_it():
    estimate = smooth(WalkGraph(*walk(1, 40)))
    estimate.at(5.0)
    assert copy.copy(estimate).graph is None
    assert len(pickle.dumps(estimate)) < 1e6
