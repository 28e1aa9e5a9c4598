"""The trial of an alternative path beside a walk under way, between two aisles with shops between them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from walks import PERIOD, fixes_at, steps_of

from pdr_graph import FloorPlan
from pdr_graph.estimation.live.live_ambiguity import try_path
from pdr_graph.estimation.live.live_smoother import LiveSmoother
from pdr_graph.estimation.live.window import Path
from pdr_graph.floor.building import Building
from pdr_graph.floor.cells import Area
from pdr_graph.frames import Frame
from pdr_graph.priors import SCHEDULE

STRIDE, STEPS, EVERY = 0.7, 60, 10
RIGHT, OTHER, SHOP = 1.0, 9.0, -2.0  # y of the middle of the aisles and a shop; fixes are along the first [m]


def two_aisles(length=100.0):
    """Two aisles of 2 m with shops beside and between them."""
    shops = (shapely.box(0, low, length, high) for low, high in ((-4, 0), (2, 8), (10, 14)))
    areas = (Area("floor", "", shapely.box(-2, -4, length, 14)), *(Area("shop", "", shop) for shop in shops))
    return Building.around(FloorPlan("1", areas, Frame()))


@pytest.fixture(scope="module")
def walking():
    """A walk along the first aisle, still going on; it is sure."""
    live = LiveSmoother(lag=60.0, plan=two_aisles())
    step = steps_of(np.full(1, STRIDE), np.zeros(1))
    for n in range(STEPS):
        begin, end = PERIOD * n, PERIOD * (n + 1)
        live.extend(replace(step, start=begin, end=end, time=np.array([end])))
        if n % EVERY == 0:
            live.append(fixes_at([end], [[STRIDE * (n + 1), RIGHT]], 1.0))
    assert live.sure
    return live


def along(graph, y):
    """The window's path, straight along an aisle."""
    times = np.array(graph.window.times)
    place = STRIDE / PERIOD * times
    pose = np.column_stack([place, np.full(len(times), y), np.zeros(len(times))])
    return Path(times, pose, times[:1], np.array([[1.0, 1.0, 0.0]]))


def trial(live, graph, y, decisions=None):
    """The trial of a path along an aisle, beside a graph."""
    alternative = along(graph, y)
    return try_path(graph.copy(), lambda: (alternative, decisions or {}), SCHEDULE.rounds)


def test_the_other_aisle_costs_more(walking):
    assert trial(walking, walking.graph, OTHER) is None


def test_the_present_path_is_no_alternative_to_itself(walking):
    assert trial(walking, walking.graph, RIGHT) is None


def test_a_path_that_has_left_the_window_is_no_alternative(walking):
    """Particles that are behind: in a rest, one keyframe is left."""
    path = along(walking.graph, OTHER)
    past = replace(path, time=path.time - path.time[-1] - 10.0)
    assert try_path(walking.graph.copy(), lambda: (past, {}), SCHEDULE.rounds) is None


def test_out_of_the_shops_the_aisle_is_found(walking):
    """A walk through the shop beside the aisle, which takes all fixes for outliers, pays the shop's price."""
    graph = walking.graph.copy()
    decided = walking.graph.decisions
    graph.decide({"fixes": decided["fixes"] | {"held": np.zeros(STEPS // EVERY, dtype=bool)}})
    graph.move_to(along(graph, SHOP))
    assert np.abs(graph.window.pose[:, 1] - SHOP).max() < 0.1, "a control: it stays there"
    found = trial(walking, graph, RIGHT, decided)
    assert found is not None
    path, decisions = found
    graph.decide(decisions)
    graph.move_to(path)
    assert np.abs(graph.window.pose[:, 1] - RIGHT).max() < 0.1


def test_a_trial_leaves_the_walk_as_it_is(walking):
    graph = walking.graph
    pose, marginals, at, cost = graph.window.pose.copy(), list(graph.marginals), graph.at, graph.cost
    trial(walking, graph, OTHER)
    assert np.array_equal(graph.window.pose, pose)
    assert graph.marginals == marginals
    assert graph.at is at
    assert graph.cost == cost
