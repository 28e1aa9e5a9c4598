"""The batch smoother, and what the live smoother, the Kalman filter and its smoother have in common with it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from plans import plan
from walks import (
    dead_reckon,
    drawn_from_the_model,
    fixes_at,
    fixes_on,
    live_track,
    part,
    pushed,
    pushing,
    square_walk,
    steps_of,
    straight,
    wandering_walk,
)

from pdr_graph import Headings, Prior, kalman_filter, kalman_smoother, smooth
from pdr_graph.estimation.factors import chain as chains
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.geometry import interpolate, rotation, wrap_angle
from pdr_graph.priors import MOTION, WALKER, changed
from pdr_graph.types import Fixes


def batch_track(steps, fixes=None, prior=None):
    return smooth(WalkGraph(steps, fixes, prior=prior)).trajectory


ENGINES = pytest.mark.parametrize("track_of", [batch_track, live_track])


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


@ENGINES
def test_linear_case_is_kalman(track_of):
    """Straight on with a known calibration, the along-track position is a linear Gaussian chain.

    Its smoother, mean and variance, by the normal equations of that chain alone.
    """
    steps, fixes, prior = linear_walk()
    track, (mean, variance) = track_of(steps, fixes, prior), chain_of(fixes, len(steps))
    assert track.position[: len(mean), 0] == pytest.approx(mean, abs=2e-3)
    assert track.covariance[: len(mean), 0, 0] == pytest.approx(variance, rel=1e-2)


def test_in_the_linear_case_the_belief_of_a_walk_under_way_is_the_kalman_filter():
    """Four steps after the last fix, as the filter knows it."""
    steps, fixes, prior = linear_walk()
    live, now = LiveSmoother(prior), 37
    for n in pushing(live, steps, fixes):
        if n == now:
            belief = live.output.belief()
    mean, variance = chain_of(fixes, now)
    assert belief.mean[0] == pytest.approx(mean[-1], abs=2e-3)
    assert belief.covariance[0, 0] == pytest.approx(variance[-1], rel=1e-2)


SIGMA_STEP, SIGMA_FIX = 0.1, 0.8  # [m] of the linear walk


def linear_walk():
    steps = straight(40, sigma_length=SIGMA_STEP, sigma_turn=1e-4)
    along = 0.7 * np.array([6, 18, 34]) + np.random.default_rng(1).normal(0, SIGMA_FIX, 3)
    fixes = fixes_at(steps.time[[5, 17, 33]], np.stack([along, np.zeros(3)], axis=1), SIGMA_FIX)
    return steps, fixes, Prior(sigma=(1e-4, 1e-4, 1e-6), change=(1e-4, 1e-4, 1e-6))


def chain_of(fixes, until):
    """Mean and variance of the positions until a step, which Gaussian steps and fixes determine."""
    sigma, every = np.hypot(SIGMA_STEP, chains.SIGMA_STILL), np.eye(until + 1)
    A = np.concatenate([np.diff(every, axis=0) / sigma, every[[6, 18, 34]] / SIGMA_FIX])
    y = np.concatenate([np.full(until, 0.7) / sigma, fixes.position[:, 0] / SIGMA_FIX])
    return np.linalg.solve(A.T @ A, A.T @ y), np.diag(np.linalg.inv(A.T @ A))


@ENGINES
def test_one_fix_determines_the_position_but_no_direction(track_of):
    """The walk may have gone any way, and the covariance of its end admits all."""
    track = track_of(straight(30), fixes_at([0.0], [[7.0, 8.0]], 1.0))
    assert track.position[0] == pytest.approx([7.0, 8.0], abs=0.01)
    assert track.covariance[-1, 2, 2] > 1.0
    end, covariance = track.position[-1], track.covariance[-1, :2, :2]
    for angle in np.linspace(0, 2 * np.pi, 12):
        gap = [7.0, 8.0] + 21.0 * np.array([np.cos(angle), np.sin(angle)]) - end
        assert gap @ np.linalg.solve(covariance, gap) < 9.2  # 99 % of two dimensions


def test_that_one_fix_determines_no_direction_is_said():
    steps, fix = straight(60), fixes_at([0.3], [[7.0, 8.0]], 1.0)
    assert any("direction of the walk is unknown" in w for w in smooth(WalkGraph(steps, fix)).warnings)
    assert not pushed(LiveSmoother(lag=60.0), steps, fix).sure


@pytest.mark.parametrize("method", [smooth, kalman_filter, kalman_smoother, None])
def test_without_a_fix_the_start_defines_the_frame(method):
    """The walk is that of the steps, of the live smoother too."""
    steps = wandering_walk(150)
    if method is None:
        track = live_track(steps, lag=60.0)
    else:
        estimate = method(WalkGraph(steps))
        assert any("no position fix" in w for w in estimate.warnings)
        track = estimate.trajectory
        assert np.sqrt(track.covariance[0, 0, 0]) < 0.01
    assert track.position == pytest.approx(dead_reckon(steps).position, abs=1e-6)


@ENGINES
def test_without_a_step_the_walker_stays(track_of):
    steps = replace(steps_of(np.empty(0), np.empty(0)), end=10.0)
    track = track_of(steps, fixes_at([2.0, 9.0], [[1.0, 2.0], [1.2, 2.2]], 0.5))
    assert len(track) == 2
    assert track.position[-1] == pytest.approx([1.1, 2.1], abs=0.02)


def test_a_fix_just_outside_the_recording_has_a_wider_sigma():
    """By 1.4 m/s: half a second before the start and two after the end it acts there; a minute after the end not."""
    steps = wandering_walk(40)
    place = dead_reckon(steps).position[[0, 18, -1, -1]]
    graph = WalkGraph(steps, fixes_at([-0.5, 10.0, steps.end + 2, steps.end + 60], place, 0.5))
    estimate = smooth(graph)
    assert graph.positions.sigma[:3] == pytest.approx(np.hypot(0.5, [0.7, 0.0, 2.8]))
    assert [fix.weight > 0 for fix in estimate.fixes] == [True, True, True, False]
    assert "outside" in estimate.fixes[3].reason
    assert any("outside" in w for w in estimate.warnings)


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
    single = smooth(WalkGraph(steps, fixes, floor=plan(("corridor", area))))
    turned = replace(fixes, position=fixes.position @ R.T)
    other = smooth(WalkGraph(steps, turned, floor=plan(("corridor", turned_area))))
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
    steps = straight(150)
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


def test_unobserved_calibration_uncertainty_grows_with_the_walk():
    """R_s, R_d and b walk randomly from segment to segment: the prior's variance adds a change for each."""
    prior = Prior()
    with changed(WALKER, drifting=1e-9):  # the heavy tail of b is no variance
        calibration = smooth(WalkGraph(wandering_walk(350), fixes_at([0.0], [[0.0, 0.0]]))).calibration
    segments = np.arange(len(calibration.start))[:, None]
    assert len(segments) == 4
    expected = np.square(prior.sigma) + segments * np.square(prior.change)
    assert np.square(calibration.prior_sigma) == pytest.approx(expected)
    assert np.square(calibration.sigma) == pytest.approx(expected, rel=1e-3)
    assert not calibration.learnt.any()


def test_walls_keep_a_drifting_walk_in_its_corridor():
    """A straight corridor 2 m wide, a gyro that drifts: without walls the track leaves it, with them it stays."""
    steps = steps_of(np.full(100, 0.7), np.full(100, 0.004))
    corridor = plan(("corridor", shapely.box(-2, -1, 75, 1)))
    fixes = fixes_at([0.0, steps.time[7]], [[0.0, 0.0], [5.6, 0.0]], 0.3)
    free, held = (smooth(WalkGraph(steps, fixes, floor=f)).trajectory.position for f in (None, corridor))
    assert np.abs(free[:, 1]).max() > 4
    assert np.abs(held[:, 1]).max() < 1
    assert not corridor.crosses_wall(held[:-1], held[1:]).any()


# The Kalman filter and its smoother


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
    with changed(WALKER, drifting=1e-9):  # the filter has no heavy tail
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


def linear_chain(steps: int = 240, seed: int = 1) -> WalkGraph:
    """A straight walk in a direction that is known well, with noisy fixes now and then: a linear Gaussian chain.

    Its strides are those expected, about which their prior, of log R_s, is linear.
    """
    walked = straight(steps, sigma_length=0.1, sigma_turn=1e-4)
    random = np.random.default_rng(seed)
    at = np.arange(20, steps, 45)
    place = np.stack([0.7 * (at + 1), np.zeros(len(at))], axis=1) + random.normal(0, 0.8, (len(at), 2))
    direction = Headings(np.zeros(1), np.zeros(1), np.full(1, 1e-4))
    stiff = Prior(sigma=(0.1, 1e-4, 1e-6), change=(0.03, 1e-5, 1e-7))
    return WalkGraph(walked, fixes_at(walked.time[at], place, 0.8), headings=direction, prior=stiff)


def test_in_the_linear_case_it_equals_the_graph():
    """Straight on in a known direction, the stride unknown and changing: means and covariances of every step agree.

    Two ways to one answer that share no code but the cutting of the walk.
    """
    graph = linear_chain()
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
    """In any direction of (x, y, θ): the filter's covariance less the smoother's has no negative eigenvalue.

    Within one calibration: later ones begin after so many steps in the filter, and are of equal length in the smoother.
    """
    steps, fixes, _ = drawn_from_the_model(MOTION.steps_per_segment - 1, seed)
    causal, smoothed = (method(WalkGraph(steps, fixes)).trajectory for method in (kalman_filter, kalman_smoother))
    assert np.linalg.eigvalsh(causal.covariance - smoothed.covariance).min() > -1e-4, "hypotheses of a millionth aside"
    assert smoothed.position[-1] == pytest.approx(causal.position[-1])


def test_the_filter_is_back_at_the_fix_after_a_wrong_one():
    """A fix of 1.5 m each 12 s, the third 12 m off: from the next on within 2.5 m for three quarters of the time."""
    apart = []
    for seed in range(8):
        steps, _, truth = drawn_from_the_model(200, seed)
        time = np.arange(0.5, steps.end, 12.0)
        place = interpolate(time, truth.time, truth.position)
        place += np.random.default_rng(seed).normal(0, 1.0, place.shape)
        place[2] += [-9.0, 8.0]
        track = kalman_filter(WalkGraph(steps, fixes_at(time, place, 1.5))).trajectory
        later = track.time > time[3]
        off = track.position - interpolate(track.time, truth.time, truth.position)
        apart.append(np.hypot(*off[later].T))
    assert np.percentile(np.concatenate(apart), 75) < 2.5


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


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), cuts=st.lists(st.integers(1, 219), max_size=4, unique=True))
def test_any_split_of_a_walk_gives_the_chain_and_the_factors_of_the_whole(seed, cuts):
    steps, fixes, _ = drawn_from_the_model(220, seed % 100, every=7)
    whole, graph = WalkGraph(steps, fixes), None
    for begin, end in itertools.pairwise([0, *sorted(cuts), len(steps)]):
        chunk = part(steps, begin, end)
        rows = fixes[(fixes.time <= chunk.end) & (fixes.time > (chunk.start if begin else -np.inf))]
        rows = fixes[fixes.time > chunk.start] if end == len(steps) and begin else rows
        graph = WalkGraph(chunk, rows) if graph is None else graph.extended(chunk, [rows] if len(rows) else [])
    assert graph.chain.time == pytest.approx(whole.chain.time, abs=1e-12)
    assert graph.chain.delta == pytest.approx(whole.chain.delta, abs=1e-12)
    assert graph.chain.bridge.root == pytest.approx(whole.chain.bridge.root, rel=1e-12)
    assert (graph.chain.segment == whole.chain.segment).all()
    at, expected = graph.evaluate(whole.start), whole.evaluate(whole.start)
    for block, other in zip(at.blocks, expected.blocks, strict=True):
        assert block.residual == pytest.approx(other.residual, abs=1e-12)
        assert [rows.tolist() for _, rows in block.variables] == [rows.tolist() for _, rows in other.variables]


def test_a_walk_that_goes_on_begins_at_its_estimate():
    """A measurement of the past has a keyframe on the way."""
    steps, fixes, _ = drawn_from_the_model(200, 3)
    early = fixes.time <= steps.time[99]
    first = smooth(WalkGraph(part(steps, 0, 100), fixes[early])).graph
    late = Fixes(np.array([steps.time[40] + 0.1]), np.zeros((1, 2)), np.array([1e3]), ("",))
    graph = first.extended(part(steps, 100, 200), [fixes[~early], late])
    _, before, after = np.intersect1d(first.chain.time, graph.chain.time, return_indices=True)
    assert len(before) > len(fixes[early])
    assert graph.start.poses[after] == pytest.approx(first.start.poses[before], abs=1e-9)
    assert np.abs(graph.chain.time - late.time[0]).min() < 1e-6
    with pytest.raises(ValueError, match="where those before end"):
        first.extended(part(steps, 120, 200))


@pytest.mark.parametrize("estimate", [kalman_filter, kalman_smoother])
def test_a_filter_uses_all_of_more_than_a_thousand_fixes(estimate):
    """They are known before the first step, and all wait for the steps of their time."""
    steps, fixes, truth = drawn_from_the_model(1300, seed=1, every=1)
    found = estimate(WalkGraph(steps, fixes))
    assert all(fix.weight > 0 for fix in found.fixes[:100])
    assert np.hypot(*(found.trajectory.position[50:300] - truth.position[50:300]).T).max() < 10
