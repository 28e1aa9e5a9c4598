"""Corridors as measurements: turns at intersections, and directions of straight runs."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from plans import plan
from walks import fixes_at, steps_of

from pdr_graph.estimation.factors.corridors import CorridorFactor, TurnFactor
from pdr_graph.estimation.factors.start import Prior
from pdr_graph.estimation.graph import WalkGraph
from pdr_graph.estimation.optimizer import optimize
from pdr_graph.geometry import wrap_angle
from pdr_graph.priors import TURNS

WIDTH = 4.0  # [m]: a walker in the middle of 4 m feels no wall, whose margin is 0.8 m
ASKEW = 0.06  # [rad] by which the walk is laid wrongly: 1.2 m at the end of 20 m, still clear of the walls
CORNER = (
    ("corridor", shapely.box(-2, -WIDTH / 2, 20 - WIDTH / 2, WIDTH / 2)),
    ("intersection", shapely.box(20 - WIDTH / 2, -WIDTH / 2, 20 + WIDTH / 2, WIDTH / 2)),
    ("corridor", shapely.box(20 - WIDTH / 2, WIDTH / 2, 20 + WIDTH / 2, 24)),
)
ELL = plan(*CORNER)


def ell_walk(*corridors):
    """Twenty metres east and, after a turn on the spot, twenty north; from a known start."""
    turn = np.zeros(60)
    turn[30] = np.pi / 2
    steps = steps_of(np.full(60, 20 / 30), turn)
    steps = replace(steps, duration=steps.duration / 2, pause_turn=turn)
    return WalkGraph(steps, fixes_at([0.0], [[0.0, 0.0]], 0.3), floor=ELL, prior=Prior(corridors=corridors))


def test_corridors_are_matched_only_on_request():
    graph = ell_walk()
    matched = graph.associated_at(graph.start)
    assert matched.find(CorridorFactor) is matched.find(TurnFactor) is None
    with pytest.raises(ValueError, match="expected 'directions', 'turns'"):
        Prior(corridors=("both",))


def test_a_straight_run_determines_the_direction_where_walls_are_far():
    wrong = []
    for corridors in ((), ("directions",)):
        graph = ell_walk(*corridors)
        askew = graph.start.rotated(ASKEW, np.zeros(2))
        solved = optimize(graph.associated_at(askew), askew)
        wrong.append(abs(wrap_angle(solved.state.poses[1, 2])))
    assert wrong[1] < wrong[0] / 2


def test_a_turn_at_its_intersection_costs_nothing():
    graph = ell_walk("turns")
    graph = graph.associated_at(graph.start)
    turns, at = graph.find(TurnFactor), graph.evaluate(graph.start)
    assert len(turns) == 1
    assert at.ends[turns.piece[0], :2] == pytest.approx([20, 0], abs=0.7)
    for name in ("turns.angle", "turns.place"):
        [block] = at.blocks_of(name)
        assert len(block) == 1
        assert not block.residual.any()
    assert turns.least[0] < np.pi / 2 < turns.most[0]


def test_a_turn_outside_its_intersection_has_its_distance_as_residual():
    """The turn is 3 m short of the corner, in a corridor that is open to it, so walls add nothing."""
    graph = ell_walk("turns")
    matched = graph.associated_at(graph.start)
    short = graph.start.replaced(x=graph.start.poses - np.array([3.0, 0.0, 0.0]))
    [outside] = matched.evaluate(short).blocks_of("turns.place")
    assert outside.residual.max() == pytest.approx((3.0 - WIDTH / 2) / TURNS.place, abs=0.1)


@pytest.mark.parametrize(
    ("corridors", "names"), [("directions", {"corridors"}), ("turns", {"turns.angle", "turns.place"})]
)
def test_matches_are_removed_with_the_plan(corridors, names):
    graph = ell_walk(corridors)
    matched = graph.associated_at(graph.start)
    without = matched.without_plan()
    whole, left = ({b.name for b in version.evaluate(version.start).blocks if len(b)} for version in (matched, without))
    assert whole - left == {"walls"} | names
    assert without.find(CorridorFactor) is without.find(TurnFactor) is None
