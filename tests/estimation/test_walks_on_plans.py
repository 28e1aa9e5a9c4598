"""Where on its plan a walk is and how probable that is, and a plan that does not fit the walk."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from plans import MAPS, corridors
from simulated import scenario_walk, walk_in_the_arcade
from walks import distances, fixes_at, steps_of, straight

from pdr_graph import Building, FloorPlan, Headings, WalkGraph, detect_steps, kalman_filter, smooth
from pdr_graph.apps.report.evaluation import coverage
from pdr_graph.estimation.ambiguity.bank import paths, probabilities
from pdr_graph.estimation.ambiguity.path_modes import solutions
from pdr_graph.estimation.ambiguity.plan_hypotheses import begun_on, joint_solutions
from pdr_graph.estimation.smoother import estimated
from pdr_graph.estimation.verdict import verdict
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.priors import SEARCH
from pdr_graph.types import Fixes, Recording
from pdr_graph.walk import Evidence, estimate, observe

ARCADE, LOOP = MAPS / "arcade.geojson", MAPS / "loop.geojson"


def error(estimate, truth):
    return distances(estimate.trajectory, truth)


def aisles(*ends):
    """Aisles from the origin to each of the ends."""
    return corridors(*([(0, 0), end] for end in ends), width=3.0)


def straight_on(metres, floor, headings=None):
    """A straight walk from the origin, of which the direction is not known without headings."""
    steps = straight(round(metres / 0.7))
    return WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]], 0.5), headings=headings, floor=floor)


def test_two_mirror_images_have_half_the_probability_each():
    """Less what is kept for ways that nobody found, 1 %, and what the chance of the particles leaves of symmetry."""
    estimate = smooth(straight_on(28, aisles((50, 0), (-50, 0))))
    assert estimate.probability == pytest.approx(0.5, abs=0.05)
    assert any("different walks" in w for w in estimate.warnings)


def test_a_compass_distinguishes_mirror_images():
    headings = Headings(np.array([10.0]), np.array([np.pi]), np.array([0.35]))
    estimate = smooth(straight_on(28, aisles((50, 0), (-50, 0)), headings))
    assert estimate.probability > 0.9
    assert estimate.trajectory.position[-1, 0] == pytest.approx(-28, abs=2.0)


def test_a_walk_longer_than_one_aisle_is_in_the_other():
    estimate = smooth(straight_on(42, aisles((60, 0), (0, 20))))
    assert estimate.probability > 0.9
    assert estimate.trajectory.position[-1] == pytest.approx([42, 0], abs=3.0)


def test_a_repeated_solution_adds_no_probability():
    """Both together are as likely as the one, and what is left is that of a way which nobody found."""
    optima = solutions(straight_on(28, aisles((50, 0))))[:1]
    once, twice = (probabilities(many, paths(many)) for many in (optima, 2 * optima))
    assert once == pytest.approx(1 / (1 + np.exp(optima[0].surprise - optima[0].unseen)))
    assert once > 0.98
    assert twice == pytest.approx(np.full(2, once[0] / 2))


def test_missed_paths_have_a_probability_only_on_a_plan():
    """Without walls the search starts in all directions, so nothing is missed."""
    optima = solutions(straight_on(28, None))
    assert probabilities(optima, paths(optima)).sum() == pytest.approx(1.0)
    optima = solutions(straight_on(28, aisles((50, 0))))
    assert 0 < 1 - probabilities(optima, paths(optima)).sum() < 2 * np.exp(-SEARCH.unseen)


def test_a_walk_that_fits_nothing_at_all_has_a_probability():
    """The live search for a place divides by it: `replay` of a real walk on a plan without a position ended there."""
    optima = [SimpleNamespace(surprise=surprise, unseen=SEARCH.unseen) for surprise in (6e8, 7e8)]
    share = probabilities(optima, np.array([0, 1]))
    assert (share > 0).all()
    assert share.sum() < 1e-9


# Without any position

TURN = np.pi / 2
RING = [(0, 0), (30, 0), (30, 18), (0, 18), (0, 0)]  # [m]


def demo():
    """The plan of the arcade, the steps of a walk in it, and its truth."""
    made, steps = scenario_walk("arcade")
    return FloorPlan.load(ARCADE), steps, made.truth


def walked(*legs):
    """Steps of 0.7 m along legs: their length [m], and the turn after each [rad]."""
    turns = [turn for length, after in legs for turn in ([0.0] * round(length / 0.7 - 1) + [after])]
    return steps_of(np.full(len(turns), 0.7), np.array(turns), sigma_length=0.05, sigma_turn=0.03)


def test_a_walk_is_found_on_its_plan_without_any_position():
    plan, steps, truth = demo()
    estimate = smooth(WalkGraph(steps, floor=plan))
    assert estimate.probability > 0.9
    assert error(estimate, truth).mean() < 2.0
    assert not plan.crosses_wall(estimate.trajectory.position[:-1], estimate.trajectory.position[1:]).any()


def test_no_filter_is_shown_of_a_walk_without_any_position():
    """It would begin at (0, 0), which may be millions of metres from the plan."""
    steps, building = straight(40), Building.around(aisles((40, 0)))
    seen = fixes_at(steps.time[:1], np.zeros((1, 2)))
    for fixes, names in ((Fixes.none(), []), (seen, ["filter"])):
        evidence = Evidence(Recording("", 0.0, None), Walker(), building, Frame(), fixes, steps=steps)
        assert list(estimate(evidence).causal()) == names


def test_a_symmetric_building_has_two_answers_of_one_half():
    """A rectangle of corridors, 30 m by 18 m, along three sides: it may be turned by half a turn."""
    ring = corridors(RING, width=2.4)
    estimate = smooth(WalkGraph(walked((28, TURN), (18, TURN), (28, 0.0)), floor=ring))
    assert [probability for probability, _ in estimate.routes] == pytest.approx([0.5, 0.5], abs=0.1)
    (_, one), (_, other) = estimate.routes
    assert one.position == pytest.approx([30, 18] - other.position, abs=2.0), "the same, turned by half a turn"
    sigma = np.sqrt(np.linalg.eigvalsh(estimate.trajectory.covariance[0, :2, :2])[-1])
    assert sigma > 0.8 * np.hypot(*(one.position[0] - other.position[0])) / 2, "the region spans both"
    assert verdict(estimate).state != "ok"


def test_a_wing_that_only_one_end_has_decides():
    """The control: with a corridor at one of the ends, into which the walk turns, there is one answer."""
    plan = corridors(RING, [(0, 18), (-14, 18)], width=2.4)
    estimate = smooth(WalkGraph(walked((28, TURN), (18, TURN), (40, 0.0)), floor=plan))
    assert estimate.probability > 0.9
    assert estimate.trajectory.position[-1] == pytest.approx([-11, 18], abs=2.5)


def test_a_plan_on_which_no_such_walk_is_possible_is_doubted():
    """60 m straight on, on a floor of 14 m by 14 m."""
    estimate = smooth(WalkGraph(walked((60, 0.0)), floor=corridors([(0, 0), (12, 0)], width=14)))
    assert estimate.probability < 0.5
    assert verdict(estimate).state != "ok"


def test_the_floor_on_which_a_walk_begins_is_found():
    """One floor has the walk's corridors, the other only a hall that is too small for it."""
    _, steps, truth = demo()
    right, hall = demo()[0], corridors([(0, 0), (12, 0)], width=12)
    graph, found = begun_on([WalkGraph(steps, floor=hall), WalkGraph(steps, floor=right)])
    assert graph.floor is right
    assert error(estimated(graph, found), truth).mean() < 2.0


def test_several_floors_are_several_possible_starts():
    walk, _ = scenario_walk("two_floors")
    building = Building.load(MAPS / "two_floors.geojson")
    inputs = Evidence(walk.recording(), Walker(), building, building.floors[0].frame, Fixes.none(), ())
    evidence = observe(inputs)
    assert [one.floors.labels[0] for one in (evidence, *evidence.others)] == ["1"], "it climbs one floor"
    level = replace(inputs, walk=replace(inputs.walk, barometer=None))
    evidence = observe(level)
    assert [one.floors.labels[0] for one in (evidence, *evidence.others)] == ["1", "2"]


# A plan that does not fit is named, and its walls are not used


@pytest.fixture(scope="module")
def arcade():
    return walk_in_the_arcade()


def fixes(truth, count=5):
    time = np.linspace(1.0, truth.time[-1] - 2, count)
    return fixes_at(time, interpolate(time, truth.time, truth.position), 1.0)


def displaced(plan, east):
    moved = (replace(area, shape=shapely.affinity.translate(area.shape, east)) for area in plan.areas)
    return replace(plan, areas=tuple(moved))


def reasons(estimate, source):
    return [reason for reason in verdict(estimate).reasons if reason.source == source]


def test_between_right_walls_the_walk_without_them_has_less_than_a_hundredth(arcade):
    steps, truth, plan = arcade
    optima = joint_solutions(WalkGraph(steps, fixes(truth), floor=plan))
    weight = probabilities(optima, np.arange(len(optima)))
    assert optima[0].graph.walled
    assert sum(w for w, optimum in zip(weight, optima, strict=True) if not optimum.graph.walled) < 0.01


def test_a_plan_six_metres_off_is_named_and_its_walls_are_not_used(arcade):
    steps, truth, plan = arcade
    wrong = smooth(WalkGraph(steps, fixes(truth), floor=displaced(plan, 6.0)))
    without = smooth(WalkGraph(steps, fixes(truth)))
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
    walk = smooth(straight_on(60, aisles((20, 0), (0, 20)), heading))
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
    walk = smooth(WalkGraph(steps, away, headings=headings, floor=plan))
    assert reasons(walk, "plan")
    assert coverage(walk.trajectory, truth) > 0.85


@pytest.mark.parametrize("method", [smooth, kalman_filter])
def test_the_probability_of_a_walk_beside_the_plan_is_zero_in_python_too(arcade, method):
    steps, truth, plan = arcade
    assert method(WalkGraph(steps, fixes(truth), floor=displaced(plan, 900.0))).probability == 0
    assert method(WalkGraph(steps, fixes(truth), floor=plan)).probability > 0.9


@pytest.fixture(scope="module")
def laps():
    """Seven laps of a corridor in 12 min: steps, true trajectory and plan."""
    corners = [[1.25, 1.25], [43.75, 1.25], [43.75, 26.75], [1.25, 26.75]]
    route = [corners[0], {"stand": 5}, *({"to": [*corners[1:], corners[0]]} for _ in range(7))]
    made = simulate(Scenario.of({"route": route, "plan": str(LOOP), "phone": {"rate": 50}}))
    return detect_steps(made.recording("accelerometer", "gyroscope")), made.truth, FloorPlan.load(LOOP)


def noisy_fixes(truth, east=0.0, north=0.0):
    time = np.arange(10.0, truth.time[-1], 60.0)
    noise = np.random.default_rng(0).normal(0, 3, (len(time), 2))
    return fixes_at(time, interpolate(time, truth.time, truth.position) + noise + [east, north], 3.0)


def test_what_right_walls_add_in_many_corridors_does_not_make_a_plan_wrong(laps):
    steps, truth, plan = laps
    walk = smooth(WalkGraph(steps, noisy_fixes(truth), floor=plan))
    assert verdict(walk).state == "ok"
    assert np.median(error(walk, truth)) < 0.8


@pytest.mark.thorough
def test_in_many_corridors_a_plan_five_metres_off_is_named(laps):
    steps, truth, plan = laps
    walk = smooth(WalkGraph(steps, noisy_fixes(truth, 4.0, 3.0), floor=plan))
    assert reasons(walk, "plan")
