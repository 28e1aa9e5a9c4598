"""Directions from a compass, and how many directions the search for a walk starts in."""

from dataclasses import replace

import numpy as np
import pytest
from walks import dead_reckon, fixes_at, square_walk, straight, wandering_walk

from pdr_graph import Headings, kalman_filter, smooth
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.priors import COMPASS, PRICES


def told(time, heading, sigma=0.2):
    time = np.atleast_1d(np.asarray(time, dtype=float))
    return Headings(time, np.resize(heading, len(time)).astype(float), np.full(len(time), sigma))


@pytest.mark.parametrize(("estimate_by", "within", "sigma"), [(smooth, 0.2, 0.25), (kalman_filter, 1.2, 0.24)])
def test_a_fix_and_a_heading_determine_a_walk(estimate_by, within, sigma):
    """The track starts at the fix in the measured direction, also by the filter, which trusts the compass."""
    steps = wandering_walk(40)
    heading = dead_reckon(steps, heading=2.0).heading
    headings = told(steps.time[20], heading[21])
    truth = dead_reckon(steps, fixes_at([0.0], [[5.0, 5.0]]), heading=2.0)
    track = estimate_by(WalkGraph(steps, fixes_at([0.0], [[5.0, 5.0]], 0.5), headings=headings)).trajectory
    assert track.position[-1] == pytest.approx(truth.position[-1], abs=within)
    assert np.sqrt(track.covariance[-1, 2, 2]) == pytest.approx(sigma, abs=0.05)


def test_headings_are_weighted_by_their_sigmas():
    """The first of two headings, of 0.1 and 0.2 rad, has four fifths of the weight in the mean direction."""
    steps = straight(30, sigma_turn=1e-4)
    outside = [-3.0, 1e4]  # [s] those are left out
    headings = Headings(np.array([2.0, 12.0, *outside]), np.array([1.0, 1.5, 3.0, 3.0]), np.array([0.1, 0.2, 0.1, 0.1]))
    graph = WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]]), headings=headings)
    assert len(graph.headings.headings) == 2
    track = smooth(graph).trajectory
    assert np.mean(track.heading) == pytest.approx(1.1, abs=0.03)


def test_a_compass_that_fixes_contradict_is_named():
    """45° off with a sigma of 11°: the walk is that of the fixes, and the estimate says to which side."""
    steps = wandering_walk(80)
    truth = dead_reckon(steps)
    fixes = fixes_at(truth.time[::10], truth.position[::10], 0.5)
    for off, sources in ((0.0, []), (np.pi / 4, ["headings"]), (np.pi, ["headings"])):
        estimate = smooth(WalkGraph(steps, fixes, headings=told(steps.time[40], truth.heading[41] + off)))
        assert np.hypot(*(estimate.trajectory.position - truth.position).T).max() < 0.5
        assert [reason.source for reason in estimate.contradictions] == sources
        assert off != np.pi / 4 or "to the left" in estimate.contradictions[0].text


def test_a_compass_that_nothing_contradicts_may_still_be_off():
    """One fix: the walk follows the compass; that one in 43 is 45° off to either side widens its direction."""
    steps = wandering_walk(80)
    graph = WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]], 0.5), headings=told(steps.time[1], 1.0))
    estimate = smooth(graph)
    [optimum] = solutions(graph)
    assert estimate.trajectory.position[-1] == pytest.approx(optimum.at.ends[-1, :2], abs=1e-6)
    assert not estimate.contradictions
    share = 2 * np.exp(-PRICES.compass_off)  # to either side
    variance = 0.2**2 + share / (1 + share) * COMPASS.off**2
    assert np.sqrt(estimate.trajectory.covariance[2, 2, 2]) == pytest.approx(np.sqrt(variance), rel=0.1)


def test_several_directions_start_the_search_unless_fixes_determine_one():
    """One fix leaves eight equally good walks; several leave one. Without any fix the start defines the frame."""
    steps = square_walk()
    assert len(solutions(WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]])))) == 8
    track = dead_reckon(steps)
    assert len(solutions(WalkGraph(steps, fixes_at(track.time[::10], track.position[::10])))) == 1
    assert len(solutions(WalkGraph(steps))) == 1


def test_the_ends_of_a_nearly_closed_walk_determine_no_direction():
    """However far drift opened its track: it starts in several directions, and its region has the truth."""
    steps = square_walk(20)
    truth = dead_reckon(steps)
    ends = fixes_at(truth.time[[0, -1]], truth.position[[0, -1]] + [[0.0, 0.0], [2.0, 0.0]], 0.5)
    drifting = replace(steps, turn=steps.turn + 0.04)
    assert np.hypot(*(dead_reckon(drifting).position[-1] - truth.position[-1])) > 12
    assert len(solutions(WalkGraph(drifting, ends))) > 1
    apart = fixes_at(truth.time[[0, 30]], truth.position[[0, 30]], 0.5)
    assert len(solutions(WalkGraph(drifting, apart))) == 1
