"""The metrics, compared with answers by hand and with plain loops over the definitions."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from scipy.stats import multivariate_normal

from pdr_graph.apps.report.evaluation import circular_accuracy, energy_score, evaluate, log_score, pair, table
from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame
from pdr_graph.geometry import rotation
from pdr_graph.types import Trajectory


def track(seconds=120.0, rate=20.0, seed=0, start=1.7e9, floor=""):
    """A wandering track with headings."""
    random = np.random.default_rng(seed)
    time = start + np.arange(0, seconds, 1 / rate)
    heading = np.cumsum(random.normal(0, 0.05, len(time)))
    velocity = 1.2 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    position = np.cumsum(velocity / rate, axis=0)
    return Trajectory(time, position, heading, (floor,) * len(time))


def changed(truth, shift=(0.0, 0.0), turn=0.0, drift=0.0):
    moved = truth.position + np.asarray(shift) + np.outer(truth.time - truth.time[0], [drift, 0.0])
    return Trajectory(truth.time, moved, truth.heading + turn, truth.floor)


@pytest.mark.parametrize("pairing", ["linear", "nearest"])
def test_the_published_check_values(pairing):
    """The truth itself; (3, 4) m and 0.3 rad off; a drift of 0.1 m/s along x."""
    truth = track()
    same = evaluate(truth, truth, pairing=pairing)
    assert same["ce"]["p95"] == same["he"]["max"] == same["eag"] == same["ve"] == 0
    off = evaluate(changed(truth, (3, 4), 0.3), truth, pairing=pairing)
    assert off["ce"]["mean"] == pytest.approx(5.0, abs=1e-9)
    assert off["he"]["p50"] == pytest.approx(0.3, abs=1e-9)
    drifting = evaluate(changed(truth, drift=0.1), truth, pairing=pairing)
    # 0.1 in the first half; in the second the time to the end shrinks while the error grows
    elapsed = np.minimum(truth.time - truth.time[0], truth.time[-1] - truth.time)
    expected = np.median((0.1 * (truth.time - truth.time[0]) / np.maximum(elapsed, 1e-9))[elapsed >= 1])
    assert drifting["eag"] == pytest.approx(expected, abs=1e-6)


def loops(estimate, truth):
    """CE, HE, EAG and VE by their definitions, sample by sample."""
    pairs = []
    for t, g, h in zip(truth.time, truth.position, truth.heading, strict=True):
        k = int(np.argmin(np.abs(estimate.time - t)))
        if abs(estimate.time[k] - t) <= 0.5:
            pairs.append((t, g, h, estimate.position[k], estimate.heading[k]))
    ce = [np.hypot(*(e - g)) for _, g, _, e, _ in pairs]
    he = [abs((eh - gh + np.pi) % (2 * np.pi) - np.pi) for _, _, gh, _, eh in pairs]
    s, f = truth.time[0], truth.time[-1]
    eag = [c / min(t - s, f - t) for (t, *_), c in zip(pairs, ce, strict=True) if min(t - s, f - t) >= 1]
    times, speeds = [p[0] for p in pairs], []
    for column in (1, 3):
        v = [0.0] + [np.hypot(*(q[column] - p[column])) / (q[0] - p[0]) for p, q in pairwise(pairs)]
        speeds.append([np.mean([w for u, w in zip(times, v, strict=True) if abs(u - x) <= 0.5]) for x in times])
    ve = np.abs(np.subtract(*speeds))
    return np.percentile(ce, [50, 95]), np.percentile(he, 75), np.median(eag), np.median(ve), len(pairs)


@pytest.mark.parametrize("seed", range(3))
def test_nearest_pairing_equals_the_definitions(seed):
    """For an estimate with uneven rows and a gap longer than the tolerance of 0.5 s."""
    random = np.random.default_rng(seed)
    truth = track(60.0, 10.0, seed)
    source = track(66.0, 30.0, seed + 10, start=truth.time[0] - 2.0)
    rows = np.sort(random.choice(len(source), 150, replace=False))
    rows = rows[(source.time[rows] < truth.time[200]) | (source.time[rows] > truth.time[260])]
    estimate = Trajectory(source.time[rows], source.position[rows], source.heading[rows])
    scores = evaluate(estimate, truth, pairing="nearest")
    ce, he, eag, ve, n = loops(estimate, truth)
    assert scores["n"] == n < len(truth)
    found = scores["ce"]["p50"], scores["ce"]["p95"], scores["he"]["p75"], scores["eag"], scores["ve"]
    assert found == pytest.approx([*ce, he, eag, ve], abs=1e-9)


def test_linear_pairing_interpolates_position_and_heading_over_the_wrap():
    estimate = Trajectory(np.array([0.0, 1.0]), np.array([[0, 0], [2, 0]]), np.array([3.1, -3.1]))
    truth = Trajectory(np.array([0.25, 1.4, 1.6]), np.zeros((3, 2)), np.full(3, np.pi))
    pairs = pair(estimate, truth)
    assert pairs.estimate[:, 0] == pytest.approx([0.5, 2.0]), "held for half a second beyond the end, then left out"
    assert np.abs(np.abs(pairs.estimate_heading[0]) - np.pi) < 0.03


def test_circular_accuracy_is_the_mode_in_the_walkers_axes():
    """Errors of 1 m to the walker's left at any heading, a tenth of them outliers: CA is 1 m, the mean is not."""
    truth = track()
    random = np.random.default_rng(0)
    left = rotation(truth.heading)[:, :, 1]
    error = left + random.normal(0, 0.05, left.shape)
    error[::10] += 20.0
    estimate = Trajectory(truth.time, truth.position + error, truth.heading, truth.floor)
    assert circular_accuracy(pair(estimate, truth)) == pytest.approx(1.0, abs=0.05)


def test_obstacle_error_is_the_share_of_steps_through_walls():
    hall = shapely.box(0, 0, 10, 10).difference(shapely.box(4, 4, 6, 6))
    plan = FloorPlan("", (Area("corridor", "", hall),), Frame())
    path = np.array([[1, 1], [1, 5], [9, 5], [9, 9]], dtype=float)  # the second step cuts the pillar
    estimate = Trajectory(np.arange(4.0), path, np.zeros(4))
    assert evaluate(estimate, estimate, plan)["oe"] == pytest.approx(1 / 4)


def test_wrong_floors_lower_fe_and_are_left_out_of_ce():
    """An unknown floor does not count as wrong."""
    truth = track(10.0, 1.0, floor="F1")
    half = tuple("F2" if n < 5 else "F1" for n in range(10))
    estimate = Trajectory(truth.time, truth.position + np.outer(np.array(half) == "F2", [7, 0]), truth.heading, half)
    scores = evaluate(estimate, truth)
    assert scores["fe"] == 0.5
    assert scores["ce"]["max"] == 0
    nameless = Trajectory(truth.time, truth.position, truth.heading, ("",) * 10)
    assert evaluate(nameless, truth)["ce"]["max"] == 0
    assert evaluate(truth, nameless)["fe"] is None


def test_metrics_that_cannot_be_computed_are_none():
    truth = track(10.0, 1.0)
    headless = Trajectory(truth.time, truth.position, np.full(10, np.nan), truth.floor)
    scores = evaluate(headless, truth)
    assert scores["he"] is scores["ca"] is scores["oe"] is None
    assert "—" in table(scores)


COVARIANCES = np.array([[[1.0, 0.0], [0.0, 1.0]], [[4.0, 1.5], [1.5, 0.7]], [[25.0, 0.0], [0.0, 0.04]]])
ERRORS = np.array([[0.0, 0.0], [1.0, -0.5], [6.0, 8.0]])


@pytest.mark.parametrize("covariance", COVARIANCES)
@pytest.mark.parametrize("error", ERRORS)
def test_the_scores_are_those_of_their_definitions(error, covariance):
    """By scipy's density, and by draws of E|X - y| - E|X - X'| / 2."""
    found = log_score(error[None], covariance[None])
    assert found == pytest.approx(-multivariate_normal(np.zeros(2), covariance).logpdf(error), rel=1e-12)
    x, other = np.random.default_rng(1).multivariate_normal(error, covariance, (2, 200_000))
    drawn = np.hypot(*x.T) - 0.5 * np.hypot(*(x - other).T)
    noise = drawn.std() / np.sqrt(len(drawn))
    assert energy_score(error[None], covariance[None]) == pytest.approx(drawn.mean(), abs=4 * noise)


def test_the_energy_score_of_a_sure_estimate_is_its_error():
    error = np.array([[3.0, 4.0], [0.3, 0.0]])
    assert energy_score(error, np.tile(1e-8 * np.eye(2), (2, 1, 1))) == pytest.approx([5.0, 0.3], abs=1e-3)


@pytest.mark.parametrize("score", [log_score, energy_score])
@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_the_scores_are_proper(score, factor):
    """Errors that have the stated covariance score better than if one states more or less."""
    errors = np.random.default_rng(2).multivariate_normal(np.zeros(2), COVARIANCES[1], 5000)
    right, wrong = (score(errors, np.tile(f * COVARIANCES[1], (5000, 1, 1))).mean() for f in (1, factor))
    assert right < wrong
