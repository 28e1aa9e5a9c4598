"""A floor plan that does not fit the walk is said, and its walls are not used."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from plans import MAPS, corridors
from walks import fixes_at, straight

import pdr_graph as pdr
from pdr_graph import Headings, smooth
from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.estimation.ambiguity.bank import probabilities
from pdr_graph.estimation.ambiguity.plan_hypotheses import joint_solutions
from pdr_graph.geometry import interpolate

ARCADE, LOOP = MAPS / "arcade.geojson", MAPS / "loop.geojson"


@pytest.fixture(scope="module")
def arcade():
    """A walk of 40 s through the arcade: its steps, true trajectory and plan."""
    route = [[2.5, 18.0], {"stand": 2}, {"to": [[6.8, 18.2], [6.8, 27.8], [27.6, 27.6], [27.9, 8.0]]}, {"stand": 2}]
    made = pdr.simulate(pdr.Scenario.of({"route": route, "plan": str(ARCADE), "phone": {"rate": 50}}))
    return pdr.detect_steps(made.recording("accelerometer", "gyroscope")), made.truth, pdr.FloorPlan.load(ARCADE)


def fixes(truth, count=5):
    time = np.linspace(1.0, truth.time[-1] - 2, count)
    return fixes_at(time, interpolate(time, truth.time, truth.position), 1.0)


def displaced(plan, east):
    moved = (replace(area, shape=shapely.affinity.translate(area.shape, east)) for area in plan.areas)
    return replace(plan, areas=tuple(moved))


def error(estimate, truth):
    track = estimate.trajectory
    return np.hypot(*(track.position - interpolate(track.time, truth.time, truth.position)).T)


def reasons(estimate, source):
    return [reason for reason in pdr.verdict(estimate).reasons if reason.source == source]


def test_between_right_walls_the_walk_without_them_has_less_than_a_hundredth(arcade):
    steps, truth, plan = arcade
    optima = joint_solutions(pdr.WalkGraph(steps, fixes(truth), floor=plan))
    weight = probabilities(optima, np.arange(len(optima)))
    assert optima[0].graph.walled
    assert sum(w for w, optimum in zip(weight, optima, strict=True) if not optimum.graph.walled) < 0.01


def test_a_plan_six_metres_off_is_named_and_its_walls_are_not_used(arcade):
    steps, truth, plan = arcade
    wrong = pdr.smooth(pdr.WalkGraph(steps, fixes(truth), floor=displaced(plan, 6.0)))
    without = pdr.smooth(pdr.WalkGraph(steps, fixes(truth)))
    assert wrong.probability > 0.9, "the fixes determine the route, and five of them within a metre make it sure"
    assert error(wrong, truth).mean() < 2
    assert wrong.trajectory.position == pytest.approx(without.trajectory.position)
    [reason] = reasons(wrong, "plan")
    assert "does not fit the walk" in reason.text
    assert reason.state == "doubtful"
    assert reason.amount > 0.9


def test_from_one_fix_a_walk_that_does_not_fit_has_a_wide_region_and_a_low_probability():
    """60 m straight on, where the plan has 20 m: plan or step count is incomplete."""
    heading = Headings(np.array([10.0]), np.array([0.0]), np.array([0.2]))
    floor = corridors([(0, 0), (20, 0)], [(0, 0), (0, 20)], width=3.0)
    walk = smooth(pdr.WalkGraph(straight(86), fixes_at([0.0], [[0.0, 0.0]], 0.5), headings=heading, floor=floor))
    end, spread = walk.trajectory.position[-1], np.sqrt(np.diag(walk.trajectory.covariance[-1])[:2])
    assert reasons(walk, "plan")
    assert walk.probability < 0.5
    assert end == pytest.approx([60, 0], abs=3.0)
    assert np.all(spread > [1.0, 4.0])


def test_a_start_seven_metres_off_may_be_the_plan_s_displacement_as_well(arcade):
    """Nothing else says which of the two is wrong: the region holds both."""
    steps, truth, plan = arcade
    at = np.array([4.0, 20.0])
    headings = Headings(at, np.interp(at, truth.time, np.unwrap(truth.heading)), np.full(2, 0.2))
    start = fixes(truth, 1)
    away = replace(start, position=start.position + np.array([0.0, 7.0]))
    walk = smooth(pdr.WalkGraph(steps, away, headings=headings, floor=plan))
    assert reasons(walk, "plan")
    assert coverage(walk.trajectory, truth) > 0.85


@pytest.mark.parametrize("method", [smooth, pdr.kalman_filter])
def test_the_probability_of_a_walk_beside_the_plan_is_zero_in_python_too(arcade, method):
    steps, truth, plan = arcade
    assert method(pdr.WalkGraph(steps, fixes(truth), floor=displaced(plan, 900.0))).probability == 0
    assert method(pdr.WalkGraph(steps, fixes(truth), floor=plan)).probability > 0.9


@pytest.fixture(scope="module")
def laps():
    """Seven laps of a corridor in 12 min: steps, true trajectory and plan."""
    corners = [[1.25, 1.25], [43.75, 1.25], [43.75, 26.75], [1.25, 26.75]]
    route = [corners[0], {"stand": 5}, *({"to": [*corners[1:], corners[0]]} for _ in range(7))]
    made = pdr.simulate(pdr.Scenario.of({"route": route, "plan": str(LOOP), "phone": {"rate": 50}}))
    return pdr.detect_steps(made.recording("accelerometer", "gyroscope")), made.truth, pdr.FloorPlan.load(LOOP)


def noisy_fixes(truth, east=0.0, north=0.0):
    time = np.arange(10.0, truth.time[-1], 60.0)
    noise = np.random.default_rng(0).normal(0, 3, (len(time), 2))
    return fixes_at(time, interpolate(time, truth.time, truth.position) + noise + [east, north], 3.0)


def test_what_right_walls_add_in_many_corridors_does_not_make_a_plan_wrong(laps):
    steps, truth, plan = laps
    walk = pdr.smooth(pdr.WalkGraph(steps, noisy_fixes(truth), floor=plan))
    assert pdr.verdict(walk).state == "ok"
    assert np.median(error(walk, truth)) < 0.8


@pytest.mark.thorough
def test_in_many_corridors_a_plan_five_metres_off_is_named(laps):
    steps, truth, plan = laps
    walk = pdr.smooth(pdr.WalkGraph(steps, noisy_fixes(truth, 4.0, 3.0), floor=plan))
    assert reasons(walk, "plan")
