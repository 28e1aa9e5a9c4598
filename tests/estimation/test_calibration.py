"""Calibration of a walker by a known line or by fixes, and its use in the next walk."""

from dataclasses import replace

import numpy as np
import pytest
from plans import MAPS
from tiers import thorough
from walks import PERIOD, fixes_at, pushing, straight

from pdr_graph import InputError, WalkGraph, detect_steps, smooth
from pdr_graph.estimation.calibration import calibrate, posterior_profile, prior_of
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.floor.plan_files import read_route
from pdr_graph.gait.walker import Profile
from pdr_graph.geometry import dead_reckon, interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import MOTION, TREADS, WALKER
from pdr_graph.types import Fixes, Steps

EIGHT = MAPS / "figure_eight.geojson"


def along(route, error=(0.0, 0.0, 0.0), laps=1, step=0.7, noise=0.0, seed=0):
    """Steps of somebody who follows a line exactly, as models see them that err by E_length, E_straight, E_corner."""
    random = np.random.default_rng(seed)
    corners = np.concatenate([route, *[route[1:]] * (laps - 1)])
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    place = interpolate(np.linspace(0, way[-1], round(way[-1] / step) + 1), way, corners)
    move = np.diff(place, axis=0)
    heading = np.unwrap(np.arctan2(move[:, 1], move[:, 0]))
    E_length, E_straight, E_corner = error
    length = np.hypot(*move.T) / (1 + E_length) * (1 + noise * random.normal(size=len(move)))
    # a step goes where its middle heads: turn half before and half after
    ends = np.concatenate([heading[:1], (heading[:-1] + heading[1:]) / 2, heading[-1:]])
    turn = (np.diff(ends) - E_straight * length) / (1 + E_corner)
    n = len(move)
    time = 0.5 * np.arange(1, n + 1)
    columns = (np.full(n, 0.5), length, turn, np.zeros(n), 0.1 * length, np.full(n, 0.003))
    return Steps(0.0, float(time[-1]) + 0.1, time, *columns)


def test_the_three_coefficients_are_separable():
    """Left and right loops separate drift from turn error; the size of the figure eight determines the length."""
    route = read_route(EIGHT)
    profile, estimate, laps = calibrate(along(route, (0.08, 0.0015, 0.03), laps=4), route)
    assert laps == 4
    assert profile.E_length == pytest.approx(0.08, abs=0.01)
    assert profile.E_straight == pytest.approx(0.0015, abs=0.0007), "drawn to 0 by the prior"
    assert profile.E_corner == pytest.approx(0.03, abs=0.015)
    assert profile.residual < 0.15
    assert estimate.converged


@pytest.mark.parametrize("turned", [0.0, 2.0])
def test_the_initial_direction_does_not_matter(turned):
    """The paper names it as a cause of its errors: hips turn before the first step."""
    route, steps = read_route(EIGHT), along(read_route(EIGHT), (0.05, 0.0, 0.0))
    turn = steps.turn.copy()
    turn[0] += turned
    profile, _, _ = calibrate(replace(steps, turn=turn, pause_turn=np.eye(1, len(turn))[0] * turned), route)
    assert profile.E_length == pytest.approx(0.05, abs=0.01)


def test_a_straight_line_does_not_determine_the_turn_error():
    """A straight walk of 60 m determines length and drift; the sigma of the turn error stays that of the prior."""
    route = np.array([[0.0, 0.0], [60.0, 0.0]])
    profile, _, _ = calibrate(along(route, (0.1, 0.002, 0.0)), route)
    assert profile.E_length == pytest.approx(0.1, abs=0.02)
    assert np.sqrt(profile.covariance[2, 2]) == pytest.approx(Prior().sigma[1], rel=0.05)


@pytest.mark.parametrize("walkers", [7, thorough(20)])
def test_sigmas_are_honest(walkers):
    """Of 85 % of the simulated walkers the true stride error lies within two sigmas."""
    route, within = read_route(EIGHT), 0
    for seed in range(walkers):
        options = {"seed": seed, "plan": str(EIGHT), "phone": {"rate": 50}}
        options["route"] = [[13.0, 7.0], {"stand": 3}, {"follow": "eight"}, {"stand": 3}]
        walk = simulate(Scenario.of(options))
        steps = detect_steps(walk.recording("accelerometer", "gyroscope"))
        profile, _, _ = calibrate(steps, route)
        true = walk.body.lengths.sum() / steps.length.sum() - 1
        within += abs(profile.E_length - true) < 2 * np.sqrt(profile.covariance[0, 0])
    assert within >= 0.85 * walkers


def test_a_walk_off_the_route_is_an_input_error():
    wrong = along(np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 30.0]]))
    with pytest.raises(InputError, match="leave the route"):
        calibrate(wrong, read_route(EIGHT), "walk.csv")
    with pytest.raises(InputError, match="steps of 20 m"):
        calibrate(along(np.array([[0.0, 0.0], [20.0, 0.0]])), read_route(EIGHT), "walk.csv")
    with pytest.raises(InputError, match="at least twenty"):
        calibrate(along(np.array([[0.0, 0.0], [5.0, 0.0]])), read_route(EIGHT), "walk.csv")


def test_a_plan_without_a_line_is_no_route():
    with pytest.raises(InputError, match="'link'"):
        read_route(MAPS / "arcade.geojson")


def walked_twice(scale, drift):
    """Two walks of somebody whose steps are said too short, and the fixes of the first."""
    route = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 20.0], [0.0, 20.0], [0.0, 0.0]])
    steps = along(route, (scale, drift, 0.0), laps=2, noise=0.05)
    track = dead_reckon(Profile(scale, drift, 0.0, np.eye(3), 0, 1).corrected(steps))
    at = np.arange(0, len(track), 10)
    return steps, Fixes(track.time[at], track.position[at], np.full(len(at), 0.3), ("",) * len(at))


def test_a_walk_with_fixes_also_calibrates():
    """Its posterior is the prior of the next walk, which then has the right length with a single fix."""
    steps, fixes = walked_twice(0.15, 0.0015)
    profile = posterior_profile(smooth(WalkGraph(steps, fixes)), steps)
    assert profile.E_length == pytest.approx(0.15, abs=0.03)
    assert profile.E_straight == pytest.approx(0.0015, abs=0.0009)

    corrected = profile.corrected(steps)
    reference = smooth(WalkGraph(corrected, fixes[:1], prior=prior_of(profile))).trajectory
    unknown = smooth(WalkGraph(steps, fixes[:1])).trajectory
    way = [np.hypot(*np.diff(track.position, axis=0).T).sum() for track in (reference, unknown)]
    assert way[0] == pytest.approx(200, rel=0.03)
    assert way[1] < 0.9 * 200
    assert reference.covariance[-1, 0, 0] < unknown.covariance[-1, 0, 0]


@pytest.mark.parametrize("wrong", [-0.35, -0.2, 0.2, 0.35])
def test_a_walk_contradicts_a_profile_of_somebody_else(wrong):
    """Position errors are those without a profile; with the right profile nothing is said."""
    steps, fixes = walked_twice(0.0, 0.0)
    few = fixes[::4]
    without = smooth(WalkGraph(steps, few)).trajectory
    for E_length, reasons in ((wrong, 1), (0.0, 0)):
        profile = Profile(E_length, 0.002, 0.0, np.diag([1e-3, 1e-6, 1e-4]), 0.3, 1.3)
        estimate = smooth(WalkGraph(profile.corrected(steps), few, prior=prior_of(profile)))
        assert np.hypot(*(estimate.trajectory.position - without.position).T).max() < 0.6
        assert sum("profile does not fit" in reason.text for reason in estimate.contradictions) == reasons


def test_the_prior_of_another_walker_is_the_usual_prior_before_the_correction():
    """R_s l = R_s' (1 + E_l) l, and R_d φ + b t = R_d' ((1 + E_c) φ + E_s v t) + b' t, for drawn R_s, R_d, b."""
    profile = Profile(0.2, 0.004, -0.05, np.eye(3), 0.3, 1.3)
    another, usual = prior_of(profile).another, Prior()
    R_s, R_d, b = np.random.default_rng(0).multivariate_normal(usual.mean, usual.covariance, 100_000).T
    drawn = np.array([R_s / 1.2, R_d / 0.95, b - R_d / 0.95 * 0.004 * 1.3])
    assert another.mean == pytest.approx(drawn.mean(axis=1), abs=2e-3)
    assert another.covariance == pytest.approx(np.cov(drawn), rel=0.03, abs=5e-6)


def test_profiles_accumulate():
    """A second walk updates the profile that corrected its steps."""
    steps, fixes = walked_twice(0.15, 0.0015)
    whole = posterior_profile(smooth(WalkGraph(steps, fixes)), steps)
    half = Profile(0.08, 0.001, 0.0, np.diag([1e-3, 1e-6, 1e-4]), 0.3, 1.3)
    corrected = half.corrected(steps)
    again = posterior_profile(smooth(WalkGraph(corrected, fixes)), corrected, half)
    assert again.E_length == pytest.approx(whole.E_length, abs=0.01)
    assert again.E_straight == pytest.approx(whole.E_straight, abs=6e-4)
    assert again.E_corner == pytest.approx(whole.E_corner, abs=0.01)


def test_the_next_walk_has_at_least_the_variance_between_walks():
    """A profile widens by `WALKER.between_walks`, up to the prior without any profile."""
    exact = Profile(0.1, 0.0, 0.0, 1e-12 * np.eye(3), 0.1, 1.3)
    assert prior_of(exact).sigma == pytest.approx(WALKER.between_walks, rel=1e-3)
    vague = Profile(0.1, 0.0, 0.0, np.eye(3), 0.1, 1.3)
    assert prior_of(vague).sigma == Prior().sigma
    assert prior_of(None) == Prior()


def test_a_correlated_prior_has_the_stated_covariance():
    prior = Prior(correlation=(0.5, -0.2, 0.1))
    sigma = np.array(prior.sigma)
    assert np.sqrt(np.diag(prior.covariance)) == pytest.approx(sigma)
    assert prior.covariance[0, 1] == pytest.approx(0.5 * sigma[0] * sigma[1])
    assert prior.covariance == pytest.approx(prior.covariance.T)


BROWSED = 0.72  # of the model's stride, where the walker browses


def paces(slower, sigma_length=0.07):
    """A straight walk of 60 steps as the model has them, then 60 short ones of another pace and sigma; five fixes."""
    steps, later = straight(120), np.arange(120) >= 60
    duration = np.where(later, PERIOD + slower, PERIOD)
    time = np.cumsum(duration)
    sigma = np.where(later, sigma_length, steps.sigma_length)
    walked = dead_reckon(replace(steps, length=np.where(later, BROWSED, 1.0) * steps.length))
    steps = replace(steps, end=time[-1] + 0.4, time=time, duration=duration, sigma_length=sigma)
    at = np.array([0, 30, 60, 90, 119])
    return steps, fixes_at(time[at], walked.position[1:][at], sigma=0.5)


def test_a_change_of_pace_frees_the_stride():
    """Of a walker who browses, from the step on at which the pace changes; as fast as before it may change little."""
    scale = smooth(WalkGraph(*paces(slower=0.15))).calibration.value[:, 0]
    assert scale == pytest.approx([1.0, BROWSED], abs=0.06)
    (shared,) = smooth(WalkGraph(*paces(slower=0.0))).calibration.value[:, 0]
    assert BROWSED + 0.08 < shared < 0.92, "a control: a mean of both"


def test_stairs_are_no_change_of_pace():
    """Slower too, but a tread is as deep at any pace."""
    assert len(smooth(WalkGraph(*paces(slower=0.15, sigma_length=TREADS.sigma))).calibration.value) == 1


def test_a_live_walk_notices_a_change_of_pace_within_two_keyframes():
    """Of ten steps, after the twelve that show it; its strides are then those of the batch."""
    steps, fixes = paces(slower=0.15)
    live, found = LiveSmoother(), None
    for n in pushing(live, steps, fixes):
        if found is None and len(live.graph.window.segments) > 1:
            found = n
    assert found is not None
    assert found <= 60 + MOTION.pace_steps + 2 * MOTION.steps_per_keyframe
    window = live.graph.window
    assert [window.c[n][0] for n in window.segments][-1] == pytest.approx(BROWSED, abs=0.06)
