"""The corridor network, as a plan draws it."""

import numpy as np
import pytest
import shapely
from plans import MAPS, plan

from pdr_graph import FloorPlan

W, X, Y = 2.5, 45.0, 28.0  # [m] of maps/loop.geojson


def test_the_network_of_the_loop_is_that_of_its_middles_and_corners():
    network = FloorPlan.load(MAPS / "loop.geojson").network
    middles = {(x, y) for x in (W / 2, X - W / 2) for y in (W / 2, Y - W / 2)}
    assert {tuple(node) for node in network.nodes.round(2).tolist()} == middles
    for node, corners in zip(network.nodes, network.corners, strict=True):
        assert np.abs(corners - node) == pytest.approx(W / 2, abs=0.01)
        assert shapely.is_ccw(shapely.linearrings(corners))
    assert len({frozenset(link) for link in network.links.tolist()}) == len(network) == 4
    assert network.width == pytest.approx([W] * 4, abs=0.12)
    for (i, j), line in zip(network.links, network.lines, strict=True):
        assert line == pytest.approx(network.nodes[[i, j]], abs=0.01)
        assert np.ptp(line, axis=0).min() == pytest.approx(0, abs=0.01), "along one side"


def test_links_follow_the_corridors_if_no_line_is_drawn():
    crossing = ("intersection", shapely.box(-1, -1, 1, 1))
    ways = [("corridor", shapely.box(1, -1, 20, 1)), ("corridor", shapely.box(-1, 1, 1, 15))]
    network = plan(crossing, *ways).network
    assert len(network.nodes) == 3
    assert len(network) == 2
    assert np.sort(network.nodes, axis=0) == pytest.approx(np.array([[0, 0], [0, 0], [20, 15]]), abs=0.01)


def test_a_plan_without_intersections_or_with_a_link_through_a_wall_has_no_network():
    hall, line = ("corridor", shapely.box(-5, -1, 20, 1)), ("link", shapely.LineString([(0, 0), (20, 0)]))
    crossing, wall = ("intersection", shapely.box(-1, -1, 1, 1)), ("wall", shapely.box(9, -1, 10, 1))
    assert len(plan(hall, line, crossing).network) == 1
    for areas in ([hall, line], [hall, line, crossing, wall], [("floor", shapely.box(0, 0, 9, 6))]):
        network = plan(*areas).network
        assert (len(network), network.nodes.shape, network.corners.shape) == (0, (0, 2), (0, 4, 2))
