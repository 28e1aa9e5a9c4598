"""Corridors as measurements: turns at intersections, and directions of straight runs."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from plans import plan
from walks import fixes_at, steps_of

from pdr_graph.estimation.factors.corridor import SIGMA_PLACE, CorridorFactor
from pdr_graph.estimation.factors.start import CorridorUse, Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.geometry import wrap_angle

WIDTH = 4.0  # [m]: a walker in the middle of 4 m feels no wall, whose margin is 0.8 m
ASKEW = 0.06  # [rad] by which the walk is laid wrongly: 1.2 m at the end of 20 m, still clear of the walls
CORNER = (
    ("corridor", shapely.box(-2, -WIDTH / 2, 20 - WIDTH / 2, WIDTH / 2)),
    ("intersection", shapely.box(20 - WIDTH / 2, -WIDTH / 2, 20 + WIDTH / 2, WIDTH / 2)),
    ("corridor", shapely.box(20 - WIDTH / 2, WIDTH / 2, 20 + WIDTH / 2, 24)),
)
ELL = plan(*CORNER)


def ell_walk(**use):
    """Twenty metres east and, after a turn on the spot, twenty north; from a known start."""
    turn = np.zeros(60)
    turn[30] = np.pi / 2
    steps = steps_of(np.full(60, 20 / 30), turn)
    steps = replace(steps, duration=steps.duration / 2, pause_turn=turn)
    return WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]], 0.3), floor=ELL, prior=Prior(corridors=CorridorUse(**use)))


def test_corridors_are_matched_only_on_request():
    graph = ell_walk()
    assert graph.associated_at(graph.start).find(CorridorFactor) is None


def test_a_straight_run_determines_the_direction_where_walls_are_far():
    wrong = []
    for directions in (False, True):
        graph = ell_walk(directions=directions)
        askew = graph.start.rotated(ASKEW, np.zeros(2))
        solved = optimize(graph.associated_at(askew), askew)
        wrong.append(abs(wrap_angle(solved.state.poses[1, 2])))
    assert wrong[1] < wrong[0] / 2


def test_a_turn_at_its_intersection_costs_nothing():
    graph = ell_walk(turns=True, directions=True)
    graph = graph.associated_at(graph.start)
    corridors, at = graph.find(CorridorFactor), graph.evaluate(graph.start)
    assert len(corridors.turns) == 1
    assert not len(corridors.keyframe), "the turn tells of both runs"
    assert at.poses.value[corridors.turns.piece[0], :2] == pytest.approx([20, 0], abs=0.7)
    for name in ("corridors.turn", "corridors.intersection"):
        [block] = at.blocks_of(name)
        assert len(block) == 1
        assert not block.residual.any()
    assert corridors.turns.least[0] < np.pi / 2 < corridors.turns.most[0]


def test_a_turn_outside_its_intersection_has_its_distance_as_residual():
    """The turn is 3 m short of the corner, in a corridor that is open to it, so walls add nothing."""
    graph = ell_walk(turns=True)
    matched = graph.associated_at(graph.start)
    short = graph.start.replaced(x=graph.start.poses - np.array([3.0, 0.0, 0.0]))
    [outside] = matched.evaluate(short).blocks_of("corridors.intersection")
    assert outside.residual.max() == pytest.approx((3.0 - WIDTH / 2) / SIGMA_PLACE, abs=0.1)


def test_matches_are_removed_with_the_plan():
    graph = ell_walk(directions=True)
    matched = graph.associated_at(graph.start)
    without = matched.without_plan()
    turns, left = ({b.name for b in version.evaluate(version.start).blocks if len(b)} for version in (matched, without))
    assert turns - left == {"walls", "corridors.direction"}
    assert without.find(CorridorFactor) is None
