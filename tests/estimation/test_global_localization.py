"""Without any position, a walk is sought on its whole plan: by its turns, between the walls."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely

from pdr_graph import Building, FloorPlan, WalkGraph, detect_steps, smooth
from pdr_graph.estimation.ambiguity.plan_hypotheses import begun_on
from pdr_graph.estimation.smoother import estimated
from pdr_graph.estimation.verdict import verdict
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame
from pdr_graph.gait.walker import Walker
from pdr_graph.geometry import interpolate
from pdr_graph.lab.simulation.scenario import Scenario
from pdr_graph.lab.simulation.simulate import simulate
from pdr_graph.types import Fixes, Recording, Steps
from pdr_graph.walk import Evidence, estimate, observe

ROOT = Path(__file__).resolve().parents[2]
TURN = np.pi / 2


@cache
def arcade():
    """The plan of the arcade, the steps of a walk in it, and its truth."""
    scenario = Scenario.load("arcade")
    walk = simulate(scenario)
    return FloorPlan.load(ROOT / "maps" / "arcade.geojson"), detect_steps(walk.recording()), walk.truth


def corridor(line, width=2.4, more=()):
    """A plan of corridors along lines [m]."""
    lines = [shapely.buffer(shapely.LineString(one), width / 2, cap_style="square") for one in (line, *more)]
    shape = shapely.union_all(lines)
    return FloorPlan("", (Area("corridor", "", shape),), Frame())


def walked(*legs):
    """Steps of 0.7 m along legs: their length [m], and the turn after each [rad]."""
    turns = [turn for length, after in legs for turn in ([0.0] * round(length / 0.7 - 1) + [after])]
    n = len(turns)
    return Steps(
        start=0.0,
        end=0.5 * n,
        time=0.5 * np.arange(1, n + 1),
        duration=np.full(n, 0.5),
        length=np.full(n, 0.7),
        turn=np.array(turns),
        sigma_length=np.full(n, 0.05),
        sigma_turn=np.full(n, 0.03),
        pause_turn=np.zeros(n),
    )


def error(estimate, truth):
    track = estimate.trajectory
    return np.hypot(*(track.position - interpolate(track.time, truth.time, truth.position)).T).mean()


def test_a_walk_is_found_on_its_plan_without_any_position():
    plan, steps, truth = arcade()
    estimate = smooth(WalkGraph(steps, floor=plan))
    assert estimate.probability > 0.9
    assert error(estimate, truth) < 2.0
    assert not plan.crosses_wall(estimate.trajectory.position[:-1], estimate.trajectory.position[1:]).any()


def test_no_filter_is_shown_of_a_walk_without_any_position():
    """It would begin at (0, 0), which may be millions of metres from the plan."""
    plan, steps, _ = arcade()
    seen = Fixes(steps.time[:1], np.zeros((1, 2)), np.ones(1), ("",))
    for fixes, names in ((Fixes.none(), []), (seen, ["filter"])):
        building = Building.around(plan)
        evidence = Evidence(Recording("", 0.0, None), Walker(), building, Frame(), fixes, steps=steps)
        assert list(estimate(evidence).causal()) == names


def test_a_symmetric_building_has_two_answers_of_one_half():
    """A rectangle of corridors, 30 m by 18 m, along three sides: it may be turned by half a turn."""
    ring = corridor([(0, 0), (30, 0), (30, 18), (0, 18), (0, 0)])
    estimate = smooth(WalkGraph(walked((28, TURN), (18, TURN), (28, 0.0)), floor=ring))
    assert [probability for probability, _ in estimate.routes] == pytest.approx([0.5, 0.5], abs=0.1)
    (_, one), (_, other) = estimate.routes
    assert one.position == pytest.approx([30, 18] - other.position, abs=2.0), "the same, turned by half a turn"
    sigma = np.sqrt(np.linalg.eigvalsh(estimate.trajectory.covariance[0, :2, :2])[-1])
    assert sigma > 0.8 * np.hypot(*(one.position[0] - other.position[0])) / 2, "the region spans both"
    assert verdict(estimate).state != "ok"


def test_a_wing_that_only_one_end_has_decides():
    """The control: with a corridor at one of the ends, into which the walk turns, there is one answer."""
    plan = corridor([(0, 0), (30, 0), (30, 18), (0, 18), (0, 0)], more=[[(0, 18), (-14, 18)]])
    estimate = smooth(WalkGraph(walked((28, TURN), (18, TURN), (40, 0.0)), floor=plan))
    assert estimate.probability > 0.9
    assert estimate.trajectory.position[-1] == pytest.approx([-11, 18], abs=2.5)


def test_a_plan_on_which_no_such_walk_is_possible_is_doubted():
    """60 m straight on, on a floor of 14 m by 14 m."""
    estimate = smooth(WalkGraph(walked((60, 0.0)), floor=corridor([(0, 0), (12, 0)], width=14)))
    assert estimate.probability < 0.5
    assert verdict(estimate).state != "ok"


def test_the_floor_on_which_a_walk_begins_is_found():
    """One floor has the walk's corridors, the other only a hall that is too small for it."""
    _, steps, truth = arcade()
    right, hall = arcade()[0], corridor([(0, 0), (12, 0)], width=12)
    graph, found = begun_on([WalkGraph(steps, floor=hall), WalkGraph(steps, floor=right)])
    assert graph.floor is right
    assert error(estimated(graph, found), truth) < 2.0


def test_several_floors_are_several_possible_starts():
    walk = simulate(Scenario.load("two_floors"))
    building = Building.load(ROOT / "maps" / "two_floors.geojson")
    inputs = Evidence(walk.recording(), Walker(), building, building.floors[0].frame, Fixes.none(), ())
    evidence = observe(inputs)
    assert [one.floors.labels[0] for one in (evidence, *evidence.others)] == ["1"], "it climbs one floor"
    level = replace(inputs, walk=replace(inputs.walk, barometer=None))
    evidence = observe(level)
    assert [one.floors.labels[0] for one in (evidence, *evidence.others)] == ["1", "2"]
