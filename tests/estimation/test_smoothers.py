"""The batch smoother, against independent answers."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from walks import (
    dead_reckon,
    drawn_from_the_model,
    fixes_at,
    fixes_on,
    square_walk,
    steps_of,
    wandering_walk,
)

from pdr_graph import Prior, smooth
from pdr_graph.estimation.factors import chain as chains
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.floor.cells import Area
from pdr_graph.floor.plan import FloorPlan
from pdr_graph.frames import Frame
from pdr_graph.geometry import rotation, wrap_angle
from pdr_graph.priors import MOTION, changed


def apart(first, second):
    """Greatest distance between two tracks. [m]"""
    return float(np.hypot(*(first - second).T).max())


def test_exact_measurements_are_reproduced():
    """Fixes on the dead-reckoned track itself: that track is the answer, at any place and in any direction."""
    steps = wandering_walk(120)
    truth = dead_reckon(steps, fixes_at([0], [[50.0, -30.0]]), heading=2.0)
    estimate = smooth(WalkGraph(steps, fixes_on(truth, every=20)))
    assert apart(estimate.trajectory.position, truth.position) < 1e-4
    assert wrap_angle(estimate.trajectory.heading - truth.heading) == pytest.approx(0, abs=1e-4)
    assert estimate.converged


def test_linear_case_is_kalman():
    """Straight on with a known calibration, the along-track position is a linear Gaussian chain.

    Its smoother, mean and variance, by the normal equations of that chain alone.
    """
    n, sigma_step, sigma_fix = 40, 0.1, 0.8
    steps = steps_of(np.full(n, 0.7), np.zeros(n), sigma_length=sigma_step, sigma_turn=1e-4)
    random = np.random.default_rng(1)
    at = np.array([5, 17, 39])
    measured = 0.7 * (at + 1) + random.normal(0, sigma_fix, 3)
    fixes = fixes_at(steps.time[at], np.stack([measured, np.zeros(3)], axis=1), sigma_fix)
    certain = Prior(sigma=(1e-4, 1e-4, 1e-6), change=(1e-4, 1e-4, 1e-6))
    estimate = smooth(WalkGraph(steps, fixes, prior=certain))

    moves = np.diff(np.eye(n + 1), axis=0) / np.hypot(sigma_step, chains.SIGMA_STILL)
    A = np.concatenate([moves, np.eye(n + 1)[at + 1] / sigma_fix])
    y = np.concatenate([np.full(n, 0.7) / np.hypot(sigma_step, chains.SIGMA_STILL), measured / sigma_fix])
    information = A.T @ A
    expected, variance = np.linalg.solve(information, A.T @ y), np.diag(np.linalg.inv(information))
    assert estimate.trajectory.position[:-1, 0] == pytest.approx(expected, abs=1e-3)
    assert estimate.trajectory.covariance[:-1, 0, 0] == pytest.approx(variance, rel=1e-2)


@pytest.mark.parametrize("seed", range(3))
def test_keyframes_keep_the_optimum(seed):
    """Ten steps per keyframe give the walk that a keyframe per step gives, within a tenth of its own uncertainty.

    Measured: 2 to 5 cm, where a position is uncertain by 1 m. It is not exact, since between keyframes the bridge is
    linear in the interval's left-over.
    """
    steps, fixes, _ = drawn_from_the_model(150, seed)
    coarse = smooth(WalkGraph(steps, fixes))
    with changed(MOTION, steps_per_keyframe=1):
        fine = smooth(WalkGraph(steps, fixes))
    assert coarse.cost == pytest.approx(fine.cost, rel=0.02)
    sigma = np.sqrt(fine.trajectory.covariance[:, 0, 0]).min()
    assert apart(coarse.trajectory.position, fine.trajectory.position) < 0.1 * sigma
    ratio = coarse.trajectory.covariance[:, 0, 0] / fine.trajectory.covariance[:, 0, 0]
    assert ratio == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("angle", [0.3, 2.0, -2.5])
def test_rotating_the_world_rotates_the_track(angle):
    """Turning map and fixes about the origin turns track and covariance, and changes nothing else."""
    steps, fixes, _ = drawn_from_the_model(80, seed=2)
    R = rotation(angle)
    area = shapely.box(-40, -60, 70, 68)
    turned_area = shapely.transform(area, lambda xy: xy @ R.T)
    plans = [FloorPlan("", (Area("corridor", "", a),), Frame()) for a in (area, turned_area)]
    single = smooth(WalkGraph(steps, fixes, floor=plans[0]))
    other = smooth(WalkGraph(steps, replace(fixes, position=fixes.position @ R.T), floor=plans[1]))
    # 5 cm: the distance grid is not turned with the walls, so that a stiff wall just holds a step, or just does not
    assert apart(single.trajectory.position @ R.T, other.trajectory.position) < 0.05
    of_position = R @ single.trajectory.covariance[:, :2, :2] @ R.T
    assert other.trajectory.covariance[:, :2, :2] == pytest.approx(of_position, rel=0.05, abs=0.08)


def test_a_fix_acts_at_its_own_time():
    """A sharp fix between two steps: the track passes through it at that very moment."""
    steps = square_walk(side=10)
    truth = dead_reckon(steps)
    at = 0.5 * (truth.time[7] + truth.time[8])
    fixes = fixes_on(truth, every=12)
    sharp = fixes_at([*fixes.time, at], [*fixes.position, truth.position[[7, 8]].mean(axis=0)], 0.01)
    track = smooth(WalkGraph(steps, sharp)).trajectory
    here = [np.interp(at, track.time, axis) for axis in track.position.T]
    assert here == pytest.approx(truth.position[[7, 8]].mean(axis=0), abs=0.02)


def test_scale_turn_and_drift_are_estimated_from_fixes():
    """Steps 10 % too short, turns 3 % too small, a gyro drift of 3 mrad/s: the calibration finds all three."""
    side, drift = 10, 0.003
    turn = np.where(np.arange(12 * 4 * side) % side == side - 1, np.pi / 2, 0.0)
    turn[np.arange(len(turn)) // (4 * side) % 2 == 1] *= -1  # a figure of eight: left laps and right laps
    steps = steps_of(np.full(len(turn), 0.7), turn, sigma_turn=0.003)
    truth = dead_reckon(steps)
    measured = replace(steps, length=steps.length / 1.1, turn=(steps.turn - drift * steps.duration) / 1.03)
    estimate = smooth(WalkGraph(measured, fixes_on(truth, every=8, sigma=0.3)))
    assert apart(estimate.trajectory.position, truth.position) < 0.4
    mean = estimate.calibration.value.mean(axis=0)
    assert mean[:2] == pytest.approx([1.1, 1.03], abs=0.01)
    assert mean[2] == pytest.approx(drift, abs=0.0005)
    assert estimate.calibration.learnt.any(axis=0).all()


def test_two_fixes_leave_the_drift_unobservable_with_a_warning():
    steps = steps_of(np.full(150, 0.7), np.zeros(150))
    truth = dead_reckon(steps)
    estimate = smooth(WalkGraph(steps, fixes_at(truth.time[[0, -1]], truth.position[[0, -1]], 0.5)))
    assert any("gyro drift b not observable from this walk: prior kept" in w for w in estimate.warnings)
    assert estimate.calibration.learnt[:, 0].all(), "two fixes measure the scale"
    sideways = np.sqrt(estimate.trajectory.covariance[:, 1, 1])
    assert sideways[75] > 2 * sideways[0], "mid-walk is where two ends know least"


def test_loop_closes_on_itself():
    """First and last fix 0.4 m apart after a lap of 56 m: no scale is read off their distance, no explosion.

    Any direction explains both fixes; the covariance must span them.
    """
    steps = square_walk(side=20)
    fixes = fixes_at([0.0, steps.end], [[10.0, 5.0], [10.3, 5.3]], 0.5)
    estimate = smooth(WalkGraph(steps, fixes))
    track = estimate.trajectory.position
    assert np.hypot(*(track - [10, 5]).T).max() < 25.0
    way = np.hypot(*np.diff(track, axis=0).T).sum()
    assert way == pytest.approx(56, rel=0.1)
    farthest = np.argmax(np.hypot(*(track - [10, 5]).T))
    assert np.sqrt(np.trace(estimate.trajectory.covariance[farthest, :2, :2])) > 15.0
    assert any("different walks" in w for w in estimate.warnings)


def test_one_fix_determines_the_position_but_no_direction():
    """The true walk went the other way: two walk lengths off, and within what the covariance admits."""
    steps = steps_of(np.full(30, 0.7), np.zeros(30))
    estimate = smooth(WalkGraph(steps, fixes_at([0.0], [[7.0, 8.0]], 1.0)))
    assert estimate.trajectory.position[0] == pytest.approx([7.0, 8.0], abs=0.01)
    assert any("direction of the walk is unknown" in w for w in estimate.warnings)
    end, covariance = estimate.trajectory.position[-1], estimate.trajectory.covariance[-1, :2, :2]
    for angle in np.linspace(0, 2 * np.pi, 12):
        gap = [7.0, 8.0] + 21.0 * np.array([np.cos(angle), np.sin(angle)]) - end
        assert gap @ np.linalg.solve(covariance, gap) < 9.2  # 99 % of two dimensions


def test_without_a_fix_the_start_defines_the_frame():
    steps = wandering_walk(30)
    estimate = smooth(WalkGraph(steps))
    assert estimate.trajectory.position == pytest.approx(dead_reckon(steps).position, abs=1e-6)
    assert np.sqrt(estimate.trajectory.covariance[0, 0, 0]) < 0.01
    assert any("no position fix" in w for w in estimate.warnings)


def test_without_a_step_the_walker_stays():
    steps = steps_of(np.empty(0), np.empty(0))
    estimate = smooth(WalkGraph(steps, fixes_at([0.2, 0.9], [[1.0, 2.0], [1.2, 2.2]], 0.5)))
    assert len(estimate.trajectory) == 2
    assert estimate.trajectory.position == pytest.approx(np.array([[1.1, 2.1]] * 2), abs=0.02)


def test_an_outlier_is_reported_and_not_followed():
    """One fix of thirteen is 80 m off: it has almost no weight, with the reason, and the walk hardly moves."""
    steps, fixes, truth = drawn_from_the_model(200, seed=8)
    wild = replace(fixes, position=fixes.position + np.outer(np.arange(len(fixes)) == 6, [60.0, 53.0]))
    clean, estimate = smooth(WalkGraph(steps, fixes)), smooth(WalkGraph(steps, wild))
    assert len(estimate.fixes) == len(fixes)
    assert estimate.fixes[6].weight < 0.001
    assert "outlier" in estimate.fixes[6].reason
    assert estimate.fixes[6].residual == pytest.approx(80, abs=5)
    assert min(f.weight for n, f in enumerate(estimate.fixes) if n != 6) > 0.5
    assert apart(estimate.trajectory.position, clean.trajectory.position) < 2.5
    assert apart(estimate.trajectory.position, truth.position) < 6.0


def test_fixes_outside_the_recording():
    """Half a second before the start, a fix acts there with a wider sigma; a minute after the end it is not used."""
    steps = wandering_walk(40)
    truth = dead_reckon(steps)
    fixes = fixes_at([-0.5, 10.0, steps.end + 60], [*truth.position[[0, 18]], [99.0, 99.0]], 0.5)
    graph = WalkGraph(steps, fixes)
    estimate = smooth(graph)
    assert graph.positions.sigma[0] == pytest.approx(np.hypot(0.5, 0.7))
    assert estimate.fixes[2].weight == 0.0
    assert "outside" in estimate.fixes[2].reason
    assert any("outside" in w for w in estimate.warnings)


@pytest.mark.parametrize("late", [True, False])
def test_a_fix_outside_the_recording_has_a_wider_sigma(late):
    """Two seconds before the start or after the end, the walker may have been 2.8 m away."""
    steps = wandering_walk(30)
    track = dead_reckon(steps)
    at = steps.end + 2.0 if late else -2.0
    row = -1 if late else 0
    fixes = fixes_at([at] if late else [at, steps.time[10]], track.position[[row] if late else [0, 11]], 0.1)
    report = smooth(WalkGraph(steps, fixes))
    sigma = np.sqrt(np.linalg.eigvalsh(report.trajectory.covariance[row, :2, :2]))
    assert sigma.max() > 2.0


def test_unobserved_calibration_uncertainty_grows_with_the_walk():
    """R_s, R_d and b walk randomly from segment to segment: the prior's variance adds a change for each."""
    prior = Prior()
    calibration = smooth(WalkGraph(wandering_walk(350), fixes_at([0.0], [[0.0, 0.0]]))).calibration
    segments = np.arange(len(calibration.start))[:, None]
    assert len(segments) == 4
    expected = np.square(prior.sigma) + segments * np.square(prior.change)
    assert np.square(calibration.prior_sigma) == pytest.approx(expected)
    assert np.square(calibration.sigma) == pytest.approx(expected, rel=1e-3)
    assert not calibration.learnt.any()


def test_a_pause_hardly_changes_the_heading_sigma():
    """Nine pauses of a minute with a perfect gyro: 0.02 rad each."""
    steps = square_walk(laps=2)
    shift = 60.0 * (np.arange(len(steps)) // 16)
    paused = replace(steps, time=steps.time + shift, end=steps.end + shift[-1])
    no_drift = Prior(sigma=(0.2, 1e-3, 1e-6), change=(0.03, 1e-3, 1e-7))

    def variance_gained(walk):
        fix = fixes_at([0.0], [[0.0, 0.0]])
        heading = smooth(WalkGraph(walk, fix, prior=no_drift)).trajectory.covariance[:, 2, 2]
        return heading[-1] - heading[0]

    assert variance_gained(paused) - variance_gained(steps) == pytest.approx(9 * 0.02**2, rel=0.1)


def test_walls_keep_a_drifting_walk_in_its_corridor():
    """A straight corridor 2 m wide, a gyro that drifts: without walls the track leaves it, with them it stays."""
    steps = steps_of(np.full(100, 0.7), np.full(100, 0.004))
    corridor = FloorPlan("", (Area("corridor", "", shapely.box(-2, -1, 75, 1)),), Frame())
    fixes = fixes_at([0.0, steps.time[7]], [[0.0, 0.0], [5.6, 0.0]], 0.3)
    free, held = (smooth(WalkGraph(steps, fixes, floor=f)).trajectory.position for f in (None, corridor))
    assert np.abs(free[:, 1]).max() > 4
    assert np.abs(held[:, 1]).max() < 1
    assert not corridor.crosses_wall(held[:-1], held[1:]).any()


def test_long_walks_do_not_overflow():
    """30 000 steps, where GTSAM's default ordering overflows the stack; fixes 3 m, error well below."""
    steps, fixes, truth = drawn_from_the_model(30_000, seed=1, every=30)
    estimate = smooth(WalkGraph(steps, fixes))
    error = np.hypot(*(estimate.trajectory.position - truth.position).T)
    assert np.sqrt(np.mean(error**2)) < 3.0
